//! One Modbus line: a TCP connection or a serial port, with the handling of all its errors.
//!
//! A line runs on a thread of its own with a small runtime, for two reasons: a serial port can block where it should
//! not, and other computation of the program must not delay a heartbeat. Requests arrive through a channel, and one at
//! a time is on the wire. Several machines on one line share it by cloning the [`Link`].
//!
//! A line is trusted until the first error: a timeout, a short answer, a wrong echo, bytes without a request. Then the
//! connection is dropped with all data that may still arrive on it. The line is not used for as long as the slowest
//! machine may need for an answer. A serial line is read until it is silent. Only then is the line opened again, under
//! a new *generation* number. The identity of a machine that was verified on the old generation must be verified again:
//! a request names the generation that it trusts, and is rejected as stale if that generation is gone. So the answer to
//! an older request can never be mistaken for the answer to a newer one.
//!
//! The library checks lengths and echoes only in debug builds, by panicking. So this module requests the plain
//! responses and checks them itself.

use std::fmt::Debug;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use rand::rngs::StdRng;
use rand::{RngExt as _, SeedableRng as _};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;
use tokio::sync::{Notify, mpsc, oneshot};
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_modbus::client::Client as _;
use tokio_modbus::slave::{Slave, SlaveContext as _};
use tokio_modbus::{ProtocolError, Request, Response};
use tokio_serial::{SerialPort as _, SerialStream};

use super::serial_port;
use super::settings::LineAddress;

/// First pause before a line is opened again; it doubles up to [`MAX_BACKOFF`].
const MIN_BACKOFF: Duration = Duration::from_millis(100);
/// Longest pause before a line is opened again.
const MAX_BACKOFF: Duration = Duration::from_secs(5);
/// Maximum time to wait for silence on a line.
const MAX_DRAIN_TIME: Duration = Duration::from_secs(2);

/// Statistics of a line since it was created.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkStatistics {
    /// Number of requests sent.
    pub requests: u64,
    /// Number of valid answers.
    pub answers: u64,
    /// Number of Modbus exceptions.
    pub exceptions: u64,
    /// Number of requests without an answer in time.
    pub timeouts: u64,
    /// Number of invalid answers: length, echo, unit, function or checksum is wrong, or there was no request.
    pub corrupt: u64,
    /// Number of connections that the other side closed.
    pub disconnects: u64,
    /// Number of failed attempts to open the line.
    pub refused: u64,
    /// Number of times the line was opened.
    pub opened: u64,
    /// Number of retries.
    pub retries: u64,
    /// Sum of the times from request to answer, in ns.
    pub answer_ns: u64,
    /// Longest time from request to answer, in ns.
    pub max_answer_ns: u64,
}

/// Statistics of a line, which its thread writes and its handles read.
#[derive(Debug, Clone, Default)]
struct Counters(Arc<Mutex<LinkStatistics>>);

impl Counters {
    fn count(&self, change: impl FnOnce(&mut LinkStatistics)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// Error of one request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LinkFault {
    /// The line could not be opened.
    Unreachable(io::ErrorKind),
    /// No answer arrived in time.
    TimedOut,
    /// The other side closed the connection.
    Disconnected,
    /// The answer is invalid.
    Corrupt { what: &'static str, expected: u64, found: u64 },
    /// The machine answered with a Modbus exception.
    Exception(u8),
    /// The line was reopened since the generation that the request names; nothing was sent.
    Stale,
}

/// Request to a line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum LinkRequest {
    Read {
        address: u16,
        count: u16,
    },
    Write {
        address: u16,
        words: Arc<[u16]>,
    },
    /// Drops the connection, because the caller has found its data invalid.
    DropConnection,
}

type LinkResult = Result<(u64, Vec<u16>), LinkFault>;

struct QueuedRequest {
    unit: u8,
    generation: Option<u64>,
    request: LinkRequest,
    reply: oneshot::Sender<LinkResult>,
}

/// Stream between a line and its machines. It can report if bytes wait to be read.
pub trait LineStream: AsyncRead + AsyncWrite + Debug + Send + Unpin {
    /// Returns a number above 0 if received bytes wait to be read, and 0 if none wait. The number can be smaller than
    /// the real number of bytes: a TCP socket returns at most 1.
    ///
    /// # Errors
    /// The other end has closed the stream, or the system reports an error.
    fn waiting_bytes(&mut self, cx: &mut Context<'_>) -> io::Result<usize>;
}

/// Method to open a line. Implement it for a line that is neither a socket nor a serial port of this computer.
pub trait Connector: Debug + Send + Sync {
    /// Opens a connection to the address `line`.
    fn connect<'a>(&'a mut self, line: &'a LineAddress) -> ConnectFuture<'a>;
}

/// Future of a line that is being opened.
pub type ConnectFuture<'a> = Pin<Box<dyn Future<Output = io::Result<Box<dyn LineStream>>> + Send + 'a>>;

/// Handle to one line. Clones share it; the line ends with its last handle.
#[derive(Debug, Clone)]
pub struct Link {
    line: LineAddress,
    request_timeout: Duration,
    requests: mpsc::Sender<QueuedRequest>,
    /// Ends a pause of the line early.
    pause_skipped: Arc<Notify>,
    counters: Counters,
}

impl Link {
    /// Creates a Modbus line (TCP connection or serial port) with its own thread. The line is opened when the first
    /// request is sent. `request_timeout` is the longest wait for an answer. `quarantine` is the longest time that a
    /// machine on the line may need for an answer: after an error, the line is not used for this time, so that no late
    /// answer is mistaken for a new one.
    ///
    /// # Errors
    /// The runtime or the thread of the line cannot be created.
    pub fn new(line: LineAddress, request_timeout: Duration, quarantine: Duration) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let name = format!("line {line}");
        let (link, connection, inbox) =
            Self::build_parts(line, request_timeout, quarantine, Box::new(SystemConnector), rand::random());
        std::thread::Builder::new().name(name).spawn(move || runtime.block_on(connection.run(inbox)))?;
        Ok(link)
    }

    /// Creates a Modbus line that the connector `dial` opens. The line runs as a task of the current Tokio runtime, not
    /// on its own thread. Use it for simulated machines in the same process and for simulated time.
    ///
    /// `request_timeout` is the longest wait for an answer. After an error the line is not used for the time
    /// `quarantine`. `seed` starts the random numbers that vary the pauses.
    pub fn with_connector(
        line: LineAddress,
        request_timeout: Duration,
        quarantine: Duration,
        dial: Box<dyn Connector>,
        seed: u64,
    ) -> Self {
        let (link, connection, inbox) = Self::build_parts(line, request_timeout, quarantine, dial, seed);
        tokio::spawn(connection.run(inbox));
        link
    }

    fn build_parts(
        line: LineAddress,
        request_timeout: Duration,
        quarantine: Duration,
        dial: Box<dyn Connector>,
        seed: u64,
    ) -> (Self, Connection, mpsc::Receiver<QueuedRequest>) {
        let (questions, inbox) = mpsc::channel(16);
        let link = Self {
            line,
            request_timeout,
            requests: questions,
            pause_skipped: Arc::default(),
            counters: Counters::default(),
        };
        let connection = Connection::new(&link, quarantine, dial, StdRng::seed_from_u64(seed));
        (link, connection, inbox)
    }

    /// Returns the address of the line.
    pub fn line(&self) -> &LineAddress {
        &self.line
    }

    /// Returns the statistics of this line since its creation, for example the numbers of requests, timeouts and
    /// retries, and the answer times.
    pub fn statistics(&self) -> LinkStatistics {
        *self.counters.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the pause that follows an error, so that the line is opened again at once. During this pause the line stays
    /// closed. If no pause is active, the next pause is skipped.
    pub(super) fn skip_pause(&self) {
        self.pause_skipped.notify_one();
    }

    pub(super) fn request_timeout(&self) -> Duration {
        self.request_timeout
    }

    pub(super) fn count_retry(&self) {
        self.counters.count(|figures| figures.retries += 1);
    }

    /// Sends the request `ask` to the machine with the number `unit`. Returns the generation and the received
    /// registers. The generation is the number of the connection, counted since the line was created. A write returns
    /// no registers.
    ///
    /// If `generation` is given, the request is sent only on the connection with this number. Otherwise the line is
    /// opened if necessary.
    ///
    /// # Errors
    /// Returns `LinkFault::Stale` if the connection `generation` no longer exists; nothing was sent then. Other faults
    /// state that the line cannot be opened, or that no valid answer arrived in time.
    pub(super) async fn request(&self, unit: u8, generation: Option<u64>, ask: LinkRequest) -> LinkResult {
        let (reply, answer) = oneshot::channel();
        let question = QueuedRequest { unit, generation, request: ask, reply };
        // The line has its own timeouts; this one is for a port that blocks inside the operating system.
        let limit = self.request_timeout * 4 + MAX_BACKOFF * 2 + MAX_DRAIN_TIME;
        let both = async {
            self.requests.send(question).await.map_err(|_| LinkFault::Disconnected)?;
            answer.await.unwrap_or(Err(LinkFault::Disconnected))
        };
        timeout(limit, both).await.unwrap_or(Err(LinkFault::TimedOut))
    }
}

/// Receiving side of the channel: the connection and its history.
struct Connection {
    line: LineAddress,
    request_timeout: Duration,
    quarantine: Duration,
    connector: Box<dyn Connector>,
    rng: StdRng,
    pause_skipped: Arc<Notify>,
    counters: Counters,
    connection: Option<tokio_modbus::client::Context>,
    generation: u64,
    failures: u32,
    not_before: Instant,
    silent_from: Instant,
}

impl Connection {
    fn new(link: &Link, quarantine: Duration, dial: Box<dyn Connector>, chance: StdRng) -> Self {
        let now = Instant::now();
        Self {
            line: link.line.clone(),
            request_timeout: link.request_timeout,
            quarantine,
            connector: dial,
            rng: chance,
            pause_skipped: link.pause_skipped.clone(),
            counters: link.counters.clone(),
            connection: None,
            generation: 0,
            failures: 0,
            not_before: now,
            silent_from: now,
        }
    }

    async fn run(mut self, mut inbox: mpsc::Receiver<QueuedRequest>) {
        while let Some(question) = inbox.recv().await {
            if question.reply.is_closed() {
                continue; // the client has gone, so the request need not be sent
            }
            let answer = self.serve(&question).await;
            let _ = question.reply.send(answer);
        }
    }

    async fn serve(&mut self, question: &QueuedRequest) -> LinkResult {
        let stale = question.generation.is_some_and(|trusted| self.connection.is_none() || trusted != self.generation);
        if stale {
            return Err(LinkFault::Stale);
        }
        if question.request == LinkRequest::DropConnection {
            self.counters.count(|figures| figures.corrupt += 1);
            self.drop_connection();
            return Ok((self.generation, Vec::new()));
        }
        if self.connection.is_none() {
            self.open().await?;
        }
        let answer = self.exchange(question.unit, &question.request).await;
        match answer {
            Ok(words) => {
                if question.generation.is_some() {
                    self.failures = 0;
                }
                Ok((self.generation, words))
            }
            Err(fault) => {
                self.record_fault(fault);
                Err(fault)
            }
        }
    }

    fn record_fault(&mut self, fault: LinkFault) {
        self.counters.count(|figures| match fault {
            LinkFault::Exception(_) => figures.exceptions += 1,
            LinkFault::TimedOut => figures.timeouts += 1,
            LinkFault::Corrupt { .. } => figures.corrupt += 1,
            LinkFault::Unreachable(_) | LinkFault::Disconnected | LinkFault::Stale => figures.disconnects += 1,
        });
        if !matches!(fault, LinkFault::Exception(_)) {
            self.drop_connection();
        }
    }

    /// Closes the connection, so that late data on it are lost. Then sets the earliest time at which the line may be
    /// opened again. The pause until this time is random. Its maximum doubles with each failure, up to [`MAX_BACKOFF`].
    /// The pause is never shorter than the quarantine (the longest time that a machine on the line may need for an
    /// answer).
    fn drop_connection(&mut self) {
        self.connection = None;
        self.failures = self.failures.saturating_add(1);
        let full = MIN_BACKOFF.saturating_mul(1 << (self.failures - 1).min(10)).min(MAX_BACKOFF);
        let jittered = full.mul_f64(0.5 + 0.5 * self.rng.random::<f64>());
        self.not_before = Instant::now() + jittered.max(self.quarantine);
    }

    async fn open(&mut self) -> Result<(), LinkFault> {
        tokio::select! {
            biased;
            () = sleep_until(self.not_before) => {}
            // The line is drained, and its sync proved, all the same.
            () = self.pause_skipped.notified() => {}
        }
        let limit = self.request_timeout.max(Duration::from_secs(1)) + MAX_DRAIN_TIME;
        let opened = timeout(limit, connect(&self.line, self.connector.as_mut())).await;
        let opened = opened.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()));
        match opened {
            Ok(connection) => {
                self.counters.count(|figures| figures.opened += 1);
                self.generation += 1;
                self.connection = Some(connection);
                Ok(())
            }
            Err(error) => {
                self.counters.count(|figures| figures.refused += 1);
                self.drop_connection();
                Err(LinkFault::Unreachable(error.kind()))
            }
        }
    }

    async fn exchange(&mut self, unit: u8, ask: &LinkRequest) -> Result<Vec<u16>, LinkFault> {
        sleep_until(self.silent_from).await;
        let request = match ask {
            LinkRequest::Read { address, count } => Request::ReadHoldingRegisters(*address, *count),
            LinkRequest::Write { address, words } => {
                Request::WriteMultipleRegisters(*address, std::borrow::Cow::Borrowed(words))
            }
            LinkRequest::DropConnection => return Ok(Vec::new()),
        };
        let limit = self.request_timeout + self.line.max_transmission_time();
        let Some(connection) = &mut self.connection else { return Err(LinkFault::Stale) };
        connection.set_slave(Slave(unit));
        self.counters.count(|figures| figures.requests += 1);
        let asked = Instant::now();
        let response = timeout(limit, connection.call(request)).await;
        self.silent_from = Instant::now() + self.line.silence();
        let words = check(ask, response.map_err(|_| LinkFault::TimedOut)?)?;
        let taken_ns = u64::try_from(asked.elapsed().as_nanos()).unwrap_or(u64::MAX);
        self.counters.count(|figures| {
            figures.answers += 1;
            figures.answer_ns += taken_ns;
            figures.max_answer_ns = figures.max_answer_ns.max(taken_ns);
        });
        Ok(words)
    }
}

/// Returns the registers of a response if it is the complete answer to the request and nothing else.
///
/// # Errors
/// The response is an exception, or it is not the answer to this request.
fn check(ask: &LinkRequest, response: tokio_modbus::Result<Response>) -> Result<Vec<u16>, LinkFault> {
    let response = response.map_err(fault_of)?;
    let response = response.map_err(|exception| LinkFault::Exception(exception.into()))?;
    let corrupt = |what, expected: usize, found: usize| LinkFault::Corrupt {
        what,
        expected: expected as u64,
        found: found as u64,
    };
    match (ask, response) {
        (LinkRequest::Read { count, .. }, Response::ReadHoldingRegisters(words))
            if words.len() == usize::from(*count) =>
        {
            Ok(words)
        }
        (LinkRequest::Read { count, .. }, Response::ReadHoldingRegisters(words)) => {
            Err(corrupt("number of registers", usize::from(*count), words.len()))
        }
        (LinkRequest::Write { address, words }, Response::WriteMultipleRegisters(at, count)) => {
            if at != *address {
                Err(corrupt("echo of an address", usize::from(*address), usize::from(at)))
            } else if usize::from(count) != words.len() {
                Err(corrupt("echo of a number of registers", words.len(), usize::from(count)))
            } else {
                Ok(Vec::new())
            }
        }
        (ask, response) => {
            let expected = if matches!(ask, LinkRequest::Read { .. }) { 3 } else { 16 };
            Err(corrupt("function", expected, usize::from(response.function_code().value())))
        }
    }
}

fn fault_of(error: tokio_modbus::Error) -> LinkFault {
    match error {
        tokio_modbus::Error::Protocol(ProtocolError::HeaderMismatch { .. }) => {
            LinkFault::Corrupt { what: "header (transaction or unit)", expected: 0, found: 1 }
        }
        tokio_modbus::Error::Protocol(ProtocolError::FunctionCodeMismatch { request, result }) => {
            let found = match result {
                Ok(response) => response.function_code().value(),
                Err(exception) => exception.function.value(),
            };
            LinkFault::Corrupt { what: "function", expected: u64::from(request.value()), found: u64::from(found) }
        }
        tokio_modbus::Error::Transport(error) => match error.kind() {
            io::ErrorKind::InvalidData | io::ErrorKind::InvalidInput => {
                LinkFault::Corrupt { what: "frame", expected: 0, found: 1 }
            }
            _ => LinkFault::Disconnected,
        },
    }
}

impl LineAddress {
    /// Returns the silence of 3.5 characters that separates two frames; zero on TCP.
    fn silence(&self) -> Duration {
        match self {
            Self::Tcp { .. } => Duration::ZERO,
            Self::Rtu { baud, .. } if *baud > 19_200 => Duration::from_micros(1_750),
            Self::Rtu { baud, .. } => Duration::from_secs_f64(3.5 * 11.0 / f64::from((*baud).max(1))),
        }
    }

    /// Returns the transmission time of the longest request with the longest answer.
    fn max_transmission_time(&self) -> Duration {
        self.transmission(2 * 256)
    }

    /// Returns the transmission time of `bytes` bytes; zero on TCP.
    pub(super) fn transmission(&self, bytes: u32) -> Duration {
        match self {
            Self::Tcp { .. } => Duration::ZERO,
            Self::Rtu { baud, .. } => Duration::from_secs_f64(f64::from(bytes) * 11.0 / f64::from((*baud).max(1))),
        }
    }
}

/// Opens a connection to the address `line`. On a serial line, then discards received data until the line is silent.
async fn connect(line: &LineAddress, dial: &mut dyn Connector) -> io::Result<tokio_modbus::client::Context> {
    let mut stream = dial.connect(line).await?;
    match line {
        LineAddress::Tcp { .. } => Ok(tokio_modbus::client::tcp::attach(RequestStream::new(stream))),
        LineAddress::Rtu { .. } => {
            drain(stream.as_mut(), line.silence().max(Duration::from_millis(5))).await?;
            Ok(tokio_modbus::client::rtu::attach(RequestStream::new(stream)))
        }
    }
}

/// Sockets and serial ports of this computer.
#[derive(Debug)]
pub(crate) struct SystemConnector;

impl Connector for SystemConnector {
    fn connect<'a>(&'a mut self, line: &'a LineAddress) -> ConnectFuture<'a> {
        Box::pin(async move {
            match line {
                LineAddress::Tcp { host, port } => {
                    let stream = TcpStream::connect((host.as_str(), *port)).await?;
                    stream.set_nodelay(true)?;
                    // A connection that is given up discards its unsent data: no START arrives after that.
                    stream.set_zero_linger()?;
                    Ok(Box::new(stream) as Box<dyn LineStream>)
                }
                LineAddress::Rtu { device, baud, parity, stop_bits } => {
                    Ok(Box::new(serial_port::open(device, *baud, *parity, *stop_bits)?) as Box<dyn LineStream>)
                }
            }
        })
    }
}

/// Discards received data until nothing has arrived on the serial line `port` for the time `silence`.
///
/// # Errors
/// Returns an error if data still arrive after 2 s, or if the connection ends or fails.
async fn drain(port: &mut dyn LineStream, silence: Duration) -> io::Result<()> {
    let until = Instant::now() + MAX_DRAIN_TIME;
    let mut bytes = [0; 256];
    while Instant::now() < until {
        match timeout(silence, port.read(&mut bytes)).await {
            Err(_) => return Ok(()),
            Ok(Ok(0)) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(Ok(_)) => sleep(Duration::from_millis(1)).await,
            Ok(Err(error)) => return Err(error),
        }
    }
    Err(io::ErrorKind::TimedOut.into())
}

impl LineStream for TcpStream {
    fn waiting_bytes(&mut self, cx: &mut Context<'_>) -> io::Result<usize> {
        let mut byte = [0; 1];
        match self.poll_peek(cx, &mut ReadBuf::new(&mut byte)) {
            Poll::Pending => Ok(0),
            Poll::Ready(Ok(0)) => Err(io::ErrorKind::ConnectionReset.into()),
            Poll::Ready(count) => count,
        }
    }
}

impl LineStream for SerialStream {
    fn waiting_bytes(&mut self, _: &mut Context<'_>) -> io::Result<usize> {
        Ok(self.bytes_to_read()? as usize)
    }
}

/// Stream on which no byte may wait when a request begins. Bytes that wait belong to no request, and the following
/// answer could not be distinguished from them. The flush does not wait until a serial port has sent everything,
/// because that would block the thread.
#[derive(Debug)]
struct RequestStream {
    inner: Box<dyn LineStream>,
    in_request: bool,
}

impl RequestStream {
    fn new(inner: Box<dyn LineStream>) -> Self {
        Self { inner, in_request: false }
    }
}

impl AsyncRead for RequestStream {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.in_request = false;
        Pin::new(&mut self.inner).poll_read(cx, buffer)
    }
}

impl AsyncWrite for RequestStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if !self.in_request {
            if self.inner.waiting_bytes(cx)? > 0 {
                return Poll::Ready(Err(io::ErrorKind::InvalidData.into()));
            }
            self.in_request = true;
        }
        Pin::new(&mut self.inner).poll_write(cx, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.inner).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::super::parity::Parity;
    use super::*;

    #[test]
    fn reply_check_refuses_mismatch() {
        let read = LinkRequest::Read { address: 64, count: 2 };
        let write = LinkRequest::Write { address: 40, words: Arc::from([1, 2, 3]) };
        assert_eq!(check(&read, Ok(Ok(Response::ReadHoldingRegisters(vec![7, 8])))), Ok(vec![7, 8]));
        assert_eq!(check(&write, Ok(Ok(Response::WriteMultipleRegisters(40, 3)))), Ok(vec![]));
        for (ask, response) in [
            (&read, Response::ReadHoldingRegisters(vec![7])),
            (&read, Response::ReadHoldingRegisters(vec![7, 8, 9])),
            (&read, Response::ReadInputRegisters(vec![7, 8])),
            (&read, Response::WriteMultipleRegisters(64, 2)),
            (&write, Response::WriteMultipleRegisters(41, 3)),
            (&write, Response::WriteMultipleRegisters(40, 2)),
            (&write, Response::ReadHoldingRegisters(vec![1, 2, 3])),
        ] {
            let hint = format!("{ask:?} {response:?}");
            assert!(matches!(check(ask, Ok(Ok(response))), Err(LinkFault::Corrupt { .. })), "{hint}");
        }
    }

    #[test]
    fn rtu_silence_is_3_5_characters() {
        let line = |baud| LineAddress::Rtu { device: "x".into(), baud, parity: Parity::Even, stop_bits: 1 };
        assert_eq!(line(115_200).silence(), Duration::from_micros(1750));
        assert!((line(9_600).silence().as_secs_f64() - 4.0104e-3).abs() < 1e-6);
        assert_eq!(LineAddress::Tcp { host: "x".into(), port: 502 }.silence(), Duration::ZERO);
    }

    #[tokio::test]
    async fn link_backs_off_after_failures() {
        let wire =
            LineAddress::Rtu { device: "/dev/no-such-port".into(), baud: 9600, parity: Parity::Even, stop_bits: 1 };
        let link = Link::new(wire, Duration::from_millis(50), Duration::ZERO).unwrap();
        let began = Instant::now();
        for _ in 0..3 {
            let answer = link.request(1, None, LinkRequest::Read { address: 0, count: 1 }).await;
            assert!(matches!(answer, Err(LinkFault::Unreachable(_))), "{answer:?}");
        }
        // At least half of 0.1 s and of 0.2 s, whatever the random numbers are.
        assert!(began.elapsed() >= Duration::from_millis(150), "{:?}", began.elapsed());
        assert_eq!((link.statistics().refused, link.statistics().opened), (3, 0));
    }
}
