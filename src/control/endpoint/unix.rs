//! Unix socket in the run folder. A user who can write to it can connect.

use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use regrind_cell::Actor;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};

/// File name of the socket in a run folder.
const SOCKET_FILE: &str = "control.sock";

/// Data from an accepted client.
pub(crate) type ClientReader = OwnedReadHalf;
/// Data to an accepted client.
pub(crate) type ClientWriter = OwnedWriteHalf;
/// Data from the cell, at the client.
pub(crate) type CellReader = OwnedReadHalf;
/// Data to the cell, at the client.
pub(crate) type CellWriter = OwnedWriteHalf;

/// Listening socket that accepts clients.
pub(crate) struct Endpoint {
    listener: UnixListener,
    /// Identity of the socket file. `None` if it could not be read; the socket is then not watched.
    mark: Option<EndpointIdentity>,
    /// True if only the user of this program and root may connect, independent of the permissions of the file.
    is_for_user: bool,
}

/// Path and identity of the socket file of an endpoint, to detect that the file was removed or replaced.
#[derive(Clone)]
pub(crate) struct EndpointIdentity {
    path: PathBuf,
    /// Device and inode.
    identity: [u64; 2],
}

impl Endpoint {
    /// Opens the socket in a run folder.
    pub(crate) fn open(folder: &Path) -> io::Result<Self> {
        Self::open_at(socket_path(folder))
    }

    fn open_at(path: PathBuf) -> io::Result<Self> {
        // Remove a socket that a killed process left. The lock of the journal proves that no process listens on it.
        if path.exists() {
            regrind_formats::remove_socket(&path)?;
        }
        let listener = UnixListener::bind(&path)?;
        let mark = identity(&path).ok().map(|identity| EndpointIdentity { path, identity });
        Ok(Self { listener, mark, is_for_user: false })
    }

    /// Creates a second socket at the path `place`, outside the run folder. Only the user of this program and root can
    /// connect. Always returns `Some` on Unix.
    pub(crate) fn open_for_user(place: &Path) -> io::Result<Option<Self>> {
        Self::open_at(place.to_owned()).map(|door| Some(Self { is_for_user: true, ..door }))
    }

    /// Returns the identity of the socket file, by which a removed or replaced file is recognised. Returns `None` if it
    /// could not be read.
    pub(crate) fn mark(&self) -> Option<EndpointIdentity> {
        self.mark.clone()
    }

    /// Waits for the next client and returns it.
    pub(crate) async fn accept(&mut self) -> io::Result<Client> {
        loop {
            let (stream, _) = self.listener.accept().await?;
            if !self.is_for_user || stream.peer_cred().is_ok_and(|peer| is_trusted(peer.uid())) {
                return Ok(Client(stream));
            }
        }
    }
}

impl EndpointIdentity {
    /// Returns true if the file at the path of the socket is still the one that this program created. Also returns true
    /// if this cannot be read at the moment.
    pub(crate) fn is_in_place(&self) -> bool {
        match identity(&self.path) {
            Ok(identity) => identity == self.identity,
            // A folder that cannot be read at the moment is not a missing folder.
            Err(error) => error.kind() != io::ErrorKind::NotFound,
        }
    }

    /// Creates a new socket at the same path, after its file was removed or replaced. Creates the folder too if it is
    /// missing.
    pub(crate) fn open_again(&self) -> io::Result<Endpoint> {
        if let Some(folder) = self.path.parent() {
            std::fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
        }
        Endpoint::open_at(self.path.clone())
    }
}

fn identity(path: &Path) -> io::Result<[u64; 2]> {
    std::fs::symlink_metadata(path).map(|found| [found.dev(), found.ino()])
}

/// Returns true if `uid` is the user of this program or root.
fn is_trusted(uid: u32) -> bool {
    uid == 0 || Some(uid) == own_uid()
}

/// Removes the socket from a run folder.
pub(crate) fn remove_endpoint(folder: &Path) {
    remove_endpoint_at(&socket_path(folder));
}

/// Removes the socket at a path.
pub(crate) fn remove_endpoint_at(path: &Path) {
    // No process listens any more. The next run replaces a socket that could not be removed.
    let _ = regrind_formats::remove_socket(path);
}

/// Accepted client.
pub(crate) struct Client(UnixStream);

impl Client {
    /// Returns the user and the process at the other end of a connection, as the operating system identifies them.
    pub(crate) fn actor(&self) -> io::Result<Actor> {
        let peer = self.0.peer_cred()?;
        let uid = peer.uid();
        // A user of a directory service can be missing in the local user list. The user of this process is then named
        // by `USER`.
        let own = || std::env::var("USER").ok().filter(|_| Some(uid) == own_uid());
        let name = regrind_formats::user_name(uid).or_else(own);
        let name = name.map_or_else(|| format!("uid {uid}"), |name| format!("{name} (uid {uid})"));
        let station = peer.pid().map_or("local console".to_owned(), |pid| format!("local console, process {pid}"));
        Ok(Actor { name, station })
    }

    pub(crate) fn into_halves(self) -> (ClientReader, ClientWriter) {
        self.0.into_split()
    }
}

/// Returns true if the client has already closed its end of the connection. Does not wait.
pub(crate) fn is_closed(says: &ClientReader) -> bool {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let closed = PollFlags::RDHUP | PollFlags::HUP | PollFlags::ERR;
    let at_once = Timespec { tv_sec: 0, tv_nsec: 0 };
    let mut ends = [PollFd::new(says.as_ref(), PollFlags::RDHUP)];
    poll(&mut ends, Some(&at_once)).is_ok_and(|_| ends[0].revents().intersects(closed))
}

fn own_uid() -> Option<u32> {
    std::fs::metadata("/proc/self").ok().map(|m| m.uid())
}

fn socket_path(folder: &Path) -> PathBuf {
    folder.join(SOCKET_FILE)
}

/// Returns true if a process listens on the socket of a run folder.
pub(crate) fn is_listening(folder: &Path) -> bool {
    // A listener whose queue is full exists all the same.
    connect_stream(&socket_path(folder)).map_or_else(|error| error.kind() == io::ErrorKind::TimedOut, |_| true)
}

/// Returns true if a trusted user's process listens on a socket outside a run folder.
pub(crate) fn is_listening_at(place: &Path) -> bool {
    connect_trusted(place).map_or_else(|error| error.kind() == io::ErrorKind::TimedOut, |_| true)
}

/// Sends a line to the cell of a run folder, and returns the line of its answer. `patience` is the timeout.
pub(crate) fn exchange_line(folder: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    exchange_on(connect_stream(&socket_path(folder))?, line, patience)
}

/// Sends a line to the cell that listens at a socket outside a run folder, and returns the line of its answer.
/// `patience` is the timeout. Returns an error if the socket belongs to another user than this one or root.
pub(crate) fn exchange_line_at(place: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    exchange_on(connect_trusted(place)?, line, patience)
}

/// Connects to a socket at `place`, outside a run folder. Returns an error if it belongs to a user other than this one
/// or root, because any user may be able to create files there.
fn connect_trusted(place: &Path) -> io::Result<std::os::unix::net::UnixStream> {
    if !is_trusted(std::fs::symlink_metadata(place)?.uid()) {
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, "the socket belongs to another user"));
    }
    connect_stream(place)
}

/// Connects to the socket at `place` without waiting. If the queue of the listener is full because its process does not
/// answer, returns an error of the kind `TimedOut`.
fn connect_stream(place: &Path) -> io::Result<std::os::unix::net::UnixStream> {
    use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    match connect(&socket, &SocketAddrUnix::new(place)?) {
        Err(rustix::io::Errno::AGAIN) => return Err(io::ErrorKind::TimedOut.into()),
        connected => connected?,
    }
    let stream = std::os::unix::net::UnixStream::from(socket);
    stream.set_nonblocking(false)?;
    Ok(stream)
}

fn exchange_on(mut stream: std::os::unix::net::UnixStream, line: &[u8], patience: Duration) -> io::Result<String> {
    stream.set_read_timeout(Some(patience))?;
    stream.set_write_timeout(Some(patience))?;
    stream.write_all(line)?;
    let mut text = String::new();
    match BufReader::new(stream).read_line(&mut text) {
        // The operating system reports a timeout as `WouldBlock`.
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => Err(io::ErrorKind::TimedOut.into()),
        Err(error) => Err(error),
        Ok(_) => Ok(text),
    }
}

/// Opens a connection to the cell of a run folder, which stays open for many lines.
pub(crate) async fn open_connection(folder: &Path) -> io::Result<(CellReader, CellWriter)> {
    UnixStream::connect(socket_path(folder)).await.map(UnixStream::into_split)
}
