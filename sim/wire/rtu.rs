//! Modbus RTU: frames separated by silence, a CRC at the end, and a line with limited speed.
//!
//! A pseudo-terminal transmits any number of bytes at once, whatever its baud rate. A paced line therefore waits for
//! the time that the bytes of request and answer would take on a wire, so that a client measures the same times as on a
//! real line.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite};

use super::answer::{After, Exchange, Framing, Units, WireFaults};
use crate::register_encoding::crc16;

/// Silence after which an incomplete frame is dropped. It is far longer than 3.5 characters, since a busy computer
/// pauses between bytes where a wire does not.
const GIVE_UP: Duration = Duration::from_millis(50);

/// Speed of a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Line {
    /// Bits per second; a character has 11 bits.
    pub baud: u32,
    /// True if the line waits for the time of its bytes; false for a port that is slow by itself.
    pub paced: bool,
}

impl Line {
    /// Returns a simulated line that delays each frame by its transmission time at the baud rate.
    pub fn paced(baud: u32) -> Self {
        Self { baud, paced: true }
    }

    /// Returns the transmission time of `count` characters of 11 bits.
    pub fn characters(&self, count: usize) -> Duration {
        Duration::from_secs_f64(11.0 * count as f64 / f64::from(self.baud.max(1)))
    }

    /// Returns the silence between two frames: 3.5 characters, or 1.75 ms above 19200 baud.
    pub fn gap(&self) -> Duration {
        if self.baud > 19_200 { Duration::from_micros(1750) } else { self.characters(7) / 2 }
    }
}

/// Answers Modbus RTU requests that arrive at the serial port `port`. `units` are the simulated machines with their
/// unit ids. `line` gives the speed of the line. `faults` are the simulated faults. Requests to unit 0 (broadcast) get
/// no answer. Runs until its future is dropped or the port fails.
///
/// # Errors
/// The port cannot be read or written any more.
pub async fn serve_rtu<P>(mut port: P, units: Units, line: Line, faults: impl WireFaults) -> io::Result<()>
where
    P: AsyncRead + AsyncWrite + Unpin,
{
    let mut heard = Vec::new();
    let mut silent = false;
    loop {
        let frame = next_frame(&mut port, &mut heard).await?;
        let (unit, pdu) = (frame[0], &frame[1..frame.len() - 2]);
        if unit == 0 || silent || pdu.is_empty() {
            continue;
        }
        tokio::time::sleep(if line.paced { line.characters(frame.len()) } else { Duration::ZERO } + line.gap()).await;
        let mut delivery = faults.answer(&Exchange { units: &units, framing: Framing::Rtu, unit, pdu });
        if line.paced {
            delivery.delay += line.characters(delivery.bytes.len());
        }
        delivery.send(&mut port).await?;
        silent = delivery.after == After::Silent;
    }
}

/// Returns the next Modbus RTU frame with a correct CRC from `port`. `heard` is a buffer: it holds the bytes that were
/// received and not used yet. After a wrong CRC, all bytes up to the next silence of 50 ms are dropped. A frame with an
/// unknown function ends at such a silence.
///
/// Returns an error if `port` is closed or cannot be read.
async fn next_frame<P: AsyncRead + Unpin>(port: &mut P, heard: &mut Vec<u8>) -> io::Result<Vec<u8>> {
    let mut broken = false;
    loop {
        if let Some(length) = length(heard).filter(|length| !broken && heard.len() >= *length) {
            if is_sound(&heard[..length]) {
                return Ok(heard.drain(..length).collect());
            }
            broken = true;
        }
        let mut bytes = [0; 256];
        let read = port.read(&mut bytes);
        let count = if heard.is_empty() {
            read.await?
        } else {
            tokio::time::timeout(GIVE_UP, read).await.unwrap_or(Ok(usize::MAX))?
        };
        match count {
            0 => return Err(io::ErrorKind::UnexpectedEof.into()),
            usize::MAX => {
                // Silence: a function of unknown length ends here.
                let frame = std::mem::take(heard);
                if !broken && is_sound(&frame) {
                    return Ok(frame);
                }
                broken = false;
            }
            count => {
                heard.extend(&bytes[..count]);
                if heard.len() > 4096 {
                    heard.clear();
                    broken = true;
                }
            }
        }
    }
}

/// Returns the length in bytes of the Modbus RTU request at the beginning of `heard`, with its CRC. Returns `None` if
/// the Modbus function is unknown, or if too few bytes have arrived to know the length.
fn length(heard: &[u8]) -> Option<usize> {
    match heard.get(1)? {
        1..=6 | 8 => Some(8),
        15 | 16 => Some(9 + usize::from(*heard.get(6)?)),
        _ => None,
    }
}

fn is_sound(frame: &[u8]) -> bool {
    frame.len() >= 4 && frame.split_last_chunk().is_some_and(|(body, crc)| crc16(body) == u16::from_le_bytes(*crc))
}
