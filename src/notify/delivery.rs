//! Delivery of the notifications of one receiver, in their order, until the receiver has accepted each or the time for it
//! is over.

use std::io;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use regrind_formats::LineFile;
use serde_json::json;
use tokio::sync::{Notify, mpsc};
use tokio::time::sleep;

use crate::error::NotifyError;
use crate::notification::Notification;
use crate::queue::{Queue, Waiting};
use crate::receiver::Receiver;
use crate::settings::NotifySettings;

/// Limits of the time between two tries.
const MIN_RETRY_DELAY: Duration = Duration::from_secs(1);
const MAX_RETRY_DELAY: Duration = Duration::from_secs(300);
/// Maximum number of lines in the file of lost notifications; after that the older half is removed.
const MAX_LOST_LINES: usize = 2000;

/// Event of the delivery to a receiver.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "named for what they are")]
pub enum DeliveryEvent {
    /// The receiver has accepted the notifications with these identities.
    Delivered { receiver: String, ids: Vec<String> },
    /// The receiver has not accepted a notification; it is tried again.
    Retrying { receiver: String, place: String, reason: String },
    /// These notifications are lost: nobody gets them.
    Lost { receiver: String, ids: Vec<String>, reason: String },
    /// The queue cannot be written; the notifications wait in memory.
    DiskFails { receiver: String, reason: String },
}

/// Notifications that wait for one receiver, and their delivery.
pub struct Outbox {
    receiver: Receiver,
    give_up_ms: u64,
    queue: Mutex<Queue>,
    lost: Mutex<LineFile>,
    added: Notify,
    events: mpsc::UnboundedSender<DeliveryEvent>,
}

impl Outbox {
    /// Opens the queue of `receiver` in the folder `folder`, with the limits of `settings`. Events of the delivery are
    /// sent to `events`.
    ///
    /// # Errors
    /// The queue cannot be read or written.
    pub fn open(
        folder: &Path,
        receiver: Receiver,
        settings: &NotifySettings,
        events: mpsc::UnboundedSender<DeliveryEvent>,
    ) -> Result<Self, NotifyError> {
        let give_up_ms = 3_600_000 * u64::from(settings.give_up_hours);
        let limit = usize::try_from(settings.keep_notifications.max(1)).unwrap_or(usize::MAX);
        let opened = || {
            let (queue, unreadable) = Queue::open(folder.join(format!("{}.queue", receiver.name())), limit)?;
            let mut lost = LineFile::at(folder.join(format!("{}.lost", receiver.name())));
            let earlier = lost.lines()?;
            let text = |line: &Vec<u8>| String::from_utf8_lossy(line).into_owned();
            let since = earlier.len().saturating_sub(MAX_LOST_LINES);
            lost.write_anew(&earlier[since..].iter().map(text).collect::<Vec<_>>())?;
            Ok((queue, lost, unreadable))
        };
        let (queue, lost, unreadable) =
            opened().map_err(|source: io::Error| NotifyError::Folder { path: folder.to_owned(), source })?;
        let (queue, lost) = (Mutex::new(queue), Mutex::new(lost));
        let outbox = Self { receiver, give_up_ms, queue, lost, added: Notify::new(), events };
        if unreadable > 0 {
            let reason = format!("{unreadable} lines of the queue cannot be read");
            outbox.report(DeliveryEvent::Lost { receiver: outbox.name(), ids: Vec::new(), reason });
        }
        Ok(outbox)
    }

    /// Adds `notification` to the queue, if the receiver gets notifications of its event. It is on disk when this
    /// returns, unless the disk fails, which is reported.
    pub fn push(&self, notification: &Notification) {
        if !self.receiver.wants(notification.event) {
            return;
        }
        let (dropped, written) = locked(&self.queue).push(notification.clone(), now_ms());
        self.report_disk(written);
        if !dropped.is_empty() {
            self.lose(
                &dropped,
                "too many notifications wait: raise `keep_notifications` in [notify], or mend the receiver",
            );
        }
        self.added.notify_one();
    }

    /// Returns the number of notifications that wait.
    pub fn len(&self) -> usize {
        locked(&self.queue).len()
    }

    /// Returns true if no notification waits.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Delivers the notifications, without end. A notification that is not accepted is tried again after a delay that
    /// rises from 1 s to 5 min, and those after it wait, until the time to give up is over.
    pub async fn deliver(&self) {
        let mut delay = MIN_RETRY_DELAY;
        let mut reason = String::new();
        loop {
            self.give_up(&reason);
            let batch = locked(&self.queue).front(self.receiver.batch());
            let Some(last) = batch.last() else {
                self.added.notified().await;
                continue;
            };
            let notifications: Vec<_> = batch.iter().map(|waiting| &waiting.notification).collect();
            match self.receiver.send(&notifications).await {
                Ok(()) => {
                    self.remove(last.number);
                    self.report(DeliveryEvent::Delivered { receiver: self.name(), ids: ids(&batch) });
                    (delay, reason) = (MIN_RETRY_DELAY, String::new());
                }
                Err(flaw) => {
                    if flaw != reason {
                        let (receiver, place) = (self.name(), self.receiver.place());
                        self.report(DeliveryEvent::Retrying { receiver, place, reason: flaw.clone() });
                        reason = flaw;
                    }
                    sleep(delay).await;
                    delay = (2 * delay).min(MAX_RETRY_DELAY);
                }
            }
        }
    }

    /// Gives the notifications up that wait for too long. `reason` is that of the last try.
    fn give_up(&self, reason: &str) {
        let oldest_ms = now_ms().saturating_sub(self.give_up_ms);
        let waiting = locked(&self.queue).front(usize::MAX);
        let old: Vec<_> = waiting.into_iter().take_while(|waiting| waiting.queued_ms < oldest_ms).collect();
        let Some(last) = old.last() else { return };
        self.remove(last.number);
        let hours = self.give_up_ms / 3_600_000;
        self.lose(&old, &format!("not delivered within {hours} h (`give_up_hours` in [notify]): {reason}"));
    }

    fn remove(&self, last: u64) {
        let written = locked(&self.queue).remove(last);
        self.report_disk(written);
    }

    /// Reports the notifications `lost`, and writes them to the file of lost notifications.
    fn lose(&self, lost: &[Waiting], reason: &str) {
        let mut file = locked(&self.lost);
        for Waiting { notification, .. } in lost {
            let line = json!({ "lost_ms": now_ms(), "why": reason, "notification": notification }).to_string();
            let written = if file.is_open() { file.append(&line) } else { file.write_anew(&[line]) };
            self.report_disk(written);
        }
        if file.count() > MAX_LOST_LINES {
            let lines = file.lines().unwrap_or_default();
            let text = |line: &Vec<u8>| String::from_utf8_lossy(line).into_owned();
            let newer = &lines[lines.len() / 2..];
            self.report_disk(file.write_anew(&newer.iter().map(text).collect::<Vec<_>>()));
        }
        drop(file);
        let (receiver, ids) = (self.name(), ids(lost));
        self.report(DeliveryEvent::Lost { receiver, ids, reason: reason.to_owned() });
    }

    fn report_disk(&self, written: io::Result<()>) {
        if let Err(error) = written {
            let reason = format!("{}: {error}", locked(&self.queue).path().display());
            self.report(DeliveryEvent::DiskFails { receiver: self.name(), reason });
        }
    }

    fn report(&self, event: DeliveryEvent) {
        // Nobody reads the events while the program ends.
        let _ = self.events.send(event);
    }

    fn name(&self) -> String {
        self.receiver.name().to_owned()
    }
}

fn ids(waiting: &[Waiting]) -> Vec<String> {
    waiting.iter().map(|waiting| waiting.notification.id.clone()).collect()
}

fn locked<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

fn now_ms() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::notification::tests::notification;

    /// Opens the outbox of a webhook to which nothing is sent.
    fn outbox(folder: &Path, keep: u32) -> (Outbox, mpsc::UnboundedReceiver<DeliveryEvent>) {
        let text = format!(
            r#"{{"webhook": [{{"name": "chat", "url": "http://127.0.0.1:1/", "events": ["held"]}}], "keep_notifications": {keep}}}"#
        );
        let settings: NotifySettings = serde_json::from_str(&text).unwrap();
        let (to, events) = mpsc::unbounded_channel();
        let receiver = Receiver::all(&settings).unwrap().remove(0);
        (Outbox::open(folder, receiver, &settings, to).unwrap(), events)
    }

    fn lost_ids(folder: &Path) -> Vec<String> {
        let text = std::fs::read_to_string(folder.join("chat.lost")).unwrap();
        let id = |line: &str| {
            let line: serde_json::Value = serde_json::from_str(line).unwrap();
            line["notification"]["id"].as_str().unwrap().to_owned()
        };
        text.lines().map(id).collect()
    }

    #[test]
    fn excess_is_lost_and_told() {
        let home = tempfile::tempdir().unwrap();
        let (outbox, mut events) = outbox(home.path(), 2);
        for record in 1..=3 {
            outbox.push(&notification(record));
        }
        let other = Notification { event: crate::settings::EventKind::Started, ..notification(4) };
        outbox.push(&other);
        assert_eq!((outbox.len(), lost_ids(home.path())), (2, vec!["a-run:1".to_owned()]));
        let event = events.try_recv().unwrap();
        assert!(matches!(&event, DeliveryEvent::Lost { ids, .. } if *ids == ["a-run:1"]), "{event:?}");
    }

    #[test]
    fn old_notifications_are_given_up_and_told() {
        let home = tempfile::tempdir().unwrap();
        let (mut outbox, mut events) = outbox(home.path(), 10);
        for record in 1..=2 {
            outbox.push(&notification(record));
        }
        outbox.give_up("no answer");
        assert_eq!(outbox.len(), 2);
        // All of the past is too old.
        outbox.give_up_ms = 0;
        while now_ms() <= locked(&outbox.queue).front(2)[1].queued_ms {}
        outbox.give_up("no answer");
        assert_eq!((outbox.len(), lost_ids(home.path()).len()), (0, 2));
        let event = events.try_recv().unwrap();
        assert!(
            matches!(&event, DeliveryEvent::Lost { ids, reason, .. } if ids.len() == 2 && reason.ends_with("no answer")),
            "{event:?}"
        );
        drop(outbox);
        let (again, _) = self::outbox(home.path(), 10);
        assert!(again.is_empty(), "it is given up for ever");
    }
}
