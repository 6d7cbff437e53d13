//! Machines without a wire: a folder for hand-overs, a folder for answers, and a person between them.
//!
//! The states are those of a machine with a wire, so that the code of a cell sees no difference:
//!
//! ```text
//!  PREPARE  the payload is checked; nothing is in the folder yet
//!  START    the hand-over appears, whole, by one rename; at most once for a job and cycle        -> EXECUTE
//!  EXECUTE  waiting; every status looks at the folder
//!  HOLD     the hand-over is withdrawn -> HELD;  RESUME  it is published again -> EXECUTE
//!  STOP     it is withdrawn permanently -> COMPLETE, stopped;   ABORT  likewise -> ABORTED
//!  COMPLETE a result was accepted; ACKNOWLEDGE closes the hand-over                               -> IDLE
//! ```
//!
//! A hand-over stays in the folder under a name that shows its status. From this name, a restarted client learns if a
//! start was accepted, and it prevents a second hand-over of the same job and cycle. **Withdrawing a hand-over stops no
//! machine**: once a person has begun the job, only that person can stop it, and the notes say so.
//!
//! A hand-over is a folder that appears as a whole. A result is accepted when it no longer grows, has an end, and
//! states, by its name or in its content, that it belongs to this part and this cycle. Any other file is left in place
//! and reported in the notes. The trait [`Exchange`] reads and writes the files themselves.

mod cmm;
mod dmis;
mod error;
mod grinder;
mod hand_over;
mod machine;
mod outbox;
mod pattern;
mod result_requirements;
mod settings;
mod stations;
mod watch;

pub(super) use cmm::plan_csv;
pub use cmm::{CmmExchange, CmmFolders, StationFiles, Stations};
pub use error::ExchangeError;
pub use grinder::{GrinderExchange, GrinderFolders};
pub use hand_over::{ConfirmedStep, Exchange, HandOver, HandOverStatus, Permit, PollResult};
pub use machine::ExchangeMachine;
pub use pattern::{Pattern, file_word};
pub use result_requirements::{ResultRequirements, assemble_measurement, check_measurement, contradiction};
pub use settings::{ExchangeWire, StationTable};
pub use stations::{PlacedStation, place_station};
pub use watch::Watch;

use crate::{CorrectionMap, Pass, Plan};

/// Request to a grinder.
#[derive(Debug, Clone, PartialEq)]
pub struct GrindOrder {
    /// Correction map.
    pub map: CorrectionMap,
    /// Parameters of the pass.
    pub pass: Pass,
    /// Identity of the map.
    pub map_identity: [u8; 32],
}

/// Request to a measuring machine.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasureOrder {
    /// Measuring plan.
    pub plan: Plan,
    /// Identity of the plan.
    pub plan_identity: [u8; 32],
}
