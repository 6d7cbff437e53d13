//! `regrind doctor`: checks whether anything prevents a run. It moves no machine, and locks none after the check.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use clap::Args;
use regrind::cell::Device;
use regrind::config::{BUILT_IN_CELL, CellConfig, LinkConfig};
use regrind::device::{
    ConnectionCheck, DeviceError, DriverError, LineAddress, Machine, MachineKind, ModbusCmm, ModbusGrinder,
    ModbusSettings, Status,
};
use regrind::drive::recovery::{describe_status, read_status};
use regrind::formats::{ResultFolder, try_writing};
use regrind::journal::{free_bytes, is_open_to_all, utc};
use regrind::recipe::Recipe;
use regrind::report::run_summary;
use regrind::setup;
use serde::Serialize;

use super::failure::Failure;
use super::live::lock_machine;
use super::run::within;
use super::{Outcome, check, control, key, plant};

/// Check the computer, the cell file, the machines and a recipe for obstacles to a run; nothing moves
#[derive(Args, Debug)]
#[command(after_help = "\
The command checks each machine by its kind:
- Modbus: reads the identity and the status, and writes only the heartbeat (sign of life) of this program;
- server of I++ DME: opens a session, reads the identity and the status, and ends the session;
- LinuxCNC: reads the identity and the status without taking control;
- measuring machine that only sends a line of text for each hit (touch): waits 5 s for a line;
- machine that exchanges files, or that a person operates: checks only the folders and settings.

Example:
  regrind doctor config/modbus-tcp.toml --recipe recipes/freeform-mirror.toml

Exit codes: 0 no obstacle; 1 an obstacle to a run; 2 bad cell file.")]
pub(super) struct Arguments {
    /// Cell to check
    #[arg(value_name = "CELL", default_value = BUILT_IN_CELL)]
    cell: PathBuf,
    /// Recipe to run on it
    #[arg(long, value_name = "FILE")]
    recipe: Option<PathBuf>,
    /// Folder of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    #[command(flatten)]
    plant: plant::DoctorArguments,
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// Result of one check.
#[derive(Serialize)]
struct Finding {
    #[serde(rename = "what")]
    check: String,
    #[serde(rename = "found")]
    level: FindingLevel,
    #[serde(rename = "words")]
    message: String,
}

#[derive(Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum FindingLevel {
    Good,
    /// Information that does not prevent a run.
    Notice,
    /// Problem that prevents a run.
    Obstacle,
}

impl Finding {
    fn new(check: impl Into<String>, level: FindingLevel, words: impl Into<String>) -> Self {
        Self { check: check.into(), level, message: words.into() }
    }

    fn from_result<E: std::fmt::Display>(what: &str, looked: Result<String, E>) -> Self {
        match looked {
            Ok(words) => Self::new(what, FindingLevel::Good, words),
            Err(reason) => Self::new(what, FindingLevel::Obstacle, reason.to_string()),
        }
    }
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let Arguments { cell: path, recipe, runs, plant, json } = arguments;
    if check::is_recipe(path) {
        return Err(Failure::RecipeForCell { path: path.clone() });
    }
    let cell = check::or_show(CellConfig::read(path))?;
    let mut findings =
        vec![Finding::new("cell", FindingLevel::Good, format!("{} is a good cell file", path.display()))];
    findings.extend(check::cell_notes(&cell).into_iter().map(|note| Finding::new("cell", FindingLevel::Notice, note)));
    findings.extend([folder(runs), clock(runs), signing()]);
    findings.extend(open_runs(runs));
    findings.extend(recipe.as_ref().map(|recipe| Finding::from_result("recipe", fits(recipe, &cell))));
    let runtime = super::runtime()?;
    findings.extend(runtime.block_on(machines(&cell)));
    findings.extend(runtime.block_on(plant.try_receivers())?.into_iter().map(|(receiver, tried)| match tried {
        Ok(words) => Finding::new(receiver, FindingLevel::Good, words),
        // A run does not need it.
        Err(words) => Finding::new(receiver, FindingLevel::Notice, words),
    }));
    if *json {
        super::print_json(&findings)?;
    } else {
        super::print(&findings.iter().map(in_words).collect::<String>())?;
    }
    let obstacle = findings.iter().any(|finding| finding.level == FindingLevel::Obstacle);
    Ok(if obstacle { Outcome::NotInTolerance } else { Outcome::Accepted })
}

fn in_words(finding: &Finding) -> String {
    let Finding { check, level, message: words } = finding;
    let mark = match level {
        FindingLevel::Good => "ok",
        FindingLevel::Notice => "note",
        FindingLevel::Obstacle => "OBSTACLE",
    };
    format!("{mark:<9}{check}: {words}\n")
}

/// Checks the folder `runs`, in which the runs are stored, and returns the result. The result is an obstacle if no file
/// can be written to the folder. The result is a notice if the disk of the folder has less than 1 GiB of free space.
/// Otherwise the result is good and states the free space in GB.
///
/// If the folder is missing, creates this folder for the check and removes it again.
fn folder(runs: &Path) -> Finding {
    const LITTLE_BYTES: u64 = 1 << 30;
    // A missing folder is created, tested, and removed again.
    let written = if runs.is_dir() { try_writing(runs) } else { ResultFolder::prepare(runs).map(drop) };
    let free = free_bytes(runs).unwrap_or(u64::MAX);
    match written {
        Err(error) => Finding::new("folder of the runs", FindingLevel::Obstacle, error.to_string()),
        Ok(()) if free < LITTLE_BYTES => {
            let words = format!(
                "the disk of {} has {} MB free, but a run with many points can require hundreds of MB; delete or move files to get more free space",
                runs.display(),
                free >> 20
            );
            Finding::new("folder of the runs", FindingLevel::Notice, words)
        }
        Ok(()) => Finding::new(
            "folder of the runs",
            FindingLevel::Good,
            format!("{} is writable, {} GB are free", runs.display(), free >> 30),
        ),
    }
}

/// Returns a notice with the number of run folders in `runs` that every user of this computer can read or enter. Such
/// folders are a risk: a user who reads a record can block the program that writes this record. Earlier versions of
/// this program created such folders. Returns `None` if no run folder is open to every user.
fn open_runs(runs: &Path) -> Option<Finding> {
    let open = control::folders(runs).filter(|folder| is_open_to_all(folder)).count();
    let words = format!(
        "the folders of {open} run(s) are open to every user of this computer. A user who reads the record of an \
         active run can block this run. Restrict the access: `chmod o-rwx {}/*`",
        runs.display()
    );
    (open > 0).then(|| Finding::new("runs", FindingLevel::Notice, words))
}

/// Checks the clock of this computer. Returns a notice if the clock shows a time before the last run in `runs` ended
/// (or began, if the run has no recorded end). Also returns a notice if the time is before 2026-01-01, the date of this
/// code. Otherwise returns a good finding with the time in UTC.
fn clock(runs: &Path) -> Finding {
    /// Date of this code. A correct clock shows no earlier time.
    const MIN: &str = "2026-01-01T00:00:00Z";
    let now = utc(SystemTime::now());
    let last = control::folders(runs)
        .filter_map(|folder| run_summary(&folder).ok())
        .map(|run| run.ended.unwrap_or(run.began))
        .max();
    let last = last.unwrap_or_default();
    if now.as_str() < MIN || now < last {
        let words = format!(
            "the clock of this computer shows {now:.19}. This time is before the last record ({last:.19}) or before \
             the release of this program. Set the clock. The order of the records is correct also with a wrong clock"
        );
        return Finding::new("clock", FindingLevel::Notice, words);
    }
    Finding::new("clock", FindingLevel::Good, format!("{now:.19} UTC"))
}

fn signing() -> Finding {
    match key::of_this_user() {
        Ok(Some(key)) => Finding::new(
            "audit key",
            FindingLevel::Good,
            format!("records are signed with {}", key.public().fingerprint()),
        ),
        Ok(None) => Finding::new(
            "audit key",
            FindingLevel::Notice,
            "this user has no signing key, so records are not signed; to create a key: regrind audit key",
        ),
        Err(error) => Finding::new("audit key", FindingLevel::Obstacle, error.to_string()),
    }
}

/// Checks whether the cell `cell` can run the recipe in the file `recipe`. All values must be within the limits of the
/// machines. The reference sphere, if the task has one, must be clear of the part. Returns a text that confirms this.
/// Returns an error with the reason if the cell cannot run the recipe.
fn fits(recipe: &Path, cell: &CellConfig) -> Result<String, Failure> {
    let recipe = check::or_show(Recipe::read(recipe))?;
    let (task, _) = setup::prepare(&recipe, cell).map_err(Failure::Setup)?;
    let sphere = if task.reference_sphere.is_some() { ", and the reference sphere is clear of the part" } else { "" };
    Ok(format!("{} is within the limits of this cell{sphere}", recipe.path().display()))
}

async fn machines(cell: &CellConfig) -> Vec<Finding> {
    if within(cell) {
        return vec![Finding::new(
            "machines",
            FindingLevel::Good,
            "simulated within the program, so there is no connection to check",
        )];
    }
    let settings = |link| setup::modbus_settings(link, cell.simulated, 1, 1);
    let [cmm, grinder] = [&cell.cmm.link, &cell.grinder.link];
    vec![
        match cmm.wire.connection_check() {
            ConnectionCheck::Session => server(MachineKind::Cmm, cmm, setup::create_cmm(cell)).await,
            ConnectionCheck::Listen => heard(cmm, setup::create_cmm(cell)).await,
            _ => machine(Device::Cmm, cell, settings(cmm), ModbusCmm::new).await,
        },
        match grinder.wire.connection_check() {
            ConnectionCheck::Session => server(MachineKind::Grinder, grinder, setup::create_grinder(cell)).await,
            _ => machine(Device::Grinder, cell, settings(grinder), ModbusGrinder::new).await,
        },
    ]
}

/// Checks the connection to a machine whose controller is a network server (I++ DME or LinuxCNC), and returns the
/// result. Locks the machine against other runs, opens a session, requests the identity and the status, and closes the
/// session. Starts no job on the machine.
///
/// `kind` is the kind of the machine, and `link` the settings of its connection. `made` is the driver of the machine,
/// or the error if the driver could not be created. The result is an obstacle if the driver or a request fails. The
/// result is a notice if the lock is not available.
async fn server<M: Machine>(kind: MachineKind, link: &LinkConfig, made: Result<M, DriverError>) -> Finding {
    let what = match kind {
        MachineKind::Cmm => Device::Cmm,
        MachineKind::Grinder => Device::Grinder,
    };
    let what = what.to_string();
    let _taken = match lock_machine(link, kind, Path::new("regrind doctor")) {
        Ok(taken) => taken,
        Err(failure) => return Finding::new(what, FindingLevel::Notice, failure.to_string()),
    };
    let mut machine = match made {
        Ok(machine) => machine,
        Err(error) => return Finding::new(what, FindingLevel::Obstacle, error.to_string()),
    };
    let looked = async {
        let identity = machine.connect().await?;
        let status = machine.status().await?;
        let words = format!("{}: {} is {}", machine.name(), identity.name, describe_status(&status));
        let told = machine.notes().iter().fold(words, |words, note| format!("{words}; {note}"));
        machine.release().await?;
        Ok::<_, DeviceError>(told)
    };
    Finding::from_result(&what, looked.await)
}

/// Time for which the line of a machine that prints its hits is read.
const LISTENS: Duration = Duration::from_secs(5);

/// Checks the connection to a measuring machine that only prints its hits (one line of text for each touch), and
/// returns the result. Waits at most [`LISTENS`] for a line. The result states which formats fit this line, or that no
/// line arrived. `link` contains the settings of the connection. `made` is the driver of the machine, or the error if
/// the driver could not be created.
async fn heard(link: &LinkConfig, made: Result<impl Machine, DriverError>) -> Finding {
    let what = Device::Cmm.to_string();
    let _taken = match lock_machine(link, MachineKind::Cmm, Path::new("regrind doctor")) {
        Ok(taken) => taken,
        Err(failure) => return Finding::new(what, FindingLevel::Notice, failure.to_string()),
    };
    let mut machine = match made {
        Ok(machine) => machine,
        Err(error) => return Finding::new(what, FindingLevel::Obstacle, error.to_string()),
    };
    let name = machine.name().to_owned();
    if let Err(error) = machine.connect().await {
        return Finding::new(what, FindingLevel::Obstacle, error.to_string());
    }
    let until = tokio::time::Instant::now() + LISTENS;
    while machine.notes().is_empty() && tokio::time::Instant::now() < until {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    match machine.notes().pop() {
        Some(note) => Finding::new(what, FindingLevel::Notice, format!("{name}: {note}")),
        None => {
            let listened = LISTENS.as_secs();
            let words = format!(
                "the connection to {name} is open, but no line of text arrived in {listened} s. Start this command \
                 again, and touch something with the probe within this time. Then the command shows the formats that \
                 match the line"
            );
            Finding::new(what, FindingLevel::Notice, words)
        }
    }
}

async fn machine<M: Machine>(
    device: Device,
    cell: &CellConfig,
    settings: Option<ModbusSettings>,
    make: fn(ModbusSettings) -> std::io::Result<M>,
) -> Finding {
    let what = device.to_string();
    let Some(settings) = settings else {
        let words = "this machine has no data connection to test; its folders and settings are valid";
        return match setup::check_machine(cell, device) {
            Ok(()) => Finding::new(what, FindingLevel::Notice, words),
            Err(error) => Finding::new(what, FindingLevel::Obstacle, error.to_string()),
        };
    };
    let (kind, link) = match device {
        Device::Cmm => (MachineKind::Cmm, &cell.cmm.link),
        Device::Grinder => (MachineKind::Grinder, &cell.grinder.link),
    };
    // The holder of the lock works with the machine, and a second client would disturb it.
    let _taken = match lock_machine(link, kind, Path::new("regrind doctor")) {
        Ok(taken) => taken,
        Err(failure) => return Finding::new(what, FindingLevel::Notice, failure.to_string()),
    };
    if let Some((LineAddress::Rtu { device: port, .. }, _)) = link.wire.modbus_line()
        && !Path::new(&port).exists()
    {
        return Finding::new(
            what,
            FindingLevel::Obstacle,
            format!("there is no port {port}: check the cable, and the name in the cell file"),
        );
    }
    match make(settings) {
        Err(error) => Finding::new(what, FindingLevel::Obstacle, format!("its port cannot be opened: {error}")),
        Ok(mut machine) => {
            let looked = read_status(&mut machine).await;
            let name = machine.name().to_owned();
            Finding::from_result(&what, looked.map(|status: Status| format!("{name} is {}", describe_status(&status))))
        }
    }
}
