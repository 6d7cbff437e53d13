//! Faults of a machine that is controlled line by line; each fault happens once. They differ from the faults of Modbus
//! requests on a wire ([`crate::wire::WireFaults`]).

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

struct Rule<Place, Fault> {
    place: Place,
    /// Number of matching lines or commands that pass without a fault before the fault happens.
    skip: u32,
    fault: Fault,
}

/// Pending faults. The place of a fault is the number, the beginning or the name of a line or command. Clones share
/// them.
pub struct PendingFaults<Place, Fault>(Arc<Mutex<Vec<Rule<Place, Fault>>>>);

impl<Place, Fault> PendingFaults<Place, Fault> {
    /// Returns a list without faults.
    pub fn none() -> Self {
        Self(Arc::default())
    }

    /// Adds `fault` to the list. The fault happens once, at a line or command that `place` matches. `place` is the
    /// number, the beginning or the name of a line or command. The first `skip` matching lines or commands pass without
    /// the fault.
    pub fn add(&self, place: impl Into<Place>, skip: u32, fault: Fault) {
        self.rules().push(Rule { place: place.into(), skip, fault });
    }

    /// Removes all faults that have not happened yet.
    pub fn clear(&self) {
        self.rules().clear();
    }

    /// Returns the fault that must happen at the present line or command, and removes this fault from the list.
    /// `is_meant` returns true for a place that matches the present line or command.
    ///
    /// Each fault in the list has a number of matches to skip. If its place matches and this number is above 0, the
    /// number decreases by 1. If its place matches and this number is 0, the fault is due. If several faults are due,
    /// returns the one that was added first; the others stay in the list. Returns `None` if no fault is due.
    pub(crate) fn next_at(&self, is_meant: impl Fn(&Place) -> bool) -> Option<Fault> {
        let mut rules = self.rules();
        let mut met = None;
        for (k, rule) in rules.iter_mut().enumerate().filter(|(_, rule)| is_meant(&rule.place)) {
            match rule.skip.checked_sub(1) {
                Some(left) => rule.skip = left,
                None => met = met.or(Some(k)),
            }
        }
        met.map(|k| rules.remove(k).fault)
    }

    fn rules(&self) -> MutexGuard<'_, Vec<Rule<Place, Fault>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<Place, Fault> Clone for PendingFaults<Place, Fault> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pending_fault_fires_once_at_its_place() {
        let faults = PendingFaults::<String, u8>::none();
        faults.add("a", 1, 1);
        faults.add("a", 1, 2);
        faults.add("b", 0, 3);
        let shared = faults.clone();
        let at = |name: &str| shared.next_at(|place| place == name);
        assert_eq!([at("c"), at("a"), at("a"), at("a"), at("a")], [None, None, Some(1), Some(2), None]);
        assert_eq!([at("b"), at("b")], [Some(3), None]);
        faults.add("b", 0, 4);
        faults.clear();
        assert_eq!(at("b"), None);
    }
}
