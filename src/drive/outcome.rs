//! Mapping of events to the commands that they answer, so that the journal shows the outcome of each command.

use crate::cell::{Command, Device, Event, MachineRequest, Reconciliation};

/// Returns true if `event` is the answer to `command`. The reconciliation of a START (the question to the machine
/// whether it executes the job) is an answer only if its outcome is known. Otherwise the START stays without an answer.
pub(super) fn answers(event: &Event, command: &Command) -> bool {
    use Command as C;
    use Event as E;
    match (command, event) {
        (C::AskToLoad, E::LoadConfirmed { .. }) => true,
        (C::Connect { device } | C::ClearMachine { device }, E::Connected { device: d, .. }) => device == d,
        (C::Connect { device }, E::NotConnected { device: d, .. }) => device == d,
        (C::LoadPass { cycle }, E::PassLoaded { cycle: c }) => cycle == c,
        (C::LoadPlan { cycle }, E::PlanLoaded { cycle: c }) => cycle == c,
        (
            C::VerifyClear { device },
            E::Cleared { device: d } | E::Obstructed { device: d, .. } | E::ClearUnknown { device: d },
        ) => device == d,
        (C::AskWhetherClear { device }, E::ClearConfirmed { device: d, .. }) => device == d,
        (C::Prepare { device, .. }, E::Prepared { device: d, .. }) => device == d,
        (C::StartMachine { device, cycle }, E::Started { device: d, cycle: c }) => device == d && cycle == c,
        // An unknown outcome leaves the command open.
        (C::StartMachine { .. }, E::Reconciled { outcome: Reconciliation::Unknown(_), .. }) => false,
        (C::StartMachine { device, cycle }, E::Reconciled { device: d, cycle: c, .. }) => device == d && cycle == c,
        (C::StartMachine { device, .. }, E::DeclaredOver { device: d, .. }) => device == d,
        (C::HoldMachine { device }, E::MachineHeld { device: d } | E::Ended { device: d, .. }) => device == d,
        (C::ResumeMachine { device }, E::MachineResumed { device: d } | E::Ended { device: d, .. }) => device == d,
        (C::StopMachine { device }, E::Ended { device: d, .. }) => device == d,
        (C::AbortMachine { device }, E::AbortConfirmed { device: d }) => device == d,
        (C::Reconcile { device, cycle }, E::Reconciled { device: d, cycle: c, .. }) => device == d && cycle == c,
        (C::Collect { cycle }, E::Collected { cycle: c, .. }) => cycle == c,
        (C::Collect { cycle } | C::Register { cycle } | C::Compensate { cycle }, E::NotSaved { cycle: c, .. }) => {
            cycle == c
        }
        (C::Qualify { cycle }, E::Qualified { cycle: c, .. }) => cycle == c,
        (C::Acknowledge { device }, E::Acknowledged { device: d }) => device == d,
        (C::Register { cycle }, E::Registered { cycle: c, .. } | E::RegistrationFailed { cycle: c, .. }) => cycle == c,
        (C::Compensate { cycle }, E::Compensated { cycle: c, .. } | E::CompensationRefused { cycle: c, .. }) => {
            cycle == c
        }
        (C::Acknowledge { device }, E::Refused { device: d, request: MachineRequest::Discard, .. }) => device == d,
        (command, E::NotOnRecord { command: name }) => command.name() == *name,
        (command, E::Refused { device, request, .. }) => machine_request(command) == Some((*device, *request)),
        _ => false,
    }
}

/// Returns the machine to which `command` is sent, and the kind of this request. If the machine refuses the request,
/// [`Event::Refused`] contains the same machine and the same kind, so that the refusal can be assigned to the command.
/// Returns `None` for a command that no machine can refuse.
fn machine_request(command: &Command) -> Option<(Device, MachineRequest)> {
    Some(match command {
        Command::LoadPass { .. } => (Device::Grinder, MachineRequest::Load),
        Command::LoadPlan { .. } => (Device::Cmm, MachineRequest::Load),
        Command::Prepare { device, .. } => (*device, MachineRequest::Prepare),
        Command::StartMachine { device, .. } => (*device, MachineRequest::Start),
        Command::HoldMachine { device } => (*device, MachineRequest::Hold),
        Command::ResumeMachine { device } => (*device, MachineRequest::Resume),
        Command::StopMachine { device } => (*device, MachineRequest::Stop),
        Command::AbortMachine { device } => (*device, MachineRequest::Abort),
        Command::ClearMachine { device } => (*device, MachineRequest::Clear),
        Command::Collect { .. } => (Device::Cmm, MachineRequest::Collect),
        Command::Acknowledge { device } => (*device, MachineRequest::Acknowledge),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_matches_start_outcome() {
        let start = Command::StartMachine { device: Device::Grinder, cycle: 2 };
        let by = |event: Event| answers(&event, &start);
        assert!(by(Event::Started { device: Device::Grinder, cycle: 2 }));
        assert!(!by(Event::Started { device: Device::Grinder, cycle: 1 }));
        assert!(!by(Event::Started { device: Device::Cmm, cycle: 2 }));
        assert!(!by(Event::StartUnknown { device: Device::Grinder, cycle: 2, reason: String::new() }));
        let refused = |request| Event::Refused { device: Device::Grinder, request, reason: String::new() };
        assert!(by(refused(MachineRequest::Start)) && !by(refused(MachineRequest::Prepare)));
    }
}
