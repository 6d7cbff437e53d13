//! Tests of durability: a journal has every acknowledged record, and no record that was refused.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use regrind_journal::{
    AuditKey, Entry, ExternalEvidence, Journal, JournalError, Reader, RecordKind, verify, verify_against,
};
use rusqlite::Connection;
use serde_json::json;

use crate::closed::closed;
use crate::written::{header, home, long, tamper};

#[test]
fn journal_write_read_verify() {
    let (_home, folder, anchor) = closed();
    let verified = verify(&folder).unwrap();
    assert_eq!((verified.records, verified.artefacts, verified.closed, verified.anchored), (11, 3, true, 11));
    assert_eq!(verified.head, anchor.head);
    let records: Vec<_> = Reader::open(&folder).unwrap().records(0).map(Result::unwrap).collect();
    assert_eq!(records[2].payload, r#"{"a":"ü\n","z":1.5}"#);
    assert_eq!(records[2].part, "SN 7");
    assert!(matches!(Journal::open(&folder).map(|_| ()), Err(JournalError::Closed { .. })));
}

#[test]
fn cut_tail_and_changed_file_found() {
    let (_home, folder, anchor) = closed();
    std::fs::remove_file(folder.join("journal.anchor")).unwrap();
    tamper(&folder, "DELETE FROM record WHERE seq > 8");
    assert!(!verify(&folder).unwrap().closed);
    assert!(matches!(
        verify_against(&folder, &ExternalEvidence { anchor: Some(anchor), keys: Vec::new() }),
        Err(JournalError::Broken { seq: 9, .. })
    ));
    let (_home, folder, _) = closed();
    std::fs::write(folder.join("cycle-2/measured.csv"), "1,2,4\n").unwrap();
    assert!(matches!(verify(&folder), Err(JournalError::Broken { seq: 7, .. })));
}

#[test]
fn triggers_refuse_changes() {
    let (_home, folder, _) = closed();
    let database = Connection::open(folder.join("journal.sqlite")).unwrap();
    for sql in ["UPDATE record SET cycle = 1", "DELETE FROM record"] {
        assert!(database.execute_batch(sql).is_err());
    }
}

#[test]
fn reopen_after_cut_reuses_no_number() {
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    let first = journal.intend(Entry::new(RecordKind::Intent, 1, 1, json!({}))).unwrap();
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
    assert_eq!(again.intend(Entry::new(RecordKind::Intent, 1, 1, json!({}))).unwrap(), first + 1);
}

#[test]
fn open_intents_without_index() {
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    for k in 0..4 {
        let id = journal.intend(Entry::new(RecordKind::Intent, k, 1, json!({}))).unwrap();
        if k % 2 == 0 {
            let outcome = Entry { command_id: Some(id), ..Entry::new(RecordKind::Outcome, k, 1, json!({})) };
            journal.append(outcome.clone()).unwrap();
            journal.append(Entry { mono_ns: 9, ..outcome }).unwrap();
        }
    }
    drop(journal);
    tamper(&folder, "DROP INDEX record_command");
    let mut journal = Journal::open(&folder).unwrap();
    let open: Vec<_> = journal.open_intents().unwrap().iter().map(|record| record.command_id).collect();
    assert_eq!(open, [Some(2), Some(4)]);
    assert_eq!(journal.intend(Entry::new(RecordKind::Intent, 9, 1, json!({}))).unwrap(), 5);
}

#[test]
fn journal_refuses_foreign_folders() {
    let (home, folder, _) = closed();
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
fn store_refuses_escape_and_overwrite() {
    let home = home();
    let mut journal = Journal::create(home.path().join("run"), header()).unwrap();
    for name in ["", "../x", "/x", "a/../b", "a/", "journal.sqlite", "journal.sqlite-wal", ".lock"] {
        assert!(matches!(journal.store(name, b"x", 0, 0), Err(JournalError::Name { .. })), "{name}");
    }
    let stored = journal.store("a.txt", b"x", 0, 0).unwrap();
    assert_eq!(journal.store("a.txt", b"x", 0, 0).unwrap(), stored);
    assert!(matches!(journal.store("a.txt", b"y", 0, 0), Err(JournalError::Recorded { .. })));
}

/// Environment variable of a child process. Its value is the folder in which the process plays its part.
const PLAY: &str = "REGRIND_JOURNAL_PLAY";

/// Checks that the verification ignores the temporary file of an anchor that was not completed.
#[test]
fn partial_anchor_is_ignored() {
    let (_home, folder, _) = closed();
    std::fs::write(folder.join(".journal.anchor.tmp"), b"{\"records\":").unwrap();
    std::fs::write(folder.join("notes.txt"), b"").unwrap();
    assert_eq!(verify(&folder).unwrap().unrecorded, ["notes.txt"]);
}

fn child(part: &str, folder: &Path) -> Command {
    let mut child = Command::new(std::env::current_exe().unwrap());
    child.args([&format!("writing::{part}"), "--exact", "--nocapture", "--test-threads=1"]).env(PLAY, folder);
    child
}

/// Returns the folder in which this process plays a part; `None` in an ordinary test run.
fn stage() -> Option<PathBuf> {
    std::env::var_os(PLAY).map(PathBuf::from)
}

/// Writes records until the process is killed, and prints the number of each acknowledged record.
/// Only a child process plays this part. In an ordinary test run this function returns at once.
#[test]
fn part_of_a_writer() {
    let Some(folder) = stage() else { return };
    let mut journal = Journal::create(folder, header()).unwrap();
    for cycle in 0.. {
        let payload = json!({ "words": "x".repeat(cycle as usize % 3000) });
        let seq = journal.append(Entry::new(RecordKind::Event, 0, cycle, payload)).unwrap();
        println!("\nacknowledged {seq}");
    }
}

#[test]
fn killed_writer_loses_no_record() {
    for least in [1, 40, 300] {
        let home = home();
        let folder = home.path().join("run");
        let mut writer = child("part_of_a_writer", &folder).stdout(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(writer.stdout.take().unwrap()).lines();
        let acknowledged = |line: String| line.strip_prefix("acknowledged ").map(|seq| seq.parse::<u64>().unwrap());
        let mut last = 0;
        while last < least {
            let line = lines.next().expect("the writer goes on until it is killed").unwrap();
            last = acknowledged(line).unwrap_or(last);
        }
        writer.kill().unwrap();
        writer.wait().unwrap();
        // What it still told before it died, the cut line left out.
        let rest: Vec<_> = lines.map_while(Result::ok).collect();
        let whole = rest.iter().take(rest.len().saturating_sub(1)).cloned().filter_map(acknowledged);
        let last = whole.max().unwrap_or(last).max(last);
        let verified = verify(&folder).unwrap();
        assert!(verified.records >= last, "{last} were acknowledged and {} are there", verified.records);
        assert!(!verified.closed);
        let mut journal = Journal::open(&folder).unwrap();
        assert_eq!(journal.last_seq(), verified.records + 1, "the lock was free and nothing was lost");
        journal.append(Entry::new(RecordKind::Note, 0, 0, json!("gone on"))).unwrap();
        journal.close(0, 0, json!("accepted")).unwrap();
        assert!(verify(&folder).unwrap().closed);
    }
}

/// Writes records to a disk of 512 KiB until it is full. Then removes a file and continues the run.
/// Only a child process plays this part. In an ordinary test run this function returns at once.
#[test]
fn part_of_a_writer_on_a_small_disk() {
    let Some(disk) = stage() else { return };
    let ballast = disk.join("ballast");
    std::fs::write(&ballast, vec![0; 128 << 10]).unwrap();
    let folder = disk.join("run");
    let mut journal = Journal::create_with(&folder, header(), Some(AuditKey::new())).unwrap();
    let event = |k: u64| Entry::new(RecordKind::Event, k, 1, json!({ "words": "x".repeat(2000) }));
    let full =
        (0..10_000).find_map(|k| journal.append(event(k)).err()).expect("the disk was large enough for everything");
    assert!(full.is_disk_full(), "{full:?}");
    assert!(full.to_string().contains("free space"), "{full}");
    // Until there is no room for a short record either.
    let short = |k: u64| Entry::new(RecordKind::Event, k, 2, json!({}));
    (0..10_000).find_map(|k| journal.append(short(k)).err()).expect("the disk was large enough for everything");
    let acknowledged = journal.last_seq();
    assert_eq!(verify(&folder).unwrap().records, acknowledged, "read on a full disk");
    let refused = journal.intend(Entry::new(RecordKind::Intent, 0, 1, json!({}))).unwrap_err();
    assert!(refused.is_disk_full(), "a command is not on record, so it is not carried out: {refused:?}");
    let refused = journal.store("large.csv", &[b'1'; 256 << 10], 0, 1).unwrap_err();
    assert!(refused.is_disk_full(), "{refused:?}");
    assert_eq!(std::fs::read_dir(&folder).unwrap().filter(|f| is_named(f, "large")).count(), 0, "half a file");
    std::fs::remove_file(ballast).unwrap();
    assert_eq!(journal.append(event(0)).unwrap(), acknowledged + 1, "room again: the run goes on");
    assert_eq!(journal.intend(Entry::new(RecordKind::Intent, 0, 1, json!({}))).unwrap(), 1, "no number was used up");
    journal.close(0, 1, json!("stopped")).unwrap();
    let verified = verify(&folder).unwrap();
    // The event, the command, the end and its seal; the first seal stands behind the beginning.
    assert_eq!((verified.records, verified.seals), (acknowledged + 4, 2));
    println!("\nplayed to the end, {acknowledged} records");
}

fn is_named(file: &std::io::Result<std::fs::DirEntry>, part: &str) -> bool {
    file.as_ref().is_ok_and(|file| file.file_name().to_string_lossy().contains(part))
}

/// Runs the writer on a disk of 512 KiB in its own mount namespace.
#[test]
#[ignore = "needs a system that gives users a mount namespace"]
fn full_disk_stops_and_recovers() {
    let home = home();
    let mount = "mount -t tmpfs -o size=512k none \"$0\" || exit 77; exec \"$@\"";
    let player = child("part_of_a_writer_on_a_small_disk", home.path());
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--mount", "sh", "-c", mount]).arg(home.path());
    command.arg(player.get_program()).args(player.get_args()).env(PLAY, home.path());
    match command.output() {
        Ok(output) if String::from_utf8_lossy(&output.stdout).contains("played to the end") => {}
        Ok(output) if output.status.code() == Some(101) => {
            panic!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
        }
        other => panic!("this system gives no small disk to a test: {other:?}"),
    }
}

#[cfg(target_os = "linux")]
#[test]
fn full_disk_reported_by_store() {
    // A device on which every write fails for want of room, under the name that a file has before it is whole.
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    let before = verify(&folder).unwrap();
    std::os::unix::fs::symlink("/dev/full", folder.join(".points.csv.tmp")).unwrap();
    let refused = journal.store("points.csv", b"1,2,3\n", 0, 1).unwrap_err();
    assert!(refused.is_disk_full(), "{refused:?}");
    assert!(!folder.join("points.csv").exists());
    assert_eq!(verify(&folder).unwrap(), before, "what is not on the disk is not on record");
    std::os::unix::fs::symlink("/dev/full", folder.join(".journal.anchor.tmp")).unwrap();
    assert!(journal.anchor().unwrap_err().is_disk_full());
    assert_eq!(verify(&folder).unwrap(), before, "the anchor before stands");
    journal.store("points.csv", b"1,2,3\n", 0, 1).unwrap();
}

/// Sets or clears the write protection of a folder and of the files in it.
#[cfg(unix)]
fn make_read_only(folder: &Path, read_only: bool) {
    use std::os::unix::fs::PermissionsExt;
    let mode = |file, folder| std::fs::Permissions::from_mode(if read_only { file } else { folder });
    for entry in std::fs::read_dir(folder).unwrap() {
        std::fs::set_permissions(entry.unwrap().path(), mode(0o444, 0o644)).unwrap();
    }
    std::fs::set_permissions(folder, mode(0o555, 0o755)).unwrap();
}

#[cfg(unix)]
#[test]
#[ignore = "needs a user who may not write everywhere: not root"]
fn read_only_folder_refuses_writer() {
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    journal.append(Entry::new(RecordKind::Note, 0, 0, json!("x"))).unwrap();
    let anchor = journal.close(0, 0, json!("stopped")).unwrap();
    make_read_only(&folder, true);
    let verified = verify(&folder);
    let refused = [Journal::open(&folder).map(|_| ()), Journal::create(folder.join("below"), header()).map(|_| ())];
    make_read_only(&folder, false);
    assert_eq!(verified.unwrap().head, anchor.head);
    for refused in refused {
        assert!(matches!(&refused, Err(JournalError::File { .. })), "{refused:?}");
        assert!(refused.unwrap_err().to_string().contains("the right to write"));
    }
}

#[test]
fn multi_page_journal_verifies() {
    const RECORDS: u64 = 2_100;
    let (_home, folder) = long(RECORDS);
    assert_eq!(verify(&folder).unwrap().records, RECORDS);
    let reader = Reader::open(&folder).unwrap();
    for from in [0, 1, 2, 1_023, 1_024, RECORDS, RECORDS + 1, u64::MAX] {
        let numbers: Vec<u64> = reader.records(from).map(|r| r.unwrap().seq).collect();
        assert_eq!(numbers, (from.max(1)..=RECORDS).collect::<Vec<_>>(), "from {from}");
    }
    // Pages end at 1, 3, 7 ... 511, 1023, 1535.
    for seq in [1, 2, 3, 4, 511, 512, 1_535, 1_536, RECORDS] {
        let (_home, folder) = long(RECORDS);
        tamper(&folder, &format!("UPDATE record SET kind = 'nothing' WHERE seq = {seq}"));
        let found = verify(&folder);
        assert!(matches!(found, Err(JournalError::Broken { seq: at, .. }) if at == seq), "{seq}: {found:?}");
        let mut given = Reader::open(&folder).unwrap().records(0).map(|r| r.is_ok()).collect::<Vec<_>>();
        assert_eq!(
            (given.len() as u64, given.pop()),
            (seq, Some(false)),
            "what stands before it is given, and nothing behind"
        );
    }
}

#[test]
fn reader_finds_appended_records() {
    let home = home();
    let folder = home.path().join("run");
    let mut journal = Journal::create(&folder, header()).unwrap();
    let reader = Reader::open(&folder).unwrap();
    let mut records = reader.records(0);
    for seq in 1..40 {
        assert_eq!(records.next().unwrap().unwrap().seq, seq);
        assert_eq!(journal.append(Entry::new(RecordKind::Note, 0, 0, json!(seq))).unwrap(), seq + 1);
    }
}
