//! Two machines that differ: what the first one learned of a recipe, and what that is worth to the second one's first part of it.

use regrind::compensation::{Alike, Correction, GainRule, LearningState};
use regrind::formats::{CellRun, Learned};
use regrind_sim::spec::{GrinderSpec, WorldSpec};
use regrind_sim::world::World;

use super::told_apart::normal;
use super::{After, Bench, Line, Way};

/// How the second machine differs from the first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Differ {
    /// Every number of the systematic errors of either differs from that of their type by so much (rms share), each by itself, and either has a
    /// waviness of its own of so many micrometres.
    By { share: f64, waviness_um: f64 },
    /// The second has nothing in common with the first: every number is drawn anew, its sign too.
    Unrelated,
}

/// One world: what the first part on the second machine came to, with and without what the first machine taught.
#[derive(Clone, Debug)]
pub struct Taught {
    /// Truth after each pass.
    pub with: Vec<After>,
    pub without: Vec<After>,
    /// RMS by which what comes back in every pass on the two machines differs.
    pub apart_um: f64,
    /// In how many bands of wavelengths something was taken over, and the largest rms share that machines were taken to differ by.
    pub bands: usize,
    pub differ: f64,
}

/// How many parts the first machine has made of the recipe.
pub const TAUGHT_BY: u32 = 2;

/// Two recipes that both machines know: the one that is taught, and the one by which the machines are compared.
pub struct Pair<'a> {
    pub taught: &'a Bench,
    pub in_common: &'a Bench,
}

impl Pair<'_> {
    /// Both machines grind a part of the recipe in common; the first one `parts` of the other recipe; then the second its first of it, with and
    /// without what the first taught. Each part has so many passes.
    pub fn world(&self, seed: u64, differ: Differ, parts: u32, passes: u16) -> Taught {
        let [first, second] = machines(seed, differ, &self.taught.spec.grinder);
        let [a, b] = [2 * seed + 1_000_000, 2 * seed + 1_000_001];
        let mut alike = Alike::default();
        let of_common = [(&first, a), (&second, b)].map(|(grinder, seed)| {
            let (_, found) = self.in_common.ground(grinder, seed, None, 1, passes);
            found.expect("passes").1
        });
        alike.compare([&of_common[0], &of_common[1]], true);
        let found = self.taught.ground(&first, a, None, parts, passes).1;
        let begun = self.taught.begun_with(found.expect("passes"), &alike);
        let told = begun.taught_by.as_ref().expect("others' word");
        let (bands, largest) = (told.differ.len(), told.differ.iter().map(|of| of[1]).fold(0.0, f64::max));
        let with = self.taught.ground(&second, b, Some((begun.correction, begun.known)), 1, passes).0;
        let without = self.taught.ground(&second, b, None, 1, passes).0;
        let apart_um = self.taught.apart_um([(&first, a), (&second, b)]);
        Taught { with, without, apart_um, bands, differ: largest }
    }
}

impl Bench {
    /// The same where the part lies on the CMM where the cell's file says that the fixture holds it, but for what it is off by at each loading: a recipe
    /// that holds motions believes the fixture, and where that is off by tenths of a millimetre no machine is to blame for the form that it costs.
    pub fn commissioned(self) -> Self {
        let mut spec = self.spec;
        let fixture = self.task.fixture_cmm_from_model;
        let (x, y, z) = nalgebra::Rotation3::from_matrix_unchecked(fixture.rotation).euler_angles();
        (spec.cmm.translation_mm, spec.cmm.rotation_deg) =
            (fixture.translation_mm.into(), [x, y, z].map(f64::to_degrees));
        Self { spec, ..self }
    }

    /// Makes parts on a grinder; returns the truth after the passes of the last one, and what was learned.
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

    /// RMS of the difference of the first pass on two grinders of which neither adds anything by chance, in micrometres.
    fn apart_um(&self, machines: [(&GrinderSpec, u64); 2]) -> f64 {
        let [first, second] = machines.map(|(grinder, seed)| {
            let grinder = GrinderSpec { scallops: false, repeatability_um: 0.0, ..grinder.clone() };
            World::new(WorldSpec { seed, grinder, ..self.spec.clone() }).unwrap()
        });
        Line::new(self, Way::Regrind(GainRule::default()), &second, &first, None, 1).pass(1).repeatable_um
    }

    /// What a run begins with that another machine's run has taught.
    fn begun_with(&self, (correction, known): (Correction, LearningState), alike: &Alike) -> Learned {
        let learned = Learned::new(true, "the first machine".into(), "run-1".into(), correction, known);
        let from = CellRun { cell: "cell-1".into(), run: "run-1".into() };
        self.task.from_others(&[(from, learned)], alike).expect("it ground the same recipe")
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

/// The same grinder with other numbers of what comes back in every pass: wheel, setting, slides, screw, wear and warmth.
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
