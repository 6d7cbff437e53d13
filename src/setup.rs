//! Builds what a run needs from a recipe and a cell file: the nominal surface, the targets, the limits, the settings of
//! the wires.
//!
//! Recipe and cell file are each checked separately. This module finds the errors that only the two together show.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::cell::{CellPlan, Deadlines, Device, GateLimits, HoldOrStop, Tolerance};
use crate::compensation::path::{
    Contact as PathContact, HeightField, MachineLimits, PathError, PathOptions, RotaryAxis, RotationAxis, Scallops,
    TargetSurface, TiltMode, TrackSpacing, Wheel as PathWheel,
};
use crate::compensation::{Correction, CorrectionLimits, MapOptions, SurfacePoint, WheelTerm, contact_width_mm};
use crate::config::{CellConfig, LinkConfig, RotaryLetter};
use crate::device::{AnyCmm, AnyGrinder, DriverContext, DriverError, LineAddress, ModbusSettings, Pass, hex};
use crate::drive::{AdaptiveOptions, ParameterCompensation, Probing, Programs, ReferenceSphere, Task, correction_grid};
use crate::formats::gcode::DialectError;
use crate::formats::{self, FormatError, NominalFile};
use crate::geometry::{Aperture, Grid, Point, Vector};
use crate::measuring::{Layout, PatternError, Target, ThermalExpansion, targets};
use crate::recipe::{
    MeasuringPattern, Micrometres, NominalSource, Recipe, RegistrationStart, SelectionMode, SpindleAxis, TableSettings,
    Tilt, TiltKind, WheelDimensions,
};
use crate::registration::{Coordinate, MapLimits};
use crate::surface::{DefinedSurface, DefinitionError, Nominal, PlaneProjection, Side, SurfaceError};

/// Reason why a recipe and a cell cannot make a run.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum SetupError {
    #[error(transparent)]
    File(#[from] FormatError),
    #[error("{path}: {source}")]
    Nominal { path: PathBuf, source: SurfaceError },
    #[error("{path}: {source}")]
    Definition { path: PathBuf, source: DefinitionError },
    #[error("{}: {key}: {what}; correct the value of this key", .path.display())]
    Table { path: PathBuf, key: &'static str, what: String },
    #[error("{path}: {source}")]
    Pattern { path: PathBuf, source: PatternError },
    #[error(
        "{}: {key} is {found}, but the cell file {} allows {allowed} (limit in that file: {limit}); change the recipe or use another cell",
        .recipe.display(), .cell.display()
    )]
    Limit { recipe: Box<Path>, cell: Box<Path>, key: &'static str, found: f64, allowed: Box<str>, limit: &'static str },
    #[error(
        "{recipe}: measure.qualify requires the reference sphere, and {cell} has none; add [cmm.reference_sphere] to \
         the cell file, or write qualify = false"
    )]
    NoSphere { recipe: PathBuf, cell: PathBuf },
    #[error(
        "{}: the gap between the reference sphere at {at} mm and the part of {} in its fixture is {gap_mm:.1} mm; \
         the probe requires {needed_mm:.1} mm; correct [cmm.reference_sphere] or [cmm.fixture]",
        .cell.display(), .recipe.display()
    )]
    SphereInPart { recipe: Box<Path>, cell: Box<Path>, at: Box<str>, gap_mm: f64, needed_mm: f64 },
    #[error(
        "{}: target {number} of the measuring pattern lies at {at} mm in the CMM frame, outside the travel of {} ({allowed}); move \
         [cmm.fixture], or measure less of the part",
        .recipe.display(), .cell.display()
    )]
    Travel { recipe: Box<Path>, cell: Box<Path>, number: usize, at: Box<str>, allowed: Box<str> },
    #[error(
        "{recipe}: the measuring pattern is `free`, and the wire of the CMM in {cell} requires a plan; choose grid, \
         spiral or file"
    )]
    NeedsPlan { recipe: PathBuf, cell: PathBuf },
    #[error(
        "{}: {key} requires the temperature of each measurement, and the wire of the CMM in {} reports none; remove \
         the key, or use another wire", .recipe.display(), .cell.display()
    )]
    NoTemperature { recipe: Box<Path>, cell: Box<Path>, key: &'static str },
    #[error(
        "{recipe}: grinding.track_mm is missing, and the scallops between the tracks cannot determine it, because \
         there is no path over this part: {source}; add grinding.track_mm"
    )]
    Tracks { recipe: PathBuf, source: PathError },
    #[error("{}: {source} (cell file {})", .recipe.display(), .cell.display())]
    Dialect { recipe: PathBuf, cell: PathBuf, source: DialectError },
    #[error("{cell}: {source}")]
    Machine { cell: PathBuf, source: DriverError },
}

/// Timeout of a job of a machine that a person serves without a wire.
const MANUAL_JOB_TIMEOUT: Duration = Duration::from_secs(7 * 86_400);
/// Timeout for a person to hold or to stop a machine and to confirm it.
const MANUAL_STOP_TIMEOUT: Duration = Duration::from_secs(600);
/// Timeout of an answer of the driver of a machine without a wire, for example from a folder on another computer. It
/// includes the time to read a large file.
const MANUAL_ANSWER_TIMEOUT: Duration = Duration::from_secs(90);
/// Size of one target in the registers of a plan, in bytes. A point of a result is smaller.
const MAX_TARGET_BYTES: usize = 56;
/// Factor between the timeout of a transfer and its duration without faults.
const TRANSFER_TIMEOUT_FACTOR: f64 = 3.0;
/// Minimum time between two polls during a slow transfer.
const MIN_MANUAL_POLL_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum rms and height of the scallops, as a share of the RMS limit and of the PV limit, if the scallops determine
/// the track distance. A larger share causes a warning. A fifth of an RMS adds 2 % in quadrature; a fifth of a PV adds
/// a fifth.
pub const MAX_SCALLOP_SHARE: f64 = 0.2;

/// Returns the task and the cell plan of a run. The task contains the data and the options of the computations. The
/// cell plan contains the parameters by which the cell decides, such as limits and timeouts.
///
/// # Errors
/// Returns an error if the nominal surface or the measuring pattern cannot be read or computed, or if the recipe and
/// the cell do not fit together, for example because a value of the recipe exceeds a limit of the cell.
pub fn prepare(recipe: &Recipe, cell: &CellConfig) -> Result<(Task, CellPlan), SetupError> {
    let (nominal, nominal_file, part_identity) = read_nominal(recipe)?;
    let side = recipe.measure.side.side().unwrap_or_default();
    let targets = lay_targets(recipe, &nominal, side)?;
    check_limits(recipe, cell, &targets)?;
    let sphere = reference_sphere(recipe, cell)?;
    if let Some(sphere) = &sphere {
        check_sphere(recipe, cell, &nominal, sphere)?;
    }
    let ground = surface_and_outline(recipe, &nominal);
    let (track_mm, scallops) = track_distance(recipe, cell, &nominal, &ground)?;
    let parameters = parameter_compensation(recipe, cell, &ground, &nominal)?;
    let datum = locked_sigmas(recipe, &nominal);
    let kind = learning_kind(recipe, &part_identity, track_mm, targets.len());
    let programs = ground.map(|ground| programs(recipe, cell, &nominal, part_identity, (ground, track_mm)));
    if let Ok(programs) = &programs {
        let said = |source| SetupError::Dialect { recipe: recipe.path().into(), cell: cell.path().into(), source };
        programs.check_dialect().map_err(said)?;
    }
    let task = Task {
        part: recipe.part.name.clone(),
        pass: pass(recipe, &nominal, part_identity, track_mm),
        programs,
        scallops,
        nominal: Arc::new(nominal),
        nominal_path: nominal_file,
        part_identity,
        probing: Probing {
            probe_radius_mm: recipe.measure.probe_radius_mm,
            approach_mm: recipe.measure.approach_mm,
            search_mm: recipe.measure.search_mm,
            speed_mm_s: recipe.measure.speed_mm_s,
            safe_height_mm: recipe.measure.safe_height_mm,
        },
        reference_sphere: sphere,
        fixture_cmm_from_model: cell.cmm.fixture_cmm_from_model,
        registration_options: recipe.registration_options(cell.cmm.fixture_cmm_from_model),
        start_at_fixture: recipe.registration.start == RegistrationStart::Fixture,
        expected_coordinates: cell.cmm.link.wire.coordinates(),
        parameter_compensation: parameters,
        locked_sigmas: datum,
        map_limits: MapLimits { max_lateral_mm: recipe.compensation.max_displacement_mm, ..MapLimits::default() },
        map_options: map_options(recipe),
        gain_rule: recipe.compensation.gain(),
        repeatability_mm: recipe.compensation.repeatability_um.map(Micrometres::mm),
        learned: None,
        setting: learning_setting(recipe, cell, &kind),
        kind,
        targets,
        correction_limits: CorrectionLimits {
            max_depth_mm: cell.grinder.limits.max_depth_mm,
            min_depth_mm: recipe.compensation.min_depth_um.mm(),
            depth_of_cut_mm: recipe.compensation.depth_of_cut_um.mm(),
            max_correction_mm: recipe.compensation.max_correction_um.mm(),
            allowance_mm: recipe.grinding.allowance_um.mm(),
            removal_budget_mm: recipe.compensation.removal_budget_um.mm(),
        },
        plot_tolerance_mm: recipe.acceptance.pv_um.map(|pv| 0.5 * pv.mm()),
        min_found_share: recipe.measure.min_coverage,
        temperature_range_c: recipe.measure.temperature_c,
        expansion: expansion(recipe, cell),
        machine_uncertainty: cell.cmm.uncertainty,
        tolerance: tolerance(recipe),
        adaptive: adaptive(recipe),
        simulation: cell.is_marked_simulation(),
        rehearsal: cell.rehearsal,
    };
    let mut plan = cell_plan(recipe, cell);
    plan.gates.min_found_share = min_found_share(recipe);
    let [map, targets] = [8 * task.first_correction().grid.len(), MAX_TARGET_BYTES * task.targets.len()];
    for (link, bytes) in [(&cell.grinder.link, map), (&cell.cmm.link, targets)] {
        plan.deadlines.transfer = plan.deadlines.transfer.max(transfer_timeout(link, bytes));
    }
    Ok((task, plan))
}

/// Returns the settings for the compensation of machine parameters. These are the tolerances of the parameters, the
/// direction in which an error of the wheel radius acts on the surface (along the normal or in height), and a point of
/// the surface for each node of the correction grid. `ground` is the surface to grind with the outline of the part, or
/// the reason why no path can be planned. Returns `None` if the recipe does not compensate parameters.
///
/// # Errors
/// Returns an error if the recipe compensates parameters and `ground` is an error.
fn parameter_compensation(
    recipe: &Recipe,
    cell: &CellConfig,
    ground: &Result<SurfaceAndOutline, PathError>,
    nominal: &Nominal,
) -> Result<Option<ParameterCompensation>, SetupError> {
    let Some(parameters) = &recipe.compensation.parameters else { return Ok(None) };
    let (field, _) = ground
        .as_ref()
        .map_err(|source| SetupError::Tracks { recipe: recipe.path().to_owned(), source: source.clone() })?;
    let Pass { x_mm, y_mm, .. } = pass(recipe, nominal, [0; 32], 1.0);
    let grid = correction_grid([x_mm, y_mm], recipe.compensation.spacing_mm);
    // A program moves the centre of the wheel along the normals. A grinder with its own path is guided in height.
    let is_program = cell.grinder.link.wire.reads_run_folder();
    let wheel_term = if is_program { WheelTerm::AlongNormal } else { WheelTerm::InHeight };
    Ok(Some(ParameterCompensation {
        tolerances: parameters.tolerances(),
        wheel_term,
        node_points: SurfacePoint::under_nodes(field, &grid),
    }))
}

/// Returns the standard uncertainties of the part's position (mm) and rotation (rad) in the fixture. The standard
/// uncertainty of the position is half of `lock_uncertainty_um` of the recipe, which is an expanded uncertainty (k =
/// 2). The standard uncertainty of the rotation is that of the position divided by half the larger extent of the part
/// in x or y. Returns `None` if the recipe does not state `lock_uncertainty_um`.
fn locked_sigmas(recipe: &Recipe, nominal: &Nominal) -> Option<[f64; 2]> {
    let Pass { x_mm, y_mm, .. } = pass(recipe, nominal, [0; 32], 1.0);
    let half_mm = [x_mm, y_mm].map(|[low, high]| 0.5 * (high - low));
    let shift_mm = 0.5 * recipe.registration.lock_uncertainty_um?.mm();
    Some([shift_mm, shift_mm / half_mm[0].max(half_mm[1])])
}

/// Returns the options of an adaptive measurement: the tolerance, the accepted risk, and the maximum number of cycles.
/// The accepted risk is the probability of accepting a part that is out of tolerance. Returns `None` if the measuring
/// mode of the recipe is not adaptive, or if the recipe does not state `accepted_risk`.
fn adaptive(recipe: &Recipe) -> Option<AdaptiveOptions> {
    let accepted_risk = recipe.measure.accepted_risk.filter(|_| recipe.measure.mode == SelectionMode::Adaptive)?;
    Some(AdaptiveOptions {
        tolerance: tolerance(recipe),
        accepted_risk,
        max_cycles: u32::from(recipe.cycle.max_cycles),
    })
}

/// Returns the minimum share (0 to 1) of the planned targets at which the probe must find a point. The share is
/// `min_coverage` of the recipe. For an adaptive measurement, `min_coverage` is multiplied by
/// [`AdaptiveOptions::FIRST_BATCH_MIN_SHARE`]. Thus one touch of the first batch can miss the part.
fn min_found_share(recipe: &Recipe) -> f64 {
    // One of the first touches can miss. The task checks the share of all touches.
    let share =
        if recipe.measure.mode == SelectionMode::Adaptive { AdaptiveOptions::FIRST_BATCH_MIN_SHARE } else { 1.0 };
    share * recipe.measure.min_coverage
}

/// Returns the acceptance criteria of the recipe: the limits of PV and RMS in mm, and how the figures are compared with
/// them. A limit that the recipe does not state is infinite.
fn tolerance(recipe: &Recipe) -> Tolerance {
    let limit = |um: Option<Micrometres>| um.map_or(f64::INFINITY, Micrometres::mm);
    Tolerance {
        pv_mm: limit(recipe.acceptance.pv_um),
        rms_mm: limit(recipe.acceptance.rms_um),
        with_uncertainty: recipe.acceptance.expanded_uncertainty,
        probability: recipe.required_probability(),
        pv_points: recipe.acceptance.pv_of,
    }
}

/// Returns the timeout for the transfer of `bytes` bytes to a machine on a serial Modbus line (RTU). The timeout is
/// three times the transfer time that follows from the baud rate and the number of bytes. The factor of three allows
/// for retries. Returns zero for every other kind of connection, including Modbus TCP.
fn transfer_timeout(link: &LinkConfig, bytes: usize) -> Duration {
    let Some((LineAddress::Rtu { baud, .. }, _)) = link.wire.modbus_line() else { return Duration::ZERO };
    // A page has 224 bytes of data in a frame of 249 and a response of 8. The machine needs some time for each page.
    let pages = bytes.div_ceil(224) as f64;
    let page_s = (249.0 + 8.0) * 11.0 / f64::from(baud.max(1)) + 0.05;
    Duration::from_secs_f64(TRANSFER_TIMEOUT_FACTOR * pages * page_s)
}

fn map_options(recipe: &Recipe) -> MapOptions {
    let (wheel_radius_mm, compensation) = (recipe.grinding.wheel.radius_mm(), &recipe.compensation);
    MapOptions {
        level_off_mm: wheel_radius_mm,
        contact_width_mm: contact_width_mm(wheel_radius_mm, compensation.depth_of_cut_um.mm()),
        smoothing: compensation.smoothing,
        order: compensation.filter_order,
        spline_smoothness: compensation.roughness,
        ..MapOptions::new(compensation.cutoff_mm, compensation.spacing_mm)
    }
}

/// Returns a text that identifies all settings that affect the errors of a pass. The text consists of the name of the
/// cell and of `kind`, the text from [`learning_kind`]. In a simulated cell, the settings of the simulation are added.
/// A run can start from the results of an earlier run only if this text is the same for both runs.
fn learning_setting(recipe: &Recipe, cell: &CellConfig, kind: &str) -> String {
    let mut said = format!("cell {:?}, {kind}", cell.name);
    // Another simulated world counts as another grinder.
    if let Some(world) = recipe.simulation.as_ref().filter(|_| cell.simulated) {
        let _ = write!(said, "; simulation {}", serde_json::json!(world));
    }
    said
}

/// Returns a text that identifies the settings that affect the errors of a pass, except the cell. These are the part
/// and the settings of grinding, measuring and compensation. A run can start from the results of a run in another cell
/// only if this text is the same for both runs.
///
/// `part` is the SHA-256 that identifies the nominal surface, `track_mm` the distance between the tracks of the wheel,
/// and `targets` the number of points to measure.
fn learning_kind(recipe: &Recipe, part: &[u8; 32], track_mm: f64, targets: usize) -> String {
    let part = hex(part);
    let (grinding, measure, map) = (&recipe.grinding, &recipe.measure, &recipe.compensation);
    let mut said = format!(
        "part {part}, begin with {:?}; {:?}, feed {} mm/min, tracks {track_mm} mm, spark-out {}, depth {} mm; {targets} targets, probe {} mm, \
         held {:?}; cut-off {} mm, {:?}, gain {:?}",
        recipe.cycle.begin_with,
        grinding.wheel,
        grinding.feed_mm_min,
        grinding.spark_out_passes,
        map.depth_of_cut_um.mm(),
        measure.probe_radius_mm,
        Coordinate::locked_flags(&recipe.registration.lock),
        map.cutoff_mm,
        map.smoothing,
        map.gain()
    );
    if let Some(Tilt { lean, angle_deg }) = grinding.tilt {
        let _ = write!(said, "; tilt {lean:?} by {angle_deg} degrees");
    }
    // Default values are omitted, so that results learned before these keys existed stay valid.
    if (map.filter_order, map.roughness) != Default::default() {
        let _ = write!(said, "; order {:?}, {:?}", map.filter_order, map.roughness);
    }
    said
}

/// Reads the nominal surface from a file, or samples it from a formula. Returns the surface, the path of its source
/// (the file or the recipe), and the SHA-256 that identifies the part.
fn read_nominal(recipe: &Recipe) -> Result<(Nominal, PathBuf, [u8; 32]), SetupError> {
    match &recipe.nominal {
        NominalSource::Surface(surface) => {
            let nominal = sample_surface(recipe.path(), surface)?;
            let identity = surface_identity(&nominal);
            Ok((nominal, recipe.path().to_owned(), identity))
        }
        NominalSource::File { path, table, projection, aperture } => {
            let table = nominal_table_format(table).map_err(|(key, what)| SetupError::Table {
                path: recipe.path().to_owned(),
                key,
                what,
            })?;
            let (file, identity) = formats::read_nominal_with_identity(path, &table)?;
            let nominal = nominal_from_file(path, file, *projection)?;
            let nominal = match aperture {
                Some(outline) => nominal.with_outline(outline.clone()),
                None => nominal,
            };
            Ok((nominal, path.clone(), identity))
        }
    }
}

/// Converts the table settings of the nominal file from text into a table format: columns, unit, and unit of z. `words`
/// are the settings from the recipe.
///
/// # Errors
/// Returns the recipe key of a setting that is not valid, and the reason.
pub fn nominal_table_format(words: &TableSettings) -> Result<formats::Table, (&'static str, String)> {
    table_format(words, ["nominal.columns", "nominal.unit", "nominal.height_unit"])
}

/// Parses the recipe settings `words` for the file that lists the points to measure. Returns the table format of the
/// file: columns, unit, and unit of z.
///
/// # Errors
/// Returns the recipe key of a setting that is not valid, and the reason.
pub fn plan_table_format(words: &TableSettings) -> Result<formats::Table, (&'static str, String)> {
    table_format(words, ["measure.file_columns", "measure.file_unit", "measure.file_height_unit"])
}

fn table_format(words: &TableSettings, keys: [&'static str; 3]) -> Result<formats::Table, (&'static str, String)> {
    let unit = |word: &Option<String>, key| word.as_deref().map(str::parse).transpose().map_err(|what| (key, what));
    Ok(formats::Table {
        columns: words.columns.as_deref().map(str::parse).transpose().map_err(|what| (keys[0], what))?,
        unit: unit(&words.unit, keys[1])?,
        height_unit: unit(&words.height_unit, keys[2])?,
    })
}

/// Builds the nominal surface from `file`, the content of the file at `path`. The content is points, a mesh or the
/// definition of a surface by a formula. `projection` is used for points only: it selects the surface onto which the
/// points are projected for their triangulation.
///
/// # Errors
/// Returns an error with `path` if no surface can be built from the content, or if a mesh encloses a solid.
pub fn nominal_from_file(path: &Path, file: NominalFile, projection: PlaneProjection) -> Result<Nominal, SetupError> {
    let of_surface = |source| SetupError::Nominal { path: path.to_owned(), source };
    match file {
        NominalFile::Points(points) => Nominal::from_points(points, projection).map_err(of_surface),
        NominalFile::Mesh { points, triangles } => {
            let nominal = Nominal::from_mesh(points, triangles).map_err(of_surface)?;
            nominal.check_is_open().map_err(of_surface)?;
            Ok(nominal)
        }
        NominalFile::Definition(text) => match DefinedSurface::from_toml(&text) {
            Ok(surface) => sample_surface(path, &surface),
            Err(source) => Err(SetupError::Definition { path: path.to_owned(), source }),
        },
    }
}

/// Returns the nominal surface that is sampled from a formula. The definition `surface` gives the node spacing, or an
/// accuracy from which the spacing is computed. The outline of `surface` limits the result. `path` is the file that
/// error messages name.
fn sample_surface(path: &Path, surface: &DefinedSurface) -> Result<Nominal, SetupError> {
    let grid = surface.spacing_mm().and_then(|spacing_mm| surface.sample(spacing_mm));
    let grid = grid.map_err(|source| SetupError::Definition { path: path.to_owned(), source })?;
    Nominal::from_grid_with_normals(grid.columns, grid.rows, grid.points, grid.normals)
        .map(|nominal| nominal.with_outline(surface.aperture().clone()))
        .map_err(|source| SetupError::Nominal { path: path.to_owned(), source })
}

/// Returns the SHA-256 of the coordinates of all points of a sampled surface. Thus two formulas that give exactly the
/// same points have the same SHA-256.
fn surface_identity(nominal: &Nominal) -> [u8; 32] {
    let mut hash = Sha256::new();
    for point in nominal.points() {
        for c in point.iter() {
            hash.update(c.to_le_bytes());
        }
    }
    hash.finalize().into()
}

fn lay_targets(recipe: &Recipe, nominal: &Nominal, side: Side) -> Result<Vec<Target>, SetupError> {
    let layout = match &recipe.pattern {
        MeasuringPattern::Generated(layout) => layout,
        MeasuringPattern::File { path, table } => {
            let table = plan_table_format(table).map_err(|(key, what)| SetupError::Table {
                path: recipe.path().to_owned(),
                key,
                what,
            })?;
            &Layout::Points(formats::read_plan(path, &table)?)
        }
        MeasuringPattern::Free { .. } => return Ok(Vec::new()),
    };
    targets(nominal, side, layout, recipe.measure.edge_margin_mm)
        .map_err(|source| SetupError::Pattern { path: recipe.path().to_owned(), source })
}

fn reference_sphere(recipe: &Recipe, cell: &CellConfig) -> Result<Option<ReferenceSphere>, SetupError> {
    match (recipe.measure.qualify, &cell.cmm.reference_sphere) {
        (false, _) => Ok(None),
        (true, Some(sphere)) => Ok(Some(ReferenceSphere {
            centre: sphere.centre,
            radius_mm: sphere.radius_mm,
            points: usize::from(sphere.points),
        })),
        (true, None) => Err(SetupError::NoSphere { recipe: recipe.path().to_owned(), cell: cell.path().to_owned() }),
    }
}

/// Checks that the probe has enough room between the reference sphere and the part in its fixture. The part is
/// approximated by the box around its nominal points. This box is aligned with the axes of the model frame and extended
/// without limit towards -z. The gap is the distance from the box to the surface of the sphere. It must be at least the
/// diameter of the probe plus the approach distance of the recipe.
///
/// # Errors
/// Returns an error if the gap is too small.
fn check_sphere(
    recipe: &Recipe,
    cell: &CellConfig,
    nominal: &Nominal,
    sphere: &ReferenceSphere,
) -> Result<(), SetupError> {
    let centre = cell.cmm.fixture_cmm_from_model.inverse().transform_point(&sphere.centre);
    let mut nearest = Point::from([f64::INFINITY; 3]);
    let mut farthest = -nearest;
    for p in nominal.points() {
        (nearest, farthest) = (nearest.inf(p), farthest.sup(p));
    }
    let beside = |at: f64, low: f64, high: f64| (low - at).max(at - high).max(0.0);
    let [x, y] = [0, 1].map(|k| beside(centre[k], nearest[k], farthest[k]));
    let gap_mm = x.hypot(y).hypot((centre.z - farthest.z).max(0.0)) - sphere.radius_mm;
    // The stylus moves around the sphere with its ball.
    let needed_mm = 2.0 * recipe.measure.probe_radius_mm + recipe.measure.approach_mm;
    if gap_mm >= needed_mm {
        return Ok(());
    }
    let (recipe, cell) = (recipe.path().into(), cell.path().into());
    let at = format!("{:.1}, {:.1}, {:.1}", sphere.centre.x, sphere.centre.y, sphere.centre.z).into();
    Err(SetupError::SphereInPart { recipe, cell, at, gap_mm: gap_mm.max(0.0), needed_mm })
}

fn check_limits(recipe: &Recipe, cell: &CellConfig, targets: &[Target]) -> Result<(), SetupError> {
    let limits = &cell.grinder.limits;
    let beyond = |key: &'static str, found: f64, least: f64, most: f64, limit: &'static str| {
        if (least..=most).contains(&found) {
            return Ok(());
        }
        let mut allowed = String::new();
        let _ = if least > 0.0 { write!(allowed, "{least} to {most}") } else { write!(allowed, "at most {most}") };
        let (recipe, cell) = (recipe.path().into(), cell.path().into());
        Err(SetupError::Limit { recipe, cell, key, found, allowed: allowed.into(), limit })
    };
    let [least, most] = limits.wheel_radius_mm;
    beyond("grinding.wheel.radius_mm", recipe.grinding.wheel.radius_mm(), least, most, "grinder.limits")?;
    let feed = recipe.grinding.feed_mm_min;
    beyond("grinding.feed_mm_min", feed, 0.0, limits.max_feed_mm_min, "grinder.limits.max_feed_mm_min")?;
    // Each value keeps its own unit in the message: micrometres in the recipe, millimetres in the cell file.
    let (depth_um, max_um) = (recipe.compensation.depth_of_cut_um.0, 1e3 * limits.max_depth_mm);
    beyond("compensation.depth_of_cut_um", depth_um, 0.0, max_um, "1000 times grinder.limits.max_depth_mm")?;
    if targets.is_empty() && !cell.cmm.link.wire.is_by_person() {
        return Err(SetupError::NeedsPlan { recipe: recipe.path().to_owned(), cell: cell.path().to_owned() });
    }
    let of_temperature = [
        ("part.expansion_um_m_k", recipe.part.expansion_um_m_k.is_some()),
        ("measure.temperature_c", recipe.measure.temperature_c.is_some()),
    ];
    // Checked here, because the first measurement comes after the first grinding.
    if let Some((key, _)) = of_temperature.into_iter().find(|(_, is_there)| *is_there)
        && !cell.cmm.link.wire.reports_temperature()
    {
        return Err(SetupError::NoTemperature { recipe: recipe.path().into(), cell: cell.path().into(), key });
    }
    check_travel(recipe, cell, targets)
}

fn check_travel(recipe: &Recipe, cell: &CellConfig, targets: &[Target]) -> Result<(), SetupError> {
    let Some(travel) = &cell.cmm.travel else { return Ok(()) };
    let reach = recipe.measure.probe_radius_mm + recipe.measure.approach_mm;
    let pose = &cell.cmm.fixture_cmm_from_model;
    let outside = |p: &Point| (0..3).any(|k| !(travel.min_mm[k]..=travel.max_mm[k]).contains(&p[k]));
    let found = targets
        .iter()
        .map(|t| pose.transform_point(&(t.point + reach * t.normal)))
        .enumerate()
        .find(|(_, p)| outside(p));
    match found {
        None => Ok(()),
        Some((k, at)) => Err(SetupError::Travel {
            recipe: recipe.path().into(),
            cell: cell.path().into(),
            number: k + 1,
            at: format!("{:.2}, {:.2}, {:.2}", at.x, at.y, at.z).into(),
            allowed: format!("{:?} to {:?}", travel.min_mm, travel.max_mm).into(),
        }),
    }
}

fn pass(recipe: &Recipe, nominal: &Nominal, part_identity: [u8; 32], track_spacing_mm: f64) -> Pass {
    let [low, high] = match nominal.outline() {
        Some(outline) => outline.bounds(),
        None => nominal.points().fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], p| {
            [[low[0].min(p.x), low[1].min(p.y)], [high[0].max(p.x), high[1].max(p.y)]]
        }),
    };
    Pass {
        spark_out_passes: recipe.grinding.spark_out_passes,
        wheel_radius_mm: recipe.grinding.wheel.radius_mm(),
        feed_mm_min: recipe.grinding.feed_mm_min,
        track_spacing_mm,
        level_mm: recipe.grinding.allowance_um.mm(),
        depth_of_cut_mm: recipe.compensation.depth_of_cut_um.mm(),
        x_mm: [low[0], high[0]],
        y_mm: [low[1], high[1]],
        part_identity,
    }
}

/// Surface under the paths, and outline of the part.
type SurfaceAndOutline = (HeightField, Aperture);

fn surface_and_outline(recipe: &Recipe, nominal: &Nominal) -> Result<SurfaceAndOutline, PathError> {
    let (field, outline) = Programs::surface_and_outline(nominal)?;
    // The surface as seen from the side of the wheel.
    Ok((if is_from_below(recipe) { field.mirrored() } else { field }, outline))
}

/// Returns true if the recipe sets the side of -z as the measured side. The part is then ground from this side too.
fn is_from_below(recipe: &Recipe) -> bool {
    recipe.measure.side.side() == Some(Side::Opposite)
}

/// Returns the distance between the tracks of the wheel in mm, and the scallops (the ridges between the tracks) at this
/// distance. `ground` is the surface to grind with the outline of the part, or the reason why no path can be planned.
///
/// The distance depends on the keys of the recipe:
///
/// - Only `track_mm`: the distance is `track_mm`.
/// - Only `scallop_nm` (the maximum height of the scallops): the distance is the largest one that respects this height.
/// - Both: the distance is the largest one that respects `scallop_nm`, and at most `track_mm`.
/// - Neither: the distance follows from the tolerances of the recipe, see [`track_for_tolerance_mm`].
///
/// Without `track_mm`, the distance is also at most the radius of the wheel, and at most half of the shorter side of
/// the part. If `ground` is an error and the recipe states `track_mm`, the distance is `track_mm` and the scallops are
/// `None`.
///
/// # Errors
/// Returns an error if no path can be planned and the recipe does not state `track_mm`, or if the target surface cannot
/// be computed.
fn track_distance(
    recipe: &Recipe,
    cell: &CellConfig,
    nominal: &Nominal,
    ground: &Result<SurfaceAndOutline, PathError>,
) -> Result<(f64, Option<Scallops>), SetupError> {
    let grinding = &recipe.grinding;
    let (field, outline) = match (ground, grinding.track_mm) {
        (Ok(ground), _) => ground,
        (Err(_), Some(track_mm)) => return Ok((track_mm, None)),
        (Err(source), None) => {
            return Err(SetupError::Tracks { recipe: recipe.path().to_owned(), source: source.clone() });
        }
    };
    let [low, high] = outline.bounds();
    let size_mm = [high[0] - low[0], high[1] - low[1]];
    let none = Correction::zero(Grid { columns: 2, rows: 2, first_mm: low, spacing_mm: size_mm }, 0.0);
    let unknown = |source| SetupError::Tracks { recipe: recipe.path().to_owned(), source };
    let wanted = TargetSurface::new(field.clone(), &none, 1.0).map_err(unknown)?;
    let options =
        with_tilt(recipe, cell, PathOptions::new(path_wheel(&grinding.wheel, nominal), 1.0, grinding.feed_mm_min));
    let wheel_at = |contact: &PathContact| options.wheel_at(contact);
    let unit = Scallops::compute(&wanted, outline, wheel_at, grinding.pattern, 1.0);
    // Tracks must overlap, and there must be more than one.
    let widest_mm = grinding.wheel.radius_mm().min(0.5 * size_mm[0].min(size_mm[1]));
    let track_mm = match (grinding.track_mm, grinding.scallop_nm) {
        (Some(track_mm), None) => track_mm,
        (max_mm, Some(nm)) => unit.max_track_mm(1e-6 * nm, f64::INFINITY).min(max_mm.unwrap_or(widest_mm)),
        (None, None) => track_for_tolerance_mm(recipe, &unit).min(widest_mm),
    };
    Ok((track_mm, Some(unit.with_track_mm(track_mm))))
}

/// Returns the maximum distance between tracks in mm at which the scallops (the ridges between the tracks) are small
/// enough for the limits of the recipe. The height of the scallops may be at most [`MAX_SCALLOP_SHARE`] times the PV
/// limit. Their rms may be at most [`MAX_SCALLOP_SHARE`] times the RMS limit. `scallops` gives height and rms for one
/// distance. For other distances, height and rms are proportional to the square of the distance. The result is rounded
/// down to two significant digits. The result is infinite if the recipe states neither limit, or if the wheel leaves no
/// scallops.
pub fn track_for_tolerance_mm(recipe: &Recipe, scallops: &Scallops) -> f64 {
    let share = |limit: Option<Micrometres>| limit.map_or(f64::INFINITY, |um| MAX_SCALLOP_SHARE * um.mm());
    let max_mm = scallops.max_track_mm(share(recipe.acceptance.pv_um), share(recipe.acceptance.rms_um));
    if !max_mm.is_finite() {
        return max_mm;
    }
    let per_mm = 10f64.powf(1.0 - max_mm.log10().floor());
    (max_mm * per_mm).floor() / per_mm
}

/// Returns the settings that all grinding programs of a part have in common, such as path options, machine limits and
/// program dialect. `ground` is the surface to grind, as a height over x and y, with the outline of the part.
/// `track_mm` is the distance between the tracks. `part_identity` is the SHA-256 that identifies the nominal surface.
fn programs(
    recipe: &Recipe,
    cell: &CellConfig,
    nominal: &Nominal,
    part_identity: [u8; 32],
    (ground, track_mm): (SurfaceAndOutline, f64),
) -> Programs {
    let (grinding, limits) = (&recipe.grinding, &cell.grinder.limits);
    let plain = PathOptions::new(path_wheel(&grinding.wheel, nominal), track_mm, grinding.feed_mm_min);
    let plain = with_tilt(recipe, cell, plain);
    // The wheel reaches its feed before it touches the part.
    let machine = MachineLimits {
        travel_mm: limits.travel.map(|travel| [travel.min_mm, travel.max_mm]),
        speed_mm_s: limits.max_speed_mm_s,
        acceleration_mm_s2: limits.max_acceleration_mm_s2,
        jerk_mm_s3: limits.max_jerk_mm_s3,
    };
    let run_up_mm = 1.1 * machine.run_up_mm(grinding.feed_mm_min);
    let options = PathOptions {
        from_below: is_from_below(recipe),
        pattern: grinding.pattern,
        one_way: grinding.one_way,
        spacing: match grinding.scallop_nm {
            // A correction can bend the surface a little more than the nominal surface is bent.
            Some(nm) => TrackSpacing::Scallop { max_height_mm: 1e-6 * nm, max_track_mm: track_mm },
            None => TrackSpacing::Distance(track_mm),
        },
        chord_error_mm: grinding.chord_error_um.mm(),
        overrun_mm: grinding.overrun_mm,
        lead_mm: plain.lead_mm.max(run_up_mm - grinding.overrun_mm),
        safe_height_mm: grinding.safe_height_mm,
        spiral_acceleration_mm_s2: limits.max_acceleration_mm_s2,
        ..plain
    };
    Programs {
        part: recipe.part.name.clone(),
        part_identity,
        surface_and_outline: ground,
        options,
        limits: machine,
        mode: grinding.path_mode,
        path_tolerance_mm: grinding.path_tolerance_um.mm(),
        controller_tolerance_mm: cell.grinder.program.controller_tolerance_mm,
        arcs_within_mm: cell.grinder.program.arcs_within_mm,
        dialect: cell.grinder.program.dialect.clone(),
        folder: cell.grinder.program.folder.clone(),
        spark_out_passes: grinding.spark_out_passes,
        simulation: cell.simulated,
    }
}

/// Returns a copy of the path options `plain` with the rotary axis of the grinder from the cell file and the tilt of
/// the wheel from the recipe. Each of the two options is `None` if its file does not state it.
fn with_tilt(recipe: &Recipe, cell: &CellConfig, plain: PathOptions) -> PathOptions {
    let step_rad = 10f64.powi(-i32::from(cell.grinder.program.dialect.numbers.angle_decimals)).to_radians();
    let rotary = cell.grinder.rotary.map(|head| {
        let (letter, about) = match head.letter {
            RotaryLetter::A => ('A', RotationAxis::X),
            RotaryLetter::B => ('B', RotationAxis::Y),
        };
        RotaryAxis {
            letter,
            axis: about,
            reversed: head.reversed,
            range_rad: head.range_deg.map(f64::to_radians),
            rate_rad_s: head.max_rate_deg_min.to_radians() / 60.0,
            step_rad,
            pivot_mm: head.pivot_mm.map(Vector::from),
        }
    });
    let lean = recipe.grinding.tilt.map(|Tilt { lean, angle_deg }| match (lean, angle_deg.to_radians()) {
        (TiltKind::Constant, angle_rad) => TiltMode::Constant { angle_rad },
        (TiltKind::Following, lead_rad) => TiltMode::Following { lead_rad },
    });
    PathOptions { rotary, tilt: lean, ..plain }
}

/// Converts the wheel of a recipe into the wheel for path planning. If the recipe states no tilt for a cup wheel, the
/// tilt is the largest slope of the part plus 0.0873 rad (about 5°).
fn path_wheel(wheel: &WheelDimensions, nominal: &Nominal) -> PathWheel {
    const CUP_TILT_MARGIN_RAD: f64 = 0.0873;
    match *wheel {
        WheelDimensions::Sphere { radius_mm } => PathWheel::Sphere { radius_mm },
        WheelDimensions::Torus { radius_mm, minor_radius_mm, spindle } => PathWheel::Torus {
            ring_mm: radius_mm - minor_radius_mm,
            tube_mm: minor_radius_mm,
            spindle: match spindle {
                SpindleAxis::X => Vector::x(),
                SpindleAxis::Y => Vector::y(),
            },
        },
        WheelDimensions::Cup { radius_mm, minor_radius_mm, tilt_deg } => {
            let sloped = || nominal.max_slope_rad() + CUP_TILT_MARGIN_RAD;
            PathWheel::tilted_cup(radius_mm, minor_radius_mm, tilt_deg.map_or_else(sloped, f64::to_radians))
        }
    }
}

/// Returns the thermal expansion coefficients, in 1/K, of the part and of the scales of the CMM. The result also
/// contains two standard uncertainties: that of the part's coefficient in 1/K, and that of the temperature in K. If the
/// recipe does not state the uncertainty of the part's coefficient, the uncertainty is 10 % of the coefficient. Returns
/// `None` if the recipe does not state the coefficient of the part.
fn expansion(recipe: &Recipe, cell: &CellConfig) -> Option<ThermalExpansion> {
    const MILLIONTH: f64 = 1e-6;
    let of_part = recipe.part.expansion_um_m_k?;
    let uncertainty = recipe.part.expansion_uncertainty_um_m_k.unwrap_or(0.1 * of_part.abs());
    Some(ThermalExpansion {
        part_per_k: MILLIONTH * of_part,
        part_sigma_per_k: MILLIONTH * uncertainty,
        scales_per_k: MILLIONTH * cell.cmm.scale_expansion_um_m_k,
        temperature_sigma_k: cell.cmm.temperature_uncertainty_k,
    })
}

fn cell_plan(recipe: &Recipe, cell: &CellConfig) -> CellPlan {
    // A job by a person can take days. During a hold the cell keeps waiting.
    let mut deadlines = Deadlines::default();
    let by_person = [&cell.cmm.link, &cell.grinder.link].map(|link| link.wire.is_by_person());
    for k in (0..2).filter(|k| by_person[*k]) {
        (deadlines.progress[k], deadlines.hold[k], deadlines.stop[k]) =
            (MANUAL_JOB_TIMEOUT, MANUAL_STOP_TIMEOUT, MANUAL_STOP_TIMEOUT);
        deadlines.progress_notice[k] = None;
        (deadlines.answer, deadlines.connect) = (MANUAL_ANSWER_TIMEOUT, MANUAL_ANSWER_TIMEOUT);
    }
    CellPlan {
        begin_with: recipe.cycle.begin_with,
        max_cycles: u32::from(recipe.cycle.max_cycles),
        tolerance: tolerance(recipe),
        stall_share: 0.02,
        stall_mm: recipe.cycle.stall_um.mm(),
        on_stall: recipe.cycle.on_stall,
        on_divergence: recipe.cycle.on_divergence,
        on_refusal: HoldOrStop::Stop,
        gates: GateLimits {
            min_found_share: recipe.measure.min_coverage,
            min_coverage: recipe.registration.min_coverage,
            max_shift_mm: recipe.registration.max_shift_mm,
            max_rotation_rad: recipe.registration.max_turn_deg.to_radians(),
            max_radius_error_mm: recipe.measure.qualify.then_some(recipe.measure.radius_tolerance_um.mm()),
        },
        removal_budget_mm: recipe.compensation.removal_budget_um.mm(),
        min_depth_mm: recipe.compensation.min_depth_um.mm(),
        clear_at_start: cell.simulated,
        deadlines,
    }
}

/// Creates the drivers of the CMM and the grinder. Sends nothing to a machine. `part` is the name of the part in files
/// and prompts. `folder` is the run folder. `owner` is the number of this client, and `epoch` increases with each start
/// of the client. A machine that several clients can reach uses these two numbers to distinguish the clients.
///
/// # Errors
/// Returns an error if a connection cannot be opened, if a folder does not exist, or if the file of reference points
/// (points with known positions, for a CMM that measures from several stations) cannot be read.
pub fn create_drivers(
    recipe: &Recipe,
    cell: &CellConfig,
    part: &str,
    folder: &Path,
    [owner, epoch]: [u32; 2],
) -> Result<(AnyCmm, AnyGrinder), SetupError> {
    let failed = |source| SetupError::Machine { cell: cell.path().to_owned(), source };
    let making = |link| DriverContext {
        part,
        cell_folder: cell.path().parent().unwrap_or(Path::new("")),
        run_folder: folder,
        min_free_points: match &recipe.pattern {
            MeasuringPattern::Free { min_points } => Some(usize::try_from(*min_points).unwrap_or(usize::MAX)),
            _ => None,
        },
        min_coverage: min_found_share(recipe),
        rehearsal: cell.rehearsal,
        volume_mm: probe_travel_mm(cell),
        ..driver_context(link, cell.simulated, [owner, epoch])
    };
    let cmm = cell.cmm.link.wire.create_cmm(&making(&cell.cmm.link)).map_err(failed)?;
    let beside = DriverContext { shared_link: cmm.link(), ..making(&cell.grinder.link) };
    let grinder = cell.grinder.link.wire.create_grinder(&beside).map_err(failed)?;
    Ok((cmm, grinder))
}

/// Returns the driver settings of a machine that is connected by Modbus. Returns `None` for a machine with another kind
/// of connection. `owner` is the number of this client, and `epoch` increases with each start of the client.
///
/// `simulated` is true if the cell file declares its machines as simulated. The driver refuses a real machine in a
/// simulated cell and a simulated machine in a real cell.
pub fn modbus_settings(link: &LinkConfig, simulated: bool, owner: u32, epoch: u32) -> Option<ModbusSettings> {
    let (line, unit) = link.wire.modbus_line()?;
    Some(ModbusSettings::from_context(line, unit, &driver_context(link, simulated, [owner, epoch])))
}

/// Checks that the resources of a machine exist, such as its exchange folders. For this check the driver of the machine
/// is created and dropped. Sends nothing to the machine.
///
/// # Errors
/// Returns an error if the connection cannot be opened, if a folder does not exist, or if the file of reference points
/// (points with known positions, for a CMM that measures from several stations) cannot be read.
pub fn check_machine(cell: &CellConfig, device: Device) -> Result<(), DriverError> {
    let link = match device {
        Device::Cmm => &cell.cmm.link,
        Device::Grinder => &cell.grinder.link,
    };
    let cell_folder = cell.path().parent().unwrap_or(Path::new(""));
    let making =
        DriverContext { cell_folder, volume_mm: probe_travel_mm(cell), ..driver_context(link, cell.simulated, [1, 1]) };
    match device {
        Device::Cmm => link.wire.create_cmm(&making).map(drop),
        Device::Grinder => link.wire.create_grinder(&making).map(drop),
    }
}

/// Creates the driver of the CMM without data of a part or a run. The driver can be used only to inspect the machine.
/// Sends nothing to the machine.
///
/// # Errors
/// Returns an error if the connection cannot be opened, if a folder does not exist, or if the file of reference points
/// (points with known positions, for a CMM that measures from several stations) cannot be read.
pub fn create_cmm(cell: &CellConfig) -> Result<AnyCmm, DriverError> {
    let cell_folder = cell.path().parent().unwrap_or(Path::new(""));
    let link = &cell.cmm.link;
    link.wire.create_cmm(&DriverContext {
        cell_folder,
        volume_mm: probe_travel_mm(cell),
        ..driver_context(link, cell.simulated, [1, 1])
    })
}

/// Creates the driver of the grinder without data of a part or a run. The driver can be used only to inspect the
/// machine. Sends nothing to the machine.
///
/// # Errors
/// Returns an error if the connection cannot be opened or a folder does not exist.
pub fn create_grinder(cell: &CellConfig) -> Result<AnyGrinder, DriverError> {
    let cell_folder = cell.path().parent().unwrap_or(Path::new(""));
    let link = &cell.grinder.link;
    link.wire.create_grinder(&DriverContext { cell_folder, ..driver_context(link, cell.simulated, [1, 1]) })
}

/// Returns the box of allowed positions of the probe's centre, as its minimum and maximum corner in mm. Returns `None`
/// if the cell file does not state it.
fn probe_travel_mm(cell: &CellConfig) -> Option<[[f64; 3]; 2]> {
    cell.cmm.travel.as_ref().map(|travel| [travel.min_mm, travel.max_mm])
}

/// Returns a driver context with the connection settings of one machine from `link`. The fields for the part, the run
/// and the folders are empty. A caller that needs these fields sets them afterwards. `simulated` is true if the
/// machines of the cell are simulations. `owner` is the number of this client, and `epoch` increases with each start of
/// the client.
fn driver_context(link: &LinkConfig, simulated: bool, [owner, epoch]: [u32; 2]) -> DriverContext<'_> {
    DriverContext {
        part: "",
        cell_folder: Path::new(""),
        run_folder: Path::new(""),
        simulated,
        owner,
        epoch,
        min_free_points: None,
        min_coverage: 0.0,
        rehearsal: false,
        timing: &link.timing,
        registers: &link.registers,
        signals: &link.signals,
        expected_name: link.expected_name.as_deref(),
        volume_mm: None,
        shared_link: None,
    }
}

/// Returns the time between two reads of the status of a machine. The cell file states it. For a machine that a person
/// operates, it is at least 250 ms.
pub fn poll_interval(link: &LinkConfig) -> Duration {
    if link.wire.is_by_person() { link.timing.poll.max(MIN_MANUAL_POLL_INTERVAL) } else { link.timing.poll }
}
