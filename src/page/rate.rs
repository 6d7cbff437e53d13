//! Count of an event within a minute, such as a refused request or an attempt to sign in.

use std::time::{Duration, Instant};

const MINUTE: Duration = Duration::from_secs(60);

/// Number of occurrences of an event within a minute.
pub(crate) struct Rate {
    began: Instant,
    count: u32,
}

impl Rate {
    pub(crate) fn new() -> Self {
        Self { began: Instant::now(), count: 0 }
    }

    pub(crate) fn is_over(&self) -> bool {
        self.began.elapsed() > MINUTE
    }

    /// Returns the age of the current counting interval: the time since it began. The counted events are, for example,
    /// refused requests or attempts to sign in. An interval lasts at least one minute. The next interval begins with
    /// the first event after this minute.
    pub(crate) fn age(&self) -> Duration {
        self.began.elapsed()
    }

    /// Returns the number of events in the current counting interval. The counted events are, for example, refused
    /// requests or attempts to sign in. An interval lasts at least one minute. The next interval begins with the first
    /// event after this minute.
    pub(crate) fn current_count(&self) -> u32 {
        self.count
    }

    pub(crate) fn count(&mut self) -> u32 {
        if self.is_over() {
            *self = Self::new();
        }
        self.count += 1;
        self.count
    }
}
