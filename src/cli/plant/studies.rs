//! `regrind study`: simulates a recipe many times on all available workers, and summarises the results.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use regrind::config::PlantConfig;
use regrind::figures::statistics::quantile;
use regrind::formats::{ResultFolder, ScratchFolder, write_atomic};
use regrind::recipe::Recipe;
use regrind_plant::{DatabaseLink, LeasedRun, PlantError, RENEWAL, Study, run_overview};
use serde_json::{Map, Value, json};

use super::super::failure::Failure;
use super::super::words::three_digits;
use super::super::{Outcome, check, name, outside};
use super::plant_file::{Where, open};
use super::recipes::{files_of, is_below};

/// Time between two queries of a worker while there is no job.
const ROUND: Duration = Duration::from_secs(5);
/// Maximum duration of a run. A run that takes longer hangs.
const MAX_RUN: Duration = Duration::from_secs(1700);
/// Maximum wait for a plant that cannot be reached.
const MAX_WAIT: Duration = Duration::from_secs(60);
/// Maximum number of jobs of one study.
const MAX_JOBS: usize = 1_000_000;
/// Maximum number of reasons of failures that are shown.
const MAX_REASONS: usize = 10;
/// Quantile of the normal distribution for a 95 % interval.
const Z: f64 = 1.96;

/// Simulate a recipe many times, on any number of computers, and summarise the results
#[derive(Args, Debug)]
#[command(after_help = "\
For commissioning: a study shows how often a part of a recipe is accepted, and after how many cycles, for each set of
values (such as gain or tolerance). It also shows how often an accepted part is truly out of tolerance. Each run is a
job in the plant's database. If a worker dies, nothing is lost: another worker gets its job.

Examples:
  regrind study begin recipes/freeform-mirror.toml --name gains --seeds 1..200 --vary compensation.gain=0.6,0.8,1.0 --plant planner.toml
  regrind study work --plant worker.toml --workers 2
  regrind study show gains --plant planner.toml

Exit codes: 0 done; 1 there is no such study; 2 bad arguments, or the database refuses the command; 3 the database
cannot be reached.")]
pub(in crate::cli) struct Arguments {
    #[command(subcommand)]
    what: StudyCommand,
}

#[derive(Debug, Subcommand)]
enum StudyCommand {
    Begin(ToBegin),
    Work(ToWork),
    Show(ToShow),
    Stop(ToStop),
}

/// Start a study: a job for each seed and each set of values
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind study begin mirror.toml --name limits --seeds 1..50 --vary acceptance.pv_um=2.5,3.0 --vary cycle.max_cycles=3,5 --plant planner.toml

Exit codes: 0 started; 2 the recipe is invalid with one of the values, or a study has this name already; 3 the database
cannot be reached.")]
struct ToBegin {
    /// Recipe, with a table [simulation]
    #[arg(value_name = "RECIPE")]
    recipe: PathBuf,
    /// Name of the study
    #[arg(long, value_name = "NAME", value_parser = name)]
    name: String,
    /// Seeds of the simulated parts and runs
    #[arg(long, value_name = "FIRST..LAST", value_parser = seeds)]
    seeds: (u64, u64),
    /// Key of the recipe and its values, separated by commas; repeat the option for another key: the study has all
    /// combinations
    #[arg(long, value_name = "KEY=VALUE,VALUE", value_parser = variation)]
    vary: Vec<(String, Vec<Value>)>,
    #[command(flatten)]
    plant: Where,
}

/// Make the simulated runs of studies until no job is left
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind study work --plant worker.toml --workers 2 --wait

The command waits while the database cannot be reached, and keeps the result of a run meanwhile.

Exit codes: 0 no job is left; 2 bad arguments, or the database refuses the command; 3 the database cannot be reached
at the start.")]
struct ToWork {
    /// Number of runs at a time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=64))]
    workers: u8,
    /// Wait for further jobs when none is left, until Ctrl-C
    #[arg(long)]
    wait: bool,
    #[command(flatten)]
    plant: Where,
}

/// Show the results of a study for each set of values
#[derive(Args, Debug)]
#[command(after_help = "\
`accepted` has a 95 % interval (Wilson 1927). `false accepts` are accepted parts whose true form in the simulation is out
of tolerance.

Example:
  regrind study show gains --plant planner.toml

Exit codes: 0 shown; 1 there is no such study; 2 the database refuses the command; 3 the database cannot be
reached.")]
struct ToShow {
    /// Name of the study
    #[arg(value_name = "NAME")]
    name: String,
    #[command(flatten)]
    plant: Where,
    /// Print each run as a line of JSON
    #[arg(long)]
    json: bool,
}

/// Stop a study: assign no further job of it
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind study stop gains --plant planner.toml

Exit codes: 0 stopped; 1 there is no such study, or the study was stopped before; 2 the database refuses the command; 3 the
database cannot be reached.")]
struct ToStop {
    /// Name of the study
    #[arg(value_name = "NAME")]
    name: String,
    #[command(flatten)]
    plant: Where,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    match &arguments.what {
        StudyCommand::Begin(of) => begin(of),
        StudyCommand::Work(of) => work(of),
        StudyCommand::Show(of) => show(of),
        StudyCommand::Stop(of) => stop(of),
    }
}

fn seeds(text: &str) -> Result<(u64, u64), String> {
    let words = || "give the first and the last seed, such as 1..200".to_owned();
    let (first, last) = text.split_once("..").ok_or_else(words)?;
    let number = |of: &str| of.trim().parse::<u64>().map_err(|_| words());
    match (number(first)?, number(last)?) {
        (first, last) if first <= last && last - first < MAX_JOBS as u64 => Ok((first, last)),
        _ => Err(format!("the last seed must not be less than the first, and at most {MAX_JOBS} seeds are allowed")),
    }
}

/// Parses an argument such as `compensation.gain=0.8,1.0` into the dotted recipe key and its values, which are in TOML
/// notation. Returns the reason if the key or the values are invalid, or if there is no value.
fn variation(text: &str) -> Result<(String, Vec<Value>), String> {
    let (key, values) = text.split_once('=').ok_or("give a key and its values, such as compensation.gain=0.8,1.0")?;
    let key = key.trim();
    let is_key =
        |part: &str| !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    if !key.split('.').all(is_key) {
        return Err(format!("{key:?} is not a valid key of a recipe; write a key such as compensation.gain"));
    }
    let table: toml::Table = format!("values = [{values}]")
        .parse()
        .map_err(|_| format!("{values:?} is not a list of TOML values; write values such as 0.8,1.0"))?;
    let values = serde_json::to_value(&table["values"]).map_err(|error| error.to_string())?;
    match values {
        Value::Array(values) if !values.is_empty() => Ok((key.to_owned(), values)),
        _ => Err("there is no value".into()),
    }
}

/// Returns all combinations of the values of the keys in `vary` (Cartesian product). Each combination maps every key to
/// one value.
fn every_one(vary: &[(String, Vec<Value>)]) -> Vec<Map<String, Value>> {
    vary.iter().fold(vec![Map::new()], |all, (key, values)| {
        let mut every = Vec::with_capacity(all.len() * values.len());
        for of in &all {
            for value in values {
                let mut of = of.clone();
                of.insert(key.clone(), value.clone());
                every.push(of);
            }
        }
        every
    })
}

/// Returns the recipe `text` (TOML) with the new values in `values`. Each entry of `values` maps a dotted key, such as
/// `compensation.gain`, to the new value. Creates a missing key or table. Returns the reason as text if `text` is not
/// valid TOML, if a part of a key is not a table, or if a value does not exist in TOML.
fn varied(text: &str, values: &Map<String, Value>) -> Result<String, String> {
    let mut recipe: toml::Table = text.parse().map_err(|error| format!("the recipe is not valid TOML: {error}"))?;
    for (key, value) in values {
        let mut table = &mut recipe;
        let (tables, last) = key.rsplit_once('.').unwrap_or(("", key));
        for part in tables.split('.').filter(|part| !part.is_empty()) {
            let inner = table.entry(part).or_insert_with(|| toml::Value::Table(toml::Table::new()));
            table = inner.as_table_mut().ok_or_else(|| format!("{key}: {part} is no table"))?;
        }
        let value: toml::Value = serde_json::from_value(value.clone()).map_err(|error| format!("{key}: {error}"))?;
        table.insert(last.to_owned(), value);
    }
    Ok(recipe.to_string())
}

fn begin(arguments: &ToBegin) -> Result<Outcome, Failure> {
    let recipe = check::or_show(Recipe::read(&arguments.recipe))?;
    let sets = every_one(&arguments.vary);
    for values in &sets {
        let text = varied(recipe.text(), values).map_err(PlantError::Recipe)?;
        // Reports now the errors for which a worker would later refuse the job.
        check::or_show(Recipe::parse(recipe.path(), &text))?;
    }
    let (first, last) = arguments.seeds;
    let seeds: Vec<u64> = (first..=last).collect();
    if seeds.len() * sets.len() > MAX_JOBS {
        let what = format!(
            "{} jobs are more than the maximum of {MAX_JOBS} in a study; use fewer seeds",
            seeds.len() * sets.len()
        );
        return Err(PlantError::Recipe(what).into());
    }
    let study = Study {
        name: arguments.name.clone(),
        recipe: recipe.path().file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        text: recipe.text().to_owned(),
        files: files_of(&recipe)?,
    };
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let sets: Vec<Value> = sets.into_iter().map(Value::Object).collect();
        let jobs = study.begin(&link, &sets, &seeds).await?;
        super::super::print(&format!(
            "{}: {} created; to run the jobs of the study: regrind study work\n",
            study.name,
            super::super::words::counted(jobs, "job")
        ))?;
        Ok(Outcome::Accepted)
    })
}

fn work(arguments: &ToWork) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    // The work of a person at this computer has priority.
    outside::give_way(outside::BACKGROUND_STEPS);
    super::super::runtime()?.block_on(async {
        // A wrong plant file, or a database that cannot be reached at the start, is told at once.
        drop(open(&config).await?);
        let (mut workers, mut made) = (tokio::task::JoinSet::new(), 0);
        let here = tokio::task::LocalSet::new();
        for _ in 0..arguments.workers {
            workers.spawn_local_on(make_runs(config.clone(), arguments.wait), &here);
        }
        let all = async {
            while let Some(worker) = workers.join_next().await {
                made += worker.map_err(|error| Failure::Terminal(error.into()))??;
            }
            Ok::<_, Failure>(())
        };
        here.run_until(all).await?;
        super::super::print(&format!("{} made\n", super::super::words::counted(made, "run")))?;
        Ok(Outcome::Accepted)
    })
}

/// Makes the runs of studies, one after the other, until no job is left. With `waits`, waits for further jobs then. Waits
/// also while the plant cannot be reached, and keeps the result of a run meanwhile. Returns the number of runs whose
/// result the plant has accepted.
async fn make_runs(config: PlantConfig, waits: bool) -> Result<usize, Failure> {
    let mut made = 0;
    loop {
        let leased = once_reached(&config, async |link| {
            let Some(job) = LeasedRun::lease_next(link).await? else { return Ok(None) };
            Ok(Some((Study::read(link, &job).await?, job)))
        });
        let Some((study, job)) = leased.await? else {
            if !waits {
                return Ok(made);
            }
            tokio::time::sleep(ROUND).await;
            continue;
        };
        let result = make_run(&config, study, &job).await;
        made += usize::from(once_reached(&config, async |link| job.finish(link, &result).await).await?);
    }
}

/// Makes the run of a leased job, and renews its lease meanwhile. Returns the summary of the run, or the reason why there
/// is none.
async fn make_run(config: &PlantConfig, study: Study, job: &LeasedRun) -> Result<Value, String> {
    let of = job.clone();
    let mut run = tokio::task::spawn_blocking(move || made_of(&study, &of));
    loop {
        tokio::select! {
            ended = &mut run => return ended.unwrap_or_else(|error| Err(error.to_string())),
            () = tokio::time::sleep(RENEWAL) => {}
        }
        // A run takes longer than a connection should stay idle. A lease that cannot be renewed now is renewed later,
        // or it is over, and the plant refuses the result.
        if let Ok(link) = open(config).await {
            let _ = job.renew(&link).await;
        }
    }
}

/// Executes `step` with a new connection to the plant. Repeats it while the plant cannot be reached, with a wait that
/// doubles up to [`MAX_WAIT`].
///
/// Returns an error that does not pass by itself.
async fn once_reached<T>(
    config: &PlantConfig,
    step: impl AsyncFn(&DatabaseLink) -> Result<T, PlantError>,
) -> Result<T, Failure> {
    let mut wait = Duration::from_secs(1);
    loop {
        let done = match open(config).await {
            Ok(link) => step(&link).await.map_err(Failure::from),
            Err(error) => Err(error),
        };
        match done {
            Err(Failure::Plant(error)) if error.may_pass() => {
                eprintln!("study: {error}; this worker tries again in {} s", wait.as_secs());
                tokio::time::sleep(wait).await;
                wait = (2 * wait).min(MAX_WAIT);
            }
            other => return other,
        }
    }
}

/// Runs the recipe of `study` on a simulated cell in a separate process. `job` states the changed recipe values and the
/// seed. Returns the summary of the run as JSON. The key `truth` of the summary contains the true PV and RMS of the
/// simulated part in µm. If the run fails or is held, returns the reason as text.
fn made_of(study: &Study, job: &LeasedRun) -> Result<Value, String> {
    let words = |error: &dyn std::fmt::Display| error.to_string();
    let place = std::env::temp_dir().join(format!("regrind-study-{:032x}", rand::random::<u128>()));
    let scratch = ScratchFolder::at(place).map_err(|error| words(&error))?;
    let empty = Map::new();
    let text = varied(&study.text, job.varied.as_object().unwrap_or(&empty))?;
    let recipe = scratch.path().join(format!("{}.toml", study.recipe));
    write(&recipe, text.as_bytes())?;
    for (name, content) in &study.files {
        let inside = Path::new(name);
        if !is_below(inside) {
            return Err(format!(
                "the recipe names the file {name:?}, which is outside of the folder of the recipe; move the file into this folder, and begin the study again"
            ));
        }
        write(&scratch.path().join(inside), content)?;
    }
    let [runs, truth] = ["runs", "truth.json"].map(|name| scratch.path().join(name));
    let mut command = Command::new(std::env::current_exe().map_err(|error| words(&error))?);
    command.arg("run").arg(&recipe).args(["--cell", "sim", "--json", "--seed", &job.seed.to_string(), "--runs"]);
    command.arg(&runs).arg("--truth").arg(&truth).env("REGRIND_KEY", "");
    run_to_end(command)?;
    let run = std::fs::read_dir(&runs).ok().and_then(|mut runs| Some(runs.next()?.ok()?.path()));
    let run = run.ok_or("the run left no record")?;
    let mut told = run_overview(&run).map_err(|error| words(&error))?;
    let truth = std::fs::read(&truth).map_err(|error| format!("the true form is not known: {error}"))?;
    told["truth"] = serde_json::from_slice(&truth).map_err(|error| words(&error))?;
    Ok(told)
}

/// Runs the process `command` of a simulated run until the run is accepted or ends out of tolerance. Returns the reason
/// as text if it ends otherwise. Nobody is there to resume a run that is Held, so such a run has failed too.
fn run_to_end(mut command: Command) -> Result<(), String> {
    let words = |error: std::io::Error| error.to_string();
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().map_err(words)?;
    let mut child = KilledOnDrop(child);
    let (sender, lines) = std::sync::mpsc::channel();
    let output = child.0.stdout.take().map(BufReader::new);
    std::thread::spawn(move || {
        output.into_iter().flat_map(BufRead::lines).map_while(Result::ok).try_for_each(|line| sender.send(line))
    });
    let errors = child.0.stderr.take();
    let errors = std::thread::spawn(move || {
        let mut text = Vec::new();
        // A message that cannot be read is missing in the reason.
        let _ = errors.map(|mut errors| errors.read_to_end(&mut text));
        String::from_utf8_lossy(&text).trim_end().to_owned()
    });
    let began = Instant::now();
    let mut waiting = Waiting::default();
    loop {
        match lines.recv_timeout(MAX_RUN.saturating_sub(began.elapsed())) {
            Ok(line) => {
                waiting.take_notice(&line);
                if let (true, Some(alarm)) = (waiting.is_held, &waiting.alarm) {
                    return Err(format!("the run was held: {alarm}"));
                }
            }
            Err(RecvTimeoutError::Timeout) => {
                return Err(format!("the run did not end within {} s", MAX_RUN.as_secs()));
            }
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    let ended = child.0.wait().map_err(words)?;
    if matches!(ended.code(), Some(0 | 1)) {
        return Ok(());
    }
    let reason = errors.join().unwrap_or_default();
    let reason = if reason.is_empty() { waiting.alarm.unwrap_or_default() } else { reason };
    Err(if reason.is_empty() { format!("the run ended with {ended}") } else { reason })
}

/// State and alarm of a run, by the lines of its output.
#[derive(Default)]
struct Waiting {
    /// True while the cell is Held.
    is_held: bool,
    /// The last alarm that a person must acknowledge.
    alarm: Option<String>,
}

impl Waiting {
    /// Takes one line of the output of `regrind run --json`. The alarm can come before the state or after it.
    fn take_notice(&mut self, line: &str) {
        let Ok(notice) = serde_json::from_str::<Value>(line) else { return };
        let text = |key: &str| notice[key].as_str().unwrap_or_default();
        match text("notice") {
            "alarm" if text("clears") == "operator" => self.alarm = Some(text("what").to_owned()),
            "state" => self.is_held = text("state").starts_with("Held"),
            _ => {}
        }
    }
}

/// Process that does not outlive the function that started it. It is simulated whole, and its folder is deleted.
struct KilledOnDrop(Child);

impl Drop for KilledOnDrop {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn write(path: &Path, content: &[u8]) -> Result<(), String> {
    let made = ResultFolder::prepare(path.parent().unwrap_or(Path::new(""))).map_err(|error| error.to_string())?;
    made.keep();
    write_atomic(path, content).map_err(|error| error.to_string())
}

fn show(arguments: &ToShow) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let text = "SELECT j.job, j.varied::text, j.seed, j.state, j.result::text FROM study s JOIN study_job j ON j.study = s.id
            WHERE s.name = $1 ORDER BY j.job";
        let found = link.query(text, &[&arguments.name]).await?;
        if found.is_empty() {
            super::super::print(&format!("there is no study {:?}\n", arguments.name))?;
            return Ok(Outcome::NotInTolerance);
        }
        let value = |text: Option<&str>| text.and_then(|text| serde_json::from_str(text).ok()).unwrap_or(Value::Null);
        let jobs = found.iter().map(|row| {
            let varied = value(row.get(1));
            json!({ "job": row.get::<_, i32>(0), "varied": varied, "seed": row.get::<_, i64>(2), "state": row.get::<_, &str>(3), "result": value(row.get(4)) })
        });
        let jobs: Vec<Value> = jobs.collect();
        match arguments.json {
            true => super::super::print(&jobs.iter().map(|job| format!("{job}\n")).collect::<String>())?,
            false => super::super::print(&in_words(&jobs))?,
        }
        Ok(Outcome::Accepted)
    })
}

/// Returns the results of the jobs of a study as a text table with a heading. Each job is one simulated run. The table
/// has one line for each set of recipe values, and combines the jobs with different seeds. The sets are in the order of
/// their first job.
fn in_words(jobs: &[Value]) -> String {
    let mut sets: BTreeMap<String, (i64, Vec<&Value>)> = BTreeMap::new();
    for job in jobs {
        let first = job["job"].as_i64().unwrap_or(0);
        sets.entry(job["varied"].to_string()).or_insert_with(|| (first, Vec::new())).1.push(job);
    }
    let mut sets: Vec<(String, (i64, Vec<&Value>))> = sets.into_iter().collect();
    sets.sort_by_key(|(_, (first, _))| *first);
    let mut text = format!(
        "{:>5} {:>5} {:>7} {:>24} {:>7} {:>9} {:>9} {:>9}  values\n",
        "runs", "open", "failed", "accepted", "cycles", "PV µm", "RMS µm", "false"
    );
    for (_, (_, jobs)) in &sets {
        text += &line_of(jobs);
    }
    text + &failures_in_words(jobs)
}

/// Returns the reasons of failed jobs, one line each, with the number of jobs and one of them. Most frequent first.
fn failures_in_words(jobs: &[Value]) -> String {
    let mut reasons: BTreeMap<&str, Vec<&Value>> = BTreeMap::new();
    for job in jobs.iter().filter(|job| job["state"] == "failed") {
        let reason = job["result"]["error"].as_str().unwrap_or("the reason is not known");
        reasons.entry(reason.lines().next().unwrap_or_default()).or_default().push(job);
    }
    let mut reasons: Vec<(&str, Vec<&Value>)> = reasons.into_iter().collect();
    reasons.sort_by_key(|(_, jobs)| std::cmp::Reverse(jobs.len()));
    let line = |(reason, jobs): &(&str, Vec<&Value>)| {
        format!("failed: {}, such as seed {}: {reason}\n", jobs.len(), jobs[0]["seed"])
    };
    reasons.iter().take(MAX_REASONS).map(line).collect()
}

fn line_of(jobs: &[&Value]) -> String {
    let count = |state: &str| jobs.iter().filter(|job| job["state"] == state).count();
    let done: Vec<&Value> = jobs.iter().filter(|job| job["state"] == "done").map(|job| &job["result"]).collect();
    let accepted: Vec<&&Value> = done.iter().filter(|run| run["result"] == "accepted").collect();
    let last = |run: &Value, key: &str| run["cycles"].as_array()?.iter().rev().find_map(|cycle| cycle[key].as_f64());
    let cycles = accepted.iter().filter_map(|run| Some(run["cycles"].as_array()?.len() as f64));
    let is_out = |run: &&&&Value| {
        let beyond = |of: &str, limit: &str| {
            run["truth"][of].as_f64().zip(run[limit].as_f64()).is_some_and(|(is, most)| is > most)
        };
        beyond("pv_um", "pv_limit_um") || beyond("rms_um", "rms_limit_um")
    };
    let known = accepted.iter().filter(|run| run["truth"].is_object()).count();
    let wrong = accepted.iter().filter(is_out).count();
    let [low, high] = wilson(accepted.len(), done.len());
    let share = match done.len() {
        0 => "-".to_owned(),
        n => format!("{:.1} % ({low:.1} to {high:.1})", 100.0 * accepted.len() as f64 / n as f64),
    };
    let shown = |value: Option<f64>| value.map_or("-".to_owned(), three_digits);
    let values = jobs[0]["varied"].as_object().into_iter().flatten().map(|(key, value)| format!("{key} = {value}"));
    format!(
        "{:>5} {:>5} {:>7} {share:>24} {:>7} {:>9} {:>9} {:>9}  {}\n",
        done.len(),
        count("open") + count("leased"),
        count("failed"),
        shown(mean(cycles)),
        shown(median(done.iter().filter_map(|run| last(run, "pv_um")).collect())),
        shown(median(done.iter().filter_map(|run| last(run, "rms_um")).collect())),
        if known == 0 { "-".to_owned() } else { format!("{wrong} of {known}") },
        values.collect::<Vec<_>>().join(", ")
    )
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0_u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    quantile(&values, 0.5)
}

/// Returns the lower and upper limit of the 95 % Wilson score interval of a proportion, in per cent (0 to 100). The
/// proportion is `of` successes in `all` trials; `all` must be above 0. Source: E. B. Wilson, JASA 22, 1927.
fn wilson(of: usize, all: usize) -> [f64; 2] {
    let (n, p) = (all as f64, of as f64 / all as f64);
    let middle = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    // Rounding must not produce a share below 0 or above 1.
    [middle - half, middle + half].map(|bound| (100.0 * bound / (1.0 + Z * Z / n)).clamp(0.0, 100.0))
}

fn stop(arguments: &ToStop) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let done = link.query("SELECT stop_study($1)", &[&arguments.name]).await?;
        if done.first().is_some_and(|row| row.get(0)) {
            super::super::print(&format!("{} is stopped: no further jobs are assigned\n", arguments.name))?;
            return Ok(Outcome::Accepted);
        }
        super::super::print(&format!(
            "no study has the name {:?}, or this study was stopped before\n",
            arguments.name
        ))?;
        Ok(Outcome::NotInTolerance)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variations_form_full_factorial() {
        let vary = ["a.b=1,2", "c=\"x\",true,0.5"].map(|text| variation(text).unwrap());
        let sets = every_one(&vary);
        assert_eq!(sets.len(), 6);
        let text = varied("c = 1\n[a]\nd = 3\n", &sets[5]).unwrap();
        let back: toml::Table = text.parse().unwrap();
        assert_eq!(back, "c = 0.5\n[a]\nb = 2\nd = 3\n".parse().unwrap());
        assert!(varied("a = 1", &sets[0]).unwrap_err().contains("a is no table"));
        for bad in ["", "a", "=1", "a b=1", "a=", "a=[", "a..b=1"] {
            assert!(variation(bad).is_err(), "{bad}");
        }
        assert_eq!(seeds("3..3"), Ok((3, 3)));
        assert!(["", "1", "2..1", "-1..2", "0..1000000"].iter().all(|bad| seeds(bad).is_err()));
    }

    #[test]
    fn held_run_waits_for_person_whatever_comes_first() {
        let alarm = r#"{"notice":"alarm","clears":"operator","what":"No part was found."}"#;
        let [held, goes_on] = ["Held (Measure, Send)", "Execute (Measure, Run)"]
            .map(|state| format!(r#"{{"notice":"state","state":"{state}"}}"#));
        let after = |lines: &[&str]| {
            let mut waiting = Waiting::default();
            lines.iter().for_each(|line| waiting.take_notice(line));
            (waiting.is_held, waiting.alarm.is_some())
        };
        assert_eq!(after(&[alarm, &held]), (true, true));
        assert_eq!(after(&[&held, alarm]), (true, true));
        assert_eq!(after(&[&held, &goes_on]), (false, false));
        let by_itself = alarm.replace("operator", "condition");
        assert_eq!(after(&[&by_itself, &held, "no JSON", "{}"]), (true, false));
    }

    #[test]
    fn wilson_interval_matches_newcombe() {
        // 81 of 263: 0.2553 to 0.3662 (Newcombe 1998, table I, method 3).
        let [low, high] = wilson(81, 263);
        assert!((low - 25.53).abs() < 0.01 && (high - 36.62).abs() < 0.01, "{low} {high}");
        let [[none, _], [_, all]] = [wilson(0, 20), wilson(20, 20)];
        assert!((0.0..1e-12).contains(&none) && (100.0 - 1e-12..=100.0).contains(&all), "{none} {all}");
        assert_eq!((median(vec![]), median(vec![3.0, 1.0]), median(vec![5.0, 1.0, 2.0])), (None, Some(2.0), Some(2.0)));
    }
}
