//! Real measurements. They are not part of the repository: the variable REGRIND_DATA names their folder.

use std::path::PathBuf;

/// Returns the path of a folder of real measurements.
pub fn data(folder: &str) -> PathBuf {
    let data = std::env::var_os("REGRIND_DATA").expect("REGRIND_DATA names the folder of real measurements");
    let found = PathBuf::from(data).join(folder);
    assert!(found.is_dir(), "REGRIND_DATA names no folder with {folder}");
    found
}
