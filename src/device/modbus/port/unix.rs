//! A port is a device among the files, or a link to one.

use std::path::Path;

/// Whether a port is on this computer.
pub(crate) fn is_there(device: &str) -> bool {
    Path::new(device).exists()
}
