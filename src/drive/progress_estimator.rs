//! Progress of the job that runs, and estimate of its remaining time.

use std::collections::VecDeque;
use std::time::Duration;

use regrind_control::JobProgress;

use crate::cell::{Device, JobStep, State};

/// Minimum observation time of a pace before it is shown.
const MIN_OBSERVATION_TIME: Duration = Duration::from_millis(500);
/// Maximum number of stored marks. The latest quarter of them determines the present pace.
const MAX_MARKS: usize = 32;

/// Progress of the job that runs.
#[derive(Debug, Default)]
pub(super) struct ProgressEstimator {
    job: Option<(Device, u32)>,
    done_and_total: (u32, u32),
    /// Times and progress since the job last began to move.
    marks: VecDeque<(Duration, u32)>,
}

impl ProgressEstimator {
    /// Stores a progress report of a job: `done` of `total` steps at the time `now` since the run began. `job` is the
    /// machine and the number of the cycle. If the job is a new one or `done` decreases, forgets the earlier reports.
    pub(super) fn record_progress(&mut self, now: Duration, job: (Device, u32), done: u32, total: u32) {
        if self.job.replace(job) != Some(job) || done < self.done_and_total.0 {
            self.marks.clear();
        }
        self.done_and_total = (done, total);
        if self.marks.len() == MAX_MARKS {
            // Drop every other mark, but keep the first and the last. The marks still reach back to the beginning, at
            // half the density.
            let mut index = 0;
            self.marks.retain(|_| {
                index += 1;
                index == 1 || index % 2 == 0
            });
        }
        self.marks.push_back((now, done));
    }

    /// Adapts the estimate of the remaining time to the state of the cell:
    ///
    /// - If the cell is not in the state Execute, deletes the earlier progress reports, because a held job has no
    ///   speed.
    /// - If the cell neither runs the job nor asks the machine whether it still executes the job (reconciliation), also
    ///   deletes the job.
    pub(super) fn update_state(&mut self, state: State) {
        let at = state.phase().and_then(|phase| phase.job());
        let is_at_it = |device| matches!(at, Some((at, JobStep::Run | JobStep::Reconcile)) if at == device);
        if self.job.is_some_and(|(device, _)| !is_at_it(device)) {
            self.job = None;
        }
        if !matches!(state, State::Execute(_)) {
            self.marks.clear();
        }
    }

    /// Returns the progress of the job, with the remaining time if it can be estimated. Returns `None` if no job is in
    /// progress.
    pub(super) fn progress(&self) -> Option<JobProgress> {
        let (device, _) = self.job?;
        let (done, total) = self.done_and_total;
        Some(JobProgress { device, done, total, remaining_s: self.remaining_s() })
    }

    fn remaining_s(&self) -> Option<[f64; 2]> {
        let (now, done) = *self.marks.back()?;
        let open = f64::from(self.done_and_total.1.saturating_sub(done));
        let since = |(at, from): (Duration, u32)| {
            let seconds = (now.saturating_sub(at)).as_secs_f64();
            (done > from && seconds >= MIN_OBSERVATION_TIME.as_secs_f64())
                .then(|| seconds / f64::from(done - from) * open)
        };
        let whole = since(*self.marks.front()?)?;
        let late = since(self.marks[self.marks.len() - self.marks.len().div_ceil(4)]).unwrap_or(whole);
        Some([whole.min(late), whole.max(late)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::Phase;

    const JOB: (Device, u32) = (Device::Grinder, 1);
    const RUNNING: State = State::Execute(Phase::Grind(JobStep::Run));

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn progress_estimator_steady_job() {
        let mut pace = ProgressEstimator::default();
        assert_eq!(pace.progress(), None);
        for k in 0..=500_u32 {
            pace.record_progress(ms(100 * u64::from(k)), JOB, k, 1000);
            pace.update_state(RUNNING);
        }
        let told = pace.progress().unwrap();
        assert_eq!((told.device, told.done, told.total), (Device::Grinder, 500, 1000));
        let [least, most] = told.remaining_s.unwrap();
        assert!((least - 50.0).abs() < 1e-9 && (most - 50.0).abs() < 1e-9, "{least} to {most}");
        assert!(pace.marks.len() <= MAX_MARKS && pace.marks[0] == (ms(0), 0), "{:?}", pace.marks);
    }

    #[test]
    fn progress_estimator_slowing_job() {
        let mut pace = ProgressEstimator::default();
        for k in 0..100_u32 {
            pace.record_progress(ms(100 * u64::from(k)), JOB, k, 200);
        }
        for k in 0..20_u32 {
            pace.record_progress(ms(10_000 + 1_000 * u64::from(k)), JOB, 100 + k, 200);
        }
        let [least, most] = pace.progress().unwrap().remaining_s.unwrap();
        assert!(least < 30.0 && most > 70.0, "{least} to {most}");
    }

    #[test]
    fn progress_estimator_hold_and_next_job() {
        let mut pace = ProgressEstimator::default();
        for k in 0..20_u32 {
            pace.record_progress(ms(100 * u64::from(k)), JOB, k, 100);
        }
        pace.update_state(State::Held(Phase::Grind(JobStep::Run)));
        let held = pace.progress().unwrap();
        assert_eq!((held.done, held.remaining_s), (19, None));
        // The hour of standstill does not count.
        pace.update_state(RUNNING);
        pace.record_progress(ms(3_600_000), JOB, 20, 100);
        assert_eq!(pace.progress().unwrap().remaining_s, None, "no pace yet");
        pace.record_progress(ms(3_601_000), JOB, 30, 100);
        assert_eq!(pace.progress().unwrap().remaining_s, Some([7.0, 7.0]));
        // The same machine runs its next job.
        pace.record_progress(ms(3_602_000), (Device::Grinder, 2), 1, 100);
        assert_eq!(pace.progress().unwrap().remaining_s, None);
        pace.update_state(State::Execute(Phase::Transfer));
        assert_eq!(pace.progress(), None);
    }

    #[test]
    fn progress_estimator_empty_job() {
        let mut pace = ProgressEstimator::default();
        pace.record_progress(ms(0), JOB, 0, 0);
        pace.record_progress(ms(1000), JOB, 0, 0);
        assert_eq!(pace.progress().unwrap().remaining_s, None);
    }
}
