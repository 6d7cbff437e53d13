//! The plant's copy of a run as evidence: fetched into a run folder, and verified with the same code as the cell's own
//! record.

use std::fs;
use std::path::{Path, PathBuf};

use data_encoding::HEXLOWER;
use regrind_journal::{
    Anchor, Begin, ExternalEvidence, JournalError, PublicKey, Reader, Record, RecordKind, Seal, Verified,
    is_plain_name, is_plain_path, restore, restore_file, verify_against,
};
use serde_json::Value;

use super::error::{PlantError, refused};
use super::link::DatabaseLink;
use super::settings::ArtefactSettings;

/// Run in the plant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlantRun {
    /// Id of the run in the database.
    pub id: i32,
    /// Cell that made the run.
    pub cell: String,
    /// Name of the run at the cell.
    pub name: String,
    /// Number of records that the plant has.
    pub records: u64,
    /// Hash of the last of these records.
    pub head: String,
    /// Keys that may have signed the cell's records, as the plant has them.
    pub keys: Vec<PublicKey>,
    /// Folder to which the run was archived. The plant then has neither its records nor its files.
    pub archive: Option<String>,
}

impl PlantRun {
    /// Finds a run in the database of the plant by its name. `cell` is the name of the cell of the run. Without `cell`,
    /// all cells are searched. If several runs are found, the run that was registered last is returned.
    ///
    /// # Errors
    /// There is no such run, or the plant cannot be reached.
    pub async fn find(link: &DatabaseLink, cell: Option<&str>, name: &str) -> Result<Self, PlantError> {
        let failed = refused("to find a run");
        let text = "SELECT r.id, c.name, r.name, r.records, r.head,
                array(SELECT k.key FROM cell_key k WHERE k.cell = c.id ORDER BY k.since, k.key), r.archive
            FROM run r JOIN cell c ON c.id = r.cell WHERE r.name = $1 AND ($2::text IS NULL OR c.name = $2) ORDER BY r.id DESC LIMIT 1";
        let row = link.client().query_opt(text, &[&name, &cell]).await.map_err(failed)?;
        let no_run = || PlantError::NoRun { cell: cell.unwrap_or("any cell").to_owned(), name: name.to_owned() };
        let row = row.ok_or_else(no_run)?;
        Ok(Self {
            id: row.get(0),
            cell: row.get(1),
            name: row.get(2),
            records: u64::try_from(row.get::<_, i32>(3)).unwrap_or(0),
            head: HEXLOWER.encode(row.get(4)),
            keys: row.get::<_, Vec<String>>(5).iter().filter_map(|key| key.parse().ok()).collect(),
            archive: row.get(6),
        })
    }

    /// Checks the journal in `folder`, the run folder at the cell, against the copy at the plant. The journal must
    /// contain at least `self.records` records. Its record with this number must have the hash `self.head`. Later
    /// records are not compared. If the plant has no record yet, returns `Ok` without a check.
    ///
    /// # Errors
    /// The journal was cut or rewritten after it was replicated, or cannot be read.
    pub fn check_local_journal(&self, folder: &Path) -> Result<(), PlantError> {
        if self.records == 0 {
            return Ok(());
        }
        let reader = Reader::open(folder)?;
        let last = reader.last()?.map_or(0, |last| last.seq);
        let what = match reader.records(self.records).next().transpose()? {
            Some(found) if found.seq == self.records && found.hash == self.head => return Ok(()),
            _ if last < self.records => {
                let had = self.records;
                format!(
                    "the plant has {had} records, and the journal has {last}: its end was cut off after replication"
                )
            }
            _ => format!("record {} differs from the replicated one: the journal was rewritten", self.records),
        };
        Err(PlantError::Differs { run: self.name.clone(), what })
    }

    /// Returns the path of the folder in `out` that has the name of the run. The cell gave this name.
    ///
    /// # Errors
    /// [`PlantError::UnsafeName`] if the name can lead to another folder on any system.
    pub fn folder_in(&self, out: &Path) -> Result<PathBuf, PlantError> {
        // A name that begins with a dot is that of no run: such folders are hidden.
        self.require_safe(&self.name, is_plain_name(&self.name) && !self.name.starts_with('.'))?;
        Ok(out.join(&self.name))
    }

    /// Fetches the records and files of the run from the plant into the new folder `folder`. `artefacts` names the
    /// folder with the large files. Skips each file that the plant does not have. Does not verify the records: call
    /// [`regrind_journal::verify`] for this.
    ///
    /// # Errors
    /// - [`PlantError::Archived`] if the run was archived.
    /// - [`PlantError::UnsafeName`] if the name of a file can lead to another folder on any system. The cell gave these
    ///   names. Nothing is written then.
    /// - The folder is in use, a record is missing, the text of a record does not have the form that a journal writes, or
    ///   the plant cannot be reached.
    pub async fn fetch(
        &self,
        link: &DatabaseLink,
        artefacts: Option<&ArtefactSettings>,
        folder: &Path,
    ) -> Result<(), PlantError> {
        if let Some(place) = self.archive.clone() {
            return Err(PlantError::Archived { cell: self.cell.clone(), run: self.name.clone(), place });
        }
        let text = "SELECT name, sha256 FROM run_artefact WHERE run = $1 ORDER BY name";
        let files = link.client().query(text, &[&self.id]).await.map_err(refused("the files of a run"))?;
        for row in &files {
            self.require_safe(row.get(0), is_plain_path(row.get(0)))?;
        }
        let records = self.records(link, folder).await?;
        let anchor = last_sealed(&records);
        restore(folder, records, anchor.as_ref())?;
        for row in &files {
            if let Some(content) = content(link, artefacts, row.get(1)).await? {
                restore_file(folder, row.get(0), &content)?;
            }
        }
        Ok(())
    }

    fn require_safe(&self, name: &str, is_safe: bool) -> Result<(), PlantError> {
        let refused =
            || PlantError::UnsafeName { cell: self.cell.clone(), run: self.name.clone(), name: name.to_owned() };
        if is_safe { Ok(()) } else { Err(refused()) }
    }

    /// Returns all records of the run from the plant, in the order of their numbers. `folder` is only used in error
    /// messages.
    ///
    /// Returns an error if a record is missing or invalid, or if the plant cannot be reached.
    async fn records(&self, link: &DatabaseLink, folder: &Path) -> Result<Vec<Record>, PlantError> {
        const PAGE: i32 = 5000;
        let mut records: Vec<Record> = Vec::new();
        let mut head = "0".repeat(64);
        loop {
            let text = "SELECT seq, hash, text FROM record WHERE run = $1 AND seq > $2 ORDER BY seq LIMIT $3";
            let after = records.last().map_or(0, |last| i32::try_from(last.seq).unwrap_or(i32::MAX));
            let rows =
                link.client().query(text, &[&self.id, &after, &i64::from(PAGE)]).await.map_err(refused("records"))?;
            for row in &rows {
                let (seq, hash, text): (i32, &[u8], &str) = (row.get(0), row.get(1), row.get(2));
                let hash = HEXLOWER.encode(hash);
                let seq = u64::try_from(seq).unwrap_or(0);
                let broken = |what: &str| JournalError::Broken { path: folder.to_owned(), seq, what: what.into() };
                if seq != records.len() as u64 + 1 {
                    return Err(broken("it does not follow the record before it: the plant lacks records").into());
                }
                let record = Record::from_text(text, &head, &hash);
                records.push(
                    record
                        .ok_or_else(|| broken("its text in the plant does not have the form that a journal writes"))?,
                );
                head = hash;
            }
            if rows.len() < PAGE as usize {
                return Ok(records);
            }
        }
    }

    /// Verifies the copy of the run that was fetched into `folder`: the records, their order, the files and the
    /// signatures. `keys` are the public keys that may have signed. If `keys` is empty, uses the keys that the plant
    /// has for the cell.
    ///
    /// # Errors
    /// - [`JournalError::Broken`] for the first record that fails the verification.
    /// - [`PlantError::Differs`] if the number of records, or the hash of the last one, differs from the values that
    ///   the plant stored.
    pub fn prove(&self, folder: &Path, keys: &[PublicKey]) -> Result<Verified, PlantError> {
        let keys = if keys.is_empty() { self.keys.clone() } else { keys.to_vec() };
        let verified = verify_against(folder, &ExternalEvidence { anchor: None, keys })?;
        match (verified.records, &verified.head) == (self.records, &self.head) {
            true => Ok(verified),
            false => {
                let [has, says] = [verified.records, self.records];
                let what = format!(
                    "the plant sent {has} records and has counted {says} on arrival, or the hash of the last one differs"
                );
                Err(PlantError::Differs { run: self.name.clone(), what })
            }
        }
    }
}

/// Returns the anchor (the number of records of the journal and the hash of the last one) from the newest seal among
/// `records`. A seal is a record that signs the records before it. If there is no seal, returns an unsigned anchor of
/// the last record. Returns `None` if `records` is empty, or if the seal cannot be read.
fn last_sealed(records: &[Record]) -> Option<Anchor> {
    let Some(seal) = records.iter().rev().find(|record| record.kind == RecordKind::Seal) else {
        return records.last().map(|last| Anchor::new(last.seq, last.hash.clone()));
    };
    let Seal { records: sealed, head, key, signature } = serde_json::from_str(&seal.payload).ok()?;
    let run = Begin::<Value>::read(records.first()?).and_then(|begin| begin.run);
    Some(Anchor { records: sealed, head, run, key: Some(key), signature: Some(signature) })
}

/// Returns the content of the file with the SHA-256 hash `sha256`. Reads the content from the database or from the
/// folder of large files, which `artefacts` names. Returns `None` if the content is not there, or if it is in the
/// folder of large files and `artefacts` is `None`.
///
/// # Errors
/// The plant cannot be reached, or a file in the folder of large files exists but cannot be read.
pub async fn content(
    link: &DatabaseLink,
    artefacts: Option<&ArtefactSettings>,
    sha256: &[u8],
) -> Result<Option<Vec<u8>>, PlantError> {
    let failed = refused("the content of a file");
    let row = link.client().query_opt("SELECT content, place FROM artefact WHERE sha256 = $1", &[&sha256]).await;
    let Some(row) = row.map_err(failed)? else { return Ok(None) };
    match (row.get::<_, Option<Vec<u8>>>(0), row.get::<_, Option<String>>(1), artefacts) {
        (Some(content), ..) => Ok(Some(content)),
        (None, Some(_), Some(kept)) => {
            // The path is built from the hash here too, so a text in a table cannot lead to another file.
            let name = HEXLOWER.encode(sha256);
            let path = kept.folder.join(name.get(..2).unwrap_or_default()).join(&name);
            // A network share that is gone can hang, so the read runs in a blocking thread and other work continues.
            let at = path.clone();
            let read = tokio::task::spawn_blocking(move || fs::read(at));
            match read.await.unwrap_or_else(|error| Err(std::io::Error::other(error))) {
                Ok(content) => Ok(Some(content)),
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
                Err(source) => Err(PlantError::Folder { path, source }),
            }
        }
        _ => Ok(None),
    }
}
