//! Modal state of a control while it reads a program, and the action of each line.
//!
//! A word without a meaning in its line is rejected. Some words make the position of an axis unknown: another tool
//! length that of Z, another zero (work coordinate system) that of all axes.

use super::arc::{Arc, Centre, Plane};
use super::number::MAX_COORDINATE_MM;
use super::read::{Block, GcodeWord, Refusal};
use regrind_core::geometry::Point;

pub(super) const INCH_MM: f64 = 25.4;
pub(super) const AXES: [u8; 3] = *b"XYZ";
const TURNING: [u8; 3] = *b"ABC";

/// Groups of G words, each word as ten times its number. A line can have only one word of a group.
const GROUPS: [&[i64]; 12] = [
    &[0, 10, 20, 30],
    &[40, 280, 300, 530],
    &[170, 180, 190],
    &[200, 210],
    &[900, 910],
    &[901, 911],
    &[930, 940, 950],
    &[400, 410, 411, 420, 421],
    &[430, 490],
    &[540, 550, 560, 570, 580, 590, 591, 592, 593],
    &[610, 611, 640],
    &[960, 970],
];
/// Groups of M words, each word as its number. A line can have only one word of a group.
const M_GROUPS: [&[i64]; 4] = [&[0, 1, 2, 30, 60], &[3, 4, 5, 19], &[6], &[48, 49]];

/// Action of a line, lengths in millimetres.
#[derive(Debug)]
pub(super) enum Act {
    /// No movement: the line only changes the modal state.
    Stay,
    /// Rotary axes move to 0, with the motion in force.
    Upright { by: u8 },
    /// Rapid move of the named axes.
    Rapid([Option<f64>; 3]),
    /// Move to the reference point (G28, G30) or in machine coordinates (G53), with the motion in force.
    Machine { by: Option<u8> },
    /// Move at feed: a straight line or an arc.
    Feed { from: Point, to: Point, arc: Option<Arc> },
}

/// State of a control, as far as it determines where the tool moves.
#[derive(Debug)]
pub(super) struct Control {
    /// Position of the tool in the program; `None` for an axis whose position is unknown.
    pub at: [Option<f64>; 3],
    pub unit_mm: f64,
    pub relative: bool,
    pub arcs_absolute: bool,
    /// True if the program ended.
    pub ended: bool,
    motion: Option<u8>,
    plane: Plane,
    system: Option<i64>,
    /// True if there was a move at feed; after that neither the zero nor a rotary axis can change.
    moved: bool,
    /// True for each rotary axis that is known to be at 0.
    upright: [bool; 3],
}

/// Effects that the words of a line request.
#[derive(Default)]
struct BlockRequests {
    motion: Option<u8>,
    dwell: bool,
    machine: bool,
    reference: bool,
    /// Letters, such as P or H, that another word of the line uses as its parameter.
    takes: Vec<u8>,
    /// Axes whose position becomes unknown before the line moves.
    forgets: [bool; 3],
}

impl Control {
    pub(super) fn new() -> Self {
        Self {
            at: [None; 3],
            unit_mm: 1.0,
            relative: false,
            arcs_absolute: false,
            ended: false,
            motion: None,
            plane: Plane::XY,
            system: None,
            moved: false,
            upright: [false; 3],
        }
    }

    /// Executes a line: updates the modal state and the position, and returns the action of the line.
    ///
    /// # Errors
    /// A line that moves the tool in a way that the text does not define, or that has a word without a meaning.
    pub(super) fn execute_block(&mut self, block: &Block) -> Result<Act, Refusal> {
        let asked = self.states(block)?;
        (0..3).filter(|&k| asked.forgets[k]).for_each(|k| self.at[k] = None);
        let turned = self.turning(block, &asked)?;
        let named = AXES.map(|letter| value(block, letter));
        let axes = named.iter().any(Option::is_some);
        let centre = [b'I', b'J', b'K'].iter().any(|letter| value(block, *letter).is_some());
        let turns = self.motion.filter(|motion| *motion > 1 && !asked.machine && !asked.reference && !asked.dwell);
        let moves = axes || (turns.is_some() && (centre || asked.motion.is_some()));
        let is_arc = moves && turns.is_some();
        if asked.machine || asked.reference {
            let act = self.machine(&asked, named, axes)?;
            return check_uses(block, &asked, moves, is_arc).map(|()| act);
        }
        check_uses(block, &asked, moves, is_arc)?;
        if !moves && turned.is_none() {
            return Ok(Act::Stay);
        }
        let Some(motion) = self.motion else {
            return Err(("the line names axes, and no G0, G1, G2 or G3 is in force".into(), "write the kind of move"));
        };
        if let (Some((word, true)), true) = (turned, moves && motion > 0 || motion > 1) {
            return Err(axis_refused(word));
        }
        if !moves {
            return Ok(Act::Upright { by: motion });
        }
        let target = self.target(named)?;
        if motion == 0 {
            let to = [0, 1, 2].map(|k| target[k].filter(|_| named[k].is_some()));
            self.at = target;
            return Ok(Act::Rapid(to));
        }
        let (Some(from), Some(to)) = (all(self.at), all(target)) else {
            let missing: String =
                ['X', 'Y', 'Z'].into_iter().zip(self.at).filter(|(_, v)| v.is_none()).map(|(c, _)| c).collect();
            let remedy = "write a G0 with these axes before it";
            return Err((format!("the position of {missing} is unknown at the beginning of this move"), remedy));
        };
        self.moved = true;
        let arc = is_arc.then(|| self.arc(block, from, to, motion == 2)).transpose()?;
        self.at = target;
        Ok(Act::Feed { from, to, arc })
    }

    /// Applies the modal words of a line (words that stay in force for later lines) to this state. Returns the requests
    /// of the other words, such as a dwell or a move to the reference point.
    ///
    /// # Errors
    /// An unknown word; a word that moves the tool in a way that the program does not show; words that exclude each
    /// other.
    fn states(&mut self, block: &Block) -> Result<BlockRequests, Refusal> {
        let mut asked = BlockRequests::default();
        let is_move = |word: &&GcodeWord| word.letter == b'G' && [0.0, 1.0, 2.0, 3.0].contains(&word.value);
        asked.motion = block.words.iter().find(is_move).map(|word| word.value as u8);
        for word in &block.words {
            match word.letter {
                b'G' => self.g(word, &mut asked)?,
                b'M' => self.m(word, &mut asked)?,
                b'X' | b'Y' | b'Z' | b'I' | b'J' | b'K' | b'R' | b'F' | b'S' | b'T' | b'H' | b'D' | b'P' | b'Q'
                | b'N' | b'A' | b'B' | b'C' => {}
                // Allowed only for inputs and outputs.
                b'E' | b'L' if has_io(block) => {}
                b'U' | b'V' | b'W' => return Err(axis_refused(word)),
                _ => return Err((format!("{} is unknown", word.text), "remove it if it does not move the tool")),
            }
        }
        check_once(block)?;
        Ok(asked)
    }

    fn g(&mut self, word: &GcodeWord, asked: &mut BlockRequests) -> Result<(), Refusal> {
        match tenths(word).ok_or_else(|| (format!("{} is unknown", word.text), "correct the number"))? {
            code @ (0 | 10 | 20 | 30) => {
                (self.motion, asked.motion) = (Some((code / 10) as u8), Some((code / 10) as u8));
            }
            40 => (asked.dwell, asked.takes) = (true, [&asked.takes[..], b"P"].concat()),
            170 => self.plane = Plane::XY,
            180 => self.plane = Plane::ZX,
            190 => self.plane = Plane::YZ,
            200 => self.unit_mm = INCH_MM,
            210 => self.unit_mm = 1.0,
            900 => self.relative = false,
            910 => self.relative = true,
            901 => self.arcs_absolute = true,
            911 => self.arcs_absolute = false,
            280 | 300 => asked.reference = true,
            530 => asked.machine = true,
            code @ (540 | 550 | 560 | 570 | 580 | 590 | 591 | 592 | 593) => self.choose_system(code, word, asked)?,
            // If its line also has a motion word, G80 changes nothing: that motion is in force.
            800 if asked.motion.is_none() => self.motion = None,
            800 => {}
            // Another tool length means another Z at the same position.
            430 | 490 => {
                asked.forgets[2] = true;
                asked.takes.push(b'H');
            }
            640 => asked.takes.extend(b"PQ"),
            960 => asked.takes.push(b'D'),
            400 | 610 | 611 | 940 | 950 | 970 | 980 | 990 => {}
            // Cancels shifted zeros; the position of the tool in the coordinates of the program is then unknown.
            921 if !self.moved => asked.forgets = [true; 3],
            930 => {
                let remedy = "let the CAM system write feeds per minute (G94)";
                return Err((
                    format!("{} gives the time of a move, but the correction divides moves", word.text),
                    remedy,
                ));
            }
            410..=429 => {
                let remedy = "let the CAM system write the path of the tool's centre (G40)";
                return Err((format!("{} lets the controller move the path by a radius", word.text), remedy));
            }
            730 | 760 | 810..=890 => {
                let remedy = "let the CAM system write single moves in place of the cycle";
                return Err((format!("{} is a canned cycle", word.text), remedy));
            }
            _ => {
                let found =
                    format!("{} can move the tool or the zero in a way that the program does not show", word.text);
                return Err((found, "let the CAM system write plain G0, G1, G2 and G3"));
            }
        }
        Ok(())
    }

    fn choose_system(&mut self, code: i64, word: &GcodeWord, asked: &mut BlockRequests) -> Result<(), Refusal> {
        let same = self.system == Some(code);
        if !same && self.moved {
            let remedy = "a map belongs to one zero: divide the program";
            return Err((format!("{} changes the zero after the tool has moved at feed", word.text), remedy));
        }
        asked.forgets = if same { asked.forgets } else { [true; 3] };
        self.system = Some(code);
        Ok(())
    }

    fn m(&mut self, word: &GcodeWord, asked: &mut BlockRequests) -> Result<(), Refusal> {
        match word.value {
            v if v == 2.0 || v == 30.0 => self.ended = true,
            // The tool moves to the place where the machine changes it.
            6.0 => asked.forgets = [true; 3],
            19.0 => asked.takes.extend(b"RPQ"),
            v if v.fract() == 0.0 && (matches!(v as i64, 61..=68)) => asked.takes.extend(b"PQEL"),
            v if v.fract() == 0.0 && (matches!(v as i64, 50..=53)) => asked.takes.push(b'P'),
            v if v.fract() == 0.0 && (matches!(v as i64, 0..=9 | 48 | 49 | 60)) => {}
            _ => {
                let found = format!("{} can call a subprogram or a function of the machine", word.text);
                return Err((found, "remove it, or write out what it does"));
            }
        }
        Ok(())
    }

    /// Processes the words of rotary axes (A, B, C), which turn the part or the tool. The map over x and y is valid
    /// only while all rotary axes are at 0. So a rotary axis can only turn to 0, and only before the first move at
    /// feed. `block` is the line, and `asked` holds the requests of its other words.
    ///
    /// Returns the first word of a rotary axis in `block`, with a flag. The flag is true if an axis may turn in this
    /// line, because no earlier line has set it to 0. Returns `None` if the line has no word of a rotary axis.
    ///
    /// # Errors
    /// A rotary axis that would turn to another angle, turn after a move at feed, or be given in one line with a dwell,
    /// G53 or a move to the reference point.
    fn turning<'w>(
        &mut self,
        block: &'w Block,
        asked: &BlockRequests,
    ) -> Result<Option<(&'w GcodeWord<'w>, bool)>, Refusal> {
        let mut first = None;
        for word in &block.words {
            let Some(k) = TURNING.iter().position(|letter| *letter == word.letter) else { continue };
            let may_turn = self.moved && !self.upright[k];
            let to_nothing = word.value == 0.0 && (self.upright[k] || !self.relative);
            if !to_nothing || may_turn || asked.machine || asked.reference || asked.dwell {
                return Err(axis_refused(word));
            }
            let turns = !std::mem::replace(&mut self.upright[k], true);
            let (word, before) = first.unwrap_or((word, false));
            first = Some((word, before || turns));
        }
        Ok(first)
    }

    /// Processes a move in machine coordinates (G53) or to the reference point (G28, G30), and returns the action. The
    /// positions of the moved axes are unknown after this move. A move to the reference point without a named axis
    /// moves all axes.
    ///
    /// `asked` holds the requests of the words in the line; it shows which of the two moves is meant. `named` holds the
    /// values of X, Y and Z in the line, and `axes` is true if the line has at least one of them.
    ///
    /// # Errors
    /// G53 without an axis, with an arc, without an active motion (G0 or G1), or in G91.
    fn machine(&mut self, asked: &BlockRequests, named: [Option<f64>; 3], axes: bool) -> Result<Act, Refusal> {
        if asked.machine && (self.relative || self.motion.is_none_or(|motion| motion > 1)) {
            return Err((
                "G53 is used with an arc, without a move or in G91".into(),
                "use G53 only with G0 or G1, in G90",
            ));
        }
        if asked.machine && !axes {
            return Err(("G53 names no axis".into(), "name the axes that move"));
        }
        // If no axis is named, all of them go to the reference point.
        (0..3).filter(|&k| named[k].is_some() || !axes).for_each(|k| self.at[k] = None);
        Ok(Act::Machine { by: self.motion.filter(|_| asked.machine) })
    }

    /// Returns the end position of a move, in millimetres. An axis is `None` if its position is unknown and the line
    /// does not state it. `named` holds the values of X, Y and Z in the line, in the unit of the program.
    ///
    /// # Errors
    /// A position beyond [`MAX_COORDINATE_MM`]; a relative move (G91) of an axis whose position is unknown.
    fn target(&self, named: [Option<f64>; 3]) -> Result<[Option<f64>; 3], Refusal> {
        let mut target = self.at;
        for k in 0..3 {
            let Some(value) = named[k].map(|v| v * self.unit_mm) else { continue };
            let to = if self.relative {
                let Some(before) = self.at[k] else {
                    let found = format!("{} moves by a distance from an unknown position", ['X', 'Y', 'Z'][k]);
                    return Err((found, "begin with a G0 in absolute coordinates (G90)"));
                };
                before + value
            } else {
                value
            };
            if to.abs() > MAX_COORDINATE_MM {
                let found = format!("{} goes to {to:e} mm; the limit is {MAX_COORDINATE_MM:e} mm", ['X', 'Y', 'Z'][k]);
                return Err((found, "correct the number, or the unit (G20, G21)"));
            }
            target[k] = Some(to);
        }
        Ok(target)
    }

    fn arc(&self, block: &Block, from: Point, to: Point, clockwise: bool) -> Result<Arc, Refusal> {
        let value = |letter: u8| value(block, letter).map(|value| value * self.unit_mm);
        if block.words.iter().any(|word| word.letter == b'P' && word.value != 1.0) {
            return Err(("P lets the arc turn several times".into(), "write a line for every turn"));
        }
        let [a, b, c] = self.plane.0;
        let centres = [b'I', b'J', b'K'].map(value);
        let centre = match (value(b'R'), centres[a].is_some() || centres[b].is_some()) {
            (Some(radius), false) if centres[c].is_none() => Centre::Radius(radius),
            (None, true) if centres[c].is_none() => Centre::At([a, b].map(|k| {
                let at = centres[k].unwrap_or(0.0);
                if self.arcs_absolute { at } else { at + from[k] }
            })),
            _ => {
                let remedy = "give the two of I, J, K that lie in the plane of the arc, or R";
                return Err(("the centre of the arc is missing, or given twice".into(), remedy));
            }
        };
        if self.arcs_absolute && (centres[a].is_none() || centres[b].is_none()) && matches!(centre, Centre::At(_)) {
            return Err(("G90.1 requires both coordinates of the centre".into(), "add the missing one"));
        }
        Arc::new(self.plane, from, to, clockwise, centre)
    }
}

/// Returns true if a line reads inputs or sets outputs (M62 to M68).
fn has_io(block: &Block) -> bool {
    block.words.iter().any(|word| word.letter == b'M' && (62.0..=68.0).contains(&word.value))
}

pub(super) fn value(block: &Block, letter: u8) -> Option<f64> {
    block.words.iter().find(|word| word.letter == letter).map(|word| word.value)
}

pub(super) fn all(of: [Option<f64>; 3]) -> Option<Point> {
    Some(Point::new(of[0]?, of[1]?, of[2]?))
}

/// Returns ten times the number of a word, such as 901 for G90.1; `None` if the number has more than one decimal.
pub(super) fn tenths(word: &GcodeWord) -> Option<i64> {
    let tenths = (word.value * 10.0).round();
    ((word.value * 10.0 - tenths).abs() <= 1e-6).then_some(tenths as i64)
}

fn axis_refused(word: &GcodeWord) -> Refusal {
    let found = format!("{} moves an axis that turns the part or the tool", word.text);
    (
        found,
        "only programs of X, Y and Z can be corrected by a map over x and y, with other axes at 0 from the beginning",
    )
}

/// Rejects a line that has the same letter twice (except G and M), or two words of a modal group ([`GROUPS`],
/// [`M_GROUPS`]).
fn check_once(block: &Block) -> Result<(), Refusal> {
    for (k, word) in block.words.iter().enumerate() {
        let before = &block.words[..k];
        let same = |groups: &[&[i64]], code: i64| {
            let group = groups.iter().find(|group| group.contains(&code)).copied().unwrap_or(&[]);
            before.iter().find(|other| {
                let number = if other.letter == b'G' { tenths(other) } else { Some(other.value as i64) };
                other.letter == word.letter && number.is_some_and(|number| group.contains(&number))
            })
        };
        let other = match word.letter {
            b'G' => same(&GROUPS, tenths(word).unwrap_or(i64::MIN)),
            b'M' => same(&M_GROUPS, word.value as i64),
            letter if before.iter().any(|other| other.letter == letter) => {
                return Err((format!("{} occurs twice", char::from(letter)), "keep one of them"));
            }
            _ => None,
        };
        if let Some(other) = other {
            let found =
                format!("{} and {} are in one line, and only one of them can be in force", other.text, word.text);
            return Err((found, "divide the line, or keep one of them"));
        }
    }
    Ok(())
}

/// Checks that each word of a line has a meaning in this line. `moves` is true if the line moves the tool, and `is_arc`
/// if its move is an arc. `asked` holds the requests of the words.
///
/// # Errors
/// A word without a meaning, such as I without an arc or P without a dwell; a motion word in one line with a dwell or a
/// move to the reference point.
fn check_uses(block: &Block, asked: &BlockRequests, moves: bool, is_arc: bool) -> Result<(), Refusal> {
    for word in &block.words {
        let used = match word.letter {
            b'X' | b'Y' | b'Z' => (moves || asked.machine || asked.reference) && !asked.dwell,
            b'I' | b'J' | b'K' => is_arc,
            b'R' | b'P' => is_arc || asked.takes.contains(&word.letter),
            b'Q' | b'H' | b'D' | b'E' | b'L' => asked.takes.contains(&word.letter),
            _ => true,
        };
        if !used {
            let found = format!("{} has no meaning in this line", word.text);
            return Err((found, "add the word that it belongs to, or remove it"));
        }
    }
    if asked.motion.is_some() && (asked.reference || asked.dwell) {
        let found = "a move is in one line with a dwell or a move to the reference point".to_owned();
        return Err((found, "divide the line"));
    }
    Ok(())
}
