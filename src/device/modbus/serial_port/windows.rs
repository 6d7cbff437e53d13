//! Serial ports on Windows: the name of a port is in no folder. It is `COM3`, or in full `\\.\COM3`.

use super::names::names;

/// Returns true if the serial port `device` exists on this computer.
pub(crate) fn is_there(device: &str) -> bool {
    let name = device.strip_prefix(r"\\.\").unwrap_or(device);
    names().iter().any(|there| there.eq_ignore_ascii_case(name))
}

/// Returns true: Windows always lists its serial ports.
pub(super) fn can_list() -> bool {
    true
}
