//! A socket in the run folder; who may write to it may come in.

use std::io::{self, BufRead, BufReader, Write};
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
pub(crate) struct Door(UnixListener);

impl Door {
    /// Opens it in a run folder.
    pub(crate) fn open(folder: &Path) -> io::Result<Self> {
        let path = path_in(folder);
        // One that a killed process left behind; the lock of the journal says that nobody lives there.
        if path.exists() {
            regrind_formats::remove_socket(&path)?;
        }
        UnixListener::bind(&path).map(Self)
    }

    /// Waits for the next client.
    pub(crate) async fn let_in(&mut self) -> io::Result<Caller> {
        self.0.accept().await.map(|(stream, _)| Caller(stream))
    }
}

/// Takes the door out of a run folder.
pub(crate) fn take_away(folder: &Path) {
    // Nobody listens any more; a socket left behind is replaced by the next run.
    let _ = regrind_formats::remove_socket(&path_in(folder));
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

fn own_uid() -> Option<u32> {
    use std::os::unix::fs::MetadataExt;
    std::fs::metadata("/proc/self").ok().map(|m| m.uid())
}

fn path_in(folder: &Path) -> PathBuf {
    folder.join(SOCKET)
}

/// Whether somebody listens behind the door of a run folder.
pub(crate) fn is_open(folder: &Path) -> bool {
    std::os::unix::net::UnixStream::connect(path_in(folder)).is_ok()
}

/// Says a line to the cell of a run folder, and waits for the line that it answers.
pub(crate) fn ask(folder: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    let mut stream = std::os::unix::net::UnixStream::connect(path_in(folder))?;
    stream.set_read_timeout(Some(patience))?;
    stream.write_all(line)?;
    let mut text = String::new();
    BufReader::new(stream).read_line(&mut text)?;
    Ok(text)
}

/// Comes to the cell of a run folder, to stay.
pub(crate) async fn knock(folder: &Path) -> io::Result<(CellSays, TellCell)> {
    UnixStream::connect(path_in(folder)).await.map(UnixStream::into_split)
}
