//! State of the grinder, from its controller and the record of its program.

use std::time::Duration;

use tokio::time::Instant;

use super::LinuxcncGrinder;
use crate::error::Answered;
use crate::linuxcnc::controller::{Interpreter, Seen};
use crate::linuxcnc::protocol::Mode;
use crate::linuxcnc::work::{Stage, Verdict, Work};
use crate::words::{Fault, Outcome, State, Status};

/// Time without a change after which a running program that does not move is noted.
const STANDS_AFTER: Duration = Duration::from_secs(5);

impl LinuxcncGrinder {
    /// Reads the state of the controller, and the record if a job may be over.
    pub(super) async fn look(&mut self) -> Answered<(Seen, Status)> {
        let owned = self.controller.owned;
        let seen = self.controller.look(owned).await?;
        if owned && !seen.ours {
            self.taken = true;
            return Err(self.controller.taken());
        }
        for error in &seen.errors {
            self.note(format!("the controller reports: {error}"));
        }
        let is_idle = seen.interpreter == Interpreter::Idle;
        self.idle_since = is_idle.then(|| self.idle_since.unwrap_or_else(Instant::now));
        self.see_it_move(&seen);
        self.judge(&seen).await?;
        let status = self.told(&seen);
        self.last = Some(status.state);
        Ok((seen, status))
    }

    /// Notes a running program that does not move. A controller whose task has died keeps reporting its last state, and
    /// it has no heartbeat that would prove it.
    fn see_it_move(&mut self, seen: &Seen) {
        match &self.moved {
            Some((line, at, since)) if (*line, at) == (seen.line, &seen.at) => {
                if seen.interpreter == Interpreter::Running && since.elapsed() > STANDS_AFTER {
                    self.note("it says that it runs, and has not moved for 5 s: look at the machine".to_owned());
                }
            }
            _ => self.moved = Some((seen.line, seen.at.clone(), Instant::now())),
        }
    }

    pub(super) fn note(&mut self, note: String) {
        const KEPT: usize = 20;
        if !self.notes.contains(&note) {
            self.notes.push(note);
        }
        let more = self.notes.len().saturating_sub(KEPT);
        self.notes.drain(..more);
    }

    /// Updates the job from the observed state.
    async fn judge(&mut self, seen: &Seen) -> Answered<()> {
        let Some(mut work) = self.work.take() else { return Ok(()) };
        let begun = self.judged(&mut work, seen).await;
        self.work = Some(work);
        begun
    }

    async fn judged(&mut self, work: &mut Work, seen: &Seen) -> Answered<()> {
        if matches!(work.stage, Stage::Ended(..)) {
            return Ok(());
        }
        // A program started at the machine's own panel has begun too.
        let is_ours = seen.program.as_deref() == Some(&work.path);
        if work.stage == Stage::Prepared && seen.interpreter != Interpreter::Idle && is_ours {
            work.stage = Stage::Begun;
        }
        if work.stage != Stage::Begun {
            return Ok(());
        }
        work.errors.extend(seen.errors.iter().cloned());
        let record = match seen.interpreter {
            Interpreter::Running => None,
            _ => self.record(work).await?,
        };
        let still = self.idle_since.map_or(Duration::ZERO, |since| since.elapsed());
        match work.judge(seen, record, still, self.settings.record_within) {
            Verdict::Ended(state, outcome, fault) => {
                work.stage = Stage::Ended(state, outcome);
                (self.fault, self.clear_at) = (fault, None);
                self.duration_s = self.began.map(|began| began.elapsed().as_secs_f64());
                if outcome == Outcome::Complete {
                    self.clear_at = Some(seen.at.clone());
                }
            }
            Verdict::Untold => self.note(
                "it stands, and its program wrote neither that it began nor that it ended: look at the machine, then regrind confirm done, or \
                 regrind confirm still"
                    .to_owned(),
            ),
            Verdict::At(_) | Verdict::Foreign(_) => {}
        }
        Ok(())
    }

    /// Returns the status in the words common to all machines.
    fn told(&mut self, seen: &Seen) -> Status {
        let is_clear = seen.interpreter == Interpreter::Idle && self.clear_at.as_ref() == Some(&seen.at);
        if !is_clear {
            self.clear_at = None;
        }
        let blank = Status { clear_of_part: is_clear.then_some(true), ..Status::of(self.free(seen)) };
        let (still, settles) = (Duration::ZERO, self.settings.record_within);
        let Some(work) = &mut self.work else { return Status { fault: standing_fault(seen), ..blank } };
        let is_auto = Some(seen.mode == Mode::Auto);
        let status = Status { job: Some(work.job), automatic: is_auto, ..blank.clone() };
        match work.stage {
            Stage::Ended(state, outcome) => {
                let fault = Some(self.fault).filter(|fault| *fault != Fault::None);
                Status { state, done: work.sequence, outcome, fault, automatic: None, ..status }
            }
            Stage::Begun => match work.judge(seen, None, still, settles) {
                Verdict::Foreign(state) => Status { state, ..blank },
                Verdict::At(state) => Status { state, progress: work.progress(seen.line), ..status },
                // Its standstill is not known until the record is read or a person has confirmed it.
                _ => Status { state: State::Execute, ..status },
            },
            Stage::Prepared if seen.interpreter != Interpreter::Idle => blank,
            Stage::Prepared if seen.stopped || !seen.on => Status { fault: standing_fault(seen), ..status },
            Stage::Prepared if seen.program.as_deref() != Some(&work.path) => blank,
            Stage::Prepared => Status { state: State::Prepared, ..status },
        }
    }

    /// Returns the state when no job of ours is active.
    fn free(&self, seen: &Seen) -> State {
        match seen.interpreter {
            Interpreter::Running => State::Execute,
            Interpreter::Paused => State::Held,
            Interpreter::Idle if self.aborted => State::Aborted,
            Interpreter::Idle if seen.stopped || !seen.on => State::Faulted,
            Interpreter::Idle => State::Idle,
        }
    }

    /// Returns true if the controller is idle and only a person can say how the job ended.
    pub(super) async fn is_untold(&mut self) -> Answered<bool> {
        let (seen, _) = self.look().await?;
        let Some(work) = self.work.clone().filter(|work| work.stage == Stage::Begun) else { return Ok(false) };
        let record = self.record(&work).await?;
        let settles = self.settings.record_within;
        Ok(work.judge(&seen, record, settles, settles) == Verdict::Untold)
    }
}

/// Returns the fault that blocks a machine without a job.
pub(super) fn standing_fault(seen: &Seen) -> Option<Fault> {
    match (seen.stopped, seen.on) {
        (true, _) => Some(Fault::StopCircuit),
        (false, false) => Some(Fault::Supplies),
        (false, true) => None,
    }
}
