//! Server that is commanded by lines of text, as its wire sees it.

use std::time::Duration;

/// Line to send to a client, or the end of its connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// Time to send it, in the caller's time.
    pub at: Duration,
    /// Line, with its line end.
    pub text: String,
    /// True if the line is sent byte by byte.
    pub split: bool,
    /// True if the connection closes after the line.
    pub closes: bool,
}

/// Server that is commanded by lines of text. It has no clock of its own: `now` is the caller's time.
pub trait LineServer: Send + 'static {
    /// Bytes that end a received line.
    const LINE_ENDS: &'static [u8];
    /// Maximum length of a received line, without its line end.
    const MAX_LINE_LENGTH: usize;
    /// True if a client is served only after the client before has gone.
    const ONE_CLIENT_AT_A_TIME: bool;

    /// Returns true if a received line must be carried out without delay, for example an abort.
    fn is_urgent(line: &str) -> bool;

    /// Registers a new client with the number `client`.
    fn connected(&mut self, client: u64);

    /// Handles the loss of the connection of the client `client` at the time `now`.
    fn client_lost(&mut self, client: u64, now: Duration);

    /// Returns false if the connection of the client `client` must be closed.
    fn serves(&self, client: u64) -> bool;

    /// Returns the earliest time at which the server acts or has something to send to the client `client`, if the
    /// client sends nothing more. Returns `None` if there is nothing to do.
    fn due(&self, client: u64) -> Option<Duration>;

    /// Handles a line that the client `client` has sent, without its line end, at the time `now`.
    fn receive(&mut self, client: u64, line: &str, now: Duration);

    /// Advances the simulation to the time `now`. Returns the lines that the server must send to the client `client` up
    /// to this time, and removes these lines from the queue.
    fn tick(&mut self, client: u64, now: Duration) -> Vec<Outgoing>;

    /// Advances the simulation to the time `now`.
    fn advance_time(&mut self, now: Duration);
}

/// Removes the lines from `queue` that are due at the time `now`, and returns them.
pub(crate) fn take_due(queue: &mut std::collections::VecDeque<Outgoing>, now: Duration) -> Vec<Outgoing> {
    let due = queue.iter().take_while(|out| out.at <= now).count();
    queue.drain(..due).collect()
}
