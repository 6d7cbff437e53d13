//! Forecast of what the shape of a part and its targets alone decide, from a measurement that is computed before
//! anything moves: the weak directions of the registration, and a refusal.

use std::f64::consts::{SQRT_2, TAU};

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use super::task::Task;
use crate::geometry::{Point, Vector};
use crate::measuring::Target;
use crate::model::{Form, ModelInputs};
use crate::registration::{Registration, WeakDirection, map_obstacle};

/// Number of waves of the form error.
const WAVES: usize = 48;
/// Maximum number of targets. More points would not change what the shape determines.
const MAX_TARGETS: usize = 1200;
/// Noise of a touch, as a share of the form error.
const NOISE_SHARE: f64 = 0.05;

/// Forecast of a measurement.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MeasurementForecast {
    /// Directions in which the registration determines the pose poorly.
    pub weak_directions: Vec<WeakDirection>,
    /// Reason why the measurement would end without a correction, in the words of the alarm of the cell; `None` if no
    /// refusal is expected.
    pub refusal: Option<String>,
}

/// Returns the forecast of the first measurement of the part of `task`.
///
/// The measurement is computed: the targets of the plan on the nominal surface, with a random form error and with noise.
/// The form error has the root mean square `rms_mm` after the best fit. Its correlation length is as long as the part is
/// large (root mean square distance of the targets from their centroid). The measurement is registered and judged as one
/// of a run is.
pub fn forecast_measurement(task: &Task, rms_mm: f64) -> MeasurementForecast {
    // The best fit takes a part of the form error, so that more of it is needed to leave `rms_mm`.
    let found = registered_forecast(task, rms_mm)
        .and_then(|found| registered_forecast(task, rms_mm * rms_mm / found.quality.rms_mm.max(0.1 * rms_mm)));
    let found = match found {
        Ok(found) => found,
        Err(reason) => return MeasurementForecast { refusal: Some(reason), ..MeasurementForecast::default() },
    };
    let inputs = ModelInputs {
        machine: task.machine_uncertainty,
        locked_sigmas: task.locked_direction_sigmas(),
        ..ModelInputs::default()
    };
    let form = Form::estimate(&found, &inputs);
    let covariance = form.as_ref().map_or(&found.quality.covariance, |form| &form.frame_covariance);
    let refusal = map_obstacle(&found, covariance, &task.map_limits);
    MeasurementForecast { weak_directions: found.quality.weak_directions, refusal }
}

/// Returns the registration of a computed measurement whose form error has the root mean square `rms_mm` before the best
/// fit. Returns an error with the reason if it cannot be registered or judged.
fn registered_forecast(task: &Task, rms_mm: f64) -> Result<Registration, String> {
    let every = task.targets.len().div_ceil(MAX_TARGETS).max(1);
    let targets: Vec<&Target> = task.targets.iter().step_by(every).collect();
    let places: Vec<Point> = targets.iter().map(|target| target.point).collect();
    let radius_mm = task.probing.probe_radius_mm;
    let errors_mm = form_errors(&places, rms_mm);
    let centre = |(target, error_mm): (&&Target, f64)| {
        task.fixture_cmm_from_model.transform_point(&(target.point + (radius_mm + error_mm) * target.normal))
    };
    let centres: Vec<Point> = targets.iter().zip(errors_mm).map(centre).collect();
    let found = task.register_with_start(&centres, radius_mm, true).map_err(|error| error.to_string())?.0;
    found.unjudgeable_reason().map_or(Ok(found), Err)
}

/// Returns a form error with noise at each of the `places`, in mm. The same places give the same errors.
fn form_errors(places: &[Point], rms_mm: f64) -> Vec<f64> {
    let n = places.len().max(1) as f64;
    let middle = places.iter().map(|place| place.coords).sum::<Vector>() / n;
    let size_mm = (places.iter().map(|place| (place.coords - middle).norm_squared()).sum::<f64>() / n).sqrt();
    let mut rng = StdRng::seed_from_u64(1);
    let mut normal = || {
        let [u, v]: [f64; 2] = [1.0 - rng.random::<f64>(), rng.random()];
        (-2.0 * u.ln()).sqrt() * (TAU * v).cos()
    };
    // A Gaussian autocovariance that falls to 1/e over `size_mm` has wave numbers of this standard deviation.
    let sigma_per_mm = SQRT_2 / size_mm.max(f64::MIN_POSITIVE);
    let waves: Vec<(Vector, f64)> =
        (0..WAVES).map(|_| (sigma_per_mm * Vector::new(normal(), normal(), normal()), TAU * normal())).collect();
    let raw = |place: &Point| waves.iter().map(|(k, phase)| (k.dot(&(place.coords - middle)) + phase).cos()).sum();
    let form: Vec<f64> = places.iter().map(raw).collect();
    let scale = rms_mm / (form.iter().map(|error| error * error).sum::<f64>() / n).sqrt().max(f64::MIN_POSITIVE);
    form.into_iter().map(|error| scale * error + NOISE_SHARE * rms_mm * normal()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn form_errors_have_their_rms_and_are_smooth() {
        let places: Vec<Point> = (0..400).map(|k| Point::new(f64::from(k % 20), f64::from(k / 20), 0.0)).collect();
        let errors = form_errors(&places, 0.004);
        assert_eq!(errors, form_errors(&places, 0.004));
        let rms = (errors.iter().map(|error| error * error).sum::<f64>() / 400.0).sqrt();
        assert!((rms / 0.004 - 1.0).abs() < 0.02, "{rms}");
        let steps = errors.chunks(20).flat_map(|row| row.windows(2)).map(|pair| (pair[1] - pair[0]).abs());
        assert!(steps.fold(0.0, f64::max) < 0.004);
        assert!(form_errors(&[], 1.0).is_empty());
    }
}
