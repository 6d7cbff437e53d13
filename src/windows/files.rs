//! Files and folders that only their owner can access, and the free space of a disk.

use std::fs::File;
use std::io;
use std::os::windows::io::FromRawHandle;
use std::path::Path;
use std::ptr;

use windows_sys::Win32::Foundation::{GENERIC_WRITE, INVALID_HANDLE_VALUE};
use windows_sys::Win32::Storage::FileSystem::{
    CREATE_NEW, CreateDirectoryW, CreateFileW, FILE_ATTRIBUTE_NORMAL, FILE_SHARE_DELETE, FILE_SHARE_READ,
    GetDiskFreeSpaceExW,
};

use super::access::OwnersAlone;
use super::{succeeded, wide};

/// Creates a file that only its owner can read, and opens it for writing. The file has these rights from its creation,
/// so no other user can open it in between.
///
/// # Errors
/// The file exists, or its folder is not writable.
pub fn create_owners_file(path: &Path) -> io::Result<File> {
    let (name, owners_alone) = (wide(path.as_os_str())?, OwnersAlone::new()?);
    // Others can read and rename the file while it is open, as with a file of std.
    let share = FILE_SHARE_READ | FILE_SHARE_DELETE;
    // SAFETY: the name ends with a zero. Name and attributes live longer than the call. There is no template file.
    let handle = unsafe {
        CreateFileW(
            name.as_ptr(),
            GENERIC_WRITE,
            share,
            owners_alone.attributes(),
            CREATE_NEW,
            FILE_ATTRIBUTE_NORMAL,
            ptr::null_mut(),
        )
    };
    if handle == INVALID_HANDLE_VALUE {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the call opened this handle for us, and nobody else closes it.
    Ok(unsafe { File::from_raw_handle(handle) })
}

/// Creates a folder that only its owner can read. Everything that is later created in it gets the same rights.
///
/// # Errors
/// The name exists, or the parent folder is not writable.
pub fn create_owners_folder(path: &Path) -> io::Result<()> {
    let (name, owners_alone) = (wide(path.as_os_str())?, OwnersAlone::new()?);
    // SAFETY: the name ends with a zero. Name and attributes live longer than the call.
    succeeded(unsafe { CreateDirectoryW(name.as_ptr(), owners_alone.attributes()) })
}

/// Returns the free space, in bytes, that the user of this process has on the disk of a folder.
///
/// # Errors
/// The folder does not exist, or the disk does not report its free space.
pub fn free_bytes(folder: &Path) -> io::Result<u64> {
    let folder = wide(folder.as_os_str())?;
    let mut left = 0;
    // SAFETY: `folder` ends with a zero, `left` lives longer than the call, and the other outputs are optional.
    succeeded(unsafe { GetDiskFreeSpaceExW(folder.as_ptr(), &mut left, ptr::null_mut(), ptr::null_mut()) })?;
    Ok(left)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::super::others_who_read;
    use super::*;

    #[test]
    fn owners_file_and_folder_are_private() {
        let home = tempfile::tempdir().unwrap();
        let folder = home.path().join("own");
        create_owners_folder(&folder).unwrap();
        assert!(create_owners_folder(&folder).is_err(), "it is there");
        let path = folder.join("secret");
        create_owners_file(&path).unwrap().write_all(b"a secret").unwrap();
        assert!(create_owners_file(&path).is_err(), "it is there");
        assert_eq!(others_who_read(&File::open(&path).unwrap()).unwrap(), [""; 0]);
        assert_eq!(std::fs::read(&path).unwrap(), b"a secret");
        std::fs::rename(&path, folder.join("renamed")).unwrap();
    }

    #[test]
    fn free_bytes_of_folder() {
        let home = tempfile::tempdir().unwrap();
        assert!(free_bytes(home.path()).unwrap() > 0);
        assert!(free_bytes(&home.path().join("absent")).is_err());
    }
}
