//! Progress that a run shows of a measurement that still goes on: it is visible, and nothing depends on it.

use std::path::Path;
use std::time::{Duration, Instant};

use regrind::cell::Ending;
use regrind::drive::{Drive, PreviewStatistics, Request, Snapshot};
use regrind_sim::registers::SimulatedMachine;
use regrind_testcell::rig::{CMM, PATIENCE, Ready, Rig, order, small, until};

fn cmm(rig: &Rig, what: impl FnOnce(&mut SimulatedMachine)) {
    rig.servings[CMM].machines()[0].1.with(what);
}

/// Polls until the snapshot satisfies a condition.
async fn seen<T>(folder: &Path, what: impl Fn(&Snapshot) -> Option<T>) -> T {
    let began = Instant::now();
    loop {
        let status = order(folder, Request::Status).await.0.status;
        if let Some(found) = what(&status) {
            return found;
        }
        assert!(began.elapsed() < PATIENCE, "{status:?}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn status_shows_preliminary_touches() {
    let mut rig = Rig::new(small(12, 8, 5000.0)).await;
    // The test decides when the CMM measures.
    cmm(&rig, |machine| machine.set_speed(0.0));
    let Ready { run, cmm: driver, grinder, folder, .. } = rig.next(true);
    let (drive, orders) = Drive::new(run, driver, grinder).unwrap();
    let running = tokio::spawn(drive.run());
    until(&folder, |words| words.starts_with("Execute (Measure, Run)")).await;
    assert_eq!(orders.status().borrow().preview, None);
    let half = |machine: &mut SimulatedMachine| {
        let progress = |machine: &mut SimulatedMachine| machine.read(84, 4).unwrap()[1];
        machine.set_speed(100.0);
        while progress(machine) < 60 {
            machine.tick(Duration::from_millis(10));
        }
        machine.set_speed(0.0);
        assert!(progress(machine) < 90, "{}", progress(machine));
    };
    cmm(&rig, half);
    // Eight full pages of seven points, including those on the reference sphere. The first pages are enough.
    let told = seen(&folder, |status| status.preview.filter(|told| told.touch_count >= 14)).await;
    let PreviewStatistics { touch_count, rms_um, min_um, max_um } = told;
    assert!(touch_count <= 90 && rms_um > 0.0 && rms_um <= min_um.abs().max(max_um.abs()), "{told:?}");
    // After a hold, the points stay visible. Orders are obeyed as usual.
    let (reply, ..) = order(&folder, Request::Hold { reason: "to look".into(), state_number: None }).await;
    assert!(reply.accepted, "{reply:?}");
    until(&folder, |words| words.starts_with("Held (Measure, Run)")).await;
    assert!(seen(&folder, |status| status.preview).await.touch_count >= touch_count);
    let (reply, ..) = order(&folder, Request::Resume { reason: String::new(), state_number: None }).await;
    assert!(reply.accepted, "{reply:?}");
    cmm(&rig, |machine| machine.set_speed(5000.0));
    let ending = tokio::time::timeout(PATIENCE, running).await.expect("it ends").unwrap();
    assert!(matches!(ending, Ending::Accepted { .. }), "{ending:?}");
    assert_eq!(orders.status().borrow().preview, None);
    // The record contains none of it.
    let journal = std::fs::read(folder.join("journal.sqlite")).unwrap();
    for word in ["so_far", "preliminary"] {
        assert!(!journal.windows(word.len()).any(|bytes| bytes == word.as_bytes()), "{word}");
    }
}
