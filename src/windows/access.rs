//! Read access to files and pipes on Windows.

use std::ffi::OsStr;
use std::fs::File;
use std::io;
use std::os::windows::io::{AsRawHandle, BorrowedHandle};
use std::ptr;

use windows_sys::Win32::Foundation::{GENERIC_ALL, GENERIC_READ, LocalFree};
use windows_sys::Win32::Security::Authorization::{
    ConvertStringSecurityDescriptorToSecurityDescriptorW, GetSecurityInfo, SDDL_REVISION_1, SE_FILE_OBJECT,
    SE_KERNEL_OBJECT,
};
use windows_sys::Win32::Security::{
    ACCESS_ALLOWED_ACE, ACE_HEADER, ACL, DACL_SECURITY_INFORMATION, GetAce, INHERIT_ONLY_ACE,
    OWNER_SECURITY_INFORMATION, PSECURITY_DESCRIPTOR, PSID, SECURITY_ATTRIBUTES,
};
use windows_sys::Win32::Storage::FileSystem::FILE_READ_DATA;

use super::person::{own_sid, text_of};
use super::{no_error, succeeded, wide};

/// Type of an access control entry that allows access.
const ALLOWS: u8 = 0;
/// Identifiers that can read every file of a computer in any case: the system, the administrators, and the owner.
const MAY_ANYWAY: [&str; 3] = ["S-1-5-18", "S-1-5-32-544", "S-1-3-4"];

/// Security descriptor: what can be done to an object, and by whom. Windows allocated it for this process.
struct Descriptor(PSECURITY_DESCRIPTOR);

impl Drop for Descriptor {
    fn drop(&mut self) {
        // SAFETY: the call that returned it allocated it for us. It is freed only here.
        unsafe { LocalFree(self.0) };
    }
}

/// Security attributes that give a new object to the user of this process only, whatever its folder allows.
pub(crate) struct OwnersAlone {
    /// Kept alive, because the attributes point to it.
    _descriptor: Descriptor,
    attributes: SECURITY_ATTRIBUTES,
}

impl OwnersAlone {
    pub(crate) fn new() -> io::Result<Self> {
        let sid = own_sid()?;
        // The owner is named explicitly, because an object of an administrator can belong to the group of all
        // administrators. New objects in a folder inherit the descriptor.
        let descriptor = parse(&format!("O:{sid}D:P(A;OICI;GA;;;{sid})"))?;
        let attributes = SECURITY_ATTRIBUTES {
            nLength: size_of::<SECURITY_ATTRIBUTES>() as u32,
            lpSecurityDescriptor: descriptor.0,
            bInheritHandle: 0,
        };
        Ok(Self { _descriptor: descriptor, attributes })
    }

    /// Returns a pointer to the security attributes, which is valid as long as `self` lives. Windows only reads them.
    pub(crate) fn attributes(&self) -> *const SECURITY_ATTRIBUTES {
        &raw const self.attributes
    }
}

/// Parses a security descriptor from its text form (SDDL).
fn parse(text: &str) -> io::Result<Descriptor> {
    let text = wide(OsStr::new(text))?;
    let mut descriptor = ptr::null_mut();
    // SAFETY: `text` ends with a zero, `descriptor` lives longer than the call, and the length is optional.
    succeeded(unsafe {
        ConvertStringSecurityDescriptorToSecurityDescriptorW(
            text.as_ptr(),
            SDDL_REVISION_1,
            &mut descriptor,
            ptr::null_mut(),
        )
    })?;
    Ok(Descriptor(descriptor))
}

/// Returns the security identifiers (SIDs) of all users and groups that can read `file`. The user of this process, the
/// owner of the file, the system and the administrators are omitted. If the file has no access list, returns the SID of
/// everyone, because then every user has full access.
///
/// # Errors
/// Returns an error if Windows does not report the access list.
pub fn others_who_read(file: &File) -> io::Result<Vec<String>> {
    let (mut list, mut descriptor) = (ptr::null_mut(), ptr::null_mut());
    let (what, unasked) = (DACL_SECURITY_INFORMATION, ptr::null_mut());
    // SAFETY: the file is open, the targets of the pointers live longer than the call, and the other outputs are
    // optional.
    no_error(unsafe {
        GetSecurityInfo(
            file.as_raw_handle(),
            SE_FILE_OBJECT,
            what,
            unasked,
            unasked,
            &mut list,
            ptr::null_mut(),
            &mut descriptor,
        )
    })?;
    let descriptor = Descriptor(descriptor);
    if list.is_null() {
        // Without a list everybody has full access.
        return Ok(vec!["S-1-1-0".into()]);
    }
    let own = own_sid()?;
    let others = readers(list)?.into_iter().filter(|sid| *sid != own && !MAY_ANYWAY.contains(&sid.as_str())).collect();
    drop(descriptor);
    Ok(others)
}

/// Returns the security identifiers (SIDs) of all users and groups to which a Windows access list grants read access.
/// `list` must point to a complete access list from Windows that is not yet freed.
fn readers(list: *const ACL) -> io::Result<Vec<String>> {
    // SAFETY: every list begins with this header.
    let count = unsafe { list.read() }.AceCount;
    let mut found = Vec::new();
    for index in 0..u32::from(count) {
        let mut entry = ptr::null_mut();
        // SAFETY: the list is complete, and `entry` lives longer than the call.
        succeeded(unsafe { GetAce(list, index, &mut entry) })?;
        // SAFETY: every entry begins with this header. It need not be aligned.
        let head = unsafe { entry.cast::<ACE_HEADER>().read_unaligned() };
        if head.AceType != ALLOWS || u32::from(head.AceFlags) & INHERIT_ONLY_ACE != 0 {
            continue;
        }
        let entry = entry.cast::<ACCESS_ALLOWED_ACE>();
        // SAFETY: an entry of this type has this layout.
        let mask = unsafe { (&raw const (*entry).Mask).read_unaligned() };
        // SAFETY: only the address is computed. The identifier begins there and ends within the entry.
        let sid: PSID = unsafe { (&raw mut (*entry).SidStart).cast() };
        if mask & (FILE_READ_DATA | GENERIC_READ | GENERIC_ALL) != 0 {
            found.push(text_of(sid)?);
        }
    }
    Ok(found)
}

/// Returns true if an open object, such as a pipe, is owned by the user of this process.
pub(crate) fn is_owned_here(open: BorrowedHandle<'_>) -> io::Result<bool> {
    let (mut owner, mut descriptor) = (ptr::null_mut(), ptr::null_mut());
    let unasked = ptr::null_mut();
    // SAFETY: the handle is open, the targets of the pointers live longer than the call, and the other outputs are
    // optional.
    no_error(unsafe {
        GetSecurityInfo(
            open.as_raw_handle(),
            SE_KERNEL_OBJECT,
            OWNER_SECURITY_INFORMATION,
            &mut owner,
            unasked,
            ptr::null_mut(),
            ptr::null_mut(),
            &mut descriptor,
        )
    })?;
    let _descriptor = Descriptor(descriptor);
    Ok(text_of(owner)? == own_sid()?)
}
