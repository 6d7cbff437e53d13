//! The last records of a signed run as evidence, without the records before them.
//!
//! A seal signs the hash of the record before it, and each hash covers all earlier records. So the hash before an
//! excerpt, its texts and the seal at its end prove every record of the excerpt. The records before it stay secret.

use std::path::Path;

use super::artefact::Artefact;
use super::canonical::chain;
use super::content::read_unique;
use super::error::JournalError;
use super::key::PublicKey;
use super::record::{Record, RecordKind};
use super::seal::{Seal, is_signed};

/// Last records of a finished run, up to the seal of its end, as somebody else has given them.
#[derive(Clone, Copy, Debug)]
pub struct Excerpt<'a> {
    /// Name of the run.
    pub run: &'a str,
    /// Hash of the record before the first text.
    pub before: &'a str,
    /// Texts of the records, as [`Record::text`] gives them.
    pub texts: &'a [String],
}

impl Excerpt<'_> {
    /// Verifies the excerpt, and returns the files that its records name. The chain must be whole, the last record must
    /// be a seal of the record before it, that record must be the end of the run, and one of `keys` must have made the
    /// seal.
    ///
    /// # Errors
    /// [`JournalError::Broken`] with the number of the first record that fails. [`JournalError::NoAuthor`] if none of
    /// `keys` has made the seal.
    pub fn verify(&self, keys: &[PublicKey]) -> Result<Vec<Artefact>, JournalError> {
        let path = Path::new(self.run).to_owned();
        let broken = |seq, what: &str| Err(JournalError::Broken { path: path.clone(), seq, what: what.to_owned() });
        let records = self.records()?;
        let [.., end, seal_record] = &records[..] else { return broken(0, "an end and a seal are missing") };
        let seal = read_unique::<Seal>(seal_record).filter(|_| seal_record.kind == RecordKind::Seal);
        let Some(seal) = seal else { return broken(seal_record.seq, "it is not a valid seal") };
        if end.kind != RecordKind::End {
            return broken(end.seq, "it is not the end of the run");
        }
        if (seal.records, &seal.head) != (end.seq, &end.hash) {
            return broken(seal_record.seq, "it does not seal the record before it");
        }
        let has_signed = |key: &&PublicKey| {
            key.to_string() == seal.key && is_signed(key, self.run, seal.records, &seal.head, &seal.signature)
        };
        if !keys.iter().any(|key| has_signed(&key)) {
            let what = "its end is not signed with one of the given keys".to_owned();
            return Err(JournalError::NoAuthor { path, what });
        }
        let files = records.iter().filter(|record| record.kind == RecordKind::Artefact);
        Ok(files.filter_map(read_unique::<Artefact>).collect())
    }

    /// Returns the records of the excerpt, each with its hashes.
    ///
    /// # Errors
    /// A text does not have the form that a journal writes, or its number does not follow the one before.
    fn records(&self) -> Result<Vec<Record>, JournalError> {
        let mut records: Vec<Record> = Vec::with_capacity(self.texts.len());
        for text in self.texts {
            let prev_hash = records.last().map_or(self.before, |last| &last.hash);
            let hash = chain(prev_hash, text);
            let due = records.last().map(|last| last.seq + 1);
            let record =
                Record::from_text(text, prev_hash, &hash).filter(|record| due.is_none_or(|due| record.seq == due));
            let Some(record) = record else {
                let what = "its text does not have the form that a journal writes, or records are missing".to_owned();
                return Err(JournalError::Broken { path: Path::new(self.run).to_owned(), seq: due.unwrap_or(0), what });
            };
            records.push(record);
        }
        Ok(records)
    }
}
