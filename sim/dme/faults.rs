//! What goes wrong at a server of I++ DME.

use std::time::Duration;

/// Something that goes wrong with a command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It is acknowledged late.
    LateAcknowledgement(Duration),
    /// It is carried out, and never said to be over.
    NoCompletion,
    /// Its data come twice.
    Twice,
    /// Its data come byte for byte.
    Split,
    /// The fields of its data come in another order.
    Reordered,
    /// A quality comes that was not asked for.
    UnaskedQuality,
    /// Its data lack their parentheses.
    Garbled,
    /// Data of a command come that was never given.
    Stranger,
    /// The connection ends when it is carried out.
    Disconnect,
    /// AbortE is acknowledged, and nothing comes of it.
    AbortIgnored,
    /// Its error has another severity.
    Severity(u8),
    /// The stop circuit opens when it comes.
    EmergencyStop,
    /// It and all that follows take as long as at a real machine.
    InRealTime,
    /// The connection ends in the middle of a scan.
    CutInScan,
    /// A point of a scan is not said.
    PointLost,
    /// A point of a scan is said in the place of the one before it, and none is said for its last target.
    PointsShifted,
}

/// Faults at commands, by their names.
pub type Faults = crate::faults::Faults<String, Fault>;
