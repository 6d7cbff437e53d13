//! The real physics behind the registers: a part is ground and measured in both word orders, and cannot be in two
//! places.

use std::time::Duration;

use crate::common::{level_mm, net, pass, plan, small_perfect, zero_map};
use crate::desk::Desk;
use regrind_sim::body::Physics;
use regrind_sim::command::{Answer, Command, State};
use regrind_sim::options::MachineOptions;
use regrind_sim::register_encoding::{WordOrder, turn_payload};
use regrind_sim::world::World;
use regrind_testsim::payloads::{Encode, decode_pass_record, decode_points};

const HALF_MM: [f64; 2] = [15.0, 10.0];

impl Desk {
    fn loaded(body: impl Physics + 'static, order: WordOrder, payloads: Vec<(u16, Vec<u8>)>) -> Self {
        Self::with(body, MachineOptions { word_order: order, ..MachineOptions::default() }, payloads)
    }

    fn with(body: impl Physics + 'static, options: MachineOptions, payloads: Vec<(u16, Vec<u8>)>) -> Self {
        let identities: Vec<u8> = payloads.iter().flat_map(|(kind, _)| [*kind as u8; 32]).collect();
        let mut desk = Self::with_body(body, MachineOptions { speed: 200.0, ..options }, crc32fast::hash(&identities));
        payloads.into_iter().for_each(|(kind, bytes)| desk.send_in_order(kind, bytes));
        desk.accept(Command::Claim);
        desk
    }

    /// Sends a payload in the word order of the machine.
    fn send_in_order(&mut self, kind: u16, mut bytes: Vec<u8>) {
        if self.order == WordOrder::Little {
            turn_payload(kind, 1, &mut bytes);
        }
        self.send(kind, &bytes, [kind as u8; 32]);
        assert_eq!(self.read(351, 1), [2], "payload {kind} is in force");
    }

    fn u32_at(&mut self, address: u16) -> u32 {
        let words = self.read(address, 2);
        self.u32(&words, 0)
    }

    fn expect(&mut self, command: Command, expected: Answer) {
        assert_eq!(self.command(command), expected as u16, "{command:?}");
    }

    fn wait_for(&mut self, state: State) {
        for _ in 0..100_000 {
            if self.machine.state() == state {
                return;
            }
            self.wait(Duration::from_millis(100));
        }
        panic!("{state:?} did not come; it is {:?}", self.machine.state());
    }

    /// Returns the format of the result, its scale and its bytes, high word first.
    fn result(&mut self) -> (u16, f64, Vec<u8>) {
        let (header, mut bytes) = self.outbox();
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
        let level_mm = level_mm(&world) - 0.01;
        let map = (2, zero_map(HALF_MM).encode());
        let mut grinder = Desk::loaded(world.grinder(), order, vec![map, (3, pass(HALF_MM, level_mm).encode())]);
        let targets = plan(&world, &net([12.0, 8.0], 4.0));
        let mut cmm = Desk::loaded(world.cmm(), order, vec![(1, targets.encode())]);

        grinder.accept(Command::Prepare);
        grinder.accept(Command::Start);
        grinder.machine.tick(Duration::from_millis(100));
        assert_eq!(grinder.machine.state(), State::Execute);
        cmm.expect(Command::Prepare, Answer::Interlock);
        grinder.wait_for(State::Complete);
        let (_, _, record) = grinder.result();
        let record = decode_pass_record(&record).unwrap();
        assert_eq!((record.job, record.cycle, record.result), (41, 2, 1), "{order:?}");
        assert!((record.depth_mm - 0.01).abs() < 1e-3, "{order:?}: {record:?}");
        grinder.accept(Command::Acknowledge);

        cmm.accept(Command::Prepare);
        cmm.accept(Command::Start);
        cmm.wait_for(State::Complete);
        let (format, scale_mm, bytes) = cmm.result();
        let records = decode_points(&bytes, (format == 2).then_some(scale_mm)).unwrap();
        assert_eq!(records.len(), targets.targets.len(), "{order:?}");
        assert!(records.iter().all(|record| record.status as u16 == 1), "{order:?}");
        assert_eq!(world.grinds_begun(41, 2), 1);
    }
}

#[test]
fn stop_after_hold_releases_part() {
    let world = World::new(small_perfect()).unwrap();
    let level_mm = level_mm(&world) - 0.01;
    let map = (2, zero_map(HALF_MM).encode());
    let mut grinder = Desk::loaded(world.grinder(), WordOrder::Big, vec![map, (3, pass(HALF_MM, level_mm).encode())]);
    let targets = plan(&world, &net([12.0, 8.0], 4.0));
    let mut cmm = Desk::loaded(world.cmm(), WordOrder::Big, vec![(1, targets.encode())]);
    grinder.accept(Command::Prepare);
    grinder.accept(Command::Start);
    grinder.machine.tick(Duration::from_millis(200));
    grinder.accept(Command::Hold);
    grinder.wait_for(State::Held);
    cmm.expect(Command::Prepare, Answer::Interlock);
    grinder.accept(Command::Stop);
    grinder.wait_for(State::Complete);
    assert_eq!(grinder.machine.read(82, 1), Ok(vec![2]), "stopped");
    cmm.accept(Command::Prepare);
    grinder.accept(Command::Acknowledge);
    grinder.accept(Command::Prepare);
    grinder.expect(Command::Start, Answer::Begun);
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
    cmm.accept(Command::Prepare);
    cmm.accept(Command::Start);
    while cmm.u32_at(84) < 15 {
        cmm.machine.tick(Duration::from_millis(5));
    }
    assert!(cmm.u32_at(84) < 21 && cmm.u32_at(86) == 35, "{}", cmm.u32_at(84));
    cmm
}

#[test]
fn full_pages_readable_during_measurement() {
    for order in [WordOrder::Big, WordOrder::Little] {
        let mut cmm = measuring(true, order);
        assert_eq!(cmm.machine.read(12, 1), Ok(vec![3]), "the flag");
        let header = cmm.machine.read(400, 56).unwrap();
        let so_far = cmm.u32_at(84);
        assert_eq!(
            (header[0], cmm.u32_at(402), cmm.u32_at(404), cmm.u32_at(406)),
            (4, 32 * so_far, 0, 41),
            "{order:?}"
        );
        assert_eq!((cmm.u32_at(410), cmm.u32_at(446)), (so_far, 0), "{order:?}");
        let full = [0, 1].map(|page| cmm.outbox_page(page));
        assert!(full.iter().all(|page| page[2] == 112), "{order:?}");
        assert_eq!(cmm.outbox_page(2)[2], 0, "the page that is being filled");
        cmm.accept(Command::Hold);
        cmm.wait_for(State::Held);
        assert_eq!([0, 1].map(|page| cmm.outbox_page(page)), full, "held");
        cmm.accept(Command::Stop);
        cmm.wait_for(State::Complete);
        assert_eq!([0, 1].map(|page| cmm.outbox_page(page)), full, "stopped");
        assert_eq!((cmm.u32_at(410), cmm.outbox_page(4)[2]), (35, 112), "with what was not reached");
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
    aborted.accept(Command::Abort);
    assert_eq!((aborted.machine.read(400, 56).unwrap(), aborted.outbox_page(0)[2]), (vec![0; 56], 0));
    aborted.wait_for(State::Aborted);
    assert_eq!((aborted.machine.read(400, 56).unwrap(), aborted.outbox_page(0)[2]), (vec![0; 56], 0));
}

/// A grinder with its payloads in force.
fn grinder(options: MachineOptions) -> Desk {
    let world = World::new(small_perfect()).unwrap();
    let map = (2, zero_map(HALF_MM).encode());
    Desk::with(world.grinder(), options, vec![map, (3, pass(HALF_MM, level_mm(&world) - 0.01).encode())])
}

#[test]
fn stray_motion_without_command() {
    let mut grinder = grinder(MachineOptions::default());
    for held in [true, false] {
        grinder.machine.stray(true);
        grinder.machine.tick(Duration::from_millis(200));
        assert_eq!(grinder.machine.state(), State::Execute);
        assert!(grinder.u32_at(84) > 0, "its progress goes on");
        if held {
            grinder.accept(Command::Hold);
            grinder.wait_for(State::Held);
        }
        grinder.machine.stray(false);
        assert_eq!((grinder.machine.state(), grinder.machine.began()), (State::Idle, vec![]));
    }
    // What is at a job is left at it.
    grinder.accept(Command::Prepare);
    grinder.accept(Command::Start);
    grinder.machine.stray(true);
    grinder.machine.stray(false);
    assert_eq!(grinder.machine.state(), State::Execute);
}

#[test]
fn panel_start_resumes_held_machine() {
    let mut grinder = grinder(MachineOptions::default());
    grinder.machine.press_start();
    assert_eq!(grinder.machine.state(), State::Idle, "nothing is held");
    grinder.accept(Command::Prepare);
    grinder.accept(Command::Start);
    grinder.accept(Command::Hold);
    grinder.wait_for(State::Held);
    grinder.machine.press_start();
    assert_eq!(grinder.machine.state(), State::Execute);
    grinder.wait_for(State::Complete);
}

#[test]
fn trusting_machine_skips_job_checks() {
    for trusting in [false, true] {
        let mut grinder = grinder(MachineOptions { trusting, ..MachineOptions::default() });
        grinder.accept(Command::Prepare);
        grinder.accept(Command::Start);
        grinder.wait_for(State::Complete);
        grinder.accept(Command::Acknowledge);
        grinder.accept(Command::Prepare);
        grinder.expect(Command::Start, if trusting { Answer::Accepted } else { Answer::Begun });
        assert_eq!(grinder.machine.began().len(), if trusting { 2 } else { 1 });
    }
    for trusting in [false, true] {
        let mut grinder = grinder(MachineOptions { trusting, ..MachineOptions::default() });
        grinder.machine.spoil();
        grinder.send_in_order(3, pass(HALF_MM, 0.0).encode());
        let in_force = |grinder: &mut Desk| grinder.machine.read(176, 16).unwrap();
        assert_eq!(in_force(&mut grinder), [0x0303; 16], "as it was sent, when it is looked at first");
        assert_eq!(in_force(&mut grinder)[0], 0x0203);
        grinder.expect(Command::Prepare, if trusting { Answer::Accepted } else { Answer::Different });
    }
}
