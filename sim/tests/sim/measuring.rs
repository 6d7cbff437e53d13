//! The measuring machine against closed forms.

use crate::common::{cmm_payloads, measure, net, plan, run, small_perfect};
use regrind_sim::Vec3;
use regrind_sim::aperture::Aperture;
use regrind_sim::body::Physics;
use regrind_sim::part::{PartSpec, ShapeSpec};
use regrind_sim::payload::{Feature, Plan, Status, Target};
use regrind_sim::spec::CmmSpec;
use regrind_sim::spec::{WorldFaults, WorldSpec};
use regrind_sim::world::World;
use regrind_testsim::payloads::decode_points;

fn world(spec: WorldSpec) -> World {
    World::new(spec).unwrap()
}

fn distance(a: Vec3, b: Vec3) -> f64 {
    (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

/// A concave sphere of radius 60 with 0.2 mm of stock: centres lie on the sphere of radius 59.8 less the ball's about
/// (0, 0, 60).
const CENTRE: Vec3 = [0.0, 0.0, 60.0];

#[test]
fn sphere_centres_concentric_in_any_pose() {
    let mut spec = small_perfect();
    spec.cmm.translation_mm = [0.7, -0.4, 0.2];
    spec.cmm.rotation_deg = [0.6, -0.4, 2.0];
    let world = world(spec);
    let (outcome, records) = measure(&mut world.cmm(), &plan(&world, &net([13.0, 8.0], 1.5)));
    assert_eq!((outcome.kind, outcome.format, outcome.coordinates), (4, 1, 1));
    assert_eq!((outcome.records as usize, outcome.probe_radius_mm, outcome.scale_mm), (records.len(), 1.5, 1.0));
    let middle = world.placement().apply(CENTRE);
    for record in &records {
        assert_eq!((record.status, record.quality), (Status::Touched, 0));
        let d = distance(record.position_mm, middle);
        assert!((d - 58.3).abs() < 1e-10, "{d} at {}", record.index);
    }
}

#[test]
fn probe_radius_error_and_part_expansion() {
    let mut spec = small_perfect();
    spec.cmm.probe_radius_error_um = 10.0;
    spec.cmm.part_temperature_c = 25.0;
    spec.cmm.cte_per_k = 1e-5;
    let world = world(spec);
    let (outcome, records) = measure(&mut world.cmm(), &plan(&world, &[[0.0, 0.0], [9.0, -4.0]]));
    assert_eq!((outcome.probe_radius_mm, outcome.temperature_c), (1.5, 25.0), "the machine believes what it was told");
    for record in records {
        let d = distance(record.position_mm, CENTRE.map(|c| c * 1.00005));
        assert!((d - (59.8 * 1.00005 - 1.51)).abs() < 1e-10, "{d}");
    }
}

#[test]
fn cmm_touches_reference_sphere() {
    let world = world(small_perfect());
    let [cx, cy, cz] = CmmSpec::default().sphere_centre_mm;
    let mut plan = plan(&world, &[[0.0, 0.0]]);
    for (index, normal) in [(7, [0.0, 0.0, 1.0]), (8, [0.6, 0.0, 0.8]), (9, [0.0, -0.6, 0.8])] {
        let point_mm = [cx + 12.5 * normal[0], cy + 12.5 * normal[1] + 0.2, cz + 12.5 * normal[2]];
        plan.targets.push(Target { index, feature: Feature::ReferenceSphere, point_mm, normal });
    }
    let (_, records) = measure(&mut world.cmm(), &plan);
    for record in &records[1..] {
        let d = distance(record.position_mm, [cx, cy, cz]);
        assert!(record.status == Status::Touched && (d - 14.0).abs() < 1e-11, "{d}");
    }
    assert_eq!(records.iter().map(|r| r.index).collect::<Vec<_>>(), [0, 7, 8, 9]);
}

#[test]
fn target_not_found_off_edge_or_no_part() {
    let beyond = world(small_perfect());
    let mut plan = plan(&beyond, &[[0.0, 0.0], [15.5, 0.0]]);
    let statuses = |world: &World, plan: &Plan| {
        measure(&mut world.cmm(), plan).1.iter().map(|r| (r.status, r.position_mm)).collect::<Vec<_>>()
    };
    let found = statuses(&beyond, &plan);
    assert_eq!((found[0].0, found[1]), (Status::Touched, (Status::NotFound, [0.0; 3])));
    plan.search_mm = 0.0;
    plan.approach_mm = 0.1;
    // The stock of 0.2 mm stands in the way of an approach to 0.1 mm.
    assert_eq!(statuses(&beyond, &plan)[0].0, Status::NotReached);
    let faults = WorldFaults { no_part: true, ..WorldFaults::default() };
    let bare = world(WorldSpec { faults, ..small_perfect() });
    assert!(statuses(&bare, &plan).iter().all(|(status, _)| *status == Status::NotFound));
}

#[test]
fn part_turned_180_faults_cmm() {
    let faults = WorldFaults { part_turned_180: true, ..WorldFaults::default() };
    let world = world(WorldSpec { faults, ..WorldSpec::default() });
    let mut cmm = world.cmm();
    let plan = plan(&world, &net([49.0, 29.0], 2.0));
    cmm.prepare(1, 0, &cmm_payloads(&plan)).unwrap();
    cmm.begin();
    let progress = cmm.advance(1e6);
    assert_eq!((progress.fault, progress.finished), (2, false), "{progress:?}");
    assert_eq!(cmm.interlocks() & 2, 2, "the probe is clear after the stop");
    let outcome = cmm.end_job(4);
    let records = decode_points(&outcome.bytes, None).unwrap();
    assert_eq!(records.len(), plan.targets.len(), "a record for every target, reached or not");
    assert!(records.iter().filter(|r| r.status == Status::NotReached).count() > 20);
}

#[test]
fn noise_outlier_and_miss_rates() {
    let mut spec = small_perfect();
    spec.cmm.noise_um = 0.5;
    let noisy = world(spec.clone());
    let places = net([14.0, 9.0], 0.4);
    let from = |world: &World| {
        let (_, records) = measure(&mut world.cmm(), &plan(world, &places));
        let touched = records.iter().filter(|r| r.status == Status::Touched);
        (touched.map(|r| distance(r.position_mm, CENTRE) - 58.3).collect::<Vec<_>>(), records.len())
    };
    let (off, count) = from(&noisy);
    let (_, rms) = crate::common::pv_rms_um(&off);
    assert!(off.len() == count && (rms - 0.5).abs() < 0.03, "{rms}");
    (spec.cmm.outlier_share, spec.cmm.not_found_share) = (0.05, 0.1);
    let (off, count) = from(&world(spec));
    let far = off.iter().filter(|d| d.abs() > 3e-3).count() as f64 / count as f64;
    let missed = 1.0 - off.len() as f64 / count as f64;
    assert!((0.03..0.06).contains(&far) && (0.08..0.12).contains(&missed), "{far} {missed}");
}

#[test]
fn part_pose_shifts_only_on_loading() {
    let world = world(WorldSpec { part: small_perfect().part, ..WorldSpec::default() });
    let (mut cmm, mut grinder) = (world.cmm(), world.grinder());
    let plan = plan(&world, &[[0.0, 0.0]]);
    measure(&mut cmm, &plan);
    let first = world.placement();
    measure(&mut cmm, &plan);
    assert_eq!(world.placement(), first);
    crate::common::grind(
        &mut grinder,
        1,
        0,
        &crate::common::zero_map([15.0, 10.0]),
        &crate::common::pass([15.0, 10.0], 0.1),
    );
    measure(&mut cmm, &plan);
    let shift = distance(world.placement().translation_mm, first.translation_mm);
    assert!((1e-4..0.15).contains(&shift), "{shift}");
}

#[test]
fn world_faults_alter_points() {
    let spec = small_perfect();
    let read = |faults: WorldFaults, scaled: bool| {
        let mut spec = WorldSpec { faults, ..spec.clone() };
        spec.cmm.scaled_points = scaled;
        let world = world(spec);
        let plan = plan(&world, &[[0.0, 0.0], [3.0, 4.0], [6.0, 1.0]]);
        let mut cmm = world.cmm();
        cmm.prepare(1, 0, &cmm_payloads(&plan)).unwrap();
        cmm.begin();
        run(&mut cmm, 1.0);
        (cmm.end_job(1), plan)
    };
    let (plain, plan) = read(WorldFaults::default(), false);
    let truth = decode_points(&plain.bytes, None).unwrap();
    let (scaled, _) = read(WorldFaults::default(), true);
    assert_eq!((scaled.format, scaled.scale_mm, scaled.bytes.len()), (2, 1e-6, 60));
    for (a, b) in decode_points(&scaled.bytes, Some(1e-6)).unwrap().iter().zip(&truth) {
        assert!(distance(a.position_mm, b.position_mm) < 1e-6);
    }
    let (inches, _) = read(WorldFaults { inches: true, ..WorldFaults::default() }, false);
    for (a, b) in decode_points(&inches.bytes, None).unwrap().iter().zip(&truth) {
        assert!(distance(a.position_mm.map(|c| c * 25.4), b.position_mm) < 1e-12);
    }
    let contact = WorldFaults { returns_contact_points: true, ..WorldFaults::default() };
    let (lying, _) = read(contact.clone(), false);
    let (honest, _) = read(WorldFaults { contact_points_declared: true, ..contact }, false);
    assert_eq!((lying.coordinates, honest.coordinates), (1, 2));
    for ((a, b), target) in decode_points(&lying.bytes, None).unwrap().iter().zip(&truth).zip(&plan.targets) {
        let back: Vec3 = std::array::from_fn(|i| b.position_mm[i] - 1.5 * target.normal[i]);
        assert!(distance(a.position_mm, back) < 1e-12);
    }
    let (short, _) = read(WorldFaults { missing_records: 2, ..WorldFaults::default() }, false);
    assert_eq!((short.records, short.bytes.len()), (1, 32));
    let (none, _) = read(WorldFaults { missing_records: 99, non_finite_point: true, ..WorldFaults::default() }, false);
    assert_eq!((none.records, none.bytes.len()), (0, 0));
    let (nan, _) = read(WorldFaults { non_finite_point: true, ..WorldFaults::default() }, false);
    assert!(f64::from_be_bytes(nan.bytes[40..48].try_into().unwrap()).is_nan());
    assert_eq!(decode_points(&nan.bytes, None), None);
}

#[test]
fn cmm_refuses_plan_beyond_travel() {
    let world = world(small_perfect());
    let mut cmm = world.cmm();
    let good = plan(&world, &[[0.0, 0.0]]);
    let mut far = good.clone();
    far.targets[0].point_mm[0] = 499.0;
    far.targets[0].normal = [1.0, 0.0, 0.0];
    let high = Plan { safe_height_mm: 900.0, ..good.clone() };
    for plan in [far, high] {
        assert_eq!(cmm.prepare(1, 0, &cmm_payloads(&plan)).unwrap_err().answer, 10);
        assert_eq!(cmm.check(1, &cmm_payloads(&plan).plan.unwrap()).unwrap_err().answer, 10);
    }
    assert_eq!(cmm.prepare(1, 0, &Default::default()).unwrap_err().answer, 8);
    assert_eq!(cmm.check(2, &cmm_payloads(&good).plan.unwrap()).unwrap_err().answer, 8);
    assert!(cmm.check(1, &cmm_payloads(&good).plan.unwrap()).is_ok());
}

#[test]
fn stop_marks_unreached_targets() {
    let world = world(small_perfect());
    let mut cmm = world.cmm();
    cmm.prepare(1, 0, &cmm_payloads(&plan(&world, &net([10.0, 5.0], 5.0)))).unwrap();
    cmm.begin();
    let progress = cmm.advance(4.5);
    assert_eq!((progress.done, progress.total, progress.finished), (4, 15, false));
    cmm.retract();
    assert_eq!(cmm.interlocks(), 15);
    cmm.advance(1.0);
    assert_eq!(cmm.interlocks(), 13);
    let outcome = cmm.end_job(2);
    let records = decode_points(&outcome.bytes, None).unwrap();
    assert_eq!((records.len(), outcome.duration_s), (15, 5.5));
    assert_eq!(records.iter().filter(|r| r.status == Status::Touched).count(), 5);
    assert!(records[5..].iter().all(|r| r.status == Status::NotReached));
}

#[test]
fn default_fixture_points_all_found() {
    for seed in 1..=5 {
        let world = world(WorldSpec { seed, ..WorldSpec::default() });
        let (_, records) = measure(&mut world.cmm(), &plan(&world, &net([50.5, 30.5], 50.5 / 30.0)));
        let lost = records.iter().filter(|r| r.status != Status::Touched).count();
        assert_eq!(lost, 0, "of {} at seed {seed}", records.len());
    }
}

#[test]
fn cmm_touches_1800_points() {
    let world = world(WorldSpec::default());
    let plan = plan(&world, &net([49.0, 29.0], 1.77));
    let (_, records) = measure(&mut world.cmm(), &plan);
    let touched = records.iter().filter(|r| r.status == Status::Touched).count();
    assert_eq!(touched, records.len());
}

#[test]
fn world_spec_round_trip_all_shapes() {
    let table = r#"
        seed = 4
        [part]
        shape = { kind = "xy-polynomial", normalisation_radius_mm = 30, coefficients = [{ i = 2, j = 0, value_mm = 1.5 }] }
        aperture = { kind = "circle", radius_mm = 20.0 }
        [cmm]
        noise_um = 0.1
        [faults]
        map_mirrored = "x"
    "#;
    let spec: WorldSpec = toml::from_str(table).unwrap();
    assert_eq!((spec.seed, spec.cmm.noise_um, spec.part.stock_um), (4, 0.1, 200.0));
    assert_eq!(spec.part.aperture, Aperture::circle(20.0));
    assert_eq!(toml::from_str::<WorldSpec>(&toml::to_string(&spec).unwrap()).unwrap(), spec);
    assert!(toml::from_str::<WorldSpec>("[cmm]\nnoise = 1").is_err());
    assert!(toml::from_str::<WorldSpec>("[part]\nshape = { kind = \"sphere\", radius_mm = 5, r = 1 }").is_err());
    let shapes = [
        spec.part.shape,
        ShapeSpec::FreeForm {},
        ShapeSpec::Sphere { radius_mm: -90.0 },
        ShapeSpec::Biconic { radius_mm: [90.0, -140.0], conic: [-0.7, 1.2] },
        ShapeSpec::OffAxisAsphere { radius_mm: 200.0, conic: -1.0, fourth: 1e-9, shift_mm: 60.0 },
        ShapeSpec::Wave { height_mm: 0.01 },
    ];
    for shape in shapes {
        let part = PartSpec { shape: shape.clone(), aperture: Aperture::circle(20.0), ..PartSpec::default() };
        let world = world(WorldSpec { part, ..WorldSpec::default() });
        let (_, records) = measure(&mut world.cmm(), &plan(&world, &net([12.0, 12.0], 3.0)));
        assert!(records.iter().all(|r| r.status == Status::Touched), "{shape:?}");
    }
}

#[test]
fn world_spec_error_names_key() {
    let bad = |change: &dyn Fn(&mut WorldSpec)| {
        let mut spec = WorldSpec::default();
        change(&mut spec);
        World::new(spec).unwrap_err().key
    };
    assert_eq!(bad(&|s| s.speed = 0.0), "speed");
    assert_eq!(bad(&|s| s.speed = f64::NAN), "speed");
    assert_eq!(bad(&|s| s.part.stock_um = -1.0), "part.stock_um");
    assert_eq!(bad(&|s| s.part.shape = ShapeSpec::Sphere { radius_mm: 40.0 }), "part.shape");
    assert_eq!(bad(&|s| s.part.shape = ShapeSpec::Sphere { radius_mm: 0.0 }), "part.shape");
    assert_eq!(bad(&|s| s.part.aperture = Aperture::circle(1e9)), "part.aperture");
    assert_eq!(bad(&|s| s.grinder.error_copying = 1.0), "grinder.error_copying");
    assert_eq!(bad(&|s| s.grinder.thermal_tau_s = 0.0), "grinder.thermal_tau_s");
    assert_eq!(bad(&|s| s.cmm.not_found_share = 1.1), "cmm.not_found_share");
    assert_eq!(bad(&|s| s.cmm.seconds_per_point = 0.0), "cmm.seconds_per_point");
}

#[test]
fn careful_start_slows_first_targets() {
    let mut spec = small_perfect();
    spec.cmm.travel_mm_s = 1e6;
    let world = World::new(spec).unwrap();
    let places: Vec<[f64; 2]> = (0..20).map(|k| [0.1 * f64::from(k) - 1.0, 0.0]).collect();
    let plan = plan(&world, &places);
    let took = |plan: &Plan| measure(&mut world.cmm(), plan).0.duration_s;
    let (usual, careful) = (took(&plan), took(&Plan { careful: (5, 0.2 * plan.speed_mm_s), ..plan.clone() }));
    assert!((careful / usual - (15.0 + 5.0 * 5.0) / 20.0).abs() < 1e-5, "{usual} s, and {careful} s with care");
}

#[test]
fn travel_time_between_targets() {
    let world = World::new(small_perfect()).unwrap();
    let took = |places: &[[f64; 2]]| measure(&mut world.cmm(), &plan(&world, places)).0.duration_s;
    let [near, far] = [took(&[[0.0, 0.0], [1.0, 0.0]]), took(&[[0.0, 0.0], [10.0, 0.0]])];
    assert_eq!(took(&[[0.0, 0.0]]), 1.0);
    // 9 mm more, at 100 mm/s, over a surface that is next to flat.
    assert!((far - near - 0.09).abs() < 0.01 && near > 2.0, "{near} {far}");
}
