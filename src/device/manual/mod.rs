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

use data_encoding::HEXLOWER;
use sha2::{Digest, Sha256};
use tokio::time::Instant;

use super::file_exchange::{
    ExchangeError, ResultRequirements, assemble_measurement, check_measurement, contradiction, file_word, plan_csv,
};
use super::{
    Answer, Armed, BatchId, Cmm, CorrectionMap, DeviceError, DeviceResult, Grinder, Identified, Identity, Interrupt,
    Job, Machine, MachineCommand, MachineKind, MachineState, Measurement, OperatorConfirmation, Outcome, Pass,
    PassRecord, Plan, Reconciled, Started, Status, digest,
};
use regrind_formats::operator_step::{OperatorAction, OperatorStep, RequiredPoints, StepConfirmation, run_argument};
use regrind_formats::result::{Content, read_bytes};
use regrind_formats::run_files::{
    CycleFile, CycleFolder, is_machine_result_file, machine_result_file, plan_file, program_for_pass,
};
use regrind_formats::{FormatError, ResultFolder, write_atomic};

pub use settings::ManualWire;

/// Settings of a manual machine for its run.
#[derive(Clone, Debug)]
pub struct ManualSettings {
    /// Name of the part in prompts.
    pub part: String,
    /// Folder of the run.
    pub run_folder: PathBuf,
    /// Known properties of the files of measurements.
    pub content: Content,
    /// Minimum number of points, if any points are accepted.
    pub min_free_points: Option<usize>,
    /// Minimum fraction of the targets that need a point in a measurement, from 0 to 1.
    pub min_coverage: f64,
    /// True if the plan itself is accepted as the measurement.
    pub rehearsal: bool,
    /// Maximum difference between the probe radius in a file and the plan's, in mm.
    pub probe_tolerance_mm: f64,
}

/// Work that the person is asked to do.
#[derive(Clone, Debug)]
enum ManualTask {
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
    state: MachineState,
    /// Loaded work and its digest.
    task: Option<(ManualTask, u32)>,
    /// Requested job, and its start sequence number.
    job: Option<(Job, u32)>,
    /// Unresolved job of an interrupted run, with its start sequence number. A person has not confirmed its outcome
    /// yet.
    unresolved: Option<(Job, u32)>,
    /// Job and cycle of every request so far, because the same job and cycle is never requested twice.
    requested_jobs: Vec<(u32, u16)>,
    outcome: Outcome,
    /// Time at which the start was confirmed.
    started_at: Option<Instant>,
    duration_s: Option<f64>,
    /// True if it is clear of the part, as a person confirmed; `None` if unknown.
    clear_of_part: Option<bool>,
    measurement: Option<Measurement>,
    /// SHA-256 of every accepted file, because the same bytes are never accepted twice.
    accepted_files: Vec<[u8; 32]>,
}

impl ManualMachine {
    /// Creates the driver of a machine that a person operates, for one run.
    pub fn new(kind: MachineKind, settings: ManualSettings) -> Self {
        Self {
            name: format!("{kind} by hand").into(),
            kind,
            settings,
            connected: false,
            state: MachineState::Idle,
            task: None,
            job: None,
            unresolved: None,
            requested_jobs: Vec::new(),
            outcome: Outcome::None,
            started_at: None,
            duration_s: None,
            clear_of_part: None,
            measurement: None,
            accepted_files: Vec::new(),
        }
    }

    fn current_status(&self) -> Status {
        Status {
            job: self.job.map(|(job, _)| job),
            done: self.job.filter(|_| self.outcome != Outcome::None).map_or(0, |(_, sequence)| sequence),
            outcome: self.outcome,
            clear_of_part: self.clear_of_part,
            ..Status::from_state(self.state)
        }
    }

    fn refused(&self, command: MachineCommand, answer: Answer) -> DeviceError {
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state: self.state }
    }

    fn not_accepted(&self, reason: impl ToString) -> DeviceError {
        DeviceError::NotAccepted { machine: Arc::clone(&self.name), reason: reason.to_string() }
    }

    /// Changes the state of the machine from one of the states in `from` to `to`. Returns the new status. `command` is
    /// the command of the client that causes the change; the error names this command.
    ///
    /// # Errors
    /// Returns the refusal [`Answer::WrongState`] if the current state is not in `from`. The state then does not
    /// change.
    fn transition(&mut self, command: MachineCommand, from: &[MachineState], to: MachineState) -> DeviceResult<Status> {
        if !from.contains(&self.state) {
            return Err(self.refused(command, Answer::WrongState));
        }
        self.state = to;
        Ok(self.current_status())
    }

    fn finish(&mut self, outcome: Outcome) {
        (self.state, self.outcome) = (MachineState::Complete, outcome);
    }

    // ---- what a person is asked ---------------------------------------------------------------------------------------------------

    /// Returns the step that the machine asks of a person now. Returns `None` if there is nothing to do.
    fn step(&self) -> Option<OperatorStep> {
        let (job, _) = self.job?;
        let (action, confirmation) = match (self.state, &self.task) {
            (MachineState::Execute, Some((ManualTask::Measure(plan), _))) => {
                (self.measure(job, plan), Some(StepConfirmation::DoneWithFile))
            }
            (MachineState::Execute, Some((ManualTask::Grind(..), _))) if self.started_at.is_some() => {
                (OperatorAction::EndPass, Some(StepConfirmation::Done))
            }
            (MachineState::Execute, Some((ManualTask::Grind(pass, map), _))) => {
                (self.begin_pass(job, pass, map), Some(StepConfirmation::Started))
            }
            (MachineState::Holding, _) => (OperatorAction::Hold { remaining: None }, Some(StepConfirmation::Still)),
            (MachineState::Stopping, _) => (OperatorAction::Stop { remaining: None }, Some(StepConfirmation::Still)),
            (MachineState::Aborting, _) => (OperatorAction::Abort, None),
            _ => return None,
        };
        Some(OperatorStep { action, confirmation, named_map: None })
    }

    fn measure(&self, job: Job, plan: &Plan) -> OperatorAction {
        let batch = job.batch_id();
        let points = match self.settings.min_free_points {
            Some(least) => RequiredPoints::AtLeast(least),
            None => RequiredPoints::Listed {
                count: plan.targets.len(),
                file: self.cycle_folder(job).join(plan_file(batch.batch)),
            },
        };
        OperatorAction::Measure {
            part: self.settings.part.clone(),
            cycle: batch.to_string(),
            points,
            plan: None,
            probe_radius_mm: Some(plan.probe_radius_mm),
        }
    }

    fn begin_pass(&self, job: Job, pass: &Pass, map: &[u8; 32]) -> OperatorAction {
        let folder = self.cycle_folder(Job { cycle: job.cycle.saturating_sub(1), ..job });
        let correction = || Some(folder.join(CycleFile::Correction.name())).filter(|file| file.is_file());
        OperatorAction::BeginPass {
            part: self.settings.part.clone(),
            cycle: job.cycle.into(),
            program: program_for_pass(&self.settings.run_folder, job.cycle.into()).or_else(correction),
            map: HEXLOWER.encode(&map[..4]),
            wheel_radius_mm: pass.wheel_radius_mm,
            feed_mm_min: pass.feed_mm_min,
            spark_out_passes: pass.spark_out_passes,
        }
    }

    fn cycle_folder(&self, job: Job) -> PathBuf {
        self.settings.run_folder.join(CycleFolder::new(job.batch_id().cycle).to_string())
    }

    // ---- what a person says -------------------------------------------------------------------------------------------------------

    async fn accept_confirmation(&mut self, word: OperatorConfirmation) -> DeviceResult<Vec<String>> {
        let is_cmm = self.kind == MachineKind::Cmm;
        match word {
            OperatorConfirmation::Started { map_identity } | OperatorConfirmation::Done { map_identity, .. }
                if self.names_other_map(map_identity) =>
            {
                Err(self.not_accepted("the map in the confirmation is not the map of this pass: check which program is in the grinder"))
            }
            OperatorConfirmation::Started { .. } if is_cmm => {
                Err(self.not_accepted("the start of a measurement needs no confirmation: measure, then type regrind confirm done --file RESULT"))
            }
            OperatorConfirmation::Started { .. } if self.state == MachineState::Execute => {
                self.started_at.get_or_insert_with(Instant::now);
                Ok(Vec::new())
            }
            OperatorConfirmation::Done { file, .. }
                if matches!(self.state, MachineState::Execute | MachineState::Holding | MachineState::Held) =>
            {
                let kept = match file {
                    Some(file) if is_cmm => self.accept_file(file).await?,
                    None if is_cmm => return Err(self.not_accepted("name the file of the measurement with --file")),
                    Some(_) => return Err(self.not_accepted("--file is allowed only for a measurement: remove --file")),
                    None if self.started_at.is_none() => {
                        return Err(self.not_accepted("confirm first that the pass has begun: regrind confirm started"));
                    }
                    None => Vec::new(),
                };
                self.duration_s = self.started_at.map(|begun| begun.elapsed().as_secs_f64());
                self.clear_of_part = Some(true);
                self.finish(Outcome::Complete);
                Ok(kept)
            }
            OperatorConfirmation::Still if self.state == MachineState::Holding => {
                self.state = MachineState::Held;
                Ok(Vec::new())
            }
            OperatorConfirmation::Still if self.state == MachineState::Stopping => {
                self.finish(Outcome::Stopped);
                Ok(Vec::new())
            }
            _ => {
                let reason = format!("the machine is in the state {}, which does not allow this confirmation", self.state);
                Err(self.not_accepted(reason))
            }
        }
    }

    /// Returns true if the operator confirmation names another map than the map of the requested pass. `named` is the
    /// SHA-256 of the map in the confirmation. Returns false if the confirmation names no map, or if no pass is
    /// requested.
    fn names_other_map(&self, named: Option<[u8; 32]>) -> bool {
        match &self.task {
            Some((ManualTask::Grind(_, map), _)) => named.is_some_and(|named| named != *map),
            _ => false,
        }
    }

    /// Accepts `file` as the result of the requested measurement. Stores its bytes in the folder of the cycle. Returns
    /// the paths of the plan and of the stored file, relative to the folder of the run.
    ///
    /// # Errors
    /// No measurement is requested, the same bytes were accepted before, the file does not fit the plan, or it cannot
    /// be read or stored.
    async fn accept_file(&mut self, file: PathBuf) -> DeviceResult<Vec<String>> {
        let (Some((job, done)), Some((ManualTask::Measure(plan), _))) = (self.job, &self.task) else {
            return Err(self.not_accepted("no measurement is requested"));
        };
        let (settings, plan, taken) = (self.settings.clone(), Arc::clone(plan), self.accepted_files.clone());
        let (BatchId { cycle, batch }, cycle_folder) = (job.batch_id(), self.cycle_folder(job));
        let read = tokio::task::spawn_blocking(move || {
            let bytes = read_bytes(&file)?;
            let sha256: [u8; 32] = Sha256::digest(&bytes).into();
            if taken.contains(&sha256) || is_stored_result(&settings.run_folder, &sha256) {
                return Err(ExchangeError::AlreadyMeasured { path: file });
            }
            let measurement = read_measurement(&settings, &plan, job, done, &file, &bytes)?;
            // The bytes are stored unchanged, under a name that no other file of the cycle has.
            let extension = file.extension().map_or("txt".to_owned(), |e| file_word(&e.to_string_lossy()));
            let name = machine_result_file(batch, &extension);
            write_atomic(&cycle_folder.join(&name), &bytes)?;
            Ok((measurement, sha256, name))
        });
        let (measurement, sha256, name) =
            read.await.map_err(|e| self.not_accepted(e))?.map_err(|e| self.not_accepted(e))?;
        self.accepted_files.push(sha256);
        self.measurement = Some(measurement);
        let folder = CycleFolder::new(cycle);
        Ok(vec![format!("{folder}/{}", plan_file(batch)), format!("{folder}/{name}")])
    }
}

/// Returns true if a cycle folder of the run folder `run` contains a file of a machine's result whose content has this
/// SHA-256. Such a file was accepted by an earlier process.
fn is_stored_result(run: &Path, sha256: &[u8; 32]) -> bool {
    let within = |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let is_result = |path: &Path| path.file_name().and_then(|name| name.to_str()).is_some_and(is_machine_result_file);
    let cycles = within(run).filter(|path| path.is_dir());
    let mut results = cycles.flat_map(|cycle| within(&cycle).filter(|path| is_result(path)).collect::<Vec<_>>());
    results.any(|path| read_bytes(&path).is_ok_and(|bytes| Sha256::digest(&bytes).as_slice() == sha256))
}

/// Parses `bytes`, the content of the measured file `path`, and checks it against `plan` and the settings. `done` is
/// the sequence number of the START that began the measurement. Returns the measurement.
///
/// # Errors
/// The file has a wrong format, belongs to another job or plan, has too few points, or its points do not fit the plan.
fn read_measurement(
    settings: &ManualSettings,
    plan: &Plan,
    job: Job,
    done: u32,
    path: &Path,
    bytes: &[u8],
) -> Result<Measurement, ExchangeError> {
    let targets: Vec<u32> = plan.targets.iter().map(|target| target.index).collect();
    let wanted = ResultRequirements {
        targets: settings.min_free_points.is_none().then_some(&targets),
        content: &settings.content,
        probe_radius_mm: plan.probe_radius_mm,
        probe_tolerance_mm: settings.probe_tolerance_mm,
    };
    let identity = plan.identity();
    let file = wanted.read(path, bytes)?;
    if let Some(reason) = contradiction(&file.statements, &settings.part, job.cycle, &HEXLOWER.encode(&identity)) {
        return Err(ExchangeError::Foreign { path: path.to_owned(), reason });
    }
    let points = wanted.assign_by_index(path, &file)?;
    if let Some(expected) = settings.min_free_points.filter(|least| points.len() < *least) {
        return Err(ExchangeError::Count { path: path.to_owned(), found: points.len(), expected });
    }
    let measurement = assemble_measurement(points, &[file], job, identity, done);
    if settings.min_free_points.is_none() {
        check_measurement(path, plan, &measurement, settings.min_coverage, settings.rehearsal)?;
    }
    Ok(measurement)
}

/// Writes the targets of `plan` as a CSV file into `folder`, for the person who measures. The file is named `plan.csv`.
/// For a later batch of touches in `job`, the name has the number of the batch, for example `plan-2.csv`.
///
/// # Errors
/// The folder or the file cannot be written.
fn write_plan(settings: &ManualSettings, folder: &Path, plan: &Plan, job: Job) -> Result<(), FormatError> {
    ResultFolder::prepare(folder)?.keep();
    let text = plan_csv(&settings.part, job, &HEXLOWER.encode(&plan.identity()), plan);
    write_atomic(&folder.join(plan_file(job.batch_id().batch)), text.as_bytes())
}

impl Machine for ManualMachine {
    fn name(&self) -> &str {
        &self.name
    }

    fn notes(&self) -> Vec<String> {
        let run = run_argument(&self.settings.run_folder);
        self.step().map_or_else(Vec::new, |step| step.lines(self.kind.name(), &run))
    }

    fn operator_step(&self) -> Option<OperatorStep> {
        self.step()
    }

    async fn connect(&mut self) -> DeviceResult<Identity> {
        self.connected = true;
        Ok(Identity::for_manual_machine(self.kind, &self.name))
    }

    async fn status(&mut self) -> DeviceResult<Status> {
        match self.connected {
            true => Ok(self.current_status()),
            false => Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), operation: "its status" }),
        }
    }

    fn restore(&mut self, intended: &Armed) {
        self.unresolved = Some((intended.job, intended.start_sequence));
        self.requested_jobs.push((intended.job.job, intended.job.cycle));
    }

    async fn claim(&mut self) -> DeviceResult<Status> {
        self.status().await
    }

    async fn prepare(&mut self, job: Job) -> DeviceResult<Armed> {
        // The cell continues only after a person has confirmed that the job is over.
        self.unresolved = None;
        let is_loaded = self.task.as_ref().is_some_and(|(_, digest)| *digest == job.digest);
        if self.state != MachineState::Idle || !is_loaded {
            let answer = if is_loaded { Answer::WrongState } else { Answer::PayloadMissing };
            return Err(self.refused(MachineCommand::Prepare, answer));
        }
        if self.requested_jobs.contains(&(job.job, job.cycle)) {
            return Err(self.refused(MachineCommand::Prepare, Answer::AlreadyBegun));
        }
        if let Some((ManualTask::Measure(plan), _)) = &self.task {
            let (settings, plan, folder) = (self.settings.clone(), Arc::clone(plan), self.cycle_folder(job));
            let written = tokio::task::spawn_blocking(move || write_plan(&settings, &folder, &plan, job));
            written.await.map_err(|e| self.not_accepted(e))?.map_err(|e| self.not_accepted(e))?;
        }
        let start_sequence = self.requested_jobs.len() as u32 + 1;
        (self.job, self.state, self.outcome) = (Some((job, start_sequence)), MachineState::Prepared, Outcome::None);
        (self.started_at, self.duration_s, self.measurement) = (None, None, None);
        Ok(Armed { job, start_sequence, token: 0, boot_id: 0 })
    }

    async fn start(&mut self, armed: Armed) -> DeviceResult<Started> {
        let Armed { job, start_sequence, .. } = armed;
        if self.state != MachineState::Prepared || self.job != Some((job, start_sequence)) {
            return Err(self.refused(MachineCommand::Start, Answer::OtherJob));
        }
        self.requested_jobs.push((job.job, job.cycle));
        (self.state, self.clear_of_part) = (MachineState::Execute, None);
        Ok(Started { job, start_sequence, status: self.current_status() })
    }

    async fn hold(&mut self) -> DeviceResult<Status> {
        self.transition(MachineCommand::Hold, &[MachineState::Execute], MachineState::Holding)
    }

    async fn resume(&mut self) -> DeviceResult<Status> {
        self.transition(MachineCommand::Resume, &[MachineState::Held], MachineState::Execute)
    }

    async fn stop(&mut self) -> DeviceResult<Status> {
        if let Some(untold) = self.unresolved.take() {
            (self.job, self.state) = (Some(untold), MachineState::Stopping);
            return Ok(self.current_status());
        }
        match self.state {
            MachineState::Prepared => (self.state, self.job) = (MachineState::Idle, None),
            // A person has confirmed that it does not move.
            MachineState::Held => self.finish(Outcome::Stopped),
            _ => {
                return self.transition(
                    MachineCommand::Stop,
                    &[MachineState::Execute, MachineState::Holding],
                    MachineState::Stopping,
                );
            }
        }
        Ok(self.current_status())
    }

    async fn abort(&mut self) -> DeviceResult<Status> {
        let untold = self.unresolved.take();
        let may_move = self.state.is_moving() || untold.is_some();
        self.job = self.job.or(untold);
        self.state = if may_move { MachineState::Aborting } else { MachineState::Aborted };
        self.outcome = Outcome::Aborted;
        Ok(self.current_status())
    }

    async fn clear(&mut self) -> DeviceResult<Status> {
        (self.job, self.outcome) = (None, Outcome::None);
        self.transition(MachineCommand::Clear, &[MachineState::Aborted], MachineState::Idle)
    }

    async fn acknowledge(&mut self, done: u32) -> DeviceResult<Status> {
        if self.job.is_none_or(|(_, sequence)| sequence != done) {
            return Err(self.refused(MachineCommand::Acknowledge, Answer::OtherResult));
        }
        let status = self.transition(MachineCommand::Acknowledge, &[MachineState::Complete], MachineState::Idle)?;
        (self.job, self.outcome) = (None, Outcome::None);
        Ok(status)
    }

    async fn release(&mut self) -> DeviceResult<Status> {
        Ok(self.current_status())
    }

    async fn reconcile(&mut self, intended: &Armed) -> DeviceResult<Reconciled> {
        let ours = self.job == Some((intended.job, intended.start_sequence));
        Ok(match self.state {
            MachineState::Complete | MachineState::Aborted if ours => Reconciled::Finished(self.current_status()),
            state if ours && (state.is_moving() || state == MachineState::Held) => {
                Reconciled::Running(self.current_status())
            }
            _ => Reconciled::Unknown {
                reason: "the machine does not report the outcome of the job; ask the person at the machine whether the job was done".to_owned(),
            },
        })
    }

    async fn confirm(&mut self, word: OperatorConfirmation) -> DeviceResult<Vec<String>> {
        self.accept_confirmation(word).await
    }
}

impl Cmm for ManualMachine {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> DeviceResult<()> {
        self.task = Some((ManualTask::Measure(Arc::new(plan.clone())), digest(&[plan.identity()])));
        Ok(())
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<Measurement> {
        let measured = self.measurement.clone().filter(|m| (m.job, m.cycle) == (job.job, job.cycle));
        measured.ok_or_else(|| DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: self.state })
    }
}

impl Grinder for ManualMachine {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, _: &Interrupt) -> DeviceResult<()> {
        let map = map.identity();
        self.task = Some((ManualTask::Grind(*pass, map), digest(&[map, pass.identity()])));
        Ok(())
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<PassRecord> {
        match (self.job, &self.task) {
            (Some((own, done)), Some((ManualTask::Grind(_, map_identity), _))) if own == job => Ok(PassRecord {
                duration_s: self.duration_s,
                ..PassRecord::unmeasured(self.outcome, *map_identity, job, done)
            }),
            _ => Err(DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: self.state }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Machine of a resumed run that was interrupted during a pass.
    fn resumed_machine() -> ManualMachine {
        let settings = ManualSettings {
            part: "a part".into(),
            run_folder: PathBuf::new(),
            content: Content::default(),
            min_free_points: None,
            min_coverage: 0.0,
            rehearsal: false,
            probe_tolerance_mm: 0.1,
        };
        let mut machine = ManualMachine::new(MachineKind::Grinder, settings);
        let job = Job { job: 7, cycle: 2, digest: 3 };
        machine.restore(&Armed { job, start_sequence: 1, token: 0, boot_id: 0 });
        machine
    }

    #[test]
    fn stored_result_recognised_by_hash() {
        let run = tempfile::tempdir().unwrap();
        std::fs::create_dir(run.path().join("cycle-1")).unwrap();
        std::fs::write(run.path().join("cycle-1/result.csv"), "1,2,3").unwrap();
        // A later batch of the same measurement, and a file that is not a result.
        std::fs::write(run.path().join("cycle-1/result-2.csv"), "4,5,6").unwrap();
        std::fs::write(run.path().join("cycle-1/results.csv"), "7,8,9").unwrap();
        let sha256 = |text: &str| -> [u8; 32] { Sha256::digest(text).into() };
        assert!(is_stored_result(run.path(), &sha256("1,2,3")));
        assert!(is_stored_result(run.path(), &sha256("4,5,6")), "the second batch");
        assert!(!is_stored_result(run.path(), &sha256("7,8,9")));
        assert!(!is_stored_result(run.path(), &sha256("1,2,4")));
    }

    #[tokio::test]
    async fn interrupted_pass_reconciles_unknown() {
        let job = Job { job: 7, cycle: 2, digest: 3 };
        let armed = Armed { job, start_sequence: 1, token: 0, boot_id: 0 };
        assert!(matches!(resumed_machine().reconcile(&armed).await, Ok(Reconciled::Unknown { .. })));
        // It may be moving: a person must confirm that it does not, and nobody has confirmed an abort.
        let mut machine = resumed_machine();
        machine.connect().await.unwrap();
        assert_eq!(machine.stop().await.unwrap().state, MachineState::Stopping);
        machine.confirm(OperatorConfirmation::Still).await.unwrap();
        let status = machine.status().await.unwrap();
        assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Stopped));
        assert_eq!(resumed_machine().abort().await.unwrap().state, MachineState::Aborting);
    }
}
