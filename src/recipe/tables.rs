//! Tables of a recipe. Each key is declared here once: editors show its comment as help, a file is checked against its
//! range, and its default applies if the key is missing.
//!
//! A required number has the default NaN. Every comparison with NaN is false, so a missing number, which is already
//! reported, causes no further messages. A recipe that was read successfully contains no NaN.

use schemars::{JsonSchema, Schema, json_schema};
use serde::{Deserialize, Serialize};

use crate::cell::{FirstStep, HoldOrStop, PvPoints};
use crate::compensation::path::{PathMode, TrackPattern};
use crate::compensation::{FilterOrder, GainRule, Smoothing, SplineSmoothness};
use crate::geometry::Aperture;
use crate::registration::{Coordinate, Loss, ProbeSide};
use crate::surface::analytic::{Formula, SamplingDefinition};
use crate::surface::parametric::FaceFrame;
use crate::surface::{DistanceModel, PlaneProjection};

/// A length in micrometres, as recipes have it.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq, PartialOrd, Serialize)]
#[serde(transparent)]
pub struct Micrometres(pub f64);

impl Micrometres {
    /// Returns the length in millimetres.
    pub fn mm(self) -> f64 {
        1e-3 * self.0
    }
}

/// A recipe of Regrind: the nominal surface of one part, and how a cell measures, judges and grinds the part.
///
/// Lengths are in millimetres if a key ends with `_mm`, and in micrometres if it ends with `_um`. Paths are relative to
/// the recipe.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct RecipeFile {
    /// The part.
    #[schemars(extend("x-required" = true))]
    pub part: Part,
    /// Nominal surface: a file, or a formula in the tables surface and aperture.
    #[schemars(extend("x-required" = true))]
    pub nominal: NominalTable,
    /// Measurement of the part.
    #[schemars(extend("x-required" = true))]
    pub measure: MeasurementSettings,
    /// Registration of the measured points.
    pub registration: RegistrationSettings,
    /// Acceptance limits of the part: at least one of pv_um and rms_um.
    #[schemars(extend("x-required" = true))]
    pub acceptance: Acceptance,
    /// Computation of a correction from the remaining error.
    #[schemars(extend("x-required" = true))]
    pub compensation: Compensation,
    /// Grinding of the part.
    #[schemars(extend("x-required" = true))]
    pub grinding: Grinding,
    /// Number of cycles, and the response to a cycle without improvement.
    pub cycle: CycleSettings,
    /// Truth of a simulated cell; real cells ignore it.
    #[schemars(schema_with = "any_table")]
    pub simulation: Option<toml::Table>,
}

/// The part.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Part {
    /// Name of the part.
    #[schemars(length(min = 1, max = 80), extend("x-required" = true), example = "free-form mirror")]
    pub name: String,
    /// Material of the part.
    #[schemars(length(min = 1, max = 80))]
    pub material: Option<String>,
    /// Number of the drawing of the part.
    #[schemars(length(min = 1, max = 80))]
    pub drawing: Option<String>,
    /// Thermal expansion of the part in millionths per kelvin. Regrind uses it to correct a measurement with a stated
    /// temperature to 20 °C.
    #[schemars(range(min = -20.0, max = 100.0), example = 0.55)]
    pub expansion_um_m_k: Option<f64>,
    /// Standard uncertainty of the expansion. Default: a tenth of the expansion.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub expansion_uncertainty_um_m_k: Option<f64>,
}

/// Nominal surface: `file`, or the tables surface and aperture.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub(super) struct NominalTable {
    /// File of points (CSV, XYZ, PLY), of a mesh (STL, PLY), of faces (STEP, IGES) or of a surface definition (TOML).
    #[schemars(length(min = 1, max = 400), example = "mirror.csv")]
    pub file: Option<String>,
    /// Columns of x, y and z in a table of points, if its header does not identify them: `x=NAME,y=NAME,z=NAME`, names
    /// or numbers from 1.
    #[schemars(length(min = 5, max = 200), example = &"x=X_nom,y=Y_nom,z=Z_nom")]
    pub columns: Option<String>,
    /// Unit of length of a table of points: mm, um, nm, cm, m or inch. Default: mm.
    #[schemars(length(min = 1, max = 12), example = &"inch")]
    pub unit: Option<String>,
    /// Unit of length of z in a table of points, if it differs from that of x and y.
    #[schemars(length(min = 1, max = 12), example = &"um")]
    pub height_unit: Option<String>,
    /// Face of a CAD model: its number from 1, its name, or `largest`, the default. `regrind accuracy` lists the faces.
    pub face: Option<FaceKey>,
    /// Frame of a face: that of the file, or one in the middle of the face with z along its outward normal.
    pub face_frame: Option<FaceFrame>,
    /// Projection of scattered points of a file for the triangulation.
    pub projection: Option<PlaneProjection>,
    /// A formula z(x, y).
    #[schemars(with = "Option<Formula>")]
    pub surface: Option<toml::Table>,
    /// The outline of the part in x, y.
    #[schemars(with = "Option<Aperture>")]
    pub aperture: Option<toml::Table>,
    /// Sampling of a formula or of a face: one of the two keys.
    #[schemars(with = "Option<SamplingDefinition>")]
    pub sampling: Option<toml::Table>,
}

/// Number or name of a face.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(untagged)]
pub(super) enum FaceKey {
    /// Number from 1.
    Number(u32),
    /// Name in the file, or `largest`.
    Name(String),
}

/// Pattern of the targets.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum PatternKind {
    /// A grid: spacing_mm, or columns and rows.
    #[default]
    Grid,
    /// A spiral from the middle outwards: spacing_mm or points.
    Spiral,
    /// The points of a file.
    File,
    /// Places that the operator chooses: points is the minimum number.
    Free,
}

/// Targets that the CMM touches.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SelectionMode {
    /// All targets of the pattern.
    #[default]
    Fixed,
    /// The most informative targets, batch by batch, until the part can be accepted or its form is known well enough
    /// for a correction.
    Adaptive,
}

/// Measurement of the part.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct MeasurementSettings {
    /// Radius of the probe, or of the reflector of a tracker.
    #[schemars(range(min = 0.05, max = 50.0), example = 1.5)]
    pub probe_radius_mm: f64,
    /// Targets that the CMM touches.
    pub mode: SelectionMode,
    /// Probability of accepting a part that is out of tolerance, in mode adaptive, which requires this key. By writing
    /// this key you accept the risk.
    #[schemars(range(min = 0.01, max = 0.1), example = 0.025)]
    pub accepted_risk: Option<f64>,
    /// Side of the nominal surface on which the probe centres are.
    pub side: ProbeSide,
    /// Pattern of the targets.
    pub(super) pattern: PatternKind,
    /// Distance between the points of a grid or a spiral.
    #[schemars(range(min = 0.005, max = 10000.0))]
    pub(super) spacing_mm: Option<f64>,
    /// Number of columns of a grid, along x.
    #[schemars(range(min = 2, max = 2000))]
    pub(super) columns: Option<u32>,
    /// Number of rows of a grid, along y.
    #[schemars(range(min = 2, max = 2000))]
    pub(super) rows: Option<u32>,
    /// Number of points of a spiral; minimum number of points of a free measurement.
    #[schemars(range(min = 10, max = 1000000))]
    pub(super) points: Option<u32>,
    /// File of points in the model frame, in mm.
    #[schemars(length(min = 1, max = 400))]
    pub(super) file: Option<String>,
    /// Columns of x, y and z in that file, if its header does not identify them: `x=NAME,y=NAME,z=NAME`, names or
    /// numbers from 1.
    #[schemars(length(min = 5, max = 200), example = &"x=X_nom,y=Y_nom,z=Z_nom")]
    pub(super) file_columns: Option<String>,
    /// Unit of length of that file, a table: mm, um, nm, cm, m or inch. Default: mm.
    #[schemars(length(min = 1, max = 12), example = &"inch")]
    pub(super) file_unit: Option<String>,
    /// Unit of length of z in that file, if it differs from that of x and y.
    #[schemars(length(min = 1, max = 12), example = &"um")]
    pub(super) file_height_unit: Option<String>,
    /// Minimum distance of the targets from the edge of the part.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub edge_margin_mm: f64,
    /// Distance from which the probe approaches a point, from the surface of the ball to the point.
    #[schemars(range(min = 0.05, max = 500.0))]
    pub approach_mm: f64,
    /// Distance that the probe searches beyond a point.
    #[schemars(range(min = 0.01, max = 500.0))]
    pub search_mm: f64,
    /// Speed of the probe during the search.
    #[schemars(range(min = 0.05, max = 500.0))]
    pub speed_mm_s: f64,
    /// Height above the highest target at which the probe travels.
    #[schemars(range(min = 0.5, max = 2000.0))]
    pub safe_height_mm: f64,
    /// Minimum share of the requested points that must be touched.
    #[schemars(range(min = 0.1, max = 1.0))]
    pub min_coverage: f64,
    /// Whether the probe touches the reference sphere before the part.
    pub qualify: bool,
    /// Maximum difference between the radius found on the reference sphere and that of the probe.
    #[schemars(range(min = 0.05, max = 1000.0))]
    pub radius_tolerance_um: Micrometres,
    /// Minimum and maximum temperature of a measurement, in °C. With this key, a measurement without a temperature is
    /// not used.
    #[schemars(inner(range(min = -40.0, max = 120.0)), example = [19.5, 20.5])]
    pub temperature_c: Option<[f64; 2]>,
}

/// Start of a registration.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RegistrationStart {
    /// A search for the pose.
    #[default]
    Search,
    /// The pose of the cell's fixture.
    Fixture,
}

/// Registration of the measured points.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct RegistrationSettings {
    /// Shape of the nominal surface between its points.
    pub distance: DistanceModel,
    /// Loss function of the distances: the square, or less for a large distance.
    pub loss: Loss,
    /// Outlier limit in robust standard deviations. A point farther away does not affect the pose. It counts in the
    /// figures unless no neighbour has the same deviation.
    #[schemars(range(min = 3.0, max = 1000.0))]
    pub outlier_sigmas: f64,
    /// Locked directions of the pose, in the model frame: they keep the values of the fixture.
    #[schemars(length(max = 6))]
    pub lock: Vec<Coordinate>,
    /// Expanded uncertainty (k = 2) of the fixture along the locked directions; for locked rotations, of the
    /// displacement at the edge of the part. The ± of the figures includes the effect of a part that lies elsewhere.
    /// Without this key the fixture is assumed to be exact, and setting and tilt are not estimated, because they have
    /// the same effect.
    #[schemars(range(min = 0.0, max = 10000.0), example = 0.5)]
    pub lock_uncertainty_um: Option<Micrometres>,
    /// Start of the registration: a search, or the pose of the cell's fixture.
    pub start: RegistrationStart,
    /// Maximum shift of the part from its position in the fixture.
    #[schemars(range(min = 0.001, max = 100000.0))]
    pub max_shift_mm: f64,
    /// Maximum rotation of the part from its orientation in the fixture.
    #[schemars(range(min = 0.0001, max = 180.0))]
    pub max_turn_deg: f64,
    /// Minimum share of the part's surface that the measured points must cover. Points that cover less are not used.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_coverage: f64,
    /// Maximum rms deviation of a fit; a fit with a larger one is refused.
    #[schemars(range(min = 0.01, max = 1000000.0))]
    pub max_rms_um: Option<Micrometres>,
}

/// Acceptance limits of the part.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Acceptance {
    /// Maximum peak to valley of the form.
    #[schemars(range(min = 0.001, max = 100000.0))]
    pub pv_um: Option<Micrometres>,
    /// Points that the peak to valley includes.
    pub pv_of: PvPoints,
    /// Maximum rms of the form.
    #[schemars(range(min = 0.001, max = 100000.0))]
    pub rms_um: Option<Micrometres>,
    /// Whether a figure must be within its limit with `probability`. If false, the most probable value is compared with
    /// the limit.
    pub expanded_uncertainty: bool,
    /// Probability with which a figure must be within its limit to be accepted, and beyond it to be rejected. Default:
    /// 0.975, or 1 - `measure.accepted_risk` if that risk is less than 0.025.
    #[schemars(range(min = 0.5, max = 0.995), example = 0.975)]
    pub probability: Option<f64>,
}

/// Computation of a correction from the remaining error.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Compensation {
    /// Fixed share of the error that every correction removes. With 0 a correction removes nothing, but the cell still
    /// grinds the passes. Default: `gain_by` chooses the share.
    #[schemars(range(min = 0.0, max = 1.2))]
    pub(super) gain: Option<f64>,
    /// Rule for the share of the error that a correction removes, if `gain` does not fix it.
    pub(super) gain_by: Option<GainRule>,
    /// Root mean square of the error that is new in each pass, if it is known. Without this key, it is estimated from
    /// the cycles.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub repeatability_um: Option<Micrometres>,
    /// Start with the repeatable error that the last finished run found, if the run had the same part and cell, the
    /// same wheel and way of grinding, the same number of targets, and the same cut-off, smoothing and gain. The form
    /// of earlier parts after the same kind of pass is then the prior of the form, as far as the measurement agrees
    /// with it.
    pub learn: bool,
    /// Minimum removal of a pass, at the place where it removes least.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub min_depth_um: Micrometres,
    /// Cut-off wavelength; shorter waves are not corrected.
    #[schemars(range(min = 0.05, max = 10000.0), example = 8.0)]
    pub cutoff_mm: f64,
    /// Filter that smooths the map of the deviations.
    pub smoothing: Smoothing,
    /// Polynomials that the Gaussian filters pass unchanged.
    pub filter_order: FilterOrder,
    /// Choice of the spline's smoothness, if `smoothing` is a spline.
    pub roughness: SplineSmoothness,
    /// Maximum correction at any place of the part.
    #[schemars(range(min = 0.01, max = 10000.0), example = 60.0)]
    pub max_correction_um: Micrometres,
    /// Maximum removal at any place below the surface of the first pass, over all passes: the allowance plus the
    /// permitted depth below the nominal surface.
    #[schemars(range(min = 0.01, max = 100000.0), example = 300.0)]
    pub removal_budget_um: Micrometres,
    /// Depth of each pass below the pass before. A pass goes deeper if the part is so low at a place that the wheel
    /// would otherwise cut air there. Locally, it removes in addition the height of the excess material. The limit of
    /// the machine is grinder.limits.max_depth_mm of the cell.
    #[schemars(range(min = 0.01, max = 10000.0), example = 60.0)]
    pub depth_of_cut_um: Micrometres,
    /// Parameters of the machine that are compensated after the first pass, each with its tolerance. The map then
    /// corrects the rest of the error. Default: the map corrects the whole error.
    pub parameters: Option<ParameterTolerances>,
    /// Distance between the nodes of the map.
    #[schemars(range(min = 0.01, max = 10000.0))]
    pub spacing_mm: f64,
    /// Maximum lateral displacement of the correction on the part (k = 2). A correction is refused if the surface
    /// determines the position of the part less well.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub max_displacement_mm: f64,
}

/// Tolerances of parameters of the machine: the expanded uncertainty (k = 2) with which each is set. A parameter with a
/// tolerance is compensated if it exceeds its uncertainty. If it exceeds its tolerance, a person is asked.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct ParameterTolerances {
    /// Tolerance of the radius of a spherical wheel.
    #[schemars(range(min = 0.1, max = 10000.0), example = 100.0)]
    pub wheel_radius_um: Option<Micrometres>,
    /// Tolerance of the setting of the wheel along x; estimated if x is locked.
    #[schemars(range(min = 0.1, max = 10000.0), example = 15.0)]
    pub wheel_x_um: Option<Micrometres>,
    /// Tolerance of the setting of the wheel along y; estimated if y is locked.
    #[schemars(range(min = 0.1, max = 10000.0), example = 15.0)]
    pub wheel_y_um: Option<Micrometres>,
    /// Tolerance of the height of the wheel; estimated if z is locked.
    #[schemars(range(min = 0.1, max = 10000.0), example = 15.0)]
    pub wheel_z_um: Option<Micrometres>,
    /// Tolerance of the tilt of the part in the grinder about x; estimated if rx is locked.
    #[schemars(range(min = 0.1, max = 10000.0), example = 60.0)]
    pub part_tilt_x_urad: Option<f64>,
    /// Tolerance of the tilt of the part in the grinder about y; estimated if ry is locked.
    #[schemars(range(min = 0.1, max = 10000.0), example = 60.0)]
    pub part_tilt_y_urad: Option<f64>,
}

impl ParameterTolerances {
    /// Returns the tolerance of each machine parameter, lengths in mm and angles in rad, in the order of
    /// [`crate::compensation::ParameterKind::ALL`]. An entry is `None` if the recipe does not compensate this
    /// parameter. The entry of the wear is always `None`.
    pub fn tolerances(&self) -> [Option<f64>; crate::compensation::ParameterKind::COUNT] {
        let [radius, x, y, z] =
            [self.wheel_radius_um, self.wheel_x_um, self.wheel_y_um, self.wheel_z_um].map(|um| um.map(Micrometres::mm));
        let [tilt_x, tilt_y] = [self.part_tilt_x_urad, self.part_tilt_y_urad].map(|urad| urad.map(|urad| 1e-6 * urad));
        [radius, x, y, z, tilt_x, tilt_y, None]
    }
}

/// Grinding of the part.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Grinding {
    /// The wheel.
    #[schemars(extend("x-required" = true))]
    pub wheel: WheelDimensions,
    /// Tilt of the wheel, on a grinder with a tilting head. Default: the wheel is upright.
    pub tilt: Option<Tilt>,
    /// Feed along the track.
    #[schemars(range(min = 0.1, max = 100000.0), example = 600.0)]
    pub feed_mm_min: f64,
    /// Distance between the tracks; with scallop_nm, its maximum. Without both keys, the distance is chosen so that the
    /// scallops, the ridges between the tracks, use at most a fifth of acceptance.rms_um and of acceptance.pv_um.
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub track_mm: Option<f64>,
    /// Pattern of the tracks.
    pub pattern: TrackPattern,
    /// Whether every track of a raster runs towards +x. If false, the tracks alternate.
    pub one_way: bool,
    /// Maximum height of the scallops, the ridges between the tracks. It sets the distance between the tracks.
    #[schemars(range(min = 0.01, max = 1000000.0))]
    pub scallop_nm: Option<f64>,
    /// Maximum distance of the straight lines of the program from the path of the wheel's centre.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub chord_error_um: Micrometres,
    /// Length of the tracks beyond the edge of the part.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub overrun_mm: f64,
    /// Height above the highest point of its path at which the wheel travels between tracks.
    #[schemars(range(min = 0.5, max = 1000.0))]
    pub safe_height_mm: f64,
    /// Path mode: how exactly the controller follows the program.
    pub path_mode: PathMode,
    /// Maximum rounding of a corner by the controller with path_mode = "blend".
    #[schemars(range(min = 0.001, max = 1000.0))]
    pub path_tolerance_um: Micrometres,
    /// Passes without in-feed at the end.
    #[schemars(range(max = 20))]
    pub spark_out_passes: u16,
    /// Level of the first pass above the nominal surface; each further pass goes deeper by the depth of cut.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub allowance_um: Micrometres,
    /// Grinding ratio G: mm³ of material removed for each mm³ of wheel worn. Only `regrind plan` uses it, to estimate
    /// the wear of the wheel.
    #[schemars(range(min = 0.01, max = 1000000.0), example = 200.0)]
    pub grinding_ratio: Option<f64>,
}

/// Mode of the tilt of a wheel.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum TiltKind {
    /// The same angle everywhere.
    #[default]
    Constant,
    /// The head follows the normal of the surface, seen along its axis: the angle between the normal and the upright
    /// direction of the head is constant.
    Following,
}

/// Tilt of the wheel by a head.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct Tilt {
    /// Mode of the tilt: constant, or following the surface.
    pub lean: TiltKind,
    /// Angle of the head, right-handed about its axis: from upright, or from the normal if the head follows the
    /// surface. A positive B tilts to +x, a positive A to -y.
    #[schemars(range(min = -90.0, max = 90.0), extend("x-required" = true), example = 20.0)]
    pub angle_deg: f64,
}

impl Default for Tilt {
    fn default() -> Self {
        Self { lean: TiltKind::Constant, angle_deg: f64::NAN }
    }
}

/// Axis of the model frame parallel to a spindle.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum SpindleAxis {
    X,
    #[default]
    Y,
}

/// Dimensions of a wheel, as it is ordered and dressed. [`crate::compensation::path::Wheel`] is the same wheel in the
/// form that paths use.
#[derive(Clone, Copy, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(tag = "shape", rename_all = "kebab-case", deny_unknown_fields)]
pub enum WheelDimensions {
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
        /// Axis of the model frame parallel to the spindle; y is across the tracks of a raster.
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
        /// Tilt of the spindle from z towards -x. Default: 5° more than the slope of the part.
        #[schemars(range(min = 1.0, max = 80.0))]
        tilt_deg: Option<f64>,
    },
}

impl WheelDimensions {
    /// Returns the radius of the wheel in mm. The meaning depends on the shape of the wheel:
    ///
    /// - sphere: the radius of the ball
    /// - torus (a disc with a round rim): from the axis of the wheel to the outermost point of the rim
    /// - cup (a ring that grinds with its face): from the axis of the wheel to the middle of the face
    pub fn radius_mm(&self) -> f64 {
        match *self {
            Self::Sphere { radius_mm } | Self::Torus { radius_mm, .. } | Self::Cup { radius_mm, .. } => radius_mm,
        }
    }
}

/// Returns NaN, the default of a required number. NaN marks the number as missing, and the check of the recipe then
/// reports it.
fn missing() -> f64 {
    f64::NAN
}

/// Number of cycles, and the response to a cycle without improvement.
#[derive(Clone, Debug, Deserialize, JsonSchema, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub struct CycleSettings {
    /// First step of the first cycle: a pass, or a measurement of the part as it is.
    pub begin_with: FirstStep,
    /// Maximum number of cycles of grinding and measuring.
    #[schemars(range(min = 1, max = 100))]
    pub max_cycles: u16,
    /// Response to a stall: a cycle that improves the part by next to nothing.
    pub on_stall: HoldOrStop,
    /// Response to a cycle that makes the part worse.
    pub on_divergence: HoldOrStop,
    /// Minimum decrease of the rms in a cycle. A cycle stalls if its rms decreases, or is expected to decrease, by less
    /// than this, or by less than 2 %.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub stall_um: Micrometres,
    /// Whether a person at the cell confirms a part from the queue of a plant before its run begins.
    pub confirm_work: bool,
}

impl Default for MeasurementSettings {
    fn default() -> Self {
        Self {
            probe_radius_mm: f64::NAN,
            mode: SelectionMode::Fixed,
            accepted_risk: None,
            side: ProbeSide::Auto,
            pattern: PatternKind::Grid,
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
            radius_tolerance_um: Micrometres(2.0),
            temperature_c: None,
        }
    }
}

impl Default for RegistrationSettings {
    fn default() -> Self {
        Self {
            distance: DistanceModel::Curved,
            loss: Loss::None,
            outlier_sigmas: 6.0,
            lock: Vec::new(),
            lock_uncertainty_um: None,
            start: RegistrationStart::Search,
            max_shift_mm: 5.0,
            max_turn_deg: 5.0,
            min_coverage: 0.5,
            max_rms_um: None,
        }
    }
}

impl Compensation {
    /// Returns the rule that selects the gain, the share of the deviation that one correction removes. This is the
    /// fixed value of the key `gain`, or else the rule in `gain_by`. If the recipe contains neither key, returns the
    /// default rule.
    pub fn gain(&self) -> GainRule {
        self.gain.map_or(self.gain_by.unwrap_or_default(), GainRule::Fixed)
    }
}

impl Default for Acceptance {
    fn default() -> Self {
        Self { pv_um: None, pv_of: PvPoints::default(), rms_um: None, expanded_uncertainty: true, probability: None }
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
            filter_order: FilterOrder::default(),
            roughness: SplineSmoothness::default(),
            min_depth_um: Micrometres(0.5),
            cutoff_mm: f64::NAN,
            max_correction_um: Micrometres(f64::NAN),
            removal_budget_um: Micrometres(f64::NAN),
            depth_of_cut_um: Micrometres(f64::NAN),
            spacing_mm: 1.0,
            max_displacement_mm: 1.0,
        }
    }
}

impl Default for Grinding {
    fn default() -> Self {
        Self {
            wheel: WheelDimensions::Sphere { radius_mm: f64::NAN },
            tilt: None,
            feed_mm_min: f64::NAN,
            track_mm: None,
            pattern: TrackPattern::Raster,
            one_way: false,
            scallop_nm: None,
            chord_error_um: Micrometres(0.1),
            overrun_mm: 2.0,
            safe_height_mm: 10.0,
            path_mode: PathMode::Blend,
            path_tolerance_um: Micrometres(0.1),
            spark_out_passes: 2,
            allowance_um: Micrometres(0.0),
            grinding_ratio: None,
        }
    }
}

impl Default for CycleSettings {
    fn default() -> Self {
        Self {
            begin_with: FirstStep::Grind,
            max_cycles: 5,
            on_stall: HoldOrStop::Stop,
            on_divergence: HoldOrStop::Hold,
            stall_um: Micrometres(0.0),
            confirm_work: true,
        }
    }
}

fn any_table(_: &mut schemars::SchemaGenerator) -> Schema {
    json_schema!({ "type": "object", "additionalProperties": true })
}
