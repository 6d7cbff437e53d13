//! Nodes that every OPC UA server has, with true times. The library takes the start of the server for the time of each
//! of their values, and reads the time in ServerStatus only once.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use opcua_core::sync::RwLock;
use opcua_server::address_space::AddressSpace;
use opcua_server::diagnostics::NamespaceMetadata;
use opcua_server::node_manager::memory::{
    CoreNodeManagerBuilder, CoreNodeManagerImpl, InMemoryNodeManagerImpl, InMemoryNodeManagerImplBuilder,
};
use opcua_server::node_manager::{
    MethodCall, MonitoredItemRef, MonitoredItemUpdateRef, ParsedReadValueId, RequestContext, ServerContext,
    SyncSampler, WriteNode,
};
use opcua_server::{CreateMonitoredItem, ServerStatusWrapper};
use opcua_types::{
    DataValue, DateTime, ExtensionObject, LocalizedText, MonitoringMode, NodeId, NumericRange, ServerStatusDataType,
    StatusCode, TimestampsToReturn, VariableId, Variant,
};

/// Interval at which subscribed times are read.
const SAMPLED: Duration = Duration::from_millis(100);

/// Builder of the nodes.
pub(super) struct CoreNodesBuilder;

/// Nodes of the base namespace: those of the library, with their times corrected.
pub(super) struct CoreNodes {
    library: CoreNodeManagerImpl,
    clock: Clock,
    sampler: SyncSampler,
}

/// Times of a server.
#[derive(Clone)]
struct Clock {
    began: DateTime,
    status: Arc<ServerStatusWrapper>,
}

impl InMemoryNodeManagerImplBuilder for CoreNodesBuilder {
    type Impl = CoreNodes;

    fn build(self, context: ServerContext, space: &mut AddressSpace) -> CoreNodes {
        let clock = Clock { began: DateTime::now(), status: context.status.clone() };
        CoreNodes { library: CoreNodeManagerBuilder.build(context, space), clock, sampler: SyncSampler::new() }
    }
}

impl Clock {
    /// Returns the value of the variable `node` if this value is or contains the present time. Returns `None` for every
    /// other variable.
    fn read(&self, node: &NodeId) -> Option<DataValue> {
        let now = DateTime::now();
        let value = match node.as_variable_id().ok()? {
            VariableId::Server_ServerStatus_CurrentTime => now.into(),
            VariableId::Server_ServerStatus => Variant::from(ExtensionObject::from_message(self.status_at(now))),
            _ => return None,
        };
        Some(super::nodes::good(value, now))
    }

    fn status_at(&self, now: DateTime) -> ServerStatusDataType {
        ServerStatusDataType {
            start_time: self.status.start_time(),
            current_time: now,
            state: self.status.state(),
            build_info: self.status.build_info(),
            seconds_till_shutdown: self.status.seconds_till_shutdown().unwrap_or_default(),
            shutdown_reason: self.status.shutdown_reason().unwrap_or_else(LocalizedText::null),
        }
    }

    /// Returns `value` with true times: the server knows the value now, and it has been so since the start of the server.
    /// Adds and removes no value. `wanted` are the times that the client wants.
    fn corrected(&self, value: DataValue, wanted: TimestampsToReturn) -> DataValue {
        use TimestampsToReturn::{Both, Server, Source};
        let source = value.source_timestamp.filter(|at| *at >= self.began).unwrap_or(self.began);
        DataValue {
            source_timestamp: matches!(wanted, Source | Both).then_some(source),
            source_picoseconds: None,
            server_timestamp: matches!(wanted, Server | Both).then(DateTime::now),
            server_picoseconds: None,
            ..value
        }
    }
}

/// Returns `value` with the times that the client wants.
fn with_wanted_times(value: DataValue, wanted: TimestampsToReturn) -> DataValue {
    use TimestampsToReturn::{Both, Server, Source};
    DataValue {
        source_timestamp: value.source_timestamp.filter(|_| matches!(wanted, Source | Both)),
        server_timestamp: value.server_timestamp.filter(|_| matches!(wanted, Server | Both)),
        ..value
    }
}

#[async_trait]
impl InMemoryNodeManagerImpl for CoreNodes {
    async fn init(&self, space: &mut AddressSpace, context: ServerContext) {
        self.sampler.run(SAMPLED, context.subscriptions.clone());
        self.library.init(space, context).await;
    }

    fn name(&self) -> &str {
        self.library.name()
    }

    fn namespaces(&self) -> Vec<NamespaceMetadata> {
        self.library.namespaces()
    }

    async fn read_values(
        &self,
        context: &RequestContext,
        space: &RwLock<AddressSpace>,
        nodes: &[&ParsedReadValueId],
        max_age: f64,
        wanted: TimestampsToReturn,
    ) -> Vec<DataValue> {
        let values = self.library.read_values(context, space, nodes, max_age, wanted).await;
        let corrected = values.into_iter().zip(nodes).map(|(value, node)| {
            let of_clock = self.clock.read(&node.node_id);
            match of_clock.filter(|_| value.status().is_good() && node.index_range == NumericRange::None) {
                Some(time) => with_wanted_times(time, wanted),
                None => self.clock.corrected(value, wanted),
            }
        });
        corrected.collect()
    }

    /// Creates the monitored items `items`. Samples the two variables that contain the present time, and leaves all
    /// others to the library.
    async fn create_value_monitored_items(
        &self,
        context: &RequestContext,
        space: &RwLock<AddressSpace>,
        items: &mut [&mut &mut CreateMonitoredItem],
    ) {
        let mut others = Vec::new();
        for item in items.iter_mut() {
            let node = item.item_to_monitor().node_id.clone();
            let Some(first) = self.clock.read(&node) else {
                others.push(&mut **item);
                continue;
            };
            item.set_initial_value(first);
            item.set_status(StatusCode::Good);
            let (clock, sampled) = (self.clock.clone(), node.clone());
            let interval = Duration::try_from_secs_f64(item.sampling_interval() / 1e3).unwrap_or(SAMPLED);
            let value = item.item_to_monitor().attribute_id;
            let sample = move || clock.read(&sampled);
            self.sampler.add_sampler(node, value, sample, item.monitoring_mode(), item.handle(), interval);
        }
        self.library.create_value_monitored_items(context, space, &mut others).await;
        let nodes: Vec<_> = others.iter().map(|item| item.item_to_monitor()).collect();
        let values = self.read_values(context, space, &nodes, 0.0, TimestampsToReturn::Both).await;
        for (item, value) in others.into_iter().zip(values) {
            if item.status_code().is_good() && value.status() != StatusCode::BadAttributeIdInvalid {
                item.set_initial_value(value);
            }
        }
    }

    async fn set_monitoring_mode(&self, context: &RequestContext, mode: MonitoringMode, items: &[&MonitoredItemRef]) {
        for item in items.iter().filter(|item| self.clock.read(item.node_id()).is_some()) {
            self.sampler.set_sampler_mode(item.node_id(), item.attribute(), item.handle(), mode);
        }
        self.library.set_monitoring_mode(context, mode, items).await;
    }

    async fn modify_monitored_items(&self, context: &RequestContext, items: &[&MonitoredItemUpdateRef]) {
        for item in items.iter().filter(|item| self.clock.read(item.node_id()).is_some()) {
            let interval =
                Duration::try_from_secs_f64(item.update().revised_sampling_interval / 1e3).unwrap_or(SAMPLED);
            self.sampler.update_sampler(item.node_id(), item.attribute(), item.handle(), interval);
        }
        self.library.modify_monitored_items(context, items).await;
    }

    async fn delete_monitored_items(&self, context: &RequestContext, items: &[&MonitoredItemRef]) {
        for item in items.iter().filter(|item| self.clock.read(item.node_id()).is_some()) {
            self.sampler.remove_sampler(item.node_id(), item.attribute(), item.handle());
        }
        self.library.delete_monitored_items(context, items).await;
    }

    async fn write(
        &self,
        _context: &RequestContext,
        space: &RwLock<AddressSpace>,
        nodes: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        super::nodes::refuse_writes(space, nodes);
        Ok(())
    }

    async fn call(
        &self,
        context: &RequestContext,
        space: &RwLock<AddressSpace>,
        methods: &mut [&mut &mut MethodCall],
    ) -> Result<(), StatusCode> {
        self.library.call(context, space, methods).await
    }
}
