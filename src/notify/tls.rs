//! Connection to a receiver: TCP with or without TLS, of which only so much is read as an answer can have.

use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use lettre::transport::smtp::client::AsyncTokioStream;
use regrind_trust::tls_config;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use crate::error::NotifyError;

/// Maximum number of bytes that are read from a receiver in one connection. A receiver that sends more is at fault.
const MAX_ANSWER_BYTES: usize = 256 << 10;

/// TLS for the connections to one server.
#[derive(Clone)]
pub(crate) struct Tls {
    connector: TlsConnector,
    server: ServerName<'static>,
}

impl Tls {
    /// Returns the TLS for the server `host` of the receiver named `receiver`. The server must prove its identity by the
    /// certificates in the PEM file `certificates`, or by those of the operating system.
    ///
    /// # Errors
    /// There are no such certificates, or `host` cannot be in a certificate.
    pub(crate) fn new(receiver: &str, host: &str, certificates: Option<&Path>) -> Result<Self, NotifyError> {
        let config = match certificates {
            Some(_) => tls_config(host, certificates, "[notify]")
                .map_err(|source| NotifyError::Trust { receiver: receiver.to_owned(), source: Box::new(source) })?,
            None => None,
        };
        let config = config.map_or_else(|| of_system(receiver), Ok)?;
        let server = ServerName::try_from(host.to_owned())
            .map_err(|_| NotifyError::ServerName { receiver: receiver.to_owned(), host: host.to_owned() })?;
        Ok(Self { connector: TlsConnector::from(Arc::new(config)), server })
    }

    /// Encrypts `connection`, of which nothing may have been read that the server sent after its last reply.
    pub(crate) async fn encrypt(&self, connection: Connection) -> io::Result<Connection> {
        let Stream::Plain(stream) = connection.stream else {
            return Err(io::Error::other("the connection is already encrypted"));
        };
        let stream = self.connector.connect(self.server.clone(), stream).await?;
        Ok(Connection { stream: Stream::Encrypted(Box::new(stream)), ..connection })
    }
}

/// Returns a client that trusts the certificates of the operating system.
fn of_system(receiver: &str) -> Result<ClientConfig, NotifyError> {
    let found = rustls_native_certs::load_native_certs();
    let missing = |what: String| NotifyError::NoCertificates { receiver: receiver.to_owned(), what };
    let mut signers = RootCertStore::empty();
    // A certificate that cannot be read proves nothing; the others still do.
    let (added, _) = signers.add_parsable_certificates(found.certs);
    if added == 0 {
        let what: Vec<_> = found.errors.iter().map(ToString::to_string).collect();
        return Err(missing(if what.is_empty() { "it has none".to_owned() } else { what.join("; ") }));
    }
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| missing(error.to_string()))?;
    Ok(config.with_root_certificates(signers).with_no_client_auth())
}

/// Connection to a receiver. It ends with an error after [`MAX_ANSWER_BYTES`] bytes of the receiver.
pub(crate) struct Connection {
    stream: Stream,
    peer: SocketAddr,
    local: SocketAddr,
    left_bytes: usize,
    /// Bytes that are read before those of the receiver.
    before: &'static [u8],
}

enum Stream {
    Plain(TcpStream),
    Encrypted(Box<TlsStream<TcpStream>>),
}

impl Connection {
    /// Opens a connection without encryption.
    pub(crate) async fn open(host: &str, port: u16) -> io::Result<Self> {
        let stream = TcpStream::connect((host, port)).await?;
        stream.set_nodelay(true)?;
        let (peer, local) = (stream.peer_addr()?, stream.local_addr()?);
        Ok(Self { stream: Stream::Plain(stream), peer, local, left_bytes: MAX_ANSWER_BYTES, before: b"" })
    }

    /// Returns the address of this computer in the connection.
    pub(crate) fn local(&self) -> SocketAddr {
        self.local
    }

    /// Returns this connection, from which the bytes `before` are read first.
    pub(crate) fn with_before(self, before: &'static [u8]) -> Self {
        Self { before, ..self }
    }
}

impl fmt::Debug for Connection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Connection").field("peer", &self.peer).finish_non_exhaustive()
    }
}

impl AsyncTokioStream for Connection {
    fn peer_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.peer)
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, to: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if !self.before.is_empty() {
            let (now, later) = self.before.split_at(self.before.len().min(to.remaining()));
            to.put_slice(now);
            self.before = later;
            return Poll::Ready(Ok(()));
        }
        let filled = to.filled().len();
        let read = match &mut self.stream {
            Stream::Plain(stream) => Pin::new(stream).poll_read(context, to),
            Stream::Encrypted(stream) => Pin::new(stream).poll_read(context, to),
        };
        let count = to.filled().len() - filled;
        match self.left_bytes.checked_sub(count) {
            Some(left) => self.left_bytes = left,
            None => {
                let words = format!("the receiver sends more than {} KiB as an answer", MAX_ANSWER_BYTES >> 10);
                return Poll::Ready(Err(io::Error::new(io::ErrorKind::InvalidData, words)));
            }
        }
        read
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        match &mut self.stream {
            Stream::Plain(stream) => Pin::new(stream).poll_write(context, bytes),
            Stream::Encrypted(stream) => Pin::new(stream).poll_write(context, bytes),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.stream {
            Stream::Plain(stream) => Pin::new(stream).poll_flush(context),
            Stream::Encrypted(stream) => Pin::new(stream).poll_flush(context),
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut self.stream {
            Stream::Plain(stream) => Pin::new(stream).poll_shutdown(context),
            Stream::Encrypted(stream) => Pin::new(stream).poll_shutdown(context),
        }
    }
}
