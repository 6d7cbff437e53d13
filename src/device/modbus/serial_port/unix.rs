//! Serial ports on Unix: a port is a device file, or a link to one.

use std::path::Path;

/// Returns true if the serial port `device` exists on this computer.
pub(crate) fn is_there(device: &str) -> bool {
    Path::new(device).exists()
}
