//! A file that one process locks at a time.

use std::fs::{File, TryLockError};
use std::thread;
use std::time::Duration;

/// Exclusively locked file. Dropping it releases the lock.
#[derive(Debug)]
pub struct LockedFile(File);

/// Number of attempts to lock. A process that only checks whether a run is driven holds the lock for a moment; a
/// process that drives the run holds it for hours.
const TRIES: usize = 20;
const BETWEEN_TRIES: Duration = Duration::from_millis(5);

impl LockedFile {
    /// Locks `file` for this process. The lock lasts until the returned value is dropped. If another process holds the
    /// lock, tries again for about 0.1 s.
    ///
    /// # Errors
    /// Another process still holds the lock, or the file cannot be locked.
    pub fn lock(file: File) -> Result<Self, TryLockError> {
        Self::lock_with_wait(file, || thread::sleep(BETWEEN_TRIES))
    }

    fn lock_with_wait(file: File, mut wait: impl FnMut()) -> Result<Self, TryLockError> {
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

impl Drop for LockedFile {
    fn drop(&mut self) {
        // Closing the file is not sufficient: a child process that another thread has just forked shares the lock until
        // its exec.
        let _ = self.0.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_file_released_despite_child() {
        let folder = tempfile::tempdir().unwrap();
        let open = || File::create(folder.path().join("lock")).unwrap();
        let file = open();
        // A child process has this handle between its fork and its exec.
        let of_a_child = file.try_clone().unwrap();
        let held = LockedFile::lock(file).unwrap();
        assert!(matches!(open().try_lock(), Err(TryLockError::WouldBlock)));
        drop(held);
        open().try_lock().unwrap();
        drop(of_a_child);
    }

    #[test]
    fn held_file_waits_for_shared_lock() {
        let folder = tempfile::tempdir().unwrap();
        let open = || File::create(folder.path().join("lock")).unwrap();
        let looking = open();
        looking.try_lock_shared().unwrap();
        // Wine unlocks the file and nevertheless reports error 33. Therefore the result of the next lock decides.
        let held = LockedFile::lock_with_wait(open(), || drop(looking.unlock())).unwrap();
        let mut waited = 0;
        assert!(matches!(LockedFile::lock_with_wait(open(), || waited += 1), Err(TryLockError::WouldBlock)));
        assert_eq!(waited, TRIES - 1);
        drop(held);
    }
}
