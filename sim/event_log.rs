//! Events of a simulated machine, in order. A test compares them with the controller's journal.

use std::fmt;
use std::time::Duration;

use data_encoding::HEXLOWER;
use serde::{Serialize, Serializer};

use crate::command::{Answer, CommandFrame, State};

/// Event with its time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LogEntry {
    /// Real time since the machine was made, as the sum of its ticks.
    #[serde(rename = "at_s", serialize_with = "seconds")]
    pub time: Duration,
    /// Kind of the event.
    #[serde(flatten)]
    pub event: HandshakeEvent,
}

/// Kind of an event.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub enum HandshakeEvent {
    /// A command was carried out, or refused with an answer.
    Commanded {
        /// Frame as it was read.
        frame: CommandFrame,
        /// Answer of the machine.
        answer: Answer,
        /// State of the machine at that time.
        state: State,
    },
    /// The last accepted frame came again and changed nothing.
    Repeated {
        /// Its sequence number.
        sequence: u32,
    },
    /// A frame was ignored: its copies or its CRC disagree, or its number is 0.
    Broken,
    /// A correct frame was ignored: its number is not greater than the acknowledged one.
    Old {
        /// Its sequence number.
        sequence: u32,
    },
    /// The state changed.
    Changed {
        /// State before.
        from: State,
        /// State after.
        to: State,
    },
    /// The physics began to move for a job. This can happen only once for a (job, cycle).
    Began {
        /// Sequence number of the START.
        start: u32,
        /// The job.
        job: u32,
        /// Its cycle.
        cycle: u16,
    },
    /// A job ended.
    Ended {
        /// Sequence number of its START.
        start: u32,
        /// 1 complete, 2 stopped, 3 aborted, 4 failed.
        result: u16,
        /// Beats of the client during the job.
        #[serde(flatten)]
        beats: BeatStatistics,
    },
    /// A payload came into force.
    Taken {
        /// Kind of the payload.
        kind: u16,
        /// Its identity.
        #[serde(serialize_with = "digits")]
        identity: [u8; 32],
    },
    /// A payload arrived that the machine cannot use.
    Refused {
        /// Kind of the payload.
        kind: u16,
        /// Reason in words.
        reason: String,
    },
    /// A fault was shown; 20 is a silent client.
    Fault {
        /// Its number in docs/modbus.md.
        fault: u16,
    },
    /// The machine began to move without a command.
    Strayed,
    /// The machine's application restarted.
    Rebooted {
        /// Its new boot id.
        boot_id: u32,
    },
    /// The application restarted with its old boot id, and denies that it began its last job.
    Forgot,
}

/// Statistics of the owner's beats during a job, from its START to its end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct BeatStatistics {
    /// Number of beats.
    #[serde(rename = "beats")]
    pub count: u32,
    /// Mean time between beats; 0 for fewer than two.
    #[serde(rename = "mean_beat_s", serialize_with = "seconds")]
    pub mean_interval: Duration,
    /// Longest time without a beat.
    #[serde(rename = "longest_silence_s", serialize_with = "seconds")]
    pub max_silence: Duration,
}

/// Collector of the owner's beats during a job.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct BeatMonitor {
    began: Duration,
    first: Option<Duration>,
    last: Option<Duration>,
    count: u32,
    max_silence: Duration,
}

impl BeatMonitor {
    pub(crate) fn new(began: Duration) -> Self {
        Self { began, ..Self::default() }
    }

    /// Records a heartbeat at the time `now`.
    pub(crate) fn record(&mut self, now: Duration) {
        self.max_silence = self.silence_at(now);
        self.first = self.first.or(Some(now));
        self.last = Some(now);
        self.count = self.count.saturating_add(1);
    }

    /// Returns the statistics of the owner's heartbeats from the start of the job to the time `now`: their number, the
    /// mean interval and the longest silence.
    pub(crate) fn statistics(&self, now: Duration) -> BeatStatistics {
        let between = self.last.zip(self.first).map_or(Duration::ZERO, |(last, first)| last - first);
        let mean = between.checked_div(self.count.saturating_sub(1)).unwrap_or_default();
        BeatStatistics { count: self.count, mean_interval: mean, max_silence: self.silence_at(now) }
    }

    fn silence_at(&self, now: Duration) -> Duration {
        self.max_silence.max(now.saturating_sub(self.last.unwrap_or(self.began)))
    }
}

/// Log of the newest events. When it is full, the older half is dropped.
#[derive(Default)]
pub(crate) struct EventLog {
    entries: Vec<LogEntry>,
    forgotten: u64,
    observer: Option<Observer>,
}

/// Observer that receives each event when it happens.
pub type Observer = Box<dyn FnMut(&LogEntry) + Send>;

impl fmt::Debug for EventLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Log").field("seen", &self.entries).field("forgotten", &self.forgotten).finish_non_exhaustive()
    }
}

fn seconds<S: Serializer>(at: &Duration, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_f64(at.as_secs_f64())
}

fn digits<S: Serializer>(identity: &[u8; 32], to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&HEXLOWER.encode(identity))
}

impl EventLog {
    const CAPACITY: usize = 1 << 16;

    pub(crate) fn push(&mut self, at: Duration, event: HandshakeEvent) {
        if self.entries.len() == Self::CAPACITY {
            self.entries.drain(..Self::CAPACITY / 2);
            self.forgotten += Self::CAPACITY as u64 / 2;
        }
        let seen = LogEntry { time: at, event };
        if let Some(observer) = &mut self.observer {
            observer(&seen);
        }
        self.entries.push(seen);
    }

    /// Sets an observer, which receives all events from now on.
    pub(crate) fn set_observer(&mut self, observer: Observer) {
        self.observer = Some(observer);
    }

    pub(crate) fn entries(&self) -> &[LogEntry] {
        &self.entries
    }

    pub(crate) fn forgotten(&self) -> u64 {
        self.forgotten
    }
}
