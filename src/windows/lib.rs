//! Calls into Windows for which no safe crate exists. On other systems this crate is empty.
//!
//! ```text
//!  person   user of this process
//!  access   access rights to files and pipes
//!  files    files and folders that only their owner can access, and the free space of a disk
//!  pipe     named pipe that only its owner can open, from this computer only
//! ```
//!
//! Each call into Windows is in its own unsafe block, with the reason why it is sound. Public functions are safe to
//! call.
#![cfg(windows)]

mod access;
mod files;
mod person;
mod pipe;

pub use access::others_who_read;
pub use files::{create_owners_file, create_owners_folder, free_bytes};
pub use person::own_name;
pub use pipe::{client_process, is_of_this_user, listen};

use std::ffi::OsStr;
use std::io;
use std::os::windows::ffi::OsStrExt;

/// Returns `text` in the form that Windows functions expect: UTF-16 code units with a zero at the end.
///
/// # Errors
/// Returns an error if `text` itself contains a zero character, because Windows would end the text at this character.
fn wide(text: &OsStr) -> io::Result<Vec<u16>> {
    let mut units: Vec<u16> = text.encode_wide().collect();
    if units.contains(&0) {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    units.push(0);
    Ok(units)
}

/// Converts the return value `answer` of a Windows function into a result. Use it for functions that return 0 on
/// failure. Returns the last error of the system if `answer` is 0, and otherwise `Ok`.
fn succeeded(answer: i32) -> io::Result<()> {
    if answer == 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Converts the return value `number` of a Windows function into a result. Use it for functions that return an error
/// number, or 0 on success. Returns `Ok` if `number` is 0, and otherwise the system error with this number.
fn no_error(number: u32) -> io::Result<()> {
    if number == 0 { Ok(()) } else { Err(io::Error::from_raw_os_error(number.cast_signed())) }
}
