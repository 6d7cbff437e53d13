//! `regrind run`: grind, measure, register, judge, compensate, until the part is accepted or the loop must stop.

use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use regrind::cell::{Actor, Beginning, CellPlan, Ending};
use regrind::config::{CellConfig, Link};
use regrind::device::{AnyCmm, AnyGrinder, Line, Machine as _};
use regrind::drive::{Drive, Orders, Request, Run, Task};
use regrind::formats::{LEARNED, Learned, LearnedError};
use regrind::journal::{Header, Journal, MachineLock};
use regrind::recipe::Recipe;
use regrind::setup;
use serde_json::json;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::mpsc;

use super::failure::Failure;
use super::show::Show;
use super::{Outcome, check, plan, simulated};

/// Run correction cycles from a recipe until the part is accepted
#[derive(Args, Debug)]
#[command(after_help = "\
Without --cell everything is simulated, on real Modbus TCP connections within this program, and marked SIMULATION.
Ctrl-C once holds the cell at the next safe place; twice aborts it. A terminal that is closed (SIGHUP) and a service that
is stopped (SIGTERM) end the run in order; told again, they abort it.

Example:
  regrind run recipes/freeform-mirror.toml
  regrind run recipes/freeform-mirror.toml --cell config/modbus-tcp.toml --part SN-0042 --operator \"A. Smith\"

Exit codes: 0 accepted; 1 finished, not in tolerance; 2 bad arguments, recipe or data; 3 fault or abort.")]
pub(super) struct Arguments {
    /// Recipe of the part
    #[arg(value_name = "RECIPE")]
    recipe: PathBuf,
    /// Cell that makes it
    #[arg(long, value_name = "FILE", default_value = "config/sim.toml")]
    cell: PathBuf,
    /// Serial number of the part
    #[arg(long, value_name = "SERIAL")]
    part: Option<String>,
    /// Who runs it
    #[arg(long, value_name = "NAME")]
    operator: Option<String>,
    /// Folder that the run's own folder is made in
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// The right part is loaded and clamped already, wheel and probe are clear of it: do not ask
    #[arg(long)]
    loaded: bool,
    /// Draw another simulated part and run from this number
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Print a line of JSON for everything that happens
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let recipe = check::or_show(Recipe::read(&arguments.recipe))?;
    let cell = check::or_show(CellConfig::read(&arguments.cell))?;
    let (mut task, plan) = setup::prepare(&recipe, &cell).map_err(Failure::Setup)?;
    if let Some(seed) = arguments.seed {
        task.setting.push_str(&format!(", seed {seed}"));
    }
    let earlier = match recipe.compensation.learn {
        true => Some(Earlier::begun_with(&mut task, &arguments.runs)?),
        false => None,
    };
    // What a run begins with is checked before anything opens; the path of any other pass when its map is made, and it may come to none.
    if plan.begin_with == Beginning::Grind {
        plan::first_path(&task, &recipe, &cell)?;
    }
    let spec = match within(&cell) {
        true => Some(simulated::world_spec(&recipe, arguments.seed)?),
        false => None,
    };
    super::runtime()?.block_on(async {
        let mut cell = cell;
        let _world = match spec {
            Some(spec) => Some(simulated::serve(spec, &mut cell).await?),
            None => None,
        };
        let ending = carry_out(arguments, &recipe, &cell, task, plan, earlier).await?;
        outcome(&ending)
    })
}

/// Opens the machines, begins the record, and lets the run go to its end and its report.
async fn carry_out(
    arguments: &Arguments,
    recipe: &Recipe,
    cell: &CellConfig,
    task: Task,
    plan: CellPlan,
    earlier: Option<Earlier>,
) -> Result<Ending, Failure> {
    let actor = operator(arguments.operator.as_deref());
    let began = jiff::Timestamp::now();
    let job = u32::try_from(began.as_second() & 0x7fff_ffff).unwrap_or(1).max(1);
    // Before the record begins: a folder that is not there, or a line that is in use, is no run.
    let part = arguments.part.clone().unwrap_or_else(|| recipe_name(recipe));
    let folder = free_folder(&arguments.runs, &recipe_name(recipe), began, cell.simulated);
    let client = [owner(&actor, &folder), job];
    let (cmm, grinder) = setup::machines(recipe, cell, &part, &folder, client).map_err(Failure::Setup)?;
    let _taken = [take(&cell.cmm.link, cmm.name(), &folder)?, take(&cell.grinder.link, grinder.name(), &folder)?];
    if let Some(earlier) = earlier.as_ref().filter(|_| !arguments.json) {
        super::print(&earlier.in_words(&arguments.runs))?;
    }
    let mut journal = journal(arguments, &folder, recipe, cell, &actor, earlier.unwrap_or_default())?;
    if task.learned.is_some() || cell.grinder.link.wire.works_from_run() {
        record_first_correction(&task, &mut journal)?;
    }
    let (notices, shown) = mpsc::unbounded_channel();
    let showing = tokio::spawn(Show::new(arguments.json, cell.simulated, recipe, &folder).follow(shown));
    let poll = [setup::poll(&cell.cmm.link), setup::poll(&cell.grinder.link)];
    let loaded = arguments.loaded || cell.simulated;
    let run = Run { plan, task, journal, job, actor: actor.clone(), loaded, poll, notices, interrupted: None };
    let ending = go(run, cmm, grinder, actor).await?;
    let shown = showing.await.map_err(|e| Failure::Terminal(e.into()));
    // The record is closed; a report that cannot be written must not change how the run ended, nor a terminal that has gone.
    let report = regrind::report::write_run_report(&folder);
    shown??;
    if let Err(error) = report {
        super::print(&format!("no report: {error}\n"))?;
    }
    Ok(ending)
}

/// What earlier runs left to learn from.
#[derive(Default)]
struct Earlier {
    /// What the newest finished run of the same setting left, and the file as it is.
    learned: Option<(Learned, Vec<u8>)>,
    /// What could not be read on the way to it.
    left_alone: Vec<LearnedError>,
}

impl Earlier {
    /// Lets a task begin with what the newest run left that is like it.
    fn begun_with(task: &mut Task, runs: &Path) -> Result<Self, Failure> {
        let earlier = Self::newest(runs, &task.setting, task.simulation);
        if let Some((learned, _)) = &earlier.learned {
            let run = learned.run.clone();
            task.begin_with(learned.clone()).map_err(|source| Failure::TooMuchLearned { run, source })?;
        }
        Ok(earlier)
    }

    fn newest(runs: &Path, setting: &str, simulated: bool) -> Self {
        let mut earlier = Self::default();
        // No folder is no run yet.
        let Ok(entries) = std::fs::read_dir(runs) else { return earlier };
        let written = |run: PathBuf| Some((std::fs::metadata(run.join(LEARNED)).and_then(|m| m.modified()).ok()?, run));
        let mut all: Vec<_> = entries.filter_map(|entry| written(entry.ok()?.path())).collect();
        all.sort();
        for (_, run) in all.into_iter().rev() {
            match Learned::read(&run, setting, simulated) {
                Ok(None) => {}
                Ok(found) => return Self { learned: found, ..earlier },
                Err(error) => earlier.left_alone.push(error),
            }
        }
        earlier
    }

    fn in_words(&self, runs: &Path) -> String {
        let mut text: String = self.left_alone.iter().map(|error| format!("left alone: {error}\n")).collect();
        text += &match &self.learned {
            Some((learned, _)) => format!("begins with what {} found to come back in every pass\n", learned.run),
            None => format!(
                "begins from nothing: no finished run in {} has this part, cell, wheel, gain and way of measuring\n",
                runs.display()
            ),
        };
        text
    }
}

/// Gives the run its machines and lets it go.
async fn go(run: Run, cmm: AnyCmm, grinder: AnyGrinder, actor: Actor) -> Result<Ending, Failure> {
    let folder = run.journal.folder().to_owned();
    let (drive, orders) =
        Drive::with_cell(run, cmm, grinder).map_err(|source| Failure::ControlSocket { path: folder, source })?;
    let signals = Signals::new().map_err(Failure::Signals)?;
    let heeding = [tokio::spawn(heed_ctrl_c(orders.clone(), actor.clone())), tokio::spawn(signals.heed(orders, actor))];
    let ending = drive.run().await;
    heeding.iter().for_each(tokio::task::JoinHandle::abort);
    Ok(ending)
}

/// Ctrl-C once holds at the next safe place, twice aborts. After a resume it counts from one again.
async fn heed_ctrl_c(orders: Orders, actor: Actor) {
    let mut held_at: Option<Instant> = None;
    while tokio::signal::ctrl_c().await.is_ok() {
        let again = held_at.is_some_and(|at| at.elapsed() < IN_ONE_GO || !orders.is_working());
        held_at = if again { held_at } else { Some(Instant::now()) };
        let request = if again {
            Request::Abort { reason: "Ctrl-C, twice".into() }
        } else {
            Request::Hold { reason: "Ctrl-C".into() }
        };
        orders.give(request, actor.clone()).await;
    }
}

/// What ends a program from outside: a terminal that is closed, a service that is stopped.
struct Signals {
    /// None where whoever started the program wants it to outlive its terminal (`nohup`).
    hangup: Option<Signal>,
    terminate: Signal,
}

impl Signals {
    fn new() -> io::Result<Self> {
        let hangup = if ignores_hangup() { None } else { Some(signal(SignalKind::hangup())?) };
        Ok(Self { hangup, terminate: signal(SignalKind::terminate())? })
    }

    /// The first ends the run in order, the next one aborts it. A terminal that closes may say so twice.
    async fn heed(mut self, orders: Orders, actor: Actor) {
        let mut first: Option<Instant> = None;
        loop {
            let (name, hung_up) = tokio::select! {
                Some(()) = self.terminate.recv() => ("SIGTERM", false),
                Some(()) = async { self.hangup.as_mut()?.recv().await }, if self.hangup.is_some() => {
                    ("SIGHUP, the terminal was closed", true)
                }
                else => return,
            };
            let reason = name.to_owned();
            let request = match first {
                None => Request::Stop { reason },
                Some(at) if hung_up && at.elapsed() < IN_ONE_GO => continue,
                Some(_) => Request::Abort { reason: format!("{reason}, again") },
            };
            first = first.or_else(|| Some(Instant::now()));
            orders.give(request, actor.clone()).await;
        }
    }
}

/// Whether SIGHUP, the first signal, is ignored by who started this program.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

/// Whether the machines of a cell are simulated in this process: only there a port may be left open.
fn within(cell: &CellConfig) -> bool {
    let open = |link: &Link| matches!(link.wire.line(), Some((Line::Tcp { port: 0, .. }, _)));
    cell.simulated && (open(&cell.cmm.link) || open(&cell.grinder.link))
}

fn journal(
    arguments: &Arguments,
    folder: &Path,
    recipe: &Recipe,
    cell: &CellConfig,
    actor: &Actor,
    Earlier { learned, left_alone }: Earlier,
) -> Result<Journal, Failure> {
    let part = arguments.part.clone().unwrap_or_else(|| "unnamed".into());
    let hex = |bytes: &[u8; 32]| bytes.iter().map(|b| format!("{b:02x}")).collect::<String>();
    let header = Header {
        run: folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
        part,
        actor: actor.name.clone(),
        station: actor.station.clone(),
        simulation: cell.simulated,
        first_command_id: 1,
        content: json!({
            "recipe": recipe.path(), "recipe_sha256": hex(recipe.source_sha256()),
            "cell": cell.path(), "cell_sha256": hex(cell.source_sha256()),
            "part_name": recipe.part.name, "seed": arguments.seed, "learned_from": learned.as_ref().map(|(learned, _)| &learned.run),
            "left_alone": left_alone.iter().map(ToString::to_string).collect::<Vec<_>>(),
        }),
    };
    let mut journal = Journal::create(folder, header).map_err(Failure::Journal)?;
    journal.store("recipe.toml", recipe.text().as_bytes(), 0, 0).map_err(Failure::Journal)?;
    journal.store("cell.toml", cell.text().as_bytes(), 0, 0).map_err(Failure::Journal)?;
    if let Some((_, text)) = learned {
        journal.store("learned_from.json", &text, 0, 0).map_err(Failure::Journal)?;
    }
    Ok(journal)
}

/// Records the correction of a first pass that begins with what was learned, and its program: as if a cycle before the first had made it.
fn record_first_correction(task: &Task, journal: &mut Journal) -> Result<(), Failure> {
    let folder = journal.folder().join("cycle-0");
    for name in task.save_first(&folder).map_err(Failure::Programs)? {
        journal.adopt(&format!("cycle-0/{name}"), 0, 0).map_err(Failure::Journal)?;
    }
    Ok(())
}

fn recipe_name(recipe: &Recipe) -> String {
    recipe.path().file_stem().map_or("run".into(), |stem| stem.to_string_lossy().into_owned())
}

/// Returns a folder for a run that began now: the recipe's name and the time, and a number if two begin in one second.
fn free_folder(runs: &Path, name: &str, began: jiff::Timestamp, simulated: bool) -> PathBuf {
    // Every file in it carries the mark in its path.
    let mark = if simulated { "-SIMULATION" } else { "" };
    let stamp = began.strftime("%Y%m%dT%H%M%SZ");
    let named = |more: u32| match more {
        0 => runs.join(format!("{name}-{stamp}{mark}")),
        more => runs.join(format!("{name}-{stamp}-{more}{mark}")),
    };
    (0..).map(named).find(|folder| !folder.exists()).expect("some number is free")
}

fn operator(named: Option<&str>) -> Actor {
    let user = || std::env::var("USER").or_else(|_| std::env::var("USERNAME")).unwrap_or_else(|_| "unknown".into());
    let host = std::fs::read_to_string("/etc/hostname").unwrap_or_default();
    let host = if host.trim().is_empty() { "this computer".to_owned() } else { host.trim().to_owned() };
    Actor { name: named.map_or_else(user, str::to_owned), station: host }
}

/// Keeps a machine on a line from every other run on this computer.
fn take(link: &Link, name: &str, run: &Path) -> Result<Option<MachineLock>, Failure> {
    let run = std::path::absolute(run).unwrap_or_else(|_| run.to_owned());
    let taken = link.wire.line().map(|_| MachineLock::take(name, &run));
    taken.transpose().map_err(Failure::Machine)
}

/// A number for this run as a client of its machines.
fn owner(actor: &Actor, run: &Path) -> u32 {
    let mut hash = crc32fast::Hasher::new();
    hash.update(b"regrind ");
    hash.update(actor.station.as_bytes());
    hash.update(run.as_os_str().as_encoded_bytes());
    hash.finalize().max(1)
}

fn outcome(ending: &Ending) -> Result<Outcome, Failure> {
    match ending {
        Ending::Accepted { .. } => Ok(Outcome::Accepted),
        Ending::NotAccepted { .. } => Ok(Outcome::NotInTolerance),
        Ending::Stopped { reason, .. } | Ending::Aborted { reason, .. } => {
            Err(Failure::Ended { reason: reason.clone() })
        }
    }
}

/// Two presses within this are one wish, whatever the cell has made of the first by then.
const IN_ONE_GO: Duration = Duration::from_secs(3);
