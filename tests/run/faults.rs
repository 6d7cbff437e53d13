//! Faults of a cell, each put into the simulated world. Every fault is caught before or at the first bad cycle, with a
//! message that a person can act on, and no part is accepted.

#![cfg(unix)]

use crate::worlds::{JOB, Ran, Setup, run, table};
use regrind::cell::{AlarmId, Ending};
use regrind_sim::spec::{Mirrored, Misreported, WorldFaults};
use regrind_testutils::sample::all;

const RECIPE: &str = "freeform-mirror";

/// Returns the usual setup. The whole pattern shows no more of a fault than a sixth of it, and takes many times as
/// long.
fn usual() -> Setup {
    Setup { coarse: !all(), ..Setup::new(RECIPE, 1) }
}

fn broken(faults: WorldFaults) -> Setup {
    usual().with(move |world| world.faults = faults.clone())
}

/// Checks that the first alarm is this one, contains these words and comes after this number of passes; that nothing is
/// accepted; and that no further pass starts.
fn caught(what: &str, setup: Setup, alarm: AlarmId, words: &[&str], passes: usize) -> Ran {
    let ran = run(setup);
    let told = format!("{what}: {}", ran.failure_text());
    println!("{told}");
    assert!(!ran.accepted(), "{told}");
    let alarms = ran.alarms();
    let first = alarms.first().unwrap_or_else(|| panic!("no alarm was raised\n{told}"));
    println!("{}\n{}\n{:#?}", first.event, first.consequence, first.remedy);
    assert_eq!(first.id, alarm, "{told}");
    let said = format!("{} {} {}", first.event, first.consequence, first.remedy.join(" "));
    for word in words {
        assert!(said.contains(word), "{what}: `{word}` is missing in: {said}");
    }
    assert_eq!(ran.passes_at_alarm, Some(passes), "{told}");
    assert_eq!(ran.world.history().len(), passes, "a pass was begun after the alarm\n{told}");
    for cycle in 1..=passes {
        assert_eq!(ran.world.grinds_begun(JOB, cycle as u16), 1, "cycle {cycle}\n{told}");
    }
    ran
}

/// Name of the fault, the fault of the world, the first alarm, and the words that it contains.
type Case = (&'static str, WorldFaults, AlarmId, &'static [&'static str]);

fn each_is_caught<const N: usize>(cases: [Case; N], passes: usize) {
    for (what, faults, alarm, words) in cases {
        caught(what, broken(faults), alarm, words, passes);
    }
}

#[test]
fn wrong_devices_detected_before_write() {
    let (other_order, exchanged) = (Setup { other_word_order: true, ..usual() }, Setup { exchanged: true, ..usual() });
    let order_words = &["word order", "othing was written", "word_order in the cell file"];
    let older = &["version 1 of the register map", "lacks a heartbeat that names its owner", "update it to version 2"];
    let newer = &["version 3 of the register map", "this version of Regrind is older"];
    let cases: [(&str, Setup, AlarmId, &[&str]); 4] = [
        ("an older map", Setup { version: 1, ..usual() }, AlarmId::WrongDevice, older),
        ("a newer map", Setup { version: 3, ..usual() }, AlarmId::WrongDevice, newer),
        ("word order", other_order, AlarmId::WordOrder, order_words),
        (
            "exchanged",
            exchanged,
            AlarmId::WrongDevice,
            &["not the device in the cell file", "address in the cell file"],
        ),
    ];
    for (what, setup, alarm, words) in cases {
        let ran = caught(what, setup, alarm, words, 0);
        assert!(
            matches!(ran.ending, Ending::Stopped { cycle: 0, ordered: false, .. }),
            "{what}: {}",
            ran.failure_text()
        );
        assert_eq!(ran.world.measurements_begun(), 0, "{what}");
    }
}

#[test]
fn map_of_other_part_refused() {
    let faults = WorldFaults { wrong_part: true, ..WorldFaults::default() };
    each_is_caught([("a map of another part", faults, AlarmId::MachineRefused, &["grinder", "another part"])], 0);
}

#[test]
fn misapplied_map_detected_at_first_pass() {
    let none = WorldFaults::default;
    let mirrored = |map_mirrored| WorldFaults { map_mirrored, ..none() };
    let turned = &["rotated map", "how the part is turned"];
    let flipped = WorldFaults { map_sign_flipped: true, ..none() };
    each_is_caught(
        [
            ("sign flipped", flipped, AlarmId::SignFlipped, &["opposite sign", "sign of the map"]),
            ("x mirrored", mirrored(Mirrored::X), AlarmId::Mirrored, &["mirrored", "direction of x and y"]),
            ("y mirrored", mirrored(Mirrored::Y), AlarmId::Mirrored, &["mirrored", "direction of x and y"]),
            ("half a turn", mirrored(Mirrored::HalfTurn), AlarmId::Mirrored, turned),
            ("a quarter", mirrored(Mirrored::QuarterTurn), AlarmId::Mirrored, turned),
            (
                "twice",
                WorldFaults { map_doubled: true, ..none() },
                AlarmId::Doubled,
                &["applied twice", "in one place only"],
            ),
            (
                "ignored",
                WorldFaults { map_ignored: true, ..none() },
                AlarmId::NoEffect,
                &["did not respond to the map"],
            ),
        ],
        2,
    );
}

#[test]
fn pass_record_checked_against_command() {
    let says = |misreported| WorldFaults { misreported, ..WorldFaults::default() };
    let alarm = AlarmId::PassRecord;
    each_is_caught(
        [
            ("another job", says(Misreported::Job), alarm, &["the job in the pass record"]),
            ("failed", says(Misreported::Result), alarm, &["the result in the pass record"]),
            ("too deep", says(Misreported::Depth), alarm, &["largest removed depth is 3.000 mm", "maximum 0.535 mm"]),
            ("no path", says(Misreported::Path), alarm, &["the path travelled is -1.000 mm", "minimum"]),
            ("another wheel", says(Misreported::Wheel), alarm, &["the radius of the wheel is", "limits"]),
            ("no time", says(Misreported::Duration), alarm, &["its duration is 0.000 s", "minimum"]),
        ],
        1,
    );
}

#[test]
fn measurement_faults_are_identified() {
    let none = WorldFaults::default;
    let contacts = WorldFaults { returns_contact_points: true, ..none() };
    let declared = WorldFaults { contact_points_declared: true, ..contacts.clone() };
    let nothing_there = &["No part was found", "loaded and clamped"];
    each_is_caught(
        [
            ("contacts, by the sphere", contacts, AlarmId::Contacts, &["contact points", "radius compensation"]),
            ("contacts, by the header", declared, AlarmId::Contacts, &["contact points", "radius compensation"]),
            (
                "inches, by the sphere",
                WorldFaults { inches: true, ..none() },
                AlarmId::Inches,
                &["inches", "millimetres"],
            ),
            ("no part", WorldFaults { no_part: true, ..none() }, AlarmId::NoPart, nothing_there),
            ("no number", WorldFaults { non_finite_point: true, ..none() }, AlarmId::BrokenResult, &["invalid", "not"]),
            ("missing records", WorldFaults { missing_records: 3, ..none() }, AlarmId::BrokenResult, &["invalid"]),
        ],
        1,
    );
}

#[test]
fn temperature_outside_window_refused() {
    let window = |least: f64, most: f64| Setup { temperature_c: Some([least, most]), ..usual() };
    let warm = window(19.5, 20.5).with(|world| world.cmm.part_temperature_c = 23.25);
    let words = &["it was 23.25 °C, limits 19.50 to 20.50 °C", "temperature of part and room"];
    caught("a warm part", warm, AlarmId::Temperature, words, 1);
    let words = &["it was 20.00 °C, limits 20.50 to 21.00 °C"];
    caught("a window above the part", window(20.5, 21.0), AlarmId::Temperature, words, 1);
}

#[test]
fn thermal_expansion_is_compensated() {
    // Ten kelvins at 8e-6 a kelvin: a curved part grows out of its nominal shape.
    let at = |temperature_c: f64, expansion_um_m_k: Option<f64>| {
        let setup = Setup { expansion_um_m_k, ..usual() };
        let setup = setup.with(move |world| {
            (world.cmm.part_temperature_c, world.cmm.cte_per_k, world.cmm.noise_um) = (temperature_c, 8e-6, 0.05);
            // A part that has grown is touched at other positions of its scallops.
            world.grinder.scallops = false;
        });
        let ran = run(setup);
        let column = |row: Vec<f64>| row[6];
        let deviations: Vec<f64> = table(&ran.folder.join("cycle-1/deviations.csv")).into_iter().map(column).collect();
        let told = ran.folder.join("cycle-1/measured.json");
        (deviations, std::fs::read_to_string(told).ok())
    };
    let (cold, _) = at(20.0, None);
    let (plain, untold) = at(30.0, None);
    let (taken_off, told) = at(30.0, Some(8.0));
    let rms = |of: &[f64]| {
        let squares: f64 = of.iter().zip(&cold).map(|(a, b)| (a - b).powi(2)).sum();
        1e3 * (squares / cold.len() as f64).sqrt()
    };
    let [plain_um, taken_off_um] = [rms(&plain), rms(&taken_off)];
    println!("growth leaves {plain_um:.3} um rms, and {taken_off_um:.4} where it is taken off");
    assert!(plain_um > 0.08 && taken_off_um < 0.005, "{plain_um} {taken_off_um}");
    assert!(untold.is_none() && told.is_some_and(|told| told.contains("\"temperature_c\": 30.0")));
}

#[test]
fn reference_sphere_detects_probe_error() {
    for error_um in [10.0, -10.0] {
        let setup = usual().with(move |world| world.cmm.probe_radius_error_um = error_um);
        let words = ["radius of the probe", "the difference is", "Qualify the probe"];
        caught(&format!("{error_um} um"), setup, AlarmId::ProbeRadius, &words, 1);
    }
}

#[test]
fn rotated_part_is_detected() {
    let faults = WorldFaults { part_turned_180: true, ..WorldFaults::default() };
    // The probe meets the steep part during a free move, and the machine stops by itself. The alarm must still send a
    // person to the part.
    let words = ["check the position of the part", "turned"];
    let ran = caught("a steep part", broken(faults.clone()), AlarmId::MachineFault, &words, 1);
    assert!(matches!(ran.ending, Ending::Aborted { cycle: 1, confirmed: true, .. }), "{}", ran.failure_text());
    let setup = Setup::new("shallow-wave", 1).with(move |world| world.faults = faults.clone());
    caught("a shallow part", setup, AlarmId::PartMisplaced, &["turned", "°, limit"], 1);
}
