//! Temporary folder of a simulation: the text of its recipe, and its run.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use super::error::FormatError;
use super::registration::write_private;
use super::system::{create_owners_folder, open_to_read};

const PREFIX: &str = "regrind-sim-";
/// File that the program locks to which the folder belongs.
const LOCK: &str = "lock";

/// Temporary folder that only its owner can read. It is deleted with its content when the value is dropped.
#[derive(Debug)]
pub struct SimulationFolder {
    folder: TempDir,
    /// Locked until the program ends, in whatever way.
    _lock: File,
}

impl SimulationFolder {
    /// Creates a folder with the text of a recipe. Its path is short: the path of a socket must fit into some hundred
    /// bytes.
    ///
    /// # Errors
    /// A folder or a file that cannot be written.
    pub fn create(text: &str) -> Result<Self, FormatError> {
        Self::create_in(&std::env::temp_dir(), text)
    }

    fn create_in(home: &Path, text: &str) -> Result<Self, FormatError> {
        let failed =
            |source| FormatError::Unwritable { path: home.to_owned(), action: "creating a folder in it", source };
        let folder = create_owners_folder(PREFIX, home).map_err(failed)?;
        let lock = create_lock(folder.path()).map_err(failed)?;
        let created = Self { folder, _lock: lock };
        write_private(&created.draft(), text.as_bytes())?;
        Ok(created)
    }

    /// Deletes the folders of programs that have ended without deleting them, for example because they were killed.
    /// Keeps each folder that cannot be deleted, and those of other programs.
    pub fn delete_abandoned() {
        Self::delete_abandoned_in(&std::env::temp_dir());
    }

    fn delete_abandoned_in(home: &Path) {
        let entries = fs::read_dir(home).into_iter().flatten().flatten();
        for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX)) {
            // A link is no directory here, so nothing outside is deleted.
            let is_folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            let lock = open_to_read(&entry.path().join(LOCK));
            if is_folder && lock.is_ok_and(|lock| lock.try_lock().is_ok()) {
                // It belongs to another user, or the disk has failed: it stays.
                let _ = fs::remove_dir_all(entry.path());
            }
        }
    }

    /// Returns the path of the file with the text.
    pub fn draft(&self) -> PathBuf {
        self.folder.path().join("recipe.toml")
    }

    /// Returns the path of the folder for the run. The folder is created with the run.
    pub fn runs(&self) -> PathBuf {
        self.folder.path().join("runs")
    }
}

/// Creates the lock of a folder. It gets its name when it is locked, so no program finds it unlocked meanwhile.
fn create_lock(folder: &Path) -> io::Result<File> {
    let unlocked = folder.join("unlocked");
    let file = File::create(&unlocked)?;
    file.try_lock()?;
    fs::rename(unlocked, folder.join(LOCK))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::super::system::readable_by_others;
    use super::*;

    #[test]
    fn simulation_folder_is_private_and_deleted() {
        let folder = SimulationFolder::create("[part]\n").unwrap();
        assert_eq!(std::fs::read_to_string(folder.draft()).unwrap(), "[part]\n");
        let home = folder.draft().parent().unwrap().to_owned();
        assert_eq!(readable_by_others(&home).unwrap().map(|open| open.how), None);
        drop(folder);
        assert!(!home.exists());
    }
    #[test]
    fn only_abandoned_folders_are_deleted() {
        let home = tempfile::tempdir().unwrap();
        let used = SimulationFolder::create_in(home.path(), "[part]\n").unwrap();
        let SimulationFolder { folder, _lock } = SimulationFolder::create_in(home.path(), "[part]\n").unwrap();
        // A killed program deletes nothing, and its lock ends with it.
        let abandoned = folder.keep();
        drop(_lock);
        let unfinished = create_owners_folder(PREFIX, home.path()).unwrap();
        SimulationFolder::delete_abandoned_in(home.path());
        assert!(!abandoned.exists());
        assert!(used.draft().exists() && unfinished.path().exists());
    }
}
