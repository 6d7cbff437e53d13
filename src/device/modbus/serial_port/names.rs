//! Names of the serial ports of this computer.

/// Returns the names of the serial ports that the operating system knows.
pub(super) fn names() -> Vec<String> {
    let ports = serialport::available_ports().unwrap_or_default();
    ports.into_iter().map(|port| port.port_name).collect()
}
