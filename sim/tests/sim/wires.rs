//! Both machines over real sockets and a real pseudo-terminal, asked by a client that is not ours; and wires that fail.

use std::future::Future;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use crate::counter::{Counter, digest, payloads};
use regrind_sim::body::Kind;
use regrind_sim::command::{Command, CommandFrame, State};
use regrind_sim::options::MachineOptions;
use regrind_sim::register_encoding::{WordOrder, bytes_of, crc16, registers_of};
use regrind_sim::registers::SimulatedMachine;
#[cfg(unix)]
use regrind_sim::wire::pty;
use regrind_sim::wire::rtu::Line;
use regrind_testsim::wire_faults::{Fault, FaultPlan, Serving, SharedFaultPlan, When};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_modbus::client::{Context, Reader, Writer};
use tokio_modbus::prelude::SlaveContext;
use tokio_modbus::{ExceptionCode, Slave, client};

const PATIENCE: Duration = Duration::from_secs(60);

fn machine(kind: Kind) -> SimulatedMachine {
    let options = MachineOptions { speed: 50.0, acting: Duration::from_millis(30), ..MachineOptions::default() };
    SimulatedMachine::new(Box::new(Counter::new(kind, 20.0)), 5, options)
}

async fn patiently<T>(what: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, what).await.expect("nothing happened for a minute")
}

/// Reads status, beating, until the machine is in a state.
async fn until(wire: &mut Context, state: State) -> Vec<u16> {
    patiently(async {
        for beat in 0.. {
            wire.write_multiple_registers(36, &[beat, 0, 3]).await.unwrap().unwrap();
            let status = wire.read_holding_registers(64, 48).await.unwrap().unwrap();
            if status[1] == state as u16 {
                return status;
            }
            tokio::task::yield_now().await;
        }
        unreachable!()
    })
    .await
}

fn u32_at(words: &[u16], at: usize) -> u32 {
    WordOrder::Big.to_u32([words[at], words[at + 1]])
}

async fn command(wire: &mut Context, frame: CommandFrame) -> Vec<u16> {
    wire.write_multiple_registers(40, &frame.registers(WordOrder::Big)).await.unwrap().unwrap();
    let status = wire.read_holding_registers(64, 48).await.unwrap().unwrap();
    assert_eq!((u32_at(&status, 4), status[6]), (frame.sequence, 1), "{frame:?}");
    status
}

async fn send_payloads(wire: &mut Context, kind: Kind) {
    for (number, bytes, identity) in payloads(kind) {
        let mut header = vec![number, 0];
        header.extend(WordOrder::Big.from_u32(bytes.len() as u32));
        header.extend(WordOrder::Big.from_u32(crc32fast::hash(&bytes)));
        header.extend([0, 0]);
        header.extend(registers_of(&identity));
        wire.write_multiple_registers(200, &header).await.unwrap().unwrap();
        for (page, data) in registers_of(&bytes).chunks(112).enumerate() {
            let mut words = vec![0, page as u16, data.len() as u16, 0, 0, 0, 0, 0];
            words.extend(data);
            wire.write_multiple_registers(224, &words).await.unwrap().unwrap();
        }
        let inbox = wire.read_holding_registers(350, 12).await.unwrap().unwrap();
        assert_eq!(inbox[1], 2, "{inbox:?}");
    }
}

/// Runs a job from CLAIM to ACKNOWLEDGE and returns the result's bytes.
async fn run_a_job(wire: &mut Context, kind: Kind) -> Vec<u8> {
    let identity = wire.read_holding_registers(0, 32).await.unwrap().unwrap();
    assert_eq!((identity[0], identity[3], identity[12]), (0x5247, kind as u16, 1));
    let claim =
        CommandFrame { sequence: 1, command: Command::Claim as u16, owner: 3, epoch: 1, ..CommandFrame::default() };
    command(wire, claim).await;
    send_payloads(wire, kind).await;
    let prepare =
        CommandFrame { sequence: 2, command: Command::Prepare as u16, job: 8, cycle: 1, digest: digest(kind), ..claim };
    let token = u32_at(&command(wire, prepare).await, 14);
    command(wire, CommandFrame { sequence: 3, command: Command::Start as u16, token, ..prepare }).await;
    let status = until(wire, State::Complete).await;
    assert_eq!((u32_at(&status, 16), status[18]), (3, 1));
    let header = wire.read_holding_registers(400, 56).await.unwrap().unwrap();
    let mut bytes = Vec::new();
    let length = u32_at(&header, 2) as usize;
    while bytes.len() < length {
        let page = (bytes.len() / 224) as u16;
        wire.write_multiple_registers(460, &[0, page]).await.unwrap().unwrap();
        let registers = wire.read_holding_registers(462, 116).await.unwrap().unwrap();
        assert_eq!(registers[..2], [0, page]);
        bytes.extend(bytes_of(&registers[4..4 + usize::from(registers[2])]));
    }
    assert_eq!(crc32fast::hash(&bytes), u32_at(&header, 4));
    command(wire, CommandFrame { sequence: 4, command: Command::Acknowledge as u16, argument: 3, ..claim }).await;
    until(wire, State::Idle).await;
    bytes
}

async fn connect(serving: &Serving, unit: u8) -> Context {
    client::tcp::connect_slave(serving.local_addr().unwrap(), Slave(unit)).await.unwrap()
}

async fn serve() -> Serving {
    let units = vec![(1, machine(Kind::Cmm)), (2, machine(Kind::Grinder))];
    Serving::tcp_with("127.0.0.1:0", units, SharedFaultPlan::none()).await.unwrap()
}

#[tokio::test]
async fn whole_job_over_tcp_two_units() {
    let serving = serve().await;
    let mut cmm = connect(&serving, 1).await;
    let mut grinder = connect(&serving, 2).await;
    let (points, record) = tokio::join!(run_a_job(&mut cmm, Kind::Cmm), run_a_job(&mut grinder, Kind::Grinder));
    assert_eq!((points.len(), record.len()), (620, 64));
    for unit in [1, 2] {
        assert_eq!(serving.machine(unit).unwrap().with(|m| m.began()), [(3, 8, 1)]);
    }
    serving.stop().await;
}

#[tokio::test]
async fn whole_job_over_rtu_two_units() {
    let units = vec![(1, machine(Kind::Cmm)), (2, machine(Kind::Grinder))];
    let serving = Serving::rtu(units, Line { baud: 115_200, paced: false }, SharedFaultPlan::none()).unwrap();
    let port = tokio_serial::SerialStream::open(&tokio_serial::new(serving.path().unwrap().to_str().unwrap(), 115_200));
    let mut wire = client::rtu::attach_slave(port.unwrap(), Slave(1));
    assert_eq!(run_a_job(&mut wire, Kind::Cmm).await.len(), 620);
    wire.set_slave(Slave(2));
    assert_eq!(run_a_job(&mut wire, Kind::Grinder).await.len(), 64);
    serving.stop().await;
}

#[tokio::test]
async fn rtu_paced_line_follows_baud_rate() {
    let line = Line::paced(9600);
    let serving = Serving::rtu(vec![(1, machine(Kind::Cmm))], line, SharedFaultPlan::none()).unwrap();
    let port = tokio_serial::SerialStream::open(&tokio_serial::new(serving.path().unwrap().to_str().unwrap(), 9600));
    let mut wire = client::rtu::attach_slave(port.unwrap(), Slave(1));
    let began = Instant::now();
    wire.read_holding_registers(64, 48).await.unwrap().unwrap();
    let least = line.characters(8 + 101) + line.gap();
    assert!(began.elapsed() >= least, "{:?} of {least:?}", began.elapsed());
    assert!((0.128..0.130).contains(&least.as_secs_f64()), "{least:?}");
}

#[tokio::test]
async fn tcp_exceptions_for_unknown_requests() {
    let serving = serve().await;
    let mut wire = connect(&serving, 1).await;
    assert_eq!(wire.read_coils(0, 1).await.unwrap(), Err(ExceptionCode::IllegalFunction));
    assert_eq!(wire.read_input_registers(0, 1).await.unwrap(), Err(ExceptionCode::IllegalFunction));
    assert_eq!(wire.read_holding_registers(39, 1).await.unwrap(), Err(ExceptionCode::IllegalDataAddress));
    assert_eq!(wire.write_multiple_registers(64, &[1]).await.unwrap(), Err(ExceptionCode::IllegalDataAddress));
    assert_eq!(wire.write_multiple_registers(200, &[0; 24]).await.unwrap(), Err(ExceptionCode::IllegalDataValue));
    wire.write_single_register(461, 99).await.unwrap().unwrap();
    assert_eq!(wire.read_holding_registers(461, 1).await.unwrap().unwrap(), [99]);
    wire.set_slave(Slave(9));
    assert_eq!(wire.read_holding_registers(0, 1).await.unwrap(), Err(ExceptionCode::GatewayTargetDevice));
    wire.set_slave(Slave(0));
    assert_eq!(wire.read_holding_registers(0, 1).await.unwrap(), Err(ExceptionCode::GatewayTargetDevice));
}

#[tokio::test]
async fn tcp_silent_client_causes_hold() {
    let options = MachineOptions { speed: 0.001, lost_after_ms: 300, ..MachineOptions::default() };
    let machine = SimulatedMachine::new(Box::new(Counter::new(Kind::Cmm, 20.0)), 5, options);
    let serving = Serving::tcp_with("127.0.0.1:0", vec![(1, machine)], SharedFaultPlan::none()).await.unwrap();
    let mut wire = connect(&serving, 1).await;
    let claim =
        CommandFrame { sequence: 1, command: Command::Claim as u16, owner: 3, epoch: 1, ..CommandFrame::default() };
    command(&mut wire, claim).await;
    send_payloads(&mut wire, Kind::Cmm).await;
    let prepare =
        CommandFrame { sequence: 2, command: Command::Prepare as u16, job: 8, digest: digest(Kind::Cmm), ..claim };
    let token = u32_at(&command(&mut wire, prepare).await, 14);
    command(&mut wire, CommandFrame { sequence: 3, command: Command::Start as u16, token, ..prepare }).await;
    let status = patiently(async {
        loop {
            let status = wire.read_holding_registers(64, 48).await.unwrap().unwrap();
            if status[1] == State::Held as u16 {
                return status;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;
    assert_eq!(status[7], 20);
}

#[tokio::test]
async fn serving_stop_closes_port() {
    let serving = serve().await;
    let addr = serving.local_addr().unwrap();
    let mut raw = TcpStream::connect(addr).await.unwrap();
    ask(&mut raw, 1, 1, &READ).await;
    assert_eq!(reply(&mut raw, 11).await.len(), 11);
    let machines = serving.machines().clone();
    serving.stop().await;
    assert_eq!(patiently(raw.read(&mut [0; 8])).await.unwrap_or(0), 0);
    let again = Serving::tcp_with(addr, machines, SharedFaultPlan::none()).await.unwrap();
    let mut raw = TcpStream::connect(addr).await.unwrap();
    ask(&mut raw, 1, 2, &READ).await;
    assert_eq!(reply(&mut raw, 11).await.len(), 11);
    again.stop().await;
}

#[tokio::test]
async fn non_modbus_closes_only_own_connection() {
    let serving = serve().await;
    let mut other = connect(&serving, 1).await;
    for junk in
        [&[0u8, 1, 0, 9, 0, 6, 1][..], &[0, 1, 0, 0, 0, 1, 1], &[0, 1, 0, 0, 1, 44, 1], b"GET / HTTP/1.1\r\n\r\n"]
    {
        let mut raw = TcpStream::connect(serving.local_addr().unwrap()).await.unwrap();
        raw.write_all(junk).await.unwrap();
        assert_eq!(patiently(raw.read(&mut [0; 8])).await.unwrap_or(0), 0, "{junk:?}");
        other.read_holding_registers(0, 4).await.unwrap().unwrap();
    }
    // Byte counts that lie are a content that cannot be taken; they move nothing.
    let mut raw = TcpStream::connect(serving.local_addr().unwrap()).await.unwrap();
    for pdu in [&[3u8, 0, 0][..], &[16, 0, 36, 0, 1, 2, 0], &[16, 0, 36, 0, 1, 4, 0, 7, 0, 0], &[6, 0, 36], &[16]] {
        ask(&mut raw, 3, 1, pdu).await;
        assert_eq!(reply(&mut raw, 9).await, [0, 3, 0, 0, 0, 3, 1, pdu[0] | 0x80, 3], "{pdu:?}");
    }
    assert_eq!(other.read_holding_registers(36, 1).await.unwrap().unwrap(), [0]);
}

/// Reads the first register of the identity block.
const READ: [u8; 5] = [3, 0, 0, 0, 1];
/// The answer to it, after the transaction id.
const GOOD: [u8; 9] = [0, 0, 0, 5, 1, 3, 2, 0x52, 0x47];

async fn ask(wire: &mut (impl AsyncWriteExt + Unpin), transaction: u16, unit: u8, pdu: &[u8]) {
    let mut frame = transaction.to_be_bytes().to_vec();
    frame.extend([0, 0]);
    frame.extend((pdu.len() as u16 + 1).to_be_bytes());
    frame.push(unit);
    frame.extend(pdu);
    wire.write_all(&frame).await.unwrap();
}

async fn reply(wire: &mut (impl AsyncReadExt + Unpin), length: usize) -> Vec<u8> {
    let mut bytes = vec![0; length];
    patiently(wire.read_exact(&mut bytes)).await.unwrap();
    bytes
}

fn good(transaction: u8) -> Vec<u8> {
    [&[0, transaction], &GOOD[..]].concat()
}

/// Breaks the first of two requests over TCP and returns all the bytes that come before the sound answer to the second.
async fn broken(fault: Fault) -> Vec<u8> {
    let serving = serve().await;
    serving.faults().set(FaultPlan::new(0).once(When::Any, fault));
    let addr: SocketAddr = serving.local_addr().unwrap();
    let mut raw = TcpStream::connect(addr).await.unwrap();
    ask(&mut raw, 1, 1, &READ).await;
    ask(&mut raw, 2, 1, &READ).await;
    let mut bytes = Vec::new();
    while !bytes.ends_with(&good(2)) {
        bytes.extend(reply(&mut raw, 1).await);
    }
    assert_eq!(serving.faults().fired().len(), 1);
    bytes.truncate(bytes.len() - 11);
    bytes
}

#[tokio::test]
async fn tcp_wire_faults_alter_reply() {
    let changed = |at: usize, to: u8| {
        let mut bytes = good(1);
        bytes[at] = to;
        bytes
    };
    assert_eq!(broken(Fault::DropRequest).await, [0; 0]);
    assert_eq!(broken(Fault::DropReply).await, [0; 0]);
    assert_eq!(broken(Fault::DuplicateReply).await, good(1).repeat(2));
    assert_eq!(broken(Fault::Truncate(4)).await, good(1)[..4]);
    assert_eq!(broken(Fault::Fewer).await, [0, 1, 0, 0, 0, 3, 1, 3, 0]);
    assert_eq!(broken(Fault::Extra(vec![7, 7])).await, [good(1), vec![7, 7]].concat());
    assert_eq!(broken(Fault::Noise(vec![7, 7])).await, [vec![7, 7], good(1)].concat());
    assert_eq!(broken(Fault::WrongTransaction).await, [&[0x5A, 0x5B], &GOOD[..]].concat());
    assert_eq!(broken(Fault::WrongUnit).await, changed(6, 0x41));
    assert_eq!(broken(Fault::WrongFunction).await, changed(7, 2));
    assert_eq!(broken(Fault::FlipCrc).await, changed(3, 1));
    assert_eq!(broken(Fault::FlipData).await, changed(10, 0x57));
    assert_eq!(broken(Fault::Exception(6)).await, [0, 1, 0, 0, 0, 3, 1, 0x83, 6]);
    assert_eq!(broken(Fault::Split(Duration::from_micros(10))).await, good(1));
}

#[tokio::test]
async fn delayed_reply_arrives_whole() {
    let delay = Duration::from_millis(60);
    let began = Instant::now();
    assert_eq!(broken(Fault::DelayReply(delay)).await, good(1));
    assert!(began.elapsed() >= delay);
}

#[tokio::test]
async fn disconnect_and_silence_faults() {
    let serving = serve().await;
    serving.faults().set(FaultPlan::new(0).once(When::Nth(2), Fault::Disconnect(5)).once(When::Nth(3), Fault::Silence));
    let mut raw = TcpStream::connect(serving.local_addr().unwrap()).await.unwrap();
    ask(&mut raw, 1, 1, &READ).await;
    ask(&mut raw, 2, 1, &READ).await;
    let mut all = Vec::new();
    patiently(raw.read_to_end(&mut all)).await.unwrap();
    assert_eq!(all, [&good(1)[..], &good(2)[..5]].concat());
    let mut silent = TcpStream::connect(serving.local_addr().unwrap()).await.unwrap();
    ask(&mut silent, 1, 1, &READ).await;
    ask(&mut silent, 2, 1, &READ).await;
    let mut other = connect(&serving, 1).await;
    patiently(async {
        while serving.faults().requests() < 3 {
            tokio::task::yield_now().await;
        }
    })
    .await;
    other.read_holding_registers(0, 4).await.unwrap().unwrap();
    assert_eq!(serving.faults().requests(), 4, "the second request of the silent connection is swallowed");
    assert!(matches!(silent.try_read(&mut [0; 4]), Err(error) if error.kind() == std::io::ErrorKind::WouldBlock));
}

#[tokio::test]
async fn word_swap_fault() {
    let serving = serve().await;
    serving.faults().set(FaultPlan::new(0).times(2, 1, When::Reading(4), Fault::WordSwap));
    let mut wire = connect(&serving, 1).await;
    for expected in [[0x1234, 0x5678], [0x5678, 0x1234], [0x1234, 0x5678]] {
        assert_eq!(wire.read_holding_registers(4, 2).await.unwrap().unwrap(), expected);
    }
}

#[tokio::test]
async fn drop_request_and_drop_reply_faults() {
    let serving = serve().await;
    let claim =
        CommandFrame { sequence: 1, command: Command::Claim as u16, owner: 3, epoch: 1, ..CommandFrame::default() };
    let words = claim.registers(WordOrder::Big);
    let pdu = [&[16, 0, 40, 0, 20, 40][..], &bytes_of(&words)].concat();
    for (fault, done) in [(Fault::DropRequest, 0), (Fault::DropReply, 1)] {
        serving.faults().set(FaultPlan::new(0).once(When::Commanding(1), fault.clone()));
        let mut raw = TcpStream::connect(serving.local_addr().unwrap()).await.unwrap();
        ask(&mut raw, 1, 1, &pdu).await;
        ask(&mut raw, 2, 1, &READ).await;
        assert_eq!(reply(&mut raw, 11).await, good(2));
        let acknowledged = serving.machine(1).unwrap().with(|m| m.read(68, 2)).unwrap();
        assert_eq!(u32_at(&acknowledged, 0), done, "{fault:?}");
    }
}

#[tokio::test]
async fn carry_out_again_fault() {
    let serving = serve().await;
    serving.faults().set(FaultPlan::new(0).once(When::Writing(460), Fault::CarryOutAgain(2)));
    let mut wire = connect(&serving, 1).await;
    wire.write_multiple_registers(460, &[7, 0]).await.unwrap().unwrap();
    wire.write_multiple_registers(460, &[8, 0]).await.unwrap().unwrap();
    assert_eq!(
        wire.read_holding_registers(460, 1).await.unwrap().unwrap(),
        [7],
        "the old write came after the new one"
    );
}

#[tokio::test]
async fn freeze_thaw_reboot_and_tear_faults() {
    let serving = serve().await;
    let faults = FaultPlan::new(0)
        .once(When::Nth(1), Fault::Freeze)
        .once(When::Nth(3), Fault::Thaw)
        .once(When::Nth(4), Fault::TornStatus)
        .once(When::Matching(Box::new(|request| request.number == 5)), Fault::Reboot);
    serving.faults().set(faults);
    let mut wire = connect(&serving, 1).await;
    let first = wire.read_holding_registers(64, 48).await.unwrap().unwrap();
    serving.machine(1).unwrap().with(|machine| machine.tick(Duration::from_secs(1)));
    assert_eq!(wire.read_holding_registers(64, 48).await.unwrap().unwrap(), first, "frozen");
    let boot = wire.read_holding_registers(10, 2).await.unwrap().unwrap();
    serving.machine(1).unwrap().with(|machine| machine.tick(Duration::from_secs(1)));
    let torn = wire.read_holding_registers(64, 48).await.unwrap().unwrap();
    assert_ne!(torn[0], torn[47]);
    assert_ne!(torn[28], first[28], "it beats again");
    assert_ne!(wire.read_holding_registers(10, 2).await.unwrap().unwrap(), boot, "rebooted");
}

#[tokio::test]
async fn reboot_fault_in_state() {
    for state in [State::Prepared, State::Execute, State::Complete] {
        let serving =
            Serving::tcp_with("127.0.0.1:0", vec![(1, machine(Kind::Cmm))], SharedFaultPlan::none()).await.unwrap();
        serving.faults().set(FaultPlan::new(0).once(When::InState(state), Fault::Reboot));
        let mut wire = connect(&serving, 1).await;
        let claim =
            CommandFrame { sequence: 1, command: Command::Claim as u16, owner: 3, epoch: 1, ..CommandFrame::default() };
        command(&mut wire, claim).await;
        send_payloads(&mut wire, Kind::Cmm).await;
        let prepare =
            CommandFrame { sequence: 2, command: Command::Prepare as u16, job: 8, digest: digest(Kind::Cmm), ..claim };
        let write = |frame: CommandFrame| frame.registers(WordOrder::Big);
        wire.write_multiple_registers(40, &write(prepare)).await.unwrap().unwrap();
        let token = serving.machine(1).unwrap().with(|m| m.read(78, 2)).unwrap();
        let start = CommandFrame { sequence: 3, command: Command::Start as u16, token: u32_at(&token, 0), ..prepare };
        wire.write_multiple_registers(40, &write(start)).await.unwrap().unwrap();
        let boot_id = patiently(async {
            loop {
                let identity = wire.read_holding_registers(10, 2).await.unwrap().unwrap();
                if u32_at(&identity, 0) != 5 {
                    return u32_at(&identity, 0);
                }
            }
        })
        .await;
        let after = serving.machine(1).unwrap().with(|m| (m.boot_id(), m.state(), m.began().len()));
        let expected = match state {
            State::Prepared => (boot_id, State::Idle, 0),
            State::Execute => (boot_id, State::Faulted, 1),
            _ => (boot_id, State::Idle, 1),
        };
        assert_eq!(after, expected, "in {state:?}");
    }
}

#[tokio::test]
async fn seeded_faults_are_reproducible() {
    let seed = 20_261_121;
    let mut runs = Vec::new();
    for _ in 0..2 {
        let serving = serve().await;
        serving.faults().set(FaultPlan::seeded(seed, 0.2, vec![Fault::Exception(4), Fault::Exception(6)]));
        let mut wire = connect(&serving, 1).await;
        let mut failed = 0;
        for _ in 0..200 {
            failed += usize::from(wire.read_holding_registers(0, 4).await.unwrap().is_err());
        }
        let fired = serving.faults().fired();
        assert_eq!(fired.len(), failed, "seed {seed}");
        assert!((20..60).contains(&failed), "seed {seed}: {failed}");
        runs.push(fired);
    }
    assert_eq!(runs[0], runs[1], "seed {seed}");
}

fn rtu_frame(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = [&[unit], pdu].concat();
    frame.extend(crc16(&frame).to_le_bytes());
    frame
}

fn open(serving: &Serving) -> tokio_serial::SerialStream {
    let path = serving.path().unwrap().to_str().unwrap();
    tokio_serial::SerialStream::open(&tokio_serial::new(path, 115_200)).unwrap()
}

#[tokio::test]
async fn rtu_answers_only_own_units() {
    let units = vec![(1, machine(Kind::Cmm)), (2, machine(Kind::Grinder))];
    let serving = Serving::rtu(units, Line { baud: 115_200, paced: false }, SharedFaultPlan::none()).unwrap();
    let mut port = open(&serving);
    let answer = rtu_frame(1, &[3, 2, 0x52, 0x47]);
    for silent in [rtu_frame(9, &READ), rtu_frame(0, &READ), rtu_frame(0, &[16, 0, 36, 0, 1, 2, 0, 7])] {
        port.write_all(&silent).await.unwrap();
        port.write_all(&rtu_frame(1, &READ)).await.unwrap();
        assert_eq!(reply(&mut port, answer.len()).await, answer, "after {silent:?}");
    }
    assert_eq!(serving.machine(1).unwrap().with(|m| m.read(36, 1)), Ok(vec![0]), "a broadcast does nothing");
    for (pdu, exception) in [(&[4u8, 0, 0, 0, 1][..], 1), (&[43, 14, 1, 0], 1), (&[3, 0, 39, 0, 1], 2)] {
        port.write_all(&rtu_frame(2, pdu)).await.unwrap();
        let expected = rtu_frame(2, &[pdu[0] | 0x80, exception]);
        assert_eq!(reply(&mut port, expected.len()).await, expected, "{pdu:?}");
    }
}

#[tokio::test]
async fn rtu_resyncs_after_noise() {
    let serving =
        Serving::rtu(vec![(1, machine(Kind::Cmm))], Line { baud: 115_200, paced: false }, SharedFaultPlan::none())
            .unwrap();
    let mut port = open(&serving);
    let (ask, answer) = (rtu_frame(1, &READ), rtu_frame(1, &[3, 2, 0x52, 0x47]));
    let mut flipped = ask.clone();
    flipped[7] ^= 1;
    for noise in [vec![0x55; 30], flipped, ask[..5].to_vec(), vec![0xFF], vec![1, 16, 0, 40, 0, 20, 40, 1]] {
        port.write_all(&noise).await.unwrap();
        // Asks again and again, as a client does, until the line has fallen silent once.
        let tries = patiently(async {
            for tries in 1.. {
                port.write_all(&ask).await.unwrap();
                let mut bytes = vec![0; answer.len()];
                let read = tokio::time::timeout(Duration::from_millis(400), port.read_exact(&mut bytes)).await;
                if read.is_ok() {
                    assert_eq!(bytes, answer);
                    return tries;
                }
            }
            unreachable!()
        })
        .await;
        assert!(tries > 0, "{noise:?}");
    }
}

#[tokio::test]
async fn rtu_wire_faults_alter_reply() {
    let good = rtu_frame(1, &[3, 2, 0x52, 0x47]);
    let mut flipped = good.clone();
    flipped[5] ^= 1;
    let cases = [
        (Fault::FlipCrc, flipped),
        (Fault::FlipData, rtu_frame(1, &[3, 2, 0x52, 0x57])),
        (Fault::DropReply, vec![]),
        (Fault::DuplicateReply, good.repeat(2)),
        (Fault::WrongUnit, rtu_frame(0x41, &[3, 2, 0x52, 0x47])),
        (Fault::Split(Duration::from_micros(10)), good.clone()),
        (Fault::Exception(6), rtu_frame(1, &[0x83, 6])),
        (Fault::Noise(vec![0; 3]), [&[0; 3][..], &good].concat()),
        (Fault::Fewer, rtu_frame(1, &[3, 0])),
        (Fault::Truncate(3), good[..3].to_vec()),
    ];
    for (fault, mut expected) in cases {
        let faults = SharedFaultPlan::from(FaultPlan::new(0).once(When::Any, fault.clone()));
        let serving =
            Serving::rtu(vec![(1, machine(Kind::Cmm))], Line { baud: 115_200, paced: false }, faults).unwrap();
        let mut port = open(&serving);
        port.write_all(&rtu_frame(1, &READ)).await.unwrap();
        port.write_all(&rtu_frame(1, &READ)).await.unwrap();
        expected.extend(&good);
        assert_eq!(reply(&mut port, expected.len()).await, expected, "{fault:?}");
    }
}

#[cfg(unix)]
#[tokio::test]
async fn pty_is_transparent_and_persistent() {
    let (mut pty, path) = pty::open().unwrap();
    let every: Vec<u8> = (0..=255).collect();
    for _ in 0..3 {
        let path = path.to_str().unwrap();
        let mut client = tokio_serial::SerialStream::open(&tokio_serial::new(path, 9600)).unwrap();
        client.write_all(&every).await.unwrap();
        assert_eq!(reply(&mut pty, 256).await, every);
        pty.write_all(&every).await.unwrap();
        assert_eq!(reply(&mut client, 256).await, every);
    }
}

#[cfg(unix)]
#[tokio::test]
async fn pty_symlink_at_cell_file_path() {
    let folder = tempfile::tempdir().unwrap();
    let name = folder.path().join("cmm");
    // A link that an older simulator left behind is replaced; a file of somebody else is not.
    std::os::unix::fs::symlink("/dev/pts/none", &name).unwrap();
    let mut serving =
        Serving::rtu(vec![(1, machine(Kind::Cmm))], Line { baud: 9600, paced: false }, SharedFaultPlan::none())
            .unwrap();
    serving.link(&name).unwrap();
    assert_eq!(serving.path(), Some(name.as_path()));
    let mut port = open(&serving);
    port.write_all(&rtu_frame(1, &READ)).await.unwrap();
    assert_eq!(reply(&mut port, 7).await, rtu_frame(1, &[3, 2, 0x52, 0x47]));
    serving.stop().await;
    assert!(std::fs::symlink_metadata(&name).is_err(), "the link goes with the line");
    std::fs::write(&name, "mine").unwrap();
    let mut serving =
        Serving::rtu(vec![(1, machine(Kind::Cmm))], Line { baud: 9600, paced: false }, SharedFaultPlan::none())
            .unwrap();
    assert!(serving.link(&name).is_err());
    drop(serving);
    assert_eq!(std::fs::read_to_string(&name).unwrap(), "mine");
}

#[tokio::test]
async fn random_pdu_never_breaks_server() {
    use rand::RngExt;
    let seed = 4242;
    let mut rng = regrind_sim::rng(seed);
    let serving = serve().await;
    let mut raw = TcpStream::connect(serving.local_addr().unwrap()).await.unwrap();
    for n in 0..2000u16 {
        let mut pdu: Vec<u8> = (0..rng.random_range(1..254)).map(|_| rng.random()).collect();
        pdu[0] = [3, 6, 16, pdu[0]][rng.random_range(0..4)];
        ask(&mut raw, n, 1, &pdu).await;
        let head = reply(&mut raw, 8).await;
        assert_eq!((&head[..2], head[6], head[7] & 0x7F), (&n.to_be_bytes()[..], 1, pdu[0] & 0x7F), "seed {seed}");
        reply(&mut raw, usize::from(u16::from_be_bytes([head[4], head[5]])) - 2).await;
    }
    assert_eq!(serving.machine(1).unwrap().with(|m| m.state()), State::Idle, "seed {seed}");
}
