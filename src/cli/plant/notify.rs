//! `regrind notify`: notifies people and programs of the events of this cell by webhook and mail, in parallel with the
//! work of the cell.

mod progress;
mod record_events;
mod record_reader;

use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use regrind::config::PlantConfig;
use regrind::document::visible;
use regrind_notify::{DeliveryEvent, NotifyError, NotifySettings, Outbox, Receiver};
use serde_json::json;
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, JoinSet};

use super::super::failure::Failure;
use super::super::{Outcome, check, outside};
use super::plant_file::read;
use super::replicate;
use record_reader::{Finding, RecordReader};

/// Time between two looks at the records, and between two tries for the lock.
const ROUND: Duration = Duration::from_secs(1);
/// Time that the last notifications have at the end of this program. Others stay in their queues.
const FAREWELL: Duration = Duration::from_secs(10);

/// Notify people and programs of holds, alarms and ends of runs, by webhook and mail
#[derive(Args, Debug)]
#[command(after_help = "\
The table [notify] of the plant file names the receivers and the events of each. The command reads the records of the
runs, and gives no orders. Notifications wait in queues on disk next to the plant file, also after the end of this
command. A receiver that does not answer delays nothing but its own notifications. `regrind run --plant` starts this
command by itself. `regrind doctor --plant FILE` tries the receivers. docs/notify.md has the form of a notification.

Example:
  regrind notify --plant plant.toml --runs /srv/runs

Exit codes: 0 stopped by Ctrl-C; 2 bad arguments, or an entry of the plant file cannot be used.")]
pub(in crate::cli) struct Arguments {
    /// Plant file: receivers of the notifications
    #[arg(long, value_name = "FILE")]
    plant: PathBuf,
    /// Folder of the runs
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Print a line of JSON for each event
    #[arg(long)]
    json: bool,
    /// End shortly after the end of standard input, that is, after the end of the program that started this one
    #[arg(long, hide = true)]
    while_stdin: bool,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let config = read(&arguments.plant)?;
    let (cell, settings) = cell_of(&config)?;
    // All files of the receivers are read before anything opens.
    let receivers = Receiver::all(settings)?;
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
        let folder = config.path().with_extension("notify");
        let progress = tokio::select! {
            progress = wait_for_lock(&folder, arguments.while_stdin) => progress?,
            () = &mut ended => return Ok(Outcome::Accepted),
        };
        let reader = RecordReader::new(&arguments.runs, cell, progress);
        let (events, told) = mpsc::unbounded_channel();
        let opened = receivers.into_iter().map(|of| Outbox::open(&folder, of, settings, events.clone()).map(Arc::new));
        let outboxes: Vec<_> = opened.collect::<Result<_, _>>()?;
        drop(events);
        let printing = tokio::spawn(print_events(told, arguments.json));
        notify(reader, outboxes, arguments.json, ended, printing).await?;
        Ok(Outcome::Accepted)
    })
}

/// Returns the name of the cell and the settings of the notifications from the plant file. If one of them is missing,
/// prints this problem and returns a failure.
fn cell_of(config: &PlantConfig) -> Result<(&str, &NotifySettings), Failure> {
    let missing = |key, remedy| check::or_show(Err(config.problem(key, "is missing", "", remedy)));
    match (&config.cell, &config.notify) {
        (_, None) => missing("notify", "name a receiver in a table [[notify.webhook]] or [[notify.mail]]"),
        (None, Some(_)) => missing("plant.cell", "give the name of this cell"),
        (Some(cell), Some(settings)) => Ok((cell, settings)),
    }
}

/// Waits for the lock of the notifications of the cell in `folder`, and returns the list of what was read. The lock
/// ensures that only one program at a time notifies. If another program has it, prints a message once (unless
/// `is_silent`), and tries again until that program ends.
async fn wait_for_lock(folder: &Path, is_silent: bool) -> Result<progress::Progress, Failure> {
    let mut waits = false;
    loop {
        if let Some(progress) = progress::Progress::open(folder)? {
            return Ok(progress);
        }
        if !std::mem::replace(&mut waits, true) && !is_silent {
            eprintln!(
                "notify: another program already notifies for this cell; this program waits until the other program ends"
            );
        }
        tokio::time::sleep(ROUND).await;
    }
}

/// Reads the records with `reader`, and delivers the notifications of each outbox, until `ended` completes. Then reads
/// the records once more, and gives the last notifications some time.
async fn notify(
    mut reader: RecordReader,
    outboxes: Vec<Arc<Outbox>>,
    json: bool,
    mut ended: Pin<&mut impl Future<Output = ()>>,
    printing: JoinHandle<()>,
) -> Result<(), Failure> {
    let mut delivering = JoinSet::new();
    for outbox in &outboxes {
        let outbox = outbox.clone();
        delivering.spawn(async move { outbox.deliver().await });
    }
    loop {
        reader = read_new(reader, &outboxes, json).await?;
        tokio::select! {
            () = tokio::time::sleep(ROUND) => {}
            () = ended.as_mut() => break,
        }
    }
    drop(read_new(reader, &outboxes, json).await?);
    let delivered = async {
        while !outboxes.iter().all(|outbox| outbox.is_empty()) {
            tokio::time::sleep(ROUND / 10).await;
        }
    };
    // A receiver that does not answer does not delay the end: its notifications are on disk.
    let _ = tokio::time::timeout(FAREWELL, delivered).await;
    delivering.shutdown().await;
    drop(outboxes);
    let _ = tokio::time::timeout(FAREWELL, printing).await;
    Ok(())
}

/// Reads the new records once, on a thread of its own, and puts their notifications into the outboxes. Prints what a
/// person should know. Returns the reader.
async fn read_new(mut reader: RecordReader, outboxes: &[Arc<Outbox>], json: bool) -> Result<RecordReader, Failure> {
    let outboxes = outboxes.to_vec();
    let looked = tokio::task::spawn_blocking(move || {
        let found = reader.read_new(|notification| outboxes.iter().for_each(|outbox| outbox.push(notification)));
        (reader, found)
    });
    let (reader, found) = looked.await.map_err(|error| Failure::Terminal(error.into()))?;
    for finding in found {
        match finding {
            Finding::Unclear { run } => say(
                json,
                &json!({ "unclear": run }),
                &format!("the record of {run} is of another version of Regrind: holds in it are not notified"),
            ),
            Finding::DiskFails { reason } => say(
                json,
                &json!({ "disk": reason }),
                &format!("notifications are possibly sent again after a restart: {reason}"),
            ),
        }
    }
    Ok(reader)
}

/// Prints the events of the deliveries that arrive in `told`. With `json`, also prints each as a line of JSON. Returns
/// when all deliveries have ended.
async fn print_events(mut told: mpsc::UnboundedReceiver<DeliveryEvent>, json: bool) {
    while let Some(event) = told.recv().await {
        match event {
            DeliveryEvent::Delivered { receiver, ids } => {
                say(json, &json!({ "delivered": ids, "to": receiver }), &format!("{} to {receiver}", ids.join(", ")));
            }
            DeliveryEvent::Retrying { receiver, place, reason } => say(
                json,
                &json!({ "waits": receiver, "place": place, "why": reason }),
                &format!(
                    "not delivered to {receiver} ({place}): {reason}; the cell continues, and this program tries again"
                ),
            ),
            DeliveryEvent::Lost { receiver, ids, reason } => say(
                json,
                &json!({ "lost": ids, "to": receiver, "why": reason }),
                &format!("{} notifications to {receiver} are lost: {reason}: {}", ids.len(), ids.join(", ")),
            ),
            DeliveryEvent::DiskFails { receiver, reason } => say(
                json,
                &json!({ "disk": reason, "to": receiver }),
                &format!("notifications to {receiver} wait in memory only: {reason}"),
            ),
        }
    }
}

fn say(json: bool, fields: &serde_json::Value, words: &str) {
    eprintln!("notify: {}", visible(words));
    if json {
        // A reader that is gone is not an error.
        let _ = super::super::print(&format!("{fields}\n"));
    }
}

impl From<NotifyError> for Failure {
    fn from(error: NotifyError) -> Self {
        Self::Plant(error.into())
    }
}
