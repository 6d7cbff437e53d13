//! Restores a record that was kept elsewhere into a run folder, where it is read and verified like every other record.

use std::path::Path;

use serde_json::Value;

use super::artefact::{path_within, write_file};
use super::canonical::canonical_json;
use super::error::JournalError;
use super::names::{ANCHOR, is_plain_path};
use super::record::Record;
use super::verify::Anchor;
use super::{open, system};

impl Record {
    /// Creates a record from `text`, the JSON text of all its fields except the hashes ([`Record::text`]). `prev_hash`
    /// is the hash of the record before, and `hash` is the hash of this record. Returns `None` if `text` differs in any
    /// byte from the text that the journal writes for this record.
    ///
    /// Does not check that `hash` matches `text`: [`verify`](super::verify()) does this.
    pub fn from_text(text: &str, prev_hash: &str, hash: &str) -> Option<Self> {
        let value: Value = serde_json::from_str(text).ok()?;
        let word = |key: &str| value[key].as_str().map(str::to_owned);
        let number = |key: &str| value[key].as_u64();
        let record = Self {
            seq: number("seq")?,
            utc: word("utc")?,
            boot_id: word("boot_id")?,
            mono_ns: number("mono_ns")?,
            actor: word("actor")?,
            station: word("station")?,
            kind: value["kind"].as_str()?.parse().ok()?,
            part: word("part")?,
            cycle: u32::try_from(number("cycle")?).ok()?,
            command_id: match &value["command_id"] {
                Value::Null => None,
                id => Some(u32::try_from(id.as_u64()?).ok()?),
            },
            reason: word("reason")?,
            payload: canonical_json(&value["payload"]),
            prev_hash: prev_hash.to_owned(),
            hash: hash.to_owned(),
        };
        (record.text() == text).then_some(record)
    }
}

/// Creates a run folder with a journal of the given `records`. If there is an `anchor` (number of records and hash of
/// the last one), also writes the anchor file. Records and anchor are written unchanged and unchecked:
/// [`verify`](super::verify()) checks whether they are authentic. [`restore_file`] adds the other recorded files.
///
/// # Errors
/// The folder is not empty or cannot be written. The record numbers are not 1, 2, 3 and so on without a gap.
pub fn restore(
    folder: &Path,
    records: impl IntoIterator<Item = Record>,
    anchor: Option<&Anchor>,
) -> Result<(), JournalError> {
    // A link leads to a folder that another person may have chosen.
    if folder.is_symlink() || !open::is_free(folder)? {
        return Err(JournalError::Exists { path: folder.to_owned() });
    }
    system::create_run_folder(folder).map_err(JournalError::file(folder, "creating the folder"))?;
    let mut connection = open::create(folder)?;
    let failed = JournalError::database(folder);
    let all = connection.transaction().map_err(&failed)?;
    for record in records {
        record.put_into(&all).map_err(&failed)?;
    }
    all.commit().map_err(&failed)?;
    match anchor {
        None => Ok(()),
        Some(anchor) => {
            let text = serde_json::to_value(anchor).map(|value| canonical_json(&value)).unwrap_or_default();
            write_file(&folder.join(ANCHOR), text.as_bytes())
        }
    }
}

/// Writes `content` to the file `name` in a run folder. `name` is the relative path of the file in the journal. An
/// existing file is replaced. Does not compare `content` with the recorded hash.
///
/// # Errors
/// [`JournalError::Name`] if `name` can lead out of the folder on any system ([`is_plain_path`]) or through a link, or is
/// a file of the journal itself. The folder cannot be written.
pub fn restore_file(folder: &Path, name: &str, content: &[u8]) -> Result<(), JournalError> {
    let path = path_within(folder, name)?;
    let above = path.ancestors().skip(1).take_while(|above| *above != folder);
    if !is_plain_path(name) || path.is_symlink() || above.into_iter().any(Path::is_symlink) {
        return Err(JournalError::Name { name: name.to_owned() });
    }
    write_file(&path, content)
}

#[cfg(test)]
mod tests {
    use super::super::{AuditKey, Entry, ExternalEvidence, Header, Journal, Reader, RecordKind, verify_against};
    use super::*;
    use serde_json::json;

    fn header(run: &str) -> Header {
        Header {
            run: run.into(),
            part: "SN \"7\"\n".into(),
            actor: "Ada".into(),
            station: "console".into(),
            simulation: true,
            first_command_id: 1,
            content: json!({ "a": 0.1, "b": [1e-7, -0.0, 1e300, u64::MAX], "c": "\u{b5}\\\u{1}" }),
        }
    }

    #[test]
    fn restored_run_verifies() {
        let home = tempfile::tempdir().unwrap();
        let [from, to] = ["there", "here"].map(|name| home.path().join(name));
        let key = AuditKey::new();
        let mut journal = Journal::create_with(&from, header("run"), Some(key.clone())).unwrap();
        journal.store("cycle-1/points.csv", b"1,2\n", 1, 1).unwrap();
        for k in 0..300 {
            let id = journal.intend(Entry::new(RecordKind::Intent, k, 1, json!({ "k": k as f64 / 7.0 }))).unwrap();
            journal.append(Entry { command_id: Some(id), ..Entry::new(RecordKind::Outcome, k, 1, json!({})) }).unwrap();
        }
        let anchor = journal.close(400, 1, json!("accepted")).unwrap();
        let records: Vec<Record> = Reader::open(&from).unwrap().records(1).map(Result::unwrap).collect();
        assert_eq!(Reader::open(&from).unwrap().last().unwrap().as_ref(), records.last());
        let told = records.iter().map(|r| Record::from_text(&r.text(), &r.prev_hash, &r.hash).unwrap());
        restore(&to, told, Some(&anchor)).unwrap();
        restore_file(&to, "cycle-1/points.csv", b"1,2\n").unwrap();
        let against = ExternalEvidence { anchor: Some(anchor), keys: vec![key.public()] };
        let mut there = verify_against(&from, &against).unwrap();
        there.under_way = false;
        assert_eq!(verify_against(&to, &against).unwrap(), there);
        assert!(restore(&to, [], None).is_err(), "a folder in use");
        assert!(restore_file(&to, "../points.csv", b"").is_err() && restore_file(&to, "journal.sqlite", b"").is_err());
    }

    #[test]
    fn restored_files_stay_in_their_folder() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("run");
        restore(&folder, [], None).unwrap();
        for name in ["../a", "/a", "C:a", "a\nb", "\u{1b}a", "Journal.SQLITE", "a/nul", "a/."] {
            let refused = restore_file(&folder, name, b"a");
            assert!(matches!(refused, Err(JournalError::Name { .. })), "{name:?}: {refused:?}");
        }
        restore_file(&folder, "cycle-1/a.csv", b"a").unwrap();
        #[cfg(unix)]
        {
            let elsewhere = tempfile::tempdir().unwrap();
            std::os::unix::fs::symlink(elsewhere.path(), folder.join("cycle-2")).unwrap();
            std::os::unix::fs::symlink(elsewhere.path().join("b"), folder.join("b.csv")).unwrap();
            std::os::unix::fs::symlink(elsewhere.path(), home.path().join("link")).unwrap();
            for name in ["cycle-2/a.csv", "b.csv"] {
                let refused = restore_file(&folder, name, b"a");
                assert!(matches!(refused, Err(JournalError::Name { .. })), "{name:?}: {refused:?}");
            }
            assert!(matches!(restore(&home.path().join("link"), [], None), Err(JournalError::Exists { .. })));
            assert_eq!(std::fs::read_dir(elsewhere.path()).unwrap().count(), 0);
        }
    }

    #[test]
    fn of_text_refuses_other_spellings() {
        let home = tempfile::tempdir().unwrap();
        drop(Journal::create(home.path().join("run"), header("run")).unwrap());
        let record = Reader::open(home.path().join("run")).unwrap().records(1).next().unwrap().unwrap();
        let text = record.text();
        let of = |text: &str| Record::from_text(text, &record.prev_hash, &record.hash);
        assert_eq!(of(&text).as_ref(), Some(&record));
        for other in [
            text.replace("\"seq\":1", "\"seq\": 1"),
            text.replace("\"seq\":1", "\"seq\":1,\"seq\":1"),
            text.replace("\"seq\":1", "\"seq\":-1"),
            text.replace("\"kind\":\"begin\"", "\"kind\":\"began\""),
            text.replace("\"cycle\":0", "\"cycle\":4294967296"),
            text.replace("}", ""),
            String::new(),
        ] {
            assert!(other != text && of(&other).is_none(), "{other}");
        }
    }
}
