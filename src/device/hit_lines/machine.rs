//! The measuring machine that prints hits, as the cell sees it. This driver writes a list of targets; a person, or the
//! machine's own part program, leads the probe by it; the driver receives the lines.
//!
//! ```text
//!  START    the list exists, and lines are accepted                                                   -> EXECUTE
//!  EXECUTE  every target touched, and `done` confirmed (or the time in the cell file is over)         -> COMPLETE
//!           a refused line, HOLD, a lost line -> HOLDING;  `still` -> HELD;  RESUME -> EXECUTE
//!  STOP and ABORT: the person is asked too
//! ```

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use super::hearing::{Asked, Hearing, locked};
use super::link::Listener;
use super::list::List;
use super::settings::HitLinesSettings;
use crate::error::{Answered, DeviceError};
use crate::exchange::plan_csv;
use crate::kept::Kept;
use crate::machine::{Cmm, Interrupt, Machine};
use crate::payload::{Identified, Measurement, Plan, Preliminary};
use crate::words::{
    Answer, Armed, Command, Identity, Job, MachineKind, Outcome, Reconciled, Started, State, Status, Word, digest, hex,
};
use regrind_formats::{AddedLines, FormatError, ResultFolder, write_atomic};

/// Measuring machine that prints a line for each hit.
#[derive(Debug)]
pub struct HitLinesCmm {
    name: Arc<str>,
    settings: HitLinesSettings,
    hearing: Arc<Mutex<Hearing>>,
    listener: Option<Listener>,
    kept: Kept<Plan>,
}

impl HitLinesCmm {
    /// Creates a machine; does not listen yet.
    pub fn new(settings: HitLinesSettings) -> Self {
        let hearing = Arc::new(Mutex::new(Hearing::new(settings.judging())));
        let name = format!("cmm by hit lines, {}", settings.line).into();
        Self { name, settings, hearing, listener: None, kept: Kept::none() }
    }

    fn told(&self) -> Answered<Status> {
        let mut hearing = locked(&self.hearing);
        if let Some(error) = &hearing.lost {
            return Err(error.clone());
        }
        if self.listener.is_none() {
            return Err(DeviceError::NotConnected { machine: Arc::clone(&self.name), what: "its status" });
        }
        hearing.let_time_pass(self.settings.clear_after);
        Ok(status_of(&hearing))
    }

    fn refused(&self, command: Command, answer: Answer) -> DeviceError {
        let state = locked(&self.hearing).state;
        DeviceError::Refused { machine: Arc::clone(&self.name), command, answer, state }
    }

    fn not_taken(&self, why: impl ToString) -> DeviceError {
        DeviceError::NotTaken { machine: Arc::clone(&self.name), why: why.to_string() }
    }

    /// Changes the state to `to` and returns the status.
    ///
    /// # Errors
    /// Refuses with [`Answer::WrongState`] if the current state is not in `from`.
    fn go(&self, command: Command, from: &[State], to: State) -> Answered<Status> {
        let mut hearing = locked(&self.hearing);
        if !from.contains(&hearing.state) {
            drop(hearing);
            return Err(self.refused(command, Answer::WrongState));
        }
        hearing.state = to;
        Ok(status_of(&hearing))
    }

    /// Returns what to do now, and what to type then.
    fn prompt(&self, hearing: &Hearing) -> Vec<String> {
        let Some(asked) = &hearing.asked else { return Vec::new() };
        let folder = &self.settings.run_folder;
        let run = match folder.parent() == Some(Path::new("runs")) {
            true => String::new(),
            false => format!(" {}", folder.display()),
        };
        let then = |word: &str| format!("then: regrind confirm {word} --machine cmm{run}");
        let part = &self.settings.part;
        let stop = |what: &str| vec![format!("{what} it at its own panel; {}", hearing.left()), then("still")];
        match hearing.state {
            State::Execute if asked.list.is_whole() => match self.settings.clear_after {
                None => vec!["every target is touched; when the probe is clear of the part,".to_owned(), then("done")],
                Some(_) => Vec::new(),
            },
            State::Execute => {
                let points = match (self.settings.free_points, asked.list.progress().1) {
                    (Some(least), _) => format!("at least {least} points"),
                    (None, count) => {
                        let list = folder.join(plan_file(asked.job));
                        format!("the {} points of {}", count.unwrap_or_default(), list.display())
                    }
                };
                let mut prompt = vec![
                    format!("MEASURE {part}, cycle {}: {points} (plan {})", asked.job.number(), hearing.plan_digits()),
                    "check: right part, clean, clamped; wheel clear of it; the probe that the list names".to_owned(),
                ];
                if self.settings.clear_after.is_none() {
                    prompt.push("when it is measured and the probe is clear of the part,".to_owned());
                    prompt.push(then("done"));
                }
                prompt
            }
            State::Holding => stop("HOLD"),
            State::Stopping => stop("STOP"),
            State::Held => vec![format!("{}; regrind resume goes on", hearing.left())],
            State::Aborting => vec!["ABORT: stop it at its own panel NOW; nothing here can".to_owned()],
            _ => Vec::new(),
        }
    }

    /// Ends the measurement on a person's confirmation. Returns the files that are kept.
    fn take_done(&self, hearing: &mut Hearing) -> Result<Vec<String>, String> {
        let Some(asked) = &hearing.asked else { return Err("no measurement is asked for".to_owned()) };
        let (there, _) = asked.list.progress();
        if let Some(least) = self.settings.free_points.filter(|least| there < *least) {
            return Err(format!("{there} points came, and at least {least} are wanted: go on measuring"));
        }
        if there == 0 {
            return Err("not a single point came: see the cable and the settings of the machine's printer".to_owned());
        }
        let kept = vec![plan_file(asked.job), hits_file(asked.job)];
        hearing.finish(Outcome::Complete);
        hearing.clear = Some(true);
        Ok(kept)
    }

    fn take_word(&self, word: Word) -> Answered<Vec<String>> {
        let mut hearing = locked(&self.hearing);
        let taken = match (word, hearing.state) {
            (Word::Done { file: Some(_), .. }, _) => Err("its points come by the line: leave --file out".to_owned()),
            (Word::Done { .. }, State::Execute | State::Holding | State::Held) => self.take_done(&mut hearing),
            (Word::Still, State::Holding) => {
                hearing.state = State::Held;
                Ok(Vec::new())
            }
            (Word::Still, State::Stopping) => {
                hearing.finish(Outcome::Stopped);
                Ok(Vec::new())
            }
            (Word::Started { .. }, _) => Err("nothing is started here; measure, and confirm done".to_owned()),
            (_, state) => Err(format!("it is {state}, and nothing of that kind is asked")),
        };
        drop(hearing);
        taken.map_err(|why| self.not_taken(why))
    }
}

fn status_of(hearing: &Hearing) -> Status {
    let asked = hearing.asked.as_ref();
    let progress = asked.map(|asked| {
        let (there, of) = asked.list.progress();
        (there as u32, of.unwrap_or(there) as u32)
    });
    Status {
        job: asked.map(|asked| asked.job),
        done: asked.filter(|_| hearing.outcome != Outcome::None).map_or(0, |asked| asked.sequence),
        outcome: hearing.outcome,
        clear_of_part: hearing.clear,
        progress,
        ..Status::of(hearing.state)
    }
}

/// Returns the path of the list of a job, relative to the folder of its run.
fn plan_file(job: Job) -> String {
    format!("cycle-{}/plan{}.csv", job.number().cycle, of_batch(job))
}

fn hits_file(job: Job) -> String {
    format!("cycle-{}/hits{}.jsonl", job.number().cycle, of_batch(job))
}

fn of_batch(job: Job) -> String {
    match job.number().batch {
        0 => String::new(),
        before => format!("-{}", before + 1),
    }
}

/// Writes the list into the folder of the run, and opens the file that stores the lines.
fn write_list(settings: &HitLinesSettings, plan: &Plan, job: Job) -> Result<AddedLines, FormatError> {
    let path = settings.run_folder.join(plan_file(job));
    ResultFolder::prepare(path.parent().unwrap_or(&settings.run_folder))?.keep();
    let text = plan_csv(&settings.part, job, &hex(&plan.identity()), plan);
    write_atomic(&path, text.as_bytes())?;
    AddedLines::open(&settings.run_folder.join(hits_file(job)))
}

/// Writes the list where the machine's part program reads it.
fn show_list(settings: &HitLinesSettings, plan: &Plan, job: Job) -> Result<(), FormatError> {
    let Some(folder) = &settings.plan_folder else { return Ok(()) };
    let text = plan_csv(&settings.part, job, &hex(&plan.identity()), plan);
    write_atomic(&PathBuf::from(folder).join("plan.csv"), text.as_bytes())
}

impl Machine for HitLinesCmm {
    fn name(&self) -> &str {
        &self.name
    }

    fn notes(&self) -> Vec<String> {
        let hearing = locked(&self.hearing);
        hearing.refusals().into_iter().chain(self.prompt(&hearing)).collect()
    }

    async fn connect(&mut self) -> Answered<Identity> {
        let lost = locked(&self.hearing).lost.is_some();
        if self.listener.is_none() || lost {
            // Close the port first: an open port cannot be opened again.
            self.listener = None;
            let (line, waits) = (self.settings.line.clone(), self.settings.waits());
            let opened = Listener::open(&self.name, line, waits, Arc::clone(&self.hearing)).await?;
            self.listener = Some(opened);
        }
        // Printed lines do not identify the machine: only the cell file says what it is.
        let simulation = self.settings.simulated;
        Ok(Identity { simulation, ..Identity::by_person(MachineKind::Cmm, &self.name) })
    }

    async fn status(&mut self) -> Answered<Status> {
        self.told()
    }

    fn restore(&mut self, intended: &Armed) {
        self.kept.restore(intended);
    }

    async fn claim(&mut self) -> Answered<Status> {
        self.told()
    }

    async fn prepare(&mut self, job: Job) -> Answered<Armed> {
        let Some(plan) = self.kept.ready_for(job) else {
            return Err(self.refused(Command::Prepare, Answer::PayloadMissing));
        };
        self.told()?;
        if locked(&self.hearing).state != State::Idle {
            return Err(self.refused(Command::Prepare, Answer::WrongState));
        }
        let (settings, owned) = (self.settings.clone(), Arc::clone(&plan));
        let written = tokio::task::spawn_blocking(move || write_list(&settings, &owned, job));
        let kept = written.await.map_err(|e| self.not_taken(e))?.map_err(|e| self.not_taken(e))?;
        let is_free = self.settings.free_points.is_some();
        let list = List::new(&plan, self.settings.what, is_free, self.settings.telling());
        let mut hearing = locked(&self.hearing);
        let armed = self.kept.prepared(job);
        hearing.asked = Some(Asked::new((job, armed.start_sequence), plan.identity(), list, Some(kept)));
        (hearing.state, hearing.outcome) = (State::Prepared, Outcome::None);
        Ok(armed)
    }

    async fn start(&mut self, armed: Armed) -> Answered<Started> {
        let Armed { job, start_sequence, .. } = armed;
        self.told()?;
        let plan = self.kept.loaded.as_ref().map(|(plan, _)| Arc::clone(plan));
        let status = {
            let mut hearing = locked(&self.hearing);
            let is_prepared = hearing.state == State::Prepared;
            let asked = hearing.asked.as_mut().filter(|asked| (asked.job, asked.sequence) == (job, start_sequence));
            let Some(asked) = asked.filter(|_| is_prepared) else {
                drop(hearing);
                return Err(self.refused(Command::Start, Answer::OtherJob));
            };
            let now = tokio::time::Instant::now();
            (asked.begun, asked.last_line) = (now, now);
            // Lines are accepted before anybody can see the list.
            (hearing.state, hearing.clear) = (State::Execute, None);
            status_of(&hearing)
        };
        self.kept.begun = start_sequence;
        if let Some(plan) = plan {
            let settings = self.settings.clone();
            let shown = tokio::task::spawn_blocking(move || show_list(&settings, &plan, job));
            let shown =
                shown.await.map_err(|e| self.not_taken(e)).and_then(|shown| shown.map_err(|e| self.not_taken(e)));
            if let Err(error) = shown {
                // The list was shown to nobody.
                locked(&self.hearing).state = State::Prepared;
                return Err(error);
            }
        }
        Ok(Started { job, start_sequence, status })
    }

    async fn hold(&mut self) -> Answered<Status> {
        self.told()?;
        self.go(Command::Hold, &[State::Execute], State::Holding)
    }

    async fn resume(&mut self) -> Answered<Status> {
        self.told()?;
        self.go(Command::Resume, &[State::Held], State::Execute)
    }

    async fn stop(&mut self) -> Answered<Status> {
        self.told()?;
        if let Some((job, sequence)) = self.kept.untold.take() {
            let mut hearing = locked(&self.hearing);
            let list = List::new(&no_plan(), self.settings.what, false, self.settings.telling());
            hearing.asked = Some(Asked::new((job, sequence), [0; 32], list, None));
            hearing.state = State::Stopping;
            return Ok(status_of(&hearing));
        }
        let state = locked(&self.hearing).state;
        match state {
            State::Prepared => {
                locked(&self.hearing).forget();
                self.go(Command::Stop, &[State::Prepared], State::Idle)
            }
            // A person has confirmed that it does not move.
            State::Held => {
                let mut hearing = locked(&self.hearing);
                hearing.finish(Outcome::Stopped);
                Ok(status_of(&hearing))
            }
            _ => self.go(Command::Stop, &[State::Execute, State::Holding], State::Stopping),
        }
    }

    async fn abort(&mut self) -> Answered<Status> {
        let untold = self.kept.untold.take();
        let mut hearing = locked(&self.hearing);
        let may_move = hearing.state.moves() || untold.is_some();
        hearing.state = if may_move { State::Aborting } else { State::Aborted };
        hearing.outcome = Outcome::Aborted;
        Ok(status_of(&hearing))
    }

    async fn clear(&mut self) -> Answered<Status> {
        if locked(&self.hearing).state == State::Aborted {
            locked(&self.hearing).forget();
        }
        self.go(Command::Clear, &[State::Aborted], State::Idle)
    }

    async fn acknowledge(&mut self, done: u32) -> Answered<Status> {
        if locked(&self.hearing).asked.as_ref().is_none_or(|asked| asked.sequence != done) {
            return Err(self.refused(Command::Acknowledge, Answer::OtherResult));
        }
        self.go(Command::Acknowledge, &[State::Complete], State::Idle)?;
        let mut hearing = locked(&self.hearing);
        hearing.forget();
        Ok(status_of(&hearing))
    }

    async fn release(&mut self) -> Answered<Status> {
        let status = self.told()?;
        // The thread ends and frees the port for other programs.
        self.listener = None;
        Ok(status)
    }

    async fn reconcile(&mut self, intended: &Armed) -> Answered<Reconciled> {
        self.told()?;
        let hearing = locked(&self.hearing);
        let ours = hearing.asked.as_ref().map(|asked| (asked.job, asked.sequence))
            == Some((intended.job, intended.start_sequence));
        Ok(match hearing.state {
            State::Complete | State::Aborted if ours => Reconciled::Finished(status_of(&hearing)),
            state if ours && (state.moves() || state == State::Held) => Reconciled::Running(status_of(&hearing)),
            _ => Reconciled::Unknown { why: "only who was asked to do it can tell what became of it".to_owned() },
        })
    }

    async fn confirm(&mut self, word: Word) -> Answered<Vec<String>> {
        self.take_word(word)
    }
}

/// Returns an empty plan: of the measurement of an interrupted run only the number is known.
fn no_plan() -> Plan {
    Plan {
        targets: Vec::new(),
        probe_radius_mm: 0.0,
        approach_mm: 0.0,
        search_mm: 0.0,
        speed_mm_s: 0.0,
        safe_height_mm: 0.0,
        careful: None,
    }
}

impl Cmm for HitLinesCmm {
    async fn load_plan(&mut self, plan: &Plan, _: &Interrupt) -> Answered<()> {
        self.kept.loaded = Some((Arc::new(plan.clone()), digest(&[plan.identity()])));
        Ok(())
    }

    async fn read_ahead(&mut self, job: Job, _: &Interrupt) -> Option<Preliminary> {
        let hearing = locked(&self.hearing);
        let asked = hearing.asked.as_ref().filter(|asked| asked.job == job)?;
        let (from, points) = (self.kept.told_ahead, asked.list.ready(self.kept.told_ahead));
        drop(hearing);
        self.kept.told_ahead += points.len();
        let there = !points.is_empty();
        there.then_some(Preliminary { job, from, points, coordinates: self.settings.what })
    }

    async fn collect(&mut self, job: Job, _: &Interrupt) -> Answered<Measurement> {
        let hearing = locked(&self.hearing);
        let complete = hearing.state == State::Complete && hearing.outcome == Outcome::Complete;
        let Some(asked) = hearing.asked.as_ref().filter(|asked| asked.job == job && complete) else {
            return Err(DeviceError::NoResult { machine: Arc::clone(&self.name), job, state: hearing.state });
        };
        Ok(Measurement {
            points: asked.list.points(),
            coordinates: self.settings.what,
            probe_radius_mm: None,
            temperature_c: None,
            duration_s: Some(hearing.worked.as_secs_f64()),
            plan_identity: asked.plan_identity,
            job: job.job,
            cycle: job.cycle,
            done: asked.sequence,
        })
    }
}
