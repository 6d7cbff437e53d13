//! Entrance to the process of a running cell for other programs on this computer: one module for each operating system,
//! with the same functions.
//!
//! ```text
//!  Door      the cell opens it in its run folder; it accepts one client after another
//!  Caller    an accepted client: its user, as identified by the operating system, and its two directions
//!  Knocked   the side of the client: the half that it reads from, and the half that it writes to
//! ```

#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

#[cfg(unix)]
pub(crate) use unix::*;
#[cfg(windows)]
pub(crate) use windows::*;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};

    use super::*;

    /// Echoes one line to each of `clients` clients.
    async fn echo(mut door: Endpoint, clients: usize) {
        for _ in 0..clients {
            let caller = door.accept().await.unwrap();
            assert!(caller.actor().unwrap().station.ends_with(&format!("process {}", std::process::id())));
            let (says, mut tell) = caller.into_halves();
            let mut line = String::new();
            // A client that only checks for a listener sends nothing.
            if BufReader::new(says).read_line(&mut line).await.is_ok_and(|read| read > 0) {
                tell.write_all(line.as_bytes()).await.unwrap();
            }
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_line_gets_an_answer_while_the_door_is_open() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path();
        assert!(!is_listening(folder) && exchange_line(folder, b"x\n", Duration::from_secs(5)).is_err());
        let door = Endpoint::open(folder).unwrap();
        let clients = tokio::spawn(echo(door, 3));
        assert!(is_listening(folder));
        assert_eq!(exchange_line(folder, b"hold\n", Duration::from_secs(5)).unwrap(), "hold\n");
        let (mut says, mut tell) = open_connection(folder).await.unwrap();
        tell.write_all(b"watch\n").await.unwrap();
        let mut said = [0; 6];
        says.read_exact(&mut said).await.unwrap();
        assert_eq!(&said, b"watch\n");
        assert_eq!(says.read(&mut said).await.unwrap_or(0), 0, "it was let go");
        clients.await.unwrap();
        remove_endpoint(folder);
        assert!(!is_listening(folder));
    }
}
