//! Outcome of a successful command.

/// Outcome of a successful command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    Accepted,
    NotInTolerance,
    /// The inspected run is active and has not ended.
    UnderWay,
}
