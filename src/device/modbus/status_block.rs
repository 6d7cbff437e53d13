//! Status block of a machine, all of one moment, and the numbers of its states and answers.

use crate::{Answer, Fault, Job, MachineState, Outcome, Status, range};

/// Values of the status block of docs/modbus.md that this program uses, all of one moment.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct StatusBlock {
    pub(super) state: MachineState,
    /// True in automatic mode, false in manual mode.
    pub(super) automatic: bool,
    /// Bits from bit 0: guards closed, clear of the part, part clamped, supplies present.
    pub(super) interlocks: u16,
    /// Sequence number of the last command that the machine acted upon; `answer` is its answer.
    pub(super) acknowledged: u32,
    pub(super) answer: Answer,
    pub(super) fault: Fault,
    /// Job that is prepared, running or finished.
    pub(super) job: Option<Job>,
    /// Token of the prepared job; 0 if there is none.
    pub(super) token: u32,
    /// Sequence number of the START whose job ended last, 0 if there is none; `outcome` is the outcome of that job.
    pub(super) done: u32,
    pub(super) outcome: Outcome,
    pub(super) progress: (u32, u32),
    /// Owner; 0 if nobody owns the machine.
    pub(super) owner: u32,
    pub(super) epoch: u32,
    /// Heartbeat of the machine.
    pub(super) beat: u16,
    /// Job and cycle that were begun last; the machine keeps them over its restart.
    pub(super) last_begun: (u32, u16),
    /// Sequence number of the START that began the running or last job; 0 if there is none.
    pub(super) begun_by: u32,
    /// Temperature in °C; `None` if the machine has no thermometer.
    pub(super) temperature_c: Option<f64>,
    pub(super) boot_id: u32,
}

impl From<&StatusBlock> for Status {
    fn from(block: &StatusBlock) -> Self {
        let good = |bit: u16| Some(block.interlocks & (1 << bit) != 0);
        let (temperature_c, progress, signals) = range::plausible_status(block.temperature_c, block.progress);
        Self {
            state: block.state,
            job: block.job,
            done: block.done,
            outcome: block.outcome,
            clear_of_part: good(1),
            supplies: good(3),
            automatic: Some(block.automatic),
            fault: Some(block.fault),
            progress,
            temperature_c,
            boot_id: Some(block.boot_id),
            signals,
        }
    }
}

impl From<StatusBlock> for Status {
    fn from(block: StatusBlock) -> Self {
        Self::from(&block)
    }
}

pub(super) fn decode_state(number: u16) -> Option<MachineState> {
    const STATES: [MachineState; 10] = [
        MachineState::Idle,
        MachineState::Prepared,
        MachineState::Execute,
        MachineState::Holding,
        MachineState::Held,
        MachineState::Stopping,
        MachineState::Complete,
        MachineState::Aborting,
        MachineState::Aborted,
        MachineState::Faulted,
    ];
    STATES.get(usize::from(number).checked_sub(1)?).copied()
}

pub(super) fn decode_answer(number: u16) -> Answer {
    match number {
        0 => Answer::None,
        1 => Answer::Accepted,
        2 => Answer::NotOwner,
        3 => Answer::WrongState,
        4 => Answer::UnknownCommand,
        5 => Answer::DeadToken,
        6 => Answer::OtherJob,
        7 => Answer::AlreadyBegun,
        8 => Answer::PayloadMissing,
        9 => Answer::InterlockOpen,
        10 => Answer::OutsideLimits,
        11 => Answer::OtherResult,
        other => Answer::Unlisted(other),
    }
}
