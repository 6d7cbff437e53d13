//! Comparison of a measurement with its plan: rejects points that the probe cannot have touched by this plan.

use thiserror::Error;

use crate::{Coordinates, Measurement, Plan, TargetKind, TouchStatus};
use regrind_core::geometry::{Point, Vector, fit_rigid};
use regrind_figures::statistics::root_mean;

/// Reason why a measurement does not belong to the plan.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum PlanMismatch {
    /// The points equal the points of the plan.
    #[error("the points are identical to the plan, so they are not a measurement; export the measured points")]
    EqualsPlan,
    /// Points that are too far from their targets, for every pose of the part in its fixture.
    #[error(
        "the points do not fit the plan. After the best fit, touched point {number} is {distance_mm:.3} mm from its target \
         (limit {limit_mm:.1} mm). This fit turns the points by {rotation_deg:.1}° (limit {MAX_ROTATION_DEG:.0}°). Check \
         that the rows are in the order of the plan, and that the plan is of this part"
    )]
    OffTarget {
        /// Position of the worst point among the touched points of the part, from 1.
        number: usize,
        /// Distance of this point from its target after the rigid fit, in mm.
        distance_mm: f64,
        /// Largest distance that is possible, in mm.
        limit_mm: f64,
        /// Rotation angle of the rigid motion that fits the points best, in degrees.
        rotation_deg: f64,
    },
}

/// Largest rotation that is plausible, because the part lies in its fixture. If the plan fits only with a larger
/// rotation, the points were measured in another order.
const MAX_ROTATION_DEG: f64 = 30.0;
/// Allowance in addition to approach and search for the place where a touch ends, in mm.
const TOUCH_ALLOWANCE_MM: f64 = 1.0;
/// Largest relative difference in size. A larger difference is not caused by the order of the points: points in another
/// order have the size of the plan.
const MAX_SIZE_DIFFERENCE: f64 = 0.02;

impl Plan {
    /// Checks that `measurement` can be the result of this plan. Fits the planned targets on the part to the touched
    /// points by one rigid motion, and then compares each point with its target. Therefore the position of the part
    /// does not matter.
    ///
    /// Returns `Ok` without this comparison in two cases:
    ///
    /// - The points determine no fit: there are fewer than three points, or they lie on a line.
    /// - The size of the point set (root mean square distance from the centroid) differs by more than 2 % from the
    ///   plan. Other checks report this difference.
    ///
    /// # Errors
    /// - [`PlanMismatch::EqualsPlan`]: all points equal the planned points to their last decimal, so nothing was
    ///   measured.
    /// - [`PlanMismatch::OffTarget`]: a point is too far from its target, or the fit needs too large a rotation.
    pub fn check(&self, measurement: &Measurement) -> Result<(), PlanMismatch> {
        let pairs = measurement.points.iter().zip(&self.targets);
        let part = pairs.filter(|(p, t)| p.status == TouchStatus::Touched && t.kind == TargetKind::Part);
        let radius_mm = if measurement.coordinates == Coordinates::Centres { self.probe_radius_mm } else { 0.0 };
        let (mut found, mut contacts, mut wanted) = (Vec::new(), Vec::new(), Vec::new());
        for (point, target) in part {
            found.push(Point::from(point.position_mm));
            contacts.push(Point::from(target.point_mm));
            wanted.push(Point::from(target.point_mm) + Vector::from(target.normal) * radius_mm);
        }
        if equals_plan(&found, &contacts) || equals_plan(&found, &wanted) {
            return Err(PlanMismatch::EqualsPlan);
        }
        // Points of another size have another unit or belong to another part. Other checks report that better.
        if (size(&found) / size(&wanted) - 1.0).abs() > MAX_SIZE_DIFFERENCE {
            return Ok(());
        }
        // Fewer than three points, or points on a line, determine no pose.
        let Ok(fit) = fit_rigid(&wanted, &found) else { return Ok(()) };
        let off_mm = fit.residuals_mm.iter().map(Vector::norm).enumerate();
        let Some((worst, off_mm)) = off_mm.max_by(|a, b| a.1.total_cmp(&b.1)) else { return Ok(()) };
        let limit_mm = self.search_mm + self.approach_mm + TOUCH_ALLOWANCE_MM;
        // If the points are almost on a line, noise alone can cause a rotation about this line.
        let turned_deg = if is_nearly_collinear(&wanted) { 0.0 } else { fit.pose.angle_rad().to_degrees() };
        if off_mm <= limit_mm && turned_deg <= MAX_ROTATION_DEG {
            return Ok(());
        }
        Err(PlanMismatch::OffTarget { number: worst + 1, distance_mm: off_mm, limit_mm, rotation_deg: turned_deg })
    }
}

/// Returns the root mean square distance of points from their centroid, in mm.
fn size(points: &[Point]) -> f64 {
    let count = points.len().max(1) as f64;
    let middle = points.iter().map(|p| p.coords).sum::<Vector>() / count;
    root_mean(points.iter().map(|p| (p.coords - middle).norm_squared()))
}

/// Returns true if points lie almost on a line. The line leads from the centroid of the points through the farthest
/// point. No point may be farther from this line than a tenth of the distance between the centroid and the farthest
/// point.
fn is_nearly_collinear(points: &[Point]) -> bool {
    const MAX_WIDTH_SHARE: f64 = 0.1;
    let count = points.len().max(1) as f64;
    let middle = points.iter().map(|p| p.coords).sum::<Vector>() / count;
    let arms = || points.iter().map(|p| p.coords - middle);
    let Some(along) = arms().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared())) else { return true };
    let longest2 = along.norm_squared();
    let aside2 =
        arms().map(|arm| along.cross(&arm).norm_squared() / longest2.max(f64::MIN_POSITIVE)).fold(0.0, f64::max);
    aside2 <= MAX_WIDTH_SHARE * MAX_WIDTH_SHARE * longest2
}

/// Returns true if each point of `found` equals the planned point at the same index, within the rounding to its last
/// decimal. Such points are a copy of the plan and were not measured. Returns false for fewer than three points,
/// because few points can agree by chance.
fn equals_plan(found: &[Point], planned: &[Point]) -> bool {
    /// Minimum number of points; fewer can agree by chance.
    const MIN_POINTS: usize = 3;
    let is_same = |(p, q): (&Point, &Point)| p.iter().zip(q.iter()).all(|(p, q)| (p - q).abs() <= rounding_mm(*p));
    found.len() >= MIN_POINTS && found.iter().zip(planned).all(is_same)
}

/// Returns the largest rounding error of a coordinate, in mm: half a unit of its last decimal, with a small allowance.
/// Finds the number of decimals, from 3 to 9, from the value itself, because it can differ between the values of a
/// file.
fn rounding_mm(value_mm: f64) -> f64 {
    const DECIMALS: std::ops::RangeInclusive<i32> = 3..=9;
    let has = |decimals: &i32| {
        let scaled = value_mm * 10f64.powi(*decimals);
        (scaled - scaled.round()).abs() < 1e-3
    };
    let decimals = DECIMALS.into_iter().find(has).unwrap_or(*DECIMALS.end());
    0.51 * 10f64.powi(-decimals)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{MeasuredPoint, PlanTarget};

    /// Returns a plan of 5 by 4 targets on a bowl, 8 mm apart.
    fn plan() -> Plan {
        let target = |k: u32| {
            let (x, y) = (8.0 * f64::from(k % 5) - 16.0, 8.0 * f64::from(k / 5) - 12.0);
            let normal = Vector::new(-x / 100.0, -y / 100.0, 1.0).normalize();
            let point_mm = [x, y, (x * x + y * y) / 200.0];
            PlanTarget { index: k, kind: TargetKind::Part, point_mm, normal: normal.into() }
        };
        Plan {
            targets: (0..20).map(target).collect(),
            probe_radius_mm: 1.5,
            approach_mm: 2.0,
            search_mm: 2.0,
            speed_mm_s: 5.0,
            safe_height_mm: 50.0,
            careful_start: None,
        }
    }

    fn measurement(points: Vec<MeasuredPoint>, coordinates: Coordinates) -> Measurement {
        let (probe_radius_mm, temperature_c, duration_s, plan_identity) = (None, None, None, [0; 32]);
        Measurement {
            points,
            coordinates,
            probe_radius_mm,
            temperature_c,
            duration_s,
            plan_identity,
            job: 1,
            cycle: 1,
            done: 1,
        }
    }

    /// Returns touches at the targets of a plan, in the given order. Each is `error_mm` off along the normal.
    fn measured(
        plan: &Plan,
        digits: i32,
        error_mm: impl Fn(usize) -> f64,
        order: impl Fn(usize) -> usize,
    ) -> Measurement {
        let scale = 10f64.powi(digits);
        let touch = |k: usize| {
            let target = &plan.targets[order(k)];
            let centre = Point::from(target.point_mm) + Vector::from(target.normal) * (1.5 + error_mm(k));
            let at_mm = [centre.x, centre.y, centre.z].map(|v| (v * scale).round() / scale);
            MeasuredPoint { index: k as u32, status: TouchStatus::Touched, quality: 0, position_mm: at_mm }
        };
        measurement((0..plan.targets.len()).map(touch).collect(), Coordinates::Centres)
    }

    #[test]
    fn plan_check_refuses_copied_plan() {
        let plan = plan();
        for digits in [3, 4, 6, 9] {
            assert_eq!(plan.check(&measured(&plan, digits, |_| 0.0, |k| k)), Err(PlanMismatch::EqualsPlan), "{digits}");
            // If a point is off by a few units of its last digit, the part was measured.
            let part = |k: usize| if k == 7 { 5.0 * 10f64.powi(-digits) } else { 0.0 };
            assert_eq!(plan.check(&measured(&plan, digits, part, |k| k)), Ok(()), "{digits}");
        }
        let contacts = |target: &PlanTarget| MeasuredPoint {
            index: target.index,
            status: TouchStatus::Touched,
            quality: 0,
            position_mm: target.point_mm,
        };
        let given_back = measurement(plan.targets.iter().map(contacts).collect(), Coordinates::Contacts);
        assert_eq!(plan.check(&given_back), Err(PlanMismatch::EqualsPlan));
        // Seven significant digits, as many programs print: some values have five decimals, others six.
        let significant = |v: f64| -> f64 {
            let decimals = 6 - v.abs().max(1e-6).log10().floor() as i32;
            (v * 10f64.powi(decimals)).round() / 10f64.powi(decimals)
        };
        let mut rounded = measured(&plan, 12, |_| 0.0, |k| k);
        rounded.points.iter_mut().for_each(|point| point.position_mm = point.position_mm.map(significant));
        assert_eq!(plan.check(&rounded), Err(PlanMismatch::EqualsPlan));
        rounded.points[3].position_mm[2] += 2e-5;
        assert_eq!(plan.check(&rounded), Ok(()));
    }

    #[test]
    fn plan_check_refuses_reordered_points() {
        let plan = plan();
        let form = |k: usize| 1e-3 * (k as f64).sin();
        assert_eq!(plan.check(&measured(&plan, 6, form, |k| k)), Ok(()));
        // A missing row shifts all rows after it, a reversed file has the last point first, and two rows are exchanged.
        let orders: [&dyn Fn(usize) -> usize; 3] = [&|k| (k + 1) % 20, &|k| 19 - k, &|k| {
            if k == 3 {
                12
            } else if k == 12 {
                3
            } else {
                k
            }
        }];
        for order in orders {
            let found = plan.check(&measured(&plan, 6, form, order));
            assert!(matches!(found, Err(PlanMismatch::OffTarget { .. })), "{found:?}");
        }
        // Three points in a row are touched again. The middle one has a burr that is higher than the row is bent, so
        // the fit rotates the row about its own line.
        let mut row = plan.clone();
        row.targets = row.targets[5..8].to_vec();
        let burr = |k: usize| if k == 1 { 0.6 } else { 1e-3 * k as f64 };
        assert_eq!(row.check(&measured(&row, 6, burr, |k| k)), Ok(()));
        // Inches are reported by the measurement of a sphere or by the fit.
        let mut inches = measured(&plan, 6, form, |k| k);
        inches.points.iter_mut().for_each(|point| point.position_mm = point.position_mm.map(|v| v / 25.4));
        assert_eq!(plan.check(&inches), Ok(()));
    }
}
