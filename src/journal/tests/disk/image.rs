//! What a disk would still hold if the power went now.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::seeded_numbers::SeededNumbers;

/// A disk writes these whole or not at all.
const SECTOR: u64 = 512;

/// What becomes of the bytes that were written and not brought to the disk when the power goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All of them are gone.
    Lost,
    /// All of them are there.
    Kept,
    /// Of each write, each sector is there or is not; and so is each change of a file's length.
    Torn,
}

impl Outcome {
    /// All there are.
    pub const ALL: [Self; 3] = [Self::Lost, Self::Kept, Self::Torn];

    fn keeps(self, drawn: &mut SeededNumbers) -> bool {
        match self {
            Self::Lost => false,
            Self::Kept => true,
            Self::Torn => drawn.below(2) == 1,
        }
    }
}

/// A change of a file that no sync has brought to the disk.
#[derive(Clone, Debug)]
enum Change {
    Write { at: u64, bytes: Arc<[u8]> },
    Truncate(u64),
}

impl Change {
    /// Brings to the bytes of a file what becomes of this change.
    fn settle(&self, file: &mut Vec<u8>, outcome: Outcome, drawn: &mut SeededNumbers) {
        match self {
            Self::Truncate(length) if outcome.keeps(drawn) => file.resize(*length as usize, 0),
            Self::Truncate(_) => {}
            Self::Write { at, bytes } => {
                let (mut from, end) = (*at, at + bytes.len() as u64);
                while from < end {
                    let to = end.min((from / SECTOR + 1) * SECTOR);
                    let part = &bytes[(from - at) as usize..(to - at) as usize];
                    settle_sector(file, from as usize, part, outcome, drawn);
                    from = to;
                }
            }
        }
    }
}

/// A sector that was lost beyond the end of the file leaves a hole, if one behind it was kept, or whatever the disk held there before.
fn settle_sector(file: &mut Vec<u8>, at: usize, bytes: &[u8], outcome: Outcome, drawn: &mut SeededNumbers) {
    let keeps = outcome.keeps(drawn);
    let is_stale = !keeps && outcome == Outcome::Torn && at >= file.len() && drawn.below(4) == 0;
    if !keeps && !is_stale {
        return;
    }
    if file.len() < at + bytes.len() {
        file.resize(at + bytes.len(), 0);
    }
    match keeps {
        true => file[at..at + bytes.len()].copy_from_slice(bytes),
        false => file[at..].iter_mut().for_each(|byte| *byte = drawn.below(256) as u8),
    }
}

/// A file, whatever its name.
#[derive(Clone, Debug, Default)]
struct Content {
    /// As it was when it was last brought to the disk.
    lasting: Arc<Vec<u8>>,
    changes: Vec<Change>,
}

impl Content {
    fn settled(&self, outcome: Outcome, drawn: &mut SeededNumbers) -> Vec<u8> {
        let mut bytes = Vec::clone(&self.lasting);
        self.changes.iter().for_each(|change| change.settle(&mut bytes, outcome, drawn));
        bytes
    }

    fn settle(&mut self, outcome: Outcome, drawn: &mut SeededNumbers) {
        if !self.changes.is_empty() {
            self.lasting = Arc::new(self.settled(outcome, drawn));
            self.changes.clear();
        }
    }
}

/// A change of a folder that may not have come to the disk.
#[derive(Clone, Debug)]
enum Naming {
    Made(PathBuf, usize),
    Gone(PathBuf),
}

/// What a disk holds of the files of SQLite in one folder.
#[derive(Clone, Debug, Default)]
pub(crate) struct Image {
    files: Vec<Content>,
    /// The names as the program sees them.
    names: BTreeMap<PathBuf, usize>,
    /// The names that are on the disk.
    lasting: BTreeMap<PathBuf, usize>,
    /// What is not, in order: a file system keeps the order.
    naming: Vec<Naming>,
}

impl Image {
    /// Returns the file of a name, if it is known.
    pub(crate) fn find(&self, path: &Path) -> Option<usize> {
        self.names.get(path).copied()
    }

    /// Takes up a file that was there before this disk looked.
    pub(crate) fn found(&mut self, path: &Path, bytes: Vec<u8>) -> usize {
        let file = self.add(path, bytes);
        self.lasting.insert(path.to_owned(), file);
        file
    }

    /// Takes up a file that was made just now.
    pub(crate) fn made(&mut self, path: &Path) -> usize {
        let file = self.add(path, Vec::new());
        self.naming.push(Naming::Made(path.to_owned(), file));
        file
    }

    fn add(&mut self, path: &Path, bytes: Vec<u8>) -> usize {
        self.files.push(Content { lasting: Arc::new(bytes), changes: Vec::new() });
        let file = self.files.len() - 1;
        self.names.insert(path.to_owned(), file);
        file
    }

    pub(crate) fn deleted(&mut self, path: &Path) {
        self.names.remove(path);
        self.naming.push(Naming::Gone(path.to_owned()));
    }

    pub(crate) fn written(&mut self, file: usize, at: u64, bytes: &[u8]) {
        self.files[file].changes.push(Change::Write { at, bytes: bytes.into() });
    }

    pub(crate) fn truncated(&mut self, file: usize, length: u64) {
        self.files[file].changes.push(Change::Truncate(length));
    }

    pub(crate) fn synced(&mut self, file: usize) {
        self.files[file].settle(Outcome::Kept, &mut SeededNumbers::new(0));
    }

    /// A sync failed, and the system takes what it could not bring to the disk for brought there: nothing will bring it any more.
    pub(crate) fn forgotten(&mut self, file: usize, drawn: &mut SeededNumbers) {
        self.files[file].settle(Outcome::Torn, drawn);
    }

    /// The folder itself was brought to the disk.
    pub(crate) fn folder_synced(&mut self) {
        self.naming.clear();
        self.lasting.clone_from(&self.names);
    }

    /// Returns the files that are found afterwards.
    fn settled(&self, outcome: Outcome, drawn: &mut SeededNumbers) -> BTreeMap<PathBuf, Vec<u8>> {
        let most = self.naming.len() as u64;
        let kept = match outcome {
            Outcome::Lost => 0,
            Outcome::Kept => most,
            Outcome::Torn => drawn.below(most + 1),
        };
        let mut names = self.lasting.clone();
        for naming in &self.naming[..kept as usize] {
            match naming {
                Naming::Made(path, file) => drop(names.insert(path.clone(), *file)),
                Naming::Gone(path) => drop(names.remove(path)),
            }
        }
        names.into_iter().map(|(path, file)| (path, self.files[file].settled(outcome, drawn))).collect()
    }
}

/// A moment at which the power may go: in the middle of a change, which may be there afterwards, or not, or in parts.
#[derive(Clone, Debug)]
pub struct Cut {
    /// What was being done.
    pub during: String,
    /// The newest mark that the test had made by then.
    pub mark: u64,
    pub(crate) image: Image,
    /// Files that SQLite does not know. They are as they were: what a program brings to the disk by itself is not looked at here.
    pub(crate) others: Arc<BTreeMap<PathBuf, Vec<u8>>>,
}

impl Cut {
    /// Makes a folder as it might be found after this cut.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub fn restore(&self, folder: &Path, outcome: Outcome, drawn: &mut SeededNumbers) -> io::Result<()> {
        fs::create_dir_all(folder)?;
        for (path, bytes) in self.others.iter() {
            let path = folder.join(path);
            path.parent().map_or(Ok(()), fs::create_dir_all)?;
            fs::write(path, bytes)?;
        }
        for (path, bytes) in self.image.settled(outcome, drawn) {
            let name = path.file_name().unwrap_or_default();
            fs::write(folder.join(name), bytes)?;
            // The index of a log is never brought to the disk: whatever is found there is worth nothing.
            let name = name.to_string_lossy();
            if outcome == Outcome::Torn && name.ends_with("-wal") && drawn.below(2) == 1 {
                let junk: Vec<u8> = (0..32 << 10).map(|_| drawn.below(256) as u8).collect();
                fs::write(folder.join(name.replace("-wal", "-shm")), junk)?;
            }
        }
        Ok(())
    }
}
