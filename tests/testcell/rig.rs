//! Simulated cell in the process of a test: the world, its wires, and any number of runs, one after the other.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::wire_faults::{Fault, FaultPlan, Serving, SharedFaultPlan, When};
use regrind::cell::Actor;
use regrind::config::{CellConfig, LinkConfig};
use regrind::device::{ModbusCmm, ModbusGrinder};
use regrind::drive::{BlockingExecutor, Notice, Reply, Request, RunInputs, send_request};
use regrind::journal::{AuditKey, Header, Journal};
use regrind::recipe::Recipe;
use regrind::setup;
use regrind_sim::options::MachineOptions;
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;
use regrind_testutils::root;
use serde_json::json;
use tempfile::TempDir;
use tokio::sync::mpsc;

/// Longest wait for any event that must happen.
pub const PATIENCE: Duration = Duration::from_secs(120);
/// Index of the CMM in the pairs of a [`Rig`].
pub const CMM: usize = 0;
/// Index of the grinder in the pairs of a [`Rig`].
pub const GRINDER: usize = 1;

/// Returns the text of a shipped file with some strings replaced.
pub fn changed(file: &str, changes: &[(&str, &str)]) -> String {
    let mut text = std::fs::read_to_string(root().join(file)).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "{file} has no {from:?}");
        text = text.replacen(from, to, 1);
    }
    text
}

/// Returns the shipped free-form mirror on a coarser grid, so that a cycle takes about a second.
pub fn small(columns: u32, rows: u32, speed: f64) -> Recipe {
    let of = [
        ("columns = 60", format!("columns = {columns}")),
        ("rows = 30", format!("rows = {rows}")),
        ("accuracy_nm = 0.5", "spacing_mm = 1.0".to_owned()),
        ("cutoff_mm = 5.0", "cutoff_mm = 20.0".to_owned()),
        ("[simulation]\nseed = 1", format!("[simulation]\nseed = 1\nspeed = {speed:.1}")),
    ];
    let changes: Vec<(&str, &str)> = of.iter().map(|(from, to)| (*from, to.as_str())).collect();
    recipe(&changes)
}

/// Returns the shipped free-form mirror with some strings replaced.
pub fn recipe(changes: &[(&str, &str)]) -> Recipe {
    let text = changed("recipes/freeform-mirror.toml", changes);
    Recipe::parse(&root().join("recipes/freeform-mirror.toml"), &text).unwrap_or_else(|p| panic!("{p:?}"))
}

/// Request that arrived at a simulated machine, with its time.
#[derive(Clone, Copy, Debug)]
pub struct ReceivedRequest {
    /// Time of arrival.
    pub at: Instant,
    /// True if the request changed the heartbeat.
    pub beat: bool,
    /// Number of the command, if the request was a command.
    pub command: Option<u16>,
}

/// Callback of a test that runs when a command arrives, before the machine sees it.
pub type Watch = Box<dyn FnMut(u16) + Send>;

/// The world and its wires.
pub struct Rig {
    /// Parts and machines.
    pub world: World,
    /// Servers of the CMM and the grinder.
    pub servings: [Serving; 2],
    /// Requests that arrived at each machine during the current run.
    pub came: [Arc<Mutex<Vec<ReceivedRequest>>>; 2],
    /// Recipe of every run.
    pub recipe: Recipe,
    /// Cell with the ports of the servers.
    pub cell: CellConfig,
    /// Folder of the run folders.
    pub home: TempDir,
    runs: u32,
}

/// Run that is complete except for its drive.
pub struct Ready {
    /// Inputs of the drive.
    pub run: RunInputs,
    /// Driver of the CMM.
    pub cmm: ModbusCmm,
    /// Driver of the grinder.
    pub grinder: ModbusGrinder,
    /// Notices of the drive.
    pub notices: mpsc::UnboundedReceiver<Notice>,
    /// Folder of the run.
    pub folder: PathBuf,
}

impl Drop for Rig {
    fn drop(&mut self) {
        regrind_testutils::keep::keep(self.home.path());
    }
}

impl Rig {
    /// Creates the world of a recipe and serves its machines on free ports.
    pub async fn new(recipe: Recipe) -> Self {
        let spec = recipe.simulation.clone().unwrap().try_into::<WorldSpec>().unwrap();
        let speed = spec.speed;
        let world = World::new(spec).unwrap();
        let options = |seed| MachineOptions { speed, seed, ..MachineOptions::default() };
        let cmm = SimulatedMachine::new(Box::new(world.cmm()), 71, options(1));
        let grinder = SimulatedMachine::new(Box::new(world.grinder()), 72, options(2));
        let serve = |unit, machine| Serving::tcp_with(("127.0.0.1", 0), vec![(unit, machine)], SharedFaultPlan::none());
        let servings = [serve(1, cmm).await.unwrap(), serve(2, grinder).await.unwrap()];
        let port = |k: usize| format!("port = {}", servings[k].local_addr().unwrap().port());
        let text = changed("config/modbus-tcp.toml", &[("port = 15021", &port(0)), ("port = 15022", &port(1))]);
        let mut cell = CellConfig::parse(Path::new("cell.toml"), &text).unwrap_or_else(|p| panic!("{p:?}"));
        for link in [&mut cell.cmm.link, &mut cell.grinder.link] {
            // A stall of the computer must not look like a machine that is gone.
            link.timing.request_timeout = Duration::from_secs(5);
            link.timing.lost_after = Duration::from_secs(60);
        }
        let rig = Self {
            world,
            servings,
            came: [Arc::default(), Arc::default()],
            recipe,
            cell,
            home: tempfile::tempdir().unwrap(),
            runs: 0,
        };
        rig.watch(CMM, Box::new(|_| ()));
        rig.watch(GRINDER, Box::new(|_| ()));
        rig
    }

    /// Calls a test's callback at the moment when a command arrives at a machine.
    pub fn watch(&self, machine: usize, mut watch: Watch) {
        let came = Arc::clone(&self.came[machine]);
        let look = move |request: &crate::wire_faults::Request| {
            let beat = request.function == 16 && request.address == 36;
            came.lock().unwrap().push(ReceivedRequest { at: Instant::now(), beat, command: request.command });
            if let Some(command) = request.command {
                watch(command);
            }
            false
        };
        let plan = FaultPlan::new(1).always(When::Matching(Box::new(look)), Fault::DropRequest);
        self.servings[machine].faults().set(plan);
    }

    /// Prepares the next run, with a new job number and thus a new part.
    pub fn next(&mut self, loaded: bool) -> Ready {
        self.runs += 1;
        self.came.iter().for_each(|came| came.lock().unwrap().clear());
        let (task, plan) = setup::prepare(&self.recipe, &self.cell).unwrap();
        let folder = self.home.path().join(self.runs.to_string());
        let header = Header {
            run: self.runs.to_string(),
            part: "SN-1".into(),
            actor: "a test".into(),
            station: "here".into(),
            simulation: true,
            first_command_id: 1,
            content: json!({}),
        };
        let journal = Journal::create_with(&folder, header, Some(AuditKey::new())).unwrap();
        let (notices, shown) = mpsc::unbounded_channel();
        let link = |link: &LinkConfig| setup::modbus_settings(link, true, 7, self.runs).unwrap();
        let cmm = ModbusCmm::new(link(&self.cell.cmm.link)).unwrap();
        let grinder = ModbusGrinder::new(link(&self.cell.grinder.link)).unwrap();
        let run = RunInputs {
            plan,
            task,
            journal: Box::new(journal),
            job: self.runs,
            actor: Actor { name: "a test".into(), station: "here".into() },
            load_confirmed: loaded,
            poll_intervals: [self.cell.cmm.link.timing.poll, self.cell.grinder.link.timing.poll],
            notices,
            interrupted: None,
            executor: BlockingExecutor::Threads,
        };
        Ready { run, cmm, grinder, notices: shown, folder }
    }

    /// Returns the time at which a command arrived at a machine, if it did.
    pub fn command_at(&self, machine: usize, command: u16, since: Instant) -> Option<Instant> {
        let came = self.came[machine].lock().unwrap();
        came.iter().find(|c| c.command == Some(command) && c.at >= since).map(|c| c.at)
    }
}

/// Gives an order over the control socket, as another terminal does. Returns the answer, the time of the order and how
/// long the answer took.
pub async fn order(folder: &Path, request: Request) -> (Reply, Instant, Duration) {
    let folder = folder.to_owned();
    tokio::task::spawn_blocking(move || {
        let began = Instant::now();
        let reply = send_request(&folder, &request).unwrap();
        (reply, began, began.elapsed())
    })
    .await
    .unwrap()
}

/// Returns the state of a running cell in words.
pub async fn words(folder: &Path) -> String {
    order(folder, Request::Status).await.0.status.message
}

/// Polls the cell until its state satisfies a condition, and returns the state in words.
pub async fn until(folder: &Path, will_do: impl Fn(&str) -> bool) -> String {
    let began = Instant::now();
    loop {
        let words = words(folder).await;
        if will_do(&words) {
            return words;
        }
        assert!(began.elapsed() < PATIENCE, "the cell stays {words}");
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// Waits for an event of the run, starting at the current position in the notices.
pub async fn event(notices: &mut mpsc::UnboundedReceiver<Notice>, wanted: &str, times: usize) {
    let mut left = times;
    let waiting = async {
        while left > 0 {
            let notice = notices.recv().await.expect("the run goes on");
            let name = match &notice {
                Notice::State { event, .. } => event.as_str(),
                Notice::Progress { .. } => "progressed",
                Notice::Figures { .. } => "registered",
                Notice::Compensated { .. } => "compensated",
                Notice::Finished { ending, .. } => panic!("over before {wanted}: {ending:?}"),
                _ => "",
            };
            left -= usize::from(name == wanted);
        }
    };
    tokio::time::timeout(PATIENCE, waiting).await.unwrap_or_else(|_| panic!("no {wanted}"));
}
