//! Two machines that differ: the state that the first one learned for a recipe, and its benefit for the second
//! machine's first part of that recipe.

use regrind::compensation::{Correction, GainRule, LearningState, MachineSimilarity};
use regrind::formats::{CellRun, Learned};
use regrind_sim::spec::{GrinderSpec, WorldSpec};
use regrind_sim::world::World;

use super::identifiability::normal;
use super::{After, Bench, Line, Way};

/// How the second machine differs from the first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Differ {
    /// Every number of the systematic errors of either machine differs independently from that of their type, and each
    /// machine has its own waviness.
    By {
        /// RMS share by which a number differs.
        share: f64,
        /// Amplitude of the waviness.
        waviness_um: f64,
    },
    /// The second machine has nothing in common with the first: every number is drawn independently, including its
    /// sign.
    Unrelated,
}

/// One world: results of the first part on the second machine, with and without the state learned on the first machine.
#[derive(Clone, Debug)]
pub struct TransferResult {
    /// Truth after each pass, with the learned state.
    pub with: Vec<After>,
    /// Truth after each pass, without it.
    pub without: Vec<After>,
    /// RMS of the difference between the repeatable errors of the two machines, in µm.
    pub apart_um: f64,
    /// Number of wavelength bands in which a learned error was transferred.
    pub bands: usize,
    /// Maximum RMS share by which the machines were assumed to differ.
    pub differ: f64,
}

/// Number of parts of the recipe that the first machine has made.
pub const TAUGHT_BY: u32 = 2;

/// Two recipes that both machines know.
pub struct Pair<'a> {
    /// Recipe whose learned state is transferred.
    pub taught: &'a Bench,
    /// Recipe by which the machines are compared.
    pub in_common: &'a Bench,
}

impl Pair<'_> {
    /// Grinds, on both machines, a part of the common recipe; on the first machine, `parts` of the other recipe; then
    /// on the second machine its first part of that recipe, with and without the state learned on the first. Each part
    /// has `passes` passes.
    pub fn world(&self, seed: u64, differ: Differ, parts: u32, passes: u16) -> TransferResult {
        let [first, second] = machines(seed, differ, &self.taught.spec.grinder);
        let [a, b] = [2 * seed + 1_000_000, 2 * seed + 1_000_001];
        let mut alike = MachineSimilarity::default();
        let of_common = [(&first, a), (&second, b)].map(|(grinder, seed)| {
            let (_, found) = self.in_common.ground(grinder, seed, None, 1, passes);
            found.expect("passes").1
        });
        alike.compare([&of_common[0], &of_common[1]], true);
        let found = self.taught.ground(&first, a, None, parts, passes).1;
        let begun = self.taught.begun_with(found.expect("passes"), &alike);
        let told = begun.origin.as_ref().expect("others' word");
        let (bands, largest) =
            (told.machine_difference.len(), told.machine_difference.iter().map(|of| of[1]).fold(0.0, f64::max));
        let with = self.taught.ground(&second, b, Some((begun.correction, begun.known)), 1, passes).0;
        let without = self.taught.ground(&second, b, None, 1, passes).0;
        let apart_um = self.taught.apart_um([(&first, a), (&second, b)]);
        TransferResult { with, without, apart_um, bands, differ: largest }
    }
}

impl Bench {
    /// Returns the same pair, where the part lies on the CMM at the fixture pose of the cell file, except for the error
    /// of each loading. A recipe that locks directions of the pose relies on the fixture pose. If that pose is wrong by
    /// tenths of a millimetre, the resulting form error is not an error of the machines.
    pub fn commissioned(self) -> Self {
        let mut spec = self.spec;
        let fixture = self.task.fixture_cmm_from_model;
        let (x, y, z) = nalgebra::Rotation3::from_matrix_unchecked(fixture.rotation).euler_angles();
        (spec.cmm.translation_mm, spec.cmm.rotation_deg) =
            (fixture.translation_mm.into(), [x, y, z].map(f64::to_degrees));
        Self { spec, ..self }
    }

    /// Makes parts on a grinder. Returns the truth after the passes of the last part, and the learned state.
    fn ground(
        &self,
        grinder: &GrinderSpec,
        seed: u64,
        mut begun: Option<(Correction, LearningState)>,
        parts: u32,
        passes: u16,
    ) -> (Vec<After>, Option<(Correction, LearningState)>) {
        let spec = WorldSpec { seed, grinder: GrinderSpec { scallops: false, ..grinder.clone() }, ..self.spec.clone() };
        let (world, twin) = (World::new(spec.clone()).unwrap(), World::new(super::random_alone(&spec)).unwrap());
        let mut after = Vec::new();
        for part in 1..=parts {
            let way = Way::Regrind(GainRule::default());
            let mut line = Line::new(self, way, &world, &twin, begun.take(), part);
            after = (1..=passes).map(|cycle| line.pass(cycle)).collect();
            begun = line.learned();
        }
        (after, begun)
    }

    /// Returns the RMS of the difference of the first pass on two grinders without random errors, in µm.
    fn apart_um(&self, machines: [(&GrinderSpec, u64); 2]) -> f64 {
        let [first, second] = machines.map(|(grinder, seed)| {
            let grinder = GrinderSpec { scallops: false, repeatability_um: 0.0, ..grinder.clone() };
            World::new(WorldSpec { seed, grinder, ..self.spec.clone() }).unwrap()
        });
        Line::new(self, Way::Regrind(GainRule::default()), &second, &first, None, 1).pass(1).repeatable_um
    }

    /// Returns the initial state of a run that starts from another machine's learned state.
    fn begun_with(&self, (correction, known): (Correction, LearningState), alike: &MachineSimilarity) -> Learned {
        let learned = Learned::new(true, "the first machine".into(), "run-1".into(), correction, known);
        let from = CellRun { cell: "cell-1".into(), run: "run-1".into() };
        self.task.learned_from_others(&[(from, learned)], alike).expect("it ground the same recipe")
    }
}

/// Draws two machines of the type of a grinder.
fn machines(seed: u64, differ: Differ, of_type: &GrinderSpec) -> [GrinderSpec; 2] {
    let mut rng = regrind_sim::rng(seed);
    let mut drawn = || normal(&mut rng);
    match differ {
        Differ::By { share, waviness_um } => [0, 1].map(|_| {
            let of = GrinderSpec { waviness_um, ..of_type.clone() };
            with_numbers(&of, |value| value * (1.0 + share * drawn()))
        }),
        Differ::Unrelated => [of_type.clone(), with_numbers(of_type, |value| value * drawn())],
    }
}

/// Returns the same grinder with other numbers for its repeatable errors: wheel, setting, slides, screw, wear and
/// thermal growth.
fn with_numbers(of: &GrinderSpec, mut other: impl FnMut(f64) -> f64) -> GrinderSpec {
    GrinderSpec {
        wheel_radius_error_um: other(of.wheel_radius_error_um),
        setting_error_um: of.setting_error_um.map(&mut other),
        straightness_x_um: of.straightness_x_um.map(&mut other),
        straightness_y_um: of.straightness_y_um.map(&mut other),
        periodic_um: other(of.periodic_um),
        following_um: other(of.following_um),
        wear_um: other(of.wear_um),
        break_in_um: other(of.break_in_um),
        thermal_um: other(of.thermal_um),
        ..of.clone()
    }
}
