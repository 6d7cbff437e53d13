//! Scans: the probe is pressed on the true part, and reports its position at each target while it moves on.

use super::faults::Fault;
use super::line::Argument;
use super::line::Scanned;
use super::machine::{CommandResult, DmeMachine};
use crate::Vec3;
use crate::cmm::TouchResult;
use crate::vector::{distance, length};

/// Number of points in a line.
const IN_A_LINE: usize = 7;

impl DmeMachine {
    /// Scans an open curve: touches each target of the curve, and returns the measured points and the duration.
    /// `closed`, `format` and `data` are the three arguments of the command ScanOnCurve. Only the argument values that
    /// Regrind sends are supported.
    ///
    /// # Errors
    /// Returns an error number of the I++ DME standard, for example:
    ///
    /// - 506 if an argument is not supported
    /// - 1001 if the ball touches before the search begins
    /// - 1006 if the probe does not find the surface at a target
    /// - 2002 if the probe cannot scan
    pub(super) fn scan(&mut self, closed: &Argument, format: &Argument, data: &Argument) -> Result<CommandResult, u16> {
        let open = Argument::Name("Closed".into(), Some(vec![0.0]));
        let written =
            Argument::Names("Format".into(), ["X()", "Y()", "Z()", "IJK()", "tag"].map(str::to_owned).to_vec());
        let Argument::Name(name, Some(numbers)) = data else { return Err(502) };
        let whole = name == "Data" && numbers.len() >= 14 && numbers.len().is_multiple_of(7);
        if !self.can_scan {
            return Err(2002);
        }
        // Closed curves, curves that leave the surface, and other formats are refused: no client of this machine
        // requests them.
        if *closed != open || *format != written || !whole || !self.at_nominals {
            return Err(506);
        }
        let [_, _, approach_mm, search_mm, _, speed_mm_s, retract_mm] = self.parameters;
        let (radius_mm, frame) = (self.radius().ok_or(508u16)?, self.frame());
        let mut done = CommandResult::default();
        self.contacts += 1;
        let mut last: Option<Vec3> = None;
        let mut normal = [0.0, 0.0, 1.0];
        for (k, row) in numbers.chunks_exact(7).enumerate() {
            let point = frame.apply_inverse([row[0], row[1], row[2]]);
            let direction = frame.turned_back([row[3], row[4], row[5]]);
            let norm = length(direction);
            if norm == 0.0 || row[6] != 1.0 {
                return Err(if norm == 0.0 { 1010 } else { 506 });
            }
            normal = direction.map(|c| c / norm);
            let over: Vec3 = std::array::from_fn(|k| point[k] + (approach_mm + radius_mm) * normal[k]);
            self.check_volume(over)?;
            let centre = match self.probe.touch(point, normal, [radius_mm, approach_mm, search_mm]) {
                TouchResult::Centre(centre) => centre,
                lost => {
                    self.start_motion(over);
                    self.arrive();
                    return Err(if matches!(lost, TouchResult::Missed) { 1006 } else { 1001 });
                }
            };
            done.seconds += match last {
                Some(last) => distance(last, centre) / speed_mm_s,
                None => self.start_motion(over).seconds + self.probe.seconds_per_point(),
            };
            if k.is_multiple_of(IN_A_LINE) {
                done.scanned.push_back(Scanned { seconds: 0.0, at_mm: centre, points: Vec::new() });
            }
            let told = frame.apply(centre);
            let fields = self.scan_report.iter().map(|name| match name.as_str() {
                "X" => told[0].to_string(),
                "Y" => told[1].to_string(),
                "Z" => told[2].to_string(),
                _ => "0".to_owned(),
            });
            let line = done.scanned.back_mut().ok_or(511u16)?;
            line.points.push(fields.collect());
            (line.seconds, line.at_mm) = (done.seconds, centre);
            last = Some(centre);
            self.touched_mm = Some(centre[2]);
        }
        let end = last.ok_or(502u16)?;
        self.start_motion(std::array::from_fn(|k| end[k] + retract_mm.max(0.0) * normal[k]));
        Ok(done)
    }
}

/// Returns the fields of all points of a scan line as one list, in the order of the points. Three values of `fault`
/// change the points first:
///
/// - `UnaskedQuality` adds the field `0` at the beginning of each point.
/// - `PointLost` removes the fourth point, if the line has its full number of points (7).
/// - `PointsShifted` replaces each point except the first by the point before it.
///
/// Any other `fault` changes nothing.
pub(super) fn spoilt(mut line: Scanned, fault: Option<&Fault>) -> Vec<String> {
    match fault {
        Some(Fault::UnaskedQuality) => line.points.iter_mut().for_each(|point| point.insert(0, "0".to_owned())),
        Some(Fault::PointLost) if line.points.len() == IN_A_LINE => drop(line.points.remove(3)),
        Some(Fault::PointsShifted) if line.points.len() > 1 => {
            let first = line.points[0].clone();
            line.points.insert(0, first);
            line.points.pop();
        }
        _ => {}
    }
    line.points.concat()
}
