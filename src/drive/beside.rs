//! What blocks is done beside the loop: on threads of the computer, or in turn with everything else where the run's whole time is
//! simulated and no thread would keep to it.

use std::future::Future;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::task::{AbortHandle, JoinSet};

/// What blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Blocking {
    /// A registration, a correction, files that are written and read.
    Computation,
    /// A record on its way to the disk.
    Record,
}

/// Where a run does what blocks.
#[derive(Clone, Default)]
pub enum Beside {
    /// On threads of the computer.
    #[default]
    Threads,
    /// In turn with everything else, each after the time that this gives for it.
    InTurn(Arc<dyn Fn(Blocking) -> Duration + Send + Sync>),
}

impl Beside {
    /// Does a piece of work among others.
    pub(super) fn compute<T: Send + 'static>(
        &self,
        among: &mut JoinSet<T>,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> AbortHandle {
        match self.clone() {
            Self::Threads => among.spawn_blocking(work),
            in_turn => among.spawn(async move {
                in_turn.take_its_time(Blocking::Computation).await;
                work()
            }),
        }
    }

    /// Lets something that blocks attend to what it is given; returns its thread, if it has one.
    pub(super) fn attend(
        &self,
        name: &str,
        attending: impl Future<Output = ()> + Send + 'static,
    ) -> Option<JoinHandle<()>> {
        if let Self::InTurn(_) = self {
            tokio::spawn(attending);
            return None;
        }
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("it asks for nothing");
        let thread = std::thread::Builder::new().name(name.into()).spawn(move || runtime.block_on(attending));
        Some(thread.expect("a thread can be had"))
    }

    /// Lets the time pass that something takes, where it is simulated.
    pub(super) async fn take_its_time(&self, what: Blocking) {
        if let Self::InTurn(time) = self {
            tokio::time::sleep(time(what)).await;
        }
    }
}
