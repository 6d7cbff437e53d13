//! A driver that panics: the panic is reported as a panic, and the run reaches its end without that machine.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use regrind::cell::{AlarmId, Device, Ending};
use regrind::device::{
    Armed, CorrectionMap, DeviceError, Grinder, Identity, Interrupt, Job, Machine, ModbusGrinder, Pass, PassRecord,
    Reconciled, Started, Status,
};
use regrind::drive::{Drive, Notice, Request};
use regrind_sim::command::State;
use regrind_testcell::rig::{CMM, GRINDER, PATIENCE, Rig, event, order, small, until};

/// Grinder whose driver has a fault.
struct Brittle {
    grinder: ModbusGrinder,
    breaks: Arc<AtomicBool>,
}

impl Machine for Brittle {
    regrind_testcell::through!(grinder: name, connect, claim, prepare, start, hold, resume, stop, abort, clear, acknowledge, release, reconcile);

    async fn status(&mut self) -> Result<Status, DeviceError> {
        assert!(!self.breaks.load(Ordering::Acquire), "an index that was out of bounds");
        self.grinder.status().await
    }
}

impl Grinder for Brittle {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.grinder.load_pass(map, pass, interrupt).await
    }
    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
        self.grinder.collect(job, interrupt).await
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn panicking_driver_raises_alarm() {
    let mut rig = Rig::new(small(20, 10, 1.0)).await;
    let ready = rig.next(true);
    let (folder, mut notices) = (ready.folder, ready.notices);
    let breaks = Arc::new(AtomicBool::new(false));
    let grinder = Brittle { grinder: ready.grinder, breaks: Arc::clone(&breaks) };
    let (drive, _orders) = Drive::new(ready.run, ready.cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "started", 1).await;
    breaks.store(true, Ordering::Release);
    let told = async {
        loop {
            match notices.recv().await.expect("the run goes on") {
                Notice::Alarm(alarm) => return alarm,
                Notice::Finished { ending, .. } => panic!("over: {ending:?}"),
                _ => {}
            }
        }
    };
    let alarm = tokio::time::timeout(PATIENCE, told).await.expect("it is told");
    assert_eq!(alarm.id, AlarmId::ProgramFailed, "{alarm:?}");
    // The message of the panic is named too.
    for piece in ["grinder", "out of bounds"] {
        assert!(alarm.event.contains(piece), "{piece}: {}", alarm.event);
    }
    until(&folder, |words| words.starts_with("Held")).await;
    let (reply, ..) = order(&folder, Request::Status).await;
    assert_eq!(reply.status.unconfirmed, [Device::Grinder], "{reply:?}");
    // Nothing sends heartbeats for it any more.
    let held = async {
        while rig.servings[GRINDER].machines()[0].1.with(|machine| machine.state()) != State::Held {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(PATIENCE, held).await.expect("the machine holds itself");
    let (reply, asked, _) = order(&folder, Request::Abort { reason: "no way on".into() }).await;
    assert!(reply.accepted, "{reply:?}");
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Aborted { confirmed: false, .. }), "{ending:?}");
    assert!(rig.command_at(CMM, 7, asked).is_some(), "the other machine hears the abort");
}
