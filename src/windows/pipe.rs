//! Named pipe that only its owner can open, and only from this computer.

use std::io;
use std::os::windows::io::{AsRawHandle, BorrowedHandle};

use tokio::net::windows::named_pipe::{NamedPipeClient, NamedPipeServer, ServerOptions};
use windows_sys::Win32::System::Pipes::GetNamedPipeClientProcessId;

use super::access::{OwnersAlone, is_owned_here};
use super::succeeded;

/// Creates the server end of the Windows named pipe `name`, for one client. Only the user of this process on this
/// computer can connect. If `is_first` is true, no pipe with this name may exist. If `is_first` is false, such a pipe
/// may exist, and the call adds a further server end to it.
///
/// # Errors
/// Returns an error if `name` is not a valid pipe name, if a pipe with this name belongs to another user, or if
/// `is_first` is true and a pipe with this name exists.
///
/// # Panics
/// Panics outside a tokio runtime with I/O enabled, like all sockets of tokio.
pub fn listen(name: &str, is_first: bool) -> io::Result<NamedPipeServer> {
    let owners_alone = OwnersAlone::new()?;
    let mut options = ServerOptions::new();
    options.first_pipe_instance(is_first).reject_remote_clients(true);
    // SAFETY: the attributes are complete, and their targets live longer than the call.
    unsafe { options.create_with_security_attributes_raw(name, owners_alone.attributes().cast_mut().cast()) }
}

/// Returns the process id of the client that is connected to the pipe.
///
/// # Errors
/// No client is connected.
pub fn client_process(pipe: &NamedPipeServer) -> io::Result<u32> {
    let mut process = 0;
    // SAFETY: the pipe is open, and `process` lives longer than the call.
    succeeded(unsafe { GetNamedPipeClientProcessId(pipe.as_raw_handle(), &mut process) })?;
    Ok(process)
}

/// Returns true if the server end of a pipe is owned by the user of this process. If it is not, another user created a
/// pipe of that name first.
///
/// # Errors
/// Windows does not report the owner of the pipe.
pub fn is_of_this_user(pipe: &NamedPipeClient) -> io::Result<bool> {
    // SAFETY: the pipe stays open for as long as it is borrowed, which is longer than this.
    is_owned_here(unsafe { BorrowedHandle::borrow_raw(pipe.as_raw_handle()) })
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::windows::named_pipe::ClientOptions;

    use super::*;

    fn name(of: &str) -> String {
        format!(r"\\.\pipe\regrind-test-{of}-{}", std::process::id())
    }

    #[tokio::test]
    async fn listen_refuses_second_first_instance() {
        let name = name("first");
        let first = listen(&name, true).unwrap();
        assert!(listen(&name, true).is_err(), "somebody has it");
        drop((listen(&name, false).unwrap(), first));
        listen(&name, true).unwrap();
    }

    #[tokio::test]
    async fn pipe_ends_identify_each_other() {
        let name = name("ends");
        let mut server = listen(&name, true).unwrap();
        let mut client = ClientOptions::new().open(&name).unwrap();
        server.connect().await.unwrap();
        assert!(is_of_this_user(&client).unwrap());
        assert_eq!(client_process(&server).unwrap(), std::process::id());
        client.write_all(b"hold").await.unwrap();
        let mut said = [0; 4];
        server.read_exact(&mut said).await.unwrap();
        assert_eq!(&said, b"hold");
    }
}
