//! A cell as an edge node of Sparkplug B.
//!
//! The node has no device: the program and the cell start and end together. There is therefore one birth with all
//! figures and one death, and it is always clear which death counts. Every connection is a session of its own, with its
//! own number, subscriptions and birth. The client does not restore sessions, and does not send messages of an earlier
//! session.

mod link;
mod message;

use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectionError, Event, EventLoop, Outgoing, Packet, Publish, QoS, SubscribeFilter,
    SubscribeReasonCode,
};
use srad_types::topic::{DeviceMessage, DeviceTopic, NodeMessage, NodeTopic};
use srad_types::utils::validate_name;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};

use self::link::BrokerOptions;
use self::message::Values;
use crate::cell_status::CellStatus;
use crate::error::LiveError;
use crate::figures::FIGURES;
use crate::publisher_event::EventSender;
use crate::publisher_lock::{BdSeqCounter, PublisherLock};
use crate::settings::SparkplugSettings;

/// Limits of the time between two attempts to connect to the broker.
const MIN_RETRY_DELAY: Duration = Duration::from_millis(500);
const MAX_RETRY_DELAY: Duration = Duration::from_secs(30);
/// Minimum time between two births, however many hosts request one.
const BETWEEN_BIRTHS: Duration = Duration::from_secs(1);
/// Time after which a message is sent again that did not fit into the queue of the client.
const OFFERED_AGAIN: Duration = Duration::from_secs(1);
/// Timeout for the death message and the disconnection at the end.
const FAREWELL: Duration = Duration::from_secs(2);
/// Maximum number of messages queued for the network.
const WAITING: usize = 16;

/// Edge node that publishes the state of a cell to a broker.
pub struct Node {
    broker: BrokerOptions,
    bd_seq: BdSeqCounter,
    topics: Topics,
    status: watch::Receiver<CellStatus>,
    notes: EventSender,
}

struct Topics {
    birth: String,
    data: String,
    death: String,
    command: String,
    device_commands: String,
}

impl Topics {
    fn new(group: &str, node: &str) -> Self {
        let topic = |message| NodeTopic::new(group, message, node).topic;
        Self {
            birth: topic(NodeMessage::NBirth),
            data: topic(NodeMessage::NData),
            death: topic(NodeMessage::NDeath),
            command: topic(NodeMessage::NCmd),
            device_commands: DeviceTopic::new(group, DeviceMessage::DCmd, node, "+").topic,
        }
    }
}

/// Reason for the end of a connection.
enum SessionEnd {
    /// The source of the state has closed.
    Ended,
    /// The broker is gone or was never reached; `stood` is true if the connection was established before.
    Lost { reason: String, stood: bool },
}

impl Node {
    /// Creates a Sparkplug node that publishes the state of the cell named `cell`. The node does not connect before
    /// [`Self::run`]. `turn` is the lock that only one publisher of the cell can have. The node publishes each status
    /// that it receives from `told`. It reports events, such as a lost connection, to `notes`.
    ///
    /// # Errors
    /// The name of the group or of the cell is not valid in a topic. A password or a certificate cannot be read. The
    /// broker is on another computer and no certificates are given. The file with the number of the connection (bdSeq)
    /// cannot be opened.
    pub fn new(
        settings: &SparkplugSettings,
        cell: &str,
        turn: &PublisherLock,
        told: watch::Receiver<CellStatus>,
        notes: EventSender,
    ) -> Result<Self, LiveError> {
        for (of, name) in [("the group", &*settings.group), ("the cell", cell)] {
            validate_name(name).map_err(|_| LiveError::Topic { of, name: name.to_owned() })?;
        }
        let way = BrokerOptions::new(settings, &format!("regrind-{}-{cell}", settings.group))?;
        Ok(Self {
            broker: way,
            bd_seq: BdSeqCounter::open(turn)?,
            topics: Topics::new(&settings.group, cell),
            status: told,
            notes,
        })
    }

    /// Publishes the status of the cell until the source of the status closes, and then returns `Ok`. If the connection
    /// to the broker is lost, connects again after a delay.
    ///
    /// # Errors
    /// The number of the connection (bdSeq) cannot be written to its file.
    pub async fn run(mut self) -> Result<(), LiveError> {
        let mut wait = MIN_RETRY_DELAY;
        let mut connection = self.bd_seq.next()?;
        loop {
            let began = Instant::now();
            let SessionEnd::Lost { reason, stood } = self.session(connection).await else { return Ok(()) };
            self.notes.retrying(&self.broker.place, reason);
            if stood {
                connection = self.bd_seq.next()?;
            }
            // After a connection that lasted, the next attempt comes soon. After one that ended at once, the wait keeps
            // growing.
            wait = if began.elapsed() > MAX_RETRY_DELAY { MIN_RETRY_DELAY } else { wait };
            let until = Instant::now() + wait;
            while Instant::now() < until {
                tokio::select! {
                    () = sleep_until(until) => {}
                    changed = self.status.changed() => if changed.is_err() { return Ok(()) },
                }
            }
            wait = (2 * wait).min(MAX_RETRY_DELAY);
        }
    }

    /// Connects to the broker and publishes the status of the cell. Ends when the connection is lost or when the source
    /// of the status closes. Returns which of these two happened. `connection` is the number of the connection (bdSeq).
    async fn session(&mut self, connection: u8) -> SessionEnd {
        let options = self.broker.with_last_will(&self.topics.death, message::death(connection));
        let (client, mut broker) = AsyncClient::new(options, WAITING);
        broker.network_options.set_tcp_nodelay(true);
        // Polls in a task of its own: cancelling a poll in the middle of a message would end the connection.
        let (to, mut events) = mpsc::channel(WAITING);
        let mut polling = JoinSet::new();
        polling.spawn(poll(broker, to));
        let mut session = Session {
            node: self,
            client,
            connection,
            values: None,
            sequence: 0,
            due: None,
            began: Instant::now(),
            stood: false,
        };
        loop {
            let due = session.due;
            let over = tokio::select! {
                event = events.recv() => session.handle_event(event),
                changed = session.node.status.changed() => match changed {
                    Ok(()) => session.publish_changes(),
                    Err(_) => return session.farewell(&mut events).await,
                },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => session.catch_up(),
            };
            if let Err(over) = over {
                return over;
            }
        }
    }
}

/// Receives the events of the MQTT client `broker` and sends them to `to`, until the connection ends.
async fn poll(mut broker: EventLoop, to: mpsc::Sender<Result<Event, ConnectionError>>) {
    loop {
        let event = broker.poll().await;
        let is_last = event.is_err();
        if to.send(event).await.is_err() || is_last {
            return;
        }
    }
}

/// Established connection.
struct Session<'a> {
    node: &'a mut Node,
    client: AsyncClient,
    connection: u8,
    /// Values published last; `None` before the birth.
    values: Option<Values>,
    sequence: u8,
    /// Time at which a deferred birth or message is due: one that was too early, or that did not fit into the queue.
    due: Option<Instant>,
    /// Time of the last birth.
    began: Instant,
    /// True if the broker has accepted the connection.
    stood: bool,
}

impl Session<'_> {
    /// Handles `event`, an event of the MQTT connection. `None` means that the connection is closed. After the broker
    /// has accepted the connection, subscribes to the commands of host applications. After the broker has answered the
    /// subscription, publishes the birth certificate (NBIRTH). Executes or refuses a received command. Ignores every
    /// other event.
    ///
    /// # Errors
    /// The connection is closed or has an error, or the subscription cannot be sent.
    fn handle_event(&mut self, event: Option<Result<Event, ConnectionError>>) -> Result<(), SessionEnd> {
        self.stood |= matches!(event, Some(Ok(Event::Incoming(Packet::ConnAck(_)))));
        let stood = self.stood;
        let lost = |reason: String| Err(SessionEnd::Lost { reason, stood });
        match event {
            None => lost("the connection was closed".into()),
            Some(Err(error)) => lost(in_words(&error)),
            Some(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                let topics = [&self.node.topics.command, &self.node.topics.device_commands];
                let filters = topics.map(|topic| SubscribeFilter::new(topic.clone(), QoS::AtLeastOnce));
                self.client.try_subscribe_many(filters).or_else(|error| lost(error.to_string()))
            }
            // Subscribes before the birth, so that no later command is missed.
            Some(Ok(Event::Incoming(Packet::SubAck(ack)))) => {
                let refused = ack.return_codes.contains(&SubscribeReasonCode::Failure);
                if refused {
                    let reason =
                        "no host can request a birth: the broker does not let the node subscribe to its commands"
                            .to_owned();
                    self.node.notes.retrying(&self.node.broker.place, reason);
                } else {
                    self.node.notes.connected(&self.node.broker.place);
                }
                self.birth();
                Ok(())
            }
            Some(Ok(Event::Incoming(Packet::Publish(publish)))) => {
                self.handle_command(&publish);
                Ok(())
            }
            Some(Ok(_)) => Ok(()),
        }
    }

    /// Publishes a birth certificate (NBIRTH) with the current values of all figures (the quantities that the cell
    /// publishes). If the queue of the MQTT client is full, postpones the certificate by one second.
    fn birth(&mut self) {
        let values = current(&mut self.node.status);
        let birth = message::birth(FIGURES, &values, self.connection);
        if self.client.try_publish(&self.node.topics.birth, QoS::AtMostOnce, false, birth).is_err() {
            self.due = Some(Instant::now() + OFFERED_AGAIN);
            self.values = None;
            return;
        }
        (self.values, self.sequence, self.due, self.began) = (Some(values), 0, None, Instant::now());
    }

    /// Publishes a data message (NDATA) with the values that differ from the last published values. Publishes nothing
    /// if no value differs, or if no birth certificate has been published yet. If the queue of the MQTT client is full,
    /// the next attempt follows after one second. Never returns an error.
    fn publish_changes(&mut self) -> Result<(), SessionEnd> {
        let Some(told) = &self.values else { return Ok(()) };
        let values = current(&mut self.node.status);
        let next = self.sequence.wrapping_add(1);
        let Some(changes) = message::changes(FIGURES, &values, told, next) else { return Ok(()) };
        match self.client.try_publish(&self.node.topics.data, QoS::AtMostOnce, false, changes) {
            Ok(()) => (self.values, self.sequence) = (Some(values), next),
            // The next message contains this change too.
            Err(_) => self.due = Some(self.due.unwrap_or_else(|| Instant::now() + OFFERED_AGAIN)),
        }
        Ok(())
    }

    /// Publishes the message that was postponed because the queue of the MQTT client was full, or because a rebirth was
    /// requested too early. If the birth certificate (NBIRTH) is not published yet, publishes it. Otherwise publishes
    /// the values that differ from the last published values. Never returns an error.
    fn catch_up(&mut self) -> Result<(), SessionEnd> {
        self.due = None;
        match self.values {
            None => self.birth(),
            Some(_) => self.publish_changes()?,
        }
        Ok(())
    }

    /// Handles `publish`, a command of a host application. If the command requests a rebirth, publishes a new birth
    /// certificate (NBIRTH), but at the earliest `BETWEEN_BIRTHS` after the last one. Refuses and reports every other
    /// request. Also refuses and reports a command to a device, because the node has no devices.
    fn handle_command(&mut self, publish: &Publish) {
        let by = format!("somebody at the broker {}", self.node.broker.place);
        let (wants_birth, others) = message::read_requests(&publish.payload);
        if publish.topic != self.node.topics.command {
            let others = if wants_birth { vec!["a birth of a device".into()] } else { others };
            return self.node.notes.refused(by, &format!("DCMD: {}", others.join(", ")));
        }
        if !others.is_empty() {
            self.node.notes.refused(by, &format!("NCMD: {}", others.join(", ")));
        }
        if wants_birth && self.began.elapsed() >= BETWEEN_BIRTHS {
            self.birth();
        } else if wants_birth {
            self.due = Some(self.began + BETWEEN_BIRTHS);
            self.values = None;
        }
    }

    /// Publishes the death certificate (NDEATH), waits until the broker confirms it, and disconnects. `events` are the
    /// events of the MQTT connection. Gives up after the timeout `FAREWELL`. The broker then publishes the certificate,
    /// when it notices that the connection is lost. Always returns [`SessionEnd::Ended`].
    async fn farewell(&mut self, events: &mut mpsc::Receiver<Result<Event, ConnectionError>>) -> SessionEnd {
        let said = async {
            let death = message::death(self.connection);
            self.client.publish(&self.node.topics.death, QoS::AtLeastOnce, false, death).await.ok()?;
            while !matches!(events.recv().await?.ok()?, Event::Incoming(Packet::PubAck(_))) {}
            self.client.disconnect().await.ok()?;
            while !matches!(events.recv().await?.ok()?, Event::Outgoing(Outgoing::Disconnect)) {}
            Some(())
        };
        // If the death cannot be sent in time, the broker publishes it.
        let _ = timeout(FAREWELL, said).await;
        SessionEnd::Ended
    }
}

fn current(told: &mut watch::Receiver<CellStatus>) -> Values {
    let told = told.borrow_and_update();
    FIGURES.iter().map(|figure| figure.value(&told)).collect()
}

/// Returns the message of an error of the MQTT client, followed by the messages of its causes.
fn in_words(error: &ConnectionError) -> String {
    let mut words = error.to_string();
    let mut behind = std::error::Error::source(error);
    while let Some(source) = behind {
        let more = source.to_string();
        if !words.contains(&more) {
            words = format!("{words}: {more}");
        }
        behind = source.source();
    }
    words
}
