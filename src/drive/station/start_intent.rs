//! Intent of a START in the record, from a prepared job and back.

use crate::device::{Armed, Job};
use crate::record::StartIntent;

/// Converts a prepared job into the intent of its START, as the journal stores it.
pub(super) fn start_intent(armed: &Armed) -> StartIntent {
    let Armed { job: Job { job, cycle, digest }, start_sequence, token, boot_id } = *armed;
    StartIntent { job, cycle, digest, start_sequence, token, boot_id }
}

/// Converts a recorded intent of a START into the data of the prepared job that a driver uses, for example to reconcile
/// the job.
pub(in super::super) fn prepared_job(intent: StartIntent) -> Armed {
    let job = Job { job: intent.job, cycle: intent.cycle, digest: intent.digest };
    Armed { job, start_sequence: intent.start_sequence, token: intent.token, boot_id: intent.boot_id }
}
