//! From the surface wanted to the way of the wheel: tracks over the part, the wheel's centre along them, and what must hold
//! before a program is made of it.
//!
//! ```text
//!  Nominal --height_of--> Field --+
//!                                 +-- Wanted (points, normals of the corrected surface) --ToolPath--> Moves --> a program
//!  Correction --spline--> Field --+                 Wheel (where its centre must be)  --/      \--> Summary, checked against limits
//! ```
//!
//! Pure. Frame: everything is in the model frame {M}, z away from the part. Units: mm, s, rad; feeds are mm/min. A path is never
//! held in memory: it is a list of tracks and an iterator over their points.

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
