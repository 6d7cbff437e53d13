//! OPC UA server of a cell: the status model of PackML (OPC 30050), every figure as a variable, results and alarms as
//! events. The server is read-only: no node can be written, and there is no method. It refuses and reports every
//! attempt to write.

mod events;
mod nodes;

use std::net::SocketAddr;
use std::time::Duration;

use opcua_server::node_manager::memory::{InMemoryNodeManager, InMemoryNodeManagerBuilder};
use opcua_server::{ANONYMOUS_USER_TOKEN_ID, ServerBuilder, ServerEndpoint, ServerHandle};
use opcua_types::{BuildInfo, DateTime};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use self::events::events_between;
use self::nodes::{CellNodes, CellNodesBuilder, Namespaces};
use crate::cell_status::{CellStatus, RunStatus};
use crate::error::LiveError;
use crate::publisher_event::EventSender;
use crate::publisher_lock::PublisherLock;
use crate::settings::OpcUaSettings;

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

/// OPC UA server that shows a cell.
pub struct UaServer {
    listen: SocketAddr,
    cell: String,
    pki_folder: std::path::PathBuf,
    status: watch::Receiver<CellStatus>,
    notes: EventSender,
}

impl UaServer {
    /// Creates an OPC UA server for the cell with the name `cell`. The server publishes each status that arrives in
    /// `told`. Connections and rejected writes are reported to `notes`. `turn` is the lock of the publisher; its folder
    /// stores the certificates of the server. The server accepts clients only after [`UaServer::run`] is called.
    ///
    /// # Errors
    /// The address in `settings` can be reached from other computers (it is not a loopback address).
    pub fn new(
        settings: &OpcUaSettings,
        cell: &str,
        turn: &PublisherLock,
        told: watch::Receiver<CellStatus>,
        notes: EventSender,
    ) -> Result<Self, LiveError> {
        let listen = settings.listen;
        if !listen.ip().is_loopback() {
            return Err(LiveError::ForOthers { listen });
        }
        Ok(Self { listen, cell: cell.to_owned(), pki_folder: turn.folder().join("opcua"), status: told, notes })
    }

    /// Serves the status of the cell to OPC UA clients. Returns `Ok` when the sender of the status channel is dropped.
    ///
    /// # Errors
    /// The OPC UA server cannot be built, or ends by itself with an error.
    pub async fn run(mut self) -> Result<(), LiveError> {
        let Some(listener) = self.listener().await else { return Ok(()) };
        let address = listener.local_addr().unwrap_or(self.listen);
        let server = |what| LiveError::Server { what };
        let (serves, handle) = self.builder(address).build().map_err(server)?;
        let shown = handle.node_managers().get_of_type::<InMemoryNodeManager<CellNodes>>();
        let shown = shown.ok_or_else(|| server("the nodes of the cell are missing".into()))?;
        let mut serving = JoinSet::new();
        serving.spawn(serves.run_with(listener));
        self.notes.connected(&format!("opc.tcp://{address}/"));
        let ended = tokio::select! {
            Some(ended) = serving.join_next() => Some(ended),
            () = show(&mut self.status, &handle, &shown) => None,
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
    /// Returns `None` if the sender of the status channel is dropped before the port is open.
    async fn listener(&mut self) -> Option<TcpListener> {
        loop {
            match TcpListener::bind(self.listen).await {
                Ok(listener) => return Some(listener),
                Err(error) => self.notes.retrying(&format!("opc.tcp://{}/", self.listen), error.to_string()),
            }
            tokio::select! {
                () = sleep(BETWEEN_TRIES) => {}
                () = async { while self.status.changed().await.is_ok() {} } => return None,
            }
        }
    }

    fn builder(&self, address: SocketAddr) -> ServerBuilder {
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
            .with_node_manager(InMemoryNodeManagerBuilder::new(CellNodesBuilder {
                cell: self.cell.clone(),
                notes: self.notes.clone(),
            }));
        // The intervals at which a cell publishes.
        let limits = &mut builder.limits_mut().subscriptions;
        (limits.min_publishing_interval_ms, limits.min_sampling_interval_ms) = (100.0, 100.0);
        builder
    }
}

/// Updates the OPC UA server with each new status that arrives in `told`. Writes the changed values to `shown`, the
/// nodes of the cell, and sends new events to the clients via `handle`. The first status causes no event. Returns when
/// the sender of `told` is dropped.
async fn show(told: &mut watch::Receiver<CellStatus>, handle: &ServerHandle, shown: &InMemoryNodeManager<CellNodes>) {
    let Namespaces { own, .. } = shown.inner().namespaces;
    let mut before: Option<CellStatus> = None;
    let mut on = CellStatus::default();
    loop {
        let now = told.borrow_and_update().clone();
        nodes::set(shown, handle.subscriptions(), before.as_ref(), &now);
        if let Some(before) = &before {
            let events = events_between([before, &on], &now, own, shown.inner().cell());
            let emitters = [shown.inner().cell_node(), opcua_types::ObjectId::Server.into()];
            let all = events.iter().flat_map(|event| emitters.iter().map(move |from| (event as _, from)));
            handle.subscriptions().notify_events(all);
        }
        if matches!(now.run_status, RunStatus::Active { .. }) {
            on.clone_from(&now);
        }
        before = Some(now);
        if told.changed().await.is_err() {
            return;
        }
    }
}
