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

use std::fmt;
use std::io::Read as _;
use std::path::Path;

use crate::FormatError;

pub use amend::{AlongNormals, Amended, Amendment, correct_program};
pub use error::GcodeError;
pub use map::{MapBase, MapKind, ProgramMap, read_program_map};
pub use table::write_axis_table;
pub use write::{ProgramHeader, write_program};

/// How exactly a controller keeps to the path that a program describes.
///
/// LinuxCNC's default at power-on is `G64` without a tolerance, which cuts corners by a tenth of a millimetre and more: a program must say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PathMode {
    /// G64: corners are rounded within a tolerance, and points on a line within another are joined; 0 joins none.
    Blend {
        /// P, in millimetres.
        tolerance_mm: f64,
        /// Q, in millimetres.
        naive_mm: f64,
    },
    /// G61: every point is passed through exactly.
    ExactPath,
    /// G61.1: every point is stopped at.
    ExactStop,
}

impl Default for PathMode {
    fn default() -> Self {
        Self::Blend { tolerance_mm: 1e-4, naive_mm: 0.0 }
    }
}

impl fmt::Display for PathMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Blend { tolerance_mm, naive_mm } => {
                write!(f, "G64 P{} Q{}", number::short(*tolerance_mm), number::short(*naive_mm))
            }
            Self::ExactPath => f.write_str("G61"),
            Self::ExactStop => f.write_str("G61.1"),
        }
    }
}

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
