//! Correction of the next pass, and path of the wheel.

use pyo3::prelude::*;
use regrind_core::compensation::path::{
    Move, PathOptions, PathSummary, TargetSurface, ToolPath, TrackPattern, TrackSpacing, Wheel, nominal_height_field,
};
use regrind_core::compensation::{Correction, CorrectionLimits, GainRule, LearningState, NextPass, PassObservation};
use regrind_core::geometry::{Aperture, Grid, Vector};
use regrind_core::registration::ProbeSide;
use sha2::{Digest, Sha256};

use super::arrays::{Output1, Output2, axis_places_mm, on_grid, output, output2};
use super::errors::{DataError, data};
use super::figures::PyErrorMap;
use super::nominal::PyNominal;
use super::registration::{SIDES, above_zero, choice};

/// Maximum number of points that a path gives as one array: 2.4 GB.
const MAX_POINTS: u64 = 50_000_000;
const PATTERNS: [(&str, TrackPattern); 2] = [("raster", TrackPattern::Raster), ("spiral", TrackPattern::Spiral)];

/// Correction of a pass: by how much the surface is to be higher than the nominal surface plus the level.
#[pyclass(name = "Correction", module = "regrind", frozen)]
pub(crate) struct PyCorrection {
    pub(crate) next: NextPass,
    /// Level of the first pass, from which the removal counts.
    allowance_mm: f64,
    /// SHA-256 of the correction of the pass before.
    pub(crate) replaces: [u8; 32],
}

impl PyCorrection {
    pub(crate) fn correction(&self) -> &Correction {
        &self.next.correction
    }
}

#[pymethods]
impl PyCorrection {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// Places of the columns along x in mm, (M,).
    #[getter]
    fn x<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, axis_places_mm(&self.correction().grid, 0))
    }

    /// Places of the rows along y in mm, (N,).
    #[getter]
    fn y<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, axis_places_mm(&self.correction().grid, 1))
    }

    /// Displacement of the surface at each node in mm, (N, M), along the outward normal; positive leaves material. It is
    /// absolute: it replaces that of the pass before.
    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Output2<'py> {
        on_grid(py, &self.correction().grid, self.correction().values_mm.clone())
    }

    /// Number of the pass that it is for, from 2.
    #[getter]
    fn cycle(&self) -> u16 {
        self.correction().cycle
    }

    /// Height of the target surface above the nominal one without the correction, in mm.
    #[getter]
    fn level(&self) -> f64 {
        self.correction().level_mm
    }

    /// Depth of the pass below the pass before, in mm: the depth of cut, or more where the part is low.
    #[getter]
    fn depth(&self) -> f64 {
        self.next.depth_mm
    }

    /// Removal below the surface of the first pass at the place of the most removal, in mm.
    #[getter]
    fn removed(&self) -> f64 {
        self.next.removed_mm
    }

    fn __repr__(&self) -> String {
        let Grid { columns, rows, .. } = self.correction().grid;
        format!("Correction({columns} x {rows} nodes, pass {}, depth {:.3} um)", self.cycle(), 1e3 * self.depth())
    }
}

/// Correction of the next pass: the last correction minus `gain` times the measured error, within limits.
///
/// A pass can only remove material, so the next pass is deeper by `depth_of_cut` in mm, or by more where the correction
/// rises. `previous` is the correction of the pass that was measured; without it, that pass was the first, had none, and left
/// `allowance` in mm. `max_correction` limits the correction at any place, `removal_budget` the removal below the first
/// pass, `max_depth` the depth of the pass at any place, and `min_depth` is the least depth of cut at any place; all in
/// mm.
///
/// Raises DataError if a limit would be exceeded: the text says where, by how much, and what to do.
///
/// >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
/// >>> places = np.column_stack([x.ravel(), y.ravel()])
/// >>> map = regrind.error_map(places, 1e-4 * x.ravel(), cutoff=4, spacing=2)
/// >>> regrind.compensate(map, depth_of_cut=0.02, max_correction=0.06, removal_budget=0.4)
/// Correction(11 x 11 nodes, pass 2, depth 20.000 um)
#[pyfunction]
#[pyo3(signature = (error_map, *, depth_of_cut, max_correction, removal_budget, previous = None, allowance = None,
    gain = 1.0, min_depth = 0.0005, max_depth = None))]
#[expect(clippy::too_many_arguments, reason = "Python names each of them")]
pub(crate) fn compensate(
    error_map: &PyErrorMap,
    depth_of_cut: f64,
    max_correction: f64,
    removal_budget: f64,
    previous: Option<&PyCorrection>,
    allowance: Option<f64>,
    gain: f64,
    min_depth: f64,
    max_depth: Option<f64>,
) -> PyResult<PyCorrection> {
    let from_zero = |name: &str, value: f64| match value >= 0.0 && value.is_finite() {
        true => Ok(value),
        false => Err(DataError::new_err(format!("{name} is {value}; it must be a finite number of mm, 0 or more"))),
    };
    if !(gain > 0.0 && gain <= 1.5) {
        return Err(DataError::new_err(format!("gain is {gain}; it must be above 0, and 1.5 at most")));
    }
    let allowance = match (previous.map(|previous| previous.allowance_mm), allowance) {
        (None, given) => given.unwrap_or(0.0),
        (Some(known), None) => known,
        (Some(known), Some(given)) if known == given => known,
        (Some(known), Some(given)) => {
            return Err(DataError::new_err(format!(
                "allowance is {given}; that of the correction before is {known}, and it stays; leave it out"
            )));
        }
    };
    let limits = CorrectionLimits {
        depth_of_cut_mm: from_zero("depth_of_cut", depth_of_cut)?,
        min_depth_mm: from_zero("min_depth", min_depth)?,
        max_correction_mm: above_zero("max_correction", max_correction)?,
        allowance_mm: from_zero("allowance", allowance)?,
        removal_budget_mm: above_zero("removal_budget", removal_budget)?,
        max_depth_mm: max_depth.map_or(Ok(f64::INFINITY), |mm| above_zero("max_depth", mm))?,
    };
    let grid = error_map.map.nodes.grid;
    let first = Correction::zero(grid, allowance);
    let last = previous.map_or(&first, PyCorrection::correction);
    let seen_mm = bounds(&grid);
    if previous.is_some() {
        check_cover(&last.grid, seen_mm, "the correction before", "the error map")?;
    }
    let extent_mm = [grid.columns, grid.rows].map(|count| count.saturating_sub(1) as f64);
    let size_mm = [extent_mm[0] * grid.spacing_mm[0], extent_mm[1] * grid.spacing_mm[1]];
    let known = LearningState::new(GainRule::Fixed(gain), &error_map.options, size_mm, None);
    let seen = PassObservation { correction: last, error: &error_map.map, response: None, explained: None };
    let next = last.next_pass(&error_map.map, &known.updated(&seen), None, &limits).map_err(data)?;
    Ok(PyCorrection { next, allowance_mm: allowance, replaces: identity(last) })
}

/// Returns the lowest and the highest place of the nodes of a grid, in mm.
fn bounds(grid: &Grid) -> [[f64; 2]; 2] {
    [grid.place_mm(0), grid.place_mm(grid.len().saturating_sub(1))]
}

/// Refuses a grid that leaves out more than a tenth of an area on a side: beyond its edge a correction is constant, and
/// one in other coordinates would be applied unseen.
fn check_cover(grid: &Grid, [low, high]: [[f64; 2]; 2], of: &str, area: &str) -> PyResult<()> {
    const MAX_SHARE: f64 = 0.1;
    let [first, last] = bounds(grid);
    for (k, axis) in ['x', 'y'].into_iter().enumerate() {
        let out_mm = (first[k] - low[k]).max(high[k] - last[k]);
        let limit_mm = MAX_SHARE * (high[k] - low[k]) + grid.spacing_mm[k];
        if out_mm > limit_mm {
            return Err(DataError::new_err(format!(
                "{of} is from {axis} {:.3} to {:.3} mm and leaves out {out_mm:.3} mm of {area}, which is from {:.3} to {:.3} mm; at \
                 most {limit_mm:.3} mm may be left out: are both in coordinates of the model?",
                first[k], last[k], low[k], high[k]
            )));
        }
    }
    Ok(())
}

/// Returns the SHA-256 of a correction: of its grid and of its values.
pub(crate) fn identity(correction: &Correction) -> [u8; 32] {
    let Correction { grid, values_mm, .. } = correction;
    let mut hash = Sha256::new();
    hash.update((grid.columns as u64).to_le_bytes());
    grid.first_mm.iter().chain(&grid.spacing_mm).chain(values_mm).for_each(|mm| hash.update(mm.to_le_bytes()));
    hash.finalize().into()
}

/// Path of the centre of a wheel over a part.
#[pyclass(name = "ToolPath", module = "regrind", frozen)]
pub(crate) struct PyToolPath {
    pub(crate) path: ToolPath,
    pub(crate) summary: PathSummary,
    pub(crate) correction: Correction,
    pub(crate) part_identity: [u8; 32],
}

/// Path of the wheel over the nominal surface plus a correction.
///
/// The wheel is a ball of `wheel_radius`, or with `rim_radius` a disc with a round rim whose spindle is along y; both in
/// mm. `track` is the distance of the tracks in mm, or `scallop` is the height h in mm of the ridges between them, to first
/// order: h = track² / (8 r), with 1/r the curvature of the wheel less that of the surface.
/// `feed` is in mm/min. `pattern` is "raster" or "spiral". `side` is the side from which the wheel comes: "above" or
/// "below". `chord_error` is the greatest distance of the lines between the points from the path in mm. `overrun` is the
/// length of the tracks beyond the edge, before which and after which the wheel comes down and lifts off along 2 mm more at
/// feed; `safe_height` is the height of rapid moves above the path; both in mm.
///
/// Raises DataError if the wheel does not fit the surface: the text says where, by how much, and what to do.
///
/// >>> x = np.linspace(-20, 20, 81)
/// >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
/// >>> nominal = regrind.Nominal.from_function(saddle, x, x)
/// >>> path = regrind.toolpath(nominal, wheel_radius=5, track=2, feed=600, chord_error=1e-3)
/// >>> path.tracks[-1]
/// np.uint32(20)
#[pyfunction]
#[pyo3(signature = (nominal, correction = None, *, wheel_radius, feed, track = None, scallop = None, rim_radius = None,
    pattern: "Literal['raster', 'spiral']" = "raster", one_way = false,
    side: "Literal['above', 'below']" = "above", chord_error = 1e-4, overrun = 2.0, safe_height = 10.0))]
#[expect(clippy::too_many_arguments, reason = "Python names each of them")]
pub(crate) fn toolpath(
    py: Python,
    nominal: &PyNominal,
    correction: Option<&PyCorrection>,
    wheel_radius: f64,
    feed: f64,
    track: Option<f64>,
    scallop: Option<f64>,
    rim_radius: Option<f64>,
    pattern: &str,
    one_way: bool,
    side: &str,
    chord_error: f64,
    overrun: f64,
    safe_height: f64,
) -> PyResult<PyToolPath> {
    let wheel = wheel(wheel_radius, rim_radius)?;
    let from_below = match choice("side", side, &SIDES)? {
        ProbeSide::Above => false,
        ProbeSide::Below => true,
        ProbeSide::Auto => {
            return Err(DataError::new_err("side is \"auto\"; a wheel comes from \"above\" or \"below\""));
        }
    };
    let options = PathOptions {
        spacing: spacing(track, scallop, wheel_radius)?,
        from_below,
        pattern: choice("pattern", pattern, &PATTERNS)?,
        one_way,
        chord_error_mm: chord_error,
        overrun_mm: overrun,
        safe_height_mm: safe_height,
        ..PathOptions::new(wheel, wheel_radius, feed)
    };
    let within = |name: &str, value: f64, least: f64, most: f64| match (least..=most).contains(&value) {
        true => Ok(()),
        false => Err(DataError::new_err(format!("{name} is {value}; it must be {least} to {most} mm"))),
    };
    within("chord_error", chord_error, 1e-7, 1.0)?;
    within("overrun", overrun, 0.0, 1000.0)?;
    let (path, summary, correction) = py.detach(|| {
        let (field, outline) = nominal_height_field(&nominal.nominal).map_err(data)?;
        let field = if from_below { field.mirrored() } else { field };
        let correction = correction.map_or_else(
            || {
                let [low, high] = outline.bounds();
                let spacing_mm = [0, 1].map(|k| high[k] - low[k]);
                Correction::zero(Grid { columns: 2, rows: 2, first_mm: low, spacing_mm }, 0.0)
            },
            |given| given.correction().clone(),
        );
        check_cover(&correction.grid, outline.bounds(), "the correction", "the part")?;
        let target = TargetSurface::new(field, &correction, wheel.reach_mm()).map_err(data)?;
        check_length(&outline, &options)?;
        let path = ToolPath::new(target, outline, options).map_err(data)?;
        let summary = path.summary().map_err(data)?;
        Ok::<_, PyErr>((path, summary, correction))
    })?;
    Ok(PyToolPath { path, summary, correction, part_identity: nominal.identity() })
}

/// Refuses a path that is so long that nobody waits for it.
fn check_length(outline: &Aperture, options: &PathOptions) -> PyResult<()> {
    const MAX_LENGTH_MM: f64 = 2e7;
    let TrackSpacing::Distance(track_mm) = options.spacing else { return Ok(()) };
    let [low, high] = outline.bounds();
    let length_mm = (high[0] - low[0]) * (high[1] - low[1]) / track_mm;
    match length_mm <= MAX_LENGTH_MM {
        true => Ok(()),
        false => Err(DataError::new_err(format!(
            "track is {track_mm}; the path would be {:.0} km long, limit {:.0} km; increase track",
            1e-6 * length_mm,
            1e-6 * MAX_LENGTH_MM
        ))),
    }
}

/// Returns a ball, or with `rim_radius` a disc with a round rim whose spindle is along y.
fn wheel(wheel_radius: f64, rim_radius: Option<f64>) -> PyResult<Wheel> {
    let radius_mm = above_zero("wheel_radius", wheel_radius)?;
    match rim_radius.map(|mm| above_zero("rim_radius", mm)).transpose()? {
        None => Ok(Wheel::Sphere { radius_mm }),
        Some(tube_mm) if tube_mm < radius_mm => {
            Ok(Wheel::Torus { ring_mm: radius_mm - tube_mm, tube_mm, spindle: Vector::y() })
        }
        Some(mm) => {
            Err(DataError::new_err(format!("rim_radius is {mm}; it must be below wheel_radius, {wheel_radius}")))
        }
    }
}

/// Returns the distance of the tracks: `track`, or what keeps the ridges below `scallop`, up to the radius of the wheel.
fn spacing(track: Option<f64>, scallop: Option<f64>, wheel_radius: f64) -> PyResult<TrackSpacing> {
    match (track, scallop) {
        (None, None) => Err(DataError::new_err("neither track nor scallop is given; one of them is needed")),
        (Some(mm), None) => Ok(TrackSpacing::Distance(above_zero("track", mm)?)),
        (_, Some(mm)) => Ok(TrackSpacing::Scallop {
            max_height_mm: above_zero("scallop", mm)?,
            max_track_mm: above_zero("track", track.unwrap_or(wheel_radius))?,
        }),
    }
}

#[pymethods]
impl PyToolPath {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// Places of the centre of the wheel at feed in the model frame in mm, (N, 3).
    ///
    /// Raises DataError for a path of more than 5e7 points.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> PyResult<Output2<'py>> {
        self.check_count()?;
        let flat: Vec<f64> = py.detach(|| {
            let at = |one: Move| match one {
                Move::Feed { to, .. } | Move::FeedTilted { to, .. } => Some([to.x, to.y, to.z]),
                Move::RapidZ(_) | Move::RapidXy(_) | Move::RapidTilted { .. } => None,
            };
            self.path.moves().filter_map(at).flatten().collect()
        });
        Ok(output2(py, (flat.len() / 3, 3), flat))
    }

    /// Index of the track of each of these points, (N,). A track that leaves the part and comes back has several.
    ///
    /// Raises DataError for a path of more than 5e7 points.
    #[getter]
    fn tracks<'py>(&self, py: Python<'py>) -> PyResult<Output1<'py, u32>> {
        self.check_count()?;
        let tracks: Vec<u32> = py.detach(|| {
            let is_feed = |one: &Move| matches!(one, Move::Feed { .. } | Move::FeedTilted { .. });
            let of = |(track, moves): (u32, regrind_core::compensation::path::Moves)| {
                std::iter::repeat_n(track, moves.filter(is_feed).count())
            };
            (0..).zip(self.path.moves_by_track()).flat_map(of).collect()
        });
        Ok(output(py, tracks))
    }

    /// Distance of the tracks over x and y, in mm.
    #[getter]
    fn track(&self) -> f64 {
        self.path.track_mm()
    }

    /// Length of the path at feed, in mm.
    #[getter]
    fn length(&self) -> f64 {
        self.summary.length_mm
    }

    /// Time of the moves at feed in s, without the time for acceleration.
    #[getter]
    fn duration(&self) -> f64 {
        self.summary.duration_s
    }

    fn __len__(&self) -> usize {
        usize::try_from(self.summary.points).unwrap_or(usize::MAX)
    }

    fn __repr__(&self) -> String {
        let PathSummary { points, length_mm, duration_s, .. } = self.summary;
        format!("ToolPath({points} points, {length_mm:.1} mm, {:.1} min)", duration_s / 60.0)
    }
}

impl PyToolPath {
    fn check_count(&self) -> PyResult<()> {
        match self.summary.points {
            0..=MAX_POINTS => Ok(()),
            points => Err(DataError::new_err(format!(
                "the path has {points} points, limit {MAX_POINTS}; increase chord_error, or write it as a program"
            ))),
        }
    }
}
