//! Simulation that is under way or has ended: its child program, its folder and its run.

use std::path::PathBuf;
use std::process::Stdio;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use regrind_cell::StateName;
use regrind_formats::SimulationFolder;
use tokio::io::AsyncReadExt;
use tokio::process::{Child, Command};
use tokio::sync::watch::Receiver;
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep};

use super::super::history::History;
use super::super::live::{ObservedRun, RunWatcher};
use super::super::users::Person;

/// Maximum size of the messages of the child program that are kept, in bytes.
const MAX_MESSAGE_BYTES: u64 = 4096;
/// Maximum duration of a simulation.
const MAX_DURATION: Duration = Duration::from_secs(3600);
/// Time between two looks at a simulation.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Text that a person lets simulate.
pub(super) struct SimulationTask {
    /// Number of the simulation, which no other one of this page has.
    pub(super) id: u64,
    /// Name of the recipe.
    pub(super) name: String,
    pub(super) text: String,
    pub(super) seed: u64,
    /// Person who has started it; `None` on a page without users.
    pub(super) person: Option<Person>,
    /// Key of the person, which must not be shown.
    pub(super) person_key: String,
}

/// Run on simulated machines, and the child program that drives it.
pub(super) struct Simulation {
    pub(super) task: SimulationTask,
    run: Arc<SimulatedRun>,
    /// End of the child program; `None` while it runs.
    pub(super) ended: Receiver<Option<EndedSimulation>>,
    program: AbortHandle,
    /// The folder is deleted with the last of its users.
    _folder: Arc<SimulationFolder>,
}

impl Drop for Simulation {
    fn drop(&mut self) {
        self.program.abort();
    }
}

/// End of the child program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct EndedSimulation {
    /// True if the program has made a run to its end, with an accepted part or not.
    pub(super) is_complete: bool,
    /// Messages of the program.
    pub(super) message: String,
}

/// Run of a simulation, as its record and its program tell about it.
struct SimulatedRun {
    history: Arc<History>,
    watcher: RunWatcher,
    /// Kept from the begin of the run, because a watcher without receivers forgets the run.
    seen: OnceLock<Receiver<ObservedRun>>,
}

impl SimulatedRun {
    fn folder(&self) -> Option<PathBuf> {
        self.history.first()
    }

    fn observed(&self) -> ObservedRun {
        let seen = self.folder().map(|folder| self.seen.get_or_init(|| self.watcher.subscribe(&folder)));
        seen.map_or_else(ObservedRun::default, |seen| seen.borrow().clone())
    }

    /// Waits until the run cannot end by itself: it holds, and no person is there who resumes it, or it takes too long.
    /// Returns the reason.
    async fn stuck(&self) -> String {
        let until = Instant::now() + MAX_DURATION;
        while Instant::now() < until {
            let seen = self.observed();
            if let Some(snapshot) = seen.snapshot.as_ref().filter(|snapshot| snapshot.state == StateName::Held) {
                let active = seen.summary.alarms.iter().filter(|alarm| alarm.withdrawn.is_none());
                let alarms: Vec<String> = active.map(|alarm| alarm.alarm.event.clone()).collect();
                return [vec![format!("the cell holds: {}", snapshot.message)], alarms].concat().join("; ");
            }
            sleep(LOOK_EVERY).await;
        }
        "the simulation did not end within an hour".to_owned()
    }
}

impl Simulation {
    /// Returns true if this is the simulation with this number, of the recipe named `name`.
    pub(super) fn is(&self, id: u64, name: &str) -> bool {
        self.task.id == id && self.task.name == name
    }

    /// Returns the folder of the run, when the child program has created it.
    pub(super) fn run_folder(&self) -> Option<PathBuf> {
        self.run.folder()
    }

    /// Returns what is known about the run; the default if it has not begun.
    pub(super) fn observed(&self) -> ObservedRun {
        self.run.observed()
    }
}

/// Starts the child program `command` for `task`, which runs in `folder`.
pub(super) fn started(
    mut command: Command,
    task: SimulationTask,
    folder: Arc<SimulationFolder>,
) -> std::io::Result<Simulation> {
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).kill_on_drop(true);
    let mut child = command.spawn()?;
    // The child ends when its input ends, also if this program is killed.
    let input = child.stdin.take();
    let (end, ended) = tokio::sync::watch::channel(None);
    let kept = Arc::clone(&folder);
    let history = Arc::new(History::new(folder.runs()));
    let watcher = RunWatcher::new(Arc::clone(&history));
    let run = Arc::new(SimulatedRun { history, watcher, seen: OnceLock::new() });
    let watched = Arc::clone(&run);
    let program = tokio::spawn(async move {
        let ending = tokio::select! {
            ended = ended_by_itself(&mut child) => ended,
            message = watched.stuck() => {
                // It has possibly ended in this moment.
                let _ = child.kill().await;
                EndedSimulation { is_complete: false, message }
            }
        };
        // Nobody waits for it if the page has gone.
        let _ = end.send(Some(ending));
        drop((input, kept));
    });
    Ok(Simulation { task, run, ended, program: program.abort_handle(), _folder: folder })
}

/// Waits for the end of the child program.
async fn ended_by_itself(child: &mut Child) -> EndedSimulation {
    let mut message = String::new();
    if let Some(errors) = child.stderr.take() {
        // A program that writes more is ended when the rest of its output has no reader.
        let _ = errors.take(MAX_MESSAGE_BYTES).read_to_string(&mut message).await;
    }
    let status = child.wait().await.ok();
    let code = status.and_then(|status| status.code());
    if let (None, Some(status)) = (code, status) {
        message =
            format!("{message}\nthe system or a person has ended the program ({status}); memory is possibly short");
    }
    EndedSimulation { is_complete: matches!(code, Some(0 | 1)), message: message.trim().to_owned() }
}
