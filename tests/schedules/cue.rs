//! Cues: moments that faults wait for. A fault that is drawn for the start of a machine, for example, then occurs
//! exactly at that start.

use std::sync::Arc;
use std::time::Duration;

use rand::RngExt as _;
use rand::rngs::StdRng;
use regrind_sim::command::State;
use regrind_sim::event_log::HandshakeEvent;
use serde_json::Value;
use tokio::sync::watch;

/// Kind of moment at which a specific fault is possible.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cue {
    /// A payload is in force.
    Loaded,
    Prepared,
    /// A START is on record.
    StartOnRecord,
    /// A START leaves the program.
    StartSent,
    /// A machine begins its job.
    Begins,
    Holding,
    Held,
    Complete,
    /// An order of a person is on record.
    Ordered,
    LinkLost,
    LinkBack,
}

impl Cue {
    pub const ALL: [Self; 11] = [
        Self::Loaded,
        Self::Prepared,
        Self::StartOnRecord,
        Self::StartSent,
        Self::Begins,
        Self::Holding,
        Self::Held,
        Self::Complete,
        Self::Ordered,
        Self::LinkLost,
        Self::LinkBack,
    ];

    /// Returns the cue of a record, if it is one.
    fn recorded(payload: &Value) -> Option<Self> {
        Some(match (payload["event"].as_str(), payload["command"].as_str()) {
            (Some("pass_loaded" | "plan_loaded"), _) => Self::Loaded,
            (Some("prepared"), _) => Self::Prepared,
            (Some("hold" | "resume" | "stop" | "abort"), _) => Self::Ordered,
            (Some("link_lost"), _) => Self::LinkLost,
            (Some("link_back"), _) => Self::LinkBack,
            (_, Some("start_machine")) => Self::StartOnRecord,
            _ => return None,
        })
    }

    /// Returns the cue of a machine's action, if it is one.
    fn done(what: &HandshakeEvent) -> Option<Self> {
        Some(match what {
            HandshakeEvent::Began { .. } => Self::Begins,
            HandshakeEvent::Changed { to: State::Holding, .. } => Self::Holding,
            HandshakeEvent::Changed { to: State::Held, .. } => Self::Held,
            HandshakeEvent::Changed { to: State::Complete, .. } => Self::Complete,
            _ => return None,
        })
    }
}

/// Time of an event.
#[derive(Clone, Copy, Debug)]
pub enum When {
    At(Duration),
    /// This long after the n-th moment of a kind.
    After(Cue, u32, Duration),
}

impl When {
    /// Draws a time in a run of this many seconds, or one of the first moments of a kind.
    pub fn drawn(chance: &mut StdRng, span_s: f64) -> Self {
        if chance.random::<f64>() < 0.5 {
            return Self::At(Duration::from_secs_f64(span_s * chance.random::<f64>()));
        }
        let cue = Cue::ALL[chance.random_range(0..Cue::ALL.len())];
        Self::After(cue, chance.random_range(1..=5), Duration::ZERO).and_soon(chance)
    }

    /// Draws another time, about as late.
    pub fn and_soon(self, chance: &mut StdRng) -> Self {
        let pause = if chance.random::<f64>() < 0.3 { Duration::ZERO } else { any_length(chance, 3.0) };
        match self {
            Self::At(at) => Self::At(at + pause),
            Self::After(cue, nth, _) => Self::After(cue, nth, pause),
        }
    }
}

/// Draws a duration up to this many seconds; some milliseconds are as likely as some seconds.
pub fn any_length(chance: &mut StdRng, max_s: f64) -> Duration {
    Duration::from_secs_f64(1e-3 * (1e3 * max_s).powf(chance.random::<f64>()))
}

/// Counters of the moments of each kind, for tasks that wait for one.
#[derive(Clone, Debug)]
pub struct Cues(Arc<watch::Sender<[u32; Cue::ALL.len()]>>);

impl Cues {
    pub fn new() -> Self {
        Self(Arc::new(watch::Sender::new([0; Cue::ALL.len()])))
    }

    pub fn see_record(&self, payload: &Value) {
        self.give(Cue::recorded(payload));
    }

    pub fn see_machine(&self, what: &HandshakeEvent) {
        self.give(Cue::done(what));
    }

    /// Counts a START that leaves the program.
    pub fn see_start(&self) {
        self.give(Some(Cue::StartSent));
    }

    /// Counts the beginning of a job on a machine that knows no jobs.
    pub fn begin(&self) {
        self.give(Some(Cue::Begins));
    }

    fn give(&self, cue: Option<Cue>) {
        if let Some(cue) = cue {
            self.0.send_modify(|counts| counts[cue as usize] += 1);
        }
    }

    /// Waits until the given time.
    pub async fn wait(&self, when: When) {
        match when {
            When::At(at) => tokio::time::sleep(at).await,
            When::After(cue, nth, pause) => {
                let mut counts = self.0.subscribe();
                // The counter lives as long as `self`.
                let _ = counts.wait_for(|counts| counts[cue as usize] >= nth).await;
                // Without a pause, the fault occurs before anything else happens.
                if !pause.is_zero() {
                    tokio::time::sleep(pause).await;
                }
            }
        }
    }
}
