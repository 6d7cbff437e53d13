//! Accuracy of the distances to a nominal surface, estimated from its points alone (section 3.1 of the paper).
//!
//! The method withholds points. It builds two coarser samplings from the other points and measures the distance of the
//! withheld points from each. The withheld points lie on the surface, so that this distance is the error of the coarser
//! sampling. The errors of the two samplings give the order p at which the error falls with the spacing. From p follows
//! the error of the whole sampling, and the error at any other spacing.
//!
//! On a grid the coarser samplings keep every third and every sixth node along each axis, not every second. With every
//! second node all withheld points lie on edges of the triangles, where the curved distance is of a higher order than
//! inside the triangles.

use rayon::prelude::*;

use super::delaunay::triangulate;
use super::error::SurfaceError;
use super::facet::FacetIndex;
use super::facet::Side;
use super::nominal::{Nominal, check_grid};
use super::normals::tangents;
use super::offset::{DistanceModel, OffsetSurface};
use super::plane_projection::{PlaneProjection, Projector, is_line};
use crate::geometry::grid_recognition::NO_POINT;
use crate::geometry::{Point, Vector, bounds, recognise_grid};

/// Spacings of the two coarser samplings of a grid, in spacings of the whole grid.
const GRID_STRIDES: [usize; 2] = [3, 6];

/// One point in 4 and one in 16 remain in the two coarser samplings of scattered points. For a cloud of less than
/// `FEW_POINTS` points, `THINNING_FACTORS_OF_FEW` is used instead.
const THINNING_FACTORS: [usize; 2] = [4, 16];
const THINNING_FACTORS_OF_FEW: [usize; 2] = [2, 4];
const FEW_POINTS: usize = 600;

/// Range of the order p that the estimate uses; an observed order is clamped to it. If the observed order is lower, the
/// spacing is not the main cause of the error.
const ORDER_RANGE: [f64; 2] = [1.5, 4.5];

/// Lowest plausible orders of the flat and of the curved distance. They are the orders on a smooth surface, reduced for
/// a form with features of many sizes.
const MIN_PLAUSIBLE_ORDERS: [f64; 2] = [1.2, 1.8];

/// Maximum number of withheld points that are measured.
const MAX_MEASURED: usize = 150_000;

/// Width of the border, in spacings. A place is inside if the sampling continues at least this far from it in all
/// directions.
const BORDER_SPACINGS: f64 = 2.0;

/// Minimum number of places inside that an estimate needs.
const MIN_INSIDE: usize = 30;

/// Points from which a nominal surface is made.
#[derive(Clone, Copy, Debug)]
pub enum NominalPoints<'a> {
    /// Points in any order, on a grid or scattered; also the vertices of a mesh.
    Points {
        /// The points in the model frame, in millimetres.
        points: &'a [Point],
        /// Projection in which scattered points are triangulated.
        projection: PlaneProjection,
    },
    /// Grid with known normals, row by row; points are NaN at a node that does not exist.
    Grid {
        /// Nodes along the first direction.
        columns: usize,
        /// Nodes along the second direction.
        rows: usize,
        /// The nodes in the model frame, in millimetres.
        points: &'a [Point],
        /// The unit normals.
        normals: &'a [Vector],
    },
}

/// Estimated errors of the distances to a nominal surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Accuracy {
    /// Number of points.
    pub points: usize,
    /// Mean spacing of the points, in millimetres.
    pub spacing_mm: f64,
    /// Errors of the flat distance, eq. (2).
    pub flat: ErrorEstimate,
    /// Errors of the curved distance.
    pub curved: ErrorEstimate,
}

/// Estimated errors of one kind of distance, flat or curved.
#[derive(Clone, Debug, PartialEq)]
pub struct ErrorEstimate {
    /// Errors away from the border.
    pub inside: ErrorFigures,
    /// Errors within two spacings of the border of the sampling.
    pub border: ErrorFigures,
    /// Place of the largest error.
    pub max_error: MaxError,
    /// Order p that the estimate uses: the error is proportional to the p-th power of the spacing.
    pub order: f64,
    /// Order as observed, before it is clamped.
    pub observed_order: f64,
    /// Reliability of the estimate.
    pub reliability: Reliability,
    spacing_mm: f64,
    /// Mean spacing of the coarser of the two samplings, in millimetres.
    coarsest_mm: f64,
}

/// Errors of a distance, in millimetres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorFigures {
    /// Peak to valley: the largest error minus the smallest.
    pub pv_mm: f64,
    /// Root mean square.
    pub rms_mm: f64,
    /// Largest absolute error.
    pub max_mm: f64,
}

/// Place of the largest error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MaxError {
    /// Position in the model frame.
    pub point: Point,
    /// Signed error, in millimetres.
    pub error_mm: f64,
    /// True if the place lies within two spacings of the border of the sampling.
    pub near_border: bool,
}

/// Reliability of an estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reliability {
    /// The error falls with the spacing as expected, so that it can be extrapolated.
    Extrapolated,
    /// The error hardly falls with the spacing: the points contain rounding errors or noise, and the estimate is the
    /// size of this noise.
    Rounding,
    /// The coarser samplings do not resolve the features of the surface: the estimate is a guess.
    TooCoarse,
}

impl ErrorEstimate {
    /// Returns the node spacing in mm at which the PV error away from the border equals `wanted_pv_mm`. Extrapolates
    /// with the order p of this estimate (the error is proportional to the p-th power of the spacing). The result is at
    /// most the spacing of the coarsest sampling that the estimate used.
    ///
    /// If the error is only rounding or noise of the points, returns the present spacing, or `None` if this error
    /// exceeds `wanted_pv_mm`.
    pub fn spacing_for(&self, wanted_pv_mm: f64) -> Option<f64> {
        if self.reliability == Reliability::Rounding {
            return (self.inside.pv_mm <= wanted_pv_mm).then_some(self.spacing_mm);
        }
        let ratio = wanted_pv_mm / self.inside.pv_mm.max(f64::MIN_POSITIVE);
        Some((self.spacing_mm * ratio.powf(1.0 / self.order)).min(self.coarsest_mm))
    }
}

/// Estimates the errors of the distances to a nominal surface through the points of `samples`. Builds two coarser
/// surfaces, each from a part of the points. Measures the distances of the other (withheld) points from each coarser
/// surface: these distances are the errors of this surface. Extrapolates the errors of the two coarser surfaces to the
/// surface through all points. See the module documentation.
///
/// Frame: model. Units: millimetres.
///
/// # Errors
/// Returns an error if the points do not form a surface, or if there are too few points to withhold most of them.
pub fn estimate_accuracy(samples: NominalPoints) -> Result<Accuracy, SurfaceError> {
    let of_all = |error, points: &[Point]| too_few_of_all(error, points.iter().filter(|p| p.x.is_finite()).count());
    let (points, [factor, coarsest], [mut fine, mut coarse]) = match samples {
        NominalPoints::Grid { columns, rows, points, normals } => {
            check_grid(columns, rows, points.len().min(normals.len()))?;
            let level = |stride| {
                strided_grid_errors(columns, rows, points, normals, stride).map_err(|error| of_all(error, points))
            };
            (points, GRID_STRIDES.map(|stride| stride as f64), [level(GRID_STRIDES[0])?, level(GRID_STRIDES[1])?])
        }
        NominalPoints::Points { points, projection } => {
            // Check all points here, so that an error refers to the whole list and not to the points that are kept.
            if let Some(index) = points.iter().position(|p| !(p.x + p.y + p.z).is_finite()) {
                return Err(SurfaceError::NotFinite { index });
            }
            let (factors, kept) = choose_coarse_points(points, projection)?;
            let level = |kept: &[u32]| subset_errors(points, kept, projection).map_err(|error| of_all(error, points));
            (points, factors, [level(&kept[0])?, level(&kept[1])?])
        }
    };
    let count = points.iter().filter(|p| p.x.is_finite()).count();
    let is_border = [&fine, &coarse].iter().any(|errors| errors.inside.len() < MIN_INSIDE);
    if is_border {
        // With few points nearly all places are near the border, so the estimate includes the border.
        [&mut fine, &mut coarse].into_iter().for_each(WithheldErrors::merge_border);
    }
    if [&fine, &coarse].iter().any(|errors| errors.inside.len() < MIN_INSIDE) {
        return Err(too_few(count));
    }
    let spacing_mm = fine.spacing_mm / factor;
    let [flat, curved] = [0, 1].map(|kind| {
        let told = extrapolate_errors(&fine, &coarse, kind, [factor, coarsest / factor], spacing_mm);
        let trust = if is_border && told.reliability == Reliability::Extrapolated {
            Reliability::TooCoarse
        } else {
            told.reliability
        };
        ErrorEstimate { reliability: trust, ..told }
    });
    Ok(Accuracy { points: count, spacing_mm, flat, curved })
}

/// Returns the error of `points` points in place of the error of a coarser sampling that is too small for a surface. The
/// size of that sampling means nothing to the caller, who has all points.
fn too_few_of_all(error: SurfaceError, points: usize) -> SurfaceError {
    match error {
        SurfaceError::TooFewPoints { .. }
        | SurfaceError::Collinear { .. }
        | SurfaceError::GridSize { .. }
        | SurfaceError::NoTriangles => too_few(points),
        other => other,
    }
}

fn too_few(points: usize) -> SurfaceError {
    SurfaceError::TooFewPoints { points, min_points: points.max(1).saturating_mul(4) }
}

/// Errors at the points that a coarser sampling withholds.
struct WithheldErrors {
    inside: Vec<WithheldPoint>,
    border: Vec<WithheldPoint>,
    /// Mean spacing of the coarser sampling, in millimetres.
    spacing_mm: f64,
}

impl WithheldErrors {
    /// Moves all withheld points (points that the coarser surface does not use) from the list `border` to the list
    /// `inside`. The estimate then does not distinguish places near the border from places inside.
    fn merge_border(&mut self) {
        self.inside.append(&mut self.border);
    }
}

/// Withheld point with its errors by the flat and by the curved distance.
struct WithheldPoint {
    point: Point,
    errors_mm: [f64; 2],
}

/// Builds a coarser grid from every `stride`-th node along both axes, with the normals of these nodes. Measures the
/// distances of the other nodes from the coarser grid, in mm. These distances are the errors of the coarser grid.
///
/// # Errors
/// Returns an error if the coarser grid has fewer than 3 nodes along an axis.
fn strided_grid_errors(
    columns: usize,
    rows: usize,
    points: &[Point],
    normals: &[Vector],
    stride: usize,
) -> Result<WithheldErrors, SurfaceError> {
    let nodes: Vec<usize> = coarse_nodes(columns, rows, stride).collect();
    let (coarse_columns, coarse_rows) = ((columns - 1) / stride + 1, (rows - 1) / stride + 1);
    let coarse_points = nodes.iter().map(|&n| points[n]).collect();
    let coarse_normals = nodes.iter().map(|&n| normals[n]).collect();
    let coarse = Nominal::from_grid_with_normals(coarse_columns, coarse_rows, coarse_points, coarse_normals)?;
    let mut left_out = vec![true; points.len()];
    nodes.iter().for_each(|&n| left_out[n] = false);
    Ok(measure_withheld(&coarse, points, &left_out))
}

/// Returns the indices of the nodes that remain if every `stride`-th node along both axes is kept.
fn coarse_nodes(columns: usize, rows: usize, stride: usize) -> impl Iterator<Item = usize> {
    (0..rows).step_by(stride).flat_map(move |j| (0..columns).step_by(stride).map(move |i| j * columns + i))
}

/// Chooses the points of two coarser samplings. Returns two ratios and two lists of point indices, one for each
/// sampling. A ratio is the spacing of the sampling divided by the spacing of all points.
///
/// Keeps every third and every sixth node along both axes if the points form a grid. Otherwise keeps one point in 4 and
/// one in 16, or one in 2 and one in 4 if there are fewer than 600 points.
///
/// # Errors
/// Returns an error if points that form no grid are fewer than 9, lie on one line, have no one-to-one projection to a
/// plane, or cannot be triangulated there.
fn choose_coarse_points(
    points: &[Point],
    projection: PlaneProjection,
) -> Result<([f64; 2], [Vec<u32>; 2]), SurfaceError> {
    let on_plane = matches!(projection, PlaneProjection::Auto | PlaneProjection::Xy);
    if let Some(order) = recognise_grid(points).filter(|_| on_plane) {
        let kept = GRID_STRIDES.map(|stride| {
            let nodes = coarse_nodes(order.columns, order.rows, stride).map(|node| order.point_indices[node]);
            nodes.filter(|&point| point != NO_POINT).collect()
        });
        return Ok((GRID_STRIDES.map(|stride| stride as f64), kept));
    }
    if points.len() < 9 {
        return Err(SurfaceError::TooFewPoints { points: points.len(), min_points: 9 });
    }
    if is_line(points) {
        return Err(SurfaceError::Collinear { points: points.len() });
    }
    let (_, map) = projection.choose(points)?;
    // A coarser sampling may leave out one of two duplicates. All points must form a surface.
    triangulate(points, &map)?;
    let order = morton_order(points, &map);
    let of = if points.len() < FEW_POINTS { THINNING_FACTORS_OF_FEW } else { THINNING_FACTORS };
    let every = |one_of: usize| order.iter().copied().skip(one_of.isqrt() / 2).step_by(one_of).collect();
    Ok((of.map(|one_of| (one_of as f64).sqrt()), of.map(every)))
}

/// Returns the indices of the points in the order of a Morton curve (Z-curve) in the plane of the projector `map`.
/// Neighbours on the curve are neighbours in the plane, so that every fourth point gives a well spread quarter of them.
fn morton_order(points: &[Point], map: &Projector) -> Vec<u32> {
    let placed: Vec<[f64; 2]> = points.par_iter().map(|p| map.project(p).0).collect();
    let [low, high] = bounds(placed.iter().copied());
    let size = (high[0] - low[0]).max(high[1] - low[1]).max(f64::MIN_POSITIVE);
    let spread = |c: f64| {
        let cell = (c / size * 65535.0) as u64;
        (0..16).fold(0u64, |code, bit| code | ((cell >> bit & 1) << (2 * bit)))
    };
    let mut coded: Vec<(u64, u32)> = placed
        .par_iter()
        .enumerate()
        .map(|(k, p)| (spread(p[0] - low[0]) | spread(p[1] - low[1]) << 1, k as u32))
        .collect();
    coded.par_sort_unstable();
    coded.into_iter().map(|(_, k)| k).collect()
}

/// Builds a coarser surface from the points with the indices `kept`, with normals fitted to these points. Measures the
/// distances of all other points from this surface, in mm. These distances are the errors of the coarser surface.
///
/// # Errors
/// Returns an error if the kept points do not form a surface.
fn subset_errors(points: &[Point], kept: &[u32], projection: PlaneProjection) -> Result<WithheldErrors, SurfaceError> {
    let coarse = Nominal::from_points(kept.iter().map(|&k| points[k as usize]).collect(), projection)?;
    let mut left_out = vec![true; points.len()];
    kept.iter().for_each(|&k| left_out[k as usize] = false);
    Ok(measure_withheld(&coarse, points, &left_out))
}

/// Measures the distances of the withheld points from the surface `coarse`, in mm. A point is withheld if its flag in
/// `left_out` is true. Sorts the points into those inside, and those within two spacings of the border. Omits points
/// beyond the edge of `coarse`. Measures only a sample if there are 300,000 points or more.
fn measure_withheld(coarse: &Nominal, points: &[Point], left_out: &[bool]) -> WithheldErrors {
    let surface = OffsetSurface::new(coarse, 0.0, Side::Normal).expect("a radius of 0 is one");
    let (flat, curved) =
        (surface.with_distance_model(DistanceModel::Triangle), surface.with_distance_model(DistanceModel::Curved));
    // Odd, so that the stride does not divide a common number of columns.
    let stride = (points.len() / MAX_MEASURED) | 1;
    let one = |k: usize| {
        let at = points[k];
        let foot = curved.project(&at, FacetIndex::UNKNOWN);
        if foot.beyond_edge_mm > 0.0 {
            return None;
        }
        let errors_mm = [flat.project(&at, foot.facet).distance_mm, foot.distance_mm];
        let spacing_mm = curved.spacing_mm(foot.facet);
        let reach = BORDER_SPACINGS * spacing_mm;
        let [u, v] = tangents(&foot.normal);
        let around = (0..8).map(|k| std::f64::consts::FRAC_PI_4 * f64::from(k)).map(|a| u * a.cos() + v * a.sin());
        let inside = around.into_iter().all(|d| curved.project(&(at + d * reach), foot.facet).beyond_edge_mm == 0.0);
        Some((inside, spacing_mm, WithheldPoint { point: at, errors_mm }))
    };
    let chosen = (0..points.len()).into_par_iter().step_by(stride);
    let measured: Vec<_> = chosen.filter(|&k| left_out[k] && points[k].x.is_finite()).filter_map(one).collect();
    let spacing_mm = measured.iter().map(|m| m.1).sum::<f64>() / measured.len().max(1) as f64;
    let (inside, border): (Vec<_>, Vec<_>) = measured.into_iter().partition(|m| m.0);
    let strip = |set: Vec<(bool, f64, WithheldPoint)>| set.into_iter().map(|m| m.2).collect();
    WithheldErrors { inside: strip(inside), border: strip(border), spacing_mm }
}

/// Extrapolates the errors of two coarser samplings, `fine` and `coarse`, to the sampling with all points (Richardson
/// extrapolation). Returns the estimated errors inside and near the border in mm, the largest error, and the
/// reliability of the estimate.
///
/// `kind` is 0 for the errors of the distance from flat facets, and 1 for the errors of the distance from curved
/// facets. `spacing_mm` is the spacing of all points. `factor` is the spacing of `fine` divided by `spacing_mm`. `step`
/// is the spacing of `coarse` divided by the spacing of `fine`.
///
/// Returns the errors of `fine` unchanged if they are only rounding or noise. Panics if `fine` has no points inside.
fn extrapolate_errors(
    fine: &WithheldErrors,
    coarse: &WithheldErrors,
    kind: usize,
    [factor, step]: [f64; 2],
    spacing_mm: f64,
) -> ErrorEstimate {
    let [inside_fine, inside_coarse] = [fine, coarse].map(|errors| error_figures(&errors.inside, kind));
    let [border_fine, border_coarse] = [fine, coarse].map(|errors| error_figures(&errors.border, kind));
    let order_inside = observed_order(&inside_fine, &inside_coarse, step);
    let trust = assess_reliability(order_inside, MIN_PLAUSIBLE_ORDERS[kind], inside_fine.rms_mm, spacing_mm);
    let order = order_inside.clamp(ORDER_RANGE[0], ORDER_RANGE[1]);
    let scale = |order: f64| if trust == Reliability::Rounding { 1.0 } else { factor.powf(-order) };
    let (inside_scale, border_scale) =
        (scale(order), scale(observed_order(&border_fine, &border_coarse, step).clamp(ORDER_RANGE[0], ORDER_RANGE[1])));
    let worst = |set: &[WithheldPoint], scale: f64, near_border: bool| {
        let largest = set.iter().max_by(|a, b| a.errors_mm[kind].abs().total_cmp(&b.errors_mm[kind].abs()));
        largest.map(|m| MaxError { point: m.point, error_mm: m.errors_mm[kind] * scale, near_border })
    };
    let inside_worst = worst(&fine.inside, inside_scale, false).expect("there are places inside");
    let worst = match worst(&fine.border, border_scale, true) {
        Some(at_border) if at_border.error_mm.abs() > inside_worst.error_mm.abs() => at_border,
        _ => inside_worst,
    };
    ErrorEstimate {
        inside: inside_fine.scaled(inside_scale),
        border: border_fine.scaled(border_scale),
        max_error: worst,
        order,
        observed_order: order_inside,
        reliability: trust,
        spacing_mm,
        coarsest_mm: coarse.spacing_mm,
    }
}

/// Returns the order p for which the rms error is proportional to the p-th power of the spacing. `fine` and `coarse`
/// are the errors of two samplings, and `step` is the ratio of their spacings. Returns 1.5 if one of the errors is 0.
fn observed_order(fine: &ErrorFigures, coarse: &ErrorFigures, step: f64) -> f64 {
    let ratio = coarse.rms_mm / fine.rms_mm;
    if ratio > 0.0 && ratio.is_finite() { ratio.log2() / step.log2() } else { ORDER_RANGE[0] }
}

/// Returns how reliable an error estimate is. `least` is the lowest plausible order (power of the spacing). `rms_mm` is
/// the rms error of the finer sampling, and `spacing_mm` is the spacing of all points.
///
/// - `Extrapolated`: the order is plausible, or the error is below 1e-11 mm.
/// - `Rounding`: the order is below `least`, and the error is less than 1e-4 of the spacing.
/// - `TooCoarse`: the order is below `least` with a larger error, or above 5.
fn assess_reliability(observed_order: f64, least: f64, rms_mm: f64, spacing_mm: f64) -> Reliability {
    /// Upper limit of the tilt that rounding and noise cause; features between the points cause more.
    const MAX_TILT: f64 = 1e-4;
    /// Limit of the floating-point accuracy on a part of one metre.
    const EXACT_MM: f64 = 1e-11;
    match observed_order {
        _ if rms_mm < EXACT_MM => Reliability::Extrapolated,
        p if p < least && rms_mm < MAX_TILT * spacing_mm => Reliability::Rounding,
        p if p < least || p > ORDER_RANGE[1] + 0.5 => Reliability::TooCoarse,
        _ => Reliability::Extrapolated,
    }
}

/// Returns PV, RMS and the largest absolute value of the errors of the points in `set`, in mm. Returns zeros if `set`
/// is empty. `kind` is 0 for the errors of the distance from flat facets, and 1 for the errors of the distance from
/// curved facets.
fn error_figures(set: &[WithheldPoint], kind: usize) -> ErrorFigures {
    if set.is_empty() {
        return ErrorFigures::default();
    }
    let errors = set.iter().map(|m| m.errors_mm[kind]);
    let (low, high, sum) = errors
        .fold((f64::INFINITY, f64::NEG_INFINITY, 0.0), |(low, high, sum), e| (low.min(e), high.max(e), sum + e * e));
    ErrorFigures { pv_mm: high - low, rms_mm: (sum / set.len() as f64).sqrt(), max_mm: high.max(-low) }
}

impl ErrorFigures {
    /// Returns these figures multiplied by the factor `by`.
    fn scaled(self, by: f64) -> Self {
        Self { pv_mm: self.pv_mm * by, rms_mm: self.rms_mm * by, max_mm: self.max_mm * by }
    }
}
