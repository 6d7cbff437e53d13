//! Surface left by a ball that follows a program: the distance of its centre from the nominal surface, along the lines
//! and arcs between the stops.

use crate::part::Part;
use crate::program::Program;
use crate::shape::project_onto;

/// Maximum distance of consecutive samples along a move, in mm.
const SAMPLE_SPACING_MM: f64 = 0.15;
/// Maximum distance of the ball from the nominal contact at which it grinds, in mm.
const NEAR_MM: f64 = 1.0;

/// Projection of the centre of the ball onto the nominal surface: position (x, y), and height of the ball over the
/// nominal surface, in mm.
#[derive(Clone, Copy, Debug)]
struct BallSample {
    at_mm: [f64; 2],
    height_mm: f64,
}

/// Simulates a ball of radius `radius_mm` (the wheel) that follows `program`. Returns, for every grid node of `part`,
/// the height in mm over the nominal surface that the ball leaves. `track_mm` is the distance between neighbouring
/// tracks. A node outside the part gets the height at the edge. The height is NaN at a node that the ball does not come
/// near.
pub(crate) fn heights_mm(part: &Part, program: &Program, radius_mm: f64, track_mm: f64) -> Vec<f64> {
    let reach_mm = (1.6 * track_mm).max(2.0 * SAMPLE_SPACING_MM);
    let cells = SampleIndex::new(touches(part, program, radius_mm), reach_mm);
    part.height.nodes().map(|at| cells.level_mm(on_part(part, at))).collect()
}

/// Returns the position on the part at which the height of a node is computed. `at_mm` is the position (x, y) of the
/// node in mm. If `at_mm` is on the part, returns `at_mm` unchanged. Otherwise returns the point at which the line from
/// the origin to `at_mm` crosses the edge of the part.
///
/// The wheel lifts off outside the part, so the path has no useful height there. If the origin itself is not on the
/// part, returns `at_mm` unchanged.
fn on_part(part: &Part, at_mm: [f64; 2]) -> [f64; 2] {
    let at = |share: f64| at_mm.map(|v| share * v);
    let is_on = |share: f64| part.aperture.contains(at(share)[0], at(share)[1]);
    if is_on(1.0) || !is_on(0.0) {
        return at_mm;
    }
    let (mut on, mut off) = (0.0, 1.0);
    for _ in 0..40 {
        let middle = 0.5 * (on + off);
        *(if is_on(middle) { &mut on } else { &mut off }) = middle;
    }
    at(on)
}

fn touches(part: &Part, program: &Program, radius_mm: f64) -> Vec<BallSample> {
    let mut found = Vec::new();
    for pair in program.waypoints.windows(2).filter(|pair| pair[1].feed_mm_min.is_some()) {
        let (from, to) = (&pair[0], &pair[1]);
        let count = (program.length_mm(from, to) / SAMPLE_SPACING_MM).ceil().max(1.0);
        for k in 1..=count as usize {
            found.extend(touch(part, program.centre_mm(from, to, k as f64 / count), radius_mm));
        }
    }
    found
}

/// Projects the ball's `centre` (x, y, z in mm) onto the nominal surface. Returns the position of the contact, and the
/// height in mm of the ball of radius `radius_mm` over the nominal surface. Returns `None` if the ball is 1 mm or more
/// from the surface, or if the projection fails.
fn touch(part: &Part, centre: [f64; 3], radius_mm: f64) -> Option<BallSample> {
    let (at_mm, over_mm) = project_onto(part.shape.as_ref(), centre, [centre[0], centre[1]])?;
    let height_mm = over_mm - radius_mm;
    (height_mm.abs() < NEAR_MM).then_some(BallSample { at_mm, height_mm })
}

/// Samples of the ball, indexed by their position.
struct SampleIndex {
    reach_mm: f64,
    samples: std::collections::HashMap<[i64; 2], Vec<BallSample>>,
}

impl SampleIndex {
    fn new(touches: Vec<BallSample>, reach_mm: f64) -> Self {
        let mut cells = Self { reach_mm, samples: Default::default() };
        for touch in touches {
            cells.samples.entry(cells.cell(touch.at_mm)).or_default().push(touch);
        }
        cells
    }

    fn cell(&self, at_mm: [f64; 2]) -> [i64; 2] {
        at_mm.map(|v| (v / self.reach_mm).floor() as i64)
    }

    /// Returns the height in mm over the nominal surface that the ball leaves at the position `at_mm` (x, y). Each
    /// sample is a position of the ball, projected onto the nominal surface, with its height. Fits a plane to the
    /// samples near `at_mm`, by weighted least squares. The weight of a sample falls to 0 at the distance
    /// `self.reach_mm`. Returns NaN if there is no sample within this distance.
    fn level_mm(&self, at_mm: [f64; 2]) -> f64 {
        let [i, j] = self.cell(at_mm);
        // Normal equations of h = c0 + c1 u + c2 v.
        let (mut m, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
        let around = (i - 1..=i + 1).flat_map(|i| (j - 1..=j + 1).map(move |j| [i, j]));
        for touch in around.filter_map(|cell| self.samples.get(&cell)).flatten() {
            let [u, v] = [0, 1].map(|k| (touch.at_mm[k] - at_mm[k]) / self.reach_mm);
            let weight = (1.0 - u * u - v * v).max(0.0).powi(2);
            let row = [1.0, u, v];
            for k in 0..3 {
                b[k] += weight * row[k] * touch.height_mm;
                (0..3).for_each(|l| m[k][l] += weight * row[k] * row[l]);
            }
        }
        // Touches along one line do not determine the slope across it; this small regularization keeps the plane level.
        m[1][1] += 1e-6 * m[0][0];
        m[2][2] += 1e-6 * m[0][0];
        solve_first(m, b)
    }
}

/// Solves the three linear equations `m` x = `b` by Cramer's rule, and returns only the first component of x. `m` is
/// the matrix by rows, and `b` is the right side. The result is not finite if the matrix is singular.
fn solve_first(m: [[f64; 3]; 3], b: [f64; 3]) -> f64 {
    let of = |c: [f64; 3]| {
        c[0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (c[1] * m[2][2] - m[1][2] * c[2])
            + m[0][2] * (c[1] * m[2][1] - m[1][1] * c[2])
    };
    of(b) / of([m[0][0], m[1][0], m[2][0]])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Waypoint;
    use crate::spec::WorldSpec;

    /// Returns a part of the default world, with a raster of ball centres over it that leaves a given height over x and
    /// y.
    fn followed(apart_mm: f64, left_mm: impl Fn(f64, f64) -> f64) -> (Part, Vec<f64>) {
        let part = Part::blank(&WorldSpec::default().part, 1);
        let [a, b] = part.aperture.half_mm();
        let (rows, columns) = ((2.0 * b / apart_mm).ceil() as usize, 200);
        let mut program = Program::default();
        for j in 0..=rows {
            for i in 0..=columns {
                let at = |k: usize, n: usize, half: f64| half * (2.0 * k as f64 / n as f64 - 1.0);
                let (x, y) = (at(i, columns, a), at(j, rows, b));
                let (point, normal) = (part.shape.point(x, y), part.shape.normal(x, y));
                let at_mm = std::array::from_fn(|k| point[k] + (10.0 + left_mm(x, y)) * normal[k]);
                let feed_mm_min = (i > 0).then_some(600.0);
                program.waypoints.push(Waypoint { at_mm, rotary_deg: None, feed_mm_min, minutes: None, arc: None });
            }
        }
        let heights = heights_mm(&part, &program, 10.0, apart_mm);
        (part, heights)
    }

    #[test]
    fn followed_heights_match_to_the_edge() {
        let left = |x: f64, y: f64| 0.02 + 0.005 * (0.1 * x).sin() * (0.1 * y).cos();
        let (part, heights) = followed(0.5, left);
        for ([x, y], found) in part.height.nodes().zip(heights) {
            if part.aperture.contains(x, y) {
                // The chords between the stops are below the curve by 1 um at most.
                assert!((found - left(x, y)).abs() < 1.5e-3, "{found} at {x} {y}");
            } else {
                assert!((found - 0.02).abs() < 0.007, "{found} at {x} {y}");
            }
        }
    }

    #[test]
    fn unreached_heights_are_nan() {
        let part = Part::blank(&WorldSpec::default().part, 1);
        assert!(heights_mm(&part, &Program::default(), 10.0, 0.5).iter().all(|h| h.is_nan()));
    }
}
