//! Events from the publishers to the program that started them: refused requests, and whether the peer is connected.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use regrind_document::visible;
use tokio::sync::mpsc;

/// Maximum number of queued events.
const WAITING: usize = 256;
/// Maximum length of a reported text from outside, in characters.
const LONGEST: usize = 200;

/// Event of a publisher.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "named for what they are")]
pub enum PublisherEvent {
    /// The publisher is connected from now on.
    Connected { place: String },
    /// The publisher is not connected; it retries.
    Retrying { place: String, reason: String },
    /// This many changes were not published and are lost: they were too many or too old.
    Dropped { place: String, changes: u64 },
    /// A client requested something that it may not do here.
    Refused { by: String, what: String },
    /// This many more refusals did not fit in the queue.
    MoreRefused { times: u32 },
}

/// Sender of events. It never blocks: events that do not fit in the queue are counted.
#[derive(Clone, Debug)]
pub struct EventSender {
    to: mpsc::Sender<PublisherEvent>,
    missed: Arc<AtomicU32>,
}

/// Creates a queue for the events that a publisher reports, for example a lost connection or a refused request. Returns
/// the sender and the receiver of the queue. The queue has a maximum length. The sender never blocks.
pub fn event_queue() -> (EventSender, mpsc::Receiver<PublisherEvent>) {
    let (to, heard) = mpsc::channel(WAITING);
    (EventSender { to, missed: Arc::default() }, heard)
}

impl EventSender {
    pub(crate) fn connected(&self, place: &str) {
        // A lost event does no harm here: the published values show the same.
        let _ = self.to.try_send(PublisherEvent::Connected { place: place.to_owned() });
    }

    pub(crate) fn retrying(&self, place: &str, reason: String) {
        let _ = self.to.try_send(PublisherEvent::Retrying { place: place.to_owned(), reason });
    }

    /// Reports lost changes. Returns false if the queue is full; the caller then reports them later.
    pub(crate) fn dropped(&self, place: &str, changes: u64) -> bool {
        self.to.try_send(PublisherEvent::Dropped { place: place.to_owned(), changes }).is_ok()
    }

    pub(crate) fn refused(&self, by: String, what: &str) {
        let times = self.missed.swap(0, Ordering::Relaxed);
        if times > 0 && self.to.try_send(PublisherEvent::MoreRefused { times }).is_err() {
            self.missed.fetch_add(times, Ordering::Relaxed);
        }
        if self.to.try_send(PublisherEvent::Refused { by: in_a_line(&by), what: in_a_line(what) }).is_err() {
            self.missed.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Returns `text` as one line. `text` comes from outside the program, so it can contain anything. A text longer than
/// `LONGEST` characters is cut and ends with " ...". Line feeds and tabs become spaces. Every other invisible or
/// misleading character becomes its code, such as `<U+202E>`.
fn in_a_line(text: &str) -> String {
    let mut line: String = text.chars().take(LONGEST).collect();
    if line.len() < text.len() {
        line.push_str(" ...");
    }
    visible(&line.replace(['\n', '\t'], " "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_queue_counts_refusals() {
        let (notes, mut heard) = event_queue();
        for k in 0..WAITING + 3 {
            notes.refused("somebody".into(), &format!("order {k}"));
        }
        for _ in 0..2 {
            heard.try_recv().unwrap();
        }
        notes.refused("somebody".into(), "the last");
        let mut last = Vec::new();
        while let Ok(news) = heard.try_recv() {
            last.push(news);
        }
        let the_last = PublisherEvent::Refused { by: "somebody".into(), what: "the last".into() };
        assert_eq!(last.split_off(last.len() - 2), [PublisherEvent::MoreRefused { times: 3 }, the_last]);
    }

    #[test]
    fn in_a_line_cleans_and_truncates() {
        assert_eq!(in_a_line("a\nb\u{202e}c"), "a b<U+202E>c");
        assert_eq!(in_a_line(&"x".repeat(1000)).len(), LONGEST + 4);
    }
}
