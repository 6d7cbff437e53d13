//! Translation of the answers of a machine into the words of the cell.

use crate::cell::{ConnectionRefusal, Device, GateFailure, JobResult};
use crate::device::{DeviceError, Fault, Outcome, Status};

/// Describes the state and job of a machine.
pub(super) fn describe_job(status: &Status) -> String {
    match status.job {
        Some(job) => format!("{} with {job}", status.state),
        None => status.state.to_string(),
    }
}

pub(super) fn job_result(outcome: Outcome) -> JobResult {
    match outcome {
        Outcome::Complete => JobResult::Complete,
        Outcome::Stopped => JobResult::Stopped,
        Outcome::Aborted => JobResult::Aborted,
        // No outcome, failed, or an unknown one.
        _ => JobResult::Failed,
    }
}

/// Returns the text of a fault for people. For a collision of the probe, the text tells a person to check the position
/// of the part first.
pub(super) fn fault_message(device: Device, fault: Fault) -> String {
    match (device, fault) {
        // A probe that meets material where only air should be is not at fault: the part is in another place.
        (Device::Cmm, Fault::Collision) => {
            "the probe touched material where the plan expects only air: check the position of the part. Is this the right \
             part, in the right seat, and not turned? Check the probe, then clear the fault of the machine"
                .to_owned()
        }
        (_, fault) => fault.to_string(),
    }
}

/// Returns the failure of the gate (the check whether a measurement can be used) if a measurement arrived, but its data
/// are invalid or belong to another job. Returns `None` for every other error.
pub(super) fn gate_failure(error: &DeviceError) -> Option<GateFailure> {
    match error {
        DeviceError::NotFinite { .. }
        | DeviceError::OutOfRange { .. }
        | DeviceError::Unlisted { .. }
        | DeviceError::WrongCount { .. } => Some(GateFailure::Broken(error.to_string())),
        DeviceError::Mismatch { .. } => Some(GateFailure::Foreign(error.to_string())),
        _ => None,
    }
}

pub(super) fn mismatch(error: &DeviceError) -> ConnectionRefusal {
    let message = error.to_string();
    match error {
        DeviceError::WrongWordOrder { .. } => ConnectionRefusal::WordOrder(message),
        DeviceError::WrongLengthUnit { .. } => ConnectionRefusal::Inches,
        DeviceError::Refused { answer: crate::device::Answer::NotOwner, .. } => ConnectionRefusal::Owned(message),
        error if error.is_link() => ConnectionRefusal::Unreachable(message),
        _ => ConnectionRefusal::WrongDevice(message),
    }
}
