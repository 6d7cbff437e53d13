//! What can be wrong with a cell, each put into the simulated world: every one is caught before or at the first bad cycle, in
//! words that a person can act on, and no part is accepted.

#![cfg(unix)]

use crate::worlds::{JOB, Ran, Setup, run};
use regrind::cell::{AlarmId, Ending};
use regrind_sim::spec::{Faults, Mirrored};

const RECIPE: &str = "freeform-mirror";

fn broken(faults: Faults) -> Setup {
    Setup::new(RECIPE, 1).with(move |world| world.faults = faults.clone())
}

/// The first alarm must be this one, say these words, and come after so many passes; nothing is accepted, and no further pass is begun.
fn caught(setup: Setup, alarm: AlarmId, words: &[&str], passes: usize) -> Ran {
    let ran = run(setup);
    let told = ran.told();
    println!("{told}");
    assert!(!ran.accepted(), "{told}");
    let alarms = ran.alarms();
    let first = alarms.first().unwrap_or_else(|| panic!("no alarm was raised\n{told}"));
    println!("{}\n{}\n{:#?}", first.what, first.consequence, first.remedy);
    assert_eq!(first.id, alarm, "{told}");
    let said = format!("{} {} {}", first.what, first.consequence, first.remedy.join(" "));
    for word in words {
        assert!(said.contains(word), "`{word}` is missing in: {said}");
    }
    assert_eq!(ran.passes_at_alarm, Some(passes), "{told}");
    assert_eq!(ran.world.history().len(), passes, "a pass was begun after the alarm\n{told}");
    for cycle in 1..=passes {
        assert_eq!(ran.world.grinds_begun(JOB, cycle as u16), 1, "cycle {cycle}\n{told}");
    }
    ran
}

#[test]
fn another_word_order_is_told_before_anything_is_written() {
    let setup = Setup { other_word_order: true, ..Setup::new(RECIPE, 1) };
    let ran =
        caught(setup, AlarmId::WordOrder, &["word order", "nothing was written", "word_order in the cell file"], 0);
    assert!(matches!(ran.ending, Ending::Stopped { cycle: 0, .. }), "{}", ran.told());
    assert_eq!(ran.world.measurements_begun(), 0);
}

#[test]
fn exchanged_machines_are_told_before_anything_is_written() {
    let setup = Setup { exchanged: true, ..Setup::new(RECIPE, 1) };
    let ran = caught(setup, AlarmId::WrongDevice, &["Another device answers", "address in the cell file"], 0);
    assert!(matches!(ran.ending, Ending::Stopped { cycle: 0, .. }), "{}", ran.told());
    assert_eq!(ran.world.measurements_begun(), 0);
}

#[test]
fn a_map_of_another_part_is_not_ground() {
    let faults = Faults { wrong_part: true, ..Faults::default() };
    caught(broken(faults), AlarmId::MachineRefused, &["grinder", "another part"], 0);
}

#[test]
fn a_flipped_sign_is_told_at_the_first_pass_with_a_map() {
    let faults = Faults { map_sign_flipped: true, ..Faults::default() };
    caught(broken(faults), AlarmId::SignFlipped, &["the other way round", "sign"], 2);
}

#[test]
fn a_mirrored_x_is_told_at_the_first_pass_with_a_map() {
    let faults = Faults { map_mirrored: Mirrored::X, ..Faults::default() };
    caught(broken(faults), AlarmId::Mirrored, &["mirrored", "direction of x and y"], 2);
}

#[test]
fn a_mirrored_y_is_told_at_the_first_pass_with_a_map() {
    let faults = Faults { map_mirrored: Mirrored::Y, ..Faults::default() };
    caught(broken(faults), AlarmId::Mirrored, &["mirrored", "direction of x and y"], 2);
}

#[test]
fn a_turned_map_is_told_at_the_first_pass_with_a_map() {
    for map_mirrored in [Mirrored::HalfTurn, Mirrored::QuarterTurn] {
        let faults = Faults { map_mirrored, ..Faults::default() };
        caught(broken(faults), AlarmId::Mirrored, &["turned map", "how the part is turned"], 2);
    }
}

#[test]
fn a_map_that_is_applied_twice_is_told_at_the_first_pass_with_one() {
    let faults = Faults { map_doubled: true, ..Faults::default() };
    caught(broken(faults), AlarmId::Doubled, &["two times", "in one place only"], 2);
}

#[test]
fn a_map_that_is_ignored_is_told_at_the_first_pass_with_one() {
    let faults = Faults { map_ignored: true, ..Faults::default() };
    caught(broken(faults), AlarmId::NoEffect, &["did not answer to the map"], 2);
}

#[test]
fn contact_points_are_told_from_the_reference_sphere() {
    let faults = Faults { returns_contact_points: true, ..Faults::default() };
    caught(broken(faults), AlarmId::Contacts, &["contact points", "radius compensation"], 1);
}

#[test]
fn contact_points_are_told_from_their_header() {
    let faults = Faults { returns_contact_points: true, contact_points_declared: true, ..Faults::default() };
    caught(broken(faults), AlarmId::Contacts, &["contact points", "radius compensation"], 1);
}

#[test]
fn inches_are_told_from_the_reference_sphere() {
    let faults = Faults { inches: true, ..Faults::default() };
    caught(broken(faults), AlarmId::Inches, &["inches", "millimetres"], 1);
}

#[test]
fn a_probe_that_is_10_um_off_is_told_from_the_reference_sphere() {
    for error_um in [10.0, -10.0] {
        let setup = Setup::new(RECIPE, 1).with(move |world| world.cmm.probe_radius_error_um = error_um);
        caught(setup, AlarmId::ProbeRadius, &["radius of the probe", "off by", "Qualify the probe"], 1);
    }
}

#[test]
fn a_part_that_lies_turned_round_is_told() {
    let faults = Faults { part_turned_180: true, ..Faults::default() };
    // The probe meets the steep part in the air, and the machine stops by itself; the alarm must still send a person to the part.
    let ran = caught(broken(faults), AlarmId::MachineFault, &["see how the part lies", "turned round"], 1);
    assert!(matches!(ran.ending, Ending::Aborted { cycle: 1, confirmed: true, .. }), "{}", ran.told());
}

#[test]
fn a_shallow_part_that_lies_turned_round_is_told() {
    let faults = Faults { part_turned_180: true, ..Faults::default() };
    let setup = Setup::new("shallow-wave", 1).with(move |world| world.faults = faults.clone());
    caught(setup, AlarmId::PartMisplaced, &["turned round", "degrees"], 1);
}

#[test]
fn a_missing_part_is_told() {
    let faults = Faults { no_part: true, ..Faults::default() };
    caught(broken(faults), AlarmId::NoPart, &["No part was found", "loaded and clamped"], 1);
}

#[test]
fn a_number_that_is_none_does_not_come_in() {
    let faults = Faults { non_finite_point: true, ..Faults::default() };
    caught(broken(faults), AlarmId::BrokenResult, &["broken", "not"], 1);
}

#[test]
fn missing_records_are_told() {
    let faults = Faults { missing_records: 3, ..Faults::default() };
    caught(broken(faults), AlarmId::BrokenResult, &["broken"], 1);
}
