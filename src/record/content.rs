//! Content of a record, of any kind.
//!
//! The keys of a payload decide the content, not only the kind of the record: a command that is answered is recorded as
//! an intent, a command that is not answered as a note. A reader of one kind alone misses half of the commands.

use regrind_journal::{Artefact, Begin, End, Entry, Record, RecordKind, Reopen, Seal};
use serde_json::Value;

use super::begin::RunContent;
use super::end::RunEnd;
use super::event::{Answer, CommandRecord, EventRecord};
use super::note::{Confirmation, MachineNotes, PassNote, RecoveryOrder, Remark, TransferNote};

/// Content of a record.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// Start of a run.
    Begin(Box<Begin<RunContent>>),
    /// Further opening of the journal, after a crash or a hold.
    Reopen(Reopen),
    /// Event that the cell received.
    Event(Box<EventRecord>),
    /// Command of the cell. It is recorded as an intent if an event answers it, otherwise as a note.
    Command(Box<CommandRecord>),
    /// Step by which a person brings a machine to idle.
    Recovery(RecoveryOrder),
    /// Result of a command or of a recovery step.
    Answer(Answer),
    /// File of the run folder.
    Artefact(Artefact),
    /// Confirmation of a person about a machine that cannot report its own state.
    Confirmation(Confirmation),
    /// Messages of a machine for people.
    MachineNotes(MachineNotes),
    /// Remark of a program that gives orders for people.
    Remark(Remark),
    /// Report of the grinder about a pass.
    Pass(PassNote),
    /// Duration of the transfer of the points of a measurement.
    Transfer(TransferNote),
    /// Signature of the records before.
    Seal(Seal),
    /// End of a run.
    End(Box<End<RunEnd>>),
    /// Content that this version of the program does not know.
    Unknown(Value),
}

impl Content {
    /// Reads the content of a record. Returns [`Content::Unknown`] for an intent, an outcome or a note without a key
    /// that this version knows.
    ///
    /// # Errors
    /// The payload is not JSON, or it has a known key but not the content that belongs to this key.
    pub fn read(record: &Record) -> Result<Self, serde_json::Error> {
        Self::from_payload(record.kind, serde_json::from_str(&record.payload)?)
    }

    /// Reads the content of a record from its kind and its payload. Returns [`Content::Unknown`] for an intent, an
    /// outcome or a note without a key that this version knows.
    ///
    /// # Errors
    /// The payload has a known key, but not the content that belongs to this key.
    pub fn from_payload(kind: RecordKind, payload: Value) -> Result<Self, serde_json::Error> {
        use serde_json::from_value as read;
        let has = |key: &str| payload.get(key).is_some_and(|value| !value.is_null());
        Ok(match kind {
            RecordKind::Begin => Self::Begin(read(payload)?),
            RecordKind::Reopen => Self::Reopen(read(payload)?),
            RecordKind::Event => Self::Event(read(payload)?),
            RecordKind::Artefact => Self::Artefact(read(payload)?),
            RecordKind::Seal => Self::Seal(read(payload)?),
            RecordKind::End => Self::End(read(payload)?),
            RecordKind::Outcome if has("event") || has("found") => Self::Answer(read(payload)?),
            RecordKind::Outcome => Self::Unknown(payload),
            RecordKind::Intent | RecordKind::Note if has("command") => Self::Command(read(payload)?),
            RecordKind::Intent | RecordKind::Note if has("recover") => Self::Recovery(read(payload)?),
            RecordKind::Intent | RecordKind::Note if has("confirmed") => Self::Confirmation(read(payload)?),
            RecordKind::Intent | RecordKind::Note if has("notes") => Self::MachineNotes(read(payload)?),
            RecordKind::Intent | RecordKind::Note if has("remark") => Self::Remark(read(payload)?),
            RecordKind::Intent | RecordKind::Note if has("pass_record") => Self::Pass(read(payload)?),
            RecordKind::Intent | RecordKind::Note if has("transfer") => Self::Transfer(read(payload)?),
            RecordKind::Intent | RecordKind::Note => Self::Unknown(payload),
        })
    }

    /// Returns the kind of the record that has this content.
    pub fn kind(&self) -> RecordKind {
        match self {
            Self::Begin(_) => RecordKind::Begin,
            Self::Reopen(_) => RecordKind::Reopen,
            Self::Event(_) => RecordKind::Event,
            Self::Command(record) if record.command.expects_answer() => RecordKind::Intent,
            Self::Recovery(_) => RecordKind::Intent,
            Self::Answer(_) => RecordKind::Outcome,
            Self::Artefact(_) => RecordKind::Artefact,
            Self::Seal(_) => RecordKind::Seal,
            Self::End(_) => RecordKind::End,
            Self::Command(_)
            | Self::Confirmation(_)
            | Self::MachineNotes(_)
            | Self::Remark(_)
            | Self::Pass(_)
            | Self::Transfer(_)
            | Self::Unknown(_) => RecordKind::Note,
        }
    }

    /// Returns the payload of a record with this content.
    pub fn payload(&self) -> Value {
        let payload = match self {
            Self::Begin(content) => serde_json::to_value(content),
            Self::Reopen(content) => serde_json::to_value(content),
            Self::Event(content) => serde_json::to_value(content),
            Self::Command(content) => serde_json::to_value(content),
            Self::Recovery(content) => serde_json::to_value(content),
            Self::Answer(content) => serde_json::to_value(content),
            Self::Artefact(content) => serde_json::to_value(content),
            Self::Confirmation(content) => serde_json::to_value(content),
            Self::MachineNotes(content) => serde_json::to_value(content),
            Self::Remark(content) => serde_json::to_value(content),
            Self::Pass(content) => serde_json::to_value(content),
            Self::Transfer(content) => serde_json::to_value(content),
            Self::Seal(content) => serde_json::to_value(content),
            Self::End(content) => serde_json::to_value(content),
            Self::Unknown(value) => Ok(value.clone()),
        };
        // Does not fail: all keys are texts, and a number that is not finite is null.
        payload.unwrap_or_default()
    }

    /// Creates the entry with this content for the journal. `mono_ns` is the time since the run began, in nanoseconds.
    /// `cycle` is the number of the cycle, 0 before the first. `actor` and `station` name the person or the machine that
    /// caused the content, and its place.
    pub fn entry(&self, mono_ns: u64, cycle: u32, (actor, station): (String, String)) -> Entry {
        Entry { actor, station, ..Entry::new(self.kind(), mono_ns, cycle, self.payload()) }
    }
}
