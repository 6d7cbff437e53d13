//! Answer to a Modbus request as the wire delivers it.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio::time::Instant;

use crate::register_encoding::{bytes_of, crc16, registers_of};
use crate::registers::{Exception, SimulatedMachine};

/// Time step of a machine between two requests.
const PIECE: Duration = Duration::from_millis(1);

/// Machine shared by wires, tests and time.
#[derive(Clone)]
pub struct SharedMachine(Arc<Mutex<TimedMachine>>);

struct TimedMachine {
    machine: SimulatedMachine,
    ticked: Option<Instant>,
}

impl From<SimulatedMachine> for SharedMachine {
    fn from(machine: SimulatedMachine) -> Self {
        Self(Arc::new(Mutex::new(TimedMachine { machine, ticked: None })))
    }
}

impl SharedMachine {
    /// Calls the function `look` with exclusive access to the machine, and returns the result of `look`.
    pub fn with<T>(&self, look: impl FnOnce(&mut SimulatedMachine) -> T) -> T {
        look(&mut self.lock().machine)
    }

    /// Advances the simulated machine by the real time since the last call. One call advances it by at most `MAX_TICK`
    /// (100 ms). The first call does not advance it.
    pub(super) fn advance_time(&self) {
        let now = Instant::now();
        let last = self.lock().ticked.replace(now).unwrap_or(now);
        let mut left = now.saturating_duration_since(last).min(MAX_TICK);
        // The physics of a fast machine takes time to compute; a request must wait for at most one step of it.
        while !left.is_zero() {
            let piece = left.min(PIECE);
            left -= piece;
            self.lock().machine.tick(piece);
        }
    }

    fn lock(&self) -> MutexGuard<'_, TimedMachine> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Machines of a wire with their unit ids.
pub type Units = Vec<(u8, SharedMachine)>;

/// Framing of an answer on the wire.
#[derive(Clone, Copy, Debug)]
pub enum Framing {
    /// A header with this transaction id.
    Tcp {
        /// Transaction id of the request.
        transaction: u16,
    },
    /// A CRC at the end.
    Rtu,
}

impl Framing {
    /// Returns the frame of an answer. `unit` is the unit id, and `pdu` the protocol data unit of the answer. If
    /// `spoiled` is true, the CRC is wrong (RTU), or the protocol id (TCP).
    pub fn frame(self, unit: u8, pdu: &[u8], spoiled: bool) -> Vec<u8> {
        let spoil = u16::from(spoiled);
        let mut frame = Vec::with_capacity(pdu.len() + 7);
        match self {
            Self::Tcp { transaction } => {
                for word in [transaction, spoil, pdu.len() as u16 + 1] {
                    frame.extend(word.to_be_bytes());
                }
                frame.push(unit);
                frame.extend(pdu);
            }
            Self::Rtu => {
                frame.push(unit);
                frame.extend(pdu);
                frame.extend((crc16(&frame) ^ spoil).to_le_bytes());
            }
        }
        frame
    }
}

/// State of the connection after an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum After {
    /// It stays open.
    Open,
    /// It is closed.
    Closed,
    /// It accepts every byte and returns none.
    Silent,
}

/// Answer as the wire delivers it.
#[derive(Clone, Debug)]
pub struct Delivery {
    /// Time before the first byte.
    pub delay: Duration,
    /// Bytes of the answer; empty if there is none.
    pub bytes: Vec<u8>,
    /// Pause between two bytes; `None` if all bytes come together.
    pub pause: Option<Duration>,
    /// State of the connection after the answer.
    pub after: After,
}

impl Delivery {
    /// Returns an answer that is delivered at once.
    pub fn at_once(bytes: Vec<u8>) -> Self {
        Self { delay: Duration::ZERO, bytes, pause: None, after: After::Open }
    }

    pub(super) async fn send(&self, wire: &mut (impl AsyncWrite + Unpin)) -> io::Result<()> {
        if !self.delay.is_zero() {
            tokio::time::sleep(self.delay).await;
        }
        let Some(pause) = self.pause else {
            wire.write_all(&self.bytes).await?;
            return wire.flush().await;
        };
        for byte in &self.bytes {
            wire.write_all(&[*byte]).await?;
            wire.flush().await?;
            tokio::time::sleep(pause).await;
        }
        Ok(())
    }
}

/// Request on a wire, and the machines that can answer it.
#[derive(Clone, Copy)]
pub struct Exchange<'a> {
    /// Machines of the wire with their unit ids.
    pub units: &'a Units,
    /// Framing of the answer.
    pub framing: Framing,
    /// Unit id of the request.
    pub unit: u8,
    /// Protocol data unit of the request.
    pub pdu: &'a [u8],
}

impl Exchange<'_> {
    /// Returns the machine that the request addresses, if there is one.
    pub fn machine(&self) -> Option<&SharedMachine> {
        self.units.iter().find(|(id, _)| *id == self.unit).map(|(_, machine)| machine)
    }

    /// Executes the request, and returns the protocol data unit of the answer. If no machine has the unit id, the answer
    /// is an exception on TCP, and there is no answer on RTU.
    pub fn reply(&self) -> Vec<u8> {
        match (self.machine(), self.framing) {
            (Some(machine), _) => carry_out(machine, self.pdu),
            (None, Framing::Tcp { .. }) => refusal(self.pdu[0], Exception::Target),
            (None, Framing::Rtu) => Vec::new(),
        }
    }
}

/// Faults of the requests on a wire and of their answers.
pub trait WireFaults: Clone + Send + Sync + 'static {
    /// Answers a request, with the faults that it meets.
    fn answer(&self, exchange: &Exchange<'_>) -> Delivery;
}

/// Wire without faults.
#[derive(Clone, Copy, Debug)]
pub struct NoFaults;

impl WireFaults for NoFaults {
    fn answer(&self, exchange: &Exchange<'_>) -> Delivery {
        let reply = exchange.reply();
        let is_answered = !reply.is_empty();
        Delivery::at_once(if is_answered { exchange.framing.frame(exchange.unit, &reply, false) } else { reply })
    }
}

fn refusal(function: u8, exception: Exception) -> Vec<u8> {
    vec![function | 0x80, exception as u8]
}

/// Carries out the Modbus request `pdu` (protocol data unit) on a machine. The functions 3 (read), 6 and 16 (write) are
/// known. Returns the protocol data unit of the answer. The answer is an exception if the function is unknown, if the
/// request is malformed, or if the machine refuses it.
pub fn carry_out(machine: &SharedMachine, pdu: &[u8]) -> Vec<u8> {
    let word = |at: usize| u16::from_be_bytes([pdu[at], pdu[at + 1]]);
    let done = match (pdu[0], pdu.len()) {
        (3, 5) => machine.with(|m| m.read(word(1), word(3))).map(|registers| {
            let mut reply = vec![3, 2 * registers.len() as u8];
            reply.extend(bytes_of(&registers));
            reply
        }),
        (6, 5) => machine.with(|m| m.write(word(1), &[word(3)])).map(|()| pdu.to_vec()),
        (16, 8..) if usize::from(pdu[5]) == pdu.len() - 6 && u16::from(pdu[5]) == word(3).wrapping_mul(2) => {
            machine.with(|m| m.write(word(1), &registers_of(&pdu[6..]))).map(|()| pdu[..5].to_vec())
        }
        (3 | 6 | 16, _) => Err(Exception::Value),
        _ => Err(Exception::Function),
    };
    done.unwrap_or_else(|exception| refusal(pdu[0], exception))
}

/// Maximum time that one tick lets pass. If the simulator gets no processor time, the machines' time stops too.
pub(super) const MAX_TICK: Duration = Duration::from_millis(100);
