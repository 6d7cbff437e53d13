//! One Modbus line: a TCP connection or a serial port, and everything that can go wrong on it.
//!
//! A line lives on a thread of its own with a little runtime of its own, because a serial port can block where it should not, and because
//! whatever else the program computes must not delay a beat. Requests come in by a channel, one is on the wire at a time, and several
//! machines on one line share it by cloning the [`Link`].
//!
//! A line is trusted until the first thing that is wrong. A time-out, a short answer, a foreign echo, bytes that nobody asked for: the
//! connection is dropped with everything that may still arrive on it, the line is left alone for as long as the slowest machine may
//! need, a serial line is listened to until it is silent, and only then is it opened anew, under a new *generation* number. Whoever had
//! proved a machine on the old generation has to prove it again: a request names the generation it trusts and is turned away as stale when
//! that is gone. An answer to an older question can so never be taken for the answer to a newer one.
//!
//! The library below checks lengths and echoes only in debug builds, by panicking. The plain responses are asked for here and checked here.

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

use super::port;
use super::settings::Line;

/// The first wait before a line is opened again; it doubles up to [`LONGEST_BACKOFF`].
const FIRST_BACKOFF: Duration = Duration::from_millis(100);
/// The longest wait before a line is opened again.
const LONGEST_BACKOFF: Duration = Duration::from_secs(5);
/// A line that is not silent for so long is not going to be.
const LONGEST_DRAIN: Duration = Duration::from_secs(2);

/// What a line has seen since it was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkFigures {
    /// Requests sent.
    pub requests: u64,
    /// Sound answers.
    pub answers: u64,
    /// Modbus exceptions among them.
    pub exceptions: u64,
    /// Requests that nothing came back for in time.
    pub timeouts: u64,
    /// Answers that did not hold: length, echo, unit, function, check sum, or nobody had asked.
    pub corrupt: u64,
    /// Connections that ended from the other side.
    pub disconnects: u64,
    /// Attempts to open the line that failed.
    pub refused: u64,
    /// Times the line was opened.
    pub opened: u64,
    /// Requests that were asked again.
    pub retries: u64,
    /// Time from request to answer, summed up over the answers, in nanoseconds.
    pub answer_ns: u64,
    /// The longest of them.
    pub slowest_ns: u64,
}

/// The figures of a line, which its thread writes and its handles read.
#[derive(Debug, Clone, Default)]
struct Counters(Arc<Mutex<LinkFigures>>);

impl Counters {
    fn count(&self, change: impl FnOnce(&mut LinkFigures)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// What can be wrong with one request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LinkFault {
    /// The line could not be opened.
    Unreachable(io::ErrorKind),
    /// No answer in time.
    TimedOut,
    /// The other side closed.
    Disconnected,
    /// An answer that does not hold.
    Corrupt { what: &'static str, expected: u64, found: u64 },
    /// A sound answer that says no.
    Exception(u8),
    /// The generation that the request trusts is gone; nothing was sent.
    Stale,
}

/// What is asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Ask {
    Read {
        address: u16,
        count: u16,
    },
    Write {
        address: u16,
        words: Arc<[u16]>,
    },
    /// What came over the line does not hold, by a check that the line cannot make: give it up.
    Distrust,
}

type Answer = Result<(u64, Vec<u16>), LinkFault>;

struct Question {
    unit: u8,
    generation: Option<u64>,
    ask: Ask,
    reply: oneshot::Sender<Answer>,
}

/// A stream between a line and its machines. Whoever asks can tell whether bytes wait on it to be read.
pub trait LineStream: AsyncRead + AsyncWrite + Debug + Send + Unpin {
    /// Returns how many bytes wait, as far as can be told.
    ///
    /// # Errors
    /// The far side has closed.
    fn waiting(&mut self, cx: &mut Context<'_>) -> io::Result<usize>;
}

/// How a line is opened where no socket and no port of this computer leads to its machines.
pub trait Dial: Debug + Send + Sync {
    /// Opens it.
    fn dial<'a>(&'a mut self, line: &'a Line) -> Dialled<'a>;
}

/// A line that is being opened.
pub type Dialled<'a> = Pin<Box<dyn Future<Output = io::Result<Box<dyn LineStream>>> + Send + 'a>>;

/// A handle to one line. Clones share it; the line ends with its last handle.
#[derive(Debug, Clone)]
pub struct Link {
    line: Line,
    request_timeout: Duration,
    questions: mpsc::Sender<Question>,
    /// Cuts a pause of the line short.
    hurried: Arc<Notify>,
    counters: Counters,
}

impl Link {
    /// A line that is opened when it is first asked. `quarantine` is how long a machine on it may need for an answer at worst: after an
    /// error the line is left alone for so long.
    pub fn new(line: Line, request_timeout: Duration, quarantine: Duration) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let name = format!("line {line}");
        let (link, connection, inbox) =
            Self::ends(line, request_timeout, quarantine, Box::new(OfThisComputer), rand::random());
        std::thread::Builder::new().name(name).spawn(move || runtime.block_on(connection.run(inbox)))?;
        Ok(link)
    }

    /// A line that somebody else opens, as a task of the runtime that this is called in; its dice are those of the seed. For machines that
    /// stand in the same process, and for time that does not pass by itself.
    pub fn over(line: Line, request_timeout: Duration, quarantine: Duration, dial: Box<dyn Dial>, seed: u64) -> Self {
        let (link, connection, inbox) = Self::ends(line, request_timeout, quarantine, dial, seed);
        tokio::spawn(connection.run(inbox));
        link
    }

    fn ends(
        line: Line,
        request_timeout: Duration,
        quarantine: Duration,
        dial: Box<dyn Dial>,
        seed: u64,
    ) -> (Self, Connection, mpsc::Receiver<Question>) {
        let (questions, inbox) = mpsc::channel(16);
        let link = Self { line, request_timeout, questions, hurried: Arc::default(), counters: Counters::default() };
        let connection = Connection::new(&link, quarantine, dial, StdRng::seed_from_u64(seed));
        (link, connection, inbox)
    }

    /// Where it leads.
    pub fn line(&self) -> &Line {
        &self.line
    }

    /// What it has seen so far.
    pub fn figures(&self) -> LinkFigures {
        *self.counters.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets the next question open the line at once, without the pause after an error.
    pub(super) fn hurry(&self) {
        self.hurried.notify_one();
    }

    pub(super) fn request_timeout(&self) -> Duration {
        self.request_timeout
    }

    pub(super) fn count_retry(&self) {
        self.counters.count(|figures| figures.retries += 1);
    }

    /// Asks one thing of one unit. With a generation, only on that connection; without, the line is opened if need be. Gives the
    /// generation on which the answer came.
    pub(super) async fn ask(&self, unit: u8, generation: Option<u64>, ask: Ask) -> Answer {
        let (reply, answer) = oneshot::channel();
        let question = Question { unit, generation, ask, reply };
        // The line keeps its own time-outs; this one is for a port that blocks inside the operating system.
        let limit = self.request_timeout * 4 + LONGEST_BACKOFF * 2 + LONGEST_DRAIN;
        let both = async {
            self.questions.send(question).await.map_err(|_| LinkFault::Disconnected)?;
            answer.await.unwrap_or(Err(LinkFault::Disconnected))
        };
        timeout(limit, both).await.unwrap_or(Err(LinkFault::TimedOut))
    }
}

/// The far side of the channel: the connection and its history.
struct Connection {
    line: Line,
    request_timeout: Duration,
    quarantine: Duration,
    dial: Box<dyn Dial>,
    chance: StdRng,
    hurried: Arc<Notify>,
    counters: Counters,
    connection: Option<tokio_modbus::client::Context>,
    generation: u64,
    failures: u32,
    not_before: Instant,
    silent_from: Instant,
}

impl Connection {
    fn new(link: &Link, quarantine: Duration, dial: Box<dyn Dial>, chance: StdRng) -> Self {
        let now = Instant::now();
        Self {
            line: link.line.clone(),
            request_timeout: link.request_timeout,
            quarantine,
            dial,
            chance,
            hurried: link.hurried.clone(),
            counters: link.counters.clone(),
            connection: None,
            generation: 0,
            failures: 0,
            not_before: now,
            silent_from: now,
        }
    }

    async fn run(mut self, mut inbox: mpsc::Receiver<Question>) {
        while let Some(question) = inbox.recv().await {
            if question.reply.is_closed() {
                continue; // whoever asked has gone; what was never sent need not be
            }
            let answer = self.serve(&question).await;
            let _ = question.reply.send(answer);
        }
    }

    async fn serve(&mut self, question: &Question) -> Answer {
        let stale = question.generation.is_some_and(|trusted| self.connection.is_none() || trusted != self.generation);
        if stale {
            return Err(LinkFault::Stale);
        }
        if question.ask == Ask::Distrust {
            self.counters.count(|figures| figures.corrupt += 1);
            self.give_up();
            return Ok((self.generation, Vec::new()));
        }
        if self.connection.is_none() {
            self.open().await?;
        }
        let answer = self.exchange(question.unit, &question.ask).await;
        match answer {
            Ok(words) => {
                if question.generation.is_some() {
                    self.failures = 0;
                }
                Ok((self.generation, words))
            }
            Err(fault) => {
                self.account(fault);
                Err(fault)
            }
        }
    }

    fn account(&mut self, fault: LinkFault) {
        self.counters.count(|figures| match fault {
            LinkFault::Exception(_) => figures.exceptions += 1,
            LinkFault::TimedOut => figures.timeouts += 1,
            LinkFault::Corrupt { .. } => figures.corrupt += 1,
            LinkFault::Unreachable(_) | LinkFault::Disconnected | LinkFault::Stale => figures.disconnects += 1,
        });
        if !matches!(fault, LinkFault::Exception(_)) {
            self.give_up();
        }
    }

    /// Drops the connection with all that may still come over it, and leaves the line alone for a while.
    fn give_up(&mut self) {
        self.connection = None;
        self.failures = self.failures.saturating_add(1);
        let full = FIRST_BACKOFF.saturating_mul(1 << (self.failures - 1).min(10)).min(LONGEST_BACKOFF);
        let jittered = full.mul_f64(0.5 + 0.5 * self.chance.random::<f64>());
        self.not_before = Instant::now() + jittered.max(self.quarantine);
    }

    async fn open(&mut self) -> Result<(), LinkFault> {
        tokio::select! {
            biased;
            () = sleep_until(self.not_before) => {}
            // What the line still carries is drained, and its sync proven, all the same.
            () = self.hurried.notified() => {}
        }
        let limit = self.request_timeout.max(Duration::from_secs(1)) + LONGEST_DRAIN;
        let opened = timeout(limit, connect(&self.line, self.dial.as_mut())).await;
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
                self.give_up();
                Err(LinkFault::Unreachable(error.kind()))
            }
        }
    }

    async fn exchange(&mut self, unit: u8, ask: &Ask) -> Result<Vec<u16>, LinkFault> {
        sleep_until(self.silent_from).await;
        let request = match ask {
            Ask::Read { address, count } => Request::ReadHoldingRegisters(*address, *count),
            Ask::Write { address, words } => {
                Request::WriteMultipleRegisters(*address, std::borrow::Cow::Borrowed(words))
            }
            Ask::Distrust => return Ok(Vec::new()),
        };
        let limit = self.request_timeout + self.line.transmission_at_most();
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
            figures.slowest_ns = figures.slowest_ns.max(taken_ns);
        });
        Ok(words)
    }
}

/// Whether a response is the whole answer to what was asked, and nothing else.
fn check(ask: &Ask, response: tokio_modbus::Result<Response>) -> Result<Vec<u16>, LinkFault> {
    let response = response.map_err(fault_of)?;
    let response = response.map_err(|exception| LinkFault::Exception(exception.into()))?;
    let corrupt = |what, expected: usize, found: usize| LinkFault::Corrupt {
        what,
        expected: expected as u64,
        found: found as u64,
    };
    match (ask, response) {
        (Ask::Read { count, .. }, Response::ReadHoldingRegisters(words)) if words.len() == usize::from(*count) => {
            Ok(words)
        }
        (Ask::Read { count, .. }, Response::ReadHoldingRegisters(words)) => {
            Err(corrupt("number of registers", usize::from(*count), words.len()))
        }
        (Ask::Write { address, words }, Response::WriteMultipleRegisters(at, count)) => {
            if at != *address {
                Err(corrupt("echo of an address", usize::from(*address), usize::from(at)))
            } else if usize::from(count) != words.len() {
                Err(corrupt("echo of a number of registers", words.len(), usize::from(count)))
            } else {
                Ok(Vec::new())
            }
        }
        (ask, response) => {
            let expected = if matches!(ask, Ask::Read { .. }) { 3 } else { 16 };
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

impl Line {
    /// The silence of three and a half characters that parts two frames; nothing on TCP.
    fn silence(&self) -> Duration {
        match self {
            Self::Tcp { .. } => Duration::ZERO,
            Self::Rtu { baud, .. } if *baud > 19_200 => Duration::from_micros(1_750),
            Self::Rtu { baud, .. } => Duration::from_secs_f64(3.5 * 11.0 / f64::from((*baud).max(1))),
        }
    }

    /// How long the longest request and the longest answer are on the line.
    fn transmission_at_most(&self) -> Duration {
        self.transmission(2 * 256)
    }

    /// How long so many bytes are on the line; no time on TCP.
    pub(super) fn transmission(&self, bytes: u32) -> Duration {
        match self {
            Self::Tcp { .. } => Duration::ZERO,
            Self::Rtu { baud, .. } => Duration::from_secs_f64(f64::from(bytes) * 11.0 / f64::from((*baud).max(1))),
        }
    }
}

/// Opens a line, and listens to a serial one until it is silent.
async fn connect(line: &Line, dial: &mut dyn Dial) -> io::Result<tokio_modbus::client::Context> {
    let mut stream = dial.dial(line).await?;
    match line {
        Line::Tcp { .. } => Ok(tokio_modbus::client::tcp::attach(Listening::new(stream))),
        Line::Rtu { .. } => {
            drain(stream.as_mut(), line.silence().max(Duration::from_millis(5))).await?;
            Ok(tokio_modbus::client::rtu::attach(Listening::new(stream)))
        }
    }
}

/// Sockets and serial ports of this computer.
#[derive(Debug)]
pub(crate) struct OfThisComputer;

impl Dial for OfThisComputer {
    fn dial<'a>(&'a mut self, line: &'a Line) -> Dialled<'a> {
        Box::pin(async move {
            match line {
                Line::Tcp { host, port } => {
                    let stream = TcpStream::connect((host.as_str(), *port)).await?;
                    stream.set_nodelay(true)?;
                    // A connection that is given up takes what it has not sent yet with it: no START arrives after it was given up.
                    stream.set_zero_linger()?;
                    Ok(Box::new(stream) as Box<dyn LineStream>)
                }
                Line::Rtu { device, baud, parity, stop_bits } => {
                    Ok(Box::new(port::open(device, *baud, *parity, *stop_bits)?) as Box<dyn LineStream>)
                }
            }
        })
    }
}

/// Reads a serial line empty until it has been silent for a while.
async fn drain(port: &mut dyn LineStream, silence: Duration) -> io::Result<()> {
    let until = Instant::now() + LONGEST_DRAIN;
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
    fn waiting(&mut self, cx: &mut Context<'_>) -> io::Result<usize> {
        let mut byte = [0; 1];
        match self.poll_peek(cx, &mut ReadBuf::new(&mut byte)) {
            Poll::Pending => Ok(0),
            Poll::Ready(Ok(0)) => Err(io::ErrorKind::ConnectionReset.into()),
            Poll::Ready(count) => count,
        }
    }
}

impl LineStream for SerialStream {
    fn waiting(&mut self, _: &mut Context<'_>) -> io::Result<usize> {
        Ok(self.bytes_to_read()? as usize)
    }
}

/// A stream on which nothing may wait when a request is begun: what waits then was sent to nobody's question, and the answer that follows
/// could not be told from it. Its flush does not wait for a serial port to have sent everything, for that would block the thread.
#[derive(Debug)]
struct Listening {
    inner: Box<dyn LineStream>,
    asking: bool,
}

impl Listening {
    fn new(inner: Box<dyn LineStream>) -> Self {
        Self { inner, asking: false }
    }
}

impl AsyncRead for Listening {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.asking = false;
        Pin::new(&mut self.inner).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Listening {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        if !self.asking {
            if self.inner.waiting(cx)? > 0 {
                return Poll::Ready(Err(io::ErrorKind::InvalidData.into()));
            }
            self.asking = true;
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
    use super::super::settings::Parity;
    use super::*;

    #[test]
    fn an_answer_is_whole_or_it_is_none() {
        let read = Ask::Read { address: 64, count: 2 };
        let write = Ask::Write { address: 40, words: Arc::from([1, 2, 3]) };
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
    fn frames_on_a_serial_line_are_three_and_a_half_characters_apart() {
        let line = |baud| Line::Rtu { device: "x".into(), baud, parity: Parity::Even, stop_bits: 1 };
        assert_eq!(line(115_200).silence(), Duration::from_micros(1750));
        assert!((line(9_600).silence().as_secs_f64() - 4.0104e-3).abs() < 1e-6);
        assert_eq!(Line::Tcp { host: "x".into(), port: 502 }.silence(), Duration::ZERO);
    }

    #[tokio::test]
    async fn a_line_waits_longer_after_every_failure_and_says_what_the_system_said() {
        let wire = Line::Rtu { device: "/dev/no-such-port".into(), baud: 9600, parity: Parity::Even, stop_bits: 1 };
        let link = Link::new(wire, Duration::from_millis(50), Duration::ZERO).unwrap();
        let began = Instant::now();
        for _ in 0..3 {
            let answer = link.ask(1, None, Ask::Read { address: 0, count: 1 }).await;
            assert!(matches!(answer, Err(LinkFault::Unreachable(_))), "{answer:?}");
        }
        // At least half of 0.1 s and of 0.2 s, whatever the dice say.
        assert!(began.elapsed() >= Duration::from_millis(150), "{:?}", began.elapsed());
        assert_eq!((link.figures().refused, link.figures().opened), (3, 0));
    }
}
