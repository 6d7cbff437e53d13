//! List of targets and of touches. A point belongs to the nearest target.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::payload::{MeasuredPoint, Plan, TouchStatus};
use regrind_formats::result::Coordinates;

/// Handling of a touch of a target that was touched before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Repeated {
    /// It is refused, and the measurement is held.
    #[default]
    Refuse,
    /// It replaces the earlier touch.
    Replace,
}

/// Parameters of the assignment of touches to targets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TouchRules {
    /// Maximum distance of a point from its target, in mm; a point farther from every target belongs to none.
    pub(super) limit_mm: f64,
    /// Time within which an identical line counts as a repetition of the same touch.
    pub(super) duplicate_window: Duration,
    pub(super) repeated: Repeated,
}

/// List of targets and of their touches.
#[derive(Clone, Debug)]
pub(super) struct TargetList {
    /// Expected position of each target; empty if any points are accepted.
    expected_mm: Vec<[f64; 3]>,
    /// Indices of the targets.
    indices: Vec<u32>,
    points: Vec<Option<MeasuredPoint>>,
    rules: TouchRules,
    /// Previous line and its time.
    last: Option<(String, Duration)>,
}

/// Meaning of a valid line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TouchAssignment {
    /// First touch of this target.
    First(u32),
    /// Repeated touch of this target, which replaces the earlier one.
    Repeated(u32),
    /// Repetition of the previous line.
    DuplicateLine,
}

impl TargetList {
    /// Creates the list of the targets of `plan`, without any touch. `what` states whether the received coordinates are
    /// centres of the probe ball or contact points on the surface. `rules` contains the rules that assign a touch to
    /// a target. If `is_free` is true, the list has no targets and accepts every point.
    pub(super) fn new(plan: &Plan, what: Coordinates, is_free: bool, rules: TouchRules) -> Self {
        let reach_mm = if what == Coordinates::Centres { plan.probe_radius_mm } else { 0.0 };
        let targets = if is_free { &[][..] } else { &plan.targets[..] };
        let expected = |k: usize| std::array::from_fn(|i| targets[k].point_mm[i] + reach_mm * targets[k].normal[i]);
        Self {
            expected_mm: (0..targets.len()).map(expected).collect(),
            indices: targets.iter().map(|target| target.index).collect(),
            points: vec![None; targets.len()],
            rules,
            last: None,
        }
    }

    fn is_free(&self) -> bool {
        self.expected_mm.is_empty()
    }

    /// Assigns the point `at_mm` to the nearest target and stores the point. `at_mm` is the position in the received
    /// line `line`, in mm. `came` is the time from the start of the measurement to the arrival of this line. Returns
    /// the index of the target, and whether this is its first touch or a replacement.
    ///
    /// If the same line as the previous one arrives within the time `duplicate_window` of the touch rules, returns
    /// `TouchAssignment::DuplicateLine` and stores nothing. If the list has no targets and accepts every point, stores
    /// the point with the next free index.
    ///
    /// # Errors
    /// Returns the reason as text if the nearest target is farther away than `limit_mm` of the touch rules. Also
    /// returns the reason if that target was already touched and the touch rules do not allow replacement.
    pub(super) fn assign(&mut self, line: &str, at_mm: [f64; 3], came: Duration) -> Result<TouchAssignment, String> {
        let before = self.last.replace((line.to_owned(), came));
        let within = |at: Duration| came.saturating_sub(at) < self.rules.duplicate_window;
        if before.is_some_and(|(text, at)| text == line && within(at)) {
            return Ok(TouchAssignment::DuplicateLine);
        }
        let point = |index| MeasuredPoint { index, status: TouchStatus::Touched, quality: 0, position_mm: at_mm };
        if self.is_free() {
            let index = self.points.len() as u32;
            self.points.push(Some(point(index)));
            return Ok(TouchAssignment::First(index));
        }
        let (k, away_mm) = self.nearest(at_mm);
        let (index, limit_mm) = (self.indices[k], self.rules.limit_mm);
        if away_mm > limit_mm {
            return Err(format!(
                "the touch is {away_mm:.3} mm from the nearest target, {index}; the limit (limit_mm) is {limit_mm} mm: \
                 check that the right part is at the position in the cell file, and touch the target again"
            ));
        }
        match (self.points[k].replace(point(index)), self.rules.repeated) {
            (None, _) => Ok(TouchAssignment::First(index)),
            (Some(_), Repeated::Replace) => Ok(TouchAssignment::Repeated(index)),
            (Some(first), Repeated::Refuse) => {
                self.points[k] = Some(first);
                let apart_mm = distance(first.position_mm, at_mm);
                Err(format!(
                    "target {index} was already touched, {apart_mm:.4} mm from this touch; the first touch remains \
                     valid: continue with the remaining targets. If the last touch of a target must replace the first \
                     touch, write repeated = \"replace\" into the cell file"
                ))
            }
        }
    }

    fn nearest(&self, at_mm: [f64; 3]) -> (usize, f64) {
        let away = self.expected_mm.iter().map(|expected| distance(*expected, at_mm)).enumerate();
        away.min_by(|(_, a), (_, b)| a.total_cmp(b)).unwrap_or((0, f64::INFINITY))
    }

    /// Returns the number of touched targets and the number of all targets. If the list accepts any points, returns the
    /// number of points and `None`.
    pub(super) fn progress(&self) -> (usize, Option<usize>) {
        (self.points.iter().flatten().count(), (!self.is_free()).then_some(self.points.len()))
    }

    /// Returns true if the list has targets and every target was touched. Returns false if the list accepts any points,
    /// because such a list has no targets.
    pub(super) fn is_complete(&self) -> bool {
        !self.is_free() && self.points.iter().all(Option::is_some)
    }

    /// Returns the plan indices of the targets that were not touched yet, in the order of the plan. Returns none if the
    /// list accepts any points.
    pub(super) fn remaining(&self) -> impl Iterator<Item = u32> + '_ {
        self.indices.iter().zip(&self.points).filter(|(_, point)| point.is_none()).map(|(index, _)| *index)
    }

    /// Returns one point for each target, in the order of the plan. A target that was not touched has a point with the
    /// status `NotFound`. If the list has no targets and accepts every point, returns the received points in the order
    /// of their arrival.
    pub(super) fn points(&self) -> Vec<MeasuredPoint> {
        let missed = |k: usize| MeasuredPoint {
            index: self.indices.get(k).copied().unwrap_or_default(),
            status: TouchStatus::NotFound,
            quality: 100,
            position_mm: [0.0; 3],
        };
        self.points.iter().enumerate().map(|(k, point)| point.unwrap_or_else(|| missed(k))).collect()
    }

    /// Returns the touched points from position `from` of the plan up to the first target that is not touched yet. That
    /// target and all later targets are left out. Returns an empty list if the target at `from` is not touched yet.
    pub(super) fn ready(&self, from: usize) -> Vec<MeasuredPoint> {
        self.points.iter().skip(from).map_while(|point| *point).collect()
    }
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::payload::{PlanTarget, TargetKind};

    /// Returns a plan for tests: `targets` targets on a line along x, 5 mm apart, on a plane that faces up.
    pub(in super::super) fn plan(targets: u32) -> Plan {
        let target = |k: u32| PlanTarget {
            index: 100 + k,
            kind: TargetKind::Part,
            point_mm: [5.0 * f64::from(k), 0.0, 0.0],
            normal: [0.0, 0.0, 1.0],
        };
        Plan {
            targets: (0..targets).map(target).collect(),
            probe_radius_mm: 1.5,
            approach_mm: 2.0,
            search_mm: 2.0,
            speed_mm_s: 5.0,
            safe_height_mm: 50.0,
            careful_start: None,
        }
    }

    pub(in super::super) const RULES: TouchRules =
        TouchRules { limit_mm: 1.0, duplicate_window: Duration::from_millis(200), repeated: Repeated::Refuse };

    fn at(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn touch_assigned_to_nearest_target() {
        let mut list = TargetList::new(&plan(3), Coordinates::Centres, false, RULES);
        // Centre of a ball of 1.5 mm radius.
        assert_eq!(list.assign("a", [5.2, 0.1, 1.6], at(0)), Ok(TouchAssignment::First(101)));
        assert!(list.assign("b", [5.2, 0.1, 0.0], at(10)).unwrap_err().contains("nearest target, 101"));
        assert!(list.assign("c", [12.5, 0.0, 1.5], at(20)).unwrap_err().contains("2.500 mm from the nearest target"));
        assert_eq!(list.assign("d", [10.0, 0.0, 1.5], at(30)), Ok(TouchAssignment::First(102)));
        assert_eq!((list.progress(), list.is_complete()), ((2, Some(3)), false));
        assert_eq!(list.remaining().collect::<Vec<_>>(), [100]);
        let points = list.points();
        assert_eq!(points.iter().map(|p| p.index).collect::<Vec<_>>(), [100, 101, 102]);
        assert_eq!((points[0].status, points[1].position_mm), (TouchStatus::NotFound, [5.2, 0.1, 1.6]));
        assert_eq!(list.assign("e", [0.0, 0.0, 1.5], at(40)), Ok(TouchAssignment::First(100)));
        assert!(list.is_complete());
        // Contact coordinates do not include the radius.
        let mut contacts = TargetList::new(&plan(3), Coordinates::Contacts, false, RULES);
        assert_eq!(contacts.assign("a", [5.0, 0.0, 0.1], at(0)), Ok(TouchAssignment::First(101)));
        assert!(contacts.assign("b", [10.0, 0.0, 1.5], at(10)).is_err());
    }

    #[test]
    fn duplicate_line_is_one_touch() {
        let mut list = TargetList::new(&plan(2), Coordinates::Centres, false, RULES);
        let centre = [0.0, 0.0, 1.5];
        assert_eq!(list.assign("a", centre, at(0)), Ok(TouchAssignment::First(100)));
        assert_eq!(list.assign("a", centre, at(150)), Ok(TouchAssignment::DuplicateLine));
        // A line that is repeated again and again does not become a new touch by its age.
        assert_eq!(list.assign("a", centre, at(300)), Ok(TouchAssignment::DuplicateLine));
        let repeated = list.assign("a", centre, at(600)).unwrap_err();
        assert!(repeated.contains("target 100 was already touched, 0.0000 mm"), "{repeated}");
        assert!(list.assign("b", [0.01, 0.0, 1.5], at(601)).unwrap_err().contains("the first touch remains valid"));
        assert_eq!(list.points()[0].position_mm, centre);
        let rules = TouchRules { repeated: Repeated::Replace, ..RULES };
        let mut list = TargetList::new(&plan(2), Coordinates::Centres, false, rules);
        assert_eq!(list.assign("a", centre, at(0)), Ok(TouchAssignment::First(100)));
        assert_eq!(list.assign("b", [0.01, 0.0, 1.5], at(1)), Ok(TouchAssignment::Repeated(100)));
        assert_eq!(list.points()[0].position_mm, [0.01, 0.0, 1.5]);
    }

    #[test]
    fn free_points_accept_every_touch() {
        let mut list = TargetList::new(&plan(2), Coordinates::Centres, true, RULES);
        assert_eq!(list.assign("a", [900.0, 0.0, 0.0], at(0)), Ok(TouchAssignment::First(0)));
        assert_eq!(list.assign("a", [900.0, 0.0, 0.0], at(1)), Ok(TouchAssignment::DuplicateLine));
        assert_eq!(list.assign("b", [901.0, 0.0, 0.0], at(2)), Ok(TouchAssignment::First(1)));
        assert_eq!((list.progress(), list.is_complete(), list.points().len()), ((2, None), false, 2));
    }
}
