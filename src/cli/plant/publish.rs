//! `regrind tell`: publishes the status of this cell by Sparkplug B, OPC UA or MTConnect, in parallel with the work of the cell.

mod follower;
mod run_ends;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use regrind::config::PlantConfig;
use regrind::drive::Request;
use regrind::formats::write_atomic;
use regrind_control::OnBehalf;
use regrind_live::{
    Adapter, EventSender, LiveError, Node, PublisherEvent, PublisherLock, StatusReceiver, UaServer, devices_file,
    event_queue, status_feed,
};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use super::super::failure::Failure;
use super::super::{Outcome, check, outside};
use super::cell_monitor::live_runs;
use super::plant_file::read;
use super::replicate;
use follower::Follower;
use run_ends::RunEnds;

/// Time between two tries for the publisher lock.
const ROUND: Duration = Duration::from_secs(1);
/// Time for which the result of an ended run is still published.
const LINGERS: Duration = Duration::from_secs(3);
/// Timeout for the closing messages.
const FAREWELL: Duration = Duration::from_secs(5);
/// Maximum number of refusals that are reported individually per minute.
const ONE_BY_ONE: usize = 8;
const MINUTE: Duration = Duration::from_secs(60);

/// Publish live values of this cell to a broker (Sparkplug B), to clients (OPC UA) and to agents (MTConnect)
#[derive(Args, Debug)]
#[command(after_help = "\
The tables [sparkplug], [opcua] and [mtconnect] of the plant file name the receivers. The command runs until you stop it,
also without an active run. The command accepts no orders: written values and received commands are refused, reported
here, and recorded in the active run. Changes that cannot be published are kept, also after the end of this command,
and are published later as historical values (Sparkplug B). `regrind run --plant` starts this command by itself.
docs/live.md lists every value.

Examples:
  regrind tell --plant plant.toml --runs /srv/runs
  regrind tell --plant plant.toml --devices Devices.xml     for the agent of MTConnect

Exit codes: 0 stopped by Ctrl-C, or the file is written; 2 bad arguments, or an entry of the plant file cannot be used.")]
pub(in crate::cli) struct Arguments {
    /// Plant file: receivers of the values
    #[arg(long, value_name = "FILE")]
    plant: PathBuf,
    /// Folder of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Write the devices file for the agent of MTConnect, and publish nothing
    #[arg(long, value_name = "FILE")]
    devices: Option<PathBuf>,
    /// Print a line of JSON for each event
    #[arg(long)]
    json: bool,
    /// End shortly after the end of standard input, that is, after the end of the program that started this one
    #[arg(long, hide = true)]
    while_stdin: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let config = read(&arguments.plant)?;
    let cell = cell_of(&config)?;
    if let Some(path) = &arguments.devices {
        return write_devices(&config, &cell, path);
    }
    // Other programs of this computer have priority.
    outside::give_way(outside::BACKGROUND_STEPS);
    super::super::runtime()?.block_on(async {
        let mut endings = outside::Endings::new().map_err(Failure::Signals)?;
        let ended = async {
            if arguments.while_stdin {
                return drop(replicate::end_of_input().await);
            }
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = endings.next() => {}
            }
        };
        tokio::pin!(ended);
        let turn = tokio::select! {
            turn = wait_for_lock(&config, arguments) => turn?,
            () = &mut ended => return Ok(Outcome::Accepted),
        };
        publish(&config, &cell, &turn, arguments, ended).await
    })
}

/// Writes the devices file of an MTConnect agent for the cell named `cell` to `path`. If the plant file has no table
/// `[mtconnect]`, prints this problem and returns a failure.
fn write_devices(config: &PlantConfig, cell: &str, path: &Path) -> Result<Outcome, Failure> {
    let missing =
        || config.problem("mtconnect", "is missing", "", "add the table [mtconnect] with the address to listen at");
    let settings = check::or_show(config.mtconnect.as_ref().ok_or_else(missing))?;
    write_atomic(path, devices_file(settings, cell).as_bytes())?;
    Ok(Outcome::Accepted)
}

/// Returns the name of the cell from the plant file, under which the live values are published. If the plant file has
/// no table `[sparkplug]`, `[opcua]` or `[mtconnect]`, or no name of the cell, prints this problem and returns a failure.
fn cell_of(config: &PlantConfig) -> Result<String, Failure> {
    let missing = |key, remedy| check::or_show(Err(config.problem(key, "is missing", "", remedy)));
    match &config.cell {
        _ if config.sparkplug.is_none() && config.opcua.is_none() && config.mtconnect.is_none() => {
            missing("sparkplug", "name the receiver of the values in a table [sparkplug], [opcua] or [mtconnect]")
        }
        Some(cell) => Ok(cell.clone()),
        None => missing("plant.cell", "give the name of this cell"),
    }
}

/// Waits for the publisher lock of the cell, and returns this lock. The lock ensures that only one program at a time
/// publishes the cell. If another program has the lock, prints a message once (not with `--while-stdin`), and tries
/// again until that program ends. Returns an error if the lock file cannot be used.
async fn wait_for_lock(config: &PlantConfig, arguments: &Arguments) -> Result<PublisherLock, Failure> {
    let folder = config.path().with_extension("live");
    let mut waits = false;
    loop {
        if let Some(turn) = PublisherLock::acquire(&folder)? {
            return Ok(turn);
        }
        if !std::mem::replace(&mut waits, true) && !arguments.while_stdin {
            eprintln!(
                "tell: another program already publishes the values of this cell; this program waits until the other program ends"
            );
        }
        tokio::time::sleep(ROUND).await;
    }
}

/// Publishes the state of the cell to all receivers that the plant file `config` names. Ends when the future `ended`
/// completes or when a publisher ends. `arguments` give the folder of the runs. `cell` is the name under which the cell
/// is published. `turn` is the lock that keeps other programs from publishing the same cell.
///
/// Returns [`Outcome::Accepted`] after an orderly end. Returns an error if a publisher cannot start or fails.
async fn publish(
    config: &PlantConfig,
    cell: &str,
    turn: &PublisherLock,
    arguments: &Arguments,
    ended: impl Future<Output = ()>,
) -> Result<Outcome, Failure> {
    let folder = config.path().with_extension("live");
    let path = folder.join("ended");
    let ends = RunEnds::open(&arguments.runs, path).map_err(|source| LiveError::Folder { path: folder, source })?;
    let (to, told) = status_feed();
    let (notes, news) = event_queue();
    let mut telling = begin(config, cell, turn, &told, &notes)?;
    // Only the publishers keep the receivers of statuses and the senders of events.
    drop((told, notes));
    let mut hearing = tokio::spawn(print_events(news, arguments.runs.clone(), arguments.json));
    let mut follower = Follower::new(&arguments.runs, ends, to);
    let over = tokio::select! {
        Some(over) = telling.join_next() => Some(over),
        never = follower.follow() => match never {},
        () = async {
            ended.await;
            if arguments.while_stdin {
                tokio::time::sleep(LINGERS).await;
            }
        } => None,
    };
    if over.is_none() {
        // A run that gives no answer does not delay the end.
        let _ = tokio::time::timeout(FAREWELL, follower.publish_once()).await;
    }
    drop(follower);
    let farewell = async { while telling.join_next().await.is_some() {} };
    // A receiver that does not read the closing messages detects the end by other means.
    let _ = tokio::time::timeout(FAREWELL, farewell).await;
    drop(telling);
    let _ = tokio::time::timeout(FAREWELL, &mut hearing).await;
    match over {
        Some(over) => {
            over.map_err(|error| Failure::Terminal(error.into()))?.map(|()| Outcome::Accepted).map_err(Failure::from)
        }
        None => Ok(Outcome::Accepted),
    }
}

/// Starts one task for each publisher that the plant file names (Sparkplug, OPC UA, MTConnect), and returns these tasks. Each task
/// publishes every status that arrives in `told`. Each task sends its events (connected, not connected, request
/// refused) to `notes`. `cell` is the published name, and `turn` the lock that keeps other programs from publishing the
/// same cell. Returns an error if a publisher cannot be created.
fn begin(
    config: &PlantConfig,
    cell: &str,
    turn: &PublisherLock,
    told: &StatusReceiver,
    notes: &EventSender,
) -> Result<JoinSet<Result<(), LiveError>>, Failure> {
    let mut telling = JoinSet::new();
    if let Some(settings) = &config.sparkplug {
        telling.spawn(Node::new(settings, cell, turn, told.another(), notes.clone())?.run());
    }
    if let Some(settings) = &config.opcua {
        telling.spawn(UaServer::new(settings, cell, turn, told.another(), notes.clone())?.run());
    }
    if let Some(settings) = &config.mtconnect {
        telling.spawn(Adapter::new(settings, told.another(), notes.clone())?.run());
    }
    Ok(telling)
}

// ---- returned events ----------------------------------------------------------------------------------------------

/// Prints the events of the publishers that arrive in `news`: connected, not connected, and request refused. With
/// `json`, also prints each event as a line of JSON. Records refused requests in the active run in the folder `runs`,
/// but only as many in a minute as [`Quota`] allows. Prints and records the number of further refused requests
/// together. Returns when all publishers have ended.
async fn print_events(mut news: mpsc::Receiver<PublisherEvent>, runs: PathBuf, json: bool) {
    let mut some = Vec::new();
    let mut quota = Quota::new(Instant::now());
    loop {
        let heard = match quota.unreported {
            0 => Ok(news.recv_many(&mut some, 256).await),
            _ => tokio::time::timeout(MINUTE, news.recv_many(&mut some, 256)).await,
        };
        for news in some.drain(..) {
            match news {
                PublisherEvent::Connected { place } => {
                    say(json, &json!({ "tells": place }), &format!("publishing to {place}"))
                }
                PublisherEvent::Retrying { place, reason } => say(
                    json,
                    &json!({ "waits": place, "why": reason }),
                    &format!("not publishing to {place}: {reason}; the cell continues, and this program tries again"),
                ),
                PublisherEvent::Dropped { place, changes } => say(
                    json,
                    &json!({ "dropped": changes, "for": place }),
                    &format!(
                        "{changes} changes for {place} are lost: they were too many or too old; raise `keep_changes` \
                         or `keep_hours` in [sparkplug]"
                    ),
                ),
                PublisherEvent::Refused { by, what } if quota.takes(Instant::now()) => {
                    refuse(&runs, json, &by, &what).await
                }
                PublisherEvent::Refused { .. } => quota.unreported += 1,
                PublisherEvent::MoreRefused { times } => quota.unreported += u64::from(times),
            }
        }
        let over = matches!(heard, Ok(0));
        if let Some(more) = quota.summed_up(Instant::now(), over) {
            refuse(&runs, json, "these or other clients", &format!("{more} further requests")).await;
        }
        if over {
            return;
        }
    }
}

/// Limit of the reported refusals per minute: some individually, and then once the number of the others. Each report is
/// a line in the record of a run.
struct Quota {
    since: Instant,
    reported: usize,
    has_summed_up: bool,
    unreported: u64,
}

impl Quota {
    fn new(now: Instant) -> Self {
        Self { since: now, reported: 0, has_summed_up: false, unreported: 0 }
    }

    fn turn(&mut self, now: Instant) {
        if now.duration_since(self.since) >= MINUTE {
            *self = Self { unreported: self.unreported, ..Self::new(now) };
        }
    }

    /// Counts a refused request that arrives at the time `now`. Returns true if the request is one of the first
    /// [`ONE_BY_ONE`] in the current minute. The caller then reports this request individually. Otherwise returns
    /// false.
    fn takes(&mut self, now: Instant) -> bool {
        self.turn(now);
        self.reported += 1;
        self.reported <= ONE_BY_ONE
    }

    /// Returns the number of refused requests that were not reported individually, and resets this number to 0. `now`
    /// is the current time. `over` is true if no further events can arrive. Returns `None` if there are no such
    /// requests. Also returns `None` if this number was already reported in the current minute and `over` is false.
    fn summed_up(&mut self, now: Instant, over: bool) -> Option<u64> {
        self.turn(now);
        let is_due = self.unreported > 0 && (over || !self.has_summed_up);
        is_due.then(|| {
            self.has_summed_up = true;
            std::mem::take(&mut self.unreported)
        })
    }
}

/// Prints that a request was refused, and records this as a remark in the active run in the folder `runs`, if there is
/// one. `by` is the client that sent the request. `what` describes the request. With `json`, also prints the refusal as
/// a line of JSON. If the run does not record the remark, prints a message.
async fn refuse(runs: &Path, json: bool, by: &str, what: &str) {
    say(
        json,
        &json!({ "refused": what, "by": by }),
        &format!("refused a request of {by}: {what}; live values can only be read"),
    );
    let runs = runs.to_owned();
    let remark = Request::Remark { what: format!("live values: refused: {what}"), alarm: None };
    let by = OnBehalf { name: None, station: by.to_owned() };
    // A run that does not answer delays only this report.
    let recorded = tokio::task::spawn_blocking(move || {
        let run = live_runs(&runs).next()?;
        Some(regrind_control::send_request_on_behalf(&run, &remark, Some(by)).is_ok_and(|reply| reply.accepted))
    });
    if recorded.await.ok().flatten() == Some(false) {
        eprintln!("tell: the run did not record the refused request");
    }
}

fn say(json: bool, fields: &serde_json::Value, words: &str) {
    eprintln!("tell: {words}");
    if json {
        // A reader that is gone is not an error.
        let _ = super::super::print(&format!("{fields}\n"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quota_limits_lines_per_minute() {
        let began = Instant::now();
        let mut quota = Quota::new(began);
        let (mut lines, mut counted) = (0, 0);
        // A thousand per second for ten minutes, processed four times per second.
        for quarter in 0..2400 {
            let now = began + Duration::from_millis(250 * quarter);
            for _ in 0..250 {
                if quota.takes(now) {
                    (lines, counted) = (lines + 1, counted + 1);
                } else {
                    quota.unreported += 1;
                }
            }
            if let Some(more) = quota.summed_up(now, quarter == 2399) {
                (lines, counted) = (lines + 1, counted + more);
            }
        }
        assert_eq!(counted, 600_000, "each is counted");
        assert!(lines <= 10 * (ONE_BY_ONE + 1) + 1, "{lines}");
    }
}
