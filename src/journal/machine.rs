//! A machine serves one run at a time: on this computer by a lock, which goes away with the process that holds it.
//!
//! The file of the lock also keeps the last epoch that a client of this computer had for the machine, so that the next one is higher
//! whatever the clock says.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};

use super::error::JournalError;
use super::held::HeldFile;
use super::{sha256_hex, system};

/// A machine that no other run on this computer can take while this lives.
#[derive(Debug)]
pub struct MachineLock {
    /// Held, not read.
    _file: HeldFile,
    /// Where the holder and the epoch stand.
    told: PathBuf,
    holder: String,
    last_epoch: u32,
}

const FOLDER: &str = "regrind-machines";
/// Begins the line of the lock's file that keeps the epoch.
const EPOCH: &str = "epoch ";

impl MachineLock {
    /// Takes a machine, by the address by which every run would call it, for a run.
    ///
    /// # Errors
    /// A machine that another run has, which is named; no folder for locks that can be written.
    pub fn take(address: &str, run: &Path) -> Result<Self, JournalError> {
        // Where no place is for all, the user's own is better than none.
        Self::take_in(&system::place_of_locks().unwrap_or_else(std::env::temp_dir).join(FOLDER), address, run)
    }

    /// Returns an epoch for the client of these machines: higher than every one that a client of this computer had for any of them, and
    /// not below the clock. The machines' files keep it.
    pub fn epoch<'a>(machines: impl IntoIterator<Item = &'a Self> + Clone, clock: u32) -> u32 {
        let last = machines.clone().into_iter().map(|machine| machine.last_epoch).max().unwrap_or(0);
        let epoch = clock.max(last.saturating_add(1));
        machines.into_iter().for_each(|machine| machine.write(epoch));
        epoch
    }

    fn take_in(folder: &Path, address: &str, run: &Path) -> Result<Self, JournalError> {
        let path = folder.join(format!("{}.lock", &sha256_hex(address.as_bytes())[..16]));
        let file = opened(folder, &path)?;
        let told = system::beside_lock(&path);
        let file = match HeldFile::take(file) {
            Ok(file) => file,
            Err(TryLockError::WouldBlock) => {
                let holder = fs::read_to_string(&told).unwrap_or_default();
                let holder = holder.lines().next().unwrap_or_default().trim().to_owned();
                return Err(JournalError::MachineTaken { address: address.to_owned(), holder });
            }
            Err(TryLockError::Error(error)) => return Err(JournalError::file(&path, "locking it")(error)),
        };
        let kept = fs::read_to_string(&told).unwrap_or_default();
        let last_epoch = kept.lines().find_map(|line| line.strip_prefix(EPOCH)?.trim().parse().ok()).unwrap_or(0);
        let holder = format!("{}, process {}", run.display(), std::process::id());
        let lock = Self { _file: file, told, holder, last_epoch };
        lock.write(last_epoch);
        Ok(lock)
    }

    /// Who holds it is for people, and the machine itself tells of its last epoch too: a file that another user made and that cannot be
    /// written locks all the same.
    fn write(&self, epoch: u32) {
        let text = format!("{}\n{EPOCH}{epoch}\n", self.holder);
        // Never empty in between: what was kept outlives a program that is killed here.
        let _ = OpenOptions::new().write(true).create(true).truncate(false).open(&self.told).and_then(|mut file| {
            file.write_all(text.as_bytes())?;
            file.set_len(text.len() as u64)
        });
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
        system::open_folder_to_all(folder);
    }
    if !path.exists() {
        OpenOptions::new().append(true).create(true).open(path).map_err(JournalError::file(path, "creating it"))?;
        system::open_file_to_all(path);
    }
    File::open(path).map_err(JournalError::file(path, "opening it"))
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

    #[test]
    fn an_epoch_rises_for_each_machine_whatever_the_clock_does() {
        let folder = tempfile::tempdir().unwrap();
        let take = |address: &str| MachineLock::take_in(folder.path(), address, Path::new("runs/a")).unwrap();
        let epoch = |addresses: &[&str], clock| {
            let machines: Vec<_> = addresses.iter().map(|address| take(address)).collect();
            MachineLock::epoch(&machines, clock)
        };
        assert_eq!(epoch(&["cmm", "grinder"], 1000), 1000);
        assert_eq!(epoch(&["cmm", "grinder"], 1000), 1001, "twice in a second");
        assert_eq!(epoch(&["grinder"], 500), 1002, "the clock was set back");
        assert_eq!(epoch(&["cmm", "other"], 10), 1002, "each machine has its own");
        assert_eq!(epoch(&["other"], 10), 1003);
        assert_eq!(epoch(&["other"], 5000), 5000);
        assert_eq!(epoch(&[], 7), 7);
        drop(take("cmm"));
        assert_eq!(epoch(&["cmm"], 0), 1003, "who only had it has kept it");
    }
}
