//! The driver at LinuxCNC itself.

use std::fs;
use std::time::Duration;

use regrind_device::{DeviceError, Fault, Grinder, Interrupt, Machine, MachineState, Outcome, Reconciled};

use crate::bench::{Bench, job, map, pass, program, to_and_fro, until};
use crate::isolated::{Controller, Operator, PORT, give_away, with_controller};
use crate::refuses;

fn bench(text: &str) -> Bench {
    let bench = Bench::new(PORT, text);
    let everybody = std::process::Command::new("chmod").arg("755").arg(bench.folder.path()).status().unwrap();
    assert!(everybody.success());
    give_away(&bench.settings.programs);
    bench
}

/// A program over a dome of 150 mm, and where its moves end, from where the machine stands.
fn raster(tracks: u32, points: u32) -> (String, Vec<[f64; 3]>) {
    let mut ends = vec![[0.0; 3]];
    for track in 0..tracks {
        for k in 0..=points {
            let k = if track % 2 == 0 { k } else { points - k };
            let (x, y) = (f64::from(k) - 0.5 * f64::from(points), f64::from(track));
            // As it is written: to the nanometre.
            let z = ((150.0_f64.powi(2) - x * x - y * y).sqrt() - 150.0) * 1e6;
            ends.push([x, y, z.round() / 1e6]);
        }
    }
    let lines = ends.iter().skip(1).map(|[x, y, z]| format!("G1 X{x:.6} Y{y:.6} Z{z:.6}\n"));
    (program(&("F6000\n".to_owned() + &lines.collect::<String>())), ends)
}

/// How far a place is from a straight line between two others.
fn distance_mm(place: [f64; 3], from: [f64; 3], to: [f64; 3]) -> f64 {
    let minus = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let (along, off) = (minus(to, from), minus(place, from));
    let share = (dot(off, along) / dot(along, along).max(1e-30)).clamp(0.0, 1.0);
    let foot = minus(off, along.map(|part| share * part));
    dot(foot, foot).sqrt()
}

macro_rules! on_a_controller {
    ($($(#[$doc:meta])* $name:ident($controller:ident) $body:block)+) => {$(
        $(#[$doc])*
        #[test]
        #[ignore = "needs a controller: Debian package linuxcnc-uspace, and root for namespaces"]
        fn $name() {
            with_controller(concat!("on_a_controller::", stringify!($name)), |$controller: Controller| async move { $body });
        }
    )+};
}

on_a_controller! {
    program_completes_and_starts_once(_controller) {
        let bench = bench(&to_and_fro(40));
        let (mut grinder, armed) = bench.started().await;
        let status = until(&mut grinder, MachineState::Complete).await;
        assert_eq!((status.outcome, status.job, status.done), (Outcome::Complete, Some(job()), armed.start_sequence));
        assert_eq!((status.clear_of_part, bench.wrote("begin"), bench.wrote("end")), (Some(true), 1, 1));
        let record = grinder.collect(job(), &Interrupt::new()).await.unwrap();
        assert_eq!((record.outcome, record.done), (Outcome::Complete, armed.start_sequence));
        assert!(record.duration_s.is_some_and(|s| s > 1.0), "{record:?}");
        // Once begun it is never begun again.
        refuses!(grinder.start(armed).await, DeviceError::Refused { .. });
        assert_eq!(grinder.acknowledge(status.done).await.unwrap().state, MachineState::Idle);
        grinder.load_pass(&map(), &pass(), &Interrupt::new()).await.unwrap();
        refuses!(grinder.prepare(job()).await, DeviceError::Refused { answer: regrind_device::Answer::AlreadyBegun, .. });
        assert_eq!(bench.wrote("begin"), 1);
    }

    spark_out_within_one_start(_controller) {
        let bench = bench(&to_and_fro(10));
        let sparing = regrind_device::Pass { spark_out_passes: 2, ..pass() };
        let mut grinder = bench.grinder();
        grinder.connect().await.unwrap();
        grinder.claim().await.unwrap();
        grinder.load_pass(&map(), &sparing, &Interrupt::new()).await.unwrap();
        use regrind_device::{Identified, digest};
        let job = regrind_device::Job { digest: digest(&[map().identity(), sparing.identity()]), ..job() };
        let armed = grinder.prepare(job).await.unwrap();
        grinder.start(armed).await.unwrap();
        let mut furthest = 0;
        loop {
            let status = grinder.status().await.unwrap();
            if let Some((done, of)) = status.progress {
                assert_eq!(of, 3000);
                furthest = furthest.max(done);
            }
            if status.state == MachineState::Complete {
                break;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert!(furthest > 2000, "{furthest}");
        assert_eq!((bench.wrote("begin"), bench.wrote("end")), (1, 1));
    }

    hold_stops_motion_resume_continues(_controller) {
        let bench = bench(&to_and_fro(60));
        let (mut grinder, _) = bench.started().await;
        grinder.hold().await.unwrap();
        until(&mut grinder, MachineState::Held).await;
        let mut operator = Operator::connect(PORT).await;
        // A moment for it to come to a stand.
        tokio::time::sleep(Duration::from_millis(300)).await;
        let stands = operator.ask("get abs_act_pos").await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        assert_eq!(operator.ask("get abs_act_pos").await, stands);
        assert_eq!(grinder.status().await.unwrap().state, MachineState::Held);
        refuses!(grinder.hold().await, DeviceError::Refused { .. });
        grinder.resume().await.unwrap();
        until(&mut grinder, MachineState::Execute).await;
        assert_eq!(until(&mut grinder, MachineState::Complete).await.outcome, Outcome::Complete);
    }

    abort_then_clear_gives_idle(_controller) {
        let bench = bench(&to_and_fro(600));
        let (mut grinder, _) = bench.started().await;
        grinder.abort().await.unwrap();
        let status = until(&mut grinder, MachineState::Aborted).await;
        assert_eq!((status.outcome, status.clear_of_part), (Outcome::Aborted, None));
        assert_eq!((bench.wrote("begin"), bench.wrote("end")), (1, 0));
        assert_eq!(grinder.clear().await.unwrap().state, MachineState::Idle);
    }

    stop_while_held(_controller) {
        let bench = bench(&to_and_fro(600));
        let (mut grinder, _) = bench.started().await;
        grinder.hold().await.unwrap();
        until(&mut grinder, MachineState::Held).await;
        grinder.stop().await.unwrap();
        assert_eq!(until(&mut grinder, MachineState::Complete).await.outcome, Outcome::Stopped);
    }

    wrong_program_folder_fails_load(controller) {
        let mut bench = bench(&to_and_fro(10));
        let mut operator = controller.operator().await;
        // What was opened before stays open, though the order for the new one is acknowledged.
        let old = bench.settings.programs.join("old.ngc");
        fs::write(&old, "G61\nG1 X1 F600\nM2\n").unwrap();
        operator.take_control().await;
        operator.ask("set mode auto").await;
        operator.ask(&format!("set open {}", old.display())).await;
        bench.settings.programs_at_controller = "/tmp/controller".into();
        bench.settings.settle_timeout = Duration::from_millis(500);
        let mut grinder = bench.grinder();
        grinder.connect().await.unwrap();
        grinder.claim().await.unwrap();
        let error = refuses!(grinder.load_pass(&map(), &pass(), &Interrupt::new()).await, DeviceError::ControllerErrors { .. });
        assert!(error.to_string().contains("can't open /tmp/controller"), "{error}");
        refuses!(grinder.prepare(job()).await, DeviceError::Refused { .. });
        assert_eq!(operator.ask("get program").await, format!("PROGRAM {}", old.display()));
        assert_eq!(operator.ask("get program_status").await, "PROGRAM_STATUS IDLE");
    }

    unparsable_program_faults(_controller) {
        let bench = bench(&program("F600\nG1 X1\nG1 X(\n"));
        let (mut grinder, _) = bench.started().await;
        let status = until(&mut grinder, MachineState::Faulted).await;
        assert_eq!((status.outcome, status.fault), (Outcome::Failed, Some(Fault::Other(0))));
        assert!(grinder.notes().iter().any(|note| note.contains("Unclosed comment")), "{:?}", grinder.notes());
        assert_eq!(grinder.clear().await.unwrap().state, MachineState::Idle);
    }

    travel_limit_faults(_controller) {
        let bench = bench(&program("F6000\nG1 X1\nG1 X500\n"));
        let (mut grinder, _) = bench.started().await;
        let status = until(&mut grinder, MachineState::Faulted).await;
        assert_eq!((status.outcome, status.fault), (Outcome::Failed, Some(Fault::TravelLimit)));
        assert!(grinder.notes().iter().any(|note| note.contains("X's positive limit")), "{:?}", grinder.notes());
    }

    operator_estop_needs_operator_reset(controller) {
        let bench = bench(&to_and_fro(600));
        let (mut grinder, _) = bench.started().await;
        let mut operator = controller.operator().await;
        operator.take_control().await;
        operator.ask("set estop on").await;
        operator.ask("set enable off").await;
        // Another client took control to do so.
        refuses!(grinder.status().await, DeviceError::ControlTaken { .. });
        grinder.abort().await.unwrap();
        let status = until(&mut grinder, MachineState::Aborted).await;
        assert_eq!((status.outcome, bench.wrote("end")), (Outcome::Aborted, 0));
        refuses!(grinder.clear().await, DeviceError::Faulted { fault: Fault::StopCircuit, .. });
        operator.make_ready().await;
        assert_eq!(operator.ask("get machine").await, "MACHINE ON");
        refuses!(grinder.status().await, DeviceError::ControlTaken { .. });
    }

    open_stop_circuit_faults(controller) {
        let bench = bench(&to_and_fro(600));
        let (mut grinder, _) = bench.started().await;
        controller.open_the_stop_circuit();
        let status = until(&mut grinder, MachineState::Faulted).await;
        assert_eq!((status.outcome, status.fault), (Outcome::Failed, Some(Fault::StopCircuit)));
        refuses!(grinder.clear().await, DeviceError::Faulted { fault: Fault::StopCircuit, .. });
        refuses!(grinder.hold().await, DeviceError::Refused { .. });
    }

    abort_passes_other_client(controller) {
        let bench = bench(&to_and_fro(600));
        let (mut grinder, _) = bench.started().await;
        let mut operator = controller.operator().await;
        operator.take_control().await;
        refuses!(grinder.hold().await, DeviceError::ControlTaken { .. });
        refuses!(grinder.claim().await, DeviceError::ControlTaken { .. });
        grinder.abort().await.unwrap();
        assert_eq!(until(&mut grinder, MachineState::Aborted).await.outcome, Outcome::Aborted);
    }

    new_driver_adopts_active_program(_controller) {
        let bench = bench(&to_and_fro(120));
        let (grinder, armed) = bench.started().await;
        drop(grinder);
        let mut grinder = bench.grinder();
        grinder.restore(&armed);
        grinder.connect().await.unwrap();
        assert_eq!(grinder.status().await.unwrap().job, Some(job()));
        grinder.claim().await.unwrap();
        assert!(matches!(grinder.reconcile(&armed).await.unwrap(), Reconciled::Running(status) if status.job == Some(job())));
        assert_eq!(until(&mut grinder, MachineState::Complete).await.outcome, Outcome::Complete);
        assert_eq!(grinder.collect(job(), &Interrupt::new()).await.unwrap().outcome, Outcome::Complete);
        assert_eq!((bench.wrote("begin"), bench.wrote("end")), (1, 1));
    }

    reconcile_finished_while_offline(_controller) {
        let bench = bench(&to_and_fro(10));
        let (grinder, armed) = bench.started().await;
        drop(grinder);
        while bench.wrote("end") == 0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let mut grinder = bench.grinder();
        grinder.connect().await.unwrap();
        let Reconciled::Finished(status) = grinder.reconcile(&armed).await.unwrap() else { panic!() };
        assert_eq!((status.state, status.outcome, status.done), (MachineState::Complete, Outcome::Complete, armed.start_sequence));
    }

    reconcile_not_started(_controller) {
        let bench = bench(&to_and_fro(10));
        let (grinder, armed) = bench.prepared().await;
        drop(grinder);
        let mut grinder = bench.grinder();
        grinder.restore(&armed);
        grinder.connect().await.unwrap();
        grinder.claim().await.unwrap();
        assert!(matches!(grinder.reconcile(&armed).await.unwrap(), Reconciled::NotStarted(_)));
        assert_eq!(bench.wrote("begin"), 0);
    }

    killed_server_reconnects_mid_program(controller) {
        let mut server = controller.second_server(PORT + 1);
        drop(Operator::connect(PORT + 1).await);
        let mut bench = bench(&to_and_fro(300));
        bench.settings.port = PORT + 1;
        let (mut grinder, armed) = bench.started().await;
        server.kill().unwrap();
        server.wait().unwrap();
        refuses!(grinder.status().await, DeviceError::Disconnected { .. });
        refuses!(grinder.connect().await, DeviceError::Unreachable { .. });
        let mut again = controller.second_server(PORT + 1);
        drop(Operator::connect(PORT + 1).await);
        grinder.connect().await.unwrap();
        grinder.claim().await.unwrap();
        assert!(matches!(grinder.reconcile(&armed).await.unwrap(), Reconciled::Running(_)));
        grinder.hold().await.unwrap();
        until(&mut grinder, MachineState::Held).await;
        grinder.resume().await.unwrap();
        assert_eq!(until(&mut grinder, MachineState::Complete).await.outcome, Outcome::Complete);
        assert_eq!((bench.wrote("begin"), bench.wrote("end")), (1, 1));
        again.kill().unwrap();
        again.wait().unwrap();
    }

    killed_controller_aborts_pass(controller) {
        let mut controller = controller;
        let bench = bench(&to_and_fro(600));
        let (mut grinder, armed) = bench.started().await;
        controller.kill();
        let error = grinder.status().await.unwrap_err();
        assert!(error.is_link(), "{error}");
        controller.start_again().await;
        grinder.connect().await.unwrap();
        grinder.claim().await.unwrap();
        let Reconciled::Finished(status) = grinder.reconcile(&armed).await.unwrap() else { panic!() };
        assert_eq!((status.state, status.outcome), (MachineState::Aborted, Outcome::Aborted));
        assert_eq!((bench.wrote("begin"), bench.wrote("end")), (1, 0));
    }

    dead_task_times_out_abort(_controller) {
        let mut bench = bench(&to_and_fro(600));
        bench.settings.answer_timeout = Duration::from_secs(1);
        let (mut grinder, _) = bench.started().await;
        let killed = std::process::Command::new("pkill").args(["-STOP", "-x", "milltask"]).status().unwrap();
        assert!(killed.success());
        // It is told as if all were well, until something is asked of it.
        assert_eq!(grinder.status().await.unwrap().state, MachineState::Execute);
        let error = grinder.abort().await.unwrap_err();
        assert!(matches!(error, DeviceError::TimedOut { .. }), "{error:?}");
    }

    executed_path_matches_program(controller) {
        let (text, ends) = raster(12, 24);
        let bench = bench(&text);
        let (mut grinder, armed) = bench.prepared().await;
        let (mut sampler, file) = controller.sample();
        grinder.start(armed).await.unwrap();
        until(&mut grinder, MachineState::Complete).await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        sampler.kill().unwrap();
        sampler.wait().unwrap();
        let told = fs::read_to_string(file).unwrap();
        let places = told.lines().filter_map(|line| {
            let mut numbers = line.split_whitespace().skip(1).map(|n| n.parse::<f64>().ok());
            Some([numbers.next()??, numbers.next()??, numbers.next()??])
        });
        let mut off: Vec<f64> = Vec::new();
        let (mut at, mut furthest) = (0, 0);
        for place in places.filter(|place| *place != [0.0; 3]) {
            // The nearest piece of the way, from where it was on.
            let near = (at..(at + 4).min(ends.len() - 1)).map(|k| (k, distance_mm(place, ends[k], ends[k + 1])));
            let (k, mm) = near.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            (at, furthest) = (k, furthest.max(k));
            off.push(mm);
        }
        assert!(off.len() > 1000 && furthest == ends.len() - 2, "{} samples, {furthest} of {}", off.len(), ends.len());
        let largest = off.iter().fold(0.0, |a: f64, b| a.max(*b));
        let rms = (off.iter().map(|mm| mm * mm).sum::<f64>() / off.len() as f64).sqrt();
        println!("{} samples, off by {:.0} nm at most, {:.0} nm rms", off.len(), 1e6 * largest, 1e6 * rms);
        assert!(largest < 0.5e-3 && rms < 0.1e-3, "{largest} mm, {rms} mm rms");
    }

    unready_controller_stays_unready(controller) {
        let bench = bench(&to_and_fro(10));
        let mut grinder = bench.loaded().await;
        let mut operator = controller.operator().await;
        operator.take_control().await;
        operator.ask("set machine off").await;
        refuses!(grinder.status().await, DeviceError::ControlTaken { .. });
        let mut grinder = bench.grinder();
        grinder.connect().await.unwrap();
        let status = grinder.claim().await.unwrap();
        assert_eq!((status.state, status.fault), (MachineState::Faulted, Some(Fault::Supplies)));
        refuses!(grinder.load_pass(&map(), &pass(), &Interrupt::new()).await, DeviceError::Faulted { .. });
        assert_eq!(operator.ask("get machine").await, "MACHINE OFF");
    }
}
