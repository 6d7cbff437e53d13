//! Lock of the publisher of a cell: two publishers of the same cell would disconnect each other from the broker.

use std::path::{Path, PathBuf};

use regrind_formats::{PersistentCounter, ResultFolder};

use crate::error::LiveError;

/// Lock of one publisher, held until this is dropped. Another publisher waits for it.
#[derive(Debug)]
pub struct PublisherLock {
    folder: PathBuf,
    _held: PersistentCounter,
}

impl PublisherLock {
    /// Takes the lock in `folder`, so that no other program publishes the same cell. Creates the folder if it does not
    /// exist. Returns `None` if another program has the lock.
    ///
    /// # Errors
    /// The folder cannot be created or written.
    pub fn acquire(folder: &Path) -> Result<Option<Self>, LiveError> {
        ResultFolder::prepare(folder)?.keep();
        let held = PersistentCounter::lock(&folder.join("turn")).map_err(unwritable(folder))?;
        Ok(held.map(|held| Self { folder: folder.to_owned(), _held: held }))
    }

    /// Returns the folder of this lock, in which publishers store their persistent files, such as certificates and the
    /// connection counter.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }
}

/// Counter of the connections to a broker (bdSeq). A host uses it to match a death to its birth.
#[derive(Debug)]
pub(crate) struct BdSeqCounter {
    counter: PersistentCounter,
    folder: PathBuf,
}

impl BdSeqCounter {
    pub(crate) fn open(turn: &PublisherLock) -> Result<Self, LiveError> {
        let kept = PersistentCounter::lock(&turn.folder.join("births")).map_err(unwritable(&turn.folder))?;
        // Only the holder of the lock uses the counter, so it must be free.
        let kept = kept.ok_or_else(|| unwritable(&turn.folder)(std::io::ErrorKind::WouldBlock.into()))?;
        Ok(Self { counter: kept, folder: turn.folder.clone() })
    }

    /// Increments the number of the connection (bdSeq), writes the new number to the disk, and returns it. The first
    /// number is 0. The number after 255 is 0 again.
    ///
    /// Returns an error if the number cannot be read from the disk or written to the disk.
    pub(crate) fn next(&mut self) -> Result<u8, LiveError> {
        let unwritable = unwritable(&self.folder);
        let before = self.counter.get().map_err(&unwritable)?;
        let next = before.and_then(|before| u8::try_from(before).ok()).map_or(0, |before| before.wrapping_add(1));
        self.counter.set(next.into()).map_err(&unwritable)?;
        Ok(next)
    }
}

fn unwritable(folder: &Path) -> impl Fn(std::io::Error) -> LiveError {
    move |source| LiveError::Folder { path: folder.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn publisher_lock_and_bdseq_counter() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("plant.live");
        for first in [0, 3] {
            let turn = PublisherLock::acquire(&folder).unwrap().unwrap();
            assert!(PublisherLock::acquire(&folder).unwrap().is_none());
            let mut births = BdSeqCounter::open(&turn).unwrap();
            assert_eq!(
                [births.next().unwrap(), births.next().unwrap(), births.next().unwrap()],
                [first, first + 1, first + 2]
            );
        }
        PersistentCounter::lock(&folder.join("births")).unwrap().unwrap().set(255).unwrap();
        let turn = PublisherLock::acquire(&folder).unwrap().unwrap();
        assert_eq!(BdSeqCounter::open(&turn).unwrap().next().unwrap(), 0);
    }
}
