//! Journals for the tests, and functions that tamper with them.

use std::ops::Deref;
use std::path::{Path, PathBuf};

use ed25519_compact::{KeyPair, Seed};
use regrind_journal::{AuditKey, Header, Journal, Reader, canonical_json, sha256_hex};
use regrind_testutils::keep::keep;
use rusqlite::Connection;
use serde_json::{Value, json};
use tempfile::TempDir;

/// Folder that is deleted after the test. Its journals are kept for the Python verifier on request.
pub struct Home(TempDir);

pub fn home() -> Home {
    Home(tempfile::tempdir().unwrap())
}

impl Deref for Home {
    type Target = TempDir;

    fn deref(&self) -> &TempDir {
        &self.0
    }
}

impl Drop for Home {
    fn drop(&mut self) {
        keep(self.0.path());
    }
}

pub fn header() -> Header {
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

/// Changes the database by SQL, after it has removed the triggers that protect the records.
pub fn tamper(folder: &Path, sql: &str) {
    let database = Connection::open(folder.join("journal.sqlite")).unwrap();
    database.pragma_update(None, "synchronous", "off").unwrap();
    for trigger in ["record_is_not_changed", "record_is_not_deleted", "record_follows_the_last"] {
        database.execute_batch(&format!("DROP TRIGGER IF EXISTS {trigger}")).unwrap();
    }
    database.execute_batch(&format!("BEGIN; {sql}; COMMIT")).unwrap_or_else(|error| panic!("{sql}: {error}"));
}

/// Writes a closed, signed journal with this number of records in one transaction.
/// The records after the first two follow docs/journal.md and do not use the code under test.
pub fn long(records: u64) -> (Home, PathBuf) {
    let home = home();
    let folder = home.path().join("run");
    let (key, secret) = key_and_secret(home.path());
    Journal::create_with(&folder, header(), Some(key)).unwrap();
    let first: Vec<_> = Reader::open(&folder).unwrap().records(1).map(Result::unwrap).collect();
    let mut long = Long { secret, records: 2, sealed: 2, open: None, head: first[1].hash.clone(), anchor: Value::Null };
    let mut database = Connection::open(folder.join("journal.sqlite")).unwrap();
    let transaction = database.transaction().unwrap();
    while long.records < records - 2 {
        long.write_next(&transaction);
    }
    long.write(&transaction, "end", None, &json!({ "ending": "accepted" }));
    long.seal(&transaction);
    transaction.commit().unwrap();
    std::fs::write(folder.join("journal.anchor"), canonical_json(&long.anchor) + "\n").unwrap();
    (home, folder)
}

/// Creates a key. Returns the key, and its secret half as an independent library reads it.
fn key_and_secret(home: &Path) -> (AuditKey, KeyPair) {
    let path = home.join("audit.key");
    let key = AuditKey::make(&path).unwrap();
    let text = std::fs::read_to_string(path).unwrap();
    let digits = text.lines().find_map(|line| line.strip_prefix("secret = \"")?.strip_suffix('"')).unwrap();
    let byte = |k| u8::from_str_radix(&digits[2 * k..2 * k + 2], 16).unwrap();
    (key, KeyPair::from_seed(Seed::new(std::array::from_fn(byte))))
}

struct Long {
    secret: KeyPair,
    records: u64,
    /// Number of the last seal.
    sealed: u64,
    /// Command that has no outcome yet.
    open: Option<u32>,
    head: String,
    anchor: Value,
}

impl Long {
    /// Writes the next record. Of ten records, two are a command and its outcome. A seal follows every 256 records.
    fn write_next(&mut self, database: &Connection) {
        let seq = self.records + 1;
        let id = seq as u32 / 10 + 1;
        match (seq % 10, self.open) {
            _ if self.records >= self.sealed + 256 => self.seal(database),
            (4, None) => {
                self.write(database, "intent", Some(id), &json!({ "command": "register", "cycle": 1 }));
                self.open = Some(id);
            }
            (7.., Some(id)) => {
                self.write(database, "outcome", Some(id), &json!({ "event": "registered" }));
                self.open = None;
            }
            _ => {
                let words = "of the path, \u{b5}m";
                let payload = json!({ "done": seq, "event": "progressed", "total": 1_000_000, "words": words });
                self.write(database, "event", None, &payload);
            }
        }
    }

    fn seal(&mut self, database: &Connection) {
        let text = json!({ "head": self.head, "records": self.records, "run": "run-1" });
        let message = format!("regrind journal seal 1\n{}", canonical_json(&text));
        let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
        let mut seal = json!({
            "head": self.head, "records": self.records, "key": hex(&*self.secret.pk),
            "signature": hex(&*self.secret.sk.sign(message, None)),
        });
        self.write(database, "seal", None, &seal);
        self.sealed = self.records;
        seal["run"] = json!("run-1");
        self.anchor = seal;
    }

    fn write(&mut self, database: &Connection, kind: &str, command_id: Option<u32>, payload: &Value) {
        let seq = self.records + 1;
        let (utc, boot_id, previous) = ("2026-07-04T12:00:00.123456789Z", "5f0c9b61d2e8a734", &self.head);
        let text = canonical_json(&json!({
            "seq": seq, "utc": utc, "boot_id": boot_id, "mono_ns": seq, "actor": "grinder", "station": "wire",
            "kind": kind, "part": "SN 7", "cycle": 1, "command_id": command_id, "reason": "", "payload": payload,
        }));
        let hash = sha256_hex(format!("regrind journal record 1\n{previous}\n{text}").as_bytes());
        let sql = "INSERT INTO record VALUES (?1, ?2, ?3, ?1, 'grinder', 'wire', ?4, 'SN 7', 1, ?5, '', ?6, ?7, ?8)";
        let payload = canonical_json(payload);
        let values = rusqlite::params![seq as i64, utc, boot_id, kind, command_id, payload, previous, hash];
        database.prepare_cached(sql).unwrap().execute(values).unwrap();
        (self.records, self.head) = (seq, hash);
    }
}
