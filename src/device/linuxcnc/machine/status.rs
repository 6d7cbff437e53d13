//! State of the grinder, from its controller and the record of its program.

use std::time::Duration;

use tokio::time::Instant;

use super::LinuxcncGrinder;
use crate::error::DeviceResult;
use crate::handshake::{Fault, MachineState, Outcome, Status};
use crate::linuxcnc::controller::{ControllerState, Interpreter};
use crate::linuxcnc::job::{ActiveJob, Stage, Verdict};
use crate::linuxcnc::protocol::ControllerMode;

/// Time without a change after which a running program that does not move is noted.
const STANDSTILL_AFTER: Duration = Duration::from_secs(5);

impl LinuxcncGrinder {
    /// Reads the state of the controller and updates the current job from it. Also reads the log file of the program if
    /// the job has begun and the controller does not report a running program. Returns the state of the controller and
    /// the status of the machine.
    ///
    /// # Errors
    /// Returns an error if another client has taken control, if the connection fails, or if the log file cannot be
    /// read.
    pub(super) async fn read_status(&mut self) -> DeviceResult<(ControllerState, Status)> {
        let owned = self.controller.has_control;
        let seen = self.controller.read_state(owned).await?;
        if owned && !seen.has_control {
            self.control_lost = true;
            return Err(self.controller.control_taken());
        }
        for error in &seen.errors {
            self.note(format!("the controller reports: {error}"));
        }
        let is_idle = seen.interpreter == Interpreter::Idle;
        self.idle_since = is_idle.then(|| self.idle_since.unwrap_or_else(Instant::now));
        self.note_standstill(&seen);
        self.update_job(&seen).await?;
        let status = self.make_status(&seen);
        self.last_state = Some(status.state);
        Ok((seen, status))
    }

    /// Adds a note for the operator if the controller reports a running program, but the line number and the position
    /// have not changed for 5 s. Such a controller may have failed: without a heartbeat, a failed controller continues
    /// to report its last state.
    fn note_standstill(&mut self, seen: &ControllerState) {
        match &self.last_motion {
            Some((line, at, since)) if (*line, at) == (seen.line, &seen.position) => {
                if seen.interpreter == Interpreter::Running && since.elapsed() > STANDSTILL_AFTER {
                    self.note("a program runs, but the machine has not moved for 5 s: check the machine".to_owned());
                }
            }
            _ => self.last_motion = Some((seen.line, seen.position.clone(), Instant::now())),
        }
    }

    pub(super) fn note(&mut self, note: String) {
        const MAX_NOTES: usize = 20;
        if !self.notes.contains(&note) {
            self.notes.push(note);
        }
        let more = self.notes.len().saturating_sub(MAX_NOTES);
        self.notes.drain(..more);
    }

    /// Updates the stage of the current job from `seen`, the state of the controller. Reads the log file of the program
    /// if the job has begun and the controller does not report a running program. Does nothing if there is no job or if
    /// the job has ended.
    ///
    /// # Errors
    /// Returns an error if the log file cannot be read.
    async fn update_job(&mut self, seen: &ControllerState) -> DeviceResult<()> {
        let Some(mut work) = self.job.take() else { return Ok(()) };
        let begun = self.update_stage(&mut work, seen).await;
        self.job = Some(work);
        begun
    }

    async fn update_stage(&mut self, work: &mut ActiveJob, seen: &ControllerState) -> DeviceResult<()> {
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
        match work.judge(seen, record, still, self.settings.record_timeout) {
            Verdict::Ended(state, outcome, fault) => {
                work.stage = Stage::Ended(state, outcome);
                (self.fault, self.clear_at) = (fault, None);
                self.duration_s = self.began.map(|began| began.elapsed().as_secs_f64());
                if outcome == Outcome::Complete {
                    self.clear_at = Some(seen.position.clone());
                }
            }
            Verdict::Unresolved => self.note(
                "the grinder has stopped, but the program logged neither its begin nor its end: check the machine. \
                 Then type regrind confirm done if the pass is complete, otherwise regrind confirm still"
                    .to_owned(),
            ),
            Verdict::InState(_) | Verdict::Foreign(_) => {}
        }
        Ok(())
    }

    /// Converts `seen`, the state of the controller, and the current job to the machine status that all drivers report.
    fn make_status(&mut self, seen: &ControllerState) -> Status {
        let is_clear = seen.interpreter == Interpreter::Idle && self.clear_at.as_ref() == Some(&seen.position);
        if !is_clear {
            self.clear_at = None;
        }
        let blank = Status { clear_of_part: is_clear.then_some(true), ..Status::from_state(self.idle_state(seen)) };
        let (still, settles) = (Duration::ZERO, self.settings.record_timeout);
        let Some(work) = &mut self.job else { return Status { fault: seen.standing_fault(), ..blank } };
        let is_auto = Some(seen.mode == ControllerMode::Auto);
        let status = Status { job: Some(work.job), automatic: is_auto, ..blank.clone() };
        match work.stage {
            Stage::Ended(state, outcome) => {
                let fault = Some(self.fault).filter(|fault| *fault != Fault::None);
                Status { state, done: work.sequence, outcome, fault, automatic: None, ..status }
            }
            Stage::Begun => match work.judge(seen, None, still, settles) {
                Verdict::Foreign(state) => Status { state, ..blank },
                Verdict::InState(state) => Status { state, progress: work.progress(seen.line), ..status },
                // Its standstill is not known until the record is read or a person has confirmed it.
                _ => Status { state: MachineState::Execute, ..status },
            },
            Stage::Prepared if seen.interpreter != Interpreter::Idle => blank,
            Stage::Prepared if seen.stop_circuit_open || !seen.drives_on => {
                Status { fault: seen.standing_fault(), ..status }
            }
            Stage::Prepared if seen.program.as_deref() != Some(&work.path) => blank,
            Stage::Prepared => Status { state: MachineState::Prepared, ..status },
        }
    }

    /// Returns the machine state if this driver has no active job: EXECUTE or HELD if a program runs or is paused,
    /// ABORTED after an abort without a job, FAULTED if the stop circuit is open or the drives are off, otherwise IDLE.
    fn idle_state(&self, seen: &ControllerState) -> MachineState {
        match seen.interpreter {
            Interpreter::Running => MachineState::Execute,
            Interpreter::Paused => MachineState::Held,
            Interpreter::Idle if self.aborted => MachineState::Aborted,
            Interpreter::Idle if seen.stop_circuit_open || !seen.drives_on => MachineState::Faulted,
            Interpreter::Idle => MachineState::Idle,
        }
    }

    /// Returns true if the outcome of the current job is unknown: the controller is idle, and the log file shows
    /// neither a begin nor an end of the program. Only a person can then state how the job ended. Returns false in all
    /// other cases, also if no job has begun.
    ///
    /// # Errors
    /// Returns an error if the status or the log file cannot be read.
    pub(super) async fn is_unresolved(&mut self) -> DeviceResult<bool> {
        let (seen, _) = self.read_status().await?;
        let Some(work) = self.job.clone().filter(|work| work.stage == Stage::Begun) else { return Ok(false) };
        let record = self.record(&work).await?;
        let settles = self.settings.record_timeout;
        Ok(work.judge(&seen, record, settles, settles) == Verdict::Unresolved)
    }
}
