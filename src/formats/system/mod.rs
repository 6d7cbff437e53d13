//! What one system does otherwise than another with files: a module each, with the same functions.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

use std::path::Path;

#[cfg(unix)]
use unix as here;
#[cfg(windows)]
use windows as here;

pub(super) use here::{create_owners, is_socket, link_to, open_to_read, sync_folder};

/// That others than its owner may read a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenToOthers {
    /// What lets them.
    pub how: String,
    /// The command that takes it from them.
    pub remedy: String,
}

/// Says how others than its owner may read a file, and what to do about it; none where they may not.
///
/// # Errors
/// A file that is not there, or of which the system does not tell it.
pub fn readable_by_others(path: &Path) -> std::io::Result<Option<OpenToOthers>> {
    here::readable_by_others(path)
}

/// Returns whether two names are those of one file that is there.
pub fn is_same_file(one: &Path, other: &Path) -> bool {
    here::is_same_file(one, other).unwrap_or(false)
}

/// Returns the name of a user whom the system knows by a number; none where it has no such list.
pub fn user_name(uid: u32) -> Option<String> {
    here::user_name(uid)
}
