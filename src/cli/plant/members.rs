//! `regrind plant init|enrol|retire|cells`: the schema of the database, and the roles that can sign in.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use regrind::document::visible_line;
use regrind::formats::{PrivateDraft, write_private};
use regrind::journal::PublicKey;
use regrind_plant::{NewMember, PlantError, PlantRole, add_cell_keys, enrol_cell, migrate, retire_cell};
use serde_json::json;

use super::super::failure::Failure;
use super::super::words::counted;
use super::super::{Outcome, key, name};
use super::plant_file::{Where, open, open_any};

/// Set up the database, or update it to this program's layout, as its owner
#[derive(Args, Debug)]
#[command(after_help = "\
Sign in as the owner of the database, with the right to create roles. Existing data is kept; the command can be repeated
at any time.

Example:
  createdb regrind && regrind plant init --plant owner.toml

Exit codes: 0 set up; 2 the database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToInit {
    #[command(flatten)]
    plant: Where,
}

/// Enrol a cell, a planner, a reader or a worker, with a new password
#[derive(Args, Debug)]
#[command(after_help = "\
A cell reads its own data, replicates its records and takes parts from the queue. A planner reads everything,
proposes recipes and queues parts. A reader, such as Grafana, reads everything. A worker simulates the runs of studies.
The password is in a file that only its owner can read: carry this file to the computer that signs in.

A member that is enrolled already is refused: with --again it gets a new password, its retirement ends, and the old password
file is replaced when the database has the new one. `regrind plant add-key` adds a key and keeps the password.

Examples:
  regrind plant enrol cell-1 --plant owner.toml --password-file cell-1.password --key cell-1.key
  regrind plant enrol office --as reader --plant owner.toml --password-file office.password

Exit codes: 0 enrolled; 2 the database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToEnrol {
    /// Name in the plant, and of the role in the database: small letters, digits and `_`
    #[arg(value_name = "NAME", value_parser = name)]
    name: String,
    /// Kind of the new member
    #[arg(long = "as", value_enum, default_value = "cell")]
    role: Kind,
    /// File for the password; created or replaced
    #[arg(long, value_name = "FILE")]
    password_file: PathBuf,
    /// Give a member that is enrolled already a new password, and end its retirement
    #[arg(long)]
    again: bool,
    /// Public key that may sign the records of the cell, or the file with the output of `regrind audit key --json`;
    /// repeat the option for another key
    #[arg(long, value_name = "PUBLIC|FILE", value_parser = key::public)]
    key: Vec<PublicKey>,
    #[command(flatten)]
    plant: Where,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Kind {
    /// Makes parts
    Cell,
    /// Queues parts and proposes recipes
    Planner,
    /// Reads everything
    Reader,
    /// Makes the simulated runs of studies
    Worker,
}

/// Add a key that may sign the records of a cell; its password stays
#[derive(Args, Debug)]
#[command(after_help = "\
A cell whose key is replaced keeps the old one for its earlier records.

Example:
  regrind plant add-key cell-1 --key cell-1-new.public --plant owner.toml

Exit codes: 0 added; 1 there is no such cell; 2 the database refuses the command; 3 the database
cannot be reached.")]
pub(super) struct ToAddKey {
    /// Name of the cell in the plant
    #[arg(value_name = "NAME")]
    name: String,
    /// Public key, or the file with the output of `regrind audit key --json`; repeat the option for another key
    #[arg(long, value_name = "PUBLIC|FILE", value_parser = key::public, required = true)]
    key: Vec<PublicKey>,
    #[command(flatten)]
    plant: Where,
}

/// Remove a cell from the plant: it can no longer sign in, and its records stay
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plant retire cell-1 --plant owner.toml

Exit codes: 0 retired; 1 there is no such cell; 2 the database refuses the command; 3 the database
cannot be reached.")]
pub(super) struct ToRetire {
    /// Name of the cell in the plant
    #[arg(value_name = "NAME")]
    name: String,
    #[command(flatten)]
    plant: Where,
}

/// List the cells, with the time of the last contact
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plant cells --plant planner.toml

Exit codes: 0 listed; 2 the database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToList {
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn init(arguments: &ToInit) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let mut link = open_any(&config).await?;
        let [before, now] = migrate(&mut link).await?;
        super::super::print(&match before == now {
            true => format!("{}: layout {now}, unchanged\n", link.place()),
            false => format!("{}: layout {now} (it had {before})\n", link.place()),
        })?;
        Ok(Outcome::Accepted)
    })
}

pub(super) fn enrol(arguments: &ToEnrol) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    let role = role_of(&arguments.name);
    let password = format!("{:032x}{:032x}", rand::random::<u128>(), rand::random::<u128>());
    super::super::runtime()?.block_on(async {
        let mut link = open(&config).await?;
        let keys: Vec<String> = arguments.key.iter().map(ToString::to_string).collect();
        // The password is on the disk before the database has it, and replaces the old one when the database has it.
        let path = &arguments.password_file;
        let text = format!("{password}\n");
        let draft = PrivateDraft::create(path, text.as_bytes())?;
        let member = NewMember { name: &arguments.name, role: &role, password: &password, is_again: arguments.again };
        let enrolled = match arguments.role {
            Kind::Cell => enrol_cell(&mut link, member, &keys).await,
            Kind::Planner => regrind_plant::enrol(&mut link, member, PlantRole::Planner).await,
            Kind::Reader => regrind_plant::enrol(&mut link, member, PlantRole::Reader).await,
            Kind::Worker => regrind_plant::enrol(&mut link, member, PlantRole::Worker).await,
        };
        if enrolled.as_ref().is_err_and(PlantError::may_pass) {
            // Whether the database has the password is not known, so both are kept.
            write_private(&PathBuf::from(format!("{}.new", path.display())), text.as_bytes())?;
        }
        enrolled?;
        draft.publish()?;
        let path = path.display();
        super::super::print(&format!("{} signs in as {role}, with the password in {path}\n", arguments.name))?;
        Ok(Outcome::Accepted)
    })
}

pub(super) fn add_key(arguments: &ToAddKey) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let mut link = open(&config).await?;
        let keys: Vec<String> = arguments.key.iter().map(ToString::to_string).collect();
        let name = &arguments.name;
        if add_cell_keys(&mut link, name, &keys).await? {
            super::super::print(&format!(
                "the records of {name} may be signed by {} more\n",
                counted(keys.len(), "key")
            ))?;
            return Ok(Outcome::Accepted);
        }
        super::super::print(&format!("there is no cell {name}; to see all cells: `regrind plant cells`\n"))?;
        Ok(Outcome::NotInTolerance)
    })
}

/// Returns the name of the database role for the plant member `name`. Converts ASCII letters to lower case, and
/// replaces every character except ASCII letters and digits by `_`. Keeps the first 48 characters. If the result begins
/// with a digit, puts `_` before the digit. The role name therefore needs no quotes in SQL.
fn role_of(name: &str) -> String {
    let plain = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' };
    let role: String = name.chars().map(plain).take(48).collect();
    match role.starts_with(|c: char| c.is_ascii_digit()) {
        true => format!("_{role}"),
        false => role,
    }
}

pub(super) fn retire(arguments: &ToRetire) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let mut link = open(&config).await?;
        let name = &arguments.name;
        if retire_cell(&mut link, name).await? {
            super::super::print(&format!("the cell {name} can no longer sign in; the plant keeps its records\n"))?;
            return Ok(Outcome::Accepted);
        }
        super::super::print(&format!("there is no cell {name}; to see all cells: `regrind plant cells`\n"))?;
        Ok(Outcome::NotInTolerance)
    })
}

pub(super) fn list(arguments: &ToList) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let text = "SELECT cell, coalesce(words, 'no report yet'), coalesce(to_char(told_at, 'YYYY-MM-DD HH24:MI:SS'), ''), coalesce(run, '')
            FROM cell_now ORDER BY cell";
        let found = link.query(text, &[]).await?;
        let cells: Vec<[String; 4]> = found.iter().map(|row| [0, 1, 2, 3].map(|k| row.get(k))).collect();
        if arguments.json {
            let told = cells.iter().map(|[cell, words, at, run]| json!({ "cell": cell, "words": words, "told_at": at, "run": run }));
            super::super::print_json(&told.collect::<Vec<_>>())?;
        } else {
            let line = |of: &[String; 4]| {
                let [cell, words, at, run] = of.each_ref().map(|field| visible_line(field));
                format!("{cell:<20}  {at:<19}  {words}  {run}\n")
            };
            super::super::print(&cells.iter().map(line).collect::<String>())?;
        }
        Ok(Outcome::Accepted)
    })
}
