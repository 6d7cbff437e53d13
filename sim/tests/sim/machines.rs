//! The real physics behind the registers: a part is ground and measured in both word orders, and cannot be in two
//! places.

use std::time::Duration;

use crate::common::{net, pass, plan, small_perfect, zero_map};
use regrind_sim::body::Physics;
use regrind_sim::command::{Answer, Command, CommandFrame, State};
use regrind_sim::options::MachineOptions;
use regrind_sim::payload::{PassRecord, decode_points};
use regrind_sim::register_encoding::{WordOrder, bytes_of, registers_of, turn_payload};
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::world::World;

const HALF_MM: [f64; 2] = [15.0, 10.0];

struct Desk {
    machine: SimulatedMachine,
    order: WordOrder,
    digest: u32,
    sequence: u32,
    beat: u16,
}

impl Desk {
    fn new(body: impl Physics + 'static, order: WordOrder, payloads: Vec<(u16, Vec<u8>)>) -> Self {
        Self::with(body, MachineOptions { word_order: order, ..MachineOptions::default() }, payloads)
    }

    fn with(body: impl Physics + 'static, options: MachineOptions, payloads: Vec<(u16, Vec<u8>)>) -> Self {
        let (order, options) = (options.word_order, MachineOptions { speed: 200.0, ..options });
        let machine = SimulatedMachine::new(Box::new(body), 5, options);
        let identities: Vec<u8> = payloads.iter().flat_map(|(kind, _)| [*kind as u8; 32]).collect();
        let mut desk = Self { machine, order, digest: crc32fast::hash(&identities), sequence: 0, beat: 0 };
        for (kind, bytes) in payloads {
            desk.send(kind, bytes);
        }
        desk.command(Command::Claim, Answer::Accepted);
        desk
    }

    fn send(&mut self, kind: u16, mut bytes: Vec<u8>) {
        if self.order == WordOrder::Little {
            turn_payload(kind, 1, &mut bytes);
        }
        let mut header = vec![kind, 0];
        header.extend(self.order.from_u32(bytes.len() as u32));
        header.extend(self.order.from_u32(crc32fast::hash(&bytes)));
        header.extend([0, 0]);
        header.extend(registers_of(&[kind as u8; 32]));
        self.machine.write(200, &header).unwrap();
        for (page, data) in registers_of(&bytes).chunks(112).enumerate() {
            let mut words = self.order.from_u32(page as u32).to_vec();
            words.extend([data.len() as u16, 0, 0, 0, 0, 0]);
            words.extend(data);
            self.machine.write(224, &words).unwrap();
        }
        assert_eq!(self.machine.read(351, 1), Ok(vec![2]), "payload {kind} is in force");
    }

    fn u32(&mut self, address: u16) -> u32 {
        let words = self.machine.read(address, 2).unwrap();
        self.order.to_u32([words[0], words[1]])
    }

    fn command(&mut self, command: Command, expected: Answer) {
        self.sequence += 1;
        let frame = CommandFrame {
            sequence: self.sequence,
            command: command as u16,
            cycle: 1,
            owner: 4,
            epoch: 1,
            job: 12,
            digest: self.digest,
            token: self.u32(78),
            argument: self.u32(80),
        };
        self.machine.write(40, &frame.registers(self.order)).unwrap();
        let answer = self.machine.read(70, 1).unwrap()[0];
        assert_eq!((self.u32(68), answer), (self.sequence, expected as u16), "{command:?}");
    }

    fn wait_for(&mut self, state: State) {
        for _ in 0..100_000 {
            if self.machine.state() == state {
                return;
            }
            self.beat = self.beat.wrapping_add(1);
            let [first, second] = self.order.from_u32(4);
            self.machine.write(36, &[self.beat, first, second]).unwrap();
            self.machine.tick(Duration::from_millis(100));
        }
        panic!("{state:?} did not come; it is {:?}", self.machine.state());
    }

    fn result(&mut self) -> (u16, f64, Vec<u8>) {
        let header = self.machine.read(400, 56).unwrap();
        let length = self.u32(402) as usize;
        let mut registers = Vec::new();
        while registers.len() < length.div_ceil(2) {
            let page = self.order.from_u32((registers.len() / 112) as u32);
            self.machine.write(460, &page).unwrap();
            let answer = self.machine.read(462, 116).unwrap();
            registers.extend(&answer[4..4 + usize::from(answer[2])]);
        }
        let mut bytes = bytes_of(&registers);
        bytes.truncate(length);
        if self.order == WordOrder::Little {
            turn_payload(header[0], header[1], &mut bytes);
        }
        (header[1], self.order.to_f64(header[16..20].try_into().unwrap()), bytes)
    }
}

#[test]
fn grind_and_measure_over_registers() {
    for order in [WordOrder::Big, WordOrder::Little] {
        let world = World::new(small_perfect()).unwrap();
        let level_mm = world.level_mm() - 0.01;
        let map = (2, zero_map(HALF_MM).encode());
        let mut grinder = Desk::new(world.grinder(), order, vec![map, (3, pass(HALF_MM, level_mm).encode())]);
        let targets = plan(&world, &net([12.0, 8.0], 4.0));
        let mut cmm = Desk::new(world.cmm(), order, vec![(1, targets.encode())]);

        grinder.command(Command::Prepare, Answer::Accepted);
        grinder.command(Command::Start, Answer::Accepted);
        grinder.machine.tick(Duration::from_millis(100));
        assert_eq!(grinder.machine.state(), State::Execute);
        cmm.command(Command::Prepare, Answer::Interlock);
        grinder.wait_for(State::Complete);
        let (_, _, record) = grinder.result();
        let record = PassRecord::decode(&record).unwrap();
        assert_eq!((record.job, record.cycle, record.result), (12, 1, 1), "{order:?}");
        assert!((record.depth_mm - 0.01).abs() < 1e-3, "{order:?}: {record:?}");
        grinder.command(Command::Acknowledge, Answer::Accepted);

        cmm.command(Command::Prepare, Answer::Accepted);
        cmm.command(Command::Start, Answer::Accepted);
        cmm.wait_for(State::Complete);
        let (format, scale_mm, bytes) = cmm.result();
        let records = decode_points(&bytes, (format == 2).then_some(scale_mm)).unwrap();
        assert_eq!(records.len(), targets.targets.len(), "{order:?}");
        assert!(records.iter().all(|record| record.status as u16 == 1), "{order:?}");
        assert_eq!(world.grinds_begun(12, 1), 1);
    }
}

#[test]
fn stop_after_hold_releases_part() {
    let world = World::new(small_perfect()).unwrap();
    let level_mm = world.level_mm() - 0.01;
    let map = (2, zero_map(HALF_MM).encode());
    let mut grinder = Desk::new(world.grinder(), WordOrder::Big, vec![map, (3, pass(HALF_MM, level_mm).encode())]);
    let targets = plan(&world, &net([12.0, 8.0], 4.0));
    let mut cmm = Desk::new(world.cmm(), WordOrder::Big, vec![(1, targets.encode())]);
    grinder.command(Command::Prepare, Answer::Accepted);
    grinder.command(Command::Start, Answer::Accepted);
    grinder.machine.tick(Duration::from_millis(200));
    grinder.command(Command::Hold, Answer::Accepted);
    grinder.wait_for(State::Held);
    cmm.command(Command::Prepare, Answer::Interlock);
    grinder.command(Command::Stop, Answer::Accepted);
    grinder.wait_for(State::Complete);
    assert_eq!(grinder.machine.read(82, 1), Ok(vec![2]), "stopped");
    cmm.command(Command::Prepare, Answer::Accepted);
    grinder.command(Command::Acknowledge, Answer::Accepted);
    grinder.command(Command::Prepare, Answer::Accepted);
    grinder.command(Command::Start, Answer::Begun);
}

impl Desk {
    fn outbox_page(&mut self, page: u32) -> Vec<u16> {
        self.machine.write(460, &self.order.from_u32(page)).unwrap();
        self.machine.read(462, 116).unwrap()
    }
}

/// A measuring machine that has measured 15 of 35 points, or a few more.
fn measuring(gives_ahead: bool, order: WordOrder) -> Desk {
    let world = World::new(small_perfect()).unwrap();
    let targets = plan(&world, &net([12.0, 8.0], 4.0));
    let options = MachineOptions { gives_ahead, word_order: order, ..MachineOptions::default() };
    let mut cmm = Desk::with(world.cmm(), options, vec![(1, targets.encode())]);
    cmm.command(Command::Prepare, Answer::Accepted);
    cmm.command(Command::Start, Answer::Accepted);
    while cmm.u32(84) < 15 {
        cmm.machine.tick(Duration::from_millis(5));
    }
    assert!(cmm.u32(84) < 21 && cmm.u32(86) == 35, "{}", cmm.u32(84));
    cmm
}

#[test]
fn full_pages_readable_during_measurement() {
    for order in [WordOrder::Big, WordOrder::Little] {
        let mut cmm = measuring(true, order);
        assert_eq!(cmm.machine.read(12, 1), Ok(vec![3]), "the flag");
        let header = cmm.machine.read(400, 56).unwrap();
        let so_far = cmm.u32(84);
        assert_eq!((header[0], cmm.u32(402), cmm.u32(404), cmm.u32(406)), (4, 32 * so_far, 0, 12), "{order:?}");
        assert_eq!((cmm.u32(410), cmm.u32(446)), (so_far, 0), "{order:?}");
        let full = [0, 1].map(|page| cmm.outbox_page(page));
        assert!(full.iter().all(|page| page[2] == 112), "{order:?}");
        assert_eq!(cmm.outbox_page(2)[2], 0, "the page that is being filled");
        cmm.command(Command::Hold, Answer::Accepted);
        cmm.wait_for(State::Held);
        assert_eq!([0, 1].map(|page| cmm.outbox_page(page)), full, "held");
        cmm.command(Command::Stop, Answer::Accepted);
        cmm.wait_for(State::Complete);
        assert_eq!([0, 1].map(|page| cmm.outbox_page(page)), full, "stopped");
        assert_eq!((cmm.u32(410), cmm.outbox_page(4)[2]), (35, 112), "with what was not reached");
        let later = cmm.machine.read(400, 56).unwrap();
        assert_eq!((&later[8..10], &later[12..20], &later[28..46]), (&header[8..10], &header[12..20], &header[28..46]));
    }
}

#[test]
fn early_pages_absent_if_off_or_aborted() {
    let mut old = measuring(false, WordOrder::Big);
    assert_eq!(old.machine.read(12, 1), Ok(vec![1]));
    assert_eq!((old.machine.read(400, 56).unwrap(), old.outbox_page(0)[2]), (vec![0; 56], 0));
    let mut aborted = measuring(true, WordOrder::Big);
    aborted.command(Command::Abort, Answer::Accepted);
    assert_eq!((aborted.machine.read(400, 56).unwrap(), aborted.outbox_page(0)[2]), (vec![0; 56], 0));
    aborted.wait_for(State::Aborted);
    assert_eq!((aborted.machine.read(400, 56).unwrap(), aborted.outbox_page(0)[2]), (vec![0; 56], 0));
}

/// A grinder with its payloads in force.
fn grinder(options: MachineOptions) -> Desk {
    let world = World::new(small_perfect()).unwrap();
    let map = (2, zero_map(HALF_MM).encode());
    Desk::with(world.grinder(), options, vec![map, (3, pass(HALF_MM, world.level_mm() - 0.01).encode())])
}

#[test]
fn stray_motion_without_command() {
    let mut grinder = grinder(MachineOptions::default());
    for held in [true, false] {
        grinder.machine.stray(true);
        grinder.machine.tick(Duration::from_millis(200));
        assert_eq!(grinder.machine.state(), State::Execute);
        assert!(grinder.u32(84) > 0, "its progress goes on");
        if held {
            grinder.command(Command::Hold, Answer::Accepted);
            grinder.wait_for(State::Held);
        }
        grinder.machine.stray(false);
        assert_eq!((grinder.machine.state(), grinder.machine.began()), (State::Idle, vec![]));
    }
    // What is at a job is left at it.
    grinder.command(Command::Prepare, Answer::Accepted);
    grinder.command(Command::Start, Answer::Accepted);
    grinder.machine.stray(true);
    grinder.machine.stray(false);
    assert_eq!(grinder.machine.state(), State::Execute);
}

#[test]
fn panel_start_resumes_held_machine() {
    let mut grinder = grinder(MachineOptions::default());
    grinder.machine.press_start();
    assert_eq!(grinder.machine.state(), State::Idle, "nothing is held");
    grinder.command(Command::Prepare, Answer::Accepted);
    grinder.command(Command::Start, Answer::Accepted);
    grinder.command(Command::Hold, Answer::Accepted);
    grinder.wait_for(State::Held);
    grinder.machine.press_start();
    assert_eq!(grinder.machine.state(), State::Execute);
    grinder.wait_for(State::Complete);
}

#[test]
fn trusting_machine_skips_job_checks() {
    for trusting in [false, true] {
        let mut grinder = grinder(MachineOptions { trusting, ..MachineOptions::default() });
        grinder.command(Command::Prepare, Answer::Accepted);
        grinder.command(Command::Start, Answer::Accepted);
        grinder.wait_for(State::Complete);
        grinder.command(Command::Acknowledge, Answer::Accepted);
        grinder.command(Command::Prepare, Answer::Accepted);
        grinder.command(Command::Start, if trusting { Answer::Accepted } else { Answer::Begun });
        assert_eq!(grinder.machine.began().len(), if trusting { 2 } else { 1 });
    }
    for trusting in [false, true] {
        let mut grinder = grinder(MachineOptions { trusting, ..MachineOptions::default() });
        grinder.machine.spoil();
        grinder.send(3, pass(HALF_MM, 0.0).encode());
        let in_force = |grinder: &mut Desk| grinder.machine.read(176, 16).unwrap();
        assert_eq!(in_force(&mut grinder), [0x0303; 16], "as it was sent, when it is looked at first");
        assert_eq!(in_force(&mut grinder)[0], 0x0203);
        grinder.command(Command::Prepare, if trusting { Answer::Accepted } else { Answer::Different });
    }
}
