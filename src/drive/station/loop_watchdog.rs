//! Watchdog of the loop of the drive.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::time::Instant;

/// Interval between two beats of the loop of the drive.
pub(in super::super) const WATCHDOG_INTERVAL: Duration = Duration::from_millis(250);
/// Time without a beat after which the loop of the drive counts as hung.
const WATCHDOG_TIMEOUT: Duration = Duration::from_secs(2);

/// Watchdog of the loop of the drive. If the loop hangs, the stations stop polling, so the machines get no heartbeat of
/// their client. They then hold by themselves.
#[derive(Clone)]
pub(in super::super) struct LoopWatchdog {
    started_at: Instant,
    last_beat_ms: Arc<AtomicU64>,
}

impl LoopWatchdog {
    pub(in super::super) fn new() -> Self {
        Self { started_at: Instant::now(), last_beat_ms: Arc::default() }
    }

    pub(in super::super) fn beat(&self) {
        self.last_beat_ms.store(self.elapsed_ms(), Ordering::Release);
    }

    pub(super) fn is_alive(&self) -> bool {
        self.elapsed_ms().saturating_sub(self.last_beat_ms.load(Ordering::Acquire))
            < WATCHDOG_TIMEOUT.as_millis() as u64
    }

    fn elapsed_ms(&self) -> u64 {
        self.started_at.elapsed().as_millis() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn watchdog_detects_hung_loop() {
        let pulse = LoopWatchdog::new();
        assert!(pulse.is_alive());
        tokio::time::advance(WATCHDOG_TIMEOUT).await;
        assert!(!pulse.is_alive());
        pulse.beat();
        assert!(pulse.clone().is_alive());
    }
}
