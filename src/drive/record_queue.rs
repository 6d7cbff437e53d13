//! Entries of a run that wait to be recorded, and the action that follows each of them.

use std::collections::VecDeque;

use regrind_control::Reply;
use tokio::sync::oneshot;

use super::recorder::{RecordReceipt, Recorder};
use crate::cell::{Command, Device, RecordFailure};
use crate::device::OperatorConfirmation;

/// Record of a run, as the loop uses it.
pub(super) struct RunRecord {
    pub(super) recorder: Recorder,
    /// Commands without an answering event so far, by the numbers of the recorder.
    pub(super) open_commands: Vec<(u64, Command)>,
    /// Entries that wait to be recorded, in order.
    pub(super) backlog: VecDeque<PendingRecord>,
    /// Reason why nothing can be recorded at present; `None` if records are written.
    pub(super) failure_reason: Option<String>,
}

impl RunRecord {
    /// Creates the record of a run that writes with `recorder`. `open` are the commands without an outcome, in the order
    /// in which the recorder got their numbers.
    pub(super) fn new(recorder: Recorder, open: Vec<Command>) -> Self {
        Self { recorder, open_commands: (1..).zip(open).collect(), backlog: VecDeque::new(), failure_reason: None }
    }

    /// Adds an entry to the queue. `action` follows when `receipt` completes.
    pub(super) fn queue(&mut self, receipt: RecordReceipt, action: RecordAction) {
        self.backlog.push_back(PendingRecord { receipt, action });
    }
}

/// Record that is not yet written, and the action that follows it.
pub(super) struct PendingRecord {
    pub(super) receipt: RecordReceipt,
    pub(super) action: RecordAction,
}

pub(super) enum RecordAction {
    Nothing,
    Execute(Box<Command>),
    Answer { answer: oneshot::Sender<Reply>, accepted: bool, message: String },
    Confirm { device: Device, confirmation: OperatorConfirmation, answer: oneshot::Sender<Result<(), String>> },
}

/// Waits until the first entry of the queue is recorded, and returns the result. Returns an error if the entry cannot
/// be recorded, or if the journal writer has ended. Never returns if the queue is empty.
pub(super) async fn wait_for_first_record(backlog: &mut VecDeque<PendingRecord>) -> Result<(), RecordFailure> {
    match backlog.front_mut() {
        Some(next) => (&mut next.receipt).await.unwrap_or_else(|_| {
            Err(RecordFailure::Unwritable(
                "the journal writer of Regrind has stopped, so nothing can be recorded; report this fault".into(),
            ))
        }),
        None => std::future::pending().await,
    }
}

/// Returns true for a command that is executed at once, before it is recorded: it brings machines to rest, only reads a
/// status, informs people, or ends the run.
pub(super) fn is_immediate(command: &Command) -> bool {
    matches!(
        command,
        Command::HoldMachine { .. }
            | Command::StopMachine { .. }
            | Command::AbortMachine { .. }
            | Command::VerifyClear { .. }
            | Command::Raise(_)
            | Command::Withdraw { .. }
            | Command::Refuse { .. }
            | Command::Finish(_)
    )
}
