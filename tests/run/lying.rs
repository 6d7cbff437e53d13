//! Machines that report false states, or lose data. The program believes a machine only as far as its report can be
//! true, and offers the person a way to continue that works.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use regrind::cell::{AlarmId, Device, Ending};
use regrind::device::{
    Armed, Cmm, CorrectionMap, DeviceError, Grinder, Identity, Interrupt, Job, Machine, MachineState, Measurement,
    ModbusCmm, ModbusGrinder, Outcome, Pass, PassRecord, Plan, Reconciled, Started, Status,
};
use regrind::drive::{Drive, Notice, Request};
use regrind_testcell::rig::{PATIENCE, Ready, Rig, event, order, small, until};
use tokio::sync::mpsc::UnboundedReceiver;

/// Function that changes a machine's reported status.
type Says = Box<dyn FnMut(&mut Status) + Send>;

/// Grinder that reports a prescribed status, and whose first answers to PREPARE are lost.
struct ScriptedGrinder {
    grinder: ModbusGrinder,
    says: Says,
    lost: u32,
}

impl ScriptedGrinder {
    fn saying(grinder: ModbusGrinder, says: impl FnMut(&mut Status) + Send + 'static) -> Self {
        Self { grinder, says: Box::new(says), lost: 0 }
    }
}

impl Machine for ScriptedGrinder {
    regrind_testcell::through!(grinder: name, connect, claim, start, hold, resume, stop, abort, clear, acknowledge, release, reconcile);

    async fn status(&mut self) -> Result<Status, DeviceError> {
        let mut status = self.grinder.status().await?;
        (self.says)(&mut status);
        Ok(status)
    }

    async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
        let armed = self.grinder.prepare(job).await?;
        if self.lost == 0 {
            return Ok(armed);
        }
        self.lost -= 1;
        Err(DeviceError::TimedOut {
            machine: "the grinder".into(),
            operation: "status",
            limit: Duration::from_millis(500),
        })
    }
}

impl Grinder for ScriptedGrinder {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.grinder.load_pass(map, pass, interrupt).await
    }
    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
        self.grinder.collect(job, interrupt).await
    }
}

/// Function that changes the result of a measurement.
type Fate = Box<dyn FnMut(&mut Measurement) + Send>;

/// Measuring machine that applies one fate after the other to its results. The first result may be discarded at its
/// panel before it is read.
struct Odd {
    cmm: ModbusCmm,
    discarded: u32,
    fates: VecDeque<Fate>,
}

impl Machine for Odd {
    regrind_testcell::through!(cmm: name, connect, status, claim, prepare, start, hold, resume, stop, abort, clear, acknowledge, release, reconcile);
}

impl Cmm for Odd {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.cmm.load_plan(plan, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        if self.discarded > 0 {
            self.discarded -= 1;
            let done = self.cmm.status().await?.done;
            self.cmm.acknowledge(done).await?;
        }
        let mut measured = self.cmm.collect(job, interrupt).await?;
        if let Some(mut fate) = self.fates.pop_front() {
            fate(&mut measured);
        }
        Ok(measured)
    }
}

/// Waits for the next alarm.
async fn alarm(notices: &mut UnboundedReceiver<Notice>) -> (AlarmId, String) {
    let told = async {
        loop {
            match notices.recv().await.expect("the run goes on") {
                Notice::Alarm(alarm) => return (alarm.id, alarm.event),
                Notice::Finished { ending, .. } => panic!("over: {ending:?}"),
                _ => {}
            }
        }
    };
    tokio::time::timeout(PATIENCE, told).await.expect("an alarm")
}

async fn resume(folder: &std::path::Path) {
    let (reply, ..) = order(folder, Request::Resume { reason: "seen to".into(), state_number: None }).await;
    assert!(reply.accepted, "{reply:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_prepare_answer_is_retried() {
    let mut rig = Rig::new(small(20, 10, 5000.0)).await;
    let Ready { run, cmm, grinder, mut notices, .. } = rig.next(true);
    let (drive, _orders) =
        Drive::new(run, cmm, ScriptedGrinder { lost: 2, ..ScriptedGrinder::saying(grinder, |_| ()) }).unwrap();
    let ending = tokio::time::timeout(PATIENCE, tokio::spawn(drive.run())).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Accepted { .. }), "{ending:?}");
    let mut alarms = Vec::new();
    while let Ok(notice) = notices.try_recv() {
        alarms.extend(if let Notice::Alarm(alarm) = notice { Some(alarm.id) } else { None });
    }
    // The link was lost twice, and nothing was refused.
    assert!(alarms.iter().all(|id| *id == AlarmId::LinkLost) && !alarms.is_empty(), "{alarms:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn vanished_job_is_not_ground_twice() {
    let mut rig = Rig::new(small(20, 10, 400.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let seen = Arc::new(Mutex::new(0));
    let count = Arc::clone(&seen);
    // For some polls after its start the machine reports that it is idle, without a job, although its work continues.
    let says = move |status: &mut Status| {
        let mut seen = count.lock().unwrap();
        *seen += u32::from(status.state == MachineState::Execute);
        if *seen > 3 && *seen < 12 {
            *status = Status { state: MachineState::Idle, job: None, progress: Some((0, 0)), ..status.clone() };
        }
    };
    let (drive, _orders) = Drive::new(run, cmm, ScriptedGrinder::saying(grinder, says)).unwrap();
    let running = tokio::spawn(drive.run());
    let (id, what) = alarm(&mut notices).await;
    assert_eq!(id, AlarmId::JobVanished, "{what}");
    assert!(what.contains("grinder, it is IDLE"), "{what}");
    // The program asks the machine and finds it at its job: nothing is lost, and nothing starts twice.
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Accepted { .. }), "{ending:?}");
    let starts = regrind::journal::Reader::open(&folder).unwrap();
    let starts: Vec<_> = starts.records(1).map(|record| record.unwrap().value()).collect();
    let of = |value: &&serde_json::Value| value["command"] == "start_machine" && value["device"] == "grinder";
    let cycles: Vec<_> = starts.iter().filter(of).map(|start| start["cycle"].clone()).collect();
    let mut once = cycles.clone();
    once.dedup();
    assert_eq!(cycles, once);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn discarded_result_is_measured_again() {
    let mut rig = Rig::new(small(20, 10, 5000.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let cmm = Odd { cmm, discarded: 1, fates: VecDeque::new() };
    let (drive, _orders) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    let (id, what) = alarm(&mut notices).await;
    assert_eq!(id, AlarmId::MachineRefused, "{what}");
    until(&folder, |words| words.starts_with("Held (Measure, Collect)")).await;
    let over = Request::Over { device: Device::Cmm, evidence: "its panel shows no result".into() };
    assert!(order(&folder, over).await.0.accepted);
    until(&folder, |words| words.starts_with("Held (Measure, Send)")).await;
    resume(&folder).await;
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Accepted { .. }), "{ending:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn progress_while_held_aborts() {
    let mut rig = Rig::new(small(20, 10, 20.0)).await;
    let Ready { run, cmm, grinder, mut notices, .. } = rig.next(true);
    let says = |status: &mut Status| {
        if status.state == MachineState::Execute {
            status.state = MachineState::Held;
        }
    };
    let (drive, _orders) = Drive::new(run, cmm, ScriptedGrinder::saying(grinder, says)).unwrap();
    let running = tokio::spawn(drive.run());
    assert_eq!(alarm(&mut notices).await.0, AlarmId::MachineHeldItself);
    let (id, what) = alarm(&mut notices).await;
    assert_eq!(id, AlarmId::HoldNotConfirmed, "{what}");
    assert!(what.contains("HELD") && what.contains("progress"), "{what}");
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { .. }), "{ending:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stop_not_executed_aborts() {
    let mut rig = Rig::new(small(20, 10, 1.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let says = |status: &mut Status| {
        if matches!(status.state, MachineState::Stopping | MachineState::Complete) {
            status.state = MachineState::Execute;
        }
    };
    let (drive, _orders) = Drive::new(run, cmm, ScriptedGrinder::saying(grinder, says)).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "started", 1).await;
    assert!(order(&folder, Request::Stop { reason: "enough".into() }).await.0.accepted);
    let (id, what) = alarm(&mut notices).await;
    assert_eq!(id, AlarmId::StopNotConfirmed, "{what}");
    assert!(what.contains("STOP") && what.contains("EXECUTE"), "{what}");
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { .. }), "{ending:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn complete_at_40_percent_refused() {
    let mut rig = Rig::new(small(20, 10, 5000.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let says = |status: &mut Status| {
        if status.state == MachineState::Complete && status.outcome == Outcome::Complete {
            status.progress = Some((400, 1000));
        }
    };
    let (drive, _orders) = Drive::new(run, cmm, ScriptedGrinder::saying(grinder, says)).unwrap();
    let running = tokio::spawn(drive.run());
    let (id, what) = alarm(&mut notices).await;
    assert_eq!(id, AlarmId::PassRecord, "{what}");
    assert!(what.contains("400 of 1000"), "{what}");
    until(&folder, |words| words.starts_with("Held (Transfer)")).await;
    order(&folder, Request::Abort { reason: "seen enough".into() }).await;
    running.await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn impossible_measurement_refused() {
    let mut rig = Rig::new(small(20, 10, 5000.0)).await;
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let kept: Arc<Mutex<Option<Measurement>>> = Arc::default();
    let given = Arc::clone(&kept);
    let fates: Vec<(Fate, AlarmId, &str)> = vec![
        (Box::new(|of| of.temperature_c = Some(-327.0)), AlarmId::BrokenResult, "the temperature is -327"),
        (Box::new(|of| of.duration_s = Some(-5.0)), AlarmId::BrokenResult, "the duration is -5 s"),
        (Box::new(|of| of.probe_radius_mm = Some(0.0)), AlarmId::BrokenResult, "radius is 0 mm"),
        (Box::new(|of| of.points[3].quality = 101), AlarmId::BrokenResult, "of a point is 101"),
        (Box::new(|of| of.points[40].position_mm[2] = 1e30), AlarmId::BrokenResult, "a coordinate is 1000000"),
    ];
    let told: Vec<_> = fates.iter().map(|(_, id, words)| (*id, *words)).collect();
    let mut fates: VecDeque<Fate> = fates.into_iter().map(|(fate, ..)| fate).collect();
    // A good result, and then the same result again under the numbers of the next cycle.
    fates.push_back(Box::new(move |of| *kept.lock().unwrap() = Some(of.clone())));
    fates.push_back(Box::new(move |of| {
        let old = given.lock().unwrap().clone().expect("the one before");
        of.points.clone_from(&old.points);
    }));
    let cmm = Odd { cmm, discarded: 0, fates };
    let (drive, _orders) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    for (expected, words) in told {
        let (id, what) = alarm(&mut notices).await;
        assert_eq!(id, expected, "{what}");
        assert!(what.contains(words), "{what} without {words}");
        until(&folder, |words| words.starts_with("Held (Measure, Send)")).await;
        resume(&folder).await;
    }
    let (id, what) = alarm(&mut notices).await;
    assert_eq!(id, AlarmId::ForeignResult, "{what}");
    assert!(what.contains("identical") && what.contains("cycle 6"), "{what}");
    order(&folder, Request::Abort { reason: "seen enough".into() }).await;
    running.await.unwrap();
}
