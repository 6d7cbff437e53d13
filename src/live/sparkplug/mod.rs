//! A cell as an edge node of Sparkplug B.
//!
//! The node has no device: the program and the cell start and end together. There is therefore one birth with all
//! figures and one death, and it is always clear which death counts. Every connection is a session of its own, with its
//! own number, subscriptions and birth. The client does not restore sessions.
//!
//! Every change goes through the store: it is forgotten when the broker has confirmed it. Data have no acknowledgement
//! (QoS 0, as the specification requires). So the node unsubscribes from a topic that it does not use: the broker
//! answers this only after it has received all that was sent before.
//!
//! With a primary host, the node is born when this host is online, and dies when the host goes offline.

mod change;
mod link;
mod message;
mod primary_host;
mod store;

use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectionError, Event, EventLoop, Outgoing, Packet, Publish, QoS, SubscribeFilter,
    SubscribeReasonCode,
};
use srad_types::topic::{DeviceMessage, DeviceTopic, NodeMessage, NodeTopic};
use srad_types::utils::validate_name;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};

use self::change::{Change, Values};
use self::link::BrokerOptions;
use self::primary_host::{PrimaryHost, Unused};
use self::store::{Limits, SentMark, Store};
use crate::cell_status::{TimedStatus, now_ms};
use crate::error::LiveError;
use crate::figures::FIGURES;
use crate::publisher_event::EventSender;
use crate::publisher_lock::{BdSeqCounter, PublisherLock};
use crate::settings::SparkplugSettings;
use crate::status_feed::StatusReceiver;

/// Limits of the time between two attempts to connect to the broker.
const MIN_RETRY_DELAY: Duration = Duration::from_millis(500);
const MAX_RETRY_DELAY: Duration = Duration::from_secs(30);
/// Minimum time between two births, however many hosts request one.
const BETWEEN_BIRTHS: Duration = Duration::from_secs(1);
/// Time after which a message is sent again that did not fit into the queue of the client.
const OFFERED_AGAIN: Duration = Duration::from_secs(1);
/// Timeout for the last data, the death message and the disconnection at the end.
const FAREWELL: Duration = Duration::from_secs(2);
/// Maximum number of messages queued for the network.
const WAITING: usize = 16;
/// Maximum number of data messages between two questions whether the broker has received them.
const UNCONFIRMED: u32 = 64;
/// Minimum time between two reports of lost changes.
const BETWEEN_LOSSES: Duration = Duration::from_secs(60);

/// Edge node that publishes the state of a cell to a broker.
pub struct Node {
    broker: BrokerOptions,
    bd_seq: BdSeqCounter,
    topics: Topics,
    told: StatusReceiver,
    /// Values of the last status, and their time in milliseconds since 1970.
    values: Values,
    at_ms: u64,
    store: Store,
    host: Option<PrimaryHost>,
    notes: EventSender,
    /// True if the last write of the store has failed.
    disk_fails: bool,
    /// Time of the last report of lost changes.
    losses_reported: Option<Instant>,
    /// Last reported reason why nothing is published; `None` while the node is born.
    waits_for: Option<String>,
}

struct Topics {
    birth: String,
    data: String,
    death: String,
    command: String,
    device_commands: String,
    /// Topic to which the node never subscribes.
    unused: String,
}

impl Topics {
    fn new(group: &str, node: &str) -> Self {
        let topic = |message| NodeTopic::new(group, message, node).topic;
        let commands_of = |device| DeviceTopic::new(group, DeviceMessage::DCmd, node, device).topic;
        Self {
            birth: topic(NodeMessage::NBirth),
            data: topic(NodeMessage::NData),
            death: topic(NodeMessage::NDeath),
            command: topic(NodeMessage::NCmd),
            device_commands: commands_of("+"),
            unused: commands_of("none"),
        }
    }
}

/// Reason for the end of a connection.
enum SessionEnd {
    /// The source of the state has closed.
    Ended,
    /// The primary host has gone offline.
    HostOffline,
    /// The broker is gone or was never reached; `stood` is true if the connection was established before.
    Lost { reason: String, stood: bool },
}

impl Node {
    /// Creates a Sparkplug node that publishes the state of the cell named `cell`. The node does not connect before
    /// [`Self::run`]. `turn` is the lock that only one publisher of the cell can have; its folder has the changes that
    /// were not published yet. The node publishes each status that it receives from `told`. It reports events, such as a
    /// lost connection, to `notes`.
    ///
    /// # Errors
    /// The name of the group, of the cell or of the primary host is not valid in a topic. A password or a certificate
    /// cannot be read. The broker is on another computer and no certificates are given. The file with the number of the
    /// connection (bdSeq) or with the unpublished changes cannot be opened.
    pub fn new(
        settings: &SparkplugSettings,
        cell: &str,
        turn: &PublisherLock,
        told: StatusReceiver,
        notes: EventSender,
    ) -> Result<Self, LiveError> {
        let host = settings.primary_host.as_deref();
        let names = [("the group", &*settings.group), ("the cell", cell)];
        for (of, name) in names.into_iter().chain(host.map(|host| ("the primary host", host))) {
            validate_name(name).map_err(|_| LiveError::Topic { of, name: name.to_owned() })?;
        }
        let limits = Limits {
            changes: usize::try_from(settings.keep_changes.max(1)).unwrap_or(usize::MAX),
            age_ms: 3_600_000 * u64::from(settings.keep_hours),
        };
        let store = Store::open(turn.folder().join("changes"), limits, now_ms());
        let unreadable = |source| LiveError::Folder { path: turn.folder().to_owned(), source };
        Ok(Self {
            broker: BrokerOptions::new(settings, &format!("regrind-{}-{cell}", settings.group))?,
            bd_seq: BdSeqCounter::open(turn)?,
            topics: Topics::new(&settings.group, cell),
            told,
            values: Values::new(),
            at_ms: 0,
            store: store.map_err(unreadable)?,
            host: host.map(PrimaryHost::new),
            notes,
            disk_fails: false,
            losses_reported: None,
            waits_for: None,
        })
    }

    /// Publishes the status of the cell until the source of the status closes, and then returns `Ok`. If the connection
    /// to the broker is lost, or the primary host is offline, keeps the changes and connects again after a delay.
    ///
    /// # Errors
    /// The number of the connection (bdSeq) cannot be written to its file.
    pub async fn run(mut self) -> Result<(), LiveError> {
        // The first status is no change.
        let Some(first) = self.told.next().await else { return Ok(()) };
        self.take_status(&first);
        let mut wait = MIN_RETRY_DELAY;
        let mut connection = self.bd_seq.next()?;
        loop {
            let began = Instant::now();
            let (stood, reason) = match self.session(connection).await {
                SessionEnd::Ended => break,
                SessionEnd::HostOffline => {
                    // The broker is there.
                    wait = MIN_RETRY_DELAY;
                    (true, "the primary host is offline".to_owned())
                }
                SessionEnd::Lost { reason, stood } => (stood, reason),
            };
            self.store.turn_into_history();
            self.report_waiting(reason);
            if stood {
                connection = self.bd_seq.next()?;
            }
            // After a connection that lasted, the next attempt comes soon. After one that ended at once, the wait keeps
            // growing.
            wait = if began.elapsed() > MAX_RETRY_DELAY { MIN_RETRY_DELAY } else { wait };
            if !self.take_until(Instant::now() + wait).await {
                break;
            }
            wait = (2 * wait).min(MAX_RETRY_DELAY);
        }
        self.report_losses(true);
        Ok(())
    }

    /// Takes the statuses that arrive before `until`. Returns false if the source of the statuses has closed.
    async fn take_until(&mut self, until: Instant) -> bool {
        while Instant::now() < until {
            tokio::select! {
                () = sleep_until(until) => {}
                told = self.told.next() => match told {
                    Some(status) => self.take_status(&status),
                    None => return false,
                },
            }
        }
        true
    }

    /// Takes the values of `status`, and stores what has changed.
    fn take_status(&mut self, status: &TimedStatus) {
        let values: Values = FIGURES.iter().map(|figure| figure.value(&status.status)).collect();
        if let Some(change) = Change::between(&self.values, &values, status.at_ms) {
            let stored = self.store.push(change, now_ms());
            self.report_disk(stored);
            self.report_losses(false);
        }
        (self.values, self.at_ms) = (values, status.at_ms.max(self.at_ms));
    }

    /// Reports that nothing is published because of `reason`, once for the same reason.
    fn report_waiting(&mut self, reason: String) {
        if self.waits_for.as_ref() != Some(&reason) {
            self.notes.retrying(&self.broker.place, reason.clone());
            self.waits_for = Some(reason);
        }
    }

    fn report_disk(&mut self, written: std::io::Result<()>) {
        let failed = written.is_err();
        if let Err(error) = written
            && !self.disk_fails
        {
            let reason = format!("changes are kept in memory only: {error}");
            self.notes.retrying(&self.store.path().display().to_string(), reason);
        }
        self.disk_fails = failed;
    }

    /// Reports the changes that were lost since the last report. Without `at_once`, at most once a minute.
    fn report_losses(&mut self, at_once: bool) {
        let is_due = at_once || self.losses_reported.is_none_or(|last| last.elapsed() >= BETWEEN_LOSSES);
        if self.store.dropped() > 0 && is_due && self.notes.dropped(&self.broker.place, self.store.dropped()) {
            self.store.dropped_reported();
            self.losses_reported = Some(Instant::now());
        }
    }

    /// Connects to the broker and publishes the status of the cell. Ends when the connection is lost, when the primary
    /// host goes offline, or when the source of the status closes. Returns which of these happened. `connection` is the
    /// number of the connection (bdSeq).
    async fn session(&mut self, connection: u8) -> SessionEnd {
        if let Some(host) = &mut self.host {
            // The broker tells the state anew.
            host.is_online = false;
        }
        let options = self.broker.with_last_will(&self.topics.death, message::death(connection));
        let (client, mut broker) = AsyncClient::new(options, WAITING);
        broker.network_options.set_tcp_nodelay(true);
        // Polls in a task of its own: cancelling a poll in the middle of a message would end the connection.
        let (to, mut events) = mpsc::channel(WAITING);
        let mut polling = JoinSet::new();
        polling.spawn(poll(broker, to));
        let mut session = Session::new(self, client, connection);
        loop {
            let due = session.due;
            let over = tokio::select! {
                event = events.recv() => session.handle_event(event),
                told = session.node.told.next() => match told {
                    Some(status) => {
                        session.node.take_status(&status);
                        Ok(())
                    }
                    None => Err(SessionEnd::Ended),
                },
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => session.catch_up(),
            };
            match over {
                Ok(()) => session.forward(),
                Err(lost @ SessionEnd::Lost { .. }) => return lost,
                Err(end) => {
                    session.farewell(&mut events, matches!(end, SessionEnd::Ended)).await;
                    return end;
                }
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
    /// True if the broker has accepted the connection.
    stood: bool,
    /// True if the broker has answered the subscription.
    subscribed: bool,
    /// True after the first birth.
    born: bool,
    /// True if a birth is due that was too early, or that did not fit into the queue.
    birth_due: bool,
    sequence: u8,
    /// Mark of the changes that the broker had been sent when it was asked for a confirmation; `None` if no answer is due.
    asked: Option<SentMark>,
    /// Number of data messages since then.
    since_asked: u32,
    /// Time at which a deferred birth or message is due.
    due: Option<Instant>,
    /// Time of the last birth.
    began: Instant,
}

impl<'a> Session<'a> {
    fn new(node: &'a mut Node, client: AsyncClient, connection: u8) -> Self {
        let (stood, subscribed, born, birth_due) = (false, false, false, false);
        let began = Instant::now();
        Self {
            node,
            client,
            connection,
            stood,
            subscribed,
            born,
            birth_due,
            sequence: 0,
            asked: None,
            since_asked: 0,
            due: None,
            began,
        }
    }

    /// Handles `event`, an event of the MQTT connection. `None` means that the connection is closed. After the broker
    /// has accepted the connection, subscribes to the commands of host applications and to the state of the primary
    /// host. After the broker has answered the subscription, publishes the birth certificate (NBIRTH), if the primary
    /// host is online. Executes or refuses a received command. Ignores every other event.
    ///
    /// # Errors
    /// The connection is closed or has an error, the subscription cannot be sent, or the primary host has gone offline.
    fn handle_event(&mut self, event: Option<Result<Event, ConnectionError>>) -> Result<(), SessionEnd> {
        let stood = self.stood;
        let lost = |reason: String| Err(SessionEnd::Lost { reason, stood });
        match event {
            None => return lost("the connection was closed".into()),
            Some(Err(error)) => return lost(in_words(&error)),
            Some(Ok(Event::Incoming(Packet::ConnAck(_)))) => {
                self.stood = true;
                let topics = &self.node.topics;
                let state = self.node.host.as_ref().map(|host| &host.topic);
                let filters = [&topics.command, &topics.device_commands].into_iter().chain(state);
                let filters: Vec<_> =
                    filters.map(|topic| SubscribeFilter::new(topic.clone(), QoS::AtLeastOnce)).collect();
                return self.client.try_subscribe_many(filters).or_else(|error| lost(error.to_string()));
            }
            // Subscribes before the birth, so that no later command is missed.
            Some(Ok(Event::Incoming(Packet::SubAck(ack)))) => self.subscribed(&ack.return_codes),
            Some(Ok(Event::Incoming(Packet::UnsubAck(_)))) => self.confirmed(),
            Some(Ok(Event::Incoming(Packet::Publish(publish)))) => {
                if self.node.host.as_ref().is_some_and(|host| host.topic == publish.topic) {
                    return self.handle_state(&publish);
                }
                self.handle_command(&publish);
            }
            Some(Ok(_)) => {}
        }
        Ok(())
    }

    fn subscribed(&mut self, codes: &[SubscribeReasonCode]) {
        self.subscribed = true;
        if codes.contains(&SubscribeReasonCode::Failure) {
            let reason =
                "the broker does not let the node subscribe to its commands or to the state of the primary host";
            self.node.report_waiting(reason.to_owned());
        }
        if self.node.host.as_ref().is_none_or(|host| host.is_online) {
            self.first_birth();
        } else {
            self.node.report_waiting("the primary host is not online yet".to_owned());
        }
    }

    /// Handles a STATE message of the primary host. If the host is online, publishes the first birth certificate
    /// (NBIRTH).
    ///
    /// # Errors
    /// The host has gone offline.
    fn handle_state(&mut self, publish: &Publish) -> Result<(), SessionEnd> {
        let Some(host) = &mut self.node.host else { return Ok(()) };
        match host.apply_state(&publish.payload) {
            Ok(()) => {}
            // Brokers repeat old messages.
            Err(Unused::Outdated) => return Ok(()),
            Err(Unused::Invalid) => {
                let by = format!("somebody at the broker {}", self.node.broker.place);
                self.node.notes.refused(by, "STATE: a message that is not a state of the primary host");
                return Ok(());
            }
        }
        match host.is_online {
            true if self.subscribed && !self.born => self.first_birth(),
            false if self.born => return Err(SessionEnd::HostOffline),
            _ => {}
        }
        Ok(())
    }

    /// Publishes the first birth certificate (NBIRTH) of the connection. The changes so far are history then.
    fn first_birth(&mut self) {
        self.node.notes.connected(&self.node.broker.place);
        self.node.waits_for = None;
        self.node.report_losses(true);
        self.node.store.turn_into_history();
        self.born = true;
        self.birth();
    }

    /// Publishes a birth certificate (NBIRTH) with the current values of all figures (the quantities that the cell
    /// publishes). If the queue of the MQTT client is full, postpones the certificate by one second.
    fn birth(&mut self) {
        let birth = message::birth(&self.node.values, self.node.at_ms, self.connection);
        if self.client.try_publish(&self.node.topics.birth, QoS::AtMostOnce, false, birth).is_err() {
            (self.due, self.birth_due) = (Some(Instant::now() + OFFERED_AGAIN), true);
            return;
        }
        (self.sequence, self.birth_due, self.began) = (0, false, Instant::now());
    }

    /// Publishes data messages (NDATA) with the changes that were not sent yet, until the queue of the MQTT client is
    /// full. Every event of the connection calls this again. Publishes nothing before the birth.
    fn forward(&mut self) {
        if !self.born || self.birth_due {
            return;
        }
        while (self.asked.is_some() || self.since_asked < UNCONFIRMED)
            && let Some((change, historical)) = self.node.store.next_to_send()
        {
            let next = self.sequence.wrapping_add(1);
            let data = message::data(change, next, historical);
            if self.client.try_publish(&self.node.topics.data, QoS::AtMostOnce, false, data).is_err() {
                self.due = Some(self.due.unwrap_or_else(|| Instant::now() + OFFERED_AGAIN));
                return;
            }
            self.node.store.mark_sent();
            (self.sequence, self.since_asked) = (next, self.since_asked + 1);
        }
        if self.asked.is_none()
            && let Some(mark) = self.node.store.sent_mark()
            && self.client.try_unsubscribe(&self.node.topics.unused).is_ok()
        {
            (self.asked, self.since_asked) = (Some(mark), 0);
        }
    }

    /// Forgets the changes that the broker has confirmed.
    fn confirmed(&mut self) {
        if let Some(mark) = self.asked.take() {
            let written = self.node.store.confirm(mark);
            self.node.report_disk(written);
        }
    }

    /// Publishes what was postponed because the queue of the MQTT client was full, or because a rebirth was requested
    /// too early. Never returns an error.
    fn catch_up(&mut self) -> Result<(), SessionEnd> {
        self.due = None;
        if self.birth_due {
            self.birth();
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
        if !wants_birth || !self.born {
            return;
        }
        if self.began.elapsed() >= BETWEEN_BIRTHS {
            self.birth();
        } else {
            (self.due, self.birth_due) = (Some(self.began + BETWEEN_BIRTHS), true);
        }
    }

    /// Publishes the death certificate (NDEATH), waits until the broker confirms it, and disconnects. If `a_host_listens`,
    /// publishes the remaining changes before. `events` are the events of the MQTT connection. Gives up after the
    /// timeout `FAREWELL`: the broker then publishes the certificate when it notices that the connection is lost, and
    /// the store keeps the changes.
    async fn farewell(&mut self, events: &mut mpsc::Receiver<Result<Event, ConnectionError>>, a_host_listens: bool) {
        let said = async {
            while a_host_listens && self.born && self.node.store.has_unsent() {
                self.forward();
                if matches!(events.recv().await?.ok()?, Event::Incoming(Packet::UnsubAck(_))) {
                    self.confirmed();
                }
            }
            if self.born {
                let death = message::death(self.connection);
                let topic = &self.node.topics.death;
                while self.client.try_publish(topic, QoS::AtLeastOnce, false, death.clone()).is_err() {
                    events.recv().await?.ok()?;
                }
                while !matches!(events.recv().await?.ok()?, Event::Incoming(Packet::PubAck(_))) {}
                if a_host_listens {
                    // The broker has all that was sent before the death.
                    self.asked = self.node.store.sent_mark();
                    self.confirmed();
                }
            }
            while self.client.try_disconnect().is_err() {
                events.recv().await?.ok()?;
            }
            while !matches!(events.recv().await?.ok()?, Event::Outgoing(Outgoing::Disconnect)) {}
            Some(())
        };
        // If the death cannot be sent in time, the broker publishes it.
        let _ = timeout(FAREWELL, said).await;
    }
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
