//! Files and folders for their owner alone, and the room that is left on a disk.

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

/// Makes a file that nobody but its owner may read, for writing. It never was anything else: there is no moment for others in between.
///
/// # Errors
/// A file of that name, and a folder that cannot be written.
pub fn create_owners_file(path: &Path) -> io::Result<File> {
    let (name, owners_alone) = (wide(path.as_os_str())?, OwnersAlone::new()?);
    // Whoever shares it may also give it another name while it is open, as a file of std is shared.
    let share = FILE_SHARE_READ | FILE_SHARE_DELETE;
    // SAFETY: the name ends with a zero, and like the attributes lives longer than the call; there is no file to take after.
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
    // SAFETY: the call has opened this handle for us, and nobody else closes it.
    Ok(unsafe { File::from_raw_handle(handle) })
}

/// Makes a folder that nobody but its owner may look into, nor into what will be made in it.
///
/// # Errors
/// Something of that name, and a folder above it that cannot be written.
pub fn create_owners_folder(path: &Path) -> io::Result<()> {
    let (name, owners_alone) = (wide(path.as_os_str())?, OwnersAlone::new()?);
    // SAFETY: the name ends with a zero, and like the attributes lives longer than the call.
    succeeded(unsafe { CreateDirectoryW(name.as_ptr(), owners_alone.attributes()) })
}

/// Returns how many bytes are left for the user of this process on the disk of a folder.
///
/// # Errors
/// A folder that is not there, and a disk that does not tell.
pub fn free_bytes(folder: &Path) -> io::Result<u64> {
    let folder = wide(folder.as_os_str())?;
    let mut left = 0;
    // SAFETY: `folder` ends with a zero, `left` lives longer than the call, and the rest may be left unasked.
    succeeded(unsafe { GetDiskFreeSpaceExW(folder.as_ptr(), &mut left, ptr::null_mut(), ptr::null_mut()) })?;
    Ok(left)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::super::others_who_read;
    use super::*;

    #[test]
    fn a_file_and_a_folder_are_their_owners_alone() {
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
    fn a_folder_has_a_disk_with_some_room() {
        let home = tempfile::tempdir().unwrap();
        assert!(free_bytes(home.path()).unwrap() > 0);
        assert!(free_bytes(&home.path().join("absent")).is_err());
    }
}
