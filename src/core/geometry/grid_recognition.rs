//! Recognition of regular grids among points in any order.

use rayon::prelude::*;

use super::Point;

/// Largest distance of a point from its node, in spacings: rounding in a file is far below it, scattered points are far
/// above.
const NODE_TOLERANCE: f64 = 0.02;

/// Marks a node that has no point.
pub const NO_POINT: u32 = u32::MAX;

/// Point cloud that is a regular grid over x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct GriddedCloud {
    /// Number of nodes along x.
    pub columns: usize,
    /// Number of nodes along y.
    pub rows: usize,
    /// Index of the point at each node, row by row with x fastest; [`NO_POINT`] if there is none.
    pub point_indices: Vec<u32>,
    /// Number of nodes without a point.
    pub holes: usize,
}

impl GriddedCloud {
    /// Returns true if the points are stored in the order of the nodes (row by row, x fastest), and every node has a
    /// point.
    pub(crate) fn is_ordered(&self) -> bool {
        self.holes == 0 && self.point_indices.iter().enumerate().all(|(node, &point)| node as u32 == point)
    }
}

/// Point cloud in grid order: row by row, x fastest, without a hole.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct OrderedGrid {
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    /// Lower and upper corner of the grid: x and y of the first and of the last node.
    pub(crate) corners: [[f64; 2]; 2],
}

/// Maximum difference in x between a point and its column, and in y between a point and its row, as a share of the
/// extent. A smaller difference is rounding.
const COLUMN_TOLERANCE: f64 = 5e-7;

/// Recognises a complete regular grid of at least 3 by 3 points that are stored row by row, x fastest. Returns `None`
/// for all other points.
///
/// This is a fast case of [`recognise_grid`], in one pass and without a copy of the points. [`recognise_grid`] also
/// recognises grids in another order and grids with holes.
pub(crate) fn recognise_ordered_grid(points: &[Point]) -> Option<OrderedGrid> {
    let columns = 1 + points.windows(2).take_while(|pair| pair[1].x > pair[0].x).count();
    let rows = points.len() / columns;
    if columns < 3 || rows < 3 || columns * rows != points.len() || points.len() >= NO_POINT as usize {
        return None;
    }
    let first = &points[..columns];
    let column: Vec<f64> = first.iter().map(|p| p.x).collect();
    let row: Vec<f64> = points.iter().step_by(columns).map(|p| p.y).collect();
    if !(is_even(&column) && is_even(&row)) {
        return None;
    }
    let near = |from: f64, to: f64| COLUMN_TOLERANCE * (to - from);
    let (near_x, near_y) = (near(column[0], column[columns - 1]), near(row[0], row[rows - 1]));
    let holds = |(line, y): (&[Point], &f64)| {
        // No early exit in the loop: a line is short, and so the compiler can process several points at a time.
        line.iter()
            .zip(&column)
            .fold(true, |all, (p, x)| all & ((p.x - x).abs() <= near_x) & ((p.y - y).abs() <= near_y) & p.z.is_finite())
    };
    points.par_chunks(columns).zip(&row).with_min_len(16).all(holds).then(|| OrderedGrid {
        columns,
        rows,
        corners: [[column[0], row[0]], [column[columns - 1], row[rows - 1]]],
    })
}

/// Returns true if the coordinates `at` rise in equal steps, within [`NODE_TOLERANCE`] of a step.
fn is_even(at: &[f64]) -> bool {
    let step = (at[at.len() - 1] - at[0]) / (at.len() - 1) as f64;
    step > 0.0
        && step.is_finite()
        && at.iter().enumerate().all(|(k, c)| (c - at[0] - k as f64 * step).abs() <= NODE_TOLERANCE * step)
}

/// Recognises a regular grid in x and y, whatever the order of the points and even if nodes are missing. Returns the
/// index of the point at each node.
///
/// Returns `None` if the points do not lie on a grid of at least 3 by 3 nodes, if two points lie at one node, if there
/// are more than 4 nodes for each point (such a grid may be a coincidence), or if a coordinate is not finite.
pub fn recognise_grid(points: &[Point]) -> Option<GriddedCloud> {
    if points.len() < 9 || points.len() >= NO_POINT as usize {
        return None;
    }
    let x = UniformAxis::find(points, |p| p.x)?;
    let y = UniformAxis::find(points, |p| p.y)?;
    let nodes = x.count.checked_mul(y.count)?;
    if x.count < 3 || y.count < 3 || nodes > 4 * points.len() {
        return None;
    }
    let node_of = |p: &Point| Some(y.node(p.y)? as u32 * x.count as u32 + x.node(p.x)? as u32);
    let node_of: Vec<u32> = points.par_iter().with_min_len(8192).map(node_of).collect::<Option<_>>()?;
    let mut point_at = vec![NO_POINT; nodes];
    for (index, node) in node_of.into_iter().enumerate() {
        if std::mem::replace(&mut point_at[node as usize], index as u32) != NO_POINT {
            return None;
        }
    }
    Some(GriddedCloud { columns: x.count, rows: y.count, point_indices: point_at, holes: nodes - points.len() })
}

/// Equally spaced coordinates along one axis.
struct UniformAxis {
    first: f64,
    per_mm: f64,
    count: usize,
}

impl UniformAxis {
    /// Finds the first coordinate, the spacing and the number of equally spaced nodes along one axis. `coordinate`
    /// returns the x or the y of a point.
    ///
    /// The spacing is the smallest gap between the sorted coordinates of a sample of the points. Returns `None` if a
    /// coordinate is not finite, if all coordinates are equal, or if the spacing divides their extent into 60,000 steps
    /// or more.
    fn find(points: &[Point], coordinate: impl Fn(&Point) -> f64 + Sync) -> Option<Self> {
        let (low, high) = points
            .par_chunks(8192)
            .map(|chunk| {
                chunk.iter().map(&coordinate).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), c| {
                    if (c + low).is_nan() { (f64::NAN, f64::NAN) } else { (low.min(c), high.max(c)) }
                })
            })
            .reduce(
                || (f64::INFINITY, f64::NEG_INFINITY),
                |a, b| if (a.0 + b.0).is_nan() { (f64::NAN, f64::NAN) } else { (a.0.min(b.0), a.1.max(b.1)) },
            );
        let extent = high - low;
        if !extent.is_finite() || extent <= 0.0 {
            return None;
        }
        let mut sample = sampled(points).map(&coordinate).collect::<Vec<_>>();
        sample.sort_unstable_by(f64::total_cmp);
        let gap = sample.windows(2).map(|w| w[1] - w[0]).filter(|gap| *gap > 1e-6 * extent).fold(extent, f64::min);
        let steps = (extent / gap).round();
        (steps < 6e4).then_some(Self { first: low, per_mm: steps / extent, count: steps as usize + 1 })
    }

    /// Returns the index of the node at `coordinate`; `None` if the coordinate is more than [`NODE_TOLERANCE`] spacings
    /// from every node.
    #[inline]
    fn node(&self, coordinate: f64) -> Option<usize> {
        let at = (coordinate - self.first) * self.per_mm;
        // `at` is never negative, so that truncation is the floor.
        let node = (at + 0.5) as u32;
        ((at - f64::from(node)).abs() <= NODE_TOLERANCE).then_some(node as usize)
    }
}

/// Returns the first 4096 points, followed by a sample of up to 4096 points spread over all points. In a grid in row
/// order, neighbouring nodes are among the first points; in a shuffled grid, they are in the spread sample.
fn sampled(points: &[Point]) -> impl Iterator<Item = &Point> {
    const SAMPLE: usize = 4096;
    let n = points.len();
    let scattered = (0..SAMPLE.min(n) as u64).map(move |k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) % n as u64) as usize);
    points.iter().take(SAMPLE).chain(scattered.map(|i| &points[i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(columns: usize, rows: usize, dx: f64, dy: f64) -> Vec<Point> {
        (0..rows)
            .flat_map(|j| {
                (0..columns).map(move |i| Point::new(i as f64 * dx - 7.3, j as f64 * dy + 1.1, (i * j) as f64))
            })
            .collect()
    }

    /// Returns the points in a fixed shuffle: multiplication by a number coprime to the length.
    fn shuffled(points: &[Point]) -> Vec<Point> {
        let n = points.len();
        let step = (n / 3..).find(|s| num_gcd(*s, n) == 1).unwrap();
        (0..n).map(|i| points[(i * step + 5) % n]).collect()
    }

    fn num_gcd(a: usize, b: usize) -> usize {
        if b == 0 { a } else { num_gcd(b, a % b) }
    }

    #[test]
    fn recognise_grid_of_shuffled_points() {
        let points = grid(101, 57, 0.1133, 0.124);
        let order = recognise_grid(&points).unwrap();
        assert_eq!((order.columns, order.rows, order.holes), (101, 57, 0));
        assert!(order.is_ordered());
        let found = recognise_ordered_grid(&points).unwrap();
        assert_eq!((found.columns, found.rows), (101, 57));
        assert_eq!(found.corners, [[points[0].x, points[0].y], [points[101 * 57 - 1].x, points[101 * 57 - 1].y]]);

        let mixed = shuffled(&points);
        assert_eq!(recognise_ordered_grid(&mixed), None);
        let order = recognise_grid(&mixed).unwrap();
        assert!(!order.is_ordered());
        for (node, &index) in order.point_indices.iter().enumerate() {
            assert_eq!(mixed[index as usize], points[node]);
        }
    }

    #[test]
    fn recognise_grid_columns_first() {
        let mut points = grid(40, 30, 1.0, 2.0);
        points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        let order = recognise_grid(&points).unwrap();
        assert_eq!((order.columns, order.rows), (40, 30));
    }

    #[test]
    fn recognise_grid_with_holes() {
        let points: Vec<_> =
            grid(81, 81, 0.5, 0.5).into_iter().filter(|p| (p.x - 12.7).hypot(p.y - 21.1) <= 20.001).collect();
        let order = recognise_grid(&points).unwrap();
        assert_eq!((order.columns, order.rows), (81, 81));
        assert_eq!(order.holes, 81 * 81 - points.len());
    }

    #[test]
    fn recognise_grid_of_rounded_points() {
        let mut points = grid(333, 222, 102.0 / 332.0, 62.0 / 221.0);
        for p in &mut points {
            p.x = (p.x * 1e4).round() / 1e4;
            p.y = (p.y * 1e4).round() / 1e4;
        }
        assert!(recognise_grid(&points).is_some() && recognise_ordered_grid(&points).is_some());
        // Spoiled grids: a point out of its column, one out of its row, one missing, one not finite.
        for spoil in [
            |p: &mut Vec<Point>| p[5000].x += 0.003,
            |p: &mut Vec<Point>| p[5000].y -= 0.003,
            |p: &mut Vec<Point>| p.truncate(333 * 222 - 1),
            |p: &mut Vec<Point>| p[5000].z = f64::NAN,
        ] {
            let mut spoilt = points.clone();
            spoil(&mut spoilt);
            assert_eq!(recognise_ordered_grid(&spoilt), None);
        }
    }

    #[test]
    fn recognise_grid_refuses_non_grids() {
        let mut scattered = grid(50, 50, 1.0, 1.0);
        for (k, p) in scattered.iter_mut().enumerate() {
            p.x += 0.3 * (k as f64 * 1.7).sin();
        }
        assert_eq!(recognise_grid(&scattered), None);
        let line: Vec<_> = (0..100).map(|i| Point::new(f64::from(i), 0.0, 0.0)).collect();
        assert_eq!(recognise_grid(&line), None);
        let mut doubled = grid(10, 10, 1.0, 1.0);
        doubled.push(doubled[17]);
        assert_eq!(recognise_grid(&doubled), None);
        let mut broken = grid(10, 10, 1.0, 1.0);
        broken[3].x = f64::NAN;
        assert_eq!(recognise_grid(&broken), None);
        broken[3].x = 1e300;
        assert_eq!(recognise_grid(&broken), None);
        assert_eq!(recognise_grid(&[]), None);
    }
}
