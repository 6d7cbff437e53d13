//! Did the part answer as it was asked to?
//!
//! The change of the error from one pass to the next is compared with the change of the correction. The slope of the one over the
//! other is 1 where everything is right, -1 where a sign is wrong, near 0 where the correction was not applied or was
//! applied somewhere else; in the latter case it fits once it is mirrored or turned.

use super::correction::Correction;
use super::map::ErrorMap;

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
    /// As if the map had been turned by half a turn.
    Turned,
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
    /// What to think of it.
    pub sense: Sense,
}

/// Compares the change of the error with the change of the correction.
///
/// `scatter_mm` is by how much the error may change by itself, as a standard deviation: the repeatability of grinding and measuring
/// together. All maps are compared on the net of the later error.
pub fn response(errors: [&ErrorMap; 2], corrections: [&Correction; 2], scatter_mm: f64) -> Response {
    let [before, after] = errors;
    let net = after.net;
    let nodes: Vec<usize> = (0..net.len()).filter(|&k| after.valid[k]).collect();
    let changed = |place: [f64; 2]| corrections[1].at(place) - corrections[0].at(place);
    let answer: Vec<f64> =
        nodes.iter().map(|&k| after.values_mm[k] - before.at(net.place_mm(k))).collect::<Vec<_>>().centred();
    let [cx, cy] = [0, 1].map(|k| {
        let nodes = [net.columns, net.rows][k];
        2.0 * net.first_mm[k] + (nodes - 1) as f64 * net.spacing_mm[k]
    });
    let fit = |place: fn([f64; 2], [f64; 2]) -> [f64; 2]| {
        let asked = nodes.iter().map(|&k| changed(place(net.place_mm(k), [cx, cy]))).collect::<Vec<_>>().centred();
        regress(&asked, &answer)
    };
    let straight = fit(|place, _| place);
    let mirrored = [
        (Sense::MirroredX, fit(|[x, y], [cx, _]| [cx - x, y])),
        (Sense::MirroredY, fit(|[x, y], [_, cy]| [x, cy - y])),
        (Sense::Turned, fit(|[x, y], [cx, cy]| [cx - x, cy - y])),
    ];
    Response {
        slope: straight.slope,
        correlation: straight.correlation,
        sense: sense(&straight, &mirrored, scatter_mm),
    }
}

fn sense(straight: &Fit, mirrored: &[(Sense, Fit)], scatter_mm: f64) -> Sense {
    if straight.asked_rms < 2.0 * scatter_mm || straight.asked_rms == 0.0 {
        return Sense::Unclear;
    }
    if straight.slope > 0.4 && straight.correlation > 0.5 {
        return Sense::AsCommanded;
    }
    if straight.slope < -0.4 && straight.correlation < -0.5 {
        return Sense::Flipped;
    }
    let best =
        mirrored.iter().max_by(|a, b| a.1.correlation.total_cmp(&b.1.correlation)).expect("three ways are tried");
    if best.1.correlation > 0.8 && best.1.correlation > straight.correlation + 0.2 && best.1.slope > 0.5 {
        return best.0;
    }
    if straight.slope.abs() < 0.4 { Sense::NoEffect } else { Sense::Unclear }
}

/// A regression through the means.
struct Fit {
    slope: f64,
    correlation: f64,
    asked_rms: f64,
}

fn regress(asked: &[f64], answer: &[f64]) -> Fit {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let (aa, ab, bb) = (dot(asked, asked), dot(asked, answer), dot(answer, answer));
    let or_zero = |v: f64| if v.is_finite() { v } else { 0.0 };
    let asked_rms = (aa / asked.len().max(1) as f64).sqrt();
    Fit { slope: or_zero(ab / aa), correlation: or_zero(ab / (aa * bb).sqrt()), asked_rms }
}

trait Centred {
    fn centred(self) -> Self;
}

impl Centred for Vec<f64> {
    fn centred(mut self) -> Self {
        let mean = self.iter().sum::<f64>() / self.len().max(1) as f64;
        self.iter_mut().for_each(|v| *v -= mean);
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compensation::Net;

    const NET: Net = Net { columns: 21, rows: 13, first_mm: [-10.0, -6.0], spacing_mm: [1.0, 1.0] };

    fn map(f: impl Fn(f64, f64) -> f64) -> ErrorMap {
        let values_mm = (0..NET.len()).map(|k| NET.place_mm(k)).map(|[x, y]| f(x, y)).collect();
        ErrorMap { net: NET, values_mm, valid: vec![true; NET.len()], rest_sigma_mm: 0.0 }
    }

    /// An error without any symmetry.
    fn error(x: f64, y: f64) -> f64 {
        5e-3 * ((0.4 * x + 0.7).sin() + (0.5 * y - 0.2 * x + 1.1).cos() + 0.02 * x * y + 0.05 * x)
    }

    fn answered(seen: impl Fn(f64, f64) -> f64) -> Response {
        let before = map(error);
        let none = Correction::none(NET, 0.0);
        let asked = Correction { values_mm: before.values_mm.iter().map(|e| -e).collect(), ..none.clone() };
        response([&before, &map(|x, y| error(x, y) + seen(x, y))], [&none, &asked], 2e-4)
    }

    #[test]
    fn every_way_to_answer_is_told() {
        assert_eq!(answered(|x, y| -error(x, y)).sense, Sense::AsCommanded);
        assert_eq!(answered(|x, y| -0.8 * error(x, y)).sense, Sense::AsCommanded);
        assert_eq!(answered(error).sense, Sense::Flipped);
        assert_eq!(answered(|x, y| -error(-x, y)).sense, Sense::MirroredX);
        assert_eq!(answered(|x, y| -error(x, -y)).sense, Sense::MirroredY);
        assert_eq!(answered(|x, y| -error(-x, -y)).sense, Sense::Turned);
        assert_eq!(answered(|_, _| 0.0).sense, Sense::NoEffect);
    }

    #[test]
    fn a_change_within_the_scatter_tells_nothing() {
        let flat = map(|_, _| 1e-5);
        let none = Correction::none(NET, 0.0);
        assert_eq!(response([&flat, &flat], [&none, &none], 1e-4).sense, Sense::Unclear);
        assert_eq!(response([&flat, &flat], [&none, &none], 0.0).sense, Sense::Unclear);
    }
}
