//! Files have modes, folders can be brought to the disk, and a lock keeps nobody from reading.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FileType, Mode, OFlags};
use rustix::io::Errno;

use super::OpenToOthers;

/// Where locks may lie, the best first: a place that is the same for every user and every session of a computer. `TMPDIR` is not.
const PLACES: [&str; 4] = ["/run/lock", "/var/lock", "/var/tmp", "/tmp"];

/// Makes a folder that nobody but its owner may look into, and those above it, where they are not there.
pub(crate) fn create_owners_folder(folder: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)
}

/// Makes the folder of a run, into which nobody but its owner may look: who reads a record can hold it up. Where the folder above hands its group down
/// to what is made in it (`chmod g+s`), that group may look too. One that is there stays as it is.
pub(crate) fn create_run_folder(folder: &Path) -> io::Result<()> {
    let above = folder.parent().filter(|above| !above.as_os_str().is_empty()).unwrap_or(Path::new("."));
    fs::create_dir_all(above)?;
    let is_shared = fs::metadata(above)?.mode() & 0o2000 != 0;
    match DirBuilder::new().mode(0o700).create(folder) {
        Ok(()) if is_shared => fs::set_permissions(folder, fs::Permissions::from_mode(0o2750)),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && folder.is_dir() => Ok(()),
        made => made,
    }
}

/// Whether every user of the computer may look into a folder.
pub(crate) fn is_open_to_all(folder: &Path) -> bool {
    fs::metadata(folder).is_ok_and(|found| found.mode() & 0o005 != 0)
}

/// Says how others than its owner may exchange what lies in a folder; none where they may not.
pub(crate) fn changeable_by_others(folder: &Path) -> io::Result<Option<OpenToOthers>> {
    let mode = fs::metadata(folder)?.mode() & 0o7777;
    let open = || OpenToOthers {
        how: format!("the mode of its folder is {mode:03o}, at most 755"),
        remedy: format!("`chmod 700 {}`", folder.display()),
    };
    Ok((mode & 0o022 != 0 && mode & 0o1000 == 0).then(open))
}

/// Makes a file that nobody but its owner may read, for writing.
pub(crate) fn create_owners_file(path: &Path) -> io::Result<File> {
    OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)
}

/// Says how others than its owner may read a file; none where they may not.
pub(crate) fn readable_by_others(path: &Path) -> io::Result<Option<OpenToOthers>> {
    let mode = fs::metadata(path)?.mode() & 0o777;
    let open = || OpenToOthers { how: format!("mode {mode:03o}, at most 600"), remedy: "`chmod 600` it".into() };
    Ok((mode & 0o077 != 0).then(open))
}

/// Brings what a file holds to the disk, whoever wrote it.
pub(crate) fn sync_file(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
}

/// Brings the names in a folder to the disk.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Tells one file from every other on this computer, whatever it is called.
pub(crate) type FileIdentity = [u64; 2];

/// Returns which file is at a path.
pub(crate) fn identity(path: &Path) -> io::Result<FileIdentity> {
    fs::metadata(path).map(|found| [found.dev(), found.ino()])
}

/// How much room is left for the user of this program on the disk of a folder.
pub(crate) fn free_bytes(folder: &Path) -> io::Result<u64> {
    let room = rustix::fs::statvfs(folder)?;
    Ok(room.f_bavail.saturating_mul(room.f_frsize))
}

/// The first place for locks that is there, that every user can write, and in which nobody can take away what is another's; none where there is no such place.
pub(crate) fn place_of_locks() -> Option<PathBuf> {
    first_for_all(&PLACES.map(Path::new)).map(Path::to_owned)
}

fn first_for_all<'a>(places: &[&'a Path]) -> Option<&'a Path> {
    let for_all =
        |place: &Path| fs::metadata(place).is_ok_and(|m| m.is_dir() && m.permissions().mode() & 0o1002 == 0o1002);
    places.iter().copied().find(|place| for_all(place))
}

/// The folder in which the locks of this computer lie. It is reached by its descriptor: whatever becomes of its name, nothing is opened elsewhere.
///
/// Anybody may write where it lies, so somebody may have been there first: what is found is looked at and never made anybody's, and no link is followed.
pub(crate) struct LockFolder {
    folder: OwnedFd,
    /// Whether every user of the computer may make files in it, or only a group.
    is_for_all: bool,
}

/// Why a folder for locks is not used.
pub(crate) struct BadFolder {
    pub(crate) what: String,
    pub(crate) remedy: String,
}

impl LockFolder {
    /// Opens it where it lies, and makes it where it is not there.
    pub(crate) fn open(place: &Path, name: &str) -> Result<Self, BadFolder> {
        let path = place.join(name);
        let bad = |what: String| {
            let remedy = format!(
                "have root do `rm -r {0}` and `install -d -o root -g root -m 1777 {0}`, or install the package, which brings it with a group",
                path.display()
            );
            BadFolder { what, remedy }
        };
        let failed = |action: &str, error: Errno| bad(format!("{action}: {}", io::Error::from(error)));
        const AS_FOLDER: OFlags = OFlags::DIRECTORY.union(OFlags::CLOEXEC);
        let place =
            rustix::fs::open(place, AS_FOLDER, Mode::empty()).map_err(|error| failed("opening its place", error))?;
        let is_made = match rustix::fs::mkdirat(&place, name, Mode::from_raw_mode(0o700)) {
            Ok(()) => true,
            Err(Errno::EXIST) => false,
            Err(error) => return Err(failed("making it", error)),
        };
        let folder = rustix::fs::openat(&place, name, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty());
        let folder = folder.map_err(|error| match error {
            Errno::LOOP | Errno::NOTDIR => bad("a link or a file lies in its place".to_owned()),
            Errno::ACCESS => BadFolder {
                what: "it is for the users of a group alone".to_owned(),
                remedy: format!(
                    "have root add you to that group (`stat -c %G {}` names it, `usermod -aG GROUP NAME` adds), and sign in anew",
                    path.display()
                ),
            },
            error => failed("opening it", error),
        })?;
        let found = rustix::fs::fstat(&folder).map_err(|error| failed("looking at it", error))?;
        let own_uid = rustix::process::geteuid().as_raw();
        if found.st_uid != own_uid && found.st_uid != 0 {
            return Err(bad(format!("it belongs to {}, who may exchange what lies in it", user_of(found.st_uid))));
        }
        if is_made {
            // Each user may make files in it, and take away his own.
            rustix::fs::fchmod(&folder, Mode::from_raw_mode(0o1777))
                .map_err(|error| failed("opening it to all", error))?;
            return Ok(Self { folder, is_for_all: true });
        }
        let mode = found.st_mode & 0o7777;
        if mode & 0o002 != 0 && mode & 0o1000 == 0 {
            return Err(bad(format!("its mode is {mode:o}: every user may take away the files of others in it")));
        }
        Ok(Self { folder, is_for_all: mode & 0o002 != 0 })
    }

    /// Opens a file in it, made where it is not there; says why it is not used where somebody laid something else in its place.
    pub(crate) fn file(&self, name: &str) -> Result<LockFile, String> {
        let words = |error: Errno| io::Error::from(error).to_string();
        let base = OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC | OFlags::NOCTTY;
        let open = |flags: OFlags| rustix::fs::openat(&self.folder, name, base | flags, Mode::from_raw_mode(0o600));
        let (file, is_made, may_write) = match open(OFlags::RDWR | OFlags::CREATE | OFlags::EXCL) {
            Ok(file) => (file, true, true),
            Err(Errno::EXIST) => match open(OFlags::RDWR) {
                Ok(file) => (file, false, true),
                // A lock needs no more than a look.
                Err(Errno::ACCESS | Errno::PERM) => {
                    let file =
                        open(OFlags::RDONLY).map_err(|error| format!("it cannot be opened: {}", words(error)))?;
                    (file, false, false)
                }
                Err(Errno::LOOP) => return Err("it is a link".to_owned()),
                Err(error) => return Err(format!("it cannot be opened: {}", words(error))),
            },
            Err(error) => return Err(format!("it cannot be made: {}", words(error))),
        };
        let found = rustix::fs::fstat(&file).map_err(words)?;
        if FileType::from_raw_mode(found.st_mode) != FileType::RegularFile {
            return Err("it is no file".to_owned());
        }
        if found.st_nlink != 1 {
            return Err(format!("it has {} names, and may be another file", found.st_nlink));
        }
        if found.st_size as u64 > MOST_TOLD {
            return Err(format!("it has {} bytes, and a lock has {MOST_TOLD} at most", found.st_size));
        }
        if is_made {
            // Who may make files here may lock this one, whatever his umask says.
            let mode = if self.is_for_all { 0o666 } else { 0o660 };
            rustix::fs::fchmod(&file, Mode::from_raw_mode(mode)).map_err(words)?;
        }
        let is_trusted = found.st_uid == 0 || found.st_uid == rustix::process::geteuid().as_raw();
        let lock = File::from(file);
        let told = if may_write { lock.try_clone().ok() } else { None };
        Ok(LockFile { lock, told, is_trusted, identity: [found.st_dev as u64, found.st_ino as u64] })
    }

    /// Tells the files of this user from those of others.
    pub(crate) fn own_mark() -> String {
        rustix::process::geteuid().as_raw().to_string()
    }
}

/// Most bytes that are told beside a lock.
const MOST_TOLD: u64 = 4096;

/// A file to be locked.
pub(crate) struct LockFile {
    pub(crate) lock: File,
    /// Where who holds it and the last epoch stand; none where that may not be written.
    pub(crate) told: Option<File>,
    /// Whether nobody but this user and root can have written it first.
    pub(crate) is_trusted: bool,
    /// Device and inode.
    identity: [u64; 2],
}

impl LockFile {
    /// Returns whether a process of another user holds a file that is this user's or root's, with what is known of it. None where the system does not tell.
    pub(crate) fn stranger(&self) -> Option<String> {
        let locks = fs::read_to_string("/proc/locks").ok()?;
        let [device, inode] = self.identity;
        let (major, minor) = (rustix::fs::major(device as _), rustix::fs::minor(device as _));
        let name = format!("{major:02x}:{minor:02x}:{inode}");
        let is_it = |line: &&str| line.split_whitespace().any(|word| word == name) && line.contains("FLOCK");
        let pid: u32 = locks.lines().find(is_it)?.split_whitespace().nth(4)?.parse().ok()?;
        let uid = fs::metadata(format!("/proc/{pid}")).ok()?.uid();
        let is_strange = self.is_trusted && uid != 0 && uid != rustix::process::geteuid().as_raw();
        is_strange.then(|| format!("process {pid} of {}", user_of(uid)))
    }
}

fn user_of(uid: u32) -> String {
    format!("the user of number {uid}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_folder_of_a_run_is_its_owners_or_its_groups() {
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
        // One that is there stays as it is.
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
    fn locks_lie_where_every_user_and_session_finds_them() {
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
