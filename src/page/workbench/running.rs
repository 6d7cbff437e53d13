//! Simulation that is under way or has ended: its child program, its folder and its run.

use std::path::PathBuf;
use std::process::Stdio;
use std::sync::Arc;

use regrind_formats::SimulationFolder;
use tokio::io::AsyncReadExt;
use tokio::process::{Child, Command};
use tokio::sync::watch::{Receiver, Sender};
use tokio::task::AbortHandle;

use super::super::history::History;
use super::super::live::{ObservedRun, RunWatcher};

/// Maximum size of the messages of the child program that are kept, in bytes.
const MAX_MESSAGE_BYTES: u64 = 4096;

/// Run on simulated machines, and the child program that drives it.
pub(super) struct Simulation {
    /// Name of the recipe.
    pub(super) name: String,
    pub(super) seed: u64,
    history: Arc<History>,
    watcher: RunWatcher,
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

impl Simulation {
    /// Returns the folder of the run, when the child program has created it.
    pub(super) fn run_folder(&self) -> Option<PathBuf> {
        self.history.first()
    }

    /// Returns what is known about the run; the default if it has not begun.
    pub(super) fn observed(&self) -> ObservedRun {
        let folder = self.run_folder();
        folder.map_or_else(ObservedRun::default, |folder| self.watcher.subscribe(&folder).borrow().clone())
    }
}

/// Starts the child program `command`, which runs in `folder`.
pub(super) fn started(
    mut command: Command,
    name: String,
    seed: u64,
    folder: Arc<SimulationFolder>,
) -> std::io::Result<Simulation> {
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).kill_on_drop(true);
    let mut child = command.spawn()?;
    // The child ends when its input ends, also if this program is killed.
    let input = child.stdin.take();
    let (end, ended) = tokio::sync::watch::channel(None);
    let kept = Arc::clone(&folder);
    let program = tokio::spawn(async move {
        wait_for_end(child, end).await;
        drop((input, kept));
    });
    let history = Arc::new(History::new(folder.runs()));
    let watcher = RunWatcher::new(Arc::clone(&history));
    Ok(Simulation { name, seed, history, watcher, ended, program: program.abort_handle(), _folder: folder })
}

/// Waits for the end of the child program, and tells it to `end`.
async fn wait_for_end(mut child: Child, end: Sender<Option<EndedSimulation>>) {
    let mut message = String::new();
    if let Some(errors) = child.stderr.take() {
        // A program that writes more is ended when the rest of its output has no reader.
        let _ = errors.take(MAX_MESSAGE_BYTES).read_to_string(&mut message).await;
    }
    let status = child.wait().await.ok().and_then(|status| status.code());
    let is_complete = matches!(status, Some(0 | 1));
    // Nobody waits for it if the page has gone.
    let _ = end.send(Some(EndedSimulation { is_complete, message: message.trim().to_owned() }));
}
