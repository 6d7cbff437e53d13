//! Every communication fault: no wrong point is accepted, and nothing hangs.

use std::time::Duration;

use regrind::device::{
    Cmm, DeviceError, Fault as MachineFault, Interrupt, Machine, Outcome, Reconciled, State, Status,
};
use regrind_sim::dme::faults::Fault;

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
    assert_eq!((status.state, status.outcome), (State::Complete, Outcome::Complete), "{:?}", bench.cmm.notes());
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
        if until_still(&mut bench.cmm).await.is_ok_and(|status| status.state == State::Held) {
            bench.cmm.resume().await.unwrap();
        }
        match until_still(&mut bench.cmm).await {
            Ok(status) if status.state == State::Complete => return assert_measured(bench, Ok(status)).await,
            Ok(status) if status.state == State::Idle => {
                super::bench::begin(&mut bench.cmm, &plan).await.unwrap();
            }
            _ => {}
        }
    }
    panic!("not measured in twenty connections: {:?}", bench.cmm.notes());
}

#[tokio::test]
async fn a_late_acknowledgement_is_waited_for() {
    let (mut bench, ended) =
        run_with_touch_fault(Fault::LateAcknowledgement(Duration::from_millis(50)), patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn an_acknowledgement_that_does_not_come_in_time_ends_the_connection() {
    let (mut bench, ended) = run_with_touch_fault(Fault::LateAcknowledgement(Duration::from_secs(3600)), hasty()).await;
    assert!(matches!(ended, Err(DeviceError::TimedOut { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn a_touch_that_is_never_said_to_be_over_ends_the_connection() {
    let (mut bench, ended) = run_with_touch_fault(Fault::NoCompletion, hasty()).await;
    assert!(matches!(ended, Err(DeviceError::TimedOut { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn data_that_come_twice_are_one_point() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Twice, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn a_line_that_comes_byte_for_byte_is_one_line() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Split, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn fields_are_known_by_their_names_in_whatever_order_they_come() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Reordered, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn a_quality_that_comes_twice_spoils_no_coordinate() {
    let (mut bench, ended) = run_with_touch_fault(Fault::UnaskedQuality, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn a_garbled_line_is_no_point_and_ends_the_connection() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Garbled, patient()).await;
    assert!(matches!(ended, Err(DeviceError::Unreadable { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn data_of_a_command_that_was_never_given_are_no_point() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Stranger, patient()).await;
    assert!(matches!(ended, Err(DeviceError::Unreadable { .. })), "{ended:?}");
    assert_resumed(&mut bench, ended).await;
}

#[tokio::test]
async fn a_connection_that_ends_in_a_job_loses_no_point() {
    let (mut bench, ended) = run_with_touch_fault(Fault::Disconnect, patient()).await;
    assert!(matches!(ended, Err(DeviceError::Disconnected { .. })), "{ended:?}");
    let plan = bench.plan(8);
    bench.cmm.connect().await.unwrap();
    let armed = regrind::device::Armed { job: job(&plan), start_sequence: 1, token: 0, boot_id: 0 };
    let Reconciled::Running(status) = bench.cmm.reconcile(&armed).await.unwrap() else { panic!() };
    // The third touch was made, but its end was not reported.
    assert_eq!((status.state, status.progress, status.clear_of_part), (State::Held, Some((2, 8)), None));
    bench.cmm.resume().await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn an_error_in_a_session_that_is_being_opened_is_cleared_away() {
    let (mut bench, ended) = run_with_fault("GetPropX", 0, Fault::Twice, patient()).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn an_emergency_stop_faults_and_is_told_as_that() {
    let (mut bench, ended) = run_with_touch_fault(Fault::EmergencyStop, patient()).await;
    let status = ended.unwrap();
    assert_eq!((status.state, status.fault), (State::Faulted, Some(MachineFault::StopCircuit)));
    assert_eq!((status.outcome, status.clear_of_part), (Outcome::Failed, None));
    assert!(bench.cmm.notes()[0].contains("error 0500"), "{:?}", bench.cmm.notes());
    assert_eq!(bench.cmm.clear().await.unwrap().state, State::Idle);
}

#[tokio::test]
async fn an_emergency_stop_between_jobs_is_seen() {
    let limits = regrind::device::ippdme::Limits { alive: Duration::from_millis(5), ..patient() };
    let mut bench = Bench::new(FAST, limits).await;
    bench.cmm.connect().await.unwrap();
    bench.serving.with(|server| server.emergency_stop(Duration::ZERO));
    let status = until(&mut bench.cmm, |status| status.state == State::Faulted).await.unwrap();
    assert_eq!(status.fault, Some(MachineFault::StopCircuit));
}

#[tokio::test]
async fn a_stop_that_a_server_only_warns_of_stops_all_the_same() {
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
    assert_eq!((status.state, status.fault), (State::Faulted, Some(MachineFault::TravelLimit)));
}

#[tokio::test]
async fn a_miss_that_needs_an_operator_is_not_tried_again() {
    let spec = regrind_sim::spec::CmmSpec { not_found_share: 1.0, ..regrind_sim::spec::CmmSpec::perfect() };
    let mut bench = Bench::measuring(spec, FAST, patient(), regrind_sim::dme::machine::Options::default()).await;
    bench.faults.add("PtMeas", 0, Fault::Severity(3));
    let plan = bench.plan(3);
    bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.fault), (State::Faulted, Some(MachineFault::Other(1006))));
}

#[tokio::test]
async fn an_abort_that_the_server_does_not_carry_out_is_not_taken_for_done() {
    let mut bench = Bench::new(1.0, hasty()).await;
    bench.faults.add("AbortE", 0, Fault::AbortIgnored);
    let plan = bench.plan(8);
    bench.begin(&plan).await.unwrap();
    until(&mut bench.cmm, |status| status.state == State::Execute).await.unwrap();
    bench.cmm.abort().await.unwrap();
    let error = until_still(&mut bench.cmm).await.unwrap_err();
    assert!(error.is_link(), "{error}");
}

#[tokio::test]
async fn a_silence_in_a_motion_is_asked_about_and_the_motion_goes_on() {
    let limits = regrind::device::ippdme::Limits { alive: Duration::from_millis(3), ..patient() };
    let mut bench = Bench::new(200.0, limits).await;
    let plan = bench.plan(8);
    bench.begin(&plan).await.unwrap();
    until_points(&mut bench.cmm, 2).await;
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
}
