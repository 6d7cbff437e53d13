//! The numbers of PackML (ISA-TR88.00.02, OPC 30050) for states and modes.

use regrind_cell::StateName;

/// Mode of production.
pub(crate) const PRODUCTION: u32 = 1;
/// Mode of a cell with a simulated machine: the first number that PackML leaves to the builder of a machine.
pub(crate) const SIMULATION: u32 = 16;

/// Returns the number of a state in PackML (ISA-TR88.00.02).
pub(crate) fn state_number(state: StateName) -> u32 {
    match state {
        StateName::Stopped => 2,
        StateName::Starting => 3,
        StateName::Idle => 4,
        StateName::Suspended => 5,
        StateName::Execute => 6,
        StateName::Stopping => 7,
        StateName::Aborting => 8,
        StateName::Aborted => 9,
        StateName::Holding => 10,
        StateName::Held => 11,
        StateName::Unholding => 12,
        StateName::Suspending => 13,
        StateName::Unsuspending => 14,
        StateName::Completing => 16,
        StateName::Complete => 17,
    }
}
