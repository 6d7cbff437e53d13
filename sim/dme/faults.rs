//! Faults of a server of I++ DME.

use std::time::Duration;

/// Fault of a command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The acknowledgement is late.
    LateAcknowledgement(Duration),
    /// The command is carried out, and its completion is never sent.
    NoCompletion,
    /// The data come twice.
    Twice,
    /// The data come byte by byte.
    Split,
    /// The fields of the data come in another order.
    Reordered,
    /// The data contain a quality that was not requested.
    UnaskedQuality,
    /// The data lack their parentheses.
    Garbled,
    /// Data come for a command that was never sent.
    Stranger,
    /// The connection ends when the command is carried out.
    Disconnect,
    /// AbortE is acknowledged, and has no effect.
    AbortIgnored,
    /// The error has another severity.
    Severity(u8),
    /// The stop circuit opens when the command arrives.
    EmergencyStop,
    /// This command and all later ones take as long as at a real machine.
    InRealTime,
    /// The connection ends in the middle of a scan.
    CutInScan,
    /// A point of a scan is not sent.
    PointLost,
    /// Each point of a scan is sent as the point of the target before it, and the last target gets none.
    PointsShifted,
}

/// Faults by the names of commands.
pub type CommandFaults = crate::pending_faults::PendingFaults<String, Fault>;
