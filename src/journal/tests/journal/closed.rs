//! A run that is over.

use std::path::PathBuf;

use regrind_journal::{Anchor, Entry, Journal, RecordKind};
use serde_json::json;

use crate::written::{Home, header, home};

/// Creates a closed run of a few records.
pub fn closed() -> (Home, PathBuf, Anchor) {
    let home = home();
    let folder = home.path().join("runs/run-1");
    let mut journal = Journal::create(&folder, header()).unwrap();
    for cycle in 1..4 {
        let id = journal.intend(Entry::new(RecordKind::Intent, 5, cycle, json!({ "command": "register" }))).unwrap();
        journal
            .append(Entry {
                command_id: Some(id),
                ..Entry::new(RecordKind::Outcome, 6, cycle, json!({ "z": 1.5, "a": "ü\n" }))
            })
            .unwrap();
        journal.store(&format!("cycle-{cycle}/measured.csv"), b"1,2,3\n", 7, cycle).unwrap();
    }
    let anchor = journal.close(9, 3, json!("accepted")).unwrap();
    (home, folder, anchor)
}
