//! Execution of blocking work outside the loop: on threads of the computer, or in turn with all other tasks if the time
//! of the run is simulated, because threads would not follow the simulated time.

use std::future::Future;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::task::{AbortHandle, JoinSet};

/// Kind of blocking work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BlockingWork {
    /// Registration, correction, or files that are written and read.
    Computation,
    /// Write of a record to the disk.
    Record,
}

/// Executor of blocking work.
#[derive(Clone, Default)]
pub enum BlockingExecutor {
    /// Threads of the computer.
    #[default]
    Threads,
    /// Simulated time: each piece of work runs in turn with all other tasks, after the duration that this function
    /// returns for it.
    SimulatedTime(Arc<dyn Fn(BlockingWork) -> Duration + Send + Sync>),
}

impl BlockingExecutor {
    /// Starts the computation `work` as a task of the set `among`, and returns the handle to abort this task. The
    /// computation runs on a thread for blocking work. If time is simulated, it runs as an asynchronous task after its
    /// simulated duration.
    pub(super) fn spawn_computation<T: Send + 'static>(
        &self,
        among: &mut JoinSet<T>,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> AbortHandle {
        match self.clone() {
            Self::Threads => among.spawn_blocking(work),
            in_turn => among.spawn(async move {
                in_turn.wait_simulated_duration(BlockingWork::Computation).await;
                work()
            }),
        }
    }

    /// Runs the future `attending` on a separate thread with the name `name`, because this future may block for long.
    /// Returns the handle of the thread. If time is simulated, runs the future as a task of the current runtime and
    /// returns `None`.
    pub(super) fn spawn_service(
        &self,
        name: &str,
        attending: impl Future<Output = ()> + Send + 'static,
    ) -> Option<JoinHandle<()>> {
        if let Self::SimulatedTime(_) = self {
            tokio::spawn(attending);
            return None;
        }
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("it asks for nothing");
        let thread = std::thread::Builder::new().name(name.into()).spawn(move || runtime.block_on(attending));
        Some(thread.expect("a thread can be had"))
    }

    /// Waits for the duration of this kind of work, if the time is simulated. Otherwise returns at once.
    pub(super) async fn wait_simulated_duration(&self, what: BlockingWork) {
        if let Self::SimulatedTime(time) = self {
            tokio::time::sleep(time(what)).await;
        }
    }
}
