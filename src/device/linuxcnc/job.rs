//! State of a job, from the observed state of the controller and the record of its program. Pure: no I/O.
//!
//! The controller reports what runs. It does not report if a program ran to its end: only the record of the program
//! proves that, not an idle controller.

use std::sync::Arc;
use std::time::Duration;

use super::controller::{ControllerState, Interpreter};
use super::program::{FramedProgram, ProgramRecord};
use crate::handshake::{Fault, Job, MachineState, Outcome};

/// Prepared job and everything known about it.
#[derive(Clone, Debug)]
pub(super) struct ActiveJob {
    pub(super) job: Job,
    /// Start sequence number.
    pub(super) sequence: u32,
    /// Token of the preparation, which the record of the program must contain.
    pub(super) token: u32,
    /// Program of the job; `None` if a program prepared earlier is not found any more.
    pub(super) program: Option<Arc<FramedProgram>>,
    /// Path of the program at the controller.
    pub(super) path: String,
    pub(super) stage: Stage,
    /// Outcome that a person requested.
    pub(super) requested_outcome: Option<Outcome>,
    /// Errors since it began, in the controller's words.
    pub(super) errors: Vec<String>,
    /// Number of completed rounds of the pass, and the line seen last.
    pub(super) round: (u32, u32),
}

/// Stage of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// Checked; START begins it.
    Prepared,
    /// START was sent, or possibly sent.
    Begun,
    /// The job is over, with this state and this outcome.
    Ended(MachineState, Outcome),
}

/// Verdict on a job at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// The job is in this state and can continue.
    InState(MachineState),
    /// The job is over, with this state, outcome and fault.
    Ended(MachineState, Outcome, Fault),
    /// The controller runs a program that is not ours.
    Foreign(MachineState),
    /// The controller is idle, and nothing shows how the job ended.
    Unresolved,
}

impl ActiveJob {
    /// Returns `record`, the content of a log file, if it belongs to this job. It belongs to this job if it contains
    /// the token (the random number) of the preparation of this job. Otherwise returns `None`.
    pub(super) fn own_record(&self, record: Option<ProgramRecord>) -> Option<ProgramRecord> {
        record.filter(|record| record.token == Some(self.token))
    }

    /// Determines the state or the outcome of a job that was started. Uses these inputs:
    ///
    /// - `seen` is the state of the controller.
    /// - `record` is the content of the log file of the program.
    /// - `still` is the time since the controller became idle.
    /// - `settles` is the maximum time from the end of a program until its log file is visible.
    ///
    /// Returns `Verdict::Unresolved` if the controller is idle for longer than `settles`, no stop or abort was
    /// requested, and the log file shows neither a begin nor an end of the program.
    pub(super) fn judge(
        &self,
        seen: &ControllerState,
        record: Option<ProgramRecord>,
        still: Duration,
        settles: Duration,
    ) -> Verdict {
        let record = self.own_record(record).unwrap_or_default();
        let is_ours = seen.program.as_deref() == Some(&self.path);
        let aborts = self.requested_outcome == Some(Outcome::Aborted);
        match seen.interpreter {
            // A pause after the end of the program holds nothing.
            Interpreter::Running | Interpreter::Paused if is_ours && record.ended == 0 => match seen.interpreter {
                _ if aborts => Verdict::InState(MachineState::Aborting),
                _ if self.requested_outcome == Some(Outcome::Stopped) => Verdict::InState(MachineState::Stopping),
                Interpreter::Paused => Verdict::InState(MachineState::Held),
                _ => Verdict::InState(MachineState::Execute),
            },
            Interpreter::Running if is_ours => Verdict::InState(MachineState::Execute),
            Interpreter::Running => Verdict::Foreign(MachineState::Execute),
            Interpreter::Paused if !is_ours => Verdict::Foreign(MachineState::Held),
            _ if record.ended > 0 && aborts => Verdict::Ended(MachineState::Aborted, Outcome::Complete, Fault::None),
            _ if record.ended > 0 => Verdict::Ended(MachineState::Complete, Outcome::Complete, Fault::None),
            _ if still < settles && self.requested_outcome.is_none() => Verdict::InState(MachineState::Execute),
            _ if aborts => Verdict::Ended(MachineState::Aborted, Outcome::Aborted, Fault::None),
            _ if self.requested_outcome.is_some() => {
                Verdict::Ended(MachineState::Complete, Outcome::Stopped, Fault::None)
            }
            _ if record.begun == 0 => Verdict::Unresolved,
            _ if seen.stop_circuit_open => Verdict::Ended(MachineState::Faulted, Outcome::Failed, Fault::StopCircuit),
            _ if !seen.drives_on => Verdict::Ended(MachineState::Faulted, Outcome::Failed, Fault::Supplies),
            _ if !self.errors.is_empty() => Verdict::Ended(MachineState::Faulted, Outcome::Failed, self.fault()),
            // Somebody has aborted it at the machine.
            _ => Verdict::Ended(MachineState::Aborted, Outcome::Aborted, Fault::None),
        }
    }

    /// Returns the progress of the job as `(done, total)`. A round is one run of the pass, and the job can have several
    /// rounds. Both numbers count thousandths of a round: `total` is 1000 for each round.
    ///
    /// `line` is the line number that the controller reports. Counts a new round if `line` is lower than the previous
    /// line number by more than half of the lines of the pass. Returns `None` if the program is not known.
    pub(super) fn progress(&mut self, line: u32) -> Option<(u32, u32)> {
        let program = self.program.as_ref()?;
        let (round, before) = self.round;
        // A pause may move the line back a little. The start of the next round is far back.
        let again = line + program.lines.1 / 2 < before && round + 1 < program.rounds;
        self.round = (round + u32::from(again), line);
        Some((1000 * self.round.0 + program.thousandths(line), 1000 * program.rounds))
    }

    /// Returns the fault that the error texts indicate by known words; `Fault::Other(0)` if they contain no known word.
    pub(super) fn fault(&self) -> Fault {
        let words = self.errors.join("\n").to_lowercase();
        match () {
            () if words.contains("limit") => Fault::TravelLimit,
            () if words.contains("following error") || words.contains("amplifier") => Fault::Drive,
            () => Fault::Other(0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::protocol::ControllerMode;
    use super::*;

    fn work() -> ActiveJob {
        ActiveJob {
            job: Job { job: 7, cycle: 2, digest: 3 },
            sequence: 2,
            token: 42,
            program: None,
            path: "/nc/p.ngc".into(),
            stage: Stage::Begun,
            requested_outcome: None,
            errors: Vec::new(),
            round: (0, 0),
        }
    }

    fn seen(interpreter: Interpreter, program: &str) -> ControllerState {
        ControllerState {
            has_control: true,
            stop_circuit_open: false,
            drives_on: true,
            mode: ControllerMode::Auto,
            homed: true,
            interpreter,
            program: Some(program.into()),
            line: 1,
            position: String::new(),
            errors: Vec::new(),
        }
    }

    fn record(begun: u32, ended: u32) -> Option<ProgramRecord> {
        Some(ProgramRecord { token: Some(42), begun, ended })
    }

    const SETTLES: Duration = Duration::from_secs(2);

    fn judged(work: &ActiveJob, seen: &ControllerState, record: Option<ProgramRecord>) -> Verdict {
        work.judge(seen, record, SETTLES, SETTLES)
    }

    #[test]
    fn judge_complete_only_by_record() {
        let (work, idle) = (work(), seen(Interpreter::Idle, "/nc/p.ngc"));
        let complete = Verdict::Ended(MachineState::Complete, Outcome::Complete, Fault::None);
        let aborted = Verdict::Ended(MachineState::Aborted, Outcome::Aborted, Fault::None);
        assert_eq!(judged(&work, &idle, record(1, 1)), complete);
        assert_eq!(judged(&work, &idle, record(1, 0)), aborted);
        assert_eq!(judged(&work, &idle, record(0, 0)), Verdict::Unresolved);
        assert_eq!(judged(&work, &idle, None), Verdict::Unresolved);
        // Record of another preparation.
        assert_eq!(
            judged(&work, &idle, Some(ProgramRecord { token: Some(41), begun: 1, ended: 1 })),
            Verdict::Unresolved
        );
        // The record may become visible late.
        assert_eq!(work.judge(&idle, record(1, 0), SETTLES / 2, SETTLES), Verdict::InState(MachineState::Execute));
    }

    #[test]
    fn judge_reports_fault_cause() {
        let mut work = work();
        let idle = seen(Interpreter::Idle, "/nc/p.ngc");
        let failed = |fault| Verdict::Ended(MachineState::Faulted, Outcome::Failed, fault);
        assert_eq!(
            judged(&work, &ControllerState { stop_circuit_open: true, drives_on: false, ..idle.clone() }, record(1, 0)),
            failed(Fault::StopCircuit)
        );
        assert_eq!(
            judged(&work, &ControllerState { drives_on: false, ..idle.clone() }, record(1, 0)),
            failed(Fault::Supplies)
        );
        for (error, fault) in [
            ("Linear move on line 7 would exceed X's positive limit", Fault::TravelLimit),
            ("joint 0 following error", Fault::Drive),
            ("Unclosed comment found", Fault::Other(0)),
        ] {
            work.errors = vec![error.into()];
            assert_eq!(judged(&work, &idle, record(1, 0)), failed(fault), "{error}");
        }
    }

    #[test]
    fn judge_requested_outcome() {
        let (running, idle) = (seen(Interpreter::Running, "/nc/p.ngc"), seen(Interpreter::Idle, "/nc/p.ngc"));
        for (wanted, on_the_way, state) in [
            (Outcome::Aborted, MachineState::Aborting, MachineState::Aborted),
            (Outcome::Stopped, MachineState::Stopping, MachineState::Complete),
        ] {
            let work = ActiveJob { requested_outcome: Some(wanted), ..work() };
            assert_eq!(judged(&work, &running, record(1, 0)), Verdict::InState(on_the_way));
            assert_eq!(judged(&work, &idle, record(1, 0)), Verdict::Ended(state, wanted, Fault::None));
            // The program ended before the stop took effect.
            assert_eq!(judged(&work, &idle, record(1, 1)), Verdict::Ended(state, Outcome::Complete, Fault::None));
        }
    }

    #[test]
    fn judge_foreign_program() {
        let work = work();
        let of = |interpreter| judged(&work, &seen(interpreter, "/nc/other.ngc"), record(0, 0));
        assert_eq!(of(Interpreter::Running), Verdict::Foreign(MachineState::Execute));
        assert_eq!(of(Interpreter::Paused), Verdict::Foreign(MachineState::Held));
        let paused = seen(Interpreter::Paused, "/nc/p.ngc");
        assert_eq!(judged(&work, &paused, record(1, 0)), Verdict::InState(MachineState::Held));
    }

    #[test]
    fn progress_counts_spark_out_rounds() {
        let mut work = work();
        let (name, text) = ("p".to_owned(), Vec::new());
        let program = FramedProgram { name, cycle: 1, text, lines: (6, 100), rounds: 2, map: [0; 32] };
        work.program = Some(Arc::new(program));
        let told: Vec<_> = [0, 6, 56, 50, 106, 6, 56, 106, 20].map(|line| work.progress(line).unwrap().0).into();
        assert_eq!(told, [0, 0, 500, 440, 1000, 1000, 1500, 2000, 1140]);
    }
}
