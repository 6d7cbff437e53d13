//! Reader of programs as a control reads them: implemented independently from the documentation of the makers, so that
//! an error of a writer cannot hide here.
//!
//! ```text
//!  text -> blocks -> stops of the wheel's centre, or of the slides and the head that carry it; feed and way to each
//! ```
//!
//! A real control accepts almost any program. This reader refuses everything that would move a real machine to another
//! place than the text seems to say: incremental coordinates, inches, places relative to the last one, a move before
//! the path mode is set, a program without an end.

use std::collections::BTreeMap;

use crate::head::Head;
use crate::motion::{CircularArc, Waypoint};
use crate::vector::distance;

/// Kind of control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Control {
    /// LinuxCNC.
    #[default]
    Linuxcnc,
    /// Fanuc with increment system IS-C.
    Fanuc,
    /// Sinumerik 840D.
    Sinumerik,
    /// Heidenhain, Klartext.
    Heidenhain,
}

/// Unit of a number without a decimal point with IS-C, in mm.
const INCREMENT_MM: f64 = 1e-4;

/// Program as a control has read it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Program {
    /// Ends of the moves, in order.
    pub waypoints: Vec<Waypoint>,
    /// Rotary axis that the program turns.
    pub axis: Option<char>,
    /// True if the program makes the control keep the wheel's centre while the head turns.
    pub keeps_centre: bool,
    /// True if the control's own kinematics keep the centre, which no program mentions.
    pub(crate) by_kinematics: bool,
    /// Head that the program turns, once it is known.
    pub(crate) head: Option<Head>,
    /// Tolerance by which corners may be rounded, if the program gives it.
    pub tolerance_mm: Option<f64>,
    /// Comments of the program.
    pub comments: Vec<String>,
}

impl Program {
    /// Sets the rotary head of the machine that executes the program. `head` is `None` for a machine without a rotary
    /// axis.
    ///
    /// # Errors
    /// Returns the reason if this machine cannot execute the program, for example because the program turns an axis
    /// that the machine does not have, or turns the head beyond its range.
    pub fn with_head(mut self, head: Option<Head>) -> Result<Self, String> {
        let reason = match (self.axis, head) {
            (Some(letter), None) => Some(format!("the program turns {letter}, and this machine has no rotary axis")),
            (_, Some(head)) => self.refusal_by(&head),
            (None, None) => None,
        };
        self.head = head;
        reason.map_or(Ok(self), Err)
    }

    /// Returns the position in mm of the wheel's centre during the move from `from` to `to`. `share` is the completed
    /// fraction of the move, from 0 to 1. If the machine has a rotary head, the position includes the rotation of the
    /// head.
    pub fn centre_mm(&self, from: &Waypoint, to: &Waypoint, share: f64) -> [f64; 3] {
        match &self.head {
            Some(head) => head.centre_on_move_mm(from, to, share),
            None => to.position_at(from.at_mm, share),
        }
    }

    /// Returns the length, in mm, of the path of the wheel's centre on the move from `from` to `to`. If the program
    /// turns a rotary axis, returns instead the straight distance between the two ends of this path.
    pub fn length_mm(&self, from: &Waypoint, to: &Waypoint) -> f64 {
        match self.axis {
            Some(_) => {
                let [a, b] = [0.0, 1.0].map(|share| self.centre_mm(from, to, share));
                distance(a, b)
            }
            None => to.length_mm(from.at_mm),
        }
    }

    /// Returns the reason why the head `head` cannot execute this program, or `None` if it can.
    fn refusal_by(&self, head: &Head) -> Option<String> {
        let letter = self.axis?;
        if letter != head.letter {
            return Some(format!("the program turns {letter}, and this machine has {}", head.letter));
        }
        if head.pivot_mm.is_some() && self.keeps_centre {
            return Some("the program uses tool centre point control, and this control moves only the slides".into());
        }
        if head.pivot_mm.is_none() && !(self.keeps_centre || self.by_kinematics) {
            return Some("the program moves only the slides, and this control keeps the wheel's centre".into());
        }
        let [least, most] = head.range_deg;
        let turns = self.waypoints.iter().filter_map(|stop| stop.rotary_deg);
        let beyond = turns.into_iter().find(|turn| !(least - 1e-6..=most + 1e-6).contains(turn));
        beyond.map(|turn| format!("{letter} {turn} is beyond {least} to {most} degrees"))
    }
}

impl Control {
    /// Returns the numerical control that uses the program dialect `dialect`: `linuxcnc`, `fanuc`, `sinumerik` or
    /// `heidenhain`. Returns `None` for any other text.
    pub fn named(dialect: &str) -> Option<Self> {
        let known = [
            ("linuxcnc", Self::Linuxcnc),
            ("fanuc", Self::Fanuc),
            ("sinumerik", Self::Sinumerik),
            ("heidenhain", Self::Heidenhain),
        ];
        known.into_iter().find(|(name, _)| *name == dialect).map(|(_, control)| control)
    }

    /// Parses the program `text` as this control would.
    ///
    /// # Errors
    /// Returns a message if the control would stop at a line, or if a line would have a different effect than its text
    /// suggests. The message names the first such line and the reason. Also returns an error if the program is not
    /// complete, for example if it has no end.
    pub fn read(self, text: &str) -> Result<Program, String> {
        let mut reader = Reader { control: self, ..Reader::default() };
        reader.program.by_kinematics = self == Self::Linuxcnc;
        for (k, line) in text.lines().enumerate() {
            reader.line(line.trim_end_matches('\r')).map_err(|reason| format!("line {}: {reason}: {line:?}", k + 1))?;
        }
        reader.finish()
    }
}

/// Reader of a program of LinuxCNC line by line, as its interpreter reads ahead of the motion.
#[derive(Clone)]
pub(crate) struct LineReader(Reader);

impl LineReader {
    /// Creates the reader of a program that begins at the position `at_mm`.
    pub(crate) fn new(at_mm: [f64; 3]) -> Self {
        Self(Reader { at_mm: Some(at_mm), ..Reader::default() })
    }

    /// Reads one line. Returns the move that it commands, with the position at which the move begins. Returns `None` if
    /// the line commands no move.
    ///
    /// # Errors
    /// Returns the reason why the line is not allowed in the program of a pass.
    pub(crate) fn read(&mut self, line: &str) -> Result<Option<([f64; 3], Waypoint)>, String> {
        let from_mm = self.0.at_mm.unwrap_or_default();
        self.0.program = Program::default();
        self.0.line(line)?;
        Ok(self.0.program.waypoints.pop().map(|waypoint| (from_mm, waypoint)))
    }

    /// Returns true if the program has ended.
    pub(crate) fn has_ended(&self) -> bool {
        self.0.ended
    }
}

#[derive(Clone, Default)]
struct Reader {
    control: Control,
    program: Program,
    at_mm: Option<[f64; 3]>,
    /// Motion mode: 0 rapid, 1 at feed, 2 and 3 along an arc, clockwise and counter-clockwise.
    motion: Option<u8>,
    /// Plane that was selected last, and the centre of Klartext, by axis.
    plane: Option<[usize; 3]>,
    centre: BTreeMap<char, f64>,
    /// For LinuxCNC: true if centres are relative to the beginning of an arc, false if they are absolute, `None` before
    /// the program sets it.
    from_start: Option<bool>,
    rotary_deg: Option<f64>,
    /// Feed of the last block that gave one. With inverse-time feeds, in 1/min and valid for its own block only.
    feed: Option<f64>,
    by_time: bool,
    keeps_centre: bool,
    /// For Sinumerik: `no_offset` is true if the work offset is not set; `in_proportion` is true if axes turn in
    /// proportion between points.
    no_offset: bool,
    in_proportion: bool,
    metric: bool,
    absolute: bool,
    by_minute: bool,
    exact: bool,
    /// For Klartext: number of lines, name of the program, and whether the block of cycle 32 still requires its
    /// tolerance.
    lines: u64,
    name: Option<String>,
    cycle: bool,
    percents: u32,
    numbered: bool,
    ended: bool,
}

impl Reader {
    fn line(&mut self, line: &str) -> Result<(), String> {
        let line = self.without_comments(line)?;
        if line.trim().is_empty() && self.control != Control::Heidenhain {
            return Ok(());
        }
        match self.control {
            Control::Heidenhain => self.klartext(line.trim()),
            _ => self.block(line.trim()),
        }
    }

    fn without_comments(&mut self, line: &str) -> Result<String, String> {
        let mut left = String::new();
        let mut rest = line;
        let brackets = matches!(self.control, Control::Linuxcnc | Control::Fanuc);
        let semicolon = self.control != Control::Fanuc;
        while let Some(at) = rest.find(|c| (brackets && c == '(') || (semicolon && c == ';')) {
            left.push_str(&rest[..at]);
            let comment = &rest[at + 1..];
            if rest[at..].starts_with(';') {
                self.program.comments.push(comment.trim().to_owned());
                return Ok(left);
            }
            let end = comment.find(')').ok_or("a comment has no end")?;
            self.program.comments.push(comment[..end].to_owned());
            rest = &comment[end + 1..];
        }
        Ok(left + rest)
    }

    fn finish(self) -> Result<Program, String> {
        if !self.ended {
            return Err("the program has no end".into());
        }
        if self.control == Control::Fanuc && self.percents != 2 {
            return Err("the program must begin and end with a percent sign".into());
        }
        Ok(self.program)
    }

    /// Parses a block, which is one line of a program. A block consists of words; most words are letters with a number,
    /// for example `G1` or `X2.5`. Adds a waypoint to the program if the block contains coordinates.
    ///
    /// # Errors
    /// Returns the reason if the block is not allowed in the program of a grinding pass.
    fn block(&mut self, line: &str) -> Result<(), String> {
        if line == "%" {
            self.percents += 1;
            return Ok(());
        }
        if self.ended {
            return Err("something comes after the end".into());
        }
        if self.control == Control::Fanuc && self.percents != 1 {
            return Err("it is outside of the percent signs".into());
        }
        let mut to: BTreeMap<char, f64> = BTreeMap::new();
        let (mut smooth, mut level, mut length, kept) = (None, None, false, self.keeps_centre);
        for word in words(line)? {
            let ProgramWord { name, number, has_point } = word;
            let whole = format!("{name}{}", number.map_or(String::new(), |n| n.to_string()));
            match (self.control, name.as_str(), number) {
                (Control::Linuxcnc | Control::Sinumerik | Control::Fanuc, "N", Some(_)) => {}
                (Control::Fanuc, "O", Some(n)) if !self.numbered && (1.0..=9999.0).contains(&n) => self.numbered = true,
                (_, "X" | "Y" | "Z" | "A" | "B", Some(n)) => {
                    let scale = if self.control == Control::Fanuc && !has_point { INCREMENT_MM } else { 1.0 };
                    to.insert(name.chars().next().unwrap_or('X'), scale * n);
                }
                (Control::Linuxcnc | Control::Sinumerik | Control::Fanuc, "I" | "J" | "K", Some(n)) => {
                    let scale = if self.control == Control::Fanuc && !has_point { INCREMENT_MM } else { 1.0 };
                    to.insert(name.chars().next().unwrap_or('I'), scale * n);
                }
                (_, "F", Some(n)) if n > 0.0 => self.feed = Some(n),
                (Control::Fanuc, "H", Some(_)) => length = true,
                (Control::Sinumerik, "TRAORI", None) => (self.keeps_centre, self.no_offset) = (true, true),
                (Control::Sinumerik, "TRAFOOF", None) => self.keeps_centre = false,
                (Control::Sinumerik, "ORIMKS", None) => {}
                (Control::Sinumerik, "ORIAXES", None) => self.in_proportion = true,
                (Control::Linuxcnc, "P", Some(n)) => self.program.tolerance_mm = Some(n),
                (Control::Linuxcnc, "Q", Some(_)) => {}
                (Control::Fanuc, "Q", Some(n)) => level = Some(n),
                (Control::Sinumerik, "CTOL", Some(n)) => self.program.tolerance_mm = Some(n),
                (Control::Sinumerik, "FFWON" | "FFWOF" | "SOFT" | "BRISK", None) => {}
                (_, "M", Some(n)) if n == 30.0 || (n == 2.0 && self.control != Control::Fanuc) => self.ended = true,
                (_, "G", Some(n)) => {
                    if let Some(told) = self.preparatory((10.0 * n).round() as i64)? {
                        smooth = Some(told);
                    }
                }
                _ => return Err(format!("{whole} is not a word of this control")),
            }
        }
        let begins = self.keeps_centre && !kept;
        if self.control == Control::Fanuc && begins != length {
            return Err("tool centre point control and the length of the tool must be in one block".into());
        }
        self.exactness(smooth, level)?;
        if to.is_empty() { Ok(()) } else { self.go(&to) }
    }

    /// Applies a G word. `tenths` is the number of the word times 10, for example 640 for G64. Returns `Some(tenths)`
    /// if the word selects the path mode (how the control rounds corners). Applies every other allowed word at once and
    /// returns `None`.
    ///
    /// # Errors
    /// Returns an error if the word is not allowed in the program of a grinding pass.
    fn preparatory(&mut self, tenths: i64) -> Result<Option<i64>, String> {
        match (self.control, tenths) {
            (_, 0 | 10 | 20 | 30) => self.motion = Some((tenths / 10) as u8),
            (_, 170) => self.plane = Some([0, 1, 2]),
            (_, 180) => self.plane = Some([2, 0, 1]),
            (_, 190) => self.plane = Some([1, 2, 0]),
            (Control::Linuxcnc, 901 | 911) => self.from_start = Some(tenths == 911),
            (_, 540) => self.no_offset = false,
            (_, 490) => self.keeps_centre = false,
            (Control::Fanuc, 434) => self.keeps_centre = true,
            (_, 400 | 800) => {}
            (Control::Linuxcnc | Control::Fanuc, 210) | (Control::Sinumerik, 7100) => self.metric = true,
            (_, 900) => self.absolute = true,
            (_, 940) => (self.by_minute, self.by_time) = (true, false),
            (_, 930) => (self.by_minute, self.by_time, self.feed) = (false, true, None),
            (Control::Linuxcnc, 610 | 611 | 640)
            | (Control::Fanuc, 51 | 610 | 640)
            | (Control::Sinumerik, 600 | 6010 | 6420 | 640) => return Ok(Some(tenths)),
            _ => return Err(format!("G{} is not allowed in the program of a pass", tenths as f64 / 10.0)),
        }
        Ok(None)
    }

    /// Records whether the selected path mode (how the control rounds corners) is exact. A path mode is exact only if
    /// it limits the deviation at corners. `smooth` is the number of the G word that selects the path mode, times 10.
    /// If `smooth` is `None`, nothing changes. `level` is the value of the Q word of a Fanuc control; the mode G5.1 is
    /// exact only with Q1. Other controls ignore `level`. Always returns `Ok`.
    fn exactness(&mut self, smooth: Option<i64>, level: Option<f64>) -> Result<(), String> {
        let tolerance = self.program.tolerance_mm.is_some_and(|mm| mm > 0.0);
        self.exact = match (self.control, smooth) {
            (_, None) => return Ok(()),
            (Control::Linuxcnc, Some(640)) | (Control::Sinumerik, Some(6420)) => tolerance,
            (Control::Fanuc, Some(51)) => level == Some(1.0),
            (Control::Fanuc | Control::Sinumerik, Some(640)) => false,
            (_, Some(_)) => true,
        };
        Ok(())
    }

    fn go(&mut self, to: &BTreeMap<char, f64>) -> Result<(), String> {
        let told = [
            (self.metric, "it moves before it selects the unit mm"),
            (self.absolute, "it moves before it selects absolute positions"),
            (self.by_minute || self.by_time, "it moves before it selects feeds in mm/min"),
            (!self.no_offset, "its work offset is cancelled and not set again"),
            (self.exact, "it moves before it sets the path mode, or in a mode that rounds corners without a limit"),
        ];
        if let Some((_, reason)) = told.iter().find(|(is_so, _)| !is_so) {
            return Err((*reason).to_owned());
        }
        let feed = match self.motion {
            Some(0) => None,
            Some(_) => Some(self.feed.ok_or("it moves without a programmed feed")?),
            None => return Err("it moves before it sets the motion mode".into()),
        };
        let before = self.at_mm.unwrap_or([f64::NAN; 3]);
        let mut at_mm = before;
        for (axis, value) in to {
            match "XYZ".find(*axis) {
                Some(k) => at_mm[k] = *value,
                None if "IJK".contains(*axis) => {}
                None => self.tilt(*axis, *value)?,
            }
        }
        let minutes = feed.filter(|_| self.by_time).map(|inverse| 1.0 / inverse);
        let feed_mm_min = minutes.map_or(feed, |minutes| Some(distance(before, at_mm) / minutes));
        if self.by_time {
            self.feed = None;
        }
        if feed_mm_min.is_some() && at_mm.iter().any(|v| v.is_nan()) {
            return Err("it moves at a feed from a position that it has not programmed".into());
        }
        let turn = match self.motion {
            Some(motion @ (2 | 3)) => Some(self.read_arc([before, at_mm], to, motion == 2)?),
            _ if to.keys().any(|letter| "IJK".contains(*letter)) => return Err("it has a centre without an arc".into()),
            _ => None,
        };
        self.at_mm = Some(at_mm);
        self.program.waypoints.push(Waypoint { at_mm, rotary_deg: self.rotary_deg, feed_mm_min, minutes, arc: turn });
        Ok(())
    }

    /// Records that the program turns the rotary axis `axis` to the angle `to_deg`, in degrees on the scale of this
    /// axis. A program may turn only one rotary axis. Tool centre point control must be active in all turns of the
    /// program or in none.
    ///
    /// # Errors
    /// Returns the reason if the turn breaks one of these rules, or if a Sinumerik program turns the axis with tool
    /// centre point control before the word `ORIAXES`.
    fn tilt(&mut self, axis: char, to_deg: f64) -> Result<(), String> {
        let first = self.program.axis.is_none();
        if *self.program.axis.get_or_insert(axis) != axis {
            return Err("it turns two axes".into());
        }
        if first {
            self.program.keeps_centre = self.keeps_centre;
        }
        if self.program.keeps_centre != self.keeps_centre {
            return Err("it turns the axis both with and without tool centre point control".into());
        }
        if self.control == Control::Sinumerik && self.keeps_centre && !self.in_proportion {
            return Err("it turns the axis before it sets the interpolation of the angle (ORIAXES)".into());
        }
        self.rotary_deg = Some(to_deg);
        Ok(())
    }

    /// Computes the circular arc that a block commands. `ends` are the positions, in mm, where the arc begins and ends.
    /// `told` contains the numbers of the block's coordinate words, each under its letter, for example X or I.
    /// `clockwise` is true for a clockwise arc.
    ///
    /// # Errors
    /// Returns the reason in these cases:
    ///
    /// - No plane is selected, or no circular arc fits these points.
    /// - The end or the centre is not given along both axes of the plane.
    /// - The centre has a coordinate outside of the plane.
    /// - A LinuxCNC program has set neither G90.1 nor G91.1, which select how the centre is given.
    fn read_arc(
        &self,
        ends: [[f64; 3]; 2],
        told: &BTreeMap<char, f64>,
        clockwise: bool,
    ) -> Result<CircularArc, String> {
        let axes = self.plane.ok_or("the plane of its arc is not selected")?;
        let [a, b, c] = axes;
        let letter = |of: &str, k: usize| of.chars().nth(k).unwrap_or('?');
        if ![a, b].iter().all(|k| told.contains_key(&letter("XYZ", *k))) {
            return Err("the end of its arc is not programmed along both axes of the plane".into());
        }
        // Maximum difference of the radii of an arc, as the maker's default.
        let (of, from_start, takes_mm) = match self.control {
            Control::Linuxcnc => (told, self.from_start.ok_or("it sets no G90.1 or G91.1 before its arc")?, 0.005),
            Control::Fanuc => (told, true, 0.005),
            Control::Sinumerik => (told, true, 0.01),
            Control::Heidenhain => (&self.centre, false, 0.016),
        };
        let letters = if self.control == Control::Heidenhain { "XYZ" } else { "IJK" };
        if of.contains_key(&letter(letters, c)) {
            return Err("the centre of its arc is out of the plane".into());
        }
        if self.control == Control::Heidenhain && told.contains_key(&letter("XYZ", c)) {
            return Err("a C stays in its plane".into());
        }
        let mut centre_mm = [0.0; 2];
        for (k, axis) in [a, b].into_iter().enumerate() {
            let told = of.get(&letter(letters, axis)).ok_or("the centre of its arc is not programmed")?;
            centre_mm[k] = if from_start { ends[0][axis] + told } else { *told };
        }
        CircularArc::new(axes, ends, centre_mm, clockwise, takes_mm)
    }

    /// Reads a line of Klartext, the language of Heidenhain controls. Each line begins with its number.
    ///
    /// # Errors
    /// Returns the reason why the line is not allowed in the program of a pass.
    fn klartext(&mut self, line: &str) -> Result<(), String> {
        let (number, rest) = line.split_once(' ').unwrap_or((line, ""));
        if number.parse() != Ok(self.lines) {
            return Err(format!("its number is not {}", self.lines));
        }
        self.lines += 1;
        let rest = rest.trim();
        let program = |begins: &str| rest.strip_prefix(begins)?.strip_suffix(" MM").map(str::to_owned);
        if self.lines == 1 {
            // The language fixes all these modes.
            (self.metric, self.absolute, self.by_minute) = (true, true, true);
            self.name = Some(program("BEGIN PGM ").ok_or("it does not begin with BEGIN PGM in MM")?);
            return Ok(());
        }
        if rest.starts_with("END PGM") {
            self.ended = true;
            return if program("END PGM ") == self.name { Ok(()) } else { Err("END PGM names another program".into()) };
        }
        match rest {
            _ if self.ended && !rest.is_empty() => Err("something comes after the end".into()),
            "" | "M30" => Ok(()),
            "CYCL DEF 32.0 TOLERANCE" => {
                self.cycle = true;
                Ok(())
            }
            "FUNCTION TCPM F TCP AXIS POS PATHCTRL AXIS" => {
                self.keeps_centre = true;
                Ok(())
            }
            "FUNCTION RESET TCPM" => {
                self.keeps_centre = false;
                Ok(())
            }
            _ if rest.starts_with("CYCL DEF 32.1") && self.cycle => {
                let tolerance = rest.strip_prefix("CYCL DEF 32.1 T").map(str::parse::<f64>).transpose();
                let tolerance = tolerance.map_err(|e| e.to_string())?.filter(|mm| *mm > 0.0);
                (self.exact, self.cycle) = (tolerance.is_some(), false);
                self.program.tolerance_mm = self.program.tolerance_mm.or(tolerance);
                Ok(())
            }
            _ => match rest.split_once(' ') {
                Some(("L", rest)) => self.straight(rest, Some(1)),
                Some(("CC", rest)) => self.read_centre(rest),
                Some(("C", rest)) => self.straight(rest, None),
                _ => Err("this line is not allowed in the program of a pass".into()),
            },
        }
    }

    /// Parses the centre of a circle (`CC`) in Klartext. `rest` contains the coordinates of the centre, for example
    /// `X+3 Z+7`. The axes of the coordinates select the plane of the following arcs. Returns an error if the
    /// coordinates do not belong to exactly two of the axes X, Y and Z, or if a coordinate is not a signed number.
    fn read_centre(&mut self, rest: &str) -> Result<(), String> {
        self.centre.clear();
        for word in rest.split_whitespace() {
            let (axis, value) = word.split_at(1);
            if !(matches!(axis, "X" | "Y" | "Z") && value.starts_with(['+', '-'])) {
                return Err(format!("{word} is not allowed in a CC"));
            }
            let value = value.parse().map_err(|_| format!("{word} is not a position"))?;
            self.centre.insert(axis.chars().next().unwrap_or('X'), value);
        }
        let named: String = self.centre.keys().collect();
        self.plane = Some(match named.as_str() {
            "XY" => [0, 1, 2],
            "XZ" => [2, 0, 1],
            "YZ" => [1, 2, 0],
            _ => return Err("a CC must have two axes".into()),
        });
        Ok(())
    }

    /// Parses a straight move (`L`) or an arc (`C`) in Klartext, and adds the move to the program. `rest` contains the
    /// words after `L` or `C`. `motion` is `Some(1)` for a straight move at the programmed feed; the word `FMAX` makes
    /// this move rapid. `motion` is `None` for an arc; the word `DR+` or `DR-` then gives the direction. Returns an
    /// error if a word is not allowed, if no coordinate is given, or if the move itself is not allowed.
    fn straight(&mut self, rest: &str, motion: Option<u8>) -> Result<(), String> {
        let mut to = BTreeMap::new();
        self.motion = motion;
        for word in rest.split_whitespace() {
            match (word.split_at(1), word) {
                (_, "FMAX") if motion.is_some() => self.motion = Some(0),
                (_, "DR-" | "DR+") if motion.is_none() => self.motion = Some(if word == "DR-" { 2 } else { 3 }),
                (_, "R0") => {}
                (("F", feed), _) => self.feed = Some(feed.parse().map_err(|_| format!("{word} is not a feed"))?),
                ((axis @ ("X" | "Y" | "Z" | "A" | "B"), value), _) if value.starts_with(['+', '-']) => {
                    let value = value.parse().map_err(|_| format!("{word} is not a position"))?;
                    to.insert(axis.chars().next().unwrap_or('X'), value);
                }
                _ => return Err(format!("{word} is not allowed in an L")),
            }
        }
        if to.is_empty() { Err("the move has no target".into()) } else { self.go(&to) }
    }
}

/// Word: letters, and a number after them or after an equals sign.
struct ProgramWord {
    name: String,
    number: Option<f64>,
    has_point: bool,
}

fn words(line: &str) -> Result<Vec<ProgramWord>, String> {
    let mut found = Vec::new();
    let mut rest = line.trim_start();
    while !rest.is_empty() {
        let letters = rest.find(|c: char| !c.is_ascii_uppercase()).unwrap_or(rest.len());
        let (name, after) = rest.split_at(letters);
        if name.is_empty() {
            return Err(format!("{rest:?} cannot be read"));
        }
        let after = after.strip_prefix('=').unwrap_or(after);
        let end = after.find(|c: char| !(c.is_ascii_digit() || matches!(c, '.' | '-' | '+'))).unwrap_or(after.len());
        let (digits, next) = after.split_at(end);
        let number = (!digits.is_empty()).then(|| digits.parse::<f64>()).transpose();
        let number = number.map_err(|_| format!("{name}{digits} has no number"))?;
        found.push(ProgramWord { name: name.to_owned(), number, has_point: digits.contains('.') });
        rest = next.trim_start();
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ends(control: Control, text: &str) -> Result<Vec<[f64; 3]>, String> {
        let feeds = |program: Program| program.waypoints.into_iter().filter(|stop| stop.feed_mm_min.is_some());
        control.read(text).map(|program| feeds(program).map(|stop| stop.at_mm).collect())
    }

    #[test]
    fn control_parses_own_dialect() {
        for (control, text) in [
            (Control::Linuxcnc, "(x)\nG21 G90 G94 G17\nG64 P0.001 Q0\nG0 Z5.0\nX1.0Y2.0\nG1 Z0.5F600\nX3.0\nM2\n"),
            (
                Control::Fanuc,
                "%\r\nO7001 (A)\r\nG21 G90 G94\r\nG05.1 Q1\r\nG00 Z5.\r\nX1. Y2.\r\nG01 Z5000 F600.\r\nX3.\r\nG05.1 Q0\r\nM30\r\n%\r\n",
            ),
            (
                Control::Sinumerik,
                "; x\nN10 G710 G90 G94\nN20 G642 CTOL=0.001\nN25 FFWON SOFT\nN30 G0 Z5\nN40 X1 Y2\nN50 G1 Z0.5 F600\nN60 X3\nN70 M30\n",
            ),
            (
                Control::Heidenhain,
                "0 BEGIN PGM A MM\n1 ; X\n2 CYCL DEF 32.0 TOLERANCE\n3 CYCL DEF 32.1 T0.001\n4 L Z+5.0 R0 FMAX\n5 L X+1.0 Y+2.0 R0 FMAX\n6 L Z+0.5 F600\n7 L X+3.0\n8 END PGM A MM\n",
            ),
        ] {
            assert_eq!(ends(control, text).unwrap(), [[1.0, 2.0, 0.5], [3.0, 2.0, 0.5]], "{control:?}");
            assert_eq!(control.read(text).unwrap().tolerance_mm, (control != Control::Fanuc).then_some(0.001));
            let cut = text.trim_end().rsplit_once('\n').unwrap().0;
            assert!(control.read(cut).is_err(), "{control:?} without an end");
        }
    }

    #[test]
    fn upright_head_leaves_arc_unchanged() {
        let head =
            Head { letter: 'B', left_handed: false, range_deg: [-60.0, 60.0], pivot_mm: Some([0.0, 0.0, 180.0]) };
        for (control, text) in ARCS {
            let plain = control.read(text).unwrap();
            let beside = plain.clone().with_head(Some(head)).unwrap();
            for pair in plain.waypoints.windows(2).filter(|pair| pair[1].arc.is_some()) {
                let half_way = |program: &Program| program.centre_mm(&pair[0], &pair[1], 0.5);
                assert_eq!(half_way(&beside), half_way(&plain), "{control:?}");
                assert_eq!(beside.length_mm(&pair[0], &pair[1]), plain.length_mm(&pair[0], &pair[1]), "{control:?}");
            }
        }
    }

    /// Half a turn about (3, 7) in the plane of z and x, from the larger z to the smaller one through the larger x,
    /// with y moving along; then a line.
    const ARCS: [(Control, &str); 4] = [
        (Control::Linuxcnc, "G21 G90 G94 G17\nG91.1 G61\nG0 X3 Y1 Z9\nG18 G3 X3Z5I0K-2Y1.5F600\nG1 X0\nM2\n"),
        (
            Control::Fanuc,
            "%\nO1\nG21 G90 G94 G17 G61\nG00 X3. Y1. Z9.\nG18 G03 X3. Y1.5 Z5. I0. K-20000 F600.\nG01 X0.\nM30\n%\n",
        ),
        (
            Control::Sinumerik,
            "N10 G710 G90 G94 G17 G60 G601\nN20 G0 X3 Y1 Z9\nN30 G18 G3 X3 Y1.5 Z5 I0 K-2 F600\nN40 G1 X0\nN50 M30\n",
        ),
        (
            Control::Heidenhain,
            "0 BEGIN PGM A MM\n1 CYCL DEF 32.0 TOLERANCE\n2 CYCL DEF 32.1 T0.001\n3 L X+3 Y+1 Z+9 R0 FMAX\n4 CC X+3 Z+7\n5 C X+3 Z+5 DR+ F600\n6 L X+0\n7 END PGM A MM\n",
        ),
    ];

    #[test]
    fn arc_geometry_in_each_control() {
        for (control, text) in ARCS {
            let program = control.read(text).unwrap_or_else(|reason| panic!("{control:?}: {reason}"));
            let rises = if control == Control::Heidenhain { 0.0 } else { 0.5 };
            let [from, arc, line] = program.waypoints[..] else { panic!("{control:?}: {program:?}") };
            assert_eq!((from.at_mm, arc.at_mm), ([3.0, 1.0, 9.0], [3.0, 1.0 + rises, 5.0]));
            assert!(line.arc.is_none() && line.at_mm == [0.0, 1.0 + rises, 5.0]);
            let off = |at: [f64; 3], of: [f64; 3]| (0..3).all(|k| (at[k] - of[k]).abs() < 1e-12);
            assert!(off(arc.position_at(from.at_mm, 0.5), [5.0, 1.0 + 0.5 * rises, 7.0]), "{control:?}");
            assert!(off(arc.position_at(from.at_mm, 1.0), arc.at_mm), "{control:?}");
            assert!((arc.length_mm(from.at_mm) - (2.0 * std::f64::consts::PI).hypot(rises)).abs() < 1e-12);
            let chords = arc.in_chords(from.at_mm, 1e-4);
            let sagging = |pair: &[[f64; 3]]| {
                let middle: [f64; 2] = [0, 2].map(|k| 0.5 * (pair[0][k] + pair[1][k]));
                2.0 - (middle[0] - 3.0).hypot(middle[1] - 7.0)
            };
            assert!(chords.windows(2).map(sagging).all(|sag| sag > 0.5e-4 && sag < 1.001e-4));
            // The other way round passes through the smaller x.
            let round = text.replace("G3 ", "G2 ").replace("G03 ", "G02 ").replace("DR+", "DR-");
            let round = control.read(&round).unwrap().waypoints[1];
            assert!(off(round.position_at(from.at_mm, 0.5), [1.0, 1.0 + 0.5 * rises, 7.0]), "{control:?}");
        }
    }

    #[test]
    fn control_refuses_malformed_arcs() {
        for (control, from, to) in [
            (Control::Linuxcnc, "G91.1 ", ""),
            (Control::Linuxcnc, "G91.1", "G90.1"),
            (Control::Linuxcnc, "G18 ", ""),
            (Control::Linuxcnc, "K-2", "K-2.1"),
            (Control::Linuxcnc, "I0K-2", "I0J-2"),
            (Control::Linuxcnc, "G3 X3Z5", "G3 X3"),
            (Control::Linuxcnc, "G1 X0", "G1 X0 I1"),
            (Control::Fanuc, "K-20000", "K-2"),
            (Control::Sinumerik, "K-2", "K7"),
            (Control::Heidenhain, "Z+5 DR+", "Y+2 Z+5 DR+"),
            (Control::Heidenhain, "DR+ ", ""),
            (Control::Heidenhain, "CC X+3 Z+7", "CC X+3"),
            (Control::Heidenhain, "Z+7", "Z+7.1"),
            (Control::Heidenhain, "C X+3 Z+5 DR+", "L X+3 Z+5 DR+"),
        ] {
            let (_, text) = ARCS.into_iter().find(|(of, _)| *of == control).unwrap();
            assert!(text.contains(from), "{from}");
            assert!(control.read(&text.replacen(from, to, 1)).is_err(), "{control:?}: {to} in place of {from}");
        }
    }

    #[test]
    fn control_refuses_ambiguous_programs() {
        for (control, text) in [
            (Control::Linuxcnc, "G21 G90 G94\nG64\nG0 Z5\nM2\n"),
            (Control::Linuxcnc, "G21 G90 G94\nG0 Z5\nM2\n"),
            (Control::Linuxcnc, "G20 G90 G94 G61\nG0 Z5\nM2\n"),
            (Control::Linuxcnc, "G21 G94 G61\nG0 Z5\nM2\n"),
            (Control::Linuxcnc, "G21 G90 G94 G61\nG1 Z5 F5\nM2\n"),
            (Control::Linuxcnc, "G21 G90 G94 G61\nG0 X1 Y1 Z5\nG1 Z1e3 F5\nM2\n"),
            (Control::Fanuc, "O1\nG21 G90 G94 G61\nG0 Z5.\nM30\n"),
            (Control::Fanuc, "%\nO1\nG21 G90 G94 G64\nG0 Z5.\nM30\n%\n"),
            (Control::Sinumerik, "G710 G90 G94 G642\nG0 Z5\nM30\n"),
            (Control::Sinumerik, "G710 G90 G94 G64\nG0 Z5\nM30\n"),
            (Control::Sinumerik, "G21 G90 G94 G60\nG0 Z5\nM30\n"),
            (Control::Heidenhain, "0 BEGIN PGM A INCH\n1 END PGM A INCH\n"),
            (Control::Heidenhain, "0 BEGIN PGM A MM\n2 END PGM A MM\n"),
            (Control::Heidenhain, "0 BEGIN PGM A MM\n1 L Z+1 R0 FMAX\n2 END PGM A MM\n"),
            (Control::Heidenhain, "0 BEGIN PGM A MM\n1 END PGM B MM\n"),
        ] {
            assert!(control.read(text).is_err(), "{control:?}: {text}");
        }
    }
}
