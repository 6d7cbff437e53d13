//! A port has a name that stands in no folder: `COM3`, or in full `\\.\COM3`.

/// Whether a port is on this computer.
pub(crate) fn is_there(device: &str) -> bool {
    let name = device.strip_prefix(r"\\.\").unwrap_or(device);
    super::names().iter().any(|there| there.eq_ignore_ascii_case(name))
}
