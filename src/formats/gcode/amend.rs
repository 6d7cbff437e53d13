//! Correction of an existing program by a map over x and y.
//!
//! ```text
//!  line of the program --control--> what the tool does --Rewriter--> corrected lines --Check--> the new program
//! ```
//! Straight lines are divided according to how the correction changes along them, not by length. An arc stays an arc if
//! the correction is the same all along it; otherwise it is written as chords. Rapid moves, moves in machine
//! coordinates (G53) and moves to the reference point (G28, G30) are copied unchanged. A line that moves the tool in a
//! way that the text does not define is rejected with its line number. Before the program gets its name, a second
//! interpreter reads every written line again and compares it with the base program and the map.

use std::fmt::Write as _;
use std::path::Path;

use data_encoding::HEXLOWER;
use regrind_core::geometry::{Point, Vector};
use sha2::{Digest, Sha256};

use super::GcodeError;
use super::amendment::{Amendment, displacement};
use super::arc::Arc;
use super::check::Check;
use super::control::{AXES, Act, Control, all};
use super::dialect::Dialect;
use super::dialect_reading::{DialectReader, NeutralLine, foreign, has_absolute_centres};
use super::dialect_writing::DialectWriter;
use super::map::{MapBase, identity_in};
use super::number::{push_fixed, rounded};
use super::read::{Block, GcodeWord, Refusal, block};
use super::write::UNCORRECTED;
use crate::is_same_file;
use crate::registration::Draft;
use crate::whole::read_whole;

/// Largest program that is read, in bytes.
const MAX_BYTES: u64 = 1 << 30;
/// Maximum number of pieces that one line is divided into.
const MAX_POINTS: f64 = 2e6;

/// Maximum share of the feed length of a program that can lie outside the map; a larger share means that the map
/// belongs to another program or has another unit.
const MAX_SHARE_OUTSIDE_MAP: f64 = 0.95;

/// Maximum difference between the displacements along an arc that is written as an arc, in millimetres.
const MAX_WOUND_MM: f64 = 1e-3;
/// Rounding error of three coordinates with six decimals, in millimetres.
const ROUNDING_MM: f64 = 2e-6;

/// Summary of a correction.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Amended {
    /// Number of lines read.
    pub lines: u64,
    /// Number of straight moves at feed, as read.
    pub straight: u64,
    /// Number of arcs, as read.
    pub arcs: u64,
    /// Number of arcs that stayed arcs.
    #[serde(rename = "arcs_kept")]
    pub arcs_unchanged: u64,
    /// Number of moves at feed that were written.
    pub written: u64,
    /// Largest displacement of a point, in millimetres.
    #[serde(rename = "largest_mm")]
    pub max_shift_mm: f64,
    /// Length of the moves at feed, in millimetres.
    pub feed_mm: f64,
    /// Length of the moves at feed that lie outside the map, in millimetres. There the values at the border of the map
    /// are used.
    #[serde(rename = "beside_map_mm")]
    pub outside_map_mm: f64,
    /// True if the program has neither G20 nor G21 before its first coordinate, so that millimetres were assumed and
    /// written.
    pub unit_assumed: bool,
}

/// Corrects the grinding program `base` with the map of `amendment`, and writes the corrected program to `out`. Returns
/// a summary of the changes.
///
/// # Errors
/// `out` is not written in any of these cases:
/// - `base` already contains the map, belongs to another part, or contains another correction than the one on which the
///   map is based.
/// - `base` is not a text file, is for an unsupported control, or has a line that cannot be corrected.
/// - `base` has no move at feed, or less than 5 % of its feed length lies inside the map.
/// - The corrected lines do not match the base program and the map when they are checked.
/// - A file cannot be read or written, or `out` is the same file as `base`.
pub fn correct_program(base: &Path, out: &Path, amendment: &Amendment) -> Result<Amended, GcodeError> {
    let bytes = read_whole(base, MAX_BYTES)?;
    let program = |what: &str, remedy| GcodeError::Program { path: base.to_owned(), what: what.into(), remedy };
    let text = decoded(&bytes)
        .ok_or_else(|| program("the program is not plain text", "give the text file that the controller reads"))?;
    let text = &*text;
    let dialect = foreign(amendment.dialect);
    if let Some((what, remedy)) = other_control(text).filter(|_| dialect.is_none()) {
        return Err(program(what, remedy));
    }
    if is_same_file(base, out) {
        return Err(program("the corrected program would overwrite this one", "give another name to --out"));
    }
    refuse_foreign(base, text, amendment)?;
    let mut correction = ProgramCorrection::new(amendment, dialect, text, &Sha256::digest(&bytes).into());
    let mut draft = Draft::create(out)?;
    for (number, line) in (1..).zip(text.lines()) {
        let refused = |(what, remedy): Refusal| GcodeError::Line { path: base.to_owned(), line: number, what, remedy };
        draft.write(&correction.line(line).map_err(refused)?)?;
    }
    let done = correction.rewriter.done;
    if done.straight + done.arcs == 0 {
        return Err(program(
            "the program has no move at feed, so there is nothing to correct",
            "check that the file is the program of the pass",
        ));
    }
    if done.outside_map_mm > MAX_SHARE_OUTSIDE_MAP * done.feed_mm {
        let over_mm = done.feed_mm - done.outside_map_mm;
        let what = format!("only {over_mm:.3} mm of {:.3} mm at feed lie over the map", done.feed_mm);
        let remedy =
            "check that the map is in the frame of the program; check the unit and the decimal points of the program";
        return Err(GcodeError::Program { path: base.to_owned(), what, remedy });
    }
    draft.publish()?;
    Ok(done)
}

/// Correction of a program, line by line.
struct ProgramCorrection<'a> {
    rewriter: Rewriter<'a>,
    check: Check<'a>,
    /// Form of the program, if it is not that of LinuxCNC.
    adapter: Option<DialectAdapter<'a>>,
    header: String,
    /// True if the header is written.
    begun: bool,
}

/// Readers and writer of a dialect.
struct DialectAdapter<'a> {
    base: DialectReader<'a>,
    /// Reader of the lines that are written, for the check.
    corrected: DialectReader<'a>,
    writer: DialectWriter<'a>,
}

impl<'a> ProgramCorrection<'a> {
    fn new(amendment: &'a Amendment<'a>, dialect: Option<&'a Dialect>, text: &str, base: &[u8; 32]) -> Self {
        let mut rewriter = Rewriter::new(amendment);
        rewriter.done.unit_assumed = !states_unit_first(text, dialect);
        let header = header(base, amendment, rewriter.done.unit_assumed);
        let check = Check::new(amendment, &header);
        let adapter = dialect.map(|dialect| DialectAdapter {
            base: DialectReader::new(dialect),
            corrected: DialectReader::new(dialect),
            writer: DialectWriter::new(dialect),
        });
        Self { rewriter, check, adapter, header, begun: false }
    }

    /// Returns the corrected lines for one line of the base program.
    fn line(&mut self, line: &str) -> Result<Vec<u8>, Refusal> {
        if self.rewriter.control.ended {
            // No control reads beyond the end of the program.
            return match &mut self.adapter {
                None => Ok(format!("{line}\n").into_bytes()),
                Some(adapter) => adapter.after_end(line),
            };
        }
        let neutral = match &mut self.adapter {
            None => NeutralLine::new(line),
            Some(adapter) => adapter.base.neutral(line)?,
        };
        let block = block(&neutral.words)?;
        let is_blank = line.trim().is_empty();
        let mut out = Vec::new();
        // The header follows the percent sign and the name of the program, if there is one.
        if !self.begun && !block.percent && !neutral.is_frame && !is_blank {
            out = match &mut self.adapter {
                None => self.header.clone().into_bytes(),
                Some(adapter) => adapter.writer.header(&self.header)?,
            };
            self.begun = true;
        }
        self.rewriter.text.clear();
        match (&neutral.copied, &mut self.adapter) {
            (Some(copied), Some(adapter)) => {
                self.rewriter.stay(&block)?;
                let written = adapter.writer.copied(copied, &neutral.words);
                self.check.line(&neutral.words, &adapter.neutral(&written)?)?;
                out.extend(written);
            }
            (_, adapter) => {
                self.rewriter.line(&neutral.words, &block)?;
                let written = match adapter {
                    None => std::mem::take(&mut self.rewriter.text),
                    Some(adapter) => adapter.writer.express(&self.rewriter.text)?,
                };
                let read = match adapter {
                    None => written.clone(),
                    Some(adapter) => adapter.neutral(&written)?,
                };
                self.check.line(&neutral.words, &read)?;
                out.extend(written);
            }
        }
        self.rewriter.control.ended |= self.begun && block.percent;
        Ok(out)
    }
}

impl DialectAdapter<'_> {
    /// Reads lines that were written, in the words of LinuxCNC.
    fn neutral(&mut self, written: &[u8]) -> Result<Vec<u8>, Refusal> {
        let mut text = Vec::new();
        for line in String::from_utf8_lossy(written).lines() {
            text.extend_from_slice(self.corrected.neutral(line)?.words.as_bytes());
            text.push(b'\n');
        }
        Ok(text)
    }

    /// Copies a line behind the end of the program.
    ///
    /// # Errors
    /// Another program begins: it would stay without the correction.
    fn after_end(&mut self, line: &str) -> Result<Vec<u8>, Refusal> {
        let text = self.base.without_number(line);
        let moves =
            |words: &str| block(words).is_ok_and(|block| block.words.iter().any(|word| b"XYZ".contains(&word.letter)));
        let neutral = self.base.neutral(line).unwrap_or_default();
        if self.base.is_name_line(line) || moves(&neutral.words) {
            let found = "another program begins behind the end of the first one".to_owned();
            return Err((found, "write each program into a file of its own, and correct each"));
        }
        Ok(if text.is_empty() { Vec::new() } else { self.writer.copied(text, "") })
    }
}

/// Decodes a program as UTF-8, or else as Latin-1, which older programs use for remarks. Returns `None` if it has
/// control characters and is therefore not text.
fn decoded(bytes: &[u8]) -> Option<std::borrow::Cow<'_, str>> {
    if bytes.iter().any(|b| *b < b' ' && !b"\t\r\n\x0c".contains(b)) {
        return None;
    }
    let latin = || bytes.iter().map(|b| char::from(*b)).collect::<String>().into();
    Some(std::str::from_utf8(bytes).map_or_else(|_| latin(), Into::into))
}

/// Detects, from the first 20 lines, a program for a Fanuc, Heidenhain or Sinumerik control, which cannot be corrected.
/// Returns the fault and the remedy; `None` for any other program.
fn other_control(text: &str) -> Option<(&'static str, &'static str)> {
    const AGAIN: &str = "name its dialect with --dialect, such as fanuc, sinumerik or heidenhain";
    /// Number of lines that are checked; later lines do not identify the control.
    const LOOKED_AT: usize = 20;
    let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty() && *line != "%").take(LOOKED_AT);
    lines
        .find_map(|line| {
            let number = line.strip_prefix(['O', 'o', ':'])?;
            let digits = number.bytes().take_while(u8::is_ascii_digit).count();
            let rest = number[digits..].trim_start();
            (digits > 0 && (rest.is_empty() || rest.starts_with('(')))
                .then_some("it is a program of a Fanuc control, because one of its lines is a program number")
        })
        .or_else(|| {
            let mut lines = text.lines().take(LOOKED_AT);
            lines
                .any(|line| line.contains("BEGIN PGM"))
                .then_some("it is a program in Klartext, for a Heidenhain control")
        })
        .or_else(|| text.starts_with("%_N_").then_some("it is a program of a Sinumerik control"))
        .map(|what| (what, AGAIN))
}

/// Returns true if the program `text` states its unit (G20 or G21) in or before the first line with a coordinate or a
/// feed. Returns false if such a line comes before any unit.
///
/// Also returns true if the program has no such line, or if a line that cannot be read comes first.
fn states_unit_first(text: &str, dialect: Option<&Dialect>) -> bool {
    let mut reader = dialect.map(DialectReader::new);
    for line in text.lines() {
        let neutral = reader.as_mut().map_or_else(|| Ok(NeutralLine::new(line)), |reader| reader.neutral(line));
        let Ok(line) = neutral.map(|line| line.words) else { return true };
        let Ok(block) = block(&line) else { return true };
        if block.words.iter().any(|word| word.letter == b'G' && [20.0, 21.0].contains(&word.value)) {
            return true;
        }
        if block.words.iter().any(|word| b"XYZIJKRF".contains(&word.letter)) {
            return false;
        }
    }
    true
}

/// Checks that the map of `amendment` can be applied to the program `text`. `path` only names the program in messages.
/// Comments in the program state the part and the maps that the program already contains.
///
/// # Errors
/// - The program already contains this map.
/// - The program states another part than the map.
/// - The map is absolute (it replaces any earlier correction), but the program already contains a correction.
/// - The map was measured after a pass with another map, and the program does not contain that other map ([`MapBase`]).
fn refuse_foreign(path: &Path, text: &str, amendment: &Amendment) -> Result<(), GcodeError> {
    let refused = |what: &str, remedy| Err(GcodeError::Program { path: path.to_owned(), what: what.into(), remedy });
    let mut maps = Vec::new();
    let lines = text.lines().map(str::to_ascii_lowercase);
    for line in lines.filter(|line| line.contains("sha256") || line.contains(UNCORRECTED)) {
        let line = line.as_str();
        if line.contains(UNCORRECTED) {
            // The program was written without correction: the map named last before this line is not in it.
            maps.pop();
        }
        maps.extend(identity_in(line, "map:"));
        if identity_in(line, "map:") == Some(amendment.map.identity) {
            return refused(
                "this map is already applied in the program",
                "use this program without a further correction, or correct its base program",
            );
        }
        if let (Some(of_program), Some(of_map)) = (identity_in(line, "part:"), amendment.map.part)
            && of_program != of_map
        {
            return refused("the map belongs to another part than the program", "give the map of this part");
        }
    }
    match amendment.map.base {
        MapBase::Nothing if !maps.is_empty() => refused(
            "the program already contains a correction, and this map is absolute: it replaces an earlier correction \
             and is not added to it",
            "give the program without correction, as regrind plan --program writes it",
        ),
        MapBase::Map(identity) if !maps.contains(&identity) => refused(
            "the map was measured after a pass with another correction than the one in the program",
            "give the program with which the part was ground before this measurement",
        ),
        _ => Ok(()),
    }
}

fn header(base: &[u8; 32], amendment: &Amendment, unit_assumed: bool) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = writeln!(text, "(Regrind {} corrected program)", env!("CARGO_PKG_VERSION"));
    if amendment.map.simulation {
        text.push_str("(SIMULATION)\n");
    }
    let _ = writeln!(text, "(base: sha256 {})", HEXLOWER.encode(base));
    let _ = writeln!(text, "(map: sha256 {})", HEXLOWER.encode(&amendment.map.identity));
    if let Some(part) = &amendment.map.part {
        let _ = writeln!(text, "(part: sha256 {})", HEXLOWER.encode(part));
    }
    let _ = writeln!(text, "(gain: {}, within {} mm)", amendment.gain, super::number::short(amendment.tolerance_mm));
    text.push_str(match amendment.along_normals {
        Some(_) => "(applied along the normals of the corrected surface)\n",
        None => "(applied along z: where the surface has a normal n, e [1 - nz] of a correction e is missing)\n",
    });
    text.push_str(if unit_assumed { "G21 G90\n" } else { "G90\n" });
    text
}

/// Text of the corrected program, and the position of the tool in it.
struct Rewriter<'a> {
    amendment: &'a Amendment<'a>,
    control: Control,
    text: Vec<u8>,
    done: Amended,
    /// Position of the tool in the corrected program; `None` for an axis whose position is unknown.
    actual: [Option<f64>; 3],
    /// Words of the rotary axes in the current line, all 0; they are written with its first move.
    beside: String,
}

impl<'a> Rewriter<'a> {
    fn new(amendment: &'a Amendment<'a>) -> Self {
        let (mut control, done) = (Control::new(), Amended::default());
        control.arcs_absolute = foreign(amendment.dialect).is_some_and(has_absolute_centres);
        Self { amendment, control, text: Vec::new(), done, actual: [None; 3], beside: String::new() }
    }

    /// Executes one line of the base program, and appends the corrected lines for it to `self.text`. `block` holds the
    /// words of `line`.
    ///
    /// # Errors
    /// A line that cannot be corrected.
    fn line(&mut self, line: &str, block: &Block) -> Result<(), Refusal> {
        self.done.lines += 1;
        if block.words.is_empty() {
            self.text.extend_from_slice(line.as_bytes());
            self.text.push(b'\n');
            return Ok(());
        }
        let act = self.control.execute_block(block)?;
        // If a word of this line makes the position of an axis unknown, it is unknown in the corrected program too.
        (0..3).filter(|&k| self.control.at[k].is_none()).for_each(|k| self.actual[k] = None);
        self.copy_words(block, |w| !is_of_the_move(w, &act) && !takes_effect_after(w));
        self.beside.clear();
        for word in block.words.iter().filter(|w| is_turning(w)) {
            self.beside += " ";
            self.beside += word.text;
        }
        match act {
            Act::Stay => {}
            Act::Upright { by } => {
                let _ = std::io::Write::write_fmt(&mut self.text, format_args!("G{by}{}\n", self.beside));
            }
            Act::Rapid(to) => self.rapid(to),
            Act::Machine { by } => self.machine(block, by),
            Act::Feed { from, to, arc: None } => {
                self.done.straight += 1;
                self.feed(from, to, &|share| from + (to - from) * share, (to - from).norm(), None)?;
            }
            Act::Feed { from, to, arc: Some(arc) } => {
                self.done.arcs += 1;
                self.feed(from, to, &|share| arc.at(share), arc.length(), Some(&arc))?;
            }
        }
        self.copy_after(block);
        Ok(())
    }

    /// Executes a line that is copied.
    ///
    /// # Errors
    /// A line that moves the tool.
    fn stay(&mut self, block: &Block) -> Result<(), Refusal> {
        self.done.lines += 1;
        match self.control.execute_block(block)? {
            Act::Stay => {}
            _ => return Err(("the line moves the tool in a way that is not known".into(), "write out what it does")),
        }
        (0..3).filter(|&k| self.control.at[k].is_none()).for_each(|k| self.actual[k] = None);
        Ok(())
    }

    /// Writes a rapid move to the end position `to` of the base program, in millimetres, without a correction. An axis
    /// that is `None` does not move.
    fn rapid(&mut self, to: [Option<f64>; 3]) {
        self.text.extend_from_slice(b"G0");
        for k in 0..3 {
            if let Some(to) = to[k] {
                self.word(AXES[k], to);
                self.actual[k] = Some(to);
            }
        }
        self.text.extend_from_slice(self.beside.as_bytes());
        self.text.push(b'\n');
    }

    /// Copies a move in machine coordinates (G53) or to the reference point (G28, G30) without a correction. `by` is
    /// the number of the G word of the motion: 0 for a rapid move, 1 for a move at feed. It is `None` for a move to the
    /// reference point. If the base program is in incremental mode (G91), G91 is written before the move and G90 after
    /// it.
    fn machine(&mut self, block: &Block, by: Option<u8>) {
        if self.control.relative {
            self.text.extend_from_slice(b"G91\n");
        }
        let begin = self.text.len();
        let by = by.map(|motion| format!("G{motion}"));
        let words = |wanted: fn(&GcodeWord) -> bool| block.words.iter().filter(move |w| wanted(w)).map(|w| w.text);
        let axes = words(|w| AXES.contains(&w.letter));
        for piece in words(is_machine).chain(by.as_deref()).chain(axes) {
            if self.text.len() > begin {
                self.text.push(b' ');
            }
            self.text.extend_from_slice(piece.as_bytes());
        }
        self.text.push(b'\n');
        if self.control.relative {
            self.text.extend_from_slice(b"G90\n");
        }
    }

    /// Writes the corrected moves that replace one move at feed of the base program. The base move goes from `from` to
    /// `to` and is `length` millimetres long. `way` returns the position on the base move for a fraction from 0 (start)
    /// to 1 (end). `arc` is the arc of the move, and `None` for a straight move.
    ///
    /// # Errors
    /// A displacement above the limit; no nominal surface under a point; a move that would be divided into too many
    /// pieces.
    fn feed(
        &mut self,
        from: Point,
        to: Point,
        way: &dyn Fn(f64) -> Point,
        length: f64,
        arc: Option<&Arc>,
    ) -> Result<(), Refusal> {
        let tolerance = self.amendment.tolerance_mm;
        let lateral = arc.map_or((to - from).xy().norm(), |_| length);
        let is_arc = arc.is_some();
        let shifts = self.shifts(way, (lateral, length), arc)?;
        let count = shifts.len() - 1;
        let corrected: Vec<Point> =
            shifts.iter().enumerate().map(|(k, shift)| way(k as f64 / count as f64) + shift).collect();
        self.measure(way, length, &shifts)?;
        let arc = arc.filter(|arc| self.can_write_arc(arc.rise)).filter(|_| {
            // Controls reject an arc with two radii.
            let alike = (0.5 * tolerance).min(MAX_WOUND_MM);
            shifts.iter().all(|shift| (shift - shifts[0]).norm() <= alike)
        });
        // After a rapid move the tool is where the base program has it. A move brings it to the start of the corrected
        // path; the centre of an arc is relative to that start.
        let near = if arc.is_some() { ROUNDING_MM } else { 0.5 * tolerance };
        let beside = all(self.actual).is_none_or(|here| (here - corrected[0]).norm() > near);
        if beside && (lateral > 0.0 || self.amendment.along_normals.is_some()) {
            self.point(&corrected[0]);
        }
        match arc {
            Some(arc) => {
                self.done.arcs_unchanged += 1;
                self.arc_to(arc, &corrected[0], &corrected[count]);
            }
            None => {
                let allowed = if is_arc { 0.6 * tolerance } else { 0.85 * tolerance };
                for k in simplified_indices(&corrected, allowed) {
                    self.point(&corrected[k]);
                }
            }
        }
        self.actual = [corrected[count].x, corrected[count].y, corrected[count].z].map(Some);
        Ok(())
    }

    /// Returns the displacements, in millimetres, that the map gives to a move of the base program. They belong to
    /// equally spaced points of the move, both ends included. The spacing is fine enough for the map, the arc and the
    /// tolerance.
    ///
    /// `way` returns the position on the move for a fraction from 0 (start) to 1 (end). `length` is the length of the
    /// move in space, and `lateral` the length of its projection onto the xy plane, both in millimetres. `arc` is
    /// `None` for a straight move.
    ///
    /// # Errors
    /// No nominal surface under a point; a move that would be divided into too many pieces.
    fn shifts(
        &self,
        way: &dyn Fn(f64) -> Point,
        (lateral, length): (f64, f64),
        arc: Option<&Arc>,
    ) -> Result<Vec<Vector>, Refusal> {
        let tolerance = self.amendment.tolerance_mm;
        let grain = 0.25 * self.amendment.shift.spacing_mm().into_iter().fold(f64::INFINITY, f64::min);
        let chords = arc.map_or(1.0, |arc| arc.chords(0.25 * tolerance));
        let changes = if self.amendment.along_normals.is_some() { length } else { lateral };
        let mut pieces = (changes / grain).ceil().max(1.0).max(chords);
        loop {
            if pieces > MAX_POINTS {
                let found = format!("the move of {length:.1} mm would be divided into {pieces:.0} pieces");
                return Err((found, "allow a larger tolerance, or use a coarser map"));
            }
            let shifts: Vec<Vector> = (0..=pieces as usize)
                .map(|k| displacement(self.amendment, &way(k as f64 / pieces)))
                .collect::<Result<_, _>>()?;
            // The error of a line between two points is one eighth of the second difference.
            let bends = shifts.windows(3).map(|three| (three[0] - three[1] * 2.0 + three[2]).norm() / 8.0);
            if changes == 0.0 || (pieces > 1.0 && bends.fold(0.0, f64::max) <= 0.05 * tolerance) {
                return Ok(shifts);
            }
            pieces *= 2.0;
        }
    }

    /// Adds a move of the base program to the summary of the correction: its largest displacement, its length, and the
    /// part of its length that lies outside the map, all in millimetres. `way` returns the position on the move for a
    /// fraction from 0 (start) to 1 (end). `shifts` holds the displacements at equally spaced fractions, both ends
    /// included.
    ///
    /// # Errors
    /// A displacement above [`Amendment::max_shift_mm`].
    fn measure(&mut self, way: &dyn Fn(f64) -> Point, length: f64, shifts: &[Vector]) -> Result<(), Refusal> {
        let max_mm = shifts.iter().map(Vector::norm).fold(0.0, f64::max);
        if max_mm > self.amendment.max_shift_mm {
            let found = format!(
                "the map would move the tool by {:.1} µm; the limit is {:.1} µm",
                1e3 * max_mm,
                1e3 * self.amendment.max_shift_mm
            );
            return Err((found, "check the map and its unit, or raise --max-correction-um"));
        }
        self.done.max_shift_mm = self.done.max_shift_mm.max(max_mm);
        let count = shifts.len() - 1;
        let beside = (0..count).filter(|&k| {
            let at = way((k as f64 + 0.5) / count as f64);
            !self.amendment.map.nodes.is_valid_at([at.x, at.y])
        });
        let share = beside.count() as f64 / count as f64;
        // A move without change of position has no length, but has a place.
        let length = length.max(1e-6);
        self.done.feed_mm += length;
        self.done.outside_map_mm += if share == 1.0 { length } else { share * length };
        Ok(())
    }

    /// Tells whether the dialect has words for an arc that rises by `rise_mm`.
    fn can_write_arc(&self, rise_mm: f64) -> bool {
        foreign(self.amendment.dialect).is_none_or(|dialect| {
            dialect.arcs.as_ref().is_some_and(|arcs| arcs.third_axis || rise_mm.abs() <= ROUNDING_MM)
        })
    }

    fn point(&mut self, at: &Point) {
        self.done.written += 1;
        self.text.extend_from_slice(b"G1");
        (0..3).for_each(|k| self.word(AXES[k], at[k]));
        self.text.extend_from_slice(std::mem::take(&mut self.beside).as_bytes());
        self.text.push(b'\n');
    }

    fn arc_to(&mut self, arc: &Arc, from: &Point, to: &Point) {
        self.done.written += 1;
        self.text.extend_from_slice(if arc.sweep < 0.0 { b"G2" } else { b"G3" });
        (0..3).for_each(|k| self.word(AXES[k], to[k]));
        for (k, by) in arc.centre_from_start() {
            self.word([b'I', b'J', b'K'][k], if self.control.arcs_absolute { by + from[k] } else { by });
        }
        self.text.extend_from_slice(std::mem::take(&mut self.beside).as_bytes());
        self.text.push(b'\n');
    }

    fn word(&mut self, letter: u8, value_mm: f64) {
        self.text.extend_from_slice(&[b' ', letter]);
        if self.control.unit_mm == 1.0 {
            push_fixed(&mut self.text, rounded(value_mm));
        } else {
            // A millionth of an inch is 25 nm, so inches need two digits more.
            let _ = std::io::Write::write_fmt(&mut self.text, format_args!("{:.8}", value_mm / self.control.unit_mm));
        }
    }

    /// Copies the words that take effect after the move of their line: stops (M0, M1, M60) and the end of the program
    /// (M2, M30).
    fn copy_after(&mut self, block: &Block) {
        let begin = self.text.len();
        for (k, word) in block.words.iter().filter(|w| takes_effect_after(w)).enumerate() {
            if k > 0 {
                self.text.push(b' ');
            }
            self.text.extend_from_slice(word.text.as_bytes());
        }
        if self.text.len() > begin {
            self.text.push(b'\n');
        }
    }

    fn copy_words(&mut self, block: &Block, wanted: impl Fn(&GcodeWord) -> bool) {
        let begin = self.text.len();
        let words = block.words.iter().filter(|w| wanted(w)).map(|w| w.text);
        for piece in words.chain(block.comments.iter().copied()) {
            if self.text.len() > begin {
                self.text.push(b' ');
            }
            self.text.extend_from_slice(piece.as_bytes());
        }
        if self.text.len() > begin {
            self.text.push(b'\n');
        }
    }
}

/// Returns true for a word that must not be copied to the corrected line. This is so for line numbers, and for words
/// that each corrected move states again, such as axes, motions, arc centres, G90 and G91. `act` is the action of the
/// line; R and P belong to the move only if the action is an arc.
fn is_of_the_move(word: &GcodeWord, act: &Act) -> bool {
    match word.letter {
        b'X' | b'Y' | b'Z' | b'I' | b'J' | b'K' | b'N' | b'A' | b'B' | b'C' => true,
        // In a line without an arc, R and P belong to another word.
        b'R' | b'P' => matches!(act, Act::Feed { arc: Some(_), .. }),
        b'G' => [0.0, 1.0, 2.0, 3.0, 80.0, 90.0, 91.0].contains(&word.value) || is_machine(word),
        _ => false,
    }
}

/// Returns true for G28 and G30 (move to the reference point) and G53 (move in machine coordinates).
fn is_machine(word: &GcodeWord) -> bool {
    word.letter == b'G' && [28.0, 30.0, 53.0].contains(&word.value)
}

fn is_turning(word: &GcodeWord) -> bool {
    matches!(word.letter, b'A' | b'B' | b'C')
}

fn takes_effect_after(word: &GcodeWord) -> bool {
    word.letter == b'M' && [0.0, 1.0, 2.0, 30.0, 60.0].contains(&word.value)
}

/// Simplifies a polyline with the Douglas-Peucker algorithm. Returns the indices, in ascending order, of the points to
/// keep. The straight lines between these points stay within `tolerance` millimetres of all `points`. The first point
/// is always kept, but its index is not returned.
fn simplified_indices(points: &[Point], tolerance: f64) -> Vec<usize> {
    let mut kept = Vec::new();
    let mut open = vec![(0, points.len() - 1)];
    while let Some((from, to)) = open.pop() {
        let (a, along) = (points[from], points[to] - points[from]);
        let length2 = along.norm_squared();
        let off = |k: usize| {
            let arm = points[k] - a;
            let share = if length2 > 0.0 { (arm.dot(&along) / length2).clamp(0.0, 1.0) } else { 0.0 };
            (arm - along * share).norm()
        };
        let worst = (from + 1..to).map(|k| (off(k), k)).max_by(|a, b| a.0.total_cmp(&b.0));
        match worst {
            // The first half is pushed last, so that it is processed first and the points come in order.
            Some((deviation, k)) if deviation > tolerance => open.extend([(k, to), (from, k)]),
            _ => kept.push(to),
        }
    }
    kept
}
