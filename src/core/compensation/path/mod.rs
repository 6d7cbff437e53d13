//! Tool path of the wheel over the target surface: tracks over the part, positions of the wheel's centre along the
//! tracks, and the checks that a path must pass before a program is written from it.
//!
//! ```text
//!  Nominal --nominal_height_field--> HeightField --+
//!                                                  +-- TargetSurface --ToolPath--> Moves --> program
//!  Correction --correction_spline--> HeightField --+       Wheel -------/     \--> PathSummary, checked against limits
//! ```
//!
//! The module is pure: no I/O and no clock. Frame: everything is in the model frame {M}, with z away from the part.
//! Units: mm, s, rad; feeds are in mm/min. The points of a path are not stored: a path is a list of tracks and an
//! iterator over their points.

mod arcs;
mod axis_table;
mod error;
mod groove;
mod height_field;
mod moves;
mod nominal_height;
mod options;
mod rotary;
mod scallop;
mod summary;
mod target_surface;
mod tilt;
mod tool_path;
mod tracks;
mod wheel;
mod wheel_fit;

pub use arcs::{Arc, ArcBlocks, ArcOptions, ArcSummary, MovesWithMiddles, Plane, ProgramBlock};
pub use axis_table::axis_offsets;
pub use error::PathError;
pub use height_field::{HeightField, Jet};
pub use moves::{Move, Moves};
pub use nominal_height::nominal_height_field;
pub use options::{PathMode, PathOptions, TrackPattern, TrackSpacing};
pub use rotary::{RotaryAxis, RotationAxis, TiltMode};
pub use scallop::Scallops;
pub use summary::{HeadRotation, MachineLimits, PathSummary, Peak};
pub use target_surface::{Contact, TargetSurface, ball_displacement, correction_spline};
pub use tool_path::ToolPath;
pub use wheel::Wheel;
