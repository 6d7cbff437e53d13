//! File functions that differ between operating systems: one module each, with the same functions.

mod open_to_others;
#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

use std::path::Path;

#[cfg(unix)]
use unix as here;
#[cfg(windows)]
use windows as here;

pub(super) use here::{
    copy_access, create_owners, create_owners_folder, exchange, is_socket, open_to_read, sync_folder,
};
pub use open_to_others::OpenToOthers;

/// Returns the permission that lets users other than the owner read the file `path`, and the command that removes this
/// permission. Returns `None` if there is no such permission. On Unix, any permission of the group or of other users
/// counts.
///
/// # Errors
/// A file that does not exist, or whose permissions the system does not report.
pub fn readable_by_others(path: &Path) -> std::io::Result<Option<OpenToOthers>> {
    here::readable_by_others(path)
}

/// Returns true if both paths lead to the same file. Returns false if one of them does not exist.
pub fn is_same_file(one: &Path, other: &Path) -> bool {
    here::is_same_file(one, other).unwrap_or(false)
}

/// Returns the name of the user with the number `uid`. Returns `None` if the system has no list of users, or if the
/// list does not contain this user.
pub fn user_name(uid: u32) -> Option<String> {
    here::user_name(uid)
}
