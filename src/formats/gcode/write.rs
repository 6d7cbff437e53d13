//! Writing a program for LinuxCNC and its kin, a move a line, as fast as a file takes it.

use std::fmt::Write as _;
use std::path::Path;

use super::number::{LARGEST_MM, push_fixed, rounded, short};
use super::{GcodeError, PathMode, hex};
use crate::compensation::path::{Move, Summary};
use crate::formats::registration::Draft;

/// Bytes that are gathered before they go to the file.
const CHUNK: usize = 1 << 16;

/// What the header of a program tells.
#[derive(Clone, Debug)]
pub struct ProgramHeader {
    /// The part by name.
    pub part: String,
    /// The pass, from 1.
    pub cycle: u16,
    /// SHA-256 of what the nominal surface came from: what the path was made over.
    pub base_identity: [u8; 32],
    /// Identity of the correction that is in the path.
    pub map_identity: [u8; 32],
    /// Height of the surface wanted over the nominal one, in millimetres.
    pub level_mm: f64,
    /// The wheel in words.
    pub wheel: String,
    /// The tracks in words.
    pub tracks: String,
    /// How often the program is run again without going deeper.
    pub spark_out_passes: u16,
    /// Whether the cell is simulated.
    pub simulation: bool,
    /// How exactly the controller keeps to the path.
    pub mode: PathMode,
}

/// Writes a program: the header, the moves, the end.
///
/// Frame: the model frame, which G54 must have its zero in. Units: mm, mm/min. A coordinate that does not change is left out. The file
/// appears whole or not at all.
///
/// # Errors
/// A coordinate that is not finite or beyond a kilometre; a number of moves other than the summary has; a file that cannot be written.
pub fn write_program(
    path: &Path,
    header: &ProgramHeader,
    summary: &Summary,
    moves: impl Iterator<Item = Move>,
) -> Result<(), GcodeError> {
    let mut draft = Draft::create(path)?;
    let head = header_text(header, summary);
    draft.write(head.as_bytes())?;
    let mut lines = Lines { text: Vec::with_capacity(CHUNK + 256), last: [i64::MAX; 3], mode: None, feed: 0, count: 0 };
    for one in moves {
        lines.push(&one)?;
        if lines.text.len() >= CHUNK {
            draft.write(&lines.text)?;
            lines.text.clear();
        }
    }
    if lines.count != summary.moves {
        return Err(GcodeError::Count { found: lines.count, expected: summary.moves });
    }
    lines.text.extend_from_slice(b"M2\n");
    draft.write(&lines.text)?;
    draft.publish()?;
    Ok(())
}

/// The lines of the moves, and what is in force after them.
struct Lines {
    text: Vec<u8>,
    last: [i64; 3],
    mode: Option<u8>,
    /// In millionths.
    feed: i64,
    count: u64,
}

impl Lines {
    #[inline]
    fn push(&mut self, one: &Move) -> Result<(), GcodeError> {
        self.count += 1;
        match one {
            Move::RapidZ(z) => {
                self.mode(b'0');
                self.word(2, *z)?;
            }
            Move::RapidXy([x, y]) => {
                self.mode(b'0');
                self.word(0, *x)?;
                self.word(1, *y)?;
            }
            Move::Feed { at, feed_mm_min } => {
                self.mode(b'1');
                for k in 0..3 {
                    self.word(k, at[k])?;
                }
                let feed = rounded(*feed_mm_min);
                if feed != self.feed {
                    self.feed = feed;
                    self.text.push(b'F');
                    self.text.extend_from_slice(short(*feed_mm_min).as_bytes());
                }
            }
        }
        self.text.push(b'\n');
        Ok(())
    }

    #[inline]
    fn mode(&mut self, mode: u8) {
        if self.mode != Some(mode) {
            self.mode = Some(mode);
            self.text.extend_from_slice(&[b'G', mode, b' ']);
        }
    }

    #[inline]
    fn word(&mut self, axis: usize, value_mm: f64) -> Result<(), GcodeError> {
        if value_mm.is_nan() || value_mm.abs() > LARGEST_MM {
            return Err(GcodeError::NotFinite { axis: ['X', 'Y', 'Z'][axis], value_mm, number: self.count });
        }
        let value = rounded(value_mm);
        if value != self.last[axis] {
            self.last[axis] = value;
            self.text.push([b'X', b'Y', b'Z'][axis]);
            push_fixed(&mut self.text, value);
        }
        Ok(())
    }
}

/// The header, with the number of its own lines counted in.
fn header_text(header: &ProgramHeader, summary: &Summary) -> String {
    let without = header_lines(header, summary, 0);
    let lines = without.lines().count() as u64 + summary.moves + 1;
    header_lines(header, summary, lines)
}

fn header_lines(h: &ProgramHeader, s: &Summary, lines: u64) -> String {
    let mut text = String::new();
    let mut say = |words: std::fmt::Arguments| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "({})", comment(&words.to_string()));
    };
    if h.simulation {
        say(format_args!("SIMULATION"));
    }
    say(format_args!("Regrind {} tool path", env!("CARGO_PKG_VERSION")));
    say(format_args!("part: {}", h.part));
    say(format_args!("part: sha256 {}", hex(&h.base_identity)));
    say(format_args!("cycle: {}", h.cycle));
    say(format_args!("base: sha256 {}", hex(&h.base_identity)));
    say(format_args!("map: sha256 {}", hex(&h.map_identity)));
    say(format_args!("frame: model, z away from the part; G54 has its zero in the origin of the model"));
    say(format_args!("units: mm, mm/min; a correction is positive where it leaves material, along the outward normal"));
    say(format_args!("level over the nominal surface: {} mm", short(h.level_mm)));
    say(format_args!("wheel: {}", h.wheel));
    say(format_args!("tracks: {}", h.tracks));
    say(format_args!("feed: {} mm/min", short(s.feed_mm_min)));
    say(format_args!("spark-out: the program is run {} times more", h.spark_out_passes));
    for (k, axis) in ['X', 'Y', 'Z'].into_iter().enumerate() {
        say(format_args!("limits: {axis} {} to {} mm", short(s.least_mm[k]), short(s.most_mm[k])));
    }
    say(format_args!("length: {} mm at feed, {:.1} minutes", short(s.length_mm.round()), s.seconds / 60.0));
    say(format_args!("points: {}", s.points));
    say(format_args!("lines: {lines}"));
    say(format_args!("spindle and coolant are the machine's own; start them before"));
    let _ = writeln!(text, "G21 G90 G94 G17 G40 G49 G80 G54\n{}", h.mode);
    text
}

/// Returns words that may stand in a comment: no brackets, which would end it or begin another, and plain characters.
pub(super) fn comment(words: &str) -> String {
    let plain = |c: char| match c {
        '(' => '[',
        ')' => ']',
        ' '..='~' => c,
        _ => '?',
    };
    words.chars().map(plain).take(200).collect()
}
