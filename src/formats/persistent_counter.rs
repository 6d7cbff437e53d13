//! Persistent counter: a number that outlives the program that counts it.

use std::fs::{File, TryLockError};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// Number in a file of its own, locked by one program at a time.
#[derive(Debug)]
pub struct PersistentCounter {
    file: File,
}

impl PersistentCounter {
    /// Opens the file `path` that stores the number of a counter, or creates it, and locks it. The lock ends when the
    /// returned counter is dropped. Returns `None` if another program holds the lock.
    ///
    /// # Errors
    /// A file that cannot be created, written or locked.
    pub fn lock(path: &Path) -> io::Result<Option<Self>> {
        let file = File::options().read(true).write(true).create(true).truncate(false).open(path)?;
        match file.try_lock() {
            Ok(()) => Ok(Some(Self { file })),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Err(error),
        }
    }

    /// Returns the number in the file; `None` if the file is empty or its content is not a number.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn get(&mut self) -> io::Result<Option<u64>> {
        let mut text = String::new();
        self.file.seek(SeekFrom::Start(0))?;
        match (&mut self.file).take(32).read_to_string(&mut text) {
            Err(error) if error.kind() != io::ErrorKind::InvalidData => Err(error),
            _ => Ok(text.trim().parse().ok()),
        }
    }

    /// Overwrites the number in the file.
    ///
    /// # Errors
    /// A file that cannot be written, for example because the disk is full.
    pub fn set(&mut self, number: u64) -> io::Result<()> {
        self.file.seek(SeekFrom::Start(0))?;
        self.file.write_all(format!("{number:<20}\n").as_bytes())
    }
}

impl Drop for PersistentCounter {
    fn drop(&mut self) {
        // Closing the file is not enough: a child that another thread has just forked shares the lock until its exec.
        let _ = self.file.unlock();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn persistent_counter_is_exclusive() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("number");
        let mut number = PersistentCounter::lock(&path).unwrap().unwrap();
        assert_eq!(number.get().unwrap(), None);
        number.set(255).unwrap();
        number.set(7).unwrap();
        // The handle that a child has between its fork and its exec.
        let _of_a_child = number.file.try_clone().unwrap();
        assert!(PersistentCounter::lock(&path).unwrap().is_none());
        drop(number);
        assert_eq!(PersistentCounter::lock(&path).unwrap().unwrap().get().unwrap(), Some(7));
    }
}
