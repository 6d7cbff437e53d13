//! Certificate with which a page is served to other computers over TLS.
//!
//! TLS needs the feature `https`. Without it every certificate is rejected, and [`Tls`] has no value.

use std::path::PathBuf;

use regrind_formats::OpenToOthers;
use thiserror::Error;

#[cfg(not(feature = "https"))]
mod absent;
#[cfg(feature = "https")]
mod present;

#[cfg(not(feature = "https"))]
pub use absent::Tls;
#[cfg(feature = "https")]
pub use present::Tls;

/// Errors of a certificate or a key that cannot be used for a page.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages tell them")]
pub enum TlsError {
    #[error("{}: no certificate in PEM can be read from this file: {what}; give the certificate of the page in PEM format", .path.display())]
    Certificate { path: PathBuf, what: String },
    #[error("{}: no private key in PEM can be read from this file: {what}; give the private key of the certificate in PEM format", .path.display())]
    Key { path: PathBuf, what: String },
    #[error("{}: other users of this computer can read this key file ({}); give access only to the owner of the file: {}", .path.display(), .open.how, .open.remedy)]
    KeyIsOpen { path: PathBuf, open: OpenToOthers },
    #[error("the certificate {} and the key {} cannot be used: {what}; give a certificate and the private key that belongs to it", .certificate.display(), .key.display())]
    Unfit { certificate: PathBuf, key: PathBuf, what: String },
    #[error(
        "{}: this program was built without TLS and cannot use a certificate; install Regrind from a package, or build \
         Regrind with `cargo install --path . --features https`", .certificate.display()
    )]
    NotBuilt { certificate: PathBuf },
}
