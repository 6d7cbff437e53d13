//! Modbus TCP: a header of seven bytes before each frame. The clients share only the machines.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

use super::answer::{After, Exchange, Framing, Units, WireFaults};

/// Time between two attempts to accept a client.
const ACCEPT_AGAIN: Duration = Duration::from_millis(20);

/// Waits for the next client that connects to `listener`, and returns its stream.
pub(super) async fn next_client(listener: &TcpListener) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((stream, _)) if stream.set_nodelay(true).is_ok() => return stream,
            Ok(_) => {}
            // The process has no descriptors left, or a client was gone at once: neither concerns the other clients.
            Err(_) => tokio::time::sleep(ACCEPT_AGAIN).await,
        }
    }
}

/// Answers Modbus TCP requests of any number of clients that connect to `listener`. `units` are the simulated machines
/// with their unit ids. `faults` are the simulated faults. Runs until its future is dropped. All connections are then
/// closed.
pub async fn serve_tcp(listener: TcpListener, units: Units, faults: impl WireFaults) {
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            stream = next_client(&listener) => {
                let (units, faults) = (units.clone(), faults.clone());
                clients.spawn(async move { serve_client(stream, &units, &faults).await });
            }
            Some(_) = clients.join_next() => {}
        }
    }
}

/// Answers the Modbus TCP requests of one client on `stream`. `units` are the simulated machines with their unit ids.
/// `faults` are the simulated faults.
///
/// Returns `Ok` in three cases: after a header that is not Modbus TCP, after a simulated fault has closed the
/// connection, or when the client disconnects after a simulated fault has stopped all answers.
///
/// # Errors
/// The stream cannot be read or written any more, for example because the client has disconnected.
pub async fn serve_client<S>(mut stream: S, units: &Units, faults: &impl WireFaults) -> io::Result<()>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    loop {
        let mut header = [0; 7];
        stream.read_exact(&mut header).await?;
        let [t0, t1, p0, p1, l0, l1, unit] = header;
        let length = u16::from_be_bytes([l0, l1]);
        if [p0, p1] != [0, 0] || !(2..=254).contains(&length) {
            return Ok(());
        }
        let mut pdu = vec![0; usize::from(length) - 1];
        stream.read_exact(&mut pdu).await?;
        let framing = Framing::Tcp { transaction: u16::from_be_bytes([t0, t1]) };
        let delivery = faults.answer(&Exchange { units, framing, unit, pdu: &pdu });
        delivery.send(&mut stream).await?;
        match delivery.after {
            After::Open => {}
            After::Closed => return stream.shutdown().await,
            After::Silent => return swallow(stream).await,
        }
    }
}

async fn swallow(mut stream: impl AsyncRead + Unpin) -> io::Result<()> {
    let mut bytes = [0; 256];
    while stream.read(&mut bytes).await? > 0 {}
    Ok(())
}
