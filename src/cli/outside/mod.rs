//! System-dependent events and information from outside the program: what ends it, who uses its terminal, where it
//! runs. Each system has its own module with the same functions.

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub(super) use unix::*;
#[cfg(windows)]
pub(super) use windows::*;

/// Request to end the program.
pub(super) struct Ending {
    /// Source of the request, for the record.
    pub(super) by: &'static str,
    /// True if the terminal was closed. This event can arrive twice.
    pub(super) hung_up: bool,
}
