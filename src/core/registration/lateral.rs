//! Lateral error of a map of the deviations: how far it lies from its place on the part.
//!
//! On a shallow part the heights are known to micrometres. At the same time the part can be shifted or turned within
//! its own surface by millimetres, and no distance shows it. A map made in this pose has the right shape at the wrong
//! place. The resulting error is:
//!
//! ```text
//!  error of the map  =  k * (largest lateral uncertainty of a point) * (slope of the map)
//!
//!  k: coverage factor; lateral uncertainty: from the covariance of the pose
//! ```
//!
//! The slope is taken between neighbouring patches of the measured deviations: the 95 % quantile over all pairs.
//! Patches are used instead of points, so that the noise of points that lie close together does not count as slope. The
//! map is refused if its error exceeds a share of the rms to be corrected. It is also refused if its lateral error
//! exceeds a limit, however gentle its slopes are. At the edge of the part and where panels meet, a map is not gentle,
//! and a tool path cut to the outline of the part runs off it there. Locked directions have no variance and do not
//! count. Directions that the surface does not determine at all do not count either; they stay at the start pose.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6};

use super::deviation::{Deviation, PointStatus};
use super::result::Registration;
use crate::geometry::Vector;

/// Limits for the lateral error of a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapLimits {
    /// Coverage factor that multiplies the standard uncertainties.
    pub coverage_factor: f64,
    /// Maximum error of the map, as a share of the rms that it corrects.
    pub max_error_share: f64,
    /// Maximum lateral error of the map in mm, with the coverage factor.
    pub max_lateral_mm: f64,
}

impl Default for MapLimits {
    /// Returns the default limits for a map of the deviations. The coverage factor is 2. The lateral error of the map
    /// (along the surface) may cause an error of 10 % of the rms deviation. The lateral error itself may be 1 mm.
    fn default() -> Self {
        Self { coverage_factor: 2.0, max_error_share: 0.1, max_lateral_mm: 1.0 }
    }
}

/// Effect of the lateral uncertainty of a pose on a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LateralError {
    /// Largest standard uncertainty of a measured point along the surface, in mm.
    pub lateral_mm: f64,
    /// Slope of the deviations in mm per mm: the 95 % quantile over pairs of neighbouring patches.
    pub slope: f64,
    /// Lateral uncertainty, with the coverage factor, times slope, in mm.
    pub error_mm: f64,
}

/// Returns the lateral error of the pose of `found`, and the error that it causes in a map of the deviations, both in
/// mm. Lateral means along the surface. With a lateral error, the map has the right shape but lies at a displaced
/// position on the part.
///
/// `covariance` is the covariance of the twist [v; omega] of the pose, in mm and radians. The covariance in
/// `found.quality` gives the repeatability of the pose. The covariance of [`crate::model::Form`] also includes the
/// effect of form error on the pose. `coverage_factor` multiplies the standard uncertainty.
///
/// Equation: for the twist [v; omega] with covariance C, a point p moves by v + omega x p. The covariance of this
/// motion is J C J^T with J = [1, -p^], where p^ is the cross-product matrix of p. This covariance is projected onto
/// the tangent plane. The square root of its largest eigenvalue is the lateral uncertainty.
pub fn lateral_error(found: &Registration, covariance: &Matrix6<f64>, coverage_factor: f64) -> LateralError {
    let used: Vec<&Deviation> = found.deviations.iter().filter(|d| d.status == PointStatus::Inlier).collect();
    let lateral_mm = used.iter().map(|d| lateral_sigma(covariance, d)).fold(0.0, f64::max);
    let slope = slope(&used);
    LateralError { lateral_mm, slope, error_mm: coverage_factor * lateral_mm * slope }
}

/// Returns a message that explains why the registration `found` must not be used for a map of the deviations. Returns
/// `None` if a map is allowed.
///
/// A map is not allowed in two cases:
///
/// - The lateral error of the map (its displacement along the surface) exceeds `limits.max_lateral_mm`.
/// - The lateral error makes the values of the map wrong by more than `limits.max_error_share` (0 to 1) times the rms
///   deviation.
///
/// `covariance` is the covariance of the twist of the pose, in mm and radians (see [`lateral_error`]).
pub fn map_obstacle(found: &Registration, covariance: &Matrix6<f64>, limits: &MapLimits) -> Option<String> {
    let LateralError { lateral_mm, slope, error_mm } = lateral_error(found, covariance, limits.coverage_factor);
    let rms_mm = found.quality.rms_mm;
    let limit_mm = limits.max_error_share * rms_mm;
    let beside_mm = limits.coverage_factor * lateral_mm;
    if error_mm <= limit_mm && beside_mm <= limits.max_lateral_mm {
        return None;
    }
    let seen = found.quality.weak_directions.iter().filter(|w| !w.is_undetermined);
    let weak: Vec<&str> = seen.map(|w| w.description.as_str()).collect();
    let weak = if weak.is_empty() { String::new() } else { format!(" ({})", weak.join("; ")) };
    Some(format!(
        "the measured heights are good, but the shape of the part does not determine where they lie on it{weak}. The \
         correction may be displaced by {beside_mm:.2} mm, limit {:.2} mm. On slopes of the error map, up to {:.2} \
         µm/mm, this makes the correction wrong by {:.1} µm, limit {:.1} µm, {:.0} % of the {:.1} µm rms to be \
         corrected; at edges and seams by more. Lock these directions in the recipe if the fixture locates the part \
         more exactly (registration.lock = [\"x\", \"y\", \"rz\"]), or measure edges or marks that determine them",
        limits.max_lateral_mm,
        1e3 * slope,
        1e3 * error_mm,
        1e3 * limit_mm,
        1e2 * limits.max_error_share,
        1e3 * rms_mm,
    ))
}

/// Returns the standard uncertainty of the position of a point along the surface, in mm. It is the value in the tangent
/// direction with the largest uncertainty. `c` is the covariance of the twist of the pose, in mm and radians.
/// `deviation` has the point and its normal.
fn lateral_sigma(c: &Matrix6<f64>, deviation: &Deviation) -> f64 {
    let hat = deviation.point.coords.cross_matrix();
    let block = |i: usize, j: usize| -> Matrix3<f64> { c.fixed_view::<3, 3>(i, j).into_owned() };
    // (v - p^ omega) has the covariance Cvv + Cvw p^ - p^ Cwv - p^ Cww p^, because p^T = -p^.
    let moved = block(0, 0) + block(0, 3) * hat - hat * block(3, 0) - hat * block(3, 3) * hat;
    let n: Vector = deviation.normal;
    let tangent = Matrix3::identity() - n * n.transpose();
    let seen = tangent * moved * tangent;
    (0.5 * (seen + seen.transpose())).symmetric_eigenvalues().max().max(0.0).sqrt()
}

/// Returns the slope of the deviations along the surface, in mm per mm. Groups the points `used` into patches (cubes in
/// space) of about nine points, and takes the mean deviation of each patch. The slope between two neighbouring patches
/// is the difference of their mean deviations divided by their distance.
///
/// The result is the 95 % quantile of the absolute slopes of all pairs of neighbouring patches. Returns 0 if there are
/// no such pairs.
fn slope(used: &[&Deviation]) -> f64 {
    let n = used.len() as f64;
    let middle = used.iter().map(|d| d.point.coords).sum::<Vector>() / n;
    let size = (used.iter().map(|d| (d.point.coords - middle).norm_squared()).sum::<f64>() / n).sqrt();
    // Points spread over a square of rms size s are s sqrt(6 / n) apart, so a patch holds about nine of them.
    let edge = 3.0 * size * (6.0 / n).sqrt();
    if !(edge > 0.0 && edge.is_finite()) {
        return 0.0;
    }
    let cell = |d: &Deviation| -> [i32; 3] { d.point.coords.map(|c| (c / edge).floor() as i32).into() };
    let mut patches: BTreeMap<[i32; 3], (f64, Vector, f64)> = BTreeMap::new();
    for d in used {
        let patch = patches.entry(cell(d)).or_default();
        *patch = (patch.0 + 1.0, patch.1 + d.point.coords, patch.2 + d.deviation_mm);
    }
    let means: BTreeMap<[i32; 3], (Vector, f64)> =
        patches.into_iter().map(|(key, (n, p, d))| (key, (p / n, d / n))).collect();
    let mut slopes = Vec::new();
    for (key, (p, d)) in &means {
        // Half of the 26 neighbours, so that every pair counts once.
        for k in 14..27 {
            let near = [key[0] + k / 9 - 1, key[1] + k / 3 % 3 - 1, key[2] + k % 3 - 1];
            if let Some((q, e)) = means.get(&near).filter(|(q, _)| (q - p).norm() > 0.5 * edge) {
                slopes.push((e - d).abs() / (q - p).norm());
            }
        }
    }
    slopes.sort_unstable_by(f64::total_cmp);
    let at = (0.95 * slopes.len() as f64) as usize;
    slopes.get(at.min(slopes.len().saturating_sub(1))).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lateral_error_of(found: &Registration, coverage_factor: f64) -> LateralError {
        lateral_error(found, &found.quality.covariance, coverage_factor)
    }

    fn obstacle_of(found: &Registration, limits: &MapLimits) -> Option<String> {
        map_obstacle(found, &found.quality.covariance, limits)
    }
    use crate::geometry::{Point, Pose};
    use crate::registration::{RegistrationQuality, WeakDirection};
    use crate::surface::Side;
    use nalgebra::{Matrix6, Vector6};

    const HALF_MM: f64 = 300.0;
    const HEIGHT_MM: f64 = 0.05;
    const WAVE_MM: f64 = 100.0;

    /// Returns a flat part that carries a wave, d = h sin(x / w), with the given standard uncertainties of the pose.
    fn waved(sigmas: [f64; 6], twins: bool) -> Registration {
        let at = |k: usize| HALF_MM * (k as f64 / 20.0 - 1.0);
        let mut deviations: Vec<Deviation> = (0..=40)
            .flat_map(|j| (0..=40).map(move |i| (at(i), at(j))))
            .map(|(x, y)| Deviation {
                point: Point::new(x, y, 0.0),
                normal: Vector::z(),
                deviation_mm: HEIGHT_MM * (x / WAVE_MM).sin(),
                uncertainty_mm: 0.0,
                status: PointStatus::Inlier,
                in_fit: true,
            })
            .collect();
        if twins {
            // The same places again, a micrometre aside and with noise. This adds no slope to the part.
            let noisy = |(k, d): (usize, &Deviation)| Deviation {
                point: d.point + Vector::new(1e-3, 0.0, 0.0),
                deviation_mm: d.deviation_mm + if k % 2 == 0 { 1e-3 } else { -1e-3 },
                ..*d
            };
            let more: Vec<Deviation> = deviations.iter().enumerate().map(noisy).collect();
            deviations.extend(more);
        }
        let n = deviations.len() as f64;
        let objective_mm2 = deviations.iter().map(|d| d.deviation_mm * d.deviation_mm).sum::<f64>();
        let description = "x and y position repeats only to 3.4 mm".to_owned();
        let verdict = RegistrationQuality {
            inliers: deviations.len(),
            objective_mm2,
            rms_mm: (objective_mm2 / n).sqrt(),
            pv_mm: 2.0 * HEIGHT_MM,
            residual_sigma_mm: 0.0,
            covariance: Matrix6::from_diagonal(&Vector6::from(sigmas.map(|s| s * s))),
            condition: 1.0,
            weak_directions: vec![WeakDirection { description, is_undetermined: false, sigma_mm: Some(3.4) }],
            coverage: 1.0,
            alternatives: Vec::new(),
            warnings: Vec::new(),
            iterations: 1,
            converged: true,
        };
        Registration {
            cmm_from_model: Pose::identity(),
            deviations,
            trace: Vec::new(),
            side: Side::Normal,
            quality: verdict,
        }
    }

    #[test]
    fn map_error_is_lateral_sigma_times_slope() {
        let e = lateral_error_of(&waved([3.4, 1.0, 9.0, 0.0, 0.0, 0.0], false), 2.0);
        assert!((e.lateral_mm - 3.4).abs() < 1e-12, "{e:?}");
        // The steepest slope of the wave is h / w; patches see a little less of it.
        let steepest = HEIGHT_MM / WAVE_MM;
        assert!(e.slope > 0.85 * steepest && e.slope <= steepest, "{e:?}");
        assert!((e.error_mm - 2.0 * e.lateral_mm * e.slope).abs() < 1e-15);
        // A turn about z moves the corners most; turns about x and y move nothing along a flat part through the origin.
        let e = lateral_error_of(&waved([0.0, 0.0, 0.0, 1e-2, 1e-2, 2e-4], false), 2.0);
        assert!((e.lateral_mm - 2e-4 * HALF_MM * 2f64.sqrt()).abs() < 1e-9, "{e:?}");
    }

    #[test]
    fn slope_ignores_noise_of_close_points() {
        let plain = lateral_error_of(&waved([1.0; 6], false), 2.0).slope;
        let twins = lateral_error_of(&waved([1.0; 6], true), 2.0).slope;
        assert!((twins / plain - 1.0).abs() < 0.25, "{twins} against {plain}");
    }

    #[test]
    fn map_refused_above_error_limit() {
        let at = |sigma: f64| waved([sigma, 0.0, 0.0, 0.0, 0.0, 0.0], false);
        let limits = MapLimits { max_lateral_mm: 1e3, ..MapLimits::default() };
        let unit = lateral_error_of(&at(1.0), limits.coverage_factor).error_mm;
        let border = limits.max_error_share * at(1.0).quality.rms_mm / unit;
        assert_eq!(obstacle_of(&at(0.999 * border), &limits), None);
        let reason = obstacle_of(&at(1.001 * border), &limits).unwrap();
        assert!(reason.contains("repeats only to 3.4 mm") && reason.contains("registration.lock"), "{reason}");
        let near = MapLimits { max_error_share: 1e3, ..MapLimits::default() };
        assert_eq!(obstacle_of(&at(0.499), &near), None);
        let reason = obstacle_of(&at(0.501), &near).unwrap();
        assert!(reason.contains("1.00 mm, limit 1.00 mm"), "{reason}");
        // Locked directions have no variance.
        assert_eq!(obstacle_of(&at(0.0), &limits), None);
    }
}
