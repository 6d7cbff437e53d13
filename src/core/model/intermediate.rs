//! Places between the touched ones: those nodes of a grid that touched places surround.
//!
//! A node without a touched place within [`MAX_DISTANCE_SPACINGS`] spacings of the points on some side lies in an
//! untouched area, or beyond the edge.

use nalgebra::DMatrix;

use super::basis::{Basis, BasisGrid};
use super::spacing_mm;
use crate::geometry::{Point, PointTree, bounds};

/// Maximum number of nodes of the grid, and number of nodes per spacing of the touched points within this maximum.
const MAX_NODES: f64 = 3000.0;
const NODES_PER_SPACING: f64 = 2.0;
/// Maximum degree of the polynomials that interpolate a smooth column between the points.
const MAX_DEGREE: usize = 9;
/// Distance, in spacings of the points, within which touched places must surround a node.
const MAX_DISTANCE_SPACINGS: f64 = 2.5;

/// Nodes of a grid, each between touched places.
pub(super) struct IntermediateNodes {
    pub(super) grid: BasisGrid,
    /// Index of each node on the grid.
    pub(super) nodes: Vec<usize>,
    /// Indices of three touched places near each node, and their weights.
    corners: Vec<([usize; 3], [f64; 3])>,
    /// Polynomials at the touched places and at the nodes.
    terms: [DMatrix<f64>; 2],
}

impl IntermediateNodes {
    /// Lays a regular grid over the touched `places`, and keeps only the nodes that have touched places near them on
    /// all sides. `places` are x and y in the plane of projection, in mm. The grid is parallel to the axes u and v of
    /// `waves` (the basis functions of the form).
    ///
    /// Returns `None` if no node is kept, or if the bounding rectangle of the places along u and v has no area.
    pub(super) fn new(places: &[[f64; 2]], waves: &Basis) -> Option<Self> {
        let places: Vec<[f64; 2]> = places.iter().map(|&place| waves.anisotropy.rotated(place)).collect();
        let distance_mm = spacing_mm(&places);
        let [low, high] = bounds(places.iter().copied());
        let spans_mm = [0, 1].map(|axis| high[axis] - low[axis]);
        let area_mm2 = spans_mm[0] * spans_mm[1];
        let spacing_mm = (distance_mm / NODES_PER_SPACING).max((area_mm2 / MAX_NODES).sqrt());
        if !(area_mm2 > 0.0 && spacing_mm > 0.0 && spacing_mm.is_finite()) {
            return None;
        }
        let counts = spans_mm.map(|span_mm| (span_mm / spacing_mm) as usize + 1);
        let corner_mm =
            [0, 1].map(|axis: usize| 0.5 * (low[axis] + high[axis] - spacing_mm * (counts[axis] - 1) as f64));
        let grid = BasisGrid { corner_mm, spacing_mm, counts };
        let tree = PointTree::new(places.iter().map(|&[x, y]| Point::new(x, y, 0.0)));
        let beside = |node: usize| {
            Some((node, surrounding_places(grid.place(node), &places, &tree, MAX_DISTANCE_SPACINGS * distance_mm)?))
        };
        let (nodes, corners): (Vec<usize>, Vec<_>) = (0..counts[0] * counts[1]).filter_map(beside).unzip();
        if nodes.is_empty() {
            return None;
        }
        let degree = (0..MAX_DEGREE).take_while(|degree| 3 * (degree + 2) * (degree + 3) / 2 <= places.len()).count();
        let at_nodes: Vec<[f64; 2]> = nodes.iter().map(|&node| grid.place(node)).collect();
        let terms = [&places, &at_nodes].map(|places| polynomials(places, [low, high], degree));
        Some(Self { grid, nodes, corners, terms })
    }

    /// Interpolates values from the touched places to the nodes of the grid. `columns` has one row for each touched
    /// place. The result has one row for each node and the same number of columns.
    ///
    /// Polynomials are first fitted to the columns. The residuals of this fit are interpolated by weighted means of
    /// three nearby touched places.
    ///
    /// The columns can contain motions of a curved part that are thousands of times larger than the form. For such
    /// columns, the error of an interpolation without polynomials would be too large.
    pub(super) fn interpolate(&self, columns: &DMatrix<f64>) -> DMatrix<f64> {
        let [at_points, at_nodes] = &self.terms;
        let factor = at_points.clone().qr();
        let fitted = factor.r().solve_upper_triangular(&factor.q().tr_mul(columns));
        let fitted = fitted.unwrap_or_else(|| DMatrix::zeros(at_points.ncols(), columns.ncols()));
        let left = columns - at_points * &fitted;
        let between = DMatrix::from_fn(self.nodes.len(), columns.ncols(), |r, c| {
            let (corners, shares) = self.corners[r];
            (0..3).map(|k| shares[k] * left[(corners[k], c)]).sum()
        });
        at_nodes * fitted + between
    }
}

/// Returns the indices of the three touched places nearest to the position `at`, and their weights for an
/// interpolation. The weights are the inverse squared distances, scaled to the sum 1. If `at` is itself a touched
/// place, this place has the weight 1.
///
/// `places` are the touched places in mm, and `tree` is their search tree. `near_mm` is the largest distance of a
/// touched place that counts as near. Returns `None` if the near places do not surround `at`.
fn surrounding_places(
    at: [f64; 2],
    places: &[[f64; 2]],
    tree: &PointTree,
    near_mm: f64,
) -> Option<([usize; 3], [f64; 3])> {
    const CANDIDATES: u32 = 12;
    let near: Vec<(usize, f64)> = tree.nearest(&Point::new(at[0], at[1], 0.0), CANDIDATES).collect();
    let mut angles: Vec<f64> = Vec::new();
    for (k, square) in &near {
        // The place is itself a touched one.
        if *square < 1e-12 * near_mm * near_mm {
            return Some(([*k; 3], [1.0, 0.0, 0.0]));
        }
        if *square <= near_mm * near_mm {
            angles.push((places[*k][1] - at[1]).atan2(places[*k][0] - at[0]));
        }
    }
    angles.sort_unstable_by(f64::total_cmp);
    let around = angles.first().map(|first| first + std::f64::consts::TAU);
    let widest = angles.iter().zip(angles.iter().skip(1).copied().chain(around)).map(|(a, b)| b - a);
    if angles.len() < 3 || widest.fold(0.0, f64::max) > std::f64::consts::PI + 1e-9 {
        return None;
    }
    let whole: f64 = near[..3].iter().map(|(_, square)| square.recip()).sum();
    Some(([0, 1, 2].map(|k| near[k].0), [0, 1, 2].map(|k| near[k].1.recip() / whole)))
}

/// Evaluates the products of Chebyshev polynomials of x and y, up to the total degree `degree`, at `places`. The
/// rectangle from `low` to `high` is their domain. Returns one row for each place, one column for each product.
fn polynomials(places: &[[f64; 2]], [low, high]: [[f64; 2]; 2], degree: usize) -> DMatrix<f64> {
    let orders: Vec<[usize; 2]> = (0..=degree).flat_map(|a| (0..=degree - a).map(move |b| [a, b])).collect();
    let along = |place: &[f64; 2], axis: usize| {
        ((2.0 * place[axis] - low[axis] - high[axis]) / (high[axis] - low[axis])).clamp(-1.0, 1.0).acos()
    };
    let angles: Vec<[f64; 2]> = places.iter().map(|place| [along(place, 0), along(place, 1)]).collect();
    DMatrix::from_fn(places.len(), orders.len(), |r, c| {
        let [a, b] = orders[c];
        (a as f64 * angles[r][0]).cos() * (b as f64 * angles[r][1]).cos()
    })
}

#[cfg(test)]
mod tests {
    use super::super::Anisotropy;
    use super::*;

    fn over(places: &[[f64; 2]]) -> Option<IntermediateNodes> {
        IntermediateNodes::new(places, &Basis::over(places, Anisotropy::NONE, 100, 0))
    }

    #[test]
    fn intermediate_rows_reproduce_plane() {
        let places: Vec<[f64; 2]> = (0..96).map(|k| [4.0 * f64::from(k % 12), 3.0 * f64::from(k / 12)]).collect();
        let between = over(&places).unwrap();
        assert!(between.nodes.len() > 3 * places.len() / 2 && between.nodes.len() < 6 * places.len());
        let tilted = DMatrix::from_fn(96, 2, |r, c| [1.0, 0.3 * places[r][0] - 0.7 * places[r][1]][c]);
        let rows = between.interpolate(&tilted);
        for (r, node) in between.nodes.iter().enumerate() {
            let [x, y] = between.grid.place(*node);
            assert!((rows[(r, 0)] - 1.0).abs() < 1e-12 && (rows[(r, 1)] - 0.3 * x + 0.7 * y).abs() < 1e-9);
        }
    }

    #[test]
    fn intermediate_rows_of_curved_column() {
        let places: Vec<[f64; 2]> = (0..400).map(|k| [4.0 * f64::from(k % 20), 3.0 * f64::from(k / 20)]).collect();
        let between = over(&places).unwrap();
        let bent = |x: f64, y: f64| (0.03 * x).sin() + 1e-3 * x * y + (0.02 * y).cos();
        let rows = between.interpolate(&DMatrix::from_fn(400, 1, |r, _| bent(places[r][0], places[r][1])));
        let off = between.nodes.iter().enumerate().map(|(r, node)| {
            let [x, y] = between.grid.place(*node);
            (rows[(r, 0)] - bent(x, y)).abs()
        });
        // Linear interpolation between two places would be wrong by 4^2 / 8 * 0.03^2, about 2e-3.
        let most = off.fold(0.0, f64::max);
        assert!(most < 1e-6, "{most}");
    }

    #[test]
    fn intermediate_skips_unmeasured_area() {
        let all = (0..900).map(|k| [2.0 * f64::from(k % 30), 2.0 * f64::from(k / 30)]);
        let places: Vec<[f64; 2]> = all.filter(|[x, y]| *x < 30.0 || *y < 30.0).collect();
        let between = over(&places).unwrap();
        let inside = between.nodes.iter().map(|&node| between.grid.place(node)).filter(|[x, y]| *x > 36.0 && *y > 36.0);
        assert_eq!(inside.count(), 0);
        assert!(over(&[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 0.0]]).is_none());
    }
}
