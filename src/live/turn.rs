//! Whose turn it is to tell a cell: two that tell the same one would push each other off the broker.

use std::path::{Path, PathBuf};

use regrind_formats::{KeptNumber, ResultFolder};

use crate::error::LiveError;

/// The turn of one program to tell a cell, until this is dropped. Another one waits for it.
#[derive(Debug)]
pub struct Turn {
    folder: PathBuf,
    _held: KeptNumber,
}

impl Turn {
    /// Takes the turn in a folder, which is made where it is not there; none where another program has it.
    ///
    /// # Errors
    /// A folder that cannot be made or written.
    pub fn take(folder: &Path) -> Result<Option<Self>, LiveError> {
        ResultFolder::prepare(folder)?.keep();
        let held = KeptNumber::take(&folder.join("turn")).map_err(unwritable(folder))?;
        Ok(held.map(|held| Self { folder: folder.to_owned(), _held: held }))
    }

    /// Returns the folder in which those who tell keep what outlives them.
    pub(crate) fn folder(&self) -> &Path {
        &self.folder
    }
}

/// The number of each connection to a broker (bdSeq), by which a host tells which birth a death belongs to.
#[derive(Debug)]
pub(crate) struct Births {
    kept: KeptNumber,
    folder: PathBuf,
}

impl Births {
    pub(crate) fn of(turn: &Turn) -> Result<Self, LiveError> {
        let kept = KeptNumber::take(&turn.folder.join("births")).map_err(unwritable(&turn.folder))?;
        // Whoever has the turn has them too.
        let kept = kept.ok_or_else(|| unwritable(&turn.folder)(std::io::ErrorKind::WouldBlock.into()))?;
        Ok(Self { kept, folder: turn.folder.clone() })
    }

    /// Takes the next number, which is on disk before it is used; 0 follows 255.
    pub(crate) fn next(&mut self) -> Result<u8, LiveError> {
        let unwritable = unwritable(&self.folder);
        let before = self.kept.get().map_err(&unwritable)?;
        let next = before.and_then(|before| u8::try_from(before).ok()).map_or(0, |before| before.wrapping_add(1));
        self.kept.set(next.into()).map_err(&unwritable)?;
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
    fn one_has_the_turn_and_births_are_counted_over_it() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("plant.live");
        for first in [0, 3] {
            let turn = Turn::take(&folder).unwrap().unwrap();
            assert!(Turn::take(&folder).unwrap().is_none());
            let mut births = Births::of(&turn).unwrap();
            assert_eq!(
                [births.next().unwrap(), births.next().unwrap(), births.next().unwrap()],
                [first, first + 1, first + 2]
            );
        }
        KeptNumber::take(&folder.join("births")).unwrap().unwrap().set(255).unwrap();
        let turn = Turn::take(&folder).unwrap().unwrap();
        assert_eq!(Births::of(&turn).unwrap().next().unwrap(), 0);
    }
}
