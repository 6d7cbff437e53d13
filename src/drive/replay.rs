//! Replay of the record of an interrupted run to its last state. Every event is handled again and every command is
//! compared with the recorded one. Every computation is repeated from the recorded points and compared with the
//! recorded files.
//!
//! ```text
//!  record --> event  --> Cell::handle --> commands == those on record?
//!             points --> the same computations --> event and files == those on record?
//!             intent --> the payloads that it names == those computed again?
//! ```
//!
//! Replay sends no command. It stops at the first difference: a program that would have decided or computed something
//! else cannot know what the machines hold.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::de::DeserializeOwned;
use serde_json::Value;
use thiserror::Error;

use super::Task;
use super::comparison::{is_same_decision, is_same_file, is_same_result};
use super::computation::{Computation, create_folder};
use super::cycles::Cycles;
use super::evaluation;
use super::pipeline;
use super::recorder::OutputFiles;
use super::station::prepared_job;
use super::task::ComputationProduct;
use crate::cell::{Cell, CellPlan, Command, Device, Ending, Event, GateResult, Judgement};
use crate::device::{Armed, BatchId, Coordinates, Identified, digest};
use crate::formats::run_files::{CycleFile, CycleFolder};
use crate::formats::{self, FormatError, ScratchFolder};
use crate::journal::{Artefact, JournalError, Reader, Record, RecordKind, sha256_hex};
use crate::record::{Content, EventDetail, EventRecord, StartIntent, TransferNote};

/// Folder for the repeated computations, below the run folder; removed afterwards.
const SCRATCH: &str = "replay";

/// Interrupted run, as its record describes it.
pub struct InterruptedRun {
    pub(super) cell: Cell,
    pub(super) cycles: Cycles,
    /// Last preparation of each machine: CMM, grinder.
    pub(super) armed: [Option<StartIntent>; 2],
    /// Number of attempts of each computation, so that no file is overwritten.
    pub(super) attempts: BTreeMap<(u32, Computation), u32>,
    pub(super) state_changes: u64,
    /// Time since the run began.
    pub(super) elapsed: Duration,
    /// Commands without an outcome, by their numbers.
    pub(super) open_commands: BTreeMap<u32, Command>,
    /// Ending, if only the last record is missing.
    pub(super) ending: Option<Ending>,
    /// Judgement whose file is not recorded, and its number within its cycle.
    pub(super) unannounced_judgement: Option<(u32, Judgement)>,
    /// Files of computations that the interrupted program did not record.
    pub(super) unrecorded_files: Vec<String>,
}

/// Reason why a run cannot be continued.
#[derive(Debug, Error)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum ReplayError {
    #[error(transparent)]
    Journal(#[from] JournalError),
    #[error(transparent)]
    File(#[from] FormatError),
    #[error("{}: the temporary file cannot be read: {source}; no command was sent; check the disk and retry", .path.display())]
    Scratch { path: PathBuf, source: io::Error },
    #[error("{}: the result of the repeated computation cannot be written ({what}); no command was sent; check the disk and retry", .run.display())]
    NotSaved { run: PathBuf, what: String },
    #[error("{}: record {seq} cannot be read ({what}); this run cannot continue; return the machines of the run to idle with `regrind recover`", .run.display())]
    Unreadable { run: PathBuf, seq: u64, what: String },
    #[error(
        "{}: at record {seq} the result of this program differs from the record: {what}; no command was sent. Continue with \
         the program that began the run, or return the machines of the run to idle with `regrind recover` and start a new run",
        .run.display()
    )]
    Differs { run: PathBuf, seq: u64, what: String },
}

impl InterruptedRun {
    /// Reads the record of an interrupted run from the run folder `run`, and repeats its decisions and computations
    /// (replay). Returns the state in which the run was interrupted. `plan` and `task` must be those with which the run
    /// began.
    ///
    /// # Errors
    /// The record cannot be read, the disk fails, or a decision or result of this program differs from the record.
    pub fn read(run: &Path, plan: CellPlan, task: &Task) -> Result<Self, ReplayError> {
        let reader = Reader::open(run)?;
        let mut replay = Replay::new(run, plan, task)?;
        for record in reader.records(0) {
            replay.apply_record(&record?)?;
        }
        replay.finish()
    }

    /// Returns the state of a run before its first event.
    pub(super) fn new(plan: CellPlan) -> Self {
        Self {
            cell: Cell::new(plan),
            cycles: Cycles::default(),
            armed: [None, None],
            attempts: BTreeMap::new(),
            state_changes: 0,
            elapsed: Duration::ZERO,
            open_commands: BTreeMap::new(),
            ending: None,
            unannounced_judgement: None,
            unrecorded_files: Vec::new(),
        }
    }

    /// Returns the last START that was prepared for a machine: the number of its cycle, and the data of the prepared
    /// job. Returns `None` if no START was prepared. The second value is true if the machine may still execute this
    /// job.
    pub(super) fn last_preparation(&self, device: Device) -> (Option<(u32, Armed)>, bool) {
        let Some(intent) = self.armed[device as usize] else { return (None, false) };
        let cycle = BatchId::decode(intent.cycle).cycle;
        let state = self.cell.state();
        let at_work = state.phase().map_or(!state.is_end(), |phase| phase.moving_device() == Some(device));
        (Some((cycle, prepared_job(intent))), at_work && cycle == self.cell.cycle())
    }

    /// Returns the state in which the run was interrupted, in words.
    pub fn describe_state(&self) -> String {
        format!("{}, cycle {}", self.cell.state(), self.cell.cycle())
    }
}

struct Replay<'t> {
    run_folder: &'t Path,
    task: &'t Task,
    replayed: InterruptedRun,
    /// Commands that followed from the last event and for which no record has been read yet.
    due_commands: VecDeque<Command>,
    /// Newest file of each name in the folder of a cycle.
    files: BTreeMap<(u32, String), Artefact>,
    /// All recorded names.
    recorded_names: BTreeSet<String>,
    /// Coordinates that the last measurement reported.
    coordinates: Option<Coordinates>,
    last_sequence: u64,
}

impl<'t> Replay<'t> {
    fn new(run: &'t Path, plan: CellPlan, task: &'t Task) -> Result<Self, ReplayError> {
        let found = InterruptedRun::new(plan);
        let (due, files, names) = (VecDeque::new(), BTreeMap::new(), BTreeSet::new());
        Ok(Self {
            run_folder: run,
            task,
            replayed: found,
            due_commands: due,
            files,
            recorded_names: names,
            coordinates: None,
            last_sequence: 0,
        })
    }

    fn apply_record(&mut self, record: &Record) -> Result<(), ReplayError> {
        self.last_sequence = record.seq;
        self.replayed.elapsed = self.replayed.elapsed.max(Duration::from_nanos(record.mono_ns));
        let content = match Content::read(record) {
            Ok(content) => content,
            Err(error) if decides(record) => return Err(self.unreadable(&error)),
            // An outcome closes its command, whatever its words. Other notes decide nothing.
            Err(_) => Content::Unknown(record.value()),
        };
        match content {
            // Decisions that the program had not recorded when it ended were not executed.
            Content::Reopen(_) => self.due_commands.clear(),
            Content::Artefact(file) => self.add_recorded_file(file),
            Content::Event(event) => return self.apply_event(Duration::from_nanos(record.mono_ns), *event),
            Content::Command(command) => {
                return self.compare_command(record.command_id, &command.command, record.value());
            }
            Content::Transfer(TransferNote { transfer }) => {
                self.coordinates = transfer.coordinates.or(self.coordinates);
            }
            Content::Answer(_) => self.close_command(record),
            Content::Unknown(_) if record.kind == RecordKind::Outcome => self.close_command(record),
            Content::Unknown(_) if record.kind == RecordKind::Reopen => self.due_commands.clear(),
            Content::Begin(_)
            | Content::Recovery(_)
            | Content::Confirmation(_)
            | Content::MachineNotes(_)
            | Content::Remark(_)
            | Content::Pass(_)
            | Content::Seal(_)
            | Content::End(_)
            | Content::Unknown(_) => {}
        }
        Ok(())
    }

    /// Removes the command that `record`, an outcome, answers from the open commands.
    fn close_command(&mut self, record: &Record) {
        self.replayed.open_commands.retain(|id, _| Some(*id) != record.command_id);
    }

    fn add_recorded_file(&mut self, file: Artefact) {
        self.recorded_names.insert(file.name.clone());
        let path = Path::new(&file.name);
        let cycle = CycleFolder::cycle_of(&file.name);
        let (Some(cycle), Some(name)) = (cycle, path.file_name().and_then(|name| name.to_str())) else { return };
        if name == CycleFile::Judgement.name()
            && self.replayed.unannounced_judgement.as_ref().is_some_and(|(_, of)| of.cycle == cycle)
        {
            self.replayed.unannounced_judgement = None;
        }
        self.files.insert((cycle, name.to_owned()), file);
    }

    fn apply_event(&mut self, now: Duration, record: EventRecord) -> Result<(), ReplayError> {
        if let Some(missing) = self.due_commands.front() {
            return Err(self.differs(format!(
                "the program would send {}, but the record has an event in place of this command",
                missing.name()
            )));
        }
        let EventRecord { event, detail } = record;
        if let Event::Prepared { device, .. } = &event {
            self.replayed.armed[*device as usize] = match detail {
                Some(EventDetail::Preparation(intent)) => Some(intent),
                Some(_) => return Err(self.unreadable(&"its detail is not a prepared job")),
                None => None,
            };
        }
        self.repeat_computation(&event)?;
        let before = self.replayed.cell.state();
        self.due_commands = self.replayed.cell.handle(now, event).into();
        self.replayed.state_changes += u64::from(self.replayed.cell.state() != before);
        let commands: Vec<Command> = self.due_commands.iter().cloned().collect();
        commands.iter().for_each(|command| self.apply_command(command));
        Ok(())
    }

    /// Repeats the effect of a command on the data of this program: the payloads of a pass, the plan of a measurement,
    /// a judgement, or the ending. Does nothing for other commands, and sends nothing to a machine.
    fn apply_command(&mut self, command: &Command) {
        let (cycles, task) = (&mut self.replayed.cycles, self.task);
        match command {
            Command::LoadPass { cycle } => drop(cycles.pass_payloads(task, *cycle)),
            Command::LoadPlan { cycle } => drop(cycles.create_plan(task, *cycle)),
            Command::Announce(judgement) => {
                let which = cycles.count_judgement(judgement.cycle);
                self.replayed.unannounced_judgement = Some((which, judgement.clone()));
            }
            Command::Finish(ending) => self.replayed.ending = Some(ending.clone()),
            _ => {}
        }
    }

    /// Checks that the recorded command `told` is the next one that the cell issues in the replay. `id` is its number in
    /// the journal, and `recorded` is the content of its record. Returns an error if the two commands differ.
    fn compare_command(&mut self, id: Option<u32>, told: &Command, mut recorded: Value) -> Result<(), ReplayError> {
        let Some(command) = self.due_commands.pop_front() else {
            let (name, _) = told.label();
            return Err(
                self.differs(format!("the program would send no command, but the record has the command {name}"))
            );
        };
        if let (Command::StartMachine { .. }, Some(recorded)) = (&command, recorded.as_object_mut()) {
            recorded.remove("intent");
        }
        let due = serde_json::to_value(&command).unwrap_or_default();
        if !is_same_decision(&due, &recorded) {
            return Err(self.differs(format!("the program would send {due}, but the record has {recorded}")));
        }
        if let Some(id) = id.filter(|_| command.expects_answer()) {
            self.replayed.open_commands.insert(id, command);
        }
        Ok(())
    }

    /// Repeats the computation that produced `event`, and stores its result. Compares the event and the files with the
    /// recorded ones. For the gate (the check whether a measurement can be used), only reads the accepted points from
    /// the record. Does nothing if no computation produced the event.
    ///
    /// # Errors
    /// The result differs from the record, or a file cannot be read or written.
    fn repeat_computation(&mut self, event: &Event) -> Result<(), ReplayError> {
        let (number, kind) = match event {
            Event::Collected { cycle, gate: GateResult::Passed, .. } => (*cycle, Computation::Gate),
            Event::Registered { cycle, .. } => (*cycle, Computation::Registration),
            Event::Compensated { cycle, .. } => (*cycle, Computation::Compensation),
            _ => return Ok(()),
        };
        let Some(cycle) = self.replayed.cycles.get(number).cloned() else { return Ok(()) };
        if kind == Computation::Gate {
            let points = self.read_points(number)?;
            self.replayed.cycles.store(number, ComputationProduct::Points(points));
            return Ok(());
        }
        let scratch = ScratchFolder::at(self.run_folder.join(SCRATCH))?;
        let mut files = OutputFiles::new(scratch.path().to_owned(), CycleFolder::new(number).to_string());
        create_folder(&files.folder())?;
        let (again, product) = match kind {
            Computation::Registration => evaluation::register_cycle(
                self.task,
                &mut files,
                number,
                &cycle,
                self.replayed.cycles.previous_judged(number),
            ),
            _ => pipeline::compensate_cycle(self.task, &mut files, number, &cycle),
        };
        if let Event::NotSaved { reason, .. } = again {
            let what = super::failure::failure_message(&reason);
            return Err(ReplayError::NotSaved { run: self.run_folder.to_owned(), what });
        }
        let [recorded, again] = [event, &again].map(|event| serde_json::to_value(event).unwrap_or_default());
        if !is_same_result(&recorded, &again) {
            return Err(self.differs(format!(
                "the repeated computation of cycle {number} gives {again}, but the record has {recorded}"
            )));
        }
        self.compare_files(number, scratch.path(), &files)?;
        self.replayed.cycles.store(number, product);
        Ok(())
    }

    /// Reads the recorded files of the measurement of cycle `number`, and returns its usable points.
    ///
    /// # Errors
    /// A file cannot be read, or the points do not pass the checks of a measurement.
    fn read_points(&self, number: u32) -> Result<super::task::UsablePoints, ReplayError> {
        let read = |file: CycleFile| match self.files.get(&(number, file.name().to_owned())) {
            Some(file) => {
                let bytes = file.read(self.run_folder)?;
                formats::parse_points(self.run_folder.join(&file.name), &bytes[..]).map_err(ReplayError::from)
            }
            None => Ok(Vec::new()),
        };
        let (part, sphere) = (read(CycleFile::Measured)?, read(CycleFile::ReferenceSphere)?);
        let coordinates = self.coordinates.unwrap_or(Coordinates::Centres);
        let conditions = self.read_json::<pipeline::MeasurementConditions>(number, CycleFile::Conditions)?;
        let temperature_c = conditions.map(|told| told.temperature_c);
        let touches = self.read_json::<pipeline::TouchRecord>(number, CycleFile::Touches)?;
        let rounds = self
            .read_json::<pipeline::RepeatedTouchesRecord>(number, CycleFile::RepeatedTouches)?
            .map_or(0, |told| told.rounds);
        let touches = (touches, rounds);
        pipeline::gate_recorded_points(self.task, part, sphere, (coordinates, temperature_c), touches).map_err(
            |reason| {
                self.differs(format!(
                    "the recorded points of cycle {number} do not pass the checks of a measurement: {reason:?}"
                ))
            },
        )
    }

    /// Reads the newest recorded JSON file `file` of cycle `number`. Returns `None` if no such file is recorded.
    /// Returns an error if the file cannot be read or has other content than expected.
    fn read_json<T: DeserializeOwned>(&self, number: u32, file: CycleFile) -> Result<Option<T>, ReplayError> {
        let Some(file) = self.files.get(&(number, file.name().to_owned())) else { return Ok(None) };
        let bytes = file.read(self.run_folder)?;
        serde_json::from_slice(&bytes).map(Some).map_err(|error| self.differs(format!("{}: {error}", file.name)))
    }

    /// Compares the files of a repeated computation, in the folder `scratch`, with the recorded files of cycle
    /// `number`. Ignores files that are not recorded, and X3P files, which contain the time of writing. Returns an
    /// error for the first difference.
    fn compare_files(&self, number: u32, scratch: &Path, files: &OutputFiles) -> Result<(), ReplayError> {
        // A file in X3P contains the time of its writing. Pictures are drawn from the map, which is compared.
        let derived = [CycleFile::ErrorMapX3p, CycleFile::ErrorMapSvg, CycleFile::ErrorMapPng].map(CycleFile::name);
        let is_derived = |name: &str| derived.iter().any(|file| name.ends_with(file));
        for name in files.file_names().iter().filter(|name| !is_derived(name)) {
            let path = scratch.join(name);
            let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
            let Some(recorded) = self.files.get(&(number, name.to_owned())) else { continue };
            if !path.is_file() {
                return Err(self.differs(format!(
                    "the repeated computation does not write the file {}, but the record has this file",
                    recorded.name
                )));
            }
            let bytes = fs::read(&path).map_err(|source| ReplayError::Scratch { path, source })?;
            if sha256_hex(&bytes) != recorded.sha256
                && !is_same_file(&recorded.name, &recorded.read(self.run_folder)?, &bytes)
            {
                return Err(self.differs(format!(
                    "the file {} of the repeated computation differs from the recorded file",
                    recorded.name
                )));
            }
        }
        Ok(())
    }

    /// Completes the replay and returns the interrupted run. Checks for each machine that the last prepared START
    /// agrees with the pass or the plan of its cycle. Also finds the files of each cycle in the run folder, with their
    /// attempts, and lists those that are not recorded.
    ///
    /// # Errors
    /// A prepared START differs from the replay, or its record cannot be read.
    fn finish(mut self) -> Result<InterruptedRun, ReplayError> {
        for device in Device::BOTH {
            self.check_preparation(device)?;
        }
        formats::finished_files(self.run_folder);
        for number in 1..=self.replayed.cell.cycle() + 1 {
            for attempt in 1.. {
                let folder = CycleFolder::Attempt { cycle: number, attempt };
                let Some(names) = self.finished_files(folder) else { break };
                names.iter().for_each(|name| self.add_existing_file(folder, name));
            }
            for batch in 1.. {
                let folder = CycleFolder::Batch { cycle: number, batch };
                let Some(names) = self.finished_files(folder) else { break };
                names.iter().for_each(|name| self.add_existing_file(folder, name));
            }
        }
        Ok(self.replayed)
    }

    /// Returns the names of the files in `folder` of the run folder, or `None` if there is no such folder.
    fn finished_files(&self, folder: CycleFolder) -> Option<Vec<String>> {
        formats::finished_files(&self.run_folder.join(folder.to_string()))
    }

    /// Registers the file `name` that exists in `folder` of the run folder. Stores the number of the folder as an
    /// attempt of the computation that wrote the file. The next attempt then has a higher number and does not overwrite
    /// the file. A file that is not recorded is added to the list of unrecorded files. Ignores hidden files and
    /// judgements.
    fn add_existing_file(&mut self, folder: CycleFolder, name: &str) {
        if name == CycleFile::Judgement.name() || name.starts_with('.') {
            return;
        }
        let (number, attempt, is_batch) = match folder {
            CycleFolder::Attempt { cycle, attempt } => (cycle, attempt, false),
            CycleFolder::Batch { cycle, batch } => (cycle, batch, true),
        };
        let kind = Computation::from_file_name(name).and_then(|kind| match kind {
            // If touches are chosen, the settled results are in the folders of the cycle, and their inputs in those of
            // its batches.
            Computation::Gate | Computation::Registration if self.task.adaptive.is_some() => {
                if is_batch {
                    return Some(kind);
                }
                (kind == Computation::Registration).then_some(Computation::FinalRegistration)
            }
            kind => Some(kind),
        });
        if let Some(kind) = kind {
            let attempts = self.replayed.attempts.entry((number, kind)).or_default();
            *attempts = attempt.max(*attempts);
        }
        let path = format!("{folder}/{name}");
        if !self.recorded_names.contains(&path) {
            self.replayed.unrecorded_files.push(path);
        }
    }

    fn check_preparation(&mut self, device: Device) -> Result<(), ReplayError> {
        let Some(intent) = self.replayed.armed[device as usize] else { return Ok(()) };
        let BatchId { cycle: number, batch } = BatchId::decode(intent.cycle);
        let Some(cycle) = self.replayed.cycles.get(number) else { return Ok(()) };
        // A preparation from before the plan of the next batch is over.
        if device == Device::Cmm && cycle.batch != batch {
            return Ok(());
        }
        let due = match (device, &cycle.plan) {
            (Device::Grinder, _) => {
                let (map, pass) = self.task.payloads(&cycle.correction);
                digest(&[map.identity(), pass.identity()])
            }
            (Device::Cmm, Some(plan)) => digest(&[plan.identity()]),
            (Device::Cmm, None) => return Ok(()),
        };
        if due == intent.digest {
            return Ok(());
        }
        let told = intent.digest;
        Err(self.differs(format!(
            "the {device} was prepared in cycle {number} for data with digest {told:08x}, but the data of this cycle have digest {due:08x}"
        )))
    }

    fn unreadable(&self, what: &dyn std::fmt::Display) -> ReplayError {
        ReplayError::Unreadable { run: self.run_folder.to_owned(), seq: self.last_sequence, what: what.to_string() }
    }

    fn differs(&self, what: String) -> ReplayError {
        ReplayError::Differs { run: self.run_folder.to_owned(), seq: self.last_sequence, what }
    }
}

/// Returns true if the replay depends on the content of a record: it is an event, a file, a command or the transfer of a
/// measurement.
fn decides(record: &Record) -> bool {
    match record.kind {
        RecordKind::Event | RecordKind::Artefact => true,
        RecordKind::Intent | RecordKind::Note => {
            let payload = record.value();
            ["command", "transfer"].iter().any(|key| payload.get(*key).is_some())
        }
        RecordKind::Begin | RecordKind::Reopen | RecordKind::Outcome | RecordKind::Seal | RecordKind::End => false,
    }
}
