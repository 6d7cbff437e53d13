//! Files have lists of who may do what, folders bring their names to the disk themselves, devices and pipes are no files.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use super::OpenToOthers;

/// Makes a file that nobody but its owner may read, for writing.
pub(crate) fn create_owners(path: &Path) -> io::Result<File> {
    regrind_windows::create_owners_file(path)
}

/// By their full names: a second name of one file, a hard link, is not told.
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

/// Whether what is at a path is a socket; none is, for programs talk to each other by pipes, which lie in no folder.
pub(crate) fn is_socket(path: &Path) -> io::Result<bool> {
    fs::symlink_metadata(path).map(|_| false)
}

/// A port has the one name that the system gives it.
pub(crate) fn link_to(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// The file system keeps a journal of names itself; nobody else can bring a folder to the disk.
pub(crate) fn sync_folder(_: &Path) -> io::Result<()> {
    Ok(())
}

/// Users have identifiers there that are no numbers.
pub(super) fn user_name(_: u32) -> Option<String> {
    None
}
