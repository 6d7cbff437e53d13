//! `regrind plan`: the commands of a run, checked against every limit, without a machine.

use std::path::PathBuf;

use clap::Args;
use data_encoding::HEXLOWER;
use regrind::cell::CellPlan;
use regrind::compensation::path::{ArcSummary, PathSummary, Peak, Scallops, ToolPath};
use regrind::config::{BUILT_IN_CELL, CellConfig};
use regrind::drive::{MeasurementForecast, Task, forecast_measurement};
use regrind::formats::gcode::GcodeError;
use regrind::model::FIRST_BATCH;
use regrind::recipe::{NominalSource, Recipe};
use regrind::registration::WeakDirection;
use regrind::setup::{self, MAX_SCALLOP_SHARE};
use serde::Serialize;

use super::Outcome;
use super::check::or_show;
use super::failure::Failure;
use super::words::{counted, three_digits};

/// Print what a run would command, checked against every limit, without a device
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plan recipes/freeform-mirror.toml

Exit codes: 0 everything is within its limits; 2 bad recipe or cell, or a limit is exceeded; 3 fault.")]
pub(super) struct Arguments {
    /// Recipe of the part
    #[arg(value_name = "RECIPE")]
    recipe: PathBuf,
    /// Cell that would make the part
    #[arg(long, value_name = "FILE", default_value = BUILT_IN_CELL)]
    cell: PathBuf,
    /// Write the program of the first pass, which has no correction, to this file
    #[arg(long, value_name = "FILE")]
    program: Option<PathBuf>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// Duration of a shift in minutes. No pass and no measurement is meant to take longer.
const MAX_MINUTES: f64 = 480.0;
/// Form error of a part that a correction is computed for, in limits of the part.
const FORM_ERROR_LIMITS: f64 = 4.0;
/// Peak to valley of a form error, in units of its root mean square.
const PV_OF_RMS: f64 = 6.0;

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let recipe = or_show(Recipe::read(&arguments.recipe))?;
    let cell = or_show(CellConfig::read(&arguments.cell))?;
    let PlannedRun { document, task, .. } = PlannedRun::new(&recipe, &cell)?;
    if let Some(file) = &arguments.program {
        let first = task.first_correction();
        let programs = task.programs.as_ref().map_err(|error| Failure::Programs(error.clone().into()))?;
        programs.write(file, &first, task.map_identity(&first)).map_err(Failure::Programs)?;
    }
    if arguments.json {
        super::print_json(&document)?;
    } else {
        super::print(&words(&document))?;
    }
    Ok(Outcome::Accepted)
}

/// Plan of a run.
pub(super) struct PlannedRun {
    /// The plan for people and programs.
    pub(super) document: PlanDocument,
    /// Task of the run.
    pub(super) task: Task,
    /// Path of the first pass with its summary; `None` if this program cannot plan a path for the part.
    pub(super) path: Option<(ToolPath, PathSummary)>,
}

impl PlannedRun {
    /// Plans a run of `recipe` in `cell`.
    ///
    /// # Errors
    /// The recipe and the cell do not fit together, the wheel cannot grind the surface, or a limit is exceeded.
    pub(super) fn new(recipe: &Recipe, cell: &CellConfig) -> Result<Self, Failure> {
        let (task, plan) = setup::prepare(recipe, cell).map_err(Failure::Setup)?;
        let path = first_path(&task, recipe, cell)?;
        let arcs = arcs_of(&task, path.as_ref())?;
        let document = PlanDocument::new((recipe, cell), (&task, &plan), path.as_ref(), arcs);
        Ok(Self { document, task, path })
    }
}

#[derive(Serialize)]
pub(super) struct PlanDocument {
    simulation: bool,
    part: String,
    part_identity: String,
    nominal_points: usize,
    targets: usize,
    /// True if the targets are touched in batches, and the measurement ends when enough is known.
    touches_are_chosen: bool,
    sphere_points: usize,
    #[serde(rename = "most_cycles")]
    max_cycles: u32,
    first_level_um: f64,
    depth_of_cut_um: f64,
    last_level_um: f64,
    removal_budget_um: f64,
    tracks: u64,
    track_mm: f64,
    /// Scallops between the tracks; absent if no path can be made.
    #[serde(skip_serializing_if = "Option::is_none")]
    scallops: Option<ScallopsDocument>,
    path_mm: f64,
    grinding_minutes: f64,
    /// Volume that one pass removes: depth of cut times the area that its tracks cover.
    removed_mm3_a_pass: f64,
    /// Volume that the wheel loses in one pass; absent if the recipe gives no grinding ratio.
    #[serde(skip_serializing_if = "Option::is_none")]
    wheel_loss_mm3_a_pass: Option<f64>,
    /// Maximum number of passes and of measurements that the recipe allows.
    #[serde(rename = "most_passes")]
    max_passes: u32,
    #[serde(rename = "most_measurements")]
    max_measurements: u32,
    /// Minimum duration of one measurement, from its search moves alone; absent if the operator takes the points.
    #[serde(rename = "least_measuring_minutes", skip_serializing_if = "Option::is_none")]
    min_measuring_minutes: Option<f64>,
    /// Hours of all passes, plus the minimum duration of all measurements.
    #[serde(rename = "least_hours_to_last")]
    min_hours_total: f64,
    /// Directions in which the shape of the part determines its position poorly, as a measurement after the first pass
    /// would tell.
    weak_directions: Vec<WeakDirection>,
    /// Warnings to read before the run.
    warnings: Vec<String>,
    /// Number of points in the program of one pass; absent if no program can be made.
    #[serde(skip_serializing_if = "Option::is_none")]
    program_points: Option<u64>,
    /// Arcs of the program of one pass; absent if the cell does not require arcs.
    #[serde(skip_serializing_if = "Option::is_none")]
    arcs: Option<ArcsDocument>,
    /// Name of the dialect of the program.
    dialect: String,
    /// Tilt of the wheel by the head; absent if the head does not tilt the wheel.
    #[serde(skip_serializing_if = "Option::is_none")]
    tilt: Option<TiltDocument>,
    /// Reason why no program can be made; absent if one can be made.
    #[serde(skip_serializing_if = "Option::is_none")]
    no_program: Option<String>,
    /// True if the recipe lets a run start from the learned error of an earlier run.
    learns: bool,
}

/// Program of a pass with arcs, compared with the program of the same pass with lines only.
#[derive(Serialize)]
struct ArcsDocument {
    arcs: u64,
    /// Number of lines at feed that no arc replaces.
    lines: u64,
    /// Number of moves (arcs and lines) per second at feed, and the same number for the program with lines only.
    moves_per_second: f64,
    lines_alone_per_second: f64,
    /// Maximum distance of an arc from the path, and its limit.
    #[serde(rename = "largest_deviation_um")]
    max_deviation_um: f64,
    within_um: f64,
    /// Largest angle between the direction at the end of a move and the direction at the start of the next move, and
    /// the same angle for the program with lines only.
    #[serde(rename = "largest_corner_mrad")]
    max_corner_mrad: f64,
    lines_alone_corner_mrad: f64,
}

impl ArcsDocument {
    fn new(arcs: &ArcSummary, summary: &PathSummary, within_mm: f64) -> Self {
        let [max_corner_mrad, lines_alone_corner_mrad] = arcs.corner_rad.map(|rad| 1e3 * rad);
        Self {
            arcs: arcs.arcs,
            lines: arcs.lines,
            moves_per_second: (arcs.arcs + arcs.lines) as f64 / summary.duration_s,
            lines_alone_per_second: summary.points as f64 / summary.duration_s,
            max_deviation_um: 1e3 * arcs.deviation_mm,
            within_um: 1e3 * within_mm,
            max_corner_mrad,
            lines_alone_corner_mrad,
        }
    }

    fn in_words(&self, points: u64) -> String {
        let n = three_digits;
        format!(
            "{} and {} replace {}; {} moves per second instead of {}; largest distance from the path {} µm, limit {} µm; largest change of direction between two moves {} mrad instead of {}",
            counted(self.arcs as usize, "arc"),
            counted(self.lines as usize, "line"),
            counted(points as usize, "line"),
            n(self.moves_per_second),
            n(self.lines_alone_per_second),
            n(self.max_deviation_um),
            n(self.within_um),
            n(self.max_corner_mrad),
            n(self.lines_alone_corner_mrad),
        )
    }
}

/// Tilt of the wheel by the head, in readings of its rotary axis.
#[derive(Serialize)]
struct TiltDocument {
    axis: char,
    #[serde(rename = "least_deg")]
    min_deg: f64,
    #[serde(rename = "most_deg")]
    max_deg: f64,
    #[serde(rename = "largest_rate_deg_min")]
    max_rate_deg_min: f64,
    /// Minimum angle between the upright direction of the head and the normals of the part. At 0, a spherical wheel
    /// touches with its pole, where the surface speed is 0.
    #[serde(rename = "least_lean_deg")]
    min_tilt_deg: f64,
}

impl TiltDocument {
    fn new(path: &ToolPath, summary: &PathSummary) -> Option<Self> {
        let turned = summary.head_rotation?;
        let on_scale = |peak: Peak| turned.rotary.scale_reading_rad(peak.value).to_degrees();
        let [a, b] = [on_scale(turned.min_tilt_rad), on_scale(turned.max_tilt_rad)];
        Some(Self {
            axis: turned.rotary.letter,
            min_deg: a.min(b),
            max_deg: a.max(b),
            max_rate_deg_min: 60.0 * turned.max_rate_rad_s.value.to_degrees(),
            min_tilt_deg: path.min_head_angle_rad().to_degrees(),
        })
    }

    fn in_words(&self) -> String {
        let n = three_digits;
        format!(
            "tilt        rotary axis {} from {} to {}°, at most {}°/min; smallest angle between the upright head and a normal of the part: {}°\n",
            self.axis,
            n(self.min_deg),
            n(self.max_deg),
            n(self.max_rate_deg_min),
            n(self.min_tilt_deg),
        )
    }
}

/// Scallops, compared with the tolerances for form and scallops together.
#[derive(Serialize)]
struct ScallopsDocument {
    pv_um: f64,
    rms_um: f64,
    mean_um: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    allowed_pv_um: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    allowed_rms_um: Option<f64>,
}

impl ScallopsDocument {
    fn new(scallops: &Scallops, recipe: &Recipe) -> Self {
        let [pv_um, rms_um, mean_um] = [scallops.height_mm, scallops.rms_mm, scallops.mean_mm].map(|mm| 1e3 * mm);
        let [allowed_pv_um, allowed_rms_um] =
            [recipe.acceptance.pv_um, recipe.acceptance.rms_um].map(|um| um.map(|um| um.0));
        Self { pv_um, rms_um, mean_um, allowed_pv_um, allowed_rms_um }
    }

    /// Compares the scallops (the ridges between two tracks of the wheel) with the PV tolerance and the RMS tolerance.
    /// Returns one text for each tolerance of which the scallops use more than the share [`MAX_SCALLOP_SHARE`]. The
    /// text states the used share and the recipe key, for example "40 % of acceptance.pv_um". Omits a tolerance that
    /// the recipe does not give.
    fn beyond(&self) -> Vec<String> {
        let taken = [
            ("acceptance.pv_um", self.pv_um, self.allowed_pv_um),
            ("acceptance.rms_um", self.rms_um, self.allowed_rms_um),
        ];
        let of = |(key, found, allowed): (&str, f64, Option<f64>)| {
            let share = found / allowed?;
            (share > MAX_SCALLOP_SHARE * (1.0 + 1e-9)).then(|| format!("{} % of {key}", three_digits(100.0 * share)))
        };
        taken.into_iter().filter_map(of).collect()
    }

    fn in_words(&self, track_mm: f64) -> String {
        let n = three_digits;
        let allowed: Vec<String> = [("PV", self.allowed_pv_um), ("RMS", self.allowed_rms_um)]
            .into_iter()
            .filter_map(|(what, um)| um.map(|um| format!("{what} {} µm", n(um))))
            .collect();
        format!(
            "PV {} µm and RMS {} µm, with {} mm from track to track; {} allowed for form error and scallops together",
            n(self.pv_um),
            n(self.rms_um),
            n(track_mm),
            match &allowed[..] {
                [one] => format!("{one} is"),
                all => format!("{} are", all.join(" and ")),
            }
        )
    }
}

impl PlanDocument {
    /// Describes the plan `plan` of the run with the task `task`. `program` is the path of the first pass with its
    /// summary, if there is one, and `arcs` describes its arcs.
    fn new(
        (recipe, cell): (&Recipe, &CellConfig),
        (task, plan): (&Task, &CellPlan),
        program: Option<&(ToolPath, PathSummary)>,
        arcs: Option<ArcsDocument>,
    ) -> Self {
        let (tracks, pass_mm) = tracks_of_pass(task, program);
        let path_mm = pass_mm * f64::from(1 + task.pass.spark_out_passes);
        let depth_um = 1e3 * task.correction_limits.depth_of_cut_mm;
        let passes = f64::from(plan.max_cycles.max(1) - 1);
        let first_um = 1e3 * task.correction_limits.allowance_mm;
        let grinding_minutes = path_mm / task.pass.feed_mm_min;
        let removed_mm3_a_pass = pass_mm * task.pass.track_spacing_mm * task.correction_limits.depth_of_cut_mm;
        let max_measurements = plan.max_cycle_number();
        let forecast = forecast(task, recipe);
        let min_measuring_minutes = min_measuring_minutes(task);
        let min_minutes = f64::from(plan.max_cycles) * grinding_minutes
            + f64::from(max_measurements) * min_measuring_minutes.unwrap_or(0.0);
        Self {
            simulation: cell.simulated,
            part: recipe.part.name.clone(),
            part_identity: HEXLOWER.encode(&task.part_identity),
            nominal_points: task.nominal.len(),
            targets: task.targets.len(),
            touches_are_chosen: task.adaptive.is_some(),
            sphere_points: task.reference_sphere.map_or(0, |s| s.points),
            max_cycles: plan.max_cycles,
            first_level_um: first_um,
            depth_of_cut_um: depth_um,
            last_level_um: first_um - (passes * depth_um).min(1e3 * task.correction_limits.removal_budget_mm),
            removal_budget_um: 1e3 * task.correction_limits.removal_budget_mm,
            tracks: tracks as u64,
            track_mm: task.pass.track_spacing_mm,
            scallops: task.scallops.map(|scallops| ScallopsDocument::new(&scallops, recipe)),
            path_mm,
            grinding_minutes,
            removed_mm3_a_pass,
            wheel_loss_mm3_a_pass: recipe.grinding.grinding_ratio.map(|ratio| removed_mm3_a_pass / ratio),
            max_passes: plan.max_cycles,
            max_measurements,
            min_measuring_minutes,
            min_hours_total: min_minutes / 60.0,
            weak_directions: forecast.measurement.weak_directions.clone(),
            warnings: warnings(task, path_mm, grinding_minutes, min_measuring_minutes)
                .into_iter()
                .chain(warning_of_scallops(task, recipe))
                .chain(warning_of_unit(task, recipe))
                .chain(forecast.warning())
                .collect(),
            program_points: program.map(|(_, summary)| summary.points),
            arcs,
            dialect: cell.grinder.program.dialect.dialect.name.clone(),
            tilt: program.and_then(|(path, summary)| TiltDocument::new(path, summary)),
            no_program: task.programs.as_ref().err().map(ToString::to_string),
            learns: recipe.compensation.learn,
        }
    }
}

/// Returns the number of tracks of a pass, and their length together in mm. `program` is the path of the first pass with
/// its summary. Without a program, tracks over the box around the part are the best estimate.
fn tracks_of_pass(task: &Task, program: Option<&(ToolPath, PathSummary)>) -> (f64, f64) {
    match program {
        Some((path, summary)) => (path.track_count() as f64, summary.length_mm),
        None => {
            let [width, depth] = [task.pass.x_mm, task.pass.y_mm].map(|[low, high]| high - low);
            let tracks = (depth / task.pass.track_spacing_mm).floor() + 1.0;
            (tracks, tracks * width)
        }
    }
}

/// Returns the summary of the circular arcs in the grinding program of the first pass. `program` is the path of this
/// pass with its summary. Returns `None` if `program` is `None`, if there is no program for the task, or if the cell
/// uses no arcs. Returns an error if the dialect of the controller cannot express the program.
fn arcs_of(task: &Task, program: Option<&(ToolPath, PathSummary)>) -> Result<Option<ArcsDocument>, Failure> {
    let (Some((path, summary)), Ok(programs)) = (program, &task.programs) else { return Ok(None) };
    let arcs = programs.arc_summary(path).map_err(|error| Failure::Programs(GcodeError::from(error).into()))?;
    Ok(arcs.zip(programs.arcs_within_mm).map(|(arcs, within_mm)| ArcsDocument::new(&arcs, summary, within_mm)))
}

/// Returns a lower bound of the measuring time in minutes: the number of targets, on the part and on the reference
/// sphere, times the time for the approach distance at probing speed. The moves between targets are not included,
/// because the measuring machine chooses them. Returns `None` if the task has no targets on the part.
fn min_measuring_minutes(task: &Task) -> Option<f64> {
    let targets = task.targets.len() + task.reference_sphere.map_or(0, |sphere| sphere.points);
    let seconds = targets as f64 * task.probing.approach_mm / task.probing.speed_mm_s;
    (!task.targets.is_empty()).then_some(seconds / 60.0)
}

/// Returns a warning for a grinding pass, and one for a measurement, if it takes longer than a shift ([`MAX_MINUTES`]).
/// `path_mm` is the length of the grinding path, and `grinding_minutes` the duration of one pass. `measuring_minutes`
/// is the minimum duration of one measurement; `None` means unknown and gives no warning.
fn warnings(task: &Task, path_mm: f64, grinding_minutes: f64, measuring_minutes: Option<f64>) -> Vec<String> {
    let n = three_digits;
    let mut warnings = Vec::new();
    if grinding_minutes > MAX_MINUTES {
        warnings.push(format!(
            "a pass takes {} h, more than a shift of {} h: {} mm of path at {} mm/min; check that grinding.feed_mm_min is not in mm/s and that \
             grinding.track_mm is not too small",
            n(grinding_minutes / 60.0),
            MAX_MINUTES / 60.0,
            n(path_mm),
            n(task.pass.feed_mm_min),
        ));
    }
    if let Some(minutes) = measuring_minutes.filter(|minutes| *minutes > MAX_MINUTES) {
        warnings.push(format!(
            "a measurement takes {} h at least, more than a shift of {} h: {}, each approached over {} mm at {} mm/s; raise measure.speed_mm_s, or \
             require fewer points",
            n(minutes / 60.0),
            MAX_MINUTES / 60.0,
            counted(task.targets.len(), "point"),
            n(task.probing.approach_mm),
            n(task.probing.speed_mm_s),
        ));
    }
    warnings
}

/// Returns a warning if the scallops (the ridges between the tracks of the wheel) use more than the share
/// [`MAX_SCALLOP_SHARE`] of the PV or RMS tolerance in `recipe`. Otherwise returns `None`, also if the scallops are
/// unknown.
fn warning_of_scallops(task: &Task, recipe: &Recipe) -> Option<String> {
    let scallops = task.scallops?;
    let beyond = ScallopsDocument::new(&scallops, recipe).beyond();
    (!beyond.is_empty()).then(|| {
        format!(
            "the scallops between the tracks are too high: {}, limit {} %; no correction can remove scallops; write grinding.track_mm = {} or less, or \
             use a wheel with a larger radius across the tracks",
            beyond.join(" and "),
            100.0 * MAX_SCALLOP_SHARE,
            setup::track_for_tolerance_mm(recipe, &scallops),
        )
    })
}

/// Returns a warning if the points of a nominal file enclose a part that is smaller than the wheel or hardly larger than
/// the ball of the probe. The file is then probably in another unit, such as inches.
fn warning_of_unit(task: &Task, recipe: &Recipe) -> Option<String> {
    let NominalSource::File { path, .. } = &recipe.nominal else { return None };
    let [width_mm, depth_mm] = [task.pass.x_mm, task.pass.y_mm].map(|[low, high]| high - low);
    let size_mm = width_mm.max(depth_mm);
    let (wheel_mm, ball_mm) = (task.pass.wheel_radius_mm, 2.0 * task.probing.probe_radius_mm);
    let n = three_digits;
    (size_mm < wheel_mm.max(2.0 * ball_mm)).then(|| {
        format!(
            "the part is {} mm x {} mm large, but the wheel has a radius of {} mm and the ball of the probe a diameter of {} mm; check that {} is in mm, or \
             write its unit (nominal.unit = \"inch\")",
            n(width_mm),
            n(depth_mm),
            n(wheel_mm),
            n(ball_mm),
            path.display(),
        )
    })
}

/// Forecast of the measurement after the first pass.
struct FirstMeasurement {
    /// Form error that is expected after the first pass, rms in millimetres.
    rms_mm: f64,
    measurement: MeasurementForecast,
}

impl FirstMeasurement {
    /// Returns a warning if the measurement would end without a correction, because the shape of the part does not
    /// determine its position well enough.
    fn warning(&self) -> Option<String> {
        let reason = self.measurement.refusal.as_ref()?;
        Some(format!(
            "a measurement of a part with {} µm rms of form error may end without a correction: {reason}",
            three_digits(1e3 * self.rms_mm)
        ))
    }
}

/// Returns the forecast of the measurement after the first pass. The form error is [`FORM_ERROR_LIMITS`] times the
/// limits of the part, as a first pass leaves it. The forecast is empty if the recipe has no limit, or if the operator
/// chooses the points.
fn forecast(task: &Task, recipe: &Recipe) -> FirstMeasurement {
    let [pv_mm, rms_mm] =
        [recipe.acceptance.pv_um.map(|um| um.mm() / PV_OF_RMS), recipe.acceptance.rms_um.map(|um| um.mm())];
    let rms_mm = FORM_ERROR_LIMITS * rms_mm.into_iter().chain(pv_mm).fold(f64::INFINITY, f64::min);
    let measurement = match rms_mm.is_finite() && !task.targets.is_empty() {
        true => forecast_measurement(task, rms_mm),
        false => MeasurementForecast::default(),
    };
    FirstMeasurement { rms_mm, measurement }
}

/// Returns the estimated duration of the planned run as text for a person. The text states the grinding time of each
/// pass in minutes, the minimum time of each measurement in minutes, and the sum in hours. The sum assumes that all
/// allowed passes are needed.
fn time_in_words(d: &PlanDocument) -> String {
    let n = three_digits;
    let measurements = counted(d.max_measurements as usize, "measurement");
    let measuring = d.min_measuring_minutes.map_or("of unknown duration".to_owned(), |minutes| {
        format!("of at least {} minutes, counting only the search moves", n(minutes))
    });
    format!(
        "at most {} of {} minutes and {measurements} {measuring}: {} h or more, if all passes and measurements are needed. This does not include the time for moves between \
         points and for loading: the recipe and the cell file do not state this time",
        if d.max_passes == 1 { "1 pass".to_owned() } else { format!("{} passes", d.max_passes) },
        n(d.grinding_minutes),
        n(d.min_hours_total),
    )
}

/// Returns the removed volumes as text for a person, in mm3: the volume that one pass removes from the part, and the
/// volume that the wheel loses in one pass and in all allowed passes. If the loss of the wheel is unknown, the text
/// says so.
fn removal_in_words(d: &PlanDocument) -> String {
    let n = three_digits;
    let most = f64::from(d.max_passes);
    let wheel = match d.wheel_loss_mm3_a_pass {
        Some(loss) => {
            format!("the wheel loses about {} mm3 in a pass, {} mm3 in all allowed passes", n(loss), n(most * loss))
        }
        None => "the loss of the wheel is unknown; set grinding.grinding_ratio to estimate it".to_owned(),
    };
    format!("about {} mm3 a pass; {wheel}", n(d.removed_mm3_a_pass))
}

/// Plans the path of the first pass, and checks this path against the limits of the grinder. Returns the path with its
/// summary. Returns `None` if this program cannot plan a path for the part; the controller of the grinder must then
/// plan the path. Returns an error if the wheel cannot grind the surface, or if the path exceeds a limit.
pub(super) fn first_path(
    task: &Task,
    recipe: &Recipe,
    cell: &CellConfig,
) -> Result<Option<(ToolPath, PathSummary)>, Failure> {
    let (recipe, cell) = (recipe.path().to_owned(), cell.path().to_owned());
    task.first_path().map_err(|source| Failure::FirstPath { recipe, cell, source })
}

fn words(d: &PlanDocument) -> String {
    let n = three_digits;
    let marked = if d.simulation { "SIMULATION  " } else { "" };
    let program = match (d.program_points, &d.no_program) {
        (Some(points), _) => format!("{} a pass, for {}", counted(points as usize, "point"), d.dialect),
        (None, reason) => format!("none: {}", reason.as_deref().unwrap_or_default()),
    };
    let arcs = d.arcs.as_ref().zip(d.program_points);
    let arcs = arcs.map_or(String::new(), |(arcs, points)| format!("arcs        {}\n", arcs.in_words(points)));
    let learns = if d.learns {
        "learn       a run starts with the correction that the last similar run learned; this plan does not contain this correction\n"
    } else {
        ""
    };
    let tilt = d.tilt.as_ref().map_or(String::new(), TiltDocument::in_words);
    let weak: String = d.weak_directions.iter().map(|weak| format!("weak        {}\n", weak.description)).collect();
    let warnings: String = d.warnings.iter().map(|warning| format!("warning     {warning}\n")).collect();
    format!(
        "{marked}{}\nnominal     {}, sha256 {}\nmeasure     {}, and {} on the reference sphere\ngrind       {} tracks, {} mm of path, {} minutes a pass\nscallops    {}\nprogram     {program}\n{arcs}{tilt}{learns}\
         level       {} µm over the nominal surface in the first pass, at least {} µm deeper in each further pass, {} µm in the last (negative: below the surface)\nbudget      {} µm of material in all passes\nremoval     {}\ncycles      at most {}\ntime        {}\n{weak}{warnings}",
        d.part,
        counted(d.nominal_points, "point"),
        d.part_identity,
        match (d.targets, d.touches_are_chosen) {
            (0, _) => "points that the operator chooses".to_owned(),
            (targets, false) => counted(targets, "point"),
            (targets, true) => format!(
                "{FIRST_BATCH} of {}, then more in batches until the error is known well enough",
                counted(targets, "point")
            ),
        },
        d.sphere_points,
        d.tracks,
        n(d.path_mm),
        n(d.grinding_minutes),
        d.scallops
            .as_ref()
            .map_or("unknown, because this program cannot plan a path for this part".to_owned(), |told| told
                .in_words(d.track_mm)),
        n(d.first_level_um),
        n(d.depth_of_cut_um),
        n(d.last_level_um),
        n(d.removal_budget_um),
        removal_in_words(d),
        d.max_cycles,
        time_in_words(d),
    )
}
