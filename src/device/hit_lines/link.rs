//! The port, and the thread that listens to it.
//!
//! A serial port can block unexpectedly, so it has its own thread with its own small runtime. Data received before the
//! port was opened are discarded: nobody had requested them.

use std::io;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::time::{Instant, sleep_until, timeout};
use tokio_serial::{SerialPort as _, SerialPortBuilderExt as _};

use super::job::{MeasurementSession, locked};
use super::line_splitter::LineSplitter;
use crate::error::DeviceError;
use crate::modbus::Parity;

/// Maximum time of waiting for silence; a line that sends for longer is an error.
const MAX_DRAIN_TIME: Duration = Duration::from_secs(2);

/// Source of the lines.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the fields are told above them")]
pub enum HitSource {
    /// Serial port: its name, bits a second, 7 or 8 data bits, parity, 1 or 2 stop bits.
    Serial { device: String, baud: u32, data_bits: u8, parity: Parity, stop_bits: u8 },
    /// Terminal server.
    Tcp { host: String, port: u16 },
}

impl std::fmt::Display for HitSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial { device, baud, .. } => write!(f, "{device} ({baud} baud)"),
            Self::Tcp { host, port } => write!(f, "{host}:{port}"),
        }
    }
}

trait Source: AsyncRead + Send + Unpin {}
impl<S: AsyncRead + Send + Unpin> Source for S {}

/// Timeouts of the line.
#[derive(Clone, Copy, Debug)]
pub(super) struct LinkTimeouts {
    /// Timeout of the connection.
    pub(super) connect: Duration,
    /// Duration of silence after which reception begins. Data received before were sent before the connection was used,
    /// and are discarded.
    pub(super) silence: Duration,
    /// Timeout of the rest of a line.
    pub(super) rest: Duration,
}

/// Handle of a listening thread. The thread ends when the handle is dropped or the connection is lost.
#[derive(Debug)]
pub(super) struct Listener {
    _until: oneshot::Sender<()>,
}

impl Listener {
    /// Opens the connection `line` to the measuring machine and discards the data that were sent before. Then starts a
    /// thread that receives the lines and passes each line to the shared state `session`. The thread ends when the
    /// returned handle is dropped or the connection is lost. `machine` is the name of the machine in errors, and
    /// `waits` contains the timeouts.
    ///
    /// # Errors
    /// Returns an error if the connection cannot be opened, or if the machine does not stop sending.
    pub(super) async fn open(
        machine: &Arc<str>,
        line: HitSource,
        waits: LinkTimeouts,
        session: Arc<Mutex<MeasurementSession>>,
    ) -> Result<Self, DeviceError> {
        let unreachable =
            |reason| DeviceError::Unreachable { machine: Arc::clone(machine), kind: reason, limit: waits.connect };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(|error| unreachable(error.kind()))?;
        let (until, ended) = oneshot::channel();
        let (opened, is_open) = oneshot::channel();
        let name = Arc::clone(machine);
        let listen = move || runtime.block_on(listen(name, line, waits, session, opened, ended));
        let spawned = std::thread::Builder::new().name("hit lines".into()).spawn(listen);
        spawned.map_err(|error| unreachable(error.kind()))?;
        match is_open.await {
            Ok(Ok(())) => Ok(Self { _until: until }),
            Ok(Err(error)) => Err(unreachable(error.kind())),
            Err(_) => Err(unreachable(io::ErrorKind::Other)),
        }
    }
}

async fn listen(
    machine: Arc<str>,
    line: HitSource,
    waits: LinkTimeouts,
    session: Arc<Mutex<MeasurementSession>>,
    opened: oneshot::Sender<io::Result<()>>,
    mut ended: oneshot::Receiver<()>,
) {
    let open = async {
        let mut source = timeout(waits.connect, connect(&line)).await.unwrap_or(Err(io::ErrorKind::TimedOut.into()))?;
        drain(source.as_mut(), waits.silence).await?;
        Ok(source)
    };
    let mut source = match open.await {
        Ok(source) => source,
        Err(error) => return drop(opened.send(Err(error))),
    };
    locked(&session).link_error = None;
    if opened.send(Ok(())).is_err() {
        return; // Nobody waits for it any more.
    }
    let (mut lines, mut bytes, mut due) = (LineSplitter::default(), [0; 512], None);
    loop {
        let read = tokio::select! {
            biased;
            _ = &mut ended => return,
            read = source.read(&mut bytes) => Some(read),
            () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => None,
        };
        match read {
            None => {
                due = None;
                if let Some(text) = lines.give_up() {
                    locked(&session).cut_short(&text);
                }
            }
            Some(Ok(count)) if count > 0 => {
                lines.push(&bytes[..count]).into_iter().for_each(|gathered| locked(&session).process(gathered));
                due = lines.has_partial_line().then(|| Instant::now() + waits.rest);
            }
            Some(_) => {
                let lost = DeviceError::Disconnected { machine, operation: "listening" };
                return locked(&session).link_lost(lost, lines.give_up());
            }
        }
    }
}

async fn connect(line: &HitSource) -> io::Result<Box<dyn Source>> {
    match line {
        HitSource::Tcp { host, port } => Ok(Box::new(TcpStream::connect((host.as_str(), *port)).await?)),
        HitSource::Serial { device, baud, data_bits, parity, stop_bits } => {
            let port = tokio_serial::new(device, *baud)
                .data_bits(if *data_bits == 7 { tokio_serial::DataBits::Seven } else { tokio_serial::DataBits::Eight })
                .parity(match parity {
                    Parity::None => tokio_serial::Parity::None,
                    Parity::Even => tokio_serial::Parity::Even,
                    Parity::Odd => tokio_serial::Parity::Odd,
                })
                .stop_bits(if *stop_bits == 2 { tokio_serial::StopBits::Two } else { tokio_serial::StopBits::One })
                .open_native_async()?;
            port.clear(tokio_serial::ClearBuffer::Input)?;
            Ok(Box::new(port))
        }
    }
}

/// Discards incoming data until nothing has arrived for the time `silence`. Returns an error if data still arrive after
/// 2 s, or if the connection ends.
async fn drain(source: &mut dyn Source, silence: Duration) -> io::Result<()> {
    let until = Instant::now() + MAX_DRAIN_TIME;
    let mut bytes = [0; 512];
    while Instant::now() < until {
        match timeout(silence, source.read(&mut bytes)).await {
            Err(_) => return Ok(()),
            Ok(Ok(0)) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(Ok(_)) => {}
            Ok(Err(error)) => return Err(error),
        }
    }
    Err(io::ErrorKind::TimedOut.into())
}
