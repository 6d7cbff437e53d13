//! One receiver of notifications: a webhook, or people by mail.

use std::time::Duration;

use tokio::time::timeout;

use crate::error::NotifyError;
use crate::mail::Mail;
use crate::notification::Notification;
use crate::settings::{EventKind, NotifySettings};
use crate::webhook::Webhook;

/// Timeout of one try to deliver.
const TRY_TIMEOUT: Duration = Duration::from_secs(20);
/// Maximum number of notifications in a mail.
const IN_A_MAIL: usize = 50;

/// Receiver of notifications.
pub struct Receiver {
    name: String,
    events: Vec<EventKind>,
    channel: Channel,
}

enum Channel {
    Webhook(Webhook),
    Mail(Box<Mail>),
}

impl Receiver {
    /// Creates all receivers of `settings`, whose paths are resolved. Reads their files, and connects to nothing.
    ///
    /// # Errors
    /// A receiver cannot be notified with these settings.
    pub fn all(settings: &NotifySettings) -> Result<Vec<Self>, NotifyError> {
        let webhooks = settings.webhook.iter().map(|of| {
            let channel = Channel::Webhook(Webhook::new(of)?);
            Ok(Self { name: of.name.clone(), events: of.events.clone(), channel })
        });
        let mails = settings.mail.iter().map(|of| {
            let channel = Channel::Mail(Box::new(Mail::new(of)?));
            Ok(Self { name: of.name.clone(), events: of.events.clone(), channel })
        });
        webhooks.chain(mails).collect()
    }

    /// Returns the name of the receiver in the plant file.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the computer to which notifications are sent, for messages.
    pub fn place(&self) -> String {
        match &self.channel {
            Channel::Webhook(webhook) => webhook.place(),
            Channel::Mail(mail) => mail.place(),
        }
    }

    /// Returns true if the receiver gets notifications of this event.
    pub(crate) fn wants(&self, event: EventKind) -> bool {
        self.events.contains(&event)
    }

    /// Returns the maximum number of notifications that are sent at once.
    pub(crate) fn batch(&self) -> usize {
        match &self.channel {
            Channel::Webhook(_) => 1,
            Channel::Mail(_) => IN_A_MAIL,
        }
    }

    /// Sends `notifications`, at most [`Self::batch`]. Returns the reason in words if they were not accepted, or if the
    /// receiver has not answered in time; it can have them nevertheless.
    pub(crate) async fn send(&self, notifications: &[&Notification]) -> Result<(), String> {
        let sent = async {
            match &self.channel {
                Channel::Webhook(webhook) => {
                    for notification in notifications {
                        webhook.send(notification).await?;
                    }
                    Ok(())
                }
                Channel::Mail(mail) => mail.send(notifications).await,
            }
        };
        in_time(sent).await
    }

    /// Tries to reach the receiver without a notification: connects, and signs in to a mail server. Returns the reason
    /// in words if this fails.
    ///
    /// # Errors
    /// The receiver cannot be reached, or does not prove its identity, or does not accept the user.
    pub async fn try_server(&self) -> Result<(), String> {
        in_time(async {
            match &self.channel {
                Channel::Webhook(webhook) => webhook.try_server().await,
                Channel::Mail(mail) => mail.try_server().await,
            }
        })
        .await
    }
}

async fn in_time(done: impl Future<Output = Result<(), String>>) -> Result<(), String> {
    let late = |_| Err(format!("it does not answer within {} s", TRY_TIMEOUT.as_secs()));
    timeout(TRY_TIMEOUT, done).await.unwrap_or_else(late)
}
