//! Compares docs/modbus.md with the wire: its registers and, to the last digit, its test vectors. A driver executes a
//! job against a simulated machine. Its requests and the answers must match the page.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, LazyLock, Mutex};
use std::time::Duration;

use regrind::device::{
    Cmm, CorrectionMap, Grinder, Identified, Interrupt, Job, LineAddress, Machine as Driver, MachineState, ModbusCmm,
    ModbusGrinder, ModbusSettings, Outcome, Plan, PlanTarget, RANGES, RegisterMap, Status, TargetKind, TouchStatus,
    ValueRange, WordOrder, digest,
};
use regrind::geometry::Grid;
use regrind_sim::body::Kind;
use regrind_sim::command::{Command, CommandFrame};
use regrind_sim::options::MachineOptions;
use regrind_sim::payload::{self, PointRecord, encode_points};
use regrind_sim::register_encoding::{self, bytes_of, crc16, registers_of, turn_payload};
use regrind_sim::registers::SimulatedMachine;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use crate::toy::{Toy, pass};

static PAGE: LazyLock<String> =
    LazyLock::new(|| std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/modbus.md")).unwrap());

/// Machine time that passes with every request.
const TURN: Duration = Duration::from_millis(50);

const OWNER: u32 = 0x12ab_34cd;
const BOOT_ID: u32 = 0x4a6f_6231;
/// Number that the machine has acknowledged before the client connects.
const NUMBER_BEFORE: u32 = 0x0001_0001;
const JOB: u32 = 70_001;
const CYCLE: u16 = 3;

// ---- the page -----------------------------------------------------------------------------------------------------------------------

/// Returns the frames of the page by their names: the fenced blocks of hexadecimal digits.
fn vectors() -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut lines = PAGE.lines();
    while let Some(line) = lines.next() {
        let Some(name) = line.strip_prefix("```hex ") else { continue };
        let digits = lines.by_ref().take_while(|line| *line != "```").flat_map(str::split_whitespace);
        let bytes = digits.map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect();
        assert!(found.insert(name.to_owned(), bytes).is_none(), "{name} stands there twice");
    }
    found
}

/// Returns the cells of a table row; none for another line.
fn cells(line: &str) -> Vec<&str> {
    let row = line.strip_prefix("| ").and_then(|line| line.strip_suffix(" |"));
    row.map(|row| row.split(" | ").collect()).unwrap_or_default()
}

// ---- the wire -----------------------------------------------------------------------------------------------------------------------

/// Requests and answers, in order, as Modbus TCP carries them, each as the first transaction.
type Record = Arc<Mutex<Vec<Vec<u8>>>>;

/// Serves a machine to one client and records the traffic.
async fn record(machine: SimulatedMachine, word_order: WordOrder) -> (ModbusSettings, Record) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let record = Record::default();
    let kept = Arc::clone(&record);
    tokio::spawn(async move {
        let (client, _) = listener.accept().await.unwrap();
        serve(client, machine, &kept).await;
    });
    let settings = ModbusSettings {
        registers: RegisterMap { word_order, ..RegisterMap::default() },
        request_timeout: Duration::from_secs(30),
        owner: OWNER,
        epoch: 7,
        ..ModbusSettings::new(LineAddress::Tcp { host: "127.0.0.1".into(), port })
    };
    (settings, record)
}

async fn serve(mut client: TcpStream, mut machine: SimulatedMachine, record: &Record) {
    let mut head = [0; 7];
    while client.read_exact(&mut head).await.is_ok() {
        let mut asked = vec![0; usize::from(u16::from_be_bytes([head[4], head[5]])) - 1];
        client.read_exact(&mut asked).await.unwrap();
        machine.tick(TURN);
        let answer = answer(&mut machine, &asked);
        record.lock().unwrap().extend([tcp(&asked), tcp(&answer)]);
        let mut sent = tcp(&answer);
        sent[..2].copy_from_slice(&head[..2]);
        client.write_all(&sent).await.unwrap();
    }
}

fn answer(machine: &mut SimulatedMachine, asked: &[u8]) -> Vec<u8> {
    let word = |at: usize| u16::from_be_bytes([asked[at], asked[at + 1]]);
    match asked[0] {
        3 => {
            let bytes = bytes_of(&machine.read(word(1), word(3)).unwrap());
            [&[3, bytes.len() as u8], &bytes[..]].concat()
        }
        16 => {
            machine.write(word(1), &registers_of(&asked[6..])).unwrap();
            asked[..5].to_vec()
        }
        other => panic!("function {other}"),
    }
}

/// Returns the frame of Modbus TCP: transaction 1, unit 1.
fn tcp(pdu: &[u8]) -> Vec<u8> {
    [&[0, 1, 0, 0, 0, pdu.len() as u8 + 1, 1], pdu].concat()
}

/// Returns the frame of Modbus RTU with the content of a frame of Modbus TCP.
fn rtu(tcp: &[u8]) -> Vec<u8> {
    [&tcp[6..], &crc16(&tcp[6..]).to_le_bytes()].concat()
}

// ---- what is sent -------------------------------------------------------------------------------------------------------------------

fn plan() -> Plan {
    let target =
        PlanTarget { index: 70_000, kind: TargetKind::Part, point_mm: [1.1, -2.3, 0.7], normal: [0.0, 0.0, 1.0] };
    Plan {
        targets: vec![target],
        probe_radius_mm: 2.0,
        approach_mm: 1.0,
        search_mm: 0.5,
        speed_mm_s: 4.0,
        safe_height_mm: 8.0,
        careful_start: None,
    }
}

fn map() -> CorrectionMap {
    CorrectionMap {
        grid: Grid { columns: 3, rows: 2, first_mm: [-10.0, -15.0], spacing_mm: [10.0, 30.0] },
        values_mm: vec![0.0012, -0.0025, 0.0003, 0.0, 0.0021, -0.0004],
        part_identity: [7; 32],
    }
}

/// Returns a machine that has already received a command of another client, so that the numbers of its client fill both
/// words.
fn machine(kind: Kind, word_order: register_encoding::WordOrder) -> SimulatedMachine {
    let options = MachineOptions { word_order, ..MachineOptions::default() };
    let mut machine = SimulatedMachine::new(Box::new(Toy::new(kind, 1e9)), BOOT_ID, options);
    let stranger =
        CommandFrame { sequence: NUMBER_BEFORE, command: Command::Release as u16, owner: 1, ..CommandFrame::default() };
    machine.write(40, &stranger.registers(word_order)).unwrap();
    machine
}

/// Returns the traffic while a point is measured.
async fn measured(order: WordOrder, sim_order: register_encoding::WordOrder) -> Vec<Vec<u8>> {
    let (settings, record) = record(machine(Kind::Cmm, sim_order), order).await;
    let (mut cmm, plan, calm) = (ModbusCmm::new(settings).unwrap(), plan(), Interrupt::new());
    let job = Job { job: JOB, cycle: CYCLE, digest: digest(&[plan.identity()]) };
    cmm.connect().await.unwrap();
    cmm.claim().await.unwrap();
    cmm.load_plan(&plan, &calm).await.unwrap();
    let armed = cmm.prepare(job).await.unwrap();
    assert_eq!(armed.start_sequence, NUMBER_BEFORE + 3);
    cmm.start(armed).await.unwrap();
    let status = complete(&mut cmm).await;
    assert_eq!((status.job, status.done, status.outcome), (Some(job), NUMBER_BEFORE + 3, Outcome::Complete));
    assert_eq!((status.clear_of_part, status.supplies, status.progress), (Some(true), Some(true), Some((1, 1))));
    assert_eq!((status.temperature_c, status.boot_id), (Some(20.25), Some(BOOT_ID)));
    let points = cmm.collect(job, &calm).await.unwrap().points;
    assert_eq!((points.len(), points[0].index, points[0].status), (1, 70_000, TouchStatus::Touched));
    assert_eq!(points[0].position_mm, [1.1, -2.3, 2.7]);
    record.lock().unwrap().clone()
}

/// Returns the traffic while seven of eight points are measured, and read.
async fn measured_ahead(order: WordOrder, word_order: register_encoding::WordOrder) -> Vec<Vec<u8>> {
    let options = MachineOptions { word_order, ..MachineOptions::default() };
    let machine = SimulatedMachine::new(Box::new(Toy::new(Kind::Cmm, 1e9).up_to(7)), BOOT_ID, options);
    let (settings, record) = record(machine, order).await;
    let (mut cmm, one, calm) = (ModbusCmm::new(settings).unwrap(), plan(), Interrupt::new());
    let target = |k: u32| {
        let [x, y, z] = one.targets[0].point_mm;
        PlanTarget { index: 70_000 + k, point_mm: [x + f64::from(k), y, z], ..one.targets[0] }
    };
    let plan = Plan { targets: (0..8).map(target).collect(), ..one.clone() };
    let job = Job { job: JOB, cycle: CYCLE, digest: digest(&[plan.identity()]) };
    cmm.connect().await.unwrap();
    cmm.claim().await.unwrap();
    cmm.load_plan(&plan, &calm).await.unwrap();
    let armed = cmm.prepare(job).await.unwrap();
    cmm.start(armed).await.unwrap();
    let mut told = Vec::new();
    for _ in 0..3 {
        cmm.status().await.unwrap();
        told.extend(cmm.read_ahead(job, &calm).await);
    }
    assert_eq!(told.len(), 1, "one page is full");
    assert_eq!(
        (told[0].points.len(), told[0].points[6].index, told[0].points[6].position_mm),
        (7, 70_006, [1.1 + 6.0, -2.3, 2.7])
    );
    record.lock().unwrap().clone()
}

async fn complete(machine: &mut impl Driver) -> Status {
    for _ in 0..200 {
        let status = machine.status().await.unwrap();
        if status.state == MachineState::Complete {
            return status;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    panic!("the job does not end");
}

/// Returns the traffic while a map and a pass are transferred, and the pass is ground.
async fn ground(order: WordOrder, sim_order: register_encoding::WordOrder) -> Vec<Vec<u8>> {
    let (settings, record) = record(machine(Kind::Grinder, sim_order), order).await;
    let (mut grinder, calm) = (ModbusGrinder::new(settings).unwrap(), Interrupt::new());
    let job = Job { job: JOB, cycle: CYCLE, digest: digest(&[map().identity(), pass().identity()]) };
    grinder.connect().await.unwrap();
    grinder.claim().await.unwrap();
    grinder.load_pass(&map(), &pass(), &calm).await.unwrap();
    let armed = grinder.prepare(job).await.unwrap();
    grinder.start(armed).await.unwrap();
    complete(&mut grinder).await;
    let record_of_pass = grinder.collect(job, &calm).await.unwrap();
    assert_eq!((record_of_pass.path_mm, record_of_pass.removed_mm3), (Some(1234.5), Some(67.8)));
    record.lock().unwrap().clone()
}

/// Returns an answer with the variable fields as on the page: the snapshot number and the heartbeats of a status, and
/// no duration in an outbox.
fn as_on_the_page(frame: &[u8]) -> Vec<u8> {
    let mut frame = frame.to_vec();
    if frame.len() == 9 + 112 && frame[7..9] == [3, 112] {
        frame[9 + 2 * 24..9 + 2 * 28].fill(0);
    }
    if frame.len() == 9 + 96 && frame[7..9] == [3, 96] {
        for (register, value) in [(0, 0x0102_u16), (28, 0x0345), (29, 0x0019), (47, 0x0102)] {
            frame[9 + 2 * register..][..2].copy_from_slice(&value.to_be_bytes());
        }
    }
    frame
}

/// Parts of the page that have one version for each word order; the others are the same in both.
const TURNED: [&str; 13] = [
    "claim", "status", "header", "page", "point", "beat", "ahead", "full", "plan", "prepare", "start", "pass", "record",
];
const UNTURNED: [&str; 10] = [
    "ahead.request",
    "full.request",
    "claim.answer",
    "beat.answer",
    "status.request",
    "header.answer",
    "page.answer",
    "select.request",
    "select.answer",
    "point.request",
];

#[tokio::test]
async fn modbus_page_frames_match_wire() {
    let page = vectors();
    let mut looked_at = BTreeSet::new();
    for (name, order, sim_order) in [
        ("big", WordOrder::Big, register_encoding::WordOrder::Big),
        ("little", WordOrder::Little, register_encoding::WordOrder::Little),
    ] {
        let mut sent = measured(order, sim_order).await;
        sent.extend(ground(order, sim_order).await);
        sent.extend(measured_ahead(order, sim_order).await);
        if std::env::var_os("REGRIND_VECTORS").is_some() {
            print_vectors(name, &sent);
            continue;
        }
        let sent: BTreeSet<_> = sent.iter().map(|frame| as_on_the_page(frame)).collect();
        let names = TURNED.map(|frame| format!("{frame}.{name}")).into_iter().chain(UNTURNED.map(str::to_owned));
        for name in names {
            let [of_tcp, of_rtu] = ["tcp", "rtu"].map(|wire| format!("{name}.{wire}"));
            assert!(sent.contains(&page[&of_tcp]), "{of_tcp} was not on the wire: {:02X?}", page[&of_tcp]);
            assert_eq!(page[&of_rtu], rtu(&page[&of_tcp]), "{of_rtu}");
            looked_at.extend([of_tcp, of_rtu]);
        }
        looked_at.insert(format!("count.{name}"));
        assert_eq!(page[&format!("count.{name}")], point_in_counts(sim_order), "count.{name}");
    }
    assert_eq!(looked_at, page.into_keys().collect(), "frames that are looked at, and frames of the page");
}

/// Prints the long frames of one job, in the format of the page (`REGRIND_VECTORS=1 cargo test --test device
/// modbus_page_frames_match_wire -- --nocapture`).
fn print_vectors(order: &str, sent: &[Vec<u8>]) {
    let word = |frame: &[u8], at: usize| u16::from_be_bytes([frame[at], frame[at + 1]]);
    let is_write = |frame: &&Vec<u8>, address: u16, registers: u16| {
        frame.len() > 13 && frame[7] == 16 && word(frame, 8) == address && word(frame, 10) == registers
    };
    let commands = |number: u16| move |frame: &&Vec<u8>| is_write(frame, 40, 20) && word(frame, 13 + 4) == number;
    let found = [
        ("plan", sent.iter().find(|frame| is_write(frame, 224, 8 + 60))),
        ("prepare", sent.iter().find(commands(2))),
        ("start", sent.iter().find(commands(3))),
        ("pass", sent.iter().find(|frame| is_write(frame, 224, 8 + 64))),
        ("record", sent.iter().find(|frame| frame[7..9] == [3, 2 * (4 + 32)])),
    ];
    for (name, frame) in found {
        for (wire, frame) in [("rtu", rtu(frame.unwrap())), ("tcp", frame.unwrap().clone())] {
            println!("```hex {name}.{order}.{wire}");
            let lines =
                frame.chunks(32).map(|line| line.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" "));
            lines.for_each(|line| println!("{line}"));
            println!("```");
        }
    }
}

fn point_record() -> PointRecord {
    PointRecord { index: 70_000, status: payload::Status::Touched, quality: 0, position_mm: [1.1, -2.3, 2.7] }
}

fn point_in_counts(order: register_encoding::WordOrder) -> Vec<u8> {
    let mut bytes = encode_points(&[point_record()], Some(1e-6));
    if order == register_encoding::WordOrder::Little {
        turn_payload(4, 2, &mut bytes);
    }
    bytes
}

#[test]
fn modbus_page_checksums_match_frames() {
    let page = vectors();
    let mut told = vec![
        format!("digest 0x{:08X}", digest(&[plan().identity()])),
        format!("identity `{}`", map().identity().map(|byte| format!("{byte:02x}")).concat()),
        format!("`123456789` gives 0x{:08X}", crc32fast::hash(b"123456789")),
        format!("`123456789` gives 0x{:04X}", crc16(b"123456789")),
    ];
    for (name, order) in [("big", register_encoding::WordOrder::Big), ("little", register_encoding::WordOrder::Little)]
    {
        let of = |frame: &str| &page[&format!("{frame}.{name}.tcp")];
        told.push(format!("0x{}", of("claim")[13 + 32..][..2].iter().map(|b| format!("{b:02X}")).collect::<String>()));
        told.push(format!("0x{:08X}", crc32fast::hash(&of("page")[13 + 16..])));
        let mut point = encode_points(&[point_record()], None);
        if order == register_encoding::WordOrder::Little {
            turn_payload(4, 1, &mut point);
        }
        assert_eq!(of("point")[9 + 8..], point, "{name}");
        told.push(format!("0x{:08X}", crc32fast::hash(&point)));
    }
    let text = PAGE.split_whitespace().collect::<Vec<_>>().join(" ");
    for told in told {
        assert!(text.contains(&told), "the page does not say {told}");
    }
}

#[test]
fn modbus_page_ranges_match_driver() {
    let rows: Vec<_> = PAGE.lines().map(cells).filter(|cells| cells.len() == 4).collect();
    for ValueRange { name: figure, min: least, max: most, unit } in RANGES {
        let is_it = |cells: &&Vec<&str>| {
            cells[0] == figure
                && cells[3].trim() == unit
                && [cells[1], cells[2]].map(str::parse) == [Ok(least), Ok(most)]
        };
        assert!(rows.iter().any(|cells| is_it(&cells)), "{figure}: {least} to {most} {unit}");
    }
}

#[test]
fn modbus_page_blocks_match_driver() {
    let told: Vec<_> = PAGE.lines().map(cells).filter(|cells| cells.len() == 5).collect();
    for (name, first, registers) in RegisterMap::default().blocks() {
        let row = [name.replace('_', " "), first.to_string(), (40_001 + first).to_string(), registers.to_string()];
        assert!(told.iter().any(|cells| cells[..4] == row), "{row:?}");
    }
}

#[test]
fn modbus_page_numbers_offset_40001() {
    let blocks = RegisterMap::default().blocks();
    let (mut first, mut rows) = (None, 0);
    for cells in PAGE.lines().map(cells) {
        match (cells.first(), cells.get(1).map(|cell| cell.parse::<u16>())) {
            (Some(&"offset"), _) => first = None,
            (Some(offset), Some(Ok(number))) if cells.len() == 4 && number > 40_000 => {
                let offset: u16 = offset.parse().unwrap();
                let base = *first.get_or_insert(number - 40_001);
                let (_, _, registers) = blocks.iter().find(|(_, first, _)| *first == base).unwrap();
                assert_eq!(number, 40_001 + base + offset);
                assert!(offset < *registers, "{number}");
                rows += 1;
            }
            _ => {}
        }
    }
    assert!(rows > 70, "only {rows} registers");
}
