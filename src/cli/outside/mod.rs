//! What comes from outside of the program otherwise on one system than on another: what ends it, who is at its terminal, where it is. A
//! module for each system, with the same functions.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub(super) use unix::*;
#[cfg(windows)]
pub(super) use windows::*;

/// That the program is to end.
pub(super) struct Ending {
    /// By what, for the record.
    pub(super) by: &'static str,
    /// Whether its terminal was closed; that may be said twice.
    pub(super) hung_up: bool,
}
