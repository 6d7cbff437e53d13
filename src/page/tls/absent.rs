//! Certificate of a page in a program without TLS. It has no value.

use std::io;
use std::path::Path;

use tokio::net::TcpStream;

use super::TlsError;

/// Certificate of a page. A program that was built without TLS has none.
#[derive(Clone)]
pub enum Tls {}

impl Tls {
    /// Rejects every certificate, because this program was built without TLS.
    ///
    /// # Errors
    /// Always [`TlsError::NotBuilt`].
    pub fn read(certificate: &Path, _key: &Path) -> Result<Self, TlsError> {
        Err(TlsError::NotBuilt { certificate: certificate.to_owned() })
    }

    pub(crate) fn is_for(&self, _host: &str) -> bool {
        match *self {}
    }

    pub(crate) fn name(&self) -> Option<String> {
        match *self {}
    }

    pub(crate) async fn accept(&self, _stream: TcpStream) -> io::Result<TcpStream> {
        match *self {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certificate_refused_without_tls() {
        let refused = Tls::read(Path::new("cell.pem"), Path::new("cell.key")).err();
        assert!(matches!(refused, Some(TlsError::NotBuilt { certificate }) if certificate == Path::new("cell.pem")));
    }
}
