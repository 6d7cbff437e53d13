//! What a control reads in a program: by its own means, written from what its makers say of it, so that no error of a writer hides here.
//!
//! ```text
//!  text -> block by block -> where the wheel's centre stops, or the slides and the head that carry it, and how fast it came there
//! ```
//!
//! A real control would do something with almost anything. This one refuses what would move a real machine elsewhere than its text says at
//! first sight: a coordinate in increments, inches, places from the last one, a move before the path mode is told, a program without an end.

use std::collections::BTreeMap;

use crate::head::Head;

/// Whose control it is.
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

/// Millimetres that a number without a point counts in with IS-C.
const INCREMENT_MM: f64 = 1e-4;

/// Where a move ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stop {
    /// In millimetres; not a number along an axis that has not been told yet.
    pub at_mm: [f64; 3],
    /// In degrees, on the scale of the rotary axis; none where none has been told yet.
    pub turn_deg: Option<f64>,
    /// In mm/min; none where it comes rapidly. Of a move that is told its time it is how fast the slides are.
    pub feed_mm_min: Option<f64>,
    /// The time of the move in minutes, where that is told.
    pub minutes: Option<f64>,
}

/// A program as a control has read it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Program {
    /// Where the moves end, in order.
    pub stops: Vec<Stop>,
    /// The rotary axis that it turns.
    pub axis: Option<char>,
    /// Whether it has the control keep the wheel's centre while the head turns.
    pub keeps_centre: bool,
    /// Whether the control's own kinematics keep it, of which no program speaks.
    pub(crate) by_kinematics: bool,
    /// The head that it turns, once it is known.
    pub(crate) head: Option<Head>,
    /// How far corners may be rounded off, where the program says it.
    pub tolerance_mm: Option<f64>,
    /// The comments.
    pub comments: Vec<String>,
}

impl Program {
    /// Gives it to a machine with this head, if it has one.
    ///
    /// # Errors
    /// What the machine cannot do.
    pub fn on(mut self, head: Option<Head>) -> Result<Self, String> {
        let why = match (self.axis, head) {
            (Some(letter), None) => Some(format!("the program turns {letter}, and this machine has no rotary axis")),
            (_, Some(head)) => head.refuses(&self),
            (None, None) => None,
        };
        self.head = head;
        why.map_or(Ok(self), Err)
    }

    /// Returns where the wheel's centre is at a share of the way from a stop to the next.
    pub fn centre_mm(&self, from: &Stop, to: &Stop, share: f64) -> [f64; 3] {
        match &self.head {
            Some(head) => head.along_mm(from, to, share),
            None => std::array::from_fn(|k| from.at_mm[k] + share * (to.at_mm[k] - from.at_mm[k])),
        }
    }
}

impl Control {
    /// Returns the control that a dialect of this name is for.
    pub fn named(dialect: &str) -> Option<Self> {
        let known = [
            ("linuxcnc", Self::Linuxcnc),
            ("fanuc", Self::Fanuc),
            ("sinumerik", Self::Sinumerik),
            ("heidenhain", Self::Heidenhain),
        ];
        known.into_iter().find(|(name, _)| *name == dialect).map(|(_, control)| control)
    }

    /// Reads a program.
    ///
    /// # Errors
    /// What the control would stop at, or what would not do what it seems to, with its line.
    pub fn read(self, text: &str) -> Result<Program, String> {
        let mut reader = Reader { control: self, ..Reader::default() };
        reader.program.by_kinematics = self == Self::Linuxcnc;
        for (k, line) in text.lines().enumerate() {
            reader.line(line.trim_end_matches('\r')).map_err(|why| format!("line {}: {why}: {line:?}", k + 1))?;
        }
        reader.finish()
    }
}

#[derive(Default)]
struct Reader {
    control: Control,
    program: Program,
    at_mm: Option<[f64; 3]>,
    /// 0 rapid, 1 at feed.
    motion: Option<u8>,
    turn_deg: Option<f64>,
    /// Of the last block that told one; in 1/min where feeds are by time, and then of no other block.
    feed: Option<f64>,
    by_time: bool,
    keeps_centre: bool,
    /// Whether a Sinumerik has its work offset, and turns axes in proportion between points.
    no_offset: bool,
    in_proportion: bool,
    metric: bool,
    absolute: bool,
    by_minute: bool,
    exact: bool,
    /// Lines of Klartext, the name of the program, and whether cycle 32 waits for its tolerance.
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
            return Err("a tape begins and ends with a percent sign".into());
        }
        Ok(self.program)
    }

    /// A block of letters and numbers.
    fn block(&mut self, line: &str) -> Result<(), String> {
        if line == "%" {
            self.percents += 1;
            return Ok(());
        }
        if self.ended {
            return Err("something comes after the end".into());
        }
        if self.control == Control::Fanuc && self.percents != 1 {
            return Err("it stands outside of the percent signs".into());
        }
        let mut to: BTreeMap<char, f64> = BTreeMap::new();
        let (mut smooth, mut level, mut length, kept) = (None, None, false, self.keeps_centre);
        for word in words(line)? {
            let Word { name, number, has_point } = word;
            let whole = format!("{name}{}", number.map_or(String::new(), |n| n.to_string()));
            match (self.control, name.as_str(), number) {
                (Control::Linuxcnc | Control::Sinumerik | Control::Fanuc, "N", Some(_)) => {}
                (Control::Fanuc, "O", Some(n)) if !self.numbered && (1.0..=9999.0).contains(&n) => self.numbered = true,
                (_, "X" | "Y" | "Z" | "A" | "B", Some(n)) => {
                    let scale = if self.control == Control::Fanuc && !has_point { INCREMENT_MM } else { 1.0 };
                    to.insert(name.chars().next().unwrap_or('X'), scale * n);
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
                _ => return Err(format!("{whole} is no word of this control")),
            }
        }
        let begins = self.keeps_centre && !kept;
        if self.control == Control::Fanuc && begins != length {
            return Err("tool centre point control and the length of the tool go together".into());
        }
        self.exactness(smooth, level)?;
        if to.is_empty() { Ok(()) } else { self.go(&to) }
    }

    /// A word G, in tenths; returns one of how exactly the path is kept to.
    fn preparatory(&mut self, tenths: i64) -> Result<Option<i64>, String> {
        match (self.control, tenths) {
            (_, 0 | 10) => self.motion = Some(u8::from(tenths == 10)),
            (_, 540) => self.no_offset = false,
            (_, 490) => self.keeps_centre = false,
            (Control::Fanuc, 434) => self.keeps_centre = true,
            (_, 170 | 400 | 800) => {}
            (Control::Linuxcnc | Control::Fanuc, 210) | (Control::Sinumerik, 7100) => self.metric = true,
            (_, 900) => self.absolute = true,
            (_, 940) => (self.by_minute, self.by_time) = (true, false),
            (_, 930) => (self.by_minute, self.by_time, self.feed) = (false, true, None),
            (Control::Linuxcnc, 610 | 611 | 640)
            | (Control::Fanuc, 51 | 610 | 640)
            | (Control::Sinumerik, 600 | 6010 | 6420 | 640) => return Ok(Some(tenths)),
            _ => return Err(format!("G{} is not what a pass needs", tenths as f64 / 10.0)),
        }
        Ok(None)
    }

    /// What a word of exactness means by itself: nothing is kept by a mode that rounds corners off as it likes.
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
            (self.metric, "it does not say that it is in mm"),
            (self.absolute, "it does not say that its places are absolute"),
            (self.by_minute || self.by_time, "it does not say that its feeds are in mm/min"),
            (!self.no_offset, "its work offset was taken back"),
            (self.exact, "it moves before it says how exactly, or in a mode that rounds corners off as it likes"),
        ];
        if let Some((_, why)) = told.iter().find(|(is_so, _)| !is_so) {
            return Err((*why).to_owned());
        }
        let feed = match self.motion {
            Some(0) => None,
            Some(_) => Some(self.feed.ok_or("it moves at a feed that nobody told")?),
            None => return Err("it moves nobody knows how".into()),
        };
        let from_mm = self.at_mm.unwrap_or([f64::NAN; 3]);
        let mut at_mm = from_mm;
        for (axis, value) in to {
            match "XYZ".find(*axis) {
                Some(k) => at_mm[k] = *value,
                None => self.turn(*axis, *value)?,
            }
        }
        let minutes = feed.filter(|_| self.by_time).map(|inverse| 1.0 / inverse);
        let feed_mm_min = minutes.map_or(feed, |minutes| {
            Some((0..3).map(|k| (at_mm[k] - from_mm[k]).powi(2)).sum::<f64>().sqrt() / minutes)
        });
        if self.by_time {
            self.feed = None;
        }
        if feed_mm_min.is_some() && at_mm.iter().any(|v| v.is_nan()) {
            return Err("it feeds from a place that it did not tell".into());
        }
        self.at_mm = Some(at_mm);
        self.program.stops.push(Stop { at_mm, turn_deg: self.turn_deg, feed_mm_min, minutes });
        Ok(())
    }

    /// Turns a rotary axis: one in a program, and in one way from beginning to end.
    fn turn(&mut self, axis: char, to_deg: f64) -> Result<(), String> {
        let first = self.program.axis.is_none();
        if *self.program.axis.get_or_insert(axis) != axis {
            return Err("it turns two axes".into());
        }
        if first {
            self.program.keeps_centre = self.keeps_centre;
        }
        if self.program.keeps_centre != self.keeps_centre {
            return Err("it turns with and without the wheel's centre kept".into());
        }
        if self.control == Control::Sinumerik && self.keeps_centre && !self.in_proportion {
            return Err("it does not say how it turns between points".into());
        }
        self.turn_deg = Some(to_deg);
        Ok(())
    }

    /// A line of Klartext, with its number.
    fn klartext(&mut self, line: &str) -> Result<(), String> {
        let (number, rest) = line.split_once(' ').unwrap_or((line, ""));
        if number.parse() != Ok(self.lines) {
            return Err(format!("its number is not {}", self.lines));
        }
        self.lines += 1;
        let rest = rest.trim();
        let program = |begins: &str| rest.strip_prefix(begins)?.strip_suffix(" MM").map(str::to_owned);
        if self.lines == 1 {
            // All the rest is so by the language.
            (self.metric, self.absolute, self.by_minute) = (true, true, true);
            self.name = Some(program("BEGIN PGM ").ok_or("it does not begin with BEGIN PGM in MM")?);
            return Ok(());
        }
        if rest.starts_with("END PGM") {
            self.ended = true;
            return if program("END PGM ") == self.name { Ok(()) } else { Err("it ends another program".into()) };
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
            _ => self.straight(rest.strip_prefix("L ").ok_or("it is no line of a pass")?),
        }
    }

    /// What comes after an L.
    fn straight(&mut self, rest: &str) -> Result<(), String> {
        let mut to = BTreeMap::new();
        self.motion = Some(1);
        for word in rest.split_whitespace() {
            match (word.split_at(1), word) {
                (_, "FMAX") => self.motion = Some(0),
                (_, "R0") => {}
                (("F", feed), _) => self.feed = Some(feed.parse().map_err(|_| format!("{word} is no feed"))?),
                ((axis @ ("X" | "Y" | "Z" | "A" | "B"), value), _) if value.starts_with(['+', '-']) => {
                    let value = value.parse().map_err(|_| format!("{word} is no place"))?;
                    to.insert(axis.chars().next().unwrap_or('X'), value);
                }
                _ => return Err(format!("{word} is no word of an L")),
            }
        }
        if to.is_empty() { Err("it goes nowhere".into()) } else { self.go(&to) }
    }
}

/// A word: letters, and a number behind them or behind an equals sign.
struct Word {
    name: String,
    number: Option<f64>,
    has_point: bool,
}

fn words(line: &str) -> Result<Vec<Word>, String> {
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
        found.push(Word { name: name.to_owned(), number, has_point: digits.contains('.') });
        rest = next.trim_start();
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ends(control: Control, text: &str) -> Result<Vec<[f64; 3]>, String> {
        let feeds = |program: Program| program.stops.into_iter().filter(|stop| stop.feed_mm_min.is_some());
        control.read(text).map(|program| feeds(program).map(|stop| stop.at_mm).collect())
    }

    #[test]
    fn every_control_reads_its_own() {
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
    fn what_would_go_elsewhere_is_refused() {
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
