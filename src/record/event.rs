//! Events and commands of the cell with what only the record has, and the answers to commands.

use regrind_cell::{Command, Device, Event};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::Value;

/// Event with the detail that only the record has.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EventRecord {
    /// Event.
    #[serde(flatten)]
    pub event: Event,
    /// Detail from the machine; `None` for most events.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detail: Option<EventDetail>,
}

/// Detail of an event.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum EventDetail {
    /// Prepared job, of `Prepared`. It is the first in this list, because [`EventDetail::Start`] has one of its keys.
    Preparation(StartIntent),
    /// Machine that was connected, of `Connected`.
    Machine {
        /// Name that the machine reported.
        name: String,
        /// Address of the machine.
        address: String,
    },
    /// Payload that was loaded, of `PassLoaded` and `PlanLoaded`.
    Payload {
        /// Digest of the payload, in 8 hexadecimal digits.
        digest: String,
    },
    /// Job that was started, of `Started`.
    Start {
        /// Sequence number of the START.
        start_sequence: u32,
    },
    /// Detail that this version of the program does not know.
    Other(Value),
}

/// Prepared START. With it, the outcome of the job can be asked after a crash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StartIntent {
    /// Number of the run.
    pub job: u32,
    /// Number of the cycle and of its batch of touches, in the form in which the machine has it.
    pub cycle: u16,
    /// Digest of the payload.
    pub digest: u32,
    /// Sequence number of the START.
    pub start_sequence: u32,
    /// One-time token of the machine; 0 if its protocol has none.
    pub token: u32,
    /// Identity of this start of the machine's application.
    pub boot_id: u32,
}

/// Command with the job that it starts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CommandRecord {
    /// Command.
    #[serde(flatten)]
    pub command: Command,
    /// Prepared job of `StartMachine`. The key is then always present, and null if nothing was prepared.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "present")]
    pub intent: Option<Option<StartIntent>>,
}

impl CommandRecord {
    /// Creates the content for `command`. `prepared` is the last prepared job of the CMM and of the grinder, in this
    /// order.
    pub fn new(command: Command, prepared: [Option<StartIntent>; 2]) -> Self {
        let intent = match &command {
            Command::StartMachine { device: Device::Cmm, .. } => Some(prepared[0]),
            Command::StartMachine { device: Device::Grinder, .. } => Some(prepared[1]),
            _ => None,
        };
        Self { command, intent }
    }
}

/// Deserializes a key that is present, so that null differs from a missing key.
fn present<'de, T: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// Result of a command or of a recovery step.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Answer {
    /// Event that answered the command.
    Event {
        /// Name of the event, such as `cleared`.
        event: String,
    },
    /// State of a machine after a recovery step.
    Found {
        /// State in words, or the error.
        found: String,
    },
}
