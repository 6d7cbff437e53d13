//! Machines without a wire: a folder that takes hand-overs, a folder that gives answers, and a person between.
//!
//! The states are those of a wire, so that whoever drives a cell sees no difference:
//!
//! ```text
//!  PREPARE  the payload is checked; nothing is in the folder yet
//!  START    the hand-over appears, whole, by one rename; at most once for a job and cycle        -> EXECUTE
//!  EXECUTE  waiting; every status looks at the folder
//!  HOLD     the hand-over is taken back -> HELD;  RESUME  it is put there again -> EXECUTE
//!  STOP     it is taken back for good -> COMPLETE, stopped;   ABORT  likewise -> ABORTED
//!  COMPLETE a result was accepted; ACKNOWLEDGE closes the hand-over                               -> IDLE
//! ```
//!
//! What was handed over stays in the folder under a name that tells what became of it. That is the memory by which a restarted client
//! learns whether a start was taken, and by which a job and cycle is never handed over twice. **Taking a hand-over back stops no
//! machine**: once a person has begun the job, only that person can stop it, and the notes say so.
//!
//! A hand-over is a folder that appears whole; a result is taken when it has stopped growing, has an end, and says, by its name or in
//! itself, that it belongs to this part and this cycle; what does not belong is left where it is, and said. The files themselves are read
//! and written behind [`Exchange`].

mod cmm;
mod dmis;
mod error;
mod grinder;
mod hand_over;
mod machine;
mod measured;
mod outbox;
mod pattern;
mod settings;
mod stations;
mod watch;

pub(super) use cmm::plan_csv;
pub use cmm::{CmmExchange, CmmFolders, StationFiles, Stations};
pub use error::ExchangeError;
pub use grinder::{GrinderExchange, GrinderFolders};
pub use hand_over::{Confirmed, Exchange, HandOver, Look, Permit, Standing};
pub use machine::ExchangeMachine;
pub use measured::{Wanted, check_measurement, foreign, measurement};
pub use pattern::{Pattern, file_word};
pub use settings::{ExchangeWire, StationTable};
pub use stations::{PlacedStation, place_station};
pub use watch::Watch;

use crate::{CorrectionMap, Pass, Plan};

/// What a grinder is handed.
#[derive(Debug, Clone, PartialEq)]
pub struct GrindOrder {
    /// The map.
    pub map: CorrectionMap,
    /// How to grind.
    pub pass: Pass,
    /// The identity of the map.
    pub map_identity: [u8; 32],
}

/// What a measuring machine is handed.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasureOrder {
    /// The plan.
    pub plan: Plan,
    /// Its identity.
    pub plan_identity: [u8; 32],
}
