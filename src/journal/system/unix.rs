//! Files have modes, folders can be brought to the disk, and a lock keeps nobody from reading.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, FileType, Mode, OFlags, RenameFlags};
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
        Ok(()) if is_shared => {
            let made = rustix::fs::open(folder, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty())?;
            Ok(rustix::fs::fchmod(&made, Mode::from_raw_mode(0o2750))?)
        }
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

/// Whether a file, and no link, belongs to the user of this program or to root.
pub(crate) fn is_own_file(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_file() && is_trusted(found.uid()))
}

/// The first place for locks that is there, that every user can write, and in which nobody can take away what is another's; none where there is no such place.
pub(crate) fn place_of_locks(folder: &str) -> Option<PathBuf> {
    // One that root has set up, as the package does, comes before any other.
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

/// The folder in which the locks of this computer lie. It is reached by its descriptor: whatever becomes of its name, nothing is opened elsewhere.
///
/// Anybody may write where it lies, so somebody may have been there first: what is found is looked at and never made anybody's, and no link is followed.
/// The folder and each file come whole, with their modes, by one change of a name.
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
                "have root do `chown -h root:root {0}; chmod 1777 {0}` if it is a folder, take away what lies there if it is none, and write \
                 `d {0} 1777 root root -` into /etc/tmpfiles.d/regrind.conf; or install the package, which brings it for a group",
                path.display()
            );
            BadFolder { what, remedy }
        };
        let failed = |action: &str, error: Errno| bad(format!("{action}: {}", io::Error::from(error)));
        let place =
            rustix::fs::open(place, AS_FOLDER, Mode::empty()).map_err(|error| failed("opening its place", error))?;
        let open = || rustix::fs::openat(&place, name, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty());
        let opened = match open() {
            Err(Errno::NOENT) => {
                make_folder(&place, name).map_err(|error| failed("making it", error))?;
                open()
            }
            opened => opened,
        };
        let folder = opened.map_err(|error| match error {
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
        if !is_trusted(found.st_uid) {
            return Err(bad(format!("it belongs to {}, who may exchange what lies in it", user_of(found.st_uid))));
        }
        let mode = found.st_mode & 0o7777;
        if mode & 0o022 != 0 && mode & 0o1000 == 0 {
            return Err(bad(format!("its mode is {mode:o}: others may take away the files of each other in it")));
        }
        Ok(Self { folder, is_for_all: mode & 0o002 != 0 })
    }

    /// Opens the file of a machine, which every user of the folder may lock; says why it is not used where somebody laid something else in its place.
    pub(crate) fn shared(&self, name: &str) -> Result<LockFile, String> {
        self.file(name, if self.is_for_all { 0o666 } else { 0o660 })
    }

    /// Opens the file of a machine that is this user's alone: nobody else may open it, so that nobody else can hold or spoil it.
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
                self.make(name, mode).map_err(|error| format!("it cannot be made: {}", words(error)))?;
                open(OFlags::RDWR)
            }
            opened => opened,
        };
        let (file, may_write) = match opened {
            Ok(file) => (file, true),
            Err(Errno::LOOP) => return Err("it is a link".to_owned()),
            // A lock needs no more than a look.
            Err(Errno::ACCESS | Errno::PERM) => match open(OFlags::RDONLY) {
                Ok(file) => (file, false),
                Err(error) => return Err(format!("it cannot be opened: {}", words(error))),
            },
            Err(error) => return Err(format!("it cannot be opened: {}", words(error))),
        };
        let found = rustix::fs::fstat(&file).map_err(words)?;
        if FileType::from_raw_mode(found.st_mode) != FileType::RegularFile {
            return Err("it is no file".to_owned());
        }
        let is_spoiled = found.st_nlink != 1 || found.st_size.cast_unsigned() > MOST_TOLD;
        if is_spoiled && !is_trusted(found.st_uid) {
            let (names, bytes) = (found.st_nlink, found.st_size);
            return Err(format!("it has {names} names and {bytes} bytes, and a lock has one and {MOST_TOLD} at most"));
        }
        let lock = File::from(file);
        // One that others have spoiled is still the lock; what stands in it is left alone.
        let told = if may_write && !is_spoiled { lock.try_clone().ok() } else { None };
        let identity = [found.st_dev, found.st_ino];
        Ok(LockFile { lock, told, is_spoiled, owner: found.st_uid, identity })
    }

    /// Makes a file with its mode, unless one comes there first.
    fn make(&self, name: &str, mode: u32) -> Result<(), Errno> {
        let draft = format!(".{:016x}", rand::random::<u64>());
        let flags = AS_FILE | OFlags::RDWR | OFlags::CREATE | OFlags::EXCL;
        let file = rustix::fs::openat(&self.folder, &draft, flags, Mode::from_raw_mode(0o600))?;
        let made = rustix::fs::fchmod(&file, Mode::from_raw_mode(mode))
            .and_then(|()| rustix::fs::linkat(&self.folder, &draft, &self.folder, name, AtFlags::empty()));
        // The error that brought us here is the one to report.
        let _ = rustix::fs::unlinkat(&self.folder, &draft, AtFlags::empty());
        if made == Err(Errno::EXIST) { Ok(()) } else { made }
    }

    /// Whether a file lies still under its name: one that was taken away in between locks nothing.
    pub(crate) fn is_still(&self, name: &str, file: &LockFile) -> bool {
        let found = rustix::fs::statat(&self.folder, name, AtFlags::SYMLINK_NOFOLLOW);
        found.is_ok_and(|found| [found.st_dev, found.st_ino] == file.identity)
    }

    /// Tells the files of this user from those of others.
    pub(crate) fn own_mark() -> String {
        rustix::process::geteuid().as_raw().to_string()
    }
}

const AS_FOLDER: OFlags = OFlags::DIRECTORY.union(OFlags::CLOEXEC);
const AS_FILE: OFlags = OFlags::NOFOLLOW.union(OFlags::NONBLOCK).union(OFlags::CLOEXEC).union(OFlags::NOCTTY);

/// Makes a folder in which each user may make files, and take away his own, unless one comes there first.
fn make_folder(place: &OwnedFd, name: &str) -> Result<(), Errno> {
    let draft = format!(".{name}-{:016x}", rand::random::<u64>());
    rustix::fs::mkdirat(place, &draft, Mode::from_raw_mode(0o700))?;
    let folder = rustix::fs::openat(place, &draft, AS_FOLDER | OFlags::NOFOLLOW, Mode::empty());
    let made = folder
        .and_then(|folder| rustix::fs::fchmod(&folder, Mode::from_raw_mode(0o1777)))
        .and_then(|()| rustix::fs::renameat_with(place, &draft, place, name, RenameFlags::NOREPLACE));
    if made.is_err() {
        // The error that brought us here is the one to report.
        let _ = rustix::fs::unlinkat(place, &draft, AtFlags::REMOVEDIR);
    }
    if made == Err(Errno::EXIST) { Ok(()) } else { made }
}

fn is_trusted(uid: u32) -> bool {
    uid == 0 || uid == rustix::process::geteuid().as_raw()
}

/// Most bytes that are told beside a lock.
const MOST_TOLD: u64 = 4096;

/// A file to be locked.
pub(crate) struct LockFile {
    pub(crate) lock: File,
    /// The file that tells its holder and the last epoch; none where that may not be written.
    pub(crate) told: Option<File>,
    /// Whether others have given it further names, or more bytes than a lock has.
    pub(crate) is_spoiled: bool,
    owner: u32,
    /// Device and inode.
    identity: [u64; 2],
}

impl LockFile {
    /// Returns which process holds it, and whose that is; none where the system does not tell.
    pub(crate) fn holder(&self) -> Option<String> {
        let locks = fs::read_to_string("/proc/locks").ok()?;
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
