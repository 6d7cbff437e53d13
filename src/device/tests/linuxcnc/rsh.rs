//! The driver at a server that goes wrong.

use std::fs;
use std::sync::Arc;
use std::time::Duration;

use regrind_device::{
    Answer, Armed, DeviceError, Fault as Told, Grinder, Interrupt, LinuxcncGrinder, Machine, MachineState,
    OperatorConfirmation, Outcome, Reconciled,
};
use tokio::sync::Notify;

use crate::bench::{Bench, is_unknown, job, map, pass, program, to_and_fro, until};
use crate::fake::{FakeServer, Fault};
use crate::refuses;

async fn bench() -> (FakeServer, Bench) {
    let fake = FakeServer::serve().await;
    let mut bench = Bench::new(fake.port, &to_and_fro(10));
    bench.settings.record_timeout = Duration::from_millis(20);
    (fake, bench)
}

/// With short waits for what is not to come.
fn hasty(mut bench: Bench) -> Bench {
    bench.settings.settle_timeout = Duration::from_millis(200);
    bench
}

#[tokio::test]
async fn whole_pass_protocol_transcript() {
    let (fake, bench) = bench().await;
    let (mut grinder, armed) = bench.started().await;
    assert_eq!(grinder.status().await.unwrap().state, MachineState::Execute);
    fake.controller().end();
    let status = until(&mut grinder, MachineState::Complete).await;
    assert_eq!(
        (status.outcome, status.done, status.clear_of_part),
        (Outcome::Complete, armed.start_sequence, Some(true))
    );
    grinder.acknowledge(status.done).await.unwrap();
    grinder.release().await.unwrap();
    let heard = fake.controller().heard.clone();
    let told: Vec<_> = heard.iter().filter(|line| !line.starts_with("get ")).map(String::as_str).collect();
    let (program, record) = (bench.file("ngc").display().to_string(), bench.file("log").display().to_string());
    let (open, log) = (format!("set open {program}"), format!("set mdi (LOGOPEN,{record})"));
    let token = format!("set mdi (LOG,prepared {:08x})", armed.token);
    let expected = [
        "hello EMC regrind 1.1",
        "set echo off",
        "set verbose on",
        "set enable EMCTOO",
        &open,
        "set mode mdi",
        &log,
        &token,
        "set mdi (LOGCLOSE)",
        "set mode auto",
        &open,
        "set run",
        "set enable off",
    ];
    assert_eq!(told, expected);
}

#[tokio::test]
async fn non_linuxcnc_gets_only_greeting() {
    let (fake, mut bench) = bench().await;
    bench.settings.answer_timeout = Duration::from_millis(100);
    fake.controller().faults.push(("hello", Fault::Instead("220 mail.example.com ESMTP\r\n")));
    refuses!(bench.grinder().connect().await, DeviceError::NotLinuxcnc { .. });
    assert_eq!(fake.controller().heard, ["hello EMC regrind 1.1"]);
    fake.controller().faults.push(("get mode", Fault::Instead("MODE GRINDING\r\n")));
    refuses!(bench.grinder().connect().await, DeviceError::NotLinuxcnc { .. });
    assert!(!fake.controller().heard.iter().any(|line| line.starts_with("set enable")));
}

#[tokio::test]
async fn wrong_name_and_wrong_password_errors() {
    let (fake, mut bench) = bench().await;
    bench.settings.expected_name = Some("/etc/mill/mill.ini".into());
    refuses!(bench.grinder().connect().await, DeviceError::WrongName { found, .. } if found == "/etc/grinder/grinder.ini");
    for name in ["/etc/grinder/grinder.ini", "EMCNETSVR", "EMCNETSVR 1.1"] {
        bench.settings.expected_name = Some(name.into());
        let identity = bench.grinder().connect().await.unwrap();
        assert_eq!(identity.name, "EMCNETSVR 1.1, /etc/grinder/grinder.ini");
    }
    bench.settings.control_password = "OTHER".into();
    let mut grinder = bench.grinder();
    grinder.connect().await.unwrap();
    refuses!(grinder.claim().await, DeviceError::Password { key: "control_password", .. });
    bench.settings.connect_password = "OTHER".into();
    refuses!(bench.grinder().connect().await, DeviceError::Password { key: "connect_password", .. });
    assert_eq!(fake.controller().runs, 0);
}

#[tokio::test]
async fn unmatched_lines_ignored() {
    let (fake, bench) = bench().await;
    let garbage = "\u{1}\u{fffd}\r\nSET RUN ACK EXTRA\n\r\n\rPROGRAM_LINES 7\r\nERROR: what\r\n";
    let lines =
        ["hello", "set enable", "get mode", "get program_line", "set open", "set mdi", "set run", "get program_status"];
    fake.controller().faults.extend(lines.map(|line| (line, Fault::Say(garbage))));
    let (mut grinder, _) = bench.started().await;
    fake.controller().end();
    until(&mut grinder, MachineState::Complete).await;
    assert!(fake.controller().faults.is_empty());
}

#[tokio::test]
async fn ignored_open_fails_load() {
    let (fake, bench) = bench().await;
    let bench = hasty(bench);
    fake.controller().program = Some("/old.ngc".into());
    fake.controller().faults.push(("set open", Fault::Ignore));
    let mut grinder = bench.grinder();
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    refuses!(grinder.load_pass(&map(), &pass(), &Interrupt::new()).await, DeviceError::TimedOut { .. });
    refuses!(grinder.prepare(job()).await, DeviceError::Refused { answer: Answer::PayloadMissing, .. });
    assert_eq!(fake.controller().runs, 0);
}

#[tokio::test]
async fn start_refuses_replaced_program() {
    let (fake, bench) = bench().await;
    let (mut grinder, armed) = bench.prepared().await;
    fake.controller().program = Some("/old.ngc".into());
    refuses!(grinder.start(armed.clone()).await, DeviceError::Refused { .. });
    let (mut grinder, armed) = {
        drop(grinder);
        bench.prepared().await
    };
    fake.controller().mode = "MANUAL".into();
    refuses!(grinder.start(armed).await, DeviceError::Refused { .. });
    assert_eq!(fake.controller().runs, 0);
}

#[tokio::test]
async fn load_refuses_other_map_or_cycle() {
    let (fake, bench) = bench().await;
    let mut grinder = bench.loaded().await;
    let later = regrind_device::Job { cycle: 3, ..job() };
    refuses!(grinder.prepare(later).await, DeviceError::Refused { answer: Answer::OtherJob, .. });
    let mut other = map();
    other.values_mm[0] = 0.5;
    refuses!(grinder.load_pass(&other, &pass(), &Interrupt::new()).await, DeviceError::Folder { .. });
    let raised = Interrupt::new();
    raised.raise();
    refuses!(grinder.load_pass(&map(), &pass(), &raised).await, DeviceError::Interrupted { .. });
    fs::write(bench.settings.run_folder.join("cycle-1/toolpath.ngc"), program("").replace("G64 P0.0001 Q0\n", ""))
        .unwrap();
    refuses!(grinder.load_pass(&map(), &pass(), &Interrupt::new()).await, DeviceError::Folder { .. });
    assert_eq!(fake.controller().runs, 0);
}

#[tokio::test]
async fn prepare_refuses_unready_machine() {
    let (fake, bench) = bench().await;
    let mut grinder = bench.loaded().await;
    fake.controller().not_homed = true;
    refuses!(grinder.prepare(job()).await, DeviceError::NotReady { .. });
    fake.controller().not_homed = false;
    fake.controller().interpreter = "PAUSED".into();
    refuses!(grinder.prepare(job()).await, DeviceError::NotReady { .. });
    fake.controller().interpreter = "IDLE".into();
    fake.controller().stopped = true;
    refuses!(grinder.prepare(job()).await, DeviceError::Faulted { fault: Told::StopCircuit, .. });
    fake.controller().stopped = false;
    grinder.prepare(job()).await.unwrap();
}

#[tokio::test]
async fn start_nak_resolved_by_status() {
    let (fake, bench) = bench().await;
    let (mut grinder, armed) = bench.prepared().await;
    fake.controller().faults.push(("set run", Fault::Nak));
    refuses!(grinder.start(armed.clone()).await, DeviceError::Refused { .. });
    refuses!(grinder.start(armed).await, DeviceError::Refused { .. });
    assert_eq!(fake.controller().runs, 0);
    let armed = grinder.prepare(job()).await.unwrap();
    fake.controller().faults.push(("set run", Fault::DoAndNak));
    grinder.start(armed).await.unwrap();
    assert_eq!(fake.controller().runs, 1);
}

#[tokio::test]
async fn ignored_start_unknown_until_reconcile() {
    let (fake, bench) = bench().await;
    let bench = hasty(bench);
    let (mut grinder, armed) = bench.prepared().await;
    fake.controller().faults.push(("set run", Fault::Ignore));
    assert!(is_unknown(&grinder.start(armed.clone()).await));
    refuses!(grinder.start(armed.clone()).await, DeviceError::Refused { .. });
    assert!(matches!(grinder.reconcile(&armed).await.unwrap(), Reconciled::NotStarted(_)));
    // Not before a claim, behind which no older line begins anything.
    let heard = fake.controller().heard.clone();
    let mut behind = heard.iter().rev().take_while(|line| *line != "set run");
    assert!(behind.any(|line| line == "set enable EMCTOO"), "{heard:?}");
    let armed = grinder.prepare(job()).await.unwrap();
    grinder.start(armed).await.unwrap();
    assert_eq!(fake.controller().runs, 1);
}

#[tokio::test]
async fn prepare_refuses_begun_program() {
    let (fake, bench) = bench().await;
    let (mut grinder, _) = bench.started().await;
    fake.controller().end();
    let status = until(&mut grinder, MachineState::Complete).await;
    grinder.acknowledge(status.done).await.unwrap();
    grinder.load_pass(&map(), &pass(), &Interrupt::new()).await.unwrap();
    refuses!(grinder.prepare(job()).await, DeviceError::Refused { answer: Answer::AlreadyBegun, .. });
    assert_eq!(fake.controller().runs, 1);
}

#[tokio::test]
async fn abort_sent_during_pending_reply() {
    let (fake, bench) = bench().await;
    let (mut grinder, armed) = bench.prepared().await;
    let late = Arc::new(Notify::new());
    fake.controller().faults.push(("set run", Fault::Late(late.clone())));
    tokio::select! {
        biased;
        started = grinder.start(armed) => panic!("{started:?}"),
        () = fake.has_heard("set run") => {}
    }
    // The server reads on when it has answered, so what was sent meanwhile is heard then: behind the run and before
    // anything else.
    let heard = fake.clone();
    let (aborted, ()) = tokio::join!(grinder.abort(), async move {
        tokio::task::yield_now().await;
        late.notify_one();
        heard.has_heard("set abort").await;
    });
    aborted.unwrap();
    until(&mut grinder, MachineState::Aborted).await;
    let heard = fake.controller().heard.clone();
    let run = heard.iter().position(|line| line == "set run").unwrap();
    assert_eq!(heard[run + 1..run + 3], ["set enable EMCTOO", "set abort"]);
}

#[tokio::test]
async fn abort_reconnects() {
    let (fake, bench) = bench().await;
    let (mut grinder, _) = bench.started().await;
    // Before anything was known of it, and after.
    fake.controller().faults.push(("set abort", Fault::Close));
    grinder.abort().await.unwrap();
    assert_eq!(until(&mut grinder, MachineState::Aborted).await.outcome, Outcome::Aborted);
    fake.controller().faults.push(("get enable", Fault::Close));
    refuses!(grinder.status().await, DeviceError::Disconnected { .. });
    grinder.abort().await.unwrap();
    assert_eq!(fake.controller().heard.iter().filter(|line| *line == "set abort").count(), 3);
}

#[tokio::test]
async fn pause_after_program_end_is_undone() {
    let (fake, bench) = bench().await;
    let (mut grinder, _) = bench.started().await;
    grinder.status().await.unwrap();
    fake.controller().end();
    let status = grinder.hold().await.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete));
    assert_eq!(fake.controller().interpreter, "IDLE");
    refuses!(grinder.hold().await, DeviceError::Refused { .. });
    assert_eq!(fake.controller().heard.iter().filter(|line| *line == "set pause").count(), 1);
}

#[tokio::test]
async fn controller_error_faults_pass() {
    let (fake, bench) = bench().await;
    let (mut grinder, _) = bench.started().await;
    fake.controller().fail("joint 1 following error");
    let status = until(&mut grinder, MachineState::Faulted).await;
    assert_eq!((status.outcome, status.fault), (Outcome::Failed, Some(Told::Drive)));
    assert!(grinder.notes().iter().any(|note| note.contains("joint 1 following error")));
    assert_eq!(grinder.clear().await.unwrap().state, MachineState::Idle);
}

#[tokio::test]
async fn stolen_control_is_not_reclaimed() {
    let (fake, bench) = bench().await;
    let (mut grinder, armed) = bench.prepared().await;
    fake.steal();
    refuses!(grinder.start(armed).await, DeviceError::ControlTaken { .. });
    grinder.connect().await.unwrap();
    refuses!(grinder.claim().await, DeviceError::ControlTaken { .. });
    grinder.abort().await.unwrap();
    assert_eq!((grinder.clear().await.unwrap().state, fake.controller().runs), (MachineState::Idle, 0));
}

#[tokio::test]
async fn stolen_control_makes_start_unknown() {
    let (fake, bench) = bench().await;
    let (mut grinder, armed) = bench.prepared().await;
    let late = Arc::new(Notify::new());
    fake.controller().faults.push(("set run", Fault::Late(late.clone())));
    let thief = fake.clone();
    let (started, ()) = tokio::join!(grinder.start(armed.clone()), async move {
        thief.has_heard("set run").await;
        thief.steal();
        late.notify_one();
    });
    assert!(is_unknown(&started), "{started:?}");
    // It is seen to run all the same, and is nobody's to begin again.
    grinder.connect().await.unwrap();
    assert!(matches!(grinder.reconcile(&armed).await.unwrap(), Reconciled::Running(_)));
    assert_eq!(fake.controller().runs, 1);
}

#[tokio::test]
async fn missing_record_needs_confirmation() {
    for (word, outcome) in [
        (OperatorConfirmation::Done { map_identity: None, file: None }, Outcome::Complete),
        (OperatorConfirmation::Still, Outcome::Stopped),
    ] {
        let (fake, bench) = bench().await;
        let (mut grinder, armed) = bench.prepared().await;
        fake.controller().writes_nothing = true;
        grinder.start(armed.clone()).await.unwrap();
        refuses!(grinder.confirm(word.clone()).await, DeviceError::ConfirmationNotNeeded { .. });
        fake.controller().end();
        for _ in 0..10 {
            assert_eq!(grinder.status().await.unwrap().state, MachineState::Execute);
            tokio::time::sleep(bench.settings.record_timeout / 2).await;
        }
        assert!(grinder.notes().iter().any(|note| note.contains("regrind confirm")));
        let other = OperatorConfirmation::Done { map_identity: Some([1; 32]), file: None };
        refuses!(grinder.confirm(other).await, DeviceError::NotAccepted { .. });
        grinder.confirm(word).await.unwrap();
        let status = grinder.status().await.unwrap();
        assert_eq!((status.state, status.outcome), (MachineState::Complete, outcome));
    }
}

#[tokio::test]
async fn deleted_record_makes_start_unknown() {
    let (fake, bench) = bench().await;
    let (grinder, armed) = bench.prepared().await;
    drop(grinder);
    fs::remove_file(bench.file("log")).unwrap();
    let mut grinder = bench.grinder();
    grinder.restore(&armed);
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    assert!(matches!(grinder.reconcile(&armed).await.unwrap(), Reconciled::Unknown { .. }));
    assert_eq!(fake.controller().runs, 0);
}

/// Connects to the machine again and reconciles an armed start, as a cell does after it has lost the connection.
async fn reconnect_and_reconcile(grinder: &mut LinuxcncGrinder, armed: Option<&Armed>) -> Option<Reconciled> {
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    match armed {
        Some(armed) => Some(grinder.reconcile(armed).await.unwrap()),
        None => None,
    }
}

/// A whole pass, whose wire is lost once; returns how it ended.
async fn run_pass(bench: &Bench, fake: &FakeServer) -> Outcome {
    let mut grinder = bench.grinder();
    let (mut armed, mut is_started) = (None, false);
    for _ in 0..6 {
        let step = async {
            grinder.connect().await?;
            grinder.claim().await?;
            if let Some(armed) = armed.as_ref().filter(|_| is_started) {
                match grinder.reconcile(armed).await? {
                    Reconciled::NotStarted(_) => is_started = false,
                    Reconciled::Unknown { reason } => panic!("{reason}"),
                    _ => {}
                }
            }
            if !is_started {
                grinder.load_pass(&map(), &pass(), &Interrupt::new()).await?;
                let prepared = grinder.prepare(job()).await?;
                armed = Some(prepared.clone());
                is_started = true;
                grinder.start(prepared).await?;
            }
            if fake.controller().interpreter == "RUNNING" {
                fake.controller().end();
            }
            loop {
                let status = grinder.status().await?;
                if status.state == MachineState::Complete {
                    grinder.acknowledge(status.done).await?;
                    return Ok::<_, DeviceError>(status.outcome);
                }
                tokio::task::yield_now().await;
            }
        };
        match step.await {
            Ok(outcome) => return outcome,
            Err(DeviceError::Refused { .. }) if is_started => {
                // Over and acknowledged, and only the answer was lost.
                return Outcome::Complete;
            }
            Err(error) => assert!(error.is_link(), "{error:?}"),
        }
    }
    panic!("it does not come to an end");
}

#[tokio::test]
async fn disconnect_at_any_line_starts_once() {
    let (fake, bench) = bench().await;
    assert_eq!(run_pass(&bench, &fake).await, Outcome::Complete);
    let lines = fake.controller().heard.len();
    let run = fake.controller().heard.iter().position(|line| line == "set run").unwrap();
    assert!(lines > 60, "{lines}");
    // Every line once, in one of two ways; what is about the start in both.
    let ways = |at: usize| match at.abs_diff(run) < 8 {
        true => vec![Fault::Close, Fault::DoAndClose],
        false if at.is_multiple_of(2) => vec![Fault::Close],
        false => vec![Fault::DoAndClose],
    };
    let mut tries = tokio::task::JoinSet::new();
    for (at, fault) in (0..lines).flat_map(|at| ways(at).into_iter().map(move |fault| (at, fault))) {
        tries.spawn(async move {
            let (fake, bench) = self::bench().await;
            let hint = format!("{fault:?} at {at}");
            fake.controller().fault_at = Some((at, fault));
            assert_eq!(run_pass(&bench, &fake).await, Outcome::Complete, "{hint}");
            assert_eq!((fake.controller().runs, bench.wrote("begin"), bench.wrote("end")), (1, 1, 1), "{hint}");
        });
    }
    while let Some(tried) = tries.join_next().await {
        tried.unwrap();
    }
}

#[tokio::test]
async fn new_driver_continues_active_pass() {
    let (fake, bench) = bench().await;
    let (grinder, armed) = bench.started().await;
    drop(grinder);
    let mut grinder = bench.grinder();
    grinder.restore(&armed);
    let verdict = reconnect_and_reconcile(&mut grinder, Some(&armed)).await;
    assert!(matches!(verdict, Some(Reconciled::Running(status)) if status.job == Some(job())));
    fake.controller().end();
    assert_eq!(until(&mut grinder, MachineState::Complete).await.outcome, Outcome::Complete);
    assert_eq!(grinder.collect(job(), &Interrupt::new()).await.unwrap().done, armed.start_sequence);
}
