//! The journal on a disk that fails, beneath SQLite: the code that runs a cell, with nothing put in its place, above a
//! disk that errs, fills up, is locked by others, stalls and loses power. What it does and what it leaves out:
//! docs/reliability.md.
#![cfg(unix)]

mod faults;
mod life;
mod power;
mod reading;
mod stalls;
