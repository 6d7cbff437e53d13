//! States, commands and answers of docs/modbus.md, implemented independently: an error must not be the same at both
//! ends of the wire.

use serde::Serialize;

use crate::register_encoding::{RegisterBlock, WordOrder, bytes_of, crc16};

/// States of docs/modbus.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum State {
    Idle = 1,
    Prepared = 2,
    Execute = 3,
    Holding = 4,
    Held = 5,
    Stopping = 6,
    Complete = 7,
    Aborting = 8,
    Aborted = 9,
    Faulted = 10,
}

/// Commands of docs/modbus.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs)]
pub enum Command {
    Claim = 1,
    Prepare = 2,
    Start = 3,
    Hold = 4,
    Resume = 5,
    Stop = 6,
    Abort = 7,
    Clear = 8,
    Acknowledge = 9,
    Release = 10,
}

impl Command {
    /// All commands, in the order of their numbers.
    pub const ALL: [Self; 10] = [
        Self::Claim,
        Self::Prepare,
        Self::Start,
        Self::Hold,
        Self::Resume,
        Self::Stop,
        Self::Abort,
        Self::Clear,
        Self::Acknowledge,
        Self::Release,
    ];

    /// Returns the command with this number in docs/modbus.md, or `None` if there is none.
    pub fn from_number(number: u16) -> Option<Self> {
        Self::ALL.get(usize::from(number).checked_sub(1)?).copied()
    }

    /// Returns true if a machine in this state may carry out the command.
    pub fn is_allowed_in(self, state: State) -> bool {
        match self {
            Self::Claim | Self::Abort => true,
            Self::Prepare => state == State::Idle,
            Self::Start => state == State::Prepared,
            Self::Hold => state == State::Execute,
            Self::Resume => state == State::Held,
            Self::Stop => matches!(state, State::Prepared | State::Execute | State::Holding | State::Held),
            Self::Clear => matches!(state, State::Aborted | State::Faulted),
            Self::Acknowledge => state == State::Complete,
            Self::Release => state != State::Execute,
        }
    }
}

/// Answers of docs/modbus.md.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum Answer {
    #[default]
    None = 0,
    Accepted = 1,
    NotOwner = 2,
    NotAllowed = 3,
    Unknown = 4,
    Token = 5,
    Different = 6,
    Begun = 7,
    Payload = 8,
    Interlock = 9,
    Limits = 10,
    Argument = 11,
}

/// Command block of 20 registers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CommandFrame {
    /// Sequence number; 0 is never used.
    pub sequence: u32,
    /// Number of the command.
    pub command: u16,
    /// Cycle of the job.
    pub cycle: u16,
    /// Id of the client that commands.
    pub owner: u32,
    /// Number of starts of that client.
    pub epoch: u32,
    /// Run of the part.
    pub job: u32,
    /// CRC-32 of the identities of the payloads that the command refers to.
    pub digest: u32,
    /// Token from PREPARE.
    pub token: u32,
    /// The `done` number, for ACKNOWLEDGE.
    pub argument: u32,
}

impl CommandFrame {
    /// Encodes the command, with its CRC, as the 20 registers of the command block in docs/modbus.md.
    pub fn registers(&self, order: WordOrder) -> Vec<u16> {
        let mut words = RegisterBlock::new(order, 20)
            .u32(0, self.sequence)
            .u16(2, self.command)
            .u16(3, self.cycle)
            .u32(4, self.owner)
            .u32(6, self.epoch)
            .u32(8, self.job)
            .u32(10, self.digest)
            .u32(12, self.token)
            .u32(14, self.argument)
            .u32(18, self.sequence)
            .done();
        words[16] = crc16(&bytes_of(&words[..16]));
        words
    }

    /// Decodes the 20 registers of the command block. Returns `None` if the CRC is wrong, the two copies of the
    /// sequence number differ, or the sequence number is 0.
    pub fn read(order: WordOrder, words: &[u16; 20]) -> Option<Self> {
        let u32_at = |at: usize| order.to_u32([words[at], words[at + 1]]);
        let sound = words[16] == crc16(&bytes_of(&words[..16])) && u32_at(0) == u32_at(18) && u32_at(0) != 0;
        sound.then(|| Self {
            sequence: u32_at(0),
            command: words[2],
            cycle: words[3],
            owner: u32_at(4),
            epoch: u32_at(6),
            job: u32_at(8),
            digest: u32_at(10),
            token: u32_at(12),
            argument: u32_at(14),
        })
    }
}

/// Operating mode, set at the machine's panel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mode {
    /// The client may command.
    #[default]
    Automatic = 1,
    /// A person at the panel controls the machine.
    Manual = 2,
}

/// Bits of the interlocks in the status block.
pub mod interlock {
    /// The guards are closed.
    pub const GUARDS: u16 = 1;
    /// Wheel or probe is clear of the part.
    pub const CLEAR: u16 = 2;
    /// The part is clamped.
    pub const CLAMPED: u16 = 4;
    /// Air and coolant are available.
    pub const SUPPLIES: u16 = 8;
    /// All of them.
    pub const ALL: u16 = 15;
    /// Interlocks that must stay closed while the machine moves.
    pub const MOVING: u16 = GUARDS | CLAMPED | SUPPLIES;
}
