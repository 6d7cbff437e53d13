//! Errors of notifications as the plant file configures them, with the remedy.

use std::io;
use std::path::PathBuf;

use regrind_formats::FormatError;
use regrind_trust::TrustError;
use thiserror::Error;

/// Reason why a receiver cannot be notified as the plant file configures it.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages tell them")]
#[non_exhaustive]
pub enum NotifyError {
    #[error("notifications to {receiver}: {source}")]
    Trust { receiver: String, source: Box<TrustError> },
    #[error("notifications to {receiver}: the address of the receiver {found}; {remedy}")]
    Address { receiver: String, found: &'static str, remedy: &'static str },
    #[error(
        "notifications to {receiver}: the secret {found}; write `whsec_` and 24 to 64 random bytes in base64 into its file: \
         (printf whsec_; head -c 32 /dev/urandom | base64) > FILE"
    )]
    Secret { receiver: String, found: &'static str },
    #[error(
        "notifications to {receiver}: the operating system has no certificates ({what}); name those of the receiver with \
         the key `certificates`"
    )]
    NoCertificates { receiver: String, what: String },
    #[error("notifications to {receiver}: {host:?} cannot be the name of a server in a certificate; write its name")]
    ServerName { receiver: String, host: String },
    #[error("notifications to {receiver}: {address:?} is not a mail address")]
    MailAddress { receiver: String, address: String },
    #[error("{}: the queue of notifications cannot be stored in this folder: {source}; check that the folder exists, and that you have the right to write in it", .path.display())]
    Folder { path: PathBuf, source: io::Error },
    #[error(transparent)]
    File(Box<FormatError>),
}

impl From<FormatError> for NotifyError {
    fn from(error: FormatError) -> Self {
        // Boxed because it is large and rare.
        Self::File(Box::new(error))
    }
}
