//! A machine serves one run at a time: on this computer by a lock, which goes away with the process that holds it.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::error::JournalError;
use super::sha256_hex;

/// A machine that no other run on this computer can take while this lives.
#[derive(Debug)]
pub struct MachineLock {
    /// Held, not read.
    _file: File,
}

impl MachineLock {
    /// Takes a machine, by the address by which every run would call it, for a run.
    ///
    /// # Errors
    /// A machine that another run has, which is named; a folder for temporary files that cannot be written.
    pub fn take(address: &str, run: &Path) -> Result<Self, JournalError> {
        Self::take_in(&std::env::temp_dir().join("regrind-machines"), address, run)
    }

    fn take_in(folder: &Path, address: &str, run: &Path) -> Result<Self, JournalError> {
        let path = folder.join(format!("{}.lock", &sha256_hex(address.as_bytes())[..16]));
        let file = opened(folder, &path)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let holder = fs::read_to_string(&path).unwrap_or_default();
                return Err(JournalError::MachineTaken {
                    address: address.to_owned(),
                    holder: holder.trim().to_owned(),
                });
            }
            Err(TryLockError::Error(error)) => return Err(JournalError::file(&path, "locking it")(error)),
        }
        // Who holds it is for people; one that another user made cannot be written, and locks all the same.
        let holder = format!("{}, process {}\n", run.display(), std::process::id());
        let _ =
            OpenOptions::new().write(true).truncate(true).open(&path).and_then(|mut f| f.write_all(holder.as_bytes()));
        Ok(Self { _file: file })
    }
}

/// Opens the file that is locked; every user of the computer may.
fn opened(folder: &Path, path: &PathBuf) -> Result<File, JournalError> {
    if !folder.is_dir() {
        // Another run may make it at the same moment.
        let made = fs::create_dir_all(folder);
        if !folder.is_dir() {
            made.map_err(JournalError::file(folder, "creating the folder"))?;
        }
        open_to_all(folder, 0o1777);
    }
    if !path.exists() {
        OpenOptions::new().append(true).create(true).open(path).map_err(JournalError::file(path, "creating it"))?;
        open_to_all(path, 0o666);
    }
    File::open(path).map_err(JournalError::file(path, "opening it"))
}

fn open_to_all(path: &Path, mode: u32) {
    use std::os::unix::fs::PermissionsExt;
    // Where that is not allowed, the locks of one user are still his.
    let _ = fs::set_permissions(path, fs::Permissions::from_mode(mode));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_is_taken_once_and_who_has_it_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let take = |address, run| MachineLock::take_in(&folder.path().join("locks"), address, Path::new(run));
        let first = take("grinder at 10.0.0.6:502, unit 1", "runs/a").unwrap();
        take("grinder at 10.0.0.7:502, unit 1", "runs/b").unwrap();
        let refused = take("grinder at 10.0.0.6:502, unit 1", "runs/b").unwrap_err().to_string();
        assert!(refused.contains("runs/a, process ") && refused.contains("10.0.0.6"), "{refused}");
        drop(first);
        take("grinder at 10.0.0.6:502, unit 1", "runs/b").unwrap();
    }
}
