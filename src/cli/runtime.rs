//! Runtime of the asynchronous commands.

use super::failure::Failure;

/// Creates the tokio runtime that executes asynchronous commands.
pub(super) fn runtime() -> Result<tokio::runtime::Runtime, Failure> {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().map_err(Failure::Terminal)
}
