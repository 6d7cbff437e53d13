//! `regrind ship`: replicates the records of this cell to the plant, in parallel with the work of the cell.

use std::io::{self, Read};
use std::mem::{Discriminant, discriminant};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::Args;
use regrind::config::PlantConfig;
use regrind::document::visible_line;
use regrind_live::{CellStatus, RunStatus};
use regrind_plant::{DatabaseLink, PlantError, ReplicationResult, Replicator};
use serde_json::json;

use super::super::failure::Failure;
use super::super::{Outcome, outside};
use super::cell_monitor::CellMonitor;
use super::failure::PlantFailure;
use super::plant_file::{open, read};

/// Time between two rounds, and maximum wait for an unreachable plant.
const ROUND: Duration = Duration::from_secs(1);
const LONGEST_WAIT: Duration = Duration::from_secs(60);
/// Time for which replication continues after the end of a run, for its remaining records.
const LINGERS: Duration = Duration::from_secs(30);

/// Replicate the records and files of finished and running runs to the plant
#[derive(Args, Debug)]
#[command(after_help = "\
The command runs until you stop it. While the plant cannot be reached, or while its disk is full, the command keeps
trying. The plant verifies the chain of every record on arrival. If a journal was shortened or changed after its
replication, or if a recorded file is missing or was changed, this command and the plant report it. Runs that are whole
at the plant are not read again. The cell never waits for this command.

Examples:
  regrind ship --plant plant.toml
  regrind ship --plant plant.toml --runs /srv/runs --once

Exit codes: 0 stopped by Ctrl-C, or everything has arrived; 1 a run differs from its copy at the plant, a recorded file
is missing or was changed, or a journal cannot be read; 2 bad arguments, or the database does not prove its identity;
3 with --once, the plant cannot be reached or its disk is full.")]
pub(in crate::cli) struct Arguments {
    /// Plant file: address and user of the database
    #[arg(long, value_name = "FILE")]
    plant: PathBuf,
    /// Folder of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// End when everything has arrived
    #[arg(long)]
    once: bool,
    /// Print a line of JSON for each event
    #[arg(long)]
    json: bool,
    /// End shortly after the end of standard input, that is, after the end of the program that started this one
    #[arg(long, hide = true)]
    while_stdin: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let config = read(&arguments.plant)?;
    // Other programs of this computer have priority.
    outside::give_way(outside::BACKGROUND_STEPS);
    let mut shipping = Replication {
        shipper: Replicator::new(arguments.runs.clone(), config.artefacts.clone()),
        config,
        link: None,
        arguments,
        monitor: None,
        waits_for: None,
    };
    super::super::runtime()?.block_on(async {
        if arguments.once {
            return shipping.once().await;
        }
        tokio::select! {
            ended = shipping.go_on() => ended.map(|()| Outcome::Accepted),
            stopped = tokio::signal::ctrl_c(), if !arguments.while_stdin => {
                stopped.map_err(Failure::Terminal)?;
                shipping.ended()
            }
        }
    })
}

struct Replication<'a> {
    config: PlantConfig,
    shipper: Replicator,
    link: Option<DatabaseLink>,
    arguments: &'a Arguments,
    /// Monitor of the status of the cell. `None` before the first round, and while the status is read.
    monitor: Option<CellMonitor>,
    /// Kind of the last error that was printed and that a retry can solve; `None` since a round succeeded.
    waits_for: Option<Discriminant<PlantError>>,
}

impl Replication<'_> {
    async fn once(&mut self) -> Result<Outcome, Failure> {
        self.round().await?;
        self.ended()
    }

    /// Returns the outcome of the command: `NotInTolerance` if a run differs from its copy at the plant, or if the plant
    /// lacks something that cannot be sent. Otherwise `Accepted`.
    fn ended(&self) -> Result<Outcome, Failure> {
        let is_whole = self.shipper.skipped().chain(self.shipper.lacking()).next().is_none();
        Ok(if is_whole { Outcome::Accepted } else { Outcome::NotInTolerance })
    }

    /// Replicates records to the plant, one round after the other. If the plant cannot be reached, waits before the
    /// next round; this time doubles up to [`LONGEST_WAIT`]. Without `--while-stdin`, continues until the caller stops
    /// the replication. With `--while-stdin`, continues until standard input is closed. Then returns after a round
    /// without new data, or after the time [`LINGERS`]. Returns an error for any fault that cannot end by itself.
    async fn go_on(&mut self) -> Result<(), Failure> {
        let mut over = self.arguments.while_stdin.then(end_of_input);
        let mut last = None;
        let mut wait = ROUND;
        loop {
            let shipped = match self.round().await {
                Ok(shipped) => {
                    wait = ROUND;
                    Some(shipped)
                }
                Err(Failure::Plant(PlantFailure::Plant(error))) if error.may_pass() => {
                    self.print_waiting(&error);
                    wait = (2 * wait).min(LONGEST_WAIT);
                    None
                }
                Err(error) => return Err(error),
            };
            let is_empty = shipped.is_some_and(|shipped| shipped == ReplicationResult::default());
            match last {
                // One more round after the last one with data, because the end of a record is written last.
                Some(until) if is_empty || Instant::now() > until => return Ok(()),
                _ => {}
            }
            match &mut over {
                Some(over) if last.is_none() => tokio::select! {
                    () = tokio::time::sleep(wait) => {}
                    _ = over => last = Some(Instant::now() + LINGERS),
                },
                _ => tokio::time::sleep(if last.is_some() { ROUND } else { wait }).await,
            }
        }
    }

    /// Executes one round of the replication: connects to the plant if there is no connection, then sends the plant all
    /// new records and the status of the cell. Returns the numbers of the sent records and files. After an error,
    /// closes the connection and returns the error.
    async fn round(&mut self) -> Result<ReplicationResult, Failure> {
        if self.link.as_ref().is_none_or(DatabaseLink::is_closed) {
            self.link = Some(open(&self.config).await?);
            self.shipper.reconnected();
        }
        let Some(link) = &self.link else { return Ok(ReplicationResult::default()) };
        let shipped = self.shipper.round(link).await;
        let told = match &shipped {
            Ok(_) => {
                let look = self
                    .monitor
                    .take()
                    .unwrap_or_else(|| CellMonitor::new(&self.arguments.runs))
                    .poll_in_background()
                    .await;
                send_status(link, self.monitor.insert(look).status()).await
            }
            Err(_) => Ok(()),
        };
        let shipped = match (shipped, told) {
            (Ok(shipped), Ok(())) => shipped,
            (Err(error), _) | (_, Err(error)) => {
                self.link = None;
                return Err(error.into());
            }
        };
        self.print_round(&shipped)?;
        Ok(shipped)
    }

    fn print_round(&mut self, shipped: &ReplicationResult) -> Result<(), Failure> {
        self.waits_for = None;
        for (run, what) in &shipped.differ {
            eprintln!("ship: {}: {}", visible_line(run), visible_line(what));
        }
        if shipped.records == 0 && shipped.files == 0 {
            return Ok(());
        }
        let ReplicationResult { records, files, runs, .. } = shipped;
        if self.arguments.json {
            return super::super::print(&format!("{}\n", json!({ "records": records, "files": files, "runs": runs })));
        }
        if self.arguments.while_stdin {
            return Ok(());
        }
        super::super::print(&format!("shipped {records} records and {files} files of {runs} runs\n"))
    }

    /// Prints `error`, which states why the plant takes no records now. Prints nothing if an error of this kind was the
    /// last one that was printed since the last successful round.
    fn print_waiting(&mut self, error: &PlantError) {
        if self.waits_for.replace(discriminant(error)) != Some(discriminant(error)) {
            let words = visible_line(&error.to_string());
            eprintln!("ship: {words}; the cell continues, and its records stay on this computer until then");
        }
    }
}

/// Sends the status `told` of the cell to the plant: the status of the active run, or that no run is active. Sends
/// nothing if the run does not respond or its program has ended, because the status is then unknown. The plant then
/// shows the cell as silent.
async fn send_status(link: &DatabaseLink, told: &CellStatus) -> Result<(), PlantError> {
    match &told.run_status {
        RunStatus::Active { run, snapshot } => {
            link.report_state(Some(run), &serde_json::to_value(snapshot).unwrap_or_default()).await
        }
        RunStatus::NoRun => link.report_state(None, &json!({ "state": "Idle", "words": "no run is on" })).await,
        RunStatus::Unresponsive { .. } | RunStatus::ProgramGone { .. } => Ok(()),
    }
}

/// Starts a thread that reads standard input, and returns a receiver. The receiver completes when all writers have
/// closed standard input.
pub(super) fn end_of_input() -> tokio::sync::oneshot::Receiver<()> {
    let (ended, end) = tokio::sync::oneshot::channel::<()>();
    // Own thread, which ends with the program, because a blocked read of a pipe cannot be cancelled.
    std::thread::spawn(move || {
        let mut some = [0; 64];
        while io::stdin().read(&mut some).is_ok_and(|read| read > 0) {}
        drop(ended);
    });
    end
}
