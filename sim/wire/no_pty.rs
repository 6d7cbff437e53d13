//! Replacement of the pseudo-terminal on systems that have none.

use std::io;
use std::path::{Path, PathBuf};

use tokio::io::DuplexStream;

/// Returns an error, because this system has no pseudo-terminals.
///
/// # Errors
/// Always.
pub fn open() -> io::Result<(DuplexStream, PathBuf)> {
    let reason = "this system has no pseudo-terminals; let the simulated machine speak Modbus TCP";
    Err(io::Error::new(io::ErrorKind::Unsupported, reason))
}

pub(super) fn link(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}
