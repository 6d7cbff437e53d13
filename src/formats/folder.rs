//! The folder that results go to.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::error::FormatError;
use super::registration::try_writing;
use super::system::{is_socket, link_to};

/// A folder that can be written to; what was created for it goes away again unless it is kept.
#[derive(Debug)]
pub struct ResultFolder {
    path: PathBuf,
    /// Folders that did not exist before, the outermost first.
    created: Vec<PathBuf>,
}

impl ResultFolder {
    /// Creates a folder and its parents where they do not exist, and tries whether a file can be created in it.
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

    /// Returns the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Keeps the folder: it holds a result now.
    pub fn keep(mut self) {
        self.created.clear();
    }
}

impl Drop for ResultFolder {
    fn drop(&mut self) {
        for folder in self.created.iter().rev() {
            // Only empty folders go; the error that brought us here is the one to report.
            let _ = fs::remove_dir(folder);
        }
    }
}

/// Removes a socket that nobody listens on any more; anything else of that name is left alone.
///
/// # Errors
/// A folder that cannot be written, and a file of that name that is no socket.
pub fn remove_socket(path: &Path) -> std::io::Result<()> {
    if !is_socket(path)? {
        return Err(std::io::Error::from(std::io::ErrorKind::AlreadyExists));
    }
    fs::remove_file(path)
}

/// Places a link to a device, replacing one that an earlier simulation left; anything else of that name is left alone.
///
/// # Errors
/// A folder that cannot be written, and something of that name that is no link.
pub fn place_link(device: &Path, link: &Path) -> std::io::Result<()> {
    if fs::symlink_metadata(link).is_ok() {
        remove_link(link)?;
    }
    link_to(device, link)
}

/// Removes a link; anything else of that name is left alone.
///
/// # Errors
/// A folder that cannot be written, and something of that name that is no link.
pub fn remove_link(link: &Path) -> std::io::Result<()> {
    if !fs::symlink_metadata(link)?.file_type().is_symlink() {
        return Err(std::io::Error::from(std::io::ErrorKind::AlreadyExists));
    }
    fs::remove_file(link)
}

/// A folder for what is only compared, taken away with all in it when this is dropped.
#[derive(Debug)]
pub struct ScratchFolder(PathBuf);

impl ScratchFolder {
    /// Takes a path for it; what an earlier one left there is taken away. The folder is made by who writes into it.
    ///
    /// # Errors
    /// Something there that cannot be taken away.
    pub fn at(path: PathBuf) -> Result<Self, FormatError> {
        match fs::remove_dir_all(&path) {
            Err(source) if source.kind() != io::ErrorKind::NotFound => {
                Err(FormatError::Unwritable { path, action: "taking it away", source })
            }
            _ => Ok(Self(path)),
        }
    }

    /// Returns where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for ScratchFolder {
    fn drop(&mut self) {
        // Nobody needs anything of it, and the next one begins by taking it away.
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Returns the names of the files in a folder, sorted, if it is there. What was being written when a program ended, and so never had
/// its name, is taken away first: nothing refers to it.
pub fn finished_files(folder: &Path) -> Option<Vec<String>> {
    let entries = fs::read_dir(folder).ok()?.flatten().filter(|entry| entry.path().is_file());
    let mut names: Vec<_> = entries.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    names.retain(|name| {
        let unfinished = name.starts_with('.') && name.ends_with(".tmp");
        if unfinished {
            // It is in nobody's way where it cannot be.
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
    fn what_was_created_goes_away_unless_it_is_kept() {
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
    fn a_file_in_the_way_is_an_error() {
        let file = tempfile::NamedTempFile::new().unwrap();
        for path in [file.path().to_owned(), file.path().join("below")] {
            assert!(matches!(ResultFolder::prepare(&path), Err(FormatError::Unwritable { .. })), "{path:?}");
        }
    }
}
