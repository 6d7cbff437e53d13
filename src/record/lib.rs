//! Content of the records of a run: one type for each kind of content, with the keys that the record has had since its
//! first version.
//!
//! All writers make the payload of a record from these types, and all readers of this program read payloads by them.
//! docs/journal.md is the contract for others. A content of an earlier version is read too: its missing keys are
//! `None`. A payload without a key that this version knows is [`Content::Unknown`], with its text; a known key with a
//! value that this version does not know is an error.

mod begin;
mod content;
mod end;
mod event;
mod note;

pub use begin::{MeasuringStrategy, PartStart, PreviousRun, RecordedPlan, RecoveryStart, RunContent, begin_of};
pub use content::Content;
pub use end::{PartEnd, RecoveryEnd, RunEnd, TouchCounts};
pub use event::{Answer, CommandRecord, EventDetail, EventRecord, StartIntent};
pub use note::{Confirmation, MachineNotes, PassFigures, PassNote, RecoveryOrder, Remark, Transfer, TransferNote};
pub use regrind_journal::{Artefact, Begin, End, KeyField, Reopen, Seal};
