//! What can be asked of a running cell, and what it answers.

use std::path::PathBuf;

use regrind_cell::Device;
use regrind_document::misleading;
use serde::{Deserialize, Serialize};

use super::snapshot::Snapshot;

/// What can be asked of a running cell: which machine it is about, and why, which may be empty.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above them")]
#[serde(tag = "order", rename_all = "snake_case")]
pub enum Request {
    /// Come to the next safe place and wait.
    Hold {
        #[serde(default)]
        reason: String,
    },
    /// Go on.
    Resume {
        #[serde(default)]
        reason: String,
        /// The state that the person saw, by [`Snapshot::number`]: an order that was meant for another one is refused.
        #[serde(default)]
        seen: Option<u64>,
    },
    /// End in order.
    Stop {
        #[serde(default)]
        reason: String,
    },
    /// End at once: the safe sequence only.
    Abort {
        #[serde(default)]
        reason: String,
    },
    /// The right part is loaded and clamped, and no machine touches it.
    Loaded,
    /// A machine that cannot tell it was looked at: it is clear of the part.
    Clear { device: Device },
    /// A machine that cannot tell what became of its job was looked at: it stands, clear of the part, and so it was seen.
    Over { device: Device, evidence: String },
    /// The machine that a person serves has begun its job.
    Started {
        /// Identity of the map that it works by: its first 8 hexadecimal digits, or more.
        #[serde(default)]
        map: Option<String>,
    },
    /// It has ended that job, and is clear of the part; a measurement came as a file.
    Done {
        /// Identity of the map that it worked by: its first 8 hexadecimal digits, or more.
        #[serde(default)]
        map: Option<String>,
        #[serde(default)]
        file: Option<PathBuf>,
    },
    /// A machine that was to hold or to stop was looked at: it stands still. Not named, it is that of the job under way.
    Still {
        #[serde(default)]
        device: Option<Device>,
    },
    /// A program that speaks for people wants something on record: who took control, what was refused.
    Remark { what: String },
    /// How is it?
    Status,
    /// How is it, now and after every change, until either end goes away.
    Watch,
}

/// What a running cell answers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    /// Whether the order was taken; of the part it says nothing.
    #[serde(alias = "accepted")]
    pub taken: bool,
    /// Why not, or what follows, for the person who asked.
    #[serde(rename = "words")]
    pub message: String,
    /// How the cell is after it.
    pub status: Snapshot,
}

/// For whom a program speaks that gives the orders of others.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct OnBehalf {
    /// Who the person is, where the program knows it.
    #[serde(default)]
    pub name: Option<String>,
    /// Where they are.
    pub station: String,
}

/// A line as it comes over the socket.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Line {
    #[serde(flatten)]
    pub(super) request: Request,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) by: Option<OnBehalf>,
}

impl Line {
    /// Whether a text in it reads otherwise than it is: it would be on record so, for years.
    pub(super) fn misleads(&self) -> bool {
        let text = match &self.request {
            Request::Hold { reason }
            | Request::Resume { reason, .. }
            | Request::Stop { reason }
            | Request::Abort { reason } => Some(reason),
            Request::Over { evidence, .. } => Some(evidence),
            Request::Remark { what } => Some(what),
            _ => None,
        };
        let by = self.by.iter().flat_map(|by| by.name.iter().chain([&by.station]));
        text.into_iter().chain(by).any(|text| misleading(text).is_some())
    }
}
