//! What goes wrong at a server of I++ DME.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Something that goes wrong with a command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It is acknowledged late.
    LateAcknowledgement(Duration),
    /// It is carried out, and never said to be over.
    NoCompletion,
    /// Its data come twice.
    Twice,
    /// Its data come byte for byte.
    Split,
    /// The fields of its data come in another order.
    Reordered,
    /// A quality comes that was not asked for.
    UnaskedQuality,
    /// Its data lack their parentheses.
    Garbled,
    /// Data of a command come that was never given.
    Stranger,
    /// The connection ends when it is carried out.
    Disconnect,
    /// AbortE is acknowledged, and nothing comes of it.
    AbortIgnored,
    /// Its error has another severity.
    Severity(u8),
    /// The stop circuit opens when it comes.
    EmergencyStop,
    /// It and all that follows take as long as at a real machine.
    InRealTime,
    /// The connection ends in the middle of a scan.
    CutInScan,
    /// A point of a scan is not said.
    PointLost,
    /// A point of a scan is said in the place of the one before it, and none is said for its last target.
    PointsShifted,
}

#[derive(Debug)]
struct Rule {
    method: String,
    /// So many of them go well before.
    skip: u32,
    fault: Fault,
}

/// Faults that are still to come. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct Faults(Arc<Mutex<Vec<Rule>>>);

impl Faults {
    /// None.
    pub fn none() -> Self {
        Self::default()
    }

    /// Has a fault happen at a command of this name, after so many others of the name.
    pub fn add(&self, method: &str, skip: u32, fault: Fault) {
        self.rules().push(Rule { method: method.to_owned(), skip, fault });
    }

    /// Forgets those that are still to come.
    pub fn clear(&self) {
        self.rules().clear();
    }

    pub(super) fn at(&self, method: &str) -> Option<Fault> {
        let mut rules = self.rules();
        let mut met = None;
        for (k, rule) in rules.iter_mut().enumerate().filter(|(_, rule)| rule.method == method) {
            match rule.skip.checked_sub(1) {
                Some(left) => rule.skip = left,
                None => met = met.or(Some(k)),
            }
        }
        met.map(|k| rules.remove(k).fault)
    }

    fn rules(&self) -> std::sync::MutexGuard<'_, Vec<Rule>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
