//! Smooth height over a regular grid: bicubic between the nodes, with the slopes and second derivatives of the same
//! function.
//!
//! From values alone the field is the tensor product of cubic splines, twice continuously differentiable. From values
//! and slopes it is Hermite's bicubic, once continuously differentiable and exact in value and slope at every node.
//! Beyond the border the field continues along its tangents.

use rayon::prelude::*;

use crate::geometry::Grid;

/// Value and derivatives of a field at a place; lengths in millimetres.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Jet {
    /// Value of the field.
    pub value: f64,
    /// Slopes along x and y.
    pub slope: [f64; 2],
    /// Second derivatives: by x twice, by x and y, by y twice.
    pub second_derivatives: [f64; 3],
}

/// Smooth height over a regular grid.
#[derive(Clone, Debug)]
pub struct HeightField {
    grid: Grid,
    per_mm: [f64; 2],
    /// Value, slope along x, slope along y, and twist (mixed derivative) at every node. The unit of length along x and
    /// y is one cell.
    nodes: Vec<[f64; 4]>,
}

impl HeightField {
    /// Fits a bicubic spline through the heights `values`, in millimetres, one for each node of the grid `on`. At the
    /// border of the grid, the slope of the spline perpendicular to the border is 0.
    pub fn spline(on: Grid, values: &[f64]) -> Self {
        let Grid { columns, rows, .. } = on;
        let mut nodes: Vec<[f64; 4]> = values.iter().map(|v| [*v, 0.0, 0.0, 0.0]).collect();
        nodes.par_chunks_mut(columns).for_each(|row| {
            let slopes = spline_slopes(columns, |i| row[i][0]);
            row.iter_mut().zip(slopes).for_each(|(node, slope)| node[1] = slope);
        });
        for (of, to) in [(0, 2), (1, 3)] {
            let lines: Vec<Vec<f64>> =
                (0..columns).into_par_iter().map(|i| spline_slopes(rows, |j| nodes[j * columns + i][of])).collect();
            nodes.par_chunks_mut(columns).enumerate().for_each(|(j, row)| {
                row.iter_mut().zip(&lines).for_each(|(node, line)| node[to] = line[j]);
            });
        }
        Self::new(on, nodes)
    }

    /// Creates a height field by bicubic Hermite interpolation on the grid `on`. `values` holds the height of each
    /// node, in millimetres. `slopes` holds the slopes of each node along x and along y. The field has exactly these
    /// heights and slopes at the nodes.
    ///
    /// A height of NaN marks a node without a value. The height of such a node is extrapolated from neighbouring nodes.
    pub fn hermite(on: Grid, values: &[f64], slopes: &[[f64; 2]]) -> Self {
        let h = on.spacing_mm;
        let mut nodes: Vec<[f64; 4]> =
            values.iter().zip(slopes).map(|(v, s)| [*v, s[0] * h[0], s[1] * h[1], 0.0]).collect();
        fill(&mut nodes, on.columns, on.rows);
        twist(&mut nodes, on.columns, on.rows);
        Self::new(on, nodes)
    }

    fn new(on: Grid, nodes: Vec<[f64; 4]>) -> Self {
        Self { grid: on, per_mm: on.spacing_mm.map(|h| 1.0 / h), nodes }
    }

    /// Returns the field with `by` subtracted from every height.
    #[must_use]
    pub fn lowered(mut self, by: f64) -> Self {
        self.nodes.iter_mut().for_each(|node| node[0] -= by);
        self
    }

    /// Returns the field with the sign of every height reversed.
    #[must_use]
    pub fn mirrored(mut self) -> Self {
        self.nodes.par_iter_mut().for_each(|node| *node = node.map(|value| -value));
        self
    }

    /// Returns the node spacing along x and y, in millimetres.
    pub fn spacing_mm(&self) -> [f64; 2] {
        self.per_mm.map(|p| 1.0 / p)
    }

    /// Returns height, slopes and second derivatives of the field at the point `[x, y]`, in millimetres. Outside the
    /// grid the field is extrapolated linearly from the border.
    #[inline]
    pub fn at(&self, [x, y]: [f64; 2]) -> Jet {
        let (i, u, over_u) = cell((x - self.grid.first_mm[0]) * self.per_mm[0], self.grid.columns);
        let (j, v, over_v) = cell((y - self.grid.first_mm[1]) * self.per_mm[1], self.grid.rows);
        let mut jet = self.within(i, j, u, v);
        if over_u != 0.0 || over_v != 0.0 {
            continued(&mut jet, [over_u, over_v]);
        }
        let [a, b] = self.per_mm;
        jet.slope = [jet.slope[0] * a, jet.slope[1] * b];
        jet.second_derivatives =
            [jet.second_derivatives[0] * a * a, jet.second_derivatives[1] * a * b, jet.second_derivatives[2] * b * b];
        jet
    }

    /// Returns height and derivatives of the field at a point in the cell of column `i` and row `j`. `u` and `v` are
    /// the position of the point in the cell along x and along y, from 0 to 1. The derivatives are with respect to `u`
    /// and `v`, not to millimetres.
    #[inline]
    fn within(&self, i: usize, j: usize, u: f64, v: f64) -> Jet {
        let below = j * self.grid.columns + i;
        let above = below + self.grid.columns;
        let (low, high) = (&self.nodes[below..below + 2], &self.nodes[above..above + 2]);
        let across = HermiteBasis::new(u);
        // Along u on both rows: the height (a), and its slope across the rows (b).
        let (a0, b0) = (
            across.curve(low[0][0], low[0][1], low[1][0], low[1][1]),
            across.curve(low[0][2], low[0][3], low[1][2], low[1][3]),
        );
        let (a1, b1) = (
            across.curve(high[0][0], high[0][1], high[1][0], high[1][1]),
            across.curve(high[0][2], high[0][3], high[1][2], high[1][3]),
        );
        let up = HermiteBasis::new(v);
        let [value, by_v, by_vv] = up.curve(a0[0], b0[0], a1[0], b1[0]);
        let [by_u, by_uv, _] = up.curve(a0[1], b0[1], a1[1], b1[1]);
        let by_uu = up.value[0] * a0[2] + up.value[1] * b0[2] + up.value[2] * a1[2] + up.value[3] * b1[2];
        Jet { value, slope: [by_u, by_v], second_derivatives: [by_uu, by_uv, by_vv] }
    }
}

/// Finds the cell of a grid axis that contains the coordinate `at`. The axis has `nodes` nodes, at least 2. `at` is
/// measured from the first node, in units of the node spacing.
///
/// Returns the index of the cell, the position in the cell (0 to 1), and the signed distance beyond the border in units
/// of the node spacing. This distance is 0 inside the grid. For a coordinate outside, cell and position are those of
/// the nearest border.
#[inline]
fn cell(at: f64, nodes: usize) -> (usize, f64, f64) {
    let kept = at.clamp(0.0, (nodes - 1) as f64);
    let i = (kept as usize).min(nodes - 2);
    (i, kept - i as f64, at - kept)
}

/// Extrapolates `jet` (height and derivatives at the border of the grid) to a point outside the grid. `du` and `dv` are
/// the signed distances of the point beyond the border along x and y, in units of the node spacing. They are 0 along an
/// axis on which the point is inside. The extrapolation is linear along each axis and keeps the mixed derivative. The
/// second derivative along an extrapolated axis becomes 0.
#[cold]
fn continued(jet: &mut Jet, [du, dv]: [f64; 2]) {
    let ([su, sv], twist) = (jet.slope, jet.second_derivatives[1]);
    jet.value += su * du + sv * dv + twist * du * dv;
    jet.slope = [su + twist * dv, sv + twist * du];
    if du != 0.0 {
        jet.second_derivatives[0] = 0.0;
    }
    if dv != 0.0 {
        jet.second_derivatives[2] = 0.0;
    }
}

/// Four Hermite basis functions, in the order value at 0, slope at 0, value at 1, slope at 1, with their first and
/// second derivatives.
struct HermiteBasis {
    value: [f64; 4],
    slope: [f64; 4],
    second_derivatives: [f64; 4],
}

impl HermiteBasis {
    #[inline]
    fn new(t: f64) -> Self {
        let (t2, s) = (t * t, 1.0 - t);
        let far = t2 * (3.0 - 2.0 * t);
        let rise = 6.0 * t * s;
        Self {
            value: [1.0 - far, t * s * s, far, -t2 * s],
            slope: [-rise, s * (1.0 - 3.0 * t), rise, t * (3.0 * t - 2.0)],
            second_derivatives: [12.0 * t - 6.0, 6.0 * t - 4.0, 6.0 - 12.0 * t, 6.0 * t - 2.0],
        }
    }

    /// Evaluates a cubic polynomial on the interval 0 to 1 at the position for which this basis was built. Returns
    /// value, slope and second derivative. The cubic has the value `z0` and the slope `m0` at 0, and the value `z1` and
    /// the slope `m1` at 1.
    #[inline]
    fn curve(&self, z0: f64, m0: f64, z1: f64, m1: f64) -> [f64; 3] {
        let sum = |w: &[f64; 4]| w[0] * z0 + w[1] * m0 + w[2] * z1 + w[3] * m1;
        [sum(&self.value), sum(&self.slope), sum(&self.second_derivatives)]
    }
}

/// Computes the cubic spline through `count` equally spaced values. `value(i)` returns the value at node `i`. Returns
/// the slope at every node, as change per node spacing. The slopes at the first and at the last node are 0. The Thomas
/// algorithm solves the tridiagonal system.
fn spline_slopes(count: usize, value: impl Fn(usize) -> f64) -> Vec<f64> {
    // m[i-1] + 4 m[i] + m[i+1] = 3 (f[i+1] - f[i-1]), m[0] = m[n-1] = 0.
    let (mut slope, mut factor) = (vec![0.0; count], vec![0.0; count]);
    for i in 1..count.saturating_sub(1) {
        let pivot = 1.0 / (4.0 - factor[i - 1]);
        factor[i] = pivot;
        slope[i] = (3.0 * (value(i + 1) - value(i - 1)) - slope[i - 1]) * pivot;
    }
    for i in (1..count.saturating_sub(1)).rev() {
        slope[i] -= factor[i] * slope[i + 1];
    }
    slope
}

/// Extrapolates the nodes whose height is NaN, ring by ring outwards from the known nodes. A new height is the weighted
/// mean of linear extrapolations from the up to eight neighbours that have a value. Then the slopes of all new nodes
/// are set to differences of the heights. Nothing is changed if no node has a value.
fn fill(nodes: &mut [[f64; 4]], columns: usize, rows: usize) {
    let near = |k: usize| {
        let (i, j) = (k % columns, k / columns);
        (j.saturating_sub(1)..=(j + 1).min(rows - 1))
            .flat_map(move |b| (i.saturating_sub(1)..=(i + 1).min(columns - 1)).map(move |a| (a, b)))
            .map(move |(a, b)| (b * columns + a, i as f64 - a as f64, j as f64 - b as f64))
    };
    let mut open: Vec<usize> = (0..nodes.len()).filter(|&k| !nodes[k][0].is_finite()).collect();
    let filled = open.clone();
    while !open.is_empty() {
        let mut ring = Vec::new();
        open.retain(|&k| {
            let (mut sum, mut weight) = ([0.0; 4], 0.0);
            for (other, du, dv) in near(k) {
                let [z, zu, zv, _] = nodes[other];
                if z.is_finite() {
                    let w = 1.0 / (du * du + dv * dv);
                    sum = [sum[0] + w * (z + zu * du + zv * dv), sum[1] + w * zu, sum[2] + w * zv, 0.0];
                    weight += w;
                }
            }
            if weight > 0.0 {
                ring.push((k, sum.map(|s| s / weight)));
            }
            weight == 0.0
        });
        if ring.is_empty() {
            // No node has a value.
            return;
        }
        ring.into_iter().for_each(|(k, node)| nodes[k] = node);
    }
    // The slopes of the filled nodes are the differences of their heights.
    let heights: Vec<f64> = nodes.iter().map(|node| node[0]).collect();
    for k in filled {
        nodes[k][1] = difference(k % columns, columns, |i| heights[k - k % columns + i]);
        nodes[k][2] = difference(k / columns, rows, |j| heights[k % columns + j * columns]);
    }
}

/// Sets the twist (the mixed second derivative with respect to x and y) of every node. The twist is the mean of two
/// finite differences: the change of the x slope along y, and the change of the y slope along x.
fn twist(nodes: &mut [[f64; 4]], columns: usize, rows: usize) {
    let twists: Vec<f64> = (0..nodes.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|k| {
            let (i, j) = (k % columns, k / columns);
            let along = difference(j, rows, |b| nodes[b * columns + i][1]);
            let across = difference(i, columns, |a| nodes[j * columns + a][2]);
            0.5 * (along + across)
        })
        .collect();
    nodes.iter_mut().zip(twists).for_each(|(node, twist)| node[3] = twist);
}

/// Returns the finite-difference derivative at the index `at` of `count` equally spaced values, as change per step.
/// `value(i)` returns the value with the index `i`. The difference is central inside and one-sided at both ends, of
/// second order everywhere. With two values, returns their difference. With fewer, returns 0.
fn difference(at: usize, count: usize, value: impl Fn(usize) -> f64) -> f64 {
    match at {
        _ if count < 2 => 0.0,
        _ if count == 2 => value(1) - value(0),
        0 => -1.5 * value(0) + 2.0 * value(1) - 0.5 * value(2),
        _ if at == count - 1 => 1.5 * value(at) - 2.0 * value(at - 1) + 0.5 * value(at - 2),
        _ => 0.5 * (value(at + 1) - value(at - 1)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { columns: 41, rows: 31, first_mm: [-5.0, 2.0], spacing_mm: [0.25, 0.3] };

    fn places(on: Grid) -> Vec<[f64; 2]> {
        (0..on.len()).map(|k| on.place_mm(k)).collect()
    }

    fn derivatives_agree(field: &HeightField, place: [f64; 2]) {
        let h = 1e-4;
        let jet = field.at(place);
        let shifted = |dx: f64, dy: f64| field.at([place[0] + dx, place[1] + dy]);
        let (east, west, north, south) = (shifted(h, 0.0), shifted(-h, 0.0), shifted(0.0, h), shifted(0.0, -h));
        let slope = [(east.value - west.value) / (2.0 * h), (north.value - south.value) / (2.0 * h)];
        let bend = [
            (east.slope[0] - west.slope[0]) / (2.0 * h),
            (east.slope[1] - west.slope[1]) / (2.0 * h),
            (north.slope[1] - south.slope[1]) / (2.0 * h),
        ];
        for (given, found) in jet.slope.into_iter().zip(slope).chain(jet.second_derivatives.into_iter().zip(bend)) {
            assert!((given - found).abs() < 1e-6, "{place:?}: {given} against {found}");
        }
    }

    #[test]
    fn hermite_field_reproduces_bicubic() {
        // The x slope is at most quadratic in y, and the y slope at most quadratic in x: the twist by differences is
        // exact.
        let z = |x: f64, y: f64| {
            0.3 + 0.1 * x - 0.2 * y + 0.05 * x * y + 0.01 * x * x * y - 0.02 * x.powi(3) + 0.004 * y.powi(3)
        };
        let slope = |x: f64, y: f64| {
            [0.1 + 0.05 * y + 0.02 * x * y - 0.06 * x * x, -0.2 + 0.05 * x + 0.01 * x * x + 0.012 * y * y]
        };
        let values: Vec<f64> = places(GRID).into_iter().map(|[x, y]| z(x, y)).collect();
        let slopes: Vec<[f64; 2]> = places(GRID).into_iter().map(|[x, y]| slope(x, y)).collect();
        let field = HeightField::hermite(GRID, &values, &slopes);
        for [x, y] in [[-4.9, 2.05], [0.13, 7.77], [4.99, 10.9], [-5.0, 2.0]] {
            let jet = field.at([x, y]);
            assert!((jet.value - z(x, y)).abs() < 1e-12);
            assert!((jet.slope[0] - slope(x, y)[0]).abs() < 1e-11 && (jet.slope[1] - slope(x, y)[1]).abs() < 1e-11);
        }
        for place in [[-4.87, 2.05], [0.13, 7.77], [6.3, 5.01], [-6.1, 13.3]] {
            derivatives_agree(&field, place);
        }
    }

    #[test]
    fn spline_field_is_c2_and_interpolates() {
        let wave = |[x, y]: [f64; 2]| 5e-3 * (0.6 * x).sin() * (0.5 * y).cos();
        let values: Vec<f64> = places(GRID).into_iter().map(wave).collect();
        let field = HeightField::spline(GRID, &values);
        for (place, value) in places(GRID).into_iter().zip(&values) {
            assert!((field.at(place).value - value).abs() < 1e-15);
        }
        let ([x, y], e) = ([0.25, 5.0], 1e-9);
        for k in 0..3 {
            let (left, right) =
                (field.at([x - e, y - e]).second_derivatives[k], field.at([x + e, y + e]).second_derivatives[k]);
            assert!((left - right).abs() < 1e-9, "{left} {right}");
        }
        // Away from the border the error is of fourth order in the spacing. At the border the wave has a slope and the
        // spline has none.
        assert!((field.at([0.11, 6.66]).value - wave([0.11, 6.66])).abs() < 1e-7);
        derivatives_agree(&field, [1.03, 4.44]);
        assert_eq!(field.at([-5.0, 4.44]).slope[0], 0.0);
    }

    #[test]
    fn hermite_field_extrapolates_holes() {
        let z = |[x, y]: [f64; 2]| 0.02 * x * x - 0.01 * (y - 6.5) * (y - 6.5) + 0.1 * x;
        let slope = |[x, y]: [f64; 2]| [0.04 * x + 0.1, -0.02 * (y - 6.5)];
        let inside = |[x, y]: [f64; 2]| x.hypot(y - 6.5) < 3.5;
        let values: Vec<f64> = places(GRID).into_iter().map(|p| if inside(p) { z(p) } else { f64::NAN }).collect();
        let slopes: Vec<[f64; 2]> = places(GRID).into_iter().map(slope).collect();
        let field = HeightField::hermite(GRID, &values, &slopes);
        assert!((field.at([1.1, 7.0]).value - z([1.1, 7.0])).abs() < 1e-9);
        // Beyond the hole's edge the error is that of a tangent: half the curvature times the square of the distance.
        assert!((field.at([4.5, 6.5]).value - z([4.5, 6.5])).abs() < 0.02 * 1.3 * 1.3);
        assert!(places(GRID).into_iter().all(|p| field.at(p).slope[0].is_finite()));
        let none = HeightField::hermite(GRID, &vec![f64::NAN; 41 * 31], &slopes);
        assert!(none.at([0.0, 3.0]).value.is_nan());
    }

    #[test]
    fn spline_field_on_two_nodes() {
        let on = Grid { columns: 2, rows: 2, first_mm: [0.0, 0.0], spacing_mm: [10.0, 20.0] };
        let field = HeightField::spline(on, &[1.0, 1.0, 1.0, 1.0]);
        assert_eq!(field.at([3.0, 40.0]), Jet { value: 1.0, ..Jet::default() });
    }
}
