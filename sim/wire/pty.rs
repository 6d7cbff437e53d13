//! A serial line without hardware: a pseudo-terminal whose far end a client opens by its path.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, ioctl_tiocnxcl, tcgetattr, tcsetattr};
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// Near end of a pseudo-terminal.
///
/// It keeps the far end open too: after a client closes the port or dies, another client can open the line.
#[derive(Debug)]
pub struct Pty {
    near: AsyncFd<OwnedFd>,
    far: OwnedFd,
}

/// Opens a pseudo-terminal in raw mode. In this mode, the operating system passes all bytes unchanged. Returns its near
/// end, and the path that a client opens.
///
/// # Errors
/// No pseudo-terminal is available.
///
/// # Panics
/// Panics outside of a tokio runtime.
pub fn open() -> io::Result<(Pty, PathBuf)> {
    let near = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
    grantpt(&near)?;
    unlockpt(&near)?;
    let path = PathBuf::from(std::ffi::OsString::from_vec(ptsname(&near, Vec::new())?.into_bytes()));
    let far = rustix::fs::open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let mut settings = tcgetattr(&far)?;
    settings.make_raw();
    tcsetattr(&far, OptionalActions::Now, &settings)?;
    rustix::io::ioctl_fionbio(&near, true)?;
    // The successor of this function is unsafe because others could close the descriptor; this one is owned only here.
    #[allow(deprecated)]
    let near = AsyncFd::new(near)?;
    Ok((Pty { near, far }, path))
}

/// Creates a symbolic link at the path `at`. The link points to the pseudo-terminal at the path `terminal`. Returns an
/// error if the link cannot be created, for example because `at` exists already.
pub(super) fn link(terminal: &Path, at: &Path) -> io::Result<()> {
    std::os::unix::fs::symlink(terminal, at)
}

impl AsyncRead for Pty {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        loop {
            let mut ready = ready!(self.near.poll_read_ready(cx))?;
            let read = ready.try_io(|near| Ok(rustix::io::read(near.get_ref(), buf.initialize_unfilled())?));
            let Ok(read) = read else { continue };
            // A killed client leaves the line locked for everybody except root, since it stays open here.
            let _ = ioctl_tiocnxcl(&self.far);
            return Poll::Ready(read.map(|count| buf.advance(count)));
        }
    }
}

impl AsyncWrite for Pty {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        loop {
            let mut ready = ready!(self.near.poll_write_ready(cx))?;
            if let Ok(written) = ready.try_io(|near| Ok(rustix::io::write(near.get_ref(), bytes)?)) {
                return Poll::Ready(written);
            }
        }
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}
