//! OPC UA nodes of a cell: those of PackML (OPC 30050) with its identifiers, and the figures in a namespace of their
//! own.
//!
//! ```text
//!  Objects / PackMLObjects / cell-1      PackMLBaseObjectType; notifies of events
//!      Status                            PackMLStatusObjectType: UnitModeCurrent, StateCurrent ...
//!      Admin                             PackMLAdminObjectType
//!      BaseStateMachine                  CurrentState, MachineState / CurrentState, ExecuteState / CurrentState
//!      Figures, Limits, Job, Alarms ...  a folder for each first word of a figure's name
//! ```
//!
//! A node with an unknown value has no value and the status BadNoData.

use std::sync::atomic::{AtomicU64, Ordering};

use async_trait::async_trait;
use opcua_core::sync::RwLock;
use opcua_nodes::{EventNotifier, ObjectBuilder, ObjectTypeBuilder, ReferenceDirection, VariableBuilder};
use opcua_server::SubscriptionCache;
use opcua_server::address_space::AddressSpace;
use opcua_server::diagnostics::NamespaceMetadata;
use opcua_server::node_manager::memory::{
    InMemoryNodeManager, InMemoryNodeManagerImpl, InMemoryNodeManagerImplBuilder,
};
use opcua_server::node_manager::{ParsedReadValueId, RequestContext, ServerContext, WriteNode};
use opcua_types::{
    DataTypeId, DataValue, DateTime, EUInformation, ExtensionObject, LocalizedText, NodeId, ObjectId, ObjectTypeId,
    QualifiedName, ReferenceTypeId, StatusCode, TimestampsToReturn, VariableTypeId, Variant,
};
use regrind_cell::StateName;

use super::events::{ALL, KINDS};
use crate::cell_status::TimedStatus;
use crate::figures::{FIGURES, Figure, FigureKind, FigureValue};
use crate::packml::state_number;

const PACKML: &str = "http://opcfoundation.org/UA/PackML/";
const OWN: &str = "urn:regrind:live";

/// Identifiers in the namespace of PackML.
mod packml {
    pub(super) const EXECUTE_STATE_MACHINE_TYPE: u32 = 1;
    pub(super) const MACHINE_STATE_MACHINE_TYPE: u32 = 2;
    pub(super) const BASE_STATE_MACHINE_TYPE: u32 = 3;
    pub(super) const STATUS_OBJECT_TYPE: u32 = 4;
    pub(super) const ADMIN_OBJECT_TYPE: u32 = 5;
    pub(super) const BASE_OBJECT_TYPE: u32 = 6;
    pub(super) const OBJECTS: u32 = 72;
    pub(super) const CLEARED: u32 = 5001;
    pub(super) const RUNNING: u32 = 75;
}

/// Number of the Cleared state in OPC 30050, in which nothing is aborted.
const CLEARED_NUMBER: u32 = 18;

/// Indices of the namespaces in the list of the server.
#[derive(Clone, Copy)]
pub(super) struct Namespaces {
    pub(super) packml: u16,
    pub(super) own: u16,
}

/// Builder of the nodes of a cell.
pub(super) struct CellNodesBuilder {
    pub(super) cell: String,
}

/// Nodes of a cell; clients cannot write them.
pub(super) struct CellNodes {
    pub(super) namespaces: Namespaces,
    metadata: Vec<NamespaceMetadata>,
    cell: String,
    /// Time of the last status of the cell, in milliseconds since 1970. The values of the nodes held at this time.
    confirmed_ms: AtomicU64,
}

impl CellNodes {
    pub(super) fn cell(&self) -> &str {
        &self.cell
    }

    pub(super) fn cell_node(&self) -> NodeId {
        cell_node(self.namespaces.own)
    }
}

/// Returns the node id of the object that represents the cell. `own` is the index of the cell's namespace.
pub(super) fn cell_node(own: u16) -> NodeId {
    NodeId::new(own, "Cell")
}

impl InMemoryNodeManagerImplBuilder for CellNodesBuilder {
    type Impl = CellNodes;

    fn build(self, context: ServerContext, space: &mut AddressSpace) -> CellNodes {
        let mut type_tree = context.type_tree.write();
        let mut add = |uri: &str| {
            let index = type_tree.namespaces_mut().add_namespace(uri);
            space.add_namespace(uri, index);
            index
        };
        let namespaces = Namespaces { packml: add(PACKML), own: add(OWN) };
        let metadata = [(PACKML, namespaces.packml), (OWN, namespaces.own)].map(|(uri, index)| NamespaceMetadata {
            namespace_uri: uri.to_owned(),
            namespace_index: index,
            is_namespace_subset: Some(uri == PACKML),
            ..NamespaceMetadata::default()
        });
        let mut tree = Tree { space, namespaces };
        tree.types();
        tree.objects(&self.cell);
        CellNodes { namespaces, metadata: metadata.into(), cell: self.cell, confirmed_ms: AtomicU64::new(0) }
    }
}

#[async_trait]
impl InMemoryNodeManagerImpl for CellNodes {
    async fn init(&self, _space: &mut AddressSpace, _context: ServerContext) {}

    fn name(&self) -> &str {
        "cell"
    }

    fn namespaces(&self) -> Vec<NamespaceMetadata> {
        self.metadata.clone()
    }

    /// Reads values. The server time of a value is the time at which the cell last confirmed the value, not only the time
    /// of its last change.
    async fn read_values(
        &self,
        context: &RequestContext,
        space: &RwLock<AddressSpace>,
        nodes: &[&ParsedReadValueId],
        max_age: f64,
        wanted: TimestampsToReturn,
    ) -> Vec<DataValue> {
        let space = space.read();
        let confirmed = time(self.confirmed_ms.load(Ordering::Relaxed));
        let confirmed = |value: DataValue| DataValue {
            server_timestamp: value.server_timestamp.map(|at| at.max(confirmed)),
            ..value
        };
        nodes.iter().map(|node| confirmed(space.read(context, node, max_age, wanted))).collect()
    }

    /// Refuses every write of a client: sets the status of each node of `nodes`. Always returns `Ok`.
    async fn write(
        &self,
        _context: &RequestContext,
        space: &RwLock<AddressSpace>,
        nodes: &mut [&mut WriteNode],
    ) -> Result<(), StatusCode> {
        refuse_writes(space, nodes);
        Ok(())
    }
}

/// Refuses to write: sets the status `BadNotWritable` for each node of `nodes` that is in `space`, and `BadNodeIdUnknown`
/// for every other.
pub(super) fn refuse_writes(space: &RwLock<AddressSpace>, nodes: &mut [&mut WriteNode]) {
    let space = space.read();
    for node in nodes {
        let exists = space.node_exists(&node.value().node_id);
        node.set_status(if exists { StatusCode::BadNotWritable } else { StatusCode::BadNodeIdUnknown });
    }
}

// ---- the tree -----------------------------------------------------------------------------------------------------------------------

struct Tree<'a> {
    space: &'a mut AddressSpace,
    namespaces: Namespaces,
}

impl Tree<'_> {
    fn packml(&self, identifier: u32) -> NodeId {
        NodeId::new(self.namespaces.packml, identifier)
    }

    fn own(&self, path: &str) -> NodeId {
        NodeId::new(self.namespaces.own, path)
    }

    /// Adds the object types of PackML (OPC 30050) and the event types of the cell to the address space. The PackML
    /// types have only their identifiers and names, without the members that the specification defines. The event types
    /// have all their fields.
    fn types(&mut self) {
        use packml::*;
        let machine: NodeId = ObjectTypeId::FiniteStateMachineType.into();
        let object: NodeId = ObjectTypeId::BaseObjectType.into();
        for (identifier, name, above) in [
            (EXECUTE_STATE_MACHINE_TYPE, "PackMLExecuteStateMachineType", &machine),
            (MACHINE_STATE_MACHINE_TYPE, "PackMLMachineStateMachineType", &machine),
            (BASE_STATE_MACHINE_TYPE, "PackMLBaseStateMachineType", &machine),
            (STATUS_OBJECT_TYPE, "PackMLStatusObjectType", &object),
            (ADMIN_OBJECT_TYPE, "PackMLAdminObjectType", &object),
            (BASE_OBJECT_TYPE, "PackMLBaseObjectType", &object),
        ] {
            let browse_name = QualifiedName::new(self.namespaces.packml, name);
            let builder = ObjectTypeBuilder::new(&self.packml(identifier), browse_name, name);
            builder.subtype_of(above.clone()).insert(self.space);
        }
        let all = self.own(ALL);
        ObjectTypeBuilder::new(&all, QualifiedName::new(self.namespaces.own, ALL), ALL)
            .is_abstract(true)
            .subtype_of(ObjectTypeId::BaseEventType)
            .insert(self.space);
        for kind in KINDS {
            let node = kind.node(self.namespaces.own);
            let browse_name = QualifiedName::new(self.namespaces.own, kind.name);
            let builder = ObjectTypeBuilder::new(&node, browse_name, kind.name);
            builder.subtype_of(all.clone()).insert(self.space);
            for (field, data_type) in kind.fields {
                let place = self.own(&format!("{}/{field}", kind.name));
                VariableBuilder::new(&place, QualifiedName::new(self.namespaces.own, *field), *field)
                    .data_type(*data_type)
                    .has_type_definition(VariableTypeId::PropertyType)
                    .has_modelling_rule(ObjectId::ModellingRule_Mandatory)
                    .property_of(node.clone())
                    .insert(self.space);
            }
        }
    }

    fn objects(&mut self, cell: &str) {
        let objects = self.packml(packml::OBJECTS);
        ObjectBuilder::new(&objects, QualifiedName::new(self.namespaces.packml, "PackMLObjects"), "PackMLObjects")
            .is_folder()
            .organized_by(ObjectId::ObjectsFolder)
            .insert(self.space);
        let root = cell_node(self.namespaces.own);
        let mut builder = ObjectBuilder::new(&root, QualifiedName::new(self.namespaces.own, cell), cell)
            .event_notifier(EventNotifier::SUBSCRIBE_TO_EVENTS)
            .has_type_definition(self.packml(packml::BASE_OBJECT_TYPE))
            .organized_by(objects);
        for kind in KINDS {
            builder = builder.reference(
                kind.node(self.namespaces.own),
                ReferenceTypeId::GeneratesEvent,
                ReferenceDirection::Forward,
            );
        }
        builder.insert(self.space);
        self.object("Status", "Status", &root, packml::STATUS_OBJECT_TYPE);
        self.object("Admin", "Admin", &root, packml::ADMIN_OBJECT_TYPE);
        self.state_machines(&root);
        for figure in FIGURES {
            self.figure(figure, &root);
        }
        // Nodes that the specification requires and no cell has; they never get a value.
        let status = self.own("Status");
        for (name, kind) in [
            ("CurMachSpeed", DataTypeId::Float),
            ("MachSpeed", DataTypeId::Float),
            ("EquipmentBlocked", DataTypeId::Boolean),
            ("EquipmentStarved", DataTypeId::Boolean),
        ] {
            self.variable(&format!("Status/{name}"), (self.namespaces.packml, name), kind, &status);
        }
    }

    fn object(&mut self, path: &str, name: &str, above: &NodeId, of_type: u32) {
        let of_type = self.packml(of_type);
        ObjectBuilder::new(&self.own(path), QualifiedName::new(self.namespaces.packml, name), name)
            .has_type_definition(of_type)
            .component_of(above.clone())
            .insert(self.space);
    }

    /// Adds the three state machines of PackML below the node `root`. They are nested: `BaseStateMachine` contains
    /// `MachineState`, and `MachineState` contains `ExecuteState`. Each gets a node for its current state, without a
    /// value.
    fn state_machines(&mut self, root: &NodeId) {
        let mut above = root.clone();
        for machine in MACHINES {
            let name = machine.path.rsplit('/').next().unwrap_or(machine.path);
            self.object(machine.path, name, &above, machine.of_type);
            above = self.own(machine.path);
            let state = format!("{}/CurrentState", machine.path);
            let node = self.own(&state);
            VariableBuilder::new(&node, QualifiedName::new(0, "CurrentState"), "CurrentState")
                .data_type(DataTypeId::LocalizedText)
                .value(Variant::Empty)
                .has_type_definition(VariableTypeId::FiniteStateVariableType)
                .component_of(above.clone())
                .insert(self.space);
            for (name, kind) in [("Id", DataTypeId::NodeId), ("Number", DataTypeId::UInt32)] {
                self.property(&format!("{state}/{name}"), name, kind, Variant::Empty, &node);
            }
        }
    }

    fn figure(&mut self, figure: &Figure, root: &NodeId) {
        let (folder, name) = figure.name.rsplit_once('/').map_or(("", figure.name), |(folder, name)| (folder, name));
        let above = if folder.is_empty() { root.clone() } else { self.own(folder) };
        if !self.space.node_exists(&above) {
            ObjectBuilder::new(&above, QualifiedName::new(self.namespaces.own, folder), folder)
                .has_type_definition(ObjectTypeId::FolderType)
                .component_of(root.clone())
                .insert(self.space);
        }
        // A node that PackML defines has its name in the namespace of PackML.
        let of_packml = figure.name == "Status/UnitModeCurrent";
        let namespace = if of_packml { self.namespaces.packml } else { self.namespaces.own };
        let node = self.variable(figure.name, (namespace, name), kind_of(figure), &above);
        if let Some(unit) = figure.unit {
            let value = Variant::from(ExtensionObject::from_message(unit_of(unit)));
            let place = format!("{}/EngineeringUnits", figure.name);
            self.property(&place, "EngineeringUnits", DataTypeId::EUInformation, value, &node);
        }
    }

    fn variable(&mut self, path: &str, name: (u16, &str), kind: DataTypeId, above: &NodeId) -> NodeId {
        let node = self.own(path);
        let about = FIGURES.iter().find(|figure| figure.name == path).map_or("", |figure| figure.about);
        VariableBuilder::new(&node, QualifiedName::new(name.0, name.1), name.1)
            .description(LocalizedText::new("en", about))
            .data_type(kind)
            .value(Variant::Empty)
            .has_type_definition(VariableTypeId::BaseDataVariableType)
            .component_of(above.clone())
            .insert(self.space);
        if let Some(opcua_nodes::NodeType::Variable(variable)) = self.space.find_mut(&node) {
            variable.set_data_value(unknown(DateTime::now()));
        }
        node
    }

    fn property(&mut self, path: &str, name: &str, kind: DataTypeId, value: Variant, above: &NodeId) {
        VariableBuilder::new(&self.own(path), QualifiedName::new(0, name), name)
            .data_type(kind)
            .value(value)
            .has_type_definition(VariableTypeId::PropertyType)
            .property_of(above.clone())
            .insert(self.space);
    }
}

fn kind_of(figure: &Figure) -> DataTypeId {
    match figure.kind {
        FigureKind::Whole => DataTypeId::UInt32,
        FigureKind::Number => DataTypeId::Double,
        FigureKind::Truth => DataTypeId::Boolean,
        FigureKind::Text => DataTypeId::String,
    }
}

/// Returns the OPC UA description of the unit `unit`. Known units are `um`, `s` and `%`. The unit id in the description
/// is a number: its bytes are the characters of the common code of the unit in UNECE Recommendation 20, such as `SEC`
/// for the second. Any other unit gets the id 0 and an empty description.
fn unit_of(unit: &str) -> EUInformation {
    let (code, name) = match unit {
        "um" => ("4H", "micrometre"),
        "s" => ("SEC", "second"),
        "%" => ("P1", "per cent"),
        _ => ("", ""),
    };
    EUInformation {
        namespace_uri: "http://www.opcfoundation.org/UA/units/un/cefact".into(),
        unit_id: code.bytes().fold(0, |number, byte| 256 * number + i32::from(byte)),
        display_name: unit.into(),
        description: name.into(),
    }
}

// ---- values -------------------------------------------------------------------------------------------------------------------------

/// Writes the values of the cell status `now` to `shown`, the OPC UA nodes of the cell. Writes only values that differ
/// from those of `before`, the last published status. If `before` is `None`, writes all values. `subscriptions`
/// notifies the clients of the changes.
pub(super) fn set(
    shown: &InMemoryNodeManager<CellNodes>,
    subscriptions: &SubscriptionCache,
    before: Option<&TimedStatus>,
    now: &TimedStatus,
) {
    let TimedStatus { status, at_ms } = now;
    let namespaces = shown.inner().namespaces;
    let known = |value: Option<Variant>, then| value.map_or_else(|| unknown(then), |value| good(value, then));
    let mut values = Vec::new();
    for figure in FIGURES {
        let value = figure.value(status);
        if before.is_none_or(|before| figure.value(&before.status) != value) {
            let ended_ms =
                status.last_run.as_ref().filter(|_| figure.name.starts_with("Last Run/")).map(|run| run.ended_ms);
            let then = time(ended_ms.unwrap_or(*at_ms));
            let value = DataValue { server_timestamp: Some(time(*at_ms)), ..known(value.map(variant), then) };
            values.push((NodeId::new(namespaces.own, figure.name), value));
        }
    }
    if before.is_none_or(|before| before.status.state() != status.state()) {
        for (path, value) in states(status.state(), namespaces.packml) {
            values.push((NodeId::new(namespaces.own, path), known(value, time(*at_ms))));
        }
    }
    let all = values.iter().map(|(node, value)| (node, None, value.clone()));
    // All these nodes were created with the tree, so this cannot fail.
    let _ = shown.set_values(subscriptions, all);
    shown.inner().confirmed_ms.fetch_max(*at_ms, Ordering::Relaxed);
}

/// Returns the time `ms`, in milliseconds since 1970 in UTC, for OPC UA.
pub(super) fn time(ms: u64) -> DateTime {
    const BETWEEN_1601_AND_1970_MS: i64 = 11_644_473_600_000;
    let since_1601_ms = i64::try_from(ms).unwrap_or(i64::MAX).saturating_add(BETWEEN_1601_AND_1970_MS);
    DateTime::from(since_1601_ms.saturating_mul(10_000))
}

fn variant(value: FigureValue) -> Variant {
    match value {
        FigureValue::Whole(value) => value.into(),
        FigureValue::Number(value) => value.into(),
        FigureValue::Truth(value) => value.into(),
        FigureValue::Text(value) => value.into(),
    }
}

/// Returns the known value `value`, which holds since `then`.
pub(super) fn good(value: Variant, then: DateTime) -> DataValue {
    DataValue {
        value: Some(value),
        status: Some(StatusCode::Good),
        source_timestamp: Some(then),
        server_timestamp: Some(then),
        ..DataValue::default()
    }
}

fn unknown(then: DateTime) -> DataValue {
    DataValue { status: Some(StatusCode::BadNoData), ..good(Variant::Empty, then) }
}

/// One of the three state machines of OPC 30050.
struct Machine {
    path: &'static str,
    of_type: u32,
}

const MACHINES: [Machine; 3] = [
    Machine { path: "BaseStateMachine", of_type: packml::BASE_STATE_MACHINE_TYPE },
    Machine { path: "BaseStateMachine/MachineState", of_type: packml::MACHINE_STATE_MACHINE_TYPE },
    Machine { path: "BaseStateMachine/MachineState/ExecuteState", of_type: packml::EXECUTE_STATE_MACHINE_TYPE },
];

/// Returns the values of the `CurrentState` nodes of the three nested PackML state machines, as pairs of node path and
/// value. `state` is the state of the cell, `None` if it is unknown. `packml` is the index of the PackML namespace.
///
/// Each machine has three values: the name, the node id and the number of the state that this machine is in. All three
/// are `None` if the machine is not active while the cell is in `state`, or if `state` is `None`. Only the number is
/// `None` for the state `Running`, which has no number.
fn states(state: Option<StateName>, packml: u16) -> Vec<(String, Option<Variant>)> {
    let own = state.map(|state| (state.to_string(), identifier(state), Some(state_number(state))));
    let cleared = Some(("Cleared".to_owned(), packml::CLEARED, Some(CLEARED_NUMBER)));
    let running = Some(("Running".to_owned(), packml::RUNNING, None));
    let current = match state {
        None => [None, None, None],
        Some(StateName::Aborting | StateName::Aborted) => [own, None, None],
        Some(StateName::Stopping | StateName::Stopped) => [cleared, own, None],
        Some(_) => [cleared, running, own],
    };
    let mut values = Vec::new();
    for (machine, current) in MACHINES.iter().zip(current) {
        let (name, node, number) =
            current.map_or((None, None, None), |(name, node, number)| (Some(name), Some(node), number));
        let place = format!("{}/CurrentState", machine.path);
        let node = node.map(|node| NodeId::new(packml, node).into());
        values.push((format!("{place}/Id"), node));
        values.push((format!("{place}/Number"), number.map(Variant::from)));
        values.push((place, name.map(|name| LocalizedText::new("en", &name).into())));
    }
    values
}

/// Returns the identifier of a state's node in the OPC UA namespace of PackML (OPC 30050).
fn identifier(state: StateName) -> u32 {
    match state {
        StateName::Idle => 28,
        StateName::Starting => 29,
        StateName::Suspending => 30,
        StateName::Suspended => 31,
        StateName::Unsuspending => 32,
        StateName::Holding => 33,
        StateName::Held => 34,
        StateName::Unholding => 35,
        StateName::Execute => 36,
        StateName::Completing => 37,
        StateName::Complete => 38,
        StateName::Stopped => 53,
        StateName::Stopping => 54,
        StateName::Aborting => 61,
        StateName::Aborted => 62,
    }
}
