//! Records that a cell can send with any program: with names, texts and times that Regrind does not write.

use std::fs;
use std::path::Path;

use regrind::journal::{Entry, Header, Journal, Reader, Record, RecordKind, sha256_hex};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::Plant;

/// Content of all files of such runs.
const CONTENT: &[u8] = b"hello";

/// Run that a cell sends: its name, its part, the content of its first record, and the names of its files.
pub struct Forged<'a> {
    pub name: &'a str,
    pub part: &'a str,
    pub content: Value,
    pub files: &'a [&'a str],
}

impl<'a> Forged<'a> {
    pub fn named(name: &'a str) -> Self {
        Self { name, part: "SN-1", content: json!({ "recover": true, "cell": "sim" }), files: &[] }
    }

    /// Writes the run into a folder, with `notes` notes, and ends it.
    pub fn write(&self, folder: &Path, notes: u64) {
        let header = Header {
            run: self.name.into(),
            part: self.part.into(),
            actor: "Eve".into(),
            station: "console".into(),
            simulation: true,
            first_command_id: 1,
            content: self.content.clone(),
        };
        let mut journal = Journal::create(folder, header).unwrap();
        for file in self.files {
            let content = json!({ "name": file, "bytes": CONTENT.len(), "sha256": sha256_hex(CONTENT) });
            journal.append(Entry::new(RecordKind::Artefact, 0, 0, content)).unwrap();
        }
        for k in 0..notes {
            journal.append(Entry::new(RecordKind::Note, k, 0, json!({ "remark": "a note" }))).unwrap();
        }
        journal.close(notes, 0, json!({ "cmm_home": true, "grinder_home": true })).unwrap();
    }

    /// Sends the run to the plant with the rights of a cell. Returns the answer of the plant: empty if it has the run.
    pub fn ship(&self, plant: &Plant, cell: &str) -> Result<String, String> {
        let home = TempDir::new().unwrap();
        let folder = home.path().join("run");
        self.write(&folder, 0);
        let records = records(&folder);
        let hashes: Vec<String> = records.iter().map(|record| format!("decode('{}', 'hex')", record.hash)).collect();
        let texts: Vec<String> = records.iter().map(|record| format!("$text${}$text$", record.text())).collect();
        let text = format!(
            "DO $$ BEGIN PERFORM give_artefact(sha256('hello'), 'hello'); END $$; SELECT s.refused FROM open_run($run${}$run$) AS o,
            LATERAL ship(o.id, 1, ARRAY[{}], ARRAY[{}]) AS s",
            self.name,
            hashes.join(","),
            texts.join(",")
        );
        plant.asked_by(cell, &text)
    }
}

pub fn records(folder: &Path) -> Vec<Record> {
    Reader::open(folder).unwrap().records(1).map(Result::unwrap).collect()
}

/// Gives all records of a journal from the number `from` on another time, and chains them again, as a clock that is wrong
/// or an expert does.
pub fn set_clock(folder: &Path, from: u64, utc: &str) {
    rewrite(folder, from, |record| record.utc = utc.to_owned());
}

/// Changes the records of a journal from the number `from` on, and chains them again.
pub fn rewrite(folder: &Path, from: u64, change: impl Fn(&mut Record)) {
    let mut all = records(folder);
    let journal = rusqlite::Connection::open(folder.join("journal.sqlite")).unwrap();
    let triggers = "SELECT group_concat(sql, ';') FROM sqlite_master WHERE type = 'trigger'";
    let triggers: String = journal.query_row(triggers, [], |row| row.get(0)).unwrap();
    for trigger in ["record_is_not_changed", "record_is_not_deleted", "record_follows_the_last"] {
        journal.execute_batch(&format!("DROP TRIGGER {trigger}")).unwrap();
    }
    let mut head = "0".repeat(64);
    for record in &mut all {
        if record.seq >= from {
            change(record);
        }
        record.prev_hash = head;
        record.hash =
            sha256_hex(format!("regrind journal record 1\n{}\n{}", record.prev_hash, record.text()).as_bytes());
        head = record.hash.clone();
        let text = "UPDATE record SET utc = ?2, reason = ?3, prev_hash = ?4, hash = ?5 WHERE seq = ?1";
        let seq = i64::try_from(record.seq).unwrap();
        journal.execute(text, (seq, &record.utc, &record.reason, &record.prev_hash, &record.hash)).unwrap();
    }
    journal.execute_batch(&triggers).unwrap();
    // An expert leaves nothing that shows the change.
    let _ = fs::remove_file(folder.join("journal.anchor"));
}
