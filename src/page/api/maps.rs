//! Maps of the cycles: their files, and their values as JSON.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::response::Response;
use regrind_formats::parse_error_map;
use regrind_formats::result::read_bytes;
use regrind_formats::run_files::CycleFile;
use regrind_report::{CycleSummary, RunSummary};

use super::content::{FileLink, MapGrid, MapLinks, RunMaps, finite};
use super::endpoint::{Call, acceptable, blocking, json, to_json, unless_known};
use crate::pieces::in_path;
use crate::problem::{Problem, ProblemKind};
use crate::shape::{RegularGrid, SAVED, regular_grid, saved_path};

/// Maximum number of nodes of a map as JSON.
const MAX_NODES: usize = 1 << 20;

/// Media types of the files, in the order of [`SAVED`].
const MEDIA: [&str; 5] = ["text/csv", "image/png", "image/svg+xml", "application/octet-stream", "text/csv"];
/// Media types of all files, each once.
pub(super) const FILE_MEDIA: [&str; 4] = ["text/csv", "image/png", "image/svg+xml", "application/octet-stream"];
/// Names of the files, in the order of [`SAVED`].
pub(super) const FILE_NAMES: [&str; 5] =
    [SAVED[0].name(), SAVED[1].name(), SAVED[2].name(), SAVED[3].name(), SAVED[4].name()];

/// Answers with the maps of a run and the addresses of their files.
pub(super) async fn maps(call: Call) -> Result<Response, Problem> {
    let (folder, summary) = call.summary().await?;
    let run = call.run();
    let maps = blocking(move || {
        let of_cycle = |of: &CycleSummary| {
            of.map.as_ref()?;
            let base = format!("/api/v1/runs/{}/cycles/{}", in_path(&run), of.cycle);
            let files = SAVED.iter().zip(MEDIA).filter_map(|(file, media_type)| {
                let bytes =
                    std::fs::metadata(saved_path(&folder, of, *file)?).ok().filter(|found| found.is_file())?.len();
                let name = file.name();
                Some(FileLink { name, media_type, bytes, href: format!("{base}/files/{name}") })
            });
            Some(MapLinks { cycle: of.cycle, href: format!("{base}/map"), files: files.collect() })
        };
        let maps = summary.cycles.iter().filter_map(of_cycle).collect();
        Ok(RunMaps { run, maps })
    });
    json(&maps.await?)
}

/// Answers with the map of a cycle as JSON.
pub(super) async fn map(call: Call) -> Result<Response, Problem> {
    let (folder, summary) = call.summary().await?;
    let (run, cycle) = (call.run(), cycle(&call));
    let body = blocking(move || {
        let path = path_of(&folder, &summary, cycle, CycleFile::ErrorMap)?;
        to_json(&grid(run, cycle, summary.simulation, &path)?)
    });
    Ok(unless_known(&call.headers, "application/json", body.await?))
}

/// Answers with a file of a cycle.
pub(super) async fn file(call: Call) -> Result<Response, Problem> {
    let (folder, summary) = call.summary().await?;
    let (cycle, name) = (cycle(&call), call.arguments.text("file").unwrap_or_default());
    let found = SAVED.iter().zip(MEDIA).find(|(file, _)| file.name() == name);
    let (wanted, media) = found.ok_or_else(|| no_file(name, cycle))?;
    acceptable(&call.headers, &[media])?;
    let body = blocking(move || {
        let path = path_of(&folder, &summary, cycle, *wanted)?;
        read_bytes(&path).map_err(|error| unreadable(&folder, &error.to_string()))
    });
    Ok(unless_known(&call.headers, media, body.await?))
}

fn cycle(call: &Call) -> u32 {
    call.arguments.number("cycle").and_then(|cycle| u32::try_from(cycle).ok()).unwrap_or_default()
}

/// Returns the path of a file of the cycle number `cycle` in the run folder `folder`.
///
/// # Errors
/// The run has no such cycle, or the cycle has no such file, or the file that is on record is gone.
fn path_of(folder: &Path, summary: &Arc<RunSummary>, cycle: u32, wanted: CycleFile) -> Result<PathBuf, Problem> {
    let of = summary
        .cycles
        .iter()
        .find(|of| of.cycle == cycle)
        .ok_or_else(|| Problem::new(ProblemKind::UnknownCycle, format!("nothing is on record of cycle {cycle}")))?;
    let path = saved_path(folder, of, wanted).filter(|path| path.is_file());
    path.ok_or_else(|| no_file(wanted.name(), cycle))
}

fn no_file(name: &str, cycle: u32) -> Problem {
    Problem::new(ProblemKind::NoFile, format!("cycle {cycle} has no file {name}"))
}

/// Returns the problem that a file cannot be read. `reason` names the file; the folders above the run folder `folder` are
/// no concern of the client.
fn unreadable(folder: &Path, reason: &str) -> Problem {
    let home = folder.parent().map(|home| format!("{}/", home.display())).unwrap_or_default();
    Problem::new(
        ProblemKind::UnreadableFile,
        if home.len() > 1 { reason.replace(&home, "") } else { reason.to_owned() },
    )
}

/// Reads the map in the file `path` on its regular grid.
fn grid(run: String, cycle: u32, simulation: bool, path: &Path) -> Result<MapGrid, Problem> {
    let folder = path.parent().and_then(Path::parent).unwrap_or(path);
    let failed = |error: regrind_formats::FormatError| unreadable(folder, &error.to_string());
    let text = String::from_utf8(read_bytes(path).map_err(failed)?)
        .map_err(|_| Problem::new(ProblemKind::UnreadableFile, "the map is not UTF-8"))?;
    let nodes = parse_error_map(path, &text).map_err(failed)?;
    let RegularGrid { columns, rows, first_mm, spacing_mm, errors_um, sigmas_um } = regular_grid(&nodes, MAX_NODES)
        .ok_or_else(|| {
            let detail = format!(
                "the {} measured nodes of the map do not lie on a regular grid of at most {MAX_NODES} nodes",
                nodes.len()
            );
            Problem::new(ProblemKind::TooLarge, detail)
        })?;
    let in_rows =
        |values: Vec<f64>| values.chunks(columns).map(|row| row.iter().map(|um| rounded(*um)).collect()).collect();
    let ([first_x_mm, first_y_mm], [spacing_x_mm, spacing_y_mm]) = (first_mm, spacing_mm);
    let (error_um, sigma_um) = (in_rows(errors_um), in_rows(sigmas_um));
    Ok(MapGrid {
        run,
        cycle,
        simulation,
        columns,
        rows,
        first_x_mm,
        first_y_mm,
        spacing_x_mm,
        spacing_y_mm,
        error_um,
        sigma_um,
    })
}

/// Returns a length in micrometres, rounded to a millionth of it; `None` if nothing was measured.
fn rounded(um: f64) -> Option<f64> {
    finite((1e6 * um).round() / 1e6)
}
