//! Records of whole runs: each has a content that this program knows, and writes again to the same text.

use std::path::Path;

use regrind::journal::{Reader, RecordKind, canonical_json};
use regrind::record::{Content, RunEnd};

/// Checks every record of the run in `folder`.
pub fn assert_known(folder: &Path) {
    for record in Reader::open(folder).unwrap().records(0) {
        let record = record.unwrap();
        let content = Content::read(&record).unwrap_or_else(|error| panic!("record {}: {error}", record.seq));
        assert!(!matches!(content, Content::Unknown(_)), "record {}: {}", record.seq, record.payload);
        assert_eq!(content.kind(), record.kind, "record {}: {}", record.seq, record.payload);
        // A test in the process of the machines begins its run with other content than the program.
        let begun_by_test = matches!(&content, Content::Begin(begin) if begin.content.place().is_none());
        if !begun_by_test {
            assert_eq!(canonical_json(&content.payload()), record.payload, "record {}", record.seq);
        }
        if let Content::End(end) = content {
            assert_eq!(record.kind, RecordKind::End);
            assert!(!matches!(end.ending, RunEnd::Other(_)), "record {}: {}", record.seq, record.payload);
        }
    }
}
