//! The handshake, register by register, without a wire and without a clock.

use std::time::Duration;

use crate::counter::{Counter, digest, payloads};
use crate::desk::Desk;
use regrind_sim::body::Kind;
use regrind_sim::command::{Answer, Command, CommandFrame, Mode, State, interlock};
use regrind_sim::event_log::{BeatStatistics, HandshakeEvent};
use regrind_sim::options::{MachineOptions, RegisterLayout};
use regrind_sim::register_encoding::{WordOrder, bytes_of, registers_of, turn_payload};
use regrind_sim::registers::Exception;

const MS: Duration = Duration::from_millis(1);
const S: Duration = Duration::from_secs(1);

/// All states, in the order of their numbers.
const ALL_STATES: [State; 10] = [
    State::Idle,
    State::Prepared,
    State::Execute,
    State::Holding,
    State::Held,
    State::Stopping,
    State::Complete,
    State::Aborting,
    State::Aborted,
    State::Faulted,
];

/// Something that happens at a desk.
type ClientAction = fn(&mut Desk);

impl Desk {
    fn at(body: Counter, options: MachineOptions) -> Self {
        let digest = digest(body.kind);
        Self::with_body(body, options, digest)
    }

    fn new(kind: Kind) -> Self {
        Self::at(Counter::new(kind, 5.0), MachineOptions::default())
    }

    /// A machine that was claimed and has its payloads.
    fn ready(kind: Kind) -> Self {
        let mut desk = Self::new(kind);
        desk.get_ready();
        desk
    }

    fn get_ready(&mut self) {
        assert_eq!(self.command(Command::Claim), Answer::Accepted as u16);
        self.get_payloads();
    }

    /// Returns the command that a client with jobs to run would send in the present state.
    fn sensible(&mut self) -> Command {
        match self.machine.state() {
            _ if self.status().owner == 0 => Command::Claim,
            State::Idle => Command::Prepare,
            State::Prepared if self.status().token == 0 => Command::Stop,
            State::Prepared => Command::Start,
            State::Held => Command::Resume,
            State::Complete => Command::Acknowledge,
            State::Aborted | State::Faulted => Command::Clear,
            _ => Command::Claim,
        }
    }

    /// Sends the payloads if the machine would take them now.
    fn get_payloads(&mut self) {
        if !matches!(self.machine.state(), State::Execute | State::Holding | State::Held) {
            for (kind, bytes, identity) in payloads(self.kind) {
                self.send(kind, &bytes, identity);
            }
        }
    }

    /// Brings a fresh machine into a state, where it stays.
    fn in_state(state: State) -> Self {
        let mut desk = Self::at(
            Counter::new(Kind::Grinder, 5.0),
            MachineOptions { acting: Duration::from_secs(10), ..MachineOptions::default() },
        );
        desk.get_ready();
        let long = 10 * S;
        let mut go = |commands: &[Command], then: Duration| {
            commands.iter().for_each(|command| desk.accept(*command));
            desk.wait(then);
        };
        use Command::*;
        match state {
            State::Idle => {}
            State::Prepared => go(&[Prepare], Duration::ZERO),
            State::Execute => go(&[Prepare, Start], S),
            State::Holding => go(&[Prepare, Start, Hold], S),
            State::Held => go(&[Prepare, Start, Hold], long),
            State::Stopping => go(&[Prepare, Start, Stop], S),
            State::Complete => go(&[Prepare, Start], 6 * S),
            State::Aborting => go(&[Prepare, Start, Abort], S),
            State::Aborted => go(&[Prepare, Start, Abort], long),
            State::Faulted => {
                go(&[Prepare, Start], S);
                desk.machine.fail(5);
            }
        }
        assert_eq!(desk.machine.state(), state);
        desk
    }
}

#[test]
fn identity_block_in_both_word_orders() {
    for (order, kind) in [(WordOrder::Big, Kind::Cmm), (WordOrder::Little, Kind::Grinder)] {
        let options = MachineOptions { word_order: order, lost_after_ms: 1200, ..MachineOptions::default() };
        let mut desk = Desk::at(Counter::new(kind, 1.0), options);
        let w = desk.read(0, 32);
        assert_eq!(w[..4], [0x5247, 0x4431, 2, kind as u16]);
        let constants: &[u16] = match order {
            WordOrder::Big => &[0x1234, 0x5678, 0xBE90, 0xC6F7, 0xA0B5, 0xED8D],
            WordOrder::Little => &[0x5678, 0x1234, 0xED8D, 0xA0B5, 0xC6F7, 0xBE90],
        };
        assert_eq!(&w[4..10], constants);
        assert_eq!(desk.u32(&w, 10), 77);
        assert_eq!(w[12..16], [1, 1, 0, 1200], "SIMULATION, millimetres, silence");
        assert_eq!(bytes_of(&w[16..]), b"COUNTER 7 of the simulated cell,");
    }
}

#[test]
fn sync_words_answered_by_complements() {
    let mut desk = Desk::new(Kind::Cmm);
    desk.machine.write(32, &[0xABCD, 0x0001]).unwrap();
    assert_eq!(desk.read(32, 4), [0xABCD, 0x0001, 0x5432, 0xFFFE]);
}

#[test]
fn registers_refuse_unmapped_address() {
    let mut machine = Desk::new(Kind::Cmm).machine;
    for (address, count) in [(39, 1), (36, 4), (60, 4), (112, 1), (30, 10), (110, 3), (500, 100), (578, 1), (65535, 2)]
    {
        assert_eq!(machine.read(address, count), Err(Exception::Address), "read {count} at {address}");
    }
    for count in [0, 126] {
        assert_eq!(machine.read(0, count), Err(Exception::Value));
    }
    for (address, count) in [(0, 32), (0, 39), (64, 48), (120, 72), (200, 125), (350, 12), (400, 56), (460, 118)] {
        assert_eq!(machine.read(address, count).unwrap().len(), usize::from(count), "read {count} at {address}");
    }
    for (address, count) in [(0, 1), (31, 2), (32, 3), (34, 1), (36, 4), (39, 1), (40, 21), (59, 2), (64, 1), (120, 1)]
    {
        assert_eq!(machine.write(address, &vec![0; count]), Err(Exception::Address), "write {count} at {address}");
    }
    for (address, count) in [(200, 25), (344, 1), (350, 1), (400, 1), (460, 3), (462, 1)] {
        assert_eq!(machine.write(address, &vec![0; count]), Err(Exception::Address), "write {count} at {address}");
    }
    for count in [0, 124] {
        assert_eq!(machine.write(40, &vec![0; count]), Err(Exception::Value));
    }
}

#[test]
fn register_layout_relocates_blocks() {
    let layout = RegisterLayout { identity: 1000, status: 2000, ..RegisterLayout::default() };
    let mut desk = Desk::at(Counter::new(Kind::Cmm, 1.0), MachineOptions { layout, ..MachineOptions::default() });
    assert_eq!(desk.read(1000, 1), [0x5247]);
    assert_eq!(desk.read(2001, 1), [1]);
    assert_eq!(desk.machine.read(0, 1), Err(Exception::Address));
}

#[test]
fn whole_job_per_kind_and_word_order() {
    for kind in [Kind::Cmm, Kind::Grinder] {
        for order in [WordOrder::Big, WordOrder::Little] {
            let body = Counter::new(kind, 5.0);
            let (asked, got) = (body.calls.clone(), body.got.clone());
            let options = MachineOptions { word_order: order, speed: 2.0, ..MachineOptions::default() };
            let mut desk = Desk::at(body, options);
            desk.get_ready();
            run_a_job(&mut desk);
            assert_eq!(*asked.lock().unwrap(), ["begin", "outcome 1"]);
            let (number, mut sent, identity) = payloads(kind).swap_remove(0);
            if order == WordOrder::Little {
                turn_payload(number, 1, &mut sent);
            }
            let got = got.lock().unwrap();
            let arrived = if kind == Kind::Cmm { &got.plan } else { &got.map }.as_ref().unwrap();
            assert!(arrived.bytes == sent && arrived.identity == identity, "{kind:?} {order:?}");
        }
    }
}

fn run_a_job(desk: &mut Desk) {
    let digest = digest(desk.kind);
    let slots = desk.read(120, 72);
    for (kind, bytes, identity) in payloads(desk.kind) {
        let slot = &slots[24 * usize::from(kind - 1)..][..24];
        assert_eq!((slot[0], slot[1]), (kind, 1));
        assert_eq!(desk.u32(slot, 2) as usize, bytes.len());
        assert_eq!(desk.u32(slot, 4), crc32fast::hash(&bytes));
        assert_eq!(bytes_of(&slot[8..]), identity);
    }
    desk.accept(Command::Prepare);
    let prepared = desk.status();
    assert_eq!((prepared.state, prepared.job, prepared.cycle, prepared.digest), (2, 41, 2, digest));
    assert!(prepared.token != 0 && prepared.progress == [0, 50] && prepared.begun_by == 0, "{prepared:?}");
    desk.accept(Command::Start);
    let (start, running) = (desk.sequence, desk.status());
    assert_eq!((running.state, running.token, running.begun_by, running.last_begun), (3, 0, start, (41, 2)));
    desk.wait(S);
    assert_eq!(desk.status().progress, [20, 50], "two seconds of its own in a real one");
    desk.wait(2 * S);
    let complete = desk.status();
    assert_eq!((complete.state, complete.done, complete.result, complete.begun_by), (7, start, 1, start));
    check_outbox(desk, start);
    desk.accept(Command::Acknowledge);
    let idle = desk.status();
    assert_eq!((idle.state, idle.done, idle.result, idle.job, idle.token), (1, 0, 0, 0, 0));
    assert_eq!((idle.begun_by, idle.last_begun, idle.temperature), (start, (41, 2), -150));
    assert_eq!(desk.read(400, 1), [0], "the outbox is empty");
}

fn check_outbox(desk: &mut Desk, start: u32) {
    let (header, mut bytes) = desk.outbox();
    let expected: (u16, u16, Vec<u8>, u32) = match desk.kind {
        Kind::Cmm => (4, 2, (0..620).map(|i| i as u8).collect(), 31),
        Kind::Grinder => (5, 1, (100..164).collect(), 1),
    };
    if desk.order == WordOrder::Little {
        turn_payload(header[0], header[1], &mut bytes);
    }
    assert_eq!(
        (header[0], header[1], &bytes, desk.u32(&header, 10)),
        (expected.0, expected.1, &expected.2, expected.3)
    );
    assert_eq!((desk.u32(&header, 6), header[8], header[9]), (41, 2, u16::from(desk.kind == Kind::Cmm)));
    let double = |at: usize| desk.order.to_f64(header[at..at + 4].try_into().unwrap());
    assert_eq!([double(12), double(16), double(20)], [1.5, 1e-5, 20.25]);
    assert!((double(24) - 5.0).abs() < 0.1, "{}", double(24));
    assert_eq!((header[28], desk.u32(&header, 46)), (1, start));
    assert_eq!(bytes_of(&header[30..46]), payloads(desk.kind)[0].2);
    let beyond = desk.order.from_u32(99);
    desk.machine.write(460, &beyond).unwrap();
    let page = desk.read(462, 4);
    assert_eq!((desk.u32(&page, 0), page[2]), (99, 0), "a page beyond the last has no data");
}

/// Checks the answer to each command in each state, and the state immediately after it.
/// Each row is a command with its allowed transitions.
#[test]
fn commands_answer_by_state_table() {
    use Command::*;
    use State::*;
    let allowed: [(Command, &[(State, State)]); 10] = [
        (Claim, &ALL_STATES.map(|state| (state, state))),
        (Prepare, &[(Idle, Prepared)]),
        (Start, &[(Prepared, Execute)]),
        (Hold, &[(Execute, Holding)]),
        (Resume, &[(Held, Execute)]),
        (Stop, &[(Prepared, Idle), (Execute, Stopping), (Holding, Stopping), (Held, Stopping)]),
        (Abort, &ALL_STATES.map(|state| (state, if state == Aborted { Aborted } else { Aborting }))),
        (Clear, &[(Aborted, Idle), (Faulted, Idle)]),
        (Acknowledge, &[(Complete, Idle)]),
        (
            Release,
            &[Idle, Prepared, Holding, Held, Stopping, Complete, Aborting, Aborted, Faulted]
                .map(|state| (state, state)),
        ),
    ];
    for (command, leads) in allowed {
        for state in ALL_STATES {
            let mut desk = Desk::in_state(state);
            let answer = desk.command(command);
            let to = leads.iter().find(|(from, _)| *from == state).map(|(_, to)| *to);
            let expected = if to.is_some() { Answer::Accepted } else { Answer::NotAllowed };
            assert_eq!(answer, expected as u16, "{command:?} in {state:?}");
            assert_eq!(desk.machine.state(), to.unwrap_or(state), "{command:?} in {state:?}");
            assert_eq!(command.is_allowed_in(state), to.is_some(), "{command:?} in {state:?}");
        }
    }
}

#[test]
fn non_owner_may_only_abort() {
    for state in ALL_STATES {
        for command in Command::ALL {
            for (owner, epoch) in [(8, 1), (9, 2), (9, 0)] {
                let mut desk = Desk::in_state(state);
                (desk.owner, desk.epoch) = (owner, epoch);
                // Its owner may claim it anew with a higher epoch.
                let may = command == Command::Abort || (command == Command::Claim && (owner, epoch) == (9, 2));
                let expected = if may { Answer::Accepted } else { Answer::NotOwner };
                assert_eq!(desk.command(command), expected as u16, "{command:?} in {state:?} of {owner}, {epoch}");
                if !may {
                    assert_eq!(desk.machine.state(), state);
                }
            }
        }
    }
}

#[test]
fn unknown_command_answer() {
    for command in [0, 11, 0xFFFF] {
        let mut desk = Desk::ready(Kind::Cmm);
        let frame = CommandFrame { command, ..desk.frame(Command::Prepare) };
        assert_eq!(desk.put(frame), Answer::Unknown as u16);
    }
}

#[test]
fn repeated_command_is_idempotent() {
    let mut desk = Desk::ready(Kind::Grinder);
    desk.accept(Command::Prepare);
    let frame = desk.frame(Command::Start);
    desk.put(frame);
    desk.wait(S);
    let before = desk.status();
    for _ in 0..5 {
        desk.put(frame);
    }
    assert_eq!(desk.status(), before);
    desk.wait(5 * S);
    desk.accept(Command::Acknowledge);
    desk.put(frame);
    assert_eq!(desk.machine.state(), State::Idle, "an old frame is not looked at");
    assert_eq!(desk.machine.began(), [(frame.sequence, 41, 2)]);
    let repeats = desk.machine.log().iter().filter(|s| matches!(s.event, HandshakeEvent::Repeated { .. })).count();
    assert_eq!(repeats, 5);
    assert!(
        matches!(desk.machine.log().last().unwrap().event, HandshakeEvent::Old { sequence } if sequence == frame.sequence)
    );
}

#[test]
fn corrupt_command_frame_ignored() {
    let mut desk = Desk::ready(Kind::Cmm);
    let before = desk.status();
    let sound = desk.frame(Command::Prepare);
    for at in 0..20 {
        let mut words = sound.registers(WordOrder::Big);
        words[at] ^= 0x0100;
        desk.machine.write(40, &words).unwrap();
        // Register 17 is nobody's: a frame with it set is sound, so it comes last.
        if at != 17 {
            assert_eq!(desk.status(), before, "register {at}");
        } else {
            assert_eq!(desk.machine.state(), State::Prepared);
            desk = Desk::ready(Kind::Cmm);
        }
    }
    let zero = CommandFrame { sequence: 0, ..sound };
    desk.put(zero);
    assert_eq!(desk.status(), before);
}

#[test]
fn command_acts_on_last_register_write() {
    let mut desk = Desk::ready(Kind::Cmm);
    let words = desk.frame(Command::Prepare).registers(WordOrder::Big);
    for (at, word) in words.iter().enumerate() {
        assert_eq!(desk.machine.state(), State::Idle);
        desk.machine.write(40 + at as u16, &[*word]).unwrap();
    }
    assert_eq!(desk.machine.state(), State::Prepared);
}

#[test]
fn start_requires_token_job_and_digest() {
    let mut desk = Desk::ready(Kind::Cmm);
    desk.accept(Command::Prepare);
    let good = desk.frame(Command::Start);
    let wrong = [
        (CommandFrame { token: good.token ^ 1, ..good }, Answer::Token),
        (CommandFrame { token: 0, ..good }, Answer::Token),
        (CommandFrame { job: 42, ..good }, Answer::Different),
        (CommandFrame { cycle: 3, ..good }, Answer::Different),
        (CommandFrame { digest: good.digest ^ 1, ..good }, Answer::Different),
    ];
    for (frame, answer) in wrong {
        desk.sequence += 1;
        assert_eq!(desk.put(CommandFrame { sequence: desk.sequence, ..frame }), answer as u16, "{frame:?}");
        assert_eq!(desk.machine.state(), State::Prepared);
    }
    desk.accept(Command::Start);
    assert_eq!(desk.command(Command::Start), Answer::NotAllowed as u16, "a second START");
    assert_eq!(desk.machine.began().len(), 1);
}

#[test]
fn start_refuses_changed_payload() {
    let mut desk = Desk::ready(Kind::Cmm);
    desk.accept(Command::Prepare);
    desk.send(1, &[1; 64], [99; 32]);
    assert_eq!(desk.command(Command::Start), Answer::Different as u16);
}

#[test]
fn token_invalidated_by_events() {
    let kills: [(&str, ClientAction); 6] = [
        ("HOLD", |desk| assert_eq!(desk.command(Command::Hold), Answer::NotAllowed as u16)),
        ("CLAIM", |desk| desk.accept(Command::Claim)),
        ("ABORT", |desk| desk.accept(Command::Abort)),
        ("an interlock", |desk| desk.machine.open_interlocks(interlock::GUARDS)),
        ("the key", |desk| desk.machine.set_mode(Mode::Manual)),
        ("a reboot", |desk| desk.machine.reboot()),
    ];
    for (what, kill) in kills {
        let mut desk = Desk::ready(Kind::Grinder);
        desk.accept(Command::Prepare);
        let mut start = desk.frame(Command::Start);
        kill(&mut desk);
        desk.machine.open_interlocks(0);
        desk.machine.set_mode(Mode::Automatic);
        assert_eq!(desk.status().token, 0, "{what}");
        desk.sequence += 1;
        start.sequence = desk.sequence;
        desk.put(start);
        desk.wait(S);
        assert_eq!(desk.machine.began(), [], "{what}");
    }
}

#[test]
fn token_expires_after_30_s() {
    let mut desk = Desk::ready(Kind::Grinder);
    desk.accept(Command::Prepare);
    desk.wait(30 * S - 20 * MS);
    assert_eq!(desk.machine.state(), State::Prepared);
    let dead = desk.frame(Command::Start);
    desk.wait(20 * MS);
    let status = desk.status();
    assert_eq!((status.state, status.token, status.job), (1, 0, 0));
    assert_eq!(desk.put(dead), Answer::NotAllowed as u16);
    desk.accept(Command::Prepare);
    assert_ne!(desk.status().token, dead.token, "a token is not given twice");
    desk.wait(30 * S - 20 * MS);
    desk.accept(Command::Start);
}

#[test]
fn job_and_cycle_start_once() {
    let ends: [(&str, ClientAction); 4] = [
        ("complete", |desk| {
            desk.wait(6 * S);
            desk.accept(Command::Acknowledge);
        }),
        ("stopped", |desk| {
            desk.accept(Command::Stop);
            desk.wait(S);
            desk.accept(Command::Acknowledge);
        }),
        ("aborted", |desk| {
            desk.accept(Command::Abort);
            desk.wait(S);
            desk.accept(Command::Clear);
        }),
        ("rebooted", |desk| {
            desk.machine.reboot();
            desk.get_ready();
            desk.accept(Command::Clear);
        }),
    ];
    for (what, end) in ends {
        let mut desk = Desk::ready(Kind::Cmm);
        desk.accept(Command::Prepare);
        desk.accept(Command::Start);
        desk.wait(S);
        end(&mut desk);
        assert_eq!(desk.status().last_begun, (41, 2), "{what}");
        desk.accept(Command::Prepare);
        assert_eq!(desk.command(Command::Start), Answer::Begun as u16, "{what}");
        assert_eq!(desk.machine.began().len(), 1, "{what}");
    }
    let options = MachineOptions { last_begun: Some((41, 2)), ..MachineOptions::default() };
    let mut desk = Desk::at(Counter::new(Kind::Cmm, 5.0), options);
    desk.get_ready();
    desk.accept(Command::Prepare);
    assert_eq!(desk.command(Command::Start), Answer::Begun as u16, "before it was switched on");
}

#[test]
fn prepare_answers_each_refusal() {
    let mut desk = Desk::new(Kind::Grinder);
    desk.accept(Command::Claim);
    assert_eq!(desk.command(Command::Prepare), Answer::Payload as u16, "nothing in force");
    let (kind, bytes, identity) = payloads(Kind::Grinder).swap_remove(0);
    desk.send(kind, &bytes, identity);
    assert_eq!(desk.command(Command::Prepare), Answer::Payload as u16, "no pass in force");
    desk.get_ready();
    let prepare = desk.frame(Command::Prepare);
    assert_eq!(desk.put(CommandFrame { digest: 1, ..prepare }), Answer::Different as u16);
    for (change, answer) in [(666, Answer::Limits), (0, Answer::Different)] {
        let frame = desk.frame(Command::Prepare);
        assert_eq!(desk.put(CommandFrame { job: change, ..frame }), answer as u16, "job {change}");
    }
    for bit in [interlock::GUARDS, interlock::CLEAR, interlock::CLAMPED, interlock::SUPPLIES] {
        desk.machine.open_interlocks(bit);
        assert_eq!(desk.status().interlocks, 15 & !bit);
        assert_eq!(desk.command(Command::Prepare), Answer::Interlock as u16, "interlock {bit}");
    }
    desk.machine.open_interlocks(0);
    desk.machine.set_mode(Mode::Manual);
    assert_eq!(desk.status().mode, 2);
    assert_eq!(desk.command(Command::Prepare), Answer::Interlock as u16, "manual");
    desk.machine.set_mode(Mode::Automatic);
    desk.accept(Command::Prepare);
}

#[test]
fn hold_resume_preserves_progress() {
    let mut desk = Desk::ready(Kind::Grinder);
    desk.accept(Command::Prepare);
    desk.accept(Command::Start);
    let start = desk.sequence;
    desk.wait(2 * S);
    desk.accept(Command::Hold);
    assert_eq!(desk.machine.state(), State::Holding);
    desk.wait(S);
    assert_eq!(desk.machine.state(), State::Held);
    let held = desk.status();
    desk.wait(60 * S);
    assert_eq!(desk.status().progress, held.progress);
    desk.machine.open_interlocks(interlock::GUARDS);
    assert_eq!(desk.command(Command::Resume), Answer::Interlock as u16);
    desk.machine.open_interlocks(0);
    desk.accept(Command::Resume);
    desk.wait(4 * S);
    let done = desk.status();
    assert_eq!((done.state, done.done, done.result), (7, start, 1));
}

#[test]
fn stop_leaves_result_abort_none() {
    for state in [State::Execute, State::Holding, State::Held] {
        let mut desk = Desk::in_state(state);
        let start = desk.status().begun_by;
        desk.accept(Command::Stop);
        desk.wait(11 * S);
        let status = desk.status();
        assert_eq!((status.state, status.done, status.result), (7, start, 2), "{state:?}");
        assert_eq!(desk.outbox().1.len(), 64);
    }
    for state in [State::Execute, State::Holding, State::Held, State::Stopping] {
        let mut desk = Desk::in_state(state);
        let start = desk.status().begun_by;
        desk.accept(Command::Abort);
        desk.wait(11 * S);
        let status = desk.status();
        assert_eq!((status.state, status.done, status.result), (9, start, 3), "{state:?}");
        assert_eq!(desk.read(400, 1), [0], "{state:?}");
        desk.accept(Command::Clear);
        assert_eq!(desk.machine.state(), State::Idle);
    }
    for state in [State::Idle, State::Prepared] {
        let mut desk = Desk::in_state(state);
        desk.accept(Command::Abort);
        desk.wait(11 * S);
        let status = desk.status();
        assert_eq!((status.state, status.done, status.result, status.begun_by), (9, 0, 0, 0), "{state:?}");
    }
}

#[test]
fn acknowledge_must_name_the_job() {
    let mut desk = Desk::in_state(State::Complete);
    let good = desk.frame(Command::Acknowledge);
    assert_eq!(desk.put(CommandFrame { argument: good.argument + 1, ..good }), Answer::Argument as u16);
    assert_eq!(desk.machine.state(), State::Complete);
    desk.accept(Command::Acknowledge);
}

#[test]
fn silent_client_causes_hold() {
    let mut desk = Desk::in_state(State::Execute);
    desk.machine.set_speed(0.1);
    desk.wait(10 * S);
    assert_eq!(desk.machine.state(), State::Execute, "a client that beats is not silent");
    desk.machine.tick(2700 * MS);
    assert_eq!(desk.machine.state(), State::Execute);
    desk.machine.tick(400 * MS);
    let status = desk.status();
    assert_eq!((status.state, status.fault), (4, 20));
    desk.machine.tick(20 * S);
    assert_eq!(desk.status().state, 5);
    desk.accept(Command::Resume);
    let status = desk.status();
    assert_eq!((status.state, status.fault), (3, 0));
    // The same number again is not a beat.
    for _ in 0..40 {
        let beat = desk.beat;
        desk.write_beat(beat, 9);
        desk.machine.tick(100 * MS);
    }
    assert_eq!(desk.status().state, 4);
}

#[test]
fn non_owner_heartbeat_ignored() {
    for order in [WordOrder::Big, WordOrder::Little] {
        let options = MachineOptions { word_order: order, ..MachineOptions::default() };
        let mut desk = Desk::at(Counter::new(Kind::Cmm, 5.0), options);
        desk.get_ready();
        desk.accept(Command::Prepare);
        desk.accept(Command::Start);
        desk.machine.set_speed(0.01);
        desk.wait(10 * S);
        assert_eq!((desk.machine.state(), desk.read(93, 1)), (State::Execute, vec![40]), "its owner beats");
        for stranger in 0..28 {
            desk.write_beat(1000 + stranger, 10);
            desk.machine.tick(100 * MS);
        }
        let status = desk.status();
        assert_eq!((status.state, status.fault, status.owner), (4, 20, 9), "{order:?}");
        assert_eq!(desk.read(93, 1), [40], "the echo is of the beats that count");
        // Whom the stranger's beats kept nothing from can claim.
        desk.owner = 11;
        desk.accept(Command::Claim);
        // A beat without an owner, or half a beat, is none.
        for half in [&[5][..], &[5, 0]] {
            assert_eq!(desk.machine.write(36, half), Err(Exception::Value));
        }
        desk.write_beat(7, 0);
        desk.machine.tick(100 * MS);
        assert_eq!(desk.read(93, 1), [40]);
    }
}

#[test]
fn heartbeat_timeout_only_in_motion() {
    for state in ALL_STATES.into_iter().filter(|s| *s != State::Execute && *s != State::Prepared) {
        let mut desk = Desk::in_state(state);
        desk.machine.tick(9 * S / 2);
        assert_ne!(desk.status().fault, 20, "{state:?}");
    }
}

#[test]
fn claim_takeover_from_silent_client() {
    let mut desk = Desk::ready(Kind::Cmm);
    desk.accept(Command::Prepare);
    desk.wait(10 * S);
    (desk.owner, desk.epoch) = (10, 1);
    assert_eq!(desk.command(Command::Claim), Answer::NotOwner as u16);
    assert_eq!(desk.status().owner, 9);
    desk.machine.tick(3100 * MS);
    desk.sequence = 3;
    desk.accept(Command::Claim);
    let status = desk.status();
    assert_eq!(
        (status.owner, status.epoch, status.state, status.token),
        (10, 1, 2, 0),
        "the state stays, the token dies"
    );
    assert_eq!(status.acknowledged, 4, "the sequence counts on from the claim");
    desk.accept(Command::Stop);
    desk.accept(Command::Release);
    assert_eq!(desk.status().owner, 0);
    (desk.owner, desk.epoch) = (9, 1);
    assert_eq!(desk.command(Command::Prepare), Answer::NotOwner as u16);
    desk.accept(Command::Claim);
    desk.owner = 0;
    assert_eq!(desk.command(Command::Claim), Answer::NotOwner as u16, "0 is nobody");
}

#[test]
fn interlock_open_in_motion_faults() {
    for (bit, fault) in [(interlock::GUARDS, 1), (interlock::CLAMPED, 30), (interlock::SUPPLIES, 3)] {
        let mut desk = Desk::in_state(State::Execute);
        let start = desk.status().begun_by;
        desk.machine.open_interlocks(bit);
        desk.wait(100 * MS);
        let status = desk.status();
        assert_eq!((status.state, status.fault, status.done, status.result), (10, fault, start, 4));
        desk.machine.open_interlocks(0);
        desk.accept(Command::Clear);
        assert_eq!((desk.status().state, desk.status().fault), (1, 0));
    }
    let mut desk = Desk::in_state(State::Execute);
    desk.machine.open_interlocks(interlock::CLEAR);
    desk.wait(100 * MS);
    assert_eq!(desk.machine.state(), State::Execute, "a machine that works is not clear of the part");
    desk.machine.set_mode(Mode::Manual);
    desk.wait(11 * S);
    assert_eq!(desk.machine.state(), State::Held, "the key holds it");
    assert_eq!(desk.command(Command::Resume), Answer::Interlock as u16);
}

#[test]
fn physics_fault_ends_job() {
    let body = Counter::new(Kind::Cmm, 5.0);
    let (fault, asked) = (body.fault.clone(), body.calls.clone());
    let mut desk = Desk::at(body, MachineOptions::default());
    desk.get_ready();
    desk.accept(Command::Prepare);
    desk.accept(Command::Start);
    desk.wait(S);
    *fault.lock().unwrap() = 2;
    desk.wait(S);
    let status = desk.status();
    assert_eq!((status.state, status.fault, status.result, status.done), (10, 2, 4, desk.sequence));
    assert_eq!(*asked.lock().unwrap(), ["begin", "retract", "outcome 4"]);
}

#[test]
fn inbox_accepts_repeat_refuses_skip() {
    let mut desk = Desk::new(Kind::Cmm);
    let bytes: Vec<u8> = (0..501).map(|i| i as u8).collect();
    let registers = registers_of(&bytes);
    let header = desk.header(1, &bytes, crc32fast::hash(&bytes), [5; 32]);
    let pages: Vec<Vec<u16>> =
        registers.chunks(112).enumerate().map(|(page, data)| desk.page(page as u32, data)).collect();
    assert_eq!((pages.len(), pages[2].len()), (3, 8 + 27));
    assert_eq!(desk.machine.write(224, &pages[0]), Err(Exception::Value), "no header yet");
    desk.machine.write(200, &header).unwrap();
    let state = |desk: &mut Desk| {
        let w = desk.read(350, 12);
        (w[0], w[1], desk.u32(&w, 2), desk.u32(&w, 4), desk.u32(&w, 6), w[8])
    };
    assert_eq!(state(&mut desk), (1, 1, 0, 0, 0, 0));
    assert_eq!(desk.machine.write(224, &pages[1]), Err(Exception::Value), "out of turn");
    desk.machine.write(224, &pages[0]).unwrap();
    desk.machine.write(224, &pages[0]).unwrap();
    assert_eq!(state(&mut desk), (1, 1, 1, 224, 0, 0));
    assert_eq!(desk.machine.write(224, &pages[2]), Err(Exception::Value), "out of turn");
    let short = desk.page(1, &registers[112..200]);
    assert_eq!(desk.machine.write(224, &short), Err(Exception::Value), "too short");
    assert_eq!(desk.machine.write(225, &pages[1][1..]), Err(Exception::Value), "not from the first register");
    assert_eq!(desk.machine.write(224, &pages[1][..8]), Err(Exception::Value), "no data");
    desk.machine.write(224, &pages[1]).unwrap();
    assert_eq!(desk.read(120, 2), [1, 0], "not yet in force");
    desk.machine.write(224, &pages[2]).unwrap();
    desk.machine.write(224, &pages[2]).unwrap();
    assert_eq!(state(&mut desk), (1, 2, 3, 501, crc32fast::hash(&bytes), 0));
    assert_eq!(desk.read(120, 2), [1, 1]);
    let beyond = desk.page(3, &registers[..112]);
    assert_eq!(desk.machine.write(224, &beyond), Err(Exception::Value), "beyond the last");
}

#[test]
fn payload_in_force_needs_crc_and_part() {
    let mut desk = Desk::ready(Kind::Cmm);
    let before = desk.read(120, 72);
    let header = desk.header(1, &[1; 100], 123, [7; 32]);
    desk.machine.write(200, &header).unwrap();
    let page = desk.page(0, &registers_of(&[1; 100]));
    desk.machine.write(224, &page).unwrap();
    assert_eq!(desk.read(350, 2), [1, 3], "the CRC is wrong");
    assert_eq!(desk.read(120, 72), before);
    desk.send(1, &[0xEE; 100], [7; 32]);
    let inbox = desk.read(350, 12);
    assert_eq!((inbox[1], inbox[8]), (4, 8), "of another part");
    assert_eq!(desk.read(120, 72), before);
    desk.send(1, &[1; 100], [7; 32]);
    assert_eq!(bytes_of(&desk.read(128, 16)), [7; 32]);
}

#[test]
fn inbox_refuses_bad_header() {
    let mut desk = Desk::new(Kind::Cmm);
    for (kind, bytes) in [(0, 100), (2, 100), (3, 100), (4, 100), (1, 0), (1, (64 << 20) + 1)] {
        let mut header = desk.header(kind, &[], 0, [0; 32]);
        header[2..4].copy_from_slice(&WordOrder::Big.from_u32(bytes));
        assert_eq!(desk.machine.write(200, &header), Err(Exception::Value), "kind {kind}, {bytes} bytes");
    }
    let header = desk.header(1, &[0; 4], 0, [0; 32]);
    assert_eq!(desk.machine.write(200, &header[..23]), Err(Exception::Value), "a part of a header");
    assert_eq!(desk.machine.write(201, &header[1..]), Err(Exception::Value), "a part of a header");
    for state in ALL_STATES {
        let mut desk = Desk::in_state(state);
        let header = desk.header(2, &[0; 4], 0, [0; 32]);
        let refused = matches!(state, State::Execute | State::Holding | State::Held);
        assert_eq!(desk.machine.write(200, &header).is_err(), refused, "{state:?}");
    }
}

#[test]
fn status_snapshot_counts_and_tears() {
    let mut desk = Desk::ready(Kind::Cmm);
    let before = desk.read(64, 1)[0];
    assert_eq!(desk.read(64, 1)[0], before, "reading is not a change");
    desk.accept(Command::Prepare);
    assert_eq!(desk.read(64, 1)[0], before + 1);
    desk.machine.tear_status();
    let torn = desk.read(64, 48);
    assert_ne!(torn[0], torn[47]);
    let whole = desk.read(64, 48);
    assert_eq!(whole[0], whole[47]);
}

#[test]
fn heartbeats_stop_on_freeze() {
    let mut desk = Desk::in_state(State::Execute);
    desk.write_beat(4711, 9);
    let before = desk.read(92, 1)[0];
    desk.machine.tick(S);
    let beats = desk.read(92, 2);
    assert!(beats[0] - before >= 4 && beats[1] == 4711, "{before} {beats:?}");
    desk.machine.freeze(true);
    let frozen = desk.read(64, 48);
    let frame = desk.frame(Command::Hold);
    desk.machine.write(40, &frame.registers(WordOrder::Big)).unwrap();
    desk.write_beat(4712, 9);
    desk.machine.tick(10 * S);
    assert_eq!(desk.read(64, 48), frozen, "the wire answers, nothing moves");
    desk.machine.freeze(false);
    desk.machine.tick(20 * MS);
    let status = desk.status();
    assert_eq!((status.state, status.acknowledged), (4, frame.sequence), "it looks at what was written meanwhile");
}

#[test]
fn reboot_preserves_only_last_begun() {
    for (state, after) in [
        (State::Idle, State::Idle),
        (State::Prepared, State::Idle),
        (State::Execute, State::Faulted),
        (State::Held, State::Faulted),
        (State::Complete, State::Idle),
    ] {
        let mut desk = Desk::in_state(state);
        let before = desk.status();
        desk.machine.reboot();
        let status = desk.status();
        assert_ne!(status.boot_id, before.boot_id);
        let identity = desk.read(0, 32);
        assert_eq!(desk.u32(&identity, 10), status.boot_id);
        assert_eq!((desk.machine.state(), status.last_begun), (after, before.last_begun), "{state:?}");
        assert_eq!((status.owner, status.token, status.acknowledged, status.begun_by, status.done), (0, 0, 0, 0, 0));
        assert_eq!(desk.read(120, 2), [1, 0], "no payload in force");
    }
}

#[test]
fn handshake_log_of_whole_job() {
    let mut desk = Desk::ready(Kind::Cmm);
    desk.accept(Command::Prepare);
    desk.accept(Command::Start);
    let start = desk.sequence;
    desk.wait(6 * S);
    let told: Vec<String> = desk
        .machine
        .log()
        .iter()
        .map(|seen| match &seen.event {
            HandshakeEvent::Commanded { frame, answer, .. } => format!("{} {answer:?}", frame.command),
            HandshakeEvent::Changed { from, to } => format!("{from:?} {to:?}"),
            HandshakeEvent::Began { start: by, job, cycle } => format!("began {} {job} {cycle}", by - start),
            HandshakeEvent::Ended { result, .. } => format!("ended {result}"),
            HandshakeEvent::Taken { kind, .. } => format!("taken {kind}"),
            other => format!("{other:?}"),
        })
        .collect();
    let expected = [
        "1 Accepted",
        "taken 1",
        "2 Accepted",
        "Idle Prepared",
        "3 Accepted",
        "began 0 41 2",
        "Prepared Execute",
        "ended 1",
        "Execute Complete",
    ];
    assert_eq!(told, expected);
    assert!(desk.machine.log().is_sorted_by_key(|seen| seen.time));
    let ended = desk.machine.log().last().unwrap().time;
    assert!((5.0..5.1).contains(&ended.as_secs_f64()), "{ended:?}");
}

#[test]
fn ended_event_has_beat_statistics() {
    let mut desk = Desk::in_state(State::Execute);
    desk.wait(S);
    desk.machine.tick(2100 * MS);
    // A beat that is repeated is none, and one of somebody else's neither.
    desk.write_beat(desk.beat, 9);
    desk.write_beat(1000, 10);
    desk.wait(3 * S);
    assert_eq!(desk.machine.state(), State::Complete);
    let ended = desk.machine.log().iter().find_map(|seen| match seen.event {
        HandshakeEvent::Ended { beats, .. } => Some(beats),
        _ => None,
    });
    // At 0, 0.25, 0.5 and 0.75 s; then eight from 3.1 to 4.85 s; the job takes 5 s.
    assert_eq!(ended, Some(BeatStatistics { count: 12, mean_interval: 4850 * MS / 11, max_silence: 2350 * MS }));
}

#[test]
fn handshake_log_is_bounded() {
    let mut desk = Desk::ready(Kind::Cmm);
    for _ in 0..70_000 {
        desk.machine.write(59, &[0xFFFF]).unwrap();
    }
    assert!(desk.machine.log().len() <= 1 << 16 && desk.machine.forgotten() > 0);
}

/// Commands in any order, with right and wrong numbers, while time passes and things happen at the machine.
#[test]
fn random_commands_start_job_once() {
    use rand::RngExt;
    let mut all = 0;
    for seed in 0..300 {
        let mut rng = regrind_sim::rng(seed);
        let mut desk = Desk::ready(Kind::Grinder);
        let mut frames = Vec::new();
        for _ in 0..400 {
            match rng.random_range(0..20) {
                0..12 => {
                    let wild = rng.random_range(0..3) == 0;
                    let command = if wild { Command::ALL[rng.random_range(0..10)] } else { desk.sensible() };
                    let mut frame = desk.frame(command);
                    frame.cycle = rng.random_range(0..8);
                    frame.token ^= u32::from(rng.random_range(0..8) == 0);
                    if command == Command::Start && rng.random_range(0..4) > 0 {
                        frame.cycle = desk.status().cycle;
                    }
                    frames.push(frame);
                    desk.put(frame);
                }
                12..15 => {
                    if let Some(old) = frames.get(rng.random_range(0..frames.len().max(1))).copied() {
                        desk.put(old);
                        desk.sequence = desk.sequence.max(desk.status().acknowledged);
                    }
                }
                15 => desk.machine.tick(MS * rng.random_range(1..5000)),
                16 => desk.machine.open_interlocks([0, 0, 0, 1, 2, 4, 8][rng.random_range(0..7)]),
                17 if rng.random_range(0..20) == 0 => desk.machine.reboot(),
                18 => desk.get_payloads(),
                _ => desk.wait(MS * rng.random_range(1..3000)),
            }
        }
        check_log(&desk, seed);
        all += desk.machine.began().len();
    }
    assert!(all > 600, "only {all} jobs in 300 runs: the test has lost its point");
}

fn check_log(desk: &Desk, seed: u64) {
    let mut began: Vec<(u32, u16)> = desk.machine.began().into_iter().map(|(_, job, cycle)| (job, cycle)).collect();
    let all = began.len();
    began.sort_unstable();
    began.dedup();
    assert_eq!(began.len(), all, "seed {seed}: a job began twice");
    let log = desk.machine.log();
    let mut state = State::Idle;
    for (before, seen) in log.iter().zip(&log[1..]) {
        if let HandshakeEvent::Began { start, .. } = seen.event {
            let HandshakeEvent::Commanded { frame, answer, state } = &before.event else {
                panic!("seed {seed}: {before:?}")
            };
            assert_eq!((frame.sequence, frame.command, *answer), (start, 3, Answer::Accepted), "seed {seed}");
            assert_eq!(*state, State::Prepared, "seed {seed}");
        }
        if let HandshakeEvent::Changed { from, to } = seen.event {
            assert_eq!(from, state, "seed {seed}");
            state = to;
            assert!(to != State::Execute || matches!(from, State::Prepared | State::Held), "seed {seed}: {from:?}");
            let ends = matches!(from, State::Aborting | State::Aborted | State::Complete);
            assert!(!ends || matches!(to, State::Idle | State::Aborting | State::Aborted | State::Faulted), "{seed}");
        }
    }
    assert_eq!(state, desk.machine.state(), "seed {seed}");
}
