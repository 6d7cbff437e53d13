//! No computation delays the communication with the machines: heartbeats and orders while 113,201 points are registered
//! and compensated.
//!
//! The machines, their wires and the drive are those of every simulated run. Only the points do not all come over the
//! wire: between driver and drive is a measuring machine that measures the first few targets and synthesizes the rest.

use std::time::Duration;

use regrind::cell::Ending;
use regrind::device::{
    Armed, Cmm, DeviceError, Identified, Identity, Interrupt, Job, Machine, MeasuredPoint, Measurement, ModbusCmm,
    Plan, Reconciled, Started, Status, TouchStatus, digest,
};
use regrind::drive::{Drive, Request};
use regrind_testcell::rig::{CMM, GRINDER, PATIENCE, Rig, event, order, until, words};

const POINTS: usize = 113_201;
/// Number of targets that are really measured: the reference sphere and a few more.
const FEW: usize = 40;

/// Measuring machine that synthesizes most of its points.
struct Generous {
    cmm: ModbusCmm,
    wanted: Option<Plan>,
    few: u32,
}

impl Machine for Generous {
    regrind_testcell::through!(cmm: name, connect, status, claim, start, hold, resume, stop, abort, clear, acknowledge, release, reconcile);

    async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
        self.cmm.prepare(Job { digest: self.few, ..job }).await
    }
}

impl Cmm for Generous {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        let few = Plan { targets: plan.targets[..FEW].to_vec(), ..plan.clone() };
        self.few = digest(&[few.identity()]);
        self.wanted = Some(plan.clone());
        self.cmm.load_plan(&few, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        let measured = self.cmm.collect(job, interrupt).await?;
        let plan = self.wanted.as_ref().expect("a plan was loaded");
        let sample = measured.points[0];
        let points = plan.targets.iter().map(|t| {
            // Waves of 10 µm, so that there is something to compensate.
            let [x, y, _] = t.point_mm;
            let proud_mm = if (t.index as usize) < FEW { 0.0 } else { 0.01 * (x / 9.0).sin() * (y / 7.0).cos() };
            let out_mm = plan.probe_radius_mm + proud_mm;
            let at_mm = std::array::from_fn(|k| t.point_mm[k] + out_mm * t.normal[k]);
            MeasuredPoint { index: t.index, status: TouchStatus::Touched, position_mm: at_mm, ..sample }
        });
        Ok(Measurement { points: points.collect(), plan_identity: plan.identity(), ..measured })
    }
}

fn recipe() -> regrind::recipe::Recipe {
    regrind_testcell::rig::recipe(&[
        ("columns = 60", "columns = 451"),
        ("rows = 30", "rows = 251"),
        ("accuracy_nm = 0.5", "spacing_mm = 0.236"),
        // A filter over thousands of points for each point would only take long.
        ("cutoff_mm = 5.0", "cutoff_mm = 2.0"),
        ("[simulation]\nseed = 1", "[simulation]\nseed = 1\nspeed = 5000.0"),
    ])
}

/// Returns the number of heartbeats that have arrived at each machine.
fn beats(rig: &Rig) -> [usize; 2] {
    [CMM, GRINDER].map(|machine| rig.came[machine].lock().unwrap().iter().filter(|came| came.beat).count())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn heartbeats_continue_during_computation() {
    let mut rig = Rig::new(recipe()).await;
    let ready = rig.next(true);
    let (folder, mut notices) = (ready.folder, ready.notices);
    assert!(ready.run.task.nominal.len() >= POINTS && ready.run.task.targets.len() == POINTS);
    let cmm = Generous { cmm: ready.cmm, wanted: None, few: 0 };
    let (drive, _orders) = Drive::new(ready.run, cmm, ready.grinder).unwrap();
    let running = tokio::spawn(drive.run());
    // Registration of the points starts with the acknowledgement of the measurement.
    event(&mut notices, "acknowledged", 2).await;
    let (reply, ..) = order(&folder, Request::Hold { reason: "while it computes".into(), state_number: None }).await;
    assert!(reply.message.starts_with("Holding (Register"), "{}", reply.message);
    let (before, mut meanwhile) = (beats(&rig), beats(&rig));
    let computing = async {
        while words(&folder).await.starts_with("Holding (Register") {
            meanwhile = beats(&rig);
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(4 * PATIENCE, computing).await.expect("the registration ends");
    for machine in [CMM, GRINDER] {
        let came = meanwhile[machine] - before[machine];
        assert!(came >= 2, "{came} beats came to machine {machine} while the points were registered");
    }
    until(&folder, |words| words.starts_with("Held")).await;
    order(&folder, Request::Resume { reason: String::new(), state_number: None }).await;
    // The judgement is immediate. Now the map is computed from 113,201 deviations.
    let (reply, asked, _) = order(&folder, Request::Abort { reason: "while it computes".into() }).await;
    assert!(reply.accepted, "{reply:?}");
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { confirmed: true, .. }), "{ending:?}");
    for machine in [CMM, GRINDER] {
        assert!(rig.command_at(machine, 7, asked).is_some(), "no ABORT came to machine {machine}");
    }
}
