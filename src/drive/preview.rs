//! Preliminary figures of the points that a CMM gives while it still measures, for display only. No gate has checked
//! them, they are not registered, and nothing is judged or recorded by them.

use regrind_control::{PreliminaryTouches, PreviewStatistics};

use crate::device::{BatchId, Coordinates, Job, MeasuredPoint, Plan, PreliminaryPoints, TargetKind, TouchStatus};
use crate::geometry::{Point, Pose};

/// Sums over the touches of the part received for a job so far.
#[derive(Debug, Default)]
pub(super) struct PreviewAccumulator {
    job: Option<Job>,
    received_points: usize,
    /// Deviations of the touched points of the part: number, sum of squares, range.
    touch_count: u32,
    square_sum_mm2: f64,
    range_mm: Option<[f64; 2]>,
    /// Place (x, y in the model frame) and deviation in micrometres of each point of the part, in
    /// the order of the plan.
    touches: Vec<([f64; 2], Option<f64>)>,
}

impl PreviewAccumulator {
    /// Adds the points `preliminary` of a running measurement to the preview (preliminary figures for display). Points
    /// with the first index 0 begin a new preview. Deletes the preview if the points belong to another job, do not
    /// follow the last added point, or do not match the targets of `plan`. `cmm_from_model` is the pose of the part that
    /// the plan assumes.
    pub(super) fn add_points(&mut self, plan: &Plan, cmm_from_model: &Pose, preliminary: &PreliminaryPoints) {
        let PreliminaryPoints { job, first_index: from, points, coordinates } = preliminary;
        if *from == 0 {
            *self = Self { job: Some(*job), ..Self::default() };
        }
        let due = plan.targets.get(*from..from.saturating_add(points.len())).unwrap_or_default();
        let fits =
            points.len() == due.len() && points.iter().zip(due).all(|(point, target)| point.index == target.index);
        if self.job != Some(*job) || self.received_points != *from || !fits {
            return self.reset();
        }
        self.received_points += points.len();
        let part = points.iter().zip(due).filter(|(_, target)| target.kind == TargetKind::Part);
        let ball_mm = if *coordinates == Coordinates::Centres { plan.probe_radius_mm } else { 0.0 };
        let model_from_cmm = cmm_from_model.inverse();
        for (point, target) in part {
            let found = (point.status == TouchStatus::Touched)
                .then(|| deviation_mm(point, &target.point_mm, &target.normal, ball_mm));
            found.into_iter().for_each(|mm| self.add_deviation(mm));
            let place = model_from_cmm.transform_point(&Point::from(target.point_mm));
            self.touches.push(([place.x, place.y], found.map(|mm| 1e3 * mm)));
        }
    }

    fn add_deviation(&mut self, mm: f64) {
        let [least, most] = self.range_mm.unwrap_or([mm, mm]);
        self.range_mm = Some([least.min(mm), most.max(mm)]);
        self.square_sum_mm2 += mm * mm;
        self.touch_count += 1;
    }

    pub(super) fn reset(&mut self) {
        *self = Self::default();
    }

    /// Returns the touches of the part from the index `from` on, at most [`PreliminaryTouches::MAX_POINTS`] of them. The
    /// result is empty if there is no measurement, or if it has not come so far.
    pub(super) fn touches_from(&self, from: u32) -> PreliminaryTouches {
        let newer = self.touches.get(from as usize..).unwrap_or_default();
        let (places_mm, deviations_um) = newer.iter().take(PreliminaryTouches::MAX_POINTS).copied().unzip();
        let of = self.job.map_or(BatchId { cycle: 0, batch: 0 }, |job| job.batch_id());
        PreliminaryTouches { cycle: of.cycle, batch: of.batch, first_index: from, places_mm, deviations_um }
    }

    /// Returns the number of touches on the part, and the RMS, minimum and maximum of their deviations in µm. Returns
    /// `None` if the part has not been touched yet.
    pub(super) fn statistics(&self) -> Option<PreviewStatistics> {
        let [least, most] = self.range_mm?;
        let rms_um = 1e3 * (self.square_sum_mm2 / f64::from(self.touch_count)).sqrt();
        Some(PreviewStatistics { touch_count: self.touch_count, rms_um, min_um: 1e3 * least, max_um: 1e3 * most })
    }
}

/// Returns the signed deviation in mm of a touched point from its target: the distance along the unit normal `normal`,
/// minus `ball_mm`. `ball_mm` is the radius of the probe, or 0 for contact points. The deviation contains the error of
/// the part and the displacement of the part in the fixture. All arguments are in the CMM frame.
fn deviation_mm(point: &MeasuredPoint, target_mm: &[f64; 3], normal: &[f64; 3], ball_mm: f64) -> f64 {
    (0..3).map(|k| (point.position_mm[k] - target_mm[k]) * normal[k]).sum::<f64>() - ball_mm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::PlanTarget;

    const JOB: Job = Job { job: 1, cycle: 1, digest: 7 };

    fn plan() -> Plan {
        let target = |index: u32| PlanTarget {
            index,
            kind: if index == 0 { TargetKind::ReferenceSphere } else { TargetKind::Part },
            point_mm: [f64::from(index), 0.0, 5.0],
            normal: [0.6, 0.0, 0.8],
        };
        Plan {
            targets: (0..6).map(target).collect(),
            probe_radius_mm: 2.0,
            approach_mm: 1.0,
            search_mm: 1.0,
            speed_mm_s: 2.0,
            safe_height_mm: 20.0,
            careful_start: None,
        }
    }

    /// Centres that are higher than the plan by the given values, and each a little to the side, which is no deviation.
    fn centres(from: u32, proud_mm: &[f64]) -> PreliminaryPoints {
        let point = |(index, proud): (u32, &f64)| MeasuredPoint {
            index,
            status: TouchStatus::Touched,
            quality: 0,
            position_mm: [f64::from(index) + (2.0 + proud) * 0.6 + 0.8, 0.3, 5.0 + (2.0 + proud) * 0.8 - 0.6],
        };
        let points = (from..).zip(proud_mm).map(point).collect();
        PreliminaryPoints { job: JOB, first_index: from as usize, points, coordinates: Coordinates::Centres }
    }

    #[test]
    fn preview_statistics_along_normals() {
        let mut touching = PreviewAccumulator::default();
        assert_eq!(touching.statistics(), None);
        touching.add_points(&plan(), &Pose::identity(), &centres(0, &[0.5, 0.003]));
        let mut rest = centres(2, &[-0.004, 9.0]);
        rest.points[1].status = TouchStatus::NotFound;
        touching.add_points(&plan(), &Pose::identity(), &rest);
        let told = touching.statistics().unwrap();
        assert_eq!(told.touch_count, 2);
        let near = |found: f64, is: f64| (found - is).abs() < 1e-9;
        assert!(near(told.min_um, -4.0) && near(told.max_um, 3.0) && near(told.rms_um, 12.5_f64.sqrt()), "{told:?}");
        // The sphere is no point of the part, and the last point was not found.
        let touches = touching.touches_from(1);
        assert_eq!((touches.cycle, touches.batch, touches.first_index, touches.deviations_um.len()), (1, 0, 1, 2));
        assert_eq!(touches.places_mm, [[2.0, 0.0], [3.0, 0.0]]);
        assert!(near(touches.deviations_um[0].unwrap(), -4.0) && touches.deviations_um[1].is_none(), "{touches:?}");
        assert_eq!(touching.touches_from(9).deviations_um, []);
    }

    #[test]
    fn preview_statistics_reset_on_mismatch() {
        for wrong in [
            centres(3, &[0.001]),
            PreliminaryPoints { job: Job { job: 2, ..JOB }, ..centres(2, &[0.001]) },
            PreliminaryPoints { first_index: 2, ..centres(3, &[0.001]) },
            PreliminaryPoints { first_index: usize::MAX - 1, ..centres(3, &[0.001]) },
            centres(2, &[0.001; 9]),
        ] {
            let mut touching = PreviewAccumulator::default();
            touching.add_points(&plan(), &Pose::identity(), &centres(0, &[0.5, 0.003]));
            touching.add_points(&plan(), &Pose::identity(), &wrong);
            assert_eq!(touching.statistics(), None, "{wrong:?}");
            // Given from the beginning they count again.
            touching.add_points(&plan(), &Pose::identity(), &centres(0, &[0.5, 0.003]));
            assert_eq!(touching.statistics().map(|told| told.touch_count), Some(1));
        }
    }
}
