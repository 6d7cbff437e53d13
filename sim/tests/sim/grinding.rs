//! The grinder against what can be worked out by hand.

use crate::common::{NOMINAL, grind, grinder_payloads, level_mm, map_of, net, pass, run, small_perfect, zero_map};
use regrind_sim::body::Physics;
use regrind_sim::part::{PartSpec, ShapeSpec};
use regrind_sim::payload::Pass;
use regrind_sim::spec::GrinderSpec;
use regrind_sim::spec::{Mirrored, WorldFaults, WorldSpec};
use regrind_sim::world::World;
use regrind_testsim::payloads::decode_pass_record;
use regrind_testsim::perfect::perfect_grinder;

const HALF_MM: [f64; 2] = [15.0, 10.0];

fn world(spec: WorldSpec) -> World {
    World::new(spec).unwrap()
}

/// A deep cut, so that the pass is one stroke.
fn deep(level_mm: f64) -> Pass {
    Pass { depth_of_cut_mm: 1.0, spark_out: 0, ..pass(HALF_MM, level_mm) }
}

fn places() -> Vec<[f64; 2]> {
    crate::common::net([14.9, 9.9], 0.7)
}

fn assert_level(world: &World, level_mm: f64, within_mm: f64) {
    for ([x, y], h) in places().iter().zip(world.deviations_mm(&places())) {
        assert!((h - level_mm).abs() <= within_mm, "({x}, {y}): {h}, wanted {level_mm}");
    }
}

#[test]
fn perfect_pass_reaches_level() {
    let world = world(small_perfect());
    assert_level(&world, 0.2, 1e-15);
    let record = grind(&mut world.grinder(), 1, 0, &zero_map(HALF_MM), &pass(HALF_MM, 0.013));
    assert_level(&world, 0.013, 1e-15);
    assert_eq!(world.history()[0].roughing_strokes, 9, "187 um in strokes of 20 um");
    assert!((record.depth_mm - 0.187).abs() < 1e-15, "{record:?}");
    assert!((level_mm(&world) - 0.013).abs() < 1e-15);
}

#[test]
fn pass_record_matches_path_and_volume() {
    let mut spec = small_perfect();
    spec.part.shape = ShapeSpec::Wave { height_mm: 1e-9 };
    let world = world(spec);
    let mut grinder = world.grinder();
    grinder.prepare(4, 2, &grinder_payloads(&zero_map(HALF_MM), &deep(0.15))).unwrap();
    grinder.begin();
    run(&mut grinder, 1.0);
    let outcome = grinder.end_job(1);
    let record = decode_pass_record(&outcome.bytes).unwrap();
    // 33 mm of track with overtravel, 24 tracks 1 mm apart, at 1500 mm/min.
    let path_mm = 24.0 * 33.0 + 23.0;
    assert!((record.path_mm - path_mm).abs() < 1e-9, "{record:?}");
    assert!((outcome.duration_s - path_mm / 25.0).abs() < 1e-9, "{outcome:?}");
    // The rim's nodes stand for half a cell too many, so the sum runs over 30.5 by 20.5 mm.
    assert!((record.volume_mm3 - 0.05 * 30.5 * 20.5).abs() < 1e-9, "{record:?}");
    assert_eq!((record.job, record.cycle, record.result, record.air_share), (4, 2, 1, 0.0));
    assert_eq!((outcome.kind, outcome.format, outcome.records, outcome.coordinates), (5, 1, 1, 0));
}

#[test]
fn pass_above_surface_removes_nothing() {
    let world = world(small_perfect());
    let record = grind(&mut world.grinder(), 1, 0, &zero_map(HALF_MM), &pass(HALF_MM, 0.25));
    assert_level(&world, 0.2, 1e-15);
    assert_eq!((record.volume_mm3, record.depth_mm, record.air_share), (0.0, 0.0, 1.0));
}

#[test]
fn spark_out_reduces_error_copying() {
    let mut spec = small_perfect();
    spec.grinder.error_copying = 0.2;
    for (spark_out, left) in [(0, 0.2), (1, 0.04), (2, 0.008)] {
        let world = world(spec.clone());
        let pass = Pass { spark_out, ..deep(0.1) };
        grind(&mut world.grinder(), 1, 0, &zero_map(HALF_MM), &pass);
        assert_level(&world, 0.1 + left * 0.1, 1e-14);
    }
}

#[test]
fn correction_map_displaces_surface() {
    let slope = |x: f64, y: f64| 1e-4 * x + 2e-4 * y;
    let mirrored = |map_mirrored| WorldFaults { map_mirrored, ..WorldFaults::default() };
    type Case = (WorldFaults, f64, fn([f64; 2]) -> [f64; 2]);
    let cases: [Case; 8] = [
        (WorldFaults::default(), 1.0, |at| at),
        (WorldFaults { map_sign_flipped: true, ..WorldFaults::default() }, -1.0, |at| at),
        (mirrored(Mirrored::X), 1.0, |[x, y]| [-x, y]),
        (mirrored(Mirrored::Y), 1.0, |[x, y]| [x, -y]),
        (mirrored(Mirrored::HalfTurn), 1.0, |[x, y]| [-x, -y]),
        (mirrored(Mirrored::QuarterTurn), 1.0, |[x, y]| [-y, x]),
        (WorldFaults { map_doubled: true, ..WorldFaults::default() }, 2.0, |at| at),
        (WorldFaults { map_ignored: true, ..WorldFaults::default() }, 0.0, |at| at),
    ];
    for (faults, times, turned) in cases {
        let world = world(WorldSpec { faults: faults.clone(), ..small_perfect() });
        // The net reaches beyond the overtravel, so that nothing is held at its edge.
        grind(&mut world.grinder(), 1, 0, &map_of([18.0, 18.0], 1.0, slope), &deep(0.1));
        for (&[x, y], h) in places().iter().zip(world.deviations_mm(&places())) {
            let [at_x, at_y] = turned([x, y]);
            let wanted = 0.1 + times * slope(at_x, at_y);
            assert!((h - wanted).abs() < 1e-14, "{faults:?} at ({x}, {y}): {h}, wanted {wanted}");
        }
    }
}

#[test]
fn map_sign_flip_doubles_error() {
    let rms = |flipped: bool| {
        let mut spec = small_perfect();
        spec.grinder.straightness_x_um = [6.0, 0.0];
        spec.faults.map_sign_flipped = flipped;
        let world = world(spec);
        let mut grinder = world.grinder();
        grind(&mut grinder, 1, 0, &zero_map(HALF_MM), &deep(0.1));
        let first = world.deviations_mm(&places()).iter().map(|h| h - 0.1).collect::<Vec<_>>();
        let map = map_of([18.0, 13.0], 0.5, |x, y| 0.1 - world.deviation_mm(x, y));
        grind(&mut grinder, 1, 1, &map, &deep(0.05));
        let second = world.deviations_mm(&places()).iter().map(|h| h - 0.05).collect::<Vec<_>>();
        (crate::common::pv_rms_um(&first).1, crate::common::pv_rms_um(&second).1)
    };
    let (first, second) = rms(false);
    assert!(second < 0.01 * first, "{first} {second}");
    let (first, second) = rms(true);
    assert!((second / first - 2.0).abs() < 0.01, "{first} {second}");
}

#[test]
fn wheel_radius_error_cuts_slopes_deeper() {
    let mut spec = small_perfect();
    spec.grinder.wheel_radius_error_um = 50.0;
    let world = world(spec);
    let mut grinder = world.grinder();
    grind(&mut grinder, 1, 0, &zero_map(HALF_MM), &deep(0.1));
    // On the net's own nodes nothing is interpolated.
    for [x, y] in [[0.0, 0.0], [14.0, 9.0], [-10.0, 5.0]] {
        let nz = world.nominal(x, y).1[2];
        let h = world.deviation_mm(x, y);
        assert!((h - 0.1 + 0.05 * (1.0 / nz - 1.0)).abs() < 1e-14, "({x}, {y}): {h}");
    }
    let corrected = Pass { wheel_radius_mm: 40.05, ..deep(0.05) };
    grind(&mut grinder, 1, 1, &zero_map(HALF_MM), &corrected);
    assert_level(&world, 0.05, 1e-14);
}

#[test]
fn wear_and_thermal_growth_along_path() {
    let mut spec = small_perfect();
    spec.grinder.wear_um = 5.0;
    let worn = world(spec.clone());
    grind(&mut worn.grinder(), 1, 0, &zero_map(HALF_MM), &deep(0.1));
    let rise = worn.deviation_mm(0.0, 10.0) - worn.deviation_mm(0.0, -10.0);
    assert!((rise - 0.005 * 20.0 / 24.0).abs() < 1e-5, "{rise}");
    spec.grinder = GrinderSpec { thermal_um: 5.0, thermal_tau_s: 30.0, ..perfect_grinder() };
    let warm = world(spec);
    let mut grinder = warm.grinder();
    let fall = |world: &World| world.deviation_mm(0.0, -10.0) - world.deviation_mm(0.0, 10.0);
    grind(&mut grinder, 1, 0, &zero_map(HALF_MM), &deep(0.1));
    let first = fall(&warm);
    grind(&mut grinder, 1, 1, &zero_map(HALF_MM), &deep(0.05));
    let second = fall(&warm);
    assert!(first > 2e-3 && second > 0.0 && second < 0.5 * first, "{first} {second}");
}

#[test]
fn scallop_ridges_between_tracks() {
    let mut spec = small_perfect();
    spec.grinder.scallops = true;
    spec.part.shape = ShapeSpec::Wave { height_mm: 1e-9 };
    let world = world(spec);
    let wheel_mm = deep(0.1).wheel_radius_mm;
    let mut grinder = world.grinder();
    grinder.prepare(1, 0, &grinder_payloads(&zero_map(HALF_MM), &deep(0.1))).unwrap();
    grinder.begin();
    grinder.advance((24.0 * 33.0 + 23.0) / 50.0);
    grinder.retract();
    grinder.end_job(3);
    // Tracks lie 1 mm apart from -11.5 mm; the first half of them has been ground. h = t^2 / (8 r), and a parabola
    // between.
    let ridge_mm = 1.0 / (8.0 * wheel_mm);
    let stands = |y: f64, height_mm: f64| {
        let found = world.deviation_mm(1.3, y);
        assert!((found - height_mm).abs() < 1e-9, "at {y}: {found}, wanted {height_mm}");
    };
    stands(-5.5, 0.1);
    stands(-5.0, 0.1 + ridge_mm);
    stands(-5.25, 0.1 + 0.25 * ridge_mm);
    stands(5.0, 0.2);
    grind(&mut grinder, 1, 0, &zero_map(HALF_MM), &deep(0.1));
    stands(5.0, 0.1 + ridge_mm);
    assert!((level_mm(&world) - 0.1 - ridge_mm / 3.0).abs() < 1e-9, "{}", level_mm(&world));
    let fine = net([14.0, 9.0], 0.037);
    let (pv_um, _) = crate::common::pv_rms_um(&world.deviations_mm(&fine));
    assert!((pv_um - 1e3 * ridge_mm).abs() < 0.02e3 * ridge_mm, "{pv_um}");
}

#[test]
fn abort_leaves_part_half_ground() {
    let world = world(small_perfect());
    let mut grinder = world.grinder();
    let first = grinder.prepare(1, 0, &grinder_payloads(&zero_map(HALF_MM), &deep(0.1))).unwrap();
    assert_eq!((first.done, first.total, first.finished), (0, 1000, false));
    grinder.begin();
    assert_eq!(grinder.interlocks() & 2, 0, "the wheel is not clear of the part");
    let total_s = (24.0 * 33.0 + 23.0) / 25.0;
    let progress = grinder.advance(total_s / 2.0);
    assert!((499..=501).contains(&progress.done) && !progress.finished, "{progress:?}");
    grinder.retract();
    assert_eq!(grinder.interlocks() & 2, 2);
    let record = decode_pass_record(&grinder.end_job(3).bytes).unwrap();
    assert_eq!((record.result, world.history()[0].result), (3, 3));
    assert!((record.path_mm - total_s / 2.0 * 25.0).abs() < 1e-9);
    assert!((world.deviation_mm(0.0, -6.0) - 0.1).abs() < 1e-15);
    assert!((world.deviation_mm(0.0, 6.0) - 0.2).abs() < 1e-15);
    assert_eq!(world.grinds_begun(1, 0), 1);
}

#[test]
fn seed_reproduces_world_at_any_time_step() {
    let history = |seed: u64, step_s: f64| {
        let part = PartSpec { form_error_um: 20.0, ..small_perfect().part };
        let world = world(WorldSpec { seed, part, ..WorldSpec::default() });
        let (mut grinder, mut cmm) = (world.grinder(), world.cmm());
        let mut seen = Vec::new();
        for cycle in 0..2 {
            let payloads = grinder_payloads(&zero_map(HALF_MM), &pass(HALF_MM, 0.1 - 0.01 * f64::from(cycle)));
            grinder.prepare(1, cycle, &payloads).unwrap();
            grinder.begin();
            run(&mut grinder, step_s);
            seen.push(grinder.end_job(1).bytes);
            cmm.prepare(
                1,
                cycle,
                &crate::common::cmm_payloads(&crate::common::plan(&world, &[[0.0, 0.0], [3.0, 4.0]])),
            )
            .unwrap();
            cmm.begin();
            run(&mut cmm, step_s);
            seen.push(cmm.end_job(1).bytes);
        }
        (seen, world.deviations_mm(&places()))
    };
    let first = history(5, 1e9);
    assert_eq!(history(5, 0.37), first);
    assert_eq!(history(5, 11.0), first);
    assert_ne!(history(6, 1e9), first);
}

#[test]
fn error_sources_are_independent() {
    let left = |waviness_um: f64, repeatability_um: f64| {
        let mut spec = small_perfect();
        (spec.grinder.waviness_um, spec.grinder.repeatability_um) = (waviness_um, repeatability_um);
        let world = world(spec);
        grind(&mut world.grinder(), 1, 0, &zero_map(HALF_MM), &deep(0.1));
        world.deviations_mm(&places())
    };
    let (both, wave, fresh) = (left(1.0, 0.5), left(1.0, 0.0), left(0.0, 0.5));
    for ((both, wave), fresh) in both.iter().zip(wave).zip(fresh) {
        assert!((both - 0.1 - (wave - 0.1) - (fresh - 0.1)).abs() < 1e-14);
    }
}

#[test]
fn grinder_prepare_refuses_bad_payload() {
    let world = world(small_perfect());
    let mut grinder = world.grinder();
    let (map, good) = (zero_map(HALF_MM), deep(0.1));
    let answer = |grinder: &mut regrind_sim::grinder::Grinder, map: &_, pass: &_| {
        grinder.prepare(1, 0, &grinder_payloads(map, pass)).map(|_| 0).unwrap_or_else(|refusal| refusal.answer)
    };
    assert_eq!(grinder.prepare(1, 0, &Default::default()).unwrap_err().answer, 8);
    assert_eq!(answer(&mut grinder, &map, &Pass { nominal: [1; 32], ..good }), 8);
    assert_eq!(answer(&mut grinder, &map, &Pass { feed_mm_min: 25_000.0, ..good }), 10);
    assert_eq!(answer(&mut grinder, &map, &Pass { extent_mm: [-15.0, 900.0, -10.0, 10.0], ..good }), 10);
    assert_eq!(answer(&mut grinder, &map, &Pass { depth_of_cut_mm: 1e-4, ..good }), 10, "1000 strokes");
    assert_eq!(answer(&mut grinder, &map_of(HALF_MM, 5.0, |_, _| 0.6), &good), 10);
    grinder.begin();
    let progress = grinder.advance(1.0);
    assert!(!progress.finished && progress.fault == 1, "what was refused does not begin: {progress:?}");
    assert!(world.history().is_empty());
    assert_eq!(answer(&mut grinder, &map, &good), 0);
    let holds_another = crate::common::small_perfect();
    let faults = WorldFaults { wrong_part: true, ..WorldFaults::default() };
    let other = World::new(WorldSpec { faults, ..holds_another }).unwrap();
    assert_eq!(answer(&mut other.grinder(), &map, &good), 8);
}

#[test]
fn new_job_loads_new_blank() {
    let world = world(small_perfect());
    let mut grinder = world.grinder();
    grind(&mut grinder, 1, 0, &zero_map(HALF_MM), &deep(0.1));
    let other_identity = |nominal| {
        let mut map = zero_map(HALF_MM);
        map.nominal = nominal;
        grinder_payloads(&map, &Pass { nominal, ..deep(0.05) })
    };
    assert_eq!(grinder.prepare(1, 1, &other_identity([9; 32])).unwrap_err().answer, 8);
    assert_eq!(world.blank(), 1);
    assert!(grinder.prepare(2, 0, &other_identity([9; 32])).is_ok());
    assert_eq!(world.blank(), 2);
    assert_level(&world, 0.2, 1e-15);
    assert!(grinder.prepare(1, 1, &other_identity(NOMINAL)).is_ok(), "no part is ever loaded back; this is a third");
}

#[test]
fn cmm_and_grinder_interlock_each_other() {
    let world = world(small_perfect());
    let (mut grinder, mut cmm) = (world.grinder(), world.cmm());
    let pass = grinder_payloads(&zero_map(HALF_MM), &deep(0.1));
    let plan = crate::common::cmm_payloads(&crate::common::plan(&world, &[[0.0, 0.0]]));
    assert_eq!((grinder.interlocks(), cmm.interlocks()), (15, 15));
    cmm.prepare(1, 0, &plan).unwrap();
    grinder.prepare(1, 0, &pass).unwrap();
    grinder.begin();
    assert_eq!((grinder.interlocks(), cmm.interlocks()), (13, 11), "wheel at the part; clamp of the CMM empty");
    cmm.begin();
    assert_eq!(cmm.advance(1.0).fault, 1, "prepared, but overtaken");
    assert_eq!(cmm.prepare(1, 0, &plan).unwrap_err().answer, 9);
    grinder.retract();
    assert_eq!((grinder.interlocks(), cmm.interlocks()), (15, 11), "held, the part is still in the grinder");
    grinder.end_job(2);
    assert_eq!(cmm.interlocks(), 15);
    cmm.prepare(1, 0, &plan).unwrap();
    cmm.begin();
    assert_eq!(grinder.prepare(1, 1, &pass).unwrap_err().answer, 9);
    assert_eq!((grinder.interlocks(), cmm.interlocks()), (11, 13));
}

#[test]
fn pass_without_part_cuts_air() {
    let mut spec = small_perfect();
    spec.faults.no_part = true;
    let world = world(spec);
    let record = grind(&mut world.grinder(), 1, 0, &zero_map(HALF_MM), &deep(0.1));
    assert_eq!((record.air_share, record.volume_mm3), (1.0, 0.0));
}
