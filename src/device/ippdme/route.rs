//! The way over the targets: from touch to touch over a plane above them all, in an order that makes the way short, and every position
//! held against the volume of the machine before the first motion.

use std::ops::Range;
use std::sync::Arc;

use crate::error::DeviceError;
use crate::payload::{Plan, Target};

/// More targets than this are touched in the order of the plan: their order would take longer to find than it saves.
const MOST_ORDERED: usize = 6000;
/// More targets than this are not improved beyond the nearest neighbour.
const MOST_IMPROVED: usize = 2500;
/// A normal that points further down than this cannot be come at from above.
const LEAST_UP: f64 = -0.2;

/// The way over the targets of a plan.
#[derive(Clone, Debug)]
pub(super) struct Route {
    /// Which target is touched when: places in the plan.
    pub(super) order: Vec<usize>,
    /// The height at which the probe's centre travels.
    pub(super) clearance_mm: f64,
    /// How long the way is across, in this order and in that of the plan.
    pub(super) travel_m: f64,
    pub(super) plain_m: f64,
}

impl Route {
    /// Finds the way.
    ///
    /// # Errors
    /// A target that cannot be come at from above, or a position outside of the volume.
    pub(super) fn over(plan: &Plan, volume_mm: &[[f64; 3]; 2], machine: &Arc<str>) -> Result<Self, DeviceError> {
        let highest = plan.targets.iter().map(|target| target.point_mm[2]).fold(f64::NEG_INFINITY, f64::max);
        let clearance_mm = highest + plan.safe_height_mm + plan.probe_radius_mm;
        for target in &plan.targets {
            check(target, plan, clearance_mm, volume_mm, machine)?;
        }
        let order = order(plan);
        let plain: Vec<usize> = (0..plan.targets.len()).collect();
        let [travel_m, plain_m] = [&order, &plain].map(|order| 1e-3 * length(&order_places(plan, order)));
        Ok(Self { order, clearance_mm, travel_m, plain_m })
    }
}

/// Where the probe's centre turns into the normal.
pub(super) fn approach(target: &Target, plan: &Plan) -> [f64; 3] {
    along(target, plan.approach_mm + plan.probe_radius_mm)
}

/// A place on the normal of a target.
pub(super) fn along(target: &Target, mm: f64) -> [f64; 3] {
    std::array::from_fn(|k| target.point_mm[k] + mm * target.normal[k])
}

fn check(
    target: &Target,
    plan: &Plan,
    clearance_mm: f64,
    volume_mm: &[[f64; 3]; 2],
    machine: &Arc<str>,
) -> Result<(), DeviceError> {
    if target.normal[2] < LEAST_UP {
        return Err(DeviceError::BadPayload {
            machine: Arc::clone(machine),
            what: "plan",
            field: format!("the height of the normal of target {}", target.index),
            value: target.normal[2],
            limit: "-0.2 or more: the probe comes from above; turn the part, or leave the target out",
        });
    }
    let start = approach(target, plan);
    let over = [start[0], start[1], clearance_mm];
    let end = along(target, plan.probe_radius_mm - plan.search_mm);
    for (what, at) in [("travel over", over), ("approach to", start), ("search at", end)] {
        for axis in 0..3 {
            let [least, most] = volume_mm.map(|corner| corner[axis]);
            if !(least..=most).contains(&at[axis]) {
                return Err(DeviceError::OutOfVolume {
                    machine: Arc::clone(machine),
                    what,
                    target: target.index,
                    axis: ['x', 'y', 'z'][axis],
                    value_mm: at[axis],
                    least_mm: least,
                    most_mm: most,
                });
            }
        }
    }
    Ok(())
}

/// The order of the touches. A careful beginning stays one, and the reference sphere is not mixed with the part.
fn order(plan: &Plan) -> Vec<usize> {
    let mut order: Vec<usize> = (0..plan.targets.len()).collect();
    if plan.targets.len() > MOST_ORDERED {
        return order;
    }
    let careful = plan.careful.map_or(0, |careful| careful.targets as usize).min(order.len());
    let mut from = careful;
    while from < order.len() {
        let what = plan.targets[from].what;
        let alike = plan.targets[from..].iter().take_while(|target| target.what == what).count();
        shorten(plan, &mut order, from..from + alike);
        from += alike;
    }
    order
}

/// Orders a stretch of the way: to the nearest neighbour, then improved by turning stretches round and by moving short ones. The plan's own
/// order stays where that is the shorter way.
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

/// Two-opt and Or-opt, until neither shortens the way.
fn improve(places: &[[f64; 2]], order: &mut Vec<usize>) {
    const PASSES: usize = 30;
    if places.len() > MOST_IMPROVED {
        return;
    }
    for _ in 0..PASSES {
        let turned = turn_stretches(places, order);
        if !move_stretches(places, order) && !turned {
            break;
        }
    }
}

/// The way between two stops of an order; none before the first and behind the last.
fn leg(places: &[[f64; 2]], order: &[usize], a: Option<usize>, b: Option<usize>) -> f64 {
    match (a.and_then(|a| order.get(a)), b.and_then(|b| order.get(b))) {
        (Some(a), Some(b)) => apart(places[*a], places[*b]),
        _ => 0.0,
    }
}

fn turn_stretches(places: &[[f64; 2]], order: &mut [usize]) -> bool {
    let mut better = false;
    // The first stop stays, for the way to it is not known here.
    for i in 1..order.len() {
        for j in i + 1..order.len() {
            let before = leg(places, order, Some(i - 1), Some(i)) + leg(places, order, Some(j), Some(j + 1));
            let after = leg(places, order, Some(i - 1), Some(j)) + leg(places, order, Some(i), Some(j + 1));
            if after < before - 1e-9 {
                order[i..=j].reverse();
                better = true;
            }
        }
    }
    better
}

fn move_stretches(places: &[[f64; 2]], order: &mut Vec<usize>) -> bool {
    let mut better = false;
    for size in 1..=3 {
        let mut i = 1;
        while i + size < order.len() {
            let cut = leg(places, order, Some(i - 1), Some(i)) + leg(places, order, Some(i + size - 1), Some(i + size));
            let saved = cut - leg(places, order, Some(i - 1), Some(i + size));
            let stretch: Vec<usize> = order.drain(i..i + size).collect();
            let (first, last) = (places[stretch[0]], places[stretch[size - 1]]);
            let costs = |k: usize| {
                let [a, b] = [order.get(k - 1), order.get(k)].map(|stop| stop.map(|stop| places[*stop]));
                let to = a.map_or(0.0, |a| apart(a, first));
                let from = b.map_or(0.0, |b| apart(last, b));
                to + from - a.zip(b).map_or(0.0, |(a, b)| apart(a, b))
            };
            let best = (1..=order.len()).min_by(|a, b| costs(*a).total_cmp(&costs(*b))).unwrap_or(i);
            let to = if costs(best) < saved - 1e-9 { best } else { i };
            better |= to != i;
            order.splice(to..to, stretch);
            i += 1;
        }
    }
    better
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
    use crate::payload::{Careful, TargetKind};

    fn plan(points: impl Iterator<Item = [f64; 3]>) -> Plan {
        let target = |(index, point_mm)| Target {
            index: index as u32,
            what: TargetKind::Part,
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
            careful: None,
        }
    }

    const VOLUME: [[f64; 3]; 2] = [[-100.0; 3], [100.0; 3]];

    fn machine() -> Arc<str> {
        Arc::from("cmm")
    }

    /// A grid whose points come shuffled.
    fn shuffled() -> Plan {
        plan((0..100).map(|k| (k * 37) % 100).map(|k| [f64::from(k % 10), f64::from(k / 10), 0.0]))
    }

    #[test]
    fn a_shuffled_grid_is_walked_almost_without_a_step_too_many() {
        let route = Route::over(&shuffled(), &VOLUME, &machine()).unwrap();
        assert!(route.travel_m < 0.107 && route.plain_m > 0.3, "{} and {}", route.travel_m, route.plain_m);
        let mut all = route.order.clone();
        all.sort_unstable();
        assert_eq!(all, (0..100).collect::<Vec<_>>());
    }

    #[test]
    fn a_careful_beginning_stays_the_beginning() {
        let careful = Careful { targets: 5, speed_mm_s: 0.5 };
        let route = Route::over(&Plan { careful: Some(careful), ..shuffled() }, &VOLUME, &machine()).unwrap();
        assert_eq!(route.order[..5], [0, 1, 2, 3, 4]);
    }

    #[test]
    fn a_position_outside_of_the_volume_is_named_before_anything_moves() {
        let outside = plan([[0.0, 0.0, 0.0], [99.0, 0.0, 77.0]].into_iter());
        let Err(DeviceError::OutOfVolume { axis, target, value_mm, .. }) =
            Route::over(&Plan { safe_height_mm: 30.0, ..outside }, &VOLUME, &machine())
        else {
            panic!()
        };
        assert_eq!((axis, target, value_mm), ('z', 0, 108.5));
    }
}
