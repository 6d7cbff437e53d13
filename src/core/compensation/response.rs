//! Did the part answer as it was asked to?
//!
//! The change of the error from one pass to the next is compared with the change of the correction. The slope of the one over the
//! other is 1 where everything is right, -1 where a sign is wrong, 2 where the correction was applied twice, near 0 where it was not applied or
//! was applied somewhere else; in the latter case it fits better once it is mirrored or turned. A map that is nearly symmetric
//! makes the part better even when it is mirrored, so the way that leaves least unexplained is asked for, not the sign of the slope alone.
//!
//! Whatever of a change looks like a motion of the part is taken away by the next registration, and is never seen. It is taken out
//! of what was asked and of what was answered before they are compared.

use nalgebra::{Matrix6, Vector6};

use super::correction::Correction;
use super::map::ErrorMap;
use crate::geometry::{Point, Vector};

/// How the part answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sense {
    /// As commanded.
    AsCommanded,
    /// With the opposite sign.
    Flipped,
    /// As if x ran the other way.
    MirroredX,
    /// As if y ran the other way.
    MirroredY,
    /// As if the map had been turned by half a turn, or by a quarter.
    Turned,
    /// As commanded, but far more: as if the map had been applied twice.
    Doubled,
    /// Not at all.
    NoEffect,
    /// The change that was asked for is too small beside the scatter to tell.
    Unclear,
}

/// The answer of a part to a change of its correction.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Response {
    /// Change of the error over change of the correction; 1 is as commanded.
    pub slope: f64,
    /// Correlation of the two, from -1 to 1.
    pub correlation: f64,
    /// Root mean square of the change that was asked for, as far as it can be seen, in millimetres.
    pub asked_mm: f64,
    /// Root mean square of what the change asked for does not explain of the answer, in millimetres.
    pub unexplained_mm: f64,
    /// What to think of it.
    pub sense: Sense,
}

/// A mirrored or turned map must leave less than this share of what the straight one leaves unexplained.
const CLEARLY_BETTER: f64 = 0.5;
/// Share of the answer that may stay unexplained before another way than the straight one is thought of.
const WELL_EXPLAINED: f64 = 0.05;
/// Slope above which an answer is nearer to twice what was asked for than to the once of a stiff machine.
const TWICE: f64 = 1.6;

/// Compares the change of the error with the change of the correction.
///
/// Shapes: `places` are points of the nominal surface with their unit normals, in any order, where both maps have been measured.
/// `scatter_mm` is by how much the error may change by itself, as a standard deviation: the repeatability of grinding and measuring
/// together. Frames: the model frame.
pub fn response(
    errors: [&ErrorMap; 2],
    corrections: [&Correction; 2],
    places: &[(Point, Vector)],
    scatter_mm: f64,
) -> Response {
    let [before, after] = errors;
    let grid = after.grid;
    let unseen = Motions::new(places);
    let over =
        |value: &dyn Fn([f64; 2]) -> f64| unseen.without(places.iter().map(|(p, _)| value([p.x, p.y])).collect());
    // Parameters move the part as a map does, and are answered alike.
    let asked = corrections.map(|correction| (correction.grid, correction.seen_mm()));
    let [earlier, later] = asked.each_ref().map(|(grid, values)| move |place| grid.interpolate(values, place));
    let changed = |place: [f64; 2]| later(place) - earlier(place);
    let answer = over(&|place| after.at(place) - before.at(place));
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
        (Sense::MirroredX, fit(|[x, y], [cx, _]| [cx - x, y])),
        (Sense::MirroredY, fit(|[x, y], [_, cy]| [x, cy - y])),
        (Sense::Turned, fit(|[x, y], [cx, cy]| [cx - x, cy - y])),
        (Sense::Turned, fit(|[x, y], [cx, cy]| [(cx - cy) / 2.0 + y, (cx + cy) / 2.0 - x])),
        (Sense::Turned, fit(|[x, y], [cx, cy]| [(cx + cy) / 2.0 - y, (cy - cx) / 2.0 + x])),
    ];
    Response {
        slope: straight.slope,
        correlation: straight.correlation,
        asked_mm: straight.asked_rms,
        unexplained_mm: straight.unexplained_rms,
        sense: sense(&straight, &mirrored, scatter_mm),
    }
}

fn sense(straight: &Fit, mirrored: &[(Sense, Fit)], scatter_mm: f64) -> Sense {
    if straight.asked_rms < 2.0 * scatter_mm || straight.asked_rms == 0.0 {
        return Sense::Unclear;
    }
    let best = mirrored.iter().max_by(|a, b| a.1.correlation.total_cmp(&b.1.correlation)).expect("five ways are tried");
    let left = [straight, &best.1].map(|fit| 1.0 - fit.correlation * fit.correlation.abs());
    let better = left[0] > WELL_EXPLAINED && left[1] < CLEARLY_BETTER * left[0];
    if better && best.1.correlation > 0.8 && best.1.slope > 0.5 {
        return best.0;
    }
    if straight.slope > TWICE && straight.correlation > 0.5 {
        return Sense::Doubled;
    }
    if straight.slope > 0.4 && straight.correlation > 0.5 {
        return Sense::AsCommanded;
    }
    if straight.slope < -0.4 && straight.correlation < -0.5 {
        return Sense::Flipped;
    }
    if straight.slope.abs() < 0.4 { Sense::NoEffect } else { Sense::Unclear }
}

/// A regression through the means.
struct Fit {
    slope: f64,
    correlation: f64,
    asked_rms: f64,
    unexplained_rms: f64,
}

fn regress(asked: &[f64], answer: &[f64]) -> Fit {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let (aa, ab, bb) = (dot(asked, asked), dot(asked, answer), dot(answer, answer));
    let or_zero = |v: f64| if v.is_finite() { v } else { 0.0 };
    let (count, slope) = (asked.len().max(1) as f64, or_zero(ab / aa));
    Fit {
        slope,
        correlation: or_zero(ab / (aa * bb).sqrt()),
        asked_rms: (aa / count).sqrt(),
        unexplained_rms: ((bb - slope * ab).max(0.0) / count).sqrt(),
    }
}

/// The changes that a motion of the part makes: they span what no registered map can show.
struct Motions {
    /// For each place what the six motions change there, with lengths in units of the part's size.
    rows: Vec<Vector6<f64>>,
    /// The pseudo-inverse of their sum of squares; on a flat part some motions change nothing.
    inverse: Matrix6<f64>,
}

impl Motions {
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

    /// Returns values at the places without what a motion could make.
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
        ErrorMap::known(GRID, values_mm, vec![true; GRID.len()])
    }

    /// An error without any symmetry.
    fn error(x: f64, y: f64) -> f64 {
        5e-3 * ((0.4 * x + 0.7).sin() + (0.5 * y - 0.2 * x + 1.1).cos() + 0.02 * x * y + 0.05 * x)
    }

    fn answered(seen: impl Fn(f64, f64) -> f64) -> Response {
        let before = map(error);
        let none = Correction::none(GRID, 0.0);
        let asked = Correction { values_mm: before.values_mm.iter().map(|e| -e).collect(), ..none.clone() };
        response([&before, &map(|x, y| error(x, y) + seen(x, y))], [&none, &asked], &places(), 2e-4)
    }

    /// The nodes, on a part that is flat.
    fn places() -> Vec<(Point, Vector)> {
        (0..GRID.len()).map(|k| GRID.place_mm(k)).map(|[x, y]| (Point::new(x, y, 0.0), Vector::z())).collect()
    }

    #[test]
    fn every_way_to_answer_is_told() {
        assert_eq!(answered(|x, y| -error(x, y)).sense, Sense::AsCommanded);
        assert_eq!(answered(|x, y| -0.8 * error(x, y)).sense, Sense::AsCommanded);
        assert_eq!(answered(error).sense, Sense::Flipped);
        assert_eq!(answered(|x, y| -error(-x, y)).sense, Sense::MirroredX);
        assert_eq!(answered(|x, y| -error(x, -y)).sense, Sense::MirroredY);
        assert_eq!(answered(|x, y| -error(-x, -y)).sense, Sense::Turned);
        assert_eq!(answered(|x, y| -error(y, -x)).sense, Sense::Turned);
        assert_eq!(answered(|x, y| -error(-y, x)).sense, Sense::Turned);
        assert_eq!(answered(|x, y| -2.0 * error(x, y)).sense, Sense::Doubled);
        assert_eq!(answered(|x, y| -1.2 * error(x, y)).sense, Sense::AsCommanded);
        assert_eq!(answered(|_, _| 0.0).sense, Sense::NoEffect);
    }

    #[test]
    fn a_change_within_the_scatter_tells_nothing() {
        let flat = map(|_, _| 1e-5);
        let none = Correction::none(GRID, 0.0);
        assert_eq!(response([&flat, &flat], [&none, &none], &places(), 1e-4).sense, Sense::Unclear);
        assert_eq!(response([&flat, &flat], [&none, &none], &places(), 0.0).sense, Sense::Unclear);
    }
}
