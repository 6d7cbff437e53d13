//! Session with a server: one command after another, each to its end, and an abort that waits for no command.
//!
//! The next command is sent when the last one is over. Tags link answers to commands: a line of a finished command, or
//! of one that was never sent, is not used as a value. The standard has no timeouts and no keep-alive, so this module
//! adds both.

use std::collections::VecDeque;
use std::fmt::Debug;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::sync::watch;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use super::command::{DmeCommand, MAX_LINE_LENGTH};
use super::response::{DmeResponse, ResponseContent, ServerError, value};
use super::syntax::{Item, Tag};
use crate::error::DeviceError;
use crate::{Connector, LineAddress};

/// Timeouts and intervals of a session.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Timeout of the connection, and of the acknowledgement of a command.
    pub answer: Duration,
    /// Timeout of the end of a command, in addition to the time that its motion takes.
    pub completion: Duration,
    /// Timeout of the end of an abort.
    pub abort: Duration,
    /// Delay between two retries to clear the errors after an abort that the server has acknowledged but not yet
    /// processed.
    pub after_abort: Duration,
    /// Duration of silence during a command after which the client checks whether the server is alive.
    pub alive: Duration,
}

/// Number of attempts to clear the server's errors after an abort.
const CLEARING_TRIES: u32 = 20;
/// Number of notes kept for a person: the last ones.
const MAX_NOTES: usize = 8;

/// Reason why a command failed.
#[derive(Debug)]
pub(super) enum Failure {
    /// The connection failed, or the data on it are invalid; the session must not be used any more.
    Link(DeviceError),
    /// The server refused the command or reported an error.
    Refused(ServerError),
    /// The command was aborted, and the server has cleared its errors.
    Aborted,
    /// The answer is not plausible.
    Implausible(DeviceError),
}

/// Byte stream to a server.
pub(super) trait Stream: AsyncRead + AsyncWrite + Debug + Send + Unpin {}
impl<S: AsyncRead + AsyncWrite + Debug + Send + Unpin> Stream for S {}

/// Session with a server.
#[derive(Debug)]
pub(super) struct Session {
    pub(super) machine: Arc<str>,
    stream: Box<dyn Stream>,
    unread: Vec<u8>,
    limits: Limits,
    last: u32,
    last_event: u16,
    /// Number of aborts ordered so far. `sent_aborts` is the number of those that were sent to the server.
    ordered_aborts: watch::Receiver<u64>,
    sent_aborts: u64,
    notes: VecDeque<String>,
}

/// Answer to a command.
#[derive(Debug, Default)]
pub(super) struct CommandReply {
    /// Data, one list for each line.
    pub(super) data: Vec<Vec<Item>>,
    /// Warnings of the server.
    pub(super) warnings: Vec<ServerError>,
}

impl CommandReply {
    /// Returns the number in the property `name` of this reply, for example 1.5 for `X` in `X(1.5)`. Identical lines of
    /// data count as one line. Returns `None` if the reply has no data or lines that differ. Also returns `None` if the
    /// line does not contain the property exactly once with exactly one number.
    pub(super) fn value(&self, name: &str) -> Option<f64> {
        value(self.line()?, name)
    }

    /// Returns the items of the only line of data in this reply. Identical lines count as one line. Returns `None` if
    /// the reply has no line of data, or if its lines differ.
    pub(super) fn line(&self) -> Option<&[Item]> {
        let (first, rest) = self.data.split_first()?;
        rest.iter().all(|other| other == first).then_some(first)
    }
}

/// Command that was sent and is not over yet, with its answer so far.
struct Pending<'a> {
    tag: Tag,
    command: &'a DmeCommand,
    acknowledged: bool,
    answer: CommandReply,
    error: Option<ServerError>,
}

impl Session {
    /// Opens a connection to the server at the address `line` with the connector `dial`. Sends nothing yet. `aborts`
    /// counts the aborts that the client has ordered since the program began; `aborted` is the number of these aborts
    /// that earlier sessions have already sent. Returns the session.
    ///
    /// # Errors
    /// Returns an error if the connection cannot be opened within the time limit `limits.answer`.
    pub(super) async fn connect(
        machine: Arc<str>,
        (line, dial): (&LineAddress, &mut dyn Connector),
        limits: Limits,
        (aborts, aborted): (watch::Receiver<u64>, u64),
    ) -> Result<Self, DeviceError> {
        let unreachable =
            |reason| DeviceError::Unreachable { machine: Arc::clone(&machine), kind: reason, limit: limits.answer };
        let dialled = timeout(limits.answer, dial.connect(line)).await;
        let stream = dialled.unwrap_or(Err(std::io::ErrorKind::TimedOut.into())).map_err(|e| unreachable(e.kind()))?;
        Ok(Self::from_stream(aborted, Arc::clone(&machine), Box::new(stream), limits, aborts))
    }

    /// Creates a session on the open connection `stream`. `aborts` counts the aborts that the client has ordered;
    /// `aborted` is the number of these aborts that earlier sessions have already sent. If `aborts` is larger than
    /// `aborted`, the session sends an abort before any other command.
    fn from_stream(
        aborted: u64,
        machine: Arc<str>,
        stream: Box<dyn Stream>,
        limits: Limits,
        aborts: watch::Receiver<u64>,
    ) -> Self {
        let (unread, notes) = (Vec::new(), VecDeque::new());
        Self {
            machine,
            stream,
            unread,
            limits,
            last: 0,
            last_event: 0,
            ordered_aborts: aborts,
            sent_aborts: aborted,
            notes,
        }
    }

    /// Starts a new session at the server, whatever state the server is in. Works in four steps:
    ///
    /// - Sends an abort if one was ordered and not sent yet.
    /// - Ends a session that an earlier connection may have left, and waits for the end of its motion. If `ours_within`
    ///   is given, the motion belongs to a job of this client, and is aborted after this time.
    /// - Starts the new session.
    /// - If the server refuses the start because of an open session or an uncleared error, clears the errors and
    ///   repeats the second and third step once.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the session again or for another reason, if an abort is ordered, or if
    /// the connection fails.
    pub(super) async fn open(&mut self, ours_within: Option<Duration>) -> Result<(), Failure> {
        const LEFT_OVER: [u16; 4] = [8, 507, 508, 514];
        if self.is_abort_ordered() {
            self.sent_aborts = *self.ordered_aborts.borrow();
            self.send_abort(true).await?;
        }
        for again in [true, false] {
            let ended = match ours_within.filter(|_| again) {
                Some(limit) => timeout(limit, self.ask("EndSession", Vec::new())).await.ok(),
                None => Some(self.ask("EndSession", Vec::new()).await),
            };
            match ended {
                Some(Ok(_) | Err(Failure::Refused(_))) => {}
                Some(Err(other)) => return Err(other),
                None => self.send_abort(true).await?,
            }
            match self.ask("StartSession", Vec::new()).await {
                Err(Failure::Refused(error)) if again && LEFT_OVER.contains(&error.number) => {
                    if let Err(failure @ (Failure::Link(_) | Failure::Implausible(_) | Failure::Aborted)) =
                        self.ask("ClearAllErrors", Vec::new()).await
                    {
                        return Err(failure);
                    }
                }
                other => return other.map(drop),
            }
        }
        Ok(())
    }

    /// Sends the command `name` with `arguments`, which must cause no motion. Waits until the server has completed the
    /// command, and returns the reply.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the command, if an abort is ordered, or if the connection fails.
    pub(super) async fn ask(&mut self, name: &str, arguments: Vec<Item>) -> Result<CommandReply, Failure> {
        self.request_motion(name, arguments, Duration::ZERO).await
    }

    /// Sends the command `name` with `arguments`, which causes a motion. `motion` is the maximum duration of this
    /// motion. Waits until the server has completed the command, and returns the reply.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the command, if an abort is ordered, or if the connection fails.
    pub(super) async fn request_motion(
        &mut self,
        name: &str,
        arguments: Vec<Item>,
        motion: Duration,
    ) -> Result<CommandReply, Failure> {
        if self.is_abort_ordered() {
            return Err(self.abort().await);
        }
        let command = DmeCommand::new(name, arguments);
        let tag = if command.is_event() { self.next_event() } else { self.next_command() };
        self.write(&command, tag).await.map_err(Failure::Link)?;
        let mut pending =
            Pending { tag, command: &command, acknowledged: false, answer: CommandReply::default(), error: None };
        self.await_end(&mut pending, motion).await
    }

    async fn await_end(&mut self, pending: &mut Pending<'_>, motion: Duration) -> Result<CommandReply, Failure> {
        let began = Instant::now();
        let mut alive_at = began + self.limits.alive;
        let mut asked_alive: Option<(Tag, Instant)> = None;
        let mut due = began + self.limits.answer;
        loop {
            let next = tokio::select! {
                biased;
                () = self.abort_ordered() => return Err(self.abort().await),
                line = read_line(&mut self.stream, &mut self.unread) => Some(line),
                () = sleep_until(due.min(alive_at)) => None,
            };
            let Some(line) = next else {
                if Instant::now() >= due || asked_alive.is_some_and(|(_, limit)| Instant::now() >= limit) {
                    return Err(Failure::Link(self.timed_out(pending.command, began.elapsed())));
                }
                // This answer is awaited in parallel with the answer to the command.
                let (tag, limit) = (self.next_event(), Instant::now() + self.limits.answer);
                self.write(&DmeCommand::new("GetErrStatusE", Vec::new()), tag).await.map_err(Failure::Link)?;
                (asked_alive, alive_at) = (Some((tag, limit)), limit);
                continue;
            };
            let response = self.parse_response(line)?;
            alive_at = Instant::now() + self.limits.alive;
            if response.tag == pending.tag {
                if let Some(answer) = self.process_own_line(pending, response.content)? {
                    return Ok(answer);
                }
                due = match (&pending.error, pending.acknowledged) {
                    // A command that failed does not move any more.
                    (Some(_), _) | (None, false) => Instant::now() + self.limits.answer,
                    (None, true) => began + self.limits.answer + motion + self.limits.completion,
                };
            } else if asked_alive.is_some_and(|(tag, _)| tag == response.tag) {
                asked_alive = asked_alive.filter(|_| response.content != ResponseContent::Complete);
            } else {
                self.process_other_line(response)?;
            }
        }
    }

    /// Processes a line from the server that has the tag of the command `pending`. `said` is the content of the line.
    /// Stores data and warnings in `pending`. Returns the complete reply if the line states that the command is
    /// complete; returns `None` for every other line.
    ///
    /// # Errors
    /// Returns a failure if the command is complete and the server has reported an error for it.
    fn process_own_line(
        &mut self,
        pending: &mut Pending<'_>,
        said: ResponseContent,
    ) -> Result<Option<CommandReply>, Failure> {
        match said {
            ResponseContent::Acknowledged => pending.acknowledged = true,
            ResponseContent::Data(data) => pending.answer.data.push(data),
            ResponseContent::Error(error) if is_harmless(&error) => {
                self.note(format!("{}: {error}", pending.command.name));
                pending.answer.warnings.push(error);
            }
            ResponseContent::Error(error) => {
                pending.error.get_or_insert(error);
            }
            ResponseContent::Complete => {
                return match pending.error.take() {
                    Some(error) => Err(Failure::Refused(error)),
                    None => Ok(Some(std::mem::take(&mut pending.answer))),
                };
            }
        }
        Ok(None)
    }

    /// Processes `response`, a line whose tag is not that of the pending command. If the line is an unsolicited message
    /// of the server, stores its data or its warning as a note for the operator. If the line is a late answer to an
    /// earlier command, ignores it.
    ///
    /// # Errors
    /// Returns a failure if the message is an error that stops the machine, or if the tag was never sent.
    fn process_other_line(&mut self, response: DmeResponse) -> Result<(), Failure> {
        match (response.tag, response.content) {
            (Tag::UNSOLICITED, ResponseContent::Error(error)) if !is_harmless(&error) => Err(Failure::Refused(error)),
            (Tag::UNSOLICITED, ResponseContent::Error(error)) => {
                self.note(format!("unsolicited: {error}"));
                Ok(())
            }
            (Tag::UNSOLICITED, ResponseContent::Data(data)) => {
                self.note(format!("action at the machine: {}", super::syntax::list(&data)));
                Ok(())
            }
            (Tag::UNSOLICITED, _) => Ok(()),
            (Tag::Command(number), _) if self.was_sent(number) => Ok(()),
            (Tag::Event(number), _) if number <= self.last_event => Ok(()),
            (tag, _) => Err(Failure::Link(
                self.unreadable(tag.to_string(), "the line is an answer to a request that was never sent"),
            )),
        }
    }

    fn was_sent(&self, number: u32) -> bool {
        // Tags restart after 99999; commands with earlier tags are long over.
        number != 0 && (number <= self.last || number > 99_999 - 1_000 && self.last < 1_000)
    }

    fn next_command(&mut self) -> Tag {
        self.last = self.last % 99_999 + 1;
        Tag::Command(self.last)
    }

    fn next_event(&mut self) -> Tag {
        self.last_event = self.last_event % 9_999 + 1;
        Tag::Event(self.last_event)
    }

    async fn write(&mut self, command: &DmeCommand, tag: Tag) -> Result<(), DeviceError> {
        let line = command.line(tag);
        let written = timeout(self.limits.answer, self.stream.write_all(line.as_bytes())).await;
        written.unwrap_or(Err(std::io::ErrorKind::TimedOut.into())).map_err(|_| self.disconnected("writing"))
    }

    fn parse_response(&mut self, line: std::io::Result<String>) -> Result<DmeResponse, Failure> {
        let line = line.map_err(|e| match e.kind() {
            std::io::ErrorKind::InvalidData => Failure::Link(
                self.unreadable(String::new(), "the line is too long: no line end within 65536 characters"),
            ),
            _ => Failure::Link(self.disconnected("reading")),
        })?;
        DmeResponse::read(&line).map_err(|flaw| Failure::Link(self.unreadable(line, flaw.reason)))
    }

    // ---- the end of everything ------------------------------------------------------------------------------------------------------

    pub(super) fn is_abort_ordered(&self) -> bool {
        *self.ordered_aborts.borrow() > self.sent_aborts
    }

    /// Waits until an abort is ordered. Waits forever if the sender of abort orders no longer exists.
    pub(super) fn abort_ordered(&self) -> impl Future<Output = ()> + Send + use<> {
        let (mut aborts, aborted) = (self.ordered_aborts.clone(), self.sent_aborts);
        async move {
            if aborts.wait_for(|ordered| *ordered > aborted).await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }

    /// Aborts the running command and all waiting commands at the server, then clears the errors of the server. Always
    /// returns a [`Failure`]: [`Failure::Aborted`] if both steps succeed, otherwise the failure of the abort.
    pub(super) async fn abort(&mut self) -> Failure {
        self.sent_aborts = *self.ordered_aborts.borrow();
        match self.run_abort().await {
            Ok(()) => Failure::Aborted,
            Err(failure) => failure,
        }
    }

    async fn run_abort(&mut self) -> Result<(), Failure> {
        self.send_abort(false).await?;
        self.clear_errors(CLEARING_TRIES).await
    }

    /// Sends the command AbortE and waits until the server has completed it. If `may_refuse` is true, ignores an error
    /// that the server reports for AbortE: a server without a session may have nothing to abort.
    ///
    /// # Errors
    /// Returns a failure if the connection fails, or if the server does not complete the command within the time limit
    /// `limits.abort`. If `may_refuse` is false, also returns a failure if the server reports an error for AbortE that
    /// is more than a warning.
    async fn send_abort(&mut self, may_refuse: bool) -> Result<(), Failure> {
        let (command, tag) = (DmeCommand::new("AbortE", Vec::new()), self.next_event());
        self.write(&command, tag).await.map_err(Failure::Link)?;
        let over = Instant::now() + self.limits.abort;
        // Nothing else is sent before the abort is over. Lines of the aborted commands are ignored.
        loop {
            let line = tokio::select! {
                biased;
                line = read_line(&mut self.stream, &mut self.unread) => line,
                () = sleep_until(over) => return Err(Failure::Link(self.timed_out(&command, self.limits.abort))),
            };
            let response = self.parse_response(line)?;
            match response.content {
                ResponseContent::Complete if response.tag == tag => return Ok(()),
                ResponseContent::Error(error) if response.tag == tag && !is_harmless(&error) && !may_refuse => {
                    let reason = "it does not execute AbortE";
                    self.note(format!("AbortE: {error}"));
                    return Err(Failure::Link(self.unreadable(error.to_string(), reason)));
                }
                _ => {}
            }
        }
    }

    /// Clears the errors of the server. If the server refuses, waits for `limits.after_abort` and tries again, up to
    /// `tries` attempts in total. Repeated attempts are useful after an abort, because a server can acknowledge the
    /// abort before it has processed it.
    ///
    /// # Errors
    /// Returns a failure if the server refuses the last attempt, if an abort is ordered, or if the connection fails.
    pub(super) async fn clear_errors(&mut self, tries: u32) -> Result<(), Failure> {
        for left in (0..tries).rev() {
            match Box::pin(self.ask("ClearAllErrors", Vec::new())).await {
                Ok(_) => return Ok(()),
                Err(Failure::Refused(_)) if left > 0 => sleep(self.limits.after_abort).await,
                Err(other) => return Err(other),
            }
        }
        Ok(())
    }

    // ---- words ------------------------------------------------------------------------------------------------------------------------

    pub(super) fn note(&mut self, note: String) {
        if !self.notes.contains(&note) {
            self.notes.push_back(note);
            if self.notes.len() > MAX_NOTES {
                self.notes.pop_front();
            }
        }
    }

    pub(super) fn notes(&self) -> Vec<String> {
        self.notes.iter().cloned().collect()
    }

    fn timed_out(&self, command: &DmeCommand, limit: Duration) -> DeviceError {
        let what = super::static_command_name(&command.name);
        DeviceError::TimedOut { machine: Arc::clone(&self.machine), operation: what, limit }
    }

    fn disconnected(&self, what: &'static str) -> DeviceError {
        DeviceError::Disconnected { machine: Arc::clone(&self.machine), operation: what }
    }

    fn unreadable(&self, line: String, reason: &'static str) -> DeviceError {
        let line = line.chars().take(120).collect();
        DeviceError::Unreadable { machine: Arc::clone(&self.machine), line, reason }
    }
}

/// Returns true if `error` does not stop the machine: its severity is 0 or 1, and its number is not one of the numbers
/// that stop a machine. The number is checked too, because servers may send another severity than the standard
/// prescribes.
fn is_harmless(error: &ServerError) -> bool {
    error.is_warning() && !matches!(error.number, 6 | 500 | 503 | 1000..=1009 | 1500..=1503 | 2500..=2506)
}

/// Reads from `stream` until one line is complete, and returns this line without its line end. Ignores empty lines.
/// Replaces each character outside printable ASCII by `?`. `unread` holds the received bytes of the next lines. If the
/// caller drops the future, the bytes of an incomplete line stay in `unread`.
///
/// # Errors
/// Returns an error if the connection ends or fails, or if the line is too long.
async fn read_line(stream: &mut Box<dyn Stream>, unread: &mut Vec<u8>) -> std::io::Result<String> {
    loop {
        if let Some(end) = unread.iter().position(|b| *b == b'\n') {
            let line: Vec<u8> = unread.drain(..=end).collect();
            let text = line.strip_suffix(b"\n").unwrap_or(&line);
            let text = text.strip_suffix(b"\r").unwrap_or(text);
            // Texts of errors can be in the server's own language, with other characters.
            let text: String = text.iter().map(|b| if (32..=126).contains(b) { char::from(*b) } else { '?' }).collect();
            if text.is_empty() {
                continue;
            }
            return Ok(text);
        }
        if unread.len() > MAX_LINE_LENGTH {
            return Err(std::io::ErrorKind::InvalidData.into());
        }
        if stream.read_buf(unread).await? == 0 {
            return Err(std::io::ErrorKind::UnexpectedEof.into());
        }
    }
}
