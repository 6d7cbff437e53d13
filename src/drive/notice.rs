//! Notices that a run sends for display while it is in progress.

use regrind_control::CycleRow;
use serde::Serialize;

use crate::cell::{Alarm, AlarmId, CompensationSummary, Device, Ending, Figures, Judgement};

/// Message for a person, or for a program that reads lines of JSON.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "notice", rename_all = "snake_case")]
#[allow(missing_docs)]
#[expect(clippy::large_enum_variant, reason = "notices are few, and never kept in numbers")]
pub enum Notice {
    /// The cell handled an event.
    State {
        state: String,
        cycle: u32,
        event: String,
        /// True if a job of a machine with a progress report is in progress.
        #[serde(skip)]
        has_progress: bool,
    },
    /// The right part must be loaded, and the loading confirmed.
    LoadPart,
    /// A machine cannot report whether it is clear of the part: a person must check and confirm it.
    AskWhetherClear { device: Device },
    /// Information about a machine for a person: why it waits, which files it ignored and why.
    Note {
        device: Device,
        #[serde(rename = "words")]
        messages: Vec<String>,
    },
    /// A job makes progress. `left_s` is the minimum and the maximum of the remaining time, in s.
    Progress {
        device: Device,
        cycle: u32,
        done: u32,
        total: u32,
        #[serde(skip_serializing_if = "Option::is_none")]
        #[serde(rename = "left_s")]
        remaining_s: Option<[f64; 2]>,
    },
    /// The points of a measurement were transferred in `seconds`.
    Transferred { cycle: u32, points: usize, seconds: f64, ms_per_point: f64 },
    /// A measurement is registered.
    Figures { cycle: u32, figures: Figures },
    /// A cycle is judged.
    Judged(Judgement),
    /// The next correction is ready.
    Compensated { cycle: u32, summary: CompensationSummary },
    /// A new alarm for a person.
    Alarm(Alarm),
    /// An alarm is gone.
    AlarmGone { alarm: AlarmId },
    /// An order or an event did not fit the state.
    Refused {
        #[serde(rename = "why")]
        reason: String,
    },
    /// The journal or a file could not be written.
    RecordFailed {
        #[serde(rename = "words")]
        message: String,
    },
    /// The run is over.
    Finished {
        ending: Ending,
        cycles: Vec<CycleRow>,
        /// Number of touches of the part, and number of touches of the whole pattern in all measurements. `None` if the
        /// measurement is not adaptive.
        touches: Option<[usize; 2]>,
    },
}
