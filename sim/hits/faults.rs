//! What goes wrong with the lines of a machine that prints its hits.

/// Something that goes wrong with a line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A character, by its place, is lost.
    Lost(usize),
    /// A bit of a character is another, by its place: what a line without parity does not notice.
    Garbled(usize),
    /// The end of the line is lost, so that it runs together with the next one.
    Merged,
    /// It comes twice.
    Twice,
    /// Something else comes before it.
    Stranger(String),
    /// It never comes.
    Dropped,
    /// The connection ends behind it.
    HangUp,
}

impl Fault {
    /// Returns what comes of a line.
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

/// Faults of lines, by their numbers, from 1.
pub type Faults = crate::faults::Faults<u64, Fault>;
