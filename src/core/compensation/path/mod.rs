//! Tool path of the wheel over the target surface: tracks over the part, positions of the wheel's centre along the
//! tracks, and the checks that a path must pass before a program is written from it.
//!
//! ```text
//!  Nominal --height_of--> Field --+
//!                                 +-- Wanted (points, normals of target) --ToolPath--> Moves --> program
//!  Correction --spline--> Field --+      Wheel (position of its centre) --/      \--> Summary, checked against limits
//! ```
//!
//! The module is pure: no I/O and no clock. Frame: everything is in the model frame {M}, with z away from the part.
//! Units: mm, s, rad; feeds are in mm/min. The points of a path are not stored: a path is a list of tracks and an
//! iterator over their points.

mod arcs;
mod axis_table;
mod error;
mod field;
mod fit;
mod nominal;
mod options;
mod scallop;
mod summary;
mod tilt;
mod tool_path;
mod tracks;
mod walk;
mod wanted;
mod wheel;

pub use arcs::{Arc, ArcOptions, ArcSummary, Arcs, Block, Plane, Sampled};
pub use axis_table::axis_offsets;
pub use error::PathError;
pub use field::{Field, Jet};
pub use nominal::height_of;
pub use options::{PathMode, PathOptions, Pattern, TrackSpacing};
pub use scallop::Scallops;
pub use summary::{Limits, Peak, Summary, Turned};
pub use tilt::{Lean, Rotary, TurnAxis};
pub use tool_path::ToolPath;
pub use walk::{Move, Moves};
pub use wanted::{Contact, Wanted, displaced, spline_of};
pub use wheel::Wheel;
