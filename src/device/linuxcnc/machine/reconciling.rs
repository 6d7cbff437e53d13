//! Fate of a job after a lost connection, or of one that an earlier process had begun.

use std::sync::Arc;

use tokio::time::{Instant, sleep};

use super::{LOOK_EVERY, LinuxcncGrinder, SEEN_TWICE_OVER};
use crate::error::Answered;
use crate::linuxcnc::controller::Interpreter;
use crate::linuxcnc::program::Record;
use crate::linuxcnc::work::Stage;
use crate::words::{Armed, Reconciled};

impl LinuxcncGrinder {
    /// Returns what became of a job, if that is known now.
    pub(super) async fn what_became(&mut self) -> Answered<Option<Reconciled>> {
        let (seen, status) = self.look().await?;
        let Some(work) = &self.work else { return Ok(None) };
        Ok(match work.stage {
            Stage::Ended(..) => Some(Reconciled::Finished(status)),
            _ if seen.program.as_deref() == Some(&work.path) && seen.interpreter != Interpreter::Idle => {
                Some(Reconciled::Running(status))
            }
            _ if seen.interpreter != Interpreter::Idle => {
                let program = seen.program.unwrap_or_default();
                Some(Reconciled::Unknown { why: format!("it runs another program now, {program}") })
            }
            _ => None,
        })
    }

    /// Finds out if the job was never begun. After a new claim, no line of an older connection can begin anything. The
    /// job was not begun if it is then not seen to run for more than a second, and its record has neither a begin nor
    /// an end.
    pub(super) async fn was_not_begun(&mut self) -> Answered<Reconciled> {
        self.claim_again().await?;
        let fenced = Instant::now();
        while fenced.elapsed() < SEEN_TWICE_OVER.max(self.settings.record_within) {
            sleep(LOOK_EVERY * 5).await;
            if let Some(verdict) = self.what_became().await? {
                return Ok(verdict);
            }
        }
        let Some(work) = self.work.clone() else { return Ok(unknown("nothing was prepared")) };
        match self.record(&work).await? {
            Some(Record { begun: 0, ended: 0, .. }) => {
                self.work = None;
                let (_, status) = self.look().await?;
                Ok(Reconciled::NotStarted(status))
            }
            Some(_) => Ok(unknown("its record says that it began, and it is not seen to have ended")),
            None => Ok(unknown("the record of its preparation is not in the folder of programs any more")),
        }
    }

    /// Finds the program that was prepared before this process started.
    pub(super) async fn find_again(&mut self, intended: &Armed) -> Answered<()> {
        let (cycle, token) = (intended.job.number().cycle.saturating_sub(1), intended.token);
        if let Some(program) = self.in_folders(move |folders| folders.prepared(cycle, token)).await? {
            let (path, program) = (self.path(&program), Arc::new(program));
            if let Some(work) = self.work_of(intended) {
                (work.program, work.path) = (Some(program), path);
            }
        }
        Ok(())
    }

    /// Finds the program of a job that was restored before the connection existed, so that a running program is
    /// recognised as that of the job.
    pub(super) async fn find_what_was_restored(&mut self) {
        let Some(work) = self.work.as_ref().filter(|work| work.program.is_none()) else { return };
        let intended = Armed { job: work.job, start_sequence: work.sequence, token: work.token, boot_id: 0 };
        if let Err(error) = self.find_again(&intended).await {
            self.note(error.to_string());
        }
    }
}

pub(super) fn unknown(why: &str) -> Reconciled {
    Reconciled::Unknown { why: why.to_owned() }
}
