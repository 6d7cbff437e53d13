//! The plant's copy of a run as evidence: brought back as a run folder, and proven by the same means as that of the cell.

use std::fs;
use std::path::Path;

use regrind_journal::{
    Against, Anchor, JournalError, Kind, PublicKey, Reader, Record, Verified, restore, restore_file, verify_against,
};
use serde_json::Value;

use super::error::{PlantError, refused};
use super::hex::digits;
use super::link::Link;
use super::settings::ArtefactSettings;

/// A run of the plant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlantRun {
    /// Its number in the database.
    pub id: i32,
    /// The cell that made it.
    pub cell: String,
    /// What it is called there.
    pub name: String,
    /// How many of its records the plant has.
    pub records: u64,
    /// The hash of the last.
    pub head: String,
    /// The keys that may have signed the cell's records, as the plant knows them.
    pub keys: Vec<PublicKey>,
}

impl PlantRun {
    /// Finds a run by its name, and by its cell where several have one of that name.
    ///
    /// # Errors
    /// No such run, a plant that cannot be reached.
    pub async fn find(link: &Link, cell: Option<&str>, name: &str) -> Result<Self, PlantError> {
        let failed = refused("to find a run");
        let text = "SELECT r.id, c.name, r.name, r.records, r.head,
                array(SELECT k.key FROM cell_key k WHERE k.cell = c.id ORDER BY k.since, k.key)
            FROM run r JOIN cell c ON c.id = r.cell WHERE r.name = $1 AND ($2::text IS NULL OR c.name = $2) ORDER BY r.id DESC LIMIT 1";
        let row = link.client().query_opt(text, &[&name, &cell]).await.map_err(failed)?;
        let no_run = || PlantError::NoRun { cell: cell.unwrap_or("any cell").to_owned(), name: name.to_owned() };
        let row = row.ok_or_else(no_run)?;
        Ok(Self {
            id: row.get(0),
            cell: row.get(1),
            name: row.get(2),
            records: u64::try_from(row.get::<_, i32>(3)).unwrap_or(0),
            head: digits(row.get(4)),
            keys: row.get::<_, Vec<String>>(5).iter().filter_map(|key| key.parse().ok()).collect(),
        })
    }

    /// Holds the journal at the cell against what had arrived: that many records must stand in it, of which the last has this hash.
    ///
    /// # Errors
    /// A journal that was cut or rewritten after it was shipped; one that cannot be read.
    pub fn stands_in(&self, folder: &Path) -> Result<(), PlantError> {
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
                    "the plant has {had} records, and the journal has {last}: its end was cut off after it was shipped"
                )
            }
            _ => format!("record {} is not the one that was shipped: the journal was rewritten", self.records),
        };
        Err(PlantError::Differs { run: self.name.clone(), what })
    }

    /// Brings the run back into a folder, which is made: its records and its files. It is proven by [`regrind_journal::verify`].
    ///
    /// # Errors
    /// A folder that is in use; a record that no journal writes; a plant that cannot be reached.
    pub async fn fetch(
        &self,
        link: &Link,
        artefacts: Option<&ArtefactSettings>,
        folder: &Path,
    ) -> Result<(), PlantError> {
        let records = self.records(link, folder).await?;
        let anchor = last_sealed(&records);
        restore(folder, records, anchor.as_ref())?;
        let failed = refused("the files of a run");
        let text = "SELECT name, sha256 FROM run_artefact WHERE run = $1 ORDER BY name";
        for row in link.client().query(text, &[&self.id]).await.map_err(failed)? {
            let (name, sha256): (&str, &[u8]) = (row.get(0), row.get(1));
            if let Some(content) = content(link, artefacts, sha256).await? {
                restore_file(folder, name, &content)?;
            }
        }
        Ok(())
    }

    /// The records of the run, in order.
    async fn records(&self, link: &Link, folder: &Path) -> Result<Vec<Record>, PlantError> {
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
                let hash = digits(hash);
                let seq = u64::try_from(seq).unwrap_or(0);
                let broken = |what: &str| JournalError::Broken { path: folder.to_owned(), seq, what: what.into() };
                if seq != records.len() as u64 + 1 {
                    return Err(broken("it does not follow the one before it: the plant lacks some").into());
                }
                let record = Record::of_text(text, &head, &hash);
                records.push(record.ok_or_else(|| broken("the plant has a text of it that no journal writes"))?);
                head = hash;
            }
            if rows.len() < PAGE as usize {
                return Ok(records);
            }
        }
    }

    /// Proves the plant's copy: records, order, files and signatures. With no keys given those count that the plant knows of the cell.
    ///
    /// # Errors
    /// [`JournalError::Broken`] with the first record that cannot be believed.
    pub fn prove(&self, folder: &Path, keys: &[PublicKey]) -> Result<Verified, PlantError> {
        let keys = if keys.is_empty() { self.keys.clone() } else { keys.to_vec() };
        let verified = verify_against(folder, &Against { anchor: None, keys })?;
        match (verified.records, &verified.head) == (self.records, &self.head) {
            true => Ok(verified),
            false => {
                let [has, says] = [verified.records, self.records];
                let what = format!("the plant has {has} records of it and counts {says}, or its last one is another");
                Err(PlantError::Differs { run: self.name.clone(), what })
            }
        }
    }
}

/// The newest seal among records, as the anchor that stood beside the journal then; where nothing is sealed, their end.
fn last_sealed(records: &[Record]) -> Option<Anchor> {
    let Some(seal) = records.iter().rev().find(|record| record.kind == Kind::Seal).map(Record::value) else {
        return records.last().map(|last| Anchor::new(last.seq, last.hash.clone()));
    };
    let word = |value: &Value, key: &str| value[key].as_str().map(str::to_owned);
    Some(Anchor {
        records: seal["records"].as_u64()?,
        head: word(&seal, "head")?,
        run: word(&records.first()?.value(), "run"),
        key: word(&seal, "key"),
        signature: word(&seal, "signature"),
    })
}

/// Reads a content by its hash; none where the plant does not have it.
///
/// # Errors
/// A plant that cannot be reached, a folder of large files that is not there.
pub async fn content(
    link: &Link,
    artefacts: Option<&ArtefactSettings>,
    sha256: &[u8],
) -> Result<Option<Vec<u8>>, PlantError> {
    let failed = refused("the content of a file");
    let row = link.client().query_opt("SELECT content, place FROM artefact WHERE sha256 = $1", &[&sha256]).await;
    let Some(row) = row.map_err(failed)? else { return Ok(None) };
    match (row.get::<_, Option<Vec<u8>>>(0), row.get::<_, Option<String>>(1), artefacts) {
        (Some(content), ..) => Ok(Some(content)),
        (None, Some(_), Some(kept)) => {
            // The place is made from the hash here too: what stands in a table leads nowhere else.
            let name = digits(sha256);
            let path = kept.folder.join(&name[..2]).join(&name);
            // A share that is gone may hang: whoever asks goes on with others meanwhile.
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
