//! Credentials by which a cell and the servers of its plant authenticate each other.
//!
//! A server on another computer proves its identity with certificates. A client signs in to it with a password that no
//! other user can read.

use std::error::Error;
use std::fs::File;
use std::io::{self, Read};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use regrind_formats::{OpenToOthers, readable_by_others};
use rustls::crypto::ring;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use rustls::{CertificateError, ClientConfig, RootCertStore};
use thiserror::Error;

/// Maximum length of a password file, in bytes.
const MAX_BYTES: u64 = 4096;

/// Error of a password or of certificates.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages tell them")]
pub enum TrustError {
    #[error(
        "{}: the password cannot be read: {source}; enter the path of the password file in the key `password_file`; for a database, the command `regrind plant enrol` creates this file", .path.display()
    )]
    Password { path: PathBuf, source: io::Error },
    #[error("{}: other users of this computer can read the password ({}); allow only the owner to read the password file: {}", .path.display(), .open.how, .open.remedy)]
    PasswordIsOpen { path: PathBuf, open: OpenToOthers },
    #[error("{}: {name} cannot be read: {source}; enter the path of its file in the key `{key}`", .path.display())]
    Secret { path: PathBuf, name: &'static str, key: &'static str, source: io::Error },
    #[error("{}: other users of this computer can read {name} ({}); allow only the owner to read the file: {}", .path.display(), .open.how, .open.remedy)]
    SecretIsOpen { path: PathBuf, name: &'static str, open: OpenToOthers },
    #[error("{}: no certificates in PEM format can be read from this file: {what}; the file must contain the certificates of the issuer of the server certificate in PEM format", .path.display())]
    Certificates { path: PathBuf, what: String },
    #[error(
        "{host} is another computer, but the certificates that Regrind needs to check the identity of that computer are missing; enter the path of the certificate file in the key `certificates` of {table}"
    )]
    Unproven { host: String, table: &'static str },
}

/// Returns the TLS configuration for a client that connects to the server `host`. The client verifies the server with
/// the certificates in the PEM file `certificates`. Returns `None` if `certificates` is `None` and the server is on
/// this computer. In this case the client need not verify the server.
///
/// `host` is a host name, an IP address, or the folder of a Unix socket. `table` is the name of the settings table that
/// contains the host; it is used in error messages only.
///
/// # Errors
/// Returns an error if the certificates cannot be read, or if the server is on another computer and `certificates` is
/// `None`.
pub fn tls_config(
    host: &str,
    certificates: Option<&Path>,
    table: &'static str,
) -> Result<Option<ClientConfig>, TrustError> {
    let is_here = host.starts_with('/') || host == "localhost" || host.parse().is_ok_and(|ip: IpAddr| ip.is_loopback());
    match certificates {
        Some(path) => {
            certified(path).map(Some).map_err(|what| TrustError::Certificates { path: path.to_owned(), what })
        }
        None if is_here => Ok(None),
        None => Err(TrustError::Unproven { host: host.to_owned(), table }),
    }
}

/// Reason why the certificate of a server was refused. No retry helps: a person must change something.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CertificateFault {
    /// Reason in words.
    pub what: String,
    /// Remedy in words.
    pub remedy: &'static str,
}

/// Returns the reason why the certificate of a server was refused, if `error` or one of its causes tells that.
pub fn certificate_fault(error: &(dyn Error + 'static)) -> Option<CertificateFault> {
    let mut cause = Some(error);
    while let Some(error) = cause {
        // The source of an error of input or output is the source of what it contains, and not what it contains.
        let inner = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        let of_inner = || inner.and_then(|inner| inner.downcast_ref::<rustls::Error>());
        if let Some(rustls::Error::InvalidCertificate(reason)) = error.downcast_ref().or_else(of_inner) {
            return Some(CertificateFault { what: reason.to_string(), remedy: certificate_remedy(reason) });
        }
        cause = inner.map_or_else(|| error.source(), |inner| Some(inner));
    }
    None
}

fn certificate_remedy(reason: &CertificateError) -> &'static str {
    match reason {
        CertificateError::Expired
        | CertificateError::ExpiredContext { .. }
        | CertificateError::NotValidYet
        | CertificateError::NotValidYetContext { .. } => {
            "check the clock of this computer; if it is right, give the server a new certificate"
        }
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
            "write a name of the server that its certificate contains, or give the server a certificate with this name"
        }
        CertificateError::UnknownIssuer | CertificateError::BadSignature => {
            "put the certificate of the server, or of its issuer, into the file that the key `certificates` names"
        }
        _ => "give the server a new certificate, as docs/plant.md makes it",
    }
}

/// Reads a password from its file, without the line ending.
///
/// # Errors
/// The file cannot be read, is longer than 4096 bytes, or can be read by other users.
pub fn read_password(path: &Path) -> Result<String, TrustError> {
    match read_private(path) {
        Ok(Ok(text)) => Ok(text),
        Ok(Err(open)) => Err(TrustError::PasswordIsOpen { path: path.to_owned(), open }),
        Err(source) => Err(TrustError::Password { path: path.to_owned(), source }),
    }
}

/// Reads a secret other than a password from its file, without the line ending. `name` is the secret in messages, and
/// `key` is the key of the settings that names the file.
///
/// # Errors
/// The file cannot be read, is longer than 4096 bytes, or can be read by other users.
pub fn read_secret(path: &Path, name: &'static str, key: &'static str) -> Result<String, TrustError> {
    match read_private(path) {
        Ok(Ok(text)) => Ok(text),
        Ok(Err(open)) => Err(TrustError::SecretIsOpen { path: path.to_owned(), name, open }),
        Err(source) => Err(TrustError::Secret { path: path.to_owned(), name, key, source }),
    }
}

/// Reads a file that only its owner can read. Returns how others can read it, if they can.
fn read_private(path: &Path) -> io::Result<Result<String, OpenToOthers>> {
    if let Some(open) = readable_by_others(path)? {
        return Ok(Err(open));
    }
    let mut text = String::new();
    File::open(path)?.take(MAX_BYTES + 1).read_to_string(&mut text)?;
    if text.len() as u64 > MAX_BYTES {
        let reason = format!("it is longer than {MAX_BYTES} bytes, too long for a secret");
        return Err(io::Error::new(io::ErrorKind::InvalidData, reason));
    }
    Ok(Ok(text.trim_end_matches(['\r', '\n']).to_owned()))
}

fn certified(path: &Path) -> Result<ClientConfig, String> {
    let mut signers = RootCertStore::empty();
    for certificate in CertificateDer::pem_file_iter(path).map_err(|error| error.to_string())? {
        signers.add(certificate.map_err(|error| error.to_string())?).map_err(|error| error.to_string())?;
    }
    if signers.is_empty() {
        return Err("the file contains no certificate".into());
    }
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| error.to_string())?;
    Ok(config.with_root_certificates(signers).with_no_client_auth())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn proof_required_for_remote_server() {
        for here in ["localhost", "127.0.0.1", "127.8.0.1", "::1", "/run/postgresql"] {
            assert!(tls_config(here, None, "[database]").unwrap().is_none(), "{here}");
        }
        for other in ["plant", "localhost.example", "10.0.0.1", "::2", "0.0.0.0", ""] {
            let refused = tls_config(other, None, "[database]").unwrap_err();
            assert!(
                matches!(&refused, TrustError::Unproven { host, table: "[database]" } if host == other),
                "{refused}"
            );
        }
    }

    #[test]
    fn proof_refuses_file_without_pem() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ca.pem");
        let missing = tls_config("plant", Some(&path), "[database]").unwrap_err().to_string();
        assert!(missing.starts_with(&path.display().to_string()), "{missing}");
        for text in ["", "no PEM", "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"] {
            fs::write(&path, text).unwrap();
            // Named certificates are read even if the host needs none.
            for host in ["plant", "localhost"] {
                let refused = tls_config(host, Some(&path), "[database]").unwrap_err();
                assert!(
                    matches!(&refused, TrustError::Certificates { path: named, .. } if *named == path),
                    "{text:?}: {refused}"
                );
            }
        }
    }

    #[test]
    fn certificate_fault_is_found_behind_other_errors() {
        let fault = |reason| rustls::Error::InvalidCertificate(reason);
        let plain = certificate_fault(&fault(CertificateError::Expired)).unwrap();
        let wrapped = io::Error::new(io::ErrorKind::InvalidData, fault(CertificateError::Expired));
        assert_eq!(certificate_fault(&io::Error::other(wrapped)), Some(plain.clone()));
        assert!(plain.remedy.contains("clock"), "{plain:?}");
        let others = [CertificateError::UnknownIssuer, CertificateError::NotValidForName].map(|reason| {
            let found = certificate_fault(&io::Error::other(fault(reason))).unwrap();
            assert_ne!(found.remedy, plain.remedy);
            found.remedy
        });
        assert_ne!(others[0], others[1]);
        assert_eq!(certificate_fault(&io::Error::other("reset")), None);
        assert_eq!(certificate_fault(&io::Error::from(io::ErrorKind::TimedOut)), None);
        assert_eq!(certificate_fault(&rustls::Error::DecryptError), None);
    }

    #[test]
    fn password_reads_one_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cell.password");
        assert!(matches!(read_password(&path), Err(TrustError::Password { .. })));
        for (text, read) in [("a b \r\n", "a b "), ("a\n\n", "a"), ("", ""), (" \u{e9}", " \u{e9}")] {
            regrind_formats::write_private(&path, text.as_bytes()).unwrap();
            assert_eq!(read_password(&path).unwrap(), read);
        }
    }

    #[test]
    fn password_length_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cell.password");
        for (bytes, is_read) in [(4095, true), (4096, true), (4097, false), (1 << 20, false)] {
            regrind_formats::write_private(&path, &vec![b'x'; bytes]).unwrap();
            match read_password(&path) {
                Ok(read) => assert!(is_read && read.len() == bytes),
                Err(error) => assert!(!is_read && error.to_string().contains("longer than 4096 bytes"), "{error}"),
            }
        }
        regrind_formats::write_private(&path, b"\xff\xfe").unwrap();
        assert!(read_password(&path).unwrap_err().to_string().contains("UTF-8"));
    }

    #[cfg(unix)]
    #[test]
    fn password_refuses_open_permissions() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cell.password");
        fs::write(&path, "secret").unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
        let refused = read_password(&path).unwrap_err().to_string();
        assert!(refused.contains("chmod") && !refused.contains("secret"), "{refused}");
    }
}
