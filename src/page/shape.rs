//! Binary maps and points for the canvas: little endian, lengths in millimetres, deviations in micrometres.
//!
//! ```text
//!  map      u32 columns, u32 rows, f64 first x, first y, f64 spacing x, y, then f32 a node, x fastest;
//!           NaN where nothing was measured;
//!           the errors of all nodes first, then the standard uncertainties of all
//!  points   f32 x, y, deviation a point, in the order measured; the deviation is NaN if the fit did not use the point
//!  planned  f32 x, y a point, in the order in which it is to be touched
//!  path     f32 x, y of the wheel's centre and the share of the path up to it a point; NaN begins a new track
//!  touched  u32 cycle, batch, index of the first point, then f32 x, y, deviation from the planned position a point, in
//!           the order measured; the deviation is NaN where the probe found nothing
//! ```

use std::path::PathBuf;

use axum::extract::{Path, Query, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use regrind_control::PreliminaryTouches;
use regrind_formats::result::read_bytes;
use regrind_formats::run_files::CycleFile;
use regrind_formats::{DeviationRow, FormatError, MapNode, read_deviations, read_error_map};
use regrind_report::CycleSummary;
use serde::Deserialize;
use tokio::task::spawn_blocking;

use super::attachment::attachment;
use super::shared::Shared;

/// Maximum number of nodes of a map that is drawn.
const MAX_NODES: usize = 4 << 20;

pub(crate) async fn map(State(page): State<Shared>, Path((run, cycle)): Path<(String, u32)>) -> Response {
    respond(move || {
        let path = file(&page, &run, cycle, |of| of.map.as_ref())?;
        Some(read_error_map(&path).map(|nodes| grid_bytes(&nodes)))
    })
    .await
}

pub(crate) async fn points(State(page): State<Shared>, Path((run, cycle)): Path<(String, u32)>) -> Response {
    respond(move || {
        let path = file(&page, &run, cycle, |of| of.deviations.as_ref())?;
        Some(read_deviations(&path).map(|rows| Some(point_bytes(&rows))))
    })
    .await
}

pub(crate) async fn planned(State(page): State<Shared>, Path(run): Path<String>) -> Response {
    respond(move || {
        let points = page.plan.points(&page.history.folder(&run)?)?;
        Some(Ok(Some(f32_bytes(points.iter().flatten()))))
    })
    .await
}

pub(crate) async fn path(State(page): State<Shared>, Path(run): Path<String>) -> Response {
    respond(move || {
        let path = page.plan.path(&page.history.folder(&run)?)?;
        Some(Ok(Some(f32_bytes(path.iter().flatten()))))
    })
    .await
}

fn f32_bytes<'v>(values: impl Iterator<Item = &'v f64>) -> Vec<u8> {
    values.flat_map(|value| (*value as f32).to_le_bytes()).collect()
}

/// Files of a cycle that a browser or a program can save: the error map as a table, as pictures and as X3P, and the
/// deviations.
pub(crate) const SAVED: [CycleFile; 5] = [
    CycleFile::ErrorMap,
    CycleFile::ErrorMapPng,
    CycleFile::ErrorMapSvg,
    CycleFile::ErrorMapX3p,
    CycleFile::Deviations,
];

/// Serves a file of a cycle for saving. Responds with the status 404 if it is none of [`SAVED`], or if the cycle has no
/// such file.
pub(crate) async fn saved_file(
    State(page): State<Shared>,
    Path((run, cycle, name)): Path<(String, u32, String)>,
) -> Response {
    let Some(wanted) = CycleFile::from_name(&name).filter(|wanted| SAVED.contains(wanted)) else {
        return StatusCode::NOT_FOUND.into_response();
    };
    let title = format!("{run}-cycle-{cycle}-{name}");
    let read = spawn_blocking(move || {
        let folder = page.history.folder(&run)?;
        let summary = page.history.summary(&folder)?;
        let of = summary.cycles.iter().find(|of| of.cycle == cycle)?;
        read_bytes(&saved_path(&folder, of, wanted)?).ok()
    });
    match read.await {
        Ok(Some(bytes)) => attachment(&title, bytes),
        Ok(None) => StatusCode::NOT_FOUND.into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Returns the path of a file of the cycle `of` in the run folder `folder`; `None` if nothing of it is on record.
pub(crate) fn saved_path(folder: &std::path::Path, of: &CycleSummary, wanted: CycleFile) -> Option<PathBuf> {
    // Results that were computed again are in a folder of their own, beside their map.
    if wanted == CycleFile::Deviations {
        return inside(folder, of.deviations.as_ref()?);
    }
    Some(inside(folder, of.map.as_ref()?)?.parent()?.join(wanted.name()))
}

/// Query of [`touched`].
#[derive(Debug, Default, Deserialize)]
pub(crate) struct TouchedFrom {
    /// Index of the first point, from 0.
    #[serde(default)]
    from: usize,
}

/// Serves the preliminary deviations of the measurement that runs in the run named `run`, from a point on.
pub(crate) async fn touched(
    State(page): State<Shared>,
    Path(run): Path<String>,
    Query(TouchedFrom { from }): Query<TouchedFrom>,
) -> Response {
    let Some(folder) = page.history.folder(&run) else { return StatusCode::NOT_FOUND.into_response() };
    let touches = std::sync::Arc::clone(&page.run_watcher.subscribe(&folder).borrow().touches);
    ([(CONTENT_TYPE, "application/octet-stream"), (CACHE_CONTROL, "no-store")], touch_bytes(&touches, from))
        .into_response()
}

fn touch_bytes(touches: &PreliminaryTouches, from: usize) -> Vec<u8> {
    let head = [touches.cycle, touches.batch, u32::try_from(from).unwrap_or(u32::MAX)];
    let newer = touches.places_mm.iter().zip(&touches.deviations_um).skip(from);
    let values = newer.flat_map(|([x, y], um)| [*x as f32, *y as f32, um.map_or(f32::NAN, |um| um as f32)]);
    head.iter().flat_map(|of| of.to_le_bytes()).chain(values.flat_map(f32::to_le_bytes)).collect()
}

/// Returns the path of a file that belongs to the cycle `cycle` of the run named `run`. `named` selects which file: it
/// returns the name of the file from the record of the cycle. Returns `None` if the run or the cycle is unknown, or if
/// the cycle has no such file.
fn file(page: &Shared, run: &str, cycle: u32, named: fn(&CycleSummary) -> Option<&String>) -> Option<PathBuf> {
    let folder = page.history.folder(run)?;
    let summary = page.history.summary(&folder)?;
    let of = summary.cycles.iter().find(|of| of.cycle == cycle)?;
    inside(&folder, named(of)?)
}

/// Returns the path of the file `name` below the run folder `folder`. Returns `None` if the name leads out of the folder: a
/// record that somebody has changed must not show other files of this computer.
fn inside(folder: &std::path::Path, name: &str) -> Option<PathBuf> {
    let mut parts = std::path::Path::new(name).components();
    parts.all(|part| matches!(part, std::path::Component::Normal(_))).then(|| folder.join(name))
}

/// Responds with the bytes that `make` returns. Responds with the status 404 if `make` returns no bytes, and 422 if it
/// returns an error. `make` runs in a separate thread, because it can block.
async fn respond(make: impl FnOnce() -> Option<Result<Option<Vec<u8>>, FormatError>> + Send + 'static) -> Response {
    match spawn_blocking(make).await {
        Ok(Some(Ok(Some(bytes)))) => {
            let headers = [(CONTENT_TYPE, "application/octet-stream"), (CACHE_CONTROL, "no-cache")];
            (headers, bytes).into_response()
        }
        Ok(Some(Err(error))) => (StatusCode::UNPROCESSABLE_ENTITY, error.to_string()).into_response(),
        Ok(_) => StatusCode::NOT_FOUND.into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Error map on a regular grid. A position without a measured node is NaN.
pub(crate) struct RegularGrid {
    /// Number of columns, along x, and of rows, along y.
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    /// First position along x and along y.
    pub(crate) first_mm: [f64; 2],
    /// Distance of two columns, and of two rows.
    pub(crate) spacing_mm: [f64; 2],
    /// Errors, row by row.
    pub(crate) errors_um: Vec<f64>,
    /// Standard uncertainties of the errors, in the same order.
    pub(crate) sigmas_um: Vec<f64>,
}

/// Returns `nodes`, the measured nodes of an error map, on their regular grid. Returns `None` if the nodes do not lie on a
/// regular grid, or if the grid has more than `max_nodes` positions.
pub(crate) fn regular_grid(nodes: &[MapNode], max_nodes: usize) -> Option<RegularGrid> {
    let [x, y] = [0, 1].map(|k| axis(nodes.iter().map(|node| node.at_mm[k]).collect()));
    let ([first_x, step_x, columns], [first_y, step_y, rows]) = (x?, y?);
    let (columns, rows) = (columns as usize, rows as usize);
    if columns.checked_mul(rows)? > max_nodes {
        return None;
    }
    let (mut errors_um, mut sigmas_um) = (vec![f64::NAN; columns * rows], vec![f64::NAN; columns * rows]);
    for MapNode { at_mm: [x, y], error_mm, sigma_mm } in nodes {
        let at = place(*y, first_y, step_y)? * columns + place(*x, first_x, step_x)?;
        *errors_um.get_mut(at)? = 1e3 * error_mm;
        *sigmas_um.get_mut(at)? = 1e3 * sigma_mm;
    }
    Some(RegularGrid {
        columns,
        rows,
        first_mm: [first_x, first_y],
        spacing_mm: [step_x, step_y],
        errors_um,
        sigmas_um,
    })
}

/// Encodes `nodes`, the measured nodes of an error map, as bytes (little-endian). The nodes must lie on a regular grid.
/// The bytes contain, in this order:
///
/// - the number of columns and the number of rows (`u32`)
/// - the first position along x and along y, in millimetres (`f64`)
/// - the spacing along x and along y, in millimetres (`f64`)
/// - the error of each grid position, in micrometres (`f32`), row by row
/// - the standard uncertainty of each grid position, in micrometres (`f32`), row by row
///
/// A grid position without a measured node is NaN. Returns `None` if the nodes do not lie on a regular grid, or if the
/// grid has more than `MAX_NODES` positions.
fn grid_bytes(nodes: &[MapNode]) -> Option<Vec<u8>> {
    let RegularGrid { columns, rows, first_mm, spacing_mm, errors_um, sigmas_um } = regular_grid(nodes, MAX_NODES)?;
    let mut bytes = Vec::with_capacity(40 + 8 * errors_um.len());
    bytes.extend([columns as u32, rows as u32].iter().flat_map(|count| count.to_le_bytes()));
    bytes.extend([first_mm, spacing_mm].iter().flatten().flat_map(|length| length.to_le_bytes()));
    bytes.extend([errors_um, sigmas_um].iter().flatten().flat_map(|value| (*value as f32).to_le_bytes()));
    Some(bytes)
}

/// Returns the index (from 0) of the grid position at `value` on a regular axis. The axis begins at `first` and has the
/// spacing `step`. `value`, `first` and `step` have the same unit, and `value` must not be less than `first`. Returns
/// `None` if the distance from `value` to the nearest grid position is 1 % of the spacing or more.
fn place(value: f64, first: f64, step: f64) -> Option<usize> {
    const ROUNDING: f64 = 0.01;
    let steps = (value - first) / step;
    ((steps - steps.round()).abs() < ROUNDING).then_some(steps.round() as usize)
}

/// Determines the regular axis of a grid from the positions in `places`. `places` need not be sorted. Returns three
/// numbers: the first position, the spacing (the smallest distance between two different positions), and the number of
/// positions. Returns `None` if there are no two different positions.
fn axis(mut places: Vec<f64>) -> Option<[f64; 3]> {
    places.sort_by(f64::total_cmp);
    let (first, last) = (*places.first()?, *places.last()?);
    // Positions of one column are written identically. A smaller distance than this is a rounding error.
    let least = 1e-6 * (last - first);
    let steps = places.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > least);
    let step = steps.fold(f64::INFINITY, f64::min);
    step.is_finite().then(|| [first, step, ((last - first) / step).round() + 1.0])
}

fn point_bytes(rows: &[DeviationRow]) -> Vec<u8> {
    let value = |row: &DeviationRow| {
        let [x, y, _] = row.point_mm;
        [x, y, if row.used { 1e3 * row.deviation_mm } else { f64::NAN }]
    };
    rows.iter().flat_map(value).flat_map(|value| (value as f32).to_le_bytes()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recorded_names_stay_in_run_folder() {
        let of = |map: &str| {
            let cycle = CycleSummary { map: Some(map.into()), ..CycleSummary::default() };
            saved_path(std::path::Path::new("run"), &cycle, CycleFile::ErrorMapPng)
        };
        assert_eq!(of("cycle-1/error_map.csv"), Some("run/cycle-1/error_map.png".into()));
        for outside in ["cycle-1/../../other/error_map.csv", "/etc/error_map.csv", "../error_map.csv"] {
            assert_eq!(of(outside), None, "{outside}");
        }
    }

    #[test]
    fn touch_bytes_begin_at_asked_point() {
        let touches = PreliminaryTouches {
            cycle: 2,
            batch: 1,
            first_index: 0,
            places_mm: vec![[0.5, 0.0], [1.5, 0.0], [2.5, -4.0]],
            deviations_um: vec![Some(1.0), None, Some(-2.5)],
        };
        let bytes = touch_bytes(&touches, 1);
        assert_eq!(bytes[..12], [2, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]);
        let value = |k: usize| f32::from_le_bytes(bytes[12 + 4 * k..16 + 4 * k].try_into().unwrap());
        assert!(bytes.len() == 36 && value(0) == 1.5 && value(2).is_nan(), "{bytes:?}");
        assert_eq!([value(3), value(4), value(5)], [2.5, -4.0, -2.5]);
        assert_eq!(touch_bytes(&touches, 9).len(), 12);
    }

    #[test]
    fn grid_bytes_of_unordered_nodes() {
        // Three columns and two rows, in any order. One node was not measured.
        let nodes = [[2.0, 5.5, 4e-3], [1.0, 5.0, 1e-3], [1.5, 5.0, 2e-3], [1.0, 5.5, 3e-3], [2.0, 5.0, -1e-3]];
        let bytes = grid_bytes(&nodes.map(node)).unwrap();
        let count = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let length = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        assert_eq!((count(0), count(4)), (3, 2));
        assert_eq!([8, 16, 24, 32].map(length), [1.0, 5.0, 0.5, 0.5]);
        let values: Vec<f32> = bytes[40..].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        assert_eq!(values[..4], [1.0, 2.0, -1.0, 3.0]);
        assert!(values[4].is_nan() && values[10].is_nan());
        assert_eq!((values[5], values.len()), (4.0, 12));
        assert_eq!(values[6..10], [0.1, 0.2, 0.1, 0.3], "how well each is known");
    }

    fn node([x, y, error_mm]: [f64; 3]) -> MapNode {
        MapNode { at_mm: [x, y], error_mm, sigma_mm: 0.1 * error_mm.abs() }
    }

    #[test]
    fn grid_bytes_requires_regular_grid() {
        assert!(grid_bytes(&[]).is_none());
        let of = |places: &[[f64; 2]]| grid_bytes(&places.iter().map(|[x, y]| node([*x, *y, 0.0])).collect::<Vec<_>>());
        assert!(of(&[[1.0, 1.0]]).is_none(), "one node has no spacing");
        assert!(of(&[[0.0, 0.0], [2.0, 2.0], [1e6, 1e6]]).is_none(), "too many nodes");
        assert!(of(&[[0.0, 0.0], [1.0, 1.0], [2.4, 2.0]]).is_none(), "between two");
    }
}
