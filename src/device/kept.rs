//! Job memory of a driver, for a machine that has no memory of jobs. The memory ends with this program.

use std::sync::Arc;

use crate::words::{Armed, Job};

/// Job memory; `Load` is the type of the payload that is loaded for the next job.
#[derive(Debug)]
pub(crate) struct Kept<Load> {
    /// Loaded payload and its digest.
    pub(crate) loaded: Option<(Arc<Load>, u32)>,
    /// Unresolved job of an interrupted run with its start number. Nothing else is known of it.
    pub(crate) untold: Option<(Job, u32)>,
    /// Number of the last start.
    pub(crate) begun: u32,
    /// Number of points of the present job that were reported before its end.
    pub(crate) told_ahead: usize,
}

impl<Load> Kept<Load> {
    pub(crate) fn none() -> Self {
        Self { loaded: None, untold: None, begun: 0, told_ahead: 0 }
    }

    /// Restores a job that an interrupted run had begun. It is not begun again, and its outcome is not reported yet.
    pub(crate) fn restore(&mut self, intended: &Armed) {
        self.untold = Some((intended.job, intended.start_sequence));
        self.begun = self.begun.max(intended.start_sequence);
    }

    /// Returns the payload that is loaded for a job and forgets the unresolved job. The cell prepares another job only
    /// after it has resolved that one.
    pub(crate) fn ready_for(&mut self, job: Job) -> Option<Arc<Load>> {
        self.untold = None;
        self.loaded.as_ref().filter(|(_, digest)| *digest == job.digest).map(|(load, _)| Arc::clone(load))
    }

    /// Returns the armed start of a prepared job, with the next start number. The machine has no token and no boot id,
    /// so both are 0.
    pub(crate) fn prepared(&mut self, job: Job) -> Armed {
        self.told_ahead = 0;
        Armed { job, start_sequence: self.begun + 1, token: 0, boot_id: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_begun_is_not_begun_again() {
        let job = Job { job: 7, cycle: 2, digest: 9 };
        let mut kept = Kept { loaded: Some((Arc::new("plan"), 9)), ..Kept::none() };
        assert_eq!(kept.prepared(job).start_sequence, 1);
        kept.restore(&Armed { job, start_sequence: 4, token: 0, boot_id: 0 });
        kept.restore(&Armed { job, start_sequence: 3, token: 0, boot_id: 0 });
        assert_eq!((kept.untold, kept.prepared(job).start_sequence), (Some((job, 3)), 5));
        assert_eq!(kept.ready_for(Job { digest: 8, ..job }), None);
        assert_eq!((kept.ready_for(job).as_deref(), kept.untold), (Some(&"plan"), None));
    }
}
