//! Programs for the grinder: read back by an interpreter that none of us wrote, swept by wheels, corrected by maps.

mod compensate;
mod dialects;
mod gcode;
mod generated;
#[path = "../common/keep.rs"]
mod keep;
mod linuxcnc;
mod path;
#[path = "../common/program.rs"]
mod program;
#[path = "../common/sample.rs"]
mod sample;
mod sweep;
mod tilt;
