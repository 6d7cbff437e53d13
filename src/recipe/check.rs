//! Checks between the keys of a recipe, and the values that several keys define together.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::curvature;
use super::tables::{
    Acceptance, Compensation, FaceKey, Grinding, MeasurementSettings, Micrometres, NominalTable, PatternKind,
    RecipeFile, RegistrationSettings, RegistrationStart, SelectionMode, TiltKind, WheelDimensions,
};
use super::{MeasuringPattern, NominalSource, TableSettings};
use crate::cell::FirstStep;
use crate::compensation::path::TrackPattern;
use crate::document::Document;
use crate::geometry::Aperture;
use crate::measuring::Layout;
use crate::registration::{Coordinate, ProbeSide};
use crate::surface::analytic::{Sampling, SamplingDefinition};
use crate::surface::{DefinedSurface, SurfaceChoice, SurfaceDefinition, SurfaceSelection};

/// Maximum number of points: more than any part is measured with.
const MAX_POINTS: f64 = 1e6;

/// Checks the values of the recipe `written`, and reports each error to `document`. `path` is the path of the recipe
/// file. Returns the source of the nominal surface and the measuring pattern, each of which is defined by several keys.
/// Returns `None` for each of the two that is missing or invalid.
pub(super) fn check(
    written: &RecipeFile,
    path: &Path,
    document: &mut Document,
) -> (Option<NominalSource>, Option<MeasuringPattern>) {
    let folder = path.parent().unwrap_or(Path::new(""));
    let nominal = nominal(&written.nominal, folder, document);
    check_against_part(written, nominal.as_ref(), document);
    check_tables(written, document);
    measure(&written.measure, document);
    chosen_touches(written, document);
    registration(&written.registration, document);
    acceptance(&written.acceptance, document);
    compensation(&written.compensation, document);
    parameters(written, document);
    grinding(&written.grinding, document);
    (nominal, pattern(&written.measure, folder, document))
}

/// Joins `folder`, the folder of the recipe, and `path`, a path that the recipe contains. Returns an absolute `path`
/// unchanged.
fn resolve_path(folder: &Path, path: &str) -> PathBuf {
    folder.join(path)
}

/// Ends of the names of files with surfaces that are sampled.
const DESIGN_EXTENSIONS: [&str; 7] = ["stp", "step", "p21", "igs", "iges", "zmx", "seq"];

fn nominal(written: &NominalTable, folder: &Path, document: &mut Document) -> Option<NominalSource> {
    let from_formula = "remove this table, or use only a formula: remove `nominal.file` and keep [nominal.surface] and [nominal.aperture]";
    if !document.contains_key("nominal") {
        return None;
    }
    let Some(file) = &written.file else {
        let of_points = [
            ("projection", written.projection.is_some()),
            ("columns", written.columns.is_some()),
            ("unit", written.unit.is_some()),
            ("height_unit", written.height_unit.is_some()),
            ("face", written.face.is_some()),
            ("face_frame", written.face_frame.is_some()),
        ];
        for (key, _) in of_points.into_iter().filter(|(_, there)| *there) {
            document.report(&format!("nominal.{key}"), "is only for `nominal.file`", "", "remove this key");
        }
        return formula(written, document);
    };
    if written.surface.is_some() {
        document.report(
            "nominal.surface",
            "is given together with `nominal.file`",
            "the nominal surface comes from a file or from a formula, not from both",
            from_formula,
        );
    }
    let extension = Path::new(file).extension().and_then(|extension| extension.to_str()).map(str::to_lowercase);
    let is_sampled = extension.is_none_or(|extension| DESIGN_EXTENSIONS.contains(&&extension[..]));
    if written.sampling.is_some() && !is_sampled {
        document.report(
            "nominal.sampling",
            "is given together with `nominal.file`, which is neither a CAD model nor a lens",
            "points and meshes are taken as they are",
            "remove this table",
        );
    }
    let selection = SurfaceSelection {
        choice: written.face.as_ref().map(|face| match face {
            FaceKey::Number(number) => SurfaceChoice::Number(*number as usize),
            FaceKey::Name(name) if name == "largest" => SurfaceChoice::Largest,
            FaceKey::Name(name) => SurfaceChoice::Name(name.clone()),
        }),
        frame: written.face_frame.unwrap_or_default(),
        aperture: written.aperture.clone().and_then(|table| aperture(table, document)),
        sampling: written.sampling.clone().and_then(|table| sampling(table, document)),
    };
    Some(NominalSource::File {
        path: resolve_path(folder, file),
        table: TableSettings {
            columns: written.columns.clone(),
            unit: written.unit.clone(),
            height_unit: written.height_unit.clone(),
        },
        projection: written.projection.unwrap_or_default(),
        selection,
    })
}

fn aperture(table: toml::Table, document: &mut Document) -> Option<Aperture> {
    match toml::Value::Table(table).try_into::<Aperture>() {
        Err(error) => document.report("nominal.aperture", error.message().trim(), "", "correct the outline"),
        Ok(aperture) => match aperture.validate() {
            Ok(()) => return Some(aperture),
            Err(error) => {
                let key = format!("nominal.aperture.{}", error.key());
                document.report(&key, without_key(error.key(), &error.to_string()), "", "");
            }
        },
    }
    None
}

/// Parses the table `[nominal.sampling]` of a face.
fn sampling(table: toml::Table, document: &mut Document) -> Option<Sampling> {
    match toml::Value::Table(table).try_into::<SamplingDefinition>() {
        Err(error) => document.report("nominal.sampling", error.message().trim(), "", "correct the sampling"),
        Ok(sampling) => match sampling.resolve() {
            Ok(sampling) => return Some(sampling),
            Err(error) => document.report("nominal.sampling", error.to_string(), "", ""),
        },
    }
    None
}

/// Parses the tables `[nominal.surface]`, `[nominal.aperture]` and `[nominal.sampling]`, which define the nominal
/// surface by a formula. The table `[nominal.sampling]` is optional.
///
/// Returns `None` if a required table is missing or if a table is invalid, and reports the fault to `document`.
fn formula(written: &NominalTable, document: &mut Document) -> Option<NominalSource> {
    let tables = [("surface", &written.surface), ("aperture", &written.aperture), ("sampling", &written.sampling)];
    let missing = tables[..2].iter().filter(|(_, table)| table.is_none());
    let missing: Vec<&str> = missing.map(|(name, _)| *name).collect();
    for name in &missing {
        let key = format!("nominal.{name}");
        // An invalid table is already reported.
        if !document.has_problem(&key) {
            let remedy = format!("add the table [nominal.{name}], or `file = \"...\"` in [nominal]");
            document.report(&key, "is missing", "", &remedy);
        }
    }
    if !missing.is_empty() || document.has_problem("nominal") {
        return None;
    }
    let entry = |(name, table): (&str, &Option<toml::Table>)| Some((name.to_owned(), table.clone()?.into()));
    let definition = toml::Value::Table(tables.into_iter().filter_map(entry).collect());
    match SurfaceDefinition::deserialize(definition) {
        Err(error) => document.report("nominal.surface", error.message().trim(), "", "correct the formula"),
        Ok(definition) => match definition.resolve() {
            Ok(defined) => return Some(NominalSource::Surface(Box::new(defined))),
            Err(error) => {
                let inner = error.key().unwrap_or_else(|| "surface".into());
                // A term of a list, such as `terms.[0, 1]`, is not a key of the file, so the problem is placed at the
                // list.
                let key = format!("nominal.{}", inner.split(".[").next().unwrap_or(&inner));
                document.report(&key, without_key(&inner, &error.to_string()), "", "");
            }
        },
    }
    None
}

/// Returns the error message `sentence` without the name of the key at its beginning. `key` is this name, without
/// backticks. For example, the message "`radius_mm` must be positive" becomes "must be positive". The caller can then
/// put the full name of the key, such as `nominal.surface.radius_mm`, before the result. If `sentence` does not begin
/// with this key in backticks, returns "is refused: " and the whole sentence.
fn without_key(key: &str, sentence: &str) -> String {
    match sentence.strip_prefix(&format!("`{key}` ")) {
        Some(rest) => rest.to_owned(),
        None => format!("is refused: {sentence}"),
    }
}

/// Tolerance for the comparison of two probabilities that are meant to be equal.
const PROBABILITY_TOLERANCE: f64 = 1e-9;

fn chosen_touches(written: &RecipeFile, document: &mut Document) {
    let risk = written.measure.accepted_risk;
    if written.measure.mode == SelectionMode::Fixed {
        if risk.is_some() {
            let remedy = "remove `accepted_risk`, or write `mode = \"adaptive\"`";
            document.report(
                "measure.accepted_risk",
                "is only for mode adaptive",
                "mode fixed touches all targets",
                remedy,
            );
        }
        return;
    }
    if risk.is_none() && !document.has_problem("measure.accepted_risk") {
        document.report(
            "measure.accepted_risk",
            "is missing",
            "mode adaptive touches only some targets, so the run can accept a part that is out of tolerance",
            "state the probability of a wrong acceptance that you allow, for example `accepted_risk = 0.025`",
        );
    }
    if let (Some(risk), Some(probability)) = (risk, written.acceptance.probability)
        && 1.0 - probability > risk + PROBABILITY_TOLERANCE
    {
        document.report(
            "measure.accepted_risk",
            format!(
                "is {risk}, but `acceptance.probability` = {probability} requires an accepted risk of at least {:.3}",
                1.0 - probability
            ),
            "the accepted risk must be at least 1 minus the required probability",
            &format!(
                "raise `accepted_risk` to {:.3}, or raise `acceptance.probability` to {:.3}",
                1.0 - probability,
                1.0 - risk
            ),
        );
    }
    if written.measure.pattern == PatternKind::Free {
        let remedy = "choose another pattern, or write `mode = \"fixed\"`";
        document.report(
            "measure.mode",
            "is adaptive",
            "mode adaptive chooses the targets from a pattern, but the pattern \"free\" has no targets",
            remedy,
        );
    }
    if !written.acceptance.expanded_uncertainty {
        document.report(
            "acceptance.expanded_uncertainty",
            "is false",
            "mode adaptive touches only some targets, so the judgement must include the uncertainty of the figures (RMS, PV)",
            "write `expanded_uncertainty = true`, or `mode = \"fixed\"`",
        );
    }
    if !written.measure.qualify {
        document.report(
            "measure.qualify",
            "is false",
            "mode adaptive requires the noise of the probe, and `qualify` measures this noise on the reference sphere",
            "write `qualify = true`, or `mode = \"fixed\"`",
        );
    }
}

fn measure(written: &MeasurementSettings, document: &mut Document) {
    if written.safe_height_mm < written.approach_mm {
        document.report(
            "measure.safe_height_mm",
            format!("is {} mm, less than `approach_mm` ({} mm)", written.safe_height_mm, written.approach_mm),
            "the safe height must be at least the approach distance",
            "raise `safe_height_mm`, or lower `approach_mm`",
        );
    }
    if let Some([least, most]) = written.temperature_c
        && least >= most
    {
        let found = format!("is [{least}, {most}]");
        document.report(
            "measure.temperature_c",
            found,
            "the first limit must be less than the second limit",
            "swap them",
        );
    }
}

fn pattern(written: &MeasurementSettings, folder: &Path, document: &mut Document) -> Option<MeasuringPattern> {
    let keys = [
        ("spacing_mm", written.spacing_mm.is_some()),
        ("columns", written.columns.is_some()),
        ("rows", written.rows.is_some()),
        ("points", written.points.is_some()),
        ("file", written.file.is_some()),
        ("file_columns", written.file_columns.is_some()),
        ("file_unit", written.file_unit.is_some()),
        ("file_height_unit", written.file_height_unit.is_some()),
    ];
    let (name, takes, needs) = match written.pattern {
        PatternKind::Grid => ("grid", &["spacing_mm", "columns", "rows"][..], "`spacing_mm`, or `columns` and `rows`"),
        PatternKind::Spiral => ("spiral", &["spacing_mm", "points"][..], "`spacing_mm` or `points`"),
        PatternKind::File => ("file", &["file", "file_columns", "file_unit", "file_height_unit"][..], "`file`"),
        PatternKind::Free => ("free", &["points"][..], "`points`, the minimum number of points"),
    };
    let allowed = format!("the pattern \"{name}\" requires {needs}");
    for (key, _) in keys.iter().filter(|(key, there)| *there && !takes.contains(key)) {
        document.report(
            &format!("measure.{key}"),
            "is not for this pattern",
            &allowed,
            "remove this key, or change `pattern`",
        );
    }
    let found = match (written.pattern, written.spacing_mm, (written.columns, written.rows), written.points) {
        (PatternKind::Grid, Some(spacing), (None, None), _) => {
            Some(MeasuringPattern::Generated(Layout::GridSpacing(spacing)))
        }
        (PatternKind::Grid, None, (Some(columns), Some(rows)), _) => {
            Some(MeasuringPattern::Generated(Layout::GridPoints([columns, rows])))
        }
        (PatternKind::Spiral, Some(spacing), _, None) => {
            Some(MeasuringPattern::Generated(Layout::SpiralSpacing(spacing)))
        }
        (PatternKind::Spiral, None, _, Some(points)) => Some(MeasuringPattern::Generated(Layout::SpiralPoints(points))),
        (PatternKind::File, ..) => written.file.as_ref().map(|file| MeasuringPattern::File {
            path: resolve_path(folder, file),
            table: TableSettings {
                columns: written.file_columns.clone(),
                unit: written.file_unit.clone(),
                height_unit: written.file_height_unit.clone(),
            },
        }),
        (PatternKind::Free, _, _, Some(min_points)) => Some(MeasuringPattern::Free { min_points }),
        _ => None,
    };
    // An invalid key is already reported.
    if found.is_none()
        && document.contains_key("measure")
        && !takes.iter().any(|key| document.has_problem(&format!("measure.{key}")))
    {
        let given: Vec<&str> =
            keys.iter().filter(|(key, there)| *there && takes.contains(key)).map(|(key, _)| *key).collect();
        let found = if given.is_empty() {
            "has no spacing of points, no number of points and no file of points".into()
        } else {
            format!("has {}", given.join(", "))
        };
        document.report("measure", found, &allowed, "give exactly these keys");
    }
    found
}

fn registration(written: &RegistrationSettings, document: &mut Document) {
    if !written.lock.is_empty() && written.start == RegistrationStart::Search {
        document.report(
            "registration.lock",
            "locks directions while `start` is \"search\"",
            "a locked direction keeps the value of the fixture pose, but a search does not start from the fixture pose",
            "write `start = \"fixture\"`, or lock no direction",
        );
    }
    if Coordinate::locked_flags(&written.lock) == [true; 6] {
        document.report("registration.lock", "locks all six directions", "at least one must be free", "remove one");
    }
}

fn acceptance(written: &Acceptance, document: &mut Document) {
    let broken = ["acceptance.pv_um", "acceptance.rms_um", "acceptance"].iter().any(|key| document.has_problem(key));
    match (written.pv_um, written.rms_um) {
        (None, None) if !broken && document.contains_key("acceptance") => {
            let remedy = "add `rms_um = 1.0`, or `pv_um = 7.0`, or both";
            document.report("acceptance", "has no limit", "at least one of `pv_um` and `rms_um` is required", remedy);
        }
        (Some(pv), Some(rms)) if pv < rms => document.report(
            "acceptance.pv_um",
            format!("is {} µm, less than `rms_um` ({} µm)", pv.0, rms.0),
            "PV is never less than RMS",
            "raise `pv_um`, or check whether `pv_um` and `rms_um` are swapped",
        ),
        _ => {}
    }
    if let Some(probability) = written.probability.filter(|_| !written.expanded_uncertainty) {
        document.report(
            "acceptance.probability",
            format!("is {probability}, but `expanded_uncertainty` is false"),
            "the program computes the probability from the uncertainty of the figure",
            "write `expanded_uncertainty = true`, or remove `probability`",
        );
    }
}

fn compensation(written: &Compensation, document: &mut Document) {
    let budget = written.removal_budget_um;
    for (key, um) in [("depth_of_cut_um", written.depth_of_cut_um), ("max_correction_um", written.max_correction_um)] {
        if um > budget {
            document.report(
                &format!("compensation.{key}"),
                format!("is {} µm, more than `removal_budget_um` ({} µm)", um.0, budget.0),
                "no pass can remove more than the removal budget",
                "lower this value, or raise the budget (`removal_budget_um`)",
            );
        }
    }
    let (cutoff, least) = (written.cutoff_mm, 2.0 * written.spacing_mm);
    if cutoff < least {
        document.report(
            "compensation.cutoff_mm",
            format!("is {cutoff} mm, less than twice the spacing of the map ({least} mm)"),
            "the cut-off wavelength must be at least twice the spacing of the map",
            "raise `cutoff_mm`, or lower `compensation.spacing_mm`",
        );
    }
    if let (Some(gain), Some(by)) = (written.gain, written.gain_by) {
        document.report(
            "compensation.gain",
            format!("is {gain}, but `gain_by` is {by:?}"),
            "`gain` fixes the share of the error that a correction removes, but `gain_by` is a rule that chooses this share",
            "remove `gain` or `gain_by`",
        );
    }
}

/// Checks the values that the estimation of machine parameters requires, such as a wheel above the part and locked
/// directions of the registration. Reports each error to `document`. Does nothing if the recipe has no table
/// `[compensation.parameters]`.
fn parameters(written: &RecipeFile, document: &mut Document) {
    const KEY: &str = "compensation.parameters";
    let Some(parameters) = written.compensation.parameters else { return };
    let tolerances = parameters.tolerances();
    if tolerances.iter().all(Option::is_none) && !document.has_problem(KEY) {
        let remedy = "add, for example, `wheel_radius_um = 100.0` (the uncertainty of the radius of the wheel), or remove the table";
        document.report(KEY, "has no parameter", "at least one parameter to compensate is required", remedy);
    }
    if written.cycle.begin_with == FirstStep::Measure {
        document.report(
            KEY,
            "is set in a recipe that begins with a measurement",
            "the program estimates the parameters from the first measurement, so the run must grind before this measurement",
            "write `begin_with = \"grind\"`, or remove the table",
        );
    }
    if written.measure.side == ProbeSide::Below {
        document.report(
            KEY,
            "is set in a recipe in which the wheel grinds the part from below",
            "the estimate of the parameters requires a wheel that comes from above (from +z)",
            "remove the table; the map then corrects the errors of these parameters",
        );
    }
    if written.grinding.tilt.is_some() {
        document.report(
            KEY,
            "is set together with grinding.tilt",
            "the estimate of the parameters requires a wheel without tilt",
            "remove grinding.tilt, or remove this table; without this table, the map corrects the errors of these parameters",
        );
    }
    if parameters.wheel_radius_um.is_some() && !matches!(written.grinding.wheel, WheelDimensions::Sphere { .. }) {
        document.report(
            "compensation.parameters.wheel_radius_um",
            "requires a spherical wheel",
            "the program knows the effect of a radius error only for a spherical wheel",
            "remove `wheel_radius_um`; the map then corrects the radius error",
        );
    }
    let registration = &written.registration;
    let held = Coordinate::locked_flags(&registration.lock);
    let names = [
        ("wheel_x_um", "x"),
        ("wheel_y_um", "y"),
        ("wheel_z_um", "z"),
        ("part_tilt_x_urad", "rx"),
        ("part_tilt_y_urad", "ry"),
    ];
    for (k, (key, coordinate)) in names.into_iter().enumerate().filter(|(k, _)| tolerances[k + 1].is_some()) {
        if !held[k] {
            document.report(
                &format!("{KEY}.{key}"),
                format!("is set, but `registration.lock` does not lock {coordinate}"),
                "in a direction that is not locked, the program cannot separate this error from a displacement of the part",
                &format!("remove this key, or lock \"{coordinate}\" if the fixture fixes the part in this direction"),
            );
        } else if registration.lock_uncertainty_um.is_none() {
            document.report(
                &format!("{KEY}.{key}"),
                "requires `registration.lock_uncertainty_um`",
                "the estimate cannot be more accurate than the fixture; `lock_uncertainty_um` is the uncertainty of the fixture",
                "add `lock_uncertainty_um = 0.5` to [registration]",
            );
        }
    }
}

/// Minimum angle between the surface normal and the axis of a spherical wheel that follows the surface. Nearer to its
/// pole, the wheel has almost no cutting speed.
const MIN_LEAD_DEG: f64 = 2.01;

fn grinding(written: &Grinding, document: &mut Document) {
    let wheel = written.wheel;
    if let WheelDimensions::Torus { radius_mm, minor_radius_mm, .. }
    | WheelDimensions::Cup { radius_mm, minor_radius_mm, .. } = wheel
        && minor_radius_mm > radius_mm
    {
        document.report(
            "grinding.wheel.minor_radius_mm",
            format!("is {minor_radius_mm} mm, more than `radius_mm` ({radius_mm} mm)"),
            "the curve radius of the rim must be at most the radius of the wheel",
            "check whether `minor_radius_mm` and `radius_mm` are swapped",
        );
    }
    if written.one_way && written.pattern == TrackPattern::Spiral {
        document.report(
            "grinding.one_way",
            "is set for a spiral",
            "`one_way` is only for a raster: all tracks of the raster then have the same direction",
            "remove `one_way`",
        );
    }
    if let Some(tilt) = written.tilt
        && tilt.lean == TiltKind::Following
        && tilt.angle_deg.abs() < MIN_LEAD_DEG
        && matches!(wheel, WheelDimensions::Sphere { .. })
    {
        document.report(
            "grinding.tilt.angle_deg",
            format!("is {}° for a spherical wheel that follows the surface", tilt.angle_deg),
            "the wheel would touch the part with the pole of the wheel, and the pole has no cutting speed",
            "tilt the wheel by more than 2° to either side; 15° to 45° is usual",
        );
    }
    if let Some(track_mm) = written.track_mm.filter(|track_mm| *track_mm > wheel.radius_mm()) {
        document.report(
            "grinding.track_mm",
            format!("is {track_mm} mm, more than the radius of the wheel ({} mm)", wheel.radius_mm()),
            "tracks must overlap",
            "lower `track_mm`",
        );
    }
}

/// Checks values of the recipe against values in other tables of the recipe, such as the allowance against the number
/// of cycles. Reports each error to `document`.
fn check_tables(written: &RecipeFile, document: &mut Document) {
    if let (Some(most), Some(rms)) = (written.registration.max_rms_um, written.acceptance.rms_um)
        && most < rms
    {
        document.report(
            "registration.max_rms_um",
            format!("is {} µm, less than `acceptance.rms_um` ({} µm)", most.0, rms.0),
            "the registration would reject a part that is in tolerance",
            "raise `max_rms_um` well above the RMS of the first cycle, or remove `max_rms_um`",
        );
    }
    if written.compensation.learn && written.cycle.begin_with == FirstStep::Measure {
        document.report(
            "compensation.learn",
            "is true, but `cycle.begin_with` is \"measure\"".to_owned(),
            "`learn` changes only a pass before the first measurement, but this recipe has no such pass",
            "remove `learn`, or write `begin_with = \"grind\"`",
        );
    }
    let (Micrometres(allowance), Micrometres(depth)) =
        (written.grinding.allowance_um, written.compensation.depth_of_cut_um);
    let cycles = written.cycle.max_cycles;
    if allowance > depth * f64::from(cycles.saturating_sub(1)) {
        document.report(
            "grinding.allowance_um",
            format!("is {allowance} µm, too much for {cycles} cycles with a depth of cut of {depth} µm"),
            "the first pass leaves the allowance on the part; the other passes must remove the allowance, and each pass removes at most one depth of cut",
            "lower `allowance_um`, or raise `cycle.max_cycles` or `compensation.depth_of_cut_um`",
        );
    }
}

/// Checks lengths in the recipe against the part, and reports each error to `document`. `nominal` is the source of the
/// nominal surface. If the recipe defines an outline of the part, checks against the size of this outline. If the
/// recipe defines the surface by a formula, also checks against the curvature of the surface. Does nothing if `nominal`
/// is `None`.
fn check_against_part(written: &RecipeFile, nominal: Option<&NominalSource>, document: &mut Document) {
    let (surface, aperture) = match nominal {
        Some(NominalSource::Surface(surface)) => (Some(surface.as_ref()), Some(surface.aperture())),
        Some(NominalSource::File { selection, .. }) => (None, selection.aperture.as_ref()),
        None => return,
    };
    if let Some(aperture) = aperture {
        let [[x0, y0], [x1, y1]] = aperture.bounds();
        check_against_size(written, [x1 - x0, y1 - y0], document);
    }
    if let Some(surface) = surface {
        check_against_curvature(written, surface, document);
    }
}

fn check_against_size(written: &RecipeFile, size_mm: [f64; 2], document: &mut Document) {
    let measure = &written.measure;
    let smaller_mm = size_mm[0].min(size_mm[1]);
    let left_mm = size_mm.map(|size| size - 2.0 * measure.edge_margin_mm);
    if left_mm[0].min(left_mm[1]) <= 0.0 {
        document.report(
            "measure.edge_margin_mm",
            format!("is {} mm on a part of {:.4} x {:.4} mm", measure.edge_margin_mm, size_mm[0], size_mm[1]),
            "no area would remain to measure",
            "lower `edge_margin_mm`",
        );
    } else if let Some(spacing) = measure.spacing_mm {
        check_spacing(spacing, left_mm, document);
    }
    let lengths = [
        ("measure.probe_radius_mm", measure.probe_radius_mm, 0.5),
        ("compensation.spacing_mm", written.compensation.spacing_mm, 1.0),
        ("compensation.cutoff_mm", written.compensation.cutoff_mm, 2.0),
        ("grinding.track_mm", written.grinding.track_mm.unwrap_or(0.0), 1.0),
    ];
    for (key, length_mm, share) in lengths {
        let limit_mm = share * smaller_mm;
        if length_mm > limit_mm {
            let found = format!("is {length_mm} mm on a part of {:.4} x {:.4} mm", size_mm[0], size_mm[1]);
            document.report(
                key,
                found,
                &format!("on this part, the limit of this key is {limit_mm:.4} mm"),
                "lower the value",
            );
        }
    }
    let cutoff_mm = written.compensation.cutoff_mm;
    if let (PatternKind::Grid, Some(columns), Some(rows)) = (measure.pattern, measure.columns, measure.rows) {
        let apart = |size: f64, n: u32| size / f64::from(n.max(2) - 1);
        check_cutoff(cutoff_mm, apart(left_mm[0], columns).max(apart(left_mm[1], rows)), document);
    } else if let Some(spacing) = measure.spacing_mm.filter(|spacing| *spacing <= left_mm[0].min(left_mm[1])) {
        check_cutoff(cutoff_mm, spacing, document);
    }
}

fn check_spacing(spacing_mm: f64, left_mm: [f64; 2], document: &mut Document) {
    let points = (left_mm[0] / spacing_mm + 1.0) * (left_mm[1] / spacing_mm + 1.0);
    let found = format!("is {spacing_mm} mm on a measured area of {:.4} x {:.4} mm", left_mm[0], left_mm[1]);
    if points > MAX_POINTS {
        let allowed = format!("this gives {points:.1e} points, limit {MAX_POINTS:.0e}");
        document.report("measure.spacing_mm", found, &allowed, "choose a coarser spacing");
    } else if spacing_mm > left_mm[0].min(left_mm[1]) {
        let allowed = "the spacing must be at most the smaller side of this area";
        document.report("measure.spacing_mm", found, allowed, "choose a finer spacing");
    }
}

fn check_cutoff(cutoff_mm: f64, apart_mm: f64, document: &mut Document) {
    if cutoff_mm < 2.0 * apart_mm {
        document.report(
            "compensation.cutoff_mm",
            format!("is {cutoff_mm} mm, but the distance between measured points is {apart_mm:.4} mm"),
            &format!("the cut-off wavelength must be at least twice this distance, {:.4} mm", 2.0 * apart_mm),
            "raise `cutoff_mm`, or measure more points",
        );
    }
}

/// Checks that the ball of the probe and a spherical wheel fit into the concave regions of `surface`, on the side that
/// is measured. If the recipe does not state this side, uses the side with the larger minimum concave radius. Reports
/// each error to `document`.
fn check_against_curvature(written: &RecipeFile, surface: &DefinedSurface, document: &mut Document) {
    let hollows = curvature::min_concave_radii_mm(surface);
    let (radius_mm, place) = match written.measure.side {
        ProbeSide::Above => hollows[0],
        ProbeSide::Below => hollows[1],
        // The side is unknown before points are measured. The flatter side gives the weakest requirement.
        ProbeSide::Auto => {
            if hollows[0].0 > hollows[1].0 {
                hollows[0]
            } else {
                hollows[1]
            }
        }
    };
    let ball_mm = if let WheelDimensions::Sphere { radius_mm } = written.grinding.wheel { radius_mm } else { 0.0 };
    for (key, ball_mm) in
        [("measure.probe_radius_mm", written.measure.probe_radius_mm), ("grinding.wheel.radius_mm", ball_mm)]
    {
        if ball_mm >= radius_mm {
            document.report(
                key,
                format!(
                    "is {ball_mm} mm, but the surface has a concave radius of {radius_mm:.4} mm at x, y = ({:.3}, {:.3}) mm",
                    place[0], place[1]
                ),
                "the radius of the probe or wheel must be less than the concave radius of the surface",
                "choose a smaller radius, or check the formula of the surface",
            );
        }
    }
}
