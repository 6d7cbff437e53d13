//! Jobs from their beginning to their end, with interventions of people and crashes.

use regrind::device::{
    CarefulStart, Cmm, DeviceError, Interrupt, IppdmeCmm, Machine, MachineState, Outcome, Plan, Reconciled, TouchStatus,
};
use regrind_sim::dme::machine::Options;
use regrind_sim::line_server::LineServer;
use regrind_sim::spec::CmmSpec;
use regrind_sim::wire::lines::ServingLines;
use regrind_testcell::perfect::perfect_cmm;

use super::bench::{Bench, begin, has_state, job, patient, settings, until, until_points, until_still};

/// Speed at which a touch takes about a millisecond.
const FAST: f64 = 5000.0;
/// Speed at which a job of twenty touches is still running when the next command arrives.
const SLOW: f64 = 50.0;

#[tokio::test]
async fn ippdme_plan_measured_on_part() {
    let mut bench = Bench::new(FAST, patient()).await;
    let plan = Plan { careful_start: Some(CarefulStart { target_count: 2, speed_mm_s: 0.5 }), ..bench.plan(20) };
    let armed = bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete), "{:?}", bench.cmm.notes());
    assert_eq!((status.done, status.clear_of_part), (armed.start_sequence, Some(true)));
    let measurement = bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    bench.assert_on_part(&plan, &measurement);
    assert!(measurement.points.iter().all(|point| point.status == TouchStatus::Touched));
    assert_eq!(measurement.probe_radius_mm, Some(1.5));
    assert_eq!(bench.cmm.acknowledge(status.done).await.unwrap().state, MachineState::Idle);
    assert_eq!(bench.world.measurements_begun(), 1);
}

#[tokio::test]
async fn part_frame_gives_same_points() {
    let bench = Bench::new(FAST, patient()).await;
    let plan = bench.plan(10);
    // The part's frame equals that of the machine here, once by zeros and once by a full turn.
    for part_frame in [Some([0.0; 6]), Some([0.0, 0.0, 0.0, 0.0, 200.0, 160.0])] {
        let port = bench.serving.local_addr().port();
        let mut cmm = IppdmeCmm::new(regrind::device::IppdmeSettings { part_frame, ..settings(port, patient()) });
        cmm.connect().await.unwrap();
        begin(&mut cmm, &plan).await.unwrap();
        until_still(&mut cmm).await.unwrap();
        bench.assert_on_part(&plan, &cmm.collect(job(&plan), &Interrupt::new()).await.unwrap());
        cmm.release().await.unwrap();
    }
}

#[tokio::test]
async fn ippdme_read_ahead_in_plan_order() {
    let mut bench = Bench::new(500.0, patient()).await;
    let plan = bench.plan(15);
    bench.begin(&plan).await.unwrap();
    let mut ahead = Vec::new();
    loop {
        let over = has_state(&bench.cmm.status().await.unwrap(), MachineState::Complete);
        if let Some(more) = bench.cmm.read_ahead(job(&plan), &Interrupt::new()).await {
            assert_eq!(more.first_index, ahead.len());
            ahead.extend(more.points);
        }
        if over {
            break;
        }
        tokio::task::yield_now().await;
    }
    assert_eq!(ahead, bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap().points);
}

#[tokio::test]
async fn hold_retracts_resume_touches_rest() {
    let mut bench = Bench::new(SLOW, patient()).await;
    let plan = bench.plan(10);
    bench.begin(&plan).await.unwrap();
    until_points(&mut bench.cmm, 2).await;
    assert_eq!(bench.cmm.hold().await.unwrap().state, MachineState::Holding);
    let held = until(&mut bench.cmm, |status| has_state(status, MachineState::Held)).await.unwrap();
    assert!(held.progress.is_some_and(|(done, _)| done < 10) && held.clear_of_part == Some(true));
    let highest = plan.targets.iter().map(|t| t.point_mm[2]).fold(f64::MIN, f64::max);
    let height = bench.serving.with(|server| server.machine().at_mm()[2]);
    assert!(height >= highest + plan.safe_height_mm, "{height}");
    bench.cmm.resume().await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete), "{:?}", bench.cmm.notes());
    let measurement = bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    bench.assert_on_part(&plan, &measurement);
}

#[tokio::test]
async fn stop_gives_no_measurement() {
    let mut bench = Bench::new(SLOW, patient()).await;
    let plan = bench.plan(20);
    bench.begin(&plan).await.unwrap();
    until_points(&mut bench.cmm, 1).await;
    bench.cmm.stop().await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Stopped));
    let none = bench.cmm.collect(job(&plan), &Interrupt::new()).await;
    assert!(matches!(none, Err(DeviceError::NoResult { .. })));
}

#[tokio::test]
async fn abort_then_clear_allows_prepare() {
    let mut bench = Bench::new(1.0, patient()).await;
    let plan = bench.plan(20);
    bench.begin(&plan).await.unwrap();
    assert_eq!(bench.cmm.abort().await.unwrap().state, MachineState::Aborting);
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.outcome, status.clear_of_part), (MachineState::Aborted, Outcome::Aborted, None));
    // Nothing of the job remains at the server.
    assert_eq!(bench.serving.with(|server| server.due(1)), None);
    assert_eq!(bench.cmm.clear().await.unwrap().state, MachineState::Idle);
    bench.cmm.prepare(job(&plan)).await.unwrap();
}

#[tokio::test]
async fn start_accepted_once() {
    let mut bench = Bench::new(1.0, patient()).await;
    let plan = bench.plan(5);
    let armed = bench.begin(&plan).await.unwrap();
    let again = bench.cmm.start(armed).await;
    assert!(matches!(again, Err(DeviceError::Refused { .. })), "{again:?}");
}

#[tokio::test]
async fn restarted_program_reports_lost_points() {
    let mut bench = Bench::new(SLOW, patient()).await;
    let plan = bench.plan(20);
    let armed = bench.begin(&plan).await.unwrap();
    until_points(&mut bench.cmm, 1).await;
    let mut another = bench.another();
    another.restore(&armed);
    drop(std::mem::replace(&mut bench.cmm, another));
    bench.cmm.connect().await.unwrap();
    let Reconciled::Finished(status) = bench.cmm.reconcile(&armed).await.unwrap() else { panic!() };
    assert_eq!((status.state, status.outcome, status.clear_of_part), (MachineState::Complete, Outcome::Failed, None));
    assert!(bench.cmm.notes().iter().any(|note| note.contains("are lost")));
    assert!(bench.cmm.collect(job(&plan), &Interrupt::new()).await.is_err());
    bench.cmm.acknowledge(status.done).await.unwrap();
    let armed = begin(&mut bench.cmm, &plan).await.unwrap();
    assert!(armed.start_sequence > status.done);
    until_points(&mut bench.cmm, 1).await;
}

#[tokio::test]
async fn plan_outside_volume_refused() {
    let mut bench = Bench::new(FAST, patient()).await;
    let plan = Plan { safe_height_mm: 450.0, ..bench.plan(5) };
    bench.cmm.connect().await.unwrap();
    let error = bench.cmm.load_plan(&plan, &Interrupt::new()).await.unwrap_err();
    let text = error.to_string();
    assert!(text.contains("target 10") && text.contains("400") && text.contains("safe_height_mm"), "{text}");
    assert_eq!(bench.world.measurements_begun(), 0);
}

#[tokio::test]
async fn wrong_probe_radius_faults() {
    let tools = vec![("NoTool".to_owned(), 0.0), ("Probe1".to_owned(), 1.52)];
    let mut bench = Bench::with(FAST, patient(), Options { tools, ..Options::default() }).await;
    let plan = bench.plan(5);
    bench.begin(&plan).await.unwrap();
    assert_eq!(until_still(&mut bench.cmm).await.unwrap().state, MachineState::Faulted);
    assert!(bench.cmm.notes()[0].contains("1.52 mm"), "{:?}", bench.cmm.notes());
    assert_eq!(bench.world.measurements_begun(), 0);
}

#[tokio::test]
async fn missing_tool_lists_available_tools() {
    let tools = vec![("Star".to_owned(), 1.5)];
    let mut bench = Bench::with(FAST, patient(), Options { tools, ..Options::default() }).await;
    let error = bench.cmm.connect().await.unwrap_err().to_string();
    assert!(error.contains("\"Probe1\"") && error.contains("Star"), "{error}");
}

#[tokio::test]
async fn real_machine_refused_as_simulation() {
    let class = "CartCMM".to_owned();
    let mut bench = Bench::with(FAST, patient(), Options { class, ..Options::default() }).await;
    let error = bench.cmm.connect().await.unwrap_err();
    assert!(matches!(error, DeviceError::SimulationMismatch { simulation: false, .. }), "{error}");
}

#[tokio::test]
async fn lower_machine_speed_is_reported() {
    let mut bench = Bench::with(FAST, patient(), Options { max_speeds_mm_s: [50.0, 2.0], ..Options::default() }).await;
    let plan = bench.plan(5);
    bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!(status.outcome, Outcome::Complete, "{:?}", bench.cmm.notes());
    assert!(bench.cmm.notes().iter().any(|note| note.contains("Speed to 50")), "{:?}", bench.cmm.notes());
}

#[tokio::test]
async fn missed_targets_retried_then_reported() {
    let spec = CmmSpec { not_found_share: 0.5, ..perfect_cmm() };
    let mut bench = Bench::measuring(spec, FAST, patient(), Options::default()).await;
    let plan = bench.plan(20);
    bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!(status.outcome, Outcome::Complete, "{:?}", bench.cmm.notes());
    let measurement = bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    bench.assert_on_part(&plan, &measurement);
    let missed = measurement.points.iter().filter(|point| point.status == TouchStatus::NotFound).count();
    // Half of the first tries, and a quarter after the second ones.
    assert!((1..15).contains(&missed), "{missed}");
}

#[tokio::test]
async fn second_client_connects_after_release() {
    let mut bench = Bench::new(FAST, patient()).await;
    bench.cmm.connect().await.unwrap();
    let mut other = bench.another();
    let (first, second) = tokio::join!(bench.cmm.release(), other.connect());
    assert!(first.is_ok() && second.is_ok(), "{first:?}, {second:?}");
    let _: &ServingLines<regrind_sim::dme::Server> = &bench.serving;
}

#[tokio::test]
async fn job_without_status_polls_holds() {
    let mut bench = Bench::new(SLOW, patient()).await;
    let mut settings = settings(bench.serving.local_addr().port(), patient());
    settings.silence_limit = std::time::Duration::ZERO;
    bench.cmm = IppdmeCmm::new(settings);
    let plan = bench.plan(10);
    bench.begin(&plan).await.unwrap();
    let held = until(&mut bench.cmm, |status| has_state(status, MachineState::Held)).await.unwrap();
    assert!(held.progress.is_some_and(|(done, _)| done < 10));
    assert!(bench.cmm.notes()[0].contains("no status request"), "{:?}", bench.cmm.notes());
}
