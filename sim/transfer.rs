//! Transfer of payloads to the machine and of results from it, page by page.

use crate::body::{Kind, Payload, ResultData};
use crate::register_encoding::{RegisterBlock, WordOrder, bytes_of, registers_of, turn_payload};

/// Number of data registers of a full page.
pub const PAGE_REGISTERS: usize = 112;
const PAGE_BYTES: u32 = 2 * PAGE_REGISTERS as u32;

/// State of an inbox.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum InboxState {
    /// There is no header yet.
    #[default]
    Empty = 0,
    /// The inbox waits for pages.
    Receiving = 1,
    /// The payload is in force.
    InForce = 2,
    /// All pages have arrived, and do not match the header.
    CrcWrong = 3,
    /// The machine cannot use the payload.
    Refused = 4,
}

/// Payload that has arrived completely, in the machine's word order as it was sent.
#[derive(Clone, Debug)]
pub(crate) struct Arrived {
    pub kind: u16,
    pub bytes: Vec<u8>,
    pub identity: [u8; 32],
}

/// Inbox in which a payload is assembled.
#[derive(Debug, Default)]
pub(crate) struct Inbox {
    kind: u16,
    pub(crate) state: InboxState,
    announced_bytes: u32,
    crc: u32,
    identity: [u8; 32],
    next_page: u32,
    bytes: Vec<u8>,
    computed: u32,
    pub(crate) reason: u16,
}

impl Inbox {
    /// Reads the header of a new payload and prepares the inbox for the pages of this payload. A page is a block of at
    /// most 112 data registers. `order` is the word order of the machine, and `words` are the registers of the header.
    /// `of` is the kind of machine. `limit_bytes` is the maximum length of a payload, in bytes.
    ///
    /// Returns true if the header is accepted. Returns false, and changes nothing, if the machine does not use this
    /// kind of payload, if the length of the payload is 0, or if this length is above the limit.
    pub(crate) fn header(&mut self, order: WordOrder, words: &[u16], of: Kind, limit_bytes: u32) -> bool {
        let (kind, announced_bytes) = (words[0], order.to_u32([words[2], words[3]]));
        if slot_of(of, kind).is_none() || announced_bytes == 0 || announced_bytes > limit_bytes {
            return false;
        }
        let mut identity = [0; 32];
        identity.copy_from_slice(&bytes_of(&words[8..24]));
        *self = Self {
            kind,
            state: InboxState::Receiving,
            announced_bytes,
            crc: order.to_u32([words[4], words[5]]),
            identity,
            ..Self::default()
        };
        true
    }

    /// Reads one page of a payload. A page is a block of at most 112 data registers, after 8 registers with its number
    /// and length. `order` is the word order of the machine, and `words` are the registers of the page.
    ///
    /// Returns one of three values:
    ///
    /// - `None`: the page is refused. It is not the next page, its length is wrong, or no header came before.
    /// - `Some(Some(_))`: the page was the last one and the CRC is right. The value contains the complete payload.
    /// - `Some(None)`: the page is accepted, but there is no complete payload. Pages are still missing, the page was
    ///   already accepted before, or the CRC is wrong.
    pub(crate) fn page(&mut self, order: WordOrder, words: &[u16]) -> Option<Option<Arrived>> {
        if self.has_page(order, words) {
            return Some(None);
        }
        let left = (self.announced_bytes - self.bytes.len() as u32).min(PAGE_BYTES);
        let wanted = left.div_ceil(2) as usize;
        let fits = usize::from(words[2]) == wanted && words.len() == 8 + wanted;
        if self.state != InboxState::Receiving || order.to_u32([words[0], words[1]]) != self.next_page || !fits {
            return None;
        }
        self.bytes.extend(&bytes_of(&words[8..])[..left as usize]);
        self.next_page += 1;
        Some(if self.bytes.len() as u32 == self.announced_bytes { self.close() } else { None })
    }

    /// Returns true if a page was accepted already. `words` are the registers of this page; the first two contain its
    /// number. `order` is the word order of the machine, which is necessary to read the number.
    pub(crate) fn has_page(&self, order: WordOrder, words: &[u16]) -> bool {
        order.to_u32([words[0], words[1]]) < self.next_page
    }

    fn close(&mut self) -> Option<Arrived> {
        self.computed = crc32fast::hash(&self.bytes);
        if self.computed != self.crc {
            self.state = InboxState::CrcWrong;
            return None;
        }
        self.state = InboxState::InForce;
        Some(Arrived { kind: self.kind, bytes: self.bytes.clone(), identity: self.identity })
    }

    /// Marks the payload in the inbox as refused: the machine cannot use it. `answer` is the number of the reason, from
    /// the list in docs/modbus.md. The client can read this number.
    pub(crate) fn refuse(&mut self, answer: u16) {
        self.state = InboxState::Refused;
        self.reason = answer;
    }

    pub(crate) fn image(&self, order: WordOrder) -> Vec<u16> {
        RegisterBlock::new(order, 12)
            .u16(0, self.kind)
            .u16(1, self.state as u16)
            .u32(2, self.next_page)
            .u32(4, self.bytes.len() as u32)
            .u32(6, self.computed)
            .u16(8, self.reason)
            .done()
    }
}

/// Returns the index, from 0, of the slot (the memory for one payload in use) for payloads of the kind `kind`. Returns
/// `None` if this machine does not use payloads of this kind.
pub(crate) fn slot_of(machine: Kind, kind: u16) -> Option<usize> {
    match (machine, kind) {
        (Kind::Cmm, 1) => Some(0),
        (Kind::Grinder, 2) => Some(1),
        (Kind::Grinder, 3) => Some(2),
        _ => None,
    }
}

/// Payload in force.
#[derive(Clone, Debug)]
pub(crate) struct Slot {
    /// Payload as the physics reads it.
    pub payload: Payload,
    /// CRC of the bytes as they were sent.
    pub crc: u32,
}

impl Slot {
    pub(crate) fn new(order: WordOrder, arrived: Arrived) -> Self {
        let crc = crc32fast::hash(&arrived.bytes);
        let mut bytes = arrived.bytes;
        if order == WordOrder::Little {
            turn_payload(arrived.kind, 1, &mut bytes);
        }
        Self { payload: Payload { bytes, identity: arrived.identity }, crc }
    }
}

pub(crate) fn slots_image(order: WordOrder, slots: &[Option<Slot>; 3]) -> Vec<u16> {
    let mut image = RegisterBlock::new(order, 72);
    for (index, slot) in slots.iter().enumerate() {
        let at = 24 * index;
        image = image.u16(at, index as u16 + 1);
        if let Some(slot) = slot {
            image = image
                .u16(at + 1, 1)
                .u32(at + 2, slot.payload.bytes.len() as u32)
                .u32(at + 4, slot.crc)
                .bytes(at + 8, &slot.payload.identity);
        }
    }
    image.done()
}

/// Result of a job, until it is acknowledged.
#[derive(Clone, Debug)]
pub(crate) struct Outbox {
    header: Vec<u16>,
    registers: Vec<u16>,
}

/// Origin of a result.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Origin {
    pub job: u32,
    pub cycle: u16,
    pub done: u32,
    pub identity: [u8; 32],
}

impl Outbox {
    /// Packs the records that a running job has produced so far as an outbox (the registers from which a client reads a
    /// result). `outcome` contains these records. `order` is the word order of the machine, and `origin` identifies the
    /// job.
    ///
    /// In the header, the CRC is 0. The `done` number, by which a client acknowledges a finished result, is also 0. The
    /// outbox contains only full pages of 112 data registers. Returns `None` if a value in the header, for example the
    /// temperature, is not finite.
    pub(crate) fn partial(order: WordOrder, outcome: ResultData, origin: Origin) -> Option<Self> {
        let mut outbox = Self::new(order, outcome, Origin { done: 0, ..origin })?;
        outbox.header[4..6].fill(0);
        let full = outbox.registers.len() / PAGE_REGISTERS * PAGE_REGISTERS;
        outbox.registers.truncate(full);
        Some(outbox)
    }

    /// Packs the result `outcome` as an outbox (the registers from which a client reads a result). `order` is the word
    /// order of the machine, and `origin` identifies the job. Returns `None` if a value in the header, for example the
    /// temperature, is not finite.
    pub(crate) fn new(order: WordOrder, outcome: ResultData, origin: Origin) -> Option<Self> {
        let figures = [outcome.probe_radius_mm, outcome.scale_mm, outcome.temperature_c, outcome.duration_s];
        if !figures.iter().all(|figure| figure.is_finite()) {
            return None;
        }
        let mut bytes = outcome.bytes;
        if order == WordOrder::Little {
            turn_payload(outcome.kind, outcome.format, &mut bytes);
        }
        let header = RegisterBlock::new(order, 56)
            .u16(0, outcome.kind)
            .u16(1, outcome.format)
            .u32(2, bytes.len() as u32)
            .u32(4, crc32fast::hash(&bytes))
            .u32(6, origin.job)
            .u16(8, origin.cycle)
            .u16(9, outcome.coordinates)
            .u32(10, outcome.records)
            .f64(12, figures[0])
            .f64(16, figures[1])
            .f64(20, figures[2])
            .f64(24, figures[3])
            .u16(28, 1)
            .bytes(30, &origin.identity)
            .u32(46, origin.done)
            .done();
        Some(Self { header, registers: registers_of(&bytes) })
    }

    pub(crate) fn header_image(&self) -> Vec<u16> {
        self.header.clone()
    }

    /// Returns the 116 registers of one page of the outbox. `page` is the number of the page, from 0, and `order` is
    /// the word order of the machine. A page after the last one contains no data: its number of data registers is 0.
    pub(crate) fn page_image(&self, order: WordOrder, page: u32) -> Vec<u16> {
        let data = self.registers.chunks(PAGE_REGISTERS).nth(page as usize).unwrap_or(&[]);
        page_image(order, page, data)
    }
}

/// Returns the 116 registers of one page of an outbox: the number of the page, the number of its data registers, and
/// the data registers. `data` contains at most 112 registers; the registers after them are 0. `order` is the word order
/// of the machine.
pub(crate) fn page_image(order: WordOrder, page: u32, data: &[u16]) -> Vec<u16> {
    RegisterBlock::new(order, 4 + PAGE_REGISTERS).u32(0, page).u16(2, data.len() as u16).words(4, data).done()
}
