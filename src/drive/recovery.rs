//! Recovery of a machine that holds a job or result of no known run. A person who has seen the state of the machine
//! decides on each step. Each step is recorded before it is sent.

use std::time::Duration;

use thiserror::Error;
use tokio::time::Instant;

use super::recorder::nanoseconds;
use crate::cell::{Actor, Device};
use crate::device::{self, DeviceError, Fault, Machine, MachineState, Status};
use crate::journal::{Entry, Journal, JournalError};
use crate::record::{Answer, Content, RecoveryOrder};

/// Interval between two status reads of a machine in motion.
const STATUS_INTERVAL: Duration = Duration::from_millis(200);

/// Time after which a machine has certainly released a client that has died.
const OWNER_RELEASE_TIME: Duration = Duration::from_secs(10);
/// Interval between two attempts to claim the machine.
const CLAIM_RETRY_INTERVAL: Duration = Duration::from_millis(500);

/// Step that brings a machine nearer to idle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecoveryStep {
    /// End its job in order, or withdraw its preparation.
    Stop,
    /// Discard its result.
    Acknowledge,
    /// Leave ABORTED or FAULTED.
    Clear,
}

/// Reason why a machine was not recovered.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum RecoveryError {
    #[error(transparent)]
    Device(#[from] DeviceError),
    #[error(transparent)]
    Journal(#[from] JournalError),
    #[error(
        "the state of the {device} changed from {shown} to {found}, so no command was sent; check the machine again"
    )]
    Changed { device: Device, shown: String, found: String },
    #[error("the {device} is still {found} after {} s; check the machine, then run the command again", .limit.as_secs())]
    TimedOut { device: Device, found: MachineState, limit: Duration },
}

impl RecoveryStep {
    /// Returns the next step that brings a machine from `state` nearer to idle; `None` if it is idle. The step for a
    /// finished job is Acknowledge, for an aborted or faulted machine Clear, and otherwise Stop.
    pub fn for_state(state: MachineState) -> Option<Self> {
        match state {
            MachineState::Idle => None,
            MachineState::Complete => Some(Self::Acknowledge),
            MachineState::Aborted | MachineState::Faulted => Some(Self::Clear),
            _ => Some(Self::Stop),
        }
    }

    /// Returns the name of the step that a person confirms.
    pub fn name(self) -> &'static str {
        match self {
            Self::Stop => "STOP",
            Self::Acknowledge => "ACKNOWLEDGE",
            Self::Clear => "CLEAR",
        }
    }

    /// Returns a text for people about the effect of this step on `device`, including what is lost.
    pub fn consequence(self, device: Device) -> &'static str {
        match (self, device) {
            (Self::Stop, _) => {
                "ends the running job and leaves the machine clear of the part; if no job runs, cancels the prepared job"
            }
            (Self::Acknowledge, Device::Cmm) => {
                "discards the result of the CMM: a measurement that no run has collected is lost"
            }
            (Self::Acknowledge, Device::Grinder) => {
                "discards the result of the grinder: the part was ground with this pass, but no record will contain this pass"
            }
            (Self::Clear, _) => {
                "returns the machine to idle: first check that the machine is at rest and clear of the part, and find out why the machine was stopped"
            }
        }
    }
}

/// Connects to a machine and returns its status. Does not change the machine: the program writes only the heartbeat
/// that shows the machine that its client is alive.
///
/// # Errors
/// The machine cannot be reached, or its answer is invalid.
pub async fn read_status<M: Machine>(machine: &mut M) -> Result<Status, RecoveryError> {
    machine.connect().await?;
    Ok(machine.status().await?)
}

/// Sends one recovery step to a machine, waits until the machine is at rest, and returns its status. `seen` is the
/// status on which the person `by` decided. Sends nothing if the machine now has another status. `limit` is the maximum
/// time until the machine is at rest. Records the step in `journal` before it is sent, and its outcome afterwards.
///
/// # Errors
/// The machine cannot be reached, belongs to another client, has changed, refuses the step, or is not at rest within
/// the limit. Or a record cannot be written.
pub async fn execute_step<M: Machine>(
    machine: &mut M,
    device: Device,
    step: RecoveryStep,
    seen: &Status,
    limit: Duration,
    journal: &mut Journal,
    by: &Actor,
) -> Result<Status, RecoveryError> {
    let began = Instant::now();
    let found = read_status(machine).await?;
    if describe_status(&found) != describe_status(seen) {
        return Err(RecoveryError::Changed { device, shown: describe_status(seen), found: describe_status(&found) });
    }
    claim_with_retry(machine).await?;
    let entry =
        |content: Content| content.entry(nanoseconds(began.elapsed()), 0, (by.name.clone(), by.station.clone()));
    let order = RecoveryOrder { recover: step.name().to_owned(), device, seen: Some(describe_status(&found)) };
    let intent = journal.intend(entry(Content::Recovery(order)))?;
    let given = match step {
        RecoveryStep::Stop => machine.stop().await,
        RecoveryStep::Acknowledge => machine.acknowledge(found.done).await,
        RecoveryStep::Clear => machine.clear().await,
    };
    let ended = match given {
        Ok(status) => wait_until_at_rest(machine, device, status, limit).await,
        Err(error) => Err(error.into()),
    };
    let told = ended.as_ref().map_or_else(ToString::to_string, describe_status);
    journal.append(Entry { command_id: Some(intent), ..entry(Content::Answer(Answer::Found { found: told })) })?;
    // Optional: a machine whose owner is silent can be claimed by the next client.
    let _ = machine.release().await;
    ended
}

/// Makes this program the owner of the machine. If the machine still belongs to another client, tries again for up to
/// [`OWNER_RELEASE_TIME`]. If the other client has ended, the machine releases it within this time.
///
/// # Errors
/// The machine still belongs to another client after this time, or the request fails.
async fn claim_with_retry<M: Machine>(machine: &mut M) -> Result<(), DeviceError> {
    let by = Instant::now() + OWNER_RELEASE_TIME;
    loop {
        match machine.claim().await {
            Err(DeviceError::Refused { answer: device::Answer::NotOwner, .. }) if Instant::now() < by => {
                tokio::time::sleep(CLAIM_RETRY_INTERVAL).await;
            }
            claimed => return claimed.map(drop),
        }
    }
}

/// Returns a text with the state of a machine, its job, its fault, and the result of a finished job.
pub fn describe_status(status: &Status) -> String {
    let job = status.job.map_or(String::new(), |job| format!(" with {job}"));
    let fault = status.fault.filter(|fault| *fault != Fault::None).map_or(String::new(), |fault| format!(", {fault}"));
    let result =
        if status.state == MachineState::Complete { format!(", result {}", status.done) } else { String::new() };
    format!("{}{job}{fault}{result}", status.state)
}

/// Reads the status of a machine until it is at rest, and returns this status. Returns an error if the machine is still
/// in motion after `limit`.
async fn wait_until_at_rest<M: Machine>(
    machine: &mut M,
    device: Device,
    mut status: Status,
    limit: Duration,
) -> Result<Status, RecoveryError> {
    let by = Instant::now() + limit;
    while status.state.is_moving() {
        if Instant::now() > by {
            return Err(RecoveryError::TimedOut { device, found: status.state, limit });
        }
        tokio::time::sleep(STATUS_INTERVAL).await;
        status = machine.status().await?;
    }
    Ok(status)
}
