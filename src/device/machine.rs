//! The two traits, and what both machines have in common.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::DeviceError;
use super::payload::{CorrectionMap, Measurement, Pass, PassRecord, Plan, Preliminary};
use super::words::{Armed, Identity, Job, Reconciled, Started, Status, Word};

/// What every machine of a cell can be asked, whatever its wire.
///
/// The commands come back when the machine has *acknowledged* them, with the status that says so; where they lead (HOLDING to HELD,
/// ABORTING to ABORTED) is seen by asking [`Machine::status`] again.
pub trait Machine: Send {
    /// The name by which messages call this machine, for example `cmm at 10.0.0.5:502, unit 1`.
    fn name(&self) -> &str;

    /// What a person should know of this machine now, beyond its status: what is waited for, which files were left alone and why.
    /// Nothing for a machine that tells everything by its status.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// Opens the wire and proves that the machine at its far end is the one that is meant, before anything is written to it.
    fn connect(&mut self) -> impl Future<Output = Result<Identity, DeviceError>> + Send;

    /// What the machine says of itself now. Asking also tells the machine that its client is alive, so ask twice a second or more.
    fn status(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Takes in what an interrupted run had prepared and may have started. For machines that keep no memory of their own: until somebody has
    /// told what became of it they are taken as ones that may move.
    fn restore(&mut self, _intended: &Armed) {}

    /// Makes this client the owner of the machine.
    fn claim(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Has the machine check its payloads and interlocks for a job. Nothing moves. Journal what comes back before giving it to
    /// [`Machine::start`].
    fn prepare(&mut self, job: Job) -> impl Future<Output = Result<Armed, DeviceError>> + Send;

    /// Begins the job, at most once. An `Armed` is used up by this, however it ends.
    ///
    /// * `Ok`: the machine says that this very START has begun the job.
    /// * [`DeviceError::Refused`]: the machine, or its state before anything was sent, said no; the job was not begun by it. Prepare anew.
    /// * [`DeviceError::StartUnknown`], or the future dropped: nobody knows. Only [`Machine::reconcile`] can tell what became of it.
    /// * Anything else comes from before the START: for an `Armed` that is used for the first time nothing was begun.
    fn start(&mut self, armed: Armed) -> impl Future<Output = Result<Started, DeviceError>> + Send;

    /// Stops at the next safe place, wheel or probe clear.
    fn hold(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Goes on after a hold.
    fn resume(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Ends the job in order, clear of the part.
    fn stop(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Ends at once; only the safe sequence is run. Needs no ownership.
    fn abort(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Leaves ABORTED or FAULTED for IDLE.
    fn clear(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Says that the result with this `done` number is safe with the client and may be forgotten.
    fn acknowledge(&mut self, done: u32) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Gives the machine back.
    fn release(&mut self) -> impl Future<Output = Result<Status, DeviceError>> + Send;

    /// Asks the machine what became of a start whose outcome is not known: after a lost connection, or after this client was restarted
    /// and has found the intent in its journal. Moves nothing. Takes a second or more when the answer is "not started", for that has to
    /// be seen twice.
    fn reconcile(&mut self, intended: &Armed) -> impl Future<Output = Result<Reconciled, DeviceError>> + Send;

    /// Takes a person's word about a machine that cannot tell itself; any other refuses. Returns what of it was kept, by its path in the
    /// folder of the run.
    fn confirm(&mut self, _word: Word) -> impl Future<Output = Result<Vec<String>, DeviceError>> + Send {
        let machine: Arc<str> = Arc::from(self.name());
        async move { Err(DeviceError::TellsItself { machine }) }
    }
}

/// A machine that measures.
pub trait Cmm: Machine {
    /// Carries the plan to the machine and proves that it is what the machine would use.
    fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt)
    -> impl Future<Output = Result<(), DeviceError>> + Send;

    /// Reads on a little in what the machine gives of the points of this job while it still runs, where it gives that. Ask after a look at
    /// the status, when nothing else is to be asked: it takes a moment, at most one step between two looks, and breaks off where the
    /// flag is raised. Returns the points that are new, if there are any; what goes wrong is seen by the next look.
    fn read_ahead(&mut self, _job: Job, _interrupt: &Interrupt) -> impl Future<Output = Option<Preliminary>> + Send {
        std::future::ready(None)
    }

    /// Fetches the points of this job, which has to be complete. Fetching twice gives the same, until it is acknowledged.
    fn collect(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<Measurement, DeviceError>> + Send;
}

/// A machine that grinds.
pub trait Grinder: Machine {
    /// Carries map and pass to the machine and proves that they are what the machine would use. The map is absolute: loading it twice
    /// changes nothing.
    fn load_pass(
        &mut self,
        map: &CorrectionMap,
        pass: &Pass,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<(), DeviceError>> + Send;

    /// Fetches the record of this job, which has to be complete. Fetching twice gives the same, until it is acknowledged.
    fn collect(
        &mut self,
        job: Job,
        interrupt: &Interrupt,
    ) -> impl Future<Output = Result<PassRecord, DeviceError>> + Send;
}

/// A flag that breaks off a long transfer between two requests, so that a hold or an abort can reach the wire at once.
///
/// Clones share the flag. The transfer answers [`DeviceError::Interrupted`] and can be begun again from its start; nothing moves by it.
#[derive(Debug, Clone, Default)]
pub struct Interrupt(Arc<AtomicBool>);

impl Interrupt {
    /// A flag that is not raised.
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks whoever looks at the flag to break off.
    pub fn raise(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Takes the flag down again.
    pub fn lower(&self) {
        self.0.store(false, Ordering::Release);
    }

    /// Whether the flag is up.
    pub fn is_raised(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}
