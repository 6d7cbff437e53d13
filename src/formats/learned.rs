//! What a finished run knows of the grinder, kept for the next part of the same kind.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::compensation::{Correction, Knowledge};

/// The file in a run folder.
pub const LEARNED: &str = "learned.json";
/// A file larger than this is none of ours.
const MOST_BYTES: u64 = 256 << 20;

/// The correction that took back what comes in every pass, and how well it is known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    /// Whether the passes were simulated.
    pub simulation: bool,
    /// What the passes had in common; a run with another of these learns nothing from it.
    pub setting: String,
    /// The run that it was learned in.
    pub run: String,
    /// The correction that the next pass of that part would have had.
    pub correction: Correction,
    /// How well it is known.
    pub known: Knowledge,
}

/// Why nothing is learned from a file.
#[derive(Debug, Error)]
#[allow(missing_docs)]
pub enum LearnedError {
    #[error("{path}: {source}")]
    Unreadable { path: PathBuf, source: std::io::Error },
    #[error("{path}: {bytes} bytes, more than the {MOST_BYTES} of any run; it is not one that Regrind wrote")]
    TooLarge { path: PathBuf, bytes: u64 },
    #[error("{path}: {why}; remove it, or copy the run again from its archive")]
    Broken { path: PathBuf, why: String },
}

impl Learned {
    /// Reads what a run left; `None` where it left nothing.
    ///
    /// # Errors
    /// A file that cannot be read, or whose numbers cannot be.
    pub fn read(run: &Path) -> Result<Option<Self>, LearnedError> {
        let path = run.join(LEARNED);
        let bytes = match std::fs::metadata(&path) {
            Ok(metadata) => metadata.len(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(LearnedError::Unreadable { path, source }),
        };
        if bytes > MOST_BYTES {
            return Err(LearnedError::TooLarge { path, bytes });
        }
        let text = match std::fs::read(&path) {
            Ok(text) => text,
            Err(source) => return Err(LearnedError::Unreadable { path, source }),
        };
        let learned: Self = match serde_json::from_slice(&text) {
            Ok(learned) => learned,
            Err(error) => return Err(LearnedError::Broken { path, why: error.to_string() }),
        };
        match learned.flaw() {
            None => Ok(Some(learned)),
            Some(why) => Err(LearnedError::Broken { path, why }),
        }
    }

    /// What in it cannot be.
    fn flaw(&self) -> Option<String> {
        let Correction { net, values_mm, level_mm, .. } = &self.correction;
        let numbers = [net.first_mm, net.spacing_mm].concat();
        if values_mm.len() != net.len() || net.is_empty() {
            return Some(format!("{} values on a net of {} x {} nodes", values_mm.len(), net.columns, net.rows));
        }
        if !values_mm.iter().chain(&numbers).all(|v| v.is_finite())
            || !level_mm.is_finite()
            || net.spacing_mm.iter().any(|s| *s <= 0.0)
        {
            return Some("a number of its correction is not finite, or its spacing not above 0".into());
        }
        (!self.known.is_sound()).then(|| "a number of what it knows of the grinder cannot be".into())
    }

    /// Returns the correction of the first pass of another part: what came back in every pass of this one, on the net of `none`.
    pub fn first_correction(&self, none: Correction) -> Correction {
        let values_mm = (0..none.net.len()).map(|k| self.correction.at(none.net.place_mm(k))).collect();
        Correction { values_mm, ..none }
    }
}
