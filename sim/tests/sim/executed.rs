//! The wheel along a path that somebody else executes, against what can be worked out by hand and against the grinder
//! that makes its own.

use crate::common::{grind, level_mm, net, pass, small_perfect, zero_map};
use regrind_sim::cmm::TouchResult;
use regrind_sim::spec::{GrinderSpec, WorldSpec};
use regrind_sim::world::World;

const HALF_MM: [f64; 2] = [15.0, 10.0];
const RADIUS_MM: f64 = 12.5;

/// Moves the wheel over tracks along x, to and fro, at a height over the nominal surface, as a program has it that
/// lifts off after each.
fn sweep(world: &World, spacing_mm: f64, height_mm: f64, tracks: impl Iterator<Item = u32>, until_x_mm: f64) {
    let mut wheel = world.wheel(RADIUS_MM).unwrap();
    let mut clock = 0.0;
    let mut to = |wheel: &mut regrind_sim::executed_wheel::Wheel, place: [f64; 3]| {
        clock += 1e-3;
        wheel.move_to(place, clock);
    };
    let above = |x: f64, y: f64, over_mm: f64| {
        let (point, n) = world.nominal(x, y);
        [0, 1, 2].map(|k| point[k] + (RADIUS_MM + over_mm) * n[k])
    };
    for track in tracks {
        let y = -HALF_MM[1] + (f64::from(track) + 0.5) * spacing_mm;
        let way = |k: u32| if track % 2 == 0 { f64::from(k) * 0.2 - 17.0 } else { 17.0 - f64::from(k) * 0.2 };
        to(&mut wheel, above(way(0), y, 20.0));
        (0..=170).filter(|k| way(*k) <= until_x_mm).for_each(|k| to(&mut wheel, above(way(k), y, height_mm)));
        to(&mut wheel, above(way(170).min(until_x_mm), y, 20.0));
    }
    wheel.finish_waiting_track();
}

fn over(world: &World, half_mm: [f64; 2]) -> Vec<f64> {
    world.deviations_mm(&net(half_mm, 0.7))
}

#[test]
fn executed_path_determines_surface() {
    // 20 mm in a whole number of tracks.
    for spacing_mm in [0.25, 0.8, 2.0] {
        let world = World::new(small_perfect()).unwrap();
        sweep(&world, spacing_mm, 0.013, 0..(20.0 / spacing_mm).round() as u32, 99.0);
        let off = over(&world, [14.9, 9.9]).iter().fold(0.0, |most: f64, h| most.max((h - 0.013).abs()));
        assert!(off < 1e-9, "{off} mm at {spacing_mm} mm");
        let [pass] = world.executed_passes()[..] else { panic!("one pass") };
        assert_eq!((pass.strokes, pass.strokes_in_air), (1.0, 0.0), "nothing twice, and nothing left out");
        assert!((pass.spacing_mm - spacing_mm).abs() < 1e-9, "{pass:?}");
    }
}

/// A controller whose next lines are late slows down on a track. The track must not move in y because of the places at
/// which the wheel was slow.
#[test]
fn slow_wheel_leaves_same_surface() {
    let surface = |slow_steps: u32| {
        let world = World::new(small_perfect()).unwrap();
        let mut wheel = world.wheel(RADIUS_MM).unwrap();
        let mut clock = 0.0;
        for track in 0..40 {
            // Each track drifts in y, to and fro, by a fifth of the spacing.
            let y_mm = |x_mm: f64| -9.75 + 0.5 * f64::from(track) + 0.05 * x_mm / 17.0;
            let mut to = |x_mm: f64, over_mm: f64| {
                let (point, n) = world.nominal(x_mm, y_mm(x_mm));
                clock += 1e-3;
                wheel.move_to([0, 1, 2].map(|k| point[k] + (RADIUS_MM + over_mm) * n[k]), clock);
            };
            let along = |x_mm: f64| if track % 2 == 0 { x_mm } else { -x_mm };
            to(along(-17.0), 20.0);
            for k in 0..170 {
                let steps = if track % 3 == 0 && k < 60 { slow_steps } else { 1 };
                (0..steps)
                    .for_each(|s| to(along(-17.0 + 0.2 * (f64::from(k) + f64::from(s) / f64::from(steps))), 0.013));
            }
            to(along(17.0), 0.013);
            to(along(17.0), 20.0);
        }
        wheel.finish_waiting_track();
        let [pass] = world.executed_passes()[..] else { panic!("one pass") };
        (pass.spacing_mm, over(&world, [14.0, 9.0]))
    };
    let [(steady_mm, steady), (slow_mm, slow)] = [1, 8].map(surface);
    assert!((steady_mm - slow_mm).abs() < 1e-4, "{steady_mm} {slow_mm}");
    let off = steady.iter().zip(&slow).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()));
    assert!(off < 2e-6, "{off} mm");
}

#[test]
fn executed_path_matches_simulated_pass() {
    // What depends on the feed, on the path's own time and on how the wheel is touched off is left out.
    let of = GrinderSpec {
        wheel_radius_error_um: 0.0,
        following_um: 0.0,
        wear_um: 0.0,
        break_in_um: 0.0,
        thermal_um: 0.0,
        ..GrinderSpec::default()
    };
    let spec = WorldSpec { grinder: of, ..small_perfect() };
    let [along, own] = [(); 2].map(|()| World::new(spec.clone()).unwrap());
    sweep(&along, 0.5, 0.05, 0..40, 99.0);
    let deep = regrind_sim::payload::Pass {
        depth_of_cut_mm: 1.0,
        spark_out: 0,
        wheel_radius_mm: RADIUS_MM,
        track_spacing_mm: 0.5,
        ..pass(HALF_MM, 0.05)
    };
    grind(&mut own.grinder(), 1, 0, &zero_map(HALF_MM), &deep);
    // Their tracks lie elsewhere: the ridges, of 2.5 um there, are not at the same places.
    let [a, b] = [&along, &own].map(|world| over(world, [14.0, 9.0]));
    let off: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a - b).collect();
    let (most, mean) = (off.iter().fold(0.0, |m: f64, d| m.max(d.abs())), off.iter().sum::<f64>() / off.len() as f64);
    assert!(most < 3.1e-3 && mean.abs() < 0.3e-3, "off by {most} at most, {mean} mm in the mean");
    assert!((level_mm(&along) - level_mm(&own)).abs() < 0.2e-3);
}

#[test]
fn unreached_surface_unchanged() {
    let world = World::new(small_perfect()).unwrap();
    sweep(&world, 0.5, 0.0, 0..10, 3.0);
    assert!(world.deviation_mm(8.0, -9.0) > 0.199, "beyond where it lifted off");
    assert!(world.deviation_mm(0.0, 5.0) > 0.199, "beside its last track");
    assert!(world.deviation_mm(-5.0, -7.75).abs() < 1e-6, "on a track");
}

#[test]
fn unknown_wheel_position_grinds_nothing() {
    let world = World::new(small_perfect()).unwrap();
    let mut wheel = world.wheel(RADIUS_MM).unwrap();
    for k in 0..100 {
        wheel.move_to([0.0, 0.0, 12.5], f64::from(k) * 1e-3);
        wheel.set_position_unknown();
    }
    assert!(world.executed_passes().is_empty() && world.deviation_mm(0.0, 0.0) > 0.199);
}

#[test]
fn touch_unexpected_after_lost_path() {
    let touched = |world: &World| {
        let (point, normal) = world.nominal(0.0, 0.0);
        world.touch_probe().touch(point, normal, [1.5, 2.0, 2.0])
    };
    let world = World::new(small_perfect()).unwrap();
    assert!(matches!(touched(&world), TouchResult::Centre(_)));
    let mut wheel = world.wheel(RADIUS_MM).unwrap();
    wheel.move_to([0.0, 0.0, 90.0], 0.0);
    wheel.path_lost();
    assert_eq!(touched(&world), TouchResult::Unexpected);
    // And one that the wheel was driven into.
    let world = World::new(small_perfect()).unwrap();
    let mut wheel = world.wheel(RADIUS_MM).unwrap();
    wheel.move_to([0.0, 0.0, 90.0], 0.0);
    wheel.move_to([0.0, 0.0, 5.0], 0.1);
    assert_eq!(touched(&world), TouchResult::Unexpected);
    // Where the wheel is, no probe is.
    let world = World::new(small_perfect()).unwrap();
    let mut wheel = world.wheel(RADIUS_MM).unwrap();
    wheel.move_to([0.0, 0.0, 90.0], 0.0);
    wheel.move_to([0.0, 0.0, 12.55], 0.1);
    assert_eq!(touched(&world), TouchResult::Unexpected);
    wheel.move_to([0.0, 0.0, 90.0], 0.2);
    assert!(matches!(touched(&world), TouchResult::Centre(_)));
    assert!(world.wheel(0.0).is_err());
}
