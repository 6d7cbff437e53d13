//! Seals: where they stand, what they prove, and that none is lost or written twice when the disk says no.

use std::fs;
use std::ops::Range;
#[cfg(unix)]
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use regrind_journal::{
    Anchor, AuditKey, Entry, Excerpt, ExternalEvidence, Journal, JournalError, PublicKey, Reader, Record, RecordKind,
    SEALED_EVERY, Verified, canonical_json, sha256_hex, verify, verify_against,
};
use rusqlite::Connection;
use serde_json::{Value, json};

use crate::closed::closed;
use crate::tampering::{copied, place};
use crate::written::{Home, header, home, tamper};

fn note(k: u64) -> Entry {
    Entry::new(RecordKind::Note, k, 1, json!({ "k": k }))
}

fn write_notes(journal: &mut Journal, numbers: Range<u64>) {
    for k in numbers {
        journal.append(note(k)).unwrap();
    }
}

fn records(folder: &Path) -> Vec<Record> {
    Reader::open(folder).unwrap().records(1).map(Result::unwrap).collect()
}

/// The numbers of the seals, also while the database has a trigger that no record has.
fn seals(folder: &Path) -> Vec<u64> {
    let database = Connection::open(folder.join("journal.sqlite")).unwrap();
    let mut seals = database.prepare("SELECT seq FROM record WHERE kind = 'seal' ORDER BY seq").unwrap();
    let seals = seals.query_map([], |row| row.get::<_, i64>(0)).unwrap();
    seals.map(|seq| seq.unwrap().try_into().unwrap()).collect()
}

fn anchor(folder: &Path) -> Anchor {
    serde_json::from_slice(&fs::read(folder.join("journal.anchor")).unwrap()).unwrap()
}

fn with_key(folder: &Path, key: PublicKey) -> Result<Verified, JournalError> {
    verify_against(folder, &ExternalEvidence { anchor: None, keys: vec![key] })
}

/// Why nothing proves who wrote a record that is whole.
fn no_author(found: Result<Verified, JournalError>) -> String {
    match found {
        Err(JournalError::NoAuthor { what, .. }) => what,
        other => panic!("{other:?}"),
    }
}

/// A signed run of 600 notes that came to its end.
fn signed() -> (Home, PathBuf, AuditKey) {
    let (home, key) = (home(), AuditKey::new());
    let folder = home.path().join("run");
    let mut journal = Journal::create_with(&folder, header(), Some(key.clone())).unwrap();
    for k in 0..600 {
        journal.append(note(k)).unwrap();
    }
    journal.close(600, 1, json!("accepted")).unwrap();
    (home, folder, key)
}

#[test]
fn seal_and_anchor_schedule() {
    let (home, key) = (home(), AuditKey::new());
    let folder = home.path().join("run");
    let mut journal = Journal::create_with(&folder, header(), Some(key.clone())).unwrap();
    assert_eq!((seals(&folder), anchor(&folder).records), (vec![2], 1));
    let last = (0..SEALED_EVERY).map(|k| journal.append(note(k)).unwrap()).last().unwrap();
    assert_eq!(last, SEALED_EVERY + 2, "a record has its own number, whatever is sealed behind it");
    assert_eq!((seals(&folder), anchor(&folder).records), (vec![2, last + 1], last));
    let under_way = verify(&folder).unwrap();
    assert_eq!((under_way.signed, under_way.seals, under_way.under_way), (last, 2, true));
    let given = journal.close(0, 1, json!("accepted")).unwrap();
    assert_eq!((seals(&folder), &anchor(&folder)), (vec![2, last + 1, last + 3], &given));
    let verified = with_key(&folder, key.public()).unwrap();
    assert_eq!((verified.signed, verified.records, verified.anchored), (last + 2, last + 3, last + 2));
    assert!(verified.closed && !verified.lacks_last_seal());
    assert_eq!(verified.keys, [key.public()]);
    assert!(matches!(Journal::open(&folder).map(|_| ()), Err(JournalError::Closed { .. })));
}

#[test]
fn anchor_without_signing_key() {
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    write_notes(&mut journal, 0..SEALED_EVERY);
    assert_eq!(anchor(&folder), Anchor::new(SEALED_EVERY + 1, records(&folder).pop().unwrap().hash));
    let verified = verify(&folder).unwrap();
    assert_eq!((verified.signed, verified.seals, verified.keys.len()), (0, 0, 0));
    let refused = journal.append(Entry::new(RecordKind::Seal, 0, 0, json!({})));
    assert!(matches!(refused, Err(JournalError::Entry { kind: "seal", .. })));
}

#[test]
fn verify_refuses_other_or_no_key() {
    let (_home, folder, key) = signed();
    with_key(&folder, key.public()).unwrap();
    let other = AuditKey::new().public();
    assert!(no_author(with_key(&folder, other)).starts_with("record 1 names the key"));
    let keys = vec![other, key.public()];
    verify_against(&folder, &ExternalEvidence { anchor: None, keys }).unwrap();
    let (_home, folder, _) = closed();
    assert_eq!(no_author(with_key(&folder, other)), "the run is not signed");
}

/// Computes all hashes from a record on anew, and what the seals say of them: what somebody can do who has no key.
fn forged(folder: &Path, from: u64, change: impl Fn(&mut Value)) {
    let all = records(folder);
    let mut head = all[from as usize - 2].hash.clone();
    let mut sql = Vec::new();
    for record in &all[from as usize - 1..] {
        let mut fields: Value = serde_json::from_str(&record.json_line()).unwrap();
        let fields = fields.as_object_mut().unwrap();
        fields.remove("prev_hash");
        fields.remove("hash");
        if record.seq == from {
            change(&mut fields["payload"]);
        } else if record.kind == RecordKind::Seal {
            fields["payload"]["head"] = json!(head);
        }
        let text = canonical_json(&json!(fields));
        let hash = sha256_hex(format!("regrind journal record 1\n{head}\n{text}").as_bytes());
        let payload = canonical_json(&fields["payload"]);
        sql.push(format!(
            "UPDATE record SET payload = '{payload}', prev_hash = '{head}', hash = '{hash}' WHERE seq = {}",
            record.seq
        ));
        head = hash;
    }
    tamper(folder, &sql.join("; "));
    let mut anchor: Value = serde_json::from_slice(&fs::read(folder.join("journal.anchor")).unwrap()).unwrap();
    let at = anchor["records"].as_u64().unwrap() as usize;
    anchor["head"] = json!(records(folder)[at - 1].hash);
    fs::write(folder.join("journal.anchor"), anchor.to_string()).unwrap();
}

#[test]
fn forged_chain_found_at_next_seal() {
    let (home, folder, _) = signed();
    let marks = seals(&folder);
    assert_eq!(marks, [2, 259, 516, 606]);
    tamper(&folder, "SELECT 1");
    for (at, seal) in [(3, 259), (258, 259), (300, 516), (601, 605), (605, 605)] {
        let changed = home.path().join("changed");
        copied(&folder, &changed);
        forged(&changed, at, |payload| *payload = json!({ "ending": "another" }));
        let found = verify(&changed);
        assert_eq!(place(&found), Some(seal), "{at}: {found:?}");
        assert!(found.unwrap_err().to_string().contains("signature"));
    }
    fs::remove_dir_all(home.path().join("changed")).unwrap();
}

#[test]
fn last_seal_removed_or_added() {
    let (_home, folder, _) = signed();
    tamper(&folder, "DELETE FROM record WHERE seq = 606");
    let verified = verify(&folder).unwrap();
    assert!(verified.closed && verified.lacks_last_seal());
    assert_eq!(verified.signed, 515);
    assert!(matches!(Journal::open(&folder).map(|_| ()), Err(JournalError::Closed { .. })));
    let (_home, folder, _) = signed();
    let last = records(&folder).pop().unwrap();
    let mut text: Value = serde_json::from_str(&last.json_line()).unwrap();
    let fields = text.as_object_mut().unwrap();
    fields.remove("prev_hash");
    fields.remove("hash");
    fields["seq"] = json!(607);
    let hash = sha256_hex(format!("regrind journal record 1\n{}\n{}", last.hash, canonical_json(&text)).as_bytes());
    let others = "utc, boot_id, mono_ns, actor, station, kind, part, cycle, command_id, reason, payload";
    tamper(
        &folder,
        &format!("INSERT INTO record SELECT 607, {others}, '{}', '{hash}' FROM record WHERE seq = 606", last.hash),
    );
    let found = verify(&folder);
    assert_eq!(place(&found), Some(607), "{found:?}");
    assert!(found.unwrap_err().to_string().contains("follows the end"));
}

#[test]
fn reopened_run_sealed_with_new_key() {
    let (home, first, second) = (home(), AuditKey::new(), AuditKey::new());
    let folder = home.path().join("run");
    drop(Journal::create_with(&folder, header(), Some(first.clone())).unwrap());
    let mut journal = Journal::open_with(&folder, Some(second.clone())).unwrap();
    assert_eq!(seals(&folder), [2, 4], "what was opened again is sealed at once");
    journal.append(note(1)).unwrap();
    drop(journal);
    let mut journal = Journal::open(&folder).unwrap();
    journal.append(note(2)).unwrap();
    assert_eq!(anchor(&folder).key, None);
    drop(journal);
    Journal::open_with(&folder, Some(first.clone())).unwrap().close(3, 1, json!("stopped")).unwrap();
    let verified = verify(&folder).unwrap();
    assert_eq!(verified.keys, [first.public(), second.public()]);
    assert_eq!((verified.signed + 1, verified.lacks_last_seal()), (verified.records, false));
    assert!(no_author(with_key(&folder, first.public())).starts_with("record 3 names the key"));
    let both = ExternalEvidence { anchor: None, keys: vec![first.public(), second.public()] };
    assert!(no_author(verify_against(&folder, &both)).contains("without a key"));
    let (_home, folder, key) = {
        let (home, key) = (home, AuditKey::new());
        let folder = home.path().join("another");
        drop(Journal::create_with(&folder, header(), Some(key.clone())).unwrap());
        Journal::open(&folder).unwrap().close(0, 0, json!("stopped")).unwrap();
        (home, folder, key)
    };
    let verified = verify(&folder).unwrap();
    assert!(verified.lacks_last_seal() && verified.signed == 1, "gone on with by somebody without a key: {verified:?}");
    assert!(no_author(with_key(&folder, key.public())).contains("without a key"));
}

#[test]
fn open_refuses_changed_records() {
    for sql in [
        "UPDATE record SET reason = 'x' WHERE seq = 4",
        "UPDATE record SET reason = 'x', hash = 'y' WHERE seq = 5",
        "UPDATE record SET hash = 'y' WHERE seq = 1",
    ] {
        let home = home();
        let folder = home.path().join("run");
        let mut journal = Journal::create_with(&folder, header(), Some(AuditKey::new())).unwrap();
        write_notes(&mut journal, 0..3);
        drop(journal);
        tamper(&folder, sql);
        let refused = Journal::open_with(&folder, Some(AuditKey::new())).map(|_| ());
        assert!(matches!(refused, Err(JournalError::Broken { .. })), "{sql}: {refused:?}");
        assert_eq!(records(&folder).len(), 5, "nothing was added");
    }
}

/// Lets the database refuse what is of a kind: before it is written, or when it is.
fn refuse(folder: &Path, kind: &str, when: &str) -> Connection {
    let database = Connection::open(folder.join("journal.sqlite")).unwrap();
    let how = if when == "BEFORE" { "ABORT" } else { "FAIL" };
    let trigger = format!(
        "CREATE TRIGGER refused {when} INSERT ON record WHEN NEW.kind = '{kind}' BEGIN SELECT RAISE({how}, 'no'); END"
    );
    database.execute_batch(&trigger).unwrap();
    database
}

#[test]
fn failed_seal_written_once_later() {
    // One that was not written, and one that was although the answer says that it was not.
    for (when, due) in [("BEFORE", SEALED_EVERY + 6), ("AFTER", SEALED_EVERY + 3)] {
        let (home, key) = (home(), AuditKey::new());
        let folder = home.path().join("run");
        let mut journal = Journal::create_with(&folder, header(), Some(key.clone())).unwrap();
        let database = refuse(&folder, "seal", when);
        write_notes(&mut journal, 0..SEALED_EVERY);
        if when == "BEFORE" {
            write_notes(&mut journal, SEALED_EVERY..SEALED_EVERY + 2);
            assert_eq!(seals(&folder), [2]);
        }
        database.execute_batch("DROP TRIGGER refused").unwrap();
        write_notes(&mut journal, 1000..1001);
        assert_eq!(seals(&folder), [2, due], "{when}");
        write_notes(&mut journal, 1001..1002);
        assert_eq!(seals(&folder), [2, due], "{when}");
        assert_eq!(anchor(&folder).records + 1, due, "{when}");
        let commands = refuse(&folder, "seal", when);
        let refused = journal.end(1002, 1, json!("accepted"));
        assert!(matches!(refused, Err(JournalError::Database { .. })), "{when}: {refused:?}");
        commands.execute_batch("DROP TRIGGER refused").unwrap();
        journal.end(1002, 1, json!("accepted")).unwrap();
        journal.end(1002, 1, json!("accepted")).unwrap();
        let verified = with_key(&folder, key.public()).unwrap();
        assert!(verified.closed && !verified.lacks_last_seal(), "{when}: {verified:?}");
        let last: Vec<_> = records(&folder).iter().rev().take(3).map(|r| r.kind).collect();
        assert_eq!(last, [RecordKind::Seal, RecordKind::End, RecordKind::Note], "{when}");
    }
}

#[test]
fn failed_record_written_once() {
    for when in ["BEFORE", "AFTER"] {
        let home = home();
        let folder = home.path().join("run");
        let mut journal = Journal::create_with(&folder, header(), Some(AuditKey::new())).unwrap();
        write_notes(&mut journal, 1..SEALED_EVERY);
        // The record that makes a seal due.
        let database = refuse(&folder, "note", when);
        journal.append(note(500)).unwrap_err();
        database.execute_batch("DROP TRIGGER refused").unwrap();
        assert_eq!(journal.append(note(500)).unwrap(), SEALED_EVERY + 2, "{when}");
        let command = Entry::new(RecordKind::Intent, 501, 1, json!({}));
        assert_eq!(journal.intend(command).unwrap(), 1);
        let notes = records(&folder).iter().filter(|r| r.mono_ns == 500 && r.kind == RecordKind::Note).count();
        assert_eq!((notes, seals(&folder).len()), (1, 2), "{when}");
        verify(&folder).unwrap();
    }
}

#[test]
fn failed_anchor_follows_later() {
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create_with(&folder, header(), Some(AuditKey::new())).unwrap();
    // What is in the way of the file that becomes the anchor.
    let in_the_way = folder.join(".journal.anchor.tmp");
    fs::create_dir(&in_the_way).unwrap();
    write_notes(&mut journal, 0..SEALED_EVERY + 5);
    assert_eq!((seals(&folder).len(), anchor(&folder).records), (2, 1), "sealed once, and the anchor before stands");
    fs::remove_dir(&in_the_way).unwrap();
    journal.append(note(1000)).unwrap();
    assert_eq!((seals(&folder).len(), anchor(&folder).records), (2, SEALED_EVERY + 2));
    verify(&folder).unwrap();
}

#[test]
fn foreign_anchor_is_refused() {
    let (_home, folder, _) = signed();
    let (_other_home, other, _) = signed();
    let against = |anchor| verify_against(&folder, &ExternalEvidence { anchor: Some(anchor), keys: Vec::new() });
    against(anchor(&folder)).unwrap();
    let found = against(Anchor { head: anchor(&folder).head, ..anchor(&other) });
    assert_eq!(place(&found), Some(605), "{found:?}");
    let found = against(Anchor { run: Some("another".into()), ..anchor(&folder) });
    assert!(found.unwrap_err().to_string().contains("another run"));
    let unsigned = Anchor { run: None, key: None, signature: None, ..anchor(&folder) };
    fs::write(folder.join("journal.anchor"), json!(unsigned).to_string()).unwrap();
    assert_eq!(place(&verify(&folder)), Some(605), "its signature was taken away");
}

#[test]
fn journal_without_seals_is_upgraded() {
    let (_home, folder, _) = closed();
    tamper(&folder, "PRAGMA user_version = 1; DELETE FROM record WHERE seq > 10");
    let first = &records(&folder)[0].hash;
    fs::write(folder.join("journal.anchor"), json!({ "head": first, "records": 1 }).to_string()).unwrap();
    assert_eq!(verify(&folder).unwrap().records, 10);
    let key = AuditKey::new();
    Journal::open_with(&folder, Some(key.clone())).unwrap().close(0, 0, json!("accepted")).unwrap();
    let verified = verify(&folder).unwrap();
    assert_eq!((verified.keys.as_slice(), verified.signed), (&[key.public()][..], verified.records - 1));
    let layout = fs::read(folder.join("journal.sqlite")).unwrap()[63];
    assert_eq!(layout, 2, "an earlier version says that it does not know this one");
}

// ---- the file of a key ----------------------------------------------------------------------------------------------------------------

#[test]
fn audit_key_is_created_once() {
    let home = home();
    let path = home.path().join("settings/regrind/audit.key");
    let key = AuditKey::make(&path).unwrap();
    #[cfg(unix)]
    {
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!((mode(&path), mode(path.parent().unwrap())), (0o600, 0o700));
    }
    assert_eq!(AuditKey::read(&path).unwrap().public(), key.public());
    assert!(!format!("{key:?}").contains(&fs::read_to_string(&path).unwrap()[120..150]));
    let refused = AuditKey::make(&path).unwrap_err();
    assert!(matches!(refused, JournalError::File { .. }), "{refused:?}");
    assert_eq!(AuditKey::read(&path).unwrap().public(), key.public(), "it was written over");
    assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1, "something was left");
    #[cfg(unix)]
    {
        let link = home.path().join("dangling");
        symlink("/nowhere", &link).unwrap();
        assert!(AuditKey::make(&link).is_err());
    }
}

#[test]
fn audit_key_refuses_broken_or_open() {
    let home = home();
    let path = home.path().join("audit.key");
    AuditKey::make(&path).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    for (text, says) in [
        ("", "no 64 hexadecimal digits"),
        (&text[..120], "no 64 hexadecimal digits"),
        (&text.replacen("secret = \"", "secret = \"0", 1), "no 64 hexadecimal digits"),
        (&text[..text.len() - 40], "does not match"),
        (&text.replace("public", "other"), "does not match"),
        (&"x".repeat(5000), "not a small file"),
    ] {
        fs::write(&path, text).unwrap();
        let refused = AuditKey::read(&path).unwrap_err().to_string();
        assert!(refused.contains(says) && refused.contains("regrind audit key"), "{text}: {refused}");
    }
    fs::write(&path, &text).unwrap();
    #[cfg(unix)]
    for mode in [0o640, 0o604, 0o666] {
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        let refused = AuditKey::read(&path).unwrap_err().to_string();
        assert!(refused.contains("chmod 600"), "{refused}");
    }
    assert!(AuditKey::read(home.path()).is_err());
    assert!(AuditKey::read(&home.path().join("nothing")).is_err());
}

#[test]
fn public_key_text_forms() {
    let key = AuditKey::new().public();
    for text in [
        format!("{key}"),
        format!("\n {key} \n"),
        format!("public key   {key}\nfingerprint  {}\nfile x\n", key.fingerprint()),
        format!("secret = \"{}\"\npublic = \"{key}\"\n", "0".repeat(64)),
        json!({ "public_key": key, "fingerprint": "x" }).to_string(),
    ] {
        assert_eq!(PublicKey::from_text(&text), Ok(key), "{text}");
    }
    for text in ["", "x", &"0".repeat(63), &"G".repeat(64), "{}", "[1]", &"1".repeat(128), "public key"] {
        assert!(PublicKey::from_text(text).is_err(), "{text}");
    }
    let fingerprint = key.fingerprint();
    assert_eq!((fingerprint.len(), fingerprint.split(' ').count()), (19, 4));
}

#[test]
fn excerpt_proves_last_records() {
    let (home, key) = (home(), AuditKey::new());
    let folder = home.path().join("run");
    let mut journal = Journal::create_with(&folder, header(), Some(key.clone())).unwrap();
    write_notes(&mut journal, 0..5);
    let file = journal.store("learned.json", b"{}", 5, 1).unwrap();
    write_notes(&mut journal, 6..8);
    journal.close(8, 1, json!("accepted")).unwrap();
    let records = records(&folder);
    let first = records.iter().position(|record| record.kind == RecordKind::Artefact).unwrap();
    let texts: Vec<String> = records[first..].iter().map(Record::text).collect();
    let before = &records[first].prev_hash;
    let of = |run: &str, before: &str, texts: &[String], keys: &[PublicKey]| {
        Excerpt { run, before, texts }.verify(keys).map_err(|error| match error {
            JournalError::Broken { .. } => "broken",
            JournalError::NoAuthor { .. } => "no author",
            other => panic!("{other}"),
        })
    };
    let known = [AuditKey::new().public(), key.public()];
    let files = of("run-1", before, &texts, &known).unwrap();
    assert_eq!((files.len(), &files[0].name[..], &files[0].sha256), (1, "learned.json", &sha256_hex(b"{}")));
    assert_eq!(file.sha256, files[0].sha256);
    // Nobody known has signed it, or it was signed for another run.
    assert_eq!(of("run-1", before, &texts, &known[..1]), Err("no author"));
    assert_eq!(of("run-1", before, &texts, &[]), Err("no author"));
    assert_eq!(of("run-2", before, &texts, &known), Err("no author"));
    // Every text changed, left out, doubled or exchanged, and another hash before.
    for k in 0..texts.len() {
        let changed = |change: &dyn Fn(&mut Vec<String>)| {
            let mut texts = texts.clone();
            change(&mut texts);
            of("run-1", before, &texts, &known).is_err()
        };
        // The seal signs what stands before it.
        let is_seal = k + 1 == texts.len();
        assert!(is_seal || changed(&|texts| texts[k] = texts[k].replace("SN 7", "SN 8")), "{k}");
        assert!(k == 0 || changed(&|texts| drop(texts.remove(k))), "{k}");
        assert!(changed(&|texts| texts.insert(k, texts[k].clone())), "{k}");
        assert!(k == 0 || changed(&|texts| texts.swap(k - 1, k)), "{k}");
    }
    assert_eq!(of("run-1", &"0".repeat(64), &texts, &known), Err("broken"));
    // A shorter excerpt proves what it has; one without its end or its seal proves nothing.
    assert_eq!(of("run-1", &records[first].hash, &texts[1..], &known).unwrap(), []);
    assert_eq!(of("run-1", before, &texts[..texts.len() - 1], &known), Err("broken"));
    assert_eq!(of("run-1", before, &[], &known), Err("broken"));
}
