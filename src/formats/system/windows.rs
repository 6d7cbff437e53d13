//! Files have access control lists, the file system itself flushes the names in a folder, devices and pipes are not
//! files.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use tempfile::TempDir;

use super::OpenToOthers;

/// Creates a file that only its owner can read, and opens it for writing. An existing file is an error.
pub(crate) fn create_owners(path: &Path) -> io::Result<File> {
    regrind_windows::create_owners_file(path)
}

/// Creates a folder in `parent`. Its name begins with `prefix`. The folder for temporary files is that of the user, who
/// alone can read what is in it.
pub(crate) fn create_owners_folder(prefix: &str, parent: &Path) -> io::Result<TempDir> {
    tempfile::Builder::new().prefix(prefix).tempdir_in(parent)
}

/// Does nothing: on Windows a file has the permissions of its folder.
pub(crate) fn copy_access(_from: &Path, _to: &File) -> io::Result<()> {
    Ok(())
}

/// Returns false: Windows cannot exchange the names of two files.
pub(crate) fn exchange(_one: &Path, _other: &Path) -> io::Result<bool> {
    Ok(false)
}

/// Returns true if the full paths of `one` and `other`, with all links followed, are equal. Two names of one file by a
/// hard link are not detected.
///
/// # Errors
/// A path that does not exist.
pub(super) fn is_same_file(one: &Path, other: &Path) -> io::Result<bool> {
    Ok(one.canonicalize()? == other.canonicalize()?)
}

pub(super) fn readable_by_others(path: &Path) -> io::Result<Option<OpenToOthers>> {
    let others = regrind_windows::others_who_read(&File::open(path)?)?;
    let own_name = regrind_windows::own_name().unwrap_or_else(|_| "%USERNAME%".into());
    let open = || OpenToOthers {
        how: others.join(", "),
        remedy: format!("icacls \"{}\" /inheritance:r /grant:r \"{own_name}:F\"", path.display()),
    };
    Ok((!others.is_empty()).then(open))
}

/// Opens a file for reading.
pub(crate) fn open_to_read(path: &Path) -> io::Result<File> {
    File::open(path)
}

/// Returns false for every existing path. On Windows, programs communicate by named pipes, which are not entries of a
/// folder.
///
/// # Errors
/// No entry at `path`.
pub(crate) fn is_socket(path: &Path) -> io::Result<bool> {
    fs::symlink_metadata(path).map(|_| false)
}

/// Does nothing and returns `Ok`. On Windows, a program cannot flush a folder, and the file system itself protects the
/// names of files against a power failure.
pub(crate) fn sync_folder(_: &Path) -> io::Result<()> {
    Ok(())
}

/// Returns `None`: on Windows user identifiers are not numbers.
pub(super) fn user_name(_: u32) -> Option<String> {
    None
}
