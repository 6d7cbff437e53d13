//! Modbus drivers against simulated machines at the far end of real sockets and serial lines, with and without faults.

#![cfg(unix)]

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use regrind::device::{
    Answer, Armed, Cmm, CorrectionMap, DeviceError, Grinder, Identified, Interrupt, Job, LineAddress, Link, Machine,
    MachineCommand, MachineKind, MachineState, Measurement, ModbusCmm, ModbusGrinder, ModbusSettings, Outcome, Parity,
    Pass, Plan, PlanTarget, Reconciled, RegisterMap, Signal, SignalType, TargetKind, TouchStatus, WordOrder, digest,
};
use regrind::geometry::Grid;
use regrind_sim::body::Kind;
use regrind_sim::command::{Command as SimCommand, CommandFrame as SimFrame};
use regrind_sim::options::{MachineOptions, RegisterLayout};
use regrind_sim::wire::rtu::Line as SerialLine;
use regrind_sim::{register_encoding, registers};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket};

use crate::toy::{Toy, pass};
use regrind_testcell::wire_faults::{Fault, FaultPlan, Request, Serving, SharedFaultPlan, When};

// ---- machines to talk to ------------------------------------------------------------------------------------------------------------

fn toy(kind: Kind, points_a_second: f64, options: MachineOptions) -> registers::SimulatedMachine {
    registers::SimulatedMachine::new(Box::new(Toy::new(kind, points_a_second)), 0xb007, options)
}

/// Speed that finishes a job between two polls.
const AT_ONCE: f64 = 1e9;

async fn serve(kind: Kind, points_a_second: f64, faults: SharedFaultPlan) -> Serving {
    let machine = toy(kind, points_a_second, MachineOptions::default());
    Serving::tcp_with("127.0.0.1:0", vec![(1, machine)], faults).await.unwrap()
}

pub fn settings(serving: &Serving) -> ModbusSettings {
    let port = serving.local_addr().unwrap().port();
    ModbusSettings {
        request_timeout: Duration::from_millis(300),
        quarantine: Duration::from_millis(20),
        retries: 6,
        lost_after: Duration::from_secs(20),
        ..ModbusSettings::new(LineAddress::Tcp { host: "127.0.0.1".into(), port })
    }
}

/// Returns settings for requests that must succeed at the first try: a stall of the computer does not count as a silent
/// machine.
pub fn patient(settings: ModbusSettings) -> ModbusSettings {
    ModbusSettings { request_timeout: Duration::from_secs(30), ..settings }
}

pub fn began(serving: &Serving) -> Vec<(u32, u32, u16)> {
    serving.machine(1).unwrap().with(|machine| machine.began())
}

// ---- what is sent -------------------------------------------------------------------------------------------------------------------

pub fn plan(points: u32) -> Plan {
    let target = |index: u32| {
        let (x, y) = (f64::from(index % 40) * 0.5, f64::from(index / 40) * 0.5);
        let length = (1.0 + 0.01 * x * x).sqrt();
        PlanTarget {
            index,
            kind: if index < 5 { TargetKind::ReferenceSphere } else { TargetKind::Part },
            point_mm: [x, y, -0.05 * x * x],
            normal: [0.1 * x / length, 0.0, 1.0 / length],
        }
    };
    Plan {
        targets: (0..points).map(target).collect(),
        probe_radius_mm: 2.0,
        approach_mm: 1.0,
        search_mm: 1.0,
        speed_mm_s: 2.0,
        safe_height_mm: 20.0,
        careful_start: None,
    }
}

fn map_and_pass() -> (CorrectionMap, Pass) {
    let map = CorrectionMap {
        grid: Grid { columns: 20, rows: 30, first_mm: [-10.0, -15.0], spacing_mm: [1.0, 1.0] },
        values_mm: (0..600).map(|k| 1e-3 * f64::from(k % 17)).collect(),
        part_identity: [7; 32],
    };
    (map, pass())
}

pub fn job_of(plan: &Plan, cycle: u16) -> Job {
    Job { job: 42, cycle, digest: digest(&[plan.identity()]) }
}

/// Asserts that every coordinate is exact to the last bit: the behaviour of the toy machine is known.
pub fn assert_exact(plan: &Plan, measured: &Measurement, hint: &str) {
    assert_eq!(measured.points.len(), plan.targets.len(), "{hint}");
    assert_eq!(measured.plan_identity, plan.identity(), "{hint}");
    for (target, point) in plan.targets.iter().zip(&measured.points) {
        assert_eq!((point.index, point.status), (target.index, TouchStatus::Touched), "{hint}");
        let centre_mm: [f64; 3] =
            std::array::from_fn(|axis| target.point_mm[axis] + plan.probe_radius_mm * target.normal[axis]);
        assert_eq!(point.position_mm, centre_mm, "{hint}");
    }
}

/// Returns a measuring machine that is connected and claimed.
pub async fn claimed(settings: ModbusSettings) -> ModbusCmm {
    let mut cmm = connected(settings).await;
    cmm.claim().await.unwrap();
    cmm
}

async fn connected(settings: ModbusSettings) -> ModbusCmm {
    let mut cmm = ModbusCmm::new(settings).unwrap();
    cmm.connect().await.unwrap();
    cmm
}

pub async fn wait_for_state<M: Machine>(machine: &mut M, state: MachineState) -> Result<(), DeviceError> {
    let began = Instant::now();
    loop {
        let status = machine.status().await?;
        if status.state == state {
            return Ok(());
        }
        assert!(began.elapsed() < Duration::from_secs(60), "not {state} after a minute: {status:?}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

async fn measure(cmm: &mut ModbusCmm, plan: &Plan, cycle: u16) -> Result<Measurement, DeviceError> {
    let (job, calm) = (job_of(plan, cycle), Interrupt::new());
    cmm.claim().await?;
    cmm.load_plan(plan, &calm).await?;
    let armed = cmm.prepare(job).await?;
    let started = cmm.start(armed).await?;
    assert_eq!(started.job, job);
    wait_for_state(cmm, MachineState::Complete).await?;
    let measured = cmm.collect(job, &calm).await?;
    assert_eq!(cmm.collect(job, &calm).await?, measured);
    cmm.acknowledge(measured.done).await?;
    Ok(measured)
}

// ---- in order -----------------------------------------------------------------------------------------------------------------------

#[tokio::test]
async fn modbus_measurement_is_bit_exact() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    let mut cmm = ModbusCmm::new(patient(settings(&serving))).unwrap();
    let identity = cmm.connect().await.unwrap();
    assert_eq!((identity.kind, identity.name.as_str(), identity.simulation), (MachineKind::Cmm, "Toy 1", true));
    let plan = plan(300);
    for cycle in 1..=2 {
        let measured = measure(&mut cmm, &plan, cycle).await.unwrap();
        assert_exact(&plan, &measured, "in order");
        assert_eq!((measured.job, measured.cycle, measured.temperature_c), (42, cycle, Some(20.5)));
    }
    assert_eq!(cmm.status().await.unwrap().state, MachineState::Idle);
    assert_eq!(began(&serving).len(), 2);
    let figures = cmm.link().statistics();
    assert_eq!((figures.opened, figures.timeouts, figures.corrupt, figures.retries), (1, 0, 0, 0));
    println!("{} requests, {:.0} us each", figures.answers, figures.answer_ns as f64 / 1e3 / figures.answers as f64);
}

#[tokio::test]
async fn modbus_pass_ground_and_recorded() {
    let serving = serve(Kind::Grinder, AT_ONCE, SharedFaultPlan::none()).await;
    let mut grinder = ModbusGrinder::new(settings(&serving)).unwrap();
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    let ((map, pass), calm) = (map_and_pass(), Interrupt::new());
    grinder.load_pass(&map, &pass, &calm).await.unwrap();
    let job = Job { job: 9, cycle: 3, digest: digest(&[map.identity(), pass.identity()]) };
    let armed = grinder.prepare(job).await.unwrap();
    grinder.start(armed).await.unwrap();
    wait_for_state(&mut grinder, MachineState::Complete).await.unwrap();
    let record = grinder.collect(job, &calm).await.unwrap();
    assert_eq!((record.outcome, record.path_mm, record.removed_mm3), (Outcome::Complete, Some(1234.5), Some(67.8)));
    assert_eq!((record.map_identity, record.wheel_radius_mm), (map.identity(), Some(25.0)));
    grinder.acknowledge(record.done).await.unwrap();
    // The same job and cycle do not begin twice, even after another prepare.
    let armed = grinder.prepare(job).await.unwrap();
    let refused = grinder.start(armed).await;
    assert!(matches!(refused, Err(DeviceError::Refused { answer: Answer::AlreadyBegun, .. })), "{refused:?}");
    assert_eq!(began(&serving).len(), 1);
}

#[tokio::test]
async fn word_orders_and_moved_registers() {
    for word_order in [WordOrder::Little, WordOrder::Badc, WordOrder::Dcba] {
        let layout = RegisterLayout { status: 1064, command: 1040, outbox_page: 2462, ..RegisterLayout::default() };
        let of_sim = if word_order.is_low_first() {
            register_encoding::WordOrder::Little
        } else {
            register_encoding::WordOrder::Big
        };
        let swaps_bytes = word_order.swaps_bytes();
        let options = MachineOptions { word_order: of_sim, swaps_bytes, layout, ..MachineOptions::default() };
        let serving =
            Serving::tcp_with("127.0.0.1:0", vec![(7, toy(Kind::Cmm, AT_ONCE, options))], SharedFaultPlan::none())
                .await
                .unwrap();
        let registers =
            RegisterMap { word_order, status: 1064, command: 1040, outbox_page: 2462, ..RegisterMap::default() };
        let settings = ModbusSettings { unit: 7, registers, ..settings(&serving) };
        let mut cmm = connected(settings.clone()).await;
        let plan = plan(50);
        assert_exact(&plan, &measure(&mut cmm, &plan, 1).await.unwrap(), word_order.name());
        // With another word order, the error names the right one.
        for other in [
            word_order.with_words_swapped(),
            word_order.with_bytes_swapped(),
            word_order.with_bytes_swapped().with_words_swapped(),
        ] {
            let registers = RegisterMap { word_order: other, ..registers };
            let wrong = ModbusCmm::new(ModbusSettings { registers, ..settings.clone() }).unwrap().connect().await;
            let told = wrong.unwrap_err().to_string();
            assert!(told.contains(&format!("word_order = \"{}\"", word_order.name())), "{other:?}: {told}");
        }
    }
}

#[tokio::test]
async fn hold_resume_stop_abort_clear() {
    let serving = serve(Kind::Cmm, 20.0, SharedFaultPlan::none()).await;
    let mut cmm = claimed(settings(&serving)).await;
    let (plan, calm) = (plan(200), Interrupt::new());
    cmm.load_plan(&plan, &calm).await.unwrap();
    let armed = cmm.prepare(job_of(&plan, 1)).await.unwrap();
    cmm.start(armed.clone()).await.unwrap();
    cmm.hold().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Held).await.unwrap();
    cmm.resume().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Execute).await.unwrap();
    cmm.stop().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Complete).await.unwrap();
    let status = cmm.status().await.unwrap();
    assert_eq!((status.outcome, status.done), (Outcome::Stopped, armed.start_sequence));
    cmm.acknowledge(status.done).await.unwrap();
    let armed = cmm.prepare(job_of(&plan, 2)).await.unwrap();
    cmm.start(armed).await.unwrap();
    cmm.abort().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Aborted).await.unwrap();
    cmm.clear().await.unwrap();
    wait_for_state(&mut cmm, MachineState::Idle).await.unwrap();
    let refused = cmm.hold().await;
    assert!(matches!(refused, Err(DeviceError::Refused { answer: Answer::WrongState, .. })), "{refused:?}");
    cmm.release().await.unwrap();
    claimed(ModbusSettings { owner: 0x9999, ..settings(&serving) }).await;
}

#[tokio::test]
async fn second_client_refused_except_abort() {
    let serving = serve(Kind::Cmm, 20.0, SharedFaultPlan::none()).await;
    let mut first = ModbusCmm::new(settings(&serving)).unwrap();
    let mut second = ModbusCmm::new(ModbusSettings { owner: 2, ..settings(&serving) }).unwrap();
    first.connect().await.unwrap();
    first.claim().await.unwrap();
    second.connect().await.unwrap();
    let refused = second.claim().await;
    assert!(matches!(refused, Err(DeviceError::Refused { answer: Answer::NotOwner, .. })), "{refused:?}");
    second.abort().await.unwrap();
    let state = first.status().await.unwrap().state;
    assert!(matches!(state, MachineState::Aborting | MachineState::Aborted), "{state}");
}

/// Writes a command of another client directly into the machine's registers; returns the answer.
fn write_command(serving: &Serving, frame: SimFrame) -> u16 {
    serving.machine(1).unwrap().with(|machine| {
        machine.write(40, &frame.registers(register_encoding::WordOrder::Big)).unwrap();
        machine.read(70, 1).unwrap()[0]
    })
}

fn of_first(command: SimCommand) -> SimFrame {
    SimFrame { command: command as u16, owner: 1, epoch: 1, ..SimFrame::default() }
}

#[tokio::test]
async fn abort_despite_second_master() {
    let (serving, plan) = (serve(Kind::Cmm, 1.0, SharedFaultPlan::none()).await, plan(100));
    let (mut cmm, armed) = armed(&serving, &plan).await;
    cmm.start(armed).await.unwrap();
    // The machine refuses a second master, but its counter is then far ahead of its owner's.
    let stranger = SimFrame { sequence: 0x7000_0000, owner: 2, ..of_first(SimCommand::Claim) };
    assert_eq!(write_command(&serving, stranger), 2, "not the owner");
    serving.faults().set(FaultPlan::new(0).once(When::Any, Fault::Disconnect(0)));
    assert!(cmm.hold().await.is_err(), "the number of an owner's HOLD counts");
    serving.faults().set(FaultPlan::new(0).once(When::Any, Fault::Disconnect(0)));
    let aborting = cmm.abort().await.unwrap().state;
    assert!(matches!(aborting, MachineState::Aborting | MachineState::Aborted), "{aborting}");
    // The second master takes the machine over: the driver sees the end of the abort anyway.
    assert_eq!(write_command(&serving, SimFrame { sequence: 0x7000_0001, ..of_first(SimCommand::Release) }), 1);
    assert_eq!(write_command(&serving, SimFrame { sequence: 0x7000_0002, ..stranger }), 1);
    wait_for_state(&mut cmm, MachineState::Aborted).await.unwrap();
}

#[tokio::test]
async fn lost_ownership_names_other_owner() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    let mut first = claimed(settings(&serving)).await;
    first.status().await.unwrap();
    assert_eq!(write_command(&serving, SimFrame { sequence: 1000, ..of_first(SimCommand::Release) }), 1);
    claimed(ModbusSettings { owner: 0xbeef, ..settings(&serving) }).await;
    let taken = first.status().await.unwrap_err();
    assert!(matches!(taken, DeviceError::OwnedByOther { ours: 1, owner: 0xbeef, .. }) && taken.is_link(), "{taken}");
    assert!(taken.to_string().contains("0000beef"), "{taken}");
}

#[tokio::test]
async fn busy_exception_retried_until_timeout() {
    let few =
        |serving: &Serving| ModbusSettings { retries: 3, lost_after: Duration::from_secs(2), ..settings(serving) };
    // A controller that is still starting reports busy for more requests than a silent one has retries.
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    serving.faults().set(FaultPlan::new(0).times(1, 12, When::Any, Fault::Exception(6)));
    let began = Instant::now();
    let mut cmm = connected(few(&serving)).await;
    assert!(began.elapsed() >= 12 * Duration::from_millis(50), "{:?}", began.elapsed());
    // A busy machine does the same. A machine that stays busy is lost after its timeout, and polled at most every 50
    // ms.
    serving.faults().set(FaultPlan::new(0).times(1, 12, When::Any, Fault::Exception(6)));
    cmm.status().await.unwrap();
    serving.faults().set(FaultPlan::new(0).always(When::Any, Fault::Exception(6)));
    let busy = cmm.status().await.unwrap_err();
    assert!(matches!(busy, DeviceError::Exception { code: 6, .. }) && busy.is_link(), "{busy}");
    assert!((4..=41).contains(&serving.faults().fired().len()), "{}", serving.faults().fired().len());
    // A gateway that finds no machine reports it too, and connecting does not wait as long for it.
    let serving = serve(Kind::Cmm, AT_ONCE, FaultPlan::new(0).always(When::Any, Fault::Exception(11)).into()).await;
    let met = ModbusCmm::new(few(&serving)).unwrap().connect().await.unwrap_err();
    assert!(matches!(met, DeviceError::Exception { code: 11, .. }), "{met}");
    assert!(serving.faults().fired().len() <= 41, "{}", serving.faults().fired().len());
}

#[tokio::test]
async fn claim_raises_epoch_after_clock_reset() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    assert_eq!(write_command(&serving, SimFrame { sequence: 5, epoch: 50, ..of_first(SimCommand::Claim) }), 1);
    let mut after = connected(ModbusSettings { epoch: 7, ..settings(&serving) }).await;
    after.claim().await.unwrap();
    let epoch = |serving: &Serving| serving.machine(1).unwrap().with(|machine| machine.read(90, 2).unwrap());
    assert_eq!(epoch(&serving), [0, 51]);
    // A client that sees a higher epoch than its own has been replaced, and does not outbid it.
    assert_eq!(write_command(&serving, SimFrame { sequence: 500, epoch: 60, ..of_first(SimCommand::Claim) }), 1);
    after.connect().await.unwrap();
    let refused = after.claim().await;
    assert!(matches!(refused, Err(DeviceError::Refused { answer: Answer::NotOwner, .. })), "{refused:?}");
    assert_eq!(epoch(&serving), [0, 60]);
}

/// Raises a flag when a machine receives the page of this number, so that the interruption always comes in the middle.
/// Counts the pages.
fn interrupt_at_page(serving: &Serving, number: u32) -> (Interrupt, Arc<AtomicU32>) {
    let (interrupt, pages) = (Interrupt::new(), Arc::new(AtomicU32::new(0)));
    let (raiser, counted) = (interrupt.clone(), Arc::clone(&pages));
    let look = move |request: &Request| {
        if request.function == 16 && request.address == 224 && counted.fetch_add(1, Ordering::SeqCst) == number {
            raiser.raise();
        }
        false
    };
    serving.faults().set(FaultPlan::new(0).always(When::Matching(Box::new(look)), Fault::DropReply));
    (interrupt, pages)
}

#[tokio::test]
async fn interrupted_transfer_not_in_force() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    let mut cmm = ModbusCmm::new(patient(settings(&serving))).unwrap();
    cmm.connect().await.unwrap();
    cmm.claim().await.unwrap();
    let ((interrupt, _), plan) = (interrupt_at_page(&serving, 100), plan(20_000));
    let broken = cmm.load_plan(&plan, &interrupt).await;
    assert!(matches!(broken, Err(DeviceError::Interrupted { done: 101, total: 5001, .. })), "{broken:?}");
    let asked = Instant::now();
    cmm.abort().await.unwrap();
    println!("abort acknowledged after {:.1} ms", asked.elapsed().as_secs_f64() * 1e3);
    let unprepared = cmm.prepare(job_of(&plan, 1)).await;
    assert!(matches!(unprepared, Err(DeviceError::Mismatch { .. })), "{unprepared:?}");
}

#[tokio::test]
async fn signals_scaled_and_range_checked() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    let temperature = Signal {
        name: "part_temperature".into(),
        address: 97,
        kind: SignalType::I16,
        scale: 0.01,
        word_order: WordOrder::Big,
        unit: "C".into(),
        range: [15.0, 25.0],
    };
    let narrow = Signal { range: [15.0, 19.0], ..temperature.clone() };
    let mut cmm = connected(ModbusSettings { signals: vec![temperature.clone()], ..settings(&serving) }).await;
    let status = cmm.status().await.unwrap();
    assert_eq!((status.signals[0].value, status.temperature_c), (Some(20.25), Some(20.25)));
    assert_eq!(status.signals[0].problem(), None);
    let mut cmm = connected(ModbusSettings { signals: vec![narrow], ..settings(&serving) }).await;
    // A bad signal hides no other part of the status.
    let status = cmm.status().await.unwrap();
    let flaw = status.signals[0].problem().unwrap();
    for piece in ["part_temperature", "20.25 C", "15 to 19 C"] {
        assert!(flaw.contains(piece), "{flaw}");
    }
    assert_eq!((status.state, status.temperature_c), (MachineState::Idle, Some(20.25)));
    // A register that does not exist, and one that holds no number.
    let cases = [
        (60_000, SignalType::I16, 0.01, ["exception 2 ", "signal", "register 60000"]),
        (97, SignalType::I16, f64::NAN, ["NaN", "word_order", "register 97 "]),
    ];
    for (address, kind, scale, pieces) in cases {
        let absent = Signal { address, kind, scale, ..temperature.clone() };
        let mut cmm = connected(ModbusSettings { signals: vec![absent], ..settings(&serving) }).await;
        let status = cmm.status().await.unwrap();
        let flaw = status.signals[0].problem().unwrap();
        assert_eq!(status.signals[0].value, None, "{flaw}");
        assert!(flaw.starts_with("part_temperature: ") && pieces.iter().all(|piece| flaw.contains(piece)), "{flaw}");
    }
}

// ---- not the machine that is meant --------------------------------------------------------------------------------------------------

/// Answers every read with the same registers, and counts the writes.
async fn impostor(image: Vec<u16>) -> (ModbusSettings, Arc<AtomicU32>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let writes = Arc::new(AtomicU32::new(0));
    let counter = writes.clone();
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let mut head = [0; 8];
            while stream.read_exact(&mut head).await.is_ok() {
                let mut rest = vec![0; usize::from(u16::from_be_bytes([head[4], head[5]])) - 2];
                stream.read_exact(&mut rest).await.unwrap();
                if head[7] != 3 {
                    counter.fetch_add(1, Ordering::SeqCst);
                }
                let count = usize::from(u16::from_be_bytes([rest[2], rest[3]]));
                let mut answer = head[..4].to_vec();
                answer.extend((2 * count as u16 + 3).to_be_bytes());
                answer.extend([head[6], 3, 2 * count as u8]);
                (0..count).for_each(|k| answer.extend(image.get(k).copied().unwrap_or(0).to_be_bytes()));
                stream.write_all(&answer).await.unwrap();
            }
        }
    });
    (ModbusSettings::new(LineAddress::Tcp { host: "127.0.0.1".into(), port }), writes)
}

fn true_identity() -> Vec<u16> {
    let mut image = vec![0x5247, 0x4431, 2, 1, 0x1234, 0x5678, 0xbe90, 0xc6f7, 0xa0b5, 0xed8d, 0, 9, 0, 1];
    image.resize(32, 0);
    image
}

async fn refusal(change: impl FnOnce(&mut Vec<u16>)) -> DeviceError {
    let mut image = true_identity();
    change(&mut image);
    let (settings, writes) = impostor(image).await;
    let refused = ModbusCmm::new(settings).unwrap().connect().await.unwrap_err();
    assert_eq!(writes.load(Ordering::SeqCst), 0, "written to: {refused}");
    println!("{refused}");
    refused
}

#[tokio::test]
async fn connect_refuses_wrong_device() {
    let e = refusal(|image| image.fill(0)).await;
    assert!(matches!(e, DeviceError::WrongDevice { address: 0, required: 0x5247, found: 0, .. }), "{e}");
    let e = refusal(|image| image[1] = 0x4432).await;
    assert!(matches!(e, DeviceError::WrongDevice { address: 1, .. }), "{e}");
    let e = refusal(|image| image.iter_mut().for_each(|word| *word = word.swap_bytes())).await;
    assert!(
        matches!(&e, DeviceError::WrongLayout { description: how, .. } if how.contains("word_order = \"badc\"")),
        "{e}"
    );
    let e = refusal(|image| {
        (image[4], image[5]) = (image[5], image[4]);
        image.iter_mut().for_each(|word| *word = word.swap_bytes());
    })
    .await;
    assert!(
        matches!(&e, DeviceError::WrongLayout { description: how, .. } if how.contains("word_order = \"dcba\"")),
        "{e}"
    );
    let e = refusal(|image| image.insert(0, 7)).await;
    assert!(
        matches!(e, DeviceError::WrongLayout { ref description, .. } if description.contains("one register later")),
        "{e}"
    );
    let e = refusal(|image| {
        image.remove(0);
    })
    .await;
    assert!(
        matches!(e, DeviceError::WrongLayout { ref description, .. } if description.contains("one register earlier")),
        "{e}"
    );
    let e = refusal(|image| image[2] = 1).await;
    assert!(matches!(e, DeviceError::WrongVersion { required: 2, found: 1, .. }), "{e}");
    let said = e.to_string();
    for lacked in ["heartbeat", "refuse a late START", "an ABORT", "after CLEAR", "to version 2"] {
        assert!(said.contains(lacked), "{said}");
    }
    let e = refusal(|image| image[2] = 3).await;
    assert!(matches!(e, DeviceError::WrongVersion { required: 2, found: 3, .. }), "{e}");
    assert!(e.to_string().contains("older"), "{e}");
    let e = refusal(|image| image[3] = 2).await;
    assert!(matches!(e, DeviceError::WrongKind { found: MachineKind::Grinder, .. }), "{e}");
    let e = refusal(|image| image[13] = 2).await;
    assert!(matches!(e, DeviceError::WrongLengthUnit { unit: 2, .. }), "{e}");
    let e = refusal(|image| {
        image[4..6].reverse();
        image[6..10].reverse();
    })
    .await;
    assert!(matches!(e, DeviceError::WrongWordOrder { matching: Some("little"), .. }), "{e}");
    let e = refusal(|image| image[4..6].reverse()).await;
    assert!(matches!(e, DeviceError::WrongWordOrder { matching: None, .. }), "{e}");
}

#[tokio::test]
async fn connect_refuses_missing_sync_answer() {
    let (settings, writes) = impostor(true_identity()).await;
    let settings = ModbusSettings { retries: 1, quarantine: Duration::ZERO, ..settings };
    let refused = ModbusCmm::new(settings).unwrap().connect().await.unwrap_err();
    assert!(matches!(refused, DeviceError::Corrupt { .. }), "{refused}");
    assert!(writes.load(Ordering::SeqCst) > 0);
}

#[tokio::test]
async fn connect_unreachable() {
    // A port that is bound but has no listener.
    let taken = TcpSocket::new_v4().unwrap();
    taken.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let port = taken.local_addr().unwrap().port();
    let wire = LineAddress::Tcp { host: "127.0.0.1".into(), port };
    let absent = ModbusCmm::new(ModbusSettings { retries: 1, ..ModbusSettings::new(wire) }).unwrap().connect().await;
    assert!(matches!(absent, Err(DeviceError::Unreachable { .. })), "{absent:?}");
    let wire = LineAddress::Rtu { device: "/dev/no-such-port".into(), baud: 9600, parity: Parity::Even, stop_bits: 1 };
    let absent = ModbusCmm::new(ModbusSettings { retries: 1, ..ModbusSettings::new(wire) }).unwrap().connect().await;
    assert!(matches!(absent, Err(DeviceError::Unreachable { .. })), "{absent:?}");
}

// ---- out of order -------------------------------------------------------------------------------------------------------------------

/// Returns all faults of a connection that can change an answer without a fault of the machine.
fn wire_faults() -> Vec<Fault> {
    vec![
        Fault::DropRequest,
        Fault::DropReply,
        Fault::DelayReply(Duration::from_millis(350)),
        Fault::DuplicateReply,
        Fault::Truncate(9),
        Fault::Extra(vec![1, 3, 2, 0, 7]),
        Fault::WrongTransaction,
        Fault::WrongUnit,
        Fault::WrongFunction,
        Fault::Exception(6),
        Fault::Exception(11),
        Fault::Split(Duration::from_micros(100)),
        Fault::FlipCrc,
        Fault::Disconnect(5),
        Fault::TornStatus,
        Fault::CarryOutAgain(3),
    ]
}

#[tokio::test]
async fn tcp_wire_faults_give_exact_points() {
    let plan = plan(60);
    for fault in wire_faults() {
        let rules = FaultPlan::new(5).always(When::Every(17), fault.clone());
        let serving = serve(Kind::Cmm, AT_ONCE, rules.into()).await;
        let mut cmm = ModbusCmm::new(settings(&serving)).unwrap();
        let hint = format!("{fault:?}");
        cmm.connect().await.unwrap_or_else(|error| panic!("{hint}: {error}"));
        let measured = measure(&mut cmm, &plan, 1).await;
        let measured = measured.unwrap_or_else(|error| panic!("{hint}: {error}"));
        assert_exact(&plan, &measured, &hint);
        assert_eq!(began(&serving).len(), 1, "{hint}");
        assert!(!serving.faults().fired().is_empty(), "{hint}");
    }
}

#[tokio::test]
async fn seeded_faults_never_start_twice() {
    let plan = plan(40);
    let mut finished = 0;
    for seed in 0..12 {
        let faults = FaultPlan::seeded(seed, 0.06, wire_faults()).into();
        let serving = serve(Kind::Cmm, AT_ONCE, faults).await;
        let mut cmm = ModbusCmm::new(settings(&serving)).unwrap();
        let hint = format!("seed {seed}");
        let outcome = match cmm.connect().await {
            Ok(_) => measure(&mut cmm, &plan, 1).await,
            Err(error) => Err(error),
        };
        match outcome {
            Ok(measured) => {
                assert_exact(&plan, &measured, &hint);
                finished += 1;
            }
            Err(error) => println!("{hint}: {error}"),
        }
        assert!(began(&serving).len() <= 1, "{hint}: begun twice");
    }
    assert!(finished >= 6, "only {finished} of 12 came through");
}

#[tokio::test]
async fn flipped_bit_found_by_result_crc() {
    // In the pages, which the CRC-32 over the whole protects; once, so that the second fetch succeeds.
    let rules = FaultPlan::new(1).once(When::Reading(462), Fault::FlipData);
    let serving = serve(Kind::Cmm, AT_ONCE, rules.into()).await;
    let mut cmm = connected(settings(&serving)).await;
    let plan = plan(40);
    assert_exact(&plan, &measure(&mut cmm, &plan, 1).await.unwrap(), "a flipped bit");
    assert_eq!((serving.faults().fired().len(), cmm.link().statistics().corrupt), (1, 1));
    // Permanently: an error, no points.
    serving.faults().set(FaultPlan::new(1).always(When::Reading(462), Fault::FlipData));
    let refused = measure(&mut cmm, &plan, 2).await;
    assert!(matches!(refused, Err(DeviceError::Corrupt { data: "check number of a result", .. })), "{refused:?}");
}

async fn armed(serving: &Serving, plan: &Plan) -> (ModbusCmm, Armed) {
    let settings = ModbusSettings { retries: 2, lost_after: Duration::from_secs(2), ..settings(serving) };
    let mut cmm = claimed(settings).await;
    cmm.load_plan(plan, &Interrupt::new()).await.unwrap();
    let armed = cmm.prepare(job_of(plan, 1)).await.unwrap();
    (cmm, armed)
}

#[tokio::test]
async fn start_retry_is_idempotent() {
    let (serving, plan) = (serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await, plan(10));
    let (mut cmm, armed) = armed(&serving, &plan).await;
    serving.faults().set(FaultPlan::new(0).times(1, 2, When::Commanding(3), Fault::DropReply));
    let sequence = armed.start_sequence;
    assert_eq!(cmm.start(armed).await.unwrap().start_sequence, sequence);
    assert_eq!(began(&serving), [(sequence, 42, 1)]);
}

/// Returns faults that let nothing through after the first START, or lose that START too.
fn silent_from_start(lost: bool) -> FaultPlan {
    let mut seen = false;
    let rule = When::Matching(Box::new(move |request| {
        let first = !seen && request.command == Some(3);
        seen |= first;
        if first { lost } else { seen }
    }));
    FaultPlan::new(0).always(rule, Fault::DropRequest)
}

#[tokio::test]
async fn unknown_start_reconciles_running() {
    let (serving, plan) = (serve(Kind::Cmm, 1.0, SharedFaultPlan::none()).await, plan(100));
    let (mut cmm, armed) = armed(&serving, &plan).await;
    // The START is carried out, and from then on nothing answers.
    serving.faults().set(silent_from_start(false).once(When::Commanding(3), Fault::DropReply));
    let unknown = cmm.start(armed.clone()).await;
    assert!(matches!(&unknown, Err(DeviceError::StartUnknown { sequence, .. }) if *sequence == armed.start_sequence));
    serving.faults().set(FaultPlan::new(0));
    cmm.connect().await.unwrap();
    let found = cmm.reconcile(&armed).await.unwrap();
    assert!(matches!(found, Reconciled::Running(_)), "{found:?}");
    assert_eq!(began(&serving).len(), 1);
}

#[tokio::test]
async fn dropped_start_reconciles_not_started() {
    let (serving, plan) = (serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await, plan(10));
    let (mut cmm, armed) = armed(&serving, &plan).await;
    serving.faults().set(silent_from_start(true));
    let unknown = cmm.start(armed.clone()).await;
    assert!(matches!(unknown, Err(DeviceError::StartUnknown { .. })), "{unknown:?}");
    serving.faults().set(FaultPlan::new(0));
    // A restarted client knows the start from its journal only.
    let mut after = connected(settings(&serving)).await;
    let asked = Instant::now();
    let found = after.reconcile(&armed).await.unwrap();
    assert!(matches!(found, Reconciled::NotStarted(_)), "{found:?}");
    assert!(asked.elapsed() >= Duration::from_secs(1));
    assert!(began(&serving).is_empty());
}

/// Returns the START of a prepared job, as a network delivers it after a delay.
fn delayed(armed: &Armed) -> SimFrame {
    let Armed { job, start_sequence: sequence, token, .. } = *armed;
    SimFrame { sequence, cycle: job.cycle, job: job.job, digest: job.digest, token, ..of_first(SimCommand::Start) }
}

#[tokio::test]
async fn late_start_after_reconcile_is_fenced() {
    let (serving, plan) = (serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await, plan(10));
    let (mut cmm, lost) = armed(&serving, &plan).await;
    serving.faults().set(FaultPlan::new(0).always(When::Commanding(3), Fault::DropRequest));
    let unknown = cmm.start(lost.clone()).await;
    assert!(matches!(unknown, Err(DeviceError::StartUnknown { .. })), "{unknown:?}");
    serving.faults().set(FaultPlan::new(0));
    cmm.connect().await.unwrap();
    let found = cmm.reconcile(&lost).await.unwrap();
    assert!(matches!(found, Reconciled::NotStarted(_)), "{found:?}");
    write_command(&serving, delayed(&lost));
    assert!(began(&serving).is_empty(), "the CLAIM has fenced it off");
    // After another prepare the same job starts, and the old frame is too old again.
    cmm.stop().await.unwrap();
    cmm.load_plan(&plan, &Interrupt::new()).await.unwrap();
    let again = cmm.prepare(job_of(&plan, 1)).await.unwrap();
    write_command(&serving, delayed(&lost));
    let sequence = again.start_sequence;
    cmm.start(again).await.unwrap();
    assert_eq!(began(&serving), [(sequence, 42, 1)]);
}

#[tokio::test]
async fn late_start_before_reconcile_is_found() {
    let (serving, plan) = (serve(Kind::Cmm, 1.0, SharedFaultPlan::none()).await, plan(100));
    let (mut cmm, late) = armed(&serving, &plan).await;
    serving.faults().set(FaultPlan::new(0).always(When::Commanding(3), Fault::DropRequest));
    assert!(cmm.start(late.clone()).await.is_err());
    write_command(&serving, delayed(&late));
    let found = cmm.reconcile(&late).await.unwrap();
    assert!(matches!(found, Reconciled::Running(_)), "{found:?}");
    assert_eq!(began(&serving).len(), 1);
}

#[tokio::test]
async fn restarted_machine_reconciles_unknown() {
    let (serving, plan) = (serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await, plan(10));
    let (mut cmm, armed) = armed(&serving, &plan).await;
    cmm.start(armed.clone()).await.unwrap();
    wait_for_state(&mut cmm, MachineState::Complete).await.unwrap();
    let found = cmm.reconcile(&armed).await.unwrap();
    assert!(matches!(found, Reconciled::Finished(_)), "{found:?}");
    serving.machine(1).unwrap().with(registers::SimulatedMachine::reboot);
    let restarted = cmm.status().await;
    assert!(matches!(restarted, Err(DeviceError::Restarted { .. })), "{restarted:?}");
    cmm.connect().await.unwrap();
    let found = cmm.reconcile(&armed).await.unwrap();
    assert!(matches!(found, Reconciled::Unknown { .. }), "{found:?}");
    let dead = cmm.start(armed).await;
    assert!(matches!(dead, Err(DeviceError::Restarted { .. })), "{dead:?}");
    assert_eq!(began(&serving).len(), 1);
}

#[tokio::test]
async fn frozen_application_detected() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    let mut cmm = connected(settings(&serving)).await;
    serving.machine(1).unwrap().with(|machine| machine.freeze(true));
    let began = Instant::now();
    let frozen = loop {
        match cmm.status().await {
            Err(error) => break error,
            Ok(_) => tokio::time::sleep(Duration::from_millis(50)).await,
        }
        assert!(began.elapsed() < Duration::from_secs(60));
    };
    assert!(matches!(frozen, DeviceError::Frozen { .. }), "{frozen}");
    serving.machine(1).unwrap().with(|machine| machine.freeze(false));
    let began = Instant::now();
    while cmm.status().await.is_err() {
        assert!(began.elapsed() < Duration::from_secs(60));
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

// ---- serial lines -------------------------------------------------------------------------------------------------------------------

pub fn rtu(
    units: Vec<(u8, registers::SimulatedMachine)>,
    line: SerialLine,
    faults: SharedFaultPlan,
) -> (Serving, ModbusSettings) {
    let serving = Serving::rtu(units, line, faults).unwrap();
    let device = serving.path().unwrap().to_string_lossy().into_owned();
    let wire = LineAddress::Rtu { device, baud: line.baud, parity: Parity::None, stop_bits: 1 };
    let settings = ModbusSettings {
        request_timeout: Duration::from_millis(300),
        quarantine: Duration::from_millis(200),
        retries: 6,
        lost_after: Duration::from_secs(20),
        ..ModbusSettings::new(wire)
    };
    (serving, settings)
}

#[tokio::test]
async fn two_machines_share_a_serial_line() {
    let options = MachineOptions::default;
    let units = vec![(1, toy(Kind::Cmm, AT_ONCE, options())), (2, toy(Kind::Grinder, AT_ONCE, options()))];
    let (_serving, settings) = rtu(units, SerialLine { baud: 115_200, paced: false }, SharedFaultPlan::none());
    let settings = patient(settings);
    let link = Link::new(settings.line.clone(), settings.request_timeout, settings.quarantine).unwrap();
    let mut cmm = ModbusCmm::on(link.clone(), settings.clone());
    let mut grinder = ModbusGrinder::on(link.clone(), ModbusSettings { unit: 2, ..settings });
    cmm.connect().await.unwrap();
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    let (plan, (map, pass), calm) = (plan(40), map_and_pass(), Interrupt::new());
    let (measured, loaded) = tokio::join!(measure(&mut cmm, &plan, 1), grinder.load_pass(&map, &pass, &calm));
    assert_exact(&plan, &measured.unwrap(), "two on a line");
    loaded.unwrap();
    assert_eq!(link.statistics().opened, 1);
}

#[tokio::test]
async fn rtu_wire_faults_give_exact_points() {
    let plan = plan(20);
    let mut faults = wire_faults();
    faults.retain(|fault| !matches!(fault, Fault::WrongTransaction));
    faults.push(Fault::Noise(vec![0xff, 0x00, 0x13]));
    for fault in faults {
        let rules = FaultPlan::new(5).always(When::Every(23), fault.clone());
        let machine = toy(Kind::Cmm, AT_ONCE, MachineOptions::default());
        let (serving, settings) = rtu(vec![(1, machine)], SerialLine { baud: 115_200, paced: false }, rules.into());
        let mut cmm = ModbusCmm::new(settings).unwrap();
        let hint = format!("{fault:?}");
        cmm.connect().await.unwrap_or_else(|error| panic!("{hint}: {error}"));
        let measured = measure(&mut cmm, &plan, 1).await;
        assert_exact(&plan, &measured.unwrap_or_else(|error| panic!("{hint}: {error}")), &hint);
        assert_eq!(began(&serving).len(), 1, "{hint}");
    }
}

#[tokio::test]
async fn late_reply_not_matched_to_next_request() {
    let plan = plan(20);
    let rules = FaultPlan::new(5).times(2, 2, When::Reading(64), Fault::DelayReply(Duration::from_millis(900))).times(
        3,
        2,
        When::Reading(462),
        Fault::DelayReply(Duration::from_millis(900)),
    );
    let machine = toy(Kind::Cmm, AT_ONCE, MachineOptions::default());
    let (serving, settings) = rtu(vec![(1, machine)], SerialLine { baud: 115_200, paced: false }, rules.into());
    let mut cmm = connected(settings).await;
    assert_exact(&plan, &measure(&mut cmm, &plan, 1).await.unwrap(), "late");
    assert_eq!((serving.faults().fired().len(), began(&serving).len()), (4, 1));
    assert!(cmm.link().statistics().timeouts >= 4, "{:?}", cmm.link().statistics());
}

#[tokio::test]
async fn start_refused_after_interlock() {
    let (serving, plan) = (serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await, plan(10));
    let (mut cmm, armed) = armed(&serving, &plan).await;
    serving.machine(1).unwrap().with(|machine| machine.open_interlocks(1));
    let refused = cmm.start(armed).await;
    assert!(matches!(refused, Err(DeviceError::Refused { command: MachineCommand::Start, .. })), "{refused:?}");
    assert!(began(&serving).is_empty());
}

#[tokio::test]
async fn hold_interrupts_page_transfer() {
    let serving = serve(Kind::Cmm, AT_ONCE, SharedFaultPlan::none()).await;
    let mut cmm = claimed(settings(&serving)).await;
    let (interrupt, pages) = interrupt_at_page(&serving, 30);
    let broken = cmm.load_plan(&plan(4000), &interrupt).await;
    assert!(matches!(broken, Err(DeviceError::Interrupted { .. })), "{broken:?}");
    let refused = cmm.hold().await; // it is idle, so it says no, but it says so
    assert!(matches!(refused, Err(DeviceError::Refused { command: MachineCommand::Hold, .. })), "{refused:?}");
    assert_eq!(pages.load(Ordering::SeqCst), 31, "pages came after the hold was ordered");
}
