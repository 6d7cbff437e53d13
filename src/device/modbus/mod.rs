//! Drivers of docs/modbus.md: a measuring machine and a grinder with Modbus registers.
//!
//! Both machines differ only in their payloads, so nearly everything is in [`ModbusMachine`]. It follows the page
//! literally:
//!
//! * A command is a value with a number. It is written until it is acknowledged.
//! * Payloads are sent in pages. The slots in force are read back and compared.
//! * Results are read in pages between two readings of their header.
//!
//! Only START is never repeated under a new number. Its frame may be written again with the same number. If that does
//! not give an answer either, the outcome is unknown and stays unknown until the machine is asked.

#[cfg(any(test, fuzzing))]
mod any_registers;
mod link;
mod protocol;
mod read_ahead;
pub(crate) mod serial_port;
mod settings;
mod signal;
mod unit;
mod wire;

use std::collections::BTreeMap;
use std::io;
use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::range;
use super::{
    Answer, Armed, Cmm, Coordinates, CorrectionMap, DeviceError, Fault, Grinder, Identity, Interrupt, Job, Machine,
    MachineCommand, MachineKind, MachineState, Measurement, Outcome, Pass, PassRecord, Plan, PreliminaryPoints,
    Reconciled, SignalValue, Started, Status, digest,
};
#[cfg(fuzzing)]
pub use any_registers::any_registers;
use link::LinkRequest;
pub(crate) use link::SystemConnector;
pub use link::{ConnectFuture, Connector, LineStream, Link, LinkStatistics};
use protocol::{CommandFrame, Payload, RecordError, crc32};
use read_ahead::{ReadAhead, ReadAheadFailures};
pub use settings::{
    LineAddress, ModbusSettings, Parity, RegisterMap, RtuWire, Signal, SignalTable, SignalType, TcpWire, WordOrder,
};
use unit::{ModbusUnit, UnitSettings};

/// Number of data registers in a full page.
const PAGE_REGISTERS: usize = 112;
/// Time after which a machine with an unchanged heartbeat counts as frozen.
const FROZEN_AFTER: Duration = Duration::from_millis(1500);
/// Time for a machine to acknowledge a command before the same frame is written again.
const ACKNOWLEDGE_TIMEOUT: Duration = Duration::from_millis(500);
/// Time for a machine to process a payload, or to reach the announced state.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(5);
/// Minimum time for which the status must show that a start was not accepted, before this is reported.
const NOT_STARTED_CONFIRMATION: Duration = Duration::from_millis(1050);
/// Temperature in the status of a machine without a thermometer.
const NO_THERMOMETER: i16 = i16::MIN;
/// Maximum size of a result of a measuring machine, in bytes.
const MAX_RESULT_BYTES: u32 = 64 << 20;

/// Payload that this driver has brought into force at the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Slot {
    bytes: u32,
    crc: u32,
    identity: [u8; 32],
}

/// Common part of the drivers of both machines.
#[derive(Debug)]
pub struct ModbusMachine {
    unit: ModbusUnit,
    owner: u32,
    epoch: u32,
    retries: u32,
    signals: Vec<Signal>,
    heartbeat_interval: Duration,
    expected_name: Option<String>,
    simulation: Option<bool>,
    sequence: u32,
    /// True if the machine has acknowledged this client as its owner on this connection. Only the heartbeat of an owner
    /// is written.
    owned: bool,
    /// True if this client has connected to the machine before.
    has_connected: bool,
    /// Sequence number of the START that was sent or reconciled last. Only a job begun by this START belongs to this
    /// client.
    last_start: Option<u32>,
    heartbeat: u16,
    last_heartbeat: Option<Instant>,
    machine_heartbeat: Option<(u16, Instant)>,
    loaded: BTreeMap<u16, Slot>,
    /// Last status block, for the one step of reading ahead that may follow it.
    last_block: Option<StatusBlock>,
    /// Pages of a result that were read while its job ran.
    read_ahead: Option<ReadAhead>,
    read_ahead_failures: ReadAheadFailures,
}

impl ModbusMachine {
    fn new(kind: MachineKind, link: Link, settings: ModbusSettings) -> Self {
        let unit = UnitSettings {
            unit: settings.unit,
            map: settings.registers,
            retries: settings.retries,
            lost_after: settings.lost_after,
        };
        Self {
            unit: ModbusUnit::new(kind, link, unit),
            owner: settings.owner,
            epoch: settings.epoch,
            retries: settings.retries,
            signals: settings.signals,
            heartbeat_interval: settings.heartbeat_interval,
            expected_name: settings.expected_name,
            simulation: settings.simulation,
            sequence: 0,
            owned: false,
            has_connected: false,
            last_start: None,
            heartbeat: 0,
            last_heartbeat: None,
            machine_heartbeat: None,
            loaded: BTreeMap::new(),
            last_block: None,
            read_ahead: None,
            read_ahead_failures: ReadAheadFailures::default(),
        }
    }

    fn machine(&self) -> std::sync::Arc<str> {
        self.unit.name.clone()
    }

    /// Returns the Modbus line to this machine, which other machines may share.
    pub fn link(&self) -> &Link {
        &self.unit.link
    }

    // ---- status and heartbeats
    // ---------------------------------------------------------------------------------------------------

    async fn connect(&mut self) -> Result<Identity, DeviceError> {
        self.machine_heartbeat = None;
        self.owned = false;
        self.loaded.clear();
        self.read_ahead = None;
        let identity = self.unit.connect().await?;
        // The check comes before the first meaningful write, because this may be another machine.
        self.check_identity(&identity)?;
        let status = self.read_status_block().await?;
        self.sequence = self.sequence.max(status.acknowledged);
        // The memory of the machine counts more than a clock: an earlier start of this client may have had a later
        // clock. A client that returns with a higher epoch than this start ever had is another client. This client does
        // not exceed its epoch.
        if !std::mem::replace(&mut self.has_connected, true) && status.owner == self.owner {
            self.epoch = self.epoch.max(status.epoch.saturating_add(1));
        }
        Ok(identity)
    }

    /// Checks the identity that the machine reports against the settings of the cell file.
    ///
    /// # Errors
    /// The machine has another name than the cell file requires. Or the machine is a simulation and the cell is not, or
    /// the reverse.
    fn check_identity(&self, identity: &Identity) -> Result<(), DeviceError> {
        if let Some(expected) = self.expected_name.as_ref().filter(|expected| **expected != identity.name) {
            let (expected, found) = (expected.clone(), identity.name.clone());
            return Err(DeviceError::WrongName { machine: self.machine(), expected, found });
        }
        match self.simulation {
            Some(expected) if expected != identity.simulation => {
                Err(DeviceError::SimulationMismatch { machine: self.machine(), simulation: identity.simulation })
            }
            _ => Ok(()),
        }
    }

    /// Writes the heartbeat, a counter that shows the machine that its client is alive. Does nothing if the heartbeat
    /// interval since the last write has not passed, or if this client is not the owner of the machine.
    async fn send_heartbeat(&mut self) -> Result<(), DeviceError> {
        if !self.owned {
            return Ok(());
        }
        if self.last_heartbeat.is_some_and(|last| last.elapsed() < self.heartbeat_interval) {
            return Ok(());
        }
        self.heartbeat = self.heartbeat.wrapping_add(1);
        self.last_heartbeat = Some(Instant::now());
        let mut beat = self.unit.writer();
        beat.u16(self.heartbeat).u32(self.owner);
        self.unit.write("beat", self.unit.map.beat, beat.words()).await
    }

    /// Sends the heartbeat if it is due. Then reads the status block and returns its values. All values belong to the
    /// same moment. The additional signals of the cell file are not part of the block.
    ///
    /// # Errors
    /// The two snapshot numbers of the block still differ after several reads, a value is invalid, a request fails, the
    /// machine was restarted, or its heartbeat no longer changes.
    async fn read_status_block(&mut self) -> Result<StatusBlock, DeviceError> {
        self.send_heartbeat().await?;
        let address = self.unit.map.status;
        let mut words = self.unit.read("status", address, 48).await?;
        for _ in 0..5 {
            if words[0] == words[47] {
                return self.decode_status(&words);
            }
            words = self.unit.read("status", address, 48).await?;
        }
        Err(self.unit.reject_data("status block (its two snapshot numbers)", words[0].into(), words[47].into()).await)
    }

    fn decode_status(&mut self, words: &[u16]) -> Result<StatusBlock, DeviceError> {
        let machine = self.machine();
        let unlisted =
            |field, found: u16| DeviceError::Unlisted { machine: machine.clone(), field, found: found.into() };
        let block = self.unit.registers(words);
        let state = decode_state(words[1]).ok_or_else(|| unlisted("its state", words[1]))?;
        if !matches!(words[2], 1 | 2) {
            return Err(unlisted("its mode", words[2]));
        }
        let outcome = protocol::decode_outcome(words[18]).map_err(|_| unlisted("the result of its job", words[18]))?;
        let job = Job { job: block.u32(8), cycle: words[10], digest: block.u32(12) };
        let block = StatusBlock {
            state,
            automatic: words[2] == 1,
            interlocks: words[3],
            acknowledged: block.u32(4),
            answer: decode_answer(words[6]),
            fault: Fault::from_number(words[7]),
            job: (job.job != 0).then_some(job),
            token: block.u32(14),
            done: block.u32(16),
            outcome,
            progress: (block.u32(20), block.u32(22)),
            owner: block.u32(24),
            epoch: block.u32(26),
            beat: words[28],
            last_begun: (block.u32(30), words[32]),
            begun_by: block.u32(36),
            temperature_c: Some(block.i16(33))
                .filter(|told| *told != NO_THERMOMETER)
                .map(|told| f64::from(told) / 100.0),
            boot_id: block.u32(34),
        };
        self.check_alive(&block)?;
        Ok(block)
    }

    fn check_alive(&mut self, status: &StatusBlock) -> Result<(), DeviceError> {
        let machine = self.machine();
        let known = self.unit.identity().map_or(0, |identity| identity.boot_id);
        if status.boot_id != known {
            return Err(DeviceError::Restarted { machine, old_boot_id: known, new_boot_id: status.boot_id });
        }
        let beat = status.beat;
        match self.machine_heartbeat {
            Some((seen, since)) if seen == beat => {
                let still = since.elapsed();
                if still > FROZEN_AFTER {
                    return Err(DeviceError::Frozen { machine, beat, unchanged_for: still, limit: FROZEN_AFTER });
                }
            }
            _ => self.machine_heartbeat = Some((beat, Instant::now())),
        }
        Ok(())
    }

    async fn status(&mut self) -> Result<Status, DeviceError> {
        self.last_block = None;
        let block = self.read_status_block().await?;
        self.check_owner(&block)?;
        let mut status = Status::from(&block);
        self.last_block = Some(block);
        for k in 0..self.signals.len() {
            let reading = self.signal(k).await?;
            status.signals.push(reading);
            // A slow signal must not make the machine believe that its client is lost.
            self.send_heartbeat().await?;
        }
        Ok(status)
    }

    /// Checks in `status` that this client is still the owner of the machine. The check is necessary because this
    /// client does not notice the commands of another owner. Returns `Ok` in these cases too:
    ///
    /// - This client has not claimed the machine.
    /// - The state is ABORTING or ABORTED, because every client may abort.
    ///
    /// # Errors
    /// Returns [`DeviceError::OwnedByOther`] if another client has become the owner.
    fn check_owner(&self, status: &StatusBlock) -> Result<(), DeviceError> {
        let aborts = matches!(status.state, MachineState::Aborting | MachineState::Aborted);
        if !self.owned || status.owner == self.owner || aborts {
            return Ok(());
        }
        Err(DeviceError::OwnedByOther { machine: self.machine(), ours: self.owner, owner: status.owner })
    }

    /// Reads the additional signal with the index `k` in the cell file. Returns the value in the unit of the signal,
    /// together with the name, the unit and the allowed range from the cell file. If the machine answers with a Modbus
    /// exception, the value is `None` and the result contains the cause. The value is also `None` if it is not finite.
    ///
    /// # Errors
    /// Returns an error if the request fails for another reason, for example because no answer arrives.
    async fn signal(&mut self, k: usize) -> Result<SignalValue, DeviceError> {
        let signal = self.signals[k].clone();
        let ask = LinkRequest::Read { address: signal.address, count: signal.kind.registers() };
        let (value, cause) = match self.unit.request_with_limit("signal", signal.address, ask).await {
            Err(error @ DeviceError::Exception { .. }) => (None, Some(error.to_string())),
            words => {
                let mut words = words?;
                if signal.word_order.swaps_bytes() != self.unit.map.word_order.swaps_bytes() {
                    words.iter_mut().for_each(|word| *word = word.swap_bytes());
                }
                (Some(signal.value(&words, signal.word_order)).filter(|value| value.is_finite()), signal.cause(&words))
            }
        };
        let Signal { name, unit, range, .. } = signal;
        Ok(SignalValue { name, value, unit, range, cause })
    }

    // ---- commands --------------------------------------------------------------------------------------------------

    fn next_sequence(&mut self) -> u32 {
        self.sequence = self.sequence.checked_add(1).unwrap_or(1);
        self.sequence
    }

    fn frame(&mut self, command: MachineCommand) -> CommandFrame {
        let sequence = self.next_sequence();
        CommandFrame { sequence, command, job: None, owner: self.owner, epoch: self.epoch, token: 0, argument: 0 }
    }

    async fn run_command(&mut self, command: MachineCommand) -> Result<StatusBlock, DeviceError> {
        let frame = self.frame(command);
        self.send_command(frame).await
    }

    /// Writes the command `frame` and waits until the machine acknowledges it. If no acknowledgement arrives within
    /// [`ACKNOWLEDGE_TIMEOUT`], writes the same frame again, at most `retries` times. Returns the status that
    /// acknowledges the command.
    ///
    /// # Errors
    /// The machine refuses the command or does not acknowledge it, or a request fails.
    async fn send_command(&mut self, frame: CommandFrame) -> Result<StatusBlock, DeviceError> {
        let CommandFrame { command, sequence, .. } = frame;
        let status = self.write_until_acknowledged(frame).await?;
        self.sequence = self.sequence.max(sequence);
        match status.answer {
            Answer::Accepted => Ok(status),
            answer => Err(DeviceError::Refused { machine: self.machine(), command, answer, state: status.state }),
        }
    }

    async fn write_until_acknowledged(&mut self, frame: CommandFrame) -> Result<StatusBlock, DeviceError> {
        let CommandFrame { command, sequence, .. } = frame;
        let words = frame.words(self.unit.map.word_order);
        let address = self.unit.map.command;
        let mut tries = 0;
        loop {
            self.unit.write("command", address, &words).await?;
            tries += 1;
            let written = Instant::now();
            let mut pause = Duration::from_millis(1);
            let last = loop {
                let status = self.read_status_block().await?;
                if status.acknowledged == sequence {
                    return Ok(status);
                }
                if written.elapsed() >= ACKNOWLEDGE_TIMEOUT {
                    break status.acknowledged;
                }
                sleep(pause).await;
                pause = (pause * 2).min(Duration::from_millis(20));
            };
            if tries > self.retries {
                let machine = self.machine();
                return Err(DeviceError::NotAcknowledged { machine, command, sequence, acknowledged: last, tries });
            }
        }
    }

    async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
        let identities: Vec<_> = self.loaded.values().map(|slot| slot.identity).collect();
        let loaded = digest(&identities);
        if identities.is_empty() || loaded != job.digest {
            let machine = self.machine();
            return Err(DeviceError::Mismatch {
                machine,
                field: "the digest of the payloads",
                sent: job.digest.into(),
                found: loaded.into(),
            });
        }
        for kind in self.loaded.keys().copied().collect::<Vec<_>>() {
            self.compare_slot(kind).await?;
        }
        let frame = CommandFrame { job: Some(job), ..self.frame(MachineCommand::Prepare) };
        self.send_command(frame).await?;
        let status = self.wait_until(|status| status.state == MachineState::Prepared && status.token != 0).await?;
        self.check_job(job, &status)?;
        Ok(Armed { job, start_sequence: self.next_sequence(), token: status.token, boot_id: status.boot_id })
    }

    /// Reads the status repeatedly until `holds` returns true for it. Returns that status.
    ///
    /// # Errors
    /// The status shows a fault, the wait takes longer than [`SETTLE_TIMEOUT`], or a request fails.
    async fn wait_until(&mut self, holds: impl Fn(&StatusBlock) -> bool) -> Result<StatusBlock, DeviceError> {
        let began = Instant::now();
        loop {
            let status = self.read_status_block().await?;
            if holds(&status) {
                return Ok(status);
            }
            let machine = self.machine();
            if status.fault != Fault::None {
                return Err(DeviceError::Faulted { machine, state: status.state, fault: status.fault });
            }
            if began.elapsed() > SETTLE_TIMEOUT {
                return Err(DeviceError::TimedOut { machine, operation: "the state announced", limit: SETTLE_TIMEOUT });
            }
            sleep(Duration::from_millis(5)).await;
        }
    }

    /// Checks that the job in `status` is `job`.
    ///
    /// # Errors
    /// The job number, the cycle or the digest (checksum of the payloads) differs, or the status has no job.
    fn check_job(&self, job: Job, status: &StatusBlock) -> Result<(), DeviceError> {
        let held = status.job.unwrap_or(Job { job: 0, cycle: 0, digest: 0 });
        let fields = [
            ("the job", u64::from(job.job), u64::from(held.job)),
            ("the cycle", u64::from(job.cycle), u64::from(held.cycle)),
            ("the digest of the payloads", u64::from(job.digest), u64::from(held.digest)),
        ];
        self.compare(fields)
    }

    /// Compares the values that this client sent with the values at the machine. Each entry of `fields` is the name of
    /// the value for messages, the value sent, and the value at the machine.
    ///
    /// # Errors
    /// Returns [`DeviceError::Mismatch`] for the first entry whose two values differ.
    fn compare<const N: usize>(&self, fields: [(&'static str, u64, u64); N]) -> Result<(), DeviceError> {
        match fields.into_iter().find(|(_, sent, held)| sent != held) {
            Some((field, sent, held)) => {
                Err(DeviceError::Mismatch { machine: self.machine(), field, sent, found: held })
            }
            None => Ok(()),
        }
    }

    async fn start(&mut self, armed: Armed) -> Result<Started, DeviceError> {
        let Armed { job, start_sequence, token, boot_id } = armed;
        let known = self.unit.identity().map_or(0, |identity| identity.boot_id);
        if boot_id != known {
            // Nothing was sent: the restart of the machine has discarded the prepared job.
            return Err(DeviceError::Restarted { machine: self.machine(), old_boot_id: boot_id, new_boot_id: known });
        }
        // Nothing was sent yet, so an error here is only a failed read. A prepared job that has expired since is a
        // clear refusal.
        let before = self.read_status_block().await?;
        let taken = before.begun_by == start_sequence || before.acknowledged == start_sequence;
        if !taken && (before.state != MachineState::Prepared || before.token != token) {
            let (command, answer, state) = (MachineCommand::Start, Answer::DeadToken, before.state);
            return Err(DeviceError::Refused { machine: self.machine(), command, answer, state });
        }
        self.last_start = Some(start_sequence);
        self.read_ahead = None;
        let (owner, epoch) = (self.owner, self.epoch);
        let frame = CommandFrame {
            sequence: start_sequence,
            command: MachineCommand::Start,
            job: Some(job),
            owner,
            epoch,
            token,
            argument: 0,
        };
        let unknown = |machine, reason| DeviceError::StartUnknown {
            machine,
            job,
            sequence: start_sequence,
            cause: Box::new(reason),
        };
        match self.send_command(frame).await {
            Ok(status) if status.begun_by == start_sequence && status.job == Some(job) => {
                Ok(Started { job, start_sequence, status: status.into() })
            }
            Ok(status) => {
                let (sent, held) = (u64::from(start_sequence), u64::from(status.begun_by));
                let (machine, field) = (self.machine(), "the START that began the job");
                Err(unknown(self.machine(), DeviceError::Mismatch { machine, field, sent, found: held }))
            }
            // The machine has answered this very START and refused it.
            Err(refused @ DeviceError::Refused { .. }) => Err(refused),
            Err(DeviceError::NotConnected { machine, operation: what }) => {
                Err(DeviceError::NotConnected { machine, operation: what })
            }
            Err(reason) => Err(unknown(self.machine(), reason)),
        }
    }

    async fn claim(&mut self) -> Result<StatusBlock, DeviceError> {
        let status = self.run_command(MachineCommand::Claim).await?;
        self.owned = true;
        Ok(status)
    }

    async fn release(&mut self) -> Result<StatusBlock, DeviceError> {
        self.owned = false;
        self.run_command(MachineCommand::Release).await
    }

    /// Commands the machine to end the job at once. Returns the status that acknowledges this command. If the
    /// connection is lost, opens it at once, without the pause that usually follows an error.
    ///
    /// If the machine does not acknowledge the command, another client may have used higher sequence numbers. This
    /// function then reads the status. If the state is ABORTING or ABORTED, returns this status. Otherwise sends the
    /// abort again with a number above the last acknowledged number.
    ///
    /// # Errors
    /// Returns an error if the connection cannot be opened, if a request fails, or if the machine refuses or does not
    /// acknowledge the command.
    async fn abort(&mut self) -> Result<StatusBlock, DeviceError> {
        self.unit.link.skip_pause();
        if self.unit.identity().is_none() {
            self.unit.connect_within(Duration::ZERO).await?;
        }
        match self.run_command(MachineCommand::Abort).await {
            // Another client has used higher numbers. The state of the machine decides; if it does not abort, an abort
            // justifies a number above theirs.
            Err(DeviceError::NotAcknowledged { acknowledged, .. }) => match self.read_status_block().await? {
                status if matches!(status.state, MachineState::Aborting | MachineState::Aborted) => Ok(status),
                _ => {
                    self.sequence = self.sequence.max(acknowledged);
                    self.run_command(MachineCommand::Abort).await
                }
            },
            answer => answer,
        }
    }

    async fn acknowledge(&mut self, done: u32) -> Result<StatusBlock, DeviceError> {
        let frame = CommandFrame { argument: done, ..self.frame(MachineCommand::Acknowledge) };
        self.send_command(frame).await
    }

    async fn reconcile(&mut self, intended: &Armed) -> Result<Reconciled, DeviceError> {
        self.last_start = Some(intended.start_sequence);
        let first = self.read_status_block().await?;
        match start_outcome(intended, &first) {
            Some(verdict) => return Ok(verdict),
            None => {
                let began = Instant::now();
                while began.elapsed() < NOT_STARTED_CONFIRMATION {
                    sleep(self.heartbeat_interval).await;
                    self.send_heartbeat().await?;
                }
            }
        }
        // A START may still be under way in the network. Once the machine has acknowledged a higher number, it no
        // longer accepts this START.
        self.sequence = self.sequence.max(intended.start_sequence).max(first.acknowledged);
        self.claim().await?;
        let second = self.read_status_block().await?;
        Ok(start_outcome(intended, &second).unwrap_or(Reconciled::NotStarted(second.into())))
    }

    // ---- payloads --------------------------------------------------------------------------------------------------

    async fn load<P: Payload>(&mut self, payload: &P, interrupt: &Interrupt) -> Result<(), DeviceError> {
        if let Some((field, value, limit)) = payload.invalid_field() {
            return Err(DeviceError::BadPayload { machine: self.machine(), payload: P::NAME, field, value, limit });
        }
        self.loaded.remove(&P::KIND);
        let words = payload.words(self.unit.map.word_order);
        let bytes = 2 * words.len() as u64;
        let Ok(bytes) = u32::try_from(bytes) else {
            let (field, limit) = ("its size in bytes".to_owned(), "less than 4 GiB");
            return Err(DeviceError::BadPayload {
                machine: self.machine(),
                payload: P::NAME,
                field,
                value: bytes as f64,
                limit,
            });
        };
        let slot = Slot { bytes, crc: crc32(&words), identity: payload.identity() };
        let mut tries = 0;
        loop {
            self.write_inbox_header::<P>(slot).await?;
            let sent = self.send_pages::<P>(&words, interrupt).await;
            let taken = match sent {
                Ok(()) => self.wait_until_accepted::<P>(slot).await,
                Err(error @ (DeviceError::Interrupted { .. } | DeviceError::Unreachable { .. })) => return Err(error),
                Err(error) => Err(error),
            };
            match taken {
                Ok(()) => break,
                Err(error) if !error.is_link() || tries >= self.retries => return Err(error),
                Err(_) => tries += 1,
            }
        }
        self.loaded.insert(P::KIND, slot);
        if let Err(error) = self.compare_slot(P::KIND).await {
            self.loaded.remove(&P::KIND);
            return Err(error);
        }
        Ok(())
    }

    async fn write_inbox_header<P: Payload>(&mut self, slot: Slot) -> Result<(), DeviceError> {
        let mut header = self.unit.writer();
        header.u16(P::KIND).u16(0).u32(slot.bytes).u32(slot.crc).zeros(2).identity(&slot.identity);
        let address = self.unit.map.inbox_header;
        match self.unit.write("inbox header", address, header.words()).await {
            Err(DeviceError::Exception { code: 3, .. }) => {
                let state = self.read_status_block().await?.state;
                let busy = matches!(state, MachineState::Execute | MachineState::Holding | MachineState::Held);
                let answer = if busy { Answer::WrongState } else { Answer::OutsideLimits };
                Err(DeviceError::PayloadRefused { machine: self.machine(), payload: P::NAME, answer })
            }
            other => other,
        }
    }

    async fn send_pages<P: Payload>(&mut self, words: &[u16], interrupt: &Interrupt) -> Result<(), DeviceError> {
        let address = self.unit.map.inbox_page;
        let of = words.len().div_ceil(PAGE_REGISTERS) as u32;
        for (number, data) in words.chunks(PAGE_REGISTERS).enumerate() {
            let done = number as u32;
            self.check_interrupt(interrupt, P::NAME, done, of)?;
            self.send_heartbeat().await?;
            let mut page = self.unit.writer();
            page.u32(done).u16(data.len() as u16).zeros(5);
            let page = [page.words(), data].concat();
            match self.unit.write("inbox page", address, &page).await {
                // Out of order: an older write has arrived late and emptied the inbox.
                Err(DeviceError::Exception { code: 3, .. }) => {
                    let state = self.unit.read("inbox state", self.unit.map.inbox_state, 12).await?;
                    let next = self.unit.registers(&state).u32(2);
                    return Err(self.unit.reject_data("number of the page it expects", done.into(), next.into()).await);
                }
                written => written?,
            }
        }
        Ok(())
    }

    fn check_interrupt(
        &self,
        interrupt: &Interrupt,
        what: &'static str,
        done: u32,
        of: u32,
    ) -> Result<(), DeviceError> {
        match interrupt.is_raised() {
            true => Err(DeviceError::Interrupted { machine: self.machine(), payload: what, done, total: of }),
            false => Ok(()),
        }
    }

    /// Waits until the machine has accepted the payload of the type `P`. `slot` contains the size and CRC-32 that this
    /// client has sent; the machine must report the same.
    ///
    /// # Errors
    /// The machine refuses the payload, reports another size or CRC-32, or has not received all bytes within
    /// [`SETTLE_TIMEOUT`]. Or a request fails.
    async fn wait_until_accepted<P: Payload>(&mut self, slot: Slot) -> Result<(), DeviceError> {
        let began = Instant::now();
        loop {
            self.send_heartbeat().await?;
            let words = self.unit.read("inbox state", self.unit.map.inbox_state, 12).await?;
            let block = self.unit.registers(&words);
            let (bytes, crc) = (block.u32(4), block.u32(6));
            match words[1] {
                2 if words[0] == P::KIND && bytes == slot.bytes && crc == slot.crc => return Ok(()),
                2 | 3 => {
                    let (expected, found) = (u64::from(slot.crc), u64::from(crc));
                    return Err(self.unit.reject_data("check number of a payload", expected, found).await);
                }
                4 => {
                    let answer = decode_answer(words[8]);
                    return Err(DeviceError::PayloadRefused { machine: self.machine(), payload: P::NAME, answer });
                }
                _ if began.elapsed() > SETTLE_TIMEOUT => {
                    let found = u64::from(bytes);
                    let (what, expected) = ("bytes arrived of the payload", u64::from(slot.bytes));
                    return Err(DeviceError::WrongCount { machine: self.machine(), elements: what, expected, found });
                }
                _ => sleep(Duration::from_millis(5)).await,
            }
        }
    }

    /// Checks that the payload that the machine would use for the next job (the payload "in force") is the one that
    /// this client has loaded. `kind` is the number of the kind of payload: 1 plan, 2 correction map, 3 pass. Compares
    /// size, CRC-32 and identity. Does nothing if this client has loaded no payload of this kind.
    ///
    /// # Errors
    /// The two payloads differ, or the machine cannot be read.
    async fn compare_slot(&mut self, kind: u16) -> Result<(), DeviceError> {
        let Some(slot) = self.loaded.get(&kind).copied() else { return Ok(()) };
        let address = self.unit.map.in_force + 24 * (kind - 1);
        let words = self.unit.read("slots in force", address, 24).await?;
        let block = self.unit.registers(&words);
        let identity = block.identity(8);
        let head = |identity: &[u8; 32]| identity[..8].iter().fold(0, |bits, byte| (bits << 8) | u64::from(*byte));
        self.compare([
            ("the kind of the payload that the machine uses", u64::from(kind), u64::from(words[0])),
            ("the state of the memory slot whose payload the machine uses", 1, u64::from(words[1])),
            ("the size of the payload that the machine uses", u64::from(slot.bytes), u64::from(block.u32(2))),
            ("the CRC-32 of the payload that the machine uses", u64::from(slot.crc), u64::from(block.u32(4))),
            (
                "the identity of the payload that the machine uses (first 8 bytes)",
                head(&slot.identity),
                head(&identity),
            ),
        ])?;
        if identity == slot.identity {
            return Ok(());
        }
        let [sent, held] = [slot.identity, identity].map(|identity| u64::from(crc32fast::hash(&identity)));
        let field = "the CRC-32 of the identity of the payload that the machine uses";
        Err(DeviceError::Mismatch { machine: self.machine(), field, sent, found: held })
    }

    // ---- results ---------------------------------------------------------------------------------------------------

    /// Fetches the complete result of `job`. `kind` is the number of the kind of result: 4 measurement, 5 pass record.
    /// Checks that the result belongs to this job and that its CRC-32 is correct. Returns the status, the header of the
    /// result and its data registers. Repeats the transfer after a communication error, at most `retries` times.
    ///
    /// # Errors
    /// The job is not complete, the result belongs to another job, `interrupt` is raised, or the transfer fails.
    async fn fetch(
        &mut self,
        job: Job,
        kind: u16,
        interrupt: &Interrupt,
    ) -> Result<(StatusBlock, Header, Vec<u16>), DeviceError> {
        let mut tries = 0;
        loop {
            let status = self.read_status_block().await?;
            if status.state != MachineState::Complete || status.done == 0 {
                return Err(DeviceError::NoResult { machine: self.machine(), job, state: status.state });
            }
            self.check_job(job, &status)?;
            if let Some(began) = self.last_start.filter(|began| *began != status.done) {
                let (sent, held) = (u64::from(began), u64::from(status.done));
                let field = "the START whose job has ended";
                return Err(DeviceError::Mismatch { machine: self.machine(), field, sent, found: held });
            }
            match self.fetch_once(job, kind, status.done, interrupt).await {
                Ok(Some((header, words))) => return Ok((status, header, words)),
                // The pages that were read ahead do not belong to this result; the next attempt reads all pages.
                Ok(None) => {}
                Err(error) if !error.is_link() || tries >= self.retries => return Err(error),
                Err(_) => tries += 1,
            }
        }
    }

    async fn fetch_once(
        &mut self,
        job: Job,
        kind: u16,
        done: u32,
        interrupt: &Interrupt,
    ) -> Result<Option<(Header, Vec<u16>)>, DeviceError> {
        let before = self.header_words().await?;
        let header = self.header(&before, job, kind, done)?;
        let total = (header.bytes / 2) as usize;
        let pages = total.div_ceil(PAGE_REGISTERS) as u32;
        let mut words = Vec::with_capacity(total);
        words.extend(self.registers_read_ahead(job, &header, done).into_iter().flatten());
        let ahead = (words.len() / PAGE_REGISTERS) as u32;
        for page in ahead..pages {
            self.check_interrupt(interrupt, "result", page, pages)?;
            self.send_heartbeat().await?;
            let due = (total - words.len()).min(PAGE_REGISTERS);
            self.fetch_page(page, due, &mut words).await?;
        }
        let after = self.header_words().await?;
        if before != after {
            let (expected, found) = (u64::from(crc32(&before)), u64::from(crc32(&after)));
            return Err(self.unit.reject_data("header of a result (read twice)", expected, found).await);
        }
        let crc = crc32(&words);
        if ahead > 0 && (crc != header.crc || self.registers_read_ahead(job, &header, done).is_none()) {
            self.read_ahead = None;
            return Ok(None);
        }
        if crc != header.crc {
            return Err(self.unit.reject_data("check number of a result", header.crc.into(), crc.into()).await);
        }
        Ok(Some((header, words)))
    }

    async fn header_words(&mut self) -> Result<Vec<u16>, DeviceError> {
        self.unit.read("outbox header", self.unit.map.outbox_header, 56).await
    }

    fn header(&self, words: &[u16], job: Job, kind: u16, done: u32) -> Result<Header, DeviceError> {
        let machine = self.machine();
        let block = self.unit.registers(words);
        self.compare([
            ("the kind of the result", u64::from(kind), u64::from(words[0])),
            ("the job of the result", u64::from(job.job), u64::from(block.u32(6))),
            ("the cycle of the result", u64::from(job.cycle), u64::from(words[8])),
            ("the number of the finished job", u64::from(done), u64::from(block.u32(46))),
        ])?;
        if words[28] != 1 {
            return Err(DeviceError::WrongLengthUnit { machine, unit: words[28] });
        }
        let reals = [("the probe's radius", 12), ("the scale", 16), ("the mean temperature", 20), ("the duration", 24)];
        for (field, at) in reals {
            // A machine without a thermometer gives NaN as the temperature.
            let is_untold = at == 20 && block.f64(at).is_nan();
            if !is_untold && !block.f64(at).is_finite() {
                return Err(DeviceError::NotFinite { machine, field: field.into(), value: block.f64(at) });
            }
        }
        let (format, bytes, records) = (words[1], block.u32(2), block.u32(10));
        let size = match kind {
            4 => protocol::point_registers(format),
            _ => (format == 1).then_some(32),
        };
        let Some(size) = size else {
            return Err(DeviceError::Unlisted { machine, field: "the format of the result", found: format.into() });
        };
        let expected = 2 * size as u64 * u64::from(records);
        if u64::from(bytes) != expected || bytes > MAX_RESULT_BYTES {
            let expected = expected.min(MAX_RESULT_BYTES.into());
            return Err(DeviceError::WrongCount {
                machine,
                elements: "bytes of the result",
                expected,
                found: bytes.into(),
            });
        }
        if (kind, format) == (4, 2) {
            range::check_count_scale(&machine, block.f64(16))?;
        }
        Ok(Header {
            format,
            bytes,
            crc: block.u32(4),
            records,
            registers: size,
            coordinates: words[9],
            probe_radius_mm: block.f64(12),
            scale_mm: block.f64(16),
            temperature_c: Some(block.f64(20)).filter(|told| !told.is_nan()),
            duration_s: block.f64(24),
            identity: block.identity(30),
        })
    }

    /// Reads one page of a result and appends its data registers to `words`. A result is transferred in pages (blocks
    /// of registers). `page` is the number of the page, counted from 0. `due` is the expected number of data registers
    /// in this page. The machine may need some time to provide the page, so the request is repeated for
    /// [`ACKNOWLEDGE_TIMEOUT`] if the machine provides another page.
    ///
    /// # Errors
    /// Returns an error if the machine still provides another page after this time, if the number of registers in the
    /// page is not `due`, or if a request fails.
    async fn fetch_page(&mut self, page: u32, due: usize, words: &mut Vec<u16>) -> Result<(), DeviceError> {
        let map = self.unit.map;
        let mut select = self.unit.writer();
        select.u32(page);
        let began = Instant::now();
        loop {
            self.unit.write("outbox select", map.outbox_select, select.words()).await?;
            let read = self.unit.read("outbox page", map.outbox_page, 4 + due as u16).await?;
            let found = self.unit.registers(&read).u32(0);
            if found == page && usize::from(read[2]) == due {
                words.extend_from_slice(&read[4..]);
                return Ok(());
            }
            if found == page {
                return Err(self.unit.reject_data("number of registers in a page", due as u64, read[2].into()).await);
            }
            if began.elapsed() > ACKNOWLEDGE_TIMEOUT {
                return Err(self.unit.reject_data("number of a page", page.into(), found.into()).await);
            }
            sleep(Duration::from_millis(2)).await;
        }
    }

    fn coordinates(&self, header: &Header) -> Result<Coordinates, DeviceError> {
        match header.coordinates {
            1 => Ok(Coordinates::Centres),
            2 => Ok(Coordinates::Contacts),
            other => {
                let (field, found) = ("the kind of its coordinates", u32::from(other));
                Err(DeviceError::Unlisted { machine: self.machine(), field, found })
            }
        }
    }

    fn record_error(&self, flaw: RecordError) -> DeviceError {
        let machine = self.machine();
        match flaw {
            RecordError::NotFinite { field, value } => DeviceError::NotFinite { machine, field, value },
            RecordError::Unlisted { field, found } => DeviceError::Unlisted { machine, field, found },
        }
    }

    fn count(&self, what: &'static str, expected: u64, found: u64) -> Result<(), DeviceError> {
        match expected == found {
            true => Ok(()),
            false => Err(DeviceError::WrongCount { machine: self.machine(), elements: what, expected, found }),
        }
    }
}

/// Values of the status block of docs/modbus.md that this program uses, all of one moment.
#[derive(Debug, Clone, PartialEq)]
struct StatusBlock {
    state: MachineState,
    /// True in automatic mode, false in manual mode.
    automatic: bool,
    /// Bits from bit 0: guards closed, clear of the part, part clamped, supplies present.
    interlocks: u16,
    /// Sequence number of the last command that the machine acted upon; `answer` is its answer.
    acknowledged: u32,
    answer: Answer,
    fault: Fault,
    /// Job that is prepared, running or finished.
    job: Option<Job>,
    /// Token of the prepared job; 0 if there is none.
    token: u32,
    /// Sequence number of the START whose job ended last, 0 if there is none; `outcome` is the outcome of that job.
    done: u32,
    outcome: Outcome,
    progress: (u32, u32),
    /// Owner; 0 if nobody owns the machine.
    owner: u32,
    epoch: u32,
    /// Heartbeat of the machine.
    beat: u16,
    /// Job and cycle that were begun last; the machine keeps them over its restart.
    last_begun: (u32, u16),
    /// Sequence number of the START that began the running or last job; 0 if there is none.
    begun_by: u32,
    /// Temperature in °C; `None` if the machine has no thermometer.
    temperature_c: Option<f64>,
    boot_id: u32,
}

impl From<&StatusBlock> for Status {
    fn from(block: &StatusBlock) -> Self {
        let good = |bit: u16| Some(block.interlocks & (1 << bit) != 0);
        let (temperature_c, progress, signals) = range::plausible_status(block.temperature_c, block.progress);
        Self {
            state: block.state,
            job: block.job,
            done: block.done,
            outcome: block.outcome,
            clear_of_part: good(1),
            supplies: good(3),
            automatic: Some(block.automatic),
            fault: Some(block.fault),
            progress,
            temperature_c,
            boot_id: Some(block.boot_id),
            signals,
        }
    }
}

impl From<StatusBlock> for Status {
    fn from(block: StatusBlock) -> Self {
        Self::from(&block)
    }
}

/// Header of a result.
#[derive(Debug, Clone)]
struct Header {
    format: u16,
    bytes: u32,
    crc: u32,
    records: u32,
    registers: usize,
    coordinates: u16,
    probe_radius_mm: f64,
    scale_mm: f64,
    /// Temperature in °C; `None` if the machine has no thermometer.
    temperature_c: Option<f64>,
    duration_s: f64,
    identity: [u8; 32],
}

/// Returns the outcome of the start `intended` that `status` shows: the job runs, has finished, or its outcome cannot
/// be determined. Returns `None` if the status shows that the machine did not accept the start. The caller must confirm
/// `None` with a second, later status.
fn start_outcome(intended: &Armed, status: &StatusBlock) -> Option<Reconciled> {
    let Armed { job, start_sequence, boot_id, .. } = *intended;
    let unknown = |reason: String| Some(Reconciled::Unknown { reason });
    if status.boot_id != boot_id {
        let is = status.boot_id;
        return unknown(format!(
            "the machine was restarted after this job was prepared (boot id {boot_id:08x}, now {is:08x}); check at the machine whether the job was done"
        ));
    }
    if status.begun_by == start_sequence {
        return match status.job {
            Some(held) if held != job => {
                unknown(format!("START number {start_sequence} began {held} instead of {job}"))
            }
            _ if status.done == start_sequence => Some(Reconciled::Finished(status.into())),
            _ => match status.state {
                MachineState::Execute
                | MachineState::Holding
                | MachineState::Held
                | MachineState::Stopping
                | MachineState::Aborting => Some(Reconciled::Running(status.into())),
                MachineState::Aborted | MachineState::Faulted => Some(Reconciled::Finished(status.into())),
                state => unknown(format!(
                    "the machine accepted START number {start_sequence}, but is in {state} and has no result of this START"
                )),
            },
        };
    }
    let begun = status.last_begun == (job.job, job.cycle);
    match status.state {
        MachineState::Idle | MachineState::Prepared if !begun => None,
        _ if begun => unknown(format!(
            "START number {} began {job}, but this program sent number {start_sequence}",
            status.begun_by
        )),
        state => unknown(format!(
            "the machine is in {state} with another job; START number {} began that job",
            status.begun_by
        )),
    }
}

fn decode_state(number: u16) -> Option<MachineState> {
    const STATES: [MachineState; 10] = [
        MachineState::Idle,
        MachineState::Prepared,
        MachineState::Execute,
        MachineState::Holding,
        MachineState::Held,
        MachineState::Stopping,
        MachineState::Complete,
        MachineState::Aborting,
        MachineState::Aborted,
        MachineState::Faulted,
    ];
    STATES.get(usize::from(number).checked_sub(1)?).copied()
}

fn decode_answer(number: u16) -> Answer {
    match number {
        0 => Answer::None,
        1 => Answer::Accepted,
        2 => Answer::NotOwner,
        3 => Answer::WrongState,
        4 => Answer::UnknownCommand,
        5 => Answer::DeadToken,
        6 => Answer::OtherJob,
        7 => Answer::AlreadyBegun,
        8 => Answer::PayloadMissing,
        9 => Answer::InterlockOpen,
        10 => Answer::OutsideLimits,
        11 => Answer::OtherResult,
        other => Answer::Unlisted(other),
    }
}

/// Defines a driver that wraps a [`ModbusMachine`] and implements [`Machine`] with it.
macro_rules! modbus_driver {
    ($(#[$doc:meta])* $driver:ident, $kind:expr) => {
        $(#[$doc])*
        #[derive(Debug)]
        pub struct $driver(ModbusMachine);

        impl $driver {
            /// Creates the driver of a machine with its own Modbus line (TCP connection or serial port). Sends nothing
            /// until the machine is connected.
            ///
            /// # Errors
            /// The thread of the line cannot be started.
            pub fn new(settings: ModbusSettings) -> io::Result<Self> {
                let link = Link::new(settings.line.clone(), settings.request_timeout, settings.quarantine)?;
                Ok(Self::on(link, settings))
            }

            /// Creates the driver of a machine on the Modbus line `link`, which other machines may also use. The driver
            /// uses the address, the request timeout and the quarantine of `link`. It ignores those in `settings`.
            pub fn on(link: Link, settings: ModbusSettings) -> Self {
                Self(ModbusMachine::new($kind, link, settings))
            }

            /// Returns the Modbus line of this machine. Use it to read the statistics of the line, or to create the
            /// driver of another machine on the same line.
            pub fn link(&self) -> &Link {
                self.0.link()
            }
        }

        impl Machine for $driver {
            fn name(&self) -> &str {
                &self.0.unit.name
            }
            async fn connect(&mut self) -> Result<Identity, DeviceError> {
                self.0.connect().await
            }
            async fn status(&mut self) -> Result<Status, DeviceError> {
                self.0.status().await
            }
            async fn claim(&mut self) -> Result<Status, DeviceError> {
                self.0.claim().await.map(Status::from)
            }
            async fn prepare(&mut self, job: Job) -> Result<Armed, DeviceError> {
                self.0.prepare(job).await
            }
            async fn start(&mut self, armed: Armed) -> Result<Started, DeviceError> {
                self.0.start(armed).await
            }
            async fn hold(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Hold).await.map(Status::from)
            }
            async fn resume(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Resume).await.map(Status::from)
            }
            async fn stop(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Stop).await.map(Status::from)
            }
            async fn abort(&mut self) -> Result<Status, DeviceError> {
                self.0.abort().await.map(Status::from)
            }
            async fn clear(&mut self) -> Result<Status, DeviceError> {
                self.0.run_command(MachineCommand::Clear).await.map(Status::from)
            }
            async fn acknowledge(&mut self, done: u32) -> Result<Status, DeviceError> {
                self.0.acknowledge(done).await.map(Status::from)
            }
            async fn release(&mut self) -> Result<Status, DeviceError> {
                self.0.release().await.map(Status::from)
            }
            async fn reconcile(&mut self, intended: &Armed) -> Result<Reconciled, DeviceError> {
                self.0.reconcile(intended).await
            }
        }
    };
}

modbus_driver!(
    /// Measuring machine that follows docs/modbus.md.
    ModbusCmm,
    MachineKind::Cmm
);
modbus_driver!(
    /// Grinder that follows docs/modbus.md.
    ModbusGrinder,
    MachineKind::Grinder
);

impl Cmm for ModbusCmm {
    async fn load_plan(&mut self, plan: &Plan, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.0.load(plan, interrupt).await
    }

    async fn read_ahead(&mut self, job: Job, interrupt: &Interrupt) -> Option<PreliminaryPoints> {
        self.0.read_ahead(job, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<Measurement, DeviceError> {
        let machine = &mut self.0;
        let (status, header, words) = machine.fetch(job, 4, interrupt).await?;
        if status.outcome != Outcome::Complete {
            return Err(DeviceError::NoResult { machine: machine.machine(), job, state: status.state });
        }
        let measured = digest(&[header.identity]);
        machine.compare([("the digest of the plan that was measured", job.digest.into(), measured.into())])?;
        if let Some(slot) = machine.loaded.get(&Plan::KIND) {
            let targets = (u64::from(slot.bytes) - 64) / 56;
            machine.count("points of the measurement", targets, header.records.into())?;
        }
        let coordinates = machine.coordinates(&header)?;
        let points = words.chunks_exact(header.registers).map(|record| {
            let record = machine.unit.registers(record);
            protocol::decode_point(record, header.format, header.scale_mm).map_err(|flaw| machine.record_error(flaw))
        });
        Ok(Measurement {
            points: points.collect::<Result<_, _>>()?,
            coordinates,
            probe_radius_mm: Some(header.probe_radius_mm),
            temperature_c: header.temperature_c,
            duration_s: Some(header.duration_s),
            plan_identity: header.identity,
            job: job.job,
            cycle: job.cycle,
            done: status.done,
        })
    }
}

impl Grinder for ModbusGrinder {
    async fn load_pass(&mut self, map: &CorrectionMap, pass: &Pass, interrupt: &Interrupt) -> Result<(), DeviceError> {
        self.0.load(map, interrupt).await?;
        self.0.load(pass, interrupt).await
    }

    async fn collect(&mut self, job: Job, interrupt: &Interrupt) -> Result<PassRecord, DeviceError> {
        let machine = &mut self.0;
        let (status, header, words) = machine.fetch(job, 5, interrupt).await?;
        machine.count("pass records", 1, header.records.into())?;
        let figures =
            protocol::decode_pass_record(machine.unit.registers(&words)).map_err(|flaw| machine.record_error(flaw))?;
        let (number, cycle, outcome, [path_mm, removed_mm3, deepest_mm, idle_share, spindle_load, wheel_radius_mm]) =
            figures;
        machine.compare([
            ("the job in the pass record", u64::from(job.job), u64::from(number)),
            ("the cycle in the pass record", u64::from(job.cycle), u64::from(cycle)),
            ("the result in the pass record", status.outcome as u64, outcome as u64),
        ])?;
        if let Some(map) = machine.loaded.get(&CorrectionMap::KIND).filter(|map| map.identity != header.identity) {
            let (sent, held) = (digest(&[map.identity]).into(), digest(&[header.identity]).into());
            let field = "the CRC-32 of the identity of the map that the grinder used";
            return Err(DeviceError::Mismatch { machine: machine.machine(), field, sent, found: held });
        }
        Ok(PassRecord {
            outcome,
            path_mm: Some(path_mm),
            removed_mm3: Some(removed_mm3),
            max_depth_mm: Some(deepest_mm),
            idle_share: Some(idle_share),
            spindle_load: Some(spindle_load),
            wheel_radius_mm: Some(wheel_radius_mm),
            temperature_c: header.temperature_c,
            duration_s: Some(header.duration_s),
            map_identity: header.identity,
            job: job.job,
            cycle: job.cycle,
            done: status.done,
        })
    }
}
