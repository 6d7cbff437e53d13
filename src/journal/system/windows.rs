//! Files have lists of who may do what, folders bring their names to the disk themselves, and a lock keeps others from reading.

use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

use super::OpenToOthers;

/// Makes a folder that nobody but its owner may look into, and those above it, where they are not there.
pub(crate) fn create_owners_folder(folder: &Path) -> io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    if let Some(above) = folder.parent().filter(|above| !above.as_os_str().is_empty()) {
        create_owners_folder(above)?;
    }
    match regrind_windows::create_owners_folder(folder) {
        // Another program may make it at the same moment.
        Err(_) if folder.is_dir() => Ok(()),
        made => made,
    }
}

/// Makes the folder of a run; who may look into it comes down from the folder above.
pub(crate) fn create_run_folder(folder: &Path) -> io::Result<()> {
    std::fs::create_dir_all(folder)
}

/// A folder hands down the rights that its maker gave it.
pub(crate) fn is_open_to_all(_: &Path) -> bool {
    false
}

/// As for the folder of a run.
pub(crate) fn changeable_by_others(_: &Path) -> io::Result<Option<OpenToOthers>> {
    Ok(None)
}

/// Makes a file that nobody but its owner may read, for writing.
pub(crate) fn create_owners_file(path: &Path) -> io::Result<File> {
    regrind_windows::create_owners_file(path)
}

/// Says how others than its owner may read a file; none where they may not.
pub(crate) fn readable_by_others(path: &Path) -> io::Result<Option<OpenToOthers>> {
    let others = regrind_windows::others_who_read(&File::open(path)?)?;
    let own_name = regrind_windows::own_name().unwrap_or_else(|_| "%USERNAME%".into());
    let open = || OpenToOthers {
        how: others.join(", "),
        remedy: format!("`icacls FILE /inheritance:r /grant:r \"{own_name}:F\"` takes it from them"),
    };
    Ok((!others.is_empty()).then(open))
}

/// Brings what a file holds to the disk, whoever wrote it; for that it has to be open for writing.
pub(crate) fn sync_file(path: &Path) -> io::Result<()> {
    OpenOptions::new().write(true).open(path)?.sync_all()
}

/// The file system keeps a journal of names itself; nobody else can bring a folder to the disk.
pub(crate) fn sync_folder(_: &Path) -> io::Result<()> {
    Ok(())
}

/// A file that is open there is neither deleted nor renamed: that it is there is enough.
pub(crate) type FileIdentity = ();

/// Returns whether a file is at a path.
pub(crate) fn identity(path: &Path) -> io::Result<FileIdentity> {
    std::fs::metadata(path).map(drop)
}

/// How much room is left for the user of this program on the disk of a folder.
pub(crate) fn free_bytes(folder: &Path) -> io::Result<u64> {
    regrind_windows::free_bytes(folder)
}

/// The place for what belongs to no user in particular, in which each may make files and read those of others.
pub(crate) fn place_of_locks(_: &str) -> Option<PathBuf> {
    std::env::var_os("ProgramData").map(PathBuf::from).filter(|place| place.is_dir())
}

/// No door lies beside a lock: a pipe cannot be taken away.
pub(crate) fn is_own_file(_: &Path) -> bool {
    false
}

/// The folder in which the locks of this computer lie; who may do what in it comes down from its place.
pub(crate) struct LockFolder(PathBuf);

/// Why a folder for locks is not used.
pub(crate) struct BadFolder {
    pub(crate) what: String,
    pub(crate) remedy: String,
}

impl LockFolder {
    /// Opens it where it lies, and makes it where it is not there.
    pub(crate) fn open(place: &Path, name: &str) -> Result<Self, BadFolder> {
        let folder = place.join(name);
        let made = std::fs::create_dir_all(&folder);
        // Another run may make it at the same moment.
        match made {
            Err(error) if !folder.is_dir() => {
                let remedy = format!("see that {} can be written", place.display());
                Err(BadFolder { what: format!("making it: {error}"), remedy })
            }
            _ => Ok(Self(folder)),
        }
    }

    /// Opens the file of a machine, which every user may lock.
    pub(crate) fn shared(&self, name: &str) -> Result<LockFile, String> {
        let path = self.0.join(name);
        let words = |error: io::Error| error.to_string();
        if !path.exists() {
            OpenOptions::new().append(true).create(true).open(&path).map_err(words)?;
        }
        let lock = File::open(&path).map_err(words)?;
        // Nobody can read the locked one: what is told stands beside it.
        let told = path.with_extension("txt");
        let told = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(told).ok();
        Ok(LockFile { lock, told, is_spoiled: false })
    }

    /// Opens the file of a machine that is this user's.
    pub(crate) fn own(&self, name: &str) -> Result<LockFile, String> {
        self.shared(name)
    }

    /// A file that is open there keeps its name.
    pub(crate) fn is_still(&self, _: &str, _: &LockFile) -> bool {
        true
    }

    /// Tells the files of this user from those of others.
    pub(crate) fn own_mark() -> String {
        regrind_windows::own_name().unwrap_or_default().chars().filter(char::is_ascii_alphanumeric).collect()
    }
}

/// A file to be locked.
pub(crate) struct LockFile {
    pub(crate) lock: File,
    /// The file that tells its holder and the last epoch; none where that may not be written.
    pub(crate) told: Option<File>,
    /// Whether others have given it further names, or more bytes than a lock has.
    pub(crate) is_spoiled: bool,
}

impl LockFile {
    /// Who holds a lock is not told there.
    pub(crate) fn holder(&self) -> Option<String> {
        None
    }
}
