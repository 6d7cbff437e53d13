//! Outcome of a job after a lost connection, or of a job that an earlier process had begun.

use std::sync::Arc;

use tokio::time::{Instant, sleep};

use super::{LinuxcncGrinder, NOT_STARTED_CONFIRMATION, POLL_INTERVAL};
use crate::error::DeviceResult;
use crate::handshake::{Armed, Reconciled};
use crate::linuxcnc::controller::Interpreter;
use crate::linuxcnc::job::Stage;
use crate::linuxcnc::program::ProgramRecord;

impl LinuxcncGrinder {
    /// Reads the status and returns the outcome of the start of the current job: running, finished, or unknown because
    /// the controller runs another program. Returns `None` if there is no job, or if the controller is idle and the end
    /// of the job is not yet known.
    ///
    /// # Errors
    /// Returns an error if the status cannot be read.
    pub(super) async fn start_outcome(&mut self) -> DeviceResult<Option<Reconciled>> {
        let (seen, status) = self.read_status().await?;
        let Some(work) = &self.job else { return Ok(None) };
        Ok(match work.stage {
            Stage::Ended(..) => Some(Reconciled::Finished(status)),
            _ if seen.program.as_deref() == Some(&work.path) && seen.interpreter != Interpreter::Idle => {
                Some(Reconciled::Running(status))
            }
            _ if seen.interpreter != Interpreter::Idle => {
                let program = seen.program.unwrap_or_default();
                Some(Reconciled::Unknown { reason: format!("the grinder now runs another program, {program}") })
            }
            _ => None,
        })
    }

    /// Finds out if the start of the current job was never carried out. First takes control again, so that a delayed
    /// order of an older connection cannot start the job. Then watches the controller for `record_timeout`, at least
    /// 1.05 s. Returns the outcome at once if the job runs or has ended. After the time, returns `NotStarted` if the
    /// log file shows neither a begin nor an end; otherwise returns `Unknown` with the reason.
    ///
    /// # Errors
    /// Returns an error if control cannot be taken, or if the status or the log file cannot be read.
    pub(super) async fn confirm_not_started(&mut self) -> DeviceResult<Reconciled> {
        self.take_control().await?;
        let fenced = Instant::now();
        while fenced.elapsed() < NOT_STARTED_CONFIRMATION.max(self.settings.record_timeout) {
            sleep(POLL_INTERVAL * 5).await;
            if let Some(verdict) = self.start_outcome().await? {
                return Ok(verdict);
            }
        }
        let Some(work) = self.job.clone() else { return Ok(Reconciled::unknown("nothing was prepared")) };
        match self.record(&work).await? {
            Some(ProgramRecord { begun: 0, ended: 0, .. }) => {
                self.job = None;
                let (_, status) = self.read_status().await?;
                Ok(Reconciled::NotStarted(status))
            }
            Some(_) => Ok(Reconciled::unknown("the .log file shows the begin of the program, but not the end")),
            None => Ok(Reconciled::unknown("the .log file of the program is no longer in the folder of programs")),
        }
    }

    /// Finds the program that an earlier process prepared for the start `intended`. Stores the program and its path in
    /// the current job if this job has the same job number and token. Does nothing if no such program exists.
    ///
    /// # Errors
    /// Returns an error if the folder of programs cannot be read.
    pub(super) async fn find_prepared_program(&mut self, intended: &Armed) -> DeviceResult<()> {
        let (cycle, token) = (intended.job.batch_id().cycle.saturating_sub(1), intended.token);
        if let Some(program) = self.in_folders(move |folders| folders.prepared(cycle, token)).await? {
            let (path, program) = (self.path(&program), Arc::new(program));
            if let Some(work) = self.job_for(intended) {
                (work.program, work.path) = (Some(program), path);
            }
        }
        Ok(())
    }

    /// Finds the program of a job that the driver restored before it had a connection. Stores the program in the job,
    /// so that the driver recognises this program when the controller runs it. Does nothing if there is no job or if
    /// its program is known. If the search fails, adds the error as a note for the operator.
    pub(super) async fn find_restored_program(&mut self) {
        let Some(work) = self.job.as_ref().filter(|work| work.program.is_none()) else { return };
        let intended = Armed { job: work.job, start_sequence: work.sequence, token: work.token, boot_id: 0 };
        if let Err(error) = self.find_prepared_program(&intended).await {
            self.note(error.to_string());
        }
    }
}
