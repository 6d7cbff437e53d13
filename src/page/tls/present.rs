//! Certificate of a page, with rustls.

use std::io;
use std::path::Path;
use std::sync::Arc;

use regrind_formats::readable_by_others;
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio_rustls::rustls::version::TLS13;
use tokio_rustls::server::TlsStream;
use webpki::EndEntityCert;

use super::TlsError;

/// Certificate of a page, ready for TLS connections.
#[derive(Clone)]
pub struct Tls {
    acceptor: TlsAcceptor,
    /// Certificate of the page itself, without the intermediate certificates of the issuers.
    certificate: CertificateDer<'static>,
}

impl Tls {
    /// Reads the file of a certificate, followed by those of its issuers, and the file of its private key, both in PEM.
    /// Connections then use TLS 1.3 only, which all browsers have supported since 2018.
    ///
    /// # Errors
    /// A file that cannot be read, or has no certificate or key; a key that other users of the computer can read; a
    /// certificate and a key that do not match.
    pub fn read(certificate: &Path, key: &Path) -> Result<Self, TlsError> {
        let unread = |what: String| TlsError::Certificate { path: certificate.to_owned(), what };
        let chain = CertificateDer::pem_file_iter(certificate).and_then(Iterator::collect);
        let chain: Vec<CertificateDer<'static>> = chain.map_err(|error| unread(error.to_string()))?;
        let Some(first) = chain.first().cloned() else { return Err(unread("there is none in it".into())) };
        let secret = secret(key)?;
        let unfit = |what: String| TlsError::Unfit { certificate: certificate.to_owned(), key: key.to_owned(), what };
        EndEntityCert::try_from(&first).map_err(|error| unfit(error.to_string()))?;
        let config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_protocol_versions(&[&TLS13])
            .and_then(|config| config.with_no_client_auth().with_single_cert(chain, secret));
        let mut config = config.map_err(|error| unfit(error.to_string()))?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self { acceptor: TlsAcceptor::from(Arc::new(config)), certificate: first })
    }

    /// Returns true if the certificate is valid for `host`, a name or an address. Returns false if `host` is neither a
    /// name nor an address. A browser shows the page only under a host for which the certificate is valid.
    pub(crate) fn is_for(&self, host: &str) -> bool {
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let (Ok(name), Ok(certificate)) = (ServerName::try_from(host), EndEntityCert::try_from(&self.certificate))
        else {
            return false;
        };
        certificate.verify_is_valid_for_subject_name(&name).is_ok()
    }

    /// Returns the first host name in the certificate that has no wildcard (`*`); `None` if there is none.
    pub(crate) fn name(&self) -> Option<String> {
        let certificate = EndEntityCert::try_from(&self.certificate).ok()?;
        certificate.valid_dns_names().find(|name| !name.contains('*')).map(str::to_owned)
    }

    pub(crate) async fn accept(&self, stream: TcpStream) -> io::Result<TlsStream<TcpStream>> {
        self.acceptor.accept(stream).await
    }
}

/// Reads a private key, and rejects it if other users can read the file.
fn secret(path: &Path) -> Result<PrivateKeyDer<'static>, TlsError> {
    let unread = |what: String| TlsError::Key { path: path.to_owned(), what };
    if let Some(open) = readable_by_others(path).map_err(|error| unread(error.to_string()))? {
        return Err(TlsError::KeyIsOpen { path: path.to_owned(), open });
    }
    PrivateKeyDer::from_pem_file(path).map_err(|error| unread(error.to_string()))
}
