//! Options of a simulated machine, with a register map of its own: the map that the machine really has, while a cell
//! file contains the map that it should have.

use std::time::Duration;

use serde::Deserialize;

use crate::register_encoding::WordOrder;

/// First address of every block.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[allow(missing_docs)]
pub struct RegisterLayout {
    pub identity: u16,
    pub sync: u16,
    pub beat: u16,
    pub command: u16,
    pub status: u16,
    pub in_force: u16,
    pub inbox_header: u16,
    pub inbox_page: u16,
    pub inbox_state: u16,
    pub outbox_header: u16,
    pub outbox_select: u16,
    pub outbox_page: u16,
}

impl Default for RegisterLayout {
    fn default() -> Self {
        Self {
            identity: 0,
            sync: 32,
            beat: 36,
            command: 40,
            status: 64,
            in_force: 120,
            inbox_header: 200,
            inbox_page: 224,
            inbox_state: 350,
            outbox_header: 400,
            outbox_select: 460,
            outbox_page: 462,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Block {
    Identity,
    Sync,
    Beat,
    Command,
    Status,
    InForce,
    InboxHeader,
    InboxPage,
    InboxState,
    OutboxHeader,
    OutboxSelect,
    OutboxPage,
}

impl RegisterLayout {
    fn blocks(&self) -> [(Block, u16, usize); 12] {
        [
            (Block::Identity, self.identity, 32),
            (Block::Sync, self.sync, 4),
            (Block::Beat, self.beat, 3),
            (Block::Command, self.command, 20),
            (Block::Status, self.status, 48),
            (Block::InForce, self.in_force, 72),
            (Block::InboxHeader, self.inbox_header, 24),
            (Block::InboxPage, self.inbox_page, 120),
            (Block::InboxState, self.inbox_state, 12),
            (Block::OutboxHeader, self.outbox_header, 56),
            (Block::OutboxSelect, self.outbox_select, 2),
            (Block::OutboxPage, self.outbox_page, 116),
        ]
    }

    /// Returns the block that contains the register `address`, the offset of the register in the block, and the length
    /// of the block. Returns `None` if no block contains it.
    pub(crate) fn find(&self, address: usize) -> Option<(Block, usize, usize)> {
        self.blocks().into_iter().find_map(|(block, first, length)| {
            let offset = address.checked_sub(first.into())?;
            (offset < length).then_some((block, offset, length))
        })
    }
}

/// Options of a simulated machine.
#[derive(Clone, Debug)]
pub struct MachineOptions {
    /// Order of the words of a value.
    pub word_order: WordOrder,
    /// True if the low byte of each register comes before the high one.
    pub swaps_bytes: bool,
    /// Addresses of the blocks.
    pub layout: RegisterLayout,
    /// Seconds of the machine's own time in a real second.
    pub speed: f64,
    /// Seed of the tokens and of the next boot ids.
    pub seed: u64,
    /// Silence in ms after which a client is lost; 0 means 3000.
    pub lost_after_ms: u16,
    /// Real time that the machine stays in HOLDING, STOPPING or ABORTING.
    pub acting: Duration,
    /// Maximum length of a payload.
    pub payload_limit_bytes: u32,
    /// Version of the register map that the machine reports.
    pub version: u16,
    /// Job and cycle that the machine began before it was switched off.
    pub last_begun: Option<(u32, u16)>,
    /// True if a CMM gives, and declares, the full pages of a result while its job still runs.
    pub gives_ahead: bool,
    /// True if the machine trusts its client: it begins a job that it has begun before, and does not check the payloads
    /// in force against the digest.
    pub trusting: bool,
}

impl Default for MachineOptions {
    fn default() -> Self {
        Self {
            word_order: WordOrder::Big,
            swaps_bytes: false,
            layout: RegisterLayout::default(),
            speed: 1.0,
            seed: 1,
            lost_after_ms: 0,
            acting: Duration::from_millis(150),
            payload_limit_bytes: 64 << 20,
            version: 2,
            last_begun: None,
            gives_ahead: true,
            trusting: false,
        }
    }
}
