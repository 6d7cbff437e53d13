//! Questions about a phase: where to restart it, which machine it concerns, and which answer it awaits.

use super::event::MachineRequest;
use super::state::{Device, JobStep, Phase, State};

use State::{Execute, Holding, Suspending, Unholding, Unsuspending};

/// Returns the phase from which to restart `phase` after an interruption. At the steps Clear, Prepare and Start of a
/// job, this is the step Send of the same job. In all other cases, it is `phase` itself.
pub(super) fn restart_phase(phase: Phase) -> Phase {
    match phase.job() {
        Some((device, JobStep::Clear | JobStep::Prepare | JobStep::Start)) => Phase::from_job(device, JobStep::Send),
        _ => phase,
    }
}

/// Returns the phase from which to restart `phase` after a lost link or a restart of the program. If a machine may be
/// moving, this is the step Reconcile of its job; otherwise it is the result of [`restart_phase`].
pub(super) fn phase_after_link_loss(phase: Phase) -> Phase {
    match phase.moving_device() {
        Some(device) => Phase::from_job(device, JobStep::Reconcile),
        None => restart_phase(phase),
    }
}

/// Returns the machine whose result this phase acknowledges or discards; `None` for any other phase.
pub(super) fn device_awaiting_acknowledge(phase: Phase) -> Option<Device> {
    phase.job().filter(|(_, step)| matches!(step, JobStep::Acknowledge | JobStep::Discard)).map(|(device, _)| device)
}

/// Returns true if `phase` waits for the answer of the machine `device` to the request `what`. Returns false if `phase`
/// is not a job of this machine.
pub(super) fn awaits_answer(phase: Phase, device: Device, what: MachineRequest) -> bool {
    let steps: &[JobStep] = match what {
        MachineRequest::Load => &[JobStep::Send],
        MachineRequest::Prepare => &[JobStep::Prepare],
        MachineRequest::Start => &[JobStep::Start],
        MachineRequest::Collect => &[JobStep::Collect],
        MachineRequest::Acknowledge | MachineRequest::Discard => &[JobStep::Acknowledge, JobStep::Discard],
        MachineRequest::Hold
        | MachineRequest::Resume
        | MachineRequest::Stop
        | MachineRequest::Abort
        | MachineRequest::Clear => &[],
    };
    phase.job().is_some_and(|(job, step)| job == device && steps.contains(&step))
}

/// Returns the machine that may be moving in the phase of `state`; `None` if no machine may.
pub(super) fn running_device(state: State) -> Option<Device> {
    state.phase().and_then(Phase::moving_device)
}

/// Returns the machine that the cell is asking for the unknown state of its job (step Reconcile). Returns `None` in any
/// other phase, and also while the cell is held or suspended.
pub(super) fn reconciling_device(state: State) -> Option<Device> {
    match state {
        Execute(phase) | Holding(phase) | Suspending(phase) | Unsuspending(phase) | Unholding(phase) => {
            phase.job().filter(|(_, step)| *step == JobStep::Reconcile).map(|(device, _)| device)
        }
        _ => None,
    }
}
