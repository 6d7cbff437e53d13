//! `regrind init`: creates a folder to start with: recipe, cell file and their schemas.

use std::fmt::Write as _;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use regrind::config;
use regrind::formats::{ResultFolder, write_atomic};

use super::failure::Failure;
use super::{Outcome, schema};

/// Create a folder to start with: a recipe, a cell, their schemas for the editor, and a page of commands
#[derive(Args, Clone, Debug)]
#[command(after_help = "\
The command refuses a folder that already has one of the files to create, so no existing file is changed. The new recipe
is an example, such as a free-form mirror: change the part, the wheel and the measurement. The new cell file is the
shipped example for the kind of machines that --machines names.

On a terminal, the command asks for arguments that are not given.

Example:
  regrind init mirrors --machines modbus-tcp
  cd mirrors && regrind check recipe.toml cell.toml

Exit codes: 0 created; 2 the folder has such files already, or cannot be written.")]
pub(super) struct Arguments {
    /// Folder to create
    #[arg(value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Connection to the machines [default: simulated]
    #[arg(long, value_enum)]
    machines: Option<Machines>,
    /// Name of the part
    #[arg(long, value_name = "NAME", value_parser = super::name)]
    part: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Machines {
    /// Both machines are simulated within the program
    Simulated,
    /// Modbus over TCP; simulated by another process until you change it
    ModbusTcp,
    /// Modbus over serial lines; simulated by another process until you change it
    ModbusRtu,
    /// The machines read and write files
    Files,
    /// A person serves the machines step by step
    Manual,
}

impl Machines {
    /// Returns the text of the cell file for this connection to the machines. The file is contained in the program.
    fn cell(self) -> &'static str {
        match self {
            Self::Simulated => include_str!("../../config/sim.toml"),
            Self::ModbusTcp => include_str!("../../config/modbus-tcp.toml"),
            Self::ModbusRtu => include_str!("../../config/serial-rtu.toml"),
            Self::Files => include_str!("../../config/file-exchange.toml"),
            Self::Manual => include_str!("../../config/manual.toml"),
        }
    }

    /// Returns the recipe for this connection to the machines, as contained in the program: first the text of the
    /// recipe file, then the name of the part in this text.
    fn recipe(self) -> (&'static str, &'static str) {
        match self {
            // Machines that exchange files have no pattern from Regrind.
            Self::Files => (include_str!("../../recipes/telescope-panel.toml"), "telescope primary mirror"),
            _ => (include_str!("../../recipes/freeform-mirror.toml"), "free-form mirror"),
        }
    }

    /// Returns the command lines with which a person makes a part with this connection to the machines, in the order of
    /// their use. Each entry contains a command line and its purpose.
    fn commands(self) -> Vec<(&'static str, &'static str)> {
        let run = "regrind run recipe.toml --cell cell.toml --part SN-0001 --operator \"Your Name\"";
        let before = match self {
            Self::ModbusTcp | Self::ModbusRtu => Some((
                "regrind simulate recipe.toml --cell cell.toml",
                "runs the simulated machines, in a second terminal",
            )),
            Self::Files => Some((
                "mkdir -p exchange/cmm/in exchange/cmm/out exchange/grinder/in exchange/grinder/out",
                "creates the folders of both machines",
            )),
            Self::Simulated | Self::Manual => None,
        };
        let always = [
            (run, "makes a part"),
            ("regrind runs", "lists the runs and their results"),
            ("regrind audit verify", "verifies the record of the newest run"),
        ];
        let checked = [
            ("regrind check recipe.toml cell.toml", "shows every problem with its line, column and remedy"),
            ("regrind plan recipe.toml --cell cell.toml", "shows the commands of a run and their duration"),
        ];
        checked.into_iter().chain(before).chain(always).collect()
    }
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let InitSettings { folder, machines, part } = read_settings(arguments)?;
    let (recipe, shipped_name) = machines.recipe();
    let name = part.as_deref().unwrap_or(shipped_name);
    let recipe = recipe_of(recipe, shipped_name, name);
    // The shipped cell of people has no reference sphere; its recipe touches none.
    let recipe = match machines {
        Machines::Manual => recipe.replace(
            "qualify = true              # touch the reference sphere first",
            "qualify = false             # true: touch the reference sphere of the cell file first",
        ),
        _ => recipe,
    };
    let recipe = if name == shipped_name { recipe } else { of_other_part(&recipe) };
    make(&folder, machines, recipe, name)?;
    if name != shipped_name {
        super::print(&format!(
            "note: the surface in recipe.toml is still that of the example, {shipped_name}; replace the tables [nominal...] by the surface of {name:?}\n"
        ))?;
    }
    Ok(Outcome::Accepted)
}

/// Settings of the new folder, from the arguments or from the answers of a person.
struct InitSettings {
    folder: PathBuf,
    machines: Machines,
    part: Option<String>,
}

/// Returns the settings for the new folder. If `arguments` name this folder, uses only `arguments` and the defaults.
/// Otherwise asks a person at the terminal for each missing setting. Returns an error if `arguments` name no folder and
/// there is no terminal.
fn read_settings(arguments: &Arguments) -> Result<InitSettings, Failure> {
    let Arguments { folder, machines, part } = arguments.clone();
    if let Some(folder) = folder {
        return Ok(InitSettings { folder, machines: machines.unwrap_or(Machines::Simulated), part });
    }
    if !(io::stdin().is_terminal() && io::stdout().is_terminal()) {
        return Err(Failure::NoFolder);
    }
    let folder = PathBuf::from(ask("Folder to create", "regrind", |given| Ok(given.to_owned()))?);
    let machines = match machines {
        Some(machines) => machines,
        None => ask_for_machines()?,
    };
    let shipped = machines.recipe().1;
    let part = match part {
        Some(part) => part,
        None => ask("Name of the part", shipped, super::name)?,
    };
    Ok(InitSettings { folder, machines, part: Some(part) })
}

fn ask_for_machines() -> Result<Machines, Failure> {
    let mut list = "Connection to the machines:\n".to_owned();
    for (number, machines) in (1..).zip(Machines::value_variants()) {
        let named = machines.to_possible_value();
        let help = named.as_ref().and_then(|value| value.get_help()).map(ToString::to_string).unwrap_or_default();
        let _ = writeln!(list, "  {number}  {:<12} {help}", named.as_ref().map_or("", |value| value.get_name()));
    }
    super::print(&list)?;
    ask("Number or name", "1", |given| {
        let by_number =
            given.parse().ok().and_then(|n: usize| Machines::value_variants().get(n.checked_sub(1)?).copied());
        by_number.map_or_else(|| Machines::from_str(given, true), Ok)
    })
}

/// Prints `question` with the default answer `usual`, and reads an answer from standard input. `read` converts the
/// answer to a value, or returns the reason for a rejection. After a rejection, prints this reason and repeats the
/// question. An empty answer means `usual`. Returns the first accepted value. Returns an error if the input ends.
fn ask<T>(question: &str, usual: &str, read: impl Fn(&str) -> Result<T, String>) -> Result<T, Failure> {
    loop {
        super::print(&format!("{question} [{usual}]: "))?;
        let mut line = String::new();
        // The end of the input is not an answer, and no answer can follow.
        if io::stdin().read_line(&mut line).unwrap_or(0) == 0 {
            return Err(Failure::NoFolder);
        }
        let given = line.trim();
        match read(if given.is_empty() { usual } else { given }) {
            Ok(answer) => return Ok(answer),
            Err(reason) => super::print(&format!("{given:?}: {reason}\n"))?,
        }
    }
}

fn make(folder: &Path, machines: Machines, recipe: String, name: &str) -> Result<(), Failure> {
    let files = [
        ("recipe.toml", recipe),
        ("cell.toml", cell_of(machines.cell())),
        ("README.md", readme(name, machines)),
        ("recipe.schema.json", format!("{:#}\n", schema::recipe_schema())),
        ("cell.schema.json", format!("{:#}\n", config::json_schema())),
    ];
    if let Some((there, _)) = files.iter().find(|(file, _)| folder.join(file).exists()) {
        return Err(Failure::IsThere { path: folder.join(there) });
    }
    let made = ResultFolder::prepare(folder)?;
    for (file, text) in &files {
        write_atomic(&folder.join(file), text.as_bytes())?;
    }
    made.keep();
    super::print(&words(folder, machines))
}

/// Returns the recipe text `shipped` with changes for a new folder. Replaces the part name `shipped_name` by `name`.
/// Replaces the file paths, which are valid only in the source tree, by the paths of the same files in the new folder.
fn recipe_of(shipped: &str, shipped_name: &str, name: &str) -> String {
    let named = toml::Value::String(name.to_owned()).to_string();
    shipped
        .replacen(&format!("name = \"{shipped_name}\""), &format!("name = {named}"), 1)
        .replace("../docs/recipe.schema.json", "recipe.schema.json")
        .replace("docs/recipe.schema.json", "recipe.schema.json")
        .replace("recipes/freeform-mirror.toml", "recipe.toml")
        .replace("config/file-exchange.toml", "cell.toml")
}

/// Returns the recipe text without the drawing and the material of the example, and with a mark above its surface.
fn of_other_part(recipe: &str) -> String {
    let is_of_example = |line: &&str| ["drawing = ", "material = "].iter().any(|key| line.starts_with(key));
    let mark = |line: &str| match line.starts_with("[nominal") {
        true => format!("# The surface of the example: replace it by that of your part.\n{line}"),
        false => line.to_owned(),
    };
    let mut is_marked = false;
    let mut text = String::new();
    for line in recipe.lines().filter(|line| !is_of_example(line)) {
        let marked = if is_marked { line.to_owned() } else { mark(line) };
        is_marked |= line.starts_with("[nominal");
        text += &format!("{marked}\n");
    }
    text
}

/// Returns the text of the cell file `shipped` with changes for a new folder. Replaces the file paths, which are valid
/// only in the source tree, by the paths of the same files in the new folder.
fn cell_of(shipped: &str) -> String {
    let text = shipped
        .replace("../docs/cell.schema.json", "cell.schema.json")
        .replace("docs/cell.schema.json", "cell.schema.json");
    let text = text.replace("../exchange/", "exchange/").replace("recipes/freeform-mirror.toml", "recipe.toml");
    let text =
        text.replace("recipes/telescope-panel.toml", "recipe.toml").replace("config/serial-rtu.toml", "cell.toml");
    let text = text.replace("config/modbus-tcp.toml", "cell.toml");
    // The other shipped files are not in this folder.
    text.replace(" With several stations: config/laser-tracker.toml.", "")
}

fn readme(name: &str, machines: Machines) -> String {
    let mut text = format!(
        "# {name}\n\n`recipe.toml` states how the part is ground, measured and accepted. `cell.toml` describes the machines. An editor for TOML completes \
         both files from the schemas in this folder. Commands for this folder:\n\n```sh\n"
    );
    let commands = machines.commands();
    let width = commands.iter().map(|(command, _)| command.chars().count()).max().unwrap_or(0);
    for (command, what) in commands {
        let _ = writeln!(text, "{command:width$}  # {what}");
    }
    text + "```\n\nCommands from another terminal during a run: `regrind status`, `regrind hold`, `regrind resume`, `regrind abort`, `regrind serve`. Add \
            `--help` to a command to see its description.\n\nNo part of this program is a safety function: the machines have their own circuits for guards and emergency stop.\n"
}

fn words(folder: &Path, machines: Machines) -> String {
    let mut text =
        format!("created {}: recipe.toml, cell.toml, README.md and two schemas\nnext:\n  cd {0}\n", folder.display());
    for (command, _) in machines.commands() {
        let _ = writeln!(text, "  {command}");
    }
    text
}
