//! Programs for numerically controlled machines: written, read and corrected in the dialect of a control.
//!
//! ```text
//!  ToolPath + Dialect --write_program--> part.ngc, part.nc, part.mpf, part.h
//!  base program --dialect_reading--> words of LinuxCNC --amend--> corrected words --dialect_writing--> program
//!                                                      (with a map over x and y)
//! ```

mod amend;
mod amendment;
mod arc;
mod check;
mod control;
mod dialect;
mod dialect_reading;
mod dialect_writing;
mod error;
mod map;
mod number;
mod read;
mod table;
mod write;

pub use amend::{Amended, correct_program};
pub use amendment::{AlongNormals, Amendment};
pub use dialect::{
    ArcWords, CentreWords, Dialect, DialectError, DialectProblem, Exactness, LINUXCNC, Tilting, Turning,
};
pub use error::GcodeError;
pub use map::{MapBase, MapKind, ProgramMap, read_program_map};
pub use table::write_axis_table;
pub use write::{ProgramHeader, write_program};
