//! The traits of the two machines, and their common part.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::DeviceError;
use super::handshake::{Armed, Identity, Job, OperatorConfirmation, Reconciled, Started, Status};
use super::payload::{CorrectionMap, Measurement, Pass, PassRecord, Plan, PreliminaryPoints};

/// Operations of every machine of a cell, whatever its wire.
///
/// A command returns when the machine has *acknowledged* it, with the status that shows this. The state that follows
/// (HOLDING to HELD, ABORTING to ABORTED) is seen by calling [`Machine::status`] again.
pub trait Machine: Send {
    /// Returns the name of this machine in messages, for example `cmm at 10.0.0.5:502, unit 1`.
    fn name(&self) -> &str;

    /// Returns notes for a person in addition to the status: which files are awaited, which files were ignored and why.
    /// Empty for a machine that reports everything in its status.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Opens the connection to the machine. Proves that the machine at its other end is the intended one, before
    /// anything is written to it.
    fn connect(&mut self) -> impl Future<Output = Result<Identity, DeviceError>> + Send;

    /// Returns the present status of the machine. The request also shows the machine that its client is alive, so call
    /// it twice a second or more.
    fn status(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Restores a start that an interrupted run had prepared and possibly sent. Implemented for machines without a
    /// memory of jobs: such a machine counts as possibly moving until a person confirms the outcome.
    fn restore(&mut self, _intended: &Armed) {}

    /// Makes this client the owner of the machine.
    fn claim(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Lets the machine check its payloads and interlocks for a job. Nothing moves. Journal the returned `Armed` before
    /// you pass it to [`Machine::start`].
    fn prepare(&mut self, job: Job) -> impl Future<Output = Result<Armed, DeviceError>> + Send;

    /// Begins the job, at most once. The call uses the `Armed` up, whatever its result.
    ///
    /// * `Ok`: the machine confirms that this START has begun the job.
    /// * [`DeviceError::Refused`]: the machine refused, or its state before anything was sent did not allow a start.
    ///   This START did not begin the job. Prepare again.
    /// * [`DeviceError::StartUnknown`], or the future was dropped: the outcome is unknown. Only [`Machine::reconcile`]
    ///   can determine it.
    /// * Any other error occurs before the START is sent: if the `Armed` is used for the first time, nothing was begun.
    fn start(&mut self, armed: Armed) -> impl Future<Output = Result<Started, DeviceError>> + Send;

    /// Holds the job at the next safe position, with the wheel or probe clear of the part.
    fn hold(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Continues after a hold.
    fn resume(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Ends the job in order, clear of the part.
    fn stop(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Ends the job at once; only the safe sequence runs. Needs no ownership.
    fn abort(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Leaves ABORTED or FAULTED for IDLE.
    fn clear(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Reports to the machine that the client has stored the result with this `done` number, so that the machine may
    /// forget it.
    fn acknowledge(&mut self, done: u32) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Gives up the ownership of the machine.
    fn release(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Asks the machine for the outcome of a start that is unknown: after a lost connection, or after a restart of this
    /// client that found the start in its journal. Moves nothing. Takes a second or more if the answer is "not
    /// started", because that must be seen twice.
    fn reconcile(&mut self, intended: &Armed) -> impl Future<Output = Result<Reconciled, DeviceError>> + Send;

    /// Accepts an operator confirmation for a machine that cannot report the fact itself. Every other machine refuses.
    /// Returns the paths of the files that were kept, relative to the folder of the run.
    fn confirm(
        &mut self,
        _word: OperatorConfirmation,
    ) -> impl Future<Output = Result<Vec<String>, DeviceError>> + Send {
        let machine: Arc<str> = Arc::from(self.name());
        async move { Err(DeviceError::ConfirmationNotNeeded { machine }) }
    }
}

/// Measuring machine.
pub trait Cmm: Machine {
    /// Transfers the plan to the machine and proves that the machine would use it.
    fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt)
    -> impl Future<Output = Result<(), DeviceError>> + Send;

    /// Reads a few preliminary points of this job while it still runs, if the machine offers them. Call it after a
    /// status, when no other request is due. It is short: it does at most one step between two calls of the status, and
    /// stops if `_interrupt` is raised. Returns the new points, or `None` if there are none. Hides an error, because
    /// the next status returns it.
    fn read_ahead(
        &mut self,
        _job: Job,
        _interrupt: &Interrupt,
    ) -> impl Future<Output = Option<PreliminaryPoints>> + Send {
        std::future::ready(None)
    }

    /// Fetches the points of this job, which must be complete. Idempotent until the result is acknowledged.
    fn collect(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<Measurement, DeviceError>> + Send;
}

/// Grinder.
pub trait Grinder: Machine {
    /// Transfers map and pass to the machine and proves that the machine would use them. The map is absolute: loading
    /// it twice changes nothing.
    fn load_pass(
        &mut self,
        map: &CorrectionMap,
        pass: &Pass,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<(), DeviceError>> + Send;

    /// Fetches the record of this job, which must be complete. Idempotent until the result is acknowledged.
    fn collect(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<PassRecord, DeviceError>> + Send;
}

/// Flag that interrupts a long transfer between two requests, so that a hold or an abort can be sent at once.
///
/// Clones share the flag. The transfer returns [`DeviceError::Interrupted`] and can be repeated from its start. The
/// flag moves nothing.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// Creates a flag that is not raised.
    pub fn new() -> Self {
        Self::default()
    }

    /// Raises the flag: every transfer that checks it stops.
    pub fn raise(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Lowers the flag.
    pub fn lower(&self) {
        self.0.store(false, Ordering::Release);
    }

    /// Returns true if the flag is raised.
    pub fn is_raised(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}
