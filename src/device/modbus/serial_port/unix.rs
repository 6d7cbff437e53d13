//! Serial ports on Unix: a port is a device file, or a link to one.

use std::path::Path;

/// Returns true if the serial port `device` exists on this computer.
pub(crate) fn is_there(device: &str) -> bool {
    Path::new(device).exists()
}

/// Returns true if the serial ports of this computer can be listed. On Linux they are in `/sys`, which a bare root or a
/// container can lack; the library that lists them panics then.
pub(super) fn can_list() -> bool {
    cfg!(not(target_os = "linux")) || Path::new("/sys/class/tty").is_dir()
}
