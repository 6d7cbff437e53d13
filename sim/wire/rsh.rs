//! The lines of linuxcncrsh over a stream: any number of clients.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::sync::watch;
use tokio::time::{Instant, sleep_until};

use crate::rsh::Controller;

/// Maximum length of a line, without its line end.
const MAX_LINE_LENGTH: usize = 4096;

/// Controller shared by its wires, its clients and a test.
#[derive(Clone)]
pub struct SharedController(Arc<Inner>);

struct Inner {
    controller: Mutex<Controller>,
    /// Counter that wakes the connections after each access to the controller, which can then have output. `clients` is
    /// the number of the last client.
    changed: watch::Sender<u64>,
    clients: Mutex<u64>,
    began: Instant,
}

impl From<Controller> for SharedController {
    fn from(controller: Controller) -> Self {
        let (changed, clients) = (watch::Sender::new(0), Mutex::new(0));
        Self(Arc::new(Inner { controller: Mutex::new(controller), changed, clients, began: Instant::now() }))
    }
}

impl SharedController {
    /// Calls `look` with exclusive access to the simulated controller, and returns the result of `look`. Then wakes the
    /// connections of all clients, because the controller can have new output for them.
    pub fn with<T>(&self, look: impl FnOnce(&mut Controller) -> T) -> T {
        let looked = look(&mut self.locked());
        self.0.changed.send_modify(|times| *times += 1);
        looked
    }

    /// Advances the simulated machine to the present time, given by [`SharedController::now`]. The machine moves along
    /// its running program.
    pub fn advance_time(&self) {
        self.locked().advance_time(self.now());
    }

    /// Returns the real time since this `SharedController` was created. This is the clock of the simulation.
    pub fn now(&self) -> Duration {
        self.0.began.elapsed()
    }

    fn locked(&self) -> MutexGuard<'_, Controller> {
        self.0.controller.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves one client that sends text lines (commands of linuxcncrsh) on `stream`. Returns when the client or the
    /// controller closes the connection, when `stream` fails, or after a line of more than 4096 bytes. A running
    /// program of the controller continues afterwards.
    pub async fn serve_client(&self, stream: impl AsyncRead + AsyncWrite + Unpin) {
        let client = {
            let mut clients = self.0.clients.lock().unwrap_or_else(PoisonError::into_inner);
            *clients += 1;
            *clients
        };
        self.locked().connected(client);
        // A failure of one client does not concern the others.
        let _ = self.converse(client, stream).await;
        self.locked().client_lost(client);
    }

    async fn converse(&self, client: u64, mut stream: impl AsyncRead + AsyncWrite + Unpin) -> io::Result<()> {
        let mut unread = Vec::new();
        let mut changed = self.0.changed.subscribe();
        loop {
            let due = self.locked().due(client).map(|due| self.0.began + due);
            tokio::select! {
                read = stream.read_buf(&mut unread) => if read? == 0 { return Ok(()) },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {}
                _ = changed.changed() => {}
            }
            while let Some(end) = unread.iter().position(|b| matches!(b, b'\r' | b'\n')) {
                let line: Vec<u8> = unread.drain(..=end).collect();
                let line = String::from_utf8_lossy(&line).trim().to_owned();
                if !line.is_empty() {
                    self.locked().receive(client, &line, self.now());
                }
            }
            if unread.len() > MAX_LINE_LENGTH || !self.locked().serves(client) {
                return stream.shutdown().await;
            }
            let outgoing = self.locked().tick(client, self.now());
            for line in outgoing {
                stream.write_all(line.text.as_bytes()).await?;
                if line.closes {
                    return stream.shutdown().await;
                }
            }
        }
    }
}
