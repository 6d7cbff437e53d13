//! One machine on a line. Its identity is verified before its data are used, and again each time the line was reopened.
//! A request without an answer is retried.
//!
//! Every request through a unit is idempotent: reads, and writes of values. There are no pulses.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::link::{Link, LinkFault, LinkRequest};
use super::protocol::{Registers, Writer};
use super::settings::{RegisterMap, WordOrder};
use crate::{DeviceError, Identity, MachineKind};

/// First words of an identity block.
const MAGIC: [u16; 2] = [0x5247, 0x4431];
/// Version of the map that this program uses.
const VERSION: u16 = 2;
/// Number of registers of the identity block.
const IDENTITY_REGISTERS: u16 = 32;
/// Flags of an identity block.
const SIMULATION: u16 = 1;
const OFFERS_READ_AHEAD: u16 = 2;
/// Pause before a busy machine is asked again.
const BUSY_PAUSE: Duration = Duration::from_millis(50);
/// Time for which a busy machine is retried at connection. It is shorter than the time that the cell waits for the
/// machine, so that the answer of the machine is reported.
const CONNECT_BUSY_TIMEOUT: Duration = Duration::from_secs(15);
/// Sentinel values of an identity block, which show the word order.
const SENTINEL_WHOLE: u32 = 0x1234_5678;
const SENTINEL_REAL: f64 = -2.5e-7;

/// One machine on a line.
#[derive(Debug)]
pub(super) struct ModbusUnit {
    pub(super) name: Arc<str>,
    pub(super) link: Link,
    pub(super) map: RegisterMap,
    unit: u8,
    kind: MachineKind,
    retries: u32,
    lost_after: Duration,
    /// Generation of the line on which the identity was verified; `None` if the identity must be verified.
    verified_generation: Option<u64>,
    identity: Option<Identity>,
    /// Flags of its identity.
    flags: u16,
}

/// Settings of a unit for its machine.
pub(super) struct UnitSettings {
    pub(super) unit: u8,
    pub(super) map: RegisterMap,
    pub(super) retries: u32,
    pub(super) lost_after: Duration,
}

impl ModbusUnit {
    pub(super) fn new(kind: MachineKind, link: Link, settings: UnitSettings) -> Self {
        let UnitSettings { unit, map, retries, lost_after } = settings;
        let name = format!("{kind} at {}, unit {unit}", link.line()).into();
        Self { name, link, map, unit, kind, retries, lost_after, verified_generation: None, identity: None, flags: 0 }
    }

    /// Returns the verified identity of the machine. Returns `None` if no connection has verified it yet, or if the
    /// last call of [`Self::connect`] failed.
    pub(super) fn identity(&self) -> Option<&Identity> {
        self.identity.as_ref()
    }

    /// Returns true if the machine supports reading full pages of a result (blocks of registers) while the job still
    /// runs. Returns false if the identity of the machine is not verified.
    pub(super) fn offers_read_ahead(&self) -> bool {
        self.identity.is_some() && self.flags & OFFERS_READ_AHEAD != 0
    }

    /// Returns the generation (number of the connection) on which the identity of the machine was verified. Returns
    /// `None` if the identity must be verified again. The connection with this number may already be lost.
    pub(super) fn generation(&self) -> Option<u64> {
        self.verified_generation
    }

    pub(super) fn registers<'a>(&self, words: &'a [u16]) -> Registers<'a> {
        Registers::new(words, self.map.word_order)
    }

    pub(super) fn writer(&self) -> Writer {
        Writer::new(self.map.word_order)
    }

    /// Discards the known identity, verifies the identity of the machine again, and returns it. After a communication
    /// error, or while the program of the machine is still starting, tries again for a limited time.
    ///
    /// # Errors
    /// The machine cannot be reached, gives a wrong answer, or is not the expected machine.
    pub(super) async fn connect(&mut self) -> Result<Identity, DeviceError> {
        self.connect_within(CONNECT_BUSY_TIMEOUT).await
    }

    /// Discards the known identity, verifies the identity of the machine again, and returns it. While the machine
    /// answers that its program is still starting, tries again for up to the time `busy`. Also tries again after a
    /// communication error, as every other request does.
    ///
    /// # Errors
    /// The machine cannot be reached, gives a wrong answer, or is not the expected machine.
    pub(super) async fn connect_within(&mut self, busy: Duration) -> Result<Identity, DeviceError> {
        self.identity = None;
        self.verified_generation = None;
        let began = Instant::now();
        for tries in 0.. {
            match self.verify_identity().await {
                Ok(_) => break,
                // Its program may still be starting: the machine is there and answers so.
                Err(error) if is_starting(&error) && began.elapsed() < busy => self.pause_before_retry(&error).await,
                Err(error) if self.is_final(&error, tries, began) => return Err(error),
                Err(error) => self.pause_before_retry(&error).await,
            }
        }
        self.identity.clone().ok_or(DeviceError::NotConnected { machine: self.name.clone(), operation: "identity" })
    }

    /// Reads `count` registers from `address`. `what` is the name of the operation in error messages. If the line was
    /// reopened, first verifies the identity of the machine again. Repeats the request after a communication error.
    ///
    /// # Errors
    /// Returns [`DeviceError::NotConnected`] if `connect` has not verified the machine. Otherwise returns the last
    /// error of the request.
    pub(super) async fn read(&mut self, what: &'static str, address: u16, count: u16) -> Result<Vec<u16>, DeviceError> {
        self.exchange(what, address, LinkRequest::Read { address, count }).await
    }

    /// Writes the registers `words` from `address`. `what` is the name of the operation in error messages. If the line
    /// was reopened, first verifies the identity of the machine again. Repeats the request after a communication error,
    /// so the machine may receive the same write more than once.
    ///
    /// # Errors
    /// Returns [`DeviceError::NotConnected`] if `connect` has not verified the machine. Otherwise returns the last
    /// error of the request.
    pub(super) async fn write(&mut self, what: &'static str, address: u16, words: &[u16]) -> Result<(), DeviceError> {
        self.exchange(what, address, LinkRequest::Write { address, words: words.into() }).await.map(drop)
    }

    /// Sends the request `ask` once, without a retry. Use it for a request whose failure has no consequences. `what`
    /// and `address` describe the operation in error messages. Returns the received registers.
    ///
    /// # Errors
    /// Returns [`DeviceError::NotConnected`] if the identity of the machine must be verified again. Otherwise returns
    /// the error of the request.
    pub(super) async fn request_once(
        &mut self,
        what: &'static str,
        address: u16,
        ask: LinkRequest,
    ) -> Result<Vec<u16>, DeviceError> {
        let Some(generation) = self.verified_generation else {
            return Err(DeviceError::NotConnected { machine: self.name.clone(), operation: what });
        };
        let answer = self.send(Some(generation), ask).await;
        answer.map(|(_, words)| words).map_err(|fault| self.device_error(what, address, fault))
    }

    /// Sends the request `ask` once. If `generation` is given, sends it only on the connection with this number.
    /// Exchanges the two bytes of each sent and received register if the word order of the machine requires it. Returns
    /// the generation (number of the connection) and the received registers.
    async fn send(&self, generation: Option<u64>, ask: LinkRequest) -> Result<(u64, Vec<u16>), LinkFault> {
        let order = self.map.word_order;
        let ask = match ask {
            LinkRequest::Write { address, words } if order.swaps_bytes() => {
                LinkRequest::Write { address, words: order.bytes_in_order(words.to_vec()).into() }
            }
            ask => ask,
        };
        let (generation, words) = self.link.request(self.unit, generation, ask).await?;
        Ok((generation, order.bytes_in_order(words)))
    }

    /// Closes the connection because the machine sent invalid data. Returns the error [`DeviceError::Corrupt`] with the
    /// name `what` of these data, the `expected` value and the value `found`.
    pub(super) async fn reject_data(&mut self, what: &'static str, expected: u64, found: u64) -> DeviceError {
        if let Some(generation) = self.verified_generation.take() {
            // A stale generation is equally good: then another machine has given the connection up already.
            let _ = self.link.request(self.unit, Some(generation), LinkRequest::DropConnection).await;
        }
        DeviceError::Corrupt { machine: self.name.clone(), data: what, expected, found }
    }

    /// Decides after the error `error` whether a request is given up (true) or sent again (false). `tries` is the
    /// number of retries so far, and `began` is the time of the first request.
    ///
    /// Gives up if one of these conditions is true:
    ///
    /// - The error is not a communication error.
    /// - The setting `lost_after` (maximum time for one request with its retries) has passed since `began`.
    /// - `tries` has reached the setting `retries` (maximum number of retries). This condition does not hold if the
    ///   machine answered that it is busy.
    fn is_final(&self, error: &DeviceError, tries: u32, began: Instant) -> bool {
        !error.is_link() || (tries >= self.retries && !error.is_busy()) || began.elapsed() >= self.lost_after
    }

    /// Adds one retry to the statistics of the line. If `error` states that the machine is busy, then waits for
    /// [`BUSY_PAUSE`]. Otherwise returns at once.
    async fn pause_before_retry(&self, error: &DeviceError) {
        self.link.count_retry();
        if error.is_busy() {
            sleep(BUSY_PAUSE).await;
        }
    }

    async fn exchange(&mut self, what: &'static str, address: u16, ask: LinkRequest) -> Result<Vec<u16>, DeviceError> {
        if self.identity.is_none() {
            return Err(DeviceError::NotConnected { machine: self.name.clone(), operation: what });
        }
        self.request_with_retries(what, address, ask, false).await
    }

    /// Sends the request `ask`, and sends it again after a communication error. The setting `retries` limits the number
    /// of retries, even if the machine answers that it is busy. So the next read of the status is not delayed long.
    /// `what` (name of the operation) and `address` (first register) are used only in error messages. Returns the
    /// registers of the answer.
    ///
    /// # Errors
    /// Returns the error of the last try.
    pub(super) async fn request_with_limit(
        &mut self,
        what: &'static str,
        address: u16,
        ask: LinkRequest,
    ) -> Result<Vec<u16>, DeviceError> {
        self.request_with_retries(what, address, ask, true).await
    }

    async fn request_with_retries(
        &mut self,
        what: &'static str,
        address: u16,
        ask: LinkRequest,
        few: bool,
    ) -> Result<Vec<u16>, DeviceError> {
        let began = Instant::now();
        let mut tries = 0;
        loop {
            match self.attempt(what, address, &ask).await {
                Ok(words) => return Ok(words),
                Err(error) if self.is_final(&error, tries, began) || few && tries >= self.retries => return Err(error),
                Err(error) => self.pause_before_retry(&error).await,
            }
            tries += 1;
        }
    }

    async fn attempt(&mut self, what: &'static str, address: u16, ask: &LinkRequest) -> Result<Vec<u16>, DeviceError> {
        loop {
            let generation = match self.verified_generation {
                Some(generation) => generation,
                None => self.verify_identity().await?,
            };
            match self.send(Some(generation), ask.clone()).await {
                Ok((_, words)) => return Ok(words),
                // Another machine on the line has met an error. Prove this machine again; the request itself was not
                // sent yet.
                Err(LinkFault::Stale) => self.verified_generation = None,
                Err(fault) => return Err(self.device_error(what, address, fault)),
            }
        }
    }

    fn device_error(&mut self, what: &'static str, address: u16, fault: LinkFault) -> DeviceError {
        let machine = self.name.clone();
        if let LinkFault::Exception(code) = fault {
            return DeviceError::Exception { machine, operation: what, address, code };
        }
        self.verified_generation = None;
        match fault {
            LinkFault::Unreachable(reason) => {
                DeviceError::Unreachable { machine, kind: reason, limit: self.lost_after }
            }
            LinkFault::TimedOut => {
                DeviceError::TimedOut { machine, operation: what, limit: self.link.request_timeout() }
            }
            LinkFault::Corrupt { what, expected, found } => {
                DeviceError::Corrupt { machine, data: what, expected, found }
            }
            LinkFault::Disconnected | LinkFault::Stale | LinkFault::Exception(_) => {
                DeviceError::Disconnected { machine, operation: what }
            }
        }
    }

    /// Verifies the identity of the machine and returns the generation (number of the connection). The steps are:
    ///
    /// - Read the identity block.
    /// - Write two random words and read back their bitwise complements. An older answer cannot contain them.
    /// - Read the identity block again. Both blocks must be equal.
    ///
    /// # Errors
    /// A request fails, the answers are wrong, it is not the expected machine, or the machine was restarted since the
    /// last verification.
    async fn verify_identity(&mut self) -> Result<u64, DeviceError> {
        let first = self.map.identity;
        let read = LinkRequest::Read { address: first, count: IDENTITY_REGISTERS };
        let asked = self.send(None, read.clone()).await;
        let (generation, words) = asked.map_err(|fault| self.device_error("identity", first, fault))?;
        let identity = self.decode_identity(&words)?;
        self.synchronise(generation).await?;
        let again = self.send(Some(generation), read).await;
        let (_, again) = again.map_err(|fault| self.device_error("identity", first, fault))?;
        self.verified_generation = Some(generation);
        if again != words {
            return Err(self.reject_data("second reading of the identity", crc(&words), crc(&again)).await);
        }
        let machine = self.name.clone();
        match &self.identity {
            Some(known) if known.boot_id != identity.boot_id => {
                self.verified_generation = None;
                Err(DeviceError::Restarted { machine, old_boot_id: known.boot_id, new_boot_id: identity.boot_id })
            }
            _ => {
                self.identity = Some(identity);
                self.flags = words[12];
                Ok(generation)
            }
        }
    }

    async fn synchronise(&mut self, generation: u64) -> Result<(), DeviceError> {
        let address = self.map.sync;
        let nonce: [u16; 2] = rand::random();
        let write = LinkRequest::Write { address, words: Arc::from(&nonce[..]) };
        let written = self.send(Some(generation), write).await;
        written.map_err(|fault| self.device_error("proof of sync", address, fault))?;
        let read = self.send(Some(generation), LinkRequest::Read { address, count: 4 }).await;
        let (_, found) = read.map_err(|fault| self.device_error("proof of sync", address, fault))?;
        let expected = [nonce[0], nonce[1], !nonce[0], !nonce[1]];
        if found != expected {
            self.verified_generation = Some(generation);
            let number = |words: &[u16]| words.iter().fold(0, |bits, word| (bits << 16) | u64::from(*word));
            return Err(self.reject_data("proof of sync", number(&expected), number(&found)).await);
        }
        Ok(())
    }

    /// Decodes the 32 registers of an identity block.
    ///
    /// # Errors
    /// The block does not belong to the expected machine: the device, the kind of machine, the version of the register
    /// map, the word order, the register addresses or the unit of length are wrong.
    pub(super) fn decode_identity(&self, words: &[u16]) -> Result<Identity, DeviceError> {
        let machine = self.name.clone();
        if let Some(how) = layout_fault(words, self.map.word_order) {
            return Err(DeviceError::WrongLayout { machine, description: how });
        }
        for (at, required) in MAGIC.into_iter().enumerate() {
            if words[at] != required {
                let address = self.map.identity.saturating_add(at as u16);
                return Err(DeviceError::WrongDevice {
                    machine,
                    expected: self.kind,
                    address,
                    required,
                    found: words[at],
                });
            }
        }
        if words[2] != VERSION {
            return Err(DeviceError::WrongVersion { machine, required: VERSION, found: words[2] });
        }
        let sentinels_fit = |order| {
            let block = Registers::new(words, order);
            block.u32(4) == SENTINEL_WHOLE && block.f64(6).to_bits() == SENTINEL_REAL.to_bits()
        };
        if !sentinels_fit(self.map.word_order) {
            let fits = sentinels_fit(self.map.word_order.with_words_swapped())
                .then_some(self.map.word_order.with_words_swapped().name());
            return Err(DeviceError::WrongWordOrder {
                machine,
                configured: self.map.word_order.name(),
                matching: fits,
            });
        }
        let block = self.registers(words);
        let kind = match words[3] {
            1 => MachineKind::Cmm,
            2 => MachineKind::Grinder,
            other => return Err(DeviceError::Unlisted { machine, field: "its kind", found: u32::from(other) }),
        };
        if kind != self.kind {
            return Err(DeviceError::WrongKind { machine, expected: self.kind, found: kind });
        }
        if words[13] != 1 {
            return Err(DeviceError::WrongLengthUnit { machine, unit: words[13] });
        }
        let silence_ms = if words[15] == 0 { 3000 } else { words[15] };
        Ok(Identity {
            kind,
            name: block.text(16, 16),
            boot_id: block.u32(10),
            simulation: words[12] & SIMULATION != 0,
            silence_limit_s: Some(f64::from(silence_ms) / 1e3),
        })
    }
}

/// Returns true for the Modbus exceptions 5 and 6, with which a machine answers that it cannot reply now. The
/// exceptions of a gateway that finds no machine do not count.
fn is_starting(error: &DeviceError) -> bool {
    matches!(error, DeviceError::Exception { code: 5 | 6, .. })
}

/// Returns a text that explains how the registers of an identity block are displaced: they are one address too early or
/// too late, or the two bytes of each register are exchanged. `order` is the word order in the cell file. Returns
/// `None` if the block is at the right address, or if `words` contains no identity block.
fn layout_fault(words: &[u16], order: WordOrder) -> Option<Cow<'static, str>> {
    let begins = |from: usize, swap: fn(u16) -> u16| {
        let due = [MAGIC[0], MAGIC[1], VERSION];
        // A block that begins one register early has lost its first word.
        let (due, from) = if from == 0 { (&due[1..], 0) } else { (&due[..], from - 1) };
        due.iter().enumerate().all(|(k, word)| words.get(from + k).is_some_and(|found| swap(*found) == *word))
    };
    let (as_it_is, swapped) = (|word: u16| word, u16::swap_bytes);
    if begins(1, swapped) {
        let exchanged: Vec<u16> = words.iter().copied().map(u16::swap_bytes).collect();
        let other = order.with_bytes_swapped();
        let is_whole = |order| Registers::new(&exchanged, order).u32(4) == SENTINEL_WHOLE;
        let fits = if is_whole(other) { other } else { other.with_words_swapped() };
        Some(
            format!(
                "the two bytes of each register are in the other order than in the cell file: write word_order = \"{}\" \
             in the cell file, or set the server of the machine or the gateway to send the other byte first",
                fits.name()
            )
            .into(),
        )
    } else if begins(2, as_it_is) || begins(2, swapped) {
        Some(
            "the block is one register later than in the cell file: the server of the machine counts from 1, but the protocol \
             counts from 0; correct the addresses of the server, or add 1 to each address in the table `registers` of the cell file"
                .into(),
        )
    } else if begins(0, as_it_is) || begins(0, swapped) {
        Some(
            "the block is one register earlier than in the cell file: the server of the machine subtracts 1 from each address; correct \
             the addresses of the server, or subtract 1 from each address in the table `registers` of the cell file"
                .into(),
        )
    } else {
        None
    }
}

fn crc(words: &[u16]) -> u64 {
    u64::from(super::protocol::crc32(words))
}
