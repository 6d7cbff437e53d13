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

/// How much room is left for the user of this program on the disk of a folder.
pub(crate) fn free_bytes(folder: &Path) -> io::Result<u64> {
    regrind_windows::free_bytes(folder)
}

/// The place for what belongs to no user in particular, in which each may make files and read those of others.
pub(crate) fn place_of_locks() -> Option<PathBuf> {
    std::env::var_os("ProgramData").map(PathBuf::from).filter(|place| place.is_dir())
}

/// Who may do what comes down from the place of the locks.
pub(crate) fn open_folder_to_all(_: &Path) {}

/// As for the folder.
pub(crate) fn open_file_to_all(_: &Path) {}

/// The file that tells of who holds a lock: one beside it, for nobody can read the locked one.
pub(crate) fn beside_lock(lock: &Path) -> PathBuf {
    lock.with_extension("txt")
}
