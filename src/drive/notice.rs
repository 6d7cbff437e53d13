//! What is shown of a run while it runs.

use regrind_control::CycleRow;
use serde::Serialize;

use crate::cell::{Alarm, AlarmId, CompensationSummary, Device, Ending, Figures, Judgement};

/// Something that a person, or a program that reads lines of JSON, may want to know.
#[derive(Clone, Debug, Serialize)]
#[serde(tag = "notice", rename_all = "snake_case")]
#[allow(missing_docs)]
#[expect(clippy::large_enum_variant, reason = "notices are few, and never kept in numbers")]
pub enum Notice {
    /// The cell took an event in.
    State {
        state: String,
        cycle: u32,
        event: String,
        /// Whether a job of a machine is under way, of which progress is told.
        #[serde(skip)]
        at_job: bool,
    },
    /// The right part is to be loaded, and that to be confirmed.
    LoadPart,
    /// A machine cannot tell whether it is clear of the part: a person is to look, and to confirm it.
    AskWhetherClear { device: Device },
    /// What a person should know of a machine: what it waits for, which files were left alone and why.
    Note {
        device: Device,
        #[serde(rename = "words")]
        messages: Vec<String>,
    },
    /// A job goes on, and will take at least and at most so many seconds more.
    Progress {
        device: Device,
        cycle: u32,
        done: u32,
        total: u32,
        #[serde(skip_serializing_if = "Option::is_none")]
        left_s: Option<[f64; 2]>,
    },
    /// The points of a measurement came over the wire, in this time.
    Transferred { cycle: u32, points: usize, seconds: f64, ms_per_point: f64 },
    /// A measurement is registered.
    Figures { cycle: u32, figures: Figures },
    /// A cycle is judged.
    Judged(Judgement),
    /// The next correction is there.
    Compensated { cycle: u32, summary: CompensationSummary },
    /// A person must see this.
    Alarm(Alarm),
    /// This is over.
    AlarmGone { alarm: AlarmId },
    /// An order or an event did not fit.
    Refused { why: String },
    /// The journal or a file could not be written.
    RecordFailed {
        #[serde(rename = "words")]
        message: String,
    },
    /// The run is over.
    Finished {
        ending: Ending,
        cycles: Vec<CycleRow>,
        /// The touches of the part, and what the whole pattern would have taken; where touches were chosen.
        touches: Option<[usize; 2]>,
    },
}
