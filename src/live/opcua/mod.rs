//! A cell as a server of OPC UA: the status model of PackML (OPC 30050), every figure as a variable, results and alarms as events. It is only to
//! be looked at: no node can be written, there is no method, and who tries is told so and heard of.

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

use self::events::happened;
use self::nodes::{CellNodes, CellNodesBuilder, Namespaces};
use crate::error::LiveError;
use crate::news::Notes;
use crate::settings::OpcUaSettings;
use crate::told::{Now, Told};
use crate::turn::Turn;

/// Between two tries to have the port.
const BETWEEN_TRIES: Duration = Duration::from_secs(1);
/// How long clients may take to go when the server does.
const FAREWELL: Duration = Duration::from_secs(2);
/// How long a client waits for something new that does not say how long: a cell may stand still for longer than a client may be silent.
const WAITS_MS: u64 = 3_600_000;
/// How often it is looked whether a client is due. An interval that is over between two looks is over with the second: were they as far
/// apart as the shortest interval, a sign of life would come twice as late as it was promised, and a client would give it up.
const LOOKS_MS: u64 = 20;
/// Most clients that look at a time.
const CLIENTS: usize = 32;

/// A server of OPC UA that shows a cell.
pub struct UaServer {
    listen: SocketAddr,
    cell: String,
    keeps: std::path::PathBuf,
    told: watch::Receiver<Told>,
    notes: Notes,
}

impl UaServer {
    /// A server for the cell of this name. It shows nobody anything yet.
    ///
    /// # Errors
    /// An address that is open to other computers.
    pub fn new(
        settings: &OpcUaSettings,
        cell: &str,
        turn: &Turn,
        told: watch::Receiver<Told>,
        notes: Notes,
    ) -> Result<Self, LiveError> {
        let listen = settings.listen;
        if !listen.ip().is_loopback() {
            return Err(LiveError::ForOthers { listen });
        }
        Ok(Self { listen, cell: cell.to_owned(), keeps: turn.folder().join("opcua"), told, notes })
    }

    /// Shows the cell until nobody has anything to show any more.
    ///
    /// # Errors
    /// What the server is made of does not fit together.
    pub async fn run(mut self) -> Result<(), LiveError> {
        let Some(listener) = self.listener().await else { return Ok(()) };
        let address = listener.local_addr().unwrap_or(self.listen);
        let server = |what| LiveError::Server { what };
        let (serves, handle) = self.builder(address).build().map_err(server)?;
        let shown = handle.node_managers().get_of_type::<InMemoryNodeManager<CellNodes>>();
        let shown = shown.ok_or_else(|| server("the nodes of the cell are missing".into()))?;
        let mut serving = JoinSet::new();
        serving.spawn(serves.run_with(listener));
        self.notes.tells(&format!("opc.tcp://{address}/"));
        let ended = tokio::select! {
            Some(ended) = serving.join_next() => Some(ended),
            () = show(&mut self.told, &handle, &shown) => None,
        };
        if let Some(ended) = ended {
            let why = ended.unwrap_or_else(|error| Err(error.to_string()));
            return why.map_err(server);
        }
        handle.cancel();
        // Who does not go is left.
        let _ = timeout(FAREWELL, serving.join_next()).await;
        Ok(())
    }

    /// Waits until the port is to be had; none where there is nothing to show any more before.
    async fn listener(&mut self) -> Option<TcpListener> {
        loop {
            match TcpListener::bind(self.listen).await {
                Ok(listener) => return Some(listener),
                Err(error) => self.notes.waits(&format!("opc.tcp://{}/", self.listen), error.to_string()),
            }
            tokio::select! {
                () = sleep(BETWEEN_TRIES) => {}
                () = async { while self.told.changed().await.is_ok() {} } => return None,
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
            .pki_dir(&self.keeps)
            .discovery_urls(vec!["/".to_owned()])
            .add_endpoint("none", ServerEndpoint::new_none("/", &[ANONYMOUS_USER_TOKEN_ID.to_string()]))
            .max_sessions(CLIENTS)
            .publish_timeout_default_ms(WAITS_MS)
            .subscription_poll_interval_ms(LOOKS_MS)
            .with_node_manager(InMemoryNodeManagerBuilder::new(CellNodesBuilder {
                cell: self.cell.clone(),
                notes: self.notes.clone(),
            }));
        // As often as a cell tells anything.
        let limits = &mut builder.limits_mut().subscriptions;
        (limits.min_publishing_interval_ms, limits.min_sampling_interval_ms) = (100.0, 100.0);
        builder
    }
}

/// Shows what is told, until nothing is any more.
async fn show(told: &mut watch::Receiver<Told>, handle: &ServerHandle, shown: &InMemoryNodeManager<CellNodes>) {
    let Namespaces { own, .. } = shown.inner().namespaces;
    let mut before: Option<Told> = None;
    let mut on = Told::default();
    loop {
        let now = told.borrow_and_update().clone();
        nodes::set(shown, handle.subscriptions(), before.as_ref(), &now);
        if let Some(before) = &before {
            let events = happened([before, &on], &now, own, shown.inner().cell());
            let emitters = [shown.inner().cell_node(), opcua_types::ObjectId::Server.into()];
            let all = events.iter().flat_map(|event| emitters.iter().map(move |from| (event as _, from)));
            handle.subscriptions().notify_events(all);
        }
        if matches!(now.now, Now::On { .. }) {
            on.clone_from(&now);
        }
        before = Some(now);
        if told.changed().await.is_err() {
            return;
        }
    }
}
