//! Preparation and start of a program: the preconditions, its record, and the one line that starts it.

use std::sync::Arc;

use rand::RngExt as _;
use tokio::time::{Instant, sleep};

use super::{LinuxcncGrinder, NOT_STARTED_CONFIRMATION, POLL_INTERVAL};
use crate::error::{DeviceError, DeviceResult};
use crate::handshake::{Answer, Armed, Fault, Job, MachineCommand, MachineState, Status};
use crate::linuxcnc::controller::{ControllerState, Interpreter};
use crate::linuxcnc::job::{ActiveJob, Stage};
use crate::linuxcnc::program::{FramedProgram, ProgramRecord, RECORD, opening, path};
use crate::linuxcnc::protocol::{ControllerMode, Set};

impl LinuxcncGrinder {
    pub(super) async fn prepare_program(&mut self, job: Job, program: Arc<FramedProgram>) -> DeviceResult<Armed> {
        let (seen, _) = self.read_status().await?;
        self.check_ready(&seen)?;
        if !self.controller.has_control {
            return Err(self.refused(MachineCommand::Prepare, Answer::NotOwner));
        }
        let name = program.name.clone();
        let before = self.in_folders(move |folders| folders.record(&name)).await?.unwrap_or_default();
        if before.begun > 0 {
            return Err(self.refused(MachineCommand::Prepare, Answer::AlreadyBegun));
        }
        let token = self.rng.random::<u32>().max(1);
        self.controller.errors().await?;
        self.open_record(&program, token).await?;
        self.controller.enter(ControllerMode::Auto, MachineCommand::Prepare).await?;
        let path = self.path(&program);
        self.controller.open(&path, MachineCommand::Prepare).await?;
        let sequence = u32::from(job.cycle).max(1);
        let (stage, requested_outcome, errors, round) = (Stage::Prepared, None, Vec::new(), (0, 0));
        self.job = Some(ActiveJob {
            job,
            sequence,
            token,
            program: Some(program),
            path,
            stage,
            requested_outcome,
            errors,
            round,
        });
        (self.began, self.duration_s, self.fault, self.clear_at) = (None, None, Fault::None, None);
        self.notes.clear();
        self.last_state = Some(MachineState::Prepared);
        Ok(Armed { job, start_sequence: sequence, token, boot_id: 0 })
    }

    /// Checks that `seen`, the state of the controller, allows a new job: the stop circuit is closed, the drives are
    /// on, no program runs or is paused, and the axes are homed.
    ///
    /// # Errors
    /// Returns an error for the first condition that is not met. Only a person at the machine can correct it.
    pub(super) fn check_ready(&self, seen: &ControllerState) -> DeviceResult<()> {
        match () {
            () if seen.stop_circuit_open || !seen.drives_on => {
                let (state, fault) = (MachineState::Faulted, seen.standing_fault().unwrap_or(Fault::None));
                Err(DeviceError::Faulted { machine: self.machine(), state, fault })
            }
            () if seen.interpreter == Interpreter::Running => Err(self.unready("the controller runs a program")),
            () if seen.interpreter == Interpreter::Paused => {
                Err(self.unready("a program is paused: end the program at the machine"))
            }
            () if !seen.homed => Err(self.unready("the machine is not homed: home the machine at its own panel")),
            () => Ok(()),
        }
    }

    fn unready(&self, reason: &'static str) -> DeviceError {
        DeviceError::NotReady { machine: self.machine(), reason }
    }

    /// Makes the controller write `token`, the random number of this preparation, into the log file of `program`; the
    /// controller creates this file anew. Then reads the file until the token is visible. The token proves that this
    /// computer and the controller see the same folder, that the controller can write into it, and that later lines of
    /// the file belong to this preparation.
    ///
    /// # Errors
    /// Returns an error if the controller refuses a line, or if the token is not visible within `settle_timeout`.
    async fn open_record(&mut self, program: &FramedProgram, token: u32) -> DeviceResult<()> {
        let record = path(&self.folders.remote, &program.name, RECORD);
        self.controller.enter(ControllerMode::Mdi, MachineCommand::Prepare).await?;
        for line in opening(&record, token) {
            self.controller.order(Set::Mdi(line), MachineCommand::Prepare).await?;
        }
        let began = Instant::now();
        loop {
            let name = program.name.clone();
            let found = self.in_folders(move |folders| folders.record(&name)).await?;
            if found == Some(ProgramRecord { token: Some(token), begun: 0, ended: 0 }) {
                return Ok(());
            }
            if began.elapsed() > self.settings.settle_timeout {
                let (here, there) = (self.folders.local.display(), &self.folders.remote);
                let errors = self.controller.errors().await?.join("; ");
                let reason = format!(
                    "the log file {record}, which the controller writes, does not appear in {here}: check that {there} on \
                     the computer of the controller is this folder, and that the account of LinuxCNC has the right to write there. {errors}"
                );
                return Err(DeviceError::Folder { machine: self.machine(), reason });
            }
            sleep(POLL_INTERVAL).await;
        }
    }

    /// Sends the order that starts the program of the job. Waits until the controller reports that the program runs, or
    /// until the log file shows its begin. Returns the status.
    ///
    /// # Errors
    /// Returns an error if the controller refuses the start and the program does not begin, if the program does not
    /// begin within `settle_timeout`, or if the connection fails.
    pub(super) async fn send_start(&mut self) -> DeviceResult<Status> {
        let heard = self.controller.order(Set::Run, MachineCommand::Start).await;
        let refused = match heard {
            Ok(()) => None,
            Err(refused @ (DeviceError::Refused { .. } | DeviceError::ControlTaken { .. })) => Some(refused),
            Err(error) => return Err(error),
        };
        let sent = Instant::now();
        let limit = if refused.is_some() { NOT_STARTED_CONFIRMATION } else { self.settings.settle_timeout };
        loop {
            match self.has_begun().await {
                Ok(Some(status)) => return Ok(status),
                Ok(None) if sent.elapsed() < limit => sleep(POLL_INTERVAL).await,
                Ok(None) => {
                    let machine = self.machine();
                    return Err(refused.unwrap_or(DeviceError::TimedOut { machine, operation: "a start", limit }));
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Returns the status if the program of the job has begun: the controller reports it as running or paused, or its
    /// log file shows a begin. Returns `None` if neither is true or if there is no job.
    ///
    /// # Errors
    /// Returns an error if the status or the log file cannot be read.
    async fn has_begun(&mut self) -> DeviceResult<Option<Status>> {
        let (seen, status) = self.read_status().await?;
        let Some(work) = self.job.clone() else { return Ok(None) };
        let is_ours = seen.program.as_deref() == Some(&work.path);
        let runs = is_ours && seen.interpreter != Interpreter::Idle;
        let wrote = self.record(&work).await?.is_some_and(|record| record.begun > 0);
        Ok((runs || wrote).then_some(status))
    }
}
