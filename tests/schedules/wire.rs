//! Traffic that leaves the program, observed at the wire: the commands, and whether each query follows the rules.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use regrind_sim::command::{Command, CommandFrame};
use regrind_sim::options::RegisterLayout;
use regrind_sim::register_encoding::WordOrder;
use tokio::time::Instant;

use crate::cue::Cues;

/// Command as it left the program.
#[derive(Clone, Copy, Debug)]
pub struct Sent {
    pub at: Instant,
    /// Index of the machine: 0 is the CMM, 1 the grinder.
    pub machine: usize,
    pub command: Command,
    pub frame: CommandFrame,
}

/// Line as it left the program, without its line end.
#[derive(Clone, Debug)]
pub struct Spoken {
    pub at: Instant,
    /// Index of the machine: 0 is the CMM, 1 the grinder.
    pub machine: usize,
    pub line: String,
}

/// Observed traffic.
#[derive(Clone, Debug, Default)]
pub struct Traffic {
    pub sent: Vec<Sent>,
    pub lines: Vec<Spoken>,
    /// Queries that break the rules.
    pub wrong: Vec<(Instant, String)>,
}

pub type Wires = Arc<Mutex<Traffic>>;

/// Observer of a connection of the program that carries lines.
pub struct Listening {
    wires: Wires,
    cues: Cues,
    machine: usize,
    half: Vec<u8>,
}

impl Listening {
    pub fn new((wires, cues): &(Wires, Cues), machine: usize) -> Self {
        Self { wires: wires.clone(), cues: cues.clone(), machine, half: Vec::new() }
    }

    /// Observes bytes that leave the program.
    pub fn hears(&mut self, bytes: &[u8]) {
        self.half.extend(bytes);
        while let Some(end) = self.half.iter().position(|byte| *byte == b'\n') {
            let line: Vec<u8> = self.half.drain(..=end).collect();
            let line = String::from_utf8_lossy(&line).trim().to_owned();
            let (at, machine) = (Instant::now(), self.machine);
            let mut wires = self.wires.lock().unwrap();
            if line == "set run" {
                self.cues.see_start();
            }
            if line.ends_with(" AbortE()") || line == "set abort" {
                wires.sent.push(Sent { at, machine, command: Command::Abort, frame: CommandFrame::default() });
            }
            wires.lines.push(Spoken { at, machine, line });
        }
    }
}

/// Observer of one connection of the program.
pub struct Watched {
    wires: Wires,
    cues: Cues,
    is_serial: bool,
    /// Part of the answer that has been read so far, if a query is open.
    open: Option<Vec<u8>>,
    /// Units from which synchronization data, written over this connection, was read back: they are identified.
    proven: BTreeSet<u8>,
    /// Units to which synchronization data was written.
    being_proven: BTreeSet<u8>,
}

impl Watched {
    pub fn new((wires, cues): &(Wires, Cues), is_serial: bool) -> Self {
        let (proven, being_proven) = (BTreeSet::new(), BTreeSet::new());
        Self { wires: wires.clone(), cues: cues.clone(), is_serial, open: None, proven, being_proven }
    }

    /// Observes a query that leaves the program, and the number of received bytes that the program has not read.
    pub fn asks(&mut self, request: &[u8], waiting: usize) {
        if waiting > 0 {
            self.wrong(format!("it asks while {waiting} bytes of something else wait"));
        }
        if self.open.as_ref().is_some_and(|answer| !self.is_whole(answer)) {
            self.wrong("it asks anew where an answer is owed".to_owned());
        }
        self.open = Some(Vec::new());
        let Some((unit, pdu)) = self.parts(request) else { return self.wrong(format!("it sends {request:?}")) };
        let Some(address) = pdu.get(1..3).map(|pair| u16::from_be_bytes([pair[0], pair[1]])) else { return };
        let layout = RegisterLayout::default();
        match pdu[0] {
            16 if address == layout.sync => drop(self.being_proven.insert(unit)),
            3 if address == layout.sync && self.being_proven.contains(&unit) => drop(self.proven.insert(unit)),
            16 if address == layout.command => self.commands(unit, &pdu[6..]),
            _ => {}
        }
    }

    /// Observes bytes of an answer that the program reads.
    pub fn reads(&mut self, bytes: &[u8]) {
        self.open.iter_mut().for_each(|answer| answer.extend(bytes));
    }

    fn commands(&mut self, unit: u8, bytes: &[u8]) {
        let words: Vec<u16> = bytes.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect();
        let frame = <[u16; 20]>::try_from(words).ok().and_then(|words| CommandFrame::read(WordOrder::Big, &words));
        let Some((frame, command)) = frame.and_then(|frame| Some((frame, Command::from_number(frame.command)?))) else {
            return self.wrong("it commands what is no command".to_owned());
        };
        if !self.proven.contains(&unit) {
            self.wrong(format!("{command:?} goes over a connection on which nobody has been met"));
        }
        if command == Command::Start {
            self.cues.see_start();
        }
        let machine = usize::from(unit) - 1;
        self.wires.lock().unwrap().sent.push(Sent { at: Instant::now(), machine, command, frame });
    }

    fn parts<'r>(&self, request: &'r [u8]) -> Option<(u8, &'r [u8])> {
        if self.is_serial {
            return Some((*request.first()?, request.get(1..request.len().checked_sub(2)?)?));
        }
        Some((*request.get(6)?, request.get(7..)?))
    }

    fn is_whole(&self, answer: &[u8]) -> bool {
        let length = match answer {
            [_, _, _, _, high, low, ..] if !self.is_serial => 6 + usize::from(u16::from_be_bytes([*high, *low])),
            [_, function, ..] if self.is_serial && function & 0x80 != 0 => 5,
            [_, 3, count, ..] if self.is_serial => 5 + usize::from(*count),
            [_, _, ..] if self.is_serial => 8,
            _ => return false,
        };
        answer.len() >= length
    }

    fn wrong(&self, what: String) {
        self.wires.lock().unwrap().wrong.push((Instant::now(), what));
    }
}
