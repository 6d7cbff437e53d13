//! What goes wrong on a wire, when, and as often as a test wants it.
//!
//! A [`FaultPlan`] is a list of rules; each names the requests it is about and what happens to them. Chance comes from a seed,
//! so a plan breaks the same requests in every run that asks them in the same order.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rand::RngExt;

use crate::Rng;
use crate::command::State;

/// One thing that goes wrong with a request or with the answer to it.
#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    /// The request is lost: nothing is done, nothing answered.
    DropRequest,
    /// It is carried out, and the answer is lost.
    DropReply,
    /// The answer comes so much later; what is asked meanwhile waits.
    DelayReply(Duration),
    /// The answer comes twice.
    DuplicateReply,
    /// Only so many bytes of the answer come.
    Truncate(usize),
    /// The answer to a read has a register less than was asked for, in a frame without a flaw.
    Fewer,
    /// The answer is followed by more bytes.
    Extra(Vec<u8>),
    /// Other bytes come before the answer.
    Noise(Vec<u8>),
    /// The answer bears another transaction id (TCP; nothing on RTU).
    WrongTransaction,
    /// The answer bears another unit.
    WrongUnit,
    /// The answer bears another function.
    WrongFunction,
    /// The request is not carried out and answered by this exception.
    Exception(u8),
    /// The answer comes in single bytes with a pause between them.
    Split(Duration),
    /// The CRC of the answer is wrong (RTU); on TCP its protocol id is.
    FlipCrc,
    /// One bit of the last register of the answer is wrong and every checksum of the wire right.
    FlipData,
    /// Some registers of the answer to a read, by their places in it, say something else, and every checksum of the wire is right.
    Lie(Vec<(usize, u16)>),
    /// Every two registers of an answer to a read are exchanged.
    WordSwap,
    /// So many bytes of the answer come, then the connection is closed (TCP; on RTU the rest is lost).
    Disconnect(usize),
    /// From here on the connection, or the whole line, takes every byte and gives none.
    Silence,
    /// The two snapshot numbers of the next status disagree.
    TornStatus,
    /// The wire carries the request out once more, before that many requests later.
    CarryOutAgain(u64),
    /// The application stops before the request is carried out; the wire goes on.
    Freeze,
    /// The application goes on.
    Thaw,
    /// The application starts anew, with another boot id, before the request is carried out.
    Reboot,
}

/// What a rule can know of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Request {
    /// Counted on this wire from 1.
    pub number: u64,
    /// The unit it is for.
    pub unit: u8,
    /// The Modbus function.
    pub function: u8,
    /// The first register.
    pub address: u16,
    /// How many registers.
    pub count: u16,
    /// The command, if it writes a whole command block.
    pub command: Option<u16>,
    /// The state of the machine before the request, if the unit is known.
    pub state: Option<State>,
}

/// Which requests a rule is about.
pub enum When {
    /// All of them.
    Any,
    /// The n-th request on this wire, from 1.
    Nth(u64),
    /// Every n-th request on this wire.
    Every(u64),
    /// Each with this probability.
    Chance(f64),
    /// Those that write at this address first.
    Writing(u16),
    /// Those that read from this address first.
    Reading(u16),
    /// Those that write this command.
    Commanding(u16),
    /// Those that find the machine in this state.
    InState(State),
    /// Those that a test likes.
    Matching(Box<dyn FnMut(&Request) -> bool + Send>),
}

impl When {
    fn is_about(&mut self, request: &Request, rng: &mut Rng) -> bool {
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
    /// One of these happens, drawn if there are several.
    faults: Vec<Fault>,
    /// Requests it is about that are let through first.
    skip: u64,
    /// How often it may still happen.
    left: u64,
}

/// A list of rules, and what they have done.
pub struct FaultPlan {
    rules: Vec<Rule>,
    rng: Rng,
    requests: u64,
    fired: Vec<(Request, Fault)>,
    again: Vec<(u64, u8, Vec<u8>)>,
}

impl FaultPlan {
    /// Nothing goes wrong; chance, if a rule wants it, comes from the seed.
    pub fn new(seed: u64) -> Self {
        Self { rules: Vec::new(), rng: crate::rng(seed), requests: 0, fired: Vec::new(), again: Vec::new() }
    }

    /// Lets one of some faults happen to every request with a probability.
    pub fn seeded(seed: u64, share: f64, faults: Vec<Fault>) -> Self {
        let mut plan = Self::new(seed);
        plan.rules.push(Rule { when: When::Chance(share), faults, skip: 0, left: u64::MAX });
        plan
    }

    /// Adds a fault of the first request that the rule is about.
    pub fn once(self, when: When, fault: Fault) -> Self {
        self.times(1, 1, when, fault)
    }

    /// Adds a fault of every request that the rule is about.
    pub fn always(self, when: When, fault: Fault) -> Self {
        self.times(1, u64::MAX, when, fault)
    }

    /// Adds a fault of `count` requests that the rule is about, beginning with the `first` of them, from 1.
    pub fn times(mut self, first: u64, count: u64, when: When, fault: Fault) -> Self {
        self.rules.push(Rule { when, faults: vec![fault], skip: first.saturating_sub(1), left: count });
        self
    }
}

/// A fault plan that a wire and a test share.
#[derive(Clone)]
pub struct Faults(Arc<Mutex<FaultPlan>>);

impl Default for Faults {
    fn default() -> Self {
        FaultPlan::new(0).into()
    }
}

impl From<FaultPlan> for Faults {
    fn from(plan: FaultPlan) -> Self {
        Self(Arc::new(Mutex::new(plan)))
    }
}

impl Faults {
    /// Nothing goes wrong.
    pub fn none() -> Self {
        Self::default()
    }

    /// Replaces the rules; the count of requests begins anew, and what is to be carried out again is forgotten.
    pub fn set(&self, plan: FaultPlan) {
        *self.lock() = plan;
    }

    /// Returns what has happened to which requests.
    pub fn fired(&self) -> Vec<(Request, Fault)> {
        self.lock().fired.clone()
    }

    /// Returns how many requests have come.
    pub fn requests(&self) -> u64 {
        self.lock().requests
    }

    /// Returns what happens to a request, after giving it its number.
    pub(crate) fn meet(&self, request: &mut Request) -> Vec<Fault> {
        let mut plan = self.lock();
        let FaultPlan { rules, rng, requests, fired, .. } = &mut *plan;
        *requests += 1;
        request.number = *requests;
        let mut met = Vec::new();
        for rule in rules.iter_mut().filter(|rule| rule.left > 0 && !rule.faults.is_empty()) {
            if !rule.when.is_about(request, rng) {
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

    /// Keeps a request to be carried out again.
    pub(crate) fn keep(&self, before: u64, unit: u8, pdu: &[u8]) {
        self.lock().again.push((before, unit, pdu.to_vec()));
    }

    /// Returns the requests that are carried out again before this one.
    pub(crate) fn due(&self, number: u64) -> Vec<(u8, Vec<u8>)> {
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
