//! Named pipe with a name derived from the run folder. Only the user of the cell can open it, and only from this
//! computer.

use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

use data_encoding::HEXLOWER;
use regrind_cell::Actor;
use sha2::{Digest, Sha256};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, ReadHalf, WriteHalf};
use tokio::net::windows::named_pipe::{ClientOptions, NamedPipeClient, NamedPipeServer};

/// Windows error code ERROR_PIPE_BUSY: every instance of the pipe has a client, and the next instance is not ready yet.
const PIPE_BUSY: i32 = 231;
/// Timeout of a client that waits for a free instance, and the pause between two attempts.
const PIPE_WAIT_TIMEOUT: Duration = Duration::from_secs(2);
const PIPE_RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// Data from an accepted client.
pub(crate) type ClientReader = ReadHalf<NamedPipeServer>;
/// Data to an accepted client.
pub(crate) type ClientWriter = WriteHalf<NamedPipeServer>;
/// Data from the cell, at the client.
pub(crate) type CellReader = ReadHalf<NamedPipeClient>;
/// Data to the cell, at the client.
pub(crate) type CellWriter = WriteHalf<NamedPipeClient>;

/// Named pipe that accepts clients.
pub(crate) struct Endpoint {
    name: String,
    /// Instance of the pipe for the next client.
    next: NamedPipeServer,
}

impl Endpoint {
    /// Creates the control pipe of the run folder `folder` and listens on it. The name of the pipe is derived from the
    /// path of the folder. Returns an error if another program already has this pipe.
    pub(crate) fn open(folder: &Path) -> io::Result<Self> {
        let name = pipe_name(folder)?;
        let next = regrind_windows::listen(&name, true).map_err(|error| match error.kind() {
            // Windows reports a name in use as access denied.
            io::ErrorKind::PermissionDenied => io::Error::new(
                io::ErrorKind::AddrInUse,
                "another program already uses the control pipe of this run; check whether this run is already open",
            ),
            _ => error,
        })?;
        Ok(Self { name, next })
    }

    /// Returns `None`, because a cell has only one endpoint on Windows. A second endpoint is for the case that the run
    /// folder is removed together with the first one. On Windows the endpoint is a pipe, which is not a file in the run
    /// folder and is not removed with it.
    pub(crate) fn open_for_user(_: &Path) -> io::Result<Option<Self>> {
        Ok(None)
    }

    /// Returns `None`: nobody can remove or replace a pipe, so it needs no identity.
    pub(crate) fn mark(&self) -> Option<EndpointIdentity> {
        None
    }

    /// Waits for the next client and returns its connection. Returns an error if the client disconnected too early, or
    /// if the pipe cannot be prepared for another client.
    pub(crate) async fn accept(&mut self) -> io::Result<Client> {
        if let Err(error) = self.next.connect().await {
            // The client disconnected before it was accepted; the instance can serve the next one.
            let _ = self.next.disconnect();
            return Err(error);
        }
        let next = regrind_windows::listen(&self.name, false)?;
        Ok(Client(std::mem::replace(&mut self.next, next)))
    }
}

/// Identity of an endpoint. The type has no values on Windows, because no endpoint is watched there.
#[derive(Clone)]
pub(crate) enum EndpointIdentity {}

impl EndpointIdentity {
    pub(crate) fn is_in_place(&self) -> bool {
        match *self {}
    }

    pub(crate) fn open_again(&self) -> io::Result<Endpoint> {
        match *self {}
    }
}

/// Does nothing: on Windows there is no endpoint outside a run folder.
pub(crate) fn remove_endpoint_at(_: &Path) {}

/// Returns false: on Windows there is no endpoint outside a run folder.
pub(crate) fn is_listening_at(_: &Path) -> bool {
    false
}

/// Always returns an error. On Unix, this function exchanges one line with the socket at a path. On Windows, an
/// endpoint exists only inside a run folder.
pub(crate) fn exchange_line_at(_: &Path, _: &[u8], _: Duration) -> io::Result<String> {
    Err(io::ErrorKind::NotFound.into())
}

/// Does nothing: a pipe is not a file in the run folder, and the system removes it with its last instance.
pub(crate) fn remove_endpoint(_: &Path) {}

/// Accepted client.
pub(crate) struct Client(NamedPipeServer);

impl Client {
    /// Returns the client of this connection: the user, and the process if known. The user is always the user of this
    /// program, because Windows lets no other user connect. Returns an error if the name of this user cannot be read.
    pub(crate) fn actor(&self) -> io::Result<Actor> {
        let process = regrind_windows::client_process(&self.0);
        let station = process.map_or("local console".to_owned(), |pid| format!("local console, process {pid}"));
        Ok(Actor { name: regrind_windows::own_name()?, station })
    }

    pub(crate) fn into_halves(self) -> (ClientReader, ClientWriter) {
        tokio::io::split(self.0)
    }
}

/// Returns false, because closed connections are not detected on Windows. The check protects against orders whose
/// client gave up while this process was suspended. On Windows only a debugger suspends a process.
pub(crate) fn is_closed(_: &ClientReader) -> bool {
    false
}

/// Returns the name of the control pipe of the run folder `folder`, computed from a hash of its absolute path.
/// Different spellings of the path give the same name. Returns an error if the folder does not exist.
fn pipe_name(folder: &Path) -> io::Result<String> {
    let whole = std::fs::canonicalize(folder)?;
    let digest = Sha256::digest(whole.as_os_str().as_encoded_bytes());
    Ok(format!(r"\\.\pipe\regrind-{}", HEXLOWER.encode(&digest[..16])))
}

/// Returns true if a process of this user listens on the control pipe of the run folder `folder`. Waits up to
/// [`PIPE_WAIT_TIMEOUT`] while the pipe is busy.
pub(crate) fn is_listening(folder: &Path) -> bool {
    let Ok(name) = pipe_name(folder) else { return false };
    block_on_thread(async move { connect_pipe(&name).await.map(drop) }).is_ok()
}

/// Sends the bytes `line` to the cell of the run folder `folder`, waits for the answer, and returns its first line.
/// `patience` is the timeout of the answer.
///
/// Returns an error if no cell listens, or if the cell does not answer in time.
pub(crate) fn exchange_line(folder: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    let (name, line) = (pipe_name(folder)?, line.to_owned());
    block_on_thread(async move {
        let mut pipe = BufReader::new(connect_pipe(&name).await?);
        pipe.write_all(&line).await?;
        let mut text = String::new();
        tokio::time::timeout(patience, pipe.read_line(&mut text)).await??;
        Ok(text)
    })
}

/// Connects to the cell of the run folder `folder` and returns the two halves of the connection, for reading and for
/// writing. The connection can carry any number of lines. Returns an error if no cell listens, or if the pipe belongs
/// to another user.
pub(crate) async fn open_connection(folder: &Path) -> io::Result<(CellReader, CellWriter)> {
    connect_pipe(&pipe_name(folder)?).await.map(tokio::io::split)
}

async fn connect_pipe(name: &str) -> io::Result<NamedPipeClient> {
    let began = Instant::now();
    loop {
        match ClientOptions::new().open(name) {
            Ok(pipe) if regrind_windows::is_of_this_user(&pipe)? => return Ok(pipe),
            Ok(_) => return Err(io::Error::new(io::ErrorKind::PermissionDenied, "the pipe belongs to another user")),
            Err(error) if error.raw_os_error() == Some(PIPE_BUSY) && began.elapsed() < PIPE_WAIT_TIMEOUT => {}
            Err(error) => return Err(error),
        }
        tokio::time::sleep(PIPE_RETRY_INTERVAL).await;
    }
}

/// Runs the future `what` to its end, blocks until then, and returns its result. Uses a separate thread with its own
/// runtime, so that the caller may itself run inside a runtime. Returns an error if the thread cannot start or panics.
fn block_on_thread<T: Send + 'static>(what: impl Future<Output = io::Result<T>> + Send + 'static) -> io::Result<T> {
    let thread = std::thread::Builder::new().spawn(move || {
        tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?.block_on(what)
    })?;
    thread.join().unwrap_or_else(|_| Err(io::Error::other("an internal error of Regrind; send the request again")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pipe_name_ignores_path_spelling() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("Run");
        std::fs::create_dir(&folder).unwrap();
        for same in [folder.join("."), home.path().join("run"), folder.join("..").join("RUN")] {
            assert_eq!(pipe_name(&same).unwrap(), pipe_name(&folder).unwrap(), "{same:?}");
        }
        assert_ne!(pipe_name(home.path()).unwrap(), pipe_name(&folder).unwrap());
        assert!(pipe_name(&home.path().join("absent")).is_err());
    }

    #[tokio::test]
    async fn door_refuses_second_open() {
        let home = tempfile::tempdir().unwrap();
        let endpoint = Endpoint::open(home.path()).unwrap();
        let refused = Endpoint::open(home.path()).err().expect("a second endpoint").to_string();
        assert!(refused.contains("another program"), "{refused}");
        drop(endpoint);
        Endpoint::open(home.path()).unwrap();
    }
}
