//! What one system does otherwise than another with the files of a record: a module each, with the same functions.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub(super) use unix::*;
#[cfg(windows)]
pub(super) use windows::*;

/// That others may read an audit key.
pub(super) struct OpenToOthers {
    /// What lets them.
    pub(super) how: String,
    /// What takes it from them.
    pub(super) remedy: String,
}
