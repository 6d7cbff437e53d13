//! Proofs of runs, and the cache of the recent ones.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use regrind_journal::Verified;
use tokio::sync::Semaphore;

/// Time for which a proof stays valid. The copy in the database can change at any time.
const LASTS: Duration = Duration::from_secs(60);
/// Maximum number of proofs in the cache.
const KEPT: usize = 16;

/// Result of a proof.
pub(super) struct Proof {
    /// Time of the proof, UTC.
    pub(super) at: String,
    /// Result of the verification; otherwise a text that says why the copy is not trustworthy.
    pub(super) outcome: Result<Verified, String>,
    /// Number of keys that the plant has for the cell.
    pub(super) keys: usize,
    /// Figures that the cell reported and that differ from those of the copy.
    pub(super) differences: Vec<String>,
    /// Report of the run, and its results as QIF and as DFQ; otherwise a text why there are none.
    pub(super) report: Result<String, String>,
    pub(super) qif: Result<String, String>,
    pub(super) dfq: Result<String, String>,
}

impl Proof {
    /// Returns true if a key that is enrolled for the cell signed the copy to its end. Nobody but the cell can then have
    /// written it. A copy without this can still be unbroken.
    pub(super) fn is_signed_to_end(&self) -> bool {
        let is_signed =
            |found: &Verified| found.closed && found.signed > 0 && !found.keys.is_empty() && !found.lacks_last_seal();
        self.keys > 0 && self.outcome.as_ref().is_ok_and(is_signed)
    }
}

type Known = HashMap<i32, (Instant, String, Arc<Proof>)>;

/// Cache of recent proofs.
pub(super) struct Proofs {
    known: Mutex<Known>,
    /// Permit to make a proof. Only one proof is made at a time.
    pub(super) turn: Semaphore,
}

impl Default for Proofs {
    fn default() -> Self {
        Self { known: Mutex::default(), turn: Semaphore::new(1) }
    }
}

impl Proofs {
    /// Returns the stored result of a verification of the run `id`. `head` is the hash of the last record that the
    /// plant has of this run. Returns `None` if there is no result from the last 60 s, or if the stored result is for
    /// another `head`.
    pub(super) fn known(&self, id: i32, head: &str) -> Option<Arc<Proof>> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.retain(|_, (since, ..)| since.elapsed() < LASTS);
        known.get(&id).filter(|(_, at, _)| at == head).map(|(.., proof)| Arc::clone(proof))
    }

    pub(super) fn keep(&self, id: i32, head: &str, proof: &Arc<Proof>) {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if known.len() >= KEPT {
            let oldest = known.iter().min_by_key(|(_, (since, ..))| *since).map(|(id, _)| *id);
            oldest.map(|id| known.remove(&id));
        }
        known.insert(id, (Instant::now(), head.to_owned(), Arc::clone(proof)));
    }
}
