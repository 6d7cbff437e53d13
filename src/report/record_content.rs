//! Content of a record of the journal. The fields of a command or a note decide what it is, not the kind of the record.
//!
//! A command that is answered is recorded as an intent, a command that is not answered as a note. A reader that looks
//! only at one kind misses half of the commands. All readers of records for people use this module.

use serde_json::Value;

use regrind_cell::{Command, Device, Ending, Event};
use regrind_journal::{Record, RecordKind};

/// Content of a record. Values are the same as in the record.
#[derive(Debug)]
pub(super) enum RecordContent {
    /// Start of the run.
    Begun(Value),
    /// Reopening of the journal.
    Reopened,
    /// Command of the cell.
    Command(Box<Command>),
    /// Event that the cell processed.
    Event(Box<Event>),
    /// Result of a command.
    Answer(String),
    /// Confirmation by a person of the state of a machine that cannot report it itself.
    Confirmation(Device, Value),
    /// Step that a person ordered, by which a machine is brought home.
    Step(Device, Value),
    /// Messages of a machine.
    Remarks(Device, Vec<String>),
    /// Remark of a user interface, such as the page of the cell.
    Remark(String),
    /// Report of a grinder about a pass.
    Pass(Value),
    /// Description of the transfer of points over the network.
    Transfer(Value),
    /// File of the run.
    File(Value),
    /// Signature of the record.
    Seal(Value),
    /// End of a run.
    End(Ending, Value),
    /// End of a recovery: for each machine, true if it is home.
    Home([bool; 2]),
    /// Content that this version of the program cannot read.
    Unknown,
}

impl RecordContent {
    /// Interprets a record of the journal. Returns [`Self::Unknown`] if this version of the program cannot read the
    /// content.
    pub(super) fn from_record(record: &Record) -> Self {
        let value = record.value();
        let told = match record.kind {
            RecordKind::Begin => Some(Self::Begun(value.clone())),
            RecordKind::Reopen => Some(Self::Reopened),
            RecordKind::Artefact => Some(Self::File(value.clone())),
            RecordKind::Seal => Some(Self::Seal(value.clone())),
            RecordKind::Event => serde_json::from_value(value.clone()).ok().map(|event| Self::Event(Box::new(event))),
            RecordKind::Outcome => {
                let event = value["event"].as_str().map(|event| event.replace('_', " "));
                event.or_else(|| value["found"].as_str().map(str::to_owned)).map(Self::Answer)
            }
            RecordKind::Intent | RecordKind::Note => Self::from_command_or_note(&value),
            RecordKind::End => Self::from_end(&value["ending"]),
        };
        told.unwrap_or(Self::Unknown)
    }

    fn from_command_or_note(value: &Value) -> Option<Self> {
        let device = || serde_json::from_value::<Device>(value["device"].clone()).ok();
        if value["command"].is_string() {
            let command = serde_json::from_value(value.clone()).ok()?;
            return Some(Self::Command(Box::new(command)));
        }
        if value["recover"].is_string() {
            return Some(Self::Step(device()?, value.clone()));
        }
        if value["confirmed"].is_string() {
            return Some(Self::Confirmation(device()?, value.clone()));
        }
        if let Some(remarks) = value["notes"].as_array() {
            let remarks = remarks.iter().filter_map(Value::as_str).map(str::to_owned).collect();
            return Some(Self::Remarks(device()?, remarks));
        }
        if let Some(remark) = value["remark"].as_str() {
            return Some(Self::Remark(remark.to_owned()));
        }
        let inner = |key: &str| Some(value[key].clone()).filter(Value::is_object);
        inner("pass_record").map(Self::Pass).or_else(|| inner("transfer").map(Self::Transfer))
    }

    fn from_end(value: &Value) -> Option<Self> {
        if let (Some(cmm), Some(grinder)) = (value["cmm_home"].as_bool(), value["grinder_home"].as_bool()) {
            return Some(Self::Home([cmm, grinder]));
        }
        // The driver loop writes the ending together with the figures of all cycles.
        let ending = value.get("ending").filter(|inner| inner.is_object()).unwrap_or(value);
        let ending = serde_json::from_value(ending.clone()).ok()?;
        Some(Self::End(ending, value["cycles"].clone()))
    }
}
