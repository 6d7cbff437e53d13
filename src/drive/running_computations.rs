//! Running computations of a run, and what they leave.

use std::collections::{BTreeMap, HashMap};

use tokio::task::JoinSet;

use super::blocking_executor::BlockingExecutor;
use super::computation::Computation;
use super::task::ComputationProduct;
use crate::cell::{Event, RecordFailure};
use crate::journal::Artefact;

/// Running computations of a run, and what they leave.
pub(super) struct Computations {
    pub(super) executor: BlockingExecutor,
    pub(super) running: JoinSet<ComputationResult>,
    /// Cycle and kind of each running computation.
    pub(super) kinds: HashMap<tokio::task::Id, (u32, Computation)>,
    /// Number of attempts of each computation of each cycle.
    pub(super) attempts: BTreeMap<(u32, Computation), u32>,
    /// Disk usage of the files of each cycle.
    pub(super) cycle_bytes: BTreeMap<u32, u64>,
    /// Maximum disk usage of a cycle.
    pub(super) max_cycle_bytes: u64,
}

impl Computations {
    /// Creates the computations of a run; none is running. `attempts` are those of an interrupted program.
    pub(super) fn new(executor: BlockingExecutor, attempts: BTreeMap<(u32, Computation), u32>) -> Self {
        let (running, kinds) = (JoinSet::new(), HashMap::new());
        Self { executor, running, kinds, attempts, cycle_bytes: BTreeMap::new(), max_cycle_bytes: 0 }
    }
}

/// Result of a computation.
pub(super) struct ComputationResult {
    pub(super) cycle: u32,
    /// `None` if no event follows.
    pub(super) event: Option<Event>,
    pub(super) product: ComputationProduct,
    /// Files that the computation created, written to the disk and read back.
    pub(super) files: Result<Vec<Artefact>, RecordFailure>,
}
