//! Command line: one file per command. Only this module prints or exits.

mod accuracy;
mod audit;
mod blocks;
#[cfg(feature = "plant")]
mod cell_monitor;
mod check;
mod choice;
mod compensate;
mod control;
mod doctor;
mod failure;
mod init;
mod initial;
mod key;
mod live;
mod nominal;
mod outside;
mod plan;
#[cfg(feature = "plant")]
mod plant;
#[cfg(feature = "plant")]
mod publish;
mod recover;
mod register;
#[cfg(feature = "plant")]
mod replicate;
mod report;
mod resume;
mod run;
#[cfg(feature = "plant")]
mod run_queue;
mod runs;
mod schema;
mod serve;
mod shell;
mod show;
mod simulate;
mod simulated;
mod states;
mod succession;
mod users;
mod watch;
mod words;

use std::io::{self, Write};
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use failure::Failure;
use regrind::document::{countable, misleading, visible};
use regrind::drive::Request;

/// Closed-loop grinding: register measured probe centres to the offset of a nominal surface.
#[derive(Debug, Parser)]
#[command(name = "regrind", version, after_help = EXIT_CODES)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Init(init::Arguments),
    Run(run::Arguments),
    Plan(plan::Arguments),
    Simulate(simulate::Arguments),
    /// Hold a running cell at the next safe place
    #[command(after_help = control::help("regrind hold --reason \"coolant looks low\""))]
    Hold(control::Arguments),
    Resume(resume::Arguments),
    Recover(recover::Arguments),
    /// Stop a running cell in order: the machines move to their safe places, and the run ends
    #[command(after_help = control::help("regrind stop --reason \"end of the shift\""))]
    Stop(control::Arguments),
    /// Abort a running cell at once, with the safe sequence only
    #[command(after_help = control::help("regrind abort --reason \"noise at the wheel\""))]
    Abort(control::Arguments),
    /// Confirm to a running cell what a person has done or seen
    Confirm(control::Confirmation),
    /// Show the state of a running cell, what it waits for, and what to do next
    #[command(after_help = control::help("regrind status runs/freeform-mirror-20260704T120000Z --json"))]
    Status(control::Arguments),
    Watch(watch::Arguments),
    Runs(runs::Arguments),
    Serve(serve::Arguments),
    Users(users::Arguments),
    #[cfg(feature = "plant")]
    Ship(replicate::Arguments),
    #[cfg(feature = "plant")]
    Work(run_queue::Arguments),
    #[cfg(feature = "plant")]
    Study(plant::studies::Arguments),
    #[cfg(feature = "plant")]
    Tell(publish::Arguments),
    #[cfg(feature = "plant")]
    Plant(plant::Arguments),
    Audit(audit::Arguments),
    Report(report::Arguments),
    Register(register::Arguments),
    Accuracy(accuracy::Arguments),
    Compensate(compensate::Arguments),
    Check(check::Arguments),
    Doctor(doctor::Arguments),
    Schema(schema::Arguments),
    States(states::Arguments),
    Completions(shell::Completions),
    Man(shell::Pages),
}

const EXIT_CODES: &str = "Exit codes: 0 accepted; 1 finished, not in tolerance; 2 bad arguments or data; 3 fault.";

/// Outcome of a successful command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Accepted,
    NotInTolerance,
    /// The inspected run is active and has not ended.
    UnderWay,
}

/// Parses the arguments, runs the command, and returns the exit code.
pub fn main() -> ExitCode {
    std::panic::set_hook(Box::new(|panic| {
        eprintln!(
            "error: a fault of the program itself: {panic}; please report this fault with the input files of the command"
        );
    }));
    std::panic::catch_unwind(run).unwrap_or(ExitCode::from(failure::FAULT))
}

fn run() -> ExitCode {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            // If the terminal itself fails, the error cannot be reported.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(failure::FAULT));
        }
    };
    let ended = match arguments.command {
        Command::Init(arguments) => init::run(&arguments),
        Command::Run(arguments) => run::run(&arguments),
        Command::Plan(arguments) => plan::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Hold(arguments) => control::order(&arguments, |reason| Request::Hold { reason }),
        Command::Resume(arguments) => resume::run(&arguments),
        Command::Recover(arguments) => recover::run(&arguments),
        Command::Stop(arguments) => control::order(&arguments, |reason| Request::Stop { reason }),
        Command::Abort(arguments) => control::order(&arguments, |reason| Request::Abort { reason }),
        Command::Confirm(arguments) => control::confirm(&arguments),
        Command::Status(arguments) => control::order(&arguments, |_| Request::Status),
        Command::Watch(arguments) => watch::run(&arguments),
        Command::Runs(arguments) => runs::run(&arguments),
        Command::Serve(arguments) => serve::run(&arguments),
        Command::Users(arguments) => users::run(&arguments),
        #[cfg(feature = "plant")]
        Command::Ship(arguments) => replicate::run(&arguments),
        #[cfg(feature = "plant")]
        Command::Work(arguments) => run_queue::run(&arguments),
        #[cfg(feature = "plant")]
        Command::Study(arguments) => plant::studies::run(&arguments),
        #[cfg(feature = "plant")]
        Command::Tell(arguments) => publish::run(&arguments),
        #[cfg(feature = "plant")]
        Command::Plant(arguments) => plant::run(&arguments),
        Command::Audit(arguments) => audit::run(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Register(arguments) => register::run(&arguments),
        Command::Accuracy(arguments) => accuracy::run(&arguments),
        Command::Compensate(arguments) => compensate::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Schema(arguments) => schema::run(&arguments),
        Command::States(arguments) => states::run(&arguments),
        Command::Completions(arguments) => shell::completions(&arguments),
        Command::Man(arguments) => shell::pages(&arguments),
    };
    match ended {
        Ok(Outcome::Accepted) => ExitCode::SUCCESS,
        Ok(Outcome::NotInTolerance) => ExitCode::from(1),
        Ok(Outcome::UnderWay) => ExitCode::from(4),
        Err(failure) => {
            let _ = writeln!(io::stderr(), "error: {}", countable(&visible(&failure.to_string())));
            ExitCode::from(failure.exit_code())
        }
    }
}

/// Creates the tokio runtime that executes asynchronous commands.
fn runtime() -> Result<tokio::runtime::Runtime, Failure> {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().map_err(Failure::Terminal)
}

/// Prints text to standard output. It is not an error if the program that reads the output has ended.
fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    // A question has no line end, so it needs a flush.
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Failure::Terminal(error)),
        _ => Ok(()),
    }
}

/// Writes a value to the terminal as indented JSON.
fn print_json(value: &impl serde::Serialize) -> Result<(), Failure> {
    let mut text = serde_json::to_string_pretty(value).map_err(|e| Failure::Terminal(e.into()))?;
    text.push('\n');
    print(&text)
}

/// Checks that `text` can be the name of a person, a part or a place. Returns the name without spaces at both ends.
/// Returns the reason as text if the name is empty or longer than 300 characters. Also returns the reason if the name
/// has characters that are invisible or that change the order of the letters.
fn name(text: &str) -> Result<String, String> {
    const LONGEST: usize = 300;
    match (misleading(text), text.trim()) {
        (Some(hidden), _) => Err(format!(
            "the text has the character U+{:04X}, which is invisible or changes the order of the letters; type the text again",
            u32::from(hidden)
        )),
        (None, "") => Err("it is empty".into()),
        (None, name) if name.chars().count() > LONGEST => Err(format!("it is longer than {LONGEST} characters")),
        (None, name) => Ok(name.to_owned()),
    }
}

/// Checks that `text` can be the remark of a person. Returns the remark without spaces at both ends; the remark can be
/// empty. Returns the reason as text if the remark has invisible characters or is longer than 300 characters.
fn remark(text: &str) -> Result<String, String> {
    if text.trim().is_empty() { Ok(String::new()) } else { name(text) }
}

/// Parses `text` as a number above 0. Accepts `inf` (infinity). Returns a text with the permitted values if `text` is
/// not such a number.
fn above_zero(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value > 0.0 => Ok(value),
        _ => Err("give a number above 0; the decimal mark is a point, not a comma".into()),
    }
}

/// Parses `text` as a finite number above 0. Returns a text with the permitted values if `text` is not such a number.
fn finite_above_zero(text: &str) -> Result<f64, String> {
    above_zero(text).and_then(|v| if v.is_finite() { Ok(v) } else { Err("give a finite number above 0".into()) })
}

/// Parses `text` as a finite number that is 0 or above. Returns a text with the permitted values if `text` is not such
/// a number.
fn finite_from_zero(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value >= 0.0 && value.is_finite() => Ok(value.abs()),
        _ => Err(
            "give a finite number above 0, or 0 for a probe without a ball; the decimal mark is a point, not a comma"
                .into(),
        ),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_arguments_are_consistent() {
        super::Arguments::command().debug_assert();
    }
}
