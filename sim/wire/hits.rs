//! Lines of hits on a pseudo-terminal, or over TCP as a terminal server transmits them.

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, ToSocketAddrs};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::sleep;

use super::pty;
use super::tcp::next_client;
use crate::hits::PartProgram;

/// Interval at which a part program checks for a new list.
const LIST_POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Minimum sleep; shorter times are accumulated.
const MIN_SLEEP: Duration = Duration::from_millis(5);

/// Next action on the line.
enum LineAction {
    Bytes(Vec<u8>, Option<oneshot::Sender<()>>),
    HangUp,
}

/// Printer of hits at the far end of a line; it stops when this is dropped.
pub struct ServingHits {
    path: Option<PathBuf>,
    local_addr: Option<SocketAddr>,
    lines: mpsc::Sender<LineAction>,
    tasks: JoinSet<()>,
}

impl ServingHits {
    /// Creates a printer of hits (one text line for each touch of the probe) on a new pseudo-terminal.
    ///
    /// # Errors
    /// Returns an error if no pseudo-terminal is available.
    pub fn serial() -> io::Result<Self> {
        let (pty, path) = pty::open()?;
        let (lines, mut inbox) = mpsc::channel(64);
        let mut tasks = JoinSet::new();
        tasks.spawn(async move {
            // A line that hangs up is closed for good.
            let _ = print(pty, &mut inbox).await;
        });
        Ok(Self { path: Some(path), local_addr: None, lines, tasks })
    }

    /// Creates a printer of hits (one text line for each touch of the probe) on a TCP server at the address `addr`.
    /// Serves one client after another. With port 0, the operating system selects a free port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp(addr: impl ToSocketAddrs) -> io::Result<Self> {
        let listener = TcpListener::bind(addr).await?;
        let local_addr = Some(listener.local_addr()?);
        let (lines, mut inbox) = mpsc::channel(64);
        let mut tasks = JoinSet::new();
        tasks.spawn(async move {
            loop {
                drop(print(next_client(&listener).await, &mut inbox).await);
            }
        });
        Ok(Self { path: None, local_addr, lines, tasks })
    }

    /// Returns the path of the pseudo-terminal, or `None` for TCP.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Returns the address of the TCP server, or `None` for a pseudo-terminal.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        self.local_addr
    }

    /// Sends `bytes` to the client, and waits until they are written. On TCP, waits for the next client if none is
    /// connected. Returns without sending if the pseudo-terminal is already closed. Also returns if the connection
    /// fails during the write.
    pub async fn send(&self, bytes: &[u8]) {
        let (written, are_written) = oneshot::channel();
        if self.lines.send(LineAction::Bytes(bytes.to_vec(), Some(written))).await.is_ok() {
            let _ = are_written.await;
        }
    }

    /// Requests that the connection is closed after the bytes that were queued before are sent. Returns when this
    /// request is queued, before the connection is closed.
    pub async fn hang_up(&self) {
        let _ = self.lines.send(LineAction::HangUp).await;
    }

    /// Starts the part program `program` in a background task. The program measures the list of targets in the file
    /// `plan.csv` of `folder`, and prints its touches. It then waits for a new list in the same file. `speed` is the
    /// number of simulated seconds in one real second.
    pub fn run(&mut self, mut program: PartProgram, folder: &Path, speed: f64) {
        let (list, lines) = (folder.join("plan.csv"), self.lines.clone());
        self.tasks.spawn(async move {
            loop {
                if let Ok(text) = std::fs::read_to_string(&list) {
                    program.begin(&text);
                }
                // A timer is coarser than the touches of a fast machine, so the waiting times are accumulated.
                let mut owed = Duration::ZERO;
                while let Some(out) = program.touch_next() {
                    owed += program.per_touch().div_f64(speed);
                    if owed > MIN_SLEEP {
                        sleep(std::mem::take(&mut owed)).await;
                    }
                    if !out.bytes.is_empty() && lines.send(LineAction::Bytes(out.bytes, None)).await.is_err() {
                        return;
                    }
                    if out.hangs_up && lines.send(LineAction::HangUp).await.is_err() {
                        return;
                    }
                }
                sleep(LIST_POLL_INTERVAL).await;
            }
        });
    }
}

/// Writes the queued bytes of `inbox` to `stream`, and discards all input. Returns when the other side closes the
/// stream, or when a hang-up is queued.
///
/// # Errors
/// Returns an error if the stream can no longer be read or written.
async fn print(
    mut stream: impl AsyncRead + AsyncWrite + Unpin,
    inbox: &mut mpsc::Receiver<LineAction>,
) -> io::Result<()> {
    let mut heard = [0; 256];
    loop {
        tokio::select! {
            put = inbox.recv() => match put {
                Some(LineAction::Bytes(bytes, written)) => {
                    stream.write_all(&bytes).await?;
                    stream.flush().await?;
                    written.map(|written| written.send(()));
                }
                Some(LineAction::HangUp) | None => return stream.shutdown().await,
            },
            // The printer ignores its input: it reads and discards it.
            read = stream.read(&mut heard) => if read? == 0 { return Ok(()) },
        }
    }
}
