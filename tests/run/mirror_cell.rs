//! Real point clouds of a 6 m telescope mirror: unchanged raw files of a laser tracker, through the folders of a
//! measuring machine.
//!
//! The data are not part of the repository: the variable REGRIND_DATA names their folder.

use std::path::Path;
use std::time::Duration;

use regrind::device::file_exchange::{
    CmmExchange, CmmFolders, Exchange, MeasureOrder, Pattern, Permit, StationFiles, Stations,
};
use regrind::device::{Coordinates, Identified, Job, Measurement, Plan, digest};
use regrind::figures::Interval;
use regrind::figures::statistics::rms;
use regrind::formats::result::{Content, Coordinates as Said};
use regrind::geometry::{Point, Pose, Twist, Vector};
use regrind::model::{Form, ModelError, ModelInputs, Prior, Sessions};
use regrind::registration::{
    MapLimits, PointStatus, Registration, RegistrationOptions, Start, lateral_error, map_obstacle, register,
};
use regrind::surface::{DefinedSurface, Nominal, Side};
use regrind_testutils::data::data;

const REFLECTOR_MM: f64 = 19.05;

/// Returns the settings of the cell file. The reference points are nominal in the telescope's frame, which is the frame
/// of the measuring machine.
fn cell(data: &Path, session: &str, outbox: &Path) -> CmmExchange {
    let files = vec![StationFiles { points: Pattern::new("M1_*.txt"), references: Pattern::new("ref_*.yaml") }];
    let nominal = data.join("nominal/reference.yaml");
    CmmExchange {
        stable_for: Duration::ZERO,
        content: Content { coordinates: Some(Said::Centres), ..Content::default() },
        stations: Some(Stations { files, nominal, group: Some("primary".into()), limit_mm: 1.0 }),
        free_count: true,
        min_points: 500,
        accept_earlier_files: true,
        ..CmmExchange::new("M1", outbox, data.join(session))
    }
}

fn plan(radius_mm: f64) -> MeasureOrder {
    let plan = Plan {
        targets: Vec::new(),
        probe_radius_mm: radius_mm,
        approach_mm: 0.0,
        search_mm: 0.0,
        speed_mm_s: 0.0,
        safe_height_mm: 0.0,
        careful_start: None,
    };
    let plan_identity = plan.identity();
    MeasureOrder { plan, plan_identity }
}

fn measured(settings: CmmExchange, radius_mm: f64) -> (Option<Measurement>, Vec<String>) {
    let mut folders = CmmFolders::new(settings);
    assert!(folders.open().unwrap().is_empty());
    let order = plan(radius_mm);
    let job = Job { job: 1, cycle: 0, digest: digest(&[order.plan_identity]) };
    folders.publish(job, 1, &order, &Permit::new()).unwrap();
    // A poll does not wait for files that take long to read.
    let began = std::time::Instant::now();
    loop {
        let look = folders.poll(Duration::from_secs(1), job).unwrap();
        if !look.notes.iter().any(|note| note.starts_with("reading ")) {
            return (look.answer, look.notes);
        }
        assert!(began.elapsed() < Duration::from_secs(300), "{:?}", look.notes);
    }
}

/// Returns the pose of the mirror in its fixture, in the telescope's frame: rotated about x by -atan(1/2), 3600 mm up.
fn cmm_from_model() -> Pose {
    let turn = Pose::exp(&Twist::new(0.0, 0.0, 0.0, -(0.5f64).atan(), 0.0, 0.0));
    Pose { translation_mm: Vector::new(0.0, 0.0, 3600.0), ..turn }
}

/// z(x, y) = sum a_ij (x/3000)^i (y/3000)^j.
fn nominal() -> Nominal {
    let text = r#"
        [surface]
        kind = "xy-polynomial"
        normalisation_radius_mm = 3000.0
        terms = [
            [0, 2, -57.74022], [0, 3, 1.5373825], [0, 4, 1.154294], [0, 5, -0.441762], [0, 6, 0.0906601],
            [2, 0, -72.17349], [2, 1, 1.8691899], [2, 2, 2.8859421], [2, 3, -1.026471], [2, 4, 0.2610568],
            [4, 0, 1.8083973], [4, 1, -0.603195], [4, 2, 0.2177414], [6, 0, 0.0394559],
        ]
        [aperture]
        kind = "rectangle"
        width_mm = 6600.0
        height_mm = 6600.0
        [sampling]
        spacing_mm = 10.0
    "#;
    let s = DefinedSurface::from_toml(text).unwrap().sample(10.0).unwrap();
    Nominal::from_grid_with_normals(s.columns, s.rows, s.points, s.normals).unwrap()
}

fn registered(nominal: &Nominal, cloud: &[Point], locked: [bool; 6]) -> Registration {
    let start = Start::Pose(cmm_from_model());
    let options = RegistrationOptions { start, locked, outlier_sigmas: 5.0, ..RegistrationOptions::new(REFLECTOR_MM) };
    register(nominal, cloud, &options).unwrap()
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn tracker_files_give_no_map_unlocked() {
    let data = data("lat-freeform-mirror");
    let nominal = nominal();
    for (session, points, rms_um, pv_um, in_plane_mm) in
        [("20250824_M1_1", 1161, 65.1, 863.0, [3.4, 3.3]), ("20250825_M1", 1422, 60.5, 620.0, [3.0, 3.0])]
    {
        let home = tempfile::tempdir().unwrap();
        let (found, said) = measured(cell(&data, session, home.path()), REFLECTOR_MM);
        let found = found.unwrap_or_else(|| panic!("{said:#?}"));
        println!("{session}\n{}", said.join("\n"));
        assert_eq!((found.points.len(), found.coordinates), (points, Coordinates::Centres));
        assert_eq!(found.probe_radius_mm, Some(REFLECTOR_MM));
        let cloud: Vec<Point> = found.points.iter().map(|p| Point::from(p.position_mm)).collect();
        let free = registered(&nominal, &cloud, [false; 6]);
        let v = &free.quality;
        let said: Vec<&str> = v.weak_directions.iter().map(|w| w.description.as_str()).collect();
        println!(
            "{} of {points} used, rms {:.2} um, PV {:.1} um; {}",
            v.inliers,
            v.rms_mm * 1e3,
            v.pv_mm * 1e3,
            said.join("; ")
        );
        assert_eq!(free.side, Side::Opposite, "the reflectors lie behind the mirror's normal");
        assert!((v.rms_mm * 1e3 - rms_um).abs() < 0.5 && (v.pv_mm * 1e3 - pv_um).abs() < 8.0);
        for k in [0, 1] {
            assert!((v.covariance[(k, k)].sqrt() / in_plane_mm[k] - 1.0).abs() < 0.1, "{session}: axis {k}");
        }
        let lateral = lateral_error(&free, &free.quality.covariance, 2.0);
        let why = map_obstacle(&free, &free.quality.covariance, &MapLimits::default());
        println!("{lateral:?}\n{}", why.as_deref().unwrap_or("a map may be made"));
        let why = why.expect("refused");
        for piece in ["x and y position", "only to 3.", "rotation about z", "registration.lock"] {
            assert!(why.contains(piece), "{piece}: {why}");
        }
        let held = registered(&nominal, &cloud, [true, true, false, false, false, true]);
        println!(
            "held: rms {:.2} um, {:?}",
            held.quality.rms_mm * 1e3,
            lateral_error(&held, &held.quality.covariance, 2.0)
        );
        assert_eq!(map_obstacle(&held, &held.quality.covariance, &MapLimits::default()), None);
    }
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn other_reflector_radius_refused() {
    let data = data("lat-freeform-mirror");
    let home = tempfile::tempdir().unwrap();
    let (found, said) = measured(cell(&data, "20250825_M1", home.path()), 6.35);
    let said = said.join("\n");
    let radii = ["probe radius of 19.05 mm", "recipe has 6.35 mm"];
    assert!(found.is_none() && radii.iter().all(|piece| said.contains(piece)), "{said}");
    // A reference point whose deviation exceeds the limit is named.
    let mut strict = cell(&data, "20250825_M1", home.path());
    strict.part = "strict".into();
    strict.stations.as_mut().unwrap().limit_mm = 0.01;
    let outbox = home.path().join("strict");
    std::fs::create_dir(&outbox).unwrap();
    strict.outbox = outbox;
    let (found, said) = measured(strict, REFLECTOR_MM);
    let said = said.join("\n");
    let off = ["station 1 (ref_1.yaml)", "primary_", "limit 0.01 mm"];
    assert!(found.is_none() && off.iter().all(|piece| said.contains(piece)), "{said}");
}

/// Returns the points of a session, and their registration with the deviations.
fn session(data: &Path, nominal: &Nominal, name: &str) -> (Vec<Point>, Registration) {
    let home = tempfile::tempdir().unwrap();
    let (found, said) = measured(cell(data, name, home.path()), REFLECTOR_MM);
    let found = found.unwrap_or_else(|| panic!("{said:#?}"));
    let cloud: Vec<Point> = found.points.iter().map(|p| Point::from(p.position_mm)).collect();
    let registration = registered(nominal, &cloud, [false; 6]);
    (cloud, registration)
}

/// Compares the prediction from one measurement, at the positions of another one, with the deviations measured there.
/// Returns the RMS of the difference in µm, and the share within the 95 % interval, which includes the noise of the
/// tracker.
fn compare_prediction(by: &Registration, of: &Registration) -> (f64, f64) {
    let used: Vec<_> = of.deviations.iter().filter(|d| d.status == PointStatus::Inlier).collect();
    let places: Vec<(Point, Vector)> = used.iter().map(|d| (d.point, d.normal)).collect();
    let form = Form::estimate_at(by, &ModelInputs::default(), &places).unwrap();
    let off: Vec<[f64; 2]> = used
        .iter()
        .zip(&form.points)
        .map(|(d, p)| [d.deviation_mm - p.form.mean_mm, p.form.sigma_mm.hypot(form.hyperparameters.noise_sigma_mm)])
        .collect();
    let n = off.len() as f64;
    let rms_um = 1e3 * (off.iter().map(|[off, _]| off * off).sum::<f64>() / n).sqrt();
    (rms_um, off.iter().filter(|[off, sigma]| off.abs() <= 1.96 * sigma).count() as f64 / n)
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn session_predicts_other_session() {
    let data = data("lat-freeform-mirror");
    let nominal = nominal();
    let sessions = ["20250824_M1_1", "20250825_M1"].map(|name| session(&data, &nominal, name));
    for [a, b] in [[0, 1], [1, 0]] {
        let ((cloud, by), (_, of)) = (&sessions[a], &sessions[b]);
        let few: Vec<Point> = cloud.iter().step_by(5).copied().collect();
        let whole = compare_prediction(by, of);
        let fifth = compare_prediction(&registered(&nominal, &few, [false; 6]), of);
        let rms_um = 1e3 * of.quality.rms_mm;
        println!(
            "session {a} tells session {b}, {rms_um:.1} um rms, but for {:.1} um, {:.1} % within 95 %; {} points of it but for {:.1} um, {:.1} %",
            whole.0,
            100.0 * whole.1,
            few.len(),
            fifth.0,
            100.0 * fifth.1
        );
        // Between the days the tracker was set up elsewhere, or the mirror was moved. The points of one session cannot
        // show this.
        assert!(whole.0 < rms_um && fifth.0 < rms_um, "{whole:?} {fifth:?} {rms_um}");
        assert!(whole.1 > 0.7 && fifth.1 > 0.85, "{whole:?} {fifth:?}");
    }
}

/// Returns the station from which each point of a session was measured. The files follow one another.
fn stations(data: &Path, name: &str) -> Vec<u32> {
    let rows = |station: u32| {
        let file = std::fs::read_to_string(data.join(name).join(format!("M1_{station}.txt"))).ok()?;
        Some(file.lines().filter(|line| line.starts_with("Checked")).count())
    };
    (1..).map_while(|station| Some(vec![station; rows(station)?])).flatten().collect()
}

fn rms_um(of: impl Iterator<Item = f64>) -> f64 {
    1e3 * rms(of)
}

fn um(Interval { median_mm, low_mm, high_mm, .. }: Interval) -> String {
    format!("{:.1} um, {:.1} to {:.1}", 1e3 * median_mm, 1e3 * low_mm, 1e3 * high_mm)
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn prediction_covers_new_session() {
    let data = data("lat-freeform-mirror");
    let nominal = nominal();
    let names = ["20250824_M1_1", "20250825_M1"];
    let days = names.map(|name| (session(&data, &nominal, name).1, stations(&data, name)));
    let (mut hits, mut count) = (0, 0);
    for [a, b] in [[0, 1], [1, 0]] {
        let known = Sessions::from_registrations(&[(&days[a].0, &days[a].1)]).unwrap();
        let unseen = Sessions::from_registrations(&[(&days[b].0, &days[b].1)]).unwrap();
        let between = known.between_session_variance(&Prior::for_size(3000.0)).unwrap();
        let told = between.predict(&known, &unseen).unwrap();
        let found = unseen.deviations_mm();
        let pairs = || told.iter().zip(found);
        let within = pairs().filter(|(t, d)| (*d - t.mean_mm).abs() <= t.half_width_mm()).count();
        (hits, count) = (hits + within, count + found.len());
        let share = within as f64 / found.len() as f64;
        let degrees = told.iter().map(|t| t.degrees_of_freedom).fold(f64::INFINITY, f64::min);
        println!("{} left out, by the {} stations of {}: {between:.5?}", names[b], between.sessions, names[a]);
        println!(
            "  found {:.1} um rms, foretold {:.1}, off by {:.1}, sigma {:.1}; {:.1} % within 95 %, {degrees:.1} degrees of freedom at least",
            rms_um(found.iter().copied()),
            rms_um(told.iter().map(|t| t.mean_mm)),
            rms_um(pairs().map(|(t, d)| d - t.mean_mm)),
            rms_um(told.iter().map(|t| t.sigma_mm)),
            100.0 * share
        );
        assert!((0.90..=0.99).contains(&share), "{share}");
        // One day as a single session cannot show the variance between days.
        let one = vec![1; days[a].1.len()];
        let alone = Sessions::from_registrations(&[(&days[a].0, &one)])
            .unwrap()
            .between_session_variance(&Prior::for_size(3000.0));
        assert_eq!(alone.err(), Some(ModelError::TooFewSessions { sessions: 1, min_sessions: 2 }));
    }
    println!("{:.1} % of {count} points of both days within 95 %", 100.0 * hits as f64 / count as f64);
}

#[test]
#[ignore = "needs real measurements: REGRIND_DATA"]
fn fifth_of_points_gives_same_figures() {
    let data = data("lat-freeform-mirror");
    let nominal = nominal();
    for name in ["20250824_M1_1", "20250825_M1"] {
        let (cloud, whole) = session(&data, &nominal, name);
        let of_all = Form::estimate(&whole, &ModelInputs::default()).unwrap();
        println!(
            "{name}: {} points, {:.1} um rms, {:.1} um PV",
            cloud.len(),
            1e3 * whole.quality.rms_mm,
            1e3 * whole.quality.pv_mm
        );
        println!("  form of all: RMS {}; PV {}", um(of_all.figures.rms), um(of_all.figures.pv_998));
        for first in 0..5 {
            let few: Vec<Point> = cloud.iter().skip(first).step_by(5).copied().collect();
            let fifth = registered(&nominal, &few, [false; 6]);
            let form = Form::estimate(&fifth, &ModelInputs::default()).unwrap();
            println!(
                "  {} of them: {:.1} um rms, {:.1} um PV; form RMS {}; PV {}",
                few.len(),
                1e3 * fifth.quality.rms_mm,
                1e3 * fifth.quality.pv_mm,
                um(form.figures.rms),
                um(form.figures.pv_998)
            );
            assert!((fifth.quality.rms_mm / whole.quality.rms_mm - 1.0).abs() < 0.15, "{name}: {first}");
            assert!(fifth.quality.pv_mm <= 1.02 * whole.quality.pv_mm, "{name}: {first}");
        }
    }
}
