//! Looking at a folder until a file has stopped growing.
//!
//! A file that somebody is copying has no end one can see. It is taken for complete when its size and its time of change have stayed
//! the same for a while, and what is in it has an end: that is for the reader to say. Time comes in as an argument, so that a test
//! steps it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use regrind_formats::FormatError;

/// How a file looked at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileLook {
    /// Its length.
    pub bytes: u64,
    /// When it was changed last, by the clock of its file system.
    pub modified: SystemTime,
}

/// A file in the folder, and since when it has looked as it does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Known {
    look: FileLook,
    since: Duration,
}

/// A folder that is looked at again and again.
#[derive(Clone, Debug)]
pub struct Watch {
    folder: PathBuf,
    stable_for: Duration,
    known: BTreeMap<String, Known>,
}

/// A file as the last look found it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WatchedFile {
    /// Its name in the folder.
    pub name: String,
    /// Where it is.
    pub path: PathBuf,
    /// How it looks.
    pub look: FileLook,
    /// Whether it has looked so for long enough.
    pub settled: bool,
}

impl Watch {
    /// Watches a folder; a file that has not changed for `stable_for` has settled.
    pub fn new(folder: impl Into<PathBuf>, stable_for: Duration) -> Self {
        Self { folder: folder.into(), stable_for, known: BTreeMap::new() }
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Looks at the folder and returns its files by name, those that begin with a dot left out.
    ///
    /// `now` is the time since any fixed moment; it must not go back.
    ///
    /// # Errors
    /// A folder that cannot be read.
    pub fn look(&mut self, now: Duration) -> Result<Vec<WatchedFile>, FormatError> {
        let unreadable = |source| FormatError::Unreadable { path: self.folder.clone(), source };
        let mut known = BTreeMap::new();
        for entry in std::fs::read_dir(&self.folder).map_err(unreadable)? {
            let entry = entry.map_err(unreadable)?;
            let Ok(name) = entry.file_name().into_string() else { continue };
            // A file that goes away while it is looked at was not there.
            let Ok(metadata) = std::fs::metadata(entry.path()) else { continue };
            if name.starts_with('.') || !metadata.is_file() {
                continue;
            }
            let look = FileLook { bytes: metadata.len(), modified: metadata.modified().map_err(unreadable)? };
            let before = self.known.get(&name).filter(|k| k.look == look);
            known.insert(name, Known { look, since: before.map_or(now, |k| k.since) });
        }
        self.known = known;
        let found = self.known.iter().map(|(name, known)| WatchedFile {
            name: name.clone(),
            path: self.folder.join(name),
            look: known.look,
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
    fn a_file_settles_when_it_stops_changing() {
        let home = tempfile::tempdir().unwrap();
        let mut watch = Watch::new(home.path(), Duration::from_secs(2));
        let at = Duration::from_secs;
        assert!(watch.look(at(0)).unwrap().is_empty());
        fs::write(home.path().join("a.csv"), "1,2,3\n").unwrap();
        fs::write(home.path().join(".hidden"), "").unwrap();
        fs::create_dir(home.path().join("folder")).unwrap();
        let settled = |watch: &mut Watch, s| watch.look(at(s)).unwrap().iter().map(|f| f.settled).collect::<Vec<_>>();
        assert_eq!(settled(&mut watch, 1), [false]);
        assert_eq!(settled(&mut watch, 2), [false]);
        // It grows: the time begins anew.
        fs::write(home.path().join("a.csv"), "1,2,3\n4,5,6\n").unwrap();
        assert_eq!(settled(&mut watch, 3), [false]);
        assert_eq!(settled(&mut watch, 4), [false]);
        assert_eq!(settled(&mut watch, 5), [true]);
        fs::remove_file(home.path().join("a.csv")).unwrap();
        assert!(settled(&mut watch, 6).is_empty());
        assert!(matches!(Watch::new("/nowhere/at/all", at(1)).look(at(0)), Err(FormatError::Unreadable { .. })));
    }
}
