//! Route over the targets. The probe travels from touch to touch in a plane above all targets, in an order that
//! shortens the travel. Every position is checked against the machine's volume before the first motion.

use std::ops::Range;
use std::sync::Arc;

use super::settings::Scanning;
use crate::error::DeviceError;
use crate::payload::{Plan, PlanTarget, TargetKind};

/// Maximum number of targets that are reordered. More targets are touched in the plan's order: the search for a better
/// order would take longer than it saves.
const MAX_ORDERED: usize = 6000;
/// Minimum z component of a normal. A target whose normal points further down is not reachable from above.
const MIN_NORMAL_Z: f64 = -0.2;
/// Maximum number of targets in one scan, so that its line is not too long for servers.
const MAX_SCAN_TARGETS: usize = 400;
/// Maximum duration of a scan, in s. A scan cannot be interrupted, so a hold waits for its end.
const MAX_SCAN_S: f64 = 30.0;
/// Minimum number of targets in a scan; a shorter row is touched.
const MIN_SCAN_TARGETS: usize = 4;
/// Minimum cosine between two successive steps of a scan (45 degrees). A row that turns by more is split.
const MIN_STEP_COSINE: f64 = 0.707;

/// Part of the route between two rises to the clearance height, with indices into the plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Leg {
    Touch(usize),
    Scan(Range<usize>),
}

/// Route over the targets of a plan.
#[derive(Clone, Debug)]
pub(super) struct Route {
    /// Touches and scans, in order.
    pub(super) legs: Vec<Leg>,
    /// Height at which the probe's centre travels, in mm.
    pub(super) clearance_mm: f64,
    /// Length of the horizontal travel, in m: `travel_m` in the order of this route, `plan_order_m` in the order of the
    /// plan.
    pub(super) travel_m: f64,
    pub(super) plan_order_m: f64,
}

impl Route {
    /// Finds a route of the probe to all targets of `plan`. `volume_mm` contains the minimum and the maximum corner of
    /// the box that the probe's centre must not leave, in mm. `machine` is the name of the machine in errors.
    ///
    /// If `scan` is given, successive targets can form a row. The distance between neighbours in a row is at most
    /// `scan.step_mm`. Rows of at least four targets are scanned, and the route keeps the order of the plan. If `scan`
    /// is `None` or no row is long enough, every target is touched, in an order that shortens the travel.
    ///
    /// # Errors
    /// Returns an error if the normal of a target points too far down to touch the target from above, or if a position
    /// of the route is outside of `volume_mm`.
    pub(super) fn find(
        plan: &Plan,
        scan: Option<Scanning>,
        volume_mm: &[[f64; 3]; 2],
        machine: &Arc<str>,
    ) -> Result<Self, DeviceError> {
        let highest = plan.targets.iter().map(|target| target.point_mm[2]).fold(f64::NEG_INFINITY, f64::max);
        let clearance_mm = highest + plan.safe_height_mm + plan.probe_radius_mm;
        for target in &plan.targets {
            check(target, plan, clearance_mm, volume_mm, machine)?;
        }
        let rows = scan.map(|scan| legs(plan, scan));
        let rows = rows.filter(|legs| legs.iter().any(|leg| matches!(leg, Leg::Scan(_))));
        let legs = rows.unwrap_or_else(|| order(plan).into_iter().map(Leg::Touch).collect());
        let order: Vec<usize> = legs.iter().flat_map(Leg::targets).collect();
        let plain: Vec<usize> = (0..plan.targets.len()).collect();
        let [travel_m, plan_order_m] = [&order, &plain].map(|order| 1e-3 * length(&order_places(plan, order)));
        Ok(Self { legs, clearance_mm, travel_m, plan_order_m })
    }
}

impl Leg {
    /// Returns the range of plan indices of the targets that this leg measures. A leg is one part of the route: a touch
    /// of one target, or a scan of several successive targets.
    pub(super) fn targets(&self) -> Range<usize> {
        match self {
            Self::Touch(k) => *k..k + 1,
            Self::Scan(targets) => targets.clone(),
        }
    }
}

/// Splits `plan` into scans (rows of targets) and single touches, in the order of the plan. These targets become single
/// touches:
///
/// - The first targets of a careful start, which are measured at a lower speed.
/// - The targets on the reference sphere.
/// - The targets in rows of fewer than four targets.
fn legs(plan: &Plan, scan: Scanning) -> Vec<Leg> {
    let careful = plan.careful_start.map_or(0, |careful| careful.target_count as usize).min(plan.targets.len());
    let mut legs: Vec<Leg> = (0..careful).map(Leg::Touch).collect();
    let mut from = careful;
    while from < plan.targets.len() {
        let row = from..row_end(plan, from, scan);
        from = row.end;
        if row.len() >= MIN_SCAN_TARGETS {
            legs.push(Leg::Scan(row));
        } else {
            legs.extend(row.map(Leg::Touch));
        }
    }
    legs
}

/// Returns the index after the last target of the row that begins at index `from` of the plan. The row ends before a
/// target whose distance from the previous target exceeds `scan.step_mm` or is 0. The row also ends at a turn of more
/// than 45 degrees, at a target that is not on the part, and at the maximum number of targets or maximum duration of a
/// scan.
fn row_end(plan: &Plan, from: usize, scan: Scanning) -> usize {
    let targets = &plan.targets[from..plan.targets.len().min(from + MAX_SCAN_TARGETS)];
    let step = |k: usize| -> [f64; 3] {
        std::array::from_fn(|axis| targets[k].point_mm[axis] - targets[k - 1].point_mm[axis])
    };
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|axis| a[axis] * b[axis]).sum::<f64>();
    let mut left_mm = MAX_SCAN_S * scan.speed_mm_s;
    let mut goes_on = |k: &usize| {
        let (k, here) = (*k, step(*k));
        let far = dot(here, here).sqrt();
        left_mm -= far;
        let near = far > 0.0 && far <= scan.step_mm && left_mm >= 0.0;
        let ahead = k == 1 || dot(here, step(k - 1)) >= MIN_STEP_COSINE * far * dot(step(k - 1), step(k - 1)).sqrt();
        near && ahead && [0, k].iter().all(|k| targets[*k].kind == TargetKind::Part)
    };
    from + 1 + (1..targets.len()).take_while(|k| goes_on(k)).count()
}

/// Returns the approach point of a target: the position of the probe's centre from which the probe moves along the
/// normal to the target.
pub(super) fn approach(target: &PlanTarget, plan: &Plan) -> [f64; 3] {
    point_on_normal(target, plan.approach_mm + plan.probe_radius_mm)
}

/// Returns the point on the normal of `target` at the signed distance `mm` from the surface, in mm. Positive distances
/// are outside of the material.
pub(super) fn point_on_normal(target: &PlanTarget, mm: f64) -> [f64; 3] {
    std::array::from_fn(|k| target.point_mm[k] + mm * target.normal[k])
}

fn check(
    target: &PlanTarget,
    plan: &Plan,
    clearance_mm: f64,
    volume_mm: &[[f64; 3]; 2],
    machine: &Arc<str>,
) -> Result<(), DeviceError> {
    if target.normal[2] < MIN_NORMAL_Z {
        return Err(DeviceError::BadPayload {
            machine: Arc::clone(machine),
            payload: "plan",
            field: format!("the z component of the normal of target {}", target.index),
            value: target.normal[2],
            limit: "-0.2 or more, because the probe comes from above; turn the part, or remove the target",
        });
    }
    let start = approach(target, plan);
    let over = [start[0], start[1], clearance_mm];
    let end = point_on_normal(target, plan.probe_radius_mm - plan.search_mm);
    for (what, at) in [("travel over", over), ("approach to", start), ("search at", end)] {
        for axis in 0..3 {
            let [least, most] = volume_mm.map(|corner| corner[axis]);
            if !(least..=most).contains(&at[axis]) {
                return Err(DeviceError::OutOfVolume {
                    machine: Arc::clone(machine),
                    motion: what,
                    target: target.index,
                    axis: ['x', 'y', 'z'][axis],
                    value_mm: at[axis],
                    min_mm: least,
                    max_mm: most,
                });
            }
        }
    }
    Ok(())
}

/// Returns an order of the targets that shortens the travel, as indices into the plan. If the plan has a careful start
/// (first targets that are measured at a lower speed), these targets stay first and keep their order. Targets on the
/// part and targets on the reference sphere are not mixed. Returns the order of the plan if the plan has more than 6000
/// targets.
fn order(plan: &Plan) -> Vec<usize> {
    let mut order: Vec<usize> = (0..plan.targets.len()).collect();
    if plan.targets.len() > MAX_ORDERED {
        return order;
    }
    let careful = plan.careful_start.map_or(0, |careful| careful.target_count as usize).min(order.len());
    let mut from = careful;
    while from < order.len() {
        let what = plan.targets[from].kind;
        let alike = plan.targets[from..].iter().take_while(|target| target.kind == what).count();
        shorten(plan, &mut order, from..from + alike);
        from += alike;
    }
    order
}

/// Reorders the elements of `order` in the range `stretch` to shorten the horizontal travel. `order` contains indices
/// into the plan. Compares three candidates: the order of the plan, this order after [`improve`], and the
/// nearest-neighbour order after [`improve`]. Keeps the shortest candidate.
fn shorten(plan: &Plan, order: &mut [usize], stretch: Range<usize>) {
    let begin = stretch.start.checked_sub(1).map(|k| place(plan, order[k]));
    let targets = &mut order[stretch];
    let places: Vec<[f64; 2]> = targets.iter().map(|k| place(plan, *k)).collect();
    let mut found = nearest(&places, begin);
    improve(&places, &mut found);
    let way = |order: &[usize]| {
        let all: Vec<[f64; 2]> = begin.into_iter().chain(order.iter().map(|k| places[*k])).collect();
        length(&all)
    };
    let plain: Vec<usize> = (0..places.len()).collect();
    let mut plain_improved = plain.clone();
    improve(&places, &mut plain_improved);
    let best = [plain, found, plain_improved].into_iter().min_by(|a, b| way(a).total_cmp(&way(b)));
    let before = targets.to_vec();
    for (k, at) in best.unwrap_or_default().into_iter().enumerate() {
        targets[k] = before[at];
    }
}

fn nearest(places: &[[f64; 2]], begin: Option<[f64; 2]>) -> Vec<usize> {
    let mut left: Vec<usize> = (0..places.len()).collect();
    let mut at = begin.unwrap_or_else(|| places.first().copied().unwrap_or_default());
    let mut order = Vec::with_capacity(left.len());
    while let Some((k, _)) =
        left.iter().enumerate().min_by(|a, b| apart(places[*a.1], at).total_cmp(&apart(places[*b.1], at)))
    {
        let next = left.swap_remove(k);
        at = places[next];
        order.push(next);
    }
    order
}

/// Shortens the tour `order` with the methods 2-opt and Or-opt. `order` contains indices into `places`, the xy
/// positions of the stops in mm. Both methods try only the nearest neighbours of each stop. The first stop stays first.
/// Ends when no change shortens the tour, or after 30 passes. Does nothing for fewer than four stops.
fn improve(places: &[[f64; 2]], order: &mut [usize]) {
    const PASSES: usize = 30;
    if order.len() < 4 {
        return;
    }
    let mut tour = Tour::new(places, order);
    for _ in 0..PASSES {
        let mut better = false;
        for stop in 0..places.len() {
            better |= tour.reverse_after(stop) || tour.reverse_before(stop) || tour.move_segment(stop);
        }
        if !better {
            break;
        }
    }
}

/// Tour that is being shortened. Its first stop stays first, because the tour does not include the travel to its first
/// stop.
struct Tour<'a> {
    places: &'a [[f64; 2]],
    order: &'a mut [usize],
    /// Index in `order` of each stop.
    at: Vec<usize>,
    /// Nearest other stops of each stop, nearest first.
    near: Vec<Vec<usize>>,
}

impl<'a> Tour<'a> {
    fn new(places: &'a [[f64; 2]], order: &'a mut [usize]) -> Self {
        let near = (0..places.len()).map(|k| neighbours(places, k)).collect();
        let mut tour = Self { places, at: vec![0; order.len()], order, near };
        tour.note(0..tour.order.len());
        tour
    }

    fn note(&mut self, stretch: Range<usize>) {
        for k in stretch {
            self.at[self.order[k]] = k;
        }
    }

    fn apart(&self, a: usize, b: usize) -> f64 {
        apart(self.places[a], self.places[b])
    }

    /// Returns the distance in mm from stop `a` to stop `b` of the tour, or 0 if `b` is `None`.
    fn to(&self, a: usize, b: Option<&usize>) -> f64 {
        b.map_or(0.0, |b| self.apart(a, *b))
    }

    fn reverse(&mut self, stretch: Range<usize>) {
        self.order[stretch.clone()].reverse();
        self.note(stretch);
    }

    /// Tries to shorten the tour by a reversal (2-opt). The reversed section begins after `stop` and ends with one of
    /// the nearest neighbours of `stop`, so this neighbour becomes the successor of `stop`. Returns true if the tour
    /// was changed, false if no such reversal shortens the tour.
    fn reverse_after(&mut self, stop: usize) -> bool {
        let i = self.at[stop];
        let Some(&next) = self.order.get(i + 1) else { return false };
        let now = self.apart(stop, next);
        for k in 0..self.near[stop].len() {
            let other = self.near[stop][k];
            let (j, saved) = (self.at[other], now - self.apart(stop, other));
            if saved <= 1e-9 {
                break;
            }
            let behind = self.order.get(j + 1);
            if j > i && saved + self.to(other, behind) - self.to(next, behind) > 1e-9 {
                self.reverse(i + 1..j + 1);
                return true;
            }
        }
        false
    }

    /// Tries to shorten the tour by a reversal (2-opt). The reversed section begins with one of the nearest neighbours
    /// of `stop` and ends before `stop`, so this neighbour becomes the predecessor of `stop`. Returns true if the tour
    /// was changed, false if no such reversal shortens the tour.
    fn reverse_before(&mut self, stop: usize) -> bool {
        let i = self.at[stop];
        if i < 2 {
            return false;
        }
        let last = self.order[i - 1];
        let now = self.apart(last, stop);
        for k in 0..self.near[stop].len() {
            let other = self.near[stop][k];
            let (j, saved) = (self.at[other], now - self.apart(stop, other));
            if saved <= 1e-9 {
                break;
            }
            if (1..i).contains(&j) {
                let before = self.order[j - 1];
                if saved + self.apart(before, other) - self.apart(before, last) > 1e-9 {
                    self.reverse(j..i);
                    return true;
                }
            }
        }
        false
    }

    /// Tries to shorten the tour by moving a section (Or-opt). The section begins with `stop` and has one to three
    /// stops. Its new position is directly after one of the nearest neighbours of `stop`. Returns true if the tour was
    /// changed, false if no such move shortens the tour.
    fn move_segment(&mut self, stop: usize) -> bool {
        let i = self.at[stop];
        for size in 1..=3 {
            if i == 0 || i + size > self.order.len() {
                return false;
            }
            let (before, last, behind) = (self.order[i - 1], self.order[i + size - 1], self.order.get(i + size));
            let saved = self.apart(before, stop) + self.to(last, behind) - self.to(before, behind);
            for k in 0..self.near[stop].len() {
                let other = self.near[stop][k];
                let j = self.at[other];
                if self.apart(other, stop) >= saved - 1e-9 {
                    break;
                }
                if (i - 1..i + size).contains(&j) {
                    continue;
                }
                let next = self.order.get(j + 1);
                if self.apart(other, stop) + self.to(last, next) - self.to(other, next) < saved - 1e-9 {
                    if j < i {
                        self.order[j + 1..i + size].rotate_right(size);
                        self.note(j + 1..i + size);
                    } else {
                        self.order[i..=j].rotate_left(size);
                        self.note(i..j + 1);
                    }
                    return true;
                }
            }
        }
        false
    }
}

/// Returns the indices of the 10 other positions in `places` that are nearest to the position with index `of`, nearest
/// first. Returns fewer indices if there are fewer than 10 other positions.
fn neighbours(places: &[[f64; 2]], of: usize) -> Vec<usize> {
    const NEAR: usize = 10;
    let mut others: Vec<usize> = (0..places.len()).filter(|k| *k != of).collect();
    let nearer = |a: &usize, b: &usize| apart(places[*a], places[of]).total_cmp(&apart(places[*b], places[of]));
    if others.len() > NEAR {
        others.select_nth_unstable_by(NEAR, nearer);
        others.truncate(NEAR);
    }
    others.sort_unstable_by(nearer);
    others
}

fn place(plan: &Plan, k: usize) -> [f64; 2] {
    let [x, y, _] = approach(&plan.targets[k], plan);
    [x, y]
}

fn order_places(plan: &Plan, order: &[usize]) -> Vec<[f64; 2]> {
    order.iter().map(|k| place(plan, *k)).collect()
}

fn apart(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn length(places: &[[f64; 2]]) -> f64 {
    places.windows(2).map(|pair| apart(pair[0], pair[1])).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::payload::CarefulStart;

    fn plan(points: impl Iterator<Item = [f64; 3]>) -> Plan {
        let target = |(index, point_mm)| PlanTarget {
            index: index as u32,
            kind: TargetKind::Part,
            point_mm,
            normal: [0.0, 0.0, 1.0],
        };
        Plan {
            targets: points.enumerate().map(target).collect(),
            probe_radius_mm: 1.5,
            approach_mm: 2.0,
            search_mm: 2.0,
            speed_mm_s: 3.0,
            safe_height_mm: 20.0,
            careful_start: None,
        }
    }

    const VOLUME: [[f64; 3]; 2] = [[-100.0; 3], [100.0; 3]];

    fn scanning(step_mm: f64) -> Option<Scanning> {
        Some(Scanning { speed_mm_s: 1.0, step_mm })
    }

    fn machine() -> Arc<str> {
        Arc::from("cmm")
    }

    /// Plan of a grid with its points in shuffled order.
    fn shuffled() -> Plan {
        plan((0..100).map(|k| (k * 37) % 100).map(|k| [f64::from(k % 10), f64::from(k / 10), 0.0]))
    }

    #[test]
    fn route_shortens_shuffled_grid() {
        let route = Route::find(&shuffled(), None, &VOLUME, &machine()).unwrap();
        assert!(route.travel_m < 0.107 && route.plan_order_m > 0.3, "{} and {}", route.travel_m, route.plan_order_m);
        let mut all: Vec<usize> = route.legs.iter().flat_map(Leg::targets).collect();
        all.sort_unstable();
        assert_eq!(all, (0..100).collect::<Vec<_>>());
    }

    #[test]
    fn route_preserves_careful_start() {
        let careful = CarefulStart { target_count: 5, speed_mm_s: 0.5 };
        let route =
            Route::find(&Plan { careful_start: Some(careful), ..shuffled() }, None, &VOLUME, &machine()).unwrap();
        assert_eq!(route.legs[..5], [0, 1, 2, 3, 4].map(Leg::Touch));
    }

    #[test]
    fn route_refuses_position_out_of_volume() {
        let outside = plan([[0.0, 0.0, 0.0], [99.0, 0.0, 77.0]].into_iter());
        let Err(DeviceError::OutOfVolume { axis, target, value_mm, .. }) =
            Route::find(&Plan { safe_height_mm: 30.0, ..outside }, None, &VOLUME, &machine())
        else {
            panic!()
        };
        assert_eq!((axis, target, value_mm), ('z', 0, 108.5));
    }

    #[test]
    fn route_scans_rows_touches_rest() {
        // Two careful targets, a row of eight and a row of eight back, a single target, and three of a sphere.
        let row = |y: f64, there: bool| (0..8).map(move |k| [f64::from(if there { k } else { 7 - k }), y, 0.0]);
        let spread = [[30.0, 0.0, 0.0], [40.0, 9.0, 0.0]].into_iter();
        let points = spread.chain(row(0.0, true)).chain(row(2.0, false)).chain([[60.0, 0.0, 0.0]]);
        let mut plan = plan(points.chain([[70.0, 0.0, 5.0], [70.5, 0.0, 5.0], [71.0, 0.0, 5.0]]));
        plan.targets[19..].iter_mut().for_each(|target| target.kind = TargetKind::ReferenceSphere);
        plan.careful_start = Some(CarefulStart { target_count: 2, speed_mm_s: 0.5 });
        let route = Route::find(&plan, scanning(1.5), &VOLUME, &machine()).unwrap();
        let touched = |targets: Range<usize>| targets.map(Leg::Touch);
        let rows = [Leg::Scan(2..10), Leg::Scan(10..18)];
        assert_eq!(route.legs, touched(0..2).chain(rows).chain(touched(18..22)).collect::<Vec<_>>());
        // A scan step shorter than that of the rows scans nothing, and the way is as short as without scanning.
        let [none, short] = [None, scanning(0.4)].map(|scan| Route::find(&plan, scan, &VOLUME, &machine()).unwrap());
        assert_eq!(short.legs, none.legs);
    }

    #[test]
    fn route_splits_long_row() {
        let plan = plan((0..1000).map(|k| [0.01 * f64::from(k), 0.0, 0.0]));
        let route = Route::find(&plan, scanning(1.0), &VOLUME, &machine()).unwrap();
        assert_eq!(route.legs, [Leg::Scan(0..400), Leg::Scan(400..800), Leg::Scan(800..1000)]);
        // At 1 mm/s no scan may be longer than 30 mm.
        let plan = super::tests::plan((0..80).map(|k| [f64::from(k), 0.0, 0.0]));
        let route = Route::find(&plan, scanning(1.0), &VOLUME, &machine()).unwrap();
        assert_eq!(route.legs, [Leg::Scan(0..31), Leg::Scan(31..62), Leg::Scan(62..80)]);
    }
}
