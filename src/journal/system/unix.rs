//! Unix: files have modes, folders can be synced to the disk, and a lock does not prevent reading.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, FileType, Mode, OFlags, RenameFlags};
use rustix::io::Errno;

use super::OpenToOthers;

/// Candidate places for locks, the best first. Each is the same for every user and every session of a computer;
/// `TMPDIR` is not.
const PLACES: [&str; 4] = ["/run/lock", "/var/lock", "/var/tmp", "/tmp"];

/// Creates a folder that only its owner can read, and its missing parents. An existing folder is accepted unchanged.
pub(crate) fn create_owners_folder(folder: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)
}

/// Creates the folder of a run and its missing parents. Only the owner can read the folder, because a process that
/// reads the database can block the process that writes records. If the parent folder passes its group on to new files
/// (`chmod g+s`), the users of that group can also read the folder. An existing folder is accepted, and its permissions
/// stay unchanged.
pub(crate) fn create_run_folder(folder: &Path) -> io::Result<()> {
    let above = folder.parent().filter(|above| !above.as_os_str().is_empty()).unwrap_or(Path::new("."));
    fs::create_dir_all(above)?;
    let is_shared = fs::metadata(above)?.mode() & 0o2000 != 0;
    match DirBuilder::new().mode(0o700).create(folder) {
        Ok(()) if is_shared => {
            let made = rustix::fs::open(folder, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty())?;
            Ok(rustix::fs::fchmod(&made, Mode::from_raw_mode(0o2750))?)
        }
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && folder.is_dir() => Ok(()),
        made => made,
    }
}

/// Returns true if every user of the computer can read or enter a folder; false if it does not exist.
pub(crate) fn is_open_to_all(folder: &Path) -> bool {
    fs::metadata(folder).is_ok_and(|found| found.mode() & 0o005 != 0)
}

/// Returns the reason why other users can replace files in a folder (the permissions of the folder), and the command
/// that prevents this. Returns `None` if other users cannot replace files.
pub(crate) fn changeable_by_others(folder: &Path) -> io::Result<Option<OpenToOthers>> {
    let mode = fs::metadata(folder)?.mode() & 0o7777;
    let open = || OpenToOthers {
        how: format!("the mode of its folder is {mode:03o}, at most 755"),
        remedy: format!("`chmod 700 {}`", folder.display()),
    };
    Ok((mode & 0o022 != 0 && mode & 0o1000 == 0).then(open))
}

/// Creates a file that only its owner can read, and opens it for writing. An existing file is an error.
pub(crate) fn create_owners_file(path: &Path) -> io::Result<File> {
    OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)
}

/// Returns the reason why other users have access to a file (the permissions of the file), and the command that
/// prevents this. Returns `None` if only the owner has access.
pub(crate) fn readable_by_others(path: &Path) -> io::Result<Option<OpenToOthers>> {
    let mode = fs::metadata(path)?.mode() & 0o777;
    let open = || OpenToOthers { how: format!("mode {mode:03o}, at most 600"), remedy: "`chmod 600` it".into() };
    Ok((mode & 0o077 != 0).then(open))
}

/// Flushes the content of a file to the disk, even if another process wrote it.
pub(crate) fn sync_file(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Flushes a folder to the disk, so that the names of its files last after a power failure.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Device and inode: identify a file on this computer, whatever its name.
pub(crate) type FileIdentity = [u64; 2];

/// Returns the device and the inode of the file at a path.
pub(crate) fn identity(path: &Path) -> io::Result<FileIdentity> {
    fs::metadata(path).map(|found| [found.dev(), found.ino()])
}

/// Returns the free space, in bytes, that the user of this program has on the disk of a folder.
pub(crate) fn free_bytes(folder: &Path) -> io::Result<u64> {
    let room = rustix::fs::statvfs(folder)?;
    Ok(room.f_bavail.saturating_mul(room.f_frsize))
}

/// Returns true if `path` is a regular file, and no link, that belongs to the user of this program or to root.
pub(crate) fn is_own_file(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_file() && is_trusted(found.uid()))
}

/// Selects the parent folder of the lock folder. `folder` is the name of the lock folder. The candidates are
/// [`PLACES`], such as `/run/lock` and `/tmp`, in this order.
///
/// Returns the first candidate in which root has already created the lock folder. If there is none, returns the first
/// candidate in which every user can create files but cannot remove files of other users (sticky bit). Returns `None`
/// if no candidate has one of these two properties.
pub(crate) fn place_of_locks(folder: &str) -> Option<PathBuf> {
    // A folder that root has created, as the package does, comes before any other.
    let by_root =
        |place: &&str| fs::symlink_metadata(Path::new(place).join(folder)).is_ok_and(|m| m.is_dir() && m.uid() == 0);
    let set_up = PLACES.iter().find(|place| by_root(place)).map(PathBuf::from);
    set_up.or_else(|| first_for_all(&PLACES.map(Path::new)).map(Path::to_owned))
}

fn first_for_all<'a>(places: &[&'a Path]) -> Option<&'a Path> {
    let for_all =
        |place: &Path| fs::metadata(place).is_ok_and(|m| m.is_dir() && m.permissions().mode() & 0o1002 == 0o1002);
    places.iter().copied().find(|place| for_all(place))
}

/// Folder for the locks of this computer. It is accessed by its descriptor: even if its name changes, no file is opened
/// elsewhere.
///
/// Every user can write to the parent place, so another user could have created the folder or a file first. Existing
/// entries are therefore checked, their owner and mode are never changed, and no link is followed. The folder and each
/// file appear complete, with their modes, by one atomic rename or link.
pub(crate) struct LockFolder {
    folder: OwnedFd,
    /// True if every user of the computer can create files in it; false if only a group can.
    is_for_all: bool,
}

/// Reason why a folder for locks cannot be used, with the remedy.
pub(crate) struct BadFolder {
    pub(crate) description: String,
    pub(crate) remedy: String,
}

impl LockFolder {
    /// Opens the lock folder `name` in the parent folder `place`. Creates the lock folder if it does not exist.
    ///
    /// # Errors
    /// `name` is a link or a file. The folder belongs to a user who is neither this user nor root. Users can remove
    /// files of other users in the folder. The folder cannot be created or opened.
    pub(crate) fn open(place: &Path, name: &str) -> Result<Self, BadFolder> {
        let path = place.join(name);
        let bad = |description: String| {
            let remedy = format!(
                "as root, run `chown -h root:root {0}; chmod 1777 {0}` if it is a folder, or remove it if it is not, \
                 and write `d {0} 1777 root root -` into /etc/tmpfiles.d/regrind.conf; or install the package, which \
                 creates it for a group",
                path.display()
            );
            BadFolder { description, remedy }
        };
        let failed = |action: &str, error: Errno| bad(format!("{action}: {}", io::Error::from(error)));
        let place = rustix::fs::open(place, AS_FOLDER, Mode::empty())
            .map_err(|error| failed("opening its parent folder", error))?;
        let open = || rustix::fs::openat(&place, name, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty());
        let opened = match open() {
            Err(Errno::NOENT) => {
                make_folder(&place, name).map_err(|error| failed("creating it", error))?;
                open()
            }
            opened => opened,
        };
        let folder = opened.map_err(|error| match error {
            Errno::LOOP | Errno::NOTDIR => bad("it is a link or a file".to_owned()),
            Errno::ACCESS => BadFolder {
                description: "it is only for the users of a group".to_owned(),
                remedy: format!(
                    "have root add you to that group (`stat -c %G {}` shows the group, `usermod -aG GROUP NAME` \
                     adds), and sign in again",
                    path.display()
                ),
            },
            error => failed("opening it", error),
        })?;
        let found = rustix::fs::fstat(&folder).map_err(|error| failed("inspecting it", error))?;
        if !is_trusted(found.st_uid) {
            return Err(bad(format!("it belongs to {}, so that user can replace its files", user_of(found.st_uid))));
        }
        let mode = found.st_mode & 0o7777;
        if mode & 0o022 != 0 && mode & 0o1000 == 0 {
            return Err(bad(format!("its mode is {mode:o}: users can remove each other's files in it")));
        }
        Ok(Self { folder, is_for_all: mode & 0o002 != 0 })
    }

    /// Opens the lock file `name`, which several users share. If the file does not exist, creates it. All users that
    /// can use the lock folder can then lock the file.
    ///
    /// # Errors
    /// The entry `name` cannot be used as a lock file, for example because it is a link. The error is the reason as a
    /// text.
    pub(crate) fn shared(&self, name: &str) -> Result<LockFile, String> {
        self.file(name, if self.is_for_all { 0o666 } else { 0o660 })
    }

    /// Opens the lock file `name` of this user. If the file does not exist, creates it so that no other user can open
    /// it. Other users therefore cannot lock or damage the file.
    ///
    /// # Errors
    /// The entry `name` cannot be used as a lock file, for example because it belongs to another user. The error is the
    /// reason as a text.
    pub(crate) fn own(&self, name: &str) -> Result<LockFile, String> {
        let file = self.file(name, 0o600)?;
        if file.owner != rustix::process::geteuid().as_raw() {
            return Err(format!("it belongs to {}", user_of(file.owner)));
        }
        Ok(file)
    }

    fn file(&self, name: &str, mode: u32) -> Result<LockFile, String> {
        let words = |error: Errno| io::Error::from(error).to_string();
        let open = |flags: OFlags| rustix::fs::openat(&self.folder, name, AS_FILE | flags, Mode::empty());
        let opened = match open(OFlags::RDWR) {
            Err(Errno::NOENT) => {
                self.make(name, mode).map_err(|error| format!("it cannot be created: {}", words(error)))?;
                open(OFlags::RDWR)
            }
            opened => opened,
        };
        let (file, may_write) = match opened {
            Ok(file) => (file, true),
            Err(Errno::LOOP) => return Err("it is a link".to_owned()),
            // Read access is sufficient for a lock.
            Err(Errno::ACCESS | Errno::PERM) => match open(OFlags::RDONLY) {
                Ok(file) => (file, false),
                Err(error) => return Err(format!("it cannot be opened: {}", words(error))),
            },
            Err(error) => return Err(format!("it cannot be opened: {}", words(error))),
        };
        let found = rustix::fs::fstat(&file).map_err(words)?;
        if FileType::from_raw_mode(found.st_mode) != FileType::RegularFile {
            return Err("it is not a file".to_owned());
        }
        let is_spoiled = found.st_nlink != 1 || found.st_size.cast_unsigned() > MAX_HOLDER_BYTES;
        if is_spoiled && !is_trusted(found.st_uid) {
            let (names, bytes) = (found.st_nlink, found.st_size);
            return Err(format!(
                "it has {names} names and {bytes} bytes; a lock has one name and at most {MAX_HOLDER_BYTES} bytes"
            ));
        }
        let lock = File::from(file);
        // A lock file that others have damaged is still the lock, but its content is neither read nor changed.
        let holder_file = if may_write && !is_spoiled { lock.try_clone().ok() } else { None };
        let identity = [found.st_dev, found.st_ino];
        Ok(LockFile { lock, holder_file, is_spoiled, owner: found.st_uid, identity })
    }

    /// Creates the file `name` with the permissions `mode`. If another process creates it first, that file is accepted.
    fn make(&self, name: &str, mode: u32) -> Result<(), Errno> {
        let draft = format!(".{:016x}", rand::random::<u64>());
        let flags = AS_FILE | OFlags::RDWR | OFlags::CREATE | OFlags::EXCL;
        let file = rustix::fs::openat(&self.folder, &draft, flags, Mode::from_raw_mode(0o600))?;
        let made = rustix::fs::fchmod(&file, Mode::from_raw_mode(mode))
            .and_then(|()| rustix::fs::linkat(&self.folder, &draft, &self.folder, name, AtFlags::empty()));
        // Report the first error, not that of the cleanup.
        let _ = rustix::fs::unlinkat(&self.folder, &draft, AtFlags::empty());
        if made == Err(Errno::EXIST) { Ok(()) } else { made }
    }

    /// Returns true if the entry `name` of the lock folder is still the open `file`. Returns false if the entry was
    /// removed or replaced in the meantime. A lock on a removed file does not exclude other processes.
    pub(crate) fn is_still(&self, name: &str, file: &LockFile) -> bool {
        let found = rustix::fs::statat(&self.folder, name, AtFlags::SYMLINK_NOFOLLOW);
        found.is_ok_and(|found| [found.st_dev, found.st_ino] == file.identity)
    }

    /// Returns the part of a lock file name that identifies the user of this program: the user number (uid).
    pub(crate) fn own_mark() -> String {
        rustix::process::geteuid().as_raw().to_string()
    }
}

const AS_FOLDER: OFlags = OFlags::DIRECTORY.union(OFlags::CLOEXEC);
const AS_FILE: OFlags = OFlags::NOFOLLOW.union(OFlags::NONBLOCK).union(OFlags::CLOEXEC).union(OFlags::NOCTTY);

/// Creates the folder `name` in the folder `place`. Every user can create files in the new folder, but can remove only
/// their own files. If another process creates the folder first, that folder is accepted.
fn make_folder(place: &OwnedFd, name: &str) -> Result<(), Errno> {
    let draft = format!(".{name}-{:016x}", rand::random::<u64>());
    rustix::fs::mkdirat(place, &draft, Mode::from_raw_mode(0o700))?;
    let folder = rustix::fs::openat(place, &draft, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty());
    let made = folder
        .and_then(|folder| rustix::fs::fchmod(&folder, Mode::from_raw_mode(0o1777)))
        .and_then(|()| rustix::fs::renameat_with(place, &draft, place, name, RenameFlags::NOREPLACE));
    if made.is_err() {
        // Report the first error, not that of the cleanup.
        let _ = rustix::fs::unlinkat(place, &draft, AtFlags::REMOVEDIR);
    }
    if made == Err(Errno::EXIST) { Ok(()) } else { made }
}

fn is_trusted(uid: u32) -> bool {
    uid == 0 || uid == rustix::process::geteuid().as_raw()
}

/// Maximum length of a lock file, in bytes.
const MAX_HOLDER_BYTES: u64 = 4096;

/// File to be locked.
pub(crate) struct LockFile {
    pub(crate) lock: File,
    /// File that stores the holder and the last epoch; `None` if it must not be written.
    pub(crate) holder_file: Option<File>,
    /// True if others have given the file additional names, or more bytes than a lock file has.
    pub(crate) is_spoiled: bool,
    owner: u32,
    /// Device and inode.
    identity: [u64; 2],
}

impl LockFile {
    /// Returns the process that holds the lock and the user of this process, for messages: `process 123 of the user of
    /// number 1000`. Returns `None` if the operating system does not report the holder.
    pub(crate) fn holder(&self) -> Option<String> {
        // The list is read in pieces, so an entry can be missed while other programs lock and unlock.
        const TRIES: usize = 8;
        (0..TRIES).find_map(|_| self.holder_in(&fs::read_to_string("/proc/locks").ok()?))
    }

    /// Returns the process that holds this file in a list of all locks, and its user.
    fn holder_in(&self, locks: &str) -> Option<String> {
        let [device, inode] = self.identity;
        let (major, minor) = (rustix::fs::major(device as _), rustix::fs::minor(device as _));
        let name = format!("{major:02x}:{minor:02x}:{inode}");
        let is_it = |line: &&str| line.split_whitespace().any(|word| word == name) && line.contains("FLOCK");
        let pid: u32 = locks.lines().find(is_it)?.split_whitespace().nth(4)?.parse().ok()?;
        let uid = fs::metadata(format!("/proc/{pid}")).ok()?.uid();
        Some(format!("process {pid} of {}", user_of(uid)))
    }
}

fn user_of(uid: u32) -> String {
    format!("the user of number {uid}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_folder_permissions() {
        let home = tempfile::tempdir().unwrap();
        let mode = |folder: &Path| fs::metadata(folder).unwrap().mode() & 0o7777;
        let own = home.path().join("runs/a");
        create_run_folder(&own).unwrap();
        assert_eq!((mode(&own), is_open_to_all(&own)), (0o700, false));
        let shared = home.path().join("shared");
        fs::create_dir(&shared).unwrap();
        fs::set_permissions(&shared, fs::Permissions::from_mode(0o2775)).unwrap();
        create_run_folder(&shared.join("a")).unwrap();
        assert_eq!((mode(&shared.join("a")), is_open_to_all(&shared.join("a"))), (0o2750, false));
        // An existing folder keeps its mode.
        let open = home.path().join("open");
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o755)).unwrap();
        create_run_folder(&open).unwrap();
        assert_eq!((mode(&open), is_open_to_all(&open)), (0o755, true));
        assert!(create_run_folder(&home.path().join("open/b\0")).is_err());
        for (mode, may_change) in [(0o700, false), (0o755, false), (0o775, true), (0o777, true), (0o1777, false)] {
            fs::set_permissions(&open, fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(changeable_by_others(&open).unwrap().is_some(), may_change, "{mode:o}");
        }
    }

    #[test]
    fn first_for_all_finds_shared_folder() {
        let home = tempfile::tempdir().unwrap();
        let [shared, own] = ["shared", "own"].map(|name| home.path().join(name));
        for (folder, mode) in [(&shared, 0o1777), (&own, 0o755)] {
            fs::create_dir(folder).unwrap();
            fs::set_permissions(folder, fs::Permissions::from_mode(mode)).unwrap();
        }
        let missing = home.path().join("missing");
        assert_eq!(first_for_all(&[&missing, &own, &shared]), Some(&*shared));
        assert_eq!(first_for_all(&[&own, &missing]), None);
    }
}
