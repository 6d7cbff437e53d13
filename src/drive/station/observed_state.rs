//! State of a machine as its station has seen it.

use tokio::time::Instant;

use crate::device::MachineState;

/// State that the last status read showed, so that only changes are reported.
#[derive(Default)]
pub(super) struct ObservedState {
    pub(super) connected: bool,
    pub(super) link_lost: bool,
    pub(super) state: Option<MachineState>,
    pub(super) progress: Option<(u32, u32)>,
    pub(super) progress_reported_at: Option<Instant>,
    pub(super) supplies_missing: bool,
    pub(super) manual: bool,
    /// True if the machine reported that it was clear of the part; `None` if it does not report this.
    pub(super) clear: Option<bool>,
    /// True if a signal of the cell file is outside its range (`signal_out_of_range`). While this is true,
    /// `signals_good_since` is the time since which all signals have been within their ranges again.
    pub(super) signal_out_of_range: bool,
    pub(super) signals_good_since: Option<Instant>,
    pub(super) aborting: bool,
    pub(super) stopping: bool,
    pub(super) clearing: bool,
    /// True if the end of the running job was reported.
    pub(super) end_reported: bool,
    /// True if a START was sent and the end of its job has not been reported.
    pub(super) running: bool,
    pub(super) next_attempt: Option<Instant>,
    pub(super) attempts: u32,
    /// Time at which the link last came back.
    pub(super) reconnected_at: Option<Instant>,
    /// True if the machine has reported the job since START was sent or since the job was reconciled.
    pub(super) at_job: bool,
    /// Number of status reads in a row without the job.
    pub(super) reads_without_job: u32,
    /// Number of status reads in which the progress had increased although the machine reports HELD.
    pub(super) progress_rises_at_held: u32,
    /// Time at which the machine accepted STOP.
    pub(super) stop_accepted_at: Option<Instant>,
}
