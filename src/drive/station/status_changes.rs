//! Changes between two statuses of a machine, reported to the cell as events.

use std::time::Duration;

use tokio::time::Instant;

use super::MachineTask;
use super::driver::StationDriver;
use super::observed_state::ObservedState;
use super::translation::{describe_job, fault_message, job_result};
use crate::cell::{Condition, Device, Event, JobResult, MachineRequest, Occupation};
use crate::device::{Fault, Interrupt, Machine as _, MachineState, Outcome, SignalValue, Status};

/// Number of status reads without the job before the job counts as vanished.
const VANISHED_AFTER_READS: u32 = 2;
/// Number of increases of the progress at HELD before the machine counts as moving. A machine may count a few completed
/// items late.
const MOVING_AFTER_RISES: u32 = 3;
/// Time after which a machine that accepted a STOP must have left EXECUTE.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum share of the path that a machine must have travelled when it reports its job complete.
const MIN_COMPLETE_SHARE: f64 = 0.95;
/// Time for which signals must be within their ranges before they count as good. Prevents flapping of a signal at its
/// limit.
const SIGNAL_SETTLING_TIME: Duration = Duration::from_secs(1);
/// Minimum interval between two reports of progress, so that the journal stays readable.
const MIN_PROGRESS_INTERVAL: Duration = Duration::from_millis(250);

impl<B: StationDriver> MachineTask<B> {
    /// Compares `status` with the previous status of the machine, and reports each change to the cell as an event.
    /// Examples are another operating mode, a signal out of its range, a held or resumed job, progress, the end of a
    /// job, and a fault.
    pub(super) async fn report_changes(&mut self, status: &Status) {
        let before = self.observed.state.replace(status.state);
        self.report_mode(status).await;
        self.report_clear(status).await;
        self.report_supplies(status).await;
        self.report_signals(status).await;
        self.report_absence(status).await;
        self.report_contradiction(before, status).await;
        match status.state {
            MachineState::Execute => {
                if before == Some(MachineState::Held) {
                    self.report(Event::MachineResumed { device: B::DEVICE }).await;
                }
                self.report_progress(status).await;
            }
            MachineState::Held if before != Some(MachineState::Held) => {
                self.report(Event::MachineHeld { device: B::DEVICE }).await
            }
            MachineState::Complete => self.finish_job(status).await,
            MachineState::Idle if self.observed.stopping => {
                self.observed.stopping = false;
                self.observed.running = false;
                self.report_end(JobResult::Stopped).await;
            }
            MachineState::Idle if self.observed.clearing => {
                self.observed.clearing = false;
                let (device, boot_id) = (B::DEVICE, status.boot_id.unwrap_or_default());
                self.report(Event::Connected { device, boot_id, simulated: false, occupation: Occupation::Idle }).await;
            }
            MachineState::Aborted => self.report_abort(before).await,
            MachineState::Faulted if before != Some(MachineState::Faulted) => {
                let fault = status.fault.unwrap_or(Fault::Other(0));
                let (device, code, message) = (B::DEVICE, fault.number(), fault_message(B::DEVICE, fault));
                self.report(Event::Fault { device, code, message }).await;
            }
            _ => {}
        }
    }

    /// Reports that a machine has lost the job of this run, after [`VANISHED_AFTER_READS`] status reads without it. The
    /// job counts as lost if the machine reported it before, now reports no job or a job of another run, and has not
    /// reported the end of the job. Does nothing while a stop, clear or abort is in progress.
    async fn report_absence(&mut self, status: &Status) {
        let ObservedState { running, end_reported: ended, stopping, clearing, aborting, .. } = self.observed;
        if !running || ended || stopping || clearing || aborting {
            return;
        }
        let is_another = status.job.is_some_and(|job| job.job != self.job);
        let at_a_job = status.state.is_moving() || matches!(status.state, MachineState::Held | MachineState::Complete);
        if at_a_job && !is_another {
            (self.observed.at_job, self.observed.reads_without_job) = (true, 0);
        }
        if !self.observed.at_job
            || !(matches!(status.state, MachineState::Idle | MachineState::Prepared) || at_a_job && is_another)
        {
            return;
        }
        self.observed.reads_without_job += 1;
        if self.observed.reads_without_job == VANISHED_AFTER_READS {
            self.report(Event::JobVanished { device: B::DEVICE, reason: format!("it is {}", describe_job(status)) })
                .await;
        }
    }

    /// Reports a status that contradicts an accepted command, as a refusal of this command. For HOLD: the machine
    /// reports HELD, but its progress has increased [`MOVING_AFTER_RISES`] times. For STOP: the machine accepted it,
    /// but is still in EXECUTE after [`STOP_TIMEOUT`]. `before` is the state in the previous status.
    async fn report_contradiction(&mut self, before: Option<MachineState>, status: &Status) {
        let device = B::DEVICE;
        let is_held = status.state == MachineState::Held && before == Some(MachineState::Held);
        match status.progress.filter(|_| is_held) {
            Some((done, total)) => {
                let (last, _) = self.observed.progress.replace((done, total)).unwrap_or((done, total));
                self.observed.progress_rises_at_held += u32::from(done > last);
                if done > last
                    && self.observed.running
                    && self.observed.progress_rises_at_held.is_multiple_of(MOVING_AFTER_RISES)
                {
                    let reason =
                        format!("the machine reports HELD, but the progress of the job has risen to {done} of {total}");
                    self.report(Event::Refused { device, request: MachineRequest::Hold, reason }).await;
                }
            }
            None => self.observed.progress_rises_at_held = 0,
        }
        let is_late = self.observed.stop_accepted_at.is_some_and(|taken| taken.elapsed() > STOP_TIMEOUT);
        if self.observed.stopping && is_late && status.state == MachineState::Execute {
            self.observed.stop_accepted_at = None;
            let reason =
                format!("the machine accepted STOP, but is still in EXECUTE {} s later", STOP_TIMEOUT.as_secs());
            self.report(Event::Refused { device, request: MachineRequest::Stop, reason }).await;
        }
    }

    /// Reports if a machine has changed to manual mode, or back to automatic mode.
    pub(super) async fn report_mode(&mut self, status: &Status) {
        let Some(manual) = status.automatic.map(|automatic| !automatic) else { return };
        if std::mem::replace(&mut self.observed.manual, manual) == manual {
            return;
        }
        let device = B::DEVICE;
        let event = if manual {
            let message = format!("{} reports manual mode", self.driver.machine().name());
            Event::NotAutomatic { device, message }
        } else {
            Event::AutomaticAgain { device }
        };
        self.report(event).await;
    }

    /// Reports that a machine without a running job is no longer clear of the part (out of its way), for example
    /// because a person has moved the machine. Does nothing if the machine does not report whether it is clear.
    async fn report_clear(&mut self, status: &Status) {
        let Some(clear) = status.clear_of_part else { return };
        let before = self.observed.clear.replace(clear);
        if before == Some(true) && !clear && !self.observed.running {
            let message = format!(
                "{} is in {} without a running job, but is no longer clear of the part",
                self.driver.machine().name(),
                status.state
            );
            self.report(Event::Obstructed { device: B::DEVICE, message }).await;
        }
    }

    async fn report_supplies(&mut self, status: &Status) {
        let Some(missing) = status.supplies.map(|there| !there) else { return };
        if std::mem::replace(&mut self.observed.supplies_missing, missing) == missing {
            return;
        }
        let (device, condition) = (B::DEVICE, Condition::Supplies);
        let event = if missing {
            let message = format!("{} reports that air or coolant is missing", self.driver.machine().name());
            Event::ConditionLost { device, condition, message }
        } else {
            Event::ConditionBack { device, condition }
        };
        self.report(event).await;
    }

    /// Reports once that signals of the machine have left their ranges in the cell file. Reports again when all signals
    /// have been within their ranges for [`SIGNAL_SETTLING_TIME`].
    async fn report_signals(&mut self, status: &Status) {
        let flaws: Vec<String> = status.signals.iter().filter_map(SignalValue::problem).collect();
        let (device, condition) = (B::DEVICE, Condition::Signals);
        if !flaws.is_empty() {
            self.observed.signals_good_since = None;
            if !std::mem::replace(&mut self.observed.signal_out_of_range, true) {
                self.report(Event::ConditionLost { device, condition, message: flaws.join("; ") }).await;
            }
        } else if self.observed.signal_out_of_range {
            let since = *self.observed.signals_good_since.get_or_insert_with(Instant::now);
            if since.elapsed() >= SIGNAL_SETTLING_TIME {
                self.observed.signal_out_of_range = false;
                self.report(Event::ConditionBack { device, condition }).await;
            }
        }
    }

    async fn report_progress(&mut self, status: &Status) {
        let (Some(progress), now) = (status.progress, Instant::now()) else { return };
        let due = self.observed.progress_reported_at.is_none_or(|at| now - at >= MIN_PROGRESS_INTERVAL);
        if due && self.observed.progress != Some(progress) {
            (self.observed.progress, self.observed.progress_reported_at) = (Some(progress), Some(now));
            let (done, total) = progress;
            self.report(Event::Progressed { device: B::DEVICE, done, total }).await;
        }
    }

    /// Reports to the cell that a job has ended. For a pass, first reads the pass record from the grinder. If the link
    /// is lost during this reading, does not report the end, and the next poll tries again.
    ///
    /// Does nothing if no job was running and no stop is in progress. Also does nothing if the end of the job was
    /// already reported and no stop is in progress.
    async fn finish_job(&mut self, status: &Status) {
        if self.observed.end_reported && !self.observed.stopping {
            return;
        }
        if !self.observed.running && !self.observed.stopping {
            return;
        }
        if !self.observed.end_reported && self.fetch_pass_record().await.is_err() {
            return; // The next look tries again.
        }
        if !self.observed.end_reported {
            self.check_early_end(status).await;
        }
        self.observed.stopping = false;
        self.observed.running = false;
        self.report_end(job_result(status.outcome)).await;
    }

    /// Reports the record of a pass as doubtful if the grinder reports the pass as complete, but the reported progress
    /// is below the share [`MIN_COMPLETE_SHARE`] of its total. Does nothing for a CMM, or if the grinder reports no
    /// progress.
    pub(super) async fn check_early_end(&mut self, status: &Status) {
        let (Device::Grinder, Outcome::Complete, Some((done, total))) = (B::DEVICE, status.outcome, status.progress)
        else {
            return;
        };
        if f64::from(done) < MIN_COMPLETE_SHARE * f64::from(total) {
            let reason =
                format!("the grinder reports the pass as complete, but the progress is only {done} of {total}");
            self.report(Event::RecordDoubted { cycle: self.cycle, reason }).await;
        }
    }

    /// Reads the pass record of the finished pass from the grinder, and sends it to the drive. Does nothing for a CMM.
    /// A record that cannot be read, or that belongs to another job, is reported as doubtful.
    ///
    /// # Errors
    /// Returns an error if the link is lost. The loss has then been reported.
    pub(super) async fn fetch_pass_record(&mut self) -> Result<(), ()> {
        let (Device::Grinder, Some(armed)) = (B::DEVICE, &self.armed) else { return Ok(()) };
        // Short: one or two pages. No interrupt is needed; an abort gives the request up.
        match self.driver.fetch(armed.job, &Interrupt::new()).await {
            Ok(record) => self.send_fetched(record).await,
            Err(error) if error.is_link() => {
                self.report_link_lost(&error).await;
                return Err(());
            }
            Err(error) => self.report(Event::RecordDoubted { cycle: self.cycle, reason: error.to_string() }).await,
        }
        Ok(())
    }

    async fn report_end(&mut self, result: JobResult) {
        self.observed.end_reported = true;
        self.report(Event::Ended { device: B::DEVICE, cycle: self.cycle, result }).await;
    }

    async fn report_abort(&mut self, before: Option<MachineState>) {
        if std::mem::replace(&mut self.observed.aborting, false) {
            self.observed.running = false;
            self.report(Event::AbortConfirmed { device: B::DEVICE }).await;
        } else if before != Some(MachineState::Aborted) && self.observed.running
            || std::mem::replace(&mut self.observed.stopping, false)
        {
            self.observed.running = false;
            self.report_end(JobResult::Aborted).await;
        }
    }
}
