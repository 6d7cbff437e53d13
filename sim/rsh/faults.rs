//! What goes wrong at linuxcncrsh.

use std::time::Duration;

/// Something that goes wrong with a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Nothing is done, and nothing answered.
    Lost,
    /// It is done, and not answered.
    Unanswered,
    /// It is done, and answered late.
    Late(Duration),
    /// Nothing is done, and it is refused.
    Refused,
    /// It is done, and refused.
    DoneAndRefused,
    /// Nothing is done, and it is acknowledged.
    Ignored,
    /// It is acknowledged, an error is reported, and what was there before stays.
    Fails,
    /// The connection ends, and nothing is done.
    CutBefore,
    /// It is done, and the connection ends.
    CutBehind,
    /// Lines come before the answer that answer nothing.
    Aside,
    /// What a program runs into a travel limit at that many thousandths of its lines.
    Limit(u32),
}

/// Faults at lines, by how they begin.
pub type Faults = crate::faults::Faults<String, Fault>;
