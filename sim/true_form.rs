//! True form of a part: its true deviations from the nominal surface, without the best-fitting rigid motion.
//!
//! The deviations are some micrometres, so the fit is linear: a motion t, r of the part changes the deviation at the
//! place p with the normal n by n · t + (p × n) · r.

use crate::Vec3;
use crate::vector::{cross, length};

/// Smallest root mean square that a direction must have besides those before it. A smaller one is rounding: the surface
/// does not determine the direction.
const MIN_INDEPENDENT: f64 = 1e-9;

/// Peak to valley and root mean square of the true form.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrueForm {
    /// Largest minus smallest deviation, in mm.
    pub pv_mm: f64,
    /// Root mean square of the deviations, in mm.
    pub rms_mm: f64,
}

impl TrueForm {
    /// Fits the position of a part by least squares, and computes the figures of what is left. A sample has a place in mm
    /// in the model frame, the unit normal there, and the deviation along it in mm. `locked` are the directions in which
    /// the part is not moved: the shifts along x, y and z, and the turns about them. Directions that the surface does not
    /// determine, such as the turns of a sphere, change nothing. Without samples, both figures are 0.
    pub fn of_samples(samples: &[(Vec3, Vec3, f64)], locked: [bool; 6]) -> Self {
        let size = samples.iter().map(|(place, ..)| length(*place)).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
        let mut left_mm: Vec<f64> = samples.iter().map(|(.., deviation_mm)| *deviation_mm).collect();
        let mut fitted: Vec<Vec<f64>> = Vec::new();
        for k in (0..6).filter(|k| !locked[*k]) {
            let change = |(place, normal, _): &(Vec3, Vec3, f64)| match k {
                0..3 => normal[k],
                _ => cross(*place, *normal)[k - 3] / size,
            };
            let mut direction: Vec<f64> = samples.iter().map(change).collect();
            // Twice, so that rounding does not leave a part of the others.
            for other in fitted.iter().chain(&fitted) {
                remove(&mut direction, other);
            }
            let independent = norm(&direction);
            // Each of its values is 1 at most.
            if independent > MIN_INDEPENDENT * (samples.len() as f64).sqrt() {
                direction.iter_mut().for_each(|value| *value /= independent);
                remove(&mut left_mm, &direction);
                fitted.push(direction);
            }
        }
        let [low, high] = left_mm.iter().fold([f64::MAX, f64::MIN], |[low, high], d| [low.min(*d), high.max(*d)]);
        let count = left_mm.len().max(1) as f64;
        Self { pv_mm: (high - low).max(0.0), rms_mm: norm(&left_mm) / count.sqrt() }
    }
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum::<f64>().sqrt()
}

/// Removes from `values` their part along `direction`, which has the length 1.
fn remove(values: &mut [f64], direction: &[f64]) {
    let along: f64 = values.iter().zip(direction).map(|(a, b)| a * b).sum();
    values.iter_mut().zip(direction).for_each(|(value, unit)| *value -= along * unit);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vector::dot;

    const FREE: [bool; 6] = [false; 6];

    /// Returns samples on the saddle z = x y / 100, whose six motions are all determined.
    fn saddle(deviation_mm: impl Fn(Vec3, Vec3) -> f64) -> Vec<(Vec3, Vec3, f64)> {
        let places = (-5..=5).flat_map(|i| (-4..=4).map(move |j| [4.0 * f64::from(i) + 1.0, 3.0 * f64::from(j)]));
        let sample = |[x, y]: [f64; 2]| {
            let slope = [-y / 100.0, -x / 100.0, 1.0];
            let normal = slope.map(|c| c / length(slope));
            let place = [x, y, x * y / 100.0];
            (place, normal, deviation_mm(place, normal))
        };
        places.map(sample).collect()
    }

    #[test]
    fn rigid_motion_leaves_no_form() {
        let (shift, turn) = ([3e-3, -2e-3, 5e-3], [1e-5, 2e-5, -3e-5]);
        let samples = saddle(|p, n| dot(n, shift) + dot(cross(p, n), turn));
        let free = TrueForm::of_samples(&samples, FREE);
        assert!(free.pv_mm < 1e-15 && free.rms_mm < 1e-15, "{free:?}");
        let held = TrueForm::of_samples(&samples, [true; 6]);
        let all: Vec<f64> = samples.iter().map(|(.., d)| *d).collect();
        assert!((held.rms_mm - norm(&all) / (all.len() as f64).sqrt()).abs() < 1e-18, "{held:?}");
    }

    #[test]
    fn plane_keeps_form_without_tilt() {
        // Four corners of a plane, one of them 4 µm high: a quarter of that is the mean, a quarter each tilt.
        let corner = |x: f64, y: f64, mm: f64| ([x, y, 0.0], [0.0, 0.0, 1.0], mm);
        let samples = [corner(-1.0, -1.0, 0.0), corner(1.0, -1.0, 0.0), corner(-1.0, 1.0, 0.0), corner(1.0, 1.0, 4e-3)];
        let form = TrueForm::of_samples(&samples, FREE);
        assert!((form.pv_mm - 2e-3).abs() < 1e-15 && (form.rms_mm - 1e-3).abs() < 1e-15, "{form:?}");
        let only_z = TrueForm::of_samples(&samples, [true, true, false, true, true, true]);
        assert!((only_z.pv_mm - 4e-3).abs() < 1e-15 && (only_z.rms_mm - 3f64.sqrt() * 1e-3).abs() < 1e-15);
    }

    #[test]
    fn part_below_nominal_has_form() {
        for level_mm in [-14e-3, 0.0, 14e-3] {
            let form = TrueForm::of_samples(&saddle(|p, _| level_mm + 1e-3 * (p[0] * 0.9).sin()), FREE);
            assert!(form.pv_mm > 1.5e-3 && form.pv_mm < 2.5e-3, "{level_mm}: {form:?}");
        }
        assert_eq!(TrueForm::of_samples(&[], FREE), TrueForm { pv_mm: 0.0, rms_mm: 0.0 });
    }

    #[test]
    fn turns_of_sphere_change_nothing() {
        let radius = 50.0;
        let sample = |i: i32, j: i32| {
            let (x, y) = (f64::from(i), f64::from(j));
            let z = (radius * radius - x * x - y * y).sqrt();
            ([x, y, z], [x / radius, y / radius, z / radius], 1e-3 * f64::from(i % 2))
        };
        let samples: Vec<_> = (-9..=9).flat_map(|i| (-9..=9).map(move |j| sample(i, j))).collect();
        let [free, held] = [FREE, [false, false, false, true, true, true]].map(|l| TrueForm::of_samples(&samples, l));
        assert!((free.rms_mm - held.rms_mm).abs() < 1e-12 && free.rms_mm > 1e-4, "{free:?} {held:?}");
    }
}
