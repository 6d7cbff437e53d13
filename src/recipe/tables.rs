//! Tables of a recipe. Each key is declared here once: editors show its comment as help, a file is checked against its
//! range, and its default applies if the key is missing.
//!
//! A required number has the default NaN. Every comparison with NaN is false, so a missing number, which is already
//! reported, causes no further messages. A recipe that was read successfully contains no NaN.

use schemars::{JsonSchema, Schema, json_schema};
use serde::{Deserialize, Serialize};

use crate::cell::{Beginning, Disposal, PvOf};
use crate::compensation::path::{PathMode, Pattern as TrackPattern};
use crate::compensation::{GainRule, Order, Roughness, Smoothing};
use crate::geometry::Aperture;
use crate::registration::{Coordinate, Loss, ProbeSide};
use crate::surface::analytic::{Formula, SamplingDefinition};
use crate::surface::{Distance, Projection};

/// A length in micrometres, as recipes have it.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq, PartialOrd, Serialize)]
#[serde(transparent)]
pub struct Um(pub f64);

impl Um {
    /// Returns the length in millimetres.
    pub fn mm(self) -> f64 {
        1e-3 * self.0
    }
}

/// A recipe of Regrind: what one part shall become and how a cell gets it there.
///
/// Lengths are millimetres where a key ends with `_mm`, micrometres where it ends with `_um`. Paths are relative to the recipe.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct RecipeFile {
    /// The part.
    #[schemars(extend("x-required" = true))]
    pub part: Part,
    /// What its surface shall be: a file, or a formula in the tables surface and aperture.
    #[schemars(extend("x-required" = true))]
    pub nominal: NominalTable,
    /// How it is measured.
    #[schemars(extend("x-required" = true))]
    pub measure: Measure,
    /// How the measured points are registered.
    pub registration: RegistrationSettings,
    /// When the part is good. At least one of pv_um and rms_um.
    #[schemars(extend("x-required" = true))]
    pub acceptance: Acceptance,
    /// How what is left is turned into a correction.
    #[schemars(extend("x-required" = true))]
    pub compensation: Compensation,
    /// How the part is ground.
    #[schemars(extend("x-required" = true))]
    pub grinding: Grinding,
    /// How often, and what to do when it does not get better.
    pub cycle: Cycle,
    /// The truth of a simulated cell; real cells do not look at it.
    #[schemars(schema_with = "any_table")]
    pub simulation: Option<toml::Table>,
}

/// The part.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Part {
    /// Its name.
    #[schemars(length(min = 1, max = 80), extend("x-required" = true), example = "free-form mirror")]
    pub name: String,
    /// What it is made of.
    #[schemars(length(min = 1, max = 80))]
    pub material: Option<String>,
    /// Number of its drawing.
    #[schemars(length(min = 1, max = 80))]
    pub drawing: Option<String>,
    /// Expansion of the part in millionths per kelvin: a measurement that tells its temperature is taken to 20 degrees Celsius by it.
    #[schemars(range(min = -20.0, max = 100.0), example = 0.55)]
    pub expansion_um_m_k: Option<f64>,
    /// Its standard uncertainty; left out, a tenth of it.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub expansion_uncertainty_um_m_k: Option<f64>,
}

/// What the surface shall be: `file`, or the tables surface and aperture.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct NominalTable {
    /// File of points (CSV, XYZ, PLY), of a mesh (STL, PLY) or of a surface definition (TOML), in mm.
    #[schemars(length(min = 1, max = 400), example = "mirror.csv")]
    pub file: Option<String>,
    /// Which columns of a table of points are x, y and z, where its header leaves it open: `x=NAME,y=NAME,z=NAME`, names or numbers from 1.
    #[schemars(length(min = 5, max = 200), example = &"x=X_nom,y=Y_nom,z=Z_nom")]
    pub columns: Option<String>,
    /// Unit of length of a table of points: mm, um, nm, cm, m or inch; without it mm.
    #[schemars(length(min = 1, max = 12), example = &"inch")]
    pub unit: Option<String>,
    /// Unit of length of z in a table of points, where it is another one than that of x and y.
    #[schemars(length(min = 1, max = 12), example = &"um")]
    pub height_unit: Option<String>,
    /// What scattered points of a file are projected onto.
    pub projection: Option<Projection>,
    /// A formula z(x, y).
    #[schemars(with = "Option<Formula>")]
    pub surface: Option<toml::Table>,
    /// The outline of the part in x, y.
    #[schemars(with = "Option<Aperture>")]
    pub aperture: Option<toml::Table>,
    /// How finely a formula is sampled: one of the two.
    #[schemars(with = "Option<SamplingDefinition>")]
    pub sampling: Option<toml::Table>,
}

/// Where points are taken.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum PatternWord {
    /// On a grid: spacing_mm, or columns and rows.
    #[default]
    Grid,
    /// On a spiral from the middle outwards: spacing_mm or points.
    Spiral,
    /// At the points of a file.
    File,
    /// Where the operator takes them: points is the least number.
    Free,
}

/// Which targets are touched.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// All of the pattern.
    #[default]
    Fixed,
    /// Batch by batch those that tell most, until the part can be accepted or its form is known well enough for a correction.
    Adaptive,
}

/// How the part is measured.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Measure {
    /// Radius of the probe, or of the reflector of a tracker.
    #[schemars(range(min = 0.05, max = 50.0), example = 1.5)]
    pub probe_radius_mm: f64,
    /// Which targets are touched.
    pub mode: Mode,
    /// The probability with which a part out of tolerance may be accepted in mode adaptive, which needs this key. By writing it you accept
    /// this risk.
    #[schemars(range(min = 0.01, max = 0.1), example = 0.025)]
    pub accepted_risk: Option<f64>,
    /// On which side of the nominal surface the probe's centres lie.
    pub side: ProbeSide,
    /// Where points are taken.
    pub(super) pattern: PatternWord,
    /// Distance of the points of a grid or a spiral.
    #[schemars(range(min = 0.005, max = 10000.0))]
    pub(super) spacing_mm: Option<f64>,
    /// Columns of a grid, along x.
    #[schemars(range(min = 2, max = 2000))]
    pub(super) columns: Option<u32>,
    /// Rows of a grid, along y.
    #[schemars(range(min = 2, max = 2000))]
    pub(super) rows: Option<u32>,
    /// Points of a spiral; least number of points of a free measurement.
    #[schemars(range(min = 10, max = 1000000))]
    pub(super) points: Option<u32>,
    /// File of points in the model frame, in mm.
    #[schemars(length(min = 1, max = 400))]
    pub(super) file: Option<String>,
    /// Which columns of that file are x, y and z, where its header leaves it open: `x=NAME,y=NAME,z=NAME`, names or numbers from 1.
    #[schemars(length(min = 5, max = 200), example = &"x=X_nom,y=Y_nom,z=Z_nom")]
    pub(super) file_columns: Option<String>,
    /// Unit of length of that file, a table: mm, um, nm, cm, m or inch; without it mm.
    #[schemars(length(min = 1, max = 12), example = &"inch")]
    pub(super) file_unit: Option<String>,
    /// Unit of length of z in that file, where it is another one than that of x and y.
    #[schemars(length(min = 1, max = 12), example = &"um")]
    pub(super) file_height_unit: Option<String>,
    /// Distance kept from the edge of the part.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub edge_margin_mm: f64,
    /// From how far the probe approaches a point, ball surface to point.
    #[schemars(range(min = 0.05, max = 500.0))]
    pub approach_mm: f64,
    /// How far beyond a point the probe searches.
    #[schemars(range(min = 0.01, max = 500.0))]
    pub search_mm: f64,
    /// Speed of the probe while it searches.
    #[schemars(range(min = 0.05, max = 500.0))]
    pub speed_mm_s: f64,
    /// How far above the highest target the probe travels.
    #[schemars(range(min = 0.5, max = 2000.0))]
    pub safe_height_mm: f64,
    /// Least share of the points asked for that must be touched.
    #[schemars(range(min = 0.1, max = 1.0))]
    pub min_coverage: f64,
    /// Whether the reference sphere is touched before the part.
    pub qualify: bool,
    /// How far the radius found on the reference sphere may be from the probe's.
    #[schemars(range(min = 0.05, max = 1000.0))]
    pub radius_tolerance_um: Um,
    /// Least and largest temperature, in degrees Celsius, that a measurement may state of itself; one that states none is not used then.
    #[schemars(inner(range(min = -40.0, max = 120.0)), example = [19.5, 20.5])]
    pub temperature_c: Option<[f64; 2]>,
}

/// Where a registration begins.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum StartAt {
    /// Nowhere in particular.
    #[default]
    Search,
    /// Where the cell's fixture holds the part.
    Fixture,
}

/// How the measured points are registered.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct RegistrationSettings {
    /// How the nominal surface runs between its points.
    pub distance: Distance,
    /// How a distance counts: as its square, or less when it is large.
    pub loss: Loss,
    /// A point farther away than this many robust sigmas does not move the pose; it counts in the figures unless no neighbour found the same.
    #[schemars(range(min = 3.0, max = 1000.0))]
    pub outlier_sigmas: f64,
    /// Coordinates of the model frame that stay as the fixture has them.
    #[schemars(length(max = 6))]
    pub lock: Vec<Coordinate>,
    /// The expanded uncertainty (k = 2) of where the fixture holds the part along what is held; of its turns as much at the edge of the
    /// part. What a part held elsewhere would look like is in the ± of its figures. Without it the fixture is taken for exact, and nothing
    /// is told of setting and tilt, which look the same.
    #[schemars(range(min = 0.0, max = 10000.0), example = 0.5)]
    pub lock_uncertainty_um: Option<Um>,
    /// Where to begin: anywhere, or where the cell's fixture holds the part.
    pub start: StartAt,
    /// The farthest that the part may lie from where the fixture holds it.
    #[schemars(range(min = 0.001, max = 100000.0))]
    pub max_shift_mm: f64,
    /// The most that the part may be turned from how the fixture holds it.
    #[schemars(range(min = 0.0001, max = 180.0))]
    pub max_turn_deg: f64,
    /// The least share of the part's surface that the measured points must cover; below, nothing is made of them.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_coverage: f64,
    /// Refuse a fit whose rms deviation is above this.
    #[schemars(range(min = 0.01, max = 1000000.0))]
    pub max_rms_um: Option<Um>,
}

/// When the part is good.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Acceptance {
    /// Largest peak to valley of the form.
    #[schemars(range(min = 0.001, max = 100000.0))]
    pub pv_um: Option<Um>,
    /// Which points the peak to valley is taken of.
    pub pv_of: PvOf,
    /// Largest rms of the form.
    #[schemars(range(min = 0.001, max = 100000.0))]
    pub rms_um: Option<Um>,
    /// Whether a figure must be within its limit with `probability`; else the most probable value is held against it.
    pub expanded_uncertainty: bool,
    /// The probability with which a figure must be within its limit to be accepted, and beyond it to be rejected. Left out 0.975, or where
    /// `measure.accepted_risk` is less than 0.025, one less that.
    #[schemars(range(min = 0.5, max = 0.995), example = 0.975)]
    pub probability: Option<f64>,
}

/// How what is left is turned into a correction.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Compensation {
    /// A fixed share of the deviation that every cycle takes back; 0 takes nothing back, and passes are ground all the same. Left out, `gain_by`
    /// chooses it.
    #[schemars(range(min = 0.0, max = 1.2))]
    pub(super) gain: Option<f64>,
    /// What the share that a cycle takes back is chosen by, where `gain` does not fix it.
    pub(super) gain_by: Option<GainRule>,
    /// Root mean square of what a pass adds by itself, where that is known; without it the cycles tell it.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub repeatability_um: Option<Um>,
    /// Begin with what the last finished run found to come back in every pass, if it had this part and cell, this wheel and way of grinding,
    /// as many targets, and this cut-off, smoothing and gain. What is measured is then told with the form that earlier parts had after such
    /// passes, as far as it is like that.
    pub learn: bool,
    /// The least that a pass takes off where it takes off least.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub min_depth_um: Um,
    /// Wavelengths shorter than this are left alone.
    #[schemars(range(min = 0.05, max = 10000.0), example = 8.0)]
    pub cutoff_mm: f64,
    /// What makes the map of the deviations smooth.
    pub smoothing: Smoothing,
    /// What the Gaussian filters let pass unchanged.
    pub filter_order: Order,
    /// How the spline's smoothness is chosen, where it is a spline.
    pub roughness: Roughness,
    /// The correction is nowhere larger than this.
    #[schemars(range(min = 0.01, max = 10000.0), example = 60.0)]
    pub max_correction_um: Um,
    /// The most that may be taken off anywhere below the surface of the first pass, over all passes; it is allowance and what may go below the
    /// nominal surface together.
    #[schemars(range(min = 0.01, max = 100000.0), example = 300.0)]
    pub removal_budget_um: Um,
    /// How much deeper each pass goes than the one before; it goes deeper than that where the part is so low that the wheel would else cut
    /// air there, and locally by as much as the part stands proud. The most that the machine may take off is grinder.limits.max_depth_mm
    /// of the cell.
    #[schemars(range(min = 0.01, max = 10000.0), example = 60.0)]
    pub depth_of_cut_um: Um,
    /// Parameters of the machine that are taken back as such after the first pass, each with its tolerance; the map is what is left. Left out,
    /// all is left to the map.
    pub parameters: Option<MachineParameters>,
    /// Distance of the nodes of the map.
    #[schemars(range(min = 0.01, max = 10000.0))]
    pub spacing_mm: f64,
    /// The correction is refused where it might sit farther than this beside its place on the part (k = 2), because the surface does not
    /// tell the part's place any better.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub max_displacement_mm: f64,
}

/// Tolerances of parameters of the machine: the expanded uncertainty (k = 2) with which each is set. One that stands is taken back where it is told
/// beyond its uncertainty; for more than its tolerance a person is asked.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct MachineParameters {
    /// Of the radius of the wheel, a ball.
    #[schemars(range(min = 0.1, max = 10000.0), example = 100.0)]
    pub wheel_radius_um: Option<Um>,
    /// Of where the wheel is set along x; told where the part is held along x.
    #[schemars(range(min = 0.1, max = 10000.0), example = 15.0)]
    pub wheel_x_um: Option<Um>,
    /// The same along y.
    #[schemars(range(min = 0.1, max = 10000.0), example = 15.0)]
    pub wheel_y_um: Option<Um>,
    /// How high the wheel is set; told where the part is held along z.
    #[schemars(range(min = 0.1, max = 10000.0), example = 15.0)]
    pub wheel_z_um: Option<Um>,
    /// Tilt of the part in the grinder about x; told where the part is held about x.
    #[schemars(range(min = 0.1, max = 10000.0), example = 60.0)]
    pub part_tilt_x_urad: Option<f64>,
    /// The same about y.
    #[schemars(range(min = 0.1, max = 10000.0), example = 60.0)]
    pub part_tilt_y_urad: Option<f64>,
}

impl MachineParameters {
    /// Returns the tolerances in millimetres and radians, in the order of [`crate::compensation::ParameterKind::ALL`].
    pub fn tolerances(&self) -> [Option<f64>; crate::compensation::ParameterKind::COUNT] {
        let [radius, x, y, z] =
            [self.wheel_radius_um, self.wheel_x_um, self.wheel_y_um, self.wheel_z_um].map(|um| um.map(Um::mm));
        let [tilt_x, tilt_y] = [self.part_tilt_x_urad, self.part_tilt_y_urad].map(|urad| urad.map(|urad| 1e-6 * urad));
        [radius, x, y, z, tilt_x, tilt_y, None]
    }
}

/// How the part is ground.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Grinding {
    /// The wheel.
    #[schemars(extend("x-required" = true))]
    pub wheel: Wheel,
    /// How a head tilts the wheel, on a grinder that has one; left out, the wheel stays upright.
    pub tilt: Option<Tilt>,
    /// Feed along the track.
    #[schemars(range(min = 0.1, max = 100000.0), example = 600.0)]
    pub feed_mm_min: f64,
    /// Distance of the tracks; the largest one where scallop_nm is given. Where neither stands it is chosen so that the scallops, the ridges
    /// between the tracks, take a fifth of acceptance.rms_um and of acceptance.pv_um at most.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub track_mm: Option<f64>,
    /// How the tracks run.
    pub pattern: TrackPattern,
    /// Whether every track of a raster runs towards +x; else they alternate.
    pub one_way: bool,
    /// Height of the ridges between tracks, at most: the tracks are laid as close as that takes.
    #[schemars(range(min = 0.01, max = 1000000.0))]
    pub scallop_nm: Option<f64>,
    /// How far the straight lines of the program may be from the path of the wheel's centre.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub chord_error_um: Um,
    /// How far tracks go on beyond the edge of the part.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub overrun_mm: f64,
    /// How far above the highest point of its path the wheel travels between tracks.
    #[schemars(range(min = 0.5, max = 1000.0))]
    pub safe_height_mm: f64,
    /// How exactly the controller keeps to the program.
    pub path_mode: PathMode,
    /// How far the controller may round a corner off with path_mode = "blend".
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub path_tolerance_um: Um,
    /// Passes without in-feed at the end.
    #[schemars(range(max = 20))]
    pub spark_out_passes: u16,
    /// Level of the first pass over the nominal surface; each further pass goes deeper by the depth of cut.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub allowance_um: Um,
    /// How many mm3 of the part the wheel takes off for each mm3 that it wears (G): `regrind plan` tells the loss of the wheel by it, and
    /// nothing else goes by it.
    #[schemars(range(min = 0.01, max = 1000000.0), example = 200.0)]
    pub grinding_ratio: Option<f64>,
}

/// How a wheel leans.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum Leaning {
    /// By the same angle everywhere.
    #[default]
    Constant,
    /// After the normal of the surface, seen along the axis of the head: the angle is kept between the normal and the upright direction of the head.
    Following,
}

/// How a head tilts the wheel.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Tilt {
    /// Whether it follows the surface.
    pub lean: Leaning,
    /// How far the head is turned, right-handed about its axis: from upright, or from the normal where it follows. A positive B leans to +x, a
    /// positive A to -y.
    #[schemars(range(min = -90.0, max = 90.0), extend("x-required" = true), example = 20.0)]
    pub angle_deg: f64,
}

impl Default for Tilt {
    fn default() -> Self {
        Self { lean: Leaning::Constant, angle_deg: f64::NAN }
    }
}

/// Axis of the model frame that a spindle lies along.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum SpindleAxis {
    X,
    #[default]
    Y,
}

/// A wheel by its dimensions, as it is ordered and dressed; [`crate::compensation::path::Wheel`] is one that stands on a part.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(tag = "shape", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Wheel {
    /// A ball.
    Sphere {
        /// Its radius.
        #[serde(default = "missing")]
        #[schemars(range(min = 0.1, max = 1000.0), example = 12.5)]
        radius_mm: f64,
    },
    /// A disc with a round rim.
    Torus {
        /// Radius to the outermost point of the rim.
        #[serde(default = "missing")]
        #[schemars(range(min = 0.1, max = 1000.0), example = 75.0)]
        radius_mm: f64,
        /// Radius of the rim's own curve.
        #[serde(default = "missing")]
        #[schemars(range(min = 0.05, max = 1000.0), example = 2.0)]
        minor_radius_mm: f64,
        /// Axis of the model frame that the spindle lies along: across the tracks of a raster is y.
        #[serde(default)]
        spindle: SpindleAxis,
    },
    /// A ring that cuts with its face.
    Cup {
        /// Radius to the middle of the face.
        #[serde(default = "missing")]
        #[schemars(range(min = 0.1, max = 1000.0), example = 40.0)]
        radius_mm: f64,
        /// Radius of the face's own curve.
        #[serde(default = "missing")]
        #[schemars(range(min = 0.05, max = 1000.0), example = 2.0)]
        minor_radius_mm: f64,
        /// Tilt of the spindle from z towards -x; left out, five degrees more than the part slopes.
        #[schemars(range(min = 1.0, max = 80.0))]
        tilt_deg: Option<f64>,
    },
}

impl Wheel {
    /// Returns the wheel radius that the grinder uses.
    pub fn radius_mm(&self) -> f64 {
        match *self {
            Self::Sphere { radius_mm } | Self::Torus { radius_mm, .. } | Self::Cup { radius_mm, .. } => radius_mm,
        }
    }
}

/// Default of a required number.
fn missing() -> f64 {
    f64::NAN
}

/// How often, and what to do when it does not get better.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Cycle {
    /// What the first cycle begins with: a pass, or a measurement of the part as it is.
    pub begin_with: Beginning,
    /// Most cycles of grinding and measuring.
    #[schemars(range(min = 1, max = 100))]
    pub max_cycles: u16,
    /// What to do when a cycle brings next to nothing.
    pub on_stall: Disposal,
    /// What to do when a cycle makes it worse.
    pub on_divergence: Disposal,
    /// A cycle whose rms falls by less than this, or is expected to, brings next to nothing; so does one whose rms falls by less than 2 %.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub stall_um: Um,
    /// Whether a part that comes from the queue of a plant is confirmed by a person at the cell before its run begins.
    pub confirm_work: bool,
}

impl Default for Measure {
    fn default() -> Self {
        Self {
            probe_radius_mm: f64::NAN,
            mode: Mode::Fixed,
            accepted_risk: None,
            side: ProbeSide::Auto,
            pattern: PatternWord::Grid,
            spacing_mm: None,
            columns: None,
            rows: None,
            points: None,
            file: None,
            file_columns: None,
            file_unit: None,
            file_height_unit: None,
            edge_margin_mm: 0.5,
            approach_mm: 2.0,
            search_mm: 2.0,
            speed_mm_s: 5.0,
            safe_height_mm: 10.0,
            min_coverage: 0.95,
            qualify: true,
            radius_tolerance_um: Um(2.0),
            temperature_c: None,
        }
    }
}

impl Default for RegistrationSettings {
    fn default() -> Self {
        Self {
            distance: Distance::Curved,
            loss: Loss::None,
            outlier_sigmas: 6.0,
            lock: Vec::new(),
            lock_uncertainty_um: None,
            start: StartAt::Search,
            max_shift_mm: 5.0,
            max_turn_deg: 5.0,
            min_coverage: 0.5,
            max_rms_um: None,
        }
    }
}

impl Compensation {
    /// Returns the rule that selects the gain: the share of the deviation that one cycle takes back.
    pub fn gain(&self) -> GainRule {
        self.gain.map_or(self.gain_by.unwrap_or_default(), GainRule::Fixed)
    }
}

impl Default for Acceptance {
    fn default() -> Self {
        Self { pv_um: None, pv_of: PvOf::default(), rms_um: None, expanded_uncertainty: true, probability: None }
    }
}

impl Default for Compensation {
    fn default() -> Self {
        Self {
            gain: None,
            gain_by: None,
            parameters: None,
            repeatability_um: None,
            learn: false,
            smoothing: Smoothing::default(),
            filter_order: Order::default(),
            roughness: Roughness::default(),
            min_depth_um: Um(0.5),
            cutoff_mm: f64::NAN,
            max_correction_um: Um(f64::NAN),
            removal_budget_um: Um(f64::NAN),
            depth_of_cut_um: Um(f64::NAN),
            spacing_mm: 1.0,
            max_displacement_mm: 1.0,
        }
    }
}

impl Default for Grinding {
    fn default() -> Self {
        Self {
            wheel: Wheel::Sphere { radius_mm: f64::NAN },
            tilt: None,
            feed_mm_min: f64::NAN,
            track_mm: None,
            pattern: TrackPattern::Raster,
            one_way: false,
            scallop_nm: None,
            chord_error_um: Um(0.1),
            overrun_mm: 2.0,
            safe_height_mm: 10.0,
            path_mode: PathMode::Blend,
            path_tolerance_um: Um(0.1),
            spark_out_passes: 2,
            allowance_um: Um(0.0),
            grinding_ratio: None,
        }
    }
}

impl Default for Cycle {
    fn default() -> Self {
        Self {
            begin_with: Beginning::Grind,
            max_cycles: 5,
            on_stall: Disposal::Stop,
            on_divergence: Disposal::Hold,
            stall_um: Um(0.0),
            confirm_work: true,
        }
    }
}

fn any_table(_: &mut schemars::SchemaGenerator) -> Schema {
    json_schema!({ "type": "object", "additionalProperties": true })
}
