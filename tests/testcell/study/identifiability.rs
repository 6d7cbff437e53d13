//! Machine parameters in many worlds: estimated, compensated, and compared with the map alone, by the truth.

use crate::perfect::perfect_grinder;
use regrind::compensation::path::nominal_height_field;
use regrind::compensation::{GainRule, ParameterKind, SurfacePoint, WheelTerm};
use regrind::drive::ParameterCompensation;
use regrind::geometry::Grid;
use regrind_sim::spec::{GrinderSpec, WorldSpec};
use regrind_sim::world::World;

use super::{After, Bench, Line, Machine, Way};

/// Expanded uncertainties of the radius of a wheel as dressed, of the setting of the wheel and the clamping of a part,
/// and of the datum of the CMM.
const RADIUS_UM: f64 = 100.0;
const SETTING_UM: f64 = 15.0;
const TILT_URAD: f64 = 60.0;
const DATUM_UM: f64 = 0.5;
/// Bow of the slides, to either side, in µm.
const STRAIGHT_UM: f64 = 0.6;
/// Maximum ratio of the error after a pass to the error that the pass adds by itself, for the pass to be at the floor.
const AT_FLOOR: f64 = 1.2;

/// Results of one world.
#[derive(Clone, Debug)]
pub struct Compared {
    /// Estimates of the parameters.
    pub parameters: Vec<ParameterResult>,
    /// Truth after every pass, with parameters.
    pub with: Vec<After>,
    /// Truth after every pass, by the map alone.
    pub alone: Vec<After>,
}

/// Estimate of one parameter. Values are in the unit in which the parameter is displayed.
#[derive(Clone, Copy, Debug)]
pub struct ParameterResult {
    /// Parameter.
    pub kind: ParameterKind,
    /// Estimate minus truth, divided by the expanded uncertainty.
    pub off: f64,
    /// Expanded uncertainty of the estimate.
    pub expanded: f64,
    /// True value.
    pub truth: f64,
    /// Value that was compensated.
    pub taken: f64,
    /// True if the compensated value exceeds its tolerance.
    pub is_beyond: bool,
}

impl Bench {
    /// Returns the same bench with the given pose directions locked. If any is locked, a datum locates the part in the
    /// grinder in every direction in which the part can be off.
    pub fn held(mut self, held: [bool; 6]) -> Self {
        self.task.registration_options.locked = held;
        if held.contains(&true) {
            self.task.start_at_fixture = true;
            self.task.locked_sigmas = Some(self.datum());
        }
        self
    }

    fn datum(&self) -> [f64; 2] {
        let [x, y] = [self.task.pass.x_mm, self.task.pass.y_mm].map(|[low, high]| high - low);
        let shift_mm = 0.5e-3 * DATUM_UM;
        [shift_mm, shift_mm / (0.5 * x.max(y))]
    }

    /// Returns the same bench on another machine.
    pub fn on(self, machine: Machine) -> Self {
        Self { machine, ..self }
    }

    /// Returns a world whose wheel and part have errors within their tolerances. All other values are those of the
    /// shipped recipe.
    fn off(&self, seed: u64) -> WorldSpec {
        let mut drawn = regrind_sim::rng(seed ^ 0x5eed_0ff5);
        let mut draw = |expanded: f64| 0.5 * expanded * normal(&mut drawn);
        let mut spec = WorldSpec { seed, ..self.spec.clone() };
        let grinder = &mut spec.grinder;
        let straight_um = [[draw(STRAIGHT_UM), draw(STRAIGHT_UM)], [draw(STRAIGHT_UM), draw(STRAIGHT_UM)]];
        if self.machine == Machine::Good {
            [grinder.straightness_x_um, grinder.straightness_y_um] = straight_um;
            (grinder.waviness_um, grinder.periodic_um, grinder.following_um) = (0.15, 0.05, 0.05);
            (grinder.wear_um, grinder.break_in_um, grinder.thermal_um) = (0.6, 0.2, 0.8);
        }
        grinder.wheel_radius_error_um = draw(RADIUS_UM);
        grinder.setting_error_um = [draw(SETTING_UM), draw(SETTING_UM)];
        grinder.setting_error_z_um = draw(SETTING_UM);
        grinder.part_tilt_urad = [draw(TILT_URAD), draw(TILT_URAD)];
        if self.task.locked_sigmas.is_some() {
            let [shift_mm, turn_rad] = self.datum();
            spec.cmm.translation_mm = [0.0; 3];
            spec.cmm.rotation_deg = [0.0; 3];
            spec.cmm.loading_shift_um = 1e3 * shift_mm;
            spec.cmm.loading_turn_deg = turn_rad.to_degrees();
        }
        spec
    }

    /// Makes one part in a world whose machine has errors, with parameters and by the map alone.
    pub fn told_apart(&self, seed: u64, passes: u16) -> Compared {
        let spec = self.off(seed);
        let (told, with) = self.with_parameters().line_of(&spec, passes);
        let (_, alone) = self.without_parameters().line_of(&spec, passes);
        Compared { parameters: told, with, alone }
    }

    fn line_of(&self, spec: &WorldSpec, passes: u16) -> (Vec<ParameterResult>, Vec<After>) {
        let of = &spec.grinder;
        let twin = super::random_alone(spec);
        let still =
            WorldSpec { grinder: GrinderSpec { repeatability_um: 0.0, ..twin.grinder.clone() }, ..twin.clone() };
        let [world, twin, still] = [spec.clone(), twin, still].map(|spec| World::new(spec).unwrap());
        let mut line = Line::new(self, Way::Regrind(GainRule::Wavelength), &world, &twin, None, 1);
        line.still = Some((&still, still.grinder()));
        let after = (1..=passes).map(|cycle| line.pass(cycle)).collect();
        let told = line.told.iter().flat_map(|told| &told.estimates);
        let told = told.filter(|p| p.inseparable_from.is_empty() && p.kind != ParameterKind::Wear).map(|p| {
            let drift_um = if p.kind == ParameterKind::SettingZ { self.drift_um(spec) } else { 0.0 };
            let truth = (truth(of, p.kind) + drift_um) / p.kind.display_units_per_unit();
            let units = p.kind.display_units_per_unit();
            ParameterResult {
                kind: p.kind,
                off: (p.value - truth) / (2.0 * p.sigma),
                expanded: 2.0 * units * p.sigma,
                truth: units * truth,
                taken: units * p.compensated,
                is_beyond: p.exceeds_tolerance,
            }
        });
        (told.collect(), after)
    }

    /// Returns the mean height that wear and spindle growth add, equally in every pass, in µm. It cannot be
    /// distinguished from an error of the wheel's height setting.
    fn drift_um(&self, spec: &WorldSpec) -> f64 {
        let of = &spec.grinder;
        let alone = GrinderSpec {
            wear_um: of.wear_um,
            break_in_um: of.break_in_um,
            thermal_um: of.thermal_um,
            error_copying: of.error_copying,
            ..perfect_grinder()
        };
        let world = World::new(WorldSpec { grinder: alone, ..spec.clone() }).unwrap();
        let mut line = Line::new(self, Way::Regrind(GainRule::Wavelength), &world, &world, None, 1);
        let level_mm = line.correction.level_mm;
        line.ground(1);
        let off = world.deviations_mm(&line.places);
        1e3 * off.iter().map(|d| d - level_mm).sum::<f64>() / off.len() as f64
    }

    fn without_parameters(&self) -> Self {
        let mut bench = self.again();
        bench.task.repeatability_mm = Some(1e-3 * self.spec.grinder.repeatability_um);
        bench
    }

    fn with_parameters(&self) -> Self {
        let mut bench = self.without_parameters();
        let task = &mut bench.task;
        let corners = [[task.pass.x_mm[0], task.pass.y_mm[0]], [task.pass.x_mm[1], task.pass.y_mm[1]]];
        let grid = Grid::over(corners.into_iter(), task.map_options.spacing_mm).unwrap();
        let nodes = SurfacePoint::under_nodes(&nominal_height_field(&task.nominal).unwrap().0, &grid);
        let [mm, rad] = [1e-3, 1e-6];
        let [radius, setting, tilt] = [mm * RADIUS_UM, mm * SETTING_UM, rad * TILT_URAD].map(Some);
        task.parameter_compensation = Some(ParameterCompensation {
            tolerances: [radius, setting, setting, setting, tilt, tilt, None],
            wheel_term: WheelTerm::InHeight,
            node_points: nodes,
        });
        bench
    }

    fn again(&self) -> Self {
        let mut bench = Self::new(&self.name).held(self.task.registration_options.locked).on(self.machine);
        bench.spec = self.spec.clone();
        bench
    }
}

/// Returns the true error of a grinder, in the unit of the estimated parameter.
fn truth(of: &GrinderSpec, kind: ParameterKind) -> f64 {
    match kind {
        ParameterKind::WheelRadius => of.wheel_radius_error_um,
        ParameterKind::SettingX => of.setting_error_um[0],
        ParameterKind::SettingY => of.setting_error_um[1],
        ParameterKind::SettingZ => of.setting_error_z_um,
        ParameterKind::TiltX => of.part_tilt_urad[0],
        ParameterKind::TiltY => of.part_tilt_urad[1],
        _ => 0.0,
    }
}

/// Returns the number of the correction after which the truth is at the floor; 0 means that none is needed. Returns the
/// number of passes if the truth never reaches the floor.
///
/// The criterion combines the repeatable error of a pass with the mean random error of all passes. How the random part
/// of one pass happens to combine with the residual is not an effect of its correction.
pub fn corrections(after: &[After]) -> usize {
    let floor_um = (after.iter().map(|a| a.floor_um * a.floor_um).sum::<f64>() / after.len() as f64).sqrt();
    after.iter().position(|a| a.repeatable_um.hypot(floor_um) <= AT_FLOOR * floor_um).unwrap_or(after.len())
}

/// Draws a number of the standard normal distribution.
pub(super) fn normal(rng: &mut regrind_sim::Rng) -> f64 {
    use rand::RngExt as _;
    let [a, b]: [f64; 2] = [rng.random(), rng.random()];
    (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}
