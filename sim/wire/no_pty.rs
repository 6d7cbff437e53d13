//! Replacement of the pseudo-terminal on systems that have none.

use std::io;
use std::path::Path;
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// Pseudo-terminal that cannot exist.
#[derive(Debug)]
pub enum Pty {}

impl Pty {
    /// Returns an error, because this system has no pseudo-terminals.
    ///
    /// # Errors
    /// Always.
    pub fn open() -> io::Result<Self> {
        let reason = "this system has no pseudo-terminals; let the simulated machine speak Modbus TCP";
        Err(io::Error::new(io::ErrorKind::Unsupported, reason))
    }

    /// Returns the path of the pseudo-terminal that a client opens.
    pub fn path(&self) -> &Path {
        match *self {}
    }
}

pub(super) fn link(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

impl AsyncRead for Pty {
    fn poll_read(self: Pin<&mut Self>, _: &mut Context<'_>, _: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        match *self {}
    }
}

impl AsyncWrite for Pty {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, _: &[u8]) -> Poll<io::Result<usize>> {
        match *self {}
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        match *self {}
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        match *self {}
    }
}
