//! Faults of the lines of a machine that prints its hits.

/// Fault of a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// The character at this index is lost.
    Lost(usize),
    /// A bit of the character at this index is flipped; a line without parity does not detect it.
    Garbled(usize),
    /// The line end is lost, so that the line runs together with the next one.
    Merged,
    /// The line comes twice.
    Twice,
    /// This text comes before the line.
    Stranger(String),
    /// The line never comes.
    Dropped,
    /// The connection ends after the line.
    HangUp,
}

impl Fault {
    /// Returns the bytes that the machine sends instead of `line` because of this fault. `line` includes the line end.
    /// The bytes are empty if the line is dropped. They equal `line` for [`Self::HangUp`], which only ends the
    /// connection.
    pub fn spoil(&self, mut line: Vec<u8>) -> Vec<u8> {
        match self {
            Self::Lost(at) => drop(line.remove((*at).min(line.len() - 3))),
            Self::Garbled(at) => {
                let at = (*at).min(line.len() - 3);
                line[at] ^= 0x40;
            }
            Self::Merged => line.truncate(line.len() - 2),
            Self::Twice => line.extend(line.clone()),
            Self::Stranger(text) => line.splice(0..0, format!("{text}\r\n").into_bytes()).for_each(drop),
            Self::Dropped => line.clear(),
            Self::HangUp => {}
        }
        line
    }
}

/// Faults by the number of the line, from 1.
pub type PrintFaults = crate::pending_faults::PendingFaults<u64, Fault>;
