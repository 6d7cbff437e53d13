//! Keeps the journals that tests write, for a verifier that is not part of this program: see .ci/run.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

/// Guard that keeps the run folders below a folder when it goes out of scope.
pub struct KeepRunFolders(
    /// Folder that holds the run folders.
    pub PathBuf,
);

impl Drop for KeepRunFolders {
    fn drop(&mut self) {
        keep(&self.0);
    }
}

/// Copies the run folders below a folder to the folder that REGRIND_KEEP_JOURNALS names, if it is set. A later state
/// replaces an earlier one. A run that is still active is skipped.
pub fn keep(home: &Path) {
    if let Some(place) = std::env::var_os("REGRIND_KEEP_JOURNALS").filter(|place| !place.is_empty()) {
        keep_below(home, Path::new(&place), 4);
    }
}

fn keep_below(folder: &Path, place: &Path, depth: u32) {
    if folder.join("journal.sqlite").is_file() {
        let lock = folder.join(".lock");
        // A test may have put a pipe in place of the lock. To open a pipe would block without end.
        if fs::symlink_metadata(&lock).is_ok_and(|found| !found.is_file()) {
            return;
        }
        let driven = fs::File::open(lock).is_ok_and(|lock| lock.try_lock_shared().is_err());
        let mut hash = DefaultHasher::new();
        (folder, std::process::id()).hash(&mut hash);
        let kept = place.join(format!("{:016x}", hash.finish()));
        if !driven {
            let _ = fs::remove_dir_all(&kept);
            copy_all(folder, &kept);
        }
        return;
    }
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        if depth > 0 && entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            keep_below(&entry.path(), place, depth - 1);
        }
    }
}

/// Copies a folder with its content. A file that the test removes meanwhile is skipped.
fn copy_all(from: &Path, to: &Path) {
    let _ = fs::create_dir_all(to);
    for entry in fs::read_dir(from).into_iter().flatten().flatten() {
        let (path, copy) = (entry.path(), to.join(entry.file_name()));
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => copy_all(&path, &copy),
            // The recorded files are many and large, and never change.
            Ok(kind) if kind.is_file() => {
                let is_journal = entry.file_name().to_string_lossy().starts_with("journal.");
                if is_journal || fs::hard_link(&path, &copy).is_err() {
                    let _ = fs::copy(&path, &copy);
                }
            }
            _ => {}
        }
    }
}
