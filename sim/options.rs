//! How a machine is set up, with a register map of its own: what the machine really has, where a cell file says what it should have.

use std::time::Duration;

use crate::words::WordOrder;

/// The first address of every block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub struct Layout {
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

impl Default for Layout {
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

impl Layout {
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

    /// Returns the block that an address lies in, and where in it.
    pub(crate) fn find(&self, address: usize) -> Option<(Block, usize, usize)> {
        self.blocks().into_iter().find_map(|(block, first, length)| {
            let offset = address.checked_sub(first.into())?;
            (offset < length).then_some((block, offset, length))
        })
    }
}

/// How a simulated machine is set up.
#[derive(Clone, Debug)]
pub struct MachineOptions {
    /// In which order the words of a value stand.
    pub word_order: WordOrder,
    /// Whether the low byte of each register stands before the high one.
    pub swaps_bytes: bool,
    /// Where the blocks are.
    pub layout: Layout,
    /// Seconds of the machine's own time in a real second.
    pub speed: f64,
    /// Draws the tokens and the next boot ids.
    pub seed: u64,
    /// Milliseconds after which a silent client is lost; 0 stands for 3000.
    pub lost_after_ms: u16,
    /// Real time that the machine is HOLDING, STOPPING or ABORTING.
    pub acting: Duration,
    /// The longest payload it holds.
    pub payload_limit_bytes: u32,
    /// The version of the map that it says it keeps.
    pub version: u16,
    /// The job and cycle it began before it was switched off.
    pub last_begun: Option<(u32, u16)>,
    /// A CMM gives the full pages of a result while its job still runs, and says so.
    pub gives_ahead: bool,
    /// It takes its client's word: begins a job that it has begun before, and does not hold what is in force against what is told to be.
    pub trusting: bool,
}

impl Default for MachineOptions {
    fn default() -> Self {
        Self {
            word_order: WordOrder::Big,
            swaps_bytes: false,
            layout: Layout::default(),
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
