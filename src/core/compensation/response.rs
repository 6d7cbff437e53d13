//! Response of the part to its correction: did it change as commanded?
//!
//! The change of the error from one pass to the next is compared with the change of the correction. The slope of the
//! first over the second is 1 if everything is right, -1 if a sign is wrong, and 2 if the correction was applied
//! twice. It is near 0 if the correction was not applied, or was applied at the wrong place; then the fit improves if
//! the map is mirrored or turned. A nearly symmetric map improves the part even if it is mirrored. So the
//! transformation that leaves the smallest unexplained change decides, not the sign of the slope alone.
//!
//! The next registration removes every change that looks like a motion of the part, so that it never appears in a
//! map. Motions are therefore removed from both the commanded and the measured change before the comparison.

use nalgebra::{Matrix6, Vector6};
use regrind_figures::PartResponse;

use super::correction::Correction;
use super::map::ErrorMap;
use crate::geometry::{Point, Vector};

/// Response of a part to a change of its correction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Response {
    /// Change of the error over change of the correction; 1 is as commanded.
    pub slope: f64,
    /// Correlation of the two changes, from -1 to 1.
    pub correlation: f64,
    /// Root mean square of the commanded change without motions of the part, in millimetres.
    pub commanded_mm: f64,
    /// Root mean square of the measured change that the commanded one does not explain, in millimetres.
    pub unexplained_mm: f64,
    /// Classification of the response.
    pub kind: PartResponse,
}

/// Maximum ratio of the unexplained variance of a mirrored or turned map to that of the straight map. With a larger
/// ratio a mirrored or turned map is not the cause.
const CLEARLY_BETTER: f64 = 0.5;
/// Share of the response's variance that may stay unexplained before mirrored and turned maps are considered.
const WELL_EXPLAINED: f64 = 0.05;
/// Slope above which a response is nearer to twice the command than to a single command on a stiff machine.
const TWICE: f64 = 1.6;

/// Compares the measured change of the error map between two passes with the commanded change of the correction.
/// Returns the response of the part: its slope (measured change divided by commanded change) and its classification,
/// for example as commanded, mirrored or without effect.
///
/// `errors` and `corrections` each contain two maps: of the previous pass, then of the last pass. `places` are points
/// of the nominal surface with their unit normals, in any order. Both error maps must have a value at these points.
/// `scatter_mm` is the repeatability of grinding and measuring together, in millimetres: the standard deviation of the
/// error without a new command. Frame: the model frame.
pub fn estimate_response(
    errors: [&ErrorMap; 2],
    corrections: [&Correction; 2],
    places: &[(Point, Vector)],
    scatter_mm: f64,
) -> Response {
    let [before, after] = errors;
    let grid = after.nodes.grid;
    let unseen = MotionProjector::new(places);
    let over =
        |value: &dyn Fn([f64; 2]) -> f64| unseen.without(places.iter().map(|(p, _)| value([p.x, p.y])).collect());
    // Parameters move the surface as a map does, and the part responds to them in the same way.
    let asked = corrections.map(|correction| (correction.grid, correction.apparent_mm()));
    let [earlier, later] = asked.each_ref().map(|(grid, values)| move |place| grid.interpolate(values, place));
    let changed = |place: [f64; 2]| later(place) - earlier(place);
    let answer = over(&|place| after.nodes.at(place) - before.nodes.at(place));
    let [cx, cy] = [0, 1].map(|k| {
        let nodes = grid.counts()[k];
        2.0 * grid.first_mm[k] + (nodes - 1) as f64 * grid.spacing_mm[k]
    });
    let fit = |place: fn([f64; 2], [f64; 2]) -> [f64; 2]| {
        let asked = over(&|at| changed(place(at, [cx, cy])));
        regress(&asked, &answer)
    };
    let straight = fit(|place, _| place);
    let mirrored = [
        fit(|[x, y], [cx, _]| [cx - x, y]),
        fit(|[x, y], [_, cy]| [x, cy - y]),
        // Half a turn, and quarter turns.
        fit(|[x, y], [cx, cy]| [cx - x, cy - y]),
        fit(|[x, y], [cx, cy]| [(cx - cy) / 2.0 + y, (cx + cy) / 2.0 - x]),
        fit(|[x, y], [cx, cy]| [(cx + cy) / 2.0 - y, (cy - cx) / 2.0 + x]),
    ];
    Response {
        slope: straight.slope,
        correlation: straight.correlation,
        commanded_mm: straight.commanded_rms,
        unexplained_mm: straight.unexplained_rms,
        kind: classify(&straight, &mirrored, scatter_mm),
    }
}

fn classify(straight: &Regression, mirrored: &[Regression], scatter_mm: f64) -> PartResponse {
    if straight.commanded_rms < 2.0 * scatter_mm || straight.commanded_rms == 0.0 {
        return PartResponse::Unclear;
    }
    let best = mirrored.iter().max_by(|a, b| a.correlation.total_cmp(&b.correlation)).expect("five ways are tried");
    let left = [straight, best].map(|fit| 1.0 - fit.correlation * fit.correlation.abs());
    let better = left[0] > WELL_EXPLAINED && left[1] < CLEARLY_BETTER * left[0];
    if better && best.correlation > 0.8 && best.slope > 0.5 {
        return PartResponse::Mirrored;
    }
    if straight.slope > TWICE && straight.correlation > 0.5 {
        return PartResponse::Doubled;
    }
    if straight.slope > 0.4 && straight.correlation > 0.5 {
        return PartResponse::Expected;
    }
    if straight.slope < -0.4 && straight.correlation < -0.5 {
        return PartResponse::SignFlipped;
    }
    if straight.slope.abs() < 0.4 { PartResponse::NoEffect } else { PartResponse::Unclear }
}

/// Regression through the origin.
struct Regression {
    slope: f64,
    correlation: f64,
    commanded_rms: f64,
    unexplained_rms: f64,
}

fn regress(asked: &[f64], answer: &[f64]) -> Regression {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let (aa, ab, bb) = (dot(asked, asked), dot(asked, answer), dot(answer, answer));
    let or_zero = |v: f64| if v.is_finite() { v } else { 0.0 };
    let (count, slope) = (asked.len().max(1) as f64, or_zero(ab / aa));
    Regression {
        slope,
        correlation: or_zero(ab / (aa * bb).sqrt()),
        commanded_rms: (aa / count).sqrt(),
        unexplained_rms: ((bb - slope * ab).max(0.0) / count).sqrt(),
    }
}

/// Projector that removes the changes by motions of the part. Registration removes these changes from a map.
struct MotionProjector {
    /// Change by each of the six motions at each place, with lengths in units of the part's size.
    rows: Vec<Vector6<f64>>,
    /// Pseudo-inverse of the sum of row times row transposed over `rows`; on a flat part some motions change nothing.
    inverse: Matrix6<f64>,
}

impl MotionProjector {
    fn new(places: &[(Point, Vector)]) -> Self {
        let size = places.iter().map(|(p, _)| p.coords.norm()).fold(f64::MIN_POSITIVE, f64::max);
        let row = |(p, n): &(Point, Vector)| {
            let turn = p.coords.cross(n) / size;
            Vector6::new(n.x, n.y, n.z, turn.x, turn.y, turn.z)
        };
        let rows: Vec<Vector6<f64>> = places.iter().map(row).collect();
        let gram: Matrix6<f64> = rows.iter().map(|row| row * row.transpose()).sum();
        let parts = gram.symmetric_eigen();
        let least = 1e-9 * parts.eigenvalues.max();
        let inverse = (0..6).filter(|&k| parts.eigenvalues[k] > least).map(|k| {
            let v = parts.eigenvectors.column(k);
            v * v.transpose() / parts.eigenvalues[k]
        });
        Self { inverse: inverse.sum(), rows }
    }

    /// Removes from `values` the part that a rigid motion of the part explains (least squares), and returns the rest.
    /// `values` holds one value for each place of this projector, in the same order.
    fn without(&self, mut values: Vec<f64>) -> Vec<f64> {
        let seen: Vector6<f64> = self.rows.iter().zip(&values).map(|(row, v)| row * *v).sum();
        let motion = self.inverse * seen;
        values.iter_mut().zip(&self.rows).for_each(|(v, row)| *v -= row.dot(&motion));
        values
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Grid;

    const GRID: Grid = Grid { columns: 21, rows: 13, first_mm: [-10.0, -6.0], spacing_mm: [1.0, 1.0] };

    fn map(f: impl Fn(f64, f64) -> f64) -> ErrorMap {
        let values_mm = (0..GRID.len()).map(|k| GRID.place_mm(k)).map(|[x, y]| f(x, y)).collect();
        ErrorMap::exact(GRID, values_mm, vec![true; GRID.len()])
    }

    /// Returns an error without any symmetry, in millimetres.
    fn error(x: f64, y: f64) -> f64 {
        5e-3 * ((0.4 * x + 0.7).sin() + (0.5 * y - 0.2 * x + 1.1).cos() + 0.02 * x * y + 0.05 * x)
    }

    fn answered(seen: impl Fn(f64, f64) -> f64) -> Response {
        let before = map(error);
        let none = Correction::zero(GRID, 0.0);
        let asked = Correction { values_mm: before.nodes.values_mm.iter().map(|e| -e).collect(), ..none.clone() };
        estimate_response([&before, &map(|x, y| error(x, y) + seen(x, y))], [&none, &asked], &places(), 2e-4)
    }

    /// Returns the nodes of the grid on a flat part.
    fn places() -> Vec<(Point, Vector)> {
        (0..GRID.len()).map(|k| GRID.place_mm(k)).map(|[x, y]| (Point::new(x, y, 0.0), Vector::z())).collect()
    }

    #[test]
    fn response_classifies_every_sense() {
        assert_eq!(answered(|x, y| -error(x, y)).kind, PartResponse::Expected);
        assert_eq!(answered(|x, y| -0.8 * error(x, y)).kind, PartResponse::Expected);
        assert_eq!(answered(error).kind, PartResponse::SignFlipped);
        assert_eq!(answered(|x, y| -error(-x, y)).kind, PartResponse::Mirrored);
        assert_eq!(answered(|x, y| -error(x, -y)).kind, PartResponse::Mirrored);
        assert_eq!(answered(|x, y| -error(-x, -y)).kind, PartResponse::Mirrored);
        assert_eq!(answered(|x, y| -error(y, -x)).kind, PartResponse::Mirrored);
        assert_eq!(answered(|x, y| -error(-y, x)).kind, PartResponse::Mirrored);
        assert_eq!(answered(|x, y| -2.0 * error(x, y)).kind, PartResponse::Doubled);
        assert_eq!(answered(|x, y| -1.2 * error(x, y)).kind, PartResponse::Expected);
        assert_eq!(answered(|_, _| 0.0).kind, PartResponse::NoEffect);
    }

    #[test]
    fn response_unclear_within_noise() {
        let flat = map(|_, _| 1e-5);
        let none = Correction::zero(GRID, 0.0);
        assert_eq!(estimate_response([&flat, &flat], [&none, &none], &places(), 1e-4).kind, PartResponse::Unclear);
        assert_eq!(estimate_response([&flat, &flat], [&none, &none], &places(), 0.0).kind, PartResponse::Unclear);
    }
}
