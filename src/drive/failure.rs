//! Words for failures of tasks and of the record.

use tokio::task::JoinError;

use crate::cell::RecordFailure;

/// Returns the message of a task that panicked.
pub(super) fn panic_message(error: JoinError) -> String {
    let Ok(panic) = error.try_into_panic() else { return "the task was cancelled".into() };
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no further information".into())
}

pub(super) fn failure_message(failure: &RecordFailure) -> String {
    match failure {
        RecordFailure::DiskFull(message) | RecordFailure::Unwritable(message) => message.clone(),
    }
}
