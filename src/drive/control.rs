//! The control socket of a running cell: a person at another terminal holds, resumes, stops or aborts it, or asks how it is.
//!
//! One line of JSON in, one line out. The operating system says who is at the other end; that is what is recorded.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::{mpsc, oneshot, watch};

use super::snapshot::Snapshot;
use crate::cell::{Actor, Device};

/// The socket in a run folder.
const SOCKET: &str = "control.sock";
/// Longest line that is read.
const LONGEST_LINE: u64 = 4096;
/// A client that says nothing for so long is gone.
const PATIENCE: Duration = Duration::from_secs(10);

/// Between two tries to let a client in.
const BETWEEN_TRIES: Duration = Duration::from_millis(50);

/// What can be asked of a running cell: which machine it is about, and why, which may be empty.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields are told above them")]
#[serde(tag = "order", rename_all = "snake_case")]
pub enum Request {
    /// Come to the next safe place and wait.
    Hold {
        #[serde(default)]
        reason: String,
    },
    /// Go on.
    Resume {
        #[serde(default)]
        reason: String,
        /// The state that the person saw, by [`Snapshot::number`]: an order that was meant for another one is refused.
        #[serde(default)]
        seen: Option<u64>,
    },
    /// End in order.
    Stop {
        #[serde(default)]
        reason: String,
    },
    /// End at once: the safe sequence only.
    Abort {
        #[serde(default)]
        reason: String,
    },
    /// The right part is loaded and clamped, and no machine touches it.
    Loaded,
    /// A machine that cannot tell it was looked at: it is clear of the part.
    Clear { device: Device },
    /// A machine that cannot tell what became of its job was looked at: it stands, clear of the part, and so it was seen.
    Over { device: Device, evidence: String },
    /// The machine that a person serves has begun its job.
    Started {
        /// Identity of the map that it works by: its first 8 hexadecimal digits, or more.
        #[serde(default)]
        map: Option<String>,
    },
    /// It has ended that job, and is clear of the part; a measurement came as a file.
    Done {
        /// Identity of the map that it worked by: its first 8 hexadecimal digits, or more.
        #[serde(default)]
        map: Option<String>,
        #[serde(default)]
        file: Option<PathBuf>,
    },
    /// A machine that was to hold or to stop was looked at: it stands still. Not named, it is that of the job under way.
    Still {
        #[serde(default)]
        device: Option<Device>,
    },
    /// How is it?
    Status,
}

/// What a running cell answers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    /// Whether the order was taken.
    pub accepted: bool,
    /// Why not, or what follows, for the person who asked.
    #[serde(rename = "words")]
    pub message: String,
    /// How the cell is after it.
    pub status: Snapshot,
}

/// An order on its way to the loop.
pub(super) struct Ordered {
    pub(super) request: Request,
    pub(super) actor: Actor,
    /// Where the answer goes; none for orders of this process itself.
    pub(super) answer: Option<oneshot::Sender<Reply>>,
}

/// A socket that goes away with its owner.
pub(super) struct Control {
    path: PathBuf,
    task: tokio::task::JoinHandle<()>,
}

impl Control {
    /// Listens in a run folder.
    ///
    /// # Errors
    /// A folder in which no socket can be made, such as one with a name too long for the operating system.
    pub(super) fn listen(
        folder: &Path,
        orders: mpsc::Sender<Ordered>,
        status: watch::Receiver<Snapshot>,
    ) -> io::Result<Self> {
        let path = folder.join(SOCKET);
        // One that a killed process left behind; the lock of the journal says that nobody lives there.
        if path.exists() {
            crate::formats::remove_socket(&path)?;
        }
        let listener = UnixListener::bind(&path)?;
        let task = tokio::spawn(async move {
            loop {
                let Ok((stream, _)) = listener.accept().await else {
                    // No descriptor is left, or the client has gone: that passes, and orders must get through when it has.
                    tokio::time::sleep(BETWEEN_TRIES).await;
                    continue;
                };
                let (orders, status) = (orders.clone(), status.clone());
                // A client that misbehaves hurts itself only.
                tokio::spawn(async move { drop(tokio::time::timeout(PATIENCE, answer(stream, orders, status)).await) });
            }
        });
        Ok(Self { path, task })
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        self.task.abort();
        // Nobody listens any more; a socket left behind is replaced by the next run.
        let _ = crate::formats::remove_socket(&self.path);
    }
}

async fn answer(
    stream: UnixStream,
    orders: mpsc::Sender<Ordered>,
    status: watch::Receiver<Snapshot>,
) -> io::Result<()> {
    let actor = actor_of(&stream)?;
    let (read, mut write) = stream.into_split();
    let mut line = String::new();
    BufReader::new(read).take(LONGEST_LINE).read_line(&mut line).await?;
    let now = || status.borrow().clone();
    let reply = match serde_json::from_str(&line) {
        Ok(Request::Status) => Reply { accepted: true, message: String::new(), status: now() },
        Ok(request) => {
            let (answer, answered) = oneshot::channel();
            let over = Reply { accepted: false, message: "the run is over".into(), status: now() };
            match orders.send(Ordered { request, actor, answer: Some(answer) }).await {
                Ok(()) => answered.await.unwrap_or(over),
                Err(_) => over,
            }
        }
        Err(error) => Reply { accepted: false, message: format!("not an order: {error}"), status: now() },
    };
    let mut text = serde_json::to_vec(&reply)?;
    text.push(b'\n');
    write.write_all(&text).await
}

/// Names the person by what the operating system vouches for.
fn actor_of(stream: &UnixStream) -> io::Result<Actor> {
    let peer = stream.peer_cred()?;
    let name = match std::env::var("USER") {
        // The same user as this process: the name is known.
        Ok(name) if Some(peer.uid()) == own_uid() => format!("{name} (uid {})", peer.uid()),
        _ => format!("uid {}", peer.uid()),
    };
    let station = peer.pid().map_or("local console".to_owned(), |pid| format!("local console, process {pid}"));
    Ok(Actor { name, station })
}

fn own_uid() -> Option<u32> {
    use std::os::unix::fs::MetadataExt;
    std::fs::metadata("/proc/self").ok().map(|m| m.uid())
}

/// Whether a run goes on in a folder: somebody listens to its orders.
pub fn is_live(folder: &Path) -> bool {
    std::os::unix::net::UnixStream::connect(folder.join(SOCKET)).is_ok()
}

/// Asks a running cell; blocks for its answer.
///
/// # Errors
/// No cell that runs in that folder, and one that does not answer.
pub fn ask(folder: &Path, request: &Request) -> io::Result<Reply> {
    use std::io::{BufRead, Write};
    let mut stream = std::os::unix::net::UnixStream::connect(folder.join(SOCKET))?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let mut text = serde_json::to_vec(request)?;
    text.push(b'\n');
    stream.write_all(&text)?;
    let mut line = String::new();
    std::io::BufReader::new(stream).read_line(&mut line)?;
    Ok(serde_json::from_str(&line)?)
}
