//! Queue of the statuses of a cell, for all publishers. Each publisher receives each status once and in order, also if
//! the statuses follow each other faster than it publishes.

use std::sync::Arc;

use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;

use crate::cell_status::TimedStatus;

/// Maximum number of statuses that wait for a publisher. A cell reports at most ten in a second.
const WAITING: usize = 1024;

/// Sender of the statuses. It never waits for a publisher.
#[derive(Debug)]
pub struct StatusSender(broadcast::Sender<Arc<TimedStatus>>);

/// Receiver of the statuses, for one publisher.
#[derive(Debug)]
pub struct StatusReceiver(broadcast::Receiver<Arc<TimedStatus>>);

/// Creates a queue of statuses. Returns the sender and a receiver.
pub fn status_feed() -> (StatusSender, StatusReceiver) {
    let (to, told) = broadcast::channel(WAITING);
    (StatusSender(to), StatusReceiver(told))
}

impl StatusSender {
    /// Sends a status to all publishers.
    pub fn send(&self, status: TimedStatus) {
        // Without a publisher nobody misses it.
        let _ = self.0.send(Arc::new(status));
    }
}

impl StatusReceiver {
    /// Returns another receiver, which receives the statuses that are sent from now on.
    pub fn another(&self) -> Self {
        Self(self.0.resubscribe())
    }

    /// Waits for the next status and returns it. Returns `None` if the sender is dropped and all statuses were
    /// received. If more than `WAITING` statuses wait, skips the oldest ones. Cancel safe.
    pub(crate) async fn next(&mut self) -> Option<Arc<TimedStatus>> {
        loop {
            match self.0.recv().await {
                Ok(status) => return Some(status),
                Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return None,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_status_received_in_order() {
        let (to, mut first) = status_feed();
        let mut second = first.another();
        for at_ms in 0..3 {
            to.send(TimedStatus { at_ms, ..TimedStatus::default() });
        }
        drop(to);
        for told in [&mut first, &mut second] {
            let mut times = Vec::new();
            while let Some(status) = told.next().await {
                times.push(status.at_ms);
            }
            assert_eq!(times, [0, 1, 2]);
        }
    }
}
