//! Locks that let a machine serve only one run at a time on this computer. The lock ends with the process that holds
//! it.
//!
//! The lock file also keeps the last epoch that a client of this computer used for the machine. The next epoch is
//! therefore higher, whatever the clock shows.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use super::canonical::sha256_hex;
use super::error::JournalError;
use super::locked_file::LockedFile;
use super::system;
use super::system::{LockFile, LockFolder};

/// Lock of a machine. While it lives, no other run on this computer can take the machine.
///
/// Two files are locked: one that all users share, and one of this user only. If another user put something else in the
/// place of the shared file, a note reports it, and the file of this user still keeps the runs of this user apart.
#[derive(Debug)]
pub struct MachineLock {
    /// Both locked files. They are held, not read.
    held: Vec<LockedFile>,
    /// The files that store the holder and the epoch.
    holder_files: Vec<File>,
    holder: String,
    last_epoch: u32,
    notes: Vec<String>,
    /// Path of the control socket next to the lock file of this user.
    control_socket: PathBuf,
}

const FOLDER: &str = "regrind-machines";
/// Prefix of the line that stores the epoch in the lock file.
const EPOCH: &str = "epoch ";
/// Number of bits of an epoch, which is a clock time in seconds. A higher value was not written by a client of this
/// computer.
const EPOCH_BITS: u32 = 31;
/// Maximum number of bytes that are read of the holder and the epoch.
const MAX_HOLDER_BYTES: u64 = 4096;
/// Number of file names of this user that are tried if others occupied some of them.
const OWN_FILES: usize = 16;
/// Number of attempts to open a file again if it was removed while it was being locked.
const TRIES: usize = 5;
/// Extension of the file name of the control socket next to a lock.
const DOOR: &str = "sock";
/// Separator between the run and the process in the stored holder.
const PROCESS: &str = ", process ";

/// Function that opens a lock file of a machine.
type Opens = fn(&LockFolder, &str) -> Result<LockFile, String>;

impl MachineLock {
    /// Locks a machine for the run in the folder `run`. The lock lasts until the returned value is dropped. `address`
    /// identifies the machine. Every run must use the same text for the same machine.
    ///
    /// # Errors
    /// Another run uses the machine (the error names that run), or no folder for lock files can be used.
    pub fn acquire(address: &str, run: &Path) -> Result<Self, JournalError> {
        // If there is no place that all users share, the user's own place is better than no lock.
        Self::acquire_in(&system::place_of_locks(FOLDER).unwrap_or_else(std::env::temp_dir), address, run)
    }

    /// Returns a new epoch for `machines`, the locked machines of one run. An epoch is a number that identifies a
    /// session of a client with a machine. Stores the new epoch in the lock files of these machines. `clock` is the
    /// current time in seconds. The new epoch is at least `clock`. It is also higher than every epoch that was stored
    /// in the lock files when the machines were locked.
    pub fn epoch<'a>(machines: impl IntoIterator<Item = &'a Self> + Clone, clock: u32) -> u32 {
        let last = machines.clone().into_iter().map(|machine| machine.last_epoch).max().unwrap_or(0);
        let epoch = clock.max(last.saturating_add(1));
        machines.into_iter().for_each(|machine| machine.write(epoch));
        epoch
    }

    /// Returns the path of the control socket. The socket gives access to the cell that has locked this machine. The
    /// socket is in the same folder as the lock file of this user. Therefore the cell can still be reached if the run
    /// folder was deleted.
    pub fn control_socket(&self) -> &Path {
        &self.control_socket
    }

    /// Lists the cells of this user that have locked machines on this computer. Each item has the path of the run
    /// folder and the path of the control socket. The list can contain a cell whose process was killed; then no process
    /// answers at the socket. The list is empty on Windows.
    pub fn control_sockets() -> Vec<(PathBuf, PathBuf)> {
        system::place_of_locks(FOLDER).map_or_else(Vec::new, |place| Self::doors_in(&place.join(FOLDER)))
    }

    fn doors_in(folder: &Path) -> Vec<(PathBuf, PathBuf)> {
        let entries = std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
        let doors = entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|end| end == DOOR));
        let run_of = |door: &Path| {
            let lock = door.with_extension("lock");
            if !system::is_own_file(&lock) {
                return None;
            }
            let told = text_of(&File::open(lock).ok()?);
            told.lines().next()?.rsplit_once(PROCESS).map(|(run, _)| PathBuf::from(run))
        };
        doors.filter_map(|door| Some((run_of(&door)?, door))).collect()
    }

    /// Returns warnings about the lock files of this machine, one text per warning. Examples are a link or a file of
    /// another user at the path of a lock file, or an impossible content. The lock ignores such files and contents.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    fn acquire_in(place: &Path, address: &str, run: &Path) -> Result<Self, JournalError> {
        let path = place.join(FOLDER);
        let folder = LockFolder::open(place, FOLDER).map_err(|bad| JournalError::LockFolder {
            path: path.clone(),
            what: bad.description,
            remedy: bad.remedy,
        })?;
        let machine = &sha256_hex(address.as_bytes())[..16];
        let mut lock = Self {
            held: Vec::new(),
            holder_files: Vec::new(),
            holder: format!("{}{PROCESS}{}", run.display(), std::process::id()),
            last_epoch: 0,
            notes: Vec::new(),
            control_socket: PathBuf::new(),
        };
        let (shared, own): (Opens, Opens) = (LockFolder::shared, LockFolder::own);
        let name = format!("{machine}.lock");
        if let Err(what) = lock.lock_file(&folder, (&name, shared), (&path, address))? {
            lock.note(&path.join(&name), &what);
        }
        let own_name = |k: usize| match k {
            0 => format!("{machine}.{}.lock", LockFolder::own_mark()),
            k => format!("{machine}.{}-{k}.lock", LockFolder::own_mark()),
        };
        for name in (0..OWN_FILES).map(own_name) {
            match lock.lock_file(&folder, (&name, own), (&path, address))? {
                Ok(()) => {
                    lock.control_socket = path.join(&name).with_extension(DOOR);
                    lock.write(lock.last_epoch);
                    return Ok(lock);
                }
                Err(what) => lock.note(&path.join(&name), &what),
            }
        }
        let remedy = format!("as root, remove the files in {} that no process holds", path.display());
        Err(JournalError::LockFolder { path, what: lock.notes.join("; "), remedy })
    }

    /// Locks a machine by its lock file `name` in `folder`, and reads the last epoch (session number) from the file.
    /// `open` is the function that opens the file. `path` is the path of `folder`, and `address` is the address of the
    /// machine; both are only used for messages.
    ///
    /// Returns `Ok(Ok(()))` if the file is locked. The lock is then stored in `self`. Returns `Ok(Err(reason))` if the
    /// entry `name` cannot be used as a lock file, for example because it is a link. The caller can then use another
    /// name.
    ///
    /// # Errors
    /// Another process holds the lock, or the file cannot be locked.
    fn lock_file(
        &mut self,
        folder: &LockFolder,
        (name, open): (&str, Opens),
        (path, address): (&Path, &str),
    ) -> Result<Result<(), String>, JournalError> {
        let path = path.join(name);
        for _ in 0..TRIES {
            let file = match open(folder, name) {
                Ok(file) => file,
                Err(what) => return Ok(Err(what)),
            };
            let told = file.holder_file.as_ref().unwrap_or(&file.lock);
            let held = match LockedFile::lock(again(&file.lock, &path)?) {
                Ok(held) => held,
                Err(TryLockError::WouldBlock) => {
                    let who = text_of(told).lines().next().unwrap_or_default().trim().to_owned();
                    let holder = [who, file.holder().unwrap_or_default()].into_iter().filter(|who| !who.is_empty());
                    let holder = holder.collect::<Vec<_>>().join("; held by ");
                    return Err(JournalError::MachineTaken { address: address.to_owned(), holder });
                }
                Err(TryLockError::Error(error)) => return Err(JournalError::file(&path, "locking it")(error)),
            };
            // Another process can have removed the name in the meantime. The next process would then lock a different
            // file.
            if !folder.is_still(name, &file) {
                continue;
            }
            if file.is_spoiled {
                self.note(&path, "it has more names or bytes than a lock can have");
            } else {
                self.read_epoch(&text_of(told), &path);
            }
            self.held.push(held);
            self.holder_files.extend(file.holder_file);
            return Ok(Ok(()));
        }
        Ok(Err("it is removed repeatedly".to_owned()))
    }

    /// Reads the epoch (session number) from `kept`, the content of a lock file. If this epoch is higher than the last
    /// epoch of this lock, replaces the last epoch by it. If the value is not a number or is too large, ignores it and
    /// adds a warning. `path` is the path of the lock file, for the warning.
    fn read_epoch(&mut self, kept: &str, path: &Path) {
        for text in kept.lines().filter_map(|line| line.strip_prefix(EPOCH)) {
            match text.trim().parse::<u32>() {
                Ok(epoch) if epoch < (1 << EPOCH_BITS) - 1 => self.last_epoch = self.last_epoch.max(epoch),
                _ => self.note(path, &format!("its epoch `{text}` is not one of a client of this computer")),
            }
        }
    }

    fn note(&mut self, path: &Path, what: &str) {
        self.notes.push(format!("{}: {what}; it was ignored", path.display()));
    }

    /// Writes the holder (run folder and process number) and `epoch` (the session number) into the lock files of this
    /// machine. Ignores write errors, because the lock is valid without this content. The holder is only information
    /// for people. The stored epoch is not the only source of the last epoch, because the machine also reports it.
    fn write(&self, epoch: u32) {
        let text = format!("{}\n{EPOCH}{epoch}\n", self.holder);
        for mut file in &self.holder_files {
            // The file is never empty in between: a process that is killed here does not lose the stored epoch.
            let _ = file
                .rewind()
                .and_then(|()| file.write_all(text.as_bytes()))
                .and_then(|()| file.set_len(text.len() as u64));
        }
    }
}

/// Duplicates the handle of an open file. The duplicate is used to lock the file. `path` is the name of the file in
/// error messages.
fn again(file: &File, path: &Path) -> Result<File, JournalError> {
    file.try_clone().map_err(JournalError::file(path, "opening it"))
}

fn text_of(mut file: &File) -> String {
    let mut bytes = Vec::new();
    let _ = file.rewind().and_then(|()| file.take(MAX_HOLDER_BYTES).read_to_end(&mut bytes));
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn machine_lock_names_its_owner() {
        let folder = tempfile::tempdir().unwrap();
        let take = |address, run| MachineLock::acquire_in(folder.path(), address, Path::new(run));
        let first = take("grinder at 10.0.0.6:502, unit 1", "runs/a").unwrap();
        assert_eq!(first.notes(), [""; 0]);
        take("grinder at 10.0.0.7:502, unit 1", "runs/b").unwrap();
        let refused = take("grinder at 10.0.0.6:502, unit 1", "runs/b").unwrap_err().to_string();
        assert!(refused.contains("runs/a, process ") && refused.contains("10.0.0.6"), "{refused}");
        drop(first);
        take("grinder at 10.0.0.6:502, unit 1", "runs/b").unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn doors_in_finds_running_cells() {
        let place = tempfile::tempdir().unwrap();
        let run = Path::new("/home/anna/runs, old/a, process 7");
        let lock = MachineLock::acquire_in(place.path(), "grinder at 10.0.0.6:502, unit 1", run).unwrap();
        let folder = place.path().join(FOLDER);
        assert_eq!(MachineLock::doors_in(&folder), []);
        std::fs::write(lock.control_socket(), "").unwrap();
        // Another socket, without a lock file next to it.
        std::fs::write(folder.join("other.sock"), "").unwrap();
        assert_eq!(MachineLock::doors_in(&folder), [(run.to_owned(), lock.control_socket().to_owned())]);
        assert_eq!(MachineLock::doors_in(&place.path().join("absent")), []);
    }

    #[test]
    fn epoch_is_monotonic_per_machine() {
        let folder = tempfile::tempdir().unwrap();
        let take = |address: &str| MachineLock::acquire_in(folder.path(), address, Path::new("runs/a")).unwrap();
        let epoch = |addresses: &[&str], clock| {
            let machines: Vec<_> = addresses.iter().map(|address| take(address)).collect();
            MachineLock::epoch(&machines, clock)
        };
        assert_eq!(epoch(&["cmm", "grinder"], 1000), 1000);
        assert_eq!(epoch(&["cmm", "grinder"], 1000), 1001, "twice in a second");
        assert_eq!(epoch(&["grinder"], 500), 1002, "the clock was set back");
        assert_eq!(epoch(&["cmm", "other"], 10), 1002, "each machine has its own");
        assert_eq!(epoch(&["other"], 10), 1003);
        assert_eq!(epoch(&["other"], 5000), 5000);
        assert_eq!(epoch(&[], 7), 7);
        drop(take("cmm"));
        assert_eq!(epoch(&["cmm"], 0), 1003, "who only had it has kept it");
    }
}

/// Tests with files that another user put in place first.
#[cfg(all(test, unix))]
mod strangers {
    use std::fs;
    use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
    use std::path::PathBuf;

    use super::*;

    const ADDRESS: &str = "grinder at 10.0.0.6:502, unit 1";

    fn name() -> String {
        format!("{}.lock", &sha256_hex(ADDRESS.as_bytes())[..16])
    }

    /// Creates a shared place with the folder of the locks in it, and a file of the owner that no other user may cause
    /// to change.
    fn place() -> (tempfile::TempDir, PathBuf, PathBuf) {
        let place = tempfile::tempdir().unwrap();
        let (folder, precious) = (place.path().join(FOLDER), place.path().join("precious"));
        fs::create_dir(&folder).unwrap();
        fs::set_permissions(&folder, fs::Permissions::from_mode(0o1777)).unwrap();
        fs::write(&precious, "precious").unwrap();
        fs::set_permissions(&precious, fs::Permissions::from_mode(0o600)).unwrap();
        (place, folder, precious)
    }

    /// Takes the machine, and checks that a second run of this user cannot take it, and that the owner's file is
    /// unchanged.
    fn taken(place: &Path, precious: &Path) -> MachineLock {
        let take = || MachineLock::acquire_in(place, ADDRESS, Path::new("runs/a"));
        let lock = take().unwrap();
        assert!(matches!(take(), Err(JournalError::MachineTaken { .. })));
        assert_eq!(MachineLock::epoch([&lock], 1000), 1000);
        assert_eq!(fs::read_to_string(precious).unwrap(), "precious");
        assert_eq!(fs::metadata(precious).unwrap().mode() & 0o777, 0o600);
        lock
    }

    #[test]
    fn machine_lock_ignores_unsafe_file() {
        type Lays = fn(&Path, &Path);
        let lays: [(&str, Lays); 5] = [
            ("it is a link", |lock, precious| symlink(precious, lock).unwrap()),
            ("it is a link", |lock, _| symlink("/nowhere/at all", lock).unwrap()),
            ("it is not a file", |lock, _| {
                assert!(std::process::Command::new("mkfifo").arg(lock).status().unwrap().success());
            }),
            ("more names or bytes", |lock, precious| fs::hard_link(precious, lock).unwrap()),
            ("more names or bytes", |lock, _| fs::File::create(lock).unwrap().set_len(20 << 30).unwrap()),
        ];
        for (what, lay) in lays {
            let (place, folder, precious) = place();
            lay(&folder.join(name()), &precious);
            let lock = taken(place.path(), &precious);
            assert!(lock.notes().len() == 1 && lock.notes()[0].contains(what), "{what}: {:?}", lock.notes());
        }
        // The same for the lock file of this user only.
        let (place, folder, precious) = place();
        let own = format!("{}.{}.lock", &sha256_hex(ADDRESS.as_bytes())[..16], LockFolder::own_mark());
        symlink(&precious, folder.join(own)).unwrap();
        assert_eq!(taken(place.path(), &precious).notes().len(), 1);
    }

    #[test]
    fn lock_folder_refused_if_unsafe() {
        let refused = |lay: &dyn Fn(&Path, &Path)| {
            let (place, folder, precious) = place();
            lay(&folder, place.path());
            let refused = MachineLock::acquire_in(place.path(), ADDRESS, Path::new("runs/a")).unwrap_err();
            assert!(refused.to_string().contains("chown -h root:root"), "{refused}");
            assert_eq!(fs::read_to_string(precious).unwrap(), "precious");
            refused.to_string()
        };
        let elsewhere = |folder: &Path, place: &Path| {
            fs::remove_dir(folder).unwrap();
            fs::create_dir(place.join("elsewhere")).unwrap();
            symlink(place.join("elsewhere"), folder).unwrap();
        };
        assert!(refused(&elsewhere).contains("a link or a file"));
        let a_file = |folder: &Path, _: &Path| {
            fs::remove_dir(folder).unwrap();
            fs::write(folder, "").unwrap();
        };
        assert!(refused(&a_file).contains("a link or a file"));
        let open = |folder: &Path, _: &Path| fs::set_permissions(folder, fs::Permissions::from_mode(0o777)).unwrap();
        assert!(refused(&open).contains("its mode is 777"));
        // Only root can give a folder away.
        if rustix::process::geteuid().is_root() {
            let given = |folder: &Path, _: &Path| std::os::unix::fs::chown(folder, Some(4711), None).unwrap();
            assert!(refused(&given).contains("4711"));
        }
    }

    #[test]
    fn lock_folder_and_file_modes() {
        let (place, folder, _) = place();
        fs::set_permissions(&folder, fs::Permissions::from_mode(0o700)).unwrap();
        drop(MachineLock::acquire_in(place.path(), ADDRESS, Path::new("runs/a")).unwrap());
        assert_eq!(fs::metadata(&folder).unwrap().mode() & 0o7777, 0o700);
        let fresh = tempfile::tempdir().unwrap();
        drop(MachineLock::acquire_in(fresh.path(), ADDRESS, Path::new("runs/a")).unwrap());
        let folder = fresh.path().join(FOLDER);
        assert_eq!(fs::metadata(&folder).unwrap().mode() & 0o7777, 0o1777);
        assert_eq!(fs::metadata(folder.join(name())).unwrap().mode() & 0o777, 0o666);
        let modes: Vec<u32> =
            fs::read_dir(&folder).unwrap().map(|file| file.unwrap().metadata().unwrap().mode() & 0o777).collect();
        assert!(modes.len() == 2 && modes.contains(&0o600), "{modes:?}");
    }

    #[test]
    fn epoch_ignores_implausible_values() {
        for poison in ["4294967295", "2147483647", "-1", "x"] {
            let (place, folder, precious) = place();
            fs::write(folder.join(name()), format!("somebody\nepoch 900\nepoch {poison}\n")).unwrap();
            let lock = taken(place.path(), &precious);
            assert!(lock.notes().len() == 1 && lock.notes()[0].contains(poison), "{:?}", lock.notes());
            drop(lock);
            let lock = taken_again(place.path());
            assert_eq!(MachineLock::epoch([&lock], 0), 1001, "what was lower is believed, and the poison is gone");
        }
    }

    /// Returns a command that runs as another user. Only root can start it.
    fn stranger(program: &str, arguments: &[&std::ffi::OsStr]) -> std::process::Command {
        use std::os::unix::process::CommandExt;
        let mut command = std::process::Command::new(program);
        command.args(arguments).uid(65534).gid(65534);
        command
    }

    #[test]
    fn machine_lock_of_another_user() {
        use std::io::{BufRead, BufReader};
        use std::process::Stdio;
        if !rustix::process::geteuid().is_root() {
            return;
        }
        let (place, folder, _) = place();
        fs::set_permissions(place.path(), fs::Permissions::from_mode(0o755)).unwrap();
        drop(taken_again(place.path()));
        let lock = folder.join(name());
        let arguments = [lock.as_os_str(), "sh".as_ref(), "-c".as_ref(), "echo held; cat".as_ref()];
        let mut holder = stranger("flock", &arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let mut said = String::new();
        BufReader::new(holder.stdout.take().unwrap()).read_line(&mut said).unwrap();
        assert_eq!(said, "held\n");
        let refused = MachineLock::acquire_in(place.path(), ADDRESS, Path::new("runs/a")).unwrap_err().to_string();
        assert!(refused.contains("number 65534"), "{refused}");
        drop(holder.stdin.take());
        holder.wait().unwrap();
        drop(taken_again(place.path()));
    }

    #[test]
    fn own_lock_resists_other_users() {
        if !rustix::process::geteuid().is_root() {
            return;
        }
        let (place, folder, precious) = place();
        fs::set_permissions(place.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let lock = taken_again(place.path());
        let own = folder.join(format!("{}.{}.lock", &sha256_hex(ADDRESS.as_bytes())[..16], LockFolder::own_mark()));
        for (program, arguments) in [
            ("flock", vec!["-n".as_ref(), own.as_os_str(), "true".as_ref()]),
            ("truncate", vec!["-s".as_ref(), "9999".as_ref(), own.as_os_str()]),
            ("rm", vec!["-f".as_ref(), own.as_os_str()]),
        ] {
            let done = stranger(program, &arguments).stderr(std::process::Stdio::null()).status().unwrap();
            assert!(!done.success(), "{program}");
        }
        // The other user can damage the shared lock file, but cannot release the machine that way.
        assert!(
            stranger("truncate", &["-s".as_ref(), "9999".as_ref(), folder.join(name()).as_os_str()])
                .status()
                .unwrap()
                .success()
        );
        assert!(matches!(
            MachineLock::acquire_in(place.path(), ADDRESS, Path::new("runs/b")),
            Err(JournalError::MachineTaken { .. })
        ));
        drop(lock);
        assert_eq!(taken(place.path(), &precious).notes().len(), 1);
    }

    #[test]
    fn machine_lock_recreated_after_removal() {
        let (place, folder, precious) = place();
        drop(taken_again(place.path()));
        fs::remove_file(folder.join(name())).unwrap();
        assert_eq!(taken(place.path(), &precious).notes(), [""; 0]);
    }

    fn taken_again(place: &Path) -> MachineLock {
        MachineLock::acquire_in(place, ADDRESS, Path::new("runs/b")).unwrap()
    }
}
