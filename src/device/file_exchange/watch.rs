//! Watch on a folder until a file has stopped growing.
//!
//! The end of a file that is being copied cannot be seen. The file counts as complete when its size and its time of
//! change have stayed the same for a time, and its content has an end, which the reader checks. Time is an argument, so
//! that a test can step it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use regrind_formats::FormatError;

/// Size and time of change of a file at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileStamp {
    /// Length, in bytes.
    pub bytes: u64,
    /// Time of the last change, by the clock of its file system.
    pub modified: SystemTime,
}

/// File in the folder, and the time since which it has not changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct KnownFile {
    stamp: FileStamp,
    since: Duration,
}

/// Folder that is read repeatedly.
#[derive(Clone, Debug)]
pub struct Watch {
    folder: PathBuf,
    stable_for: Duration,
    known: BTreeMap<String, KnownFile>,
}

/// File as found by the last scan of the folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WatchedFile {
    /// Name in the folder.
    pub name: String,
    /// Path of the file.
    pub path: PathBuf,
    /// Size and time of change.
    pub stamp: FileStamp,
    /// True if the file has not changed for `stable_for`, so that it counts as complete.
    pub settled: bool,
}

impl Watch {
    /// Creates a watch on a folder. A file that has not changed for `stable_for` counts as complete.
    pub fn new(folder: impl Into<PathBuf>, stable_for: Duration) -> Self {
        Self { folder: folder.into(), stable_for, known: BTreeMap::new() }
    }

    /// Returns the path of the watched folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Reads the folder and returns its files, sorted by name. Omits sub-folders and files whose name begins with a
    /// dot. Each returned file states whether it counts as complete because it has not changed for some time.
    ///
    /// `now` is the time since any fixed moment. It must not decrease from one call to the next.
    ///
    /// # Errors
    /// Returns an error if the folder cannot be read.
    pub fn scan(&mut self, now: Duration) -> Result<Vec<WatchedFile>, FormatError> {
        let unreadable = |source| FormatError::Unreadable { path: self.folder.clone(), source };
        let mut known = BTreeMap::new();
        for entry in std::fs::read_dir(&self.folder).map_err(unreadable)? {
            let entry = entry.map_err(unreadable)?;
            let Ok(name) = entry.file_name().into_string() else { continue };
            // A file that disappears while it is read counts as absent.
            let Ok(metadata) = std::fs::metadata(entry.path()) else { continue };
            if name.starts_with('.') || !metadata.is_file() {
                continue;
            }
            let look = FileStamp { bytes: metadata.len(), modified: metadata.modified().map_err(unreadable)? };
            let before = self.known.get(&name).filter(|k| k.stamp == look);
            known.insert(name, KnownFile { stamp: look, since: before.map_or(now, |k| k.since) });
        }
        self.known = known;
        let found = self.known.iter().map(|(name, known)| WatchedFile {
            name: name.clone(),
            path: self.folder.join(name),
            stamp: known.stamp,
            settled: now.saturating_sub(known.since) >= self.stable_for,
        });
        Ok(found.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn watch_file_settles_when_unchanged() {
        let home = tempfile::tempdir().unwrap();
        let mut watch = Watch::new(home.path(), Duration::from_secs(2));
        let at = Duration::from_secs;
        assert!(watch.scan(at(0)).unwrap().is_empty());
        fs::write(home.path().join("a.csv"), "1,2,3\n").unwrap();
        fs::write(home.path().join(".hidden"), "").unwrap();
        fs::create_dir(home.path().join("folder")).unwrap();
        let settled = |watch: &mut Watch, s| watch.scan(at(s)).unwrap().iter().map(|f| f.settled).collect::<Vec<_>>();
        assert_eq!(settled(&mut watch, 1), [false]);
        assert_eq!(settled(&mut watch, 2), [false]);
        // It grows, so the time starts again.
        fs::write(home.path().join("a.csv"), "1,2,3\n4,5,6\n").unwrap();
        assert_eq!(settled(&mut watch, 3), [false]);
        assert_eq!(settled(&mut watch, 4), [false]);
        assert_eq!(settled(&mut watch, 5), [true]);
        fs::remove_file(home.path().join("a.csv")).unwrap();
        assert!(settled(&mut watch, 6).is_empty());
        assert!(matches!(Watch::new("/nowhere/at/all", at(1)).scan(at(0)), Err(FormatError::Unreadable { .. })));
    }
}
