//! Command line: one file per command. Only this module prints or exits.

mod accuracy;
mod audit;
mod blocks;
mod check;
mod choice;
mod compensate;
mod complete;
mod completeness;
mod control;
mod doctor;
mod draft;
mod face_list;
mod failure;
mod file_kind;
mod fit_arguments;
mod init;
mod initial;
mod key;
mod live;
mod nominal;
mod outcome;
mod outside;
mod parsers;
mod plan;
#[cfg(feature = "plant")]
mod plant;
mod recover;
mod register;
mod report;
mod resume;
mod run;
mod run_plan;
mod runs;
mod runtime;
mod schema;
mod serve;
mod shell;
mod show;
mod simulate;
mod simulated;
mod states;
mod stitch;
mod succession;
mod terminal;
mod truth;
mod users;
mod watch;
#[cfg(not(feature = "plant"))]
mod without_plant;
mod words;
mod workbench;

use std::io::{self, Write};
use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};

use outcome::{FAULT, Outcome};
use parsers::{above_zero, finite_above_zero, finite_from_zero, name, remark};
use regrind::document::{countable, visible};
use regrind::drive::Request;
use runtime::runtime;
use terminal::{print, print_json, print_json_line};
#[cfg(not(feature = "plant"))]
use without_plant as plant;

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
    #[command(hide = true)]
    Draft(draft::Arguments),
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
    #[command(flatten)]
    Plant(plant::Commands),
    Audit(audit::Arguments),
    Report(report::Arguments),
    Register(register::Arguments),
    Stitch(stitch::Arguments),
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

/// Parses the arguments, runs the command, and returns the exit code.
pub fn main() -> ExitCode {
    std::panic::set_hook(Box::new(|panic| {
        eprintln!(
            "error: a fault of the program itself: {panic}; please report this fault with the input files of the command"
        );
    }));
    std::panic::catch_unwind(run).unwrap_or(ExitCode::from(FAULT))
}

fn run() -> ExitCode {
    match complete::answer(Arguments::command) {
        Ok(false) => {}
        Ok(true) => return ExitCode::SUCCESS,
        Err(error) => {
            let _ = error.print();
            return ExitCode::from(FAULT);
        }
    }
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            // If the terminal itself fails, the error cannot be reported.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(FAULT));
        }
    };
    let ended = match arguments.command {
        Command::Init(arguments) => init::run(&arguments),
        Command::Run(arguments) => run::run(&arguments),
        Command::Plan(arguments) => plan::run(&arguments),
        Command::Draft(arguments) => draft::run(&arguments),
        Command::Simulate(arguments) => simulate::run(&arguments),
        Command::Hold(arguments) => control::order(&arguments, |reason| Request::Hold { reason, state_number: None }),
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
        Command::Plant(command) => plant::run(&command),
        Command::Audit(arguments) => audit::run(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Register(arguments) => register::run(&arguments),
        Command::Stitch(arguments) => stitch::run(&arguments),
        Command::Accuracy(arguments) => accuracy::run(&arguments),
        Command::Compensate(arguments) => compensate::run(&arguments),
        Command::Check(arguments) => check::run(&arguments),
        Command::Doctor(arguments) => doctor::run(&arguments),
        Command::Schema(arguments) => schema::run(&arguments),
        Command::States(arguments) => states::run(&arguments),
        Command::Completions(arguments) => shell::completions(&arguments),
        Command::Man(arguments) => shell::pages(&arguments, Arguments::command()),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_consistent() {
        Arguments::command().debug_assert();
    }
}
