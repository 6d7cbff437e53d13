//! Correcting a program that exists already, by a map over x and y.
//!
//! Every straight line is divided where the correction along it changes, not by its length; an arc stays an arc where the correction is
//! the same all along it, and is written as chords where it is not. Rapid moves and moves in machine coordinates (G53) stay as they
//! are. What moves the tool in a way that the program's text does not tell is refused with its line.

use std::fmt::Write as _;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::arc::{Arc, Centre, Plane};
use super::map::{MapBase, identity_in};
use super::number::{LARGEST_MM, push_fixed, rounded};
use super::read::{Block, Refusal, Word, block};
use super::write::UNCORRECTED;
use super::{GcodeError, hex};
use crate::registration::Draft;
use crate::whole::read_whole;
use regrind_core::compensation::path::{Field, Wanted, displaced};
use regrind_core::geometry::{Point, Vector};

/// Largest program that is read, in bytes.
const MOST_BYTES: u64 = 1 << 30;
/// Most points that one line is divided into.
const MOST_POINTS: f64 = 2e6;
const INCH_MM: f64 = 25.4;

/// How a program is corrected.
#[derive(Debug)]
pub struct Amendment<'a> {
    /// What the surface is moved by along its normal, in millimetres, positive away from the part; over x and y of the program's frame.
    pub shift: &'a Field,
    /// The nominal surface that a ball grinds; `None` to move the program's points along z.
    pub along_normals: Option<AlongNormals<'a>>,
    /// How far the new program may be from the corrected path, in millimetres.
    pub tolerance_mm: f64,
    /// Identity of the map.
    pub map_identity: [u8; 32],
    /// The part that the map belongs to, where it says so.
    pub part: Option<[u8; 32]>,
    /// What the program must have in it already.
    pub base: MapBase,
    /// What the map was multiplied by.
    pub gain: f64,
    /// Whether the map comes from a simulated cell.
    pub simulation: bool,
}

/// The nominal surface under a program, for corrections along its normals.
#[derive(Clone, Copy, Debug)]
pub struct AlongNormals<'a> {
    /// The nominal surface, without a correction.
    pub nominal: &'a Wanted,
    /// How far above the program's point the ball's centre is: 0 where the program moves the centre, the radius where it moves the tip.
    pub centre_above_mm: f64,
}

/// What became of a program.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Amended {
    /// Lines read.
    pub lines: u64,
    /// Straight moves at feed, as read.
    pub straight: u64,
    /// Arcs, as read.
    pub arcs: u64,
    /// Arcs that stayed arcs.
    pub arcs_kept: u64,
    /// Moves at feed that were written.
    pub written: u64,
    /// Largest change of a point, in millimetres.
    pub largest_mm: f64,
}

/// Reads a program, corrects it, and writes it under another name.
///
/// # Errors
/// A program that has the map in it already, that belongs to another part or has another correction in it than the map takes up, or that
/// holds what cannot be corrected; files.
pub fn correct_program(base: &Path, out: &Path, amendment: &Amendment) -> Result<Amended, GcodeError> {
    let bytes = read_whole(base, MOST_BYTES)?;
    let text = std::str::from_utf8(&bytes).map_err(|_| GcodeError::Program {
        path: base.to_owned(),
        what: "the program is no plain text".into(),
        remedy: "give the program as the controller reads it",
    })?;
    refuse_foreign(base, text, amendment)?;
    let mut writer = Rewriter::new(amendment);
    let mut draft = Draft::create(out)?;
    let header = header(&Sha256::digest(&bytes).into(), amendment);
    let mut begun = false;
    for (number, line) in (1..).zip(text.lines()) {
        let refused = |(what, remedy): Refusal| GcodeError::Line { path: base.to_owned(), line: number, what, remedy };
        let block = block(line).map_err(refused)?;
        // The header stands behind the percent sign, if there is one.
        if !begun && !block.percent {
            draft.write(header.as_bytes())?;
            begun = true;
        }
        writer.text.clear();
        writer.line(line, &block).map_err(refused)?;
        draft.write(&writer.text)?;
    }
    draft.publish()?;
    Ok(writer.done)
}

/// Refuses a program that has the map in it, that belongs to another part than the map, or to another correction.
fn refuse_foreign(path: &Path, text: &str, amendment: &Amendment) -> Result<(), GcodeError> {
    let refused = |what: &str, remedy| Err(GcodeError::Program { path: path.to_owned(), what: what.into(), remedy });
    let mut maps = Vec::new();
    let comments = text.lines().filter(|line| line.contains("sha256") || line.contains(UNCORRECTED));
    for line in comments {
        if line.contains(UNCORRECTED) {
            // It is the map named last that the program does without.
            maps.pop();
        }
        maps.extend(identity_in(line, "map:"));
        if identity_in(line, "map:") == Some(amendment.map_identity) {
            return refused(
                "this map is already applied in the program",
                "use the program as it is, or correct the program that it was made from",
            );
        }
        if let (Some(of_program), Some(of_map)) = (identity_in(line, "part:"), amendment.part)
            && of_program != of_map
        {
            return refused("the map belongs to another part than the program", "give the map of this part");
        }
    }
    match amendment.base {
        MapBase::Nothing if !maps.is_empty() => refused(
            "the program has a correction in it, and this one is absolute: it replaces that, it does not come on top of it",
            "correct the program without a correction, as regrind plan --program writes it",
        ),
        MapBase::Map(identity) if !maps.contains(&identity) => refused(
            "the map was measured after a pass with another correction than the program has in it",
            "correct the program that the part was ground with before it was measured",
        ),
        _ => Ok(()),
    }
}

fn header(base: &[u8; 32], amendment: &Amendment) -> String {
    let mut text = String::new();
    // Writing to a string does not fail.
    let _ = writeln!(text, "(Regrind {} corrected program)", env!("CARGO_PKG_VERSION"));
    if amendment.simulation {
        text.push_str("(SIMULATION)\n");
    }
    let _ = writeln!(text, "(base: sha256 {})", hex(base));
    let _ = writeln!(text, "(map: sha256 {})", hex(&amendment.map_identity));
    if let Some(part) = &amendment.part {
        let _ = writeln!(text, "(part: sha256 {})", hex(part));
    }
    let _ = writeln!(text, "(gain: {}, within {} mm)", amendment.gain, super::number::short(amendment.tolerance_mm));
    text.push_str(match amendment.along_normals {
        Some(_) => "(applied along the normals of the corrected surface)\n",
        None => "(applied along z: where the surface has a normal n, e [1 - nz] of a correction e is missing)\n",
    });
    text.push_str("G90\n");
    text
}

/// The state of a controller, as far as it tells where the tool moves, and the text that comes out.
struct Rewriter<'a> {
    amendment: &'a Amendment<'a>,
    text: Vec<u8>,
    done: Amended,
    /// Where the base program has the tool, and where the corrected one; `None` where an axis is not known.
    base: [Option<f64>; 3],
    actual: [Option<f64>; 3],
    motion: Option<u8>,
    plane: Plane,
    unit_mm: f64,
    relative: bool,
    arcs_absolute: bool,
    system: Option<i64>,
    /// Whether anything was moved by now: the coordinate system must not change after that.
    moved: bool,
    ended: bool,
}

/// What the G words of a line ask for.
#[derive(Default)]
struct Asked {
    motion: Option<u8>,
    machine: bool,
}

impl<'a> Rewriter<'a> {
    fn new(amendment: &'a Amendment<'a>) -> Self {
        Self {
            amendment,
            text: Vec::new(),
            done: Amended::default(),
            base: [None; 3],
            actual: [None; 3],
            motion: None,
            plane: Plane::XY,
            unit_mm: 1.0,
            relative: false,
            arcs_absolute: false,
            system: None,
            moved: false,
            ended: false,
        }
    }

    /// Takes one line and writes what becomes of it.
    fn line(&mut self, line: &str, block: &Block) -> Result<(), Refusal> {
        self.done.lines += 1;
        if self.ended || block.words.is_empty() {
            self.text.extend_from_slice(line.as_bytes());
            self.text.push(b'\n');
            return Ok(());
        }
        let asked = self.states(block)?;
        let axes = block.words.iter().any(|w| matches!(w.letter, b'X' | b'Y' | b'Z'));
        if let Some(w) = block.words.iter().find(|w| matches!(w.letter, b'A' | b'B' | b'C' | b'U' | b'V' | b'W')) {
            let found = format!("{} moves an axis that turns the part or the tool", w.text);
            return Err((found, "only programs of X, Y and Z can be corrected by a map over x and y"));
        }
        if !axes {
            if asked.motion.is_some_and(|m| m >= 2) {
                return self.moves(line, block, &asked);
            }
            self.copy(block);
            return Ok(());
        }
        self.moves(line, block, &asked)
    }

    /// Takes in what a line puts in force; refuses what moves the tool otherwise.
    fn states(&mut self, block: &Block) -> Result<Asked, Refusal> {
        let mut asked = Asked::default();
        for word in &block.words {
            match word.letter {
                b'G' => self.g(word, &mut asked)?,
                b'M' => self.m(word)?,
                b'X' | b'Y' | b'Z' | b'I' | b'J' | b'K' | b'R' | b'F' | b'S' | b'T' | b'H' | b'D' | b'P' | b'Q'
                | b'N' => {}
                // Axes that turn are refused by name.
                b'A' | b'B' | b'C' | b'U' | b'V' | b'W' => {}
                _ => return Err((format!("{} is not known", word.text), "remove it, if it does not move the tool")),
            }
        }
        Ok(asked)
    }

    fn g(&mut self, word: &Word, asked: &mut Asked) -> Result<(), Refusal> {
        let tenths = (word.value * 10.0).round();
        if (word.value * 10.0 - tenths).abs() > 1e-6 {
            return Err((format!("{} is not known", word.text), "correct the number"));
        }
        match tenths as i64 {
            code @ (0 | 10 | 20 | 30) => {
                (self.motion, asked.motion) = (Some((code / 10) as u8), Some((code / 10) as u8));
            }
            170 => self.plane = Plane::XY,
            180 => self.plane = Plane::ZX,
            190 => self.plane = Plane::YZ,
            200 => self.unit_mm = INCH_MM,
            210 => self.unit_mm = 1.0,
            900 => self.relative = false,
            910 => self.relative = true,
            901 => self.arcs_absolute = true,
            911 => self.arcs_absolute = false,
            530 => asked.machine = true,
            code @ (540 | 550 | 560 | 570 | 580 | 590 | 591 | 592 | 593) => self.choose_system(code, word)?,
            800 => self.motion = None,
            40 | 400 | 430 | 490 | 610 | 611 | 640 | 940 | 950 | 960 | 970 | 980 | 990 => {}
            930 => {
                let remedy = "let the CAM system write feeds a minute (G94)";
                return Err((
                    format!("{} states times of moves, which a divided line does not keep", word.text),
                    remedy,
                ));
            }
            410..=429 => {
                let remedy = "let the CAM system write the path of the tool's centre (G40)";
                return Err((format!("{} lets the controller move the path by a radius", word.text), remedy));
            }
            730 | 760 | 810..=890 => {
                let remedy = "let the CAM system write the moves of the cycle out";
                return Err((format!("{} is a canned cycle", word.text), remedy));
            }
            _ => {
                let found =
                    format!("{} may move the tool or the zero in a way that the program does not tell", word.text);
                return Err((found, "let the CAM system write plain G0, G1, G2 and G3"));
            }
        }
        Ok(())
    }

    fn choose_system(&mut self, code: i64, word: &Word) -> Result<(), Refusal> {
        let same = self.system == Some(code);
        if !same && self.moved {
            let remedy = "a map belongs to one zero: divide the program";
            return Err((format!("{} changes the zero after the tool has moved at feed", word.text), remedy));
        }
        if !same {
            self.forget([true; 3]);
        }
        self.system = Some(code);
        Ok(())
    }

    fn m(&mut self, word: &Word) -> Result<(), Refusal> {
        match word.value {
            v if v == 2.0 || v == 30.0 => self.ended = true,
            v if v.fract() == 0.0 && (matches!(v as i64, 0..=9 | 19 | 48..=53 | 60..=68)) => {}
            _ => {
                let found = format!("{} is a subprogram, a state of the controller, or the machine's own", word.text);
                return Err((found, "remove it, or write out what it does"));
            }
        }
        Ok(())
    }

    /// Takes in a line that moves the tool.
    fn moves(&mut self, line: &str, block: &Block, asked: &Asked) -> Result<(), Refusal> {
        let Some(motion) = self.motion else {
            return Err(("axes are named and no G0, G1, G2 or G3 is in force".into(), "write which move is meant"));
        };
        let value = |letter: u8| block.words.iter().find(|w| w.letter == letter).map(|w| w.value);
        let named = [b'X', b'Y', b'Z'].map(value);
        for (k, letter) in [b'X', b'Y', b'Z'].into_iter().enumerate() {
            if block.words.iter().filter(|w| w.letter == letter).count() > 1 {
                return Err((format!("{} stands twice", ['X', 'Y', 'Z'][k]), "keep one of them"));
            }
        }
        if asked.machine {
            if motion > 1 || self.relative {
                return Err(("G53 stands with an arc or in G91".into(), "G53 goes with G0 and G1, in G90"));
            }
            self.forget(named.map(|v| v.is_some()));
            self.text.extend_from_slice(line.as_bytes());
            self.text.push(b'\n');
            return Ok(());
        }
        let target = self.target(named)?;
        if motion == 0 {
            return self.rapid(block, named, target);
        }
        let (Some(from), Some(to)) = (all(self.base), all(target)) else {
            let missing: String =
                ['X', 'Y', 'Z'].into_iter().zip(self.base).filter(|(_, v)| v.is_none()).map(|(c, _)| c).collect();
            let remedy = "write a G0 with these axes before it";
            return Err((format!("it is not known where {missing} is when this move begins"), remedy));
        };
        self.copy_before(block);
        self.moved = true;
        let ended = if motion == 1 {
            self.done.straight += 1;
            self.feed(from, to, &|share| from + (to - from) * share, (to - from).norm(), None)
        } else {
            self.done.arcs += 1;
            let arc = self.arc(block, from, to, motion == 2)?;
            self.feed(from, to, &|share| arc.at(share), arc.length(), Some(&arc))
        };
        ended?;
        self.base = target;
        self.copy_after(block);
        Ok(())
    }

    /// Where the base program moves to.
    fn target(&self, named: [Option<f64>; 3]) -> Result<[Option<f64>; 3], Refusal> {
        let mut target = self.base;
        for k in 0..3 {
            let Some(value) = named[k].map(|v| v * self.unit_mm) else { continue };
            let to = if self.relative {
                let Some(before) = self.base[k] else {
                    let found = format!("{} moves by a distance from a place that is not known", ['X', 'Y', 'Z'][k]);
                    return Err((found, "begin with a G0 in absolute coordinates (G90)"));
                };
                before + value
            } else {
                value
            };
            if to.abs() > LARGEST_MM {
                let found = format!(
                    "{} goes to {to:e} mm, farther than the {LARGEST_MM:e} that are written",
                    ['X', 'Y', 'Z'][k]
                );
                return Err((found, "correct the number, or the unit (G20, G21)"));
            }
            target[k] = Some(to);
        }
        Ok(target)
    }

    /// A rapid move goes where it went; only the axes that it names.
    fn rapid(&mut self, block: &Block, named: [Option<f64>; 3], target: [Option<f64>; 3]) -> Result<(), Refusal> {
        self.copy_before(block);
        self.text.extend_from_slice(b"G0");
        for k in (0..3).filter(|&k| named[k].is_some()) {
            if let Some(to) = target[k] {
                self.word([b'X', b'Y', b'Z'][k], to);
                (self.base[k], self.actual[k]) = (Some(to), Some(to));
            }
        }
        self.text.push(b'\n');
        self.copy_after(block);
        Ok(())
    }

    fn arc(&self, block: &Block, from: Point, to: Point, clockwise: bool) -> Result<Arc, Refusal> {
        let value = |letter: u8| block.words.iter().find(|w| w.letter == letter).map(|w| w.value * self.unit_mm);
        if value(b'P').is_some() {
            return Err(("P lets the arc turn several times".into(), "write a line for every turn"));
        }
        let [a, b, c] = self.plane.0;
        let centres = [b'I', b'J', b'K'].map(value);
        let centre = match (value(b'R'), centres[a].is_some() || centres[b].is_some()) {
            (Some(radius), false) => Centre::Radius(radius),
            (None, true) if centres[c].is_none() => Centre::At([a, b].map(|k| {
                let at = centres[k].unwrap_or(0.0);
                if self.arcs_absolute { at } else { at + from[k] }
            })),
            _ => {
                let remedy = "give the two of I, J, K that lie in the plane of the arc, or R";
                return Err(("the centre of the arc is not told, or told twice".into(), remedy));
            }
        };
        if self.arcs_absolute && (centres[a].is_none() || centres[b].is_none()) && matches!(centre, Centre::At(_)) {
            return Err(("G90.1 asks for both places of the centre".into(), "add the missing one"));
        }
        Arc::new(self.plane, from, to, clockwise, centre)
    }

    /// Writes a move at feed, corrected.
    fn feed(
        &mut self,
        from: Point,
        to: Point,
        way: &dyn Fn(f64) -> Point,
        length: f64,
        arc: Option<&Arc>,
    ) -> Result<(), Refusal> {
        let tolerance = self.amendment.tolerance_mm;
        // Fine enough for the map, and an arc's chords take half of the tolerance.
        let grain = 0.25 * self.amendment.shift.spacing_mm().into_iter().fold(f64::INFINITY, f64::min);
        let lateral = match arc {
            None => (to - from).xy().norm(),
            Some(_) => length,
        };
        let pieces = (lateral / grain).ceil().max(1.0).max(arc.map_or(1.0, |a| a.chords(0.5 * tolerance)));
        if pieces > MOST_POINTS {
            let found = format!("the move of {length:.1} mm would be divided into {pieces:.0} pieces");
            return Err((found, "allow a larger tolerance, or take a coarser map"));
        }
        let count = pieces as usize;
        let mut corrected = Vec::with_capacity(count + 1);
        for k in 0..=count {
            // The last point is the one that is written in the program.
            let at = if k == count { to } else { way(k as f64 / count as f64) };
            corrected.push(at + self.displacement(&at)?);
        }
        let largest = (0..=count).map(|k| (corrected[k] - way(k as f64 / count as f64)).norm()).fold(0.0, f64::max);
        self.done.largest_mm = self.done.largest_mm.max(largest);
        // After a rapid move the tool stands where the base program has it: it is brought to where the corrected path begins.
        let here = all(self.actual);
        let beside = here.is_none_or(|here| (here - corrected[0]).norm() > 0.5 * tolerance);
        if beside && lateral > 0.0 {
            self.point(&corrected[0]);
        }
        match arc {
            Some(arc) if is_constant(&corrected, arc, 0.5 * tolerance) => {
                self.done.arcs_kept += 1;
                self.arc_to(arc, &corrected[count]);
            }
            _ => {
                let allowed = if arc.is_some() { 0.45 * tolerance } else { 0.9 * tolerance };
                for k in kept(&corrected, allowed) {
                    self.point(&corrected[k]);
                }
            }
        }
        self.actual = [corrected[count].x, corrected[count].y, corrected[count].z].map(Some);
        Ok(())
    }

    fn displacement(&self, at: &Point) -> Result<Vector, Refusal> {
        let shift = self.amendment.shift;
        let Some(along) = &self.amendment.along_normals else { return Ok(Vector::z() * shift.at([at.x, at.y]).value) };
        let centre = at + Vector::z() * along.centre_above_mm;
        displaced(along.nominal, shift, &centre).ok_or_else(|| {
            let found =
                format!("no place of the nominal surface is under x {:.3}, y {:.3}, z {:.3} mm", at.x, at.y, at.z);
            (found, "is the program in the frame of the nominal surface, and is its point the one that was told?")
        })
    }

    fn point(&mut self, at: &Point) {
        self.done.written += 1;
        self.text.extend_from_slice(b"G1");
        for (k, letter) in [b'X', b'Y', b'Z'].into_iter().enumerate() {
            self.word(letter, at[k]);
        }
        self.text.push(b'\n');
    }

    fn arc_to(&mut self, arc: &Arc, to: &Point) {
        self.done.written += 1;
        self.text.extend_from_slice(if arc.sweep < 0.0 { b"G2" } else { b"G3" });
        for (k, letter) in [b'X', b'Y', b'Z'].into_iter().enumerate() {
            self.word(letter, to[k]);
        }
        for (k, by) in arc.centre_from_start() {
            self.word([b'I', b'J', b'K'][k], if self.arcs_absolute { by + self.arc_start(k) } else { by });
        }
        self.text.push(b'\n');
    }

    fn arc_start(&self, axis: usize) -> f64 {
        self.base[axis].unwrap_or(0.0)
    }

    fn word(&mut self, letter: u8, value_mm: f64) {
        self.text.extend_from_slice(&[b' ', letter]);
        if self.unit_mm == 1.0 {
            push_fixed(&mut self.text, rounded(value_mm));
        } else {
            // A millionth of an inch is 25 nm: two digits more.
            let _ = std::io::Write::write_fmt(&mut self.text, format_args!("{:.8}", value_mm / self.unit_mm));
        }
    }

    /// Copies a line that does not move the tool; the coordinates that come out are absolute whatever the base says.
    fn copy(&mut self, block: &Block) {
        self.copy_before(block);
        self.copy_after(block);
    }

    /// What takes effect before a move.
    fn copy_before(&mut self, block: &Block) {
        self.copy_words(block, |w| !is_of_the_move(w) && !takes_effect_after(w));
    }

    /// What takes effect after a move: stops and the end.
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

    fn copy_words(&mut self, block: &Block, wanted: impl Fn(&Word) -> bool) {
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

    fn forget(&mut self, axes: [bool; 3]) {
        for k in (0..3).filter(|&k| axes[k]) {
            (self.base[k], self.actual[k]) = (None, None);
        }
    }
}

fn all(of: [Option<f64>; 3]) -> Option<Point> {
    Some(Point::new(of[0]?, of[1]?, of[2]?))
}

/// Words that are written anew for every move, and numbers of lines, which would stand twice.
fn is_of_the_move(word: &Word) -> bool {
    match word.letter {
        b'X' | b'Y' | b'Z' | b'I' | b'J' | b'K' | b'R' | b'N' => true,
        b'G' => [0.0, 1.0, 2.0, 3.0, 80.0, 90.0, 91.0].contains(&word.value),
        _ => false,
    }
}

fn takes_effect_after(word: &Word) -> bool {
    word.letter == b'M' && [0.0, 1.0, 2.0, 30.0, 60.0].contains(&word.value)
}

/// Whether a corrected arc is the same arc, moved.
fn is_constant(corrected: &[Point], arc: &Arc, tolerance: f64) -> bool {
    let count = (corrected.len() - 1) as f64;
    let first = corrected[0] - arc.at(0.0);
    (0..corrected.len()).all(|k| (corrected[k] - arc.at(k as f64 / count) - first).norm() <= tolerance)
}

/// Which points must be written so that the lines between them keep to all of them (Douglas and Peucker); without the first.
fn kept(points: &[Point], tolerance: f64) -> Vec<usize> {
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
            // The nearer half last, so that it is taken first: the points come in order.
            Some((deviation, k)) if deviation > tolerance => open.extend([(k, to), (from, k)]),
            _ => kept.push(to),
        }
    }
    kept
}
