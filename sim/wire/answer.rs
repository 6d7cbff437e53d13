//! Answer to a Modbus request as the wire delivers it, with the faults of the plan.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio::time::Instant;

use super::faults::{Fault, Request, SharedFaultPlan};
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
#[derive(Clone, Copy)]
pub(super) enum Framing {
    Tcp { transaction: u16 },
    Rtu,
}

impl Framing {
    fn frame(self, unit: u8, pdu: &[u8], spoiled: bool) -> Vec<u8> {
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
pub(super) enum After {
    Open,
    Closed,
    Silent,
}

/// Answer as the wire delivers it, with its faults.
pub(super) struct Delivery {
    pub(super) delay: Duration,
    pub(super) bytes: Vec<u8>,
    pause: Option<Duration>,
    pub(super) after: After,
}

impl Delivery {
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

/// Executes a Modbus request and returns the answer with its simulated faults, for example a delay, wrong bytes or a
/// closed connection. First executes the stored requests whose second execution is due before this request.
///
/// `units` are the machines with their unit ids. `faults` is the fault plan, which selects the faults of this request.
/// `framing` is the format of the answer (TCP or RTU). `unit` is the unit id, and `pdu` is the protocol data unit of
/// the request.
///
/// If no machine has the unit id, the answer is an exception on TCP, and there is no answer on RTU. A fault can prevent
/// the execution of the request.
pub(super) fn answer(units: &Units, faults: &SharedFaultPlan, framing: Framing, unit: u8, pdu: &[u8]) -> Delivery {
    let machine = units.iter().find(|(id, _)| *id == unit).map(|(_, machine)| machine);
    let mut request = describe(machine, unit, pdu);
    let met = faults.draw(&mut request);
    for (unit, pdu) in faults.take_due(request.number) {
        if let Some((_, machine)) = units.iter().find(|(id, _)| *id == unit) {
            carry_out(machine, &pdu);
        }
    }
    let mut exception = None;
    for fault in &met {
        match (fault, machine) {
            (Fault::Exception(code), _) => exception = Some(vec![pdu[0] | 0x80, *code]),
            (Fault::DropRequest, _) => exception = Some(Vec::new()),
            (Fault::CarryOutAgain(after), _) => faults.defer(request.number + after, unit, pdu),
            (Fault::Freeze, Some(machine)) => machine.with(|machine| machine.freeze(true)),
            (Fault::Thaw, Some(machine)) => machine.with(|machine| machine.freeze(false)),
            (Fault::Reboot, Some(machine)) => machine.with(SimulatedMachine::reboot),
            (Fault::TornStatus, Some(machine)) => machine.with(SimulatedMachine::tear_status),
            _ => {}
        }
    }
    let reply = exception.unwrap_or_else(|| match (machine, framing) {
        (Some(machine), _) => carry_out(machine, pdu),
        (None, Framing::Tcp { .. }) => refusal(pdu[0], Exception::Target),
        (None, Framing::Rtu) => Vec::new(),
    });
    deliver(framing, unit, reply, &met)
}

pub(super) fn describe(machine: Option<&SharedMachine>, unit: u8, pdu: &[u8]) -> Request {
    let word = |at: usize| pdu.get(at..at + 2).map_or(0, |pair| u16::from_be_bytes([pair[0], pair[1]]));
    let (address, count) = (word(1), if pdu[0] == 6 { 1 } else { word(3) });
    let (state, block) = machine.map(|machine| machine.with(|m| (m.state(), m.layout().command))).unzip();
    let is_command = pdu[0] == 16 && block == Some(address) && count == 20;
    let command = is_command.then(|| word(10));
    Request { number: 0, unit, function: pdu[0], address, count, command, state }
}

pub(super) fn deliver(framing: Framing, unit: u8, mut reply: Vec<u8>, met: &[Fault]) -> Delivery {
    let mut delivery = Delivery { delay: Duration::ZERO, bytes: Vec::new(), pause: None, after: After::Open };
    if reply.is_empty() {
        return delivery;
    }
    let (mut framing, mut unit) = (framing, unit);
    for fault in met {
        match fault {
            Fault::WrongTransaction => {
                if let Framing::Tcp { transaction } = &mut framing {
                    *transaction ^= 0x5A5A;
                }
            }
            Fault::WrongUnit => unit ^= 0x40,
            Fault::WrongFunction => reply[0] ^= 0x01,
            Fault::FlipData => reply.last_mut().into_iter().for_each(|byte| *byte ^= 0x10),
            Fault::Fewer if reply[0] == 3 && reply[1] >= 2 => {
                reply[1] -= 2;
                reply.truncate(reply.len() - 2);
            }
            Fault::Lie(instead) if reply[0] == 3 => {
                for (register, value) in instead {
                    let at = 2 + 2 * register;
                    reply.get_mut(at..at + 2).into_iter().for_each(|word| word.copy_from_slice(&value.to_be_bytes()));
                }
            }
            Fault::WordSwap if reply[0] == 3 => reply[2..].chunks_exact_mut(4).for_each(|pair| pair.rotate_left(2)),
            _ => {}
        }
    }
    delivery.bytes = framing.frame(unit, &reply, met.contains(&Fault::FlipCrc));
    for fault in met {
        match fault {
            Fault::DropReply => delivery.bytes.clear(),
            Fault::DelayReply(delay) => delivery.delay = *delay,
            Fault::DuplicateReply => delivery.bytes = delivery.bytes.repeat(2),
            Fault::Truncate(length) => delivery.bytes.truncate(*length),
            Fault::Extra(bytes) => delivery.bytes.extend(bytes),
            Fault::Noise(bytes) => delivery.bytes = [&bytes[..], &delivery.bytes].concat(),
            Fault::Split(pause) => delivery.pause = Some(*pause),
            Fault::Disconnect(length) => {
                delivery.bytes.truncate(*length);
                delivery.after = After::Closed;
            }
            Fault::Silence => {
                delivery.bytes.clear();
                delivery.after = After::Silent;
            }
            _ => {}
        }
    }
    delivery
}

pub(super) fn refusal(function: u8, exception: Exception) -> Vec<u8> {
    vec![function | 0x80, exception as u8]
}

/// Carries out the Modbus request `pdu` (protocol data unit) on a machine. The functions 3 (read), 6 and 16 (write) are
/// known. Returns the protocol data unit of the answer. The answer is an exception if the function is unknown, if the
/// request is malformed, or if the machine refuses it.
pub(super) fn carry_out(machine: &SharedMachine, pdu: &[u8]) -> Vec<u8> {
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
