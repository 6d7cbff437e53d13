//! Control socket of a running cell: a person at another terminal holds, resumes, stops or aborts the cell, or asks for
//! its state.
//!
//! The client sends one line of JSON and gets one line back; a client that watches gets one line after another. The
//! operating system identifies the user of the client. That identity is recorded, together with the person for whom the
//! program acts.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use regrind_cell::Actor;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};

use super::endpoint::{self, CellReader, CellWriter, Client, ClientWriter, Endpoint};
use super::request::{OnBehalf, Reply, Request, RequestLine};
use super::snapshot::Snapshot;

/// Maximum length of a line from a client, in bytes.
const MAX_LINE_BYTES: u64 = 4096;
/// Timeout of a read or write. A client that sends nothing for this time is considered disconnected.
const IO_TIMEOUT: Duration = Duration::from_secs(10);

/// Timeout of the cell's answer to an order. After this time the client gets a reply that there was no answer. It is
/// shorter than [`IO_TIMEOUT`], so that the client still waits.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(8);
/// Maximum number of clients that watch at the same time. Each keeps a file descriptor, and orders also need
/// descriptors.
const MAX_WATCHERS: usize = 16;
/// Pause after a failed attempt to accept a client.
const ACCEPT_RETRY_INTERVAL: Duration = Duration::from_millis(50);
/// Minimum and maximum time between two lines to a client that watches. A person cannot follow more lines. A cell that
/// is silent for longer than the maximum is gone.
const MIN_LINE_INTERVAL: Duration = Duration::from_millis(100);
const MAX_LINE_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum silence after which a client that watches considers the cell gone.
const SILENCE_TIMEOUT: Duration = Duration::from_millis(2500);

/// Order that the loop of the cell receives.
pub struct ReceivedOrder {
    /// The request.
    pub request: Request,
    /// Person or program that asks.
    pub actor: Actor,
    /// Channel for the answer; `None` for orders of this process itself.
    pub answer: Option<oneshot::Sender<Reply>>,
}

/// Time between two checks that the endpoint in the run folder still exists.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Change of the endpoint in the run folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum EndpointChange {
    /// The endpoint is missing or was replaced, so clients may not find the cell. Contains the reason if it could not
    /// be created again; otherwise empty.
    Lost(String),
    /// The endpoint was created again, or is back at its path.
    Restored,
}

/// Channels and limits for serving the clients.
#[derive(Clone)]
struct ControlService {
    orders: mpsc::Sender<ReceivedOrder>,
    status: watch::Receiver<Snapshot>,
    watcher_permits: Arc<Semaphore>,
}

/// Endpoints of a cell. They are closed and removed when this is dropped.
pub struct Control {
    folder: PathBuf,
    second_place: Option<PathBuf>,
    service: ControlService,
    changes: mpsc::UnboundedReceiver<EndpointChange>,
    tasks: Vec<tokio::task::JoinHandle<()>>,
}

impl Control {
    /// Opens the control endpoint (a Unix socket, or a pipe on Windows) of the run folder `folder` and serves its
    /// clients in the background. Sends the orders of clients to `orders`. Sends each new value of `status` to the
    /// clients that watch the cell.
    ///
    /// If `watched` is true, checks periodically that the socket file exists. A socket file that was removed or
    /// replaced is created again, and [`Self::changed`] reports this.
    ///
    /// # Errors
    /// Returns an error if the endpoint cannot be created. For example, the path of the folder is too long for a
    /// socket, or another program already has the pipe.
    pub fn listen(
        folder: &Path,
        orders: mpsc::Sender<ReceivedOrder>,
        status: watch::Receiver<Snapshot>,
        watched: bool,
    ) -> io::Result<Self> {
        let door = Endpoint::open(folder)?;
        let desk = ControlService { orders, status, watcher_permits: Arc::new(Semaphore::new(MAX_WATCHERS)) };
        let (tell, changes) = mpsc::unbounded_channel();
        let (hand_over, made_again) = mpsc::channel(1);
        let mut tasks = Vec::new();
        match door.mark().filter(|_| watched) {
            Some(mark) => tasks.push(tokio::spawn(restore_if_removed(mark, tell, hand_over))),
            None => drop(hand_over),
        }
        tasks.push(tokio::spawn(accept_clients(door, made_again, desk.clone())));
        Ok(Self { folder: folder.to_owned(), second_place: None, service: desk, changes, tasks })
    }

    /// Opens a second control endpoint at the path `place`, in addition to the endpoint in the run folder. Only the
    /// user of this program and root can connect to it. Does nothing on Windows.
    ///
    /// # Errors
    /// Returns an error if no socket can be created at that path.
    pub fn listen_also_at(&mut self, place: &Path) -> io::Result<()> {
        let Some(door) = Endpoint::open_for_user(place)? else { return Ok(()) };
        self.second_place = Some(place.to_owned());
        let (_, none) = mpsc::channel(1);
        self.tasks.push(tokio::spawn(accept_clients(door, none, self.service.clone())));
        Ok(())
    }

    /// Waits for a change of the endpoint in the run folder and returns it: the endpoint was lost, or it was created
    /// again. If the endpoint is not watched (see [`Self::listen`]), waits without end. This is always the case on
    /// Windows.
    pub async fn changed(&mut self) -> EndpointChange {
        match self.changes.recv().await {
            Some(change) => change,
            // The door is not watched.
            None => std::future::pending().await,
        }
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        self.tasks.iter().for_each(tokio::task::JoinHandle::abort);
        endpoint::remove_endpoint(&self.folder);
        if let Some(place) = &self.second_place {
            endpoint::remove_endpoint_at(place);
        }
    }
}

/// Accepts clients without end and serves each of them in a separate task with the channels in `desk`. `door` is the
/// endpoint on which clients connect. If a new endpoint arrives in `made_again`, this endpoint replaces `door`. After
/// an error, waits [`ACCEPT_RETRY_INTERVAL`] and continues.
async fn accept_clients(mut door: Endpoint, mut made_again: mpsc::Receiver<Endpoint>, desk: ControlService) {
    loop {
        let caller = tokio::select! {
            caller = door.accept() => caller,
            Some(new) = made_again.recv() => {
                door = new;
                continue;
            }
        };
        let Ok(caller) = caller else {
            // No descriptor is left, or the client has gone. Both conditions pass, and orders must get through
            // afterwards.
            tokio::time::sleep(ACCEPT_RETRY_INTERVAL).await;
            continue;
        };
        let desk = desk.clone();
        // A client that misbehaves affects only its own task.
        tokio::spawn(async move { drop(serve_client(caller, desk).await) });
    }
}

/// Checks every [`CHECK_INTERVAL`] that the socket file of the endpoint still exists. `mark` is the identity of this
/// file.
///
/// If the file was removed or replaced, creates a new endpoint and sends it to `hand_over`. Reports the loss and the
/// recovery to `tell`. If the endpoint cannot be created, the report of the loss contains the reason, and the next
/// check tries again.
///
/// The disk is accessed in a separate thread, so that a slow disk does not delay orders.
async fn restore_if_removed(
    mut mark: endpoint::EndpointIdentity,
    tell: mpsc::UnboundedSender<EndpointChange>,
    hand_over: mpsc::Sender<Endpoint>,
) {
    let mut looks = tokio::time::interval(CHECK_INTERVAL);
    let mut is_lost = false;
    loop {
        looks.tick().await;
        let looked = tokio::task::spawn_blocking(move || {
            let made = (!mark.is_in_place()).then(|| mark.open_again());
            (mark, made)
        });
        let Ok((same, made)) = looked.await else { return };
        mark = same;
        let Some(made) = made else {
            // The door was moved away and back.
            if std::mem::take(&mut is_lost) {
                let _ = tell.send(EndpointChange::Restored);
            }
            continue;
        };
        if !std::mem::replace(&mut is_lost, true) {
            let reason = made.as_ref().map_or_else(io::Error::to_string, |_| String::new());
            let _ = tell.send(EndpointChange::Lost(reason));
        }
        let Some((door, new)) = made.ok().and_then(|door| Some((door.mark()?, door))) else { continue };
        (mark, is_lost) = (door, false);
        let _ = tell.send(EndpointChange::Restored);
        if hand_over.send(new).await.is_err() {
            return;
        }
    }
}

/// Reads one request line from the client `caller`, executes it with the channels in `desk`, and sends the reply. A
/// client that asks to watch the cell then receives its status until the connection ends.
///
/// Replies with a refusal if the request is invalid or contains misleading characters. Also refuses another watching
/// client if [`MAX_WATCHERS`] clients already watch. Executes nothing if the client has already closed the connection.
/// Returns an error if reading or writing fails or takes longer than [`IO_TIMEOUT`].
async fn serve_client(caller: Client, desk: ControlService) -> io::Result<()> {
    let ControlService { orders, mut status, watcher_permits: places } = desk;
    let peer = caller.actor()?;
    let (read, mut write) = caller.into_halves();
    let mut text = String::new();
    let mut read = BufReader::new(read).take(MAX_LINE_BYTES);
    tokio::time::timeout(IO_TIMEOUT, read.read_line(&mut text)).await??;
    if endpoint::is_closed(read.get_ref().get_ref()) {
        // This process was suspended, and the client has given up. An order that nobody waits for is not executed.
        return Ok(());
    }
    let reply = match serde_json::from_str(&text) {
        Ok(RequestLine { request: Request::Watch, .. }) => match places.try_acquire() {
            Ok(_place) => return stream_status(&mut write, &mut status).await,
            Err(_) => refusal(
                format!("{MAX_WATCHERS} clients already watch this cell, which is the limit; close one of them"),
                &status,
            ),
        },
        Ok(line) if line.has_misleading_text() => refusal(
            "not an order: the text contains characters that are invisible or change the reading direction; remove \
             these characters"
                .into(),
            &status,
        ),
        Ok(RequestLine { request, on_behalf: by }) => {
            forward_request(request, on_behalf(peer, by), &orders, &status).await
        }
        Err(error) => refusal(format!("not an order: {error}"), &status),
    };
    send_reply(&mut write, &reply).await
}

/// Sends `request` to the cell through `orders`, waits for the answer and returns it. `actor` is the person to record
/// for the request. A request for the status is answered at once from `status`.
///
/// Returns a refusal if the run is over, or if the cell does not answer within [`ANSWER_TIMEOUT`]. In the second case
/// it is unknown whether the cell accepts the order.
async fn forward_request(
    request: Request,
    actor: Actor,
    orders: &mpsc::Sender<ReceivedOrder>,
    status: &watch::Receiver<Snapshot>,
) -> Reply {
    if request == Request::Status {
        return Reply::new(true, String::new(), status.borrow().clone());
    }
    let over = || refusal("the run is over".into(), status);
    let (answer, answered) = oneshot::channel();
    let handed_over = async {
        orders.send(ReceivedOrder { request, actor, answer: Some(answer) }).await.ok()?;
        answered.await.ok()
    };
    match tokio::time::timeout(ANSWER_TIMEOUT, handed_over).await {
        Ok(reply) => reply.unwrap_or_else(over),
        Err(_) => refusal(
            "the cell did not answer in time; it is unknown whether the cell accepted the order; check with `regrind \
             status`"
                .into(),
            status,
        ),
    }
}

fn refusal(message: String, status: &watch::Receiver<Snapshot>) -> Reply {
    Reply::new(false, message, status.borrow().clone())
}

/// Sends the present `status` of the cell to a client through `write`, and sends it again after each change, but at
/// most once per [`MIN_LINE_INTERVAL`]. Without a change, repeats the status after [`MAX_LINE_INTERVAL`]. So the client
/// can conclude from a longer silence that the cell is gone.
///
/// Returns when the run ends. Returns an error if the client cannot be reached.
async fn stream_status(write: &mut ClientWriter, status: &mut watch::Receiver<Snapshot>) -> io::Result<()> {
    loop {
        let now = status.borrow_and_update().clone();
        send_reply(write, &Reply::new(true, String::new(), now)).await?;
        tokio::time::sleep(MIN_LINE_INTERVAL).await;
        // A timeout sends the state again, as a change does.
        if let Ok(Err(_)) = tokio::time::timeout(MAX_LINE_INTERVAL, status.changed()).await {
            return Ok(());
        }
    }
}

async fn send_reply(write: &mut ClientWriter, reply: &Reply) -> io::Result<()> {
    let mut text = serde_json::to_vec(reply)?;
    text.push(b'\n');
    tokio::time::timeout(IO_TIMEOUT, write.write_all(&text)).await?
}

/// Returns the person to record for a request. `peer` is the user of the program that sent the request, as identified
/// by the operating system. `by` is the person whom this program names as the origin of the request.
///
/// The result contains both names, because the program can state any name in `by`. Without `by`, the result is `peer`.
fn on_behalf(peer: Actor, by: Option<OnBehalf>) -> Actor {
    let Some(by) = by else { return peer };
    let name = by.name.map_or(peer.name.clone(), |name| format!("{name}, by a program of {}", peer.name));
    Actor { name, station: format!("{} ({})", by.station, peer.station) }
}

/// Returns true if a run is active in a folder: a cell listens for its orders.
pub fn is_live(folder: &Path) -> bool {
    endpoint::is_listening(folder)
}

/// Returns true if a cell listens for orders on the second endpoint at the path `place`, outside the run folder.
/// Returns false if the endpoint belongs to another user (except root). Always returns false on Windows.
pub fn is_live_at(place: &Path) -> bool {
    endpoint::is_listening_at(place)
}

/// Sends `request` to the cell that runs in the run folder `folder`, blocks until the reply arrives, and returns the
/// reply.
///
/// # Errors
/// Returns an error if no cell runs in the folder, or if the cell does not answer in time.
pub fn send_request(folder: &Path, request: &Request) -> io::Result<Reply> {
    send_request_on_behalf(folder, request, None)
}

/// Sends `request` to the cell that runs in the run folder `folder`, blocks until the reply arrives, and returns the
/// reply. `by` is the person for whom this program sends the request; `None` means the user of this program.
///
/// # Errors
/// Returns the same errors as [`send_request`].
pub fn send_request_on_behalf(folder: &Path, request: &Request, by: Option<OnBehalf>) -> io::Result<Reply> {
    let text = endpoint::exchange_line(folder, &encode_line(request, by)?, IO_TIMEOUT)?;
    Ok(serde_json::from_str(&text)?)
}

/// Sends `request` to the cell that listens on the second endpoint at the path `place`, outside the run folder. Blocks
/// until the reply arrives, and returns the reply.
///
/// # Errors
/// Returns an error if no cell listens at that path, if the endpoint belongs to another user, or if the cell does not
/// answer in time.
pub fn send_request_at(place: &Path, request: &Request) -> io::Result<Reply> {
    let text = endpoint::exchange_line_at(place, &encode_line(request, None)?, IO_TIMEOUT)?;
    Ok(serde_json::from_str(&text)?)
}

fn encode_line(request: &Request, by: Option<OnBehalf>) -> io::Result<Vec<u8>> {
    let mut text = serde_json::to_vec(&RequestLine { request: request.clone(), on_behalf: by })?;
    text.push(b'\n');
    Ok(text)
}

/// Connection that watches a running cell.
pub struct StatusStream {
    lines: Lines<BufReader<CellReader>>,
    /// Kept open: the cell stops sending when the client closes its end.
    _write: CellWriter,
}

/// Connects to the cell that runs in the run folder `folder` and asks for its status. Returns a stream that yields the
/// present status and then each new status, see [`StatusStream::next`].
///
/// # Errors
/// Returns an error if no cell runs in the folder.
pub async fn watch(folder: &Path) -> io::Result<StatusStream> {
    let (read, mut write) = endpoint::open_connection(folder).await?;
    write.write_all(&encode_line(&Request::Watch, None)?).await?;
    Ok(StatusStream { lines: BufReader::new(read).lines(), _write: write })
}

impl StatusStream {
    /// Waits for the next status of the cell and returns it. The cell repeats an unchanged status about once per
    /// second. Returns `None` if the cell has closed the connection.
    ///
    /// # Errors
    /// Returns an error if the cell sends nothing for 2.5 s, if a line cannot be parsed, or if the cell refuses because
    /// too many clients already watch.
    pub async fn next(&mut self) -> io::Result<Option<Snapshot>> {
        let Some(text) = tokio::time::timeout(SILENCE_TIMEOUT, self.lines.next_line()).await?? else { return Ok(None) };
        let Reply { accepted, message, status, .. } = serde_json::from_str(&text)?;
        if accepted { Ok(Some(status)) } else { Err(io::Error::other(message)) }
    }
}
