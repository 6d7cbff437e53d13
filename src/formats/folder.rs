//! The folder that results go to.

use std::fs;
use std::path::{Path, PathBuf};

use super::error::FormatError;
use super::registration::try_writing;

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
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        if !fs::symlink_metadata(path)?.file_type().is_socket() {
            return Err(std::io::Error::from(std::io::ErrorKind::AlreadyExists));
        }
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
    #[cfg(unix)]
    return std::os::unix::fs::symlink(device, link);
    #[cfg(not(unix))]
    Err(std::io::Error::from(std::io::ErrorKind::Unsupported))
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
