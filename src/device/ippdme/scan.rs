//! Scanning of rows of targets: the probe passes over them in contact. One command for each row, one point at each
//! target.
//!
//! A server reports the points of a scan as bare numbers, in lines of any length, while the probe moves. They are
//! evaluated after the server has reported the end of the scan, all or none: as many points as targets, each at its own
//! target. Some servers add a quality that was not requested; its position among the numbers is found from the
//! positions of the points.

use std::ops::Range;
use std::sync::Arc;

use super::job::{MISS_ERRORS, RoutedPlan, Worker, distance, locked};
use super::link::Failure;
use super::response::ServerError;
use super::route::{Leg, point_on_normal};
use super::syntax::Item;
use crate::error::DeviceError;
use crate::payload::{MeasuredPoint, Plan, PlanTarget, TouchStatus};

/// Radius of curvature sent for a straight curve, in mm.
const STRAIGHT_MM: f64 = 1e4;

impl Worker {
    /// Configures the server for scanning: sets the scan speed and the retract distance, and requests exactly one point
    /// at each target. Does nothing if the cell file does not configure scanning. Adds only a note for the operator if
    /// the server reports no tool radius; the targets are then touched one by one.
    ///
    /// # Errors
    /// Returns a failure if the server refuses a setting or uses another value, if an abort is ordered, or if the
    /// connection fails.
    pub(super) async fn set_up_scans(&mut self, work: &RoutedPlan) -> Result<(), Failure> {
        let Some(scan) = self.settings.scan else { return Ok(()) };
        if locked(&self.shared).radius_mm.is_none() {
            // A point of a scan does not report the radius either.
            self.session
                .note("the machine does not report the radius of the tool, so each row is touched point by point, not scanned".to_owned());
            return Ok(());
        }
        let wanted = [("ScanPar.Speed", scan.speed_mm_s), ("ScanPar.Retract", work.plan.approach_mm)];
        self.speeds_mm_s[2] = self.set(&wanted).await?[0];
        self.session.ask("OnScanReport", ["X", "Y", "Z"].map(Item::property_query).to_vec()).await?;
        let hint = [work.plan.search_mm, min_radius_mm(work)].map(Item::Number).to_vec();
        // The hint only makes the scan faster, and not every server supports it.
        self.request_if_supported("ScanOnCurveHint", hint).await?;
        self.session.ask("ScanOnCurveDensity", vec![Item::property("AtNominals", 1.0)]).await?;
        Ok(())
    }

    /// Scans the targets with the plan indices `row` in one motion, and stores their points. Returns true on success.
    /// Returns false and stores no points if the tool radius is unknown, if the probe met no surface, or if the probe
    /// met an obstacle. In these cases the caller must touch the targets one by one.
    ///
    /// # Errors
    /// Returns a failure if the server reports another error, if the points do not match the targets, if an abort is
    /// ordered, or if the connection fails.
    pub(super) async fn scan(&mut self, work: &RoutedPlan, row: Range<usize>) -> Result<bool, Failure> {
        if locked(&self.shared).radius_mm.is_none() {
            return Ok(false);
        }
        let targets = &work.plan.targets[row.clone()];
        self.set_speeds(work, row.start).await?;
        self.move_above(work, &targets[0]).await?;
        let way_mm: f64 = targets.windows(2).map(|pair| distance(pair[0].point_mm, pair[1].point_mm)).sum();
        let touch = self.motion_time(2.0 * (work.plan.approach_mm + work.plan.search_mm), 1);
        let scanned =
            self.session.request_motion("ScanOnCurve", curve(targets), touch + self.motion_time(way_mm, 2)).await;
        let points = match scanned {
            Ok(answer) if answer.data.is_empty() && answer.warnings.iter().any(is_missed) => None,
            Ok(answer) => Some(self.decode_scan(work, targets, &answer.data)?),
            Err(Failure::Refused(error)) if is_missed(&error) && error.severity <= 2 => {
                self.session.note(format!(
                    "the scan of the row from target {} failed, so this row is touched point by point: {error}",
                    targets[0].index
                ));
                self.session.clear_errors(1).await?;
                None
            }
            Err(other) => return Err(other),
        };
        self.read_position().await?;
        self.rise(work).await?;
        let is_there = points.is_some();
        let mut shared = locked(&self.shared);
        for (slot, point) in shared.points[row].iter_mut().zip(points.into_iter().flatten()) {
            *slot = Some(point);
        }
        Ok(is_there)
    }

    /// Converts the result of a scan to measured points, one for each of `targets`. `data` contains the lines of
    /// numbers that the server returned: three coordinates in mm for each point, and with some servers also a quality
    /// before or after them.
    ///
    /// # Errors
    /// Returns a failure if the number of points differs from the number of targets, or if a point is too far from its
    /// target.
    fn decode_scan(
        &self,
        work: &RoutedPlan,
        targets: &[PlanTarget],
        data: &[Vec<Item>],
    ) -> Result<Vec<MeasuredPoint>, Failure> {
        let mut lines: Vec<&Vec<Item>> = data.iter().collect();
        // A repeated line counts once: the probe is never at one place twice.
        lines.dedup();
        let numbers: Option<Vec<f64>> = lines.iter().flat_map(|line| line.iter()).map(Item::number).collect();
        let width = numbers.as_ref().map_or(0, |numbers| numbers.len() / targets.len());
        let numbers = numbers
            .filter(|numbers| matches!(width, 3 | 4) && numbers.len() == width * targets.len())
            .filter(|_| lines.iter().all(|line| line.len().is_multiple_of(width)))
            .ok_or_else(|| {
                Failure::Implausible(self.missing_value("ScanOnCurve", "one point at each target of the scan"))
            })?;
        let places = |first: usize| -> Vec<[f64; 3]> {
            numbers.chunks_exact(width).map(|point| std::array::from_fn(|k| point[first + k])).collect()
        };
        let mut found = self.check_row(work, targets, &places(0)).map(|()| 0);
        if width == 4 && found.is_err() && self.check_row(work, targets, &places(1)).is_ok() {
            found = Ok(1);
        }
        let first = found?;
        let quality = |point: &[f64]| if width == 4 { point[3 - 3 * first].clamp(0.0, 100.0) as u16 } else { 0 };
        let points = targets.iter().zip(places(first)).zip(numbers.chunks_exact(width));
        Ok(points
            .map(|((target, at_mm), said)| {
                let (index, status) = (target.index, TouchStatus::Touched);
                MeasuredPoint { index, status, quality: quality(said), position_mm: at_mm }
            })
            .collect())
    }

    /// Checks the scanned positions `places` of the probe's centre, in mm, one for each of `targets`. Each position
    /// must meet two conditions:
    ///
    /// - Its distance from the expected position of the probe's centre is at most the sum of the approach distance, the
    ///   search distance and `probe_tolerance_mm`.
    /// - Its distance from the line through its target along the normal is at most half of the distance between this
    ///   target and the nearest adjacent target of the row.
    ///
    /// # Errors
    /// Returns a failure for the first position that does not meet a condition.
    fn check_row(&self, work: &RoutedPlan, targets: &[PlanTarget], places: &[[f64; 3]]) -> Result<(), Failure> {
        for (k, (target, at_mm)) in targets.iter().zip(places).enumerate() {
            self.check_touch_position(work, target, *at_mm)?;
            let near = [k.checked_sub(1), Some(k + 1)].into_iter().flatten().filter_map(|k| targets.get(k));
            let steps = near.map(|other| distance(other.point_mm, target.point_mm));
            let most = 0.5 * steps.fold(f64::INFINITY, f64::min);
            let aside_mm = lateral_distance_mm(target, &work.plan, *at_mm);
            if aside_mm > most {
                let field = format!("the lateral distance of the scanned point from target {}", target.index);
                let (machine, unit) = (Arc::clone(&self.session.machine), "mm".to_owned());
                let error = DeviceError::OutOfRange { machine, field, value: aside_mm, min: 0.0, max: most, unit };
                return Err(Failure::Implausible(error));
            }
        }
        Ok(())
    }
}

fn is_missed(error: &ServerError) -> bool {
    MISS_ERRORS.contains(&error.number)
}

/// Returns the arguments of the I++ DME command `ScanOnCurve` for an open curve through `targets`. The arguments
/// contain for each target the point in mm, the normal, and the number 1, which marks a point on the surface.
fn curve(targets: &[PlanTarget]) -> Vec<Item> {
    let call = |name: &str, items: Vec<Item>| Item::Call(name.to_owned(), items);
    let mut format = ["X", "Y", "Z", "IJK"].map(Item::property_query).to_vec();
    format.push(Item::Name("tag".to_owned()));
    let numbers = targets.iter().flat_map(|target| target.point_mm.into_iter().chain(target.normal).chain([1.0]));
    let data = numbers.map(Item::Number).collect();
    vec![Item::property("Closed", 0.0), call("Format", format), call("Data", data)]
}

/// Returns the lateral distance of `at_mm` from `target`, in mm. `at_mm` is a position of the probe's centre. The
/// lateral distance is the distance from the line through the target along its normal.
fn lateral_distance_mm(target: &PlanTarget, plan: &Plan, at_mm: [f64; 3]) -> f64 {
    let centre = point_on_normal(target, plan.probe_radius_mm);
    let off: [f64; 3] = std::array::from_fn(|k| at_mm[k] - centre[k]);
    let along_mm: f64 = (0..3).map(|k| off[k] * target.normal[k]).sum();
    (0..3).map(|k| (off[k] - along_mm * target.normal[k]).powi(2)).sum::<f64>().sqrt()
}

/// Returns the smallest radius of curvature along the scanned rows, in mm, estimated from the change of the normal
/// between neighbouring targets. The result is at most `STRAIGHT_MM`, the value for straight rows.
fn min_radius_mm(work: &RoutedPlan) -> f64 {
    let rows = work.route.legs.iter().filter_map(|leg| if let Leg::Scan(row) = leg { Some(row.clone()) } else { None });
    let pairs = rows.flat_map(|row| work.plan.targets[row].windows(2));
    let radii = pairs.map(|pair| {
        let turn = distance(pair[0].normal, pair[1].normal);
        distance(pair[0].point_mm, pair[1].point_mm) / turn.max(1e-9)
    });
    radii.fold(STRAIGHT_MM, f64::min)
}
