//! A whole cell in one process, for tests of whole cycles: a simulated world with real sockets, and the drive that runs
//! it.
//!
//! [`run`] executes a recipe as `regrind run` does. The state of the world at each measurement is saved just before the
//! next pass changes it, so that a test can compare every cycle with the truth.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::program::{changed, root};
use regrind::cell::{Actor, Alarm, AlarmId, Ending, Role, StateName};
use regrind::config::CellConfig;
use regrind::device::Wire;
use regrind::device::{ModbusCmm, ModbusGrinder, ModbusSettings};
use regrind::drive::{BlockingExecutor, CycleRow, Drive, JournalSink, Notice, Request, RunInputs, send_request};
use regrind::journal::{Header, Journal};
use regrind::recipe::{Recipe, SelectionMode};
use regrind::setup;
use regrind_sim::Vec3;
use regrind_sim::body::{Kind, Payload, Payloads, Physics, Progress, Refusal, ResultData};
use regrind_sim::options::MachineOptions;
use regrind_sim::part::{Approach, Contact, Part};
use regrind_sim::probe::Placement;
use regrind_sim::register_encoding;
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::spec::WorldSpec;
use regrind_sim::wire::Serving;
use regrind_sim::world::World;
use serde_json::json;
use tokio::sync::mpsc;

/// Job number of the part's run.
pub const JOB: u32 = 7;
/// Upper bound of the duration of a run, even on a loaded computer.
const PATIENCE: Duration = Duration::from_secs(3600);
/// Seconds of machine time per second.
const SPEED: f64 = 50_000.0;

/// Replacements for the free-form mirror with a sixth of its points.
const COARSE: [(&str, &str); 3] =
    [("columns = 60", "columns = 24"), ("rows = 30", "rows = 12"), ("cutoff_mm = 5.0", "cutoff_mm = 12.0")];

/// Changes that a test makes to a cell before it runs.
pub struct Setup {
    /// Name of the recipe, without its extension.
    pub recipe: &'static str,
    /// Seed of everything that is random in the world.
    pub seed: u64,
    /// Function that changes the truth.
    pub world: Box<dyn Fn(&mut WorldSpec) + Send>,
    /// True if the two machines are exchanged: each answers at the other's address.
    pub exchanged: bool,
    /// True if the word order of the machines' values is opposite to that in the cell file.
    pub other_word_order: bool,
    /// Version of the register map that both machines report.
    pub version: u16,
    /// Temperature limits of a measurement in the recipe.
    pub temperature_c: Option<[f64; 2]>,
    /// Thermal expansion of the part in the recipe.
    pub expansion_um_m_k: Option<f64>,
    /// True if touches are chosen.
    pub adaptive: bool,
    /// True for a sixth of the points, in tests that do not depend on their number.
    pub coarse: bool,
}

impl Setup {
    /// Returns a setup with a recipe as shipped, and a seed.
    pub fn new(recipe: &'static str, seed: u64) -> Self {
        let world = Box::new(|_: &mut WorldSpec| {});
        Self {
            recipe,
            seed,
            world,
            exchanged: false,
            other_word_order: false,
            version: 2,
            temperature_c: None,
            expansion_um_m_k: None,
            adaptive: false,
            coarse: false,
        }
    }

    /// Returns the same setup with a changed world.
    pub fn with(mut self, world: impl Fn(&mut WorldSpec) + Send + 'static) -> Self {
        self.world = Box::new(world);
        self
    }
}

/// State of the world when a cycle was measured.
pub struct Snapshot {
    /// Number of the cycle.
    pub cycle: u32,
    /// Placement of the part on the CMM.
    pub placement: Placement,
    /// Projections of the measured centres onto the nominal surface, as positions in the xy plane of the true model
    /// frame, in mm.
    pub places_mm: Vec<[f64; 2]>,
    /// Heights of the ball centre above the offset surface of the nominal at these positions, in mm.
    pub heights_mm: Vec<f64>,
    /// True for each position at which the ball finds no contact along the nominal normal. The height there is the true
    /// deviation without the ball.
    pub without_ball: Vec<bool>,
}

/// Result of a run.
pub struct Ran {
    /// How the run ended.
    pub ending: Ending,
    /// Notices, in order.
    pub notices: Vec<Notice>,
    /// Run folder, with the journal.
    pub folder: PathBuf,
    /// Simulated world, with the truth.
    pub world: World,
    /// State of the world at each measured cycle.
    pub snapshots: Vec<Snapshot>,
    /// Maximum PV and RMS that are accepted, in mm.
    pub tolerance_mm: [f64; 2],
    /// Probe radius that the recipe states, in mm.
    pub probe_radius_mm: f64,
    /// Number of passes that had started when the first alarm appeared that a person must clear, if there was one.
    pub passes_at_alarm: Option<usize>,
    _home: tempfile::TempDir,
}

impl Ran {
    /// Returns the table of cycles.
    pub fn rows(&self) -> Vec<CycleRow> {
        let rows = |n: &Notice| if let Notice::Finished { cycles, .. } = n { Some(cycles.clone()) } else { None };
        self.notices.iter().rev().find_map(rows).unwrap_or_default()
    }

    /// Returns all alarms, in order.
    pub fn alarms(&self) -> Vec<&Alarm> {
        self.notices.iter().filter_map(|n| if let Notice::Alarm(alarm) = n { Some(alarm) } else { None }).collect()
    }

    /// Returns true if the part was accepted.
    pub fn accepted(&self) -> bool {
        matches!(self.ending, Ending::Accepted { .. })
    }

    /// Returns all the text that a failed test should show.
    pub fn failure_text(&self) -> String {
        let alarms: Vec<_> = self.alarms().iter().map(|a| format!("{:?}: {}", a.id, a.event)).collect();
        let rows: Vec<_> = self
            .rows()
            .iter()
            .map(|r| format!("cycle {}: PV {:.2} RMS {:.3} um", r.cycle, r.pv_um, r.rms_um))
            .collect();
        format!("{:?}\n{}\n{}", self.ending, alarms.join("\n"), rows.join("\n"))
    }
}

/// Grinder that lets a test inspect the world just before every pass.
struct Watched<B> {
    body: B,
    before: Box<dyn FnMut() + Send>,
}

impl<B: Physics> Physics for Watched<B> {
    fn kind(&self) -> Kind {
        self.body.kind()
    }
    fn name(&self) -> String {
        self.body.name()
    }
    fn check(&self, kind: u16, payload: &Payload) -> Result<(), Refusal> {
        self.body.check(kind, payload)
    }
    fn prepare(&mut self, job: u32, cycle: u16, payloads: &Payloads) -> Result<Progress, Refusal> {
        self.body.prepare(job, cycle, payloads)
    }
    fn begin(&mut self) {
        (self.before)();
        self.body.begin();
    }
    fn advance(&mut self, seconds: f64) -> Progress {
        self.body.advance(seconds)
    }
    fn retract(&mut self) {
        self.body.retract();
    }
    fn end_job(&mut self, result: u16) -> ResultData {
        self.body.end_job(result)
    }
    fn interlocks(&self) -> u16 {
        self.body.interlocks()
    }
    fn temperature_c(&self) -> f64 {
        self.body.temperature_c()
    }
}

/// Recorder of the state of the world at each measured cycle.
struct WorldRecorder {
    world: World,
    folder: PathBuf,
    radius_mm: f64,
    taken: Mutex<Vec<Snapshot>>,
}

impl WorldRecorder {
    /// Records the state of the world at the newest measured cycle, once.
    fn record_state(&self) {
        let Self { world, folder, radius_mm, .. } = self;
        let mut taken = self.taken.lock().unwrap();
        let cycles = std::fs::read_dir(folder).unwrap().filter_map(|entry| {
            let name = entry.unwrap().file_name();
            name.to_str()?.strip_prefix("cycle-")?.parse::<u32>().ok()
        });
        let measured = |cycle: &u32| folder.join(format!("cycle-{cycle}/registration.json")).is_file();
        let Some(cycle) = cycles.filter(measured).max() else { return };
        if taken.iter().any(|t| t.cycle == cycle) {
            return;
        }
        let (placement, measured) = (world.placement(), table(&folder.join(format!("cycle-{cycle}/measured.csv"))));
        let centres = measured.iter().map(|row| back(&placement, [row[0], row[1], row[2]]));
        let places_mm: Vec<[f64; 2]> = centres.map(|centre| project_onto_nominal(world, centre).0).collect();
        // A touch at the very edge of the part may have its projection beyond the edge.
        let touched = ball_heights_mm(world, &places_mm, *radius_mm);
        let without_ball = touched.iter().map(Option::is_none).collect();
        let touched = touched.into_iter().zip(&places_mm);
        let heights_mm = touched.map(|(height, &[x, y])| height.unwrap_or_else(|| world.deviation_mm(x, y))).collect();
        taken.push(Snapshot { cycle, placement, places_mm, heights_mm, without_ball });
    }
}

/// Returns a true ball height in mm for each position (x, y) in `places_mm`, in the model frame. A ball of radius
/// `radius_mm` moves along the normal of the nominal surface at (x, y) until it touches the real surface. The height is
/// the distance of its centre from the nominal surface along this normal, minus the radius. In a groove, this height
/// differs from the deviation, because the ball touches the surface beside the normal.
///
/// A value is `None` if the contact is beyond the part, or if the height is not between -1 mm and 1 mm.
fn ball_heights_mm(world: &World, places_mm: &[[f64; 2]], radius_mm: f64) -> Vec<Option<f64>> {
    const REACH_MM: f64 = 1.0;
    let height_mm = |part: &Part, &[x, y]: &[f64; 2]| {
        let (point_mm, direction) = (part.shape.point(x, y), part.shape.normal(x, y));
        let way =
            Approach { point_mm, direction, radius_mm, from_mm: radius_mm + REACH_MM, to_mm: radius_mm - REACH_MM };
        let Contact::Touched { centre_mm, .. } = part.touch(&way) else { return None };
        Some((0..3).map(|i| (centre_mm[i] - point_mm[i]) * direction[i]).sum::<f64>() - radius_mm)
    };
    world.with_part(|part| places_mm.iter().map(|place| height_mm(part, place)).collect())
}

/// Transforms a point from the CMM's frame to the part's frame.
pub fn back(placement: &Placement, p: Vec3) -> Vec3 {
    let d: Vec3 = std::array::from_fn(|i| p[i] - placement.translation_mm[i]);
    std::array::from_fn(|k| (0..3).map(|i| placement.rotation[i][k] * d[i]).sum())
}

/// Projects a point onto the true nominal surface. Returns the position of the projection, the normal there, and the
/// distance.
///
/// Each iteration moves the projection by the residual along the surface. The residual shrinks by the ratio of distance
/// to radius of curvature.
pub fn project_onto_nominal(world: &World, p: Vec3) -> ([f64; 2], Vec3, f64) {
    let [mut x, mut y] = [p[0], p[1]];
    for _ in 0..40 {
        let (s, n) = world.nominal(x, y);
        let d: Vec3 = std::array::from_fn(|i| p[i] - s[i]);
        let along: f64 = (0..3).map(|i| d[i] * n[i]).sum();
        let [tx, ty] = [d[0] - along * n[0], d[1] - along * n[1]];
        (x, y) = (x + tx, y + ty);
        if tx.abs().max(ty.abs()) < 1e-12 {
            break;
        }
    }
    let (s, n) = world.nominal(x, y);
    ([x, y], n, (0..3).map(|i| (p[i] - s[i]) * n[i]).sum())
}

/// Reads a table of numbers under a header.
pub fn table(path: &std::path::Path) -> Vec<Vec<f64>> {
    let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let row = |line: &str| line.split(',').map(|cell| cell.trim().parse().unwrap()).collect();
    // First come comments, for example the mark of a simulation, then the header.
    text.lines().filter(|line| !line.starts_with('#')).skip(1).map(row).collect()
}

/// Runs a cell in its own runtime.
pub fn run(setup: Setup) -> Ran {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(async {
        let seed = setup.seed;
        let name = setup.recipe;
        tokio::time::timeout(PATIENCE, go(setup)).await.unwrap_or_else(|_| panic!("{name}, seed {seed}: no end"))
    })
}

async fn go(setup: Setup) -> Ran {
    let home = tempfile::tempdir().unwrap();
    let _kept = regrind_testutils::keep::KeepRunFolders(home.path().to_owned());
    let folder = home.path().join("run");
    let file = format!("recipes/{}.toml", setup.recipe);
    let text = if setup.coarse { changed(&file, &COARSE) } else { changed(&file, &[]) };
    let mut recipe = Recipe::parse(&root().join(&file), &text).unwrap_or_else(|problems| panic!("{problems:?}"));
    recipe.measure.temperature_c = setup.temperature_c;
    recipe.part.expansion_um_m_k = setup.expansion_um_m_k;
    if setup.adaptive {
        (recipe.measure.mode, recipe.measure.accepted_risk) = (SelectionMode::Adaptive, Some(0.025));
    }
    let cell = CellConfig::read(&root().join("config/sim.toml")).unwrap();
    let (task, plan) = setup::prepare(&recipe, &cell).unwrap();
    let tolerance_mm = [plan.tolerance.pv_mm, plan.tolerance.rms_mm];
    let world = world(&setup, &recipe);
    let radius_mm = recipe.measure.probe_radius_mm;
    let eye =
        Arc::new(WorldRecorder { world: world.clone(), folder: folder.clone(), radius_mm, taken: Mutex::default() });
    let (servings, [of_cmm, of_grinder]) = serve(&setup, &cell, &eye).await;
    let journal: Box<dyn JournalSink> = Box::new(Journal::create(&folder, header("test part")).unwrap());
    let (notices, mut shown) = mpsc::unbounded_channel();
    let poll = [Duration::from_millis(10); 2];
    let actor = Actor { name: "test".into(), station: "here".into() };
    let run = RunInputs {
        plan,
        task,
        journal,
        job: JOB,
        actor: actor.clone(),
        load_confirmed: true,
        poll_intervals: poll,
        notices,
        interrupted: None,
        executor: BlockingExecutor::Threads,
    };
    let cmm = ModbusCmm::new(of_cmm).unwrap();
    let grinder = ModbusGrinder::new(of_grinder).unwrap();
    let (drive, orders) = Drive::new(run, cmm, grinder).unwrap();
    let driving = tokio::spawn(drive.run());
    let mut seen = Vec::new();
    let mut passes_at_alarm = None;
    while let Some(notice) = shown.recv().await {
        let person = matches!(&notice, Notice::Alarm(alarm) if alarm.cleared_by != Role::Nobody && alarm.id != AlarmId::Diverging);
        seen.push(notice);
        if person && passes_at_alarm.is_none() {
            passes_at_alarm = Some(world.history().len());
            let (folder, orders, actor) = (folder.clone(), orders.clone(), actor.clone());
            // A held cell waits for a person. This task ends the run instead.
            tokio::spawn(async move {
                if rests(folder).await {
                    orders.send(Request::Stop { reason: "the test has seen enough".into() }, actor).await;
                }
            });
        }
    }
    let ending = driving.await.unwrap();
    eye.record_state();
    drop(servings);
    let (snapshots, probe_radius_mm) = (std::mem::take(&mut *eye.taken.lock().unwrap()), eye.radius_mm);
    Ran { ending, notices: seen, folder, world, snapshots, tolerance_mm, probe_radius_mm, passes_at_alarm, _home: home }
}

/// Waits until the cell is held. Returns false if the run ended by itself.
async fn rests(folder: PathBuf) -> bool {
    loop {
        let folder = folder.clone();
        let reply = tokio::task::spawn_blocking(move || send_request(&folder, &Request::Status)).await.unwrap();
        match reply {
            Ok(reply) if reply.status.state == StateName::Held => return true,
            Ok(_) => tokio::time::sleep(Duration::from_millis(5)).await,
            Err(_) => return false,
        }
    }
}

/// Returns the first record of a run of a part.
pub fn header(part: &str) -> Header {
    Header {
        run: "run".into(),
        part: part.into(),
        actor: "test".into(),
        station: "here".into(),
        simulation: true,
        first_command_id: 1,
        content: json!({}),
    }
}

fn world(setup: &Setup, recipe: &Recipe) -> World {
    let table = recipe.simulation.clone().expect("the recipe has a world");
    let mut spec = table.try_into::<WorldSpec>().unwrap();
    spec.seed = setup.seed;
    spec.speed = SPEED;
    (setup.world)(&mut spec);
    World::new(spec).unwrap()
}

/// Serves both machines on their own ports, and gives the drivers of the cell the addresses.
async fn serve(setup: &Setup, cell: &CellConfig, eye: &Arc<WorldRecorder>) -> ([Serving; 2], [ModbusSettings; 2]) {
    let options = |seed| MachineOptions {
        speed: SPEED,
        seed,
        // A client on a loaded computer must not look like a client that is gone.
        lost_after_ms: 30_000,
        acting: Duration::from_millis(10),
        word_order: if setup.other_word_order {
            register_encoding::WordOrder::Little
        } else {
            register_encoding::WordOrder::Big
        },
        version: setup.version,
        ..MachineOptions::default()
    };
    let (world, eye) = (&eye.world, eye.clone());
    let before: Box<dyn FnMut() + Send> = Box::new(move || eye.record_state());
    let grinder = Watched { body: world.grinder(), before };
    let cmm = SimulatedMachine::new(Box::new(world.cmm()), 0xc, options(setup.seed));
    let grinder = SimulatedMachine::new(Box::new(grinder), 0x9, options(setup.seed + 1));
    let mut links = [cell.cmm.link.clone(), cell.grinder.link.clone()];
    let [cmm_unit, grinder_unit] = if setup.exchanged { [2, 1] } else { [1, 2] };
    let cmm = Serving::tcp("127.0.0.1:0", vec![(cmm_unit, cmm)]).await.unwrap();
    let grinder = Serving::tcp("127.0.0.1:0", vec![(grinder_unit, grinder)]).await.unwrap();
    let mut ports = [&cmm, &grinder].map(|serving| serving.local_addr().unwrap().port());
    if setup.exchanged {
        ports.reverse();
    }
    for (link, bound) in links.iter_mut().zip(ports) {
        if let Wire::ModbusTcp(tcp) = &mut link.wire {
            tcp.port = bound;
        }
        link.timing.request_timeout = Duration::from_secs(5);
        link.timing.lost_after = Duration::from_secs(60);
    }
    let settings = links.map(|link| setup::modbus_settings(&link, true, 0x7e57, 1).unwrap());
    ([cmm, grinder], settings)
}
