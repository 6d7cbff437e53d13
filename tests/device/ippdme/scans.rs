//! Scanned rows: their points lie on the part, each at its target, and no fault brings a wrong one.

use regrind::device::{
    Cmm, DeviceError, Fault as MachineFault, Interrupt, IppdmeCmm, Machine, MachineState, Outcome, Plan, PlanTarget,
    Scanning, Status, TargetKind, TouchStatus,
};
use regrind_sim::dme::faults::Fault;
use regrind_sim::dme::machine::Options;
use regrind_sim::line_server::LineServer;
use regrind_sim::spec::CmmSpec;
use regrind_testcell::perfect::perfect_cmm;

use super::bench::{Bench, job, patient, settings, until, until_still};

const FAST: f64 = 5000.0;

async fn scanning(speed: f64, cmm: CmmSpec) -> Bench {
    let mut bench = Bench::measuring(cmm, speed, patient(), Options::default()).await;
    let mut settings = settings(bench.serving.local_addr().port(), patient());
    settings.scan = Some(Scanning { speed_mm_s: 10.0, step_mm: 1.5 });
    bench.cmm = IppdmeCmm::new(settings);
    bench
}

/// Returns a plan of three rows of twelve targets, back and forth, and one single target.
fn rows(bench: &Bench) -> Plan {
    let row = |k: u32| {
        (0..12).map(move |i| (f64::from(if k.is_multiple_of(2) { i } else { 11 - i }) - 5.5, 3.0 * f64::from(k)))
    };
    let places = (0..3).flat_map(row).chain([(-12.0, -6.0)]);
    let targets = places.enumerate().map(|(index, (x, y))| {
        let (point_mm, normal) = bench.world.nominal(x, y);
        PlanTarget { index: 10 + index as u32, kind: TargetKind::Part, point_mm, normal }
    });
    Plan { targets: targets.collect(), ..bench.plan(1) }
}

async fn run_with_fault(fault: Option<Fault>) -> (Bench, Result<Status, DeviceError>) {
    let mut bench = scanning(FAST, perfect_cmm()).await;
    if let Some(fault) = fault {
        bench.faults.add("ScanOnCurve", 1, fault);
    }
    let plan = rows(&bench);
    bench.begin(&plan).await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    (bench, ended)
}

async fn assert_measured(bench: &mut Bench, ended: Result<Status, DeviceError>) {
    let status = ended.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Complete, Outcome::Complete), "{:?}", bench.cmm.notes());
    let plan = rows(bench);
    let measurement = bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    bench.assert_on_part(&plan, &measurement);
    assert!(measurement.points.iter().all(|point| point.status == TouchStatus::Touched));
}

#[tokio::test]
async fn rows_scanned_at_their_targets() {
    let (mut bench, ended) = run_with_fault(None).await;
    assert_measured(&mut bench, ended).await;
    // A scan counts as one contact, however many points it brings: three rows and a touch, compared with 37 touches.
    assert_eq!(bench.serving.with(|server| server.machine().contacts()), 4);
}

#[tokio::test]
async fn extra_quality_in_scan_ignored() {
    let (mut bench, ended) = run_with_fault(Some(Fault::UnaskedQuality)).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn duplicate_or_split_scan_line_is_one() {
    for fault in [Fault::Twice, Fault::Split] {
        let (mut bench, ended) = run_with_fault(Some(fault)).await;
        assert_measured(&mut bench, ended).await;
    }
}

/// Asserts that a scan with this fault is rejected completely, and that the machine is at rest.
async fn assert_scan_refused(fault: Fault, says: &str) {
    let (bench, ended) = run_with_fault(Some(fault)).await;
    let status = ended.unwrap();
    assert_eq!((status.state, status.outcome), (MachineState::Faulted, Outcome::Failed));
    assert_eq!(status.progress, Some((12, 37)), "the first row alone");
    assert!(bench.cmm.notes()[0].contains(says), "{:?}", bench.cmm.notes());
}

#[tokio::test]
async fn scan_refuses_missing_point() {
    assert_scan_refused(Fault::PointLost, "one point at each target").await;
}

#[tokio::test]
async fn scan_refuses_shifted_points() {
    assert_scan_refused(Fault::PointsShifted, "the lateral distance").await;
}

#[tokio::test]
async fn disconnect_in_scan_rescans_row() {
    let (mut bench, ended) = run_with_fault(Some(Fault::CutInScan)).await;
    let error = ended.unwrap_err();
    assert!(error.is_link(), "{error}");
    bench.cmm.connect().await.unwrap();
    let held = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((held.state, held.progress, held.clear_of_part), (MachineState::Held, Some((12, 37)), None));
    bench.cmm.resume().await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn row_losing_surface_is_touched() {
    let mut bench = scanning(FAST, CmmSpec { not_found_share: 0.1, ..perfect_cmm() }).await;
    let plan = rows(&bench);
    bench.begin(&plan).await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    assert!(bench.cmm.notes().iter().any(|note| note.contains("is touched")), "{:?}", bench.cmm.notes());
    let status = ended.unwrap();
    assert_eq!(status.outcome, Outcome::Complete, "{:?}", bench.cmm.notes());
    let measurement = bench.cmm.collect(job(&plan), &Interrupt::new()).await.unwrap();
    bench.assert_on_part(&plan, &measurement);
}

/// Returns a job in its second row, which takes as long as a real one.
async fn in_the_second_row(speed_mm_s: f64) -> Bench {
    let mut bench = scanning(FAST, perfect_cmm()).await;
    let mut settings = settings(bench.serving.local_addr().port(), patient());
    settings.scan = Some(Scanning { speed_mm_s, step_mm: 1.5 });
    bench.cmm = IppdmeCmm::new(settings);
    bench.faults.add("ScanOnCurve", 1, Fault::InRealTime);
    let plan = rows(&bench);
    bench.begin(&plan).await.unwrap();
    let serving = &bench.serving;
    until(&mut bench.cmm, |_| serving.with(|server| server.machine().contacts()) == 2).await.unwrap();
    bench
}

#[tokio::test]
async fn hold_in_scan_defers_next_row() {
    // The row ends after about five seconds.
    let mut bench = in_the_second_row(10.0).await;
    assert_eq!(bench.cmm.hold().await.unwrap().state, MachineState::Holding);
    let held = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((held.state, held.progress, held.clear_of_part), (MachineState::Held, Some((24, 37)), Some(true)));
    assert_eq!(bench.serving.with(|server| (server.due(1), server.machine().contacts())), (None, 2));
    bench.cmm.resume().await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
}

#[tokio::test]
async fn abort_in_scan_ends_row() {
    // The row takes half a minute, and nobody waits for it.
    let mut bench = in_the_second_row(0.4).await;
    bench.cmm.abort().await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.outcome, status.clear_of_part), (MachineState::Aborted, Outcome::Aborted, None));
    // The row that was finished before is present, and nothing of this one. Nothing of this one remains at the server.
    assert_eq!(status.progress, Some((12, 37)));
    let left = bench.serving.with(|server| (server.due(1), server.machine().contacts()));
    assert_eq!(left, (None, 2));
}

#[tokio::test]
async fn scan_refuses_reordered_values() {
    assert_scan_refused(Fault::Reordered, "from the target").await;
}

#[tokio::test]
async fn unknown_tool_radius_touches_rows() {
    let mut bench = scanning(FAST, perfect_cmm()).await;
    bench.serving.with(|server| server.machine().hide_radius());
    let plan = rows(&bench);
    bench.begin(&plan).await.unwrap();
    let ended = until_still(&mut bench.cmm).await;
    assert_measured(&mut bench, ended).await;
    assert_eq!(bench.serving.with(|server| server.machine().contacts()), 37);
}

#[tokio::test]
async fn non_scanning_probe_is_tool_fault() {
    let mut bench = scanning(FAST, perfect_cmm()).await;
    bench.serving.with(|server| server.machine().disable_scanning());
    let plan = rows(&bench);
    bench.begin(&plan).await.unwrap();
    let status = until_still(&mut bench.cmm).await.unwrap();
    assert_eq!((status.state, status.fault), (MachineState::Faulted, Some(MachineFault::Tool)));
    assert!(bench.cmm.notes()[0].contains("2002"), "{:?}", bench.cmm.notes());
}
