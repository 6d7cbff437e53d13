//! Check of a corrected program: a second interpreter reads the base program and the corrected program line by line,
//! and compares the corrected lines with the base and the map.
//!
//! This interpreter shares only the splitting of a line into words with the interpreter that corrects, so that each
//! finds the mistakes of the other.

use std::collections::BTreeMap;

use regrind_core::geometry::{Point, Vector};

use super::amendment::{Amendment, displacement};
use super::dialect_reading::{foreign, has_absolute_centres, has_g_words};
use super::number::PER_MM;
use super::read::{Block, Refusal, block};

/// Number of steps of the last written digit by which three coordinates and an arc's centre can be rounded.
const ROUNDED_STEPS: f64 = 4.0;

/// Maximum difference between the radii at the ends of an arc, in millimetres; controls reject a larger one.
const MAX_WOUND_MM: f64 = 0.0127 + 0.004;

/// Base program and corrected program, read side by side.
pub(super) struct Check<'a> {
    amendment: &'a Amendment<'a>,
    base: Machine,
    corrected: Machine,
    /// Tolerance for the rounding to the last written digit, in millimetres.
    digits_mm: f64,
    /// False for Klartext, in which each arc has its plane.
    has_planes: bool,
}

/// Modal state and position of a machine.
#[derive(Clone, Debug, Default)]
struct Machine {
    at: [Option<f64>; 3],
    inches: bool,
    by_distance: bool,
    centres_absolute: bool,
    /// 0 for XY, 1 for ZX, 2 for YZ.
    plane: usize,
    /// Zero (work coordinate system) in force, as ten times the number of its G word.
    zero: Option<i64>,
    motion: Option<u8>,
    feed: Option<f64>,
    over: bool,
}

/// Movement of one line.
#[derive(Debug)]
enum Movement {
    /// Rapid move, not at feed: its end position, as far as it is known.
    Rapid([Option<f64>; 3]),
    /// Move in machine coordinates: its motion, whether it is incremental, and its words.
    Machine(Option<u8>, bool, String),
    Straight(Point, Point),
    Round(Round),
}

/// Move around a centre, with or without a rise.
#[derive(Debug)]
struct Round {
    from: Point,
    to: Point,
    centre: [f64; 2],
    axes: [usize; 3],
    angle: f64,
}

impl Movement {
    fn at(&self, share: f64) -> Point {
        match self {
            Self::Straight(from, to) => from + (to - from) * share,
            Self::Round(round) => round.at(share),
            Self::Rapid(_) | Self::Machine(..) => Point::origin(),
        }
    }

    fn length(&self) -> f64 {
        match self {
            Self::Straight(from, to) => (to - from).norm(),
            Self::Round(round) => round.length(),
            Self::Rapid(_) | Self::Machine(..) => 0.0,
        }
    }
}

impl Round {
    /// Returns the point at `share` of the arc, from 0 at its start to 1 at its end, in millimetres. The angle, the
    /// radius and the coordinate perpendicular to the plane change linearly from the start to the end.
    fn at(&self, share: f64) -> Point {
        let [a, b, c] = self.axes;
        let [p, q] = [self.from[a] - self.centre[0], self.from[b] - self.centre[1]];
        let [s, t] = [self.to[a] - self.centre[0], self.to[b] - self.centre[1]];
        let stretch = 1.0 + (s.hypot(t) / p.hypot(q) - 1.0) * share;
        let (sine, cosine) = (self.angle * share).sin_cos();
        let mut at = self.from;
        at[a] = self.centre[0] + stretch * (p * cosine - q * sine);
        at[b] = self.centre[1] + stretch * (p * sine + q * cosine);
        at[c] = self.from[c] + (self.to[c] - self.from[c]) * share;
        at
    }

    fn length(&self) -> f64 {
        let [a, b, c] = self.axes;
        let radius = (self.from[a] - self.centre[0]).hypot(self.from[b] - self.centre[1]);
        (radius * self.angle).hypot(self.to[c] - self.from[c])
    }
}

impl Machine {
    /// Executes the words of a line: updates the state of the machine and returns the movement. Returns `None` for a
    /// line without a movement, or after the end of the program.
    ///
    /// # Errors
    /// A movement that the words do not define, such as a move at feed from an unknown position.
    fn read(&mut self, block: &Block) -> Result<Option<Movement>, String> {
        if self.over {
            return Ok(None);
        }
        let number = |letter: u8| block.words.iter().find(|w| w.letter == letter).map(|w| w.value);
        let codes: Vec<i64> =
            block.words.iter().filter(|w| w.letter == b'G').map(|w| (w.value * 10.0).round() as i64).collect();
        let is_zero = |code: &&i64| (540..600).contains(*code);
        let other_zero = codes.iter().find(is_zero).is_some_and(|code| self.zero.replace(*code) != Some(*code));
        let tool = block.words.iter().any(|w| w.letter == b'M' && w.value == 6.0);
        if other_zero || tool || codes.contains(&921) {
            self.at = [None; 3];
        }
        if codes.iter().any(|code| [430, 490].contains(code)) {
            self.at[2] = None;
        }
        let moves = codes.iter().any(|code| [0, 10, 20, 30].contains(code));
        for code in &codes {
            match code {
                0 | 10 | 20 | 30 => self.motion = Some((code / 10) as u8),
                800 if !moves => self.motion = None,
                170 | 180 | 190 => self.plane = ((code - 170) / 10) as usize,
                200 | 210 => self.inches = *code == 200,
                900 | 910 => self.by_distance = *code == 910,
                901 | 911 => self.centres_absolute = *code == 901,
                _ => {}
            }
        }
        let scale = if self.inches { 25.4 } else { 1.0 };
        self.feed = number(b'F').map(|feed| feed * scale).or(self.feed);
        self.over = block.words.iter().any(|w| w.letter == b'M' && (w.value == 2.0 || w.value == 30.0));
        let named = [number(b'X'), number(b'Y'), number(b'Z')];
        if let Some(code) = codes.iter().find(|code| [280, 300, 530].contains(*code)) {
            let alone = named.iter().all(Option::is_none);
            (0..3).filter(|&k| alone || named[k].is_some()).for_each(|k| self.at[k] = None);
            let by = self.motion.filter(|_| *code == 530);
            return Ok(Some(Movement::Machine(by, self.by_distance, format!("{code} {named:?} {scale}"))));
        }
        let offsets = [number(b'I'), number(b'J'), number(b'K')];
        let around = offsets.iter().any(Option::is_some) && matches!(self.motion, Some(2 | 3));
        if named.iter().all(Option::is_none) && !around {
            return Ok(None);
        }
        let mut to = self.at;
        for k in 0..3 {
            if let Some(value) = named[k] {
                let begin = if self.by_distance { self.at[k].ok_or("a distance from an unknown place")? } else { 0.0 };
                to[k] = Some(begin + value * scale);
            }
        }
        let from = std::mem::replace(&mut self.at, to);
        match self.motion.ok_or("axes without a motion")? {
            0 => Ok(Some(Movement::Rapid([0, 1, 2].map(|k| to[k].filter(|_| named[k].is_some()))))),
            motion => {
                let whole = |of: [Option<f64>; 3]| Some(Point::new(of[0]?, of[1]?, of[2]?));
                let (from, to) = whole(from).zip(whole(to)).ok_or("a move at feed from an unknown place")?;
                if motion == 1 {
                    return Ok(Some(Movement::Straight(from, to)));
                }
                self.round((from, to), motion == 3, offsets, number(b'R'), scale)
                    .map(|round| Some(Movement::Round(round)))
            }
        }
    }

    fn round(
        &self,
        (from, to): (Point, Point),
        left: bool,
        offsets: [Option<f64>; 3],
        radius: Option<f64>,
        scale: f64,
    ) -> Result<Round, String> {
        let axes = [[0, 1, 2], [2, 0, 1], [1, 2, 0]][self.plane];
        let [a, b, _] = axes;
        let (p, q) = (Vector::new(from[a], from[b], 0.0), Vector::new(to[a], to[b], 0.0));
        let centre = match radius {
            Some(radius) => {
                let (half, radius) = ((q - p) / 2.0, radius * scale);
                let height2 = radius * radius - half.norm_squared();
                let normal = Vector::new(-half.y, half.x, 0.0) / half.norm();
                let side = if left == (radius > 0.0) { 1.0 } else { -1.0 };
                p + half + normal * (side * height2.max(0.0).sqrt())
            }
            None => {
                let of = |k: usize| offsets[k].unwrap_or(0.0) * scale;
                let given = Vector::new(of(a), of(b), 0.0);
                if self.centres_absolute { given } else { p + given }
            }
        };
        let (begin, end) = (p - centre, q - centre);
        let mut angle = (begin.x * end.y - begin.y * end.x).atan2(begin.x * end.x + begin.y * end.y);
        // If start and end are equal, the arc is a full turn.
        if left && angle < 1e-9 {
            angle += std::f64::consts::TAU;
        } else if !left && angle > -1e-9 {
            angle -= std::f64::consts::TAU;
        }
        if begin.norm() == 0.0 {
            return Err("an arc about its own beginning".into());
        }
        if (begin.norm() - end.norm()).abs() > MAX_WOUND_MM {
            return Err(format!("an arc of two radii, {:.4} and {:.4} mm", begin.norm(), end.norm()));
        }
        Ok(Round { from, to, centre: [centre.x, centre.y], axes, angle })
    }
}

impl<'a> Check<'a> {
    /// Creates a check that compares a corrected program with its base program. `header` holds the lines that the
    /// correction writes at the beginning of the corrected program. Their modal words, such as G90, are applied to the
    /// corrected program only.
    pub(super) fn new(amendment: &'a Amendment<'a>, header: &str) -> Self {
        let dialect = foreign(amendment.dialect);
        let centres_absolute = dialect.is_some_and(has_absolute_centres);
        let machine = || Machine { centres_absolute, ..Machine::default() };
        let per_mm = dialect.map_or(PER_MM, |dialect| 10f64.powi(i32::from(dialect.numbers.decimals)));
        let (base, corrected) = (machine(), machine());
        let has_planes = dialect.is_none_or(has_g_words);
        let mut check = Self { amendment, base, corrected, digits_mm: ROUNDED_STEPS / per_mm, has_planes };
        for line in header.lines() {
            // The header contains no moves.
            let _ = block(line).map(|block| check.corrected.read(&block));
        }
        check
    }

    /// Compares `line`, the next line of the base program, with `text`, the corrected lines for it.
    ///
    /// # Errors
    /// Corrected lines that do not follow from the base line and the map.
    pub(super) fn line(&mut self, line: &str, text: &[u8]) -> Result<(), Refusal> {
        self.compared(line, text).map_err(|found| {
            let found = format!("the corrected lines differ from the base and the map: {found}");
            (found, "nothing was written; report this fault with the program and the map")
        })
    }

    fn compared(&mut self, line: &str, text: &[u8]) -> Result<(), String> {
        let readable = |(found, _): Refusal| found;
        let base = block(line).map_err(readable)?;
        let over = self.base.over;
        let wanted = self.base.read(&base)?;
        let text = std::str::from_utf8(text).map_err(|_| "the corrected lines are not text")?;
        let (mut ways, mut words) = (Vec::new(), BTreeMap::new());
        for line in text.lines() {
            let block = block(line).map_err(readable)?;
            count_words(&block, &mut words, 1);
            if let Some(way) = self.corrected.read(&block)? {
                ways.push(way);
            }
        }
        count_words(&base, &mut words, -1);
        let is_plane = |word: &str| matches!(word, "G17" | "G18" | "G19") && !self.has_planes;
        let lost = words.iter().find(|(word, count)| **count != 0 && !is_plane(word));
        if let (false, Some((word, _))) = (over, lost) {
            return Err(format!("{word} is lost or added"));
        }
        self.same_state()?;
        match (wanted, &ways[..]) {
            (None, []) => Ok(()),
            (Some(Movement::Rapid(to)), [Movement::Rapid(found)]) => {
                let same = |k: usize| match (to[k], found[k]) {
                    (Some(a), Some(b)) => (a - b).abs() <= self.digits_mm,
                    (a, b) => a == b,
                };
                if (0..3).all(same) { Ok(()) } else { Err(format!("a rapid move to {found:?}, not to {to:?}")) }
            }
            (Some(Movement::Machine(by, distance, what)), [Movement::Machine(found_by, found_distance, found)])
                if by == *found_by && distance == *found_distance && what == *found =>
            {
                Ok(())
            }
            (Some(way @ (Movement::Straight(..) | Movement::Round(_))), [_, ..])
                if ways.iter().all(|way| matches!(way, Movement::Straight(..) | Movement::Round(_))) =>
            {
                self.along(&way, &ways)
            }
            (wanted, found) => Err(format!("{} moves of another kind for {wanted:?}", found.len())),
        }
    }

    /// Compares the modal state after the same line of the base program and of the corrected program. The unit, the
    /// plane, the feed, the mode of arc centres and the end of the program must be equal. The position must be known
    /// for the same axes. The corrected program must use absolute coordinates.
    ///
    /// # Errors
    /// A message, if one of these conditions is not met.
    fn same_state(&self) -> Result<(), String> {
        let (base, corrected) = (&self.base, &self.corrected);
        let same_plane = base.plane == corrected.plane || !self.has_planes;
        let same = base.inches == corrected.inches && same_plane && base.feed == corrected.feed;
        let known = (0..3).all(|k| base.at[k].is_some() == corrected.at[k].is_some());
        let rest = base.centres_absolute == corrected.centres_absolute && base.over == corrected.over;
        if same && known && rest && !corrected.by_distance {
            Ok(())
        } else {
            Err("the state of the control differs (unit, plane, feed or known position)".into())
        }
    }

    /// Checks that the corrected program follows the map in one move at feed. `way` is the move of the base program,
    /// and `found` are the moves that replace it. The moves `found` must follow the move `way` displaced by the map,
    /// within the tolerance of the correction, in the right order and without a detour.
    ///
    /// # Errors
    /// A description of the first difference; a point of the move with no nominal surface under it.
    fn along(&self, way: &Movement, found: &[Movement]) -> Result<(), String> {
        let allowed = self.amendment.tolerance_mm + self.digits_mm;
        let at = |share: f64| {
            let base = way.at(share);
            displacement(self.amendment, &base).map(|by| base + by).map_err(|(found, _)| found)
        };
        let (begin, end) = (at(0.0)?, at(1.0)?);
        let off = |from: Point, to: Point| (from - to).norm();
        // The first move is allowed to only bring the tool to the start of the corrected path.
        let brings = found.len() > 1 && off(found[0].at(1.0), begin) <= allowed;
        let found = if brings && off(found[0].at(0.0), begin) > 0.0 { &found[1..] } else { found };
        let (first, last) = (found[0].at(0.0), found[found.len() - 1].at(1.0));
        if off(last, end) > allowed {
            return Err(format!("the last move ends {:.6} mm from its position by the map", off(last, end)));
        }
        let samples = 2 * found.len() + 3;
        let (mut k, mut before, mut length) = (0, begin, 0.0);
        for sample in 0..=samples {
            // The samples differ from the points that the correction chose.
            let share = if sample == samples { 1.0 } else { (sample as f64 + 0.37) / samples as f64 };
            let wanted = at(share)?;
            length += off(before, wanted);
            before = wanted;
            let away = |way: &Movement| match way {
                Movement::Straight(from, to) => distance_to_segment(*from, *to, wanted),
                // An arc that stayed an arc is compared at the same share of its length.
                round => off(round.at(share), wanted),
            };
            while k + 1 < found.len() && away(&found[k + 1]) <= away(&found[k]) {
                k += 1;
            }
            // A straight move down to the part can begin where the rapid move ended.
            let reaches = away(&found[k]).min(distance_to_segment(first, begin, wanted));
            if reaches > allowed {
                return Err(format!("a move is {reaches:.6} mm from the position by the map"));
            }
        }
        let written: f64 = found.iter().map(Movement::length).sum();
        // The chords between the samples are shorter than an arc.
        let longest = length.max(way.length()) + off(first, begin) + 4.0 * allowed;
        if written > longest * (1.0 + 1e-6) {
            return Err(format!("the moves are {:.6} mm too long", written - longest));
        }
        Ok(())
    }
}

/// Returns the distance of a point from a straight segment between two points.
fn distance_to_segment(from: Point, to: Point, point: Point) -> f64 {
    let (along, arm) = (to - from, point - from);
    let length2 = along.norm_squared();
    let share = if length2 > 0.0 { (arm.dot(&along) / length2).clamp(0.0, 1.0) } else { 0.0 };
    (arm - along * share).norm()
}

/// Returns true if a P word in `block` would state the number of turns of an arc. This is so if the line has I, J, K or
/// R, and has none of the words that use P for another purpose (M19, G4, G64).
fn is_turn(block: &Block) -> bool {
    let has = |letter: u8, of: &[f64]| block.words.iter().any(|w| w.letter == letter && of.contains(&w.value));
    block.words.iter().any(|w| matches!(w.letter, b'I' | b'J' | b'K' | b'R'))
        && !has(b'M', &[19.0])
        && !has(b'G', &[4.0, 64.0])
}

/// Adds `by` to the counter of each word of the line `block` in `counts`. The keys of `counts` are words such as `M3`.
/// Words that move the tool, and line numbers, are not counted.
fn count_words(block: &Block, counts: &mut BTreeMap<String, i32>, by: i32) {
    for word in &block.words {
        let moves = match word.letter {
            b'X' | b'Y' | b'Z' | b'I' | b'J' | b'K' | b'N' | b'A' | b'B' | b'C' => true,
            b'G' => [0.0, 1.0, 2.0, 3.0, 80.0, 90.0, 91.0].contains(&word.value),
            // The radius of an arc is rewritten as its centre.
            b'R' => !block.words.iter().any(|w| w.letter == b'M' && w.value == 19.0),
            // P1 means one turn, the same as without P.
            b'P' => is_turn(block),
            _ => false,
        };
        if !moves {
            let name = format!("{}{}", char::from(word.letter), word.value);
            *counts.entry(name).or_default() += by;
        }
    }
}
