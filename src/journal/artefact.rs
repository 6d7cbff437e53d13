//! The files of a run: on the disk first, on record then.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::canonical::hex;
use super::error::JournalError;
use super::open::sync_folder;
use super::system;
use super::{ANCHOR, DATABASE, LOCK};

/// A file of the run folder, as it stands in the journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Artefact {
    /// Its path within the run folder, with `/` between names.
    pub name: String,
    /// Its length.
    pub bytes: u64,
    /// Its SHA-256 in small hexadecimal digits.
    pub sha256: String,
}

impl Artefact {
    /// Brings a file that was written into a run folder to the disk and reads what it holds. A large one takes its time.
    ///
    /// # Errors
    /// A name that is no plain relative path, a file that cannot be read, a disk that fails.
    pub fn of(folder: &Path, name: &str) -> Result<Self, JournalError> {
        let path = path_within(folder, name)?;
        sync_file(&path)?;
        describe(&path, name)
    }

    /// Reads what the file of a run folder holds, if that is what stands on record.
    ///
    /// # Errors
    /// A file that cannot be read; [`JournalError::OtherFile`] for one that holds something else.
    pub fn read(&self, folder: &Path) -> Result<Vec<u8>, JournalError> {
        let path = path_within(folder, &self.name)?;
        let mut bytes = Vec::new();
        // One that has grown is not read to its end.
        let file = File::open(&path).map_err(JournalError::file(&path, "reading it"))?;
        file.take(self.bytes + 1).read_to_end(&mut bytes).map_err(JournalError::file(&path, "reading it"))?;
        let is_same = bytes.len() as u64 == self.bytes && hex(&Sha256::digest(&bytes)) == self.sha256;
        if is_same { Ok(bytes) } else { Err(JournalError::OtherFile { path }) }
    }
}

/// Returns the path of a file within a run folder, if the name cannot lead out of it and is not one of the journal's own.
pub(super) fn path_within(folder: &Path, name: &str) -> Result<PathBuf, JournalError> {
    let plain = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    let own = [DATABASE, ANCHOR, LOCK].contains(&name) || name.starts_with(&format!("{DATABASE}-"));
    if name.is_empty() || name.contains('\\') || name.ends_with('/') || !plain || own {
        return Err(JournalError::Name { name: name.to_owned() });
    }
    Ok(folder.join(name))
}

/// What a file is called until it is whole. One that was cut off by a crash stays, and is written over by the next.
pub(super) fn temporary_name(name: &str) -> String {
    format!(".{name}.tmp")
}

/// Brings bytes to the disk under a temporary name, then gives the file its name, then brings the name to the disk.
pub(super) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), JournalError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).map_err(JournalError::file(folder, "creating the folder"))?;
    let temporary = path.with_file_name(temporary_name(&path.file_name().unwrap_or_default().to_string_lossy()));
    let written = fill(&temporary, bytes).and_then(|()| fs::rename(&temporary, path));
    if written.is_err() {
        // The error that brought us here is the one to report.
        let _ = fs::remove_file(&temporary);
    }
    written.map_err(JournalError::file(path, "writing it"))?;
    sync_folder(folder)?;
    // The folder itself may be new.
    folder.parent().map_or(Ok(()), sync_folder)
}

fn fill(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // What an interrupted attempt left is written over: it never had its name.
    let mut file = OpenOptions::new().write(true).create(true).truncate(true).open(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Returns what a file holds.
pub(super) fn describe(path: &Path, name: &str) -> Result<Artefact, JournalError> {
    let failed = JournalError::file(path, "reading it");
    let mut file = File::open(path).map_err(&failed)?;
    let (mut digest, mut bytes, mut block) = (Sha256::new(), 0, vec![0; 64 << 10]);
    loop {
        match file.read(&mut block) {
            Ok(0) => break,
            Ok(n) => {
                digest.update(&block[..n]);
                bytes += n as u64;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(failed(error)),
        }
    }
    Ok(Artefact { name: name.to_owned(), bytes, sha256: hex(&digest.finalize()) })
}

/// Brings a file that somebody else wrote to the disk.
pub(super) fn sync_file(path: &Path) -> Result<(), JournalError> {
    system::sync_file(path).map_err(JournalError::file(path, "bringing it to the disk"))?;
    path.parent().map_or(Ok(()), sync_folder)
}
