//! Common part of both Modbus machines: the connection, the heartbeats and the status.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::time::Instant;

use super::link::{Link, LinkRequest};
use super::pages_ahead::{ReadAhead, ReadAheadFailures};
use super::protocol;
use super::settings::{ModbusSettings, Signal};
use super::status_block::{StatusBlock, decode_answer, decode_state};
use super::unit::{ModbusUnit, UnitSettings};
use crate::{DeviceError, Fault, Identity, Job, MachineKind, MachineState, SignalValue, Status};

/// Time after which a machine with an unchanged heartbeat counts as frozen.
const FROZEN_AFTER: Duration = Duration::from_millis(1500);
/// Temperature in the status of a machine without a thermometer.
const NO_THERMOMETER: i16 = i16::MIN;

/// Common part of the drivers of both machines.
#[derive(Debug)]
pub struct ModbusMachine {
    pub(super) unit: ModbusUnit,
    pub(super) owner: u32,
    pub(super) epoch: u32,
    pub(super) retries: u32,
    pub(super) signals: Vec<Signal>,
    pub(super) heartbeat_interval: Duration,
    pub(super) expected_name: Option<String>,
    pub(super) simulation: Option<bool>,
    pub(super) sequence: u32,
    /// True if the machine has acknowledged this client as its owner on this connection. Only the heartbeat of an owner
    /// is written.
    pub(super) owned: bool,
    /// True if this client has connected to the machine before.
    pub(super) has_connected: bool,
    /// Sequence number of the START that was sent or reconciled last. Only a job begun by this START belongs to this
    /// client.
    pub(super) last_start: Option<u32>,
    pub(super) heartbeat: u16,
    pub(super) last_heartbeat: Option<Instant>,
    pub(super) machine_heartbeat: Option<(u16, Instant)>,
    pub(super) loaded: BTreeMap<u16, Slot>,
    /// Last status block, for the one step of reading ahead that may follow it.
    pub(super) last_block: Option<StatusBlock>,
    /// Pages of a result that were read while its job ran.
    pub(super) read_ahead: Option<ReadAhead>,
    pub(super) read_ahead_failures: ReadAheadFailures,
}

/// Payload that this driver has brought into force at the machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Slot {
    pub(super) bytes: u32,
    pub(super) crc: u32,
    pub(super) identity: [u8; 32],
}

impl ModbusMachine {
    pub(super) fn new(kind: MachineKind, link: Link, settings: ModbusSettings) -> Self {
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

    pub(super) fn machine(&self) -> std::sync::Arc<str> {
        self.unit.name.clone()
    }

    /// Returns the Modbus line to this machine, which other machines may share.
    pub fn link(&self) -> &Link {
        &self.unit.link
    }

    pub(super) async fn connect(&mut self) -> Result<Identity, DeviceError> {
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

    pub(super) async fn status(&mut self) -> Result<Status, DeviceError> {
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

    /// Sends the heartbeat if it is due. Then reads the status block and returns its values. All values belong to the
    /// same moment. The additional signals of the cell file are not part of the block.
    ///
    /// # Errors
    /// The two snapshot numbers of the block still differ after several reads, a value is invalid, a request fails, the
    /// machine was restarted, or its heartbeat no longer changes.
    pub(super) async fn read_status_block(&mut self) -> Result<StatusBlock, DeviceError> {
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

    pub(super) fn decode_status(&mut self, words: &[u16]) -> Result<StatusBlock, DeviceError> {
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

    /// Writes the heartbeat, a counter that shows the machine that its client is alive. Does nothing if the heartbeat
    /// interval since the last write has not passed, or if this client is not the owner of the machine.
    pub(super) async fn send_heartbeat(&mut self) -> Result<(), DeviceError> {
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

    /// Reads the additional signal with the index `k` in the cell file. Returns the value in the unit of the signal,
    /// together with the name, the unit and the allowed range from the cell file. If the machine answers with a Modbus
    /// exception, the value is `None` and the result contains the cause. The value is also `None` if it is not finite.
    ///
    /// # Errors
    /// Returns an error if the request fails for another reason, for example because no answer arrives.
    pub(super) async fn signal(&mut self, k: usize) -> Result<SignalValue, DeviceError> {
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
}
