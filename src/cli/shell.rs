//! `regrind completions` and `regrind man`: shell completions and manual pages, generated from the same text as
//! `--help`.

use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;
use clap_complete::env::Shells;
use clap_mangen::Man;
use regrind::formats::{ResultFolder, write_atomic};

use super::Outcome;
use super::complete::VARIABLE;
use super::failure::Failure;

/// Print the script that completes the commands in a shell
#[derive(Args, Debug)]
#[command(after_help = "\
The script completes commands and options, and also the names of runs (below --runs, or runs), recipes, cell files, and
what the running cell asks to confirm. For these it starts regrind, which must be in the PATH, with the variable
REGRIND_COMPLETE. Print the script again after an update of regrind.

Examples:
  regrind completions bash > ~/.local/share/bash-completion/completions/regrind
  regrind completions zsh > ~/.zfunc/_regrind
  regrind completions powershell >> $PROFILE

Exit codes: 0 printed; 2 bad arguments.")]
pub(super) struct Completions {
    /// Name of the shell
    #[arg(value_enum)]
    shell: Shell,
}

/// Write the manual pages for `man`, one for each command
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind man --out ~/.local/share/man/man1
  man regrind-run

Exit codes: 0 written; 2 the folder cannot be written.")]
pub(super) struct Pages {
    /// Folder to write to; created if absent
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Prints the completion script, which starts this program for the candidates.
pub(super) fn completions(arguments: &Completions) -> Result<Outcome, Failure> {
    let mut script = Vec::new();
    let shells = Shells::builtins();
    if let Some(shell) = shells.completer(&arguments.shell.to_string()) {
        // Writing into memory cannot fail.
        let _ = shell.write_registration(VARIABLE, "regrind", "regrind", "regrind", &mut script);
    }
    super::print(&String::from_utf8_lossy(&script))?;
    Ok(Outcome::Accepted)
}

/// Writes the manual pages of the commands of `program`.
pub(super) fn pages(arguments: &Pages, program: Command) -> Result<Outcome, Failure> {
    let folder = ResultFolder::prepare(&arguments.out)?;
    for (name, page) in manual(program) {
        write_atomic(&arguments.out.join(name), &page)?;
    }
    folder.keep();
    Ok(Outcome::Accepted)
}

/// Returns the manual page of `program` and of each of its commands that is not hidden. Each entry contains the file name, such as
/// `regrind-run.1`, and the content.
fn manual(program: Command) -> Vec<(String, Vec<u8>)> {
    let mut program = program.disable_help_subcommand(true);
    program.build();
    let mut pages = Vec::new();
    gather(&program, "regrind", &mut pages);
    pages
}

fn gather(command: &Command, name: &str, pages: &mut Vec<(String, Vec<u8>)>) {
    let named = command.clone().name(name.to_owned());
    let mut page = Vec::new();
    // Writing into memory cannot fail.
    if Man::new(named).render(&mut page).is_ok() {
        pages.push((format!("{name}.1"), page));
    }
    for below in command.get_subcommands().filter(|below| !below.is_hide_set() && below.get_name() != "help") {
        gather(below, &format!("{name}-{}", below.get_name()), pages);
    }
}
