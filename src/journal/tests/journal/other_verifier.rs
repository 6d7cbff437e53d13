//! Tests of the Python verifier, docs/verify_journal.py, which was written from docs/journal.md alone.
//! It must give the same verdict on every journal as this library.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use regrind_disk::SeededNumbers;
use regrind_journal::{AuditKey, Entry, Journal, JournalError, Reader, RecordKind, verify};
use serde_json::{Value, json};

use crate::closed::closed;
use crate::tampering::{Tampering, copied, long_and_whole, place, tries};
use crate::written::{header, home, tamper};

fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(name)
}

/// Returns a Python that has the package `cryptography`.
/// Tries the Python in REGRIND_PYTHON first, then the usual ones.
fn python() -> String {
    let named = std::env::var("REGRIND_PYTHON").ok();
    let has = |python: &String| {
        Command::new(python).args(["-c", "import cryptography"]).output().is_ok_and(|done| done.status.success())
    };
    let mut all = named.into_iter().chain(["python3", "/usr/bin/python3"].map(str::to_owned));
    all.find(has).expect("a python3 with the package cryptography")
}

/// Runs the Python verifier and returns its verdict on each run, in order.
fn run_verifier(arguments: &[&str], runs: &[PathBuf]) -> Vec<Value> {
    let mut command = Command::new(python());
    command.arg(script("docs/verify_journal.py")).arg("--json").args(arguments).args(runs);
    let done = command.output().unwrap();
    let text = String::from_utf8(done.stdout).unwrap();
    assert!(done.stderr.is_empty(), "{}", String::from_utf8_lossy(&done.stderr));
    let told: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(told.len(), runs.len(), "{text}");
    told
}

/// Asserts that the verdict of the Python verifier equals the verdict of this library.
fn assert_same(folder: &Path, told: &Value) {
    match verify(folder) {
        Ok(ours) => {
            let keys: Vec<String> = ours.keys.iter().map(ToString::to_string).collect();
            let expected = json!({
                "run": folder, "sound": true, "records": ours.records, "head": ours.head, "anchored": ours.anchored,
                "closed": ours.closed, "under_way": ours.under_way, "artefacts": ours.artefacts, "keys": keys,
                "seals": ours.seals, "signed": ours.signed, "lacks": told["lacks"],
                "whole": ours.closed && told["lacks"].is_null() && !ours.lacks_last_seal(),
            });
            assert_eq!(*told, expected);
            let whole =
                ours.anchored > 0 && (ours.closed || ours.under_way) && (ours.under_way || !ours.lacks_last_seal());
            assert_eq!(told["lacks"].is_null(), whole, "{told}");
        }
        Err(JournalError::Broken { seq, what, .. }) => {
            assert_eq!((&told["sound"], &told["record"]), (&json!(false), &json!(seq)), "{what}: {told}");
        }
        Err(other) => assert!(told["absent"].is_string(), "{other}: {told}"),
    }
}

#[test]
#[ignore = "needs Python with cryptography: see REGRIND_PYTHON"]
fn verifiers_agree_on_sound_journals() {
    let home = home();
    let (_closed, plain, _) = closed();
    let (_long, long) = long_and_whole(2_000);
    // Under way, with words that want to be escaped; broken off; gone on with by another computer.
    let words = "\"\\/\u{8}\t\n\u{c}\r\u{1}\u{1f}\u{7f}\u{85}\u{2028}\u{fffd}ü\u{1f600}";
    let driven = home.path().join("driven");
    let mut journal = Journal::create_with(&driven, header(), Some(AuditKey::new())).unwrap();
    let entry = Entry {
        actor: words.into(),
        reason: words.into(),
        ..Entry::new(RecordKind::Note, 7, 0, json!({ words: words }))
    };
    journal.append(entry).unwrap();
    journal.store("über/a b.csv", b"1,2\n", 8, 1).unwrap();
    let left = home.path().join("left");
    fs::create_dir_all(left.join("über")).unwrap();
    for name in ["journal.sqlite", "journal.sqlite-wal", "journal.anchor", "über/a b.csv"] {
        fs::copy(driven.join(name), left.join(name)).unwrap();
    }
    let again = home.path().join("again");
    drop(Journal::create_with(&again, header(), Some(AuditKey::new())).unwrap());
    Journal::open_with(&again, Some(AuditKey::new())).unwrap().close(1, 1, json!("stopped")).unwrap();
    let runs = [plain, long, driven, left, again, home.path().join("nothing")];
    let told_all = run_verifier(&[], &runs);
    assert!(!runs[3].join("journal.sqlite-shm").exists(), "evidence is not written to");
    runs.iter().zip(&told_all).for_each(|(run, told)| assert_same(run, told));
    for (run, of_folder) in runs.iter().zip(&told_all).take(5) {
        let lines: String = Reader::open(run).unwrap().records(1).map(|r| r.unwrap().json_line() + "\n").collect();
        let export = home.path().join("record.jsonl");
        fs::write(&export, &lines).unwrap();
        let anchor = run.join("journal.anchor");
        let of_export = run_verifier(&["--anchor", anchor.to_str().unwrap()], std::slice::from_ref(&export)).remove(0);
        for member in ["sound", "records", "head", "anchored", "closed", "keys", "seals", "signed", "artefacts"] {
            assert_eq!(of_export[member], of_folder[member], "{member}");
        }
        fs::write(&export, lines.replacen("\"mono_ns\":", "\"mono_ns\":1", 1)).unwrap();
        assert_eq!(run_verifier(&[], &[export])[0]["record"], 1);
    }
    let key = told_all[1]["keys"][0].as_str().unwrap();
    assert_eq!(run_verifier(&["--key", key], &runs[1..2])[0]["sound"], true);
    let by_nobody = run_verifier(&["--key", &"0".repeat(64)], &runs[1..2]).remove(0);
    assert_eq!((&by_nobody["sound"], &by_nobody["record"]), (&json!(false), &Value::Null));
}

#[test]
#[ignore = "needs Python with cryptography: see REGRIND_PYTHON"]
fn verifiers_agree_on_seeded_tampering() {
    let records = if tries(0) > 0 { 10_000 } else { 1_000 };
    let (home, whole) = long_and_whole(records);
    let mut drawn = SeededNumbers::new(1);
    let numbers: Vec<u64> = (0..tries(60)).collect();
    for batch in numbers.chunks(30) {
        let places: Vec<(PathBuf, Tampering)> = batch
            .iter()
            .map(|number| (home.path().join(format!("changed-{number}")), Tampering::drawn(&mut drawn, records)))
            .collect();
        for (changed, tampering) in &places {
            copied(&whole, changed);
            tamper(changed, &tampering.sql);
        }
        let runs: Vec<PathBuf> = places.iter().map(|(changed, _)| changed.clone()).collect();
        for ((changed, tampering), told) in places.iter().zip(run_verifier(&[], &runs)) {
            let found = told["record"].as_u64().or_else(|| Some(told["records"].as_u64()? + 1));
            assert_eq!(found, Some(tampering.first_bad), "{}: {told}", tampering.sql);
            assert_eq!(found, place(&verify(changed)));
            assert_same(changed, &told);
            fs::remove_dir_all(changed).unwrap();
        }
    }
}

#[test]
#[ignore = "needs Python with cryptography: see REGRIND_PYTHON"]
fn verifiers_agree_on_files_and_forgeries() {
    let mut runs = Vec::new();
    let mut homes = Vec::new();
    let mut broken = |change: &dyn Fn(&Path)| {
        let (home, folder, _) = closed();
        change(&folder);
        runs.push(folder);
        homes.push(home);
    };
    broken(&|run| fs::write(run.join("cycle-2/measured.csv"), "1,2,4\n").unwrap());
    broken(&|run| fs::remove_file(run.join("cycle-1/measured.csv")).unwrap());
    broken(&|run| fs::remove_file(run.join("journal.anchor")).unwrap());
    broken(&|run| fs::write(run.join("journal.anchor"), "{\"records\":3}").unwrap());
    broken(&|run| fs::write(run.join("journal.anchor"), "{\"records\":3,\"head\":\"x\"}").unwrap());
    broken(&|run| fs::write(run.join("journal.anchor"), "{\"records\":30,\"head\":\"x\"}").unwrap());
    broken(&|run| fs::write(run.join("journal.sqlite"), "no database").unwrap());
    broken(&|run| fs::remove_file(run.join("journal.sqlite")).unwrap());
    broken(&|run| tamper(run, "DELETE FROM record"));
    broken(&|run| tamper(run, "UPDATE record SET kind = 'another' WHERE seq = 3"));
    broken(&|run| tamper(run, "UPDATE record SET payload = CAST(x'ff' AS TEXT) WHERE seq = 3"));
    broken(&|run| tamper(run, "UPDATE record SET cycle = 5000000000 WHERE seq = 3"));
    broken(&|run| tamper(run, "UPDATE record SET mono_ns = -1 WHERE seq = 3"));
    broken(&|run| tamper(run, "UPDATE record SET seq = -1 WHERE seq = 11"));
    // No database any more: there is no record at which that could be.
    broken(&|run| {
        let damage = "PRAGMA writable_schema = ON; UPDATE sqlite_schema SET sql = 'no table at all'; PRAGMA schema_version = 1000";
        tamper(run, damage);
    });
    // An anchor whose signature was taken away, altered, or is another's.
    for change in [
        |anchor: &mut Value| *anchor = json!({ "head": anchor["head"], "records": anchor["records"] }),
        |anchor: &mut Value| anchor["signature"] = json!("0".repeat(128)),
        |anchor: &mut Value| anchor["signature"] = json!(7),
        |anchor: &mut Value| anchor["key"] = json!("0".repeat(64)),
        |anchor: &mut Value| drop(anchor.as_object_mut().unwrap().remove("key")),
        |anchor: &mut Value| anchor["run"] = json!("another"),
    ] {
        let (home, signed) = long_and_whole(300);
        let mut anchor: Value = serde_json::from_slice(&fs::read(signed.join("journal.anchor")).unwrap()).unwrap();
        change(&mut anchor);
        fs::write(signed.join("journal.anchor"), anchor.to_string()).unwrap();
        runs.push(signed);
        homes.push(home);
    }
    runs.iter().zip(run_verifier(&[], &runs)).for_each(|(run, told)| assert_same(run, &told));
}

#[test]
#[ignore = "needs Python with cryptography: see REGRIND_PYTHON"]
fn other_verifier_finds_every_bit_flip() {
    let (_home, folder) = long_and_whole(100);
    let script_of_bits = script("src/journal/tests/journal/every_bit.py");
    let done = Command::new(python()).arg(script_of_bits).arg(script("docs")).arg(&folder).output().unwrap();
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success(), "{said}{}", String::from_utf8_lossy(&done.stderr));
    let bits: u64 = said.split_whitespace().next().unwrap().parse().unwrap();
    assert!(bits > 190_000, "{said}");
}
