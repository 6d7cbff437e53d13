//! Connection to linuxcncrsh. A task owns it and writes every request at once, even while earlier answers are pending,
//! so a hold or an abort waits for nothing. A caller that stops waiting for an answer does not disturb the next one.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, sleep_until, timeout};

use super::protocol::{Lines, Place, Reply, Request, Waiting};
use crate::{Dial, Line, LineStream};

/// Reason why there is no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LinkFault {
    /// No connection could be made.
    Unreachable(io::ErrorKind),
    /// No answer in time. The connection was closed, so that a late answer is not assigned to another request.
    TimedOut,
    /// The other end closed the connection, or it broke.
    Disconnected,
    /// The data received are not this protocol.
    Nonsense,
    /// The request is not one plain line, and was not sent.
    Unsendable,
}

/// Connection. Dropping it closes it and discards requests not sent yet.
#[derive(Debug)]
pub(super) struct Link {
    questions: mpsc::UnboundedSender<Question>,
}

#[derive(Debug)]
struct Question {
    request: Request,
    line: String,
    within: Duration,
    reply: oneshot::Sender<Result<Reply, LinkFault>>,
}

/// Pending answer.
#[derive(Debug)]
pub(super) struct Asked(Result<oneshot::Receiver<Result<Reply, LinkFault>>, LinkFault>);

impl Asked {
    /// Waits for the answer.
    pub(super) async fn answer(self) -> Result<Reply, LinkFault> {
        // The sender was dropped: the task has ended.
        self.0?.await.unwrap_or(Err(LinkFault::Disconnected))
    }
}

impl Link {
    /// Connects; sends nothing yet.
    pub(super) async fn open(line: &Line, dial: &mut dyn Dial, within: Duration) -> Result<Self, LinkFault> {
        let stream = match timeout(within, dial.dial(line)).await {
            Ok(Ok(stream)) => stream,
            Ok(Err(error)) => return Err(LinkFault::Unreachable(error.kind())),
            Err(_) => return Err(LinkFault::Unreachable(io::ErrorKind::TimedOut)),
        };
        let (questions, asked) = mpsc::unbounded_channel();
        tokio::spawn(Conversation::new(stream).run(asked));
        Ok(Self { questions })
    }

    /// Sends a request after the earlier ones, answered or not.
    pub(super) fn ask(&self, request: Request, within: Duration) -> Asked {
        let Some(line) = request.line() else { return Asked(Err(LinkFault::Unsendable)) };
        let (reply, answer) = oneshot::channel();
        match self.questions.send(Question { request, line, within, reply }) {
            Ok(()) => Asked(Ok(answer)),
            Err(_) => Asked(Err(LinkFault::Disconnected)),
        }
    }

    /// Sends a request that has no answer.
    pub(super) fn say(&self, request: Request) {
        drop(self.ask(request, Duration::ZERO));
    }
}

/// Receiver of a pending answer, and its deadline.
type Waiter = (oneshot::Sender<Result<Reply, LinkFault>>, Instant);

struct Conversation {
    stream: Box<dyn LineStream>,
    lines: Lines,
    waiting: Waiting<Waiter>,
}

impl Conversation {
    fn new(stream: Box<dyn LineStream>) -> Self {
        Self { stream, lines: Lines::default(), waiting: Waiting::default() }
    }

    /// Serves the connection until no sender of requests is left or the connection fails. Then reports the fault to all
    /// pending requests.
    async fn run(mut self, mut asked: mpsc::UnboundedReceiver<Question>) {
        let fault = self.converse(&mut asked).await;
        asked.close();
        let left = std::iter::from_fn(|| asked.try_recv().ok()).map(|question| question.reply);
        for reply in self.waiting.drain().map(|(reply, _)| reply).chain(left) {
            let _ = reply.send(Err(fault));
        }
    }

    async fn converse(&mut self, asked: &mut mpsc::UnboundedReceiver<Question>) -> LinkFault {
        let mut bytes = [0; 4096];
        loop {
            let due = self.waiting.first().map(|(_, due)| *due);
            let result = tokio::select! {
                biased;
                question = asked.recv() => match question {
                    Some(question) => self.send(question).await,
                    None => Err(LinkFault::Disconnected),
                },
                read = self.stream.read(&mut bytes) => match read {
                    Ok(count) if count > 0 => self.take(&bytes[..count]),
                    _ => Err(LinkFault::Disconnected),
                },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => Err(LinkFault::TimedOut),
            };
            if let Err(fault) = result {
                return fault;
            }
        }
    }

    async fn send(&mut self, question: Question) -> Result<(), LinkFault> {
        let Question { request, line, within, reply } = question;
        let echo = request == Request::EchoOff;
        if reply.is_closed() && !echo {
            return Ok(()); // whoever asked has gone; what was never sent need not be
        }
        let due = Instant::now() + within;
        let written = async { self.stream.write_all(line.as_bytes()).await };
        let limit = within.max(Duration::from_secs(1));
        let written = timeout(limit, written).await.unwrap_or(Err(io::ErrorKind::TimedOut.into()));
        if !echo {
            self.waiting.push(request, (reply, due));
        }
        written.map_err(|_| LinkFault::Disconnected)
    }

    fn take(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        for line in self.lines.take(bytes).ok_or(LinkFault::Nonsense)? {
            match self.waiting.place(&line) {
                Place::Answer((reply, _), said) => drop(reply.send(Ok(said))),
                Place::Aside => {}
                Place::Nonsense => return Err(LinkFault::Nonsense),
            }
        }
        Ok(())
    }
}
