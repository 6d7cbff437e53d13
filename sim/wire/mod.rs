//! The machines' end of a wire.
//!
//! ```text
//!  tcp      any number of clients, several units behind one port
//!  rtu      a serial line, real or not, that takes as long as its baud rate says
//!  pty      a serial line without hardware, opened by its path
//!  faults   faults on Modbus, with their conditions
//!  dme      I++ DME over TCP, one client at a time
//!  rsh      the lines of linuxcncrsh, any number of clients
//!  executed the path that an external controller executes, a line for each servo cycle
//!  hits     a line for each touch, on a serial line or over TCP
//! ```
//!
//! Most callers need only [`Serving`]: it binds, serves, lets the machines' time pass, and stops.

pub mod dme;
pub mod executed_path;
pub mod faults;
pub mod hits;
#[cfg(not(unix))]
#[path = "no_pty.rs"]
pub mod pty;
#[cfg(unix)]
pub mod pty;
pub mod rsh;
pub mod rtu;
pub mod tcp;

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, ToSocketAddrs};
use tokio::task::JoinSet;
use tokio::time::Instant;

use crate::register_encoding::{bytes_of, crc16, registers_of};
use crate::registers::{Exception, SimulatedMachine};
use faults::{Fault, Request, SharedFaultPlan};

/// Interval at which the machines' time advances.
const TICK: Duration = Duration::from_millis(10);
/// Maximum time that one tick lets pass. If the simulator gets no processor time, the machines' time stops too.
const MAX_TICK: Duration = Duration::from_millis(100);

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
    fn advance_time(&self) {
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

/// Advances the machines with real time. Runs until its future is dropped.
pub async fn advance_machines(machines: Vec<SharedMachine>) {
    let mut ticks = tokio::time::interval(TICK);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        machines.iter().for_each(SharedMachine::advance_time);
    }
}

/// Framing of an answer on the wire.
#[derive(Clone, Copy)]
enum Framing {
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
enum After {
    Open,
    Closed,
    Silent,
}

/// Answer as the wire delivers it, with its faults.
struct Delivery {
    delay: Duration,
    bytes: Vec<u8>,
    pause: Option<Duration>,
    after: After,
}

impl Delivery {
    async fn send(&self, wire: &mut (impl AsyncWrite + Unpin)) -> io::Result<()> {
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
fn answer(units: &Units, faults: &SharedFaultPlan, framing: Framing, unit: u8, pdu: &[u8]) -> Delivery {
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

fn describe(machine: Option<&SharedMachine>, unit: u8, pdu: &[u8]) -> Request {
    let word = |at: usize| pdu.get(at..at + 2).map_or(0, |pair| u16::from_be_bytes([pair[0], pair[1]]));
    let (address, count) = (word(1), if pdu[0] == 6 { 1 } else { word(3) });
    let (state, block) = machine.map(|machine| machine.with(|m| (m.state(), m.layout().command))).unzip();
    let is_command = pdu[0] == 16 && block == Some(address) && count == 20;
    let command = is_command.then(|| word(10));
    Request { number: 0, unit, function: pdu[0], address, count, command, state }
}

fn deliver(framing: Framing, unit: u8, mut reply: Vec<u8>, met: &[Fault]) -> Delivery {
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

fn refusal(function: u8, exception: Exception) -> Vec<u8> {
    vec![function | 0x80, exception as u8]
}

/// Carries out the Modbus request `pdu` (protocol data unit) on a machine. The functions 3 (read), 6 and 16 (write) are
/// known. Returns the protocol data unit of the answer. The answer is an exception if the function is unknown, if the
/// request is malformed, or if the machine refuses it.
fn carry_out(machine: &SharedMachine, pdu: &[u8]) -> Vec<u8> {
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

/// Machines that are served until this is stopped or dropped.
pub struct Serving {
    local_addr: Option<SocketAddr>,
    path: Option<PathBuf>,
    machines: Units,
    faults: SharedFaultPlan,
    tasks: JoinSet<io::Result<()>>,
    /// Link to a pseudo-terminal, and its target.
    linked: Option<(PathBuf, PathBuf)>,
}

impl Drop for Serving {
    fn drop(&mut self) {
        if let Some((link, port)) = self.linked.take()
            && std::fs::read_link(&link).is_ok_and(|to| to == port)
        {
            // There is nobody to report an error to; the next simulator replaces a link that stays.
            let _ = std::fs::remove_file(link);
        }
    }
}

impl Serving {
    /// Serves machines over Modbus TCP at the address `addr`, without simulated faults. `units` contains each machine
    /// with its unit id. With port 0, the operating system selects a free port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp<M: Into<SharedMachine>>(addr: impl ToSocketAddrs, units: Vec<(u8, M)>) -> io::Result<Self> {
        Self::tcp_with(addr, units, SharedFaultPlan::none()).await
    }

    /// Serves machines over Modbus TCP at the address `addr`, with simulated faults. `units` contains each machine with
    /// its unit id. `faults` is the fault plan. With port 0, the operating system selects a free port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp_with<M: Into<SharedMachine>>(
        addr: impl ToSocketAddrs,
        units: Vec<(u8, M)>,
        faults: SharedFaultPlan,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(addr).await?;
        let mut serving = Self::new(units, faults);
        serving.local_addr = Some(listener.local_addr()?);
        let (machines, faults) = (serving.machines.clone(), serving.faults.clone());
        serving.tasks.spawn(async move { tcp::serve_tcp(listener, machines, faults).await });
        Ok(serving)
    }

    /// Serves machines over Modbus RTU on a new pseudo-terminal. `units` contains each machine with its unit id, `line`
    /// is the speed of the simulated serial line, and `faults` is the fault plan. [`Self::path`] returns the path of
    /// the pseudo-terminal; a client opens this path like a serial port.
    ///
    /// # Errors
    /// Returns an error if no pseudo-terminal is available.
    pub fn rtu<M: Into<SharedMachine>>(
        units: Vec<(u8, M)>,
        line: rtu::Line,
        faults: SharedFaultPlan,
    ) -> io::Result<Self> {
        let port = pty::Pty::open()?;
        let mut serving = Self::new(units, faults);
        serving.path = Some(port.path().to_path_buf());
        serving.spawn_rtu(port, line);
        Ok(serving)
    }

    /// Creates a symbolic link at the path `at` to the served serial port. The configuration of a client can then
    /// contain a fixed path. Replaces an existing link at `at`. The link is removed when this value is dropped.
    ///
    /// # Errors
    /// Returns an error if `at` is an existing file that is not a link, if the link cannot be created, or if the
    /// machines are served over TCP.
    pub fn link(&mut self, at: impl AsRef<Path>) -> io::Result<()> {
        let at = at.as_ref();
        let port = self.path.clone().ok_or(io::ErrorKind::Unsupported)?;
        if std::fs::symlink_metadata(at).is_ok_and(|found| found.is_symlink()) {
            std::fs::remove_file(at)?;
        }
        pty::link(&port, at)?;
        self.linked = Some((at.to_path_buf(), port));
        self.path = Some(at.to_path_buf());
        Ok(())
    }

    /// Serves machines over Modbus RTU on an existing serial port of this computer, with 8 data bits, no parity and 1
    /// stop bit. `path` is the path of the port. `units` contains each machine with its unit id. `line` contains the
    /// baud rate, and `faults` is the fault plan.
    ///
    /// # Errors
    /// Returns an error if the port cannot be opened.
    pub fn rtu_at<M: Into<SharedMachine>>(
        path: impl AsRef<Path>,
        units: Vec<(u8, M)>,
        line: rtu::Line,
        faults: SharedFaultPlan,
    ) -> io::Result<Self> {
        let path = path.as_ref();
        let builder = tokio_serial::new(path.to_string_lossy(), line.baud);
        let port = tokio_serial::SerialStream::open(&builder)?;
        let mut serving = Self::new(units, faults);
        serving.path = Some(path.to_path_buf());
        serving.spawn_rtu(port, line);
        Ok(serving)
    }

    fn new<M: Into<SharedMachine>>(units: Vec<(u8, M)>, faults: SharedFaultPlan) -> Self {
        let machines: Units = units.into_iter().map(|(unit, machine)| (unit, machine.into())).collect();
        let living = machines.iter().map(|(_, machine)| machine.clone()).collect();
        let mut tasks = JoinSet::new();
        tasks.spawn(async move {
            advance_machines(living).await;
            Ok(())
        });
        Self { local_addr: None, path: None, machines, faults, tasks, linked: None }
    }

    fn spawn_rtu<P>(&mut self, port: P, line: rtu::Line)
    where
        P: tokio::io::AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let (machines, faults) = (self.machines.clone(), self.faults.clone());
        self.tasks.spawn(async move { rtu::serve_rtu(port, machines, line, faults).await });
    }

    /// Returns the address of the TCP server, or `None` for a serial port.
    pub fn local_addr(&self) -> Option<SocketAddr> {
        self.local_addr
    }

    /// Returns the path of the served serial port, or `None` for TCP. If [`Self::link`] created a link, returns the
    /// path of the link. A client can open this path only if the port is a pseudo-terminal.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Returns the served machines, each with its unit id.
    pub fn machines(&self) -> &Units {
        &self.machines
    }

    /// Returns the served machine with the unit id `unit`. Returns `None` if there is no such machine.
    pub fn machine(&self, unit: u8) -> Option<&SharedMachine> {
        self.machines.iter().find(|(id, _)| *id == unit).map(|(_, machine)| machine)
    }

    /// Returns the fault plan of the served machines. A caller can replace this plan at any time with
    /// [`SharedFaultPlan::set`].
    pub fn faults(&self) -> &SharedFaultPlan {
        &self.faults
    }

    /// Waits until the simulated interface fails, for example because a serial port is unplugged, and returns the
    /// failure as an error. Does not return while the interface works. A TCP port does not fail.
    ///
    /// # Errors
    /// Returns the failure of the interface.
    pub async fn failed(&mut self) -> io::Result<()> {
        loop {
            match self.tasks.join_next().await {
                Some(Ok(Err(error))) => return Err(error),
                Some(Err(error)) => return Err(io::Error::other(error)),
                Some(Ok(Ok(()))) => {}
                None => return Ok(()),
            }
        }
    }

    /// Closes every connection and waits until all tasks have ended. The machines keep their state and can be served
    /// again.
    pub async fn stop(mut self) {
        self.tasks.shutdown().await;
    }
}
