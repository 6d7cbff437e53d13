//! Requests to a running cell, and its replies.

use std::path::PathBuf;

use regrind_cell::{AlarmId, Device};
use regrind_document::misleading;
use serde::{Deserialize, Serialize};

use super::machine_status::MachineStatus;
use super::snapshot::Snapshot;

/// Request to a running cell: the order, with the machine that it concerns and a reason, which can be empty.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above them")]
#[serde(tag = "order", rename_all = "snake_case")]
pub enum Request {
    /// Order to move to the next safe position and wait.
    Hold {
        #[serde(default)]
        reason: String,
        /// Number of the state that the person saw, [`Snapshot::state_number`], if the order only states the reason of
        /// a hold. Such an order is refused in another state. An order without this number is never refused for it.
        #[serde(rename = "seen", default, skip_serializing_if = "Option::is_none")]
        state_number: Option<u64>,
    },
    /// Order to continue.
    Resume {
        #[serde(default)]
        reason: String,
        /// Number of the state that the person saw, [`Snapshot::state_number`]. An order that was meant for another
        /// state is refused.
        #[serde(rename = "seen", default)]
        state_number: Option<u64>,
    },
    /// Order to end in an orderly way.
    Stop {
        #[serde(default)]
        reason: String,
    },
    /// Order to end at once, with only the safe sequence.
    Abort {
        #[serde(default)]
        reason: String,
    },
    /// Confirmation that the right part is loaded and clamped, and that no machine touches it.
    Loaded,
    /// Confirmation of a person who checked a machine that cannot report it: the machine is clear of the part.
    Clear { device: Device },
    /// Confirmation of a person who checked a machine that cannot report the result of its job: the machine is at rest
    /// and clear of the part. `evidence` is what the person saw.
    Over { device: Device, evidence: String },
    /// Confirmation that the machine that a person operates has started its job.
    Started {
        /// Identity of the map that the machine uses: its first 8 hexadecimal digits, or more.
        #[serde(default)]
        map: Option<String>,
    },
    /// Confirmation that the machine that a person operates has ended its job and is clear of the part. The result of a
    /// measurement is given as a file.
    Done {
        /// Identity of the map that the machine used: its first 8 hexadecimal digits, or more.
        #[serde(default)]
        map: Option<String>,
        #[serde(default)]
        file: Option<PathBuf>,
    },
    /// Confirmation of a person who checked a machine that was ordered to hold or to stop: the machine is at rest. If
    /// `device` is `None`, the machine is that of the current job.
    Still {
        #[serde(default)]
        device: Option<Device>,
    },
    /// Remark for the record: an entry of a person in the log of the shift, or a note of a program that gives orders for
    /// people, such as the server of the web page. With `alarm`, the person acknowledges this active alarm: somebody has
    /// seen it and takes care. This clears nothing.
    Remark {
        #[serde(default)]
        what: String,
        #[serde(default, skip_serializing_if = "Option::is_none")]
        alarm: Option<AlarmId>,
    },
    /// Request for the preliminary touches of the present measurement, from the point with the index `from` on. The
    /// index counts the points of the part in the order of the measurement.
    Touches {
        #[serde(default)]
        from: u32,
    },
    /// Request for the status of both machines with the courses of their values.
    Machines,
    /// Request for the state of the cell once.
    Status,
    /// Request for the state of the cell now and after every change, until either end closes the connection.
    Watch,
}

/// Reply of a running cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    /// True if the order was accepted. It is not a verdict on the part.
    #[serde(rename = "taken", alias = "accepted")]
    pub accepted: bool,
    /// Reason of a refusal, or state of the cell after the order, for the person who gave the order.
    #[serde(rename = "words")]
    pub message: String,
    /// State of the cell after the request.
    pub status: Snapshot,
    /// Answer to [`Request::Touches`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub touches: Option<PreliminaryTouches>,
    /// Answer to [`Request::Machines`]: the measuring machine and the grinder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machines: Option<[MachineStatus; 2]>,
}

impl Reply {
    /// Returns a reply without touches and machines.
    pub fn new(accepted: bool, message: String, status: Snapshot) -> Self {
        Self { accepted, message, status, touches: None, machines: None }
    }
}

/// Touches of the part in a measurement that still runs, in the order of the measurement. They are for display only: no gate
/// has checked them, and they are not registered.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PreliminaryTouches {
    /// Cycle of the measurement.
    pub cycle: u32,
    /// Batch of the measurement: 0, or a higher number if touches were chosen or repeated.
    pub batch: u32,
    /// Index of the first point among the points of the part, from 0.
    pub first_index: u32,
    /// Place of each point, as it was planned: x and y in millimetres, model frame.
    pub places_mm: Vec<[f64; 2]>,
    /// Deviation of each point from its planned position, in micrometres; `None` if the probe found nothing.
    pub deviations_um: Vec<Option<f64>>,
}

impl PreliminaryTouches {
    /// Maximum number of points in one answer.
    pub const MAX_POINTS: usize = 4096;

    /// Returns the number of points that the probe found.
    pub fn found_count(&self) -> usize {
        self.deviations_um.iter().flatten().count()
    }
}

/// Person for whom a program gives an order.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OnBehalf {
    /// Name of the person, if the program knows it.
    #[serde(default)]
    pub name: Option<String>,
    /// Place of the person.
    pub station: String,
}

/// Request in the form of one JSON line on the socket, with the person for whom a program gives it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct RequestLine {
    #[serde(flatten)]
    pub(super) request: Request,
    #[serde(rename = "by", default, skip_serializing_if = "Option::is_none")]
    pub(super) on_behalf: Option<OnBehalf>,
}

impl RequestLine {
    /// Returns true if a text in the request contains characters that are invisible or change the reading direction.
    /// Such a text would look different from its content in the record.
    pub(super) fn has_misleading_text(&self) -> bool {
        let text = match &self.request {
            Request::Hold { reason, .. }
            | Request::Resume { reason, .. }
            | Request::Stop { reason }
            | Request::Abort { reason } => Some(reason),
            Request::Over { evidence, .. } => Some(evidence),
            Request::Remark { what, .. } => Some(what),
            _ => None,
        };
        let by = self.on_behalf.iter().flat_map(|by| by.name.iter().chain([&by.station]));
        text.into_iter().chain(by).any(|text| misleading(text).is_some())
    }
}
