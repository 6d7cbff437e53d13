//! The grinder, as the cell sees it. `beginning`: preparation and start. `looking`: current state. `reconciling`: fate
//! of a job after an interruption.
//!
//! ```text
//!  LOAD     the pass in its frame is written into the folder under its own name; the controller opens it
//!  PREPARE  the controller writes a token into the record, which is read back here; then it opens the program
//!  START    `run`, once; the program is seen to run, or has recorded that it began                -> EXECUTE
//!  EXECUTE  every status reads the state; the program records the end of its last motion         -> COMPLETE
//!  HOLD     `pause` -> HELD, anywhere in its path;  RESUME -> EXECUTE
//!  STOP, ABORT  `abort`; the wheel stops where it is, possibly in the part                     -> COMPLETE, ABORTED
//! ```

mod beginning;
mod looking;
mod reconciling;

use std::sync::Arc;
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{SeedableRng as _, random};
use tokio::time::{Instant, timeout};

use super::controller::{Controller, Interpreter};
use super::folder::Folders;
use super::program::{PROGRAM, Program, Record, path};
use super::protocol::{Mode, Set};
use super::settings::LinuxcncSettings;
use super::work::{Stage, Work};
use crate::Dial;
use crate::error::{Answered, DeviceError};
use crate::machine::{Grinder, Interrupt, Machine};
use crate::modbus::OfThisComputer;
use crate::payload::{CorrectionMap, Identified, Pass, PassRecord};
use crate::words::{
    Answer, Armed, Command, Fault, Identity, Job, MachineKind, Outcome, Reconciled, Started, State, Status, Word,
    digest,
};
use looking::standing_fault;
use reconciling::unknown;

/// Interval between two status queries while waiting for a start or a record.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Minimum time over which a start must be seen not to have happened.
const SEEN_TWICE_OVER: Duration = Duration::from_millis(1050);
/// Timeout of work in a folder, which can be on another computer.
const FOLDER_WITHIN: Duration = Duration::from_secs(30);

/// Grinder controlled through linuxcncrsh.
#[derive(Debug)]
pub struct LinuxcncGrinder {
    controller: Controller,
    settings: LinuxcncSettings,
    folders: Folders,
    /// True if another client has taken control. Only an abort takes control back.
    taken: bool,
    /// Loaded program, and the digest of its payload.
    loaded: Option<(Arc<Program>, u32)>,
    work: Option<Work>,
    /// True if aborted when no job had begun: CLEAR is needed all the same.
    aborted: bool,
    /// Time since which the controller has been seen idle.
    idle_since: Option<Instant>,
    began: Option<Instant>,
    duration_s: Option<f64>,
    fault: Fault,
    /// Position, clear of the part, at which a finished program left the machine.
    clear_at: Option<String>,
    /// Line and position seen last, and since when.
    moved: Option<(u32, String, Instant)>,
    /// State at the last status query.
    last: Option<State>,
    notes: Vec<String>,
    /// Random generator of the preparation tokens.
    chance: StdRng,
}

impl LinuxcncGrinder {
    /// Creates a grinder; sends nothing to it yet.
    pub fn new(settings: LinuxcncSettings) -> Self {
        Self::by(settings, Box::new(OfThisComputer), (false, random()))
    }

    /// Creates a grinder that opens its connections with `dial`, uses no other thread, and draws its random numbers
    /// from `seed`: for controllers in the same process, and for simulated time.
    pub fn over(settings: LinuxcncSettings, dial: Box<dyn Dial>, seed: u64) -> Self {
        Self::by(settings, dial, (true, seed))
    }

    fn by(settings: LinuxcncSettings, dial: Box<dyn Dial>, (in_turn, seed): (bool, u64)) -> Self {
        let folders = Folders {
            run: settings.run_folder.clone(),
            here: settings.programs.clone(),
            there: settings.programs_at_controller.clone(),
            in_turn,
        };
        Self {
            controller: Controller::new(settings.clone(), dial),
            settings,
            folders,
            taken: false,
            loaded: None,
            work: None,
            aborted: false,
            idle_since: None,
            began: None,
            duration_s: None,
            fault: Fault::None,
            clear_at: None,
            moved: None,
            last: None,
            notes: Vec::new(),
            chance: StdRng::seed_from_u64(seed),
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

    async fn connect(&mut self) -> Answered<Identity> {
        let name = self.controller.meet().await?;
        self.find_what_was_restored().await;
        // The controller has no boot number, and does not know if a real machine is connected.
        let simulation = self.settings.simulated;
        Ok(Identity { kind: MachineKind::Grinder, name, boot_id: 0, simulation, silence_limit_s: None })
    }

    async fn status(&mut self) -> Answered<Status> {
        Ok(self.look().await?.1)
    }

    fn restore(&mut self, intended: &Armed) {
        let Armed { job, start_sequence, token, .. } = *intended;
        let (program, path, stage, wanted) = (None, String::new(), Stage::Begun, None);
        let (errors, round) = (Vec::new(), (0, 0));
        self.work = Some(Work { job, sequence: start_sequence, token, program, path, stage, wanted, errors, round });
    }

    async fn claim(&mut self) -> Answered<Status> {
        self.claim_again().await?;
        self.status().await
    }

    async fn prepare(&mut self, job: Job) -> Answered<Armed> {
        let Some((program, loaded)) = self.loaded.clone() else {
            return Err(self.refused(Command::Prepare, Answer::PayloadMissing));
        };
        if loaded != job.digest || program.cycle + 1 != job.number().cycle {
            return Err(self.refused(Command::Prepare, Answer::OtherJob));
        }
        if self.aborted || !matches!(self.stage(), None | Some(Stage::Prepared)) {
            return Err(self.refused(Command::Prepare, Answer::WrongState));
        }
        self.work = None;
        self.prepared(job, program).await
    }

    async fn start(&mut self, armed: Armed) -> Answered<Started> {
        let (seen, status) = self.look().await?;
        let is_prepared = self.work_of(&armed).is_some_and(|work| work.stage == Stage::Prepared);
        if !is_prepared || status.state != State::Prepared || seen.mode != Mode::Auto {
            return Err(self.refused(Command::Start, Answer::DeadToken));
        }
        let Armed { job, start_sequence, .. } = armed;
        // From here on the job may have begun, even if this call fails.
        if let Some(work) = self.work_of(&armed) {
            work.stage = Stage::Begun;
        }
        (self.began, self.idle_since) = (Some(Instant::now()), None);
        match self.run().await {
            Ok(status) => Ok(Started { job, start_sequence, status }),
            Err(refused @ DeviceError::Refused { .. }) => {
                self.work = None;
                Err(refused)
            }
            Err(why) => {
                let (machine, why) = (self.machine(), Box::new(why));
                Err(DeviceError::StartUnknown { machine, job, sequence: start_sequence, why })
            }
        }
    }

    async fn hold(&mut self) -> Answered<Status> {
        // An idle controller would be paused without a program. If the program was seen running, the order is sent at
        // once.
        if self.last != Some(State::Execute) {
            self.look().await?;
        }
        if self.last != Some(State::Execute) || self.stage() != Some(Stage::Begun) {
            return Err(self.refused(Command::Hold, Answer::WrongState));
        }
        let status = self.order(Set::Pause, Command::Hold).await?;
        self.free_if_over(status).await
    }

    async fn resume(&mut self) -> Answered<Status> {
        self.look().await?;
        if self.last != Some(State::Held) || self.stage() != Some(Stage::Begun) {
            return Err(self.refused(Command::Resume, Answer::WrongState));
        }
        self.order(Set::Resume, Command::Resume).await
    }

    async fn stop(&mut self) -> Answered<Status> {
        match self.stage() {
            Some(Stage::Prepared) => {
                self.work = None;
                self.status().await
            }
            Some(Stage::Begun) => {
                self.want(Outcome::Stopped);
                self.order(Set::Abort, Command::Stop).await
            }
            _ => {
                self.look().await?;
                Err(self.refused(Command::Stop, Answer::WrongState))
            }
        }
    }

    async fn abort(&mut self) -> Answered<Status> {
        self.want(Outcome::Aborted);
        if !self.controller.is_connected() {
            self.controller.meet().await?;
        }
        let aborted = match self.controller.abort().await {
            // The connection was lost without notice.
            Err(DeviceError::Disconnected { .. }) => {
                self.controller.meet().await?;
                self.controller.abort().await
            }
            answer => answer,
        };
        match aborted {
            // A machine that is switched off accepts no order. If nothing runs, there is nothing to abort.
            Err(refused @ DeviceError::Refused { .. }) => match self.controller.look(false).await?.interpreter {
                Interpreter::Idle => {}
                _ => return Err(refused),
            },
            answer => answer?,
        }
        self.taken = false;
        match self.work.as_mut().map(|work| &mut work.stage) {
            Some(Stage::Begun) => {}
            Some(Stage::Ended(state, _)) => *state = State::Aborted,
            Some(Stage::Prepared) | None => (self.work, self.aborted) = (None, true),
        }
        self.status().await
    }

    async fn clear(&mut self) -> Answered<Status> {
        let (seen, status) = self.look().await?;
        if !matches!(status.state, State::Aborted | State::Faulted) {
            return Err(self.refused(Command::Clear, Answer::WrongState));
        }
        if let Some(fault) = standing_fault(&seen) {
            return Err(DeviceError::Faulted { machine: self.machine(), state: status.state, fault });
        }
        (self.work, self.aborted, self.fault) = (None, false, Fault::None);
        self.notes.clear();
        self.status().await
    }

    async fn acknowledge(&mut self, done: u32) -> Answered<Status> {
        match &self.work {
            Some(Work { stage: Stage::Ended(State::Complete, _), sequence, .. }) if *sequence == done => {}
            Some(Work { stage: Stage::Ended(State::Complete, _), .. }) => {
                return Err(self.refused(Command::Acknowledge, Answer::OtherResult));
            }
            _ => return Err(self.refused(Command::Acknowledge, Answer::WrongState)),
        }
        self.work = None;
        self.status().await
    }

    async fn release(&mut self) -> Answered<Status> {
        let status = self.status().await?;
        self.controller.leave().await;
        Ok(status)
    }

    async fn reconcile(&mut self, intended: &Armed) -> Answered<Reconciled> {
        match self.work_of(intended) {
            Some(work) if work.program.is_none() => self.find_again(intended).await?,
            Some(work) => work.stage = if work.stage == Stage::Prepared { Stage::Begun } else { work.stage },
            None => {
                self.restore(intended);
                self.find_again(intended).await?;
            }
        }
        if self.work.as_ref().is_none_or(|work| work.program.is_none()) {
            return Ok(unknown("the record of its preparation is not in the folder of programs"));
        }
        match self.what_became().await? {
            Some(verdict) => Ok(verdict),
            None => self.was_not_begun().await,
        }
    }

    async fn confirm(&mut self, word: Word) -> Answered<Vec<String>> {
        if !self.is_untold().await? {
            return Err(DeviceError::TellsItself { machine: self.machine() });
        }
        let not_taken = |why: &str| DeviceError::NotTaken { machine: self.machine(), why: why.to_owned() };
        let program = self.work.as_ref().and_then(|work| work.program.clone());
        let ended = match word {
            Word::Started { .. } => return Err(not_taken("it stands; confirm done, or still")),
            Word::Done { file: Some(_), .. } => return Err(not_taken("a pass leaves no file: leave --file out")),
            Word::Done { map_identity: Some(map), .. } if program.is_none_or(|program| program.map != map) => {
                return Err(not_taken("that is another map than the one of its program"));
            }
            Word::Done { .. } => Stage::Ended(State::Complete, Outcome::Complete),
            Word::Still => Stage::Ended(State::Complete, Outcome::Stopped),
        };
        if let Some(work) = &mut self.work {
            work.stage = ended;
        }
        Ok(Vec::new())
    }
}

impl Grinder for LinuxcncGrinder {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Answered<()> {
        self.loaded = None;
        let (identity, rounds) = (map.identity(), u32::from(pass.spark_out_passes) + 1);
        let program = self.in_folders(move |folders| folders.newest(&identity, rounds)).await?;
        let break_off = |done| match interrupt.is_raised() {
            true => Err(DeviceError::Interrupted { machine: self.machine(), what: "program", done, of: 2 }),
            false => Ok(()),
        };
        break_off(0)?;
        let put = program.clone();
        self.in_folders(move |folders| folders.put(&put)).await?;
        break_off(1)?;
        let (seen, _) = self.look().await?;
        self.check_ready(&seen)?;
        let path = self.path(&program);
        self.controller.open(&path, Command::Prepare).await?;
        self.loaded = Some((Arc::new(program), digest(&[identity, pass.identity()])));
        Ok(())
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Answered<PassRecord> {
        let no_result = DeviceError::NoResult { machine: self.machine(), job, state: self.last.unwrap_or(State::Idle) };
        let work = self.work.as_ref().filter(|work| work.job == job).ok_or_else(|| no_result.clone())?;
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

    fn refused(&self, command: Command, answer: Answer) -> DeviceError {
        let state = self.last.unwrap_or(State::Idle);
        DeviceError::Refused { machine: self.machine(), command, answer, state }
    }

    fn stage(&self) -> Option<Stage> {
        self.work.as_ref().map(|work| work.stage)
    }

    fn work_of(&mut self, armed: &Armed) -> Option<&mut Work> {
        self.work.as_mut().filter(|work| (work.job, work.token) == (armed.job, armed.token))
    }

    /// Stores the requested outcome of the job, if one was begun.
    fn want(&mut self, outcome: Outcome) {
        if let Some(work) = self.work.as_mut().filter(|work| work.stage == Stage::Begun) {
            work.wanted = Some(outcome);
        }
    }

    async fn claim_again(&mut self) -> Answered<()> {
        if self.taken {
            return Err(self.controller.taken());
        }
        self.controller.take().await
    }

    /// Sends an order to a running or held job.
    async fn order(&mut self, set: Set, command: Command) -> Answered<Status> {
        match self.controller.order(set, command).await {
            Ok(()) => {}
            Err(DeviceError::Refused { answer, .. }) => {
                let _ = self.look().await?;
                return Err(self.refused(command, answer));
            }
            Err(error) => {
                self.taken |= matches!(error, DeviceError::ControlTaken { .. });
                return Err(error);
            }
        }
        Ok(self.look().await?.1)
    }

    /// Ends a pause that came just after the end of the program, so that the controller is free.
    async fn free_if_over(&mut self, status: Status) -> Answered<Status> {
        if !matches!(self.work.as_ref().map(|work| work.stage), Some(Stage::Ended(..))) {
            return Ok(status);
        }
        self.order(Set::Abort, Command::Hold).await
    }

    /// Runs work in the folders on a thread for blocking work.
    async fn in_folders<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Folders) -> Result<T, String> + Send + 'static,
    ) -> Answered<T> {
        let folders = self.folders.clone();
        let done = match self.folders.in_turn {
            true => Ok(Ok(work(&folders))),
            false => timeout(FOLDER_WITHIN, tokio::task::spawn_blocking(move || work(&folders))).await,
        };
        let done = match done {
            Ok(done) => done.unwrap_or_else(|error| Err(error.to_string())),
            Err(_) => Err(format!("{} did not answer within 30 s", self.folders.here.display())),
        };
        done.map_err(|why| DeviceError::Folder { machine: self.machine(), why })
    }

    /// Returns the record that the program of a job wrote, if its token is that of this preparation.
    async fn record(&self, work: &Work) -> Answered<Option<Record>> {
        let Some(name) = work.program.as_ref().map(|program| program.name.clone()) else { return Ok(None) };
        Ok(work.owns(self.in_folders(move |folders| folders.record(&name)).await?))
    }

    fn path(&self, program: &Program) -> String {
        path(&self.folders.there, &program.name, PROGRAM)
    }
}
