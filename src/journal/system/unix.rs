//! Files have modes, folders can be brought to the disk, and a lock keeps nobody from reading.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use super::OpenToOthers;

/// Where locks may lie, the best first: a place that is the same for every user and every session of a computer. `TMPDIR` is not.
const PLACES: [&str; 4] = ["/run/lock", "/var/lock", "/var/tmp", "/tmp"];

/// Makes a folder that nobody but its owner may look into, and those above it, where they are not there.
pub(crate) fn create_owners_folder(folder: &Path) -> io::Result<()> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)
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

/// How much room is left for the user of this program on the disk of a folder.
pub(crate) fn free_bytes(folder: &Path) -> io::Result<u64> {
    let room = rustix::fs::statvfs(folder)?;
    Ok(room.f_bavail.saturating_mul(room.f_frsize))
}

/// The first place for locks that is there and every user can write; none where there is no such place.
pub(crate) fn place_of_locks() -> Option<PathBuf> {
    first_for_all(&PLACES.map(Path::new)).map(Path::to_owned)
}

fn first_for_all<'a>(places: &[&'a Path]) -> Option<&'a Path> {
    let for_all = |place: &Path| fs::metadata(place).is_ok_and(|m| m.is_dir() && m.permissions().mode() & 0o002 != 0);
    places.iter().copied().find(|place| for_all(place))
}

/// Lets every user of the computer make files in a folder, each its own.
pub(crate) fn open_folder_to_all(folder: &Path) {
    set_mode(folder, 0o1777);
}

/// Lets every user of the computer write a file.
pub(crate) fn open_file_to_all(path: &Path) {
    set_mode(path, 0o666);
}

fn set_mode(path: &Path, mode: u32) {
    // Where that is not allowed, the locks of one user are still his.
    let _ = fs::set_permissions(path, fs::Permissions::from_mode(mode));
}

/// The file that tells of who holds a lock: the locked one itself, which everybody may still read.
pub(crate) fn beside_lock(lock: &Path) -> PathBuf {
    lock.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

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
