//! Outcome of a command, and the exit codes of the program.

/// Outcome of a successful command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    Accepted,
    NotInTolerance,
    /// The inspected run is active and has not ended.
    UnderWay,
}

/// Exit code for a failed check: a broken or incomplete record, a copy that differs from it, or unfinished work.
pub(super) const NOT_AS_IT_SHOULD_BE: u8 = 1;
/// Exit code for invalid arguments, recipe or data.
pub(super) const BAD_INPUT: u8 = 2;
/// Exit code for a fault of the machine or of the program.
pub(super) const FAULT: u8 = 3;
