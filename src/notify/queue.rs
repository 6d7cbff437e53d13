//! Notifications that wait for one receiver. They are kept in memory and in a file, so that the end of the program loses
//! none. Their number and age are limited.
//!
//! The file has a line of JSON for each notification, and one for each that was delivered or dropped. It is emptied when
//! nothing is left.

use std::collections::VecDeque;
use std::io;
use std::path::{Path, PathBuf};

use regrind_formats::LineFile;
use serde_json::{Value as Json, json};

use crate::notification::Notification;

/// Notification that waits.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Waiting {
    /// Number in the queue.
    pub(crate) number: u64,
    /// Time at which it came into the queue, in milliseconds since 1970.
    pub(crate) queued_ms: u64,
    pub(crate) notification: Notification,
}

/// Queue of one receiver.
#[derive(Debug)]
pub(crate) struct Queue {
    file: LineFile,
    limit: usize,
    entries: VecDeque<Waiting>,
    next: u64,
}

impl Queue {
    /// Opens the queue in the file `path`, which keeps at most `limit` notifications. Returns the queue and the number
    /// of lines that cannot be read.
    ///
    /// # Errors
    /// The file cannot be read or written.
    pub(crate) fn open(path: PathBuf, limit: usize) -> io::Result<(Self, u64)> {
        let file = LineFile::at(path);
        let (entries, next, unreadable) = read(&file.lines()?);
        let mut queue = Self { file, limit, entries, next };
        queue.write_anew()?;
        Ok((queue, unreadable))
    }

    /// Adds `notification` at the time `now_ms`, in milliseconds since 1970, unless it waits already. Returns the oldest
    /// notifications that are dropped for it.
    ///
    /// # Errors
    /// The file cannot be written. The notification waits in memory then.
    pub(crate) fn push(&mut self, notification: Notification, now_ms: u64) -> (Vec<Waiting>, io::Result<()>) {
        if self.entries.iter().any(|waiting| waiting.notification.id == notification.id) {
            return (Vec::new(), Ok(()));
        }
        let waiting = Waiting { number: self.next, queued_ms: now_ms, notification };
        self.next += 1;
        let mut written = self.append(&line(&waiting));
        self.entries.push_back(waiting);
        let excess = self.entries.len().saturating_sub(self.limit);
        let dropped: Vec<_> = self.entries.drain(..excess).collect();
        if let Some(last) = dropped.last() {
            written = written.and(self.append(&removal(last.number)));
        }
        // The reader of the record goes on only after the disk has the notification.
        written = written.and_then(|()| self.file.sync());
        (dropped, written)
    }

    /// Returns the oldest notifications, at most `count`.
    pub(crate) fn front(&self, count: usize) -> Vec<Waiting> {
        self.entries.iter().take(count).cloned().collect()
    }

    /// Removes the notifications up to the number `last`.
    ///
    /// # Errors
    /// The file cannot be written. The notifications are possibly delivered again after the end of this program.
    pub(crate) fn remove(&mut self, last: u64) -> io::Result<()> {
        while self.entries.front().is_some_and(|waiting| waiting.number <= last) {
            self.entries.pop_front();
        }
        if self.entries.is_empty() { self.write_anew() } else { self.append(&removal(last)) }
    }

    /// Returns the number of waiting notifications.
    pub(crate) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(crate) fn path(&self) -> &Path {
        self.file.path()
    }

    fn append(&mut self, line: &str) -> io::Result<()> {
        // Delivered and dropped notifications leave lines behind.
        if !self.file.is_open() || self.file.count() > 2 * self.limit.max(1000) {
            self.write_anew()?;
        }
        self.file.append(line)
    }

    /// Writes the file with the waiting notifications and nothing else.
    fn write_anew(&mut self) -> io::Result<()> {
        self.file.write_anew(&self.entries.iter().map(line).collect::<Vec<_>>())
    }
}

fn removal(last: u64) -> String {
    json!({ "removed": last }).to_string()
}

fn line(waiting: &Waiting) -> String {
    json!({ "number": waiting.number, "queued_ms": waiting.queued_ms, "notification": waiting.notification })
        .to_string()
}

/// Returns the waiting notifications of `lines`, the next number, and the number of unreadable lines.
fn read(lines: &[Vec<u8>]) -> (VecDeque<Waiting>, u64, u64) {
    let (mut entries, mut next, mut unreadable) = (VecDeque::<Waiting>::new(), 0, 0);
    for line in lines {
        let mut json: Json = serde_json::from_slice(line).unwrap_or_default();
        if let Some(last) = json["removed"].as_u64() {
            entries.retain(|waiting| waiting.number > last);
            next = next.max(last + 1);
            continue;
        }
        let mut read = || {
            let (number, queued_ms) = (json["number"].as_u64()?, json["queued_ms"].as_u64()?);
            let notification = serde_json::from_value(json["notification"].take()).ok()?;
            Some(Waiting { number, queued_ms, notification })
        };
        match read() {
            Some(waiting) if waiting.number >= next => {
                next = waiting.number + 1;
                entries.push_back(waiting);
            }
            _ => unreadable += 1,
        }
    }
    (entries, next, unreadable)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::notification::tests::notification;

    fn records(queue: &Queue) -> Vec<u64> {
        queue.front(100).iter().map(|waiting| waiting.notification.record).collect()
    }

    #[test]
    fn queue_outlives_the_program() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("chat.queue");
        let (mut queue, _) = Queue::open(path.clone(), 10).unwrap();
        for record in 1..=3 {
            queue.push(notification(record), record).1.unwrap();
        }
        queue.push(notification(2), 9).1.unwrap();
        assert_eq!(records(&queue), [1, 2, 3], "one that waits comes only once");
        queue.remove(queue.front(1)[0].number).unwrap();
        // A torn last line, as a loss of power leaves it.
        let torn = format!("{}{{\"number\":4,\"queu", std::fs::read_to_string(&path).unwrap());
        std::fs::write(&path, torn).unwrap();
        drop(queue);

        let (mut queue, unreadable) = Queue::open(path.clone(), 10).unwrap();
        assert_eq!((records(&queue), unreadable), (vec![2, 3], 1));
        assert_eq!(queue.front(1)[0].queued_ms, 2);
        queue.push(notification(4), 5).1.unwrap();
        queue.remove(queue.front(3)[2].number).unwrap();
        assert_eq!((queue.len(), std::fs::metadata(&path).unwrap().len()), (0, 0));
        queue.push(notification(5), 5).1.unwrap();
        assert_eq!(records(&queue), [5]);
    }

    #[test]
    fn oldest_is_dropped_and_returned() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("chat.queue");
        let (mut queue, _) = Queue::open(path.clone(), 2).unwrap();
        let mut dropped = Vec::new();
        for record in 1..=4 {
            let (more, written) = queue.push(notification(record), record);
            written.unwrap();
            dropped.extend(more.into_iter().map(|waiting| waiting.notification.record));
        }
        assert_eq!((dropped, records(&queue)), (vec![1, 2], vec![3, 4]));
        drop(queue);
        assert_eq!(records(&Queue::open(path, 2).unwrap().0), [3, 4]);
    }
}
