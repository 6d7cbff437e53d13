//! What a record of the journal tells: by what stands in it, whatever kind it stands as.
//!
//! A command that is answered stands as an intent and one that is not as a note; who reads them by their kind misses the half of
//! them. Every reader of records for people begins here.

use serde_json::Value;

use regrind_cell::{Command, Device, Ending, Event};
use regrind_journal::{Kind, Record};

/// What a record tells. Values are as they stand in the record.
#[derive(Debug)]
pub(super) enum Told {
    /// The run began.
    Begun(Value),
    /// The journal was opened again.
    OpenedAgain,
    /// The cell commanded.
    Command(Box<Command>),
    /// The cell took an event in.
    Event(Box<Event>),
    /// What became of a command.
    Answer(String),
    /// A person's word about a machine that cannot tell it itself.
    Word(Device, Value),
    /// A step that a person gave a machine to bring it home.
    Step(Device, Value),
    /// Words of a machine.
    Remarks(Device, Vec<String>),
    /// What a program that speaks for people had to have on record.
    Remark(String),
    /// What a grinder tells of a pass.
    Pass(Value),
    /// How points came over the wire.
    Transfer(Value),
    /// A file of the run.
    File(Value),
    /// The record was signed.
    Seal(Value),
    /// The end of a run.
    End(Ending, Value),
    /// The end of a recovery: whether each machine is home.
    Home([bool; 2]),
    /// What this version of the program cannot read.
    Unknown,
}

impl Told {
    /// Reads a record.
    pub(super) fn of(record: &Record) -> Self {
        let value = record.value();
        let told = match record.kind {
            Kind::Begin => Some(Self::Begun(value.clone())),
            Kind::Reopen => Some(Self::OpenedAgain),
            Kind::Artefact => Some(Self::File(value.clone())),
            Kind::Seal => Some(Self::Seal(value.clone())),
            Kind::Event => serde_json::from_value(value.clone()).ok().map(|event| Self::Event(Box::new(event))),
            Kind::Outcome => {
                let event = value["event"].as_str().map(|event| event.replace('_', " "));
                event.or_else(|| value["found"].as_str().map(str::to_owned)).map(Self::Answer)
            }
            Kind::Intent | Kind::Note => Self::of_command_or_note(&value),
            Kind::End => Self::of_end(&value["ending"]),
        };
        told.unwrap_or(Self::Unknown)
    }

    fn of_command_or_note(value: &Value) -> Option<Self> {
        let device = || serde_json::from_value::<Device>(value["device"].clone()).ok();
        if value["command"].is_string() {
            let command = serde_json::from_value(value.clone()).ok()?;
            return Some(Self::Command(Box::new(command)));
        }
        if value["recover"].is_string() {
            return Some(Self::Step(device()?, value.clone()));
        }
        if value["confirmed"].is_string() {
            return Some(Self::Word(device()?, value.clone()));
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

    fn of_end(value: &Value) -> Option<Self> {
        if let (Some(cmm), Some(grinder)) = (value["cmm_home"].as_bool(), value["grinder_home"].as_bool()) {
            return Some(Self::Home([cmm, grinder]));
        }
        // The drive puts the ending beside the figures of all cycles.
        let ending = value.get("ending").filter(|inner| inner.is_object()).unwrap_or(value);
        let ending = serde_json::from_value(ending.clone()).ok()?;
        Some(Self::End(ending, value["cycles"].clone()))
    }
}
