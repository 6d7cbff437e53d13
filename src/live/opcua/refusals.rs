//! Refused requests of OPC UA clients. The server refuses each wish to write, call, add or delete something, also if the
//! node does not exist. Each refusal is reported.

use std::sync::Arc;

use async_trait::async_trait;
use opcua_nodes::DefaultTypeTree;
use opcua_server::CreateMonitoredItem;
use opcua_server::diagnostics::NamespaceMetadata;
use opcua_server::node_manager::{
    AddNodeItem, AddReferenceItem, BrowseNode, BrowsePathItem, DeleteNodeItem, DeleteReferenceItem, DynNodeManager,
    ExternalReferenceRequest, HistoryNode, HistoryUpdateNode, MethodCall, MonitoredItemRef, MonitoredItemUpdateRef,
    NodeManager, QueryRequest, ReadNode, RegisterNodeItem, RequestContext, ServerContext, WriteNode,
};
use opcua_types::{
    ExpandedNodeId, MonitoringMode, NodeId, ReadAnnotationDataDetails, ReadAtTimeDetails, ReadEventDetails,
    ReadProcessedDetails, ReadRawModifiedDetails, StatusCode, TimestampsToReturn, Variant,
};

use crate::publisher_event::EventSender;

/// Nodes of another node manager, or of none. Reports each request to change or call something that was refused.
pub(super) struct Reported {
    pub(super) nodes: Arc<DynNodeManager>,
    pub(super) notes: EventSender,
}

impl Reported {
    fn refused(&self, context: &RequestContext, what: &str) {
        let by = {
            let session = context.session().read();
            let uri = &session.application_description().application_uri;
            format!("the OPC UA client {} ({uri})", session.session_name())
        };
        self.notes.refused(by, what);
    }
}

fn in_words(value: &Variant) -> String {
    value.to_string()
}

#[async_trait]
impl NodeManager for Reported {
    fn owns_node(&self, id: &NodeId) -> bool {
        self.nodes.owns_node(id)
    }

    fn name(&self) -> &str {
        self.nodes.name()
    }

    fn owns_server_events(&self) -> bool {
        self.nodes.owns_server_events()
    }

    fn handle_new_node(&self, parent_id: &ExpandedNodeId) -> bool {
        self.nodes.owns_node(&parent_id.node_id)
    }

    fn namespaces_for_user(&self, context: &RequestContext) -> Vec<NamespaceMetadata> {
        self.nodes.namespaces_for_user(context)
    }

    async fn init(&self, type_tree: &mut DefaultTypeTree, context: ServerContext) {
        self.nodes.init(type_tree, context).await;
    }

    async fn resolve_external_references(&self, context: &RequestContext, items: &mut [&mut ExternalReferenceRequest]) {
        self.nodes.resolve_external_references(context, items).await;
    }

    async fn read(
        &self,
        context: &RequestContext,
        max_age: f64,
        wanted: TimestampsToReturn,
        nodes: &mut [&mut ReadNode],
    ) -> Result<(), StatusCode> {
        self.nodes.read(context, max_age, wanted, nodes).await
    }

    async fn history_read_raw_modified(
        &self,
        context: &RequestContext,
        details: &ReadRawModifiedDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.nodes.history_read_raw_modified(context, details, nodes, wanted).await
    }

    async fn history_read_processed(
        &self,
        context: &RequestContext,
        details: &ReadProcessedDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.nodes.history_read_processed(context, details, nodes, wanted).await
    }

    async fn history_read_at_time(
        &self,
        context: &RequestContext,
        details: &ReadAtTimeDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.nodes.history_read_at_time(context, details, nodes, wanted).await
    }

    async fn history_read_events(
        &self,
        context: &RequestContext,
        details: &ReadEventDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.nodes.history_read_events(context, details, nodes, wanted).await
    }

    async fn history_read_annotations(
        &self,
        context: &RequestContext,
        details: &ReadAnnotationDataDetails,
        nodes: &mut [&mut HistoryNode],
        wanted: TimestampsToReturn,
    ) -> Result<(), StatusCode> {
        self.nodes.history_read_annotations(context, details, nodes, wanted).await
    }

    /// Refuses every write. A node that exists is not writable, and another one is unknown.
    async fn write(&self, context: &RequestContext, nodes: &mut [&mut WriteNode]) -> Result<(), StatusCode> {
        if let Err(reason) = self.nodes.write(context, nodes).await {
            let reason = if reason == StatusCode::BadServiceUnsupported { StatusCode::BadNotWritable } else { reason };
            nodes.iter_mut().for_each(|node| node.set_status(reason));
        }
        for node in nodes.iter().filter(|node| !node.status().is_good()) {
            let wanted = node.value();
            let value = wanted.value.value.as_ref().map_or_else(|| "nothing".to_owned(), in_words);
            self.refused(context, &format!("write: {} = {value}", wanted.node_id));
        }
        Ok(())
    }

    async fn history_update(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut HistoryUpdateNode],
    ) -> Result<(), StatusCode> {
        let done = self.nodes.history_update(context, nodes).await;
        for node in nodes.iter().filter(|node| done.is_err() || !node.status().is_good()) {
            self.refused(context, &format!("change of the history of {}", node.details().node_id()));
        }
        done
    }

    async fn browse(&self, context: &RequestContext, nodes: &mut [BrowseNode]) -> Result<(), StatusCode> {
        self.nodes.browse(context, nodes).await
    }

    async fn translate_browse_paths_to_node_ids(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut BrowsePathItem],
    ) -> Result<(), StatusCode> {
        self.nodes.translate_browse_paths_to_node_ids(context, nodes).await
    }

    async fn register_nodes(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut RegisterNodeItem],
    ) -> Result<(), StatusCode> {
        self.nodes.register_nodes(context, nodes).await
    }

    async fn unregister_nodes(&self, context: &RequestContext, nodes: &[&NodeId]) -> Result<(), StatusCode> {
        self.nodes.unregister_nodes(context, nodes).await
    }

    async fn create_monitored_items(
        &self,
        context: &RequestContext,
        items: &mut [&mut CreateMonitoredItem],
    ) -> Result<(), StatusCode> {
        self.nodes.create_monitored_items(context, items).await
    }

    async fn modify_monitored_items(&self, context: &RequestContext, items: &[&MonitoredItemUpdateRef]) {
        self.nodes.modify_monitored_items(context, items).await;
    }

    async fn set_monitoring_mode(&self, context: &RequestContext, mode: MonitoringMode, items: &[&MonitoredItemRef]) {
        self.nodes.set_monitoring_mode(context, mode, items).await;
    }

    async fn delete_monitored_items(&self, context: &RequestContext, items: &[&MonitoredItemRef]) {
        self.nodes.delete_monitored_items(context, items).await;
    }

    async fn query(&self, context: &RequestContext, request: &mut QueryRequest) -> Result<(), StatusCode> {
        self.nodes.query(context, request).await
    }

    /// Calls the methods that the standard requires of a server: they concern only the subscriptions of the client.
    /// Refuses and reports every other call.
    async fn call(&self, context: &RequestContext, calls: &mut [&mut MethodCall]) -> Result<(), StatusCode> {
        if self.nodes.call(context, calls).await.is_err() {
            calls.iter_mut().for_each(|call| call.set_status(StatusCode::BadMethodInvalid));
        }
        for call in calls.iter().filter(|call| !call.status().is_good()) {
            let arguments: Vec<_> = call.arguments().iter().map(in_words).collect();
            let arguments = arguments.join(", ");
            self.refused(context, &format!("call: {} of {} ({arguments})", call.method_id(), call.object_id()));
        }
        Ok(())
    }

    async fn add_nodes(&self, context: &RequestContext, nodes: &mut [&mut AddNodeItem]) -> Result<(), StatusCode> {
        let done = self.nodes.add_nodes(context, nodes).await;
        for node in nodes.iter().filter(|node| done.is_err() || !node.status().is_good()) {
            self.refused(
                context,
                &format!("new node: {} below {}", node.browse_name().name, node.parent_node_id().node_id),
            );
        }
        done
    }

    async fn add_references(
        &self,
        context: &RequestContext,
        references: &mut [&mut AddReferenceItem],
    ) -> Result<(), StatusCode> {
        let done = self.nodes.add_references(context, references).await;
        for item in references.iter().filter(|item| done.is_err() || !item.source_status().is_good()) {
            let (from, to) = (item.source_node_id(), &item.target_node_id().node_id);
            self.refused(context, &format!("new reference: from {from} to {to}"));
        }
        done
    }

    async fn delete_nodes(
        &self,
        context: &RequestContext,
        nodes: &mut [&mut DeleteNodeItem],
    ) -> Result<(), StatusCode> {
        let done = self.nodes.delete_nodes(context, nodes).await;
        for node in nodes.iter().filter(|node| done.is_err() || !node.status().is_good()) {
            self.refused(context, &format!("deletion of the node {}", node.node_id()));
        }
        done
    }

    async fn delete_node_references(&self, context: &RequestContext, to_delete: &[&DeleteNodeItem]) {
        self.nodes.delete_node_references(context, to_delete).await;
    }

    async fn delete_references(
        &self,
        context: &RequestContext,
        references: &mut [&mut DeleteReferenceItem],
    ) -> Result<(), StatusCode> {
        let done = self.nodes.delete_references(context, references).await;
        for item in references.iter().filter(|item| done.is_err() || !item.source_status().is_good()) {
            let (from, to) = (item.source_node_id(), &item.target_node_id().node_id);
            self.refused(context, &format!("deletion of the reference from {from} to {to}"));
        }
        done
    }
}

/// Nodes of namespaces that the server does not have: there are none.
pub(super) struct NoNodes {
    /// Number of the namespaces that the server has.
    pub(super) namespaces: u16,
}

#[async_trait]
impl NodeManager for NoNodes {
    fn owns_node(&self, id: &NodeId) -> bool {
        id.namespace >= self.namespaces
    }

    fn name(&self) -> &str {
        "none"
    }

    fn namespaces_for_user(&self, _context: &RequestContext) -> Vec<NamespaceMetadata> {
        Vec::new()
    }

    async fn init(&self, _type_tree: &mut DefaultTypeTree, _context: ServerContext) {}

    // Each item keeps the status that it has without a node manager: that its node is unknown.

    async fn read(
        &self,
        _context: &RequestContext,
        _max_age: f64,
        _wanted: TimestampsToReturn,
        _nodes: &mut [&mut ReadNode],
    ) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn write(&self, _context: &RequestContext, _nodes: &mut [&mut WriteNode]) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn browse(&self, _context: &RequestContext, _nodes: &mut [BrowseNode]) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn translate_browse_paths_to_node_ids(
        &self,
        _context: &RequestContext,
        _nodes: &mut [&mut BrowsePathItem],
    ) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn register_nodes(
        &self,
        _context: &RequestContext,
        _nodes: &mut [&mut RegisterNodeItem],
    ) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn create_monitored_items(
        &self,
        _context: &RequestContext,
        _items: &mut [&mut CreateMonitoredItem],
    ) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn query(&self, _context: &RequestContext, _request: &mut QueryRequest) -> Result<(), StatusCode> {
        Ok(())
    }

    async fn call(&self, _context: &RequestContext, _calls: &mut [&mut MethodCall]) -> Result<(), StatusCode> {
        Ok(())
    }
}
