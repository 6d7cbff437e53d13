//! The journals that tests make, kept for a verifier that is no part of this program: see .ci/run.

use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

/// Keeps the run folders below a folder once this goes out of scope.
#[allow(dead_code, reason = "not every test that includes this uses all of it")]
pub struct Kept(pub PathBuf);

impl Drop for Kept {
    fn drop(&mut self) {
        keep(&self.0);
    }
}

/// Keeps the run folders below a folder where REGRIND_KEEP_JOURNALS says, if it says so. A later state takes the place of an earlier
/// one; a run that goes on is left alone.
pub fn keep(home: &Path) {
    if let Some(place) = std::env::var_os("REGRIND_KEEP_JOURNALS").filter(|place| !place.is_empty()) {
        keep_below(home, Path::new(&place), 4);
    }
}

fn keep_below(folder: &Path, place: &Path, depth: u32) {
    if folder.join("journal.sqlite").is_file() {
        let lock = folder.join(".lock");
        // A test may have laid a pipe in its place, which is waited for without end.
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

/// What a test takes away meanwhile is not there to be kept.
fn copy_all(from: &Path, to: &Path) {
    let _ = fs::create_dir_all(to);
    for entry in fs::read_dir(from).into_iter().flatten().flatten() {
        let (path, copy) = (entry.path(), to.join(entry.file_name()));
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => copy_all(&path, &copy),
            // The files on record are many and large, and nobody writes them again.
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
