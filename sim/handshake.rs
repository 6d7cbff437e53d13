//! Machine's side of the handshake of docs/modbus.md: one state, commands that are values and not pulses, and time as
//! an input.
//!
//! For every frame, the number and the answer are latched before anything moves. A (job, cycle) moves the machine only
//! once in its life. Nothing here knows the address of a register, or a clock.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::time::Duration;

use rand::RngExt;

use crate::Rng;
use crate::body::{Kind, Payloads, Physics, Progress};
use crate::command::{Answer, Command, CommandFrame, Mode, State, interlock};
use crate::event_log::{BeatMonitor, EventLog, HandshakeEvent};
use crate::options::MachineOptions;
use crate::register_encoding::{RegisterBlock, WordOrder};
use crate::transfer::{Arrived, Origin, Outbox, Slot, slot_of};

/// Faults of docs/modbus.md that the handshake itself raises.
const FAULT_STOP_CIRCUIT: u16 = 1;
const FAULT_SUPPLIES: u16 = 3;
const FAULT_SILENT: u16 = 20;
const FAULT_OTHER: u16 = 30;

/// Lifetime of a token.
const TOKEN_LIFE: Duration = Duration::from_secs(30);

/// Maximum time step of the physics, in s, unless a tick would then have more than 200 steps.
const STEP_S: f64 = 0.1;

/// Prepared job.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct JobKey {
    job: u32,
    cycle: u16,
    digest: u32,
}

/// Machine's side of the handshake.
pub(crate) struct Handshake {
    pub(crate) body: Box<dyn Physics>,
    pub(crate) log: EventLog,
    pub(crate) now: Duration,
    pub(crate) speed: f64,
    pub(crate) slots: [Option<Slot>; 3],
    pub(crate) outbox: Option<Outbox>,
    pub(crate) state: State,
    pub(crate) boot_id: u32,
    order: WordOrder,
    silence_limit: Duration,
    acting: Duration,
    rng: Rng,
    mode: Mode,
    opened: u16,
    acknowledged: u32,
    answer: Answer,
    fault: u16,
    job: JobKey,
    token: u32,
    token_remaining: Duration,
    /// True if a START began a job that has not ended.
    running: bool,
    begun_by: u32,
    begun: BTreeSet<(u32, u16)>,
    trusting: bool,
    gives_ahead: bool,
    /// True if the identities in force are to be changed after the next payload has come into force and was read.
    spoils: bool,
    /// True if the identities in force are to be changed at the next read of the slots in force.
    spoils_soon: bool,
    last_begun: (u32, u16),
    done: u32,
    result: u16,
    progress: Progress,
    owner: u32,
    epoch: u32,
    silent: Duration,
    /// Beats of the owner during the running job.
    beat_monitor: BeatMonitor,
    acting_left: Duration,
}

impl Handshake {
    pub(crate) fn new(body: Box<dyn Physics>, boot_id: u32, options: &MachineOptions) -> Self {
        let silence_ms = if options.lost_after_ms == 0 { 3000 } else { options.lost_after_ms };
        Self {
            body,
            log: EventLog::default(),
            now: Duration::ZERO,
            speed: options.speed,
            slots: [None, None, None],
            outbox: None,
            state: State::Idle,
            boot_id: boot_id.max(1),
            order: options.word_order,
            silence_limit: Duration::from_millis(silence_ms.into()),
            acting: options.acting,
            rng: crate::rng(options.seed ^ u64::from(boot_id)),
            mode: Mode::Automatic,
            opened: 0,
            acknowledged: 0,
            answer: Answer::None,
            fault: 0,
            job: JobKey::default(),
            token: 0,
            token_remaining: Duration::ZERO,
            running: false,
            begun_by: 0,
            begun: options.last_begun.into_iter().collect(),
            trusting: options.trusting,
            gives_ahead: options.gives_ahead,
            spoils: false,
            spoils_soon: false,
            last_begun: options.last_begun.unwrap_or_default(),
            done: 0,
            result: 0,
            progress: Progress::default(),
            owner: 0,
            epoch: 0,
            silent: Duration::ZERO,
            beat_monitor: BeatMonitor::default(),
            acting_left: Duration::ZERO,
        }
    }

    /// Handles the 20 registers of the command block after the client has written the last of them. Carries out the
    /// command if it is new and allowed. Ignores a block with a wrong CRC, and a sequence number equal to the last one.
    /// Also ignores a lower sequence number, except for CLAIM and ABORT.
    pub(crate) fn read_command(&mut self, words: &[u16; 20]) {
        let Some(frame) = CommandFrame::read(self.order, words) else { return self.note(HandshakeEvent::Broken) };
        let (sequence, command) = (frame.sequence, Command::from_number(frame.command));
        if sequence == self.acknowledged {
            return self.note(HandshakeEvent::Repeated { sequence });
        }
        if sequence < self.acknowledged && !matches!(command, Some(Command::Claim | Command::Abort)) {
            return self.note(HandshakeEvent::Old { sequence });
        }
        let answer = command.map_or(Answer::Unknown, |command| self.judge(command, &frame));
        self.acknowledged = sequence;
        self.answer = answer;
        self.note(HandshakeEvent::Commanded { frame, answer, state: self.state });
        if let (Some(command), Answer::Accepted) = (command, answer) {
            self.act(command, &frame);
        }
    }

    /// Returns true if the client with the id `owner` owns the machine. The id 0 is never an owner.
    pub(crate) fn is_owned_by(&self, owner: u32) -> bool {
        owner != 0 && owner == self.owner
    }

    /// Records a heartbeat of the client that owns the machine, and restarts the clock that measures the silence of
    /// this client.
    pub(crate) fn beat(&mut self) {
        self.beat_monitor.record(self.now);
        self.hear();
    }

    /// Restarts the clock that measures how long the owner has been silent.
    fn hear(&mut self) {
        self.silent = Duration::ZERO;
    }

    fn judge(&mut self, command: Command, frame: &CommandFrame) -> Answer {
        match command {
            Command::Claim => return self.judge_claim(frame),
            Command::Abort => return Answer::Accepted,
            _ => {}
        }
        if self.owner == 0 || (frame.owner, frame.epoch) != (self.owner, self.epoch) {
            return Answer::NotOwner;
        }
        self.hear();
        if !command.is_allowed_in(self.state) {
            if command == Command::Hold {
                self.token = 0;
            }
            return Answer::NotAllowed;
        }
        match command {
            Command::Prepare => self.judge_prepare(frame),
            Command::Start => self.judge_start(frame),
            Command::Resume if !self.is_safe(interlock::MOVING) => Answer::Interlock,
            Command::Acknowledge if frame.argument != self.done => Answer::Argument,
            _ => Answer::Accepted,
        }
    }

    fn judge_claim(&self, frame: &CommandFrame) -> Answer {
        let free = self.owner == 0 || self.is_client_lost();
        let mine = frame.owner == self.owner && frame.epoch >= self.epoch;
        if frame.owner != 0 && (free || mine) { Answer::Accepted } else { Answer::NotOwner }
    }

    fn judge_prepare(&mut self, frame: &CommandFrame) -> Answer {
        if !self.is_safe(interlock::ALL) {
            return Answer::Interlock;
        }
        match self.digest() {
            None => return Answer::Payload,
            Some(digest) if frame.job == 0 || (digest != frame.digest && !self.trusting) => return Answer::Different,
            Some(_) => {}
        }
        let payload = |index: usize| self.slots[index].as_ref().map(|slot| slot.payload.clone());
        let payloads = Payloads { plan: payload(0), map: payload(1), pass: payload(2) };
        match self.body.prepare(frame.job, frame.cycle, &payloads) {
            Ok(progress) => {
                self.progress = progress;
                Answer::Accepted
            }
            Err(refusal) => match refusal.answer {
                9 => Answer::Interlock,
                10 => Answer::Limits,
                _ => Answer::Payload,
            },
        }
    }

    fn judge_start(&self, frame: &CommandFrame) -> Answer {
        let asked = JobKey { job: frame.job, cycle: frame.cycle, digest: frame.digest };
        if !self.is_safe(interlock::ALL) {
            Answer::Interlock
        } else if self.token == 0 || frame.token != self.token {
            Answer::Token
        } else if asked != self.job || (self.digest() != Some(frame.digest) && !self.trusting) {
            Answer::Different
        } else if self.begun.contains(&(frame.job, frame.cycle)) && !self.trusting {
            Answer::Begun
        } else {
            Answer::Accepted
        }
    }

    /// Returns the digest of the payloads in force (the plan, or the map and the pass, that the machine stores and
    /// uses). The digest is the CRC-32 of their SHA-256 identities. Returns `None` if a payload that this kind of
    /// machine needs is missing.
    fn digest(&self) -> Option<u32> {
        let needed: &[usize] = match self.body.kind() {
            Kind::Cmm => &[0],
            Kind::Grinder => &[1, 2],
        };
        let mut hasher = crc32fast::Hasher::new();
        for index in needed {
            hasher.update(&self.slots[*index].as_ref()?.payload.identity);
        }
        Some(hasher.finalize())
    }

    /// Carries out `command`, which the machine has already accepted and answered. `frame` contains the arguments of
    /// the command.
    fn act(&mut self, command: Command, frame: &CommandFrame) {
        match command {
            Command::Claim => {
                (self.owner, self.epoch, self.token) = (frame.owner, frame.epoch, 0);
                self.hear();
            }
            Command::Prepare => {
                self.job = JobKey { job: frame.job, cycle: frame.cycle, digest: frame.digest };
                self.token = self.rng.random_range(1..=u32::MAX);
                self.token_remaining = TOKEN_LIFE;
                self.enter(State::Prepared);
            }
            Command::Start => self.begin(frame),
            Command::Hold => self.hold(0),
            Command::Resume => {
                self.fault = 0;
                self.enter(State::Execute);
            }
            Command::Stop if self.state == State::Prepared => self.enter(State::Idle),
            Command::Stop => self.retract(State::Stopping),
            Command::Abort if matches!(self.state, State::Aborting | State::Aborted) => {}
            Command::Abort => self.retract(State::Aborting),
            Command::Clear => self.enter(State::Idle),
            Command::Acknowledge => {
                (self.done, self.result) = (0, 0);
                self.enter(State::Idle);
            }
            Command::Release => (self.owner, self.epoch, self.token) = (0, 0, 0),
        }
    }

    fn begin(&mut self, frame: &CommandFrame) {
        let (job, cycle) = (frame.job, frame.cycle);
        self.token = 0;
        self.begun_by = frame.sequence;
        self.last_begun = (job, cycle);
        self.begun.insert((job, cycle));
        self.running = true;
        self.beat_monitor = BeatMonitor::new(self.now);
        self.note(HandshakeEvent::Began { start: frame.sequence, job, cycle });
        self.enter(State::Execute);
        self.body.begin();
    }

    fn hold(&mut self, fault: u16) {
        self.show(fault);
        self.retract(State::Holding);
    }

    /// Moves the wheel or the probe clear of the part, and enters the state `acting`: HOLDING, STOPPING or ABORTING.
    /// The machine leaves this state by itself after a fixed time. The token (the random number that PREPARE gives and
    /// START must repeat) becomes invalid.
    fn retract(&mut self, acting: State) {
        self.token = 0;
        self.acting_left = self.acting;
        self.enter(acting);
        self.body.retract();
    }

    /// Enters FAULTED with the fault number `fault` of docs/modbus.md until CLEAR, and ends a running job with the
    /// result failed.
    pub(crate) fn fail(&mut self, fault: u16) {
        self.token = 0;
        self.show(fault);
        self.body.retract();
        self.enter(State::Faulted);
        self.end(4);
    }

    fn show(&mut self, fault: u16) {
        self.fault = fault;
        if fault != 0 {
            self.note(HandshakeEvent::Fault { fault });
        }
    }

    fn enter(&mut self, to: State) {
        if to == State::Idle {
            (self.job, self.token, self.fault) = (JobKey::default(), 0, 0);
            self.outbox = None;
        }
        let from = std::mem::replace(&mut self.state, to);
        if from != to {
            self.note(HandshakeEvent::Changed { from, to });
        }
    }

    /// Ends the running job, and stores its result in the outbox. `result` is the result number of docs/modbus.md: 1
    /// complete, 2 stopped, 3 aborted, 4 failed. Returns false if the result data cannot be encoded. Returns true and
    /// does nothing if no job runs.
    fn end(&mut self, result: u16) -> bool {
        if !std::mem::take(&mut self.running) {
            return true;
        }
        (self.done, self.result) = (self.begun_by, result);
        self.note(HandshakeEvent::Ended {
            start: self.begun_by,
            result,
            beats: self.beat_monitor.statistics(self.now),
        });
        let origin = self.origin();
        self.outbox = Outbox::new(self.order, self.body.end_job(result), origin);
        self.outbox.is_some()
    }

    /// Returns the data that identify the result of the running or last job. These are the job number, the cycle, the
    /// `done` number (the sequence number of the START of the job that ended last), and the SHA-256 identity of the
    /// plan or map.
    fn origin(&self) -> Origin {
        let slot = self.slots[if self.body.kind() == Kind::Cmm { 0 } else { 1 }].as_ref();
        let identity = slot.map_or([0; 32], |slot| slot.payload.identity);
        Origin { job: self.job.job, cycle: self.job.cycle, done: self.done, identity }
    }

    /// Returns true if a client can read the complete pages of a result (blocks of registers with result data) while
    /// the job still runs. Two conditions must hold. The option `gives_ahead` of the simulator is set, and this kind of
    /// machine has partial results.
    pub(crate) fn gives_ahead(&self) -> bool {
        self.gives_ahead && self.body.has_partial_result()
    }

    /// Returns the outbox (result header and data) that a client can read now. In the state COMPLETE this is the whole
    /// result. While a job runs, is held or stops, this is the partial result, if the machine offers one. Returns
    /// `None` in all other states, or if there is no result.
    pub(crate) fn outbox(&self) -> Option<Cow<'_, Outbox>> {
        match self.state {
            State::Complete => self.outbox.as_ref().map(Cow::Borrowed),
            State::Execute | State::Holding | State::Held | State::Stopping if self.running && self.gives_ahead() => {
                Outbox::partial(self.order, self.body.partial_result()?, self.origin()).map(Cow::Owned)
            }
            _ => None,
        }
    }

    fn complete(&mut self, result: u16) {
        if self.end(result) {
            self.enter(State::Complete);
        } else {
            self.result = 4;
            self.fail(FAULT_OTHER);
        }
    }

    /// Advances the machine by the real time `elapsed`, which must be at most a few hundredths of a second.
    pub(crate) fn advance_time(&mut self, elapsed: Duration) {
        self.now += elapsed;
        self.silent = self.silent.saturating_add(elapsed);
        match self.state {
            State::Prepared => self.wait_for_start(elapsed),
            State::Execute => self.execute(elapsed),
            State::Holding | State::Stopping | State::Aborting => {
                self.acting_left = self.acting_left.saturating_sub(elapsed);
                if self.acting_left.is_zero() {
                    self.arrive();
                }
            }
            _ => {}
        }
    }

    fn arrive(&mut self) {
        match self.state {
            State::Holding => self.enter(State::Held),
            State::Stopping => self.complete(2),
            State::Aborting => {
                self.enter(State::Aborted);
                self.end(3);
            }
            _ => {}
        }
    }

    fn wait_for_start(&mut self, elapsed: Duration) {
        self.token_remaining = self.token_remaining.saturating_sub(elapsed);
        if !self.is_safe(interlock::ALL) {
            self.token = 0;
        }
        if self.token_remaining.is_zero() {
            self.enter(State::Idle);
        }
    }

    fn execute(&mut self, elapsed: Duration) {
        let lost = interlock::MOVING & !self.interlocks();
        if lost != 0 {
            return self.fail(match lost {
                interlock::SUPPLIES => FAULT_SUPPLIES,
                interlock::CLAMPED => FAULT_OTHER,
                _ => FAULT_STOP_CIRCUIT,
            });
        }
        if self.is_client_lost() {
            return self.hold(FAULT_SILENT);
        }
        if !self.running {
            self.progress.done = self.progress.done.saturating_add(1);
            return;
        }
        let seconds = elapsed.as_secs_f64() * self.speed;
        let steps = (seconds / STEP_S).ceil().clamp(1.0, 200.0);
        for _ in 0..steps as u32 {
            self.progress = self.body.advance(seconds / steps);
            if self.progress.fault != 0 {
                return self.fail(self.progress.fault);
            }
            if self.progress.finished {
                return self.complete(1);
            }
        }
    }

    fn is_client_lost(&self) -> bool {
        self.silent > self.silence_limit
    }

    fn is_safe(&self, needed: u16) -> bool {
        self.mode == Mode::Automatic && self.interlocks() & needed == needed
    }

    fn interlocks(&self) -> u16 {
        self.body.interlocks() & interlock::ALL & !self.opened
    }

    /// Opens the interlocks whose bits are set in `bits`, even if the simulated machine reports them as closed. An open
    /// interlock forbids motion. Any other interlock has the state that the simulated machine reports, so `bits` = 0
    /// ends the simulated fault.
    pub(crate) fn open(&mut self, bits: u16) {
        self.opened = bits;
        if self.state == State::Prepared && !self.is_safe(interlock::ALL) {
            self.token = 0;
        }
    }

    /// Turns the key switch at the panel to `mode`. If this changes the mode, a running job holds.
    pub(crate) fn turn_key(&mut self, mode: Mode) {
        if self.mode != mode {
            self.mode = mode;
            self.token = 0;
            if self.state == State::Execute {
                self.hold(0);
            }
        }
    }

    /// Presses the start button at the panel. A held job continues if the interlocks allow motion.
    pub(crate) fn press_start(&mut self) {
        if self.state == State::Held && self.running && self.is_safe(interlock::MOVING) {
            (self.fault, self.silent) = (0, Duration::ZERO);
            self.enter(State::Execute);
        }
    }

    /// Starts or ends a stray motion: a simulated motion that no command requested. If `strays` is true and the machine
    /// is idle, the machine enters EXECUTE without a job. If `strays` is false, a stray motion ends and the machine is
    /// idle. Otherwise nothing happens.
    pub(crate) fn stray(&mut self, strays: bool) {
        if strays && self.state == State::Idle {
            self.note(HandshakeEvent::Strayed);
            self.progress = Progress { done: 0, total: u32::MAX, ..Progress::default() };
            self.silent = Duration::ZERO;
            self.enter(State::Execute);
        } else if !strays && !self.running && matches!(self.state, State::Execute | State::Holding | State::Held) {
            self.enter(State::Idle);
        }
    }

    /// Requests a simulated fault that happens once. After the next payload is accepted, the machine changes the
    /// SHA-256 identities of all its stored payloads. The change happens just after a client has read the registers
    /// that show the stored payloads.
    pub(crate) fn spoil(&mut self) {
        self.spoils = true;
    }

    /// Handles the event that a client has read the registers of the payloads in force (the stored payloads that the
    /// machine uses). If a fault requested by [`Self::spoil`] is due, changes the SHA-256 identities of all stored
    /// payloads. The fault is due if a payload was accepted after the request. Otherwise nothing happens.
    pub(crate) fn slots_were_read(&mut self) {
        if !std::mem::take(&mut self.spoils_soon) {
            return;
        }
        for kind in 1..=self.slots.len() {
            let Some(slot) = &mut self.slots[kind - 1] else { continue };
            slot.payload.identity[0] ^= 1;
            let identity = slot.payload.identity;
            self.note(HandshakeEvent::Taken { kind: kind as u16, identity });
        }
    }

    /// Restarts the machine's program with a new boot id. The machine remembers only the list of jobs that it began.
    /// Afterwards the machine is idle, or FAULTED if the restart interrupted a job.
    pub(crate) fn reboot(&mut self) {
        let cut_off = self.lose_memory();
        self.note(HandshakeEvent::Rebooted { boot_id: self.boot_id });
        self.enter(State::Idle);
        if cut_off {
            self.show(FAULT_OTHER);
            self.enter(State::Faulted);
        }
    }

    /// Draws a new boot id, and clears the payloads, the owner and the last command. The list of jobs that the machine
    /// began is kept. A running job ends, and its result is lost. Returns true if a job was running.
    fn lose_memory(&mut self) -> bool {
        let cut_off = std::mem::take(&mut self.running);
        if cut_off {
            self.body.retract();
            // The physics ends its job; its result is lost with the application's memory.
            let _ = self.body.end_job(4);
        }
        self.boot_id = loop {
            let id = self.rng.random_range(1..=u32::MAX);
            if id != self.boot_id {
                break id;
            }
        };
        self.slots = [None, None, None];
        (self.acknowledged, self.answer, self.owner, self.epoch) = (0, Answer::None, 0, 0);
        (self.begun_by, self.done, self.result) = (0, 0, 0);
        self.progress = Progress::default();
        self.silent = Duration::ZERO;
        cut_off
    }

    /// Simulates a restart that a client cannot detect: the boot id stays the same. The machine forgets all jobs that
    /// it began, its payloads and its owner, and is idle.
    pub(crate) fn forget(&mut self) {
        let boot_id = self.boot_id;
        self.lose_memory();
        self.note(HandshakeEvent::Forgot);
        (self.boot_id, self.last_begun) = (boot_id, (0, 0));
        self.begun.clear();
        self.show(0);
        self.enter(State::Idle);
    }

    pub(crate) fn note(&mut self, what: HandshakeEvent) {
        self.log.push(self.now, what);
    }

    /// Checks a payload that was received completely. If it is good, stores it as the payload in force, which the next
    /// job uses.
    ///
    /// # Errors
    /// Returns the answer number of docs/modbus.md with which the machine refuses the payload, for example 8 for a
    /// broken payload.
    pub(crate) fn put_in_force(&mut self, arrived: Arrived) -> Result<(), u16> {
        let (kind, identity) = (arrived.kind, arrived.identity);
        let slot = Slot::new(self.order, arrived);
        if let Err(refusal) = self.body.check(kind, &slot.payload) {
            self.note(HandshakeEvent::Refused { kind, reason: refusal.to_string() });
            return Err(refusal.answer);
        }
        if let Some(index) = slot_of(self.body.kind(), kind) {
            self.slots[index] = Some(slot);
        }
        self.spoils_soon |= std::mem::take(&mut self.spoils);
        self.note(HandshakeEvent::Taken { kind, identity });
        Ok(())
    }

    /// Returns true if a job runs or is held, so that the payloads must not be changed.
    pub(crate) fn is_moving(&self) -> bool {
        matches!(self.state, State::Execute | State::Holding | State::Held)
    }

    /// Returns the 48 registers of the status block. The snapshot numbers and the heartbeats in it are still 0.
    pub(crate) fn image(&self) -> Vec<u16> {
        let temperature = (self.body.temperature_c() * 100.0).round().clamp(-32768.0, 32767.0) as i16;
        RegisterBlock::new(self.order, 48)
            .u16(1, self.state as u16)
            .u16(2, self.mode as u16)
            .u16(3, self.interlocks())
            .u32(4, self.acknowledged)
            .u16(6, self.answer as u16)
            .u16(7, self.fault)
            .u32(8, self.job.job)
            .u16(10, self.job.cycle)
            .u32(12, self.job.digest)
            .u32(14, self.token)
            .u32(16, self.done)
            .u16(18, self.result)
            .u32(20, self.progress.done)
            .u32(22, self.progress.total)
            .u32(24, self.owner)
            .u32(26, self.epoch)
            .u32(30, self.last_begun.0)
            .u16(32, self.last_begun.1)
            .u16(33, temperature as u16)
            .u32(34, self.boot_id)
            .u32(36, self.begun_by)
            .done()
    }
}
