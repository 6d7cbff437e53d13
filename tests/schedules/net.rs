//! Network between the program and the machines: bytes are delayed, stay in transit after the program has closed the
//! connection or died, or never arrive.

use std::collections::VecDeque;
use std::fmt;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use regrind::device::{ConnectFuture, Connector, LineAddress, LineStream};
use regrind_sim::dme::Server;
use regrind_sim::rsh::Controller;
use regrind_sim::wire::Units;
use regrind_sim::wire::lines::SharedLineServer;
use regrind_sim::wire::rtu::{Line as Pace, serve_rtu};
use regrind_sim::wire::tcp::serve_client;
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _, DuplexStream, ReadBuf, duplex, split};
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::task::AbortHandle;

use crate::cue::Cues;
use crate::life::Life;
use crate::wire::{Listening, Watched, Wires};
use regrind_testcell::wire_faults::SharedFaultPlan;

/// Current behaviour of a network.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Weather {
    /// Share of slow transmissions.
    pub slow_share: f64,
    /// Longest delay of a slow transmission.
    pub slow: Duration,
    /// Connections are refused, and open ones are cut.
    pub down: bool,
    /// Transmissions are lost without an error.
    pub silent: bool,
}

impl Weather {
    pub const FAIR: Self = Self { slow_share: 0.0, slow: Duration::ZERO, down: false, silent: false };
}

/// Interval between two checks whether a network works again.
const AGAIN: Duration = Duration::from_millis(20);

/// Far end of a connection.
#[derive(Clone)]
pub enum Far {
    Registers(Units),
    Dme(SharedLineServer<Server>),
    Rsh(SharedLineServer<Controller>),
}

/// Network to one machine, or to both on one line.
#[derive(Clone)]
pub struct Net(Arc<Shared>);

struct Shared {
    far: Far,
    faults: SharedFaultPlan,
    /// A server of lines has one client at a time.
    turn: Arc<tokio::sync::Mutex<()>>,
    state: Mutex<State>,
    /// The machines' end of a serial line; none if each call has its own connection.
    bus: Option<UnboundedSender<Vec<u8>>>,
}

struct State {
    weather: Weather,
    changes: u64,
    chance: StdRng,
    /// Tasks that carry answers to a client.
    carrying: Vec<AbortHandle>,
    /// Listener on the serial line.
    listening: Option<UnboundedSender<Vec<u8>>>,
}

impl fmt::Debug for Net {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Net")
    }
}

impl Net {
    /// Returns a network of connections, or a serial line with this number of bits per second.
    pub fn new(far: Far, faults: SharedFaultPlan, baud: Option<u32>, seed: u64) -> Self {
        let turn = Arc::default();
        let chance = StdRng::seed_from_u64(seed);
        let state =
            Mutex::new(State { weather: Weather::FAIR, changes: 0, chance, carrying: Vec::new(), listening: None });
        let (Some(baud), Far::Registers(units)) = (baud, &far) else {
            return Self(Arc::new(Shared { far, faults, turn, state, bus: None }));
        };
        let units = units.clone();
        let (ours, theirs) = duplex(1 << 16);
        let (bus, sent) = unbounded_channel();
        let net = Self(Arc::new(Shared { far, faults: faults.clone(), turn, state, bus: Some(bus) }));
        tokio::spawn(async move { serve_rtu(theirs, units, Pace::paced(baud), faults).await });
        let (from_machines, to_machines) = split(ours);
        tokio::spawn(net.clone().carry_to(sent, to_machines));
        let back = net.clone();
        tokio::spawn(back.carry_on_the_line(from_machines));
        net
    }

    /// Changes the behaviour for the given duration, unless another change comes first.
    pub async fn weather(&self, weather: Weather, lasts: Duration) {
        let number = self.set(weather);
        tokio::time::sleep(lasts).await;
        if self.state().changes == number {
            self.set(Weather::FAIR);
        }
    }

    /// Changes the behaviour; returns the number of the change.
    pub fn set(&self, weather: Weather) -> u64 {
        let mut state = self.state();
        state.weather = weather;
        state.changes += 1;
        if weather.down {
            state.carrying.drain(..).for_each(|carrying| carrying.abort());
            state.listening = None;
        }
        state.changes
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.0.state.lock().unwrap()
    }

    /// Returns the delay of the next bytes; none if they are lost.
    fn way(&self) -> Option<Duration> {
        let mut state = self.state();
        let Weather { slow_share, slow, silent, .. } = state.weather;
        let usual = Duration::from_micros(state.chance.random_range(50..800));
        let is_slow = state.chance.random::<f64>() < slow_share;
        let way = if is_slow { slow.mul_f64(state.chance.random()) } else { usual };
        (!silent).then_some(way)
    }

    /// Carries what a client sends. Bytes in transit arrive even after the sender has gone.
    async fn carry_to(self, mut sent: UnboundedReceiver<Vec<u8>>, mut to: impl AsyncWrite + Unpin) {
        while let Some(bytes) = sent.recv().await {
            let Some(way) = self.way() else { continue };
            tokio::time::sleep(way).await;
            if to.write_all(&bytes).await.is_err() {
                return;
            }
        }
    }

    async fn carry_back(self, mut from: impl AsyncRead + Unpin, to: UnboundedSender<Vec<u8>>) {
        let mut bytes = [0; 512];
        while let Ok(count @ 1..) = from.read(&mut bytes).await {
            let Some(way) = self.way() else { continue };
            tokio::time::sleep(way).await;
            if to.send(bytes[..count].to_vec()).is_err() {
                return;
            }
        }
    }

    /// Carries lines to a machine. TCP retransmits lost data as long as the sender exists, and reports its end.
    async fn carry_lines_to(self, mut sent: UnboundedReceiver<Vec<u8>>, mut to: impl AsyncWrite + Unpin) {
        while let Some(bytes) = sent.recv().await {
            while self.is_silent() && !sent.is_closed() {
                tokio::time::sleep(AGAIN).await;
            }
            let Some(way) = self.way() else { break };
            tokio::time::sleep(way).await;
            if to.write_all(&bytes).await.is_err() {
                return;
            }
        }
        let _ = to.shutdown().await;
    }

    async fn carry_lines_back(self, mut from: impl AsyncRead + Unpin, to: UnboundedSender<Vec<u8>>) {
        let mut bytes = [0; 512];
        while let Ok(count @ 1..) = from.read(&mut bytes).await {
            while self.is_silent() && !to.is_closed() {
                tokio::time::sleep(AGAIN).await;
            }
            let Some(way) = self.way() else { return };
            tokio::time::sleep(way).await;
            if to.send(bytes[..count].to_vec()).is_err() {
                return;
            }
        }
    }

    fn is_silent(&self) -> bool {
        self.state().weather.silent
    }

    async fn carry_on_the_line(self, mut from: impl AsyncRead + Unpin) {
        let mut bytes = [0; 512];
        while let Ok(count @ 1..) = from.read(&mut bytes).await {
            let Some(way) = self.way() else { continue };
            tokio::time::sleep(way).await;
            if let Some(to) = &self.state().listening {
                let _ = to.send(bytes[..count].to_vec());
            }
        }
    }

    fn call(&self, life: Arc<Life>, wires: Option<&(Wires, Cues)>) -> Port {
        let (to_client, from) = unbounded_channel();
        let watched = wires.map(|wires| self.watched(wires));
        if let Some(bus) = &self.0.bus {
            self.state().listening = Some(to_client);
            return Port { to: bus.clone(), from, ahead: VecDeque::new(), life, watched };
        }
        let (ours, theirs): (DuplexStream, DuplexStream) = duplex(1 << 16);
        let (to, sent) = unbounded_channel();
        let shared = self.0.clone();
        tokio::spawn(async move {
            match &shared.far {
                Far::Registers(units) => drop(serve_client(theirs, units, &shared.faults).await),
                Far::Rsh(controller) => controller.serve_client(theirs).await,
                Far::Dme(server) => {
                    let _turn = shared.turn.lock().await;
                    server.serve_client(theirs).await;
                }
            }
        });
        let (from_machines, to_machines) = split(ours);
        let carrying = if let Far::Registers(_) = self.0.far {
            tokio::spawn(self.clone().carry_to(sent, to_machines));
            tokio::spawn(self.clone().carry_back(from_machines, to_client))
        } else {
            tokio::spawn(self.clone().carry_lines_to(sent, to_machines));
            tokio::spawn(self.clone().carry_lines_back(from_machines, to_client))
        };
        let carrying = carrying.abort_handle();
        let mut state = self.state();
        state.carrying.retain(|carrying| !carrying.is_finished());
        state.carrying.push(carrying);
        Port { to, from, ahead: VecDeque::new(), life, watched }
    }

    fn watched(&self, wires: &(Wires, Cues)) -> Watch {
        match self.0.far {
            Far::Registers(_) => Watch::Frames(Watched::new(wires, self.0.bus.is_some())),
            Far::Dme(_) => Watch::Lines(Listening::new(wires, 0)),
            Far::Rsh(_) => Watch::Lines(Listening::new(wires, 1)),
        }
    }

    /// Cuts off every listener: the program has died.
    pub fn hang_up(&self) {
        let mut state = self.state();
        state.carrying.drain(..).for_each(|carrying| carrying.abort());
        state.listening = None;
    }

    /// Returns the dialler by which a life of the program reaches the machines. Only these connections are watched.
    pub fn connect(&self, life: &Arc<Life>, wires: Option<&(Wires, Cues)>) -> Box<dyn Connector> {
        Box::new(Caller { net: self.clone(), life: life.clone(), wires: wires.cloned() })
    }
}

#[derive(Debug)]
struct Caller {
    net: Net,
    life: Arc<Life>,
    wires: Option<(Wires, Cues)>,
}

impl Connector for Caller {
    fn connect<'a>(&'a mut self, _: &'a LineAddress) -> ConnectFuture<'a> {
        Box::pin(async move {
            let way = self.net.way();
            tokio::time::sleep(way.unwrap_or(Duration::from_secs(60))).await;
            if way.is_none() || self.net.state().weather.down || !self.life.passes() {
                return Err(io::ErrorKind::ConnectionRefused.into());
            }
            Ok(Box::new(self.net.call(self.life.clone(), self.wires.as_ref())) as Box<dyn LineStream>)
        })
    }
}

/// Observer of a connection.
enum Watch {
    Frames(Watched),
    Lines(Listening),
}

impl Watch {
    fn asks(&mut self, bytes: &[u8], waiting: usize) {
        match self {
            Self::Frames(watched) => watched.asks(bytes, waiting),
            Self::Lines(listening) => listening.hears(bytes),
        }
    }

    fn reads(&mut self, bytes: &[u8]) {
        if let Self::Frames(watched) = self {
            watched.reads(bytes);
        }
    }
}

/// The program's end of a connection.
struct Port {
    to: UnboundedSender<Vec<u8>>,
    from: UnboundedReceiver<Vec<u8>>,
    ahead: VecDeque<u8>,
    life: Arc<Life>,
    watched: Option<Watch>,
}

impl fmt::Debug for Port {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Port")
    }
}

impl LineStream for Port {
    fn waiting_bytes(&mut self, cx: &mut Context<'_>) -> io::Result<usize> {
        loop {
            match self.from.poll_recv(cx) {
                Poll::Ready(Some(bytes)) => self.ahead.extend(bytes),
                Poll::Ready(None) => return Err(io::ErrorKind::ConnectionReset.into()),
                Poll::Pending => return Ok(self.ahead.len()),
            }
        }
    }
}

impl AsyncRead for Port {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if self.ahead.is_empty() {
            match self.from.poll_recv(cx) {
                Poll::Ready(Some(bytes)) if self.life.passes() => self.ahead.extend(bytes),
                Poll::Ready(_) => return Poll::Ready(Ok(())),
                Poll::Pending => return Poll::Pending,
            }
        }
        let count = buffer.remaining().min(self.ahead.len());
        let bytes: Vec<u8> = self.ahead.drain(..count).collect();
        self.watched.iter_mut().for_each(|watched| watched.reads(&bytes));
        buffer.put_slice(&bytes);
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Port {
    fn poll_write(mut self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if !self.life.passes() {
            return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
        }
        while let Ok(come) = self.from.try_recv() {
            self.ahead.extend(come);
        }
        let waiting = self.ahead.len();
        self.watched.iter_mut().for_each(|watched| watched.asks(bytes, waiting));
        let sent = self.to.send(bytes.to_vec());
        Poll::Ready(sent.map(|()| bytes.len()).map_err(|_| io::ErrorKind::BrokenPipe.into()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}
