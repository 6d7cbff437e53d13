//! `regrind run`: grinds, measures, registers, judges and compensates, until the part is accepted or the loop must
//! stop.

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use clap::Args;
use data_encoding::HEXLOWER;
use regrind::cell::{Actor, CellPlan, Ending, FirstStep, TABLE_VERSION};
use regrind::config::{BUILT_IN_CELL, CellConfig};
use regrind::document::{Problems, read_text, visible};
use regrind::drive::Task;
use regrind::formats::run_files::{CycleFolder, RunFile};
use regrind::formats::{KnowledgeOrigin, Learned, LearnedError, SettingIdentity};
use regrind::journal::{AuditKey, Header, Journal, Reader, free_bytes, utc_to_the_second};
use regrind::recipe::Recipe;
use regrind::record::{MeasuringStrategy, PartStart, RecordedPlan, RunContent};
use regrind::setup;

use super::control::folders;
use super::draft::read_draft;
use super::failure::Failure;
use super::live::{PreparedRun, RunContext, outcome};
use super::outcome::FAULT;
use super::succession::RunPlace;
use super::{Outcome, check, key, outside, plan, plant, serve, simulated, truth};

/// Run correction cycles from a recipe until the part is accepted
#[derive(Args, Debug)]
#[command(after_help = "\
Without --cell everything is simulated, on real Modbus TCP connections within this program, and marked SIMULATION.
Press Ctrl-C once to hold the cell at the next safe place, or twice to abort the run. A closed terminal (SIGHUP) and a
stopped service (SIGTERM) stop the run: the machines go to their safe place, and the run ends. A second signal aborts
the run.

Example:
  regrind run recipes/freeform-mirror.toml
  regrind run recipes/freeform-mirror.toml --cell config/modbus-tcp.toml --part SN-0042 --operator \"A. Smith\"

Exit codes: 0 accepted; 1 finished, not in tolerance, or stopped by a person; 2 bad arguments, recipe or data; 3 fault or abort.")]
pub(super) struct Arguments {
    /// Recipe of the part
    #[arg(value_name = "RECIPE")]
    pub(super) recipe: PathBuf,
    /// Cell that makes the part; `sim` is the built-in simulated cell
    #[arg(long, value_name = "FILE", default_value = BUILT_IN_CELL)]
    pub(super) cell: PathBuf,
    /// Serial number of the part
    #[arg(long, value_name = "SERIAL", value_parser = super::name)]
    pub(super) part: Option<String>,
    /// Name of the operator
    #[arg(long, value_name = "NAME", value_parser = super::name)]
    pub(super) operator: Option<String>,
    /// Folder in which to create the folder of the run
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub(super) runs: PathBuf,
    /// Do not ask for the part: the right one is loaded and clamped, and wheel and probe are clear of it
    #[arg(long)]
    pub(super) loaded: bool,
    /// Rehearse without a part, at machines that people serve: everything is marked SIMULATION, and the plan itself is
    /// accepted as a measurement
    #[arg(long)]
    pub(super) rehearsal: bool,
    /// Seed of another simulated part and run
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// Also show the cell as a page in the browser at this address, as `regrind serve` does; on a terminal the page stays
    /// after the run until Ctrl-C
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = serve::ADDRESS)]
    pub(super) serve: Option<SocketAddr>,
    /// Read the text of the recipe from this file, as if it were that of RECIPE; only simulated machines are used, at the
    /// lowest priority
    #[arg(long, value_name = "FILE", hide = true)]
    pub(super) draft: Option<PathBuf>,
    #[command(flatten)]
    pub(super) plant: plant::RunArguments,
    /// Print a line of JSON for each event
    #[arg(long)]
    pub(super) json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let recipe = check::or_show(read_recipe(arguments))?;
    let mut cell = check::or_show(CellConfig::read(&arguments.cell))?;
    if arguments.draft.is_some() {
        if !within(&cell) {
            return Err(Failure::DraftNeedsSimulation { cell: arguments.cell.clone() });
        }
        outside::give_way_to_all();
        end_with_input();
    }
    let of_cell: Vec<String> =
        cell.renamed_keys().iter().cloned().chain(cell.calibration_notes(&regrind::report::today())).collect();
    for (path, notes) in [(&arguments.recipe, recipe.notes()), (&arguments.cell, &of_cell[..])] {
        for note in notes.iter().filter(|_| !arguments.json) {
            super::print(&format!("note     {}, {note}\n", path.display()))?;
        }
    }
    if arguments.rehearsal && !cell.is_manual() {
        return Err(Failure::NoRehearsal { cell: arguments.cell.clone() });
    }
    cell.rehearsal = arguments.rehearsal;
    let (mut task, plan) = setup::prepare(&recipe, &cell).map_err(Failure::Setup)?;
    if let Some(seed) = arguments.seed {
        task.setting = task.setting.with_seed(seed);
    }
    let earlier = match recipe.compensation.learn {
        true => Some(EarlierKnowledge::apply_newest(&mut task, arguments)?),
        false => None,
    };
    // An unusable key is an error and does not lead to an unsigned record.
    let key = key::of_this_user()?;
    if cell.require_signature && key.is_none() {
        return Err(Failure::Unsigned { cell: arguments.cell.clone() });
    }
    // The inputs of a run are checked before anything opens. The path of a later pass is checked when its map exists,
    // and the run may not need a later pass at all.
    if plan.begin_with == FirstStep::Grind {
        plan::first_path(&task, &recipe, &cell)?;
    }
    let spec = match within(&cell) {
        true => Some(check::or_show(truth::world_spec(&recipe, &task.nominal, arguments.seed))?),
        false => None,
    };
    super::runtime()?.block_on(async {
        let mut cell = cell;
        let world = match spec {
            Some(spec) => Some(simulated::serve(spec, &mut cell, &recipe).await?),
            None => None,
        };
        let (ending, page) = carry_out(arguments, &recipe, &cell, task, plan, earlier, key).await?;
        if let Some(served) = &world {
            arguments.plant.write_truth(&served.world, &recipe, &cell)?;
        }
        drop(world);
        if let Some(page) = page {
            page.stay(arguments.json).await;
        }
        outcome(&ending)
    })
}

/// Ends this program when its standard input ends. The page that started it holds the other end, so the simulation does
/// not outlive a page that was killed.
fn end_with_input() {
    std::thread::spawn(|| {
        // An input that cannot be read has no page behind it either.
        let _ = io::copy(&mut io::stdin(), &mut io::sink());
        std::process::exit(FAULT.into())
    });
}

/// Reads the recipe of a run, or the text that is to be tried in its place.
fn read_recipe(arguments: &Arguments) -> Result<Recipe, Problems> {
    match &arguments.draft {
        None => Recipe::read(&arguments.recipe),
        Some(draft) => read_draft(&arguments.recipe, &read_text(draft)?),
    }
}

/// Returns the folder of a run in `runs` that accepted the part with the serial number `part`, the last by name.
fn accepted_run(runs: &Path, part: &str) -> Option<PathBuf> {
    let is_accepted = |run: &PathBuf| {
        let result = std::fs::read(run.join(RunFile::Result.name())).ok()?;
        let result: serde_json::Value = serde_json::from_slice(&result).ok()?;
        if result["ending"]["ending"] != "accepted" {
            return None;
        }
        let first = Reader::open(run).ok()?.records(0).next()?.ok()?;
        Some(first.part == part)
    };
    folders(runs).filter(|run| is_accepted(run) == Some(true)).max()
}

/// Locks and connects the machines, creates the run folder and the journal, and executes the run until its end. Returns
/// how the run has ended, and the process that shows its page. `earlier` is the knowledge from earlier runs, or `None` if the recipe does not use any. `key`
/// signs the record; without a key the record is not signed. Returns an error if the disk has too little space, a
/// machine is not available, or a file cannot be written.
async fn carry_out(
    arguments: &Arguments,
    recipe: &Recipe,
    cell: &CellConfig,
    task: Task,
    plan: CellPlan,
    earlier: Option<EarlierKnowledge>,
    key: Option<AuditKey>,
) -> Result<(Ending, Option<serve::PageProcess>), Failure> {
    let actor = operator(arguments.operator.as_deref());
    let began = SystemTime::now();
    let job = epoch(began);
    // These checks come before the record: with a missing folder or a busy line there is no run.
    let part = arguments.part.clone().unwrap_or_else(|| recipe_name(recipe));
    let earlier_run = arguments.part.as_ref().and_then(|part| accepted_run(&arguments.runs, part));
    if let Some(accepted) = earlier_run.filter(|_| !arguments.json) {
        super::print(&format!("note     the part {part} was ACCEPTED before, in {}\n", accepted.display()))?;
    }
    let folder = free_folder(&arguments.runs, &recipe_name(recipe), began, cell.is_marked_simulation());
    let (free, needed) = (free_bytes(&folder).unwrap_or(u64::MAX), task.cycle_bytes());
    if free < needed {
        return Err(Failure::NoSpace { path: arguments.runs.clone(), free, needed });
    }
    let page = arguments.serve.map(|at| serve::PageProcess::start(&arguments.runs, &folder, at, arguments.json));
    let page = page.transpose()?;
    let _plant = arguments.plant.start_processes(&arguments.runs)?;
    let live = RunContext { recipe, cell, part: &part, folder: &folder, job, actor, json: arguments.json };
    let machines = live.open(job)?;
    if let Some(earlier) = earlier.as_ref().filter(|_| !arguments.json) {
        // The names of other cells and their runs come from the plant.
        super::print(&visible(&earlier.in_words(&arguments.runs)))?;
    }
    // The machines are locked, and nothing was sent to them. From here on the part belongs to this run.
    arguments.plant.begin_part(&folder).await?;
    if key.is_none() && !arguments.json {
        super::print(
            "not signed: the origin of this record cannot be proven; create a signing key with `regrind audit key`\n",
        )?;
    }
    let (place, turn) = RunPlace::next(&arguments.runs)?;
    let header = header(arguments, &live, (&task, &plan), earlier.as_ref(), place);
    let mut journal = begin(header, &live, earlier.and_then(|earlier| earlier.learned), key)?;
    drop(turn);
    let works_by_program = cell.grinder.link.wire.reads_run_folder() || cell.grinder.program.folder.is_some();
    if task.learned.is_some() || works_by_program {
        record_first_correction(&task, &mut journal)?;
    }
    let loaded = arguments.loaded || cell.simulated;
    let ending = live.carry_out(machines, PreparedRun { task, plan, journal, loaded, interrupted: None }).await?;
    Ok((ending, page))
}

/// Returns the time `now` in whole seconds since 1970, modulo 2^31, and at least 1. A machine compares this number with
/// the number of an earlier program: the program with the higher number began later.
pub(super) fn epoch(now: SystemTime) -> u32 {
    let seconds = now.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
    u32::try_from(seconds & 0x7fff_ffff).unwrap_or(1).max(1)
}

/// Knowledge that earlier runs have left.
#[derive(Default)]
struct EarlierKnowledge {
    /// Knowledge of the newest finished run with the same setting, and the content of its file.
    learned: Option<(Learned, Vec<u8>)>,
    /// Errors of runs that could not be read during the search.
    skipped: Vec<LearnedError>,
    /// Messages about the knowledge of the plant.
    messages: Vec<String>,
}

impl EarlierKnowledge {
    /// Changes `task` so that the run begins with the knowledge (correction and error statistics) of the newest
    /// finished run with the same settings. If there is no such run and `arguments` name a plant file, uses the results
    /// that other cells of the plant have learned. Returns the knowledge that was found. Leaves `task` unchanged if
    /// nothing was found.
    ///
    /// # Errors
    /// The correction from the earlier run exceeds the limits of this task, or the plant file is invalid.
    fn apply_newest(task: &mut Task, arguments: &Arguments) -> Result<Self, Failure> {
        let mut earlier = Self::newest(&arguments.runs, &task.setting, task.simulation);
        if let Some((learned, _)) = &earlier.learned {
            let run = learned.run.clone();
            task.start_from_learned(learned.clone()).map_err(|source| Failure::TooMuchLearned { run, source })?;
        } else if let Some(learned) = arguments.plant.query_knowledge(task, &mut earlier.messages)? {
            earlier.apply_plant(task, learned)?;
        }
        Ok(earlier)
    }

    /// Changes `task` so that the run begins with `learned`, the results that other cells of the plant have learned. If
    /// these results are not usable, `task` is unchanged and a message states the reason. Returns an error if the
    /// results cannot be written as JSON.
    fn apply_plant(&mut self, task: &mut Task, learned: Learned) -> Result<(), Failure> {
        // Read back in the same way as by a program that resumes the run.
        let text = serde_json::to_vec(&learned).map_err(|error| Failure::Terminal(error.into()))?;
        match task.start_from_learned(learned.clone()) {
            Ok(()) => self.learned = Some((learned, text)),
            Err(source) => {
                self.messages.push(format!(
                    "the learned results of {} cannot be used, so the run begins without these results: {source}",
                    learned.run
                ));
            }
        }
        Ok(())
    }

    fn newest(runs: &Path, setting: &SettingIdentity, simulated: bool) -> Self {
        let mut earlier = Self::default();
        // Without the folder there are no runs yet.
        let Ok(entries) = std::fs::read_dir(runs) else { return earlier };
        let written = |run: PathBuf| {
            Some((std::fs::metadata(run.join(RunFile::Learned.name())).and_then(|m| m.modified()).ok()?, run))
        };
        let mut all: Vec<_> = entries.filter_map(|entry| written(entry.ok()?.path())).collect();
        all.sort();
        for (_, run) in all.into_iter().rev() {
            match Learned::read(&run, setting, simulated) {
                Ok(None) => {}
                Ok(found) => return Self { learned: found, ..earlier },
                Err(error) => earlier.skipped.push(error),
            }
        }
        earlier
    }

    fn in_words(&self, runs: &Path) -> String {
        let mut text: String = self.skipped.iter().map(|error| format!("ignored: {error}\n")).collect();
        text.extend(self.messages.iter().map(|words| format!("{words}\n")));
        text += &match &self.learned {
            Some((Learned { origin: Some(others), .. }, _)) => others_in_words(others),
            Some((learned, _)) => format!(
                "begins with the error that {} found in every pass: the first pass corrects this error\n",
                learned.run
            ),
            None => format!(
                "begins without knowledge from earlier runs: no finished run in {} has the same part, cell, wheel, gain and way of measuring\n",
                runs.display()
            ),
        };
        text
    }
}

/// Returns one line of text for a person about the knowledge `others` from other cells with which the run begins. The
/// line names the source runs. It states the assumed difference of the machines in per cent, or why the run begins
/// without a correction.
fn others_in_words(others: &KnowledgeOrigin) -> String {
    let runs: Vec<String> = others.runs.iter().map(|from| format!("{} (run {})", from.cell, from.run)).collect();
    let runs = runs.join(" and ");
    let percent = |of: fn(f64, f64) -> f64| {
        100.0 * others.machine_difference.iter().map(|[_, share]| *share).reduce(of).unwrap_or(0.0)
    };
    let [least, most] = [percent(f64::min), percent(f64::max)];
    match others.machine_difference.is_empty() {
        false => format!(
            "begins with the knowledge from {runs}; {least:.0} to {most:.0} % (RMS, by wavelength) of the repeatable error are assumed to be specific to one machine, based on {} comparison(s) of machines\n",
            others.comparisons
        ),
        true => format!(
            "begins with the form statistics that {runs} learned, but without a correction: {}\n",
            match others.comparisons {
                0 =>
                    "machine similarity is unknown: grind one recipe on two machines, or set `[plant] machines_differ`",
                _ => "the compared machines show no common error",
            }
        ),
    }
}

/// Returns true if a machine of the cell is simulated inside this process. This is the case if the cell is simulated
/// and the cell file leaves the address of a machine undefined, for example with port 0. Otherwise returns false.
pub(super) fn within(cell: &CellConfig) -> bool {
    cell.simulated && [&cell.cmm.link, &cell.grinder.link].iter().any(|link| link.wire.has_open_address())
}

/// Returns the first entry of the record of a run. The entry contains the data that a program needs to resume the run,
/// such as the paths and hashes of the recipe and the cell file, and the plan. `live` is the context of the run.
/// `earlier` is the knowledge from earlier runs with which the run begins; `None` if there is none. `place` is the
/// position of the run among the runs of its folder.
fn header(
    arguments: &Arguments,
    live: &RunContext,
    (task, plan): (&Task, &CellPlan),
    earlier: Option<&EarlierKnowledge>,
    place: RunPlace,
) -> Header {
    let RunContext { recipe, cell, folder, actor, .. } = live;
    let learned = earlier.and_then(|earlier| earlier.learned.as_ref()).map(|(learned, _)| learned);
    let left_alone = earlier.iter().flat_map(|earlier| &earlier.skipped).map(ToString::to_string);
    let left_alone: Vec<String> =
        left_alone.chain(earlier.iter().flat_map(|earlier| earlier.messages.clone())).collect();
    // The open ports are assigned by now. The text of the file shows whether they were open.
    let machines_within = CellConfig::parse(cell.path(), cell.text()).is_ok_and(|cell| within(&cell));
    Header {
        run: folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
        part: arguments.part.clone().unwrap_or_else(|| "unnamed".into()),
        actor: actor.name.clone(),
        station: actor.station.clone(),
        simulation: cell.is_marked_simulation(),
        first_command_id: 1,
        content: RunContent::Part(Box::new(PartStart {
            recipe: Some(recipe.path().to_string_lossy().into_owned()),
            recipe_sha256: Some(HEXLOWER.encode(recipe.source_sha256())),
            cell: Some(cell.path().to_string_lossy().into_owned()),
            cell_sha256: Some(HEXLOWER.encode(cell.source_sha256())),
            working_folder: Some(std::env::current_dir().unwrap_or_default().to_string_lossy().into_owned()),
            nominal_sha256: Some(HEXLOWER.encode(&task.part_identity)),
            setting: Some(task.setting.id.clone()),
            part_name: Some(recipe.part.name.clone()),
            drawing: recipe.part.drawing.clone(),
            material: recipe.part.material.clone(),
            part_in_files: Some(live.part.to_owned()),
            job: Some(live.job),
            seed: arguments.seed,
            measuring: measuring_strategy(task),
            plan: RecordedPlan::new(plan),
            table_version: Some(TABLE_VERSION),
            machines_within: Some(machines_within),
            rehearsal: Some(cell.rehearsal),
            learned_from: learned.map(|learned| learned.run.clone()),
            taught_by: learned.and_then(|learned| learned.origin.clone()),
            left_alone: Some(left_alone),
            number: Some(place.number),
            before: place.before,
        }))
        .into(),
    }
}

/// Returns the measuring strategy of a task; `None` if it has no targets.
fn measuring_strategy(task: &Task) -> Option<MeasuringStrategy> {
    (!task.targets.is_empty()).then(|| MeasuringStrategy {
        targets: task.targets.len(),
        adaptive: task.adaptive.is_some(),
        sphere_points: task.reference_sphere.map_or(0, |sphere| sphere.points),
        speed_mm_s: task.probing.speed_mm_s,
        approach_mm: task.probing.approach_mm,
    })
}

fn begin(
    header: Header,
    live: &RunContext,
    learned: Option<(Learned, Vec<u8>)>,
    key: Option<AuditKey>,
) -> Result<Journal, Failure> {
    let mut journal = Journal::create_with(live.folder, header, key).map_err(Failure::Journal)?;
    let mut store = |file: RunFile, text: &[u8]| journal.store(file.name(), text, 0, 0).map_err(Failure::Journal);
    store(RunFile::Recipe, live.recipe.text().as_bytes())?;
    store(RunFile::Cell, live.cell.text().as_bytes())?;
    if let Some((_, text)) = learned {
        store(RunFile::LearnedFrom, &text)?;
    }
    Ok(journal)
}

/// Writes the correction of the first pass, and the grinding program of this pass, to the subfolder `cycle-0` of the
/// run folder. Adds these files to `journal`. Returns an error if the program cannot be computed or a file cannot be
/// written.
fn record_first_correction(task: &Task, journal: &mut Journal) -> Result<(), Failure> {
    let folder = CycleFolder::new(0).to_string();
    for name in task.save_first_pass(&journal.folder().join(&folder)).map_err(Failure::Programs)? {
        journal.adopt(&format!("{folder}/{name}"), 0, 0).map_err(Failure::Journal)?;
    }
    Ok(())
}

fn recipe_name(recipe: &Recipe) -> String {
    recipe.path().file_stem().map_or("run".into(), |stem| stem.to_string_lossy().into_owned())
}

/// Returns the path of a new run folder in `runs`. Does not create the folder. The folder name consists of `name`, the
/// time `began` in UTC, and the mark `SIMULATION` if `simulated` is true. If this folder already exists, the name also
/// contains a number.
pub(super) fn free_folder(runs: &Path, name: &str, began: SystemTime, simulated: bool) -> PathBuf {
    // The mark is in the path of every file of the run.
    let mark = if simulated { "-SIMULATION" } else { "" };
    let stamp = utc_to_the_second(began).replace(['-', ':'], "");
    let named = |more: u32| match more {
        0 => runs.join(format!("{name}-{stamp}{mark}")),
        more => runs.join(format!("{name}-{stamp}-{more}{mark}")),
    };
    (0..).map(named).find(|folder| !folder.exists()).expect("some number is free")
}

pub(super) fn operator(named: Option<&str>) -> Actor {
    let user = || std::env::var("USER").or_else(|_| std::env::var("USERNAME")).unwrap_or_else(|_| outside::own_name());
    let station = outside::host().unwrap_or_else(|| "this computer".into());
    Actor { name: named.map_or_else(user, str::to_owned), station }
}
