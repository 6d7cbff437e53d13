//! Run in this process: its machines, its terminal, and the events from outside that end it.

use std::path::Path;
use std::time::{Duration, Instant};

use regrind::cell::{Actor, Ending};
use regrind::config::{CellConfig, LinkConfig};
use regrind::device::{AnyCmm, AnyGrinder, MachineKind};
use regrind::drive::{BlockingExecutor, Drive, InterruptedRun, JournalSink, OrderSender, Request, RunInputs, Task};
use regrind::journal::{Journal, MachineLock};
use regrind::recipe::Recipe;
use regrind::report::ending_words;
use regrind::setup;
use regrind_control::NextStep;
use tokio::sync::mpsc;

use super::Outcome;
use super::failure::Failure;
use super::outside::{self, Endings};
use super::show::{Show, print_end, reads_keys};

/// Context of a run.
pub(super) struct RunContext<'a> {
    pub(super) recipe: &'a Recipe,
    pub(super) cell: &'a CellConfig,
    /// Name of the part in files.
    pub(super) part: &'a str,
    /// Folder of the run.
    pub(super) folder: &'a Path,
    /// Number that identifies this run at the machines.
    pub(super) job: u32,
    pub(super) actor: Actor,
    pub(super) json: bool,
}

/// Machines of a run. Other runs on this computer cannot use them until this value is dropped.
pub(super) struct Machines {
    cmm: AnyCmm,
    grinder: AnyGrinder,
    taken: [Option<MachineLock>; 2],
}

/// Inputs of a run besides its machines.
pub(super) struct PreparedRun {
    pub(super) task: Task,
    pub(super) plan: regrind::cell::CellPlan,
    pub(super) journal: Journal,
    /// True if no confirmation that the part is loaded is required.
    pub(super) loaded: bool,
    pub(super) interrupted: Option<InterruptedRun>,
}

impl RunContext<'_> {
    /// Locks the measuring machine and the grinder against other runs on this computer, and opens the connections to
    /// both. Sends nothing to a machine. `now` is the current time in seconds, as returned by [`super::run::epoch`].
    /// Returns an error if another run has locked a machine, or if a connection cannot be opened.
    pub(super) fn open(&self, now: u32) -> Result<Machines, Failure> {
        let Self { recipe, cell, part, folder, .. } = self;
        let taken = [
            lock_machine(&cell.cmm.link, MachineKind::Cmm, folder)?,
            lock_machine(&cell.grinder.link, MachineKind::Grinder, folder)?,
        ];
        let client = [owner(&self.actor, folder), MachineLock::epoch(taken.iter().flatten(), now)];
        let (cmm, grinder) = setup::create_drivers(recipe, cell, part, folder, client).map_err(Failure::Setup)?;
        Ok(Machines { cmm, grinder, taken })
    }

    /// Executes the prepared run `work` on `machines`, and shows its progress until the run ends. Then writes the
    /// report of the run. Returns how the run has ended.
    ///
    /// Returns an error if the control socket or the signals of the system are not available, or if the output cannot
    /// be written. If the report cannot be written, prints a message and returns no error.
    pub(super) async fn carry_out(self, machines: Machines, work: PreparedRun) -> Result<Ending, Failure> {
        let (cell, actor) = (self.cell, self.actor);
        let (notices, shown) = mpsc::unbounded_channel();
        let showing = tokio::spawn(
            Show::new(self.json, cell.is_marked_simulation(), self.recipe, work.plan.tolerance, self.folder)
                .follow(shown),
        );
        let poll = [setup::poll_interval(&cell.cmm.link), setup::poll_interval(&cell.grinder.link)];
        let PreparedRun { task, plan, journal, loaded, interrupted } = work;
        let (journal, beside): (Box<dyn JournalSink>, _) = (Box::new(journal), BlockingExecutor::Threads);
        let actor_of_run = actor.clone();
        let run = RunInputs {
            plan,
            task,
            journal,
            job: self.job,
            actor: actor_of_run,
            load_confirmed: loaded,
            poll_intervals: poll,
            notices,
            interrupted,
            executor: beside,
        };
        let ending = go(run, machines, actor).await?;
        let shown = showing.await.map_err(|e| Failure::Terminal(e.into()));
        // The record is closed. A failed report or a closed terminal must not change the result of the run.
        let report = regrind::report::write_run_report(self.folder, &regrind::report::ReportOptions::default());
        shown??;
        match report {
            Err(error) => super::print(&format!("{}\nthe report was not written: {error}\n", ending_words(&ending)))?,
            Ok(path) if !self.json => print_end(self.folder, &ending, &path)?,
            Ok(_) => {}
        }
        Ok(ending)
    }
}

/// Executes the run on `machines` until the run ends, and returns the ending. Meanwhile, accepts orders from the
/// control sockets, from the terminal (Enter, Ctrl-C) and from signals of the system. `actor` is the person at the
/// terminal. Returns an error if the control socket or the signals are not available.
async fn go(run: RunInputs, machines: Machines, actor: Actor) -> Result<Ending, Failure> {
    let folder = run.journal.folder().to_owned();
    let Machines { cmm, grinder, taken } = machines;
    let (mut drive, orders) =
        Drive::with_cell(run, cmm, grinder).map_err(|source| Failure::ControlSocket { path: folder, source })?;
    // One socket next to the locks is enough. A cell without it still receives orders in its folder.
    if let Some(door) = taken.iter().flatten().map(MachineLock::control_socket).next()
        && let Err(error) = drive.listen_also_at(door)
    {
        eprintln!(
            "{}: this control socket cannot be opened: {error}; the cell receives orders only through the socket in the folder of the run",
            regrind::document::visible(&door.display().to_string())
        );
    }
    let endings = Endings::new().map_err(Failure::Signals)?;
    let heeding = [
        tokio::spawn(heed_ctrl_c(orders.clone(), actor.clone())),
        tokio::spawn(heed_enter(orders.clone(), actor.clone())),
        tokio::spawn(heed_endings(endings, orders, actor)),
    ];
    let ending = drive.run().await;
    heeding.iter().for_each(tokio::task::JoinHandle::abort);
    Ok(ending)
}

/// Sends an order to the cell for each Ctrl-C that is pressed at the terminal. `actor` is the person at the terminal.
///
/// - The first Ctrl-C sends the order to hold.
/// - A later Ctrl-C sends the order to abort if the last order to hold was sent less than [`IN_ONE_GO`] ago, or if the
///   cell is not executing (for example because the cell is still held).
/// - Any other Ctrl-C sends the order to hold again. In this case a person has resumed the cell after the last hold.
async fn heed_ctrl_c(orders: OrderSender, actor: Actor) {
    let mut held_at: Option<Instant> = None;
    while tokio::signal::ctrl_c().await.is_ok() {
        let again = held_at.is_some_and(|at| at.elapsed() < IN_ONE_GO || !orders.is_executing());
        held_at = if again { held_at } else { Some(Instant::now()) };
        let request = if again {
            Request::Abort { reason: "Ctrl-C, twice".into() }
        } else {
            Request::Hold { reason: "Ctrl-C".into(), state_number: None }
        };
        orders.send(request, actor.clone()).await;
    }
}

/// Waits until the cell asks for the confirmation that the part is loaded. Then waits for Enter at this terminal, and
/// sends the confirmation in the name of `actor`. Discards keys that were pressed before the cell asked. Sends nothing
/// if no person can answer at this terminal, or if the cell no longer waits for the confirmation.
async fn heed_enter(orders: OrderSender, actor: Actor) {
    let mut status = orders.status();
    if status.wait_for(|seen| seen.next_step == NextStep::Load).await.is_err() || !reads_keys() {
        return;
    }
    // If earlier input cannot be discarded, Enter is not accepted as a confirmation.
    if outside::forget_what_was_typed().is_err() {
        return;
    }
    // Own thread, because reading a terminal blocks. It stops when nobody is asked or when the program loses the
    // terminal.
    let still_asked = move || status.has_changed().is_ok() && status.borrow().next_step == NextStep::Load;
    let typed = tokio::task::spawn_blocking(move || {
        while still_asked() {
            if let Some(entered) = outside::enter_within(BETWEEN_LOOKS, reads_keys) {
                return entered && still_asked();
            }
        }
        false
    });
    if typed.await.unwrap_or(false) {
        orders.send(Request::Loaded, actor).await;
    }
}

/// Time between two checks whether the cell still waits for the confirmation of the loaded part.
const BETWEEN_LOOKS: Duration = Duration::from_millis(200);

/// Sends an order to the cell for each event in `endings`, such as a closed terminal or SIGTERM. The first event stops
/// the run in an orderly way. The next event aborts the run. A closed terminal can send its event twice. Therefore a
/// second event of a closed terminal is ignored within [`IN_ONE_GO`] after the first event. `actor` is the person named
/// in the orders.
async fn heed_endings(mut endings: Endings, orders: OrderSender, actor: Actor) {
    let mut first: Option<Instant> = None;
    while let Some(outside::Ending { by, hung_up }) = endings.next().await {
        let request = match first {
            None => Request::Stop { reason: by.to_owned() },
            Some(at) if hung_up && at.elapsed() < IN_ONE_GO => continue,
            Some(_) => Request::Abort { reason: format!("{by}, again") },
        };
        first = first.or_else(|| Some(Instant::now()));
        orders.send(request, actor.clone()).await;
    }
}

/// Locks a machine against all other runs on this computer. The lock belongs to the address of the machine in `link`
/// (host and port, or serial line). `kind` is the kind of the machine, and `run` the folder of the run that takes the
/// lock. Returns `None` if the machine has no address, for example because it exchanges files. Returns an error if
/// another run has the lock.
pub(super) fn lock_machine(link: &LinkConfig, kind: MachineKind, run: &Path) -> Result<Option<MachineLock>, Failure> {
    let run = std::path::absolute(run).unwrap_or_else(|_| run.to_owned());
    let taken = link.wire.address().map(|address| MachineLock::acquire(&format!("{kind} at {address}"), &run));
    let taken = taken.transpose().map_err(Failure::Machine)?;
    for note in taken.iter().flat_map(MachineLock::notes) {
        eprintln!("lock: {}", regrind::document::visible(note));
    }
    Ok(taken)
}

/// Returns the client number of this run: the number, above 0, by which the machines recognise the run. The number is
/// the CRC-32 of the station (computer name) of `actor` and the absolute path of the run folder `run`. The name of the
/// person has no influence. Therefore another person who resumes the run at this station gets the same number.
pub(super) fn owner(actor: &Actor, run: &Path) -> u32 {
    let mut hash = crc32fast::Hasher::new();
    hash.update(b"regrind ");
    hash.update(actor.station.as_bytes());
    // The result does not depend on the notation of the path.
    let run: std::path::PathBuf = std::path::absolute(run).unwrap_or_else(|_| run.to_owned()).components().collect();
    hash.update(run.as_os_str().as_encoded_bytes());
    hash.finalize().max(1)
}

pub(super) fn outcome(ending: &Ending) -> Result<Outcome, Failure> {
    match ending {
        Ending::Accepted { .. } => Ok(Outcome::Accepted),
        // An orderly end by a person is not a fault.
        Ending::NotAccepted { .. } | Ending::Stopped { ordered: true, .. } => Ok(Outcome::NotInTolerance),
        Ending::Stopped { reason, .. } | Ending::Aborted { reason, .. } => {
            Err(Failure::Ended { reason: reason.clone() })
        }
    }
}

/// Time after the first Ctrl-C in which a second one always aborts, even if the cell executes again by then. Also the
/// time in which the second event of a closing terminal is ignored.
const IN_ONE_GO: Duration = Duration::from_secs(3);
