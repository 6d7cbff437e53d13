//! `regrind users`: the users who can sign in to the page from another computer, their roles, and the tokens of programs.

use std::io::{self, BufRead, IsTerminal};
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use regrind::formats::write_private;
use regrind_page::{PageRole, Users, UsersError};
use serde_json::json;

use super::Outcome;
use super::failure::Failure;

/// Manage the users who may sign in to the page of the cell, and the tokens of programs that read it
#[derive(Args, Debug)]
#[command(after_help = "\
Roles: a viewer reads the page and gives no order; quality can only hold the cell; an operator can give every order, but
cannot resume after an alarm that only a process engineer clears; an engineer can give every order. A program has a token
in place of a password, and reads what a viewer sees. The list has only a hash of each password and of each token. A
change takes effect at once, also for an open page.

Examples:
  regrind users add \"A. Smith\" --role operator
  regrind users token prometheus
  regrind serve --listen 0.0.0.0:7373 --certificate cell.pem --key cell.key --users users.toml

Exit codes: 0 done; 2 bad arguments, a password that is too short, or a list that cannot be read or written.")]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: UsersCommand,
}

#[derive(Subcommand, Debug)]
enum UsersCommand {
    /// Add a person, or change the role and password of a person
    Add {
        /// Name for signing in, which is recorded with each order
        #[arg(value_name = "NAME")]
        name: String,
        /// Role: viewer, quality, operator or engineer
        #[arg(long)]
        role: PageRole,
        #[command(flatten)]
        list: UserListFile,
    },
    /// Make a token with which a program reads the page, or replace the token of a program. The token is printed once
    Token {
        /// Name of the program
        #[arg(value_name = "NAME")]
        name: String,
        #[command(flatten)]
        list: UserListFile,
    },
    /// Remove a person, or the token of a program, from the list
    Remove {
        /// Name of the person or of the program
        #[arg(value_name = "NAME")]
        name: String,
        #[command(flatten)]
        list: UserListFile,
    },
    /// Print the list
    List {
        #[command(flatten)]
        list: UserListFile,
        /// Print JSON instead of text
        #[arg(long)]
        json: bool,
    },
}

#[derive(Args, Debug)]
struct UserListFile {
    /// File of the list
    #[arg(long = "users", value_name = "FILE", default_value = "users.toml")]
    path: PathBuf,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    match &arguments.what {
        UsersCommand::Add { name, role, list } => add(name, *role, &list.path)?,
        UsersCommand::Token { name, list } => make_token(name, &list.path)?,
        UsersCommand::Remove { name, list } => remove(name, &list.path)?,
        UsersCommand::List { list, json } => print_users(&Users::read(&list.path)?, *json)?,
    }
    Ok(Outcome::Accepted)
}

/// Reads the list of users at `path`. Returns an empty list if there is no such file.
fn read_or_new(path: &Path) -> Result<Users, Failure> {
    match Users::read(path) {
        Err(UsersError::Unreadable { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(Users::default()),
        read => Ok(read?),
    }
}

/// Makes a token for the program `name` and prints it. Only the token goes to the standard output, so that it can be
/// written to a file.
fn make_token(name: &str, path: &Path) -> Result<(), Failure> {
    let mut users = read_or_new(path)?;
    let token = users.add_token(name)?;
    write_private(path, users.to_text().as_bytes())?;
    super::print(&format!("{token}\n"))?;
    eprintln!(
        "{} can now read the page with this token, which is shown only here; user list: {}",
        name.trim(),
        path.display()
    );
    Ok(())
}

fn add(name: &str, role: PageRole, path: &Path) -> Result<(), Failure> {
    let mut users = read_or_new(path)?;
    users.add(name, role, &password(name)?)?;
    write_private(path, users.to_text().as_bytes())?;
    super::print(&format!("{} can now sign in as {role}; user list: {}\n", name.trim(), path.display()))
}

fn remove(name: &str, path: &Path) -> Result<(), Failure> {
    let mut users = Users::read(path)?;
    if !users.remove(name) {
        return Err(Failure::NoUser { name: name.to_owned(), path: path.to_owned() });
    }
    write_private(path, users.to_text().as_bytes())?;
    super::print(&format!("{name} no longer has access\n"))
}

fn print_users(users: &Users, as_json: bool) -> Result<(), Failure> {
    if as_json {
        let people = users.people().map(|of| json!({ "name": of.name, "role": of.role, "kind": "person" }));
        let programs =
            users.programs().map(|name| json!({ "name": name, "role": PageRole::Viewer, "kind": "program" }));
        return super::print_json(&people.chain(programs).collect::<Vec<_>>());
    }
    users.people().try_for_each(|of| super::print(&format!("{:9}  {}\n", of.role, of.name)))?;
    users.programs().try_for_each(|name| super::print(&format!("{:9}  {name}\n", "program")))
}

/// Reads a password for the user `name` from the standard input and returns it. At a terminal, asks for the password
/// twice without showing it. From a pipe, reads the first line.
///
/// Returns an error if the two passwords differ, or if the input cannot be read.
fn password(name: &str) -> Result<String, Failure> {
    if !io::stdin().is_terminal() {
        let mut line = String::new();
        io::stdin().lock().read_line(&mut line).map_err(Failure::Terminal)?;
        return Ok(line.trim_end_matches(['\r', '\n']).to_owned());
    }
    let terminal = console::Term::stderr();
    let asked = |prompt: String| {
        terminal.write_str(&prompt).and_then(|()| terminal.read_secure_line()).map_err(Failure::Terminal)
    };
    let first = asked(format!("password for {name}: "))?;
    if asked("once more: ".into())? == first { Ok(first) } else { Err(Failure::NotAlike) }
}
