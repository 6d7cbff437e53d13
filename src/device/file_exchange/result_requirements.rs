//! Requirements for a file that contains the measurement of a plan, whether a folder or a person provides it.

use std::collections::HashMap;
use std::path::Path;

use super::ExchangeError;
use crate::{Job, MeasuredPoint, Measurement, Plan, PlanMismatch, TouchStatus};
use regrind_core::geometry::Point;
use regrind_formats::FormatError;
use regrind_formats::result::{Content, Coordinates, ResultFile, Statements, check_ended, parse_result};

/// Requirements for a measurement.
#[derive(Clone, Copy, Debug)]
pub struct ResultRequirements<'a> {
    /// Numbers of the targets of the plan, in its order; `None` if any number of points is allowed.
    pub targets: Option<&'a [u32]>,
    /// Known properties of the files.
    pub content: &'a Content,
    /// Radius of the probe in the plan, in mm.
    pub probe_radius_mm: f64,
    /// Maximum difference in mm between this radius and that of a file.
    pub probe_tolerance_mm: f64,
}

impl ResultRequirements<'_> {
    /// Reads a file of measured points from its content `bytes`. Checks the file against the plan and the cell file.
    /// `path` is the name of the file in messages.
    ///
    /// # Errors
    /// Returns an error if the file is incomplete or not valid, if it was measured with another probe radius, or if
    /// neither the file nor the cell file states whether the coordinates are probe centres or contact points.
    pub fn read(&self, path: &Path, bytes: &[u8]) -> Result<ResultFile, ExchangeError> {
        check_ended(path, bytes)?;
        let file = parse_result(path, bytes, self.content)?;
        if file.coordinates.is_none() {
            return Err(ExchangeError::CoordinatesUnstated { path: path.to_owned() });
        }
        let (expected_mm, limit_mm) = (self.probe_radius_mm, self.probe_tolerance_mm);
        match file.probe_radius_mm.filter(|found| (found - expected_mm).abs() > limit_mm) {
            Some(found_mm) => {
                Err(ExchangeError::ProbeRadius { path: path.to_owned(), found_mm, expected_mm, limit_mm })
            }
            None => Ok(file),
        }
    }

    /// Assigns the points of `result` to the targets of the plan. Uses the target number of each row if the file has
    /// them, otherwise the order of the points. With target numbers, returns one point for each target in the order of
    /// the plan; a target without a row is marked as not found. If any number of points is allowed, returns all points,
    /// numbered from 0. `path` is used in messages.
    ///
    /// # Errors
    /// Returns an error if a target number is not in the plan or occurs twice. Without target numbers, returns an error
    /// if the number of points differs from the number of targets.
    pub fn assign_by_index(&self, path: &Path, result: &ResultFile) -> Result<Vec<MeasuredPoint>, ExchangeError> {
        let Some(targets) = self.targets else { return Ok(numbered(&result.points)) };
        let Some(indices) = &result.indices else { return self.assign_in_order(path, &result.points) };
        // In the order of the plan; a target without a row counts as not found.
        let mut all: Vec<MeasuredPoint> = targets.iter().map(|&index| not_found(index)).collect();
        let place: HashMap<u32, usize> = targets.iter().enumerate().map(|(k, &t)| (t, k)).collect();
        for (row, (index, point)) in indices.iter().zip(&result.points).enumerate() {
            let wrong = |reason| {
                let (path, line) = (path.to_owned(), row as u64 + 1);
                ExchangeError::from(FormatError::Index { path, line, found: index.to_string(), reason })
            };
            let slot = *place.get(index).ok_or_else(|| wrong("is not a target of the plan"))?;
            if all[slot].status == TouchStatus::Touched {
                return Err(wrong("occurs twice"));
            }
            all[slot] = touched(*index, (*point).into());
        }
        Ok(all)
    }

    /// Assigns `points`, in mm, to the targets of the plan in the order of the plan: the first point belongs to the
    /// first target. If any number of points is allowed, numbers the points from 0 instead. `path` is used in messages.
    ///
    /// # Errors
    /// Returns an error if the number of points differs from the number of targets of the plan.
    pub fn assign_in_order(&self, path: &Path, points: &[Point]) -> Result<Vec<MeasuredPoint>, ExchangeError> {
        match self.targets {
            None => Ok(numbered(points)),
            Some(targets) if points.len() != targets.len() => {
                let (found, expected) = (points.len(), targets.len());
                Err(ExchangeError::Count { path: path.to_owned(), found, expected })
            }
            Some(targets) => Ok(targets.iter().zip(points).map(|(&index, p)| touched(index, (*p).into())).collect()),
        }
    }
}

/// Checks a complete measurement against its plan. Call it before the measurement is accepted, because a rejected file
/// can still be replaced. `min_found` is the fraction of the targets, from 0 to 1, that need a touched point.
/// `rehearsal` is true if people only act as the machines; the plan itself may then be returned as the measurement.
/// `path` is used in messages.
///
/// # Errors
/// A measurement can be divided into several batches of touches. Returns an error in each of these cases:
///
/// - Too few targets have a touched point. The first batch needs the fraction `min_found` of its targets. Each
///   further batch needs half of its targets.
/// - The points are equal to the points of the plan, and `rehearsal` is false.
/// - After a rigid best fit of all touched points of the part to their targets, a point is too far from its target, or
///   the rotation of the fit is too large.
pub fn check_measurement(
    path: &Path,
    plan: &Plan,
    measurement: &Measurement,
    min_found: f64,
    rehearsal: bool,
) -> Result<(), ExchangeError> {
    let found = measurement.points.iter().filter(|point| point.status == TouchStatus::Touched).count();
    let expected = plan.targets.len();
    // A further batch has only a few targets, of which one may be out of reach. All batches together are checked once
    // they are there.
    let is_first = Job { job: measurement.job, cycle: measurement.cycle, digest: 0 }.batch_id().batch == 0;
    let least = if is_first { (min_found * expected as f64).ceil() as usize } else { expected.div_ceil(2) };
    if found < least {
        return Err(ExchangeError::TooFewTargets { path: path.to_owned(), found, expected, min: least });
    }
    match plan.check(measurement) {
        Err(PlanMismatch::EqualsPlan) if rehearsal => Ok(()),
        Err(beside) => Err(ExchangeError::Foreign { path: path.to_owned(), reason: beside.to_string() }),
        Ok(()) => Ok(()),
    }
}

/// Builds a measurement from its `points` and from the headers of its result files `results`. The probe radius and the
/// temperature come from the first file that states them; they are `None` if no file states them. `plan_identity` is
/// the SHA-256 of the plan. `done` is the number of the START command that began the measurement. The measurement keeps
/// this number for its acknowledgement. The duration is `None`.
pub fn assemble_measurement(
    points: Vec<MeasuredPoint>,
    results: &[ResultFile],
    job: Job,
    plan_identity: [u8; 32],
    done: u32,
) -> Measurement {
    Measurement {
        points,
        // Files without this statement were rejected.
        coordinates: results.iter().find_map(|r| r.coordinates).unwrap_or(Coordinates::Centres),
        probe_radius_mm: results.iter().find_map(|r| r.probe_radius_mm),
        temperature_c: results.iter().find_map(|r| r.statements.temperature_c),
        duration_s: None,
        plan_identity,
        job: job.job,
        cycle: job.cycle,
        done,
    }
}

/// Compares the header `says` of a result file with the expected part, cycle and plan. `plan` is the identity (SHA-256)
/// of the plan in hexadecimal digits. Returns a text about the first difference. Returns `None` if there is no
/// difference; a value that the header does not contain is no difference.
pub fn contradiction(says: &Statements, part: &str, cycle: u16, plan: &str) -> Option<String> {
    if let Some(other) = says.part.as_ref().filter(|other| *other != part) {
        return Some(format!("is of part {other}, not {part}"));
    }
    if let Some(other) = says.cycle.filter(|other| *other != cycle) {
        return Some(format!("is of cycle {other}, not {cycle}"));
    }
    says.plan.as_ref().filter(|other| *other != plan).map(|_| "was measured with another plan".to_owned())
}

fn touched(index: u32, at_mm: [f64; 3]) -> MeasuredPoint {
    MeasuredPoint { index, status: TouchStatus::Touched, quality: 0, position_mm: at_mm }
}

fn not_found(index: u32) -> MeasuredPoint {
    MeasuredPoint { index, status: TouchStatus::NotFound, quality: 100, position_mm: [0.0; 3] }
}

fn numbered(points: &[Point]) -> Vec<MeasuredPoint> {
    points.iter().zip(0..).map(|(p, index)| touched(index, (*p).into())).collect()
}
