//! What is asked of Windows and no safe crate asks for it. Elsewhere there is nothing in here.
//!
//! ```text
//!  person   who this process belongs to
//!  access   who may do what with a file or a pipe
//!  files    files and folders for their owner alone, and the room that is left on a disk
//!  pipe     a named pipe that nobody but its owner opens, from this computer only
//! ```
//!
//! Every call into Windows stands in a block of its own that says why it is sound; what is public can be called by anybody.
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

/// A text as Windows takes it: in UTF-16, with a zero behind it and none within.
fn wide(text: &OsStr) -> io::Result<Vec<u16>> {
    let mut units: Vec<u16> = text.encode_wide().collect();
    if units.contains(&0) {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    units.push(0);
    Ok(units)
}

/// What a call says that returns 0 where it failed.
fn succeeded(answer: i32) -> io::Result<()> {
    if answer == 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// What a call says that returns the number of its error, or 0.
fn no_error(number: u32) -> io::Result<()> {
    if number == 0 { Ok(()) } else { Err(io::Error::from_raw_os_error(number.cast_signed())) }
}
