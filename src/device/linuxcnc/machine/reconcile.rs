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
    /// Returns whether the start of the job has led to a running or finished job, or that the controller runs another
    /// program. Returns `None` if none of these is seen yet, or if there is no job.
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
                Some(Reconciled::Unknown { reason: format!("it runs another program now, {program}") })
            }
            _ => None,
        })
    }

    /// Finds out if the start of the job was never carried out. First takes control again, so that no line of an older
    /// connection can begin the job. The job was not started if it is not seen to run for more than a second after
    /// that, and if its log file has neither a begin nor an end.
    pub(super) async fn confirm_not_started(&mut self) -> DeviceResult<Reconciled> {
        self.take_control().await?;
        let fenced = Instant::now();
        while fenced.elapsed() < NOT_STARTED_CONFIRMATION.max(self.settings.record_timeout) {
            sleep(POLL_INTERVAL * 5).await;
            if let Some(verdict) = self.start_outcome().await? {
                return Ok(verdict);
            }
        }
        let Some(work) = self.job.clone() else { return Ok(unknown("nothing was prepared")) };
        match self.record(&work).await? {
            Some(ProgramRecord { begun: 0, ended: 0, .. }) => {
                self.job = None;
                let (_, status) = self.read_status().await?;
                Ok(Reconciled::NotStarted(status))
            }
            Some(_) => Ok(unknown("the .log file of its program shows its begin, but not its end")),
            None => Ok(unknown("the .log file of its program is no longer in the folder of programs")),
        }
    }

    /// Finds the program of the start `intended` that an earlier process prepared, and assigns it to the job.
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

    /// Finds the program of a job that was restored before the connection existed, so that a running program is
    /// recognised as that of the job.
    pub(super) async fn find_restored_program(&mut self) {
        let Some(work) = self.job.as_ref().filter(|work| work.program.is_none()) else { return };
        let intended = Armed { job: work.job, start_sequence: work.sequence, token: work.token, boot_id: 0 };
        if let Err(error) = self.find_prepared_program(&intended).await {
            self.note(error.to_string());
        }
    }
}

pub(super) fn unknown(why: &str) -> Reconciled {
    Reconciled::Unknown { reason: why.to_owned() }
}
