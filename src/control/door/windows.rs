//! A named pipe, called after the run folder; only the user whose cell it is may open it, and only from this computer.

use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

use regrind_cell::Actor;
use sha2::{Digest, Sha256};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, ReadHalf, WriteHalf};
use tokio::net::windows::named_pipe::{ClientOptions, NamedPipeClient, NamedPipeServer};

/// Windows says so where every end of a pipe has its client, and the next end is being made (ERROR_PIPE_BUSY).
const ALL_TAKEN: i32 = 231;
/// How long a client waits for an end of its own, and between two tries.
const FOR_AN_END: Duration = Duration::from_secs(2);
const BETWEEN_TRIES: Duration = Duration::from_millis(20);

/// What a client that was let in says.
pub(crate) type CallerSays = ReadHalf<NamedPipeServer>;
/// What is said to a client that was let in.
pub(crate) type TellCaller = WriteHalf<NamedPipeServer>;
/// What a cell says to its client.
pub(crate) type CellSays = ReadHalf<NamedPipeClient>;
/// What a client says to its cell.
pub(crate) type TellCell = WriteHalf<NamedPipeClient>;

/// Where clients are let in.
pub(crate) struct Door {
    name: String,
    /// The end of the pipe for the next client.
    next: NamedPipeServer,
}

impl Door {
    /// Opens it for a run folder.
    pub(crate) fn open(folder: &Path) -> io::Result<Self> {
        let name = name_of(folder)?;
        let next = regrind_windows::listen(&name, true).map_err(|error| match error.kind() {
            // Windows says of a name that is taken that it is not allowed.
            io::ErrorKind::PermissionDenied => {
                io::Error::new(io::ErrorKind::AddrInUse, "another program has the control pipe of this run")
            }
            _ => error,
        })?;
        Ok(Self { name, next })
    }

    /// Opens one that lies in no run folder: a pipe lies in none, and cannot be taken away.
    pub(crate) fn open_for_user(_: &Path) -> io::Result<Option<Self>> {
        Ok(None)
    }

    /// Returns by which it is known again: a pipe is not watched, for nobody can take it away.
    pub(crate) fn mark(&self) -> Option<Mark> {
        None
    }

    /// Waits for the next client.
    pub(crate) async fn let_in(&mut self) -> io::Result<Caller> {
        if let Err(error) = self.next.connect().await {
            // The client has gone before it was let in; the end is good for the next one.
            let _ = self.next.disconnect();
            return Err(error);
        }
        let next = regrind_windows::listen(&self.name, false)?;
        Ok(Caller(std::mem::replace(&mut self.next, next)))
    }
}

/// No door of this system has one.
#[derive(Clone)]
pub(crate) enum Mark {}

impl Mark {
    pub(crate) fn is_in_place(&self) -> bool {
        match *self {}
    }

    pub(crate) fn open_again(&self) -> io::Result<Door> {
        match *self {}
    }
}

/// No door lies anywhere else.
pub(crate) fn take_away_at(_: &Path) {}

/// No door lies anywhere else.
pub(crate) fn is_open_at(_: &Path) -> bool {
    false
}

/// No door lies anywhere else.
pub(crate) fn ask_at(_: &Path, _: &[u8], _: Duration) -> io::Result<String> {
    Err(io::ErrorKind::NotFound.into())
}

/// Takes the door away: a pipe goes with its last end, and lies in no folder.
pub(crate) fn take_away(_: &Path) {}

/// A client that was let in.
pub(crate) struct Caller(NamedPipeServer);

impl Caller {
    /// Names the person by what the operating system vouches for: it lets nobody but this user in.
    pub(crate) fn actor(&self) -> io::Result<Actor> {
        let process = regrind_windows::client_process(&self.0);
        let station = process.map_or("local console".to_owned(), |pid| format!("local console, process {pid}"));
        Ok(Actor { name: regrind_windows::own_name()?, station })
    }

    pub(crate) fn into_halves(self) -> (CallerSays, TellCaller) {
        tokio::io::split(self.0)
    }
}

/// Whether a client has closed its end: a process that is held up here is in a debugger, whose user knows of it.
pub(crate) fn has_gone(_: &CallerSays) -> bool {
    false
}

/// The name of the pipe of a run folder, however the folder is called by who asks.
fn name_of(folder: &Path) -> io::Result<String> {
    let whole = std::fs::canonicalize(folder)?;
    let digest = Sha256::digest(whole.as_os_str().as_encoded_bytes());
    let digits: String = digest[..16].iter().map(|byte| format!("{byte:02x}")).collect();
    Ok(format!(r"\\.\pipe\regrind-{digits}"))
}

/// Whether somebody listens behind the door of a run folder.
pub(crate) fn is_open(folder: &Path) -> bool {
    let Ok(name) = name_of(folder) else { return false };
    on_a_thread_of_its_own(async move { connected(&name).await.map(drop) }).is_ok()
}

/// Says a line to the cell of a run folder, and waits for the line that it answers.
pub(crate) fn ask(folder: &Path, line: &[u8], patience: Duration) -> io::Result<String> {
    let (name, line) = (name_of(folder)?, line.to_owned());
    on_a_thread_of_its_own(async move {
        let mut pipe = BufReader::new(connected(&name).await?);
        pipe.write_all(&line).await?;
        let mut text = String::new();
        tokio::time::timeout(patience, pipe.read_line(&mut text)).await??;
        Ok(text)
    })
}

/// Comes to the cell of a run folder, to stay.
pub(crate) async fn knock(folder: &Path) -> io::Result<(CellSays, TellCell)> {
    connected(&name_of(folder)?).await.map(tokio::io::split)
}

async fn connected(name: &str) -> io::Result<NamedPipeClient> {
    let began = Instant::now();
    loop {
        match ClientOptions::new().open(name) {
            Ok(pipe) if regrind_windows::is_of_this_user(&pipe)? => return Ok(pipe),
            Ok(_) => return Err(io::Error::new(io::ErrorKind::PermissionDenied, "the pipe belongs to another user")),
            Err(error) if error.raw_os_error() == Some(ALL_TAKEN) && began.elapsed() < FOR_AN_END => {}
            Err(error) => return Err(error),
        }
        tokio::time::sleep(BETWEEN_TRIES).await;
    }
}

/// Waits for something that may take a while, for who cannot wait himself. Only what waits can end before a pipe answers, and whoever
/// asks may be a part of something that waits already: so a thread, and a runtime, of its own.
fn on_a_thread_of_its_own<T: Send + 'static>(
    what: impl Future<Output = io::Result<T>> + Send + 'static,
) -> io::Result<T> {
    let thread = std::thread::Builder::new().spawn(move || {
        tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?.block_on(what)
    })?;
    thread.join().unwrap_or_else(|_| Err(io::Error::other("the thread that asks has ended")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_has_one_name_however_its_folder_is_called() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("Run");
        std::fs::create_dir(&folder).unwrap();
        for same in [folder.join("."), home.path().join("run"), folder.join("..").join("RUN")] {
            assert_eq!(name_of(&same).unwrap(), name_of(&folder).unwrap(), "{same:?}");
        }
        assert_ne!(name_of(home.path()).unwrap(), name_of(&folder).unwrap());
        assert!(name_of(&home.path().join("absent")).is_err());
    }

    #[tokio::test]
    async fn a_door_that_is_open_is_not_opened_by_another_program() {
        let home = tempfile::tempdir().unwrap();
        let door = Door::open(home.path()).unwrap();
        let refused = Door::open(home.path()).err().expect("a second door").to_string();
        assert!(refused.contains("another program"), "{refused}");
        drop(door);
        Door::open(home.path()).unwrap();
    }
}
