//! Files have modes, folders can be flushed to the disk, devices have names in the file system.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;

use tempfile::TempDir;

use super::OpenToOthers;

/// Creates a file that only its owner can read and write, and opens it for writing. An existing file is an error.
pub(crate) fn create_owners(path: &Path) -> io::Result<File> {
    OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)
}

/// Gives the open file `to` the owner, the group and the permissions of the file `from`. If this program may not give
/// the file away, the group has only the permissions that all others have.
pub(crate) fn copy_access(from: &Path, to: &File) -> io::Result<()> {
    let pattern = fs::metadata(from)?;
    let is_given = std::os::unix::fs::fchown(to, Some(pattern.uid()), Some(pattern.gid())).is_ok();
    let mode = pattern.mode() & 0o777;
    let mode = if is_given { mode } else { mode & (0o707 | (mode & 0o007) << 3) };
    to.set_permissions(fs::Permissions::from_mode(mode))
}

/// Exchanges the names of two files in one step. Returns false if the file system cannot do this.
pub(crate) fn exchange(one: &Path, other: &Path) -> io::Result<bool> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    use rustix::io::Errno;
    match renameat_with(CWD, one, CWD, other, RenameFlags::EXCHANGE) {
        Ok(()) => Ok(true),
        Err(Errno::INVAL | Errno::NOSYS | Errno::NOTSUP) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Creates a folder in `parent` that only its owner can read. Its name begins with `prefix`.
pub(crate) fn create_owners_folder(prefix: &str, parent: &Path) -> io::Result<TempDir> {
    tempfile::Builder::new().prefix(prefix).permissions(fs::Permissions::from_mode(0o700)).tempdir_in(parent)
}

pub(super) fn readable_by_others(path: &Path) -> io::Result<Option<OpenToOthers>> {
    let mode = fs::metadata(path)?.mode() & 0o777;
    let open = || OpenToOthers { how: format!("mode {mode:o}"), remedy: format!("chmod 600 {}", path.display()) };
    Ok((mode & 0o077 != 0).then(open))
}

pub(super) fn is_same_file(one: &Path, other: &Path) -> io::Result<bool> {
    let identity = |path: &Path| fs::metadata(path).map(|there| (there.dev(), there.ino()));
    Ok(identity(one)? == identity(other)?)
}

pub(super) fn user_name(uid: u32) -> Option<String> {
    let users = fs::read_to_string("/etc/passwd").ok()?;
    let fields = |line: &str| line.split(':').take(3).map(str::to_owned).collect::<Vec<_>>();
    let mut users = users.lines().map(fields).filter(|fields| fields.len() == 3);
    users.find(|user| user[2].parse() == Ok(uid) && !user[0].is_empty()).map(|user| user[0].clone())
}

/// Opens the file `path` for reading. Returns an error for a named pipe, because opening it can block, and for a
/// device, because it can have no end. Pipes and devices are accepted only as `/dev/stdin` or under `/dev/fd` and
/// `/proc/self/fd`, where a shell provides the input of a program.
pub(crate) fn open_to_read(path: &Path) -> io::Result<File> {
    let kind = fs::metadata(path)?.file_type();
    let is_given =
        ["/dev/fd/", "/dev/stdin", "/proc/self/fd/"].iter().any(|place| path.starts_with(place.trim_end_matches('/')));
    if (kind.is_fifo() || kind.is_char_device() || kind.is_block_device()) && !is_given {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is a pipe or a device, not a file"));
    }
    File::open(path)
}

/// Returns true if the entry at `path` is a socket. A symbolic link to a socket is not a socket.
///
/// # Errors
/// No entry at `path`.
pub(crate) fn is_socket(path: &Path) -> io::Result<bool> {
    Ok(fs::symlink_metadata(path)?.file_type().is_socket())
}

/// Flushes a folder to the disk, so that the names of its files last after a power failure.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}
