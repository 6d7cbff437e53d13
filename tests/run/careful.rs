//! After a measurement that a gate refused, the part may have a new seating: the next plan begins with few targets, and
//! slowly.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use regrind::cell::AlarmId;
use regrind::device::{
    Armed, Cmm, DeviceError, Identity, Interrupt, Job, Machine, Measurement, ModbusCmm, Plan, Reconciled, Started,
    Status, TargetKind,
};
use regrind::drive::{Drive, Notice, Request};
use regrind_testcell::rig::{PATIENCE, Rig, event, order, small, until};

/// Measuring machine whose first measurement is wrong. It stores the plans that it receives.
struct Odd {
    cmm: ModbusCmm,
    first: Option<fn(&mut Measurement)>,
    plans: Arc<Mutex<Vec<Plan>>>,
}

impl Machine for Odd {
    regrind_testcell::through!(cmm: name, connect, status, claim, prepare, start, hold, resume, stop, abort, clear, acknowledge, release, reconcile);
}

impl Cmm for Odd {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.plans.lock().unwrap().push(plan.clone());
        self.cmm.load_plan(plan, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        let mut measured = self.cmm.collect(job, interrupt).await?;
        if let Some(change) = self.first.take() {
            change(&mut measured);
        }
        Ok(measured)
    }
}

/// Returns the positions of the part's targets, exact to the last bit.
fn places(plan: &Plan) -> BTreeSet<[u64; 3]> {
    let part = plan.targets.iter().filter(|target| target.kind == TargetKind::Part);
    part.map(|target| target.point_mm.map(f64::to_bits)).collect()
}

/// Returns the minimum distance between any two of the first `of` targets, in mm.
fn min_apart_mm(plan: &Plan, of: usize) -> f64 {
    let at = |k: usize| plan.targets[k].point_mm;
    let apart = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
    let pairs = (0..of).flat_map(|a| (0..a).map(move |b| (a, b)));
    pairs.map(|(a, b)| apart(at(a), at(b))).fold(f64::INFINITY, f64::min)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn careful_start_after_refused_measurement() {
    let mut rig = Rig::new(small(20, 10, 5000.0)).await;
    rig.recipe.measure.temperature_c = Some([19.0, 21.0]);
    let ready = rig.next(true);
    let (folder, mut notices, plans) = (ready.folder, ready.notices, Arc::default());
    let first: fn(&mut Measurement) = |measured| measured.temperature_c = Some(30.0);
    let cmm = Odd { cmm: ready.cmm, first: Some(first), plans: Arc::clone(&plans) };
    let (drive, _orders) = Drive::new(ready.run, cmm, ready.grinder).unwrap();
    let running = tokio::spawn(drive.run());
    until(&folder, |words| words.starts_with("Held (Measure, Send)")).await;
    order(&folder, Request::Resume { reason: "seated anew".into(), state_number: None }).await;
    event(&mut notices, "compensated", 1).await;
    let began = Instant::now();
    while plans.lock().unwrap().len() < 3 {
        assert!(began.elapsed() < PATIENCE, "no measurement after the next pass");
        tokio::time::sleep(std::time::Duration::from_millis(5)).await;
    }
    order(&folder, Request::Abort { reason: "seen enough".into() }).await;
    running.await.unwrap();
    let plans: Vec<Plan> = plans.lock().unwrap().clone();
    let [first, again, later] = &plans[..3] else { unreachable!() };
    assert_eq!((first.careful_start, later.careful_start), (None, None), "where the part lies as it was found");
    let careful = again.careful_start.expect("the part may lie elsewhere");
    assert_eq!((careful.target_count, careful.speed_mm_s), (9, 0.2 * again.speed_mm_s));
    assert!(again.targets[..9].iter().all(|target| target.kind == TargetKind::Part));
    assert!(again.targets.iter().enumerate().all(|(k, target)| target.index as usize == k));
    // The same positions, with the first of them far apart.
    assert_eq!((places(again), again.targets.len()), (places(first), first.targets.len()));
    let wide = min_apart_mm(again, 9);
    assert!(wide > 10.0, "{wide} mm apart");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn result_of_other_probe_radius_refused() {
    let mut rig = Rig::new(small(20, 10, 5000.0)).await;
    let ready = rig.next(true);
    let (folder, mut notices) = (ready.folder, ready.notices);
    let first: fn(&mut Measurement) = |measured| measured.probe_radius_mm = measured.probe_radius_mm.map(|mm| 1.1 * mm);
    let cmm = Odd { cmm: ready.cmm, first: Some(first), plans: Arc::default() };
    let (drive, _orders) = Drive::new(ready.run, cmm, ready.grinder).unwrap();
    let running = tokio::spawn(drive.run());
    let told = async {
        loop {
            match notices.recv().await.expect("the run goes on") {
                Notice::Alarm(alarm) => return alarm,
                Notice::Finished { ending, .. } => panic!("over: {ending:?}"),
                _ => {}
            }
        }
    };
    let alarm = tokio::time::timeout(PATIENCE, told).await.expect("an alarm");
    assert_eq!(alarm.id, AlarmId::BrokenResult, "{alarm:?}");
    assert!(alarm.event.contains("mm, but the recipe has"), "{}", alarm.event);
    until(&folder, |words| words.starts_with("Held (Measure, Send)")).await;
    order(&folder, Request::Abort { reason: "seen enough".into() }).await;
    running.await.unwrap();
}
