//! Adapter for agents of MTConnect: a server of SHDR, the line protocol between an adapter and an agent. An agent gets
//! all values when it connects, and each change after that. It can send nothing but the signs of life of the protocol.
//!
//! ```text
//!  TimedStatus --> ITEMS --> lines of SHDR --> agent --> its clients (XML over HTTP)
//!                     \--> Devices.xml  --> agent
//! ```

mod devices;
mod items;
mod shdr;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};

pub use self::devices::devices_file;
use self::shdr::Lines;
use crate::cell_status::TimedStatus;
use crate::error::LiveError;
use crate::publisher_event::EventSender;
use crate::settings::MtConnectSettings;
use crate::status_feed::StatusReceiver;

/// Time between two tries to open the port.
const BETWEEN_TRIES: Duration = Duration::from_secs(1);
/// Interval of the signs of life of an agent, in ms, as the adapter asks for it.
const HEARTBEAT_MS: u32 = 10_000;
/// Maximum number of agents at the same time.
const AGENTS: usize = 8;
/// Maximum length of a line of an agent, in bytes.
const MAX_LINE_BYTES: u64 = 256;
/// Maximum number of statuses that wait for an agent. Those that it misses are not sent to it.
const WAITING: usize = 1024;
/// Timeout of a write to an agent. An agent that reads nothing for so long is disconnected.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);

/// Adapter that shows a cell to agents of MTConnect.
pub struct Adapter {
    listen: SocketAddr,
    told: StatusReceiver,
    notes: EventSender,
}

impl Adapter {
    /// Creates an adapter. It sends each status that arrives in `told` to the agents, and reports connections and refused
    /// lines to `notes`. It accepts agents only after [`Adapter::run`] is called.
    ///
    /// # Errors
    /// The address in `settings` can be reached from other computers.
    pub fn new(settings: &MtConnectSettings, told: StatusReceiver, notes: EventSender) -> Result<Self, LiveError> {
        let listen = settings.listen;
        if !listen.ip().is_loopback() {
            return Err(LiveError::AgentsElsewhere { listen });
        }
        Ok(Self { listen, told, notes })
    }

    /// Serves the status of the cell to agents. Returns `Ok` when the sender of the statuses is dropped.
    ///
    /// # Errors
    /// None; the type is that of the other publishers.
    pub async fn run(mut self) -> Result<(), LiveError> {
        // No value is sent without its time.
        let Some(mut last) = self.told.next().await else { return Ok(()) };
        let Some(listener) = self.listener(&mut last).await else { return Ok(()) };
        let address = listener.local_addr().unwrap_or(self.listen);
        self.notes.connected(&format!("shdr://{address}/"));
        let (to, _) = broadcast::channel(WAITING);
        let mut agents = JoinSet::new();
        loop {
            tokio::select! {
                told = self.told.next() => match told {
                    Some(status) => {
                        last = status.clone();
                        // Without an agent nobody misses it.
                        let _ = to.send(status);
                    }
                    None => return Ok(()),
                },
                accepted = listener.accept(), if agents.len() < AGENTS => match accepted {
                    Ok((stream, peer)) => {
                        let agent = Agent::new(peer, self.notes.clone());
                        agents.spawn(agent.serve(stream, last.clone(), to.subscribe()));
                    }
                    // No descriptor is left, or the agent has gone.
                    Err(_) => tokio::time::sleep(BETWEEN_TRIES).await,
                },
                Some(_) = agents.join_next() => {}
            }
        }
    }

    /// Opens the TCP port. While it cannot be opened, reports this and tries again every second. `last` is the last
    /// status. Returns `None` if the sender of the statuses is dropped before.
    async fn listener(&mut self, last: &mut Arc<TimedStatus>) -> Option<TcpListener> {
        loop {
            match TcpListener::bind(self.listen).await {
                Ok(listener) => return Some(listener),
                Err(error) => self.notes.retrying(&format!("shdr://{}/", self.listen), error.to_string()),
            }
            let until = Instant::now() + BETWEEN_TRIES;
            while Instant::now() < until {
                tokio::select! {
                    () = sleep_until(until) => {}
                    told = self.told.next() => *last = told?,
                }
            }
        }
    }
}

/// Connected agent.
struct Agent {
    name: String,
    notes: EventSender,
    lines: Lines,
}

impl Agent {
    fn new(peer: SocketAddr, notes: EventSender) -> Self {
        Self { name: format!("agent {peer}"), notes, lines: Lines::default() }
    }

    /// Sends the status `first` and each status of `told` to the agent, and answers its signs of life. Returns when the
    /// agent is gone, reads nothing, sends a line that is too long, or when there are no more statuses.
    async fn serve(
        mut self,
        stream: TcpStream,
        first: Arc<TimedStatus>,
        mut told: broadcast::Receiver<Arc<TimedStatus>>,
    ) {
        // Lines are short and few.
        let _ = stream.set_nodelay(true);
        let (read, mut write) = stream.into_split();
        let mut read = BufReader::new(read);
        let greeting = format!("{}{}", shdr::greeting(), self.lines.changed(&first));
        if send(&mut write, &greeting).await.is_none() {
            return;
        }
        let mut line = Vec::new();
        loop {
            let text = tokio::select! {
                status = told.recv() => match status {
                    Ok(status) => self.lines.changed(&status),
                    Err(RecvError::Lagged(_)) => String::new(),
                    Err(RecvError::Closed) => return,
                },
                // Cancel safe: what was read stays in `line`.
                found = read_line(&mut read, &mut line) => match found {
                    Some(()) => self.answer(&std::mem::take(&mut line)),
                    None => return self.report_overlong(&line),
                },
            };
            if send(&mut write, &text).await.is_none() {
                return;
            }
        }
    }

    /// Returns the answer to a line of the agent. Reports a line that is no sign of life.
    fn answer(&self, line: &[u8]) -> String {
        let line = String::from_utf8_lossy(line);
        if shdr::is_ping(&line) {
            return shdr::pong(HEARTBEAT_MS);
        }
        if !line.trim().is_empty() {
            self.notes.refused(self.name.clone(), &format!("SHDR: {}", line.trim()));
        }
        String::new()
    }

    fn report_overlong(&self, line: &[u8]) {
        if line.len() as u64 >= MAX_LINE_BYTES {
            self.notes.refused(self.name.clone(), "SHDR: a line that is too long");
        }
    }
}

/// Reads the rest of a line into `line`. Returns `None` at the end of the connection, and if the line is too long.
async fn read_line(read: &mut BufReader<OwnedReadHalf>, line: &mut Vec<u8>) -> Option<()> {
    let left = MAX_LINE_BYTES.saturating_sub(line.len() as u64);
    read.take(left).read_until(b'\n', line).await.ok()?;
    line.pop_if(|last| *last == b'\n').map(drop)
}

async fn send(write: &mut OwnedWriteHalf, text: &str) -> Option<()> {
    if text.is_empty() {
        return Some(());
    }
    timeout(WRITE_TIMEOUT, write.write_all(text.as_bytes())).await.ok()?.ok()
}
