//! A client at the registers of a machine, without a wire and without a clock.

use std::time::Duration;

use regrind_sim::body::{Kind, Physics};
use regrind_sim::command::{Answer, Command, CommandFrame};
use regrind_sim::options::MachineOptions;
use regrind_sim::register_encoding::{WordOrder, bytes_of, registers_of};
use regrind_sim::registers::SimulatedMachine;

/// A client at a machine's registers.
pub struct Desk {
    pub machine: SimulatedMachine,
    pub order: WordOrder,
    pub kind: Kind,
    pub digest: u32,
    pub sequence: u32,
    pub owner: u32,
    pub epoch: u32,
    pub beat: u16,
}

/// The status block, read.
#[derive(Debug, PartialEq)]
pub struct Status {
    pub state: u16,
    pub mode: u16,
    pub interlocks: u16,
    pub acknowledged: u32,
    pub answer: u16,
    pub fault: u16,
    pub job: u32,
    pub cycle: u16,
    pub digest: u32,
    pub token: u32,
    pub done: u32,
    pub result: u16,
    pub progress: [u32; 2],
    pub owner: u32,
    pub epoch: u32,
    pub last_begun: (u32, u16),
    pub temperature: i16,
    pub boot_id: u32,
    pub begun_by: u32,
}

impl Desk {
    /// A machine with this body. `digest` is the digest of the payloads that the client sends.
    pub fn with_body(body: impl Physics + 'static, options: MachineOptions, digest: u32) -> Self {
        let (order, kind) = (options.word_order, body.kind());
        let machine = SimulatedMachine::new(Box::new(body), 77, options);
        Self { machine, order, kind, digest, sequence: 100, owner: 9, epoch: 1, beat: 0 }
    }

    pub fn read(&mut self, address: u16, count: u16) -> Vec<u16> {
        self.machine.read(address, count).unwrap()
    }

    pub fn u32(&self, words: &[u16], at: usize) -> u32 {
        self.order.to_u32([words[at], words[at + 1]])
    }

    pub fn status(&mut self) -> Status {
        let w = self.read(64, 48);
        assert_eq!(w[0], w[47]);
        let long = |at: usize| self.u32(&w, at);
        Status {
            state: w[1],
            mode: w[2],
            interlocks: w[3],
            acknowledged: long(4),
            answer: w[6],
            fault: w[7],
            job: long(8),
            cycle: w[10],
            digest: long(12),
            token: long(14),
            done: long(16),
            result: w[18],
            progress: [long(20), long(22)],
            owner: long(24),
            epoch: long(26),
            last_begun: (long(30), w[32]),
            temperature: w[33] as i16,
            boot_id: long(34),
            begun_by: long(36),
        }
    }

    /// The frame of a command as the client would fill it in now, with the next number.
    pub fn frame(&mut self, command: Command) -> CommandFrame {
        self.sequence += 1;
        let status = self.status();
        CommandFrame {
            sequence: self.sequence,
            command: command as u16,
            cycle: 2,
            owner: self.owner,
            epoch: self.epoch,
            job: 41,
            digest: self.digest,
            token: status.token,
            argument: status.done,
        }
    }

    pub fn put(&mut self, frame: CommandFrame) -> u16 {
        self.machine.write(40, &frame.registers(self.order)).unwrap();
        self.status().answer
    }

    pub fn command(&mut self, command: Command) -> u16 {
        let frame = self.frame(command);
        let answer = self.put(frame);
        assert_eq!(self.status().acknowledged, frame.sequence);
        answer
    }

    pub fn accept(&mut self, command: Command) {
        assert_eq!(self.command(command), Answer::Accepted as u16, "{command:?} in {:?}", self.machine.state());
    }

    pub fn header(&self, kind: u16, bytes: &[u8], crc: u32, identity: [u8; 32]) -> Vec<u16> {
        let mut words = vec![kind, 0];
        words.extend(self.order.from_u32(bytes.len() as u32));
        words.extend(self.order.from_u32(crc));
        words.extend([0, 0]);
        words.extend(registers_of(&identity));
        words
    }

    pub fn page(&self, page: u32, data: &[u16]) -> Vec<u16> {
        let mut words = self.order.from_u32(page).to_vec();
        words.extend([data.len() as u16, 0, 0, 0, 0, 0]);
        words.extend(data);
        words
    }

    pub fn send(&mut self, kind: u16, bytes: &[u8], identity: [u8; 32]) {
        let header = self.header(kind, bytes, crc32fast::hash(bytes), identity);
        self.machine.write(200, &header).unwrap();
        for (page, data) in registers_of(bytes).chunks(112).enumerate() {
            let page = self.page(page as u32, data);
            self.machine.write(224, &page).unwrap();
        }
    }

    /// Beats while time passes.
    pub fn wait(&mut self, time: Duration) {
        let mut left = time;
        while !left.is_zero() {
            let step = left.min(Duration::from_millis(250));
            left -= step;
            self.beat = self.beat.wrapping_add(1);
            self.write_beat(self.beat, self.owner);
            self.machine.tick(step);
        }
    }

    pub fn write_beat(&mut self, count: u16, owner: u32) {
        let [first, second] = self.order.from_u32(owner);
        self.machine.write(36, &[count, first, second]).unwrap();
    }

    pub fn outbox(&mut self) -> (Vec<u16>, Vec<u8>) {
        let header = self.read(400, 56);
        let length = self.u32(&header, 2) as usize;
        let mut registers = Vec::new();
        while registers.len() < length.div_ceil(2) {
            let page = (registers.len() / 112) as u32;
            self.machine.write(460, &self.order.from_u32(page)).unwrap();
            let answer = self.read(462, 116);
            assert_eq!(self.u32(&answer, 0), page);
            registers.extend(&answer[4..4 + usize::from(answer[2])]);
        }
        let mut bytes = bytes_of(&registers);
        bytes.truncate(length);
        assert_eq!(crc32fast::hash(&bytes), self.u32(&header, 4));
        (header, bytes)
    }
}
