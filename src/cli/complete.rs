//! Candidates for a word that a person completes in a shell: runs, recipes, cell files, and the words that the running
//! cell waits for.
//!
//! The script of `regrind completions` starts this program with the variable [`VARIABLE`] to get them. Every other start
//! of the program builds its commands without the candidates.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::{Duration, SystemTime};

use clap::{Arg, Command};
use clap_complete::CompleteEnv;
use clap_complete::engine::{ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter};
use regrind::config::BUILT_IN_CELL;
use regrind::drive::{Request, Snapshot, is_live, send_request};
use regrind_control::NextStep;

use super::check::has_table;
use super::control::{confirmed_words, folders};

/// Variable of the environment that asks for candidates, with the name of the shell.
pub(super) const VARIABLE: &str = "REGRIND_COMPLETE";
/// Time that a running cell has to answer. A person waits for the candidates.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
/// Folder of the runs if no other is named.
const RUNS: &str = "runs";
/// Maximum number of runs that are offered: the newest.
const MAX_RUNS: usize = 100;

/// Prints the candidates for the word that is completed, if the environment asks for them. Returns true if it does.
///
/// # Errors
/// The shell is unknown, or the candidates cannot be printed.
pub(super) fn answer(program: fn() -> Command) -> clap::error::Result<bool> {
    let folder = std::env::current_dir().ok();
    CompleteEnv::with_factory(|| with_candidates(program(), ""))
        .var(VARIABLE)
        .try_complete(std::env::args_os(), folder.as_deref())
}

/// Returns `command`, which is called `name` by its parent, and all commands below it with candidates for their
/// arguments.
fn with_candidates(command: Command, name: &str) -> Command {
    let in_command = name.to_owned();
    command.mut_args(move |arg| argument(arg, &in_command)).mut_subcommands(|below| {
        let name = below.get_name().to_owned();
        with_candidates(below, &name)
    })
}

/// Returns `arg`, an argument of the command `command`, with its candidates.
fn argument(arg: Arg, command: &str) -> Arg {
    let value_name = arg.get_value_names().and_then(|names| names.first()).map(ToString::to_string);
    let completer = match (arg.get_id().as_str(), value_name.as_deref()) {
        ("what", _) if command == "confirm" => ArgValueCompleter::new(confirmations),
        ("alarm", _) if command == "confirm" => ArgValueCompleter::new(alarms),
        (_, Some("RUN")) => match command {
            "hold" | "stop" | "abort" | "confirm" | "status" | "watch" => ArgValueCompleter::new(live_runs),
            _ => ArgValueCompleter::new(all_runs),
        },
        (_, Some("RECIPE")) | ("recipe", _) => ArgValueCompleter::new(files(&["[part]"], None)),
        (_, Some("CELL")) | ("cell", Some("FILE")) => {
            ArgValueCompleter::new(files(&["[cell]", "[cmm", "[[cmm", "[grinder", "[[grinder"], Some(BUILT_IN_CELL)))
        }
        ("plant" | "file", Some("FILE")) if arg.get_long() == Some("plant") => {
            ArgValueCompleter::new(files(&["[plant]"], None))
        }
        (_, Some("DIR")) => ArgValueCompleter::new(|current: &OsStr| plain(PathCompleter::dir().complete(current))),
        _ => return arg,
    };
    arg.add(completer)
}

/// Returns the completer for files with one of the table headers `heads`, and for the word `more`.
fn files(heads: &'static [&'static str], more: Option<&'static str>) -> impl ValueCompleter {
    move |current: &OsStr| {
        let is_wanted = move |path: &Path| path.extension() == Some(OsStr::new("toml")) && has_table(path, heads);
        let found = PathCompleter::any().filter(is_wanted).complete(current);
        let more = more.filter(|word| word.as_bytes().starts_with(current.as_encoded_bytes()));
        plain(more.map(CompletionCandidate::new).into_iter().chain(found).collect())
    }
}

/// Returns the candidates that mean nothing else to a shell, which takes them as they are: a name could be a command.
fn plain(candidates: Vec<CompletionCandidate>) -> Vec<CompletionCandidate> {
    let is_plain = |c: char| c.is_alphanumeric() || "._-+,:@/\\".contains(c);
    candidates
        .into_iter()
        .filter(|candidate| candidate.get_value().to_str().is_some_and(|text| text.chars().all(is_plain)))
        .collect()
}

fn live_runs(current: &OsStr) -> Vec<CompletionCandidate> {
    let found = runs(current, is_live);
    // The socket of a run can be in another place.
    if found.is_empty() { all_runs(current) } else { found }
}

fn all_runs(current: &OsStr) -> Vec<CompletionCandidate> {
    let found = runs(current, |_| true);
    if found.is_empty() { plain(PathCompleter::dir().complete(current)) } else { found }
}

/// Returns the folders of runs that `is_wanted` and begin with `current`, or whose names do. The newest is first.
fn runs(current: &OsStr, is_wanted: impl Fn(&Path) -> bool) -> Vec<CompletionCandidate> {
    let typed = current.as_encoded_bytes();
    let begins = |text: &OsStr| text.as_encoded_bytes().starts_with(typed);
    let fits = |folder: &PathBuf| begins(folder.as_os_str()) || folder.file_name().is_some_and(begins);
    let changed =
        |folder: &PathBuf| fs::metadata(folder).and_then(|data| data.modified()).unwrap_or(SystemTime::UNIX_EPOCH);
    let mut found: Vec<_> = folders(&runs_folder()).filter(fits).collect();
    found.sort_by_cached_key(|folder| std::cmp::Reverse(changed(folder)));
    found.truncate(MAX_RUNS);
    plain(found.into_iter().filter(|folder| is_wanted(folder)).map(CompletionCandidate::new).collect())
}

/// Returns the folder of the runs: the value of `--runs` in the line that is completed, or the default.
fn runs_folder() -> PathBuf {
    let words: Vec<OsString> = std::env::args_os().skip_while(|word| word != "--").skip(1).collect();
    let named = words.iter().enumerate().find_map(|(k, word)| match word.to_str() {
        Some("--runs") => words.get(k + 1).map(PathBuf::from),
        Some(word) => word.strip_prefix("--runs=").map(PathBuf::from),
        None => None,
    });
    named.filter(|folder| !folder.as_os_str().is_empty()).unwrap_or_else(|| RUNS.into())
}

/// Returns the state of the active run; `None` if there is none, or if it does not answer soon.
fn status() -> Option<Snapshot> {
    let run = folders(&runs_folder()).find(|folder| is_live(folder))?;
    let (to, answer) = mpsc::channel();
    // The thread ends with the program.
    std::thread::spawn(move || {
        if let Ok(reply) = send_request(&run, &Request::Status) {
            // Nobody waits any more if the answer came late.
            let _ = to.send(reply.status);
        }
    });
    answer.recv_timeout(ANSWER_TIMEOUT).ok()
}

/// Returns the facts that the running cell asks a person to confirm, or all if it asks for none.
fn confirmations(current: &OsStr) -> Vec<CompletionCandidate> {
    let asked = status().map(|now| asked(&now)).unwrap_or_default();
    let words = confirmed_words().filter(|(word, _)| asked.is_empty() || asked.contains(&&**word));
    beginning(current, words)
}

/// Returns the words for what the cell in the state `now` asks a person to confirm.
fn asked(now: &Snapshot) -> Vec<&'static str> {
    let mut words = match &now.next_step {
        NextStep::Load => vec!["loaded"],
        NextStep::SeeClear { .. } => vec!["clear"],
        NextStep::AtMachine { .. } => vec!["started", "done"],
        NextStep::SeeWhetherItStands { .. } => vec!["still", "over"],
        _ => Vec::new(),
    };
    if !now.alarms.is_empty() {
        words.push("seen");
    }
    words
}

/// Returns the names of the active alarms of the running cell.
fn alarms(current: &OsStr) -> Vec<CompletionCandidate> {
    let alarms = status().map(|now| now.alarms).unwrap_or_default();
    let named = alarms.into_iter().filter_map(|alarm| {
        let name = serde_json::to_value(alarm.id).ok()?.as_str()?.to_owned();
        Some((name, Some(alarm.id.head().to_owned())))
    });
    beginning(current, named)
}

/// Returns the candidates that begin with `current`.
fn beginning(current: &OsStr, words: impl Iterator<Item = (String, Option<String>)>) -> Vec<CompletionCandidate> {
    let fits = |word: &str| word.as_bytes().starts_with(current.as_encoded_bytes());
    words
        .filter(|(word, _)| fits(word))
        .map(|(word, help)| CompletionCandidate::new(word).help(help.map(Into::into)))
        .collect()
}

#[cfg(test)]
mod tests {
    use regrind::cell::{Alarm, AlarmId, Device, Role};

    use super::*;

    #[test]
    fn words_are_those_that_the_cell_asks_for() {
        let at = |next_step| Snapshot { next_step, ..Snapshot::default() };
        assert_eq!(asked(&at(NextStep::Load)), ["loaded"]);
        assert_eq!(asked(&at(NextStep::Nothing)), [""; 0]);
        let event = String::new;
        let alarm = Alarm {
            id: AlarmId::LinkLost,
            event: event(),
            consequence: event(),
            remedy: Vec::new(),
            cleared_by: Role::Nobody,
        };
        let stands = at(NextStep::SeeWhetherItStands { device: Device::Cmm });
        assert_eq!(asked(&Snapshot { alarms: vec![alarm], ..stands }), ["still", "over", "seen"]);
    }
}
