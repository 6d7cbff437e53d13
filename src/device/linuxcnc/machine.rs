//! The grinder, as the cell sees it. `beginning`: preparation and start. `looking`: current state. `reconciling`:
//! outcome of a job after an interruption.
//!
//! ```text
//!  LOAD     the pass in its frame is written into the folder under its own name; the controller opens it
//!  PREPARE  the controller writes a token into the record, which is read back here; then it opens the program
//!  START    `run`, once; the program is seen to run, or has recorded that it began                -> EXECUTE
//!  EXECUTE  every status reads the state; the program records the end of its last motion         -> COMPLETE
//!  HOLD     `pause` -> HELD, anywhere in its path;  RESUME -> EXECUTE
//!  STOP, ABORT  `abort`; the wheel stops where it is, possibly in the part                     -> COMPLETE, ABORTED
//! ```

mod reconcile;
mod start;
mod status;

use std::sync::Arc;
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{SeedableRng as _, random};
use tokio::time::{Instant, timeout};

use super::controller::{Controller, Interpreter};
use super::folder::Folders;
use super::job::{ActiveJob, Stage};
use super::program::{FramedProgram, PROGRAM, ProgramRecord, path};
use super::protocol::{ControllerMode, Set};
use super::settings::LinuxcncSettings;
use crate::Connector;
use crate::error::{DeviceError, DeviceResult};
use crate::handshake::{
    Answer, Armed, Fault, Identity, Job, MachineCommand, MachineKind, MachineState, OperatorConfirmation, Outcome,
    Reconciled, Started, Status, digest,
};
use crate::machine::{Grinder, Interrupt, Machine};
use crate::modbus::SystemConnector;
use crate::payload::{CorrectionMap, Identified, Pass, PassRecord};

/// Interval between two status queries while waiting for a start or a record.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Minimum time of observation before a start is reported as not begun.
const NOT_STARTED_CONFIRMATION: Duration = Duration::from_millis(1050);
/// Timeout of work in a folder, which can be on another computer.
const FOLDER_TIMEOUT: Duration = Duration::from_secs(30);

/// Grinder controlled through linuxcncrsh.
#[derive(Debug)]
pub struct LinuxcncGrinder {
    controller: Controller,
    settings: LinuxcncSettings,
    folders: Folders,
    /// True if another client has taken control. Only an abort takes control back.
    control_lost: bool,
    /// Loaded program, and the digest of its payload.
    loaded: Option<(Arc<FramedProgram>, u32)>,
    job: Option<ActiveJob>,
    /// True after an abort without a job. The machine then requires CLEAR, as after the abort of a job.
    aborted: bool,
    /// Time since which the controller has been seen idle.
    idle_since: Option<Instant>,
    began: Option<Instant>,
    duration_s: Option<f64>,
    fault: Fault,
    /// Position, as the controller reports it, at which a finished program left the wheel clear of the part.
    clear_at: Option<String>,
    /// Line and position seen last, and since when.
    last_motion: Option<(u32, String, Instant)>,
    /// State at the last status query.
    last_state: Option<MachineState>,
    notes: Vec<String>,
    /// Random generator of the preparation tokens.
    rng: StdRng,
}

impl LinuxcncGrinder {
    /// Creates the driver of a grinder. Sends nothing to the grinder yet.
    pub fn new(settings: LinuxcncSettings) -> Self {
        Self::build(settings, Box::new(SystemConnector), (false, random()))
    }

    /// Creates the driver of a grinder that opens its connections with `dial`, uses no other thread, and draws its
    /// random numbers from `seed`: for controllers in the same process, and for simulated time.
    pub fn with_connector(settings: LinuxcncSettings, dial: Box<dyn Connector>, seed: u64) -> Self {
        Self::build(settings, dial, (true, seed))
    }

    fn build(settings: LinuxcncSettings, dial: Box<dyn Connector>, (in_turn, seed): (bool, u64)) -> Self {
        let folders = Folders {
            run: settings.run_folder.clone(),
            local: settings.programs.clone(),
            remote: settings.programs_at_controller.clone(),
            single_threaded: in_turn,
        };
        Self {
            controller: Controller::new(settings.clone(), dial),
            settings,
            folders,
            control_lost: false,
            loaded: None,
            job: None,
            aborted: false,
            idle_since: None,
            began: None,
            duration_s: None,
            fault: Fault::None,
            clear_at: None,
            last_motion: None,
            last_state: None,
            notes: Vec::new(),
            rng: StdRng::seed_from_u64(seed),
        }
    }
}

impl Machine for LinuxcncGrinder {
    fn name(&self) -> &str {
        &self.controller.name
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    async fn connect(&mut self) -> DeviceResult<Identity> {
        let name = self.controller.connect().await?;
        self.find_restored_program().await;
        // The controller has no boot number, and does not know if a real machine is connected.
        let simulation = self.settings.simulated;
        Ok(Identity { kind: MachineKind::Grinder, name, boot_id: 0, simulation, silence_limit_s: None })
    }

    async fn status(&mut self) -> DeviceResult<Status> {
        Ok(self.read_status().await?.1)
    }

    fn restore(&mut self, intended: &Armed) {
        let Armed { job, start_sequence, token, .. } = *intended;
        let (program, path, stage, requested_outcome) = (None, String::new(), Stage::Begun, None);
        let (errors, round) = (Vec::new(), (0, 0));
        self.job = Some(ActiveJob {
            job,
            sequence: start_sequence,
            token,
            program,
            path,
            stage,
            requested_outcome,
            errors,
            round,
        });
    }

    async fn claim(&mut self) -> DeviceResult<Status> {
        self.take_control().await?;
        self.status().await
    }

    async fn prepare(&mut self, job: Job) -> DeviceResult<Armed> {
        let Some((program, loaded)) = self.loaded.clone() else {
            return Err(self.refused(MachineCommand::Prepare, Answer::PayloadMissing));
        };
        if loaded != job.digest || program.cycle + 1 != job.batch_id().cycle {
            return Err(self.refused(MachineCommand::Prepare, Answer::OtherJob));
        }
        if self.aborted || !matches!(self.stage(), None | Some(Stage::Prepared)) {
            return Err(self.refused(MachineCommand::Prepare, Answer::WrongState));
        }
        self.job = None;
        self.prepare_program(job, program).await
    }

    async fn start(&mut self, armed: Armed) -> DeviceResult<Started> {
        let (seen, status) = self.read_status().await?;
        let is_prepared = self.job_for(&armed).is_some_and(|work| work.stage == Stage::Prepared);
        if !is_prepared || status.state != MachineState::Prepared || seen.mode != ControllerMode::Auto {
            return Err(self.refused(MachineCommand::Start, Answer::DeadToken));
        }
        let Armed { job, start_sequence, .. } = armed;
        // From here on the job may have begun, even if this call fails.
        if let Some(work) = self.job_for(&armed) {
            work.stage = Stage::Begun;
        }
        (self.began, self.idle_since) = (Some(Instant::now()), None);
        match self.send_start().await {
            Ok(status) => Ok(Started { job, start_sequence, status }),
            Err(refused @ DeviceError::Refused { .. }) => {
                self.job = None;
                Err(refused)
            }
            Err(reason) => {
                let (machine, reason) = (self.machine(), Box::new(reason));
                Err(DeviceError::StartUnknown { machine, job, sequence: start_sequence, cause: reason })
            }
        }
    }

    async fn hold(&mut self) -> DeviceResult<Status> {
        // An idle controller would be paused without a program. If the program was seen running, the order is sent at
        // once.
        if self.last_state != Some(MachineState::Execute) {
            self.read_status().await?;
        }
        if self.last_state != Some(MachineState::Execute) || self.stage() != Some(Stage::Begun) {
            return Err(self.refused(MachineCommand::Hold, Answer::WrongState));
        }
        let status = self.order(Set::Pause, MachineCommand::Hold).await?;
        self.abort_if_ended(status).await
    }

    async fn resume(&mut self) -> DeviceResult<Status> {
        self.read_status().await?;
        if self.last_state != Some(MachineState::Held) || self.stage() != Some(Stage::Begun) {
            return Err(self.refused(MachineCommand::Resume, Answer::WrongState));
        }
        self.order(Set::Resume, MachineCommand::Resume).await
    }

    async fn stop(&mut self) -> DeviceResult<Status> {
        match self.stage() {
            Some(Stage::Prepared) => {
                self.job = None;
                self.status().await
            }
            Some(Stage::Begun) => {
                self.set_requested_outcome(Outcome::Stopped);
                self.order(Set::Abort, MachineCommand::Stop).await
            }
            _ => {
                self.read_status().await?;
                Err(self.refused(MachineCommand::Stop, Answer::WrongState))
            }
        }
    }

    async fn abort(&mut self) -> DeviceResult<Status> {
        self.set_requested_outcome(Outcome::Aborted);
        if !self.controller.is_connected() {
            self.controller.connect().await?;
        }
        let aborted = match self.controller.abort().await {
            // The connection was lost without notice.
            Err(DeviceError::Disconnected { .. }) => {
                self.controller.connect().await?;
                self.controller.abort().await
            }
            answer => answer,
        };
        match aborted {
            // A machine that is switched off accepts no order. If nothing runs, there is nothing to abort.
            Err(refused @ DeviceError::Refused { .. }) => match self.controller.read_state(false).await?.interpreter {
                Interpreter::Idle => {}
                _ => return Err(refused),
            },
            answer => answer?,
        }
        self.control_lost = false;
        match self.job.as_mut().map(|work| &mut work.stage) {
            Some(Stage::Begun) => {}
            Some(Stage::Ended(state, _)) => *state = MachineState::Aborted,
            Some(Stage::Prepared) | None => (self.job, self.aborted) = (None, true),
        }
        self.status().await
    }

    async fn clear(&mut self) -> DeviceResult<Status> {
        let (seen, status) = self.read_status().await?;
        if !matches!(status.state, MachineState::Aborted | MachineState::Faulted) {
            return Err(self.refused(MachineCommand::Clear, Answer::WrongState));
        }
        if let Some(fault) = seen.standing_fault() {
            return Err(DeviceError::Faulted { machine: self.machine(), state: status.state, fault });
        }
        (self.job, self.aborted, self.fault) = (None, false, Fault::None);
        self.notes.clear();
        self.status().await
    }

    async fn acknowledge(&mut self, done: u32) -> DeviceResult<Status> {
        match &self.job {
            Some(ActiveJob { stage: Stage::Ended(MachineState::Complete, _), sequence, .. }) if *sequence == done => {}
            Some(ActiveJob { stage: Stage::Ended(MachineState::Complete, _), .. }) => {
                return Err(self.refused(MachineCommand::Acknowledge, Answer::OtherResult));
            }
            _ => return Err(self.refused(MachineCommand::Acknowledge, Answer::WrongState)),
        }
        self.job = None;
        self.status().await
    }

    async fn release(&mut self) -> DeviceResult<Status> {
        let status = self.status().await?;
        self.controller.disconnect().await;
        Ok(status)
    }

    async fn reconcile(&mut self, intended: &Armed) -> DeviceResult<Reconciled> {
        match self.job_for(intended) {
            Some(work) if work.program.is_none() => self.find_prepared_program(intended).await?,
            Some(work) => work.stage = if work.stage == Stage::Prepared { Stage::Begun } else { work.stage },
            None => {
                self.restore(intended);
                self.find_prepared_program(intended).await?;
            }
        }
        if self.job.as_ref().is_none_or(|work| work.program.is_none()) {
            return Ok(Reconciled::unknown(
                "the folder of programs has no program whose .log file belongs to this job",
            ));
        }
        match self.start_outcome().await? {
            Some(verdict) => Ok(verdict),
            None => self.confirm_not_started().await,
        }
    }

    async fn confirm(&mut self, word: OperatorConfirmation) -> DeviceResult<Vec<String>> {
        if !self.is_unresolved().await? {
            return Err(DeviceError::ConfirmationNotNeeded { machine: self.machine() });
        }
        let not_taken = |reason: &str| DeviceError::NotAccepted { machine: self.machine(), reason: reason.to_owned() };
        let program = self.job.as_ref().and_then(|work| work.program.clone());
        let ended = match word {
            OperatorConfirmation::Started { .. } => {
                return Err(not_taken(
                    "the grinder has stopped, so the begin cannot be confirmed: type regrind confirm done if the pass is complete, otherwise regrind confirm still",
                ));
            }
            OperatorConfirmation::Done { file: Some(_), .. } => {
                return Err(not_taken("--file is allowed only for a measurement: remove --file"));
            }
            OperatorConfirmation::Done { map_identity: Some(map), .. }
                if program.is_none_or(|program| program.map != map) =>
            {
                return Err(not_taken(
                    "the map in the confirmation is not the map of the prepared program: check which program ran at the grinder",
                ));
            }
            OperatorConfirmation::Done { .. } => Stage::Ended(MachineState::Complete, Outcome::Complete),
            OperatorConfirmation::Still => Stage::Ended(MachineState::Complete, Outcome::Stopped),
        };
        if let Some(work) = &mut self.job {
            work.stage = ended;
        }
        Ok(Vec::new())
    }
}

impl Grinder for LinuxcncGrinder {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> DeviceResult<()> {
        self.loaded = None;
        let (identity, rounds) = (map.identity(), u32::from(pass.spark_out_passes) + 1);
        let program = self.in_folders(move |folders| folders.newest(&identity, rounds)).await?;
        let break_off = |done| match interrupt.is_raised() {
            true => Err(DeviceError::Interrupted { machine: self.machine(), payload: "program", done, total: 2 }),
            false => Ok(()),
        };
        break_off(0)?;
        let put = program.clone();
        self.in_folders(move |folders| folders.put(&put)).await?;
        break_off(1)?;
        let (seen, _) = self.read_status().await?;
        self.check_ready(&seen)?;
        let path = self.path(&program);
        self.controller.open(&path, MachineCommand::Prepare).await?;
        self.loaded = Some((Arc::new(program), digest(&[identity, pass.identity()])));
        Ok(())
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<PassRecord> {
        let no_result = DeviceError::NoResult {
            machine: self.machine(),
            job,
            state: self.last_state.unwrap_or(MachineState::Idle),
        };
        let work = self.job.as_ref().filter(|work| work.job == job).ok_or_else(|| no_result.clone())?;
        let (Stage::Ended(_, outcome), Some(program)) = (work.stage, &work.program) else { return Err(no_result) };
        Ok(PassRecord {
            duration_s: self.duration_s,
            ..PassRecord::unmeasured(outcome, program.map, job, work.sequence)
        })
    }
}

impl LinuxcncGrinder {
    fn machine(&self) -> Arc<str> {
        self.controller.machine()
    }

    fn refused(&self, command: MachineCommand, answer: Answer) -> DeviceError {
        let state = self.last_state.unwrap_or(MachineState::Idle);
        DeviceError::Refused { machine: self.machine(), command, answer, state }
    }

    fn stage(&self) -> Option<Stage> {
        self.job.as_ref().map(|work| work.stage)
    }

    fn job_for(&mut self, armed: &Armed) -> Option<&mut ActiveJob> {
        self.job.as_mut().filter(|work| (work.job, work.token) == (armed.job, armed.token))
    }

    /// Stores `outcome`, the outcome that a person requested, in the current job. Does nothing if there is no job, or
    /// if the job has not started or is over.
    fn set_requested_outcome(&mut self, outcome: Outcome) {
        if let Some(work) = self.job.as_mut().filter(|work| work.stage == Stage::Begun) {
            work.requested_outcome = Some(outcome);
        }
    }

    async fn take_control(&mut self) -> DeviceResult<()> {
        if self.control_lost {
            return Err(self.controller.control_taken());
        }
        self.controller.take_control().await
    }

    /// Sends the order `set` to the controller, then reads and returns the status. `command` is the name of the order
    /// for error messages.
    ///
    /// # Errors
    /// Returns an error with the current state if the controller refuses the order. Returns an error if another client
    /// has control or if the connection fails.
    async fn order(&mut self, set: Set, command: MachineCommand) -> DeviceResult<Status> {
        match self.controller.order(set, command).await {
            Ok(()) => {}
            Err(DeviceError::Refused { answer, .. }) => {
                let _ = self.read_status().await?;
                return Err(self.refused(command, answer));
            }
            Err(error) => {
                self.control_lost |= matches!(error, DeviceError::ControlTaken { .. });
                return Err(error);
            }
        }
        Ok(self.read_status().await?.1)
    }

    /// Sends an abort if the job has already ended when the machine was paused. Without the abort, the controller would
    /// stay paused and accept no other program. Returns the new status after an abort. Otherwise sends nothing and
    /// returns `status` unchanged.
    async fn abort_if_ended(&mut self, status: Status) -> DeviceResult<Status> {
        if !matches!(self.job.as_ref().map(|work| work.stage), Some(Stage::Ended(..))) {
            return Ok(status);
        }
        self.order(Set::Abort, MachineCommand::Hold).await
    }

    /// Runs the file operation `work` on a thread for blocking work, and returns its result. Runs `work` on the current
    /// thread if the driver is single-threaded.
    ///
    /// # Errors
    /// Returns an error with the reason if `work` fails, or if it does not end within 30 s on the other thread.
    async fn in_folders<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Folders) -> Result<T, String> + Send + 'static,
    ) -> DeviceResult<T> {
        let folders = self.folders.clone();
        let done = match self.folders.single_threaded {
            true => Ok(Ok(work(&folders))),
            false => timeout(FOLDER_TIMEOUT, tokio::task::spawn_blocking(move || work(&folders))).await,
        };
        let done = match done {
            Ok(done) => done.unwrap_or_else(|error| Err(error.to_string())),
            Err(_) => Err(format!("{} did not answer within 30 s", self.folders.local.display())),
        };
        done.map_err(|reason| DeviceError::Folder { machine: self.machine(), reason })
    }

    /// Returns the content of the log file that the program of the job `work` wrote. Returns `None` if the program is
    /// not known, or if there is no log file. Also returns `None` if the log file does not contain the token (the
    /// random number) of the preparation of this job.
    ///
    /// # Errors
    /// Returns an error if the log file cannot be read.
    async fn record(&self, work: &ActiveJob) -> DeviceResult<Option<ProgramRecord>> {
        let Some(name) = work.program.as_ref().map(|program| program.name.clone()) else { return Ok(None) };
        Ok(work.own_record(self.in_folders(move |folders| folders.record(&name)).await?))
    }

    fn path(&self, program: &FramedProgram) -> String {
        path(&self.folders.remote, &program.name, PROGRAM)
    }
}
