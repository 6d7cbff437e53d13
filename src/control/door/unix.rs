//! A socket in the run folder; who may write to it may come in.

use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use regrind_cell::Actor;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};

/// The socket in a run folder.
const SOCKET: &str = "control.sock";

/// What a client that was let in says.
pub(crate) type CallerSays = OwnedReadHalf;
/// What is said to a client that was let in.
pub(crate) type TellCaller = OwnedWriteHalf;
/// What a cell says to its client.
pub(crate) type CellSays = OwnedReadHalf;
/// What a client says to its cell.
pub(crate) type TellCell = OwnedWriteHalf;

/// Where clients are let in.
pub(crate) struct Door {
    listener: UnixListener,
    /// None for one that is not watched.
    mark: Option<Mark>,
    /// Whether it is for the user of this program and root alone, whatever the modes of the place say.
    is_for_user: bool,
}

/// The socket of a door, by which it is known again.
#[derive(Clone)]
pub(crate) struct Mark {
    path: PathBuf,
    /// Device and inode.
    identity: [u64; 2],
}

impl Door {
    /// Opens it in a run folder.
    pub(crate) fn open(folder: &Path) -> io::Result<Self> {
        Self::open_at(path_in(folder))
    }

    fn open_at(path: PathBuf) -> io::Result<Self> {
        // One that a killed process left behind; the lock of the journal says that nobody lives there.
        if path.exists() {
            regrind_formats::remove_socket(&path)?;
        }
        let listener = UnixListener::bind(&path)?;
        let mark = identity(&path).ok().map(|identity| Mark { path, identity });
        Ok(Self { listener, mark, is_for_user: false })
    }

    /// Opens one that lies in no run folder, for the user of this program and root alone; none where this system has none.
    pub(crate) fn open_for_user(place: &Path) -> io::Result<Option<Self>> {
        Self::open_at(place.to_owned()).map(|door| Some(Self { is_for_user: true, ..door }))
    }

    /// Returns by which it is known again.
    pub(crate) fn mark(&self) -> Option<Mark> {
        self.mark.clone()
    }

    /// Waits for the next client.
    pub(crate) async fn let_in(&mut self) -> io::Result<Caller> {
        loop {
            let (stream, _) = self.listener.accept().await?;
            if !self.is_for_user || stream.peer_cred().is_ok_and(|peer| is_trusted(peer.uid())) {
                return Ok(Caller(stream));
            }
        }
    }
}

impl Mark {
    /// Whether the socket still lies where it was made.
    pub(crate) fn is_in_place(&self) -> bool {
        match identity(&self.path) {
            Ok(identity) => identity == self.identity,
            // A folder that cannot be looked into just now is no folder that is gone.
            Err(error) => error.kind() != io::ErrorKind::NotFound,
        }
    }

    /// Makes the socket again, and the folder around it.
    pub(crate) fn open_again(&self) -> io::Result<Door> {
        if let Some(folder) = self.path.parent() {
            std::fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
        }
        Door::open_at(self.path.clone())
    }
}

fn identity(path: &Path) -> io::Result<[u64; 2]> {
    std::fs::symlink_metadata(path).map(|found| [found.dev(), found.ino()])
}

/// Whether what belongs to a user may be believed: the user of this program, or root.
fn is_trusted(uid: u32) -> bool {
    uid == 0 || Some(uid) == own_uid()
}

/// Takes the door out of a run folder.
pub(crate) fn take_away(folder: &Path) {
    take_away_at(&path_in(folder));
}

/// Takes a door away from where it lies.
pub(crate) fn take_away_at(path: &Path) {
    // Nobody listens any more; a socket left behind is replaced by the next run.
    let _ = regrind_formats::remove_socket(path);
}

/// A client that was let in.
pub(crate) struct Caller(UnixStream);

impl Caller {
    /// Names the person by what the operating system vouches for.
    pub(crate) fn actor(&self) -> io::Result<Actor> {
        let peer = self.0.peer_cred()?;
        let uid = peer.uid();
        // A user of a directory service stands in no list of this computer; the same one as this process is known by its own name.
        let own = || std::env::var("USER").ok().filter(|_| Some(uid) == own_uid());
        let name = regrind_formats::user_name(uid).or_else(own);
        let name = name.map_or_else(|| format!("uid {uid}"), |name| format!("{name} (uid {uid})"));
        let station = peer.pid().map_or("local console".to_owned(), |pid| format!("local console, process {pid}"));
        Ok(Actor { name, station })
    }

    pub(crate) fn into_halves(self) -> (CallerSays, TellCaller) {
        self.0.into_split()
    }
}

/// Whether a client has closed its end by now.
pub(crate) fn has_gone(says: &CallerSays) -> bool {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let closed = PollFlags::RDHUP | PollFlags::HUP | PollFlags::ERR;
    let at_once = Timespec { tv_sec: 0, tv_nsec: 0 };
    let mut ends = [PollFd::new(says.as_ref(), PollFlags::RDHUP)];
    poll(&mut ends, Some(&at_once)).is_ok_and(|_| ends[0].revents().intersects(closed))
}

fn own_uid() -> Option<u32> {
    std::fs::metadata("/proc/self").ok().map(|m| m.uid())
}

fn path_in(folder: &Path) -> PathBuf {
    folder.join(SOCKET)
}

/// Whether somebody listens behind the door of a run folder.
pub(crate) fn is_open(folder: &Path) -> bool {
    // One that has no room for another caller is there all the same.
    connected(&path_in(folder)).map_or_else(|error| error.kind() == io::ErrorKind::TimedOut, |_| true)
}

/// Whether somebody whom one may believe listens behind a door that lies in no run folder.
pub(crate) fn is_open_at(place: &Path) -> bool {
    connected_at(place).map_or_else(|error| error.kind() == io::ErrorKind::TimedOut, |_| true)
}

/// Says a line to the cell of a run folder, and waits for the line that it answers.
pub(crate) fn ask(folder: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    exchanged(connected(&path_in(folder))?, line, patience)
}

/// Says a line to the cell behind a door that lies in no run folder, and waits for the line that it answers.
pub(crate) fn ask_at(place: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    exchanged(connected_at(place)?, line, patience)
}

/// Others may write where it lies: only the socket of this user, or of root, is spoken to.
fn connected_at(place: &Path) -> io::Result<std::os::unix::net::UnixStream> {
    if !is_trusted(std::fs::symlink_metadata(place)?.uid()) {
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, "the socket belongs to another user"));
    }
    connected(place)
}

/// Connects without waiting: where as many wait at the door as may, whoever is behind it does not answer.
fn connected(place: &Path) -> io::Result<std::os::unix::net::UnixStream> {
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

fn exchanged(mut stream: std::os::unix::net::UnixStream, line: &[u8], patience: Duration) -> io::Result<String> {
    stream.set_read_timeout(Some(patience))?;
    stream.set_write_timeout(Some(patience))?;
    stream.write_all(line)?;
    let mut text = String::new();
    match BufReader::new(stream).read_line(&mut text) {
        // The system's word for a time that is over.
        Err(error) if error.kind() == io::ErrorKind::WouldBlock => Err(io::ErrorKind::TimedOut.into()),
        Err(error) => Err(error),
        Ok(_) => Ok(text),
    }
}

/// Comes to the cell of a run folder, to stay.
pub(crate) async fn knock(folder: &Path) -> io::Result<(CellSays, TellCell)> {
    UnixStream::connect(path_in(folder)).await.map(UnixStream::into_split)
}
