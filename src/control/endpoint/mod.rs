//! Entrance to the process of a running cell for other programs on this computer: one module for each operating system,
//! with the same functions.
//!
//! ```text
//!  Endpoint                 the cell opens it in its run folder; it accepts one client after another
//!  Client                   an accepted client: its user, as identified by the operating system, and its two directions
//!  CellReader, CellWriter   the side of the client: the half that it reads from, and the half that it writes to
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
    async fn echo(mut endpoint: Endpoint, clients: usize) {
        for _ in 0..clients {
            let client = endpoint.accept().await.unwrap();
            assert!(client.actor().unwrap().station.ends_with(&format!("process {}", std::process::id())));
            let (says, mut tell) = client.into_halves();
            let mut line = String::new();
            // A client that only checks for a listener sends nothing.
            if BufReader::new(says).read_line(&mut line).await.is_ok_and(|read| read > 0) {
                tell.write_all(line.as_bytes()).await.unwrap();
            }
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn door_answers_lines_while_open() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path();
        assert!(!is_listening(folder) && exchange_line(folder, b"x\n", Duration::from_secs(5)).is_err());
        let endpoint = Endpoint::open(folder).unwrap();
        let clients = tokio::spawn(echo(endpoint, 3));
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
