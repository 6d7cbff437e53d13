//! Test bench: a driver, the simulated server with the true part, and jobs between them.

use std::time::{Duration, Instant};

use regrind::device::Interrupt;
use regrind::device::ippdme::Limits;
use regrind::device::{
    Armed, Cmm, DeviceError, Identified, IppdmeCmm, IppdmeSettings, Job, Machine, MachineState, Measurement, Plan,
    PlanTarget, Status, TargetKind, TouchStatus, digest,
};
use regrind_sim::dme::Server;
use regrind_sim::dme::faults::CommandFaults;
use regrind_sim::dme::machine::{self, Options};
use regrind_sim::spec::{CmmSpec, WorldSpec};
use regrind_sim::wire::lines::ServingLines;
use regrind_sim::world::World;
use regrind_testcell::perfect::perfect_cmm;

pub const RADIUS_MM: f64 = 1.5;

/// Timeout longer than anything takes on a busy computer.
const LONG: Duration = Duration::from_secs(60);

pub struct Bench {
    pub world: World,
    pub faults: CommandFaults,
    pub serving: ServingLines<Server>,
    pub cmm: IppdmeCmm,
}

/// Returns limits that no delay reaches by chance.
pub fn patient() -> Limits {
    Limits {
        answer: Duration::from_secs(20),
        completion: Duration::from_secs(20),
        abort: Duration::from_secs(20),
        after_abort: Duration::from_millis(2),
        alive: Duration::from_millis(200),
    }
}

/// Returns limits for answers that never come.
pub fn hasty() -> Limits {
    let short = Duration::from_millis(400);
    Limits { answer: short, completion: short, abort: short, ..patient() }
}

pub fn settings(port: u16, limits: Limits) -> IppdmeSettings {
    IppdmeSettings {
        host: "127.0.0.1".into(),
        port,
        tool: "Probe1".into(),
        probe_tolerance_mm: 0.01,
        travel_speed_mm_s: 100.0,
        scan: None,
        part_frame: None,
        retries: 1,
        volume_mm: [[-500.0, -500.0, -300.0], [500.0, 500.0, 400.0]],
        limits,
        silence_limit: Duration::from_secs(20),
        expected_name: None,
        simulated: true,
    }
}

impl Bench {
    /// Returns a cell whose machine's time runs at this multiple of real time.
    pub async fn new(speed: f64, limits: Limits) -> Self {
        Self::with(speed, limits, Options::default()).await
    }

    pub async fn with(speed: f64, limits: Limits, options: Options) -> Self {
        Self::measuring(perfect_cmm(), speed, limits, options).await
    }

    pub async fn measuring(cmm: CmmSpec, speed: f64, limits: Limits, options: Options) -> Self {
        let world = World::new(WorldSpec { cmm, ..WorldSpec::default() }).unwrap();
        let faults = CommandFaults::none();
        let server = Server::new(machine::DmeMachine::new(world.touch_probe(), options), speed, faults.clone());
        let serving = ServingLines::tcp("127.0.0.1:0", server).await.unwrap();
        let cmm = IppdmeCmm::new(settings(serving.local_addr().port(), limits));
        Self { world, faults, serving, cmm }
    }

    /// Returns another program's connection to the machine.
    pub fn another(&self) -> IppdmeCmm {
        IppdmeCmm::new(settings(self.serving.local_addr().port(), patient()))
    }

    /// Returns a plan with this number of targets on the part, in an order that is not a short path.
    pub fn plan(&self, count: u32) -> Plan {
        let target = |index: u32| {
            let k = (index * 7) % count;
            let (x, y) = (f64::from(k % 5) * 6.0 - 12.0, f64::from(k / 5) * 6.0 - 6.0);
            let (point_mm, normal) = self.world.nominal(x, y);
            PlanTarget { index: 10 + index, kind: TargetKind::Part, point_mm, normal }
        };
        Plan {
            targets: (0..count).map(target).collect(),
            probe_radius_mm: RADIUS_MM,
            approach_mm: 2.0,
            search_mm: 2.0,
            speed_mm_s: 3.0,
            safe_height_mm: 20.0,
            careful_start: None,
        }
    }

    /// Connects to the machine, transfers a plan and begins it.
    pub async fn begin(&mut self, plan: &Plan) -> Result<Armed, DeviceError> {
        self.cmm.connect().await?;
        begin(&mut self.cmm, plan).await
    }

    /// Asserts that every touched point lies on the true part.
    pub fn assert_on_part(&self, plan: &Plan, measurement: &Measurement) {
        assert_eq!(measurement.points.len(), plan.targets.len());
        for (point, target) in measurement.points.iter().zip(&plan.targets) {
            assert_eq!(point.index, target.index, "points come in the order of the plan");
            if point.status != TouchStatus::Touched {
                continue;
            }
            let along: f64 = (0..3).map(|k| (point.position_mm[k] - target.point_mm[k]) * target.normal[k]).sum();
            let [x, y, _] = target.point_mm;
            let off_mm = along - RADIUS_MM - self.world.deviation_mm(x, y);
            assert!(off_mm.abs() < 1e-3, "target {} is off by {off_mm} mm", target.index);
        }
    }
}

pub fn job(plan: &Plan) -> Job {
    Job { job: 7, cycle: 1, digest: digest(&[plan.identity()]) }
}

pub async fn begin(cmm: &mut IppdmeCmm, plan: &Plan) -> Result<Armed, DeviceError> {
    cmm.claim().await?;
    cmm.load_plan(plan, &Interrupt::new()).await?;
    let armed = cmm.prepare(job(plan)).await?;
    cmm.start(armed.clone()).await?;
    Ok(armed)
}

/// Polls until the status satisfies the condition; a communication error ends it.
pub async fn until(cmm: &mut IppdmeCmm, is_so: impl Fn(&Status) -> bool) -> Result<Status, DeviceError> {
    let began = Instant::now();
    loop {
        let status = cmm.status().await?;
        if is_so(&status) {
            return Ok(status);
        }
        assert!(began.elapsed() < LONG, "it does not come to it: {status:?}, {:?}", cmm.notes());
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// Polls until nothing moves any more.
pub async fn until_still(cmm: &mut IppdmeCmm) -> Result<Status, DeviceError> {
    until(cmm, |status| !status.state.is_moving()).await
}

/// Polls until this number of points is present.
pub async fn until_points(cmm: &mut IppdmeCmm, count: u32) {
    until(cmm, |status| status.progress.is_some_and(|(done, _)| done >= count)).await.unwrap();
}

pub fn has_state(status: &Status, state: MachineState) -> bool {
    status.state == state
}
