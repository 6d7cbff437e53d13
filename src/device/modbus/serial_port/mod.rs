//! Serial ports of this computer.

mod names;
#[cfg(unix)]
mod unix;
#[cfg(windows)]
mod windows;

use std::io;

use tokio_serial::{SerialPortBuilderExt as _, SerialStream};

use super::parity::Parity;
use names::names;

#[cfg(unix)]
use unix::{can_list, is_there};
#[cfg(windows)]
use windows::{can_list, is_there};

/// Opens the serial port `device` with 8 data bits. `baud` is the speed in bit/s, and `stop_bits` is 1 or 2. While the
/// port is open, no other program can open it.
///
/// # Errors
/// The operating system cannot open the port, for example because it does not exist or is in use.
pub(super) fn open(device: &str, baud: u32, parity: Parity, stop_bits: u8) -> io::Result<SerialStream> {
    let parity = match parity {
        Parity::None => tokio_serial::Parity::None,
        Parity::Even => tokio_serial::Parity::Even,
        Parity::Odd => tokio_serial::Parity::Odd,
    };
    let stop_bits = if stop_bits == 2 { tokio_serial::StopBits::Two } else { tokio_serial::StopBits::One };
    Ok(tokio_serial::new(device, baud).parity(parity).stop_bits(stop_bits).open_native_async()?)
}

/// Returns a message if the serial port `device` does not exist on this computer, with the names of the existing ports.
/// Returns `None` if the port exists or `device` is empty.
pub(crate) fn missing(device: &str) -> Option<String> {
    if device.is_empty() || is_there(device) {
        return None;
    }
    let names = if can_list() { names() } else { Vec::new() };
    let there = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    Some(format!("the serial port {device} does not exist on this computer; the serial ports here: {there}"))
}
