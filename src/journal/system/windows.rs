//! Windows: files have access control lists, the file system itself makes folder entries durable, and a lock prevents
//! others from reading.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use super::OpenToOthers;

/// Creates a folder that only its owner can read, and its missing parents. An existing folder is accepted unchanged.
pub(crate) fn create_owners_folder(folder: &Path) -> io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    if let Some(above) = folder.parent().filter(|above| !above.as_os_str().is_empty()) {
        create_owners_folder(above)?;
    }
    match regrind_windows::create_owners_folder(folder) {
        // Another program can create it at the same moment.
        Err(_) if folder.is_dir() => Ok(()),
        made => made,
    }
}

/// Creates the folder of a run with the access rights of its parent folder. An existing folder is accepted unchanged.
pub(crate) fn create_run_folder(folder: &Path) -> io::Result<()> {
    std::fs::create_dir_all(folder)
}

/// Returns false: on Windows the person who created the parent folder has chosen who can read a run folder.
pub(crate) fn is_open_to_all(_: &Path) -> bool {
    false
}

/// Returns `None`, which means that no risk is reported. On Windows the person who created the parent folder has chosen
/// who can change the files of a folder.
pub(crate) fn changeable_by_others(_: &Path) -> io::Result<Option<OpenToOthers>> {
    Ok(None)
}

/// Creates a file that only its owner can read, and opens it for writing. An existing file is an error.
pub(crate) fn create_owners_file(path: &Path) -> io::Result<File> {
    regrind_windows::create_owners_file(path)
}

/// Returns the names of the users other than the owner who can read a file, and the command that removes their access.
/// Returns `None` if only the owner can read the file.
pub(crate) fn readable_by_others(path: &Path) -> io::Result<Option<OpenToOthers>> {
    let others = regrind_windows::others_who_read(&File::open(path)?)?;
    let own_name = regrind_windows::own_name().unwrap_or_else(|_| "%USERNAME%".into());
    let open = || OpenToOthers {
        how: others.join(", "),
        remedy: format!("run `icacls FILE /inheritance:r /grant:r \"{own_name}:F\"`"),
    };
    Ok((!others.is_empty()).then(open))
}

/// Flushes the content of a file to the disk, even if another process wrote it. Windows requires that the file is open
/// for writing.
pub(crate) fn sync_file(path: &Path) -> io::Result<()> {
    OpenOptions::new().write(true).open(path)?.sync_all()
}

/// Does nothing: on Windows the file system keeps a journal of names, and a program cannot flush a folder.
pub(crate) fn sync_folder(_: &Path) -> io::Result<()> {
    Ok(())
}

/// Identity of a file. An open file cannot be deleted or renamed on Windows, so its existence is sufficient.
pub(crate) type FileIdentity = ();

/// Checks that `path` exists. The returned identity is empty, because Windows does not let anybody remove or rename an
/// open file.
///
/// # Errors
/// Nothing exists at `path`, or its metadata cannot be read.
pub(crate) fn identity(path: &Path) -> io::Result<FileIdentity> {
    std::fs::metadata(path).map(drop)
}

/// Returns the free space, in bytes, that the user of this program has on the disk of a folder.
pub(crate) fn free_bytes(folder: &Path) -> io::Result<u64> {
    regrind_windows::free_bytes(folder)
}

/// Returns the parent folder of the lock folder: the folder in the environment variable `ProgramData`. In this folder,
/// each user can create files and read the files of other users. Returns `None` if the variable is not set or the
/// folder does not exist.
pub(crate) fn place_of_locks(_: &str) -> Option<PathBuf> {
    std::env::var_os("ProgramData").map(PathBuf::from).filter(|place| place.is_dir())
}

/// Returns false. This function is used only to find control sockets next to lock files. On Windows there are no such
/// sockets: a cell uses a named pipe instead, which nobody can remove.
pub(crate) fn is_own_file(_: &Path) -> bool {
    false
}

/// Folder for the locks of this computer. Its access rights are inherited from its parent.
pub(crate) struct LockFolder(PathBuf);

/// Reason why a folder for locks cannot be used, with the remedy.
pub(crate) struct BadFolder {
    pub(crate) description: String,
    pub(crate) remedy: String,
}

impl LockFolder {
    /// Opens the lock folder `name` in the parent folder `place`. Creates the lock folder if it does not exist.
    ///
    /// # Errors
    /// The folder does not exist and cannot be created.
    pub(crate) fn open(place: &Path, name: &str) -> Result<Self, BadFolder> {
        let folder = place.join(name);
        let made = std::fs::create_dir_all(&folder);
        // Another run can create it at the same moment.
        match made {
            Err(error) if !folder.is_dir() => {
                let remedy = format!("check that {} is writable", place.display());
                Err(BadFolder { description: format!("creating it: {error}"), remedy })
            }
            _ => Ok(Self(folder)),
        }
    }

    /// Opens the lock file `name`. Creates the file if it does not exist. Every user can lock the file.
    ///
    /// # Errors
    /// The file cannot be created or opened. The error is the message of the operating system.
    pub(crate) fn shared(&self, name: &str) -> Result<LockFile, String> {
        let path = self.0.join(name);
        let words = |error: io::Error| error.to_string();
        if !path.exists() {
            OpenOptions::new().append(true).create(true).open(&path).map_err(words)?;
        }
        let lock = File::open(&path).map_err(words)?;
        // Nobody can read a locked file: the holder and the epoch are stored in a file next to it.
        let path_of_holder = path.with_extension("txt");
        let holder_file =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path_of_holder).ok();
        Ok(LockFile { lock, holder_file, is_spoiled: false })
    }

    /// Opens the lock file `name` of this user. Creates the file if it does not exist.
    ///
    /// # Errors
    /// The file cannot be created or opened. The error is the message of the operating system.
    pub(crate) fn own(&self, name: &str) -> Result<LockFile, String> {
        self.shared(name)
    }

    /// Returns true: on Windows an open file cannot be removed or renamed.
    pub(crate) fn is_still(&self, _: &str, _: &LockFile) -> bool {
        true
    }

    /// Returns the part of a lock file name that identifies the user of this program: the letters and digits of the
    /// user name. Returns an empty text if the user name is unknown.
    pub(crate) fn own_mark() -> String {
        regrind_windows::own_name().unwrap_or_default().chars().filter(char::is_ascii_alphanumeric).collect()
    }
}

/// File to be locked.
pub(crate) struct LockFile {
    pub(crate) lock: File,
    /// File that stores the holder and the last epoch; `None` if it cannot be written.
    pub(crate) holder_file: Option<File>,
    /// True if others have given the file additional names, or more bytes than a lock file has.
    pub(crate) is_spoiled: bool,
}

impl LockFile {
    /// Returns `None`: Windows does not report the holder of a lock.
    pub(crate) fn holder(&self) -> Option<String> {
        None
    }
}
