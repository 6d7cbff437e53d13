//! Faults of linuxcncrsh.

use std::time::Duration;

/// Fault of a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The line is not carried out and not answered.
    Lost,
    /// The line is carried out, and not answered.
    Unanswered,
    /// The line is carried out, and answered late.
    Late(Duration),
    /// The line is not carried out, and is refused.
    Refused,
    /// The line is carried out, and is refused.
    DoneAndRefused,
    /// The line is not carried out, and is acknowledged.
    Ignored,
    /// The line is acknowledged, an error is reported, and the state before stays.
    Fails,
    /// The connection ends, and the line is not carried out.
    CutBefore,
    /// The line is carried out, and the connection ends.
    CutAfter,
    /// Lines that answer nothing come before the answer.
    UnmatchedLines,
    /// The program reaches a travel limit at this share of its lines, in thousandths.
    Limit(u32),
}

/// Faults by the beginning of the line.
pub type LineFaults = crate::pending_faults::PendingFaults<String, Fault>;
