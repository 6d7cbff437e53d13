//! `regrind recover`: brings machines to idle that hold jobs unknown to any run.

use std::io;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use clap::Args;
use regrind::cell::{Actor, Device};
use regrind::config::{CellConfig, LinkConfig};
use regrind::device::{Machine, MachineKind, MachineState, ModbusCmm, ModbusGrinder, ModbusSettings};
use regrind::drive::recovery::{self, RecoveryError, RecoveryStep, describe_status, read_status};
use regrind::journal::{Header, Journal, MachineLock, Reader, RecordKind};
use regrind::record::{Begin, RecoveryEnd, RecoveryStart, RunContent, RunEnd};
use regrind::setup;

use super::failure::Failure;
use super::live::{lock_machine, owner};
use super::run::{epoch, free_folder, operator};
use super::succession::RunPlace;
use super::{Outcome, check, control, key, terminal};

/// Bring machines of a cell to idle that hold a job which no run knows
#[derive(Args, Debug)]
#[command(after_help = "\
Shows the state of each machine and the command for the next step to idle: STOP, ACKNOWLEDGE or CLEAR. The command is
sent only after you type the name of the command; after any other input no command is sent. Each step is recorded in a
new folder under --runs. If the job belongs to an interrupted run in --runs, use `regrind resume` first.

Example:
  regrind recover --cell config/modbus-tcp.toml

Exit codes: 0 both machines are idle; 2 bad cell file; 3 a machine is not idle, refused a
command, or cannot be reached.")]
pub(super) struct Arguments {
    /// Cell whose machines to bring to idle
    #[arg(long, value_name = "FILE")]
    cell: PathBuf,
    /// Folder of the runs, and of the record of this recovery
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Name of the person who decides
    #[arg(long, value_name = "NAME", value_parser = super::name)]
    operator: Option<String>,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let cell = check::or_show(CellConfig::read(&arguments.cell))?;
    let actor = operator(arguments.operator.as_deref());
    let began = SystemTime::now();
    let folder = free_folder(&arguments.runs, "recover", began, cell.simulated);
    let taken = [
        lock_machine(&cell.cmm.link, MachineKind::Cmm, &folder)?,
        lock_machine(&cell.grinder.link, MachineKind::Grinder, &folder)?,
    ];
    let epoch = MachineLock::epoch(taken.iter().flatten(), epoch(began));
    let settings = |link| setup::modbus_settings(link, cell.simulated, owner(&actor, &folder), epoch);
    let [cmm, grinder] = [settings(&cell.cmm.link), settings(&cell.grinder.link)];
    let (RunPlace { number, before }, turn) = RunPlace::next(&arguments.runs)?;
    let named = cell.path().to_string_lossy().into_owned();
    let content =
        RunContent::Recovery(RecoveryStart { recover: true, cell: Some(named), number: Some(number), before });
    let header = Header {
        run: folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
        part: "unnamed".into(),
        actor: actor.name.clone(),
        station: actor.station.clone(),
        simulation: cell.simulated,
        first_command_id: 1,
        content: content.into(),
    };
    let journal = Journal::create_with(&folder, header, key::of_this_user()?).map_err(Failure::Journal)?;
    drop(turn);
    let mut recovery = Recovery { actor, journal, folder, runs: arguments.runs.clone(), simulated: cell.simulated };
    super::runtime()?.block_on(async {
        let cmm = recovery.bring_home(Device::Cmm, &cell.cmm.link, cmm, ModbusCmm::new).await;
        let cmm = print_failure(cmm)?;
        let grinder = recovery.bring_home(Device::Grinder, &cell.grinder.link, grinder, ModbusGrinder::new).await;
        recovery.end([cmm, print_failure(grinder)?])
    })
}

/// Evaluates the result `home` of the attempt to bring one machine to idle. Returns the value in `home`: true if the
/// machine is idle, false if not. If `home` is an error, prints this error and returns false, so that the caller
/// continues with the next machine. Returns an error only if the terminal cannot be used.
fn print_failure(home: Result<bool, Failure>) -> Result<bool, Failure> {
    match home {
        Err(failure @ Failure::Terminal(_)) => Err(failure),
        Err(failure) => super::print(&format!("{failure}\n")).map(|()| false),
        home => home,
    }
}

/// Time between two polls of a machine that is changing its state.
const BETWEEN_LOOKS: Duration = Duration::from_secs(1);

/// Recovery of the machines of a cell, with its record.
struct Recovery {
    actor: Actor,
    journal: Journal,
    folder: PathBuf,
    runs: PathBuf,
    simulated: bool,
}

impl Recovery {
    /// Brings a machine to idle in several steps. Before each step, shows the state of the machine and asks a person
    /// for permission. `device` is the machine, and `link` its connection. `settings` are the Modbus settings, or
    /// `None` if the machine has no Modbus connection. `machine` creates the driver from these settings. Returns true
    /// if the machine is idle. Returns false if the person declines a step, if a step does not change the state, or if
    /// `settings` is `None`.
    ///
    /// # Errors
    /// The machine cannot be reached, a step fails, or the terminal cannot be used.
    async fn bring_home<M: Machine>(
        &mut self,
        device: Device,
        link: &LinkConfig,
        settings: Option<ModbusSettings>,
        machine: fn(ModbusSettings) -> io::Result<M>,
    ) -> Result<bool, Failure> {
        let Some(settings) = settings else {
            super::print(&format!("{device}: {}\n", link.wire.end_of_job()))?;
            return Ok(false);
        };
        let mut machine = machine(settings).map_err(|source| Failure::Port { device, source })?;
        let limit = link.timing.lost_after.max(Duration::from_secs(60));
        let mark = if self.simulated { "SIMULATION  " } else { "" };
        let failed = |source| Failure::Recover { device, source };
        loop {
            let seen = read_status(&mut machine).await.map_err(failed)?;
            super::print(&format!("{mark}{}: {}\n", machine.name(), describe_status(&seen)))?;
            if matches!(seen.state, MachineState::Stopping | MachineState::Aborting) {
                // The machine is changing its state by itself.
                tokio::time::sleep(BETWEEN_LOOKS).await;
                continue;
            }
            let Some(step) = RecoveryStep::for_state(seen.state) else { return Ok(true) };
            if let Some(run) = seen.job.and_then(|job| self.run_of(job.job)) {
                super::print(&format!(
                    "  this is a job of the interrupted run {run}: `regrind resume {run}` continues the run; send a command here only if resume is refused\n"
                ))?;
            }
            super::print(&format!(
                "  {} {}\n  type {0} to send this command: ",
                step.name(),
                step.consequence(device)
            ))?;
            if terminal::answer()? != step.name() {
                super::print("no command was sent; the machine stays in this state\n")?;
                return Ok(false);
            }
            match recovery::execute_step(&mut machine, device, step, &seen, limit, &mut self.journal, &self.actor).await
            {
                // A new state is shown. Without a change the same question would repeat for ever.
                Ok(now) if now.state == seen.state && now.state != MachineState::Idle => return Ok(false),
                Ok(_) | Err(RecoveryError::Changed { .. }) => {}
                Err(error) => return Err(failed(error)),
            }
        }
    }

    /// Finds the interrupted run that has the job number `job`, and returns the path of its folder. The machines
    /// identify a run by its job number. A run is interrupted if its record contains no end. Searches the folder of the
    /// runs, without the folder of this recovery. Returns `None` if no such run is found.
    fn run_of(&self, job: u32) -> Option<String> {
        let is_open = |folder: &PathBuf| -> Option<bool> {
            let reader = Reader::open(folder).ok()?;
            let begin = Begin::<RunContent>::read(&reader.records(0).next()?.ok()?)?;
            let ended = reader.records(0).any(|record| record.is_ok_and(|record| record.kind == RecordKind::End));
            Some(begin.content.part()?.job == Some(job) && !ended)
        };
        // The record of this recovery is open for writing. Reading it here as well would release its lock.
        let others = control::folders(&self.runs).filter(|folder| *folder != self.folder);
        let mut open = others.filter(|folder| is_open(folder) == Some(true));
        open.next().map(|folder| folder.display().to_string())
    }

    fn end(self, home: [bool; 2]) -> Result<Outcome, Failure> {
        let idle = RunEnd::Recovery(RecoveryEnd { cmm_home: home[0], grinder_home: home[1] });
        self.journal.close(0, 0, idle.into()).map_err(Failure::Journal)?;
        super::print(&format!("record in {}\n", self.folder.display()))?;
        if home == [true, true] { Ok(Outcome::Accepted) } else { Err(Failure::NotHome) }
    }
}
