//! Transfer of a payload to a machine in pages, and the comparison of the slots in force.

use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::commands::SETTLE_TIMEOUT;
use super::machine::{ModbusMachine, Slot};
use super::protocol::{PAGE_REGISTERS, Payload, crc32};
use super::status_block::decode_answer;
use crate::{Answer, DeviceError, Interrupt, MachineState};

impl ModbusMachine {
    pub(super) async fn load<P: Payload>(&mut self, payload: &P, interrupt: &Interrupt) -> Result<(), DeviceError> {
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
    pub(super) async fn compare_slot(&mut self, kind: u16) -> Result<(), DeviceError> {
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

    pub(super) fn check_interrupt(
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
}
