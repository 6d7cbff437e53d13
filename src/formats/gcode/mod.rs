//! Programs for numerically controlled machines, in the dialect of LinuxCNC: writing them, reading them, correcting them.
//!
//! ```text
//!  ToolPath --write_program--> part.ngc
//!  base.ngc --Program::read--> lines and moves --correct--> corrected.ngc     (with a map over x and y)
//! ```

mod amend;
mod arc;
mod error;
mod map;
mod number;
mod read;
mod table;
mod write;

use std::io::Read as _;
use std::path::Path;

use crate::FormatError;

pub use amend::{AlongNormals, Amended, Amendment, correct_program};
pub use error::GcodeError;
pub use map::{MapBase, MapKind, ProgramMap, read_program_map};
pub use table::write_axis_table;
pub use write::{ProgramHeader, write_program};

pub(super) fn hex(bytes: &[u8; 32]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// Reads a whole file of no more than so many bytes.
fn read_bytes(path: &Path, limit: u64) -> Result<Vec<u8>, GcodeError> {
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    let found = bytes.len() as u64;
    if found > limit {
        return Err(FormatError::TooLarge { path: path.to_owned(), found, limit, unit: "bytes" }.into());
    }
    Ok(bytes)
}
