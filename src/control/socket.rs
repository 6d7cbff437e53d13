//! The control socket of a running cell: a person at another terminal holds, resumes, stops or aborts it, or asks how it is.
//!
//! One line of JSON in, one line out; for who watches, one line after another. The operating system says who is at the other end;
//! that is what is recorded, and for whom a program speaks beside it.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use regrind_cell::Actor;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::sync::{Semaphore, mpsc, oneshot, watch};

use super::door::{self, Caller, CellSays, Door, TellCaller, TellCell};
use super::request::{Line, OnBehalf, Reply, Request};
use super::snapshot::Snapshot;

/// Longest line that is read.
const LONGEST_LINE: u64 = 4096;
/// A client that says nothing for so long is gone.
const PATIENCE: Duration = Duration::from_secs(10);

/// An order that has no answer by then gets one that says so, while who gave it still listens.
const ANSWERS_WITHIN: Duration = Duration::from_secs(8);
/// Most clients that watch at a time: each has a descriptor for as long as it likes, and orders need theirs.
const WATCHERS: usize = 16;
/// Between two tries to let a client in.
const BETWEEN_TRIES: Duration = Duration::from_millis(50);
/// Between two lines to who watches: no eye follows more of them, and a cell that says nothing for longer than this is not there.
const LEAST_BETWEEN_LINES: Duration = Duration::from_millis(100);
const MOST_BETWEEN_LINES: Duration = Duration::from_secs(1);
/// Longest time without a line after which who watches takes the cell for gone.
const SILENCE: Duration = Duration::from_millis(2500);

/// An order on its way to the loop.
pub struct Ordered {
    /// What is asked.
    pub request: Request,
    /// Who asks.
    pub actor: Actor,
    /// Where the answer goes; none for orders of this process itself.
    pub answer: Option<oneshot::Sender<Reply>>,
}

/// Between two looks whether the door in the run folder is still there.
const BETWEEN_LOOKS: Duration = Duration::from_secs(1);

/// What became of the door in the run folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DoorChange {
    /// It is gone or exchanged, and who gives orders may not find the cell; and why it could not be made again, where it could not.
    Lost(String),
    /// It was made again.
    MadeAgain,
}

/// What is needed to serve those who come in.
#[derive(Clone)]
struct Desk {
    orders: mpsc::Sender<Ordered>,
    status: watch::Receiver<Snapshot>,
    places: Arc<Semaphore>,
}

/// The doors of a cell, which go away with their owner.
pub struct Control {
    folder: PathBuf,
    beside: Option<PathBuf>,
    desk: Desk,
    changes: mpsc::UnboundedReceiver<DoorChange>,
    tasks: Vec<tokio::task::JoinHandle<()>>,
}

impl Control {
    /// Listens in a run folder. Where it is `watched`, a door that somebody takes away is told and made again.
    ///
    /// # Errors
    /// A folder in which no socket can be made, such as one with a name too long for the operating system; a pipe that another program has.
    pub fn listen(
        folder: &Path,
        orders: mpsc::Sender<Ordered>,
        status: watch::Receiver<Snapshot>,
        watched: bool,
    ) -> io::Result<Self> {
        let door = Door::open(folder)?;
        let desk = Desk { orders, status, places: Arc::new(Semaphore::new(WATCHERS)) };
        let (tell, changes) = mpsc::unbounded_channel();
        let (hand_over, made_again) = mpsc::channel(1);
        let mut tasks = Vec::new();
        match door.mark().filter(|_| watched) {
            Some(mark) => tasks.push(tokio::spawn(keep_in_place(mark, tell, hand_over))),
            None => drop(hand_over),
        }
        tasks.push(tokio::spawn(attend(door, made_again, desk.clone())));
        Ok(Self { folder: folder.to_owned(), beside: None, desk, changes, tasks })
    }

    /// Listens at another place too, for the user of this program and root alone.
    ///
    /// # Errors
    /// A place where no socket can be made.
    pub fn listen_beside(&mut self, place: &Path) -> io::Result<()> {
        let Some(door) = Door::open_for_user(place)? else { return Ok(()) };
        self.beside = Some(place.to_owned());
        let (_, none) = mpsc::channel(1);
        self.tasks.push(tokio::spawn(attend(door, none, self.desk.clone())));
        Ok(())
    }

    /// Waits until the door in the run folder is gone, or made again.
    pub async fn changed(&mut self) -> DoorChange {
        match self.changes.recv().await {
            Some(change) => change,
            // Nobody watches it.
            None => std::future::pending().await,
        }
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        self.tasks.iter().for_each(tokio::task::JoinHandle::abort);
        door::take_away(&self.folder);
        if let Some(place) = &self.beside {
            door::take_away_at(place);
        }
    }
}

/// Lets in who comes to a door, and to the one that is made in its place.
async fn attend(mut door: Door, mut made_again: mpsc::Receiver<Door>, desk: Desk) {
    loop {
        let caller = tokio::select! {
            caller = door.let_in() => caller,
            Some(new) = made_again.recv() => {
                door = new;
                continue;
            }
        };
        let Ok(caller) = caller else {
            // No descriptor is left, or the client has gone: that passes, and orders must get through when it has.
            tokio::time::sleep(BETWEEN_TRIES).await;
            continue;
        };
        let desk = desk.clone();
        // A client that misbehaves hurts itself only.
        tokio::spawn(async move { drop(serve(caller, desk).await) });
    }
}

/// Looks whether a door is still there, and makes it again where it is not. Disks are asked on a thread of their own: one that does not answer keeps
/// nobody from an order.
async fn keep_in_place(mut mark: door::Mark, tell: mpsc::UnboundedSender<DoorChange>, hand_over: mpsc::Sender<Door>) {
    let mut looks = tokio::time::interval(BETWEEN_LOOKS);
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
            // It was moved away, and back.
            if std::mem::take(&mut is_lost) {
                let _ = tell.send(DoorChange::MadeAgain);
            }
            continue;
        };
        if !std::mem::replace(&mut is_lost, true) {
            let why = made.as_ref().map_or_else(io::Error::to_string, |_| String::new());
            let _ = tell.send(DoorChange::Lost(why));
        }
        let Some((door, new)) = made.ok().and_then(|door| Some((door.mark()?, door))) else { continue };
        (mark, is_lost) = (door, false);
        let _ = tell.send(DoorChange::MadeAgain);
        if hand_over.send(new).await.is_err() {
            return;
        }
    }
}

/// Lets a client say what it wants, and gives it that.
async fn serve(caller: Caller, desk: Desk) -> io::Result<()> {
    let Desk { orders, mut status, places } = desk;
    let peer = caller.actor()?;
    let (read, mut write) = caller.into_halves();
    let mut text = String::new();
    let mut read = BufReader::new(read).take(LONGEST_LINE);
    tokio::time::timeout(PATIENCE, read.read_line(&mut text)).await??;
    if door::has_gone(read.get_ref().get_ref()) {
        // This process stood still, and who asked has given up: an order that nobody waits for any more is not carried out.
        return Ok(());
    }
    let reply = match serde_json::from_str(&text) {
        Ok(Line { request: Request::Watch, .. }) => match places.try_acquire() {
            Ok(_place) => return told_on(&mut write, &mut status).await,
            Err(_) => refusal(format!("{WATCHERS} others watch already; close one of them"), &status),
        },
        Ok(line) if line.misleads() => {
            refusal("not an order: it has characters that are not seen or turn what is read".into(), &status)
        }
        Ok(Line { request, by }) => answer(request, on_behalf(peer, by), &orders, &status).await,
        Err(error) => refusal(format!("not an order: {error}"), &status),
    };
    tell(&mut write, &reply).await
}

/// Hands an order over, and waits for what the cell says to it.
async fn answer(
    request: Request,
    actor: Actor,
    orders: &mpsc::Sender<Ordered>,
    status: &watch::Receiver<Snapshot>,
) -> Reply {
    if request == Request::Status {
        return Reply { taken: true, message: String::new(), status: status.borrow().clone() };
    }
    let over = || refusal("the run is over".into(), status);
    let (answer, answered) = oneshot::channel();
    let handed_over = async {
        orders.send(Ordered { request, actor, answer: Some(answer) }).await.ok()?;
        answered.await.ok()
    };
    match tokio::time::timeout(ANSWERS_WITHIN, handed_over).await {
        Ok(reply) => reply.unwrap_or_else(over),
        Err(_) => refusal("the cell has not answered; whether it took the order is not known".into(), status),
    }
}

fn refusal(message: String, status: &watch::Receiver<Snapshot>) -> Reply {
    Reply { taken: false, message, status: status.borrow().clone() }
}

/// Tells how the cell is after every change, and at least so often that silence means that nobody is there.
async fn told_on(write: &mut TellCaller, status: &mut watch::Receiver<Snapshot>) -> io::Result<()> {
    loop {
        let now = status.borrow_and_update().clone();
        tell(write, &Reply { taken: true, message: String::new(), status: now }).await?;
        tokio::time::sleep(LEAST_BETWEEN_LINES).await;
        // Silence is as good a reason to tell it again as a change.
        if let Ok(Err(_)) = tokio::time::timeout(MOST_BETWEEN_LINES, status.changed()).await {
            return Ok(());
        }
    }
}

async fn tell(write: &mut TellCaller, reply: &Reply) -> io::Result<()> {
    let mut text = serde_json::to_vec(reply)?;
    text.push(b'\n');
    tokio::time::timeout(PATIENCE, write.write_all(&text)).await?
}

/// Names the person for whom a program speaks; what that program says of them is told as its word.
fn on_behalf(peer: Actor, by: Option<OnBehalf>) -> Actor {
    let Some(by) = by else { return peer };
    let name = by.name.map_or(peer.name.clone(), |name| format!("{name}, by a program of {}", peer.name));
    Actor { name, station: format!("{} ({})", by.station, peer.station) }
}

/// Whether a run goes on in a folder: somebody listens to its orders.
pub fn is_live(folder: &Path) -> bool {
    door::is_open(folder)
}

/// Whether a cell listens behind a door that does not lie in a run folder.
pub fn is_live_at(place: &Path) -> bool {
    door::is_open_at(place)
}

/// Asks a running cell; blocks for its answer.
///
/// # Errors
/// No cell that runs in that folder, and one that does not answer.
pub fn ask(folder: &Path, request: &Request) -> io::Result<Reply> {
    ask_for(folder, request, None)
}

/// Asks a running cell on behalf of somebody else; blocks for its answer.
///
/// # Errors
/// Those of [`ask`].
pub fn ask_for(folder: &Path, request: &Request, by: Option<OnBehalf>) -> io::Result<Reply> {
    let text = door::ask(folder, &line(request, by)?, PATIENCE)?;
    Ok(serde_json::from_str(&text)?)
}

/// Asks the cell behind a door that does not lie in a run folder; blocks for its answer.
///
/// # Errors
/// No cell behind it, one of another user, and one that does not answer.
pub fn ask_at(place: &Path, request: &Request) -> io::Result<Reply> {
    let text = door::ask_at(place, &line(request, None)?, PATIENCE)?;
    Ok(serde_json::from_str(&text)?)
}

fn line(request: &Request, by: Option<OnBehalf>) -> io::Result<Vec<u8>> {
    let mut text = serde_json::to_vec(&Line { request: request.clone(), by })?;
    text.push(b'\n');
    Ok(text)
}

/// A running cell that is watched.
pub struct Watch {
    lines: Lines<BufReader<CellSays>>,
    /// Held open: a cell that is no longer listened to stops telling.
    _write: TellCell,
}

/// Begins to watch a running cell.
///
/// # Errors
/// No cell that runs in that folder.
pub async fn watch(folder: &Path) -> io::Result<Watch> {
    let (read, mut write) = door::knock(folder).await?;
    write.write_all(&line(&Request::Watch, None)?).await?;
    Ok(Watch { lines: BufReader::new(read).lines(), _write: write })
}

impl Watch {
    /// Waits for the next thing that the cell tells of itself; none where it has gone.
    ///
    /// # Errors
    /// A cell that says nothing for too long, what nobody understands, or that it is watched by too many.
    pub async fn next(&mut self) -> io::Result<Option<Snapshot>> {
        let Some(text) = tokio::time::timeout(SILENCE, self.lines.next_line()).await?? else { return Ok(None) };
        let Reply { taken, message, status } = serde_json::from_str(&text)?;
        if taken { Ok(Some(status)) } else { Err(io::Error::other(message)) }
    }
}
