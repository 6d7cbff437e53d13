//! OPC UA server of a cell: the status model of PackML (OPC 30050), every figure as a variable, results and alarms as
//! events. The server is read-only: no node can be written, and the cell has no method. It refuses and reports every
//! attempt to write or to call.

mod core_nodes;
mod events;
mod nodes;
mod refusals;

use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use opcua_server::diagnostics::DiagnosticsNodeManagerBuilder;
use opcua_server::node_manager::memory::{InMemoryNodeManager, InMemoryNodeManagerBuilder};
use opcua_server::node_manager::{NodeManagerBuilder, ServerContext};
use opcua_server::{ANONYMOUS_USER_TOKEN_ID, ServerBuilder, ServerEndpoint, ServerHandle};
use opcua_types::{BuildInfo, DateTime};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};

use self::core_nodes::CoreNodesBuilder;
use self::events::events_between;
use self::nodes::{CellNodes, CellNodesBuilder, Namespaces};
use self::refusals::{NoNodes, Reported};
use crate::cell_status::{CellStatus, RunStatus, TimedStatus};
use crate::error::LiveError;
use crate::publisher_event::EventSender;
use crate::publisher_lock::PublisherLock;
use crate::settings::OpcUaSettings;
use crate::status_feed::StatusReceiver;

/// Time between two attempts to bind the port.
const BETWEEN_TRIES: Duration = Duration::from_secs(1);
/// Time that clients have to disconnect when the server stops.
const FAREWELL: Duration = Duration::from_secs(2);
/// Default timeout of a client's publish request, in ms. A cell can be unchanged for longer than a client may be
/// silent, so the timeout is long.
const WAITS_MS: u64 = 3_600_000;
/// Interval, in ms, at which the server checks whether a publish to a client is due. An interval that ends between two
/// checks is served at the second. If the checks were as far apart as the shortest publishing interval, a keep-alive
/// would arrive after twice the promised time, and the client would give the server up.
const LOOKS_MS: u64 = 20;
/// Maximum number of clients at the same time.
const CLIENTS: usize = 32;

type CellNodeManager = InMemoryNodeManager<CellNodes>;

/// OPC UA server that shows a cell.
pub struct UaServer {
    listen: SocketAddr,
    cell: String,
    pki_folder: std::path::PathBuf,
    status: StatusReceiver,
    last: Arc<TimedStatus>,
    notes: EventSender,
}

impl UaServer {
    /// Creates an OPC UA server for the cell with the name `cell`. The server publishes each status that arrives in
    /// `told`. Connections and refused requests are reported to `notes`. `turn` is the lock of the publisher; its folder
    /// stores the certificates of the server. The server accepts clients only after [`UaServer::run`] is called.
    ///
    /// # Errors
    /// The address in `settings` can be reached from other computers (it is not a loopback address).
    pub fn new(
        settings: &OpcUaSettings,
        cell: &str,
        turn: &PublisherLock,
        told: StatusReceiver,
        notes: EventSender,
    ) -> Result<Self, LiveError> {
        let listen = settings.listen;
        if !listen.ip().is_loopback() {
            return Err(LiveError::ForOthers { listen });
        }
        let (cell, pki_folder) = (cell.to_owned(), turn.folder().join("opcua"));
        Ok(Self { listen, cell, pki_folder, status: told, last: Arc::default(), notes })
    }

    /// Serves the status of the cell to OPC UA clients. Returns `Ok` when the sender of the statuses is dropped.
    ///
    /// # Errors
    /// The OPC UA server cannot be built, or ends by itself with an error.
    pub async fn run(mut self) -> Result<(), LiveError> {
        // No value is shown without its time.
        let Some(first) = self.status.next().await else { return Ok(()) };
        self.last = first;
        let Some(listener) = self.listener().await else { return Ok(()) };
        let address = listener.local_addr().unwrap_or(self.listen);
        let server = |what| LiveError::Server { what };
        let made = Arc::default();
        let (serves, handle) = self.builder(address, &made).build().map_err(server)?;
        let shown = made.get().ok_or_else(|| server("the nodes of the cell are missing".into()))?;
        let mut serving = JoinSet::new();
        serving.spawn(serves.run_with(listener));
        self.notes.connected(&format!("opc.tcp://{address}/"));
        let ended = tokio::select! {
            Some(ended) = serving.join_next() => Some(ended),
            () = self.show(&handle, shown) => None,
        };
        if let Some(ended) = ended {
            let reason = ended.unwrap_or_else(|error| Err(error.to_string()));
            return reason.map_err(server);
        }
        handle.cancel();
        // Clients that do not disconnect in time are dropped.
        let _ = timeout(FAREWELL, serving.join_next()).await;
        Ok(())
    }

    /// Opens the TCP port of the server. While the port cannot be opened, reports this and tries again every second.
    /// Returns `None` if the sender of the statuses is dropped before the port is open.
    async fn listener(&mut self) -> Option<TcpListener> {
        loop {
            match TcpListener::bind(self.listen).await {
                Ok(listener) => return Some(listener),
                Err(error) => self.notes.retrying(&format!("opc.tcp://{}/", self.listen), error.to_string()),
            }
            let until = Instant::now() + BETWEEN_TRIES;
            while Instant::now() < until {
                tokio::select! {
                    () = sleep_until(until) => {}
                    told = self.status.next() => self.last = told?,
                }
            }
        }
    }

    /// Returns the builder of the server at `address`. The server stores the nodes of the cell in `made`.
    fn builder(&self, address: SocketAddr, made: &Arc<OnceLock<Arc<CellNodeManager>>>) -> ServerBuilder {
        let version = env!("CARGO_PKG_VERSION");
        let about = BuildInfo {
            product_uri: "urn:regrind".into(),
            manufacturer_name: "The Regrind developers".into(),
            product_name: "Regrind".into(),
            software_version: version.into(),
            build_number: version.into(),
            build_date: DateTime::null(),
        };
        let mut builder = ServerBuilder::new()
            .application_name(format!("Regrind, {}", self.cell))
            .application_uri(format!("urn:regrind:{}", self.cell))
            .product_uri("urn:regrind")
            .build_info(about)
            .host(address.ip().to_string())
            .port(address.port())
            .pki_dir(&self.pki_folder)
            .discovery_urls(vec!["/".to_owned()])
            .add_endpoint("none", ServerEndpoint::new_none("/", &[ANONYMOUS_USER_TOKEN_ID.to_string()]))
            .max_sessions(CLIENTS)
            .publish_timeout_default_ms(WAITS_MS)
            .subscription_poll_interval_ms(LOOKS_MS)
            .without_node_managers()
            .with_node_manager(reported(InMemoryNodeManagerBuilder::new(CoreNodesBuilder), &self.notes))
            .with_node_manager(reported(DiagnosticsNodeManagerBuilder, &self.notes))
            .with_node_manager(self.cell_nodes(made.clone()))
            .with_node_manager(self.no_nodes());
        // The intervals at which a cell publishes.
        let limits = &mut builder.limits_mut().subscriptions;
        (limits.min_publishing_interval_ms, limits.min_sampling_interval_ms) = (100.0, 100.0);
        builder
    }

    fn cell_nodes(&self, made: Arc<OnceLock<Arc<CellNodeManager>>>) -> impl FnOnce(ServerContext) -> Reported + use<> {
        let (cell, notes) = (self.cell.clone(), self.notes.clone());
        move |context| {
            let nodes = Box::new(InMemoryNodeManagerBuilder::new(CellNodesBuilder { cell })).build(context);
            if let Ok(shown) = nodes.clone().into_any_arc().downcast() {
                made.get_or_init(|| shown);
            }
            Reported { nodes, notes }
        }
    }

    /// Returns the builder of the node manager for all other namespaces. It must be the last one.
    fn no_nodes(&self) -> impl FnOnce(ServerContext) -> Reported + use<> {
        let notes = self.notes.clone();
        move |context| {
            let last = context.type_tree.read().namespaces().known_namespaces().values().max().copied();
            Reported { nodes: Arc::new(NoNodes { namespaces: last.map_or(0, |last| last + 1) }), notes }
        }
    }

    /// Updates the OPC UA server with each status that arrives. Writes the changed values to `shown`, the nodes of the
    /// cell, and sends new events to the clients via `handle`. The first status causes no event. Returns when the sender
    /// of the statuses is dropped.
    async fn show(&mut self, handle: &ServerHandle, shown: &CellNodeManager) {
        let Namespaces { own, .. } = shown.inner().namespaces;
        let mut before: Option<Arc<TimedStatus>> = None;
        let mut on = CellStatus::default();
        loop {
            let now = self.last.clone();
            nodes::set(shown, handle.subscriptions(), before.as_deref(), &now);
            if let Some(before) = &before {
                let events = events_between([&before.status, &on], &now, own, shown.inner().cell());
                let emitters = [shown.inner().cell_node(), opcua_types::ObjectId::Server.into()];
                let all = events.iter().flat_map(|event| emitters.iter().map(move |from| (event as _, from)));
                handle.subscriptions().notify_events(all);
            }
            if matches!(now.status.run_status, RunStatus::Active { .. }) {
                on.clone_from(&now.status);
            }
            before = Some(now);
            match self.status.next().await {
                Some(told) => self.last = told,
                None => return,
            }
        }
    }
}

/// Returns the builder of a node manager that does what the one of the builder `nodes` does, and reports what it refuses.
fn reported<N>(nodes: N, notes: &EventSender) -> impl FnOnce(ServerContext) -> Reported + use<N>
where
    N: NodeManagerBuilder + 'static,
{
    let notes = notes.clone();
    move |context| Reported { nodes: Box::new(nodes).build(context), notes }
}
