//! `regrind stitch`: registers several maps or clouds of one part together.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::formats::{
    NominalInput, NotedPoints, RegistrationDocument, ResultFolder, STITCHED_POINTS, StitchingDocument,
    read_measured_with_notes, save_stitching,
};
use regrind::geometry::Pose;
use regrind::stitching::{MeasuredMap, Seam, Stitching, StitchingError, StitchingOptions, stitch};

use super::failure::Failure;
use super::fit_arguments::{FitArguments, MeasuredTable};
use super::initial::read_pose;
use super::nominal::{self, NominalTable, kind_in_words};
use super::words::{count, counted, three_digits};
use super::{Outcome, finite_above_zero};

/// Register several maps or clouds of one part together, so that they agree where they overlap
#[derive(Args, Debug)]
#[command(after_long_help = LONG_HELP, after_help = "Example:\n  regrind stitch --nominal mirror.toml --measured a.datx \
--measured b.datx --place a.txt --place b.txt --method contact --out stitched\n\n--help shows more than -h.")]
pub(super) struct Arguments {
    /// Nominal surface: points as text or PLY, a mesh as STL or PLY, a CAD model as STEP or IGES, or a TOML definition
    #[arg(long, value_name = "FILE")]
    nominal: PathBuf,
    /// Measured map or points, once for each; at least two
    #[arg(long, value_name = "FILE", required = true)]
    measured: Vec<PathBuf>,
    /// Approximate pose of a map in the common frame, once for each map in their order; without it all maps have one frame
    #[arg(long, value_name = "FILE")]
    place: Vec<PathBuf>,
    /// Standard uncertainty of these poses in mm, at the border of the part
    #[arg(long, value_name = "MM", default_value_t = 1.0, value_parser = finite_above_zero)]
    place_sigma: f64,
    #[command(flatten)]
    table: MeasuredTable,
    #[command(flatten)]
    of_nominal: NominalTable,
    /// Folder for the results; created if absent
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    fit: FitArguments,
    /// Print stitching.json instead of a summary
    #[arg(long)]
    json: bool,
}

const LONG_HELP: &str = "\
Example:
  regrind stitch --nominal mirror.toml --measured a.datx --measured b.datx --place a.txt --place b.txt --method contact
    --out stitched

The maps must overlap. --place gives the 16 numbers of a 4 x 4 matrix for each map, as the stage or the frame of the
station says. The poses are then estimated from the overlaps; the form of the part is in both maps of an overlap, so it
does not change them. An error that all maps have, such as that of the reference of an interferometer, is in no overlap:
calibrate it before. --initial, --lock and the other options of the fit are those of the whole.

Writes into the folder:
  stitching.json              the pose of each map, their covariance, and the seams: mean step, 95 % interval of the
                              true step, and rms of the differences, in mm
  stitched.csv                all points in the common frame, with the number of their map
  registration.json           the registration of the whole
  deviations.csv              a row per point of stitched.csv, as `regrind register` writes it
  deviation_uncertainty.csv   standard uncertainty of each deviation, with that of the pose of its map

Exit codes: 0 stitched; 2 bad arguments or data; 3 fault.";

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let registration = arguments.fit.options()?;
    let places = places(arguments)?;
    let folder = ResultFolder::prepare(&arguments.out)?;
    let (nominal, choice) = nominal::surface(&arguments.nominal, arguments.fit.projection, &arguments.of_nominal)?;
    let table = arguments.table.table();
    let read = |path: &PathBuf| -> Result<NotedPoints, Failure> {
        arguments.fit.check_is_fit_for(path)?;
        Ok(read_measured_with_notes(path, &table)?)
    };
    let measured = arguments.measured.iter().map(read).collect::<Result<Vec<NotedPoints>, Failure>>()?;
    let maps: Vec<MeasuredMap> = measured
        .iter()
        .zip(places)
        .map(|(map, common_from_map)| MeasuredMap { points: &map.points, common_from_map })
        .collect();
    let options = StitchingOptions { registration, placement_sigma_mm: arguments.place_sigma };
    let mut stitching = stitch(&nominal, &maps, &options).map_err(|source| failure(arguments, source))?;
    let notes = measured.iter().flat_map(|map| map.notes.iter().map(ToString::to_string));
    stitching.whole.quality.warnings.extend(notes);
    let files: Vec<(PathBuf, usize)> =
        arguments.measured.iter().cloned().zip(maps.iter().map(|map| map.points.len())).collect();
    let kind = kind_in_words(nominal.kind(), choice);
    let input = NominalInput { file: &arguments.nominal, points: nominal.len(), kind };
    let document = StitchingDocument::new(&stitching, &files);
    let whole = RegistrationDocument::new(&stitching.whole, &registration, input, Path::new(STITCHED_POINTS));
    document.check().and(whole.check()).map_err(|what| Failure::NotFinite { what })?;
    save_stitching(folder.path(), &stitching, &document, &whole).map_err(Failure::NotSaved)?;
    if arguments.json {
        super::print_json(&document)?;
    } else {
        super::print(&summary(arguments, &stitching))?;
    }
    folder.keep();
    Ok(Outcome::Accepted)
}

/// Returns the approximate pose of each map.
fn places(arguments: &Arguments) -> Result<Vec<Pose>, Failure> {
    let (maps, places) = (arguments.measured.len(), arguments.place.len());
    match places {
        0 => Ok(vec![Pose::identity(); maps]),
        _ if places == maps => arguments.place.iter().map(|path| read_pose(path)).collect(),
        _ => Err(Failure::Places { maps, places }),
    }
}

fn failure(arguments: &Arguments, error: StitchingError) -> Failure {
    let file = |map: usize| arguments.measured[map].clone();
    match error {
        StitchingError::TooFewPoints { map, .. }
        | StitchingError::NoOverlap { map, .. }
        | StitchingError::OffPart { map, .. } => Failure::Stitching { path: file(map), source: error },
        error => Failure::Stitching { path: arguments.nominal.clone(), source: error },
    }
}

/// Maximum number of seams that are listed; stitching.json has all.
const MAX_SEAMS: usize = 30;

/// Returns the result as lines of text: deviation of the whole, noise, and the seams.
fn summary(arguments: &Arguments, stitching: &Stitching) -> String {
    let um = |mm: f64| three_digits(1e3 * mm);
    let nm = |mm: f64| three_digits(1e6 * mm);
    let quality = &stitching.whole.quality;
    let mut text = String::new();
    let mut line = |name: &str, words: String| {
        writeln!(text, "{name:<12}{words}").expect("text grows");
    };
    let points = counted(stitching.common_points.len(), "point");
    line(
        "maps",
        format!("{}, {points}, {}", count(stitching.common_from_map.len()), counted(stitching.rounds, "round")),
    );
    line("deviation", format!("RMS {} µm, PV {} µm", um(quality.rms_mm), um(quality.pv_mm)));
    let noises: Vec<String> = stitching.noise_sigmas_mm.iter().map(|sigma_mm| nm(*sigma_mm)).collect();
    line("noise", format!("{} nm for one point of the maps", noises.join(", ")));
    line("seams", "maps, places; mean step; true step in the middle (95 %); RMS of the differences".to_owned());
    for seam in stitching.seams.iter().take(MAX_SEAMS) {
        let Seam { maps: [first, second], places, step_mm, sigma_mm, rms_mm, .. } = seam;
        let (step, half, rms) = (nm(*step_mm), nm(1.96 * sigma_mm), nm(*rms_mm));
        let maps = format!("{} and {}, {}", first + 1, second + 1, count(*places));
        line("", format!("{maps:<18} {step:>9} nm   0 ± {half} nm   {rms} nm"));
    }
    if stitching.seams.len() > MAX_SEAMS {
        line("", format!("and {} more in stitching.json", stitching.seams.len() - MAX_SEAMS));
    }
    for warning in &quality.warnings {
        line("warning", warning.clone());
    }
    line("files", format!("stitching.json, stitched.csv and those of a registration in {}", arguments.out.display()));
    text
}
