//! A machine whose physics is a counter, and payloads for it.
#![allow(dead_code)]

use std::sync::{Arc, Mutex};

use regrind_sim::body::{Kind, Payload, Payloads, Physics, Progress, Refusal, ResultData};
use regrind_sim::command::interlock;

/// Calls of the handshake to the physics, in order, without those that only advance the time.
pub type RecordedCalls = Arc<Mutex<Vec<String>>>;

/// A job is a number of seconds; a payload whose first byte is 0xEE is of another part.
pub struct Counter {
    pub kind: Kind,
    pub length_s: f64,
    pub done_s: f64,
    pub fault: Arc<Mutex<u16>>,
    pub interlocks: Arc<Mutex<u16>>,
    pub calls: RecordedCalls,
    pub got: Arc<Mutex<Payloads>>,
    pub duration_s: f64,
}

impl Counter {
    pub fn new(kind: Kind, length_s: f64) -> Self {
        Self {
            kind,
            length_s,
            done_s: 0.0,
            fault: Arc::default(),
            interlocks: Arc::new(Mutex::new(interlock::ALL)),
            calls: Arc::default(),
            got: Arc::default(),
            duration_s: f64::NAN,
        }
    }

    fn record_call(&self, what: impl Into<String>) {
        self.calls.lock().unwrap().push(what.into());
    }

    fn progress(&self) -> Progress {
        Progress {
            done: (10.0 * self.done_s).round() as u32,
            total: (10.0 * self.length_s).round() as u32,
            finished: self.done_s >= self.length_s,
            fault: *self.fault.lock().unwrap(),
        }
    }
}

impl Physics for Counter {
    fn kind(&self) -> Kind {
        self.kind
    }

    fn name(&self) -> String {
        "COUNTER 7 of the simulated cell, serial number 12345".into()
    }

    fn check(&self, kind: u16, payload: &Payload) -> Result<(), Refusal> {
        if payload.bytes[0] == 0xEE {
            return Err(Refusal { answer: 8, reason: format!("payload {kind} is of another part") });
        }
        Ok(())
    }

    fn prepare(&mut self, job: u32, _: u16, payloads: &Payloads) -> Result<Progress, Refusal> {
        if job == 666 {
            return Err(Refusal { answer: 10, reason: "the wheel is too large".into() });
        }
        self.done_s = 0.0;
        *self.got.lock().unwrap() = payloads.clone();
        Ok(self.progress())
    }

    fn begin(&mut self) {
        self.duration_s = 0.0;
        self.record_call("begin");
    }

    fn advance(&mut self, seconds: f64) -> Progress {
        assert!(seconds > 0.0 && seconds.is_finite(), "{seconds}");
        self.done_s += seconds;
        self.duration_s += seconds;
        self.progress()
    }

    fn retract(&mut self) {
        self.record_call("retract");
    }

    fn end_job(&mut self, result: u16) -> ResultData {
        self.record_call(format!("outcome {result}"));
        let (kind, format, bytes, records) = match self.kind {
            Kind::Cmm => (4, 2, (0..31 * 20).map(|i| i as u8).collect::<Vec<u8>>(), 31),
            Kind::Grinder => (5, 1, (100..164).collect(), 1),
        };
        ResultData {
            kind,
            format,
            bytes,
            records,
            coordinates: u16::from(self.kind == Kind::Cmm),
            probe_radius_mm: 1.5,
            scale_mm: 1e-5,
            temperature_c: 20.25,
            duration_s: self.duration_s,
        }
    }

    fn interlocks(&self) -> u16 {
        *self.interlocks.lock().unwrap()
    }

    fn temperature_c(&self) -> f64 {
        -1.5
    }
}

/// Returns the payloads that a kind of machine needs: kind, bytes, identity.
pub fn payloads(kind: Kind) -> Vec<(u16, Vec<u8>, [u8; 32])> {
    let bytes = |length: usize| (0..length).map(|i| (i % 251) as u8).collect::<Vec<u8>>();
    match kind {
        Kind::Cmm => vec![(1, bytes(64 + 31 * 56), [11; 32])],
        Kind::Grinder => vec![(2, bytes(96 + 8 * 63), [22; 32]), (3, bytes(128), [33; 32])],
    }
}

/// Returns the digest of those payloads.
pub fn digest(kind: Kind) -> u32 {
    let identities: Vec<u8> = payloads(kind).into_iter().flat_map(|(_, _, identity)| identity).collect();
    crc32fast::hash(&identities)
}
