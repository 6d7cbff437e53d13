//! Notifications of a cell: webhooks and mail to people and programs that do not watch the cell all the time. The
//! notifications wait in queues on disk, so that a receiver that does not answer delays nothing and loses nothing.
//!
//! ```text
//!  record of a run --> Notification --> Queue of each receiver --> Webhook (HTTP, signed) --> receiver
//!                                        (file)               \--> Mail (SMTP)            --> receiver
//!                                           ^------ delivered, given up, dropped <-----------/
//! ```
#![cfg(feature = "plant")]

mod delivery;
mod error;
mod mail;
mod notification;
mod queue;
mod receiver;
mod settings;
mod tls;
mod webhook;

pub use delivery::{DeliveryEvent, Outbox};
pub use error::NotifyError;
pub use notification::{AlarmNotice, FigureNotice, Notification, notification_schema};
pub use receiver::Receiver;
pub use settings::{Encryption, EventKind, MailSettings, NotifySettings, SettingsProblem, WebhookSettings};
