//! The traits of the two machines, and their common part.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::DeviceError;
use super::handshake::{Armed, Identity, Job, OperatorConfirmation, Reconciled, Started, Status};
use super::payload::{CorrectionMap, Measurement, Pass, PassRecord, Plan, PreliminaryPoints};
use regrind_formats::operator_step::OperatorStep;

/// Operations of every machine of a cell, whatever its wire.
///
/// A command returns when the machine has *acknowledged* it, with the status that shows this. The state that follows
/// (HOLDING to HELD, ABORTING to ABORTED) is seen by calling [`Machine::status`] again.
pub trait Machine: Send {
    /// Returns the name of this machine in messages, for example `cmm at 10.0.0.5:502, unit 1`.
    fn name(&self) -> &str;

    /// Returns lines of text for the operator that the status does not contain. Examples: which files the driver waits
    /// for, and which files it ignored and why. Returns an empty list if the status of the machine contains everything.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns the step that the machine asks of a person now, if a person operates it. [`Machine::notes`] contains the
    /// lines of this step. Returns `None` if a person has nothing to do.
    fn operator_step(&self) -> Option<OperatorStep> {
        None
    }

    /// Opens the connection to the machine and returns the identity that the machine reports. Checks the identity
    /// before any command or payload is written.
    ///
    /// # Errors
    /// The machine cannot be reached, or it is not the intended machine.
    fn connect(&mut self) -> impl Future<Output = Result<Identity, DeviceError>> + Send;

    /// Returns the present status of the machine. The request also shows the machine that its client is alive, so call
    /// it twice a second or more.
    fn status(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Restores the start `_intended` of an interrupted run, after a restart of this program. It is not known if the
    /// machine has begun this job. After the call, the machine counts as possibly moving until a person confirms the
    /// outcome.
    ///
    /// Does nothing by default. Only drivers of machines without a memory of jobs implement it.
    fn restore(&mut self, _intended: &Armed) {}

    /// Makes this client the owner of the machine. Returns the status with which the machine acknowledges this.
    fn claim(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Asks the machine to check the loaded payloads and its interlocks for `job`. Nothing moves. Returns an `Armed`:
    /// the checked job with the number of the START that would begin it. Write the `Armed` to the journal before you
    /// pass it to [`Machine::start`].
    fn prepare(&mut self, job: Job) -> impl Future<Output = Result<Armed, DeviceError>> + Send;

    /// Sends the START of a prepared job. The machine begins the job at most once. The call consumes `armed`, whatever
    /// the result. An earlier call with a copy of `armed` may already have begun the job.
    ///
    /// - `Ok`: the machine confirms that this START has begun the job.
    /// - [`DeviceError::Refused`]: the machine refused, or its state before anything was sent did not allow a start.
    ///   This START did not begin the job. Prepare again.
    /// - [`DeviceError::StartUnknown`], or the future was dropped: the outcome is unknown. Only [`Machine::reconcile`]
    ///   can determine it.
    /// - Any other error: this call has not sent the START. If no earlier call used a copy of `armed`, no job was
    ///   begun.
    fn start(&mut self, armed: Armed) -> impl Future<Output = Result<Started, DeviceError>> + Send;

    /// Commands the machine to pause the job at the next safe position, with the wheel or probe clear of the part.
    /// Returns the status with which the machine acknowledges the command. The machine may still be moving then: call
    /// [`Machine::status`] until the state is HELD.
    fn hold(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Continues the job after a hold. Returns the status with which the machine acknowledges the command.
    fn resume(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Commands the machine to end the job in an orderly way, with the wheel or probe clear of the part. Returns the
    /// status with which the machine acknowledges the command. The machine may still be moving then.
    fn stop(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Commands the machine to end the job at once. The machine then runs only its safe sequence. Any client may abort;
    /// it need not be the owner. Returns the status with which the machine acknowledges the command.
    fn abort(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Brings the machine from the state ABORTED or FAULTED back to IDLE. Returns the status with which the machine
    /// acknowledges the command.
    fn clear(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Reports to the machine that the client has stored the result of a job. The machine may then delete the result.
    /// `done` is the sequence number of the START that began this job; it is the value `done` in the [`Status`] of the
    /// machine. Returns the status with which the machine acknowledges the command.
    fn acknowledge(&mut self, done: u32) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Gives up the ownership of the machine, so that another client can claim it. Returns the status with which the
    /// machine acknowledges the command.
    fn release(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Determines the outcome of the start `intended` from the status of the machine. Use it after a lost connection,
    /// or after a restart of this client, if the journal contains the start but not its outcome. Moves nothing.
    ///
    /// Takes a second or more if the answer is "not started": two statuses, at least a second apart, must show this.
    fn reconcile(&mut self, intended: &Armed) -> impl Future<Output = Result<Reconciled, DeviceError>> + Send;

    /// Accepts `_word`, an operator confirmation of a fact that the machine cannot report itself, for example that a
    /// pass has begun. Returns the paths of the files that the driver stored for this confirmation, relative to the
    /// folder of the run. The list can be empty.
    ///
    /// # Errors
    /// Returns an error if no confirmation of this kind is expected in the current state. A machine that reports its
    /// own state always returns [`DeviceError::ConfirmationNotNeeded`].
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
    /// Transfers `plan` to the machine and checks that the machine will use it for the next job. If `interrupt` is
    /// raised, the transfer stops with [`DeviceError::Interrupted`] and must be repeated from its start.
    fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt)
    -> impl Future<Output = Result<(), DeviceError>> + Send;

    /// Reads some measured points of `_job` while the job still runs, and returns the new points. They are preliminary
    /// and serve only for display. Returns `None` if there are no new points, if the machine cannot report points
    /// early, or if the reading fails. The next call of [`Machine::status`] reports a lost machine.
    ///
    /// Call this function after [`Machine::status`], when no other request is necessary. Each call does only a short
    /// part of the transfer, so that the next status is not late. The transfer stops if `_interrupt` is raised.
    fn read_ahead(
        &mut self,
        _job: Job,
        _interrupt: &Interrupt,
    ) -> impl Future<Output = Option<PreliminaryPoints>> + Send {
        std::future::ready(None)
    }

    /// Fetches the measured points of `job`. Can be repeated: the result stays the same until it is acknowledged. If
    /// `interrupt` is raised, the transfer stops with [`DeviceError::Interrupted`].
    ///
    /// # Errors
    /// The job is not complete, or the transfer fails.
    fn collect(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<Measurement, DeviceError>> + Send;
}

/// Grinder.
pub trait Grinder: Machine {
    /// Transfers `map` and `pass` to the machine and checks that the machine will use both for the next job. The map is
    /// absolute: it replaces the previous map, so a second transfer of the same map changes nothing. If `interrupt` is
    /// raised, the transfer stops with [`DeviceError::Interrupted`] and must be repeated from its start.
    fn load_pass(
        &mut self,
        map: &CorrectionMap,
        pass: &Pass,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<(), DeviceError>> + Send;

    /// Fetches the record of the pass that `job` ground. Can be repeated: the result stays the same until it is
    /// acknowledged. If `interrupt` is raised, the transfer stops with [`DeviceError::Interrupted`].
    ///
    /// # Errors
    /// The job is not complete, or the transfer fails.
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
    /// Creates an interrupt flag that is not raised, so that transfers can run.
    pub fn new() -> Self {
        Self::default()
    }

    /// Raises the interrupt flag. Every transfer that uses this flag or a clone of it then stops.
    pub fn raise(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Lowers the interrupt flag, so that transfers can run again.
    pub fn lower(&self) {
        self.0.store(false, Ordering::Release);
    }

    /// Returns true if the interrupt flag is raised, which means that transfers must stop.
    pub fn is_raised(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}
