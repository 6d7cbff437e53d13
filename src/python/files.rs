//! Files in and out.

use std::path::{Path, PathBuf};

use pyo3::prelude::*;
use regrind_core::compensation::path::{PathMode, TrackPattern};
use regrind_formats::gcode::{Dialect, DialectError, Exactness, ProgramHeader, write_program};
use regrind_formats::{
    CorrectionIdentities, DeviationRow, ErrorMapOrigin, Table, read_measured_with_notes, write_correction,
    write_deviations, write_error_map, write_error_map_x3p, write_points,
};

use super::arrays::{Output2, Whole, points, vectors};
use super::errors::{DataError, data};
use super::figures::PyErrorMap;
use super::nominal::PyNominal;
use super::path::{PyCorrection, PyToolPath, identity};
use super::registration::{PyRegistration, above_zero, choice};

/// Dialects of programs, with their definitions.
const DIALECTS: [(&str, &str); 4] = [
    ("linuxcnc", include_str!("dialects/linuxcnc.toml")),
    ("fanuc", include_str!("dialects/fanuc.toml")),
    ("sinumerik", include_str!("dialects/sinumerik.toml")),
    ("heidenhain", include_str!("dialects/heidenhain.toml")),
];

/// Measured points of a file: text, PLY, or the map of an interferometer or a profilometer. The array is (N, 3), in mm.
///
/// Raises DataError with the path, the place and the reason.
#[pyfunction]
pub(crate) fn read(py: Python<'_>, path: PathBuf) -> PyResult<Output2<'_>> {
    let read = py.detach(|| read_measured_with_notes(&path, &Table::default())).map_err(data)?;
    Ok(vectors(py, read.points.iter().map(|point| point.coords).collect::<Vec<_>>().into_iter()))
}

/// Writes points, deviations, a map, a correction or a program, completely or not at all.
///
/// `what` decides the content: an array (N, 3) in mm gives the columns x_mm, y_mm, z_mm; a Registration gives the file
/// deviations.csv of the command line; an ErrorMap gives error_map.csv, or X3P if `path` ends with .x3p; a Correction
/// gives correction.csv; a ToolPath gives a program in the `dialect` "linuxcnc", "fanuc", "sinumerik" or "heidenhain".
/// Maps and corrections as text state the part that they belong to, so they need `nominal`. `cycle` is the number of the
/// pass that a map was measured after. `controller_tolerance` is by how much the control rounds corners, in mm: a dialect
/// that cannot state it in the program needs it.
///
/// Raises DataError with the path and the reason; a file of that name is then unchanged.
#[pyfunction]
#[pyo3(signature = (path, what: "ArrayLike | Registration | ErrorMap | Correction | ToolPath", *, nominal = None,
    cycle = 1, dialect: "Literal['linuxcnc', 'fanuc', 'sinumerik', 'heidenhain']" = "linuxcnc",
    controller_tolerance = None))]
pub(crate) fn write(
    py: Python,
    path: PathBuf,
    what: &Bound<PyAny>,
    nominal: Option<&PyNominal>,
    cycle: i64,
    dialect: &str,
    controller_tolerance: Option<f64>,
) -> PyResult<()> {
    let cycle = Whole(cycle).within("cycle", 0, 65_535)?;
    let part = || {
        nominal.map(PyNominal::identity).ok_or_else(|| {
            DataError::new_err(format!("{}: nominal is missing; the file states its part", path.display()))
        })
    };
    if let Ok(registration) = what.cast::<PyRegistration>() {
        let found = &registration.get().found;
        return py
            .detach(|| write_deviations(&path, &found.deviations.iter().map(DeviationRow::from).collect::<Vec<_>>()))
            .map_err(data);
    }
    if let Ok(map) = what.cast::<PyErrorMap>() {
        let map = &map.get().map;
        if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("x3p")) {
            let datetime = py.import("datetime")?;
            let utc = datetime.getattr("timezone")?.getattr("utc")?;
            let now = datetime.getattr("datetime")?.call_method1("now", (utc,))?;
            let date: String = now.call_method1("strftime", ("%Y-%m-%dT%H:%M:%SZ",))?.extract()?;
            return py.detach(|| write_error_map_x3p(&path, map, &date, false)).map_err(data);
        }
        let origin = ErrorMapOrigin { part: part()?, cycle: cycle as u32, ground_with: None };
        return py.detach(|| write_error_map(&path, map, &origin, false)).map_err(data);
    }
    if let Ok(correction) = what.cast::<PyCorrection>() {
        let given = correction.get();
        let map = identity(given.correction());
        let identities = CorrectionIdentities { part: part()?, map, replaces: given.replaces };
        return py.detach(|| write_correction(&path, given.correction(), (&identities, &[]), false)).map_err(data);
    }
    if let Ok(program) = what.cast::<PyToolPath>() {
        let program = program.get();
        return py.detach(|| save_program(&path, program, dialect, controller_tolerance));
    }
    let points = points(what, "what")?;
    if points.is_empty() {
        return Err(DataError::new_err(format!("{}: what has no point", path.display())));
    }
    py.detach(|| write_points(&path, "x_mm,y_mm,z_mm", &points)).map_err(data)
}

fn save_program(path: &Path, program: &PyToolPath, dialect: &str, controller_tolerance: Option<f64>) -> PyResult<()> {
    let text = choice("dialect", dialect, &DIALECTS)?;
    let dialect: Dialect = toml::from_str(text).map_err(data)?;
    let options = program.path.options();
    let pattern = match options.pattern {
        TrackPattern::Raster => "raster along x",
        TrackPattern::Spiral => "spiral inwards",
    };
    let header = ProgramHeader {
        part: path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned()),
        cycle: program.correction.cycle,
        base_identity: program.part_identity,
        map_identity: identity(&program.correction),
        uncorrected: program.correction.is_zero(),
        level_mm: program.correction.level_mm,
        from_below: options.from_below,
        rotary: None,
        lean: String::new(),
        wheel: if options.from_below { options.wheel.mirrored() } else { options.wheel }.description(),
        parameters: Vec::new(),
        tracks: format!(
            "{} track pieces, {:.6} mm apart, {pattern}",
            program.path.track_count(),
            program.path.track_mm()
        ),
        spark_out_passes: 0,
        simulation: false,
        exactness: Exactness {
            mode: PathMode::Blend,
            tolerance_mm: options.chord_error_mm,
            controller_mm: controller_tolerance.map(|mm| above_zero("controller_tolerance", mm)).transpose()?,
            chord_error_mm: options.chord_error_mm,
            arcs_within_mm: None,
        },
    };
    if let Err(DialectError::ToleranceUnknown { dialect }) = dialect.post(&header.exactness) {
        return Err(DataError::new_err(format!(
            "the dialect {dialect} cannot state how far the control rounds corners; give controller_tolerance, in mm"
        )));
    }
    write_program(path, &header, &dialect, &program.summary, &program.path).map_err(data)
}
