//! The machines' end of a wire.
//!
//! ```text
//!  tcp      any number of clients, several units behind one port
//!  rtu      a serial line, real or not, that takes as long as its baud rate says
//!  pty      a serial line without hardware, opened by its path
//!  lines    lines of text over TCP, for I++ DME and linuxcncrsh
//!  executed the path that an external controller executes, a line for each servo cycle
//!  hits     a line for each touch, on a serial line or over TCP
//! ```
//!
//! Most callers need only [`Serving`]: it binds, serves, lets the machines' time pass, and stops.

mod answer;
pub mod executed_path;
pub mod hits;
pub mod lines;
#[cfg(not(unix))]
#[path = "no_pty.rs"]
pub mod pty;
#[cfg(unix)]
pub mod pty;
pub mod rtu;
pub mod tcp;
pub mod terminal_link;

use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::net::{TcpListener, ToSocketAddrs};
use tokio::task::JoinSet;

pub use answer::{After, Delivery, Exchange, Framing, NoFaults, SharedMachine, Units, WireFaults, carry_out};
use terminal_link::TerminalLink;

/// Interval at which the machines' time advances.
const TICK: Duration = Duration::from_millis(10);

/// Advances the machines with real time. Runs until its future is dropped.
pub async fn advance_machines(machines: Vec<SharedMachine>) {
    let mut ticks = tokio::time::interval(TICK);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        machines.iter().for_each(SharedMachine::advance_time);
    }
}

/// Machines that are served until this is stopped or dropped.
pub struct Serving<F = NoFaults> {
    local_addr: Option<SocketAddr>,
    path: Option<PathBuf>,
    machines: Units,
    faults: F,
    tasks: JoinSet<()>,
    link: Option<TerminalLink>,
}

impl Serving {
    /// Serves machines over Modbus TCP at the address `addr`, without simulated faults. `units` contains each machine
    /// with its unit id. With port 0, the operating system selects a free port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp<M: Into<SharedMachine>>(addr: impl ToSocketAddrs, units: Vec<(u8, M)>) -> io::Result<Self> {
        Self::tcp_with(addr, units, NoFaults).await
    }
}

impl<F: WireFaults> Serving<F> {
    /// Serves machines over Modbus TCP at the address `addr`, with simulated faults. `units` contains each machine with
    /// its unit id. With port 0, the operating system selects a free port.
    ///
    /// # Errors
    /// Returns an error if the address cannot be bound.
    pub async fn tcp_with<M: Into<SharedMachine>>(
        addr: impl ToSocketAddrs,
        units: Vec<(u8, M)>,
        faults: F,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(addr).await?;
        let mut serving = Self::new(units, faults);
        serving.local_addr = Some(listener.local_addr()?);
        let (machines, faults) = (serving.machines.clone(), serving.faults.clone());
        serving.tasks.spawn(tcp::serve_tcp(listener, machines, faults));
        Ok(serving)
    }

    /// Serves machines over Modbus RTU on a new pseudo-terminal. `units` contains each machine with its unit id, `line`
    /// is the speed of the simulated serial line, and `faults` are the simulated faults. [`Self::path`] returns the path of
    /// the pseudo-terminal; a client opens this path like a serial port.
    ///
    /// # Errors
    /// Returns an error if no pseudo-terminal is available.
    pub fn rtu<M: Into<SharedMachine>>(units: Vec<(u8, M)>, line: rtu::Line, faults: F) -> io::Result<Self> {
        let (port, path) = pty::open()?;
        let mut serving = Self::new(units, faults);
        serving.path = Some(path);
        let (machines, faults) = (serving.machines.clone(), serving.faults.clone());
        serving.tasks.spawn(async move {
            // A pseudo-terminal fails only when it is closed for good.
            let _ = rtu::serve_rtu(port, machines, line, faults).await;
        });
        Ok(serving)
    }

    /// Creates a symbolic link at the path `at` to the served pseudo-terminal. The configuration of a client can then
    /// contain a fixed path. Replaces an existing link at `at`. The link is removed when this value is dropped.
    ///
    /// # Errors
    /// Returns the reason as text if `at` is an existing file that is not a link, or if the link cannot be created.
    pub fn link(&mut self, at: impl AsRef<Path>) -> Result<(), String> {
        let at = at.as_ref();
        let terminal = self.path.replace(at.to_path_buf()).unwrap_or_default();
        self.link = Some(TerminalLink::place(&terminal, at)?);
        Ok(())
    }

    fn new<M: Into<SharedMachine>>(units: Vec<(u8, M)>, faults: F) -> Self {
        let machines: Units = units.into_iter().map(|(unit, machine)| (unit, machine.into())).collect();
        let living = machines.iter().map(|(_, machine)| machine.clone()).collect();
        let mut tasks = JoinSet::new();
        tasks.spawn(advance_machines(living));
        Self { local_addr: None, path: None, machines, faults, tasks, link: None }
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

    /// Returns the faults of the wire.
    pub fn faults(&self) -> &F {
        &self.faults
    }

    /// Closes every connection and waits until all tasks have ended. The machines keep their state and can be served
    /// again.
    pub async fn stop(mut self) {
        self.tasks.shutdown().await;
    }
}
