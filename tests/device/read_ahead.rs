//! Pages of a result that arrive while its job is still running: a machine that supports them, one that does not, and
//! some that send false data. The machine measures only when a test makes it, and otherwise does nothing.

#![cfg(unix)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use regrind::device::{
    Cmm, DeviceError, Interrupt, Machine, MachineState, MeasuredPoint, Measurement, ModbusCmm, ModbusSettings, Plan,
    PreliminaryPoints,
};
use regrind_sim::body::Kind;
use regrind_sim::command::State as At;
use regrind_sim::options::MachineOptions;
use regrind_sim::wire::rtu::Line as SerialLine;
use regrind_sim::{register_encoding, registers};

use crate::modbus::{assert_exact, began, claimed, job_of, patient, plan, rtu, settings, wait_for_state};
use crate::toy::Toy;
use regrind_testcell::wire_faults::{Fault, FaultPlan, Request, Serving, SharedFaultPlan, When};

const HEADER: u16 = 400;
const SELECT: u16 = 460;
const PAGE: u16 = 462;
/// Number of points of a full page.
const FULL: usize = 7;
const POINTS: u32 = 200;
/// Number of pages of the whole result.
const PAGES: u64 = 29;

fn machine(toy: Toy, gives_ahead: bool) -> registers::SimulatedMachine {
    let options = MachineOptions { speed: 0.0, gives_ahead, ..MachineOptions::default() };
    registers::SimulatedMachine::new(Box::new(toy), 0xb007, options)
}

fn toy() -> Toy {
    Toy::new(Kind::Cmm, 1000.0)
}

async fn serve(toy: Toy, gives_ahead: bool) -> Serving {
    Serving::tcp_with("127.0.0.1:0", vec![(1, machine(toy, gives_ahead))], SharedFaultPlan::none()).await.unwrap()
}

/// Lets the machine measure a thousand points a second for this time.
fn work(serving: &Serving, ms: u64) {
    serving.machine(1).unwrap().with(|machine| {
        machine.set_speed(1.0);
        machine.tick(Duration::from_millis(ms));
        machine.set_speed(0.0);
    });
}

/// Begins a job.
async fn begin_job(settings: ModbusSettings, plan: &Plan) -> ModbusCmm {
    let mut cmm = claimed(settings).await;
    cmm.load_plan(plan, &Interrupt::new()).await.unwrap();
    let armed = cmm.prepare(job_of(plan, 1)).await.unwrap();
    cmm.start(armed).await.unwrap();
    cmm
}

/// Begins a job, and measures about half of it: more than 14 pages, fewer than 15.
async fn half_done(serving: &Serving, settings: ModbusSettings, plan: &Plan) -> ModbusCmm {
    let cmm = begin_job(settings, plan).await;
    work(serving, 102);
    cmm
}

/// Polls this number of times, and takes one step of reading ahead after each.
async fn poll(cmm: &mut ModbusCmm, plan: &Plan, cycle: u16, polls: usize) -> Vec<PreliminaryPoints> {
    let mut told = Vec::new();
    for _ in 0..polls {
        cmm.status().await.unwrap();
        told.extend(cmm.read_ahead(job_of(plan, cycle), &Interrupt::new()).await);
    }
    told
}

async fn finish(serving: &Serving, cmm: &mut ModbusCmm, plan: &Plan) -> Result<Measurement, DeviceError> {
    work(serving, 200);
    wait_for_state(cmm, MachineState::Complete).await?;
    cmm.collect(job_of(plan, 1), &Interrupt::new()).await
}

/// Counts the requests that read or write from an address on, starting now.
fn counted(serving: &Serving, rules: FaultPlan, at: u16) -> Arc<AtomicU64> {
    let count = Arc::new(AtomicU64::new(0));
    let counter = Arc::clone(&count);
    let look = move |request: &Request| {
        counter.fetch_add(u64::from(request.address == at), Ordering::SeqCst);
        false
    };
    serving.faults().set(rules.always(When::Matching(Box::new(look)), Fault::DropReply));
    count
}

fn read_count(count: &AtomicU64) -> u64 {
    count.load(Ordering::SeqCst)
}

/// Selects requests at an address while the job runs.
fn early(at: u16) -> When {
    When::Matching(Box::new(move |request| request.address == at && request.state == Some(At::Execute)))
}

fn points(told: &[PreliminaryPoints]) -> Vec<MeasuredPoint> {
    told.iter().flat_map(|told| told.points.clone()).collect()
}

#[tokio::test]
async fn read_ahead_result_equals_full_read() {
    let plan = plan(POINTS);
    let mut both = Vec::new();
    for (gives_ahead, came) in [(true, 14), (false, 0)] {
        let serving = serve(toy(), gives_ahead).await;
        let mut cmm = half_done(&serving, patient(settings(&serving)), &plan).await;
        let early = counted(&serving, FaultPlan::new(0), PAGE);
        let told = poll(&mut cmm, &plan, 1, 20).await;
        // Nothing requests a page that is not full.
        assert_eq!(read_count(&early), came);
        assert!(told.iter().enumerate().all(|(k, told)| told.first_index == FULL * k), "{told:?}");
        let late = counted(&serving, FaultPlan::new(0), PAGE);
        let measured = finish(&serving, &mut cmm, &plan).await.unwrap();
        assert_eq!(read_count(&late), PAGES - came);
        assert_exact(&plan, &measured, "read ahead");
        assert_eq!(points(&told), measured.points[..FULL * came as usize]);
        assert_eq!(cmm.collect(job_of(&plan, 1), &Interrupt::new()).await.unwrap(), measured, "read twice");
        both.push(measured);
    }
    assert_eq!(both[0], both[1]);
}

#[tokio::test]
async fn read_ahead_records_across_pages() {
    let plan = plan(POINTS);
    let options =
        MachineOptions { speed: 0.0, word_order: register_encoding::WordOrder::Little, ..MachineOptions::default() };
    let machine = registers::SimulatedMachine::new(Box::new(toy().in_counts()), 0xb007, options);
    let serving = Serving::tcp_with("127.0.0.1:0", vec![(1, machine)], SharedFaultPlan::none()).await.unwrap();
    let mut settings = patient(settings(&serving));
    settings.registers.word_order = regrind::device::WordOrder::Little;
    let mut cmm = half_done(&serving, settings, &plan).await;
    let told = poll(&mut cmm, &plan, 1, 20).await;
    let measured = finish(&serving, &mut cmm, &plan).await.unwrap();
    // Nine full pages of 112 registers, ten to a record.
    assert_eq!(points(&told), measured.points[..100]);
    assert!(told.iter().map(|told| told.points.len()).all(|new| new == 11 || new == 12), "{told:?}");
    assert_eq!(measured.points.len(), POINTS as usize);
}

/// Returns the false data and faults during reading ahead: the register address, and the fault.
fn lies() -> Vec<(u16, Fault)> {
    let lie = |register, value| Fault::Lie(vec![(register, value)]);
    let mut all = vec![
        (HEADER, lie(0, 5)),                                                  // another kind
        (HEADER, lie(1, 3)),                                                  // a format that is none
        (HEADER, lie(1, 2)),                                                  // a format with other bytes
        (HEADER, lie(7, 43)),                                                 // another job
        (HEADER, lie(8, 2)),                                                  // another cycle
        (HEADER, lie(9, 2)),                                                  // contacts, and centres in the end
        (HEADER, lie(9, 7)),                                                  // neither
        (HEADER, Fault::Lie(vec![(2, 0), (3, 64_000), (10, 0), (11, 2000)])), // more than there is
        (HEADER, lie(12, 0x4010)),                                            // another probe
        (HEADER, lie(16, 0x7ff8)),                                            // a scale that is no number
        (HEADER, lie(28, 2)),                                                 // inches
        (HEADER, lie(30, 0xdead)),                                            // another plan
        (HEADER, lie(47, 4)),                                                 // the number of an end
        (PAGE, lie(1, 9)),                                                    // another page
        (PAGE, lie(2, 5)),                                                    // a page that is not full
        (PAGE, lie(2, 0)),                                                    // not full yet
        (PAGE, lie(6, 9)),                                                    // a status that is none
        (PAGE, lie(8, 0x7ff8)),                                               // a coordinate that is no number
        (PAGE, lie(8, 0x4044)),                                               // another coordinate
        (PAGE, Fault::FlipData),
        (PAGE, Fault::Fewer),
        (PAGE, Fault::WordSwap),
    ];
    all.extend([
        (HEADER, Fault::Disconnect(5)),
        (SELECT, Fault::DropRequest),
        (PAGE, Fault::DropReply),
        (PAGE, Fault::FlipCrc),
    ]);
    all.extend([HEADER, SELECT, PAGE].into_iter().flat_map(|at| [2, 6].map(|code| (at, Fault::Exception(code)))));
    all
}

#[tokio::test]
async fn read_ahead_faults_never_alter_result() {
    let plan = plan(POINTS);
    for (at, fault) in lies() {
        for always in [false, true] {
            let hint = format!("{at}: {fault:?}, always: {always}");
            let serving = serve(toy(), true).await;
            let settings = ModbusSettings { request_timeout: Duration::from_millis(100), ..settings(&serving) };
            let mut cmm = half_done(&serving, settings, &plan).await;
            let rules = FaultPlan::new(1);
            serving.faults().set(match always {
                true => rules.always(early(at), fault.clone()),
                false => rules.times(if at == HEADER { 1 } else { 2 }, 1, early(at), fault.clone()),
            });
            // No poll fails because of it: after a fault, reading ahead ends, and soon.
            poll(&mut cmm, &plan, 1, 8).await;
            let measured = finish(&serving, &mut cmm, &plan).await;
            assert_exact(&plan, &measured.unwrap_or_else(|error| panic!("{hint}: {error}")), &hint);
            assert_eq!(began(&serving).len(), 1, "{hint}");
        }
    }
}

#[tokio::test]
async fn read_ahead_gives_up_after_refusal() {
    let plan = plan(POINTS);
    for (fault, times) in [(Fault::Exception(2), 1), (Fault::Disconnect(0), 3)] {
        let serving = serve(toy(), true).await;
        let mut cmm = half_done(&serving, patient(settings(&serving)), &plan).await;
        serving.faults().set(FaultPlan::new(1).always(early(HEADER), fault.clone()));
        assert!(poll(&mut cmm, &plan, 1, 8).await.is_empty());
        assert_eq!(serving.faults().fired().len(), times, "{fault:?}");
        // Another START is another job: reading ahead begins again.
        serving.faults().set(FaultPlan::new(1));
        cmm.stop().await.unwrap();
        wait_for_state(&mut cmm, MachineState::Complete).await.unwrap();
        let done = cmm.status().await.unwrap().done;
        cmm.acknowledge(done).await.unwrap();
        let armed = cmm.prepare(job_of(&plan, 2)).await.unwrap();
        cmm.start(armed).await.unwrap();
        work(&serving, 20);
        assert_eq!(poll(&mut cmm, &plan, 2, 5).await.len(), 2, "{fault:?}");
    }
}

#[tokio::test]
async fn read_ahead_cache_ends_with_link_or_job() {
    let plan = plan(POINTS);
    for reconnects in [false, true] {
        let serving = serve(toy(), true).await;
        let mut cmm = half_done(&serving, settings(&serving), &plan).await;
        // A cached page with a flipped bit; only the check over its record prevents its use.
        serving.faults().set(FaultPlan::new(0).once(early(PAGE), Fault::FlipData));
        assert_eq!(points(&poll(&mut cmm, &plan, 1, 9).await).len(), 8 * FULL);
        serving.faults().set(FaultPlan::new(0).once(When::Reading(64), Fault::Disconnect(3)));
        match reconnects {
            true => drop(cmm.connect().await.unwrap()),
            false => drop(cmm.status().await.unwrap()),
        }
        cmm.claim().await.unwrap();
        let again = poll(&mut cmm, &plan, 1, 3).await;
        assert_eq!(again.iter().map(|told| told.first_index).collect::<Vec<_>>(), [0, FULL], "it begins anew");
        let late = counted(&serving, FaultPlan::new(0), PAGE);
        assert_exact(&plan, &finish(&serving, &mut cmm, &plan).await.unwrap(), "another line");
        assert_eq!(read_count(&late), PAGES - 2, "read once");
    }
}

#[tokio::test]
async fn read_ahead_refetches_changed_page() {
    let plan = plan(POINTS);
    let serving = serve(toy(), true).await;
    let mut cmm = half_done(&serving, settings(&serving), &plan).await;
    serving.faults().set(FaultPlan::new(0).once(early(PAGE), Fault::FlipData));
    poll(&mut cmm, &plan, 1, 20).await;
    let late = counted(&serving, FaultPlan::new(0), PAGE);
    assert_exact(&plan, &finish(&serving, &mut cmm, &plan).await.unwrap(), "a page that changed");
    assert_eq!(read_count(&late), PAGES - 14 + PAGES);
    // A damaged result remains an error, as before.
    serving.faults().set(FaultPlan::new(0).always(When::Reading(PAGE), Fault::FlipData));
    let broken = cmm.collect(job_of(&plan, 1), &Interrupt::new()).await;
    assert!(matches!(broken, Err(DeviceError::Corrupt { data: "check number of a result", .. })), "{broken:?}");
}

#[tokio::test]
async fn read_ahead_one_step_per_poll() {
    let plan = plan(POINTS);
    let serving = serve(toy(), true).await;
    let mut cmm = half_done(&serving, patient(settings(&serving)), &plan).await;
    let (job, calm, raised) = (job_of(&plan, 1), Interrupt::new(), Interrupt::new());
    raised.raise();
    let requests = |serving: &Serving| serving.faults().requests();
    cmm.status().await.unwrap();
    let before = requests(&serving);
    assert_eq!(cmm.read_ahead(job, &raised).await, None);
    assert_eq!(cmm.read_ahead(job, &calm).await, None);
    assert_eq!(requests(&serving), before, "an order was on its way, and the look is used up");
    // The header, then one page per poll.
    poll(&mut cmm, &plan, 1, 2).await;
    cmm.status().await.unwrap();
    let before = requests(&serving);
    assert_eq!(cmm.read_ahead(job, &calm).await.unwrap().first_index, FULL);
    assert_eq!(cmm.read_ahead(job, &calm).await, None);
    assert_eq!(requests(&serving), before + 2);
    // An order that arrives at the same time has priority over the page.
    let (raiser, flag) = (calm.clone(), calm.clone());
    let raise = When::Matching(Box::new(move |request| {
        if request.address == SELECT {
            raiser.raise();
        }
        false
    }));
    let pages = counted(&serving, FaultPlan::new(0).always(raise, Fault::DropReply), PAGE);
    cmm.status().await.unwrap();
    assert_eq!(cmm.read_ahead(job, &flag).await, None);
    assert_eq!(read_count(&pages), 0);
    cmm.hold().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Held).await.unwrap();
    // Reading of measured points continues during a hold, and ends after an abort.
    assert_eq!(poll(&mut cmm, &plan, 1, 1).await[0].first_index, 2 * FULL);
    cmm.abort().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Aborted).await.unwrap();
    let none = counted(&serving, FaultPlan::new(0), PAGE);
    assert!(poll(&mut cmm, &plan, 1, 3).await.is_empty());
    assert_eq!(read_count(&none), 0);
}

#[tokio::test]
async fn read_ahead_off_on_slow_line() {
    let plan = plan(40);
    for (baud, told) in [(19_200, 0), (38_400, 2)] {
        let (serving, settings) =
            rtu(vec![(1, machine(toy(), true))], SerialLine { baud, paced: false }, SharedFaultPlan::none());
        let mut cmm = begin_job(patient(settings), &plan).await;
        work(&serving, 20);
        assert_eq!(poll(&mut cmm, &plan, 1, 4).await.len(), told, "{baud}");
    }
}

/// Measures the figure of docs/figures.md: run with `--ignored --nocapture`.
#[tokio::test]
#[ignore = "takes as long as a line of 115,200 baud takes and as 1,800 points at 50 a second, two minutes"]
async fn read_ahead_1800_points_over_rtu() {
    let plan = plan(1800);
    for gives_ahead in [false, true] {
        let options = MachineOptions { gives_ahead, ..MachineOptions::default() };
        let machine = registers::SimulatedMachine::new(Box::new(Toy::new(Kind::Cmm, 50.0)), 0xb007, options);
        let (_serving, settings) = rtu(vec![(1, machine)], SerialLine::paced(115_200), SharedFaultPlan::none());
        let settings = ModbusSettings { request_timeout: Duration::from_secs(2), ..settings };
        let at_first = Instant::now();
        let mut cmm = begin_job(settings, &plan).await;
        let loaded = at_first.elapsed();
        let mut came = 0;
        while cmm.status().await.unwrap().state != MachineState::Complete {
            let told = cmm.read_ahead(job_of(&plan, 1), &Interrupt::new()).await;
            came += told.map_or(0, |told| told.points.len());
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let ended = Instant::now();
        let measured = cmm.collect(job_of(&plan, 1), &Interrupt::new()).await.unwrap();
        let collected = ended.elapsed();
        assert_exact(&plan, &measured, "1,800 points");
        println!(
            "gives ahead: {gives_ahead}; plan {loaded:.1?}; {came} points ahead; the whole result {collected:.2?} after the end"
        );
        println!("{:?}", cmm.link().statistics());
    }
}
