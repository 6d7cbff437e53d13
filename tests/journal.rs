//! The journal: what was acknowledged is there, and every change is found.

use regrind::journal::{Anchor, Entry, Header, Journal, JournalError, Kind, open_read_only, verify, verify_against};
use rusqlite::Connection;
use serde_json::json;
use tempfile::TempDir;

fn header() -> Header {
    Header {
        run: "run-1".into(),
        part: "SN 7".into(),
        actor: "Ada".into(),
        station: "console".into(),
        simulation: true,
        first_command_id: 1,
        content: json!({ "recipe": "abc" }),
    }
}

/// A run of a few records, closed.
fn written() -> (TempDir, std::path::PathBuf, Anchor) {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join("runs/run-1");
    let mut journal = Journal::create(&folder, header()).unwrap();
    for cycle in 1..4 {
        let id = journal.intend(Entry::new(Kind::Intent, 5, cycle, json!({ "command": "register" }))).unwrap();
        journal
            .append(Entry {
                command_id: Some(id),
                ..Entry::new(Kind::Outcome, 6, cycle, json!({ "z": 1.5, "a": "ü\n" }))
            })
            .unwrap();
        journal.store(&format!("cycle-{cycle}/measured.csv"), b"1,2,3\n", 7, cycle).unwrap();
    }
    let anchor = journal.close(9, 3, json!("accepted")).unwrap();
    (home, folder, anchor)
}

/// Changes the database as somebody would who knows SQL.
fn tamper(folder: &std::path::Path, sql: &str) {
    let database = Connection::open(folder.join("journal.sqlite")).unwrap();
    let triggers = ["record_is_not_changed", "record_is_not_deleted", "record_follows_the_last"];
    for trigger in triggers {
        database.execute_batch(&format!("DROP TRIGGER {trigger}")).unwrap();
    }
    database.execute_batch(sql).unwrap();
}

#[test]
fn what_was_written_is_read_and_verified() {
    let (_home, folder, anchor) = written();
    let verified = verify(&folder).unwrap();
    assert_eq!((verified.records, verified.artefacts, verified.closed, verified.anchored), (11, 3, true, 11));
    assert_eq!(verified.head, anchor.head);
    let records: Vec<_> = open_read_only(&folder).unwrap().records(0).map(Result::unwrap).collect();
    assert_eq!(records[2].payload, r#"{"a":"ü\n","z":1.5}"#);
    assert_eq!(records[2].part, "SN 7");
    assert!(matches!(Journal::open(&folder).map(|_| ()), Err(JournalError::Closed { .. })));
}

#[test]
fn every_change_is_found() {
    let fields = [
        "utc = 'x'",
        "boot_id = 'x'",
        "mono_ns = 1",
        "actor = 'x'",
        "station = 'x'",
        "kind = 'note'",
        "part = 'x'",
        "cycle = 9",
        "command_id = 77",
        "reason = 'x'",
        "payload = '{}'",
        "prev_hash = 'x'",
        "hash = 'x'",
        "seq = 99",
    ];
    let mut changes: Vec<_> = fields.iter().map(|field| format!("UPDATE record SET {field} WHERE seq = 6")).collect();
    changes.push("DELETE FROM record WHERE seq = 6".into());
    changes.push("DELETE FROM record WHERE seq = 1".into());
    changes.push("DELETE FROM record WHERE seq > 8".into());
    changes.push("DELETE FROM record".into());
    changes.push("UPDATE record SET seq = 100 WHERE seq = 5; UPDATE record SET seq = 5 WHERE seq = 6; UPDATE record SET seq = 6 WHERE seq = 100".into());
    changes.push("INSERT INTO record SELECT 12, utc, boot_id, mono_ns, actor, station, kind, part, cycle, command_id, reason, payload, prev_hash, 'y' FROM record WHERE seq = 6".into());
    for sql in changes {
        let (_home, folder, _) = written();
        tamper(&folder, &sql);
        assert!(matches!(verify(&folder), Err(JournalError::Broken { .. })), "{sql}: {:?}", verify(&folder));
    }
}

#[test]
fn a_cut_tail_is_found_by_an_anchor_kept_elsewhere_and_a_changed_file_by_its_hash() {
    let (_home, folder, anchor) = written();
    std::fs::remove_file(folder.join("journal.anchor")).unwrap();
    tamper(&folder, "DELETE FROM record WHERE seq > 8");
    assert!(!verify(&folder).unwrap().closed);
    assert!(matches!(verify_against(&folder, &anchor), Err(JournalError::Broken { seq: 9, .. })));
    let (_home, folder, _) = written();
    std::fs::write(folder.join("cycle-2/measured.csv"), "1,2,4\n").unwrap();
    assert!(matches!(verify(&folder), Err(JournalError::Broken { seq: 7, .. })));
}

#[test]
fn triggers_stand_in_the_way_of_changes() {
    let (_home, folder, _) = written();
    let database = Connection::open(folder.join("journal.sqlite")).unwrap();
    for sql in ["UPDATE record SET cycle = 1", "DELETE FROM record"] {
        assert!(database.execute_batch(sql).is_err());
    }
}

#[test]
fn a_writer_that_was_cut_off_keeps_every_acknowledged_record_and_reuses_no_number() {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    let first = journal.intend(Entry::new(Kind::Intent, 1, 1, json!({}))).unwrap();
    assert!(matches!(Journal::open(&folder).map(|_| ()), Err(JournalError::Busy { .. })), "two writers");
    assert_eq!(verify(&folder).unwrap().open_intents, [first], "read while it is written");
    // The folder as a power cut would leave it: nothing was closed.
    let copy = home.path().join("copy");
    std::fs::create_dir(&copy).unwrap();
    for name in ["journal.sqlite", "journal.sqlite-wal", "journal.anchor"] {
        std::fs::copy(folder.join(name), copy.join(name)).unwrap();
    }
    let mut again = Journal::open(&copy).unwrap();
    assert_eq!(again.open_intents().unwrap().iter().map(|r| r.command_id).collect::<Vec<_>>(), [Some(first)]);
    assert_eq!(again.intend(Entry::new(Kind::Intent, 1, 1, json!({}))).unwrap(), first + 1);
}

#[test]
fn folders_in_use_and_foreign_files_are_refused() {
    let (home, folder, _) = written();
    assert!(matches!(Journal::create(&folder, header()).map(|_| ()), Err(JournalError::Exists { .. })));
    assert!(matches!(verify(home.path()), Err(JournalError::Absent { .. })));
    let file = home.path().join("file");
    std::fs::write(&file, "x").unwrap();
    assert!(matches!(Journal::create(file.join("below"), header()).map(|_| ()), Err(JournalError::File { .. })));
    for (name, sql) in [("text", None), ("foreign", Some("CREATE TABLE t (a)"))] {
        let other = home.path().join(name);
        std::fs::create_dir(&other).unwrap();
        match sql {
            Some(sql) => Connection::open(other.join("journal.sqlite")).unwrap().execute_batch(sql).unwrap(),
            None => std::fs::write(other.join("journal.sqlite"), "not a database").unwrap(),
        }
        assert!(matches!(Journal::open(&other).map(|_| ()), Err(JournalError::Foreign { .. })), "{name}");
    }
}

#[test]
fn names_do_not_lead_out_of_the_folder_and_nothing_on_record_is_written_over() {
    let home = tempfile::tempdir().unwrap();
    let mut journal = Journal::create(home.path().join("run"), header()).unwrap();
    for name in ["", "../x", "/x", "a/../b", "a/", "journal.sqlite", "journal.sqlite-wal", ".lock"] {
        assert!(matches!(journal.store(name, b"x", 0, 0), Err(JournalError::Name { .. })), "{name}");
    }
    let stored = journal.store("a.txt", b"x", 0, 0).unwrap();
    assert_eq!(journal.store("a.txt", b"x", 0, 0).unwrap(), stored);
    assert!(matches!(journal.store("a.txt", b"y", 0, 0), Err(JournalError::Recorded { .. })));
}
