//! Content of a disk after a power cut.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::seeded_numbers::SeededNumbers;

/// Unit of writing of the disk, in bytes. A power cut keeps a sector completely or not at all.
const SECTOR: u64 = 512;

/// Result of a power cut for the changes that no sync has brought to the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All changes are lost.
    Lost,
    /// All changes are on the disk.
    Kept,
    /// Each sector of a write is kept or lost by chance, and so is each change of a file's length.
    Torn,
}

impl Outcome {
    /// All outcomes.
    pub const ALL: [Self; 3] = [Self::Lost, Self::Kept, Self::Torn];

    fn keeps(self, drawn: &mut SeededNumbers) -> bool {
        match self {
            Self::Lost => false,
            Self::Kept => true,
            Self::Torn => drawn.below(2) == 1,
        }
    }
}

/// Change of a file that no sync has brought to the disk.
#[derive(Clone, Debug)]
enum Change {
    Write { at: u64, bytes: Arc<[u8]> },
    Truncate(u64),
}

impl Change {
    /// Applies this change to the bytes of a file, as the outcome of the power cut decides.
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

/// Applies the write of one sector.
/// A lost sector beyond the end of the file becomes a hole if a later sector is kept, or it has old data of the disk.
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

/// Content of a file, independent of its name.
#[derive(Clone, Debug, Default)]
struct Content {
    /// Bytes of the file after its last sync.
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

/// Change of a folder that no sync has brought to the disk.
#[derive(Clone, Debug)]
enum Naming {
    Made(PathBuf, usize),
    Gone(PathBuf),
}

/// Content of a disk: the SQLite files of one folder.
#[derive(Clone, Debug, Default)]
pub(crate) struct Image {
    files: Vec<Content>,
    /// Names of the files as the program sees them.
    names: BTreeMap<PathBuf, usize>,
    /// Names of the files that are on the disk.
    lasting: BTreeMap<PathBuf, usize>,
    /// Changes of names that are not on the disk yet, in order. A file system keeps this order.
    naming: Vec<Naming>,
}

impl Image {
    /// Returns the number of the file with this name, if the file is known.
    pub(crate) fn find(&self, path: &Path) -> Option<usize> {
        self.names.get(path).copied()
    }

    /// Adds a file that existed before this disk was installed.
    pub(crate) fn found(&mut self, path: &Path, bytes: Vec<u8>) -> usize {
        let file = self.add(path, bytes);
        self.lasting.insert(path.to_owned(), file);
        file
    }

    /// Adds a file that the program has just created.
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

    /// Applies a failed sync after which the system regards all changes as written.
    /// No later sync writes the lost changes.
    pub(crate) fn forgotten(&mut self, file: usize, drawn: &mut SeededNumbers) {
        self.files[file].settle(Outcome::Torn, drawn);
    }

    /// Applies a sync of the folder itself.
    pub(crate) fn folder_synced(&mut self) {
        self.naming.clear();
        self.lasting.clone_from(&self.names);
    }

    /// Returns the files that exist after the power cut.
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

/// Moment of a possible power cut, in the middle of a change. The change can be kept, lost or torn.
#[derive(Clone, Debug)]
pub struct Cut {
    /// Operation during which the power is cut.
    pub during: String,
    /// Last mark that the test had set before the cut.
    pub mark: u64,
    pub(crate) image: Image,
    /// Files that do not belong to SQLite, with their bytes at the cut. The simulated disk does not model their syncs.
    pub(crate) others: Arc<BTreeMap<PathBuf, Vec<u8>>>,
}

impl Cut {
    /// Creates a folder with the files that a program can find after this cut.
    ///
    /// # Errors
    /// The folder cannot be written.
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
