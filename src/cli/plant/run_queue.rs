//! `regrind work`: runs the parts in the plant's queue one after the other. A person at the cell confirms each.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::Args;
use regrind::config::{BUILT_IN_CELL, PlantConfig};
use regrind::drive::is_live;
use regrind::formats::{ResultFolder, write_atomic};
use regrind::journal::{DATABASE, Reader, RecordKind};
use regrind::recipe::Recipe;
use regrind_plant::{DatabaseLink, LEASE, Lease, PlantError, PlantRecipe, StartedPart};

use super::super::failure::Failure;
use super::super::{Outcome, check, run as making, terminal};
use super::confirmed_part::ConfirmedPart;
use super::failure::PlantFailure;
use super::plant_file::{open, read};
use super::recipes::is_below;
use super::run_arguments::RunArguments;

/// Time between two queries of the queue with `--wait`.
const ROUND: Duration = Duration::from_secs(5);
/// Folder of downloaded recipes, within the folder of the runs.
const RECIPES: &str = ".recipes";

/// Make the parts that are queued for this cell at the plant, one after the other
#[derive(Args, Debug)]
#[command(after_help = "\
The part with the earliest due date is leased to this cell. The recipe of the part is fetched by its hash and
verified: two of the approvers in the plant file must have signed the recipe. The person at the cell types or scans the
serial number of the part to confirm; any other input returns the part to the queue. After its start the part belongs to
its run: no other cell gets the part, even if this cell fails. The command ends when no part is left, or when a part
is not accepted.

Examples:
  regrind work --plant cell-1.toml --cell config/modbus-tcp.toml --operator \"A. Smith\"
  regrind work --plant cell-1.toml --part SN-0042 --once
  regrind work --plant cell-1.toml --give-back SN-0042
  regrind work --plant cell-1.toml --give-up SN-0042 --reason \"the blank broke\"

Exit codes: 0 all queued parts are accepted; 1 a part was not accepted, was returned to the queue, or was started
here and is not finished;
2 bad arguments, or a recipe that is not approved; 3 a fault or abort, or the plant cannot be reached.")]
pub(in crate::cli) struct Arguments {
    /// Plant file: address and user of the database, and the approvers of recipes
    #[arg(long, value_name = "FILE")]
    plant: PathBuf,
    /// Cell that makes the parts; `sim` is the built-in simulated cell
    #[arg(long, value_name = "FILE", default_value = BUILT_IN_CELL)]
    cell: PathBuf,
    /// Name of the person at the cell
    #[arg(long, value_name = "NAME", value_parser = super::super::name)]
    operator: Option<String>,
    /// Folder in which to create the folders of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Confirm the part with this serial number, if it is the next; give back any other part
    #[arg(long, value_name = "SERIAL", value_parser = super::super::name)]
    part: Option<String>,
    /// Make at most one part
    #[arg(long)]
    once: bool,
    /// Wait for further parts when none is left, or while the plant cannot be reached, until Ctrl-C
    #[arg(long, conflicts_with = "once")]
    wait: bool,
    /// Give back a part that was started here without any result of its run: you have checked that nothing was ground
    #[arg(long, value_name = "SERIAL", value_parser = super::super::name, conflicts_with_all = ["part", "once", "wait"])]
    give_back: Option<String>,
    /// Give up a part whose run was interrupted and will not be resumed: a planner decides whether it is made again
    #[arg(long, value_name = "SERIAL", value_parser = super::super::name, requires = "reason", conflicts_with_all = ["part", "once", "wait", "give_back"])]
    give_up: Option<String>,
    /// Reason for giving it up, for the record
    #[arg(long, alias = "why", value_name = "WORDS", value_parser = super::super::name, requires = "give_up")]
    reason: Option<String>,
    /// Seed of other simulated parts and runs
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Print a line of JSON for each event of a run
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let config = read(&arguments.plant)?;
    if let Some(serial) = arguments.give_back.as_ref().or(arguments.give_up.as_ref()) {
        return super::super::runtime()?.block_on(give(&config, &arguments.runs, serial, arguments.reason.as_deref()));
    }
    let mut is_told = false;
    loop {
        let next = match super::super::runtime()?.block_on(next(&config, arguments)) {
            Err(Failure::Plant(error)) if arguments.wait && error.may_pass() => {
                if !std::mem::replace(&mut is_told, true) {
                    eprintln!("work: {error}; this cell waits until the plant can be reached");
                }
                std::thread::sleep(ROUND);
                continue;
            }
            other => other?,
        };
        is_told = false;
        let (recipe, taken) = match next {
            Next::Part(recipe, taken) => (recipe, taken),
            Next::None if arguments.wait => {
                std::thread::sleep(ROUND);
                continue;
            }
            Next::None => {
                super::super::print("no part is waiting for this cell\n")?;
                return Ok(Outcome::Accepted);
            }
            Next::GivenBack => return Ok(Outcome::NotInTolerance),
        };
        let lease = taken.lease.clone();
        let outcome = making::run(&making::Arguments {
            rehearsal: false,
            draft: None,
            recipe,
            cell: arguments.cell.clone(),
            part: Some(taken.lease.serial.clone()),
            operator: arguments.operator.clone(),
            runs: arguments.runs.clone(),
            loaded: false,
            seed: arguments.seed,
            serve: None,
            plant: RunArguments { plant: Some(arguments.plant.clone()), work: Some(taken), truth: None },
            json: arguments.json,
        });
        let outcome = match outcome {
            Ok(outcome) => outcome,
            Err(error) => {
                super::super::runtime()?.block_on(return_unbegun(&config, &lease));
                return Err(error);
            }
        };
        // After any other result a person must act before the next blank is ground.
        if outcome != Outcome::Accepted || arguments.once {
            return Ok(outcome);
        }
    }
}

/// Answer of the queue for the cell.
enum Next {
    /// Confirmed part, and the path of its recipe.
    Part(PathBuf, Box<ConfirmedPart>),
    /// Part that nobody at the cell confirmed.
    GivenBack,
    None,
}

/// Leases (reserves) the next part of the queue for this cell. Fetches the recipe of the part from the plant, verifies
/// its signatures, stores it, and asks a person to confirm the part. Returns the confirmed part with the path of the
/// recipe. If nobody confirms the part, returns the part to the queue. Returns [`Next::None`] if no part waits for this
/// cell.
///
/// If the recipe is invalid or not approved, returns the part to the queue and returns an error. Also returns an error
/// if a part that this cell has started still has an open run.
async fn next(config: &PlantConfig, arguments: &Arguments) -> Result<Next, Failure> {
    let link = open(config).await?;
    nothing_is_open(&link, &arguments.runs).await?;
    let Some((lease, recipe, signed)) = provable(&link, config).await? else { return Ok(Next::None) };
    let path = keep(&arguments.runs, &lease.recipe_sha256, &recipe)?;
    let read = match check::or_show(Recipe::read(&path)) {
        Ok(read) => read,
        Err(error) => {
            lease.hand_back(&link, "the program of this cell rejects the recipe of the part").await?;
            return Err(error);
        }
    };
    let PlantRecipe { name, version, .. } = &recipe;
    let due = lease.due.as_ref().map_or(String::new(), |due| format!(", due {due}"));
    let told = format!(
        "{}  to be made by version {version} of the recipe {name}, signed by {}{due}\n",
        lease.serial,
        signed.join(" and ")
    );
    super::super::print(&regrind::document::visible(&told))?;
    match confirmed(&link, &lease, &read, arguments).await? {
        true => Ok(Next::Part(path, Box::new(ConfirmedPart { config: config.clone(), lease }))),
        false => {
            lease.hand_back(&link, "no person at the cell confirmed the part").await?;
            super::super::print("the part is given back\n")?;
            Ok(Next::GivenBack)
        }
    }
}

/// Returns the leased part to the queue if no run has begun to make it, for example because another run has the machines.
/// If the plant cannot be reached, the lease ends by itself.
async fn return_unbegun(config: &PlantConfig, lease: &Lease) {
    let returned = async {
        let link = open(config).await?;
        let is_begun = StartedPart::all(&link).await?.iter().any(|begun| begun.lease.work == lease.work);
        if !is_begun {
            lease.hand_back(&link, "its run did not begin").await?;
        }
        Ok::<(), Failure>(())
    };
    let _ = returned.await;
}

/// Leases the next part whose recipe this cell can prove. Returns the lease, the recipe, and the people who signed it. A
/// part whose recipe cannot be proven goes back to the queue, because another cell can know who signed it. Returns `None`
/// if no part waits for this cell.
///
/// # Errors
/// The recipe of each waiting part cannot be proven: the reason of the first. The plant cannot be reached.
async fn provable(
    link: &DatabaseLink,
    config: &PlantConfig,
) -> Result<Option<(Lease, PlantRecipe, Vec<String>)>, PlantError> {
    let mut refused: Vec<i64> = Vec::new();
    let mut first = None;
    loop {
        let Some(lease) = Lease::acquire(link).await? else { return first.map_or(Ok(None), Err) };
        if refused.contains(&lease.work) {
            lease.hand_back(link, "the recipes of all other parts are refused too").await?;
            return first.map_or(Ok(None), Err);
        }
        match PlantRecipe::pull(link, &lease.recipe_sha256, &config.approvers).await {
            Ok((recipe, signed)) => return Ok(Some((lease, recipe, signed))),
            Err(error) if error.may_pass() => {
                lease.hand_back(link, &error.to_string()).await?;
                return Err(error);
            }
            Err(error) => {
                lease.refuse_recipe(link, &error.to_string()).await?;
                refused.push(lease.work);
                first.get_or_insert(error);
            }
        }
    }
}

/// Returns true if the run of the leased part may begin. If `arguments` give a serial number (`--part`), this number
/// must be that of the part. Otherwise the recipe requires no confirmation, or a person at the terminal enters the
/// serial number of the part. Returns false if the given serial number is wrong. Renews the lease (the reservation of
/// the part) while the person has not answered. Returns an error if the lease cannot be renewed, except for a temporary
/// fault.
async fn confirmed(
    link: &DatabaseLink,
    lease: &Lease,
    recipe: &Recipe,
    arguments: &Arguments,
) -> Result<bool, Failure> {
    if let Some(serial) = &arguments.part {
        return Ok(*serial == lease.serial);
    }
    if !recipe.cycle.confirm_work {
        return Ok(true);
    }
    super::super::print(
        "  type or scan the serial number to start this part; any other input returns the part to the queue: ",
    )?;
    let mut answer = tokio::task::spawn_blocking(terminal::answer);
    loop {
        tokio::select! {
            typed = &mut answer => return Ok(typed.map_err(|error| Failure::Terminal(error.into()))?? == lease.serial),
            () = tokio::time::sleep(LEASE / 3) => match lease.renew(link).await {
                // The plant decides when the part begins. A network fault in the meantime does not decide anything.
                Err(error) if error.may_pass() => {}
                renewed => renewed?,
            },
        }
    }
}

/// Returns an error if a part that this cell has started still has an open run. The cell then leases no further part.
/// The error names the run and how to close it.
async fn nothing_is_open(link: &DatabaseLink, runs: &Path) -> Result<(), Failure> {
    for begun in StartedPart::all(link).await? {
        let (run, serial, folder) = (&begun.run, &begun.lease.serial, runs.join(&begun.run));
        let nothing = match run_progress(&folder) {
            // The end of the run is still on its way to the plant.
            RunProgress::Over => continue,
            RunProgress::UnderWay => {
                let reason = format!(
                    "run {run} of {serial} is not over: regrind resume {} continues the run; if resume is refused, give up the part: regrind work --give-up {serial} --reason \"...\"",
                    folder.display()
                );
                return Err(PlantFailure::OpenWork { reason }.into());
            }
            RunProgress::Nowhere => {
                format!(
                    "which has no record in {}; check whether the part was ground; if the part was not ground, return the part to the queue",
                    runs.display()
                )
            }
            RunProgress::Begun => "which sent no request to a machine; return the part to the queue".to_owned(),
        };
        let reason = format!("{serial} was begun in run {run}, {nothing}: regrind work --give-back {serial}");
        return Err(PlantFailure::OpenWork { reason }.into());
    }
    Ok(())
}

/// Ends the assignment of the part `serial` to this cell. If `up` contains a reason, the part is abandoned: it is made
/// again only if a planner queues it again. If `up` is `None`, the part returns to the queue. If this cell has not
/// started the part, there is nothing to end, and the result is `NotInTolerance` (only for its exit code).
///
/// # Errors
/// The run of the part is active. Without a reason, also: the run has sent a command to a machine or has ended.
async fn give(config: &PlantConfig, runs: &Path, serial: &str, up: Option<&str>) -> Result<Outcome, Failure> {
    let link = open(config).await?;
    let begun = StartedPart::all(&link).await?.into_iter().find(|begun| begun.lease.serial == serial);
    let Some(begun) = begun else {
        super::super::print(&format!("{serial} was not started by this cell\n"))?;
        return Ok(Outcome::NotInTolerance);
    };
    let (run, folder) = (&begun.run, runs.join(&begun.run));
    let refused = |reason: String| Err(PlantFailure::OpenWork { reason }.into());
    if is_live(&folder) {
        return refused(format!("run {run} of {serial} is active; end the run first with regrind stop"));
    }
    if let Some(reason) = up {
        begun.give_up(&link, reason).await?;
        super::super::print(&format!(
            "the part {serial} is given up; to make the part again, a planner must queue the part again\n"
        ))?;
        return Ok(Outcome::Accepted);
    }
    if matches!(run_progress(&folder), RunProgress::UnderWay | RunProgress::Over) {
        return refused(format!(
            "the part {serial} is not returned to the queue, because run {run} has a record here; continue the run with regrind resume, or give up the part with regrind work --give-up"
        ));
    }
    begun.give_back(&link, "its run did nothing").await?;
    super::super::print(&format!("the part {serial} is returned to the queue\n"))?;
    Ok(Outcome::Accepted)
}

/// Progress of a run, by its record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RunProgress {
    /// Run without a record.
    Nowhere,
    /// Run that began, but sent nothing to a machine.
    Begun,
    /// Run that sent a request to a machine.
    UnderWay,
    /// Run with a recorded end.
    Over,
}

/// Returns the progress of the run in `folder` as stated in its record: no record, begun, command sent to a machine, or
/// ended. If the record cannot be read, assumes that the run has sent a command to a machine.
fn run_progress(folder: &Path) -> RunProgress {
    // To look makes no journal where there is none.
    let Ok(reader) = Reader::open(folder) else {
        return if folder.join(DATABASE).exists() { RunProgress::UnderWay } else { RunProgress::Nowhere };
    };
    let mut far = RunProgress::Nowhere;
    for record in reader.records(0) {
        far = match record.map(|record| record.kind) {
            Ok(RecordKind::End) => return RunProgress::Over,
            Ok(RecordKind::Intent | RecordKind::Event) | Err(_) => RunProgress::UnderWay,
            Ok(_) if far == RunProgress::Nowhere => RunProgress::Begun,
            Ok(_) => far,
        };
    }
    far
}

/// Writes a recipe of the plant, with the files that it needs, to a subfolder of `runs`. The name of the subfolder is
/// `sha256`, the hash of the recipe. Returns the path of the recipe file. Returns an error if a file name leads out of
/// the subfolder, or if a file cannot be written.
fn keep(runs: &Path, sha256: &str, recipe: &PlantRecipe) -> Result<PathBuf, Failure> {
    let folder = runs.join(RECIPES).join(sha256);
    let plain = |c: char| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let name: String = recipe.name.chars().map(plain).collect();
    let path = folder.join(format!("{}.toml", name.trim_start_matches('.')));
    write(&path, recipe.text.as_bytes())?;
    for (name, content) in &recipe.files {
        let inside = Path::new(name);
        if !is_below(inside) {
            let what = format!(
                "the recipe {} names the file {name:?}, which is outside of the folder of the recipe; propose the recipe again with all files in its folder",
                recipe.name
            );
            return Err(PlantError::Recipe(what).into());
        }
        write(&folder.join(inside), content)?;
    }
    Ok(path)
}

fn write(path: &Path, content: &[u8]) -> Result<(), Failure> {
    // A file with equal content was verified before. Any other file is overwritten.
    if fs::read(path).is_ok_and(|there| there == content) {
        return Ok(());
    }
    ResultFolder::prepare(path.parent().unwrap_or(Path::new("")))?.keep();
    Ok(write_atomic(path, content)?)
}
