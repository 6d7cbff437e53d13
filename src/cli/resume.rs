//! `regrind resume`: resumes a held cell, or continues a run whose program was interrupted.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use clap::Args;
use data_encoding::HEXLOWER;
use regrind::cell::{Actor, CellPlan, TABLE_VERSION};
use regrind::config::CellConfig;
use regrind::drive::{InterruptedRun, Request, Task};
use regrind::formats::run_files::{RunFile, newest_cycle};
use regrind::formats::{FormatError, Learned};
use regrind::journal::{
    Artefact, DATABASE, Journal, JournalError, LOCK, Reader, RecordKind, RunLock, may_be_lost, verify,
};
use regrind::recipe::Recipe;
use regrind::record::{Begin, Content, PartStart, RecordedPlan, Remark, RunContent};
use regrind::setup;

use super::failure::Failure;
use super::live::{PreparedRun, RunContext, outcome};
use super::run::{epoch, operator, within};
use super::{Outcome, check, control, key, plant};

/// Resume a held cell, or a run whose program has ended
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; by default the active run under runs/. If no run is active, the default is the newest run
without an end in its record.

A run whose program has ended without an end in its record (a crash, a power failure) is resumed in this terminal. The
program verifies the record, and replays the record without commands to the machines. The program then reads the state
of the jobs from the machines, and the cell goes to Held, \"The Regrind program was restarted during the run\". Then
inspect the machines, and give the same command in another terminal: the run continues. If the folder shows that
records were lost (the log of the database or journal.anchor is missing or damaged), the run resumes only with
--despite-loss, which confirms that you have inspected both machines. Otherwise bring the machines to idle with
`regrind recover`.

Examples:
  regrind resume
  regrind resume runs/freeform-mirror-20260704T120000Z --reason \"coolant is filled up\"

Exit codes: 0 the cell accepted the order, or the part is accepted; 1 finished, not in tolerance, or the record is
broken; 2 no such run, or the run is over; 3 the cell refused the order, fault or abort.")]
pub(super) struct Arguments {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Reason, for the record
    #[arg(long, value_name = "TEXT", default_value = "")]
    reason: String,
    /// Name of the person who resumes the run
    #[arg(long, value_name = "NAME", value_parser = super::name)]
    operator: Option<String>,
    /// Resume a run although its record may have lost its last lines: you have inspected both machines, and neither has
    /// a job that the record does not know
    #[arg(long)]
    despite_loss: bool,
    #[command(flatten)]
    plant: plant::ResumeArguments,
    /// Print the answer, or a line for each event, as JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let folder = match &arguments.run {
        Some(run) => run.clone(),
        None => control::live_or(Path::new("runs"), control::unfinished)?,
    };
    if control::is_driven(&folder) {
        let request = Request::Resume { reason: arguments.reason.clone(), state_number: None };
        return control::give(Some(&folder), &request, arguments.json);
    }
    take_up(arguments, &std::path::absolute(&folder).unwrap_or(folder))
}

/// Continues the interrupted run in `folder`. First verifies the record, and rebuilds the task and the plan from the
/// stored recipe and the stored cell file. Then replays the recorded decisions. Opens the machines only after these
/// checks. Returns an error if the record is not valid, if the task or the plan has changed, or if the replay gives
/// other decisions. Also returns an error if the machines were simulated inside the program that was interrupted.
fn take_up(arguments: &Arguments, folder: &Path) -> Result<Outcome, Failure> {
    let key = key::of_this_user()?;
    let plant_file = arguments.plant.plant_file();
    // From here on, another program that resumes or verifies the run finds it driven.
    let lock = RunLock::acquire(folder).map_err(Failure::Journal)?;
    let begun = RunStart::read(folder, arguments.despite_loss)?;
    // If the working folder is gone, a recipe without files there still works. Any other recipe reports the missing
    // file.
    let _ = std::env::set_current_dir(&begun.working_folder);
    let recipe = check::or_show(Recipe::parse(&begun.recipe, &begun.text(folder, RunFile::Recipe)?))?;
    let mut cell = check::or_show(CellConfig::parse(&begun.cell, &begun.text(folder, RunFile::Cell)?))?;
    cell.rehearsal = begun.rehearsal;
    if within(&cell) {
        return Err(Failure::WorldGone { run: folder.to_owned() });
    }
    let (task, plan) = begun.prepared(folder, &recipe, &cell)?;
    let interrupted = InterruptedRun::read(folder, plan.clone(), &task).map_err(Failure::Replay)?;
    if !arguments.json {
        let marked = if cell.is_marked_simulation() { "SIMULATION  " } else { "" };
        let state = interrupted.describe_state();
        super::print(&format!(
            "{marked}interrupted in {state}\nthe record is complete, and a replay of the record gives the same results\n"
        ))?;
    }
    // A part of the queue stays with its run: the plant learns of its end from the record.
    let _plant = plant::start_processes(folder.parent().unwrap_or(folder), plant_file.as_deref())?;
    super::runtime()?.block_on(async {
        let (part, actor) = (&begun.part_in_files, operator(arguments.operator.as_deref()));
        let (recipe, cell, json) = (&recipe, &cell, arguments.json);
        let live = RunContext { recipe, cell, part, folder, job: begun.job, actor, json };
        let machines = live.open(epoch(SystemTime::now()))?;
        let mut journal = Journal::open_locked(lock, key).map_err(Failure::Journal)?;
        if let Some(what) = &begun.lost {
            let remark = format!("resumed with --despite-loss, although the end of the record may be lost: {what}");
            let Actor { name, station } = live.actor.clone();
            let remark = Content::Remark(Remark { remark, alarm: None });
            journal.append(remark.entry(0, begun.cycle, (name, station))).map_err(Failure::Journal)?;
        }
        let (loaded, interrupted) = (cell.simulated, Some(interrupted));
        outcome(&live.carry_out(machines, PreparedRun { task, plan, journal, loaded, interrupted }).await?)
    })
}

/// Returns true if a run folder contains nothing except a journal database and its lock file.
fn is_bare(run: &Path) -> bool {
    let mut names = fs::read_dir(run).into_iter().flatten().filter_map(Result::ok).map(|entry| entry.file_name());
    names.all(|name| name.to_str().is_some_and(|name| name.starts_with(DATABASE) || name == LOCK))
}

/// Inputs with which an interrupted run began, as its record has them.
struct RunStart {
    recipe: PathBuf,
    cell: PathBuf,
    /// Working folder of the program that began the run; relative paths start there.
    working_folder: PathBuf,
    nominal_sha256: String,
    setting: String,
    part_in_files: String,
    job: u32,
    seed: Option<u64>,
    plan: RecordedPlan,
    rehearsal: bool,
    /// Reason why records may be lost, if a person continues with `--despite-loss`.
    lost: Option<String>,
    /// Highest cycle number in the record.
    cycle: u32,
    /// The files that are on record, by their names: nothing else of the folder is read.
    files: BTreeMap<String, Artefact>,
}

impl RunStart {
    /// Verifies the record of the interrupted run in the folder `run`, and reads the inputs with which the run began.
    ///
    /// # Errors
    /// Returns an error if the record is invalid, contains no event, or already has an end. Also returns an error if
    /// the run is from another version of the program. If records at the end may be lost, returns an error unless
    /// `despite_loss` is true; the reason is then only stored in the result.
    fn read(run: &Path, despite_loss: bool) -> Result<Self, Failure> {
        let reader = Reader::open(run).map_err(Failure::Journal)?;
        let lost = || may_be_lost(run).map_err(Failure::Journal);
        let refused = |what: String| Failure::MayBeLost { run: run.to_owned(), what };
        let first = reader.records(0).next();
        if first.is_none() {
            // A program that was interrupted while it created the folder has written nothing else.
            let what = if is_bare(run) { None } else { lost()? };
            return Err(what.map_or_else(|| Failure::NotBegun { run: run.to_owned() }, refused));
        }
        let verified = verify(run).map_err(|error| match error {
            JournalError::Broken { .. } => Failure::Broken(error),
            error => Failure::Journal(error),
        })?;
        if verified.closed {
            return Err(Failure::Over { run: run.to_owned() });
        }
        let records = || reader.records(0).filter_map(Result::ok);
        let last = records().map(|record| record.cycle).max().unwrap_or(0);
        let newest = newest_cycle(run);
        let of_files = (newest > last.saturating_add(1))
            .then(|| format!("the folder has files of cycle {newest}, but the record ends in cycle {last}"));
        let lost = lost()?.or(of_files);
        if let Some(what) = lost.clone().filter(|_| !despite_loss) {
            return Err(refused(what));
        }
        if !records().any(|record| record.kind == RecordKind::Event) {
            return Err(Failure::NotBegun { run: run.to_owned() });
        }
        let begin = records().next().and_then(|first| Begin::<RunContent>::read(&first)).unwrap_or_default();
        let program = begin.regrind.unwrap_or_else(|| "unknown".to_owned());
        let earlier = |what: String| Failure::EarlierRun { run: run.to_owned(), program: program.clone(), what };
        let start = begin.content.part().cloned().unwrap_or_default();
        let mut begun = Self::from_record(start).map_err(earlier)?;
        for record in records().filter(|record| record.kind == RecordKind::Artefact) {
            let Content::Artefact(file) = Content::read(&record).map_err(|error| earlier(error.to_string()))? else {
                continue;
            };
            begun.files.insert(file.name.clone(), file);
        }
        (begun.lost, begun.cycle) = (lost, last);
        Ok(begun)
    }

    /// Takes the inputs that this program needs from `start`, the first record of a run. Returns a message about the
    /// first input that is missing, or about another version of the transition table.
    fn from_record(start: PartStart) -> Result<Self, String> {
        fn due<T>(input: Option<T>, name: &str) -> Result<T, String> {
            input.ok_or_else(|| format!("missing or unreadable field `{name}`"))
        }
        let begun = Self {
            recipe: due(start.recipe, "recipe")?.into(),
            cell: due(start.cell, "cell")?.into(),
            working_folder: due(start.working_folder, "working_folder")?.into(),
            nominal_sha256: due(start.nominal_sha256, "nominal_sha256")?,
            setting: due(start.setting, "setting")?,
            part_in_files: due(start.part_in_files, "part_in_files")?,
            job: due(start.job, "job")?,
            seed: start.seed,
            plan: due(Some(start.plan).filter(|plan| !plan.is_missing()), "plan")?,
            rehearsal: start.rehearsal.unwrap_or_default(),
            lost: None,
            cycle: 0,
            files: BTreeMap::new(),
        };
        match due(start.table_version, "table_version")? {
            TABLE_VERSION => Ok(begun),
            version => Err(format!(
                "the run uses version {version} of the transition table, but this program uses version {TABLE_VERSION}"
            )),
        }
    }

    /// Returns the text of the input file `file` (recipe or cell file) that the run `run` stored when it began. Returns
    /// an error if the record does not list the file or if its content has changed.
    fn text(&self, run: &Path, file: RunFile) -> Result<String, Failure> {
        let path = run.join(file.name());
        let Some(file) = self.files.get(file.name()) else {
            let source =
                std::io::Error::new(std::io::ErrorKind::NotFound, "the record of this run does not contain this file");
            return Err(Failure::File(FormatError::Unreadable { path, source }));
        };
        String::from_utf8(file.read(run).map_err(Failure::Journal)?).map_err(|error| {
            let source = std::io::Error::new(std::io::ErrorKind::InvalidData, error);
            Failure::File(FormatError::Unreadable { path, source })
        })
    }

    /// Builds the task and the plan of the run in the folder `run` from `recipe` and `cell`, the stored recipe and the
    /// stored cell file of this run. Returns an error if the nominal surface, the settings or the plan differ from
    /// those in the record. This happens, for example, if a file that the recipe names has changed.
    fn prepared(&self, run: &Path, recipe: &Recipe, cell: &CellConfig) -> Result<(Task, CellPlan), Failure> {
        let (mut task, plan) = setup::prepare(recipe, cell).map_err(Failure::Setup)?;
        if let Some(seed) = self.seed {
            task.setting = task.setting.with_seed(seed);
        }
        if let Some(learned) = self.files.get(RunFile::LearnedFrom.name()) {
            let text = learned.read(run).map_err(Failure::Journal)?;
            let learned = Learned::from_saved(&run.join(&learned.name), &text).map_err(Failure::Learned)?;
            let from = learned.run.clone();
            task.start_from_learned(learned).map_err(|source| Failure::TooMuchLearned { run: from, source })?;
        }
        let differs = |what: &'static str| Err(Failure::OtherTask { run: run.to_owned(), what });
        if HEXLOWER.encode(&task.part_identity) != self.nominal_sha256 {
            return differs("the nominal surface");
        }
        if !task.setting.fits(&self.setting) {
            return differs("the setting of grinding, measuring and correction");
        }
        if RecordedPlan::new(&plan) != self.plan {
            return differs("the plan of the cell");
        }
        Ok((task, plan))
    }
}
