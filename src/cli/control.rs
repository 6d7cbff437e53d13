//! `regrind hold | stop | abort | confirm | status`: controls a running cell from another terminal.

use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use regrind::cell::{AlarmId, Device};
use regrind::drive::{CycleRow, JobProgress, Reply, Request, Snapshot, is_live, send_request};
use regrind::journal::{MachineLock, Reader, Record, RecordKind};
use regrind::record::{Begin, RunContent};
use regrind_control::{is_live_at, send_request_at};
use serde::Deserialize;
use serde::de::value::StrDeserializer;

use super::Outcome;
use super::choice::word_of;
use super::failure::Failure;
use super::show::{how_far, limits, preview_text, pv_name};
use super::words::time_left;

/// Returns the text at the end of the help of an order (a command to a running cell). The text explains which run is
/// used if the person names none, lists the exit codes, and contains `example`, an example command line.
pub(super) fn help(example: &str) -> String {
    format!(
        "\
RUN is the folder of a run; by default the active run under runs/. Regrind writes your user name in the operating
system into the record.

Example:
  {example}

Exit codes: 0 the cell accepted the order; 2 no such run; 3 the cell refused the order, or did not answer."
    )
}

/// An order to a running cell.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Reason, for the record
    #[arg(long, value_name = "TEXT", default_value = "", value_parser = super::remark)]
    reason: String,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
}

/// Confirmation of a person to a running cell.
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  regrind confirm loaded
  regrind confirm started                       for machines that a person serves, see docs/manual.md
  regrind confirm done --file points.csv
  regrind confirm done --map 3fa9c210           for machines that take files, see docs/file-exchange.md
  regrind confirm clear --machine cmm
  regrind confirm seen --alarm link_lost        an alarm was seen; this clears nothing
  regrind confirm over --machine grinder --evidence \"at rest, wheel up, one pass was ground\"

Exit codes: 0 the cell accepted the confirmation; 2 no such run; 3 the cell refused the confirmation, or did not
answer.")]
pub(super) struct Confirmation {
    /// Fact to confirm
    #[arg(value_enum)]
    what: ConfirmedState,
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Inspected machine, for `clear`, `still` and `over`
    #[arg(long, value_parser = word_of::<Device>())]
    machine: Option<Device>,
    /// First 8 or more digits of the hash of the map that the grinder uses, for `started` and `done`
    #[arg(long, value_name = "DIGITS")]
    map: Option<String>,
    /// File of the measurement, for `done` of a measuring machine that a person serves
    #[arg(long, value_name = "FILE")]
    file: Option<PathBuf>,
    /// Active alarm that was seen, by its name in the record, for `seen`
    #[arg(long, value_name = "ALARM", value_parser = alarm_named)]
    alarm: Option<AlarmId>,
    /// Observation at the machine, for `over` and `seen`
    #[arg(long, value_name = "TEXT", default_value = "", value_parser = super::remark)]
    evidence: String,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ConfirmedState {
    /// The right part is loaded and clamped, wheel and probe are clear of it
    Loaded,
    /// The machine that a person serves has started its job
    Started,
    /// The machine has finished its job, and is clear of the part
    Done,
    /// A machine is clear of the part, but cannot report it
    Clear,
    /// A machine that was ordered to hold or stop is at rest
    Still,
    /// A job whose state no machine can report is over: the machine is at rest, clear of the part
    Over,
    /// A person has seen an alarm and takes care; this clears nothing
    Seen,
}

/// Returns the words for the facts that a person can confirm, with their help.
pub(super) fn confirmed_words() -> impl Iterator<Item = (String, Option<String>)> {
    let values = ConfirmedState::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    values.map(|value| (value.get_name().to_owned(), value.get_help().map(ToString::to_string)))
}

/// Reads the name of an alarm, such as `link_lost`.
fn alarm_named(name: &str) -> Result<AlarmId, String> {
    let unknown = "no alarm has this name; `regrind status --json` has the active alarms with their names";
    AlarmId::deserialize(StrDeserializer::<serde::de::value::Error>::new(name)).map_err(|_| unknown.to_owned())
}

/// Sends an order to the cell of the run that `arguments` name, and prints the reply. `order` is a function that builds
/// the [`Request`] from the reason in `arguments`.
///
/// Returns an error if no run is found, or if the cell does not answer or refuses the order.
pub(super) fn order(arguments: &Arguments, order: fn(String) -> Request) -> Result<Outcome, Failure> {
    give(arguments.run.as_deref(), &order(arguments.reason.clone()), arguments.json)
}

pub(super) fn confirm(arguments: &Confirmation) -> Result<Outcome, Failure> {
    let request = match (arguments.what, arguments.machine) {
        (ConfirmedState::Loaded, _) => Request::Loaded,
        (ConfirmedState::Started, _) => Request::Started { map: named_map(arguments)? },
        (ConfirmedState::Done, _) => Request::Done { map: named_map(arguments)?, file: named_file(arguments)? },
        (ConfirmedState::Clear, Some(device)) => Request::Clear { device },
        (ConfirmedState::Clear, None) => return Err(Failure::NoMachine),
        (ConfirmedState::Still, device) => Request::Still { device },
        (ConfirmedState::Over, Some(device)) if !arguments.evidence.trim().is_empty() => {
            Request::Over { device, evidence: arguments.evidence.clone() }
        }
        (ConfirmedState::Over, _) => return Err(Failure::Evidence),
        (ConfirmedState::Seen, _) if arguments.alarm.is_none() => return Err(Failure::NoAlarm),
        (ConfirmedState::Seen, _) => Request::Remark { what: arguments.evidence.clone(), alarm: arguments.alarm },
    };
    give(arguments.run.as_deref(), &request, arguments.json)
}

fn named_map(arguments: &Confirmation) -> Result<Option<String>, Failure> {
    match &arguments.map {
        Some(map) if map.trim().len() < 8 => Err(Failure::ShortMap),
        map => Ok(map.clone()),
    }
}

/// Returns the absolute path of the file that a person names in the confirmation `arguments`. The path must be
/// absolute, because the cell can run in another folder.
///
/// Returns `None` if no file is named. Returns an error if the file does not exist.
fn named_file(arguments: &Confirmation) -> Result<Option<PathBuf>, Failure> {
    let absolute =
        |path: &PathBuf| path.canonicalize().map_err(|source| Failure::NoFile { path: path.clone(), source });
    arguments.file.as_ref().map(absolute).transpose()
}

pub(super) fn give(run: Option<&Path>, request: &Request, json: bool) -> Result<Outcome, Failure> {
    let folder = run.map_or_else(|| live(Path::new("runs")), |run| Ok(run.to_owned()))?;
    let asked = |request: &Request| reached(&folder, request).map_err(|source| Failure::unreached(&folder, source));
    let reply = match request {
        // The resume applies to the current state of the cell. If another terminal gives a hold in the meantime, that
        // hold stays.
        Request::Resume { reason, state_number: None } => {
            let state_number = Some(asked(&Request::Status)?.status.state_number);
            asked(&Request::Resume { reason: reason.clone(), state_number })?
        }
        request => asked(request)?,
    };
    show(&reply, request, &folder, json)?;
    if reply.accepted { Ok(Outcome::Accepted) } else { Err(Failure::OrderRefused { message: reply.message }) }
}

/// Sends `request` to the cell that executes the run in `folder`, and returns the reply. First uses the control socket
/// in `folder`. If no program listens at that socket, uses the second control socket of the run, next to the lock file
/// of the machines.
///
/// Returns an error if no program listens at either socket, or if the cell does not answer.
fn reached(folder: &Path, request: &Request) -> io::Result<Reply> {
    match send_request(folder, request) {
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::ConnectionRefused) => {
            socket_beside_lock(folder).map_or(Err(error), |door| send_request_at(&door, request))
        }
        asked => asked,
    }
}

/// Returns true if a program executes the run in `folder`. Such a program listens at the control socket in `folder`, or
/// at the second control socket next to the lock file of the machines.
pub(super) fn is_driven(folder: &Path) -> bool {
    is_live(folder) || socket_beside_lock(folder).is_some()
}

fn socket_beside_lock(folder: &Path) -> Option<PathBuf> {
    let run = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    runs_holding_machines().find(|(of, _)| is_same(of, &run)).map(|(_, door)| door)
}

/// Returns the runs on this computer that have locked machines and whose cell listens for requests. Each entry contains
/// two paths: the run folder, and the control socket of the run. This socket is next to the lock file of a machine.
fn runs_holding_machines() -> impl Iterator<Item = (PathBuf, PathBuf)> {
    MachineLock::control_sockets().into_iter().filter(|(_, door)| is_live_at(door))
}

/// Returns true if two paths have the same components. The files need not exist.
fn is_same(a: &Path, b: &Path) -> bool {
    a.components().eq(b.components())
}

fn show(reply: &Reply, request: &Request, folder: &Path, json: bool) -> Result<(), Failure> {
    if json {
        return super::print_json(reply);
    }
    if *request != Request::Status {
        return if reply.accepted { super::print(&format!("{}\n", reply.message)) } else { Ok(()) };
    }
    super::print(&status_text(&reply.status, folder))
}

/// Returns the status of a cell as lines of text for a person: the state, the progress, the alarms with their remedies,
/// the next step, the part, and the figures of each cycle. `folder` is the run folder, which the text names.
fn status_text(status: &Snapshot, folder: &Path) -> String {
    let mut text = String::new();
    let marked = if status.simulation { "SIMULATION  " } else { "" };
    let cycle = match status.cycle {
        0 => "before the first cycle".to_owned(),
        cycle => format!("cycle {cycle} of at most {}", status.max_cycles),
    };
    let _ = writeln!(text, "{marked}{}, {cycle}", status.message);
    if let Some(JobProgress { device, done, total, remaining_s }) = status.progress {
        let left = remaining_s.map_or(String::new(), |remaining_s| format!(", {} left", time_left(remaining_s)));
        let _ = writeln!(text, "{}{left}", how_far(device, done, total));
    }
    if let Some(told) = &status.preview {
        let _ = writeln!(text, "{}", preview_text(told));
    }
    for alarm in &status.alarms {
        let _ = writeln!(text, "ALARM    {}\n         {}", alarm.event, alarm.consequence);
        for (k, remedy) in alarm.remedy.iter().enumerate() {
            let _ = writeln!(text, "         {}. {remedy}", k + 1);
        }
    }
    for waits in status.waits_for.iter().filter(|waits| **waits != status.next) {
        let _ = writeln!(text, "{waits}");
    }
    // The further lines of a step stand below its first one.
    let _ = writeln!(text, "next     {}", status.next.replace('\n', "\n         "));
    let serial = if status.serial.is_empty() { String::new() } else { format!(", {}", status.serial) };
    let _ = writeln!(text, "part     {}{serial}, run {}", status.part, folder.display());
    if let Some(tolerance) = status.tolerance.filter(|_| !status.cycles.is_empty()) {
        let _ = writeln!(text, "limits   {}", limits(&tolerance));
        for row in &status.cycles {
            let (CycleRow { cycle, .. }, pv, [pv_um, rms_um]) = (row, pv_name(&tolerance), row.judged_um());
            let _ = writeln!(text, "cycle {cycle:<2} {pv} {pv_um:.2} µm, RMS {rms_um:.3} µm");
        }
    }
    text
}

/// Returns `run` if the person named a run folder. Otherwise returns the folder of the newest run in `runs`, a
/// subfolder of the working folder. Returns an error if no run is named and `runs` contains no run.
pub(super) fn folder_of(run: Option<&Path>) -> Result<PathBuf, Failure> {
    if let Some(missing) = run.filter(|run| !run.exists()) {
        return Err(Failure::NoSuchFolder { path: missing.to_owned() });
    }
    run.map(Path::to_owned).or_else(|| newest(Path::new("runs"))).ok_or_else(|| Failure::NoRun { path: "runs".into() })
}

/// Returns the folder of the active run in the folder `runs`. A run is active if its cell listens for orders. If no run
/// is active, returns the folder of the newest run. Returns an error if several runs are active, or if `runs` contains
/// no run.
pub(super) fn live(runs: &Path) -> Result<PathBuf, Failure> {
    live_or(runs, newest)
}

/// Returns the folder of the only active run in the folder `runs`. A run is active if its cell listens for orders. If
/// no run is active, calls `otherwise` with `runs` and returns the folder that `otherwise` selects.
///
/// # Errors
/// Several runs are active, or no run is active and `otherwise` returns `None`.
pub(super) fn live_or(runs: &Path, otherwise: fn(&Path) -> Option<PathBuf>) -> Result<PathBuf, Failure> {
    let mut live: Vec<_> = folders(runs).filter(|folder| is_live(folder)).collect();
    if live.is_empty() {
        // The cell can still run after its folder was removed.
        let absolute = std::path::absolute(runs).unwrap_or_else(|_| runs.to_owned());
        let of_these = |run: &PathBuf| run.parent().is_some_and(|above| is_same(above, &absolute));
        live = runs_holding_machines().map(|(run, _)| run).filter(of_these).collect();
        live.dedup();
    }
    match live.len() {
        0 => otherwise(runs).ok_or_else(|| Failure::NoRun { path: runs.to_owned() }),
        1 => Ok(live.remove(0)),
        _ => {
            live.sort();
            Err(Failure::SeveralRuns { runs: live })
        }
    }
}

pub(super) fn folders(runs: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = std::fs::read_dir(runs).into_iter().flatten().filter_map(io::Result::ok);
    // A hidden entry is kept next to the runs and is not a run.
    let is_hidden = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    entries.filter(move |entry| !is_hidden(entry)).map(|entry| entry.path()).filter(|path| path.is_dir())
}

/// Returns the folder of the newest run in `runs` whose record has no end. Skips records of `regrind recover` and
/// records that cannot be read. If no run is left, returns the folder of the newest run. Returns `None` if `runs`
/// contains no run.
pub(super) fn unfinished(runs: &Path) -> Option<PathBuf> {
    let is_open = |folder: &PathBuf| {
        let Ok(reader) = Reader::open(folder) else { return false };
        let mut records = reader.records(0).filter_map(Result::ok);
        let is_run = |first: &Record| Begin::<RunContent>::read(first).is_none_or(|begin| !begin.content.is_recovery());
        records.next().as_ref().is_some_and(is_run) && !records.any(|record| record.kind == RecordKind::End)
    };
    let mut all: Vec<_> = folders(runs).collect();
    all.sort_by_cached_key(|folder| began(folder));
    all.into_iter().rev().find(is_open).or_else(|| newest(runs))
}

/// Returns the folder of the run in `runs` that began last. Returns `None` if `runs` contains no run.
fn newest(runs: &Path) -> Option<PathBuf> {
    folders(runs).max_by_key(|folder| began(folder))
}

/// Returns the start time of the run in `folder` as text that sorts by time. The text consists of the digits and
/// letters of the UTC time, such as `20260704T120000`. Uses the time of the first record. If there is no readable
/// record, uses the time in the folder name. Returns `None` if the folder name contains no time.
///
/// The modification time of the folder is not used. Therefore a changed file does not make a run newer.
fn began(folder: &Path) -> Option<String> {
    let by_record = || {
        let reader = Reader::open(folder).ok()?;
        let first = reader.records(0).next()?.ok()?;
        Some(first.utc.chars().filter(char::is_ascii_alphanumeric).collect::<String>())
    };
    let by_name = || {
        let name = folder.file_name()?.to_str()?;
        let is_time = |part: &&str| part.len() == 16 && part.as_bytes()[8] == b'T' && part.ends_with('Z');
        name.split('-').find(is_time).map(|time| time.trim_end_matches('Z').to_owned())
    };
    by_record().or_else(by_name)
}
