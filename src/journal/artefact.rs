//! Files of a run: each is written to the disk first, and recorded after that.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Component, Path, PathBuf};

use data_encoding::HEXLOWER;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::JournalError;
use super::names::{ANCHOR, DATABASE, LOCK};
use super::open::sync_folder;
use super::system;

/// Journal entry of a file of the run folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Artefact {
    /// Path within the run folder, with `/` between names.
    pub name: String,
    /// Length in bytes.
    pub bytes: u64,
    /// SHA-256 of the content, in lowercase hexadecimal digits.
    pub sha256: String,
}

impl Artefact {
    /// Flushes the file `name` of a run folder to the disk, reads it, and returns its name, length and hash. This takes
    /// time for a large file.
    ///
    /// # Errors
    /// The name is not a plain relative path, the file cannot be read, or the disk fails.
    pub fn from_file(folder: &Path, name: &str) -> Result<Self, JournalError> {
        let path = path_within(folder, name)?;
        sync_file(&path)?;
        describe(&path, name)
    }

    /// Reads the file that this value describes (name, length and hash) from the run folder `folder`. Returns the
    /// content of the file.
    ///
    /// # Errors
    /// The file cannot be read. [`JournalError::OtherFile`] if the length or the hash of the content differs from that
    /// in this value.
    pub fn read(&self, folder: &Path) -> Result<Vec<u8>, JournalError> {
        let path = path_within(folder, &self.name)?;
        let mut bytes = Vec::new();
        // Reads at most one byte beyond the recorded length: a file that has grown is not read to its end.
        let file = File::open(&path).map_err(JournalError::file(&path, "reading it"))?;
        file.take(self.bytes + 1).read_to_end(&mut bytes).map_err(JournalError::file(&path, "reading it"))?;
        let is_same = bytes.len() as u64 == self.bytes && HEXLOWER.encode(&Sha256::digest(&bytes)) == self.sha256;
        if is_same { Ok(bytes) } else { Err(JournalError::OtherFile { path }) }
    }
}

/// Returns the path of the file `name` in a run folder.
///
/// # Errors
/// [`JournalError::Name`] for a name that can lead out of the folder, or that is a file of the journal itself.
pub(super) fn path_within(folder: &Path, name: &str) -> Result<PathBuf, JournalError> {
    let plain = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    let own = [DATABASE, ANCHOR, LOCK].contains(&name) || name.starts_with(&format!("{DATABASE}-"));
    if name.is_empty() || name.contains('\\') || name.ends_with('/') || !plain || own {
        return Err(JournalError::Name { name: name.to_owned() });
    }
    Ok(folder.join(name))
}

/// Returns the name that the file `name` has while it is being written, such as `.part.json.tmp` for `part.json`. After
/// a crash, a file with this temporary name can remain. The next write of the file `name` overwrites it.
pub(super) fn temporary_name(name: &str) -> String {
    format!(".{name}.tmp")
}

/// Writes a file atomically: syncs the bytes to the disk under a temporary name, renames the file, then syncs the
/// folder.
pub(super) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), JournalError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    fs::create_dir_all(folder).map_err(JournalError::file(folder, "creating the folder"))?;
    let temporary = path.with_file_name(temporary_name(&path.file_name().unwrap_or_default().to_string_lossy()));
    let written = fill(&temporary, bytes).and_then(|()| fs::rename(&temporary, path));
    if written.is_err() {
        // Report the first error, not that of the cleanup.
        let _ = fs::remove_file(&temporary);
    }
    written.map_err(JournalError::file(path, "writing it"))?;
    sync_folder(folder)?;
    // The folder itself can be new.
    folder.parent().map_or(Ok(()), sync_folder)
}

fn fill(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // Overwrites the remains of an interrupted attempt, which never got the final name.
    let mut file = OpenOptions::new().write(true).create(true).truncate(true).open(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Reads the file at `path`, and returns its length, its hash and the given `name`.
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
    Ok(Artefact { name: name.to_owned(), bytes, sha256: HEXLOWER.encode(&digest.finalize()) })
}

/// Flushes a file that another part of the program wrote, and the folder that contains it, to the disk.
pub(super) fn sync_file(path: &Path) -> Result<(), JournalError> {
    system::sync_file(path).map_err(JournalError::file(path, "flushing it to the disk"))?;
    path.parent().map_or(Ok(()), sync_folder)
}
