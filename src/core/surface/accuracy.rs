//! How exact distances to a nominal surface will be, found from its points alone (section 3.1 of the paper).
//!
//! Points are left out: two coarser samplings are made of what is kept, and the distance of the points left out from them is
//! measured. They lie on the surface, so that the distance is the error. The errors of the two samplings give the order p at which
//! the error falls with the spacing, and with it the error of the whole sampling and of any other.
//!
//! Of a grid every third and every sixth node is kept along each axis, and not every second: the points left out between
//! those lie on edges alone, where the curved distance is of a higher order than within the triangles.

use rayon::prelude::*;

use crate::geometry::grid_order::NO_POINT;
use crate::geometry::{Point, Vector, bounds, recognise_grid};

use super::error::SurfaceError;
use super::facet::Side;
use super::nominal::{Nominal, check_grid};
use super::normals::tangents;
use super::offset::{Distance, OffsetSurface, Place};
use super::projection::{Map, Projection, is_line};

/// The spacings of the two coarser samplings of a grid, in spacings of the whole one.
const OF_GRID: [usize; 2] = [3, 6];

/// One of so many scattered points is kept in the two coarser samplings: of many points, and of fewer than so many.
const OF_SCATTERED: [usize; 2] = [4, 16];
const OF_FEW: [usize; 2] = [2, 4];
const FEW: usize = 600;

/// The order that is believed of an observed one: below, something else than the spacing makes the error.
const ORDERS: [f64; 2] = [1.5, 4.5];

/// The orders of the two distances on a smooth surface, less what a form with features of many sizes takes away.
const LEAST_ORDER: [f64; 2] = [1.2, 1.8];

/// Left-out points that are measured at most.
const MEASURED: usize = 150_000;

/// A place counts as inside if the sampling goes on for that many of its spacings all around.
const BORDER: f64 = 2.0;

/// Places a sampling must have inside to be judged by.
const LEAST_INSIDE: usize = 30;

/// What a nominal surface is made of.
#[derive(Clone, Copy, Debug)]
pub enum Samples<'a> {
    /// Points in any order, a grid or scattered; also the vertices of a mesh.
    Points {
        /// The points in the model frame, in millimetres.
        points: &'a [Point],
        /// What scattered points are projected onto.
        projection: Projection,
    },
    /// A grid with known normals, row by row; NaN where there is no node.
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

/// How exact distances to a nominal surface are.
#[derive(Clone, Debug, PartialEq)]
pub struct Accuracy {
    /// Number of points.
    pub points: usize,
    /// Mean spacing of the points, in millimetres.
    pub spacing_mm: f64,
    /// Of the flat distance, eq. (2).
    pub flat: Estimate,
    /// Of the curved distance.
    pub curved: Estimate,
}

/// How exact one kind of distance is.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// Errors away from the border.
    pub inside: Figures,
    /// Errors within two spacings of the border of the sampling.
    pub border: Figures,
    /// Where the error is largest.
    pub worst: Worst,
    /// The order p that the estimate is made with: the error falls as the p-th power of the spacing.
    pub order: f64,
    /// The order as observed.
    pub observed_order: f64,
    /// How far the estimate may be trusted.
    pub trust: Trust,
    spacing_mm: f64,
    /// Spacing of the coarsest sampling looked at.
    coarsest_mm: f64,
}

/// Errors of a distance, in millimetres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    /// Largest less least.
    pub pv_mm: f64,
    /// Root mean square.
    pub rms_mm: f64,
    /// Largest in size.
    pub max_mm: f64,
}

/// The place of the largest error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Worst {
    /// Where, in the model frame.
    pub at: Point,
    /// How large, in millimetres; signed.
    pub error_mm: f64,
    /// Whether it lies within two spacings of the border of the sampling.
    pub near_border: bool,
}

/// How far an estimate may be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trust {
    /// The error falls with the spacing as it should.
    Extrapolated,
    /// The error hardly falls: the points are rounded or scatter, and the estimate is what they scatter by.
    Rounding,
    /// The coarser samplings are too coarse for the features of the surface: the estimate is a guess.
    TooCoarse,
}

impl Estimate {
    /// Returns the spacing at which the PV error inside is a wanted one, in millimetres; `None` where no spacing brings it
    /// because the points are not exact enough. It is never coarser than the coarsest sampling that was looked at.
    pub fn spacing_for(&self, wanted_pv_mm: f64) -> Option<f64> {
        if self.trust == Trust::Rounding {
            return (self.inside.pv_mm <= wanted_pv_mm).then_some(self.spacing_mm);
        }
        let ratio = wanted_pv_mm / self.inside.pv_mm.max(f64::MIN_POSITIVE);
        Some((self.spacing_mm * ratio.powf(1.0 / self.order)).min(self.coarsest_mm))
    }
}

/// Estimates how exact distances to the surface through some points are.
///
/// Frame: model. Units: millimetres.
///
/// # Errors
/// Points that make no surface, and fewer than it takes to leave most of them out.
pub fn accuracy(samples: Samples) -> Result<Accuracy, SurfaceError> {
    let (points, [factor, coarsest], [mut fine, mut coarse]) = match samples {
        Samples::Grid { columns, rows, points, normals } => {
            check_grid(columns, rows, points.len().min(normals.len()))?;
            let level = |stride| defined_grid_level(columns, rows, points, normals, stride);
            (points, OF_GRID.map(|stride| stride as f64), [level(OF_GRID[0])?, level(OF_GRID[1])?])
        }
        Samples::Points { points, projection } => {
            // Whatever is wrong with the points is said of all of them, not of those that happen to be kept.
            if let Some(index) = points.iter().position(|p| !(p.x + p.y + p.z).is_finite()) {
                return Err(SurfaceError::NotFinite { index });
            }
            let (factors, kept) = kept_of_points(points, projection)?;
            (points, factors, [kept_level(points, &kept[0], projection)?, kept_level(points, &kept[1], projection)?])
        }
    };
    let count = points.iter().filter(|p| p.x.is_finite()).count();
    let least = count.max(1).saturating_mul(4);
    let is_border = [&fine, &coarse].iter().any(|errors| errors.inside.len() < LEAST_INSIDE);
    if is_border {
        // A few points are all near the border, so the estimate takes the border in.
        [&mut fine, &mut coarse].into_iter().for_each(Errors::take_the_border_in);
    }
    if [&fine, &coarse].iter().any(|errors| errors.inside.len() < LEAST_INSIDE) {
        return Err(SurfaceError::TooFewPoints { points: count, least });
    }
    let spacing_mm = fine.spacing_mm / factor;
    let [flat, curved] = [0, 1].map(|kind| {
        let told = estimate(&fine, &coarse, kind, [factor, coarsest / factor], spacing_mm);
        let trust = if is_border && told.trust == Trust::Extrapolated { Trust::TooCoarse } else { told.trust };
        Estimate { trust, ..told }
    });
    Ok(Accuracy { points: count, spacing_mm, flat, curved })
}

/// Errors measured at the points that a coarser sampling leaves out.
struct Errors {
    inside: Vec<Measured>,
    border: Vec<Measured>,
    /// Mean spacing of the coarser sampling, in millimetres.
    spacing_mm: f64,
}

impl Errors {
    fn take_the_border_in(&mut self) {
        self.inside.append(&mut self.border);
    }
}

/// A point left out: its error by the flat and by the curved distance.
struct Measured {
    at: Point,
    errors_mm: [f64; 2],
}

/// Every n-th node along both axes, with the normals of the whole grid.
fn defined_grid_level(
    columns: usize,
    rows: usize,
    points: &[Point],
    normals: &[Vector],
    stride: usize,
) -> Result<Errors, SurfaceError> {
    let nodes: Vec<usize> = coarse_nodes(columns, rows, stride).collect();
    let (coarse_columns, coarse_rows) = ((columns - 1) / stride + 1, (rows - 1) / stride + 1);
    let coarse_points = nodes.iter().map(|&n| points[n]).collect();
    let coarse_normals = nodes.iter().map(|&n| normals[n]).collect();
    let coarse = Nominal::from_grid_with_normals(coarse_columns, coarse_rows, coarse_points, coarse_normals)?;
    let mut left_out = vec![true; points.len()];
    nodes.iter().for_each(|&n| left_out[n] = false);
    Ok(measure(&coarse, points, &left_out))
}

/// The nodes that stay when every n-th is kept along both axes.
fn coarse_nodes(columns: usize, rows: usize, stride: usize) -> impl Iterator<Item = usize> {
    (0..rows).step_by(stride).flat_map(move |j| (0..columns).step_by(stride).map(move |i| j * columns + i))
}

/// Chooses what to keep for the two coarser samplings; returns their spacings in spacings of the whole sampling.
fn kept_of_points(points: &[Point], projection: Projection) -> Result<([f64; 2], [Vec<u32>; 2]), SurfaceError> {
    let on_plane = matches!(projection, Projection::Auto | Projection::Xy);
    if let Some(order) = recognise_grid(points).filter(|_| on_plane) {
        let kept = OF_GRID.map(|stride| {
            let nodes = coarse_nodes(order.columns, order.rows, stride).map(|node| order.point_at[node]);
            nodes.filter(|&point| point != NO_POINT).collect()
        });
        return Ok((OF_GRID.map(|stride| stride as f64), kept));
    }
    if points.len() < 9 {
        return Err(SurfaceError::TooFewPoints { points: points.len(), least: 9 });
    }
    if is_line(points) {
        return Err(SurfaceError::Collinear { points: points.len() });
    }
    let (_, map) = projection.prepare(points)?;
    let order = along_the_plane(points, &map);
    let of = if points.len() < FEW { OF_FEW } else { OF_SCATTERED };
    let every = |one_of: usize| order.iter().copied().skip(one_of.isqrt() / 2).step_by(one_of).collect();
    Ok((of.map(|one_of| (one_of as f64).sqrt()), of.map(every)))
}

/// Puts points in the order of Morton's curve through the plane of a projection: neighbours in it are neighbours there, so
/// that every fourth is a quarter of them well spread.
fn along_the_plane(points: &[Point], map: &Map) -> Vec<u32> {
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

/// The sampling of the points that are kept, its normals fitted as those of the whole sampling are.
fn kept_level(points: &[Point], kept: &[u32], projection: Projection) -> Result<Errors, SurfaceError> {
    let coarse = Nominal::from_points(kept.iter().map(|&k| points[k as usize]).collect(), projection)?;
    let mut left_out = vec![true; points.len()];
    kept.iter().for_each(|&k| left_out[k as usize] = false);
    Ok(measure(&coarse, points, &left_out))
}

/// Measures the distances of points left out from a coarser sampling.
fn measure(coarse: &Nominal, points: &[Point], left_out: &[bool]) -> Errors {
    let surface = OffsetSurface::new(coarse, 0.0, Side::Normal).expect("a radius of 0 is one");
    let (flat, curved) = (surface.with_distance(Distance::Triangle), surface.with_distance(Distance::Curved));
    // An odd stride that divides no common number of columns.
    let stride = (points.len() / MEASURED) | 1;
    let one = |k: usize| {
        let at = points[k];
        let foot = curved.foot(&at, Place::UNKNOWN);
        if foot.beyond_mm > 0.0 {
            return None;
        }
        let errors_mm = [flat.foot(&at, foot.place).distance_mm, foot.distance_mm];
        let spacing_mm = curved.spacing_mm(foot.place);
        let reach = BORDER * spacing_mm;
        let [u, v] = tangents(&foot.normal);
        let around = (0..8).map(|k| std::f64::consts::FRAC_PI_4 * f64::from(k)).map(|a| u * a.cos() + v * a.sin());
        let inside = around.into_iter().all(|d| curved.foot(&(at + d * reach), foot.place).beyond_mm == 0.0);
        Some((inside, spacing_mm, Measured { at, errors_mm }))
    };
    let chosen = (0..points.len()).into_par_iter().step_by(stride);
    let measured: Vec<_> = chosen.filter(|&k| left_out[k] && points[k].x.is_finite()).filter_map(one).collect();
    let spacing_mm = measured.iter().map(|m| m.1).sum::<f64>() / measured.len().max(1) as f64;
    let (inside, border): (Vec<_>, Vec<_>) = measured.into_iter().partition(|m| m.0);
    let strip = |set: Vec<(bool, f64, Measured)>| set.into_iter().map(|m| m.2).collect();
    Errors { inside: strip(inside), border: strip(border), spacing_mm }
}

/// Extrapolates from two coarser samplings to the whole one.
fn estimate(fine: &Errors, coarse: &Errors, kind: usize, [factor, step]: [f64; 2], spacing_mm: f64) -> Estimate {
    let [inside_fine, inside_coarse] = [fine, coarse].map(|errors| figures(&errors.inside, kind));
    let [border_fine, border_coarse] = [fine, coarse].map(|errors| figures(&errors.border, kind));
    let observed_order = observed(&inside_fine, &inside_coarse, step);
    let trust = trust(observed_order, LEAST_ORDER[kind], inside_fine.rms_mm, spacing_mm);
    let order = observed_order.clamp(ORDERS[0], ORDERS[1]);
    let scale = |order: f64| if trust == Trust::Rounding { 1.0 } else { factor.powf(-order) };
    let (inside_scale, border_scale) =
        (scale(order), scale(observed(&border_fine, &border_coarse, step).clamp(ORDERS[0], ORDERS[1])));
    let worst = |set: &[Measured], scale: f64, near_border: bool| {
        let largest = set.iter().max_by(|a, b| a.errors_mm[kind].abs().total_cmp(&b.errors_mm[kind].abs()));
        largest.map(|m| Worst { at: m.at, error_mm: m.errors_mm[kind] * scale, near_border })
    };
    let inside_worst = worst(&fine.inside, inside_scale, false).expect("there are places inside");
    let worst = match worst(&fine.border, border_scale, true) {
        Some(at_border) if at_border.error_mm.abs() > inside_worst.error_mm.abs() => at_border,
        _ => inside_worst,
    };
    Estimate {
        inside: inside_fine.scaled(inside_scale),
        border: border_fine.scaled(border_scale),
        worst,
        order,
        observed_order,
        trust,
        spacing_mm,
        coarsest_mm: coarse.spacing_mm,
    }
}

/// The order at which the error fell from one sampling to the next, whose spacing is so many times as small.
fn observed(fine: &Figures, coarse: &Figures, step: f64) -> f64 {
    let ratio = coarse.rms_mm / fine.rms_mm;
    if ratio > 0.0 && ratio.is_finite() { ratio.log2() / step.log2() } else { ORDERS[0] }
}

fn trust(observed_order: f64, least: f64, rms_mm: f64, spacing_mm: f64) -> Trust {
    /// Rounding and scatter tilt the surface by less than this; features between the points by more.
    const LARGEST_TILT: f64 = 1e-4;
    /// The arithmetic itself is no more exact on a part of a metre.
    const EXACT_MM: f64 = 1e-11;
    match observed_order {
        _ if rms_mm < EXACT_MM => Trust::Extrapolated,
        p if p < least && rms_mm < LARGEST_TILT * spacing_mm => Trust::Rounding,
        p if p < least || p > ORDERS[1] + 0.5 => Trust::TooCoarse,
        _ => Trust::Extrapolated,
    }
}

fn figures(set: &[Measured], kind: usize) -> Figures {
    if set.is_empty() {
        return Figures::default();
    }
    let errors = set.iter().map(|m| m.errors_mm[kind]);
    let (low, high, sum) = errors
        .fold((f64::INFINITY, f64::NEG_INFINITY, 0.0), |(low, high, sum), e| (low.min(e), high.max(e), sum + e * e));
    Figures { pv_mm: high - low, rms_mm: (sum / set.len() as f64).sqrt(), max_mm: high.max(-low) }
}

impl Figures {
    fn scaled(self, by: f64) -> Self {
        Self { pv_mm: self.pv_mm * by, rms_mm: self.rms_mm * by, max_mm: self.max_mm * by }
    }
}
