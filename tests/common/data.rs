//! Real measurements: they stand outside of the project, in the folder that REGRIND_DATA names.

use std::path::PathBuf;

/// A folder of real measurements.
pub fn data(folder: &str) -> PathBuf {
    let data = std::env::var_os("REGRIND_DATA").expect("REGRIND_DATA names the folder of real measurements");
    let found = PathBuf::from(data).join(folder);
    assert!(found.is_dir(), "REGRIND_DATA names no folder with {folder}");
    found
}
