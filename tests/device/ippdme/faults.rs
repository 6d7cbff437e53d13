//! Every communication fault: no wrong point is accepted, and nothing hangs.

use std::time::Duration;

use regrind::device::{
    Cmm, DeviceError, Fault as MachineFault, Interrupt, Machine, MachineState, Outcome, Reconciled, Status,
};
use regrind_sim::dme::faults::Fault;
use regrind_testcell::perfect::perfect_cmm;

use super::bench::{Bench, hasty, job, patient, until, until_points, until_still};

const FAST: f64 = 5000.0;

/// Runs a job with a fault at the third touch.
async fn run_with_touch_fault(
    fault: Fault,
    limits: regrind::device::ippdme::Limits,
) -> (Bench, Result<Status, DeviceError>) {
    run_with_fault("PtMeas", 2, fault, limits).await
}

async fn run_with_fault(
    method: &str,
    skip: u32,
    fault: Fault,
    limits: regrind::device::ippdme::Limits,
) -> (Bench, Result<Status, DeviceError>) {
    let mut bench = Bench::new(FAST, limits).await;
    bench.faults.add(method, skip, fault);
    let plan = bench.plan(8);
    let ended = match bench.begin(&plan).await {
        Ok(_) => until_still(&mut bench.cmm).await,
        Err(error) => Err(error),
    };
    (bench, ended)
}

/// Asserts that the job finished anyway, with true points.
async fn assert_measured(bench: &mut Bench, ended: Result<Status, DeviceError>) {
    let status = ended.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete), "{:?}", bench.cmm.notes());
    let plan = bench.plan(8);
    let measurement = bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    bench.assert_on_part(&plan, &measurement);
}

/// Asserts that the connection was given up; after a new connection, the machine is at rest, the job is held, and a
/// resume brings the missing points.
async fn assert_resumed(bench: &mut Bench, ended: Result<Status, DeviceError>) {
    let error = ended.unwrap_err();
    assert!(error.is_link(), "{error}");
    let plan = bench.plan(8);
    // It does not matter for which command the short timeout expired: reconnect until it succeeds.
    for _ in 0..20 {
        if bench.cmm.connect().await.is_err() {
            continue;
        }
        if until_still(&mut bench.cmm).await.is_ok_and(|status| status.state == MachineState::Held) {
            bench.cmm.resume().await.unwrap();
        }
        match until_still(&mut bench.cmm).await {
            Ok(status) if status.state == MachineState::Complete => return assert_measured(bench, Ok(status)).await,
            Ok(status) if status.state == MachineState::Idle => {
                super::bench::begin(&mut bench.cmm, &plan).await.unwrap();
            }
            _ => {}
        }
    }
    panic!("not measured in twenty connections: {:?}", bench.cmm.notes());
}

#[tokio::test]
async fn late_acknowledgement_accepted() {
    let (mut bench, ended) =
        run_with_touch_fault(Fault::LateAcknowledgement(Duration::from_millis(50)), patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn acknowledgement_timeout_disconnects() {
    let (mut bench, ended) = run_with_touch_fault(Fault::LateAcknowledgement(Duration::from_secs(3600)), hasty()).await;
    assert!(matches!(ended, Err(DeviceError::TimedOut { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn touch_completion_timeout_disconnects() {
    let (mut bench, ended) = run_with_touch_fault(Fault::NoCompletion, hasty()).await;
    assert!(matches!(ended, Err(DeviceError::TimedOut { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn duplicate_data_is_one_point() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Twice, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn split_line_is_one_line() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Split, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn reordered_fields_found_by_name() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Reordered, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn extra_quality_in_touch_ignored() {
    let (mut bench, ended) = run_with_touch_fault(Fault::UnaskedQuality, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn garbled_line_disconnects() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Garbled, patient()).await;
    assert!(matches!(ended, Err(DeviceError::Unreadable { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn unrequested_data_disconnects() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Stranger, patient()).await;
    assert!(matches!(ended, Err(DeviceError::Unreadable { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn disconnect_in_job_preserves_points() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Disconnect, patient()).await;
    assert!(matches!(ended, Err(DeviceError::Disconnected { .. })), "{ended:?}");
    let plan = bench.plan(8);
    bench.cmm.connect().await.unwrap();
    let armed = regrind::device::Armed { job: job(&plan), start_sequence: 1, token: 0, boot_id: 0 };
    let Reconciled::Running(status) = bench.cmm.reconcile(&armed).await.unwrap() else { panic!() };
    // The third touch was made, but its end was not reported.
    assert_eq!((status.state, status.progress, status.clear_of_part), (MachineState::Held, Some((2, 8)), None));
    bench.cmm.resume().await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn session_start_error_cleared() {
    let (mut bench, ended) = run_with_fault("GetPropX", 0, Fault::Twice, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn emergency_stop_in_job_faults() {
    let (mut bench, ended) = run_with_touch_fault(Fault::EmergencyStop, patient()).await;
    let status = ended.unwrap();
    assert_eq!((status.state, status.fault), (MachineState::Faulted, Some(MachineFault::StopCircuit)));
    assert_eq!((status.outcome, status.clear_of_part), (Outcome::Failed, None));
    assert!(bench.cmm.notes()[0].contains("error 0500"), "{:?}", bench.cmm.notes());
    assert_eq!(bench.cmm.clear().await.unwrap().state, MachineState::Idle);
}

#[tokio::test]
async fn emergency_stop_between_jobs_faults() {
    let limits = regrind::device::ippdme::Limits { alive: Duration::from_millis(5), ..patient() };
    let mut bench = Bench::new(FAST, limits).await;
    bench.cmm.connect().await.unwrap();
    bench.serving.with(|server| server.emergency_stop(Duration::ZERO));
    let status = until(&mut bench.cmm, |status| status.state == MachineState::Faulted).await.unwrap();
    assert_eq!(status.fault, Some(MachineFault::StopCircuit));
}

#[tokio::test]
async fn travel_limit_warning_faults() {
    let mut bench = Bench::new(FAST, patient()).await;
    // Outside the volume of the machine, which is smaller than in the cell file.
    bench.faults.add("GoTo", 0, Fault::Severity(1));
    let mut plan = bench.plan(3);
    for target in &mut plan.targets {
        target.point_mm[2] += 375.0;
    }
    let port = bench.serving.local_addr().port();
    let mut settings = super::bench::settings(port, patient());
    settings.volume_mm = [[-1000.0; 3], [1000.0; 3]];
    bench.cmm = regrind::device::IppdmeCmm::new(settings);
    bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.fault), (MachineState::Faulted, Some(MachineFault::TravelLimit)));
}

#[tokio::test]
async fn miss_needing_operator_not_retried() {
    let spec = regrind_sim::spec::CmmSpec { not_found_share: 1.0, ..perfect_cmm() };
    let mut bench = Bench::measuring(spec, FAST, patient(), regrind_sim::dme::machine::Options::default()).await;
    bench.faults.add("PtMeas", 0, Fault::Severity(3));
    let plan = bench.plan(3);
    bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.fault), (MachineState::Faulted, Some(MachineFault::Other(1006))));
}

#[tokio::test]
async fn ignored_abort_is_link_error() {
    let mut bench = Bench::new(1.0, hasty()).await;
    bench.faults.add("AbortE", 0, Fault::AbortIgnored);
    let plan = bench.plan(8);
    bench.begin(&plan).await.unwrap();
    until(&mut bench.cmm, |status| status.state == MachineState::Execute).await.unwrap();
    bench.cmm.abort().await.unwrap();
    let error = until_still(&mut bench.cmm).await.unwrap_err();
    assert!(error.is_link(), "{error}");
}

#[tokio::test]
async fn silent_motion_is_polled_and_continues() {
    let limits = regrind::device::ippdme::Limits { alive: Duration::from_millis(3), ..patient() };
    let mut bench = Bench::new(200.0, limits).await;
    let plan = bench.plan(8);
    bench.begin(&plan).await.unwrap();
    until_points(&mut bench.cmm, 2).await;
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
}
