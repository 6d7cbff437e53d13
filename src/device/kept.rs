//! What a driver keeps of jobs for a machine that knows of none, and that loses them with this program.

use std::sync::Arc;

use crate::words::{Armed, Job};

/// The jobs of such a machine; `Load` is what lies ready for the next one.
#[derive(Debug)]
pub(crate) struct Kept<Load> {
    /// What lies ready, and its digest.
    pub(crate) loaded: Option<(Arc<Load>, u32)>,
    /// The job of an interrupted run, of which nothing is here but its number.
    pub(crate) untold: Option<(Job, u32)>,
    /// The last job that was begun.
    pub(crate) begun: u32,
    /// Points of the present job that were told before its end.
    pub(crate) told_ahead: usize,
}

impl<Load> Kept<Load> {
    pub(crate) fn none() -> Self {
        Self { loaded: None, untold: None, begun: 0, told_ahead: 0 }
    }

    /// Takes in what an interrupted run had begun: it is not begun again, and nobody has told what became of it.
    pub(crate) fn restore(&mut self, intended: &Armed) {
        self.untold = Some((intended.job, intended.start_sequence));
        self.begun = self.begun.max(intended.start_sequence);
    }

    /// Returns what lies ready for a job. The cell prepares another only behind the end of what was untold.
    pub(crate) fn ready_for(&mut self, job: Job) -> Option<Arc<Load>> {
        self.untold = None;
        self.loaded.as_ref().filter(|(_, digest)| *digest == job.digest).map(|(load, _)| Arc::clone(load))
    }

    /// Numbers a job that is prepared. Such a machine has neither a word of a preparation nor a number of its own.
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
