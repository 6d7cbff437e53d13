//! Record of a run on a disk with simulated faults: temporarily full, slow, or with writes that succeed but report
//! failure.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::drive::JournalSink;
use regrind::journal::{Anchor, Artefact, Entry, Journal, JournalError};
use serde_json::{Value, json};
use tokio::time::Instant;

use crate::cue::Cues;
use crate::life::Life;

/// Behaviour of the disk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disk {
    /// Share of the writes that find no room, or fail.
    pub failing_share: f64,
    /// Share of the writes that succeed but are reported as failed.
    pub unknown_share: f64,
    /// Share of the slow writes.
    pub slow_share: f64,
    /// Longest duration of a slow write.
    pub slow: Duration,
}

impl Disk {
    pub const SOUND: Self = Self { failing_share: 0.0, unknown_share: 0.0, slow_share: 0.0, slow: Duration::ZERO };
}

/// Disk that all lives of the program share.
#[derive(Clone)]
pub struct SharedDisk(Arc<Mutex<(Disk, StdRng)>>);

impl SharedDisk {
    pub fn new(seed: u64) -> Self {
        Self(Arc::new(Mutex::new((Disk::SOUND, StdRng::seed_from_u64(seed)))))
    }

    pub fn set(&self, disk: Disk) {
        self.0.lock().unwrap().0 = disk;
    }

    /// Returns the duration of the next write.
    pub fn write_takes(&self) -> Duration {
        let (disk, chance) = &mut *self.0.lock().unwrap();
        let usual = Duration::from_micros(chance.random_range(100..4000));
        if chance.random::<f64>() < disk.slow_share { disk.slow.mul_f64(chance.random()) } else { usual }
    }

    /// Draws the outcome of the next write.
    fn fate(&self) -> Fate {
        let (disk, chance) = &mut *self.0.lock().unwrap();
        let drawn = chance.random::<f64>();
        if drawn < disk.failing_share {
            Fate::Fails
        } else if drawn < disk.failing_share + disk.unknown_share {
            Fate::Unknown
        } else {
            Fate::Written
        }
    }
}

enum Fate {
    Written,
    Fails,
    Unknown,
}

/// Record in the journal, with its time.
#[derive(Clone, Debug)]
pub struct Recorded {
    pub at: Instant,
    pub payload: Value,
}

/// Records of all lives, in order.
pub type Written = Arc<Mutex<Vec<Recorded>>>;

/// Journal in a life of the program.
pub struct LifeJournal {
    journal: SharedJournal,
    folder: PathBuf,
    disk: SharedDisk,
    life: Arc<Life>,
    written: Written,
    cues: Cues,
    /// Write that succeeded without acknowledgement, by the text given, until the same text is given again.
    untold: Option<(String, u64)>,
}

/// Journal that is dropped with its life: tasks of a dead life can neither write it nor keep its lock.
pub type SharedJournal = Arc<Mutex<Option<Journal>>>;

impl LifeJournal {
    pub fn new(journal: Journal, disk: &SharedDisk, life: &Arc<Life>, written: &Written, cues: &Cues) -> Self {
        let folder = journal.folder().to_owned();
        let journal = Arc::new(Mutex::new(Some(journal)));
        let (disk, life, written, cues) = (disk.clone(), life.clone(), written.clone(), cues.clone());
        Self { journal, folder, disk, life, written, cues, untold: None }
    }

    /// Returns the journal, so that it can be taken from a life that is over.
    pub fn shared(&self) -> SharedJournal {
        self.journal.clone()
    }

    fn failed<T>(&self, kind: io::ErrorKind) -> Result<T, JournalError> {
        Err(JournalError::File { path: self.folder.clone(), action: "writing it", source: kind.into() })
    }

    /// Writes something if the disk allows it. `text` identifies it.
    fn write(
        &mut self,
        text: String,
        payload: Value,
        write: impl FnOnce(&mut Journal) -> Result<u64, JournalError>,
    ) -> Result<u64, JournalError> {
        if !self.life.passes() {
            return self.failed(io::ErrorKind::BrokenPipe);
        }
        if let Some((_, number)) = self.untold.take_if(|(untold, _)| *untold == text) {
            return Ok(number);
        }
        let fate = self.disk.fate();
        if matches!(fate, Fate::Fails) {
            return self.failed(io::ErrorKind::StorageFull);
        }
        let number = {
            let mut journal = self.journal.lock().unwrap();
            let Some(journal) = journal.as_mut() else { return self.failed(io::ErrorKind::BrokenPipe) };
            write(journal)?
        };
        self.cues.see_record(&payload);
        self.written.lock().unwrap().push(Recorded { at: Instant::now(), payload });
        if !self.life.passes() {
            return self.failed(io::ErrorKind::BrokenPipe);
        }
        if matches!(fate, Fate::Unknown) {
            self.untold = Some((text, number));
            return self.failed(io::ErrorKind::Other);
        }
        Ok(number)
    }
}

fn text_of(entry: &Entry) -> String {
    format!("{} {} {}", entry.kind.as_str(), entry.mono_ns, entry.payload)
}

impl JournalSink for LifeJournal {
    fn folder(&self) -> &Path {
        &self.folder
    }

    fn append(&mut self, entry: Entry) -> Result<u64, JournalError> {
        self.write(text_of(&entry), entry.payload.clone(), |journal| journal.append(entry))
    }

    fn intend(&mut self, entry: Entry) -> Result<u32, JournalError> {
        let id = self.write(text_of(&entry), entry.payload.clone(), |journal| journal.intend(entry).map(u64::from))?;
        Ok(id as u32)
    }

    fn adopt_known(&mut self, found: Artefact, mono_ns: u64, cycle: u32) -> Result<Artefact, JournalError> {
        let (text, given) = (format!("file {}", found.name), found.clone());
        self.write(text, Value::Null, |journal| journal.adopt_known(given, mono_ns, cycle).map(|_| 0))?;
        Ok(found)
    }

    fn end(&mut self, mono_ns: u64, cycle: u32, ending: Value) -> Result<Anchor, JournalError> {
        let mut anchor = None;
        let ended = self.write("end".into(), json!("end"), |journal| {
            anchor = Some(journal.end(mono_ns, cycle, ending.clone())?);
            Ok(0)
        });
        match (ended, anchor) {
            (Ok(_), Some(anchor)) => Ok(anchor),
            // Already written, without acknowledgement.
            (Ok(_), None) => {
                self.journal.lock().unwrap().as_mut().map_or_else(
                    || self.failed(io::ErrorKind::BrokenPipe),
                    |journal| journal.end(mono_ns, cycle, ending),
                )
            }
            (Err(error), _) => Err(error),
        }
    }
}
