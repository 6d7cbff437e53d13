//! Changes that are not yet confirmed by the broker. They are kept in memory and in a file, so that neither a cut
//! connection nor the end of the program loses them. Their number and age are limited: the oldest are dropped and
//! counted.
//!
//! ```text
//!  change --> live ----> sent as a present value ---\
//!              | connection lost                     >--> confirmed by the broker --> forgotten
//!              v                                    /
//!          history ----> sent as a historical value
//! ```
//!
//! The file has a line of JSON for each change, and one for each range of changes that were confirmed or dropped. It is
//! emptied when nothing is left.

use std::collections::VecDeque;
use std::io;
use std::path::{Path, PathBuf};

use regrind_formats::LineFile;
use serde_json::{Value as Json, json};

use super::change::Change;

/// Limits of what is kept.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    pub(super) changes: usize,
    pub(super) age_ms: u64,
}

/// Changes in order. Those before `sent` were sent.
#[derive(Debug, Default)]
struct Queue {
    entries: VecDeque<(u64, Change)>,
    sent: usize,
}

impl Queue {
    fn pop(&mut self) -> Option<(u64, Change)> {
        self.sent = self.sent.saturating_sub(1);
        self.entries.pop_front()
    }

    fn last_sent(&self) -> Option<u64> {
        Some(self.entries.get(self.sent.checked_sub(1)?)?.0)
    }

    /// Removes the entries up to the number `last`. Returns the numbers of the first and last removed ones.
    fn confirm(&mut self, last: u64) -> Option<[u64; 2]> {
        let first = self.entries.front()?.0;
        let mut removed = None;
        while self.sent > 0 && self.entries.front().is_some_and(|(number, _)| *number <= last) {
            removed = self.pop().map(|(number, _)| [first, number]);
        }
        removed
    }
}

/// Last numbers that were sent, of history and of live changes. The broker confirms both at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct SentMark([Option<u64>; 2]);

/// Unconfirmed changes.
#[derive(Debug)]
pub(super) struct Store {
    file: LineFile,
    limits: Limits,
    history: Queue,
    live: Queue,
    next: u64,
    /// Changes that were lost and are not yet reported.
    dropped: u64,
}

impl Store {
    /// Opens the store in the file `path`, and reads what an earlier program has not published. Counts lines that cannot
    /// be read as dropped. `now_ms` is the present time, in milliseconds since 1970.
    ///
    /// # Errors
    /// The file cannot be read or written.
    pub(super) fn open(path: PathBuf, limits: Limits, now_ms: u64) -> io::Result<Self> {
        let file = LineFile::at(path);
        let (entries, dropped) = read(&file.lines()?);
        let next = entries.back().map_or(0, |(number, _)| number + 1);
        let history = Queue { entries, sent: 0 };
        let mut store = Self { file, limits, history, live: Queue::default(), next, dropped };
        store.drop_excess(now_ms);
        store.write_anew()?;
        Ok(store)
    }

    /// Keeps `change` until the broker has confirmed it.
    ///
    /// # Errors
    /// The file cannot be written. The change is kept in memory then.
    pub(super) fn push(&mut self, change: Change, now_ms: u64) -> io::Result<()> {
        let number = self.next;
        self.next += 1;
        let line = line(number, &change);
        self.live.entries.push_back((number, change));
        let dropped = self.drop_excess(now_ms);
        self.append(&line)?;
        dropped.map_or(Ok(()), |range| self.append(&removal(range)))
    }

    /// Returns the next change to send, and true if it is historical. Live changes come first, because a host shows them.
    pub(super) fn next_to_send(&self) -> Option<(&Change, bool)> {
        let live = self.live.entries.get(self.live.sent).map(|(_, change)| (change, false));
        live.or_else(|| self.history.entries.get(self.history.sent).map(|(_, change)| (change, true)))
    }

    /// Notes that the change of [`Self::next_to_send`] was sent.
    pub(super) fn mark_sent(&mut self) {
        if self.live.sent < self.live.entries.len() {
            self.live.sent += 1;
        } else if self.history.sent < self.history.entries.len() {
            self.history.sent += 1;
        }
    }

    /// Returns a mark of what was sent and is not confirmed; `None` if there is nothing.
    pub(super) fn sent_mark(&self) -> Option<SentMark> {
        let mark = [self.history.last_sent(), self.live.last_sent()];
        mark.iter().any(Option::is_some).then_some(SentMark(mark))
    }

    /// Forgets the changes up to `mark`, because the broker has them.
    ///
    /// # Errors
    /// The file cannot be written. The changes are possibly sent again after the end of this program.
    pub(super) fn confirm(&mut self, mark: SentMark) -> io::Result<()> {
        let mut ranges = Vec::new();
        for (queue, last) in [&mut self.history, &mut self.live].into_iter().zip(mark.0) {
            ranges.extend(last.and_then(|last| queue.confirm(last)));
        }
        if self.count() == 0 {
            return self.write_anew();
        }
        ranges.into_iter().try_for_each(|range| self.append(&removal(range)))
    }

    /// Turns all unconfirmed changes into history: the connection is lost, or no present value is told for now.
    pub(super) fn turn_into_history(&mut self) {
        self.history.entries.append(&mut self.live.entries);
        (self.history.sent, self.live.sent) = (0, 0);
    }

    /// Returns true if a change waits for being sent.
    pub(super) fn has_unsent(&self) -> bool {
        self.next_to_send().is_some()
    }

    /// Returns the number of the lost changes that are not yet reported.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Notes that the lost changes were reported.
    pub(super) fn dropped_reported(&mut self) {
        self.dropped = 0;
    }

    pub(super) fn path(&self) -> &Path {
        self.file.path()
    }

    fn count(&self) -> usize {
        self.history.entries.len() + self.live.entries.len()
    }

    /// Drops the oldest changes that are too many or too old. Counts them as lost if they were not sent. Returns the
    /// numbers of the first and the last dropped change.
    fn drop_excess(&mut self, now_ms: u64) -> Option<[u64; 2]> {
        let mut range = None;
        loop {
            let count = self.count();
            let queue = if self.history.entries.is_empty() { &mut self.live } else { &mut self.history };
            let Some((number, oldest)) = queue.entries.front() else { return range };
            let is_old = now_ms.saturating_sub(oldest.at_ms) > self.limits.age_ms;
            if !is_old && count <= self.limits.changes {
                return range;
            }
            range = Some([range.map_or(*number, |[first, _]: [u64; 2]| first), *number]);
            self.dropped += u64::from(queue.sent == 0);
            queue.pop();
        }
    }

    fn append(&mut self, line: &str) -> io::Result<()> {
        // Confirmed and dropped changes leave lines behind.
        if !self.file.is_open() || self.file.count() > 2 * self.limits.changes.max(1000) {
            return self.write_anew();
        }
        self.file.append(line)
    }

    /// Writes the file with the unconfirmed changes and nothing else.
    fn write_anew(&mut self) -> io::Result<()> {
        let all = self.history.entries.iter().chain(&self.live.entries);
        self.file.write_anew(&all.map(|(number, change)| line(*number, change)).collect::<Vec<_>>())
    }
}

fn removal(range: [u64; 2]) -> String {
    json!({ "removed": range }).to_string()
}

fn line(number: u64, change: &Change) -> String {
    let mut json = change.to_json();
    json["number"] = json!(number);
    json.to_string()
}

/// Returns the changes of `lines` that are neither confirmed nor dropped, with their numbers. Also returns the number of
/// unreadable lines.
fn read(lines: &[Vec<u8>]) -> (VecDeque<(u64, Change)>, u64) {
    let mut entries: VecDeque<(u64, Change)> = VecDeque::new();
    let mut unreadable = 0;
    for line in lines {
        let json: Json = serde_json::from_slice(line).unwrap_or_default();
        let removed = json["removed"].as_array();
        let removed = removed.and_then(|range| Some([range.first()?.as_u64()?, range.get(1)?.as_u64()?]));
        let change = json["number"].as_u64().and_then(|number| Some((number, Change::from_json(&json)?)));
        match (removed, change) {
            (Some([first, last]), _) => {
                let begin = entries.partition_point(|(number, _)| *number < first);
                let end = entries.partition_point(|(number, _)| *number <= last);
                drop(entries.drain(begin..end.max(begin)));
            }
            (None, Some(change)) if entries.back().is_none_or(|(number, _)| *number < change.0) => {
                entries.push_back(change);
            }
            _ => unreadable += 1,
        }
    }
    (entries, unreadable)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figures::{FIGURES, FigureValue};

    const LIMITS: Limits = Limits { changes: 3, age_ms: 100 };

    fn change(at_ms: u64) -> Change {
        let of = FIGURES.iter().position(|figure| figure.name == "Figures/PV").unwrap();
        Change { at_ms, values: vec![(of, Some(FigureValue::Number(0.1 + at_ms as f64))), (0, None)] }
    }

    fn drain(store: &mut Store) -> Vec<(u64, bool)> {
        let mut sent = Vec::new();
        while let Some((change, historical)) = store.next_to_send() {
            sent.push((change.at_ms, historical));
            store.mark_sent();
        }
        sent
    }

    #[test]
    fn unconfirmed_changes_outlive_the_program() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("changes");
        let mut store = Store::open(path.clone(), LIMITS, 0).unwrap();
        store.push(change(1), 1).unwrap();
        assert_eq!(drain(&mut store), [(1, false)]);
        let mark = store.sent_mark().unwrap();
        store.push(change(2), 2).unwrap();
        store.push(change(3), 3).unwrap();
        assert_eq!(drain(&mut store), [(2, false), (3, false)]);
        store.confirm(mark).unwrap();
        // A torn last line, as a loss of power leaves it.
        let torn = format!("{}{{\"at_ms\":4,\"val", std::fs::read_to_string(&path).unwrap());
        std::fs::write(&path, torn).unwrap();
        drop(store);

        let mut store = Store::open(path.clone(), LIMITS, 4).unwrap();
        assert_eq!(store.dropped(), 1);
        assert_eq!(store.next_to_send(), Some((&change(2), true)));
        store.push(change(5), 5).unwrap();
        assert_eq!(drain(&mut store), [(5, false), (2, true), (3, true)]);
        store.confirm(store.sent_mark().unwrap()).unwrap();
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 0);
        assert_eq!(store.sent_mark(), None);
    }

    #[test]
    fn lost_connection_repeats_what_is_unconfirmed() {
        let home = tempfile::tempdir().unwrap();
        let mut store = Store::open(home.path().join("changes"), LIMITS, 0).unwrap();
        for at_ms in [1, 2] {
            store.push(change(at_ms), at_ms).unwrap();
        }
        drain(&mut store);
        store.turn_into_history();
        assert_eq!(drain(&mut store), [(1, true), (2, true)]);
        assert_eq!(store.dropped(), 0);
    }

    #[test]
    fn oldest_dropped_and_counted() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("changes");
        let mut store = Store::open(path.clone(), LIMITS, 0).unwrap();
        for at_ms in 1..=5 {
            store.push(change(at_ms), at_ms).unwrap();
        }
        assert_eq!(store.dropped(), 2);
        store.dropped_reported();
        store.push(change(104), 104).unwrap();
        assert_eq!(store.dropped(), 1, "one is older than 100 ms");
        drop(store);
        let mut store = Store::open(path, LIMITS, 105).unwrap();
        assert_eq!(store.dropped(), 1, "no loss is counted twice");
        assert_eq!(drain(&mut store), [(5, true), (104, true)]);
    }
}
