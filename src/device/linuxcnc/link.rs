//! Connection to linuxcncrsh. A task owns it and writes every request at once, even while earlier answers are pending,
//! so a hold or an abort waits for nothing. A caller that stops waiting for an answer does not disturb the next one.

use std::io;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{Instant, sleep_until, timeout};

use super::protocol::{LineMatch, LineSplitter, PendingRequests, RshReply, RshRequest};
use crate::{Connector, LineAddress, LineStream};

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
    NotProtocol,
    /// The request is not one plain line, and was not sent.
    Unsendable,
}

/// Connection. Dropping it closes it and discards requests not sent yet.
#[derive(Debug)]
pub(super) struct Link {
    requests: mpsc::UnboundedSender<QueuedRequest>,
}

#[derive(Debug)]
struct QueuedRequest {
    request: RshRequest,
    line: String,
    timeout: Duration,
    reply: oneshot::Sender<Result<RshReply, LinkFault>>,
}

/// Pending answer.
#[derive(Debug)]
pub(super) struct PendingReply(Result<oneshot::Receiver<Result<RshReply, LinkFault>>, LinkFault>);

impl PendingReply {
    /// Waits for the answer to this request.
    ///
    /// # Errors
    /// The answer does not arrive in time, the request was invalid, or the connection fails.
    pub(super) async fn answer(self) -> Result<RshReply, LinkFault> {
        // The sender was dropped: the task has ended.
        self.0?.await.unwrap_or(Err(LinkFault::Disconnected))
    }
}

impl Link {
    /// Opens the connection with `dial`; sends nothing yet. `within` is the time limit.
    pub(super) async fn open(
        line: &LineAddress,
        dial: &mut dyn Connector,
        within: Duration,
    ) -> Result<Self, LinkFault> {
        let stream = match timeout(within, dial.connect(line)).await {
            Ok(Ok(stream)) => stream,
            Ok(Err(error)) => return Err(LinkFault::Unreachable(error.kind())),
            Err(_) => return Err(LinkFault::Unreachable(io::ErrorKind::TimedOut)),
        };
        let (questions, asked) = mpsc::unbounded_channel();
        tokio::spawn(ConnectionTask::new(stream).run(asked));
        Ok(Self { requests: questions })
    }

    /// Sends a request without waiting for the answers of earlier ones. `within` is the time limit for the answer.
    pub(super) fn ask(&self, request: RshRequest, within: Duration) -> PendingReply {
        let Some(line) = request.line() else { return PendingReply(Err(LinkFault::Unsendable)) };
        let (reply, answer) = oneshot::channel();
        match self.requests.send(QueuedRequest { request, line, timeout: within, reply }) {
            Ok(()) => PendingReply(Ok(answer)),
            Err(_) => PendingReply(Err(LinkFault::Disconnected)),
        }
    }

    /// Sends a request that has no answer.
    pub(super) fn send_unanswered(&self, request: RshRequest) {
        drop(self.ask(request, Duration::ZERO));
    }
}

/// Receiver of a pending answer, and its deadline.
type Waiter = (oneshot::Sender<Result<RshReply, LinkFault>>, Instant);

struct ConnectionTask {
    stream: Box<dyn LineStream>,
    lines: LineSplitter,
    pending: PendingRequests<Waiter>,
}

impl ConnectionTask {
    fn new(stream: Box<dyn LineStream>) -> Self {
        Self { stream, lines: LineSplitter::default(), pending: PendingRequests::default() }
    }

    /// Serves the connection until no sender of requests is left or the connection fails. Then reports the fault to all
    /// pending requests.
    async fn run(mut self, mut asked: mpsc::UnboundedReceiver<QueuedRequest>) {
        let fault = self.serve_until_fault(&mut asked).await;
        asked.close();
        let left = std::iter::from_fn(|| asked.try_recv().ok()).map(|question| question.reply);
        for reply in self.pending.drain().map(|(reply, _)| reply).chain(left) {
            let _ = reply.send(Err(fault));
        }
    }

    async fn serve_until_fault(&mut self, asked: &mut mpsc::UnboundedReceiver<QueuedRequest>) -> LinkFault {
        let mut bytes = [0; 4096];
        loop {
            let due = self.pending.first().map(|(_, due)| *due);
            let result = tokio::select! {
                biased;
                question = asked.recv() => match question {
                    Some(question) => self.send(question).await,
                    None => Err(LinkFault::Disconnected),
                },
                read = self.stream.read(&mut bytes) => match read {
                    Ok(count) if count > 0 => self.process_bytes(&bytes[..count]),
                    _ => Err(LinkFault::Disconnected),
                },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => Err(LinkFault::TimedOut),
            };
            if let Err(fault) = result {
                return fault;
            }
        }
    }

    async fn send(&mut self, question: QueuedRequest) -> Result<(), LinkFault> {
        let QueuedRequest { request, line, timeout: within, reply } = question;
        let echo = request == RshRequest::EchoOff;
        if reply.is_closed() && !echo {
            return Ok(()); // whoever asked has gone; what was never sent need not be
        }
        let due = Instant::now() + within;
        let written = async { self.stream.write_all(line.as_bytes()).await };
        let limit = within.max(Duration::from_secs(1));
        let written = timeout(limit, written).await.unwrap_or(Err(io::ErrorKind::TimedOut.into()));
        if !echo {
            self.pending.push(request, (reply, due));
        }
        written.map_err(|_| LinkFault::Disconnected)
    }

    fn process_bytes(&mut self, bytes: &[u8]) -> Result<(), LinkFault> {
        for line in self.lines.push(bytes).ok_or(LinkFault::NotProtocol)? {
            match self.pending.match_line(&line) {
                LineMatch::Answer((reply, _), said) => drop(reply.send(Ok(said))),
                LineMatch::Unmatched => {}
                LineMatch::NotProtocol => return Err(LinkFault::NotProtocol),
            }
        }
        Ok(())
    }
}
