//! What goes wrong at linuxcncrsh.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Something that goes wrong with a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Nothing is done, and nothing answered.
    Lost,
    /// It is done, and not answered.
    Unanswered,
    /// It is done, and answered late.
    Late(Duration),
    /// Nothing is done, and it is refused.
    Refused,
    /// It is done, and refused.
    DoneAndRefused,
    /// Nothing is done, and it is acknowledged.
    Ignored,
    /// It is acknowledged, an error is reported, and what was there before stays.
    Fails,
    /// The connection ends, and nothing is done.
    CutBefore,
    /// It is done, and the connection ends.
    CutBehind,
    /// Lines come before the answer that answer nothing.
    Aside,
    /// What a program runs into a travel limit at that many thousandths of its lines.
    Limit(u32),
}

#[derive(Debug)]
struct Rule {
    begins: String,
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

    /// Has a fault happen at a line that begins so, after so many others that do.
    pub fn add(&self, begins: &str, skip: u32, fault: Fault) {
        self.rules().push(Rule { begins: begins.to_owned(), skip, fault });
    }

    /// Forgets those that are still to come.
    pub fn clear(&self) {
        self.rules().clear();
    }

    pub(super) fn at(&self, line: &str) -> Option<Fault> {
        let mut rules = self.rules();
        let mut met = None;
        for (k, rule) in rules.iter_mut().enumerate().filter(|(_, rule)| line.starts_with(&rule.begins)) {
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
