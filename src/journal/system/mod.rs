//! File operations of the journal that differ between operating systems: one module for each system, with the same
//! functions.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub(super) use unix::*;
#[cfg(windows)]
pub(super) use windows::*;

/// Reason why other users can read or exchange an audit key, with the remedy.
pub(super) struct OpenToOthers {
    /// Reason why others have access.
    pub(super) how: String,
    /// Action that removes their access.
    pub(super) remedy: String,
}
