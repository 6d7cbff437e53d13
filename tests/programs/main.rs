//! Programs for the grinder: read back by an interpreter that none of us wrote, swept by wheels, corrected by maps.

regrind_testcell::program!();

mod compensate;
mod dialects;
mod gcode;
mod generated;
mod linuxcnc;
mod path;
mod sweep;
mod tilt;
