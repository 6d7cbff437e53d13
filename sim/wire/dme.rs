//! I++ DME over TCP: one client at a time, lines both ways.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, ToSocketAddrs};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};

use super::executed::ExecutedPath;
use crate::dme::{Outgoing, Server};

/// The longest line, its end left out.
const LONGEST_LINE: usize = 65_536;

/// A server that is being served, until this is dropped.
pub struct ServingDme {
    local_addr: SocketAddr,
    server: Shared,
    _tasks: JoinSet<()>,
}

type Shared = Arc<Mutex<Server>>;

fn locked(server: &Shared) -> MutexGuard<'_, Server> {
    server.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ServingDme {
    /// Serves over TCP; port 0 takes any that is free.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn tcp(addr: impl ToSocketAddrs, server: Server) -> io::Result<Self> {
        Self::tcp_after(addr, server, None).await
    }

    /// Serves over TCP a machine that gets its parts from a grinder outside: whatever it is told to do, it does after what that has done.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn tcp_after(
        addr: impl ToSocketAddrs,
        server: Server,
        grinder: Option<ExecutedPath>,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(addr).await?;
        let local_addr = listener.local_addr()?;
        let server = Arc::new(Mutex::new(server));
        let mut tasks = JoinSet::new();
        tasks.spawn(serve(listener, Arc::clone(&server), grinder));
        Ok(Self { local_addr, server, _tasks: tasks })
    }

    /// Where it is served.
    pub fn local_addr(&self) -> SocketAddr {
        self.local_addr
    }

    /// Looks at the server, or changes it, while nobody else does.
    pub fn with<T>(&self, look: impl FnOnce(&mut Server) -> T) -> T {
        look(&mut locked(&self.server))
    }
}

/// Serves one client after another.
async fn serve(listener: TcpListener, server: Shared, grinder: Option<ExecutedPath>) {
    let began = Instant::now();
    loop {
        match listener.accept().await {
            Ok((stream, _)) => {
                // A client that goes away is the end of its session, and no other's concern.
                let _ = serve_client(stream, &server, grinder.as_ref(), began).await;
                locked(&server).hung_up();
            }
            Err(_) => tokio::time::sleep(Duration::from_millis(20)).await,
        }
    }
}

async fn serve_client(
    mut stream: TcpStream,
    server: &Shared,
    grinder: Option<&ExecutedPath>,
    began: Instant,
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    let mut unread = Vec::new();
    loop {
        let due = locked(server).due().map(|due| began + due);
        tokio::select! {
            read = stream.read_buf(&mut unread) => if read? == 0 { return Ok(()) },
            () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {}
        }
        while let Some(end) = unread.iter().position(|b| *b == b'\n') {
            let line: Vec<u8> = unread.drain(..=end).collect();
            let line = String::from_utf8_lossy(&line);
            // Nothing delays an abort.
            if let Some(grinder) = grinder.filter(|_| !line.starts_with('E')) {
                grinder.caught_up().await;
            }
            locked(server).receive(line.trim_end_matches(['\r', '\n']), began.elapsed());
        }
        if unread.len() > LONGEST_LINE {
            return Ok(());
        }
        let outgoing = locked(server).tick(began.elapsed());
        if send(&mut stream, &outgoing).await? {
            return stream.shutdown().await;
        }
    }
}

/// Sends lines, several of them in one segment where nothing splits them, and says whether the connection is to be closed.
async fn send(stream: &mut TcpStream, outgoing: &[Outgoing]) -> io::Result<bool> {
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
