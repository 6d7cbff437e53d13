//! Folder for results.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::error::FormatError;
use super::registration::{sync_folder, try_writing};
use super::system::is_socket;

/// Writable folder; the folders that were created for it are removed again unless it is kept.
#[derive(Debug)]
pub struct ResultFolder {
    path: PathBuf,
    /// Folders that did not exist before, outermost first.
    created: Vec<PathBuf>,
}

impl ResultFolder {
    /// Creates the folder `path` and its missing parents, and checks that a file can be created in it. Folders that
    /// were created are removed when the value is dropped, unless [`Self::keep`] is called.
    ///
    /// # Errors
    /// A folder that cannot be created or written to.
    pub fn prepare(path: impl AsRef<Path>) -> Result<Self, FormatError> {
        let path = path.as_ref().to_owned();
        let missing = path.ancestors().take_while(|p| !p.as_os_str().is_empty() && !p.exists());
        let mut created: Vec<PathBuf> = missing.map(Path::to_owned).collect();
        created.reverse();
        let folder = Self { path, created };
        fs::create_dir_all(&folder.path).map_err(|source| FormatError::Unwritable {
            path: folder.path.clone(),
            action: "creating the folder",
            source,
        })?;
        try_writing(&folder.path)?;
        Ok(folder)
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Keeps the folder after the value is dropped, because it now contains a result.
    pub fn keep(mut self) {
        self.created.clear();
    }
}

impl Drop for ResultFolder {
    fn drop(&mut self) {
        for folder in self.created.iter().rev() {
            // Only empty folders are removed; the first error is the one to report.
            let _ = fs::remove_dir(folder);
        }
    }
}

/// Removes the socket at `path`. The caller must know that no program listens on it.
///
/// # Errors
/// Nothing at `path`; something that is not a socket, which stays unchanged; a folder that is not writable.
pub fn remove_socket(path: &Path) -> std::io::Result<()> {
    if !is_socket(path)? {
        return Err(std::io::Error::from(std::io::ErrorKind::AlreadyExists));
    }
    fs::remove_file(path)
}

/// Temporary folder for a comparison, removed with its content when this value is dropped.
#[derive(Debug)]
pub struct ScratchFolder(PathBuf);

impl ScratchFolder {
    /// Reserves `path` for a temporary folder, and deletes a folder that an earlier run left at `path`. The folder
    /// itself is not created: the caller does that.
    ///
    /// # Errors
    /// A folder at `path` that cannot be deleted.
    pub fn at(path: PathBuf) -> Result<Self, FormatError> {
        match fs::remove_dir_all(&path) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                Err(FormatError::Unwritable { path, action: "deleting it", source })
            }
            _ => Ok(Self(path)),
        }
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

/// Moves the folder `from` to `to` on the same disk, and flushes both names to the disk. Missing parents of `to` are
/// created. The content of `from` must be on the disk already.
///
/// # Errors
/// `to` exists. A folder that cannot be created, renamed or flushed.
pub fn move_folder(from: &Path, to: &Path) -> Result<(), FormatError> {
    let failed = |action| move |source| FormatError::Unwritable { path: to.to_owned(), action, source };
    if fs::symlink_metadata(to).is_ok() {
        return Err(failed("creating it")(io::Error::from(io::ErrorKind::AlreadyExists)));
    }
    let parent = to.parent().unwrap_or(Path::new(""));
    fs::create_dir_all(parent).map_err(failed("creating its folder"))?;
    fs::rename(from, to).map_err(failed("renaming it"))?;
    // Each parent can be new.
    for folder in to.ancestors().take(4).filter(|folder| !folder.as_os_str().is_empty()) {
        sync_folder(folder).map_err(failed("flushing it to the disk"))?;
    }
    sync_folder(from).map_err(failed("flushing it to the disk"))
}

impl Drop for ScratchFolder {
    fn drop(&mut self) {
        // An error is harmless: nothing in it is needed, and the next run removes it first.
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Returns the sorted names of the files in a folder; `None` if the folder does not exist or cannot be read. First
/// deletes the unfinished files (`.name.tmp`) that a terminated program left, because nothing refers to them.
pub fn finished_files(folder: &Path) -> Option<Vec<String>> {
    let entries = fs::read_dir(folder).ok()?.flatten().filter(|entry| entry.path().is_file());
    let mut names: Vec<_> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    names.retain(|name| {
        let unfinished = name.starts_with('.') && name.ends_with(".tmp");
        if unfinished {
            // A file that cannot be removed does no harm.
            let _ = fs::remove_file(folder.join(name));
        }
        !unfinished
    });
    names.sort();
    Some(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn result_folder_dropped_without_keep() {
        let home = tempfile::tempdir().unwrap();
        let deep = home.path().join("a/b/c");
        drop(ResultFolder::prepare(&deep).unwrap());
        assert!(!home.path().join("a").exists());
        ResultFolder::prepare(&deep).unwrap().keep();
        assert!(deep.is_dir() && deep.read_dir().unwrap().next().is_none());
        drop(ResultFolder::prepare(&deep).unwrap());
        assert!(deep.is_dir());
    }

    #[test]
    fn result_folder_refuses_file_in_path() {
        let file = tempfile::NamedTempFile::new().unwrap();
        for path in [file.path().to_owned(), file.path().join("below")] {
            assert!(matches!(ResultFolder::prepare(&path), Err(FormatError::Unwritable { .. })), "{path:?}");
        }
    }
}
