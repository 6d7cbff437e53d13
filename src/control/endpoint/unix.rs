//! Unix socket in the run folder. A user who can write to it can connect.

use std::io::{self, BufRead, BufReader, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use regrind_cell::Actor;
use regrind_formats::run_files::RunFile;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};

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
    /// Creates the control socket in the run folder `folder` and listens on it. Replaces a socket file that a killed
    /// process left.
    ///
    /// Returns an error if the socket cannot be created, or if another kind of file has its name.
    pub(crate) fn open(folder: &Path) -> io::Result<Self> {
        Self::open_at(socket_path(folder))
    }

    fn open_at(path: PathBuf) -> io::Result<Self> {
        // Remove a socket that a killed process left. The lock of the journal proves that no process listens on it.
        if path.exists() {
            regrind_formats::remove_socket(&path)?;
        }
        let listener = UnixListener::bind(&ShortPath::new(&path)?.path)?;
        let mark = identity(&path).ok().map(|identity| EndpointIdentity { path, identity });
        Ok(Self { listener, mark, is_for_user: false })
    }

    /// Creates a second control socket at the path `place`, outside the run folder. Only the user of this program and
    /// root can connect. Replaces a socket file that a killed process left.
    ///
    /// On Unix the result is an error or `Some`, never `None`.
    pub(crate) fn open_for_user(place: &Path) -> io::Result<Option<Self>> {
        Self::open_at(place.to_owned()).map(|door| Some(Self { is_for_user: true, ..door }))
    }

    /// Returns path and identity (device and inode) of the socket file. With this identity a later check detects that
    /// the file was removed or replaced. Returns `None` if the identity could not be read when the socket was created.
    pub(crate) fn mark(&self) -> Option<EndpointIdentity> {
        self.mark.clone()
    }

    /// Waits for the next client and returns its connection. A socket that was created for one user ignores clients of
    /// other users, except root. Returns an error if accepting fails.
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
    /// Returns true if the socket file still exists and is the one that this program created. Returns false if the file
    /// is missing or another file has its path. Returns true if the file cannot be checked at present, for example for
    /// lack of permission.
    pub(crate) fn is_in_place(&self) -> bool {
        match identity(&self.path) {
            Ok(identity) => identity == self.identity,
            // A folder that cannot be read at the moment is not a missing folder.
            Err(error) => error.kind() != io::ErrorKind::NotFound,
        }
    }

    /// Creates a new socket at the stored path, after the socket file was removed or replaced. Also creates the folder
    /// of this path if it is missing; only the user of this program can access a folder created in this way. Returns an
    /// error if the socket cannot be created.
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

/// Removes the control socket from the run folder `folder`. Ignores errors, because the next run replaces a socket that
/// remains.
pub(crate) fn remove_endpoint(folder: &Path) {
    remove_endpoint_at(&socket_path(folder));
}

/// Removes the socket at `path`. Ignores errors, because the next run replaces a socket that remains.
pub(crate) fn remove_endpoint_at(path: &Path) {
    // No process listens any more. The next run replaces a socket that could not be removed.
    let _ = regrind_formats::remove_socket(path);
}

/// Accepted client.
pub(crate) struct Client(UnixStream);

impl Client {
    /// Returns the client of this connection as the operating system identifies it: the name and id of the user, and
    /// the id of the process if known. Returns an error if the operating system does not identify the client.
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

/// Returns true if the client has closed its end of the connection. Does not wait for data. `says` is the half of the
/// connection that reads from the client.
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
    folder.join(RunFile::ControlSocket.name())
}

/// Path of a socket, short enough for its address.
struct ShortPath {
    path: PathBuf,
    /// Folder of the socket. `path` leads through its file descriptor, so it stays open.
    _folder: Option<std::fs::File>,
}

impl ShortPath {
    /// Returns the path `path`, or one through the open folder of the socket if `path` is too long for the address of a
    /// socket. Returns an error if the folder cannot be opened.
    fn new(path: &Path) -> io::Result<Self> {
        /// Maximum length of a path in an address, in bytes, on every Unix.
        const MAX_LENGTH: usize = 103;
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else {
            return Ok(Self { path: path.to_owned(), _folder: None });
        };
        if path.as_os_str().len() <= MAX_LENGTH || !cfg!(target_os = "linux") {
            return Ok(Self { path: path.to_owned(), _folder: None });
        }
        let folder = std::fs::File::open(folder)?;
        let path = PathBuf::from(format!("/proc/self/fd/{}", folder.as_raw_fd())).join(name);
        Ok(Self { path, _folder: Some(folder) })
    }
}

/// Returns true if a process listens on the control socket of the run folder `folder`, even if this process does not
/// answer at present.
pub(crate) fn is_listening(folder: &Path) -> bool {
    // A listener whose queue is full exists all the same.
    connect_stream(&socket_path(folder)).map_or_else(|error| error.kind() == io::ErrorKind::TimedOut, |_| true)
}

/// Returns true if a process listens on the socket at the path `place`, outside a run folder. Returns false if the
/// socket file does not belong to the user of this program or to root.
pub(crate) fn is_listening_at(place: &Path) -> bool {
    connect_trusted(place).map_or_else(|error| error.kind() == io::ErrorKind::TimedOut, |_| true)
}

/// Sends the bytes `line` to the cell of the run folder `folder`, waits for the answer, and returns its first line.
/// `patience` is the timeout of each read and write.
///
/// Returns an error if no cell listens, or an error of the kind `TimedOut` if the cell does not answer in time. Returns
/// an empty text if the cell closes the connection without an answer.
pub(crate) fn exchange_line(folder: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    exchange_on(connect_stream(&socket_path(folder))?, line, patience)
}

/// Sends the bytes `line` to the cell that listens on the socket at the path `place`, outside a run folder. Waits for
/// the answer and returns its first line. `patience` is the timeout of each read and write.
///
/// Returns an error if no cell listens, if the cell does not answer in time, or if the socket file belongs to a user
/// other than the user of this program or root. Returns an empty text if the cell closes the connection without an
/// answer.
pub(crate) fn exchange_line_at(place: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    exchange_on(connect_trusted(place)?, line, patience)
}

/// Connects to the socket at the path `place`, outside a run folder. Any user may be able to create files outside a run
/// folder. So this function returns an error if the socket file does not belong to the user of this program or to root.
fn connect_trusted(place: &Path) -> io::Result<std::os::unix::net::UnixStream> {
    if !is_trusted(std::fs::symlink_metadata(place)?.uid()) {
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, "the socket belongs to another user"));
    }
    connect_stream(place)
}

/// Connects to the socket at the path `place` and returns the stream. Does not wait for the connection.
///
/// Returns an error if no process listens. Returns an error of the kind `TimedOut` if a process listens but does not
/// accept clients, so that its queue is full.
fn connect_stream(place: &Path) -> io::Result<std::os::unix::net::UnixStream> {
    use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    match connect(&socket, &SocketAddrUnix::new(&ShortPath::new(place)?.path)?) {
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

/// Connects to the cell of the run folder `folder` and returns the two halves of the connection, for reading and for
/// writing. The connection can carry any number of lines. Returns an error if no cell listens.
pub(crate) async fn open_connection(folder: &Path) -> io::Result<(CellReader, CellWriter)> {
    let place = ShortPath::new(&socket_path(folder))?;
    UnixStream::connect(&place.path).await.map(UnixStream::into_split)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn socket_in_a_folder_with_a_long_path() {
        let scratch = tempfile::tempdir().unwrap();
        let short = scratch.path().join("run");
        let long = scratch.path().join("a".repeat(120)).join("b".repeat(120));
        for folder in [short, long] {
            std::fs::create_dir_all(&folder).unwrap();
            assert!(!is_listening(&folder));
            let mut endpoint = Endpoint::open(&folder).unwrap();
            let mark = endpoint.mark().unwrap();
            assert!(mark.is_in_place() && socket_path(&folder).exists());
            let (connected, accepted) = tokio::join!(open_connection(&folder), endpoint.accept());
            assert!(connected.is_ok() && accepted.is_ok());
            assert!(is_listening(&folder));
            remove_endpoint(&folder);
            assert!(!mark.is_in_place());
            drop(endpoint);
            let again = mark.open_again().unwrap();
            assert!(is_listening(&folder));
            drop(again);
        }
    }
}
