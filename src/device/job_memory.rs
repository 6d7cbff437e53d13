//! Job memory of a driver, for a machine that has no memory of jobs. The memory ends with this program.

use std::sync::Arc;

use crate::handshake::{Armed, Job};

/// Job memory; `Load` is the type of the payload that is loaded for the next job.
#[derive(Debug)]
pub(crate) struct JobMemory<Load> {
    /// Loaded payload and its digest.
    pub(crate) loaded: Option<(Arc<Load>, u32)>,
    /// Unresolved job of an interrupted run with its start number. Nothing else is known of it.
    pub(crate) unresolved: Option<(Job, u32)>,
    /// Number of the last start.
    pub(crate) last_start_sequence: u32,
    /// Number of points of the present job that were reported before its end.
    pub(crate) reported_points: usize,
}

impl<Load> JobMemory<Load> {
    pub(crate) fn new() -> Self {
        Self { loaded: None, unresolved: None, last_start_sequence: 0, reported_points: 0 }
    }

    /// Stores the job and the start number of `intended`, the start that an interrupted run had sent. Does not start
    /// the job again. The job becomes unresolved, which means that its outcome is not known. The next start gets a
    /// number above the start number of `intended`.
    pub(crate) fn restore(&mut self, intended: &Armed) {
        self.unresolved = Some((intended.job, intended.start_sequence));
        self.last_start_sequence = self.last_start_sequence.max(intended.start_sequence);
    }

    /// Returns the loaded payload if its digest equals the digest in `job`. Returns `None` if no payload is loaded or
    /// if the digest differs. Also deletes the unresolved job, because the cell prepares a new job only after the
    /// outcome of the old job is known.
    pub(crate) fn payload_for(&mut self, job: Job) -> Option<Arc<Load>> {
        self.unresolved = None;
        self.loaded.as_ref().filter(|(_, digest)| *digest == job.digest).map(|(load, _)| Arc::clone(load))
    }

    /// Creates the [`Armed`] of `job`: the prepared job with the sequence number of its start. This number is one above
    /// the number of the last start. The one-time token and the boot id are 0, because a machine without a memory of
    /// jobs has neither. Also sets the number of already reported points to 0.
    pub(crate) fn arm(&mut self, job: Job) -> Armed {
        self.reported_points = 0;
        Armed { job, start_sequence: self.last_start_sequence + 1, token: 0, boot_id: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn job_memory_restores_unresolved() {
        let job = Job { job: 7, cycle: 2, digest: 9 };
        let mut kept = JobMemory { loaded: Some((Arc::new("plan"), 9)), ..JobMemory::new() };
        assert_eq!(kept.arm(job).start_sequence, 1);
        kept.restore(&Armed { job, start_sequence: 4, token: 0, boot_id: 0 });
        kept.restore(&Armed { job, start_sequence: 3, token: 0, boot_id: 0 });
        assert_eq!((kept.unresolved, kept.arm(job).start_sequence), (Some((job, 3)), 5));
        assert_eq!(kept.payload_for(Job { digest: 8, ..job }), None);
        assert_eq!((kept.payload_for(job).as_deref(), kept.unresolved), (Some(&"plan"), None));
    }
}
