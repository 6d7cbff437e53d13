//! Runs whose touches are chosen batch by batch: their number, their results, and the faults that stop them within the
//! first ten.

use std::fs;
use std::path::Path;

use crate::killed::run_with_kills;
use crate::program::{changed, regrind};
use crate::worlds::{Ran, Setup, run, table};
use regrind::cell::AlarmId;
use regrind::drive::Notice;
use regrind::journal::{Reader, RecordKind, verify};
use regrind_sim::part::ShapeSpec;
use regrind_sim::spec::WorldFaults;
use regrind_testcell::outlived::{began_once, on_serial_lines};
use regrind_testutils::sample::cases;
use serde_json::Value;

fn chosen(recipe: &'static str, seed: u64) -> Setup {
    Setup { adaptive: true, ..Setup::new(recipe, seed) }
}

fn document(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))).unwrap()
}

/// Returns the number of requested targets of every measurement in the record.
fn batches(folder: &Path) -> Vec<u64> {
    let records = Reader::open(folder).unwrap();
    let values =
        records.records(0).map(Result::unwrap).filter(|record| record.kind == RecordKind::Event).map(|r| r.value());
    values.filter(|value| value["event"] == "collected").map(|value| value["targets"].as_u64().unwrap()).collect()
}

#[test]
fn adaptive_part_with_sixth_of_touches() {
    for (recipe, seed) in cases([("freeform-mirror", 1), ("biconic", 2)], 2) {
        let ran = run(chosen(recipe, seed));
        assert!(ran.accepted(), "{recipe}: {}", ran.failure_text());
        let told = document(&ran.folder.join("result.json"));
        let [taken, whole] = ["taken", "whole_patterns"].map(|key| told["touches"][key].as_u64().unwrap());
        println!("{recipe}: {taken} touches of {whole}, batch by batch up to {:?}", batches(&ran.folder));
        assert!(6 * taken <= whole, "{recipe}: {taken} of {whole}");
        // The last measurement is complete in the folder of its cycle. Each batch before it has its own folder.
        let last = ran.rows().last().unwrap().cycle;
        let cycle = ran.folder.join(format!("cycle-{last}"));
        for name in ["measured.csv", "touches.json", "registration.json", "model.json", "form.csv", "error_map.svg"] {
            assert!(cycle.join(name).is_file(), "{recipe}: {name}");
        }
        let touches = document(&cycle.join("touches.json"));
        assert_eq!(touches["tried"][0].as_array().unwrap().len(), 10);
        assert_eq!(touches["of"].as_array().unwrap().len(), table(&cycle.join("measured.csv")).len());
        assert!(cycle.join("batch-1/measured.csv").is_file() && cycle.join("batch-1/registration.json").is_file());
        // The form is estimated over the whole pattern.
        let form = table(&cycle.join("form.csv")).len() as u64;
        assert_eq!(form * ran.rows().len() as u64, whole, "{recipe}");
        is_true(&ran, recipe);
        let verified = verify(&ran.folder).unwrap();
        assert!(verified.closed && verified.unrecorded.is_empty(), "{verified:?}");
        crate::contents::assert_known(&ran.folder);
    }
}

/// Checks that the true part is within its tolerance, also at positions that were not touched.
fn is_true(ran: &Ran, recipe: &str) {
    let half = [46.0, 26.0];
    let places: Vec<[f64; 2]> = (0..61 * 41)
        .map(|k| [f64::from(k % 61) / 30.0 - 1.0, f64::from(k / 61) / 20.0 - 1.0])
        .map(|[u, v]| [u * half[0], v * half[1]])
        .filter(|[x, y]| ran.world.spec().part.aperture.contains(*x, *y))
        .collect();
    let mut deviations = ran.world.deviations_mm(&places);
    let normals: Vec<[f64; 6]> = places
        .iter()
        .map(|&[x, y]| {
            let (point, normal) = ran.world.nominal(x, y);
            let cross = |a: usize, b: usize| (point[a] * normal[b] - point[b] * normal[a]) / 50.0;
            [normal[0], normal[1], normal[2], cross(1, 2), cross(2, 0), cross(0, 1)]
        })
        .collect();
    let rows = nalgebra::DMatrix::from_fn(places.len(), 6, |r, c| normals[r][c]);
    let seen = nalgebra::DVector::from_column_slice(&deviations);
    let fitted = rows.clone().svd(true, true).solve(&seen, 1e-9).unwrap();
    deviations = (seen - rows * fitted).iter().copied().collect();
    deviations.sort_by(f64::total_cmp);
    let n = deviations.len();
    let pv_mm = deviations[n - 1 - n / 1000] - deviations[n / 1000];
    let rms_mm = (deviations.iter().map(|d| d * d).sum::<f64>() / n as f64).sqrt();
    let [pv_limit, rms_limit] = ran.tolerance_mm;
    assert!(pv_mm <= pv_limit && rms_mm <= rms_limit, "{recipe}: PV {pv_mm}, RMS {rms_mm}");
}

#[test]
fn adaptive_faults_found_in_ten_touches() {
    let faults = |faults: WorldFaults| chosen("freeform-mirror", 1).with(move |world| world.faults = faults.clone());
    let mirrored = faults(WorldFaults { cmm_mirrored: true, ..WorldFaults::default() });
    let inches = faults(WorldFaults { inches: true, ..WorldFaults::default() });
    let radius = chosen("freeform-mirror", 1).with(|world| world.cmm.probe_radius_error_um = 50.0);
    let contacts = faults(WorldFaults { returns_contact_points: true, ..WorldFaults::default() });
    let other = chosen("freeform-mirror", 1).with(|world| {
        let ShapeSpec::XyPolynomial { coefficients, .. } = &mut world.part.shape else { panic!("another shape") };
        coefficients.iter_mut().filter(|term| term.i + term.j == 3).for_each(|term| term.value_mm *= 1.3);
    });
    let cases = [
        ("mirrored", mirrored, AlarmId::RegistrationFailed),
        ("inches", inches, AlarmId::Inches),
        ("wrong radius", radius, AlarmId::ProbeRadius),
        ("contact points", contacts, AlarmId::Contacts),
        ("wrong part", other, AlarmId::RegistrationFailed),
    ];
    for (what, setup, alarm) in cases {
        let ran = run(setup);
        let told = format!("{what}: {}", ran.failure_text());
        println!("{told}");
        assert_eq!(ran.alarms().first().map(|alarm| alarm.id), Some(alarm), "{told}");
        assert_eq!((ran.world.measurements_begun(), ran.world.history().len()), (1, 1), "{told}");
        let of_part = batches(&ran.folder);
        assert!(of_part.iter().all(|targets| *targets <= 10), "{told}: {of_part:?}");
    }
}

#[test]
fn adaptive_missing_part_in_ten_touches() {
    let setup = chosen("freeform-mirror", 1).with(|world| world.faults.no_part = true);
    let ran = run(setup);
    assert_eq!(ran.alarms().first().map(|alarm| alarm.id), Some(AlarmId::NoPart), "{}", ran.failure_text());
    assert_eq!(ran.world.measurements_begun(), 1, "{}", ran.failure_text());
}

#[test]
fn adaptive_batches_publish_figures() {
    let ran = run(chosen("off-axis-asphere", 3));
    let figures = ran.notices.iter().filter_map(|notice| match notice {
        Notice::Figures { figures, .. } => Some(figures),
        _ => None,
    });
    let figures: Vec<_> = figures.collect();
    // Ten touches with six fitted motions are too few for a statement about the form.
    let forms: Vec<_> = figures.iter().map(|figures| (figures.points, figures.form.map(|form| form.rms))).collect();
    assert!(forms.iter().all(|(points, form)| form.is_some() == (*points > 10)), "{forms:?}");
    let on: Vec<_> = figures
        .iter()
        .map(|figures| (figures.points, figures.further_touches.clone().map(|on| on.target_count)))
        .collect();
    println!("{on:?}");
    assert_eq!(on[0].1, Some(30), "{on:?}");
    assert!(on.last().unwrap().1.is_none(), "{on:?}");
    // All requested targets were touched, except those that were not found.
    for pair in on.windows(2).filter(|pair| pair[0].1.is_some()) {
        assert!(
            pair[1].0 <= pair[0].0 + pair[0].1.unwrap() && pair[1].0 + 2 >= pair[0].0 + pair[0].1.unwrap(),
            "{on:?}"
        );
    }
    let ended = |notice: &&Notice| matches!(notice, Notice::State { event, .. } if event == "ended");
    assert!(ran.notices.iter().filter(ended).count() > on.len(), "every batch is a job of its own");
}

#[test]
fn adaptive_resume_repeats_no_touch() {
    let home = tempfile::tempdir().unwrap();
    let recipe = changed(
        "recipes/freeform-mirror.toml",
        &[
            ("[registration]", "[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025\n\n[registration]"),
            ("seed = 1\n", "seed = 1\nspeed = 3000.0\n"),
        ],
    );
    let _serving = on_serial_lines(regrind, home.path(), &recipe);
    let (mut max_kills, mut parts) = (0, 0);
    for seed in cases([31, 32], 2) {
        parts += 1;
        let (folder, kills) = run_with_kills(home.path(), seed);
        max_kills = kills.max(max_kills);
        let told = document(&folder.join("result.json"));
        println!("seed {seed}: {kills} kills, {}", told["touches"]);
        let verified = verify(&folder).unwrap();
        assert!(verified.closed && verified.open_intents.is_empty(), "seed {seed}: {verified:?}");
        for cycle in ["cycle-1", "cycle-2"].map(|cycle| folder.join(cycle)).iter().filter(|cycle| cycle.is_dir()) {
            let tried = document(&cycle.join("touches.json"))["tried"].clone();
            let mut all: Vec<u64> = tried
                .as_array()
                .unwrap()
                .iter()
                .flat_map(|b| b.as_array().unwrap())
                .map(|t| t.as_u64().unwrap())
                .collect();
            let count = all.len();
            all.sort_unstable();
            all.dedup();
            assert_eq!(all.len(), count, "seed {seed}: a target was touched twice");
        }
    }
    assert!(max_kills > 0);
    assert!(began_once(home.path()) >= 4 * parts);
}
