//! The way into the process of a running cell, for other programs of this computer: a module for each system, with the same functions.
//!
//! ```text
//!  Door      opened by the cell in its run folder; lets one client in after another
//!  Caller    a client that was let in: who it is by the word of the operating system, and its two directions
//!  Knocked   the client's side: what it reads from, and what it writes to
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

    /// Answers each of so many clients with its own words.
    async fn echo(mut door: Door, clients: usize) {
        for _ in 0..clients {
            let caller = door.let_in().await.unwrap();
            assert!(caller.actor().unwrap().station.ends_with(&format!("process {}", std::process::id())));
            let (says, mut tell) = caller.into_halves();
            let mut line = String::new();
            // Who only looks whether somebody is there says nothing.
            if BufReader::new(says).read_line(&mut line).await.is_ok_and(|read| read > 0) {
                tell.write_all(line.as_bytes()).await.unwrap();
            }
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_line_gets_an_answer_while_the_door_is_open() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path();
        assert!(!is_open(folder) && ask(folder, b"x\n", Duration::from_secs(5)).is_err());
        let door = Door::open(folder).unwrap();
        let clients = tokio::spawn(echo(door, 3));
        assert!(is_open(folder));
        assert_eq!(ask(folder, b"hold\n", Duration::from_secs(5)).unwrap(), "hold\n");
        let (mut says, mut tell) = knock(folder).await.unwrap();
        tell.write_all(b"watch\n").await.unwrap();
        let mut said = [0; 6];
        says.read_exact(&mut said).await.unwrap();
        assert_eq!(&said, b"watch\n");
        assert_eq!(says.read(&mut said).await.unwrap_or(0), 0, "it was let go");
        clients.await.unwrap();
        take_away(folder);
        assert!(!is_open(folder));
    }
}
