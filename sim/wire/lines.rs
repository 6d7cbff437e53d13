//! Lines of text over a stream, both ways, for every server that is commanded by lines.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, ToSocketAddrs};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};

use super::executed_path::ExecutedPath;
use super::tcp::next_client;
use crate::line_server::{LineServer, Outgoing};

/// Server of lines that is shared by its wires, its clients and a test.
pub struct SharedLineServer<S>(Arc<Inner<S>>);

struct Inner<S> {
    server: Mutex<S>,
    /// Counter that wakes the connections after each access to the server, which can then have output.
    changed: watch::Sender<u64>,
    /// Number of the last client.
    clients: Mutex<u64>,
    began: Instant,
}

impl<S> Clone for SharedLineServer<S> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<S: LineServer> From<S> for SharedLineServer<S> {
    fn from(server: S) -> Self {
        let (changed, clients) = (watch::Sender::new(0), Mutex::new(0));
        Self(Arc::new(Inner { server: Mutex::new(server), changed, clients, began: Instant::now() }))
    }
}

impl<S: LineServer> SharedLineServer<S> {
    /// Calls the function `look` with exclusive access to the server, and returns the result of `look`. Then wakes the
    /// connections of all clients, because the server can have new output for them.
    pub fn with<T>(&self, look: impl FnOnce(&mut S) -> T) -> T {
        let looked = look(&mut self.locked());
        self.0.changed.send_modify(|times| *times += 1);
        looked
    }

    /// Advances the simulated machine to the present time, given by [`SharedLineServer::now`].
    pub fn advance_time(&self) {
        self.locked().advance_time(self.now());
    }

    /// Returns the real time since this value was created. This is the clock of the simulation.
    pub fn now(&self) -> Duration {
        self.0.began.elapsed()
    }

    fn locked(&self) -> MutexGuard<'_, S> {
        self.0.server.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves one client on `stream`. Returns when the client or the server closes the connection, when `stream` fails,
    /// or after a line that is too long. What the machine is doing continues afterwards.
    pub async fn serve_client(&self, stream: impl AsyncRead + AsyncWrite + Unpin) {
        self.serve_after(stream, None).await;
    }

    async fn serve_after(&self, stream: impl AsyncRead + AsyncWrite + Unpin, grinder: Option<&ExecutedPath>) {
        let client = {
            let mut clients = self.0.clients.lock().unwrap_or_else(PoisonError::into_inner);
            *clients += 1;
            *clients
        };
        self.locked().connected(client);
        // A failure of one client does not concern the others.
        let _ = self.converse(client, stream, grinder).await;
        let now = self.now();
        self.locked().client_lost(client, now);
    }

    async fn converse(
        &self,
        client: u64,
        mut stream: impl AsyncRead + AsyncWrite + Unpin,
        grinder: Option<&ExecutedPath>,
    ) -> io::Result<()> {
        let mut unread = Vec::new();
        let mut changed = self.0.changed.subscribe();
        while unread.len() <= S::MAX_LINE_LENGTH && self.locked().serves(client) {
            let due = self.locked().due(client).map(|due| self.0.began + due);
            tokio::select! {
                read = stream.read_buf(&mut unread) => if read? == 0 { return Ok(()) },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {}
                _ = changed.changed() => {}
            }
            while let Some(end) = unread.iter().position(|byte| S::LINE_ENDS.contains(byte)) {
                let line: Vec<u8> = unread.drain(..=end).collect();
                let line = String::from_utf8_lossy(&line);
                if let Some(grinder) = grinder.filter(|_| !S::is_urgent(&line)) {
                    grinder.caught_up().await;
                }
                self.locked().receive(client, line.trim_end_matches(['\r', '\n']), self.now());
            }
            let outgoing = self.locked().tick(client, self.now());
            if send(&mut stream, &outgoing).await? {
                break;
            }
        }
        stream.shutdown().await
    }
}

/// Running server of lines; it stops when this is dropped.
pub struct ServingLines<S> {
    local_addr: SocketAddr,
    server: SharedLineServer<S>,
    _tasks: JoinSet<()>,
}

impl<S: LineServer> ServingLines<S> {
    /// Serves the server `server` over TCP at the address `addr`. With port 0, the operating system selects a free
    /// port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp(addr: impl ToSocketAddrs, server: S) -> io::Result<Self> {
        Self::tcp_after(addr, server, None).await
    }

    /// Serves the server `server` over TCP at the address `addr`. `grinder` follows the path that an external
    /// controller of the grinder executes. If `grinder` is given, each command that is not urgent first waits until the
    /// part is ground along the whole executed path.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp_after(addr: impl ToSocketAddrs, server: S, grinder: Option<ExecutedPath>) -> io::Result<Self> {
        let listener = TcpListener::bind(addr).await?;
        let local_addr = listener.local_addr()?;
        let server = SharedLineServer::from(server);
        let mut tasks = JoinSet::new();
        tasks.spawn(serve(listener, server.clone(), grinder.map(Arc::new)));
        Ok(Self { local_addr, server, _tasks: tasks })
    }

    /// Returns the address of the TCP server.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Calls the function `look` with exclusive access to the server, and returns the result of `look`.
    pub fn with<T>(&self, look: impl FnOnce(&mut S) -> T) -> T {
        self.server.with(look)
    }
}

/// Accepts clients on `listener`, and serves them one after another or at the same time, as the server requires.
async fn serve<S: LineServer>(listener: TcpListener, server: SharedLineServer<S>, grinder: Option<Arc<ExecutedPath>>) {
    let mut clients = JoinSet::new();
    loop {
        let stream = next_client(&listener).await;
        let (server, grinder) = (server.clone(), grinder.clone());
        clients.spawn(async move { server.serve_after(stream, grinder.as_deref()).await });
        while S::ONE_CLIENT_AT_A_TIME && clients.join_next().await.is_some() {}
        while clients.try_join_next().is_some() {}
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
