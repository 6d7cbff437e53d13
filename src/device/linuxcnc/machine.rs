//! The grinder as the cell sees it.
//!
//! ```text
//!  LOAD     the program of the pass goes into the folder, in its frame, under a name of its own; the controller opens it
//!  PREPARE  the controller opens the record by a word that is read back here; then the program, and says that it has it
//!  START    `run`, once; the program is seen to run, or to have written that it began                        -> EXECUTE
//!  EXECUTE  every status looks; the end is what the program wrote when its last motion had ended             -> COMPLETE
//!  HOLD     `pause` -> HELD, wherever it is in its path;  RESUME -> EXECUTE
//!  STOP, ABORT  `abort`; the wheel stands where it stood, in the part perhaps                  -> COMPLETE, ABORTED
//! ```

use std::sync::Arc;
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _, random};
use tokio::time::{Instant, sleep, timeout};

use super::controller::{Controller, Interpreter, Seen};
use super::folder::Folders;
use super::program::{PROGRAM, Program, RECORD, Record, opening, path};
use super::protocol::{Mode, Set};
use super::settings::LinuxcncSettings;
use super::work::{Stage, Verdict, Work};
use crate::Dial;
use crate::error::{Answered, DeviceError};
use crate::machine::{Grinder, Interrupt, Machine};
use crate::modbus::OfThisComputer;
use crate::payload::{CorrectionMap, Identified, Pass, PassRecord};
use crate::words::{
    Answer, Armed, Command, Fault, Identity, Job, MachineKind, Outcome, Reconciled, Started, State, Status, Word,
    digest,
};

/// Between two looks where a start or a record is waited for.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// A program that runs moves; one that does not for so long is told of.
const STANDS_AFTER: Duration = Duration::from_secs(5);
/// The span over which a start has to be seen not taken.
const SEEN_TWICE_OVER: Duration = Duration::from_millis(1050);
/// A folder, perhaps on another computer, answers within this.
const FOLDER_WITHIN: Duration = Duration::from_secs(30);

/// A grinder behind linuxcncrsh.
#[derive(Debug)]
pub struct LinuxcncGrinder {
    controller: Controller,
    settings: LinuxcncSettings,
    folders: Folders,
    /// Another client has taken control: it is not taken back but by an abort.
    taken: bool,
    /// The program that lies ready, and the digest of what it is for.
    loaded: Option<(Arc<Program>, u32)>,
    work: Option<Work>,
    /// Ended at once when nothing was begun: needs CLEAR all the same.
    aborted: bool,
    /// Since when the controller has been seen idle.
    idle_since: Option<Instant>,
    began: Option<Instant>,
    duration_s: Option<f64>,
    fault: Fault,
    /// Where a program that had ended left the machine, clear of the part.
    clear_at: Option<String>,
    /// The line and the place that were seen last, and since when.
    moved: Option<(u32, String, Instant)>,
    /// What the last look showed.
    last: Option<State>,
    notes: Vec<String>,
    /// Where the words of preparations come from.
    chance: StdRng,
}

impl LinuxcncGrinder {
    /// A grinder; nothing is asked of it yet.
    pub fn new(settings: LinuxcncSettings) -> Self {
        Self::by(settings, Box::new(OfThisComputer), (false, random()))
    }

    /// A grinder whose connections somebody else opens, beside which no thread works, and whose dice are those of the seed: for controllers
    /// that stand in the same process, and for time that does not pass by itself.
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

    fn machine(&self) -> Arc<str> {
        self.controller.machine()
    }

    fn refused(&self, command: Command, answer: Answer) -> DeviceError {
        let state = self.last.unwrap_or(State::Idle);
        DeviceError::Refused { machine: self.machine(), command, answer, state }
    }

    fn unready(&self, why: &'static str) -> DeviceError {
        DeviceError::Unready { machine: self.machine(), why }
    }

    /// Does something with the folders, on a thread for blocking work.
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

    /// What the program of a job wrote of itself.
    async fn record(&self, work: &Work) -> Answered<Option<Record>> {
        let Some(name) = work.program.as_ref().map(|program| program.name.clone()) else { return Ok(None) };
        Ok(work.owns(self.in_folders(move |folders| folders.record(&name)).await?))
    }

    // ---- looking -----------------------------------------------------------------------------------------------------------------

    /// Looks at the controller, and at the record where a job may be over.
    async fn look(&mut self) -> Answered<(Seen, Status)> {
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

    /// A controller whose task has died goes on telling what it told last. It has no beat by which that could be known for sure.
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

    fn note(&mut self, note: String) {
        const KEPT: usize = 20;
        if !self.notes.contains(&note) {
            self.notes.push(note);
        }
        let more = self.notes.len().saturating_sub(KEPT);
        self.notes.drain(..more);
    }

    /// Brings the job to where it stands by what is seen.
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
        // Begun at the machine's own panel it is begun all the same.
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

    /// How it stands, in the words of every machine.
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
                // Nobody knows that it stands still before the record was read, or a person has said so.
                _ => Status { state: State::Execute, ..status },
            },
            Stage::Prepared if seen.interpreter != Interpreter::Idle => blank,
            Stage::Prepared if seen.stopped || !seen.on => Status { fault: standing_fault(seen), ..status },
            Stage::Prepared if seen.program.as_deref() != Some(&work.path) => blank,
            Stage::Prepared => Status { state: State::Prepared, ..status },
        }
    }

    /// Where it stands when no job of ours is at work.
    fn free(&self, seen: &Seen) -> State {
        match seen.interpreter {
            Interpreter::Running => State::Execute,
            Interpreter::Paused => State::Held,
            Interpreter::Idle if self.aborted => State::Aborted,
            Interpreter::Idle if seen.stopped || !seen.on => State::Faulted,
            Interpreter::Idle => State::Idle,
        }
    }

    // ---- preparing ---------------------------------------------------------------------------------------------------------------

    /// Refuses what must not be begun with: nothing here makes the machine ready but a person at it.
    fn check_ready(&self, seen: &Seen) -> Answered<()> {
        match () {
            () if seen.stopped || !seen.on => {
                let (state, fault) = (State::Faulted, standing_fault(seen).unwrap_or(Fault::None));
                Err(DeviceError::Faulted { machine: self.machine(), state, fault })
            }
            () if seen.interpreter == Interpreter::Running => Err(self.unready("it runs a program")),
            () if seen.interpreter == Interpreter::Paused => {
                Err(self.unready("a program is paused at it: end it at the machine"))
            }
            () if !seen.homed => Err(self.unready("it is not homed: home it at the machine")),
            () => Ok(()),
        }
    }

    fn path(&self, program: &Program) -> String {
        path(&self.folders.there, &program.name, PROGRAM)
    }

    /// Has the controller open the record, and reads there what it was told to write: so both see one folder, the controller can write
    /// in it, and what is found in the record later is of this preparation.
    async fn open_record(&mut self, program: &Program, token: u32) -> Answered<()> {
        let record = path(&self.folders.there, &program.name, RECORD);
        self.controller.enter(Mode::Mdi, Command::Prepare).await?;
        for line in opening(&record, token) {
            self.controller.order(Set::Mdi(line), Command::Prepare).await?;
        }
        let began = Instant::now();
        loop {
            let name = program.name.clone();
            let found = self.in_folders(move |folders| folders.record(&name)).await?;
            if found == Some(Record { prepared: Some(token), begun: 0, ended: 0 }) {
                return Ok(());
            }
            if began.elapsed() > self.settings.settle_within {
                let (here, there) = (self.folders.here.display(), &self.folders.there);
                let errors = self.controller.errors().await?.join("; ");
                let why = format!(
                    "what the controller writes to {record} is not seen in {here}: is {there} the same folder, and may the account that \
                     LinuxCNC runs by write there? {errors}"
                );
                return Err(DeviceError::Folder { machine: self.machine(), why });
            }
            sleep(LOOK_EVERY).await;
        }
    }

    async fn prepared(&mut self, job: Job, program: Arc<Program>) -> Answered<Armed> {
        let (seen, _) = self.look().await?;
        self.check_ready(&seen)?;
        if !self.controller.owned {
            return Err(self.refused(Command::Prepare, Answer::NotOwner));
        }
        let name = program.name.clone();
        let before = self.in_folders(move |folders| folders.record(&name)).await?.unwrap_or_default();
        if before.begun > 0 {
            return Err(self.refused(Command::Prepare, Answer::AlreadyBegun));
        }
        let token = self.chance.random::<u32>().max(1);
        self.controller.errors().await?;
        self.open_record(&program, token).await?;
        self.controller.enter(Mode::Auto, Command::Prepare).await?;
        let path = self.path(&program);
        self.controller.open(&path, Command::Prepare).await?;
        let sequence = u32::from(job.cycle).max(1);
        let (stage, wanted, errors, round) = (Stage::Prepared, None, Vec::new(), (0, 0));
        self.work = Some(Work { job, sequence, token, program: Some(program), path, stage, wanted, errors, round });
        (self.began, self.duration_s, self.fault, self.clear_at) = (None, None, Fault::None, None);
        self.notes.clear();
        self.last = Some(State::Prepared);
        Ok(Armed { job, start_sequence: sequence, token, boot_id: 0 })
    }

    // ---- starting ----------------------------------------------------------------------------------------------------------------

    /// Whether the program of the job is seen to run, or has written that it began.
    async fn has_begun(&mut self) -> Answered<Option<Status>> {
        let (seen, status) = self.look().await?;
        let Some(work) = self.work.clone() else { return Ok(None) };
        let is_ours = seen.program.as_deref() == Some(&work.path);
        let runs = is_ours && seen.interpreter != Interpreter::Idle;
        let wrote = self.record(&work).await?.is_some_and(|record| record.begun > 0);
        Ok((runs || wrote).then_some(status))
    }

    /// Sends the one line that begins it, and waits until that shows.
    async fn run(&mut self) -> Answered<Status> {
        let heard = self.controller.order(Set::Run, Command::Start).await;
        let refused = match heard {
            Ok(()) => None,
            Err(refused @ (DeviceError::Refused { .. } | DeviceError::ControlTaken { .. })) => Some(refused),
            Err(error) => return Err(error),
        };
        let sent = Instant::now();
        let limit = if refused.is_some() { SEEN_TWICE_OVER } else { self.settings.settle_within };
        loop {
            match self.has_begun().await {
                Ok(Some(status)) => return Ok(status),
                Ok(None) if sent.elapsed() < limit => sleep(LOOK_EVERY).await,
                Ok(None) => {
                    let machine = self.machine();
                    return Err(refused.unwrap_or(DeviceError::TimedOut { machine, what: "a start", limit }));
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn work_of(&mut self, armed: &Armed) -> Option<&mut Work> {
        self.work.as_mut().filter(|work| (work.job, work.token) == (armed.job, armed.token))
    }

    // ---- reconciling -------------------------------------------------------------------------------------------------------------

    /// Finds again what was prepared before this program began.
    async fn find_again(&mut self, intended: &Armed) -> Answered<()> {
        let (cycle, token) = (intended.job.number().cycle.saturating_sub(1), intended.token);
        if let Some(program) = self.in_folders(move |folders| folders.prepared(cycle, token)).await? {
            let (path, program) = (self.path(&program), Arc::new(program));
            if let Some(work) = self.work_of(intended) {
                (work.program, work.path) = (Some(program), path);
            }
        }
        Ok(())
    }

    /// A job that was taken in before anything was connected is looked for at once, so that what runs is known for it.
    async fn find_what_was_restored(&mut self) {
        let Some(work) = self.work.as_ref().filter(|work| work.program.is_none()) else { return };
        let intended = Armed { job: work.job, start_sequence: work.sequence, token: work.token, boot_id: 0 };
        if let Err(error) = self.find_again(&intended).await {
            self.note(error.to_string());
        }
    }

    /// What became of a job, if that can be told now.
    async fn what_became(&mut self) -> Answered<Option<Reconciled>> {
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

    /// Behind a new claim no line of an older connection can begin anything. What was not begun over more than a second then, and has its
    /// record as it was when it was prepared, was not begun.
    async fn was_not_begun(&mut self) -> Answered<Reconciled> {
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

    async fn claim_again(&mut self) -> Answered<()> {
        if self.taken {
            return Err(self.controller.taken());
        }
        self.controller.take().await
    }

    /// An order that a job which runs or holds is given.
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

    /// A pause that came when the program had just ended is taken back, so that the controller is free.
    async fn free_if_over(&mut self, status: Status) -> Answered<Status> {
        if !matches!(self.work.as_ref().map(|work| work.stage), Some(Stage::Ended(..))) {
            return Ok(status);
        }
        self.order(Set::Abort, Command::Hold).await
    }

    /// How the job is to end, if one was begun.
    fn want(&mut self, outcome: Outcome) {
        if let Some(work) = self.work.as_mut().filter(|work| work.stage == Stage::Begun) {
            work.wanted = Some(outcome);
        }
    }

    fn stage(&self) -> Option<Stage> {
        self.work.as_ref().map(|work| work.stage)
    }

    /// Whether the controller stands and only a person can tell what became of the job.
    async fn is_untold(&mut self) -> Answered<bool> {
        let (seen, _) = self.look().await?;
        let Some(work) = self.work.clone().filter(|work| work.stage == Stage::Begun) else { return Ok(false) };
        let record = self.record(&work).await?;
        let settles = self.settings.record_within;
        Ok(work.judge(&seen, record, settles, settles) == Verdict::Untold)
    }
}

/// What stands in the way of a machine at which no job is.
fn standing_fault(seen: &Seen) -> Option<Fault> {
    match (seen.stopped, seen.on) {
        (true, _) => Some(Fault::StopCircuit),
        (false, false) => Some(Fault::Supplies),
        (false, true) => None,
    }
}

fn unknown(why: &str) -> Reconciled {
    Reconciled::Unknown { why: why.to_owned() }
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
        // It has no number that changes when it is restarted, and does not know whether a machine is behind it.
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
        // From here on it may have begun, however this ends.
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
        // A controller that is idle would be paused without a program; one that was seen to run is told at once.
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
            // The connection was lost and nobody had noticed.
            Err(DeviceError::Disconnected { .. }) => {
                self.controller.meet().await?;
                self.controller.abort().await
            }
            answer => answer,
        };
        match aborted {
            // What is switched off takes no order. Where nothing runs there is nothing to end.
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
