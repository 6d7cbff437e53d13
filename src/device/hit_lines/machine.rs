//! The measuring machine that prints hits, as the cell sees it. This driver writes a list of targets; a person, or the
//! machine's own part program, leads the probe by it; the driver receives the lines.
//!
//! ```text
//!  START    the list exists, and lines are accepted                                                   -> EXECUTE
//!  EXECUTE  every target touched, and `done` confirmed (or the time in the cell file is over)         -> COMPLETE
//!           a refused line, HOLD, a lost line -> HOLDING;  `still` -> HELD;  RESUME -> EXECUTE
//!  STOP and ABORT: the person is asked too
//! ```

use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use data_encoding::HEXLOWER;

use super::job::{MeasurementSession, RequestedMeasurement, locked};
use super::link::Listener;
use super::settings::HitLinesSettings;
use super::target_list::TargetList;
use crate::error::{DeviceError, DeviceResult};
use crate::file_exchange::plan_csv;
use crate::handshake::{
    Answer, Armed, BatchId, Identity, Job, MachineCommand, MachineKind, MachineState, OperatorConfirmation, Outcome,
    Reconciled, Started, Status, digest,
};
use crate::job_memory::JobMemory;
use crate::machine::{Cmm, Interrupt, Machine};
use crate::payload::{Identified, Measurement, Plan, PreliminaryPoints};
use regrind_formats::operator_step::{OperatorAction, OperatorStep, RequiredPoints, StepConfirmation, run_argument};
use regrind_formats::run_files::{self, CycleFolder};
use regrind_formats::{FormatError, JsonlAppender, ResultFolder, write_atomic};

/// Measuring machine that prints a line for each hit.
#[derive(Debug)]
pub struct HitLinesCmm {
    name: Arc<str>,
    settings: HitLinesSettings,
    session: Arc<Mutex<MeasurementSession>>,
    listener: Option<Listener>,
    memory: JobMemory<Plan>,
}

impl HitLinesCmm {
    /// Creates the driver of a machine. It does not listen yet.
    pub fn new(settings: HitLinesSettings) -> Self {
        let session = Arc::new(Mutex::new(MeasurementSession::new(settings.line_rules())));
        let name = format!("cmm by hit lines, {}", settings.source).into();
        Self { name, settings, session, listener: None, memory: JobMemory::new() }
    }

    fn current_status(&self) -> DeviceResult<Status> {
        let mut session = locked(&self.session);
        if let Some(error) = &session.link_error {
            return Err(error.clone());
        }
        if self.listener.is_none() {
            return Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), operation: "its status" });
        }
        session.finish_if_clear(self.settings.clear_after);
        Ok(status_of(&session))
    }

    fn refused(&self, command: MachineCommand, answer: Answer) -> DeviceError {
        let state = locked(&self.session).state;
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state }
    }

    fn not_accepted(&self, reason: impl ToString) -> DeviceError {
        DeviceError::NotAccepted { machine: Arc::clone(&self.name), reason: reason.to_string() }
    }

    /// Changes the state of the machine from one of the states in `from` to `to`. Returns the new status. `command` is
    /// the command of the client that causes the change; the error names this command.
    ///
    /// # Errors
    /// Returns the refusal [`Answer::WrongState`] if the current state is not in `from`. The state then does not
    /// change.
    fn transition(&self, command: MachineCommand, from: &[MachineState], to: MachineState) -> DeviceResult<Status> {
        let mut session = locked(&self.session);
        if !from.contains(&session.state) {
            drop(session);
            return Err(self.refused(command, Answer::WrongState));
        }
        session.state = to;
        Ok(status_of(&session))
    }

    /// Returns the step that the machine asks of a person now. `session` is the current measurement session. Returns
    /// `None` if no measurement is requested, or if there is nothing to do.
    fn step(&self, session: &MeasurementSession) -> Option<OperatorStep> {
        let asked = session.measurement.as_ref()?;
        let remaining = Some(session.remaining_targets());
        // After a pause, the machine ends by itself.
        let done = self.settings.clear_after.is_none().then_some(StepConfirmation::Done);
        let (action, confirmation) = match session.state {
            MachineState::Execute if asked.list.is_complete() => (OperatorAction::MoveProbeClear, Some(done?)),
            MachineState::Execute => (self.measure(session, asked), done),
            MachineState::Holding => (OperatorAction::Hold { remaining }, Some(StepConfirmation::Still)),
            MachineState::Stopping => (OperatorAction::Stop { remaining }, Some(StepConfirmation::Still)),
            MachineState::Aborting => (OperatorAction::Abort, None),
            _ => return None,
        };
        Some(OperatorStep { action, confirmation, named_map: None })
    }

    fn measure(&self, session: &MeasurementSession, asked: &RequestedMeasurement) -> OperatorAction {
        let points = match (self.settings.min_free_points, asked.list.progress().1) {
            (Some(least), _) => RequiredPoints::AtLeast(least),
            (None, count) => RequiredPoints::Listed {
                count: count.unwrap_or_default(),
                file: self.settings.run_folder.join(plan_file(asked.job)),
            },
        };
        OperatorAction::Measure {
            part: self.settings.part.clone(),
            cycle: asked.job.batch_id().to_string(),
            points,
            plan: Some(session.plan_digits()),
            probe_radius_mm: None,
        }
    }

    /// Ends the measurement of the session `session` with the outcome COMPLETE, after a person has confirmed its end.
    /// Returns the paths of the two stored files, relative to the folder of the run: the list of targets and the
    /// received lines.
    ///
    /// # Errors
    /// Returns the reason as text if no measurement is requested, if no point arrived, or if fewer points arrived than
    /// the setting `min_free_points`.
    fn finish_measurement(&self, session: &mut MeasurementSession) -> Result<Vec<String>, String> {
        let Some(asked) = &session.measurement else { return Err("no measurement is requested".to_owned()) };
        let (there, _) = asked.list.progress();
        if let Some(least) = self.settings.min_free_points.filter(|least| there < *least) {
            return Err(format!("{there} points arrived; at least {least} are required: continue to measure"));
        }
        if there == 0 {
            return Err("no point arrived: check the cable and the settings of the machine's printer".to_owned());
        }
        let kept = vec![plan_file(asked.job), hits_file(asked.job)];
        session.finish(Outcome::Complete);
        session.clear_of_part = Some(true);
        Ok(kept)
    }

    fn accept_confirmation(&self, word: OperatorConfirmation) -> DeviceResult<Vec<String>> {
        let mut session = locked(&self.session);
        let taken = match (word, session.state) {
            (OperatorConfirmation::Done { file: Some(_), .. }, _) => {
                Err("this machine sends its points to Regrind directly, so no file is needed: remove --file".to_owned())
            }
            (OperatorConfirmation::Done { .. }, MachineState::Execute | MachineState::Holding | MachineState::Held) => {
                self.finish_measurement(&mut session)
            }
            (OperatorConfirmation::Still, MachineState::Holding) => {
                session.state = MachineState::Held;
                Ok(Vec::new())
            }
            (OperatorConfirmation::Still, MachineState::Stopping) => {
                session.finish(Outcome::Stopped);
                Ok(Vec::new())
            }
            (OperatorConfirmation::Started { .. }, _) => {
                Err("the start of a measurement needs no confirmation: measure, then type regrind confirm done"
                    .to_owned())
            }
            (_, state) => Err(format!("the machine is {state}; no confirmation of this kind is expected")),
        };
        drop(session);
        taken.map_err(|reason| self.not_accepted(reason))
    }
}

fn status_of(session: &MeasurementSession) -> Status {
    let asked = session.measurement.as_ref();
    let progress = asked.map(|asked| {
        let (there, of) = asked.list.progress();
        (there as u32, of.unwrap_or(there) as u32)
    });
    Status {
        job: asked.map(|asked| asked.job),
        done: asked.filter(|_| session.outcome != Outcome::None).map_or(0, |asked| asked.sequence),
        outcome: session.outcome,
        clear_of_part: session.clear_of_part,
        progress,
        ..Status::from_state(session.state)
    }
}

/// Returns the path of the list of targets of a job, relative to the folder of its run.
fn plan_file(job: Job) -> String {
    let BatchId { cycle, batch } = job.batch_id();
    format!("{}/{}", CycleFolder::new(cycle), run_files::plan_file(batch))
}

fn hits_file(job: Job) -> String {
    let BatchId { cycle, batch } = job.batch_id();
    format!("{}/{}", CycleFolder::new(cycle), run_files::hits_file(batch))
}

/// Writes the targets of `plan` as a CSV file for `job` into the folder of the run. Then opens the JSON-lines file of
/// this job, which stores each line that the machine sends. Returns this open file.
///
/// # Errors
/// Returns an error if a folder or a file cannot be created.
fn write_list(settings: &HitLinesSettings, plan: &Plan, job: Job) -> Result<JsonlAppender, FormatError> {
    let path = settings.run_folder.join(plan_file(job));
    ResultFolder::prepare(path.parent().unwrap_or(&settings.run_folder))?.keep();
    let text = plan_csv(&settings.part, job, &HEXLOWER.encode(&plan.identity()), plan);
    write_atomic(&path, text.as_bytes())?;
    JsonlAppender::open(&settings.run_folder.join(hits_file(job)))
}

/// Writes the list of targets as `plan.csv` into the folder from which the machine's part program reads it. Does
/// nothing if the cell file names no such folder.
fn show_list(settings: &HitLinesSettings, plan: &Plan, job: Job) -> Result<(), FormatError> {
    let Some(folder) = &settings.plan_folder else { return Ok(()) };
    let text = plan_csv(&settings.part, job, &HEXLOWER.encode(&plan.identity()), plan);
    write_atomic(&PathBuf::from(folder).join("plan.csv"), text.as_bytes())
}

impl Machine for HitLinesCmm {
    fn name(&self) -> &str {
        &self.name
    }

    fn notes(&self) -> Vec<String> {
        let session = locked(&self.session);
        let run = run_argument(&self.settings.run_folder);
        let step = self.step(&session).map_or_else(Vec::new, |step| step.lines(MachineKind::Cmm.name(), &run));
        let held = (session.state == MachineState::Held && session.measurement.is_some())
            .then(|| format!("{}; to continue: regrind resume", session.remaining_targets()));
        session.refusals().into_iter().chain(step).chain(held).collect()
    }

    fn operator_step(&self) -> Option<OperatorStep> {
        self.step(&locked(&self.session))
    }

    async fn connect(&mut self) -> DeviceResult<Identity> {
        let lost = locked(&self.session).link_error.is_some();
        if self.listener.is_none() || lost {
            // Close the port first: an open port cannot be opened again.
            self.listener = None;
            let (line, waits) = (self.settings.source.clone(), self.settings.timeouts());
            let opened = Listener::open(&self.name, line, waits, Arc::clone(&self.session)).await?;
            self.listener = Some(opened);
        }
        // Printed lines do not identify the machine: only the cell file says what it is.
        let simulation = self.settings.simulated;
        Ok(Identity { simulation, ..Identity::for_manual_machine(MachineKind::Cmm, &self.name) })
    }

    async fn status(&mut self) -> DeviceResult<Status> {
        self.current_status()
    }

    fn restore(&mut self, intended: &Armed) {
        self.memory.restore(intended);
    }

    async fn claim(&mut self) -> DeviceResult<Status> {
        self.current_status()
    }

    async fn prepare(&mut self, job: Job) -> DeviceResult<Armed> {
        let Some(plan) = self.memory.payload_for(job) else {
            return Err(self.refused(MachineCommand::Prepare, Answer::PayloadMissing));
        };
        self.current_status()?;
        if locked(&self.session).state != MachineState::Idle {
            return Err(self.refused(MachineCommand::Prepare, Answer::WrongState));
        }
        let (settings, owned) = (self.settings.clone(), Arc::clone(&plan));
        let written = tokio::task::spawn_blocking(move || write_list(&settings, &owned, job));
        let kept = written.await.map_err(|e| self.not_accepted(e))?.map_err(|e| self.not_accepted(e))?;
        let is_free = self.settings.min_free_points.is_some();
        let list = TargetList::new(&plan, self.settings.coordinates, is_free, self.settings.touch_rules());
        let mut session = locked(&self.session);
        let armed = self.memory.arm(job);
        session.measurement =
            Some(RequestedMeasurement::new((job, armed.start_sequence), plan.identity(), list, Some(kept)));
        (session.state, session.outcome) = (MachineState::Prepared, Outcome::None);
        Ok(armed)
    }

    async fn start(&mut self, armed: Armed) -> DeviceResult<Started> {
        let Armed { job, start_sequence, .. } = armed;
        self.current_status()?;
        let plan = self.memory.loaded.as_ref().map(|(plan, _)| Arc::clone(plan));
        let status = {
            let mut session = locked(&self.session);
            let is_prepared = session.state == MachineState::Prepared;
            let asked =
                session.measurement.as_mut().filter(|asked| (asked.job, asked.sequence) == (job, start_sequence));
            let Some(asked) = asked.filter(|_| is_prepared) else {
                drop(session);
                return Err(self.refused(MachineCommand::Start, Answer::OtherJob));
            };
            let now = tokio::time::Instant::now();
            (asked.begun, asked.last_line) = (now, now);
            // Lines are accepted before anybody can see the list.
            (session.state, session.clear_of_part) = (MachineState::Execute, None);
            status_of(&session)
        };
        self.memory.last_start_sequence = start_sequence;
        if let Some(plan) = plan {
            let settings = self.settings.clone();
            let shown = tokio::task::spawn_blocking(move || show_list(&settings, &plan, job));
            let shown =
                shown.await.map_err(|e| self.not_accepted(e)).and_then(|shown| shown.map_err(|e| self.not_accepted(e)));
            if let Err(error) = shown {
                // The list was shown to nobody.
                locked(&self.session).state = MachineState::Prepared;
                return Err(error);
            }
        }
        Ok(Started { job, start_sequence, status })
    }

    async fn hold(&mut self) -> DeviceResult<Status> {
        self.current_status()?;
        self.transition(MachineCommand::Hold, &[MachineState::Execute], MachineState::Holding)
    }

    async fn resume(&mut self) -> DeviceResult<Status> {
        self.current_status()?;
        self.transition(MachineCommand::Resume, &[MachineState::Held], MachineState::Execute)
    }

    async fn stop(&mut self) -> DeviceResult<Status> {
        self.current_status()?;
        if let Some((job, sequence)) = self.memory.unresolved.take() {
            let mut session = locked(&self.session);
            let list = TargetList::new(&no_plan(), self.settings.coordinates, false, self.settings.touch_rules());
            session.measurement = Some(RequestedMeasurement::new((job, sequence), [0; 32], list, None));
            session.state = MachineState::Stopping;
            return Ok(status_of(&session));
        }
        let state = locked(&self.session).state;
        match state {
            MachineState::Prepared => {
                locked(&self.session).forget();
                self.transition(MachineCommand::Stop, &[MachineState::Prepared], MachineState::Idle)
            }
            // A person has confirmed that it does not move.
            MachineState::Held => {
                let mut session = locked(&self.session);
                session.finish(Outcome::Stopped);
                Ok(status_of(&session))
            }
            _ => self.transition(
                MachineCommand::Stop,
                &[MachineState::Execute, MachineState::Holding],
                MachineState::Stopping,
            ),
        }
    }

    async fn abort(&mut self) -> DeviceResult<Status> {
        let untold = self.memory.unresolved.take();
        let mut session = locked(&self.session);
        let may_move = session.state.is_moving() || untold.is_some();
        session.state = if may_move { MachineState::Aborting } else { MachineState::Aborted };
        session.outcome = Outcome::Aborted;
        Ok(status_of(&session))
    }

    async fn clear(&mut self) -> DeviceResult<Status> {
        if locked(&self.session).state == MachineState::Aborted {
            locked(&self.session).forget();
        }
        self.transition(MachineCommand::Clear, &[MachineState::Aborted], MachineState::Idle)
    }

    async fn acknowledge(&mut self, done: u32) -> DeviceResult<Status> {
        if locked(&self.session).measurement.as_ref().is_none_or(|asked| asked.sequence != done) {
            return Err(self.refused(MachineCommand::Acknowledge, Answer::OtherResult));
        }
        self.transition(MachineCommand::Acknowledge, &[MachineState::Complete], MachineState::Idle)?;
        let mut session = locked(&self.session);
        session.forget();
        Ok(status_of(&session))
    }

    async fn release(&mut self) -> DeviceResult<Status> {
        let status = self.current_status()?;
        // The thread ends and frees the port for other programs.
        self.listener = None;
        Ok(status)
    }

    async fn reconcile(&mut self, intended: &Armed) -> DeviceResult<Reconciled> {
        self.current_status()?;
        let session = locked(&self.session);
        let ours = session.measurement.as_ref().map(|asked| (asked.job, asked.sequence))
            == Some((intended.job, intended.start_sequence));
        Ok(match session.state {
            MachineState::Complete | MachineState::Aborted if ours => Reconciled::Finished(status_of(&session)),
            state if ours && (state.is_moving() || state == MachineState::Held) => {
                Reconciled::Running(status_of(&session))
            }
            _ => Reconciled::Unknown {
                reason: "the machine does not report the outcome of the job; ask the person at the machine whether the job was done".to_owned(),
            },
        })
    }

    async fn confirm(&mut self, word: OperatorConfirmation) -> DeviceResult<Vec<String>> {
        self.accept_confirmation(word)
    }
}

/// Returns a plan without targets and with all lengths 0. The driver uses this plan for a measurement that an
/// interrupted run began: after a restart, only the job number is known, not the plan.
fn no_plan() -> Plan {
    Plan {
        targets: Vec::new(),
        probe_radius_mm: 0.0,
        approach_mm: 0.0,
        search_mm: 0.0,
        speed_mm_s: 0.0,
        safe_height_mm: 0.0,
        careful_start: None,
    }
}

impl Cmm for HitLinesCmm {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> DeviceResult<()> {
        self.memory.loaded = Some((Arc::new(plan.clone()), digest(&[plan.identity()])));
        Ok(())
    }

    async fn read_ahead(&mut self, job: Job, _: &Interrupt) -> Option<PreliminaryPoints> {
        let session = locked(&self.session);
        let asked = session.measurement.as_ref().filter(|asked| asked.job == job)?;
        let (from, points) = (self.memory.reported_points, asked.list.ready(self.memory.reported_points));
        drop(session);
        self.memory.reported_points += points.len();
        let there = !points.is_empty();
        there.then_some(PreliminaryPoints { job, first_index: from, points, coordinates: self.settings.coordinates })
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> DeviceResult<Measurement> {
        let session = locked(&self.session);
        let complete = session.state == MachineState::Complete && session.outcome == Outcome::Complete;
        let Some(asked) = session.measurement.as_ref().filter(|asked| asked.job == job && complete) else {
            return Err(DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: session.state });
        };
        Ok(Measurement {
            points: asked.list.points(),
            coordinates: self.settings.coordinates,
            probe_radius_mm: None,
            temperature_c: None,
            duration_s: Some(session.duration.as_secs_f64()),
            plan_identity: asked.plan_identity,
            job: job.job,
            cycle: job.cycle,
            done: asked.sequence,
        })
    }
}
