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

pub use amend::{AlongNormals, Amended, Amendment, correct_program};
pub use error::GcodeError;
pub use map::{MapBase, MapKind, ProgramMap, read_program_map};
pub use table::write_axis_table;
pub use write::{ProgramHeader, write_program};

pub(super) fn hex(bytes: &[u8; 32]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
