//! User of this process.

use std::io;
use std::os::windows::io::{AsRawHandle, FromRawHandle, OwnedHandle};
use std::ptr;

use windows_sys::Win32::Foundation::{HANDLE, LocalFree};
use windows_sys::Win32::Security::Authorization::ConvertSidToStringSidW;
use windows_sys::Win32::Security::{GetTokenInformation, PSID, TOKEN_QUERY, TOKEN_USER, TokenUser};
use windows_sys::Win32::System::Threading::{GetCurrentProcess, OpenProcessToken};
use windows_sys::Win32::System::WindowsProgramming::GetUserNameW;

use super::succeeded;

/// Maximum length of a user name, including the zero at its end (UNLEN).
const LONGEST_NAME: usize = 257;

/// Returns the name of the user of this process, as Windows knows it.
///
/// # Errors
/// Returns an error if Windows does not report the name.
pub fn own_name() -> io::Result<String> {
    let mut name = [0; LONGEST_NAME];
    let mut length = LONGEST_NAME as u32;
    // SAFETY: `name` has `length` units to write to; both live longer than the call.
    succeeded(unsafe { GetUserNameW(name.as_mut_ptr(), &mut length) })?;
    let name = name.split(|unit| *unit == 0).next().unwrap_or_default();
    Ok(String::from_utf16_lossy(name))
}

/// Returns the security identifier (SID) of the user of this process, such as `S-1-5-21-...`.
pub(crate) fn own_sid() -> io::Result<String> {
    let token = own_token()?;
    let mut length = 0;
    // SAFETY: without a buffer the call only reports the required length and fails. This failure is expected.
    unsafe { GetTokenInformation(token.as_raw_handle(), TokenUser, ptr::null_mut(), 0, &mut length) };
    // Words of eight bytes for the alignment: the data begins with a pointer.
    let mut room = vec![0_u64; (length as usize).div_ceil(8).max(1)];
    // SAFETY: `room` has at least `length` bytes and the alignment of the `TOKEN_USER` at its beginning.
    succeeded(unsafe {
        GetTokenInformation(token.as_raw_handle(), TokenUser, room.as_mut_ptr().cast(), length, &mut length)
    })?;
    if (length as usize) < size_of::<TOKEN_USER>() {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    // SAFETY: the call filled in a complete `TOKEN_USER`. Its identifier follows it in `room`.
    let user = unsafe { room.as_ptr().cast::<TOKEN_USER>().read() };
    text_of(user.User.Sid)
}

fn own_token() -> io::Result<OwnedHandle> {
    let mut token: HANDLE = ptr::null_mut();
    // SAFETY: the handle of the own process is always valid, and `token` lives longer than the call.
    succeeded(unsafe { OpenProcessToken(GetCurrentProcess(), TOKEN_QUERY, &mut token) })?;
    // SAFETY: the call opened this handle for us, and nobody else closes it.
    Ok(unsafe { OwnedHandle::from_raw_handle(token) })
}

/// Returns the text form of a security identifier (SID). `sid` must be a complete identifier from Windows.
pub(crate) fn text_of(sid: PSID) -> io::Result<String> {
    let mut text = ptr::null_mut();
    // SAFETY: Windows wrote `sid`. The call reports an invalid one as an error.
    succeeded(unsafe { ConvertSidToStringSidW(sid, &mut text) })?;
    let mut units = Vec::new();
    // SAFETY: the text ends with a zero and is read only up to it.
    while let unit @ 1.. = unsafe { text.add(units.len()).read() } {
        units.push(unit);
    }
    // SAFETY: the call allocated the text for us, and nothing points to it any more.
    unsafe { LocalFree(text.cast()) };
    Ok(String::from_utf16_lossy(&units))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_name_and_sid() {
        assert!(!own_name().unwrap().is_empty());
        let sid = own_sid().unwrap();
        assert!(sid.starts_with("S-1-") && !sid.contains('\0'), "{sid}");
    }
}
