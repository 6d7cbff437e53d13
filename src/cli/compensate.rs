//! `regrind compensate`: corrects an existing program by a map of the part's error.

use std::path::{Path, PathBuf};

use clap::Args;
use regrind::compensation::Correction;
use regrind::compensation::path::{TargetSurface, correction_spline, nominal_height_field};
use regrind::config::read_named_dialect;
use regrind::formats::gcode::{
    AlongNormals, Amended, Amendment, GcodeError, LINUXCNC, MapKind, correct_program, read_program_map,
};
use regrind::formats::is_same_file;
use regrind::geometry::Grid;
use regrind::surface::PlaneProjection;
use serde::Serialize;

use super::check::or_show;
use super::failure::Failure;
use super::nominal::{self, NominalTable};
use super::words::three_digits;
use super::{Outcome, finite_above_zero};

/// Correct an existing program by a map of the part's error
#[derive(Args, Debug)]
#[command(after_long_help = LONG_HELP, after_help = "Example:\n  regrind compensate --program part.ngc --map error_map.csv --out part-2.ngc\n\n--help \
shows more than -h.")]
pub(super) struct Arguments {
    /// Program to correct
    #[arg(long, value_name = "FILE")]
    program: PathBuf,
    /// Dialect of the program: linuxcnc, fanuc, sinumerik, heidenhain, or the file of another dialect
    #[arg(long, value_name = "NAME", default_value = LINUXCNC)]
    dialect: String,
    /// error_map.csv, whose error is subtracted, or correction.csv, which is added to a program without a correction
    #[arg(long, value_name = "FILE")]
    map: PathBuf,
    /// Share of the map to apply
    #[arg(long, value_name = "SHARE", default_value_t = 1.0, value_parser = finite_above_zero)]
    gain: f64,
    /// File for the corrected program
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Apply the map along the normals of this nominal surface instead of along z
    #[arg(long, value_name = "FILE")]
    nominal: Option<PathBuf>,
    #[command(flatten)]
    table: NominalTable,
    /// With --nominal: the program moves the lowest point of a ball of this radius, in mm, not its centre
    #[arg(long, value_name = "MM", requires = "nominal", value_parser = finite_above_zero)]
    tip_of_radius: Option<f64>,
    /// Maximum distance of the new program from the corrected path, in µm
    #[arg(long, value_name = "UM", default_value_t = 0.1, value_parser = finite_above_zero)]
    tolerance_um: f64,
    /// Maximum correction, in µm; a map with a larger one is refused, for example a map in another unit
    #[arg(long, alias = "largest-correction-um", value_name = "UM", default_value_t = 500.0, value_parser = finite_above_zero)]
    max_correction_um: f64,
    /// Print JSON instead of a summary
    #[arg(long)]
    json: bool,
}

const LONG_HELP: &str = "\
Example:
  regrind compensate --program part.ngc --map error_map.csv --out part-2.ngc
  regrind compensate --program O7001.nc --dialect fanuc --map error_map.csv --out O7002.nc

x and y of the map are in the work coordinates of the program (G54): the model frame. Without --nominal, the command
applies the map along z. On a slope, where the unit normal has the z component nz, a correction e is then too small by
e (1 - nz). With --nominal, the wheel must be a ball of any radius. The program then moves the centre of the ball or, with
--tip-of-radius, the lowest point of the ball.

Straight moves at feed are divided if the correction changes along the move. An arc stays an arc if the correction is
constant along the arc; otherwise the arc becomes chords. Rapid moves (G0), moves in machine coordinates (G53) and moves
to the reference point (G28, G30) stay unchanged. After G28, G30 or G53, the command does not know the positions of the
moved axes. After a change of the tool length (G43, G49), the command does not know the position of z. After M6 or a new
zero, the command knows no position. The command refuses a move at feed if the position of an axis is unknown.
The command also refuses the following, and names the line: a word without a meaning in its line, variables, O-words,
canned cycles, cutter compensation, G92 and other moved zeros, inverse-time feed, rotary axes that leave 0, and a change
of the work coordinates within the program. The new program keeps the comments, but not the line numbers.

Between its nodes, a map is a cubic spline. Next to a step of the map, the spline overshoots by a tenth of the step. In a
map of Regrind, nodes with 0 in a column `valid` keep their value. In another map, these nodes get the nearest valid
value.

The command refuses a program without a move at feed, a program with hardly any move at feed over the map, and a
correction of more than --max-correction-um. The command reports the length of the path outside the map. There, the
correction changes within five nodes to the constant value of the nearest node of the map. Before the command saves the
new program, an independent reader reads the new lines, and the command compares these with the old program and the map.

The new program contains the hashes of the old program and of the map. The command refuses:
- a program that is already corrected by this map;
- a map of another part;
- an error map that was measured after a pass with a correction other than the one in the program;
- a correction.csv for a program that already has a correction: this file has the total correction.
The command does not lower the whole program. At points where the map raises the tool, the tool may not reach the part.
To prevent this, set the zero of the tool lower.

Exit codes: 0 written; 2 bad arguments or data; 3 fault.";

/// Output as JSON.
#[derive(Serialize)]
struct Document<'a> {
    simulation: bool,
    out: &'a std::path::Path,
    #[serde(flatten)]
    amended: Amended,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let others = [Some(&arguments.map), arguments.nominal.as_ref()];
    if let Some(path) = others.into_iter().flatten().find(|path| is_same_file(path, &arguments.out)) {
        let what = "the corrected program would overwrite this file".to_owned();
        let path = path.clone();
        return Err(Failure::Program(GcodeError::Program { path, what, remedy: "give another name to --out" }));
    }
    let map = read_program_map(&arguments.map).map_err(Failure::Program)?;
    // An error is subtracted. A correction is already the displacement of the surface.
    let sign = if map.kind == MapKind::Error { -arguments.gain } else { arguments.gain };
    let values_mm = map.nodes.values_mm.iter().map(|v| sign * v).collect();
    let tip_mm = arguments.tip_of_radius.unwrap_or(0.0);
    let level_off_mm = LEVEL_OFF_NODES * map.nodes.grid.spacing_mm[0].max(map.nodes.grid.spacing_mm[1]);
    let shift = correction_spline(
        &Correction { grid: map.nodes.grid, values_mm, cycle: 1, level_mm: 0.0, parameters: None },
        level_off_mm,
    );
    let ground = arguments.nominal.as_ref().map(|file| ground(file, &arguments.table)).transpose()?;
    let dialect = or_show(read_named_dialect(&arguments.dialect, Path::new("")))?.dialect;
    let amendment = Amendment {
        dialect: Some(&dialect),
        shift: &shift,
        along_normals: ground.as_ref().map(|nominal| AlongNormals { nominal, centre_above_mm: tip_mm }),
        tolerance_mm: 1e-3 * arguments.tolerance_um,
        map: &map,
        gain: arguments.gain,
        max_shift_mm: 1e-3 * arguments.max_correction_um,
    };
    let amended = correct_program(&arguments.program, &arguments.out, &amendment).map_err(Failure::Program)?;
    if arguments.json {
        super::print_json(&Document { simulation: map.simulation, out: &arguments.out, amended })?;
    } else {
        let marked = if map.simulation { "SIMULATION  " } else { "" };
        super::print(&format!("{marked}{}: {}", arguments.out.display(), summary(&amended)))?;
    }
    Ok(Outcome::Accepted)
}

/// Returns a text for people about the corrected program `amended`, with up to three lines:
///
/// - The numbers of moves and arcs, and the largest displacement of a point, in µm.
/// - The length of the path that is outside the correction map, in mm. This line is omitted if the length is 0.
/// - A note that the program states no unit and that millimetres are assumed. This line is omitted if the program
///   states its unit.
fn summary(amended: &Amended) -> String {
    let mut text = format!(
        "{} straight moves and {} arcs became {} moves, including {} arcs; each point moved by at most {} µm\n",
        amended.straight,
        amended.arcs,
        amended.written,
        amended.arcs_unchanged,
        three_digits(1e3 * amended.max_shift_mm)
    );
    if amended.outside_map_mm > 0.0 {
        text += &format!(
            "outside the map: {} mm of {} mm at feed; there, the correction becomes the constant value at the border of the map\n",
            three_digits(amended.outside_map_mm),
            three_digits(amended.feed_mm)
        );
    }
    if amended.unit_assumed {
        text +=
            "unit: there is no G20 or G21 before the first coordinate; millimetres are assumed, and G21 was added\n";
    }
    text
}

/// Distance outside the grid, in nodes, within which the values of a map level off.
const LEVEL_OFF_NODES: f64 = 5.0;

/// Reads the nominal surface in `file` and returns it as a target surface without a correction. `table` is the format
/// of the file if the file is a table of points, and the face of a CAD model.
///
/// Returns an error if the file cannot be read, or if the surface cannot be written as a height z = f(x, y).
fn ground(file: &std::path::Path, table: &NominalTable) -> Result<TargetSurface, Failure> {
    let (surface, _) = nominal::surface(file, PlaneProjection::Auto, table)?;
    let failed = |source| Failure::Path { path: file.to_owned(), source };
    let (field, _) = nominal_height_field(&surface).map_err(failed)?;
    let grid = Grid { columns: 1, rows: 1, first_mm: [0.0; 2], spacing_mm: [1.0; 2] };
    TargetSurface::new(field, &Correction::zero(grid, 0.0), 1.0).map_err(failed)
}
