//! Tests of tampering: each change of a journal is detected and located.

use std::fs;
use std::path::{Path, PathBuf};

use regrind_disk::SeededNumbers;
use regrind_journal::{JournalError, Reader, Verified, verify};
use rusqlite::Connection;
use rusqlite::types::Value;

use crate::closed::closed;
use crate::written::{Home, long, tamper};

/// Change of a journal, and the first record that fails verification after it.
pub struct Tampering {
    pub sql: String,
    pub first_bad: u64,
}

const TEXTS: [&str; 10] =
    ["utc", "boot_id", "actor", "station", "kind", "part", "reason", "payload", "prev_hash", "hash"];

impl Tampering {
    /// Draws a change of a closed journal with this number of records.
    pub fn drawn(drawn: &mut SeededNumbers, records: u64) -> Self {
        let at = 1 + drawn.below(records);
        match drawn.below(5) {
            0 => Self::change(drawn, at, records),
            1 => Self { sql: format!("DELETE FROM record WHERE seq = {at}"), first_bad: at },
            2 => Self::insertion(drawn, at, records),
            3 => {
                let other = 1 + (at + drawn.below(records - 1)) % records;
                let (at, other) = (at.min(other), at.max(other));
                let sql = format!(
                    "UPDATE record SET seq = -1 WHERE seq = {at}; UPDATE record SET seq = {at} WHERE seq = {other};
                     UPDATE record SET seq = {other} WHERE seq = -1"
                );
                Self { sql, first_bad: at }
            }
            _ if drawn.below(4) == 0 => Self { sql: format!("DELETE FROM record WHERE seq <= {at}"), first_bad: 1 },
            _ => Self { sql: format!("DELETE FROM record WHERE seq >= {at}"), first_bad: at },
        }
    }

    fn change(drawn: &mut SeededNumbers, at: u64, records: u64) -> Self {
        let sql = match drawn.below(14) {
            0 => format!("UPDATE record SET seq = {} WHERE seq = {at}", records + 1 + drawn.below(1 << 40)),
            1 => format!("UPDATE record SET mono_ns = mono_ns + {} WHERE seq = {at}", 1 + drawn.below(1 << 40)),
            2 => format!("UPDATE record SET cycle = cycle + {} WHERE seq = {at}", 1 + drawn.below(1 << 33)),
            3 => format!("UPDATE record SET command_id = coalesce(command_id, -1) + 1 WHERE seq = {at}"),
            column => {
                let text = TEXTS[column as usize - 4];
                // Any letter of it becomes another one, or one is added.
                let (place, letter) = (drawn.below(1 << 20), char::from(b'a' + drawn.below(26) as u8));
                let begin = format!("substr({text}, 1, {place} % (1 + length({text})))");
                let rest = format!("substr({text}, {} + {place} % (1 + length({text})))", 1 + drawn.below(2));
                format!(
                    "UPDATE record SET {text} = iif({begin} || '{letter}' || {rest} = {text}, {text} || 'x', \
                     {begin} || '{letter}' || {rest}) WHERE seq = {at}"
                )
            }
        };
        Self { sql, first_bad: at }
    }

    /// Returns a change that inserts a copy of another record. The numbers of the later records increase by one.
    fn insertion(drawn: &mut SeededNumbers, at: u64, records: u64) -> Self {
        let copied = 1 + drawn.below(records);
        let copied = if copied >= at { copied + 1 } else { copied };
        let others = "utc, boot_id, mono_ns, actor, station, kind, part, cycle, command_id, reason, payload";
        let zeros = "0".repeat(64);
        let sql = format!(
            "UPDATE record SET seq = -seq - 1 WHERE seq >= {at}; UPDATE record SET seq = -seq WHERE seq < 0;
             INSERT INTO record SELECT {at}, {others}, 
             coalesce((SELECT hash FROM record WHERE seq = {at} - 1), '{zeros}'), \
             substr(hash, 2) || 'a' FROM record WHERE seq = {copied}"
        );
        Self { sql, first_bad: at }
    }
}

/// Returns the number of the first record that is invalid or missing.
pub fn place(found: &Result<Verified, JournalError>) -> Option<u64> {
    match found {
        Err(JournalError::Broken { seq, .. }) => Some(*seq),
        Ok(verified) if verified.lacks_last_seal() => Some(verified.records + 1),
        _ => None,
    }
}

/// Copies a journal, so that a test can change the copy.
pub fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for name in ["journal.sqlite", "journal.anchor"] {
        fs::copy(from.join(name), to.join(name)).unwrap();
    }
    for name in ["journal.sqlite-wal", "journal.sqlite-shm"] {
        let _ = fs::remove_file(to.join(name));
    }
}

/// Creates a long journal whose database is one file without a log.
pub fn long_and_whole(records: u64) -> (Home, PathBuf) {
    let (home, folder) = long(records);
    tamper(&folder, "SELECT 1");
    assert!(!folder.join("journal.sqlite-wal").exists());
    (home, folder)
}

#[test]
fn journal_by_documentation_verifies() {
    let (_home, folder) = long(1_000);
    let verified = verify(&folder).unwrap();
    assert_eq!((verified.records, verified.signed, verified.anchored), (1_000, 999, 999));
    assert_eq!((verified.closed, verified.seals, verified.keys.len()), (true, 5, 1));
    assert!(verified.open_intents.is_empty() && !verified.lacks_last_seal(), "{verified:?}");
}

/// Returns how many of the 5,000 random changes to try. .ci/long sets the full number.
pub fn tries(few: u64) -> u64 {
    std::env::var("REGRIND_TAMPERINGS").ok().and_then(|number| number.parse().ok()).unwrap_or(few)
}

#[test]
fn random_tampering_is_located() {
    const RECORDS: u64 = 10_000;
    let (home, whole) = long_and_whole(RECORDS);
    let mut drawn = SeededNumbers::new(1);
    let changed = home.path().join("changed");
    for number in 0..tries(100) {
        let Tampering { sql, first_bad } = Tampering::drawn(&mut drawn, RECORDS);
        copied(&whole, &changed);
        tamper(&changed, &sql);
        let found = verify(&changed);
        assert_eq!(place(&found), Some(first_bad), "{number}: {sql}: {found:?}");
    }
    // What was changed last is for no other verifier: it has none of the ends of a run.
    fs::remove_dir_all(changed).unwrap();
}

#[test]
fn bit_flip_in_database_is_located() {
    let (home, whole) = long_and_whole(100);
    let columns = ["seq", "mono_ns", "cycle", "command_id"].into_iter().chain(TEXTS);
    let mut drawn = SeededNumbers::new(2);
    let changed = home.path().join("changed");
    for column in columns.flat_map(|column| [column; 8]) {
        let at = 1 + drawn.below(100);
        copied(&whole, &changed);
        tamper(&changed, "SELECT 1");
        let database = Connection::open(changed.join("journal.sqlite")).unwrap();
        let value = database.query_row(&format!("SELECT {column} FROM record WHERE seq = {at}"), [], |row| row.get(0));
        let flipped = match value.unwrap() {
            Value::Integer(number) => Value::Integer(number ^ 1 << drawn.below(63)),
            Value::Text(text) if !text.is_empty() => {
                let mut bytes = text.into_bytes();
                let bit = drawn.below(8 * bytes.len() as u64) as usize;
                bytes[bit / 8] ^= 1 << (bit % 8);
                Value::Blob(bytes)
            }
            _ => continue,
        };
        let is_text = matches!(flipped, Value::Blob(_));
        let value = if is_text { "CAST(?1 AS TEXT)" } else { "?1" };
        // Two records cannot have one number.
        if database.execute(&format!("UPDATE record SET {column} = {value} WHERE seq = {at}"), [flipped]).is_err() {
            continue;
        }
        drop(database);
        let found = verify(&changed);
        assert_eq!(place(&found), Some(at), "{column}: {found:?}");
    }
}

#[test]
fn row_before_first_record_is_found() {
    for number in [0, -1, i64::MIN] {
        let (_home, folder, _) = closed();
        let others = "utc, boot_id, mono_ns, actor, station, kind, part, cycle, command_id, reason, payload, prev_hash";
        tamper(&folder, &format!("INSERT INTO record SELECT {number}, {others}, 'x' FROM record WHERE seq = 6"));
        let found = verify(&folder);
        assert!(matches!(found, Err(JournalError::Broken { seq: 0, .. })), "{number}: {found:?}");
    }
}

#[test]
fn foreign_schema_is_refused() {
    let view = "ALTER TABLE record RENAME TO kept; CREATE VIEW record AS SELECT * FROM kept";
    let endless = "ALTER TABLE record RENAME TO kept; CREATE VIEW record AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) \
                   SELECT k AS seq, utc, boot_id, mono_ns, actor, station, kind, part, cycle, command_id, reason, payload, prev_hash, hash FROM n, kept";
    for sql in
        [view, endless, "CREATE TABLE other (k INTEGER)", "CREATE INDEX other ON record (part)", "DROP TABLE record"]
    {
        let (_home, folder, _) = closed();
        tamper(&folder, sql);
        for error in [verify(&folder).unwrap_err(), Reader::open(&folder).map(drop).unwrap_err()] {
            assert!(matches!(error, JournalError::Foreign { .. }), "{sql}: {error}");
        }
    }
}

#[cfg(unix)]
#[test]
fn verify_never_blocks_on_pipes() {
    let pipe = |path: &Path| {
        let _ = fs::remove_file(path);
        assert!(std::process::Command::new("mkfifo").arg(path).status().unwrap().success());
    };
    let (_home, folder, _) = closed();
    pipe(&folder.join(".lock"));
    assert!(!verify(&folder).unwrap().under_way);
    pipe(&folder.join("journal.anchor"));
    assert!(matches!(verify(&folder), Err(JournalError::File { .. })));
    let (_home, folder, _) = closed();
    pipe(&folder.join("journal.sqlite-wal"));
    assert!(matches!(verify(&folder), Err(JournalError::Foreign { .. })));
    let (_home, folder, _) = closed();
    let file = folder.join("cycle-1/measured.csv");
    // One that is said to be large is not read: it has another length than the one on record.
    fs::File::options().write(true).open(&file).unwrap().set_len(1 << 40).unwrap();
    assert!(matches!(verify(&folder), Err(JournalError::Broken { .. })));
}

#[test]
fn flipped_file_byte_is_found() {
    let (home, whole) = long_and_whole(60);
    let before = verify(&whole).unwrap();
    let bytes = fs::read(whole.join("journal.sqlite")).unwrap();
    let changed = home.path().join("changed");
    copied(&whole, &changed);
    let mut drawn = SeededNumbers::new(3);
    let anywhere = (0..tries(100) * 15).map(|_| (drawn.below(bytes.len() as u64) as usize, 1 + drawn.below(255) as u8));
    let header = (0..100).flat_map(|at| [(at, 1), (at, 0x80), (at, 0xff)]);
    let mut found = 0;
    for (at, flip) in header.chain(anywhere.collect::<Vec<_>>()) {
        let mut bytes = bytes.clone();
        bytes[at] ^= flip;
        fs::write(changed.join("journal.sqlite"), &bytes).unwrap();
        match verify(&changed) {
            Ok(verified) => assert_eq!(verified, before, "byte {at} by {flip:#x}"),
            Err(_) => found += 1,
        }
        for name in ["journal.sqlite-wal", "journal.sqlite-shm"] {
            let _ = fs::remove_file(changed.join(name));
        }
    }
    assert!(found > 500, "{found} found");
    fs::remove_dir_all(changed).unwrap();
    drop(home);
}

#[test]
fn flipped_anchor_bit_is_found() {
    let (_home, folder) = long_and_whole(60);
    let before = verify(&folder).unwrap();
    let bytes = fs::read(folder.join("journal.anchor")).unwrap();
    let mut unread = 0;
    for bit in (0..8 * bytes.len()).step_by(if tries(0) > 0 { 1 } else { 7 }) {
        let mut bytes = bytes.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        fs::write(folder.join("journal.anchor"), &bytes).unwrap();
        match verify(&folder) {
            // Blanks between members, and a member that is not read any more.
            Ok(verified) if verified.anchored == 59 => unread += 1,
            Ok(verified) => assert!(verified.anchored < before.anchored, "bit {bit}"),
            Err(JournalError::Broken { .. }) => {}
            Err(other) => panic!("bit {bit}: {other}"),
        }
    }
    assert!(unread < 60, "{unread}");
    fs::write(folder.join("journal.anchor"), bytes).unwrap();
}

#[test]
fn changed_column_is_located() {
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
    for field in fields {
        let (_home, folder, _) = closed();
        tamper(&folder, &format!("UPDATE record SET {field} WHERE seq = 6"));
        let found = verify(&folder);
        assert!(matches!(found, Err(JournalError::Broken { seq: 6, .. })), "{field}: {found:?}");
    }
    let (_home, folder, _) = closed();
    tamper(&folder, "DELETE FROM record");
    assert!(matches!(verify(&folder), Err(JournalError::Broken { seq: 1, .. })));
}
