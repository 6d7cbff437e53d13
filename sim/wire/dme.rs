//! I++ DME over TCP: one client at a time, lines both ways.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, ToSocketAddrs};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};

use super::executed_path::ExecutedPath;
use crate::dme::{Outgoing, Server};

/// Maximum length of a line, without its line end.
const MAX_LINE_LENGTH: usize = 65_536;

/// Server shared by its wire, its client and a test.
#[derive(Clone)]
pub struct SharedServer(Arc<Inner>);

struct Inner {
    server: Mutex<Server>,
    /// Signal that a caller has accessed the server, which can then have output.
    changed: Notify,
    began: Instant,
}

impl From<Server> for SharedServer {
    fn from(server: Server) -> Self {
        Self(Arc::new(Inner { server: Mutex::new(server), changed: Notify::new(), began: Instant::now() }))
    }
}

impl SharedServer {
    /// Calls the function `look` with exclusive access to the server, and returns the result of `look`. Then wakes the
    /// connection of the client, because the server can have new output.
    pub fn with<T>(&self, look: impl FnOnce(&mut Server) -> T) -> T {
        let looked = look(&mut self.locked());
        self.0.changed.notify_one();
        looked
    }

    /// Returns the time since the server was created.
    pub fn now(&self) -> Duration {
        self.0.began.elapsed()
    }

    fn locked(&self) -> MutexGuard<'_, Server> {
        self.0.server.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves one client on `stream`. Returns when the client or the server closes the connection, when `stream` fails,
    /// or after a line of more than 65536 bytes. The session of the client then ends: the running command continues to
    /// its end, and waiting commands are dropped.
    pub async fn serve_client(&self, stream: impl AsyncRead + AsyncWrite + Unpin) {
        self.serve_after(stream, None).await;
    }

    async fn serve_after(&self, stream: impl AsyncRead + AsyncWrite + Unpin, grinder: Option<&ExecutedPath>) {
        // A failure of one client does not concern the others.
        let _ = self.converse(stream, grinder).await;
        let now = self.now();
        self.locked().client_lost(now);
    }

    async fn converse(
        &self,
        mut stream: impl AsyncRead + AsyncWrite + Unpin,
        grinder: Option<&ExecutedPath>,
    ) -> io::Result<()> {
        let mut unread = Vec::new();
        loop {
            let due = self.locked().due().map(|due| self.0.began + due);
            tokio::select! {
                read = stream.read_buf(&mut unread) => if read? == 0 { return Ok(()) },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {}
                () = self.0.changed.notified() => {}
            }
            while let Some(end) = unread.iter().position(|b| *b == b'\n') {
                let line: Vec<u8> = unread.drain(..=end).collect();
                let line = String::from_utf8_lossy(&line);
                // An abort is never delayed.
                if let Some(grinder) = grinder.filter(|_| !line.starts_with('E')) {
                    grinder.caught_up().await;
                }
                self.locked().receive(line.trim_end_matches(['\r', '\n']), self.now());
            }
            if unread.len() > MAX_LINE_LENGTH {
                return Ok(());
            }
            let outgoing = self.locked().tick(self.now());
            if send(&mut stream, &outgoing).await? {
                return stream.shutdown().await;
            }
        }
    }
}

/// Running server; it stops when this is dropped.
pub struct ServingDme {
    local_addr: SocketAddr,
    server: SharedServer,
    _tasks: JoinSet<()>,
}

impl ServingDme {
    /// Serves the I++ DME server `server` over TCP at the address `addr`. With port 0, the operating system selects a
    /// free port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp(addr: impl ToSocketAddrs, server: Server) -> io::Result<Self> {
        Self::tcp_after(addr, server, None).await
    }

    /// Serves the I++ DME server `server` over TCP at the address `addr`. `grinder` follows the path that an external
    /// controller of the grinder executes. If `grinder` is given, each command except an abort first waits until the
    /// part is ground along the whole executed path.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp_after(
        addr: impl ToSocketAddrs,
        server: Server,
        grinder: Option<ExecutedPath>,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(addr).await?;
        let local_addr = listener.local_addr()?;
        let server = SharedServer::from(server);
        let mut tasks = JoinSet::new();
        tasks.spawn(serve(listener, server.clone(), grinder));
        Ok(Self { local_addr, server, _tasks: tasks })
    }

    /// Returns the address of the TCP server.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Calls the function `look` with exclusive access to the server, and returns the result of `look`.
    pub fn with<T>(&self, look: impl FnOnce(&mut Server) -> T) -> T {
        self.server.with(look)
    }
}

/// Accepts clients on `listener` and serves one after another. If `grinder` is given, each command except an abort
/// first waits until the part is ground along the whole path that the grinder's controller has executed.
async fn serve(listener: TcpListener, server: SharedServer, grinder: Option<ExecutedPath>) {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                if stream.set_nodelay(true).is_ok() {
                    server.serve_after(stream, grinder.as_ref()).await;
                }
            }
            Err(_) => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    }
}

/// Sends the lines `outgoing` to the client, in order. Sends a line marked `split` byte by byte, and the lines between
/// such lines in one write. Stops after a line marked `closes` and returns true; the caller must then close the
/// connection. Returns false if no line is marked `closes`.
async fn send(stream: &mut (impl AsyncWrite + Unpin), outgoing: &[Outgoing]) -> io::Result<bool> {
    let mut together = Vec::new();
    for line in outgoing {
        if line.split {
            stream.write_all(&std::mem::take(&mut together)).await?;
            for byte in line.text.bytes() {
                stream.write_all(&[byte]).await?;
                stream.flush().await?;
                tokio::task::yield_now().await;
            }
        } else {
            together.extend(line.text.bytes());
        }
        if line.closes {
            stream.write_all(&together).await?;
            return Ok(true);
        }
    }
    stream.write_all(&together).await?;
    Ok(false)
}
