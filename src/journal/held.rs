//! A file that one program has at a time.

use std::fs::{File, TryLockError};
use std::thread;
use std::time::Duration;

/// A locked file, free again as soon as this is dropped.
#[derive(Debug)]
pub struct HeldFile(File);

/// Who only looks whether a run is driven has its lock for a moment; a holder has it for hours.
const TRIES: usize = 20;
const BETWEEN_TRIES: Duration = Duration::from_millis(5);

impl HeldFile {
    /// Locks a file, or says that another has it.
    ///
    /// # Errors
    /// A file that somebody holds, or that cannot be locked.
    pub fn take(file: File) -> Result<Self, TryLockError> {
        Self::take_waiting(file, || thread::sleep(BETWEEN_TRIES))
    }

    fn take_waiting(file: File, mut wait: impl FnMut()) -> Result<Self, TryLockError> {
        for _ in 1..TRIES {
            match file.try_lock() {
                Ok(()) => return Ok(Self(file)),
                Err(TryLockError::WouldBlock) => wait(),
                Err(error) => return Err(error),
            }
        }
        file.try_lock().map(|()| Self(file))
    }
}

impl Drop for HeldFile {
    fn drop(&mut self) {
        // Closing would not do: a child that another thread has just forked shares the lock until its exec.
        let _ = self.0.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_free_at_once_though_a_program_that_was_just_started_has_it_open_still() {
        let folder = tempfile::tempdir().unwrap();
        let open = || File::create(folder.path().join("lock")).unwrap();
        let file = open();
        // What a child has between its fork and its exec.
        let of_a_child = file.try_clone().unwrap();
        let held = HeldFile::take(file).unwrap();
        assert!(matches!(open().try_lock(), Err(TryLockError::WouldBlock)));
        drop(held);
        open().try_lock().unwrap();
        drop(of_a_child);
    }

    #[test]
    fn who_only_looks_turns_nobody_away_and_who_holds_does() {
        let folder = tempfile::tempdir().unwrap();
        let open = || File::create(folder.path().join("lock")).unwrap();
        let looking = open();
        looking.try_lock_shared().unwrap();
        let held = HeldFile::take_waiting(open(), || looking.unlock().unwrap()).unwrap();
        let mut waited = 0;
        assert!(matches!(HeldFile::take_waiting(open(), || waited += 1), Err(TryLockError::WouldBlock)));
        assert_eq!(waited, TRIES - 1);
        drop(held);
    }
}
