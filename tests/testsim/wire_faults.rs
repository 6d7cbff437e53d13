//! Faults of a Modbus wire, with their conditions and their number.
//!
//! A [`FaultPlan`] is a list of rules; each selects requests and gives their faults. Random choices come from a seed,
//! so a plan breaks the same requests in every run with the same order of requests.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rand::RngExt;
use regrind_sim::Rng;
use regrind_sim::command::State;
use regrind_sim::registers::SimulatedMachine;
use regrind_sim::wire::{After, Delivery, Exchange, Framing, SharedMachine, WireFaults, carry_out};

/// Machines that are served on a wire with faults.
pub type Serving = regrind_sim::wire::Serving<SharedFaultPlan>;

/// Fault of a request or of its answer.
#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    /// The request is lost: it is not carried out and not answered.
    DropRequest,
    /// The request is carried out, and the answer is lost.
    DropReply,
    /// The answer is late by this time; later requests wait.
    DelayReply(Duration),
    /// The answer comes twice.
    DuplicateReply,
    /// Only this number of bytes of the answer comes.
    Truncate(usize),
    /// The answer to a read has one register less than requested, in a correct frame.
    Fewer,
    /// The answer is followed by more bytes.
    Extra(Vec<u8>),
    /// Other bytes come before the answer.
    Noise(Vec<u8>),
    /// The answer has another transaction id (TCP; no effect on RTU).
    WrongTransaction,
    /// The answer has another unit id.
    WrongUnit,
    /// The answer has another function code.
    WrongFunction,
    /// The request is not carried out, and is answered by this exception.
    Exception(u8),
    /// The answer comes in single bytes with a pause between them.
    Split(Duration),
    /// The CRC of the answer is wrong (RTU); on TCP its protocol id is.
    FlipCrc,
    /// One bit of the last register of the answer is wrong, and every checksum of the wire is right.
    FlipData,
    /// Registers at these indices of the answer to a read have other values, and every checksum of the wire is right.
    Lie(Vec<(usize, u16)>),
    /// In the answer to a read, the two registers of each pair are exchanged.
    WordSwap,
    /// This number of bytes of the answer comes, then the connection is closed (TCP; on RTU the rest is lost).
    Disconnect(usize),
    /// From here on, the connection or the whole line accepts every byte and returns none.
    Silence,
    /// The two snapshot numbers of the next status disagree.
    TornStatus,
    /// The request is carried out a second time, before the request that follows this number of requests later.
    CarryOutAgain(u64),
    /// The application freezes before the request is carried out; the wire continues.
    Freeze,
    /// The application continues.
    Thaw,
    /// The application restarts, with another boot id, before the request is carried out.
    Reboot,
}

/// Properties of a request that a rule can use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Request {
    /// Number of the request on this wire, from 1.
    pub number: u64,
    /// Unit id of the request.
    pub unit: u8,
    /// Modbus function code.
    pub function: u8,
    /// Address of the first register.
    pub address: u16,
    /// Number of registers.
    pub count: u16,
    /// Command, if the request writes a whole command block.
    pub command: Option<u16>,
    /// State of the machine before the request, if the unit is known.
    pub state: Option<State>,
}

/// Condition that selects the requests of a rule.
pub enum When {
    /// All requests.
    Any,
    /// The n-th request on this wire, from 1.
    Nth(u64),
    /// Every n-th request on this wire.
    Every(u64),
    /// Each request with this probability.
    Chance(f64),
    /// Requests that write from this address on.
    Writing(u16),
    /// Requests that read from this address on.
    Reading(u16),
    /// Requests that write this command.
    Commanding(u16),
    /// Requests that find the machine in this state.
    InState(State),
    /// Requests for which this function returns true.
    Matching(Box<dyn FnMut(&Request) -> bool + Send>),
}

impl When {
    fn matches(&mut self, request: &Request, rng: &mut Rng) -> bool {
        match self {
            Self::Any => true,
            Self::Nth(n) => request.number == *n,
            Self::Every(n) => *n > 0 && request.number.is_multiple_of(*n),
            Self::Chance(share) => rng.random::<f64>() < *share,
            Self::Writing(address) => request.function != 3 && request.address == *address,
            Self::Reading(address) => request.function == 3 && request.address == *address,
            Self::Commanding(command) => request.command == Some(*command),
            Self::InState(state) => request.state == Some(*state),
            Self::Matching(like) => like(request),
        }
    }
}

struct Rule {
    when: When,
    /// Possible faults; one is drawn if there are several.
    faults: Vec<Fault>,
    /// Number of selected requests that pass first without a fault.
    skip: u64,
    /// Number of times that the fault can still happen.
    left: u64,
}

/// List of rules, and the faults that have happened.
pub struct FaultPlan {
    rules: Vec<Rule>,
    rng: Rng,
    requests: u64,
    fired: Vec<(Request, Fault)>,
    again: Vec<(u64, u8, Vec<u8>)>,
}

impl FaultPlan {
    /// Creates a plan without faults. `seed` initializes the random choices of the rules that the caller adds to the
    /// plan later. Equal seeds give equal choices for the same sequence of requests.
    pub fn new(seed: u64) -> Self {
        Self { rules: Vec::new(), rng: regrind_sim::rng(seed), requests: 0, fired: Vec::new(), again: Vec::new() }
    }

    /// Creates a plan in which each request has a fault with the probability `share`, from 0 to 1. Each fault is drawn
    /// at random from `faults`. `seed` initializes the random choices. If `faults` is empty, the plan has no faults.
    pub fn seeded(seed: u64, share: f64, faults: Vec<Fault>) -> Self {
        let mut plan = Self::new(seed);
        plan.rules.push(Rule { when: When::Chance(share), faults, skip: 0, left: u64::MAX });
        plan
    }

    /// Adds a fault for the first request that `when` selects.
    pub fn once(self, when: When, fault: Fault) -> Self {
        self.times(1, 1, when, fault)
    }

    /// Adds a fault for every request that `when` selects.
    pub fn always(self, when: When, fault: Fault) -> Self {
        self.times(1, u64::MAX, when, fault)
    }

    /// Adds a fault for consecutive requests among those that `when` selects. The fault begins at the selected request
    /// number `first`, counted from 1, and happens `count` times.
    pub fn times(mut self, first: u64, count: u64, when: When, fault: Fault) -> Self {
        self.rules.push(Rule { when, faults: vec![fault], skip: first.saturating_sub(1), left: count });
        self
    }
}

/// Fault plan shared by a wire and a test.
#[derive(Clone)]
pub struct SharedFaultPlan(Arc<Mutex<FaultPlan>>);

impl Default for SharedFaultPlan {
    fn default() -> Self {
        FaultPlan::new(0).into()
    }
}

impl From<FaultPlan> for SharedFaultPlan {
    fn from(plan: FaultPlan) -> Self {
        Self(Arc::new(Mutex::new(plan)))
    }
}

impl SharedFaultPlan {
    /// Creates a plan without faults.
    pub fn none() -> Self {
        Self::default()
    }

    /// Replaces the fault plan by `plan`. The requests are counted from 1 again. The list of the faults that have
    /// happened is lost. Requests that were stored for a second execution are lost too.
    pub fn set(&self, plan: FaultPlan) {
        *self.lock() = plan;
    }

    /// Returns the faults that have happened since this plan was created or set, in order of time. Each fault comes
    /// with the request to which it happened.
    pub fn fired(&self) -> Vec<(Request, Fault)> {
        self.lock().fired.clone()
    }

    /// Returns the number of requests that were received since this plan was created or set.
    pub fn requests(&self) -> u64 {
        self.lock().requests
    }

    /// Counts the request `request` and writes its number, from 1, into `request.number`. Returns the faults that the
    /// rules of the plan select for this request. The list is empty if no rule selects it. Each returned fault is also
    /// added to the list of faults that have happened.
    fn draw(&self, request: &mut Request) -> Vec<Fault> {
        let mut plan = self.lock();
        let FaultPlan { rules, rng, requests, fired, .. } = &mut *plan;
        *requests += 1;
        request.number = *requests;
        let mut met = Vec::new();
        for rule in rules.iter_mut().filter(|rule| rule.left > 0 && !rule.faults.is_empty()) {
            if !rule.when.matches(request, rng) {
                continue;
            }
            if rule.skip > 0 {
                rule.skip -= 1;
                continue;
            }
            rule.left = rule.left.saturating_sub(1);
            let fault = rule.faults[rng.random_range(0..rule.faults.len())].clone();
            fired.push((*request, fault.clone()));
            met.push(fault);
        }
        met
    }

    /// Stores a request that will be carried out a second time. `before` is the number of the later request before
    /// which this happens. `unit` is the unit id of the stored request, and `pdu` is its protocol data unit.
    fn defer(&self, before: u64, unit: u8, pdu: &[u8]) {
        self.lock().again.push((before, unit, pdu.to_vec()));
    }

    /// Removes and returns the stored requests that must be carried out a second time before the request with the
    /// number `number`. Each entry is the unit id and the protocol data unit (PDU) of a stored request.
    fn take_due(&self, number: u64) -> Vec<(u8, Vec<u8>)> {
        let mut plan = self.lock();
        let (due, later) = plan.again.drain(..).partition(|(before, ..)| *before <= number);
        plan.again = later;
        let due: Vec<(u64, u8, Vec<u8>)> = due;
        due.into_iter().map(|(_, unit, pdu)| (unit, pdu)).collect()
    }

    fn lock(&self) -> MutexGuard<'_, FaultPlan> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl WireFaults for SharedFaultPlan {
    /// Executes a request and returns the answer with its faults. First executes the stored requests whose second
    /// execution is due before this request. A fault can prevent the execution of the request.
    fn answer(&self, exchange: &Exchange<'_>) -> Delivery {
        let Exchange { units, framing, unit, pdu } = *exchange;
        let mut request = describe(exchange);
        let met = self.draw(&mut request);
        for (unit, pdu) in self.take_due(request.number) {
            if let Some((_, machine)) = units.iter().find(|(id, _)| *id == unit) {
                carry_out(machine, &pdu);
            }
        }
        let mut exception = None;
        for fault in &met {
            match (fault, exchange.machine()) {
                (Fault::Exception(code), _) => exception = Some(vec![pdu[0] | 0x80, *code]),
                (Fault::DropRequest, _) => exception = Some(Vec::new()),
                (Fault::CarryOutAgain(after), _) => self.defer(request.number + after, unit, pdu),
                (Fault::Freeze, Some(machine)) => machine.with(|machine| machine.freeze(true)),
                (Fault::Thaw, Some(machine)) => machine.with(|machine| machine.freeze(false)),
                (Fault::Reboot, Some(machine)) => machine.with(SimulatedMachine::reboot),
                (Fault::TornStatus, Some(machine)) => machine.with(SimulatedMachine::tear_status),
                _ => {}
            }
        }
        deliver(framing, unit, exception.unwrap_or_else(|| exchange.reply()), &met)
    }
}

fn describe(exchange: &Exchange<'_>) -> Request {
    let Exchange { unit, pdu, .. } = *exchange;
    let word = |at: usize| pdu.get(at..at + 2).map_or(0, |pair| u16::from_be_bytes([pair[0], pair[1]]));
    let (address, count) = (word(1), if pdu[0] == 6 { 1 } else { word(3) });
    let look = |machine: &SharedMachine| machine.with(|m| (m.state(), m.layout().command));
    let (state, block) = exchange.machine().map(look).unzip();
    let is_command = pdu[0] == 16 && block == Some(address) && count == 20;
    let command = is_command.then(|| word(10));
    Request { number: 0, unit, function: pdu[0], address, count, command, state }
}

fn deliver(framing: Framing, unit: u8, mut reply: Vec<u8>, met: &[Fault]) -> Delivery {
    let mut delivery = Delivery::at_once(Vec::new());
    if reply.is_empty() {
        return delivery;
    }
    let (mut framing, mut unit) = (framing, unit);
    for fault in met {
        match fault {
            Fault::WrongTransaction => {
                if let Framing::Tcp { transaction } = &mut framing {
                    *transaction ^= 0x5A5A;
                }
            }
            Fault::WrongUnit => unit ^= 0x40,
            Fault::WrongFunction => reply[0] ^= 0x01,
            Fault::FlipData => reply.last_mut().into_iter().for_each(|byte| *byte ^= 0x10),
            Fault::Fewer if reply[0] == 3 && reply[1] >= 2 => {
                reply[1] -= 2;
                reply.truncate(reply.len() - 2);
            }
            Fault::Lie(instead) if reply[0] == 3 => {
                for (register, value) in instead {
                    let at = 2 + 2 * register;
                    reply.get_mut(at..at + 2).into_iter().for_each(|word| word.copy_from_slice(&value.to_be_bytes()));
                }
            }
            Fault::WordSwap if reply[0] == 3 => reply[2..].chunks_exact_mut(4).for_each(|pair| pair.rotate_left(2)),
            _ => {}
        }
    }
    delivery.bytes = framing.frame(unit, &reply, met.contains(&Fault::FlipCrc));
    for fault in met {
        match fault {
            Fault::DropReply => delivery.bytes.clear(),
            Fault::DelayReply(delay) => delivery.delay = *delay,
            Fault::DuplicateReply => delivery.bytes = delivery.bytes.repeat(2),
            Fault::Truncate(length) => delivery.bytes.truncate(*length),
            Fault::Extra(bytes) => delivery.bytes.extend(bytes),
            Fault::Noise(bytes) => delivery.bytes = [&bytes[..], &delivery.bytes].concat(),
            Fault::Split(pause) => delivery.pause = Some(*pause),
            Fault::Disconnect(length) => {
                delivery.bytes.truncate(*length);
                delivery.after = After::Closed;
            }
            Fault::Silence => {
                delivery.bytes.clear();
                delivery.after = After::Silent;
            }
            _ => {}
        }
    }
    delivery
}
