//! Who may read what.

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

/// The kind of an entry that allows something.
const ALLOWS: u8 = 0;
/// Who may read everything on a computer whatever is said: the system itself, and who administers it; and the owner.
const MAY_ANYWAY: [&str; 3] = ["S-1-5-18", "S-1-5-32-544", "S-1-3-4"];

/// What may be done to something, and by whom; Windows has allocated it for us.
struct Descriptor(PSECURITY_DESCRIPTOR);

impl Drop for Descriptor {
    fn drop(&mut self) {
        // SAFETY: it was allocated for us by the call that returned it, and is freed here alone.
        unsafe { LocalFree(self.0) };
    }
}

/// Says that something new is for the user of this process alone, whatever holds for the folder that it is in.
pub(crate) struct OwnersAlone {
    /// Held, for the attributes point to it.
    _descriptor: Descriptor,
    attributes: SECURITY_ATTRIBUTES,
}

impl OwnersAlone {
    pub(crate) fn new() -> io::Result<Self> {
        let sid = own_sid()?;
        // The owner is said, for who administers a computer may make things in the name of all who do. What is made in a folder inherits it.
        let descriptor = parse(&format!("O:{sid}D:P(A;OICI;GA;;;{sid})"))?;
        let attributes = SECURITY_ATTRIBUTES {
            nLength: size_of::<SECURITY_ATTRIBUTES>() as u32,
            lpSecurityDescriptor: descriptor.0,
            bInheritHandle: 0,
        };
        Ok(Self { _descriptor: descriptor, attributes })
    }

    /// Where the attributes lie, for as long as this lives. Windows only reads them.
    pub(crate) fn attributes(&self) -> *const SECURITY_ATTRIBUTES {
        &raw const self.attributes
    }
}

/// Reads a descriptor from the text that Windows has for it (SDDL).
fn parse(text: &str) -> io::Result<Descriptor> {
    let text = wide(OsStr::new(text))?;
    let mut descriptor = ptr::null_mut();
    // SAFETY: `text` ends with a zero, `descriptor` lives longer than the call, and the length may be left unasked.
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

/// Returns who may read a file besides its owner, the system and who administers it, by their security identifiers.
///
/// # Errors
/// Windows does not tell it.
pub fn others_who_read(file: &File) -> io::Result<Vec<String>> {
    let (mut list, mut descriptor) = (ptr::null_mut(), ptr::null_mut());
    let (what, unasked) = (DACL_SECURITY_INFORMATION, ptr::null_mut());
    // SAFETY: the file is open, what is written to lives longer than the call, and the rest may be left unasked.
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
        // No list at all: everybody may do everything.
        return Ok(vec!["S-1-1-0".into()]);
    }
    let own = own_sid()?;
    let others = readers(list)?.into_iter().filter(|sid| *sid != own && !MAY_ANYWAY.contains(&sid.as_str())).collect();
    drop(descriptor);
    Ok(others)
}

/// Who is allowed to read by a list, which must be one that Windows wrote and nobody has freed yet.
fn readers(list: *const ACL) -> io::Result<Vec<String>> {
    // SAFETY: every list begins with this head.
    let count = unsafe { list.read() }.AceCount;
    let mut found = Vec::new();
    for index in 0..u32::from(count) {
        let mut entry = ptr::null_mut();
        // SAFETY: the list is whole, and `entry` lives longer than the call.
        succeeded(unsafe { GetAce(list, index, &mut entry) })?;
        // SAFETY: every entry begins with this head; it need not be aligned.
        let head = unsafe { entry.cast::<ACE_HEADER>().read_unaligned() };
        if head.AceType != ALLOWS || u32::from(head.AceFlags) & INHERIT_ONLY_ACE != 0 {
            continue;
        }
        let entry = entry.cast::<ACCESS_ALLOWED_ACE>();
        // SAFETY: an entry of this kind is laid out so.
        let mask = unsafe { (&raw const (*entry).Mask).read_unaligned() };
        // SAFETY: only where it lies is computed; the identifier begins there and ends within the entry.
        let sid: PSID = unsafe { (&raw mut (*entry).SidStart).cast() };
        if mask & (FILE_READ_DATA | GENERIC_READ | GENERIC_ALL) != 0 {
            found.push(text_of(sid)?);
        }
    }
    Ok(found)
}

/// Whether something that is open here, such as a pipe, belongs to the user whose process this is.
pub(crate) fn is_owned_here(open: BorrowedHandle<'_>) -> io::Result<bool> {
    let (mut owner, mut descriptor) = (ptr::null_mut(), ptr::null_mut());
    let unasked = ptr::null_mut();
    // SAFETY: the handle is open, what is written to lives longer than the call, and the rest may be left unasked.
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
