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

/// Steps by which the priority of a program is lowered that works beside the programs of this computer.
#[cfg(feature = "plant")]
pub(super) const BACKGROUND_STEPS: i32 = 10;
/// Steps to the lowest priority of a program.
#[cfg(unix)]
const LOWEST_STEPS: i32 = 19;
