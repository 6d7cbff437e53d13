//! Machine operated by a person: nothing is connected, and a person is asked for every step and confirms it.
//!
//! ```text
//!  START    shows what to do and what to check; at most once for a job and cycle                -> EXECUTE
//!  EXECUTE  `started` (grinder), then `done`, which for a measurement names its file             -> COMPLETE
//!  HOLD, STOP and ABORT: the person is asked too                               -> HOLDING, STOPPING, ABORTING
//!  HOLDING  `still` -> HELD;  RESUME -> EXECUTE          STOPPING  `still` -> COMPLETE, stopped
//! ```
//!
//! Until a person has confirmed `still`, the machine counts as moving. From START until `done` or `still` it is unknown
//! if it is clear of the part: silence confirms nothing. Page for the shop: docs/manual.md.

mod settings;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use sha2::{Digest, Sha256};
use tokio::time::Instant;

use super::exchange::{ExchangeError, Wanted, check_measurement, file_word, foreign, measurement, plan_csv};
use super::{
    Answer, Answered, Armed, Cmm, Command, CorrectionMap, DeviceError, Grinder, Identified, Identity, Interrupt, Job,
    Machine, MachineKind, Measurement, Outcome, Pass, PassRecord, Plan, Reconciled, Started, State, Status, Word,
    digest, hex,
};
use regrind_formats::result::{Content, read_bytes};
use regrind_formats::{FormatError, ResultFolder, write_atomic};

pub use settings::ManualWire;

/// Settings of a manual machine for its run.
#[derive(Clone, Debug)]
pub struct ManualSettings {
    /// Name of the part in prompts.
    pub part: String,
    /// Folder of the run.
    pub folder: PathBuf,
    /// Known properties of the files of measurements.
    pub content: Content,
    /// Minimum number of points, if any points are accepted.
    pub free_points: Option<usize>,
    /// Minimum share of the targets of which a measurement must have a point.
    pub least_found: f64,
    /// True if the plan itself is accepted as the measurement.
    pub rehearsal: bool,
    /// Maximum difference between the probe radius in a file and the plan's, in mm.
    pub probe_tolerance_mm: f64,
}

/// Work that the person is asked to do.
#[derive(Clone, Debug)]
enum Work {
    Measure(Arc<Plan>),
    Grind(Pass, [u8; 32]),
}

/// Machine operated by a person.
#[derive(Debug)]
pub struct ManualMachine {
    name: Arc<str>,
    kind: MachineKind,
    settings: ManualSettings,
    connected: bool,
    state: State,
    /// Loaded work and its digest.
    work: Option<(Work, u32)>,
    /// Requested job, and its start sequence number.
    job: Option<(Job, u32)>,
    /// Unresolved job of an interrupted run: nobody has said what became of it.
    untold: Option<(Job, u32)>,
    /// Jobs and cycles that were ever requested: none is requested twice.
    asked: Vec<(u32, u16)>,
    outcome: Outcome,
    /// Time at which the start was confirmed.
    begun: Option<Instant>,
    duration_s: Option<f64>,
    /// True if it is clear of the part, as a person confirmed; `None` if unknown.
    clear: Option<bool>,
    measured: Option<Measurement>,
    /// SHA-256 of every accepted file: no two measurements have the same bytes.
    taken: Vec<[u8; 32]>,
}

impl ManualMachine {
    /// Creates a machine operated by a person, for one run.
    pub fn new(kind: MachineKind, settings: ManualSettings) -> Self {
        Self {
            name: format!("{kind} by hand").into(),
            kind,
            settings,
            connected: false,
            state: State::Idle,
            work: None,
            job: None,
            untold: None,
            asked: Vec::new(),
            outcome: Outcome::None,
            begun: None,
            duration_s: None,
            clear: None,
            measured: None,
            taken: Vec::new(),
        }
    }

    fn told(&self) -> Status {
        Status {
            job: self.job.map(|(job, _)| job),
            done: self.job.filter(|_| self.outcome != Outcome::None).map_or(0, |(_, sequence)| sequence),
            outcome: self.outcome,
            clear_of_part: self.clear,
            ..Status::of(self.state)
        }
    }

    fn refused(&self, command: Command, answer: Answer) -> DeviceError {
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state: self.state }
    }

    fn not_taken(&self, why: impl ToString) -> DeviceError {
        DeviceError::NotTaken { machine: Arc::clone(&self.name), why: why.to_string() }
    }

    /// Changes the state to `to` and returns the status.
    ///
    /// # Errors
    /// Refuses with [`Answer::WrongState`] if the current state is not in `from`.
    fn go(&mut self, command: Command, from: &[State], to: State) -> Answered<Status> {
        if !from.contains(&self.state) {
            return Err(self.refused(command, Answer::WrongState));
        }
        self.state = to;
        Ok(self.told())
    }

    fn finish(&mut self, outcome: Outcome) {
        (self.state, self.outcome) = (State::Complete, outcome);
    }

    // ---- what a person is asked ---------------------------------------------------------------------------------------------------

    /// Returns what to do and what to check now, and what to type then.
    fn prompt(&self) -> Vec<String> {
        let Some((job, _)) = self.job else { return Vec::new() };
        let name = self.kind.name();
        let confirm = |what: &str| format!("then: regrind confirm {what}{}", self.run());
        let still =
            |what: &str| vec![format!("{what} it at its own panel"), confirm(&format!("still --machine {name}"))];
        match (self.state, &self.work) {
            (State::Execute, Some((Work::Measure(plan), _))) => self.prompt_to_measure(job, plan, &confirm),
            (State::Execute, Some((Work::Grind(pass, map), _))) => self.prompt_to_grind(job, pass, map, &confirm),
            (State::Holding, _) => still("HOLD"),
            (State::Stopping, _) => still("STOP"),
            (State::Aborting, _) => vec!["ABORT: stop it at its own panel NOW; nothing here can".to_owned()],
            _ => Vec::new(),
        }
    }

    fn prompt_to_measure(&self, job: Job, plan: &Plan, confirm: &dyn Fn(&str) -> String) -> Vec<String> {
        let (part, file) = (&self.settings.part, self.cycle_folder(job).join(plan_file(job)));
        let points = match self.settings.free_points {
            Some(least) => format!("at least {least} points"),
            None => format!("{} points of {}", plan.targets.len(), file.display()),
        };
        vec![
            format!("MEASURE {part}, cycle {}: {points}", job.number()),
            format!("check: right part, clean, clamped; wheel clear of it; probe radius {} mm", plan.probe_radius_mm),
            "when it is measured and the probe is clear of the part,".to_owned(),
            confirm("done --file RESULT"),
        ]
    }

    fn prompt_to_grind(&self, job: Job, pass: &Pass, map: &[u8; 32], confirm: &dyn Fn(&str) -> String) -> Vec<String> {
        if self.begun.is_some() {
            let ended = "when the pass has ended and the wheel is clear of the part,".to_owned();
            return vec![ended, confirm("done")];
        }
        let folder = self.cycle_folder(Job { cycle: job.cycle.saturating_sub(1), ..job });
        let there = program_in(&folder).or_else(|| Some(folder.join("correction.csv")).filter(|file| file.is_file()));
        let by = there.map_or("your own program".to_owned(), |file| file.display().to_string());
        let map = hex(&map[..4]);
        vec![
            format!("GRIND {}, cycle {}: by {by} (map {map})", self.settings.part, job.cycle),
            format!(
                "check: right part, clamped; probe clear of it; wheel radius {} mm, feed {} mm/min, {} spark-out passes",
                pass.wheel_radius_mm, pass.feed_mm_min, pass.spark_out_passes
            ),
            "begin the pass,".to_owned(),
            confirm("started"),
        ]
    }

    /// Returns the run argument of `regrind confirm`; empty if the command finds the newest run by itself.
    fn run(&self) -> String {
        let folder = &self.settings.folder;
        if folder.parent() == Some(Path::new("runs")) { String::new() } else { format!(" {}", folder.display()) }
    }

    fn cycle_folder(&self, job: Job) -> PathBuf {
        self.settings.folder.join(format!("cycle-{}", job.number().cycle))
    }

    // ---- what a person says -------------------------------------------------------------------------------------------------------

    async fn take_word(&mut self, word: Word) -> Answered<Vec<String>> {
        let is_cmm = self.kind == MachineKind::Cmm;
        match word {
            Word::Started { map_identity } | Word::Done { map_identity, .. } if self.is_other(map_identity) => {
                Err(self.not_taken("that is another map than the one asked for: which program is in the grinder?"))
            }
            Word::Started { .. } if is_cmm => Err(self.not_taken("nothing is started here; measure, and confirm done")),
            Word::Started { .. } if self.state == State::Execute => {
                self.begun.get_or_insert_with(Instant::now);
                Ok(Vec::new())
            }
            Word::Done { file, .. } if matches!(self.state, State::Execute | State::Holding | State::Held) => {
                let kept = match file {
                    Some(file) if is_cmm => self.take_file(file).await?,
                    None if is_cmm => return Err(self.not_taken("name the measurement: --file, and where it is")),
                    Some(_) => return Err(self.not_taken("a pass leaves no file: leave --file out")),
                    None if self.begun.is_none() => {
                        return Err(self.not_taken("confirm first that it has begun: regrind confirm started"));
                    }
                    None => Vec::new(),
                };
                self.duration_s = self.begun.map(|begun| begun.elapsed().as_secs_f64());
                self.clear = Some(true);
                self.finish(Outcome::Complete);
                Ok(kept)
            }
            Word::Still if self.state == State::Holding => {
                self.state = State::Held;
                Ok(Vec::new())
            }
            Word::Still if self.state == State::Stopping => {
                self.finish(Outcome::Stopped);
                Ok(Vec::new())
            }
            _ => Err(self.not_taken(format!("it is {}, and nothing of that kind is asked", self.state))),
        }
    }

    /// Returns true if a confirmation names another map than the requested one.
    fn is_other(&self, named: Option<[u8; 32]>) -> bool {
        match &self.work {
            Some((Work::Grind(_, map), _)) => named.is_some_and(|named| named != *map),
            _ => false,
        }
    }

    /// Accepts a file as the requested measurement, and stores its bytes in the folder of the run.
    async fn take_file(&mut self, file: PathBuf) -> Answered<Vec<String>> {
        let (Some((job, done)), Some((Work::Measure(plan), _))) = (self.job, &self.work) else {
            return Err(self.not_taken("no measurement is asked for"));
        };
        let (settings, plan, taken) = (self.settings.clone(), Arc::clone(plan), self.taken.clone());
        let cycle_folder = self.cycle_folder(job);
        let read = tokio::task::spawn_blocking(move || {
            let bytes = read_bytes(&file)?;
            let sha256: [u8; 32] = Sha256::digest(&bytes).into();
            if taken.contains(&sha256) || lies_there(&settings.folder, &sha256) {
                return Err(ExchangeError::Offered { path: file });
            }
            let measurement = measured(&settings, &plan, job, done, &file, &bytes)?;
            // The bytes are stored unchanged, under a name that no other file of the cycle has.
            let extension = file.extension().map_or("txt".to_owned(), |e| file_word(&e.to_string_lossy()));
            let name = format!("result{}.{extension}", of_batch(job));
            write_atomic(&cycle_folder.join(&name), &bytes)?;
            Ok((measurement, sha256, name))
        });
        let (measurement, sha256, name) = read.await.map_err(|e| self.not_taken(e))?.map_err(|e| self.not_taken(e))?;
        self.taken.push(sha256);
        self.measured = Some(measurement);
        let cycle = job.number().cycle;
        Ok(vec![format!("cycle-{cycle}/{}", plan_file(job)), format!("cycle-{cycle}/{name}")])
    }
}

fn plan_file(job: Job) -> String {
    format!("plan{}.csv", of_batch(job))
}

/// Returns the suffix of the file names of a batch; empty for the first batch.
fn of_batch(job: Job) -> String {
    match job.number().batch {
        0 => String::new(),
        before => format!("-{}", before + 1),
    }
}

/// Returns true if a file was accepted before this process resumed the run: the folders of the cycles hold all accepted
/// files.
fn lies_there(run: &Path, sha256: &[u8; 32]) -> bool {
    let within = |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let stem = |path: &Path, wanted: &str| path.file_stem().is_some_and(|stem| stem == wanted);
    let cycles = within(run).filter(|path| path.is_dir());
    let mut results = cycles.flat_map(|cycle| within(&cycle).filter(|path| stem(path, "result")).collect::<Vec<_>>());
    results.any(|path| read_bytes(&path).is_ok_and(|bytes| Sha256::digest(&bytes).as_slice() == sha256))
}

/// Parses the bytes of a file and checks them against the plan. Returns the measurement.
fn measured(
    settings: &ManualSettings,
    plan: &Plan,
    job: Job,
    done: u32,
    path: &Path,
    bytes: &[u8],
) -> Result<Measurement, ExchangeError> {
    let targets: Vec<u32> = plan.targets.iter().map(|target| target.index).collect();
    let wanted = Wanted {
        targets: settings.free_points.is_none().then_some(&targets),
        content: &settings.content,
        probe_radius_mm: plan.probe_radius_mm,
        probe_tolerance_mm: settings.probe_tolerance_mm,
    };
    let identity = plan.identity();
    let file = wanted.read(path, bytes)?;
    if let Some(why) = foreign(&file.statements, &settings.part, job.cycle, &hex(&identity)) {
        return Err(ExchangeError::Foreign { path: path.to_owned(), why });
    }
    let points = wanted.matched(path, &file)?;
    if let Some(expected) = settings.free_points.filter(|least| points.len() < *least) {
        return Err(ExchangeError::Count { path: path.to_owned(), found: points.len(), expected });
    }
    let measurement = measurement(points, &[file], job, identity, done);
    if settings.free_points.is_none() {
        check_measurement(path, plan, &measurement, settings.least_found, settings.rehearsal)?;
    }
    Ok(measurement)
}

/// Writes the plan for the person who measures.
fn write_plan(settings: &ManualSettings, folder: &Path, plan: &Plan, job: Job) -> Result<(), FormatError> {
    ResultFolder::prepare(folder)?.keep();
    let text = plan_csv(&settings.part, job, &hex(&plan.identity()), plan);
    write_atomic(&folder.join("plan.csv"), text.as_bytes())
}

impl Machine for ManualMachine {
    fn name(&self) -> &str {
        &self.name
    }

    fn notes(&self) -> Vec<String> {
        self.prompt()
    }

    async fn connect(&mut self) -> Answered<Identity> {
        self.connected = true;
        Ok(Identity::by_person(self.kind, &self.name))
    }

    async fn status(&mut self) -> Answered<Status> {
        match self.connected {
            true => Ok(self.told()),
            false => Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), what: "its status" }),
        }
    }

    fn restore(&mut self, intended: &Armed) {
        self.untold = Some((intended.job, intended.start_sequence));
        self.asked.push((intended.job.job, intended.job.cycle));
    }

    async fn claim(&mut self) -> Answered<Status> {
        self.status().await
    }

    async fn prepare(&mut self, job: Job) -> Answered<Armed> {
        // The cell continues only after a person has confirmed that the job is over.
        self.untold = None;
        let is_loaded = self.work.as_ref().is_some_and(|(_, digest)| *digest == job.digest);
        if self.state != State::Idle || !is_loaded {
            let answer = if is_loaded { Answer::WrongState } else { Answer::PayloadMissing };
            return Err(self.refused(Command::Prepare, answer));
        }
        if self.asked.contains(&(job.job, job.cycle)) {
            return Err(self.refused(Command::Prepare, Answer::AlreadyBegun));
        }
        if let Some((Work::Measure(plan), _)) = &self.work {
            let (settings, plan, folder) = (self.settings.clone(), Arc::clone(plan), self.cycle_folder(job));
            let written = tokio::task::spawn_blocking(move || write_plan(&settings, &folder, &plan, job));
            written.await.map_err(|e| self.not_taken(e))?.map_err(|e| self.not_taken(e))?;
        }
        let start_sequence = self.asked.len() as u32 + 1;
        (self.job, self.state, self.outcome) = (Some((job, start_sequence)), State::Prepared, Outcome::None);
        (self.begun, self.duration_s, self.measured) = (None, None, None);
        Ok(Armed { job, start_sequence, token: 0, boot_id: 0 })
    }

    async fn start(&mut self, armed: Armed) -> Answered<Started> {
        let Armed { job, start_sequence, .. } = armed;
        if self.state != State::Prepared || self.job != Some((job, start_sequence)) {
            return Err(self.refused(Command::Start, Answer::OtherJob));
        }
        self.asked.push((job.job, job.cycle));
        (self.state, self.clear) = (State::Execute, None);
        Ok(Started { job, start_sequence, status: self.told() })
    }

    async fn hold(&mut self) -> Answered<Status> {
        self.go(Command::Hold, &[State::Execute], State::Holding)
    }

    async fn resume(&mut self) -> Answered<Status> {
        self.go(Command::Resume, &[State::Held], State::Execute)
    }

    async fn stop(&mut self) -> Answered<Status> {
        if let Some(untold) = self.untold.take() {
            (self.job, self.state) = (Some(untold), State::Stopping);
            return Ok(self.told());
        }
        match self.state {
            State::Prepared => (self.state, self.job) = (State::Idle, None),
            // A person has confirmed that it does not move.
            State::Held => self.finish(Outcome::Stopped),
            _ => return self.go(Command::Stop, &[State::Execute, State::Holding], State::Stopping),
        }
        Ok(self.told())
    }

    async fn abort(&mut self) -> Answered<Status> {
        let untold = self.untold.take();
        let may_move = self.state.moves() || untold.is_some();
        self.job = self.job.or(untold);
        self.state = if may_move { State::Aborting } else { State::Aborted };
        self.outcome = Outcome::Aborted;
        Ok(self.told())
    }

    async fn clear(&mut self) -> Answered<Status> {
        (self.job, self.outcome) = (None, Outcome::None);
        self.go(Command::Clear, &[State::Aborted], State::Idle)
    }

    async fn acknowledge(&mut self, done: u32) -> Answered<Status> {
        if self.job.is_none_or(|(_, sequence)| sequence != done) {
            return Err(self.refused(Command::Acknowledge, Answer::OtherResult));
        }
        let status = self.go(Command::Acknowledge, &[State::Complete], State::Idle)?;
        (self.job, self.outcome) = (None, Outcome::None);
        Ok(status)
    }

    async fn release(&mut self) -> Answered<Status> {
        Ok(self.told())
    }

    async fn reconcile(&mut self, intended: &Armed) -> Answered<Reconciled> {
        let ours = self.job == Some((intended.job, intended.start_sequence));
        Ok(match self.state {
            State::Complete | State::Aborted if ours => Reconciled::Finished(self.told()),
            state if ours && (state.moves() || state == State::Held) => Reconciled::Running(self.told()),
            _ => Reconciled::Unknown { why: "only who was asked to do it can tell what became of it".to_owned() },
        })
    }

    async fn confirm(&mut self, word: Word) -> Answered<Vec<String>> {
        self.take_word(word).await
    }
}

impl Cmm for ManualMachine {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> Answered<()> {
        self.work = Some((Work::Measure(Arc::new(plan.clone())), digest(&[plan.identity()])));
        Ok(())
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Answered<Measurement> {
        let measured = self.measured.clone().filter(|m| (m.job, m.cycle) == (job.job, job.cycle));
        measured.ok_or_else(|| DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: self.state })
    }
}

impl Grinder for ManualMachine {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, _: &Interrupt) -> Answered<()> {
        let map = map.identity();
        self.work = Some((Work::Grind(*pass, map), digest(&[map, pass.identity()])));
        Ok(())
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Answered<PassRecord> {
        match (self.job, &self.work) {
            (Some((own, done)), Some((Work::Grind(_, map_identity), _))) if own == job => Ok(PassRecord {
                duration_s: self.duration_s,
                ..PassRecord::unmeasured(self.outcome, *map_identity, job, done)
            }),
            _ => Err(DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: self.state }),
        }
    }
}

/// Returns the path of the program of a pass in the folder of a cycle, in any dialect.
fn program_in(folder: &Path) -> Option<PathBuf> {
    let files = std::fs::read_dir(folder).ok()?.flatten().map(|entry| entry.path());
    let mut programs: Vec<PathBuf> =
        files.filter(|file| file.is_file() && file.file_stem() == Some("toolpath".as_ref())).collect();
    programs.sort();
    programs.into_iter().next()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Machine of a resumed run that was interrupted during a pass.
    fn taken_up() -> ManualMachine {
        let settings = ManualSettings {
            part: "a part".into(),
            folder: PathBuf::new(),
            content: Content::default(),
            free_points: None,
            least_found: 0.0,
            rehearsal: false,
            probe_tolerance_mm: 0.1,
        };
        let mut machine = ManualMachine::new(MachineKind::Grinder, settings);
        let job = Job { job: 7, cycle: 2, digest: 3 };
        machine.restore(&Armed { job, start_sequence: 1, token: 0, boot_id: 0 });
        machine
    }

    #[test]
    fn a_file_that_was_taken_before_the_program_ended_is_known() {
        let run = tempfile::tempdir().unwrap();
        std::fs::create_dir(run.path().join("cycle-1")).unwrap();
        std::fs::write(run.path().join("cycle-1/result.csv"), "1,2,3").unwrap();
        let sha256 = |text: &str| -> [u8; 32] { Sha256::digest(text).into() };
        assert!(lies_there(run.path(), &sha256("1,2,3")));
        assert!(!lies_there(run.path(), &sha256("1,2,4")));
    }

    #[tokio::test]
    async fn what_became_of_the_pass_of_an_interrupted_run_is_nothing_that_this_program_knows() {
        let job = Job { job: 7, cycle: 2, digest: 3 };
        let armed = Armed { job, start_sequence: 1, token: 0, boot_id: 0 };
        assert!(matches!(taken_up().reconcile(&armed).await, Ok(Reconciled::Unknown { .. })));
        // It may be moving: a person must confirm that it does not, and nobody has confirmed an abort.
        let mut machine = taken_up();
        machine.connect().await.unwrap();
        assert_eq!(machine.stop().await.unwrap().state, State::Stopping);
        machine.confirm(Word::Still).await.unwrap();
        let status = machine.status().await.unwrap();
        assert_eq!((status.state, status.outcome), (State::Complete, Outcome::Stopped));
        assert_eq!(taken_up().abort().await.unwrap().state, State::Aborting);
    }
}
