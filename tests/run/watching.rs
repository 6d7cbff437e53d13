//! Supervision of the machine that has no job at the moment: keys that are turned, jobs that nobody ordered, an older
//! contract.

use std::time::{Duration, Instant};

use regrind::cell::{Alarm, AlarmId, Ending};
use regrind::drive::{Drive, Notice, Request};
use regrind_sim::command::{Mode, State, interlock};
use regrind_testcell::rig::{CMM, GRINDER, PATIENCE, Ready, Rig, event, order, small, until};
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::task::JoinHandle;

const HOLD: u16 = 4;
const RESUME: u16 = 5;

/// Starts a run whose grinder grinds slowly enough to last for the whole test.
async fn grinding(rig: &mut Rig) -> (Watched, JoinHandle<Ending>) {
    let Ready { run, cmm, grinder, mut notices, folder } = rig.next(true);
    let (drive, orders) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    event(&mut notices, "started", 1).await;
    (Watched { notices, folder, _orders: orders }, running)
}

/// State that a test keeps of an active run.
struct Watched {
    notices: UnboundedReceiver<Notice>,
    folder: std::path::PathBuf,
    _orders: regrind::drive::OrderSender,
}

impl Watched {
    async fn alarm(&mut self) -> Alarm {
        let told = async {
            loop {
                match self.notices.recv().await.expect("the run goes on") {
                    Notice::Alarm(alarm) => return alarm,
                    Notice::Finished { ending, .. } => panic!("over: {ending:?}"),
                    _ => {}
                }
            }
        };
        tokio::time::timeout(PATIENCE, told).await.expect("an alarm")
    }

    /// Resumes repeatedly until the order is accepted. Returns the first answer.
    async fn resume(&self) -> String {
        let began = Instant::now();
        let mut first = None;
        loop {
            let (reply, ..) = order(&self.folder, Request::Resume { reason: String::new(), state_number: None }).await;
            let said = first.get_or_insert(reply.message).clone();
            if reply.accepted {
                return said;
            }
            assert!(began.elapsed() < PATIENCE, "{said}");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    async fn abort(self, running: JoinHandle<Ending>) {
        order(&self.folder, Request::Abort { reason: "enough".into() }).await;
        let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
        assert!(matches!(ending, Ending::Aborted { confirmed: true, .. }), "{ending:?}");
    }
}

fn turn(rig: &Rig, machine: usize, mode: Mode) {
    rig.servings[machine].machines()[0].1.with(|machine| machine.set_mode(mode));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn idle_machine_key_holds_moving_one() {
    let mut rig = Rig::new(small(20, 10, 1.0)).await;
    let (mut run, running) = grinding(&mut rig).await;
    let turned = Instant::now();
    turn(&rig, CMM, Mode::Manual);
    let alarm = run.alarm().await;
    assert_eq!(alarm.id, AlarmId::NotAutomatic);
    for piece in ["CMM", "manual mode", "while the grinder"] {
        assert!(alarm.event.contains(piece), "{piece}: {}", alarm.event);
    }
    until(&run.folder, |words| words.starts_with("Held (Grind, Run)")).await;
    assert!(rig.command_at(GRINDER, HOLD, turned).is_some());
    let (reply, ..) = order(&run.folder, Request::Resume { reason: String::new(), state_number: None }).await;
    let refused = ["CMM", "manual mode"].iter().all(|piece| reply.message.contains(piece));
    assert!(!reply.accepted && refused, "{reply:?}");
    turn(&rig, CMM, Mode::Automatic);
    run.resume().await;
    until(&run.folder, |words| words.starts_with("Execute (Grind, Run)")).await;
    assert!(rig.command_at(GRINDER, RESUME, turned).is_some());
    run.abort(running).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn moving_machine_key_holds_not_aborts() {
    let mut rig = Rig::new(small(20, 10, 1.0)).await;
    let (mut run, running) = grinding(&mut rig).await;
    let turned = Instant::now();
    turn(&rig, GRINDER, Mode::Manual);
    let alarm = run.alarm().await;
    assert!(alarm.id == AlarmId::NotAutomatic && alarm.event.contains("grinder"), "{alarm:?}");
    until(&run.folder, |words| words.starts_with("Held (Grind, Run)")).await;
    turn(&rig, GRINDER, Mode::Automatic);
    run.resume().await;
    until(&run.folder, |words| words.starts_with("Execute (Grind, Run)")).await;
    assert!(rig.command_at(GRINDER, 7, turned).is_none() && rig.command_at(CMM, 7, turned).is_none());
    run.abort(running).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn machine_not_clear_holds_moving_one() {
    let mut rig = Rig::new(small(20, 10, 1.0)).await;
    let (mut run, running) = grinding(&mut rig).await;
    let moved = Instant::now();
    rig.servings[CMM].machines()[0].1.with(|machine| machine.open_interlocks(interlock::CLEAR));
    let alarm = run.alarm().await;
    assert_eq!(alarm.id, AlarmId::NotClear);
    assert!(alarm.event.contains("CMM") && alarm.event.contains("while the grinder moves"), "{}", alarm.event);
    until(&run.folder, |words| words.starts_with("Held (Grind, Run)")).await;
    assert!(rig.command_at(GRINDER, HOLD, moved).is_some());
    rig.servings[CMM].machines()[0].1.with(|machine| machine.open_interlocks(0));
    run.abort(running).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn manual_mode_prevents_prepare() {
    let mut rig = Rig::new(small(20, 10, 1.0)).await;
    turn(&rig, CMM, Mode::Manual);
    let Ready { run, cmm, grinder, notices, folder } = rig.next(true);
    let began = Instant::now();
    let (drive, orders) = Drive::new(run, cmm, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    let mut run = Watched { notices, folder, _orders: orders };
    let alarm = run.alarm().await;
    assert!(alarm.id == AlarmId::NotAutomatic && alarm.event.contains("CMM"), "{alarm:?}");
    until(&run.folder, |words| words.starts_with("Held (Grind, Send)")).await;
    assert!(rig.command_at(GRINDER, 2, began).is_none(), "nothing was prepared");
    assert_eq!(rig.servings[GRINDER].machines()[0].1.with(|machine| machine.state()), State::Idle);
    run.abort(running).await;
}
