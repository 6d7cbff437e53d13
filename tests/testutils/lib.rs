//! Helpers for the tests of every crate. They depend on no other crate of this workspace, so the tests of a low crate
//! build nothing that stands above it. What needs a cell is in regrind-testcell.

pub mod data;
pub mod keep;
pub mod python;
pub mod sample;

use std::path::Path;

/// Returns the root folder of the sources.
pub fn root() -> &'static Path {
    // The folder of this crate is two levels below.
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).expect("the folder of the sources")
}
