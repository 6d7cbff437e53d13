//! Writing of corrected lines in the dialect of their program.

use super::control::INCH_MM;
use super::dialect::{ArcWords, CentreWords, Dialect};
use super::dialect_reading::{decimals, has_g_words, own_unit};
use super::number::push_decimals;
use super::read::{Block, GcodeWord, Refusal, block};
use super::write::{comments, end_line, number};

/// Writer of lines in a dialect, from lines in the words of LinuxCNC.
pub(super) struct DialectWriter<'a> {
    dialect: &'a Dialect,
    /// Number of blocks with a number so far.
    numbered: u64,
    inches: bool,
    /// Plane of arcs: 0 for x and y, 1 for z and x, 2 for y and z.
    plane: usize,
    /// Feed in Klartext that no line has stated yet. The next move at feed states it, or a line of its own.
    feed: Option<String>,
}

impl<'a> DialectWriter<'a> {
    pub(super) fn new(dialect: &'a Dialect) -> Self {
        Self { dialect, numbered: 0, inches: false, plane: 0, feed: None }
    }

    /// Returns the comments of a header as lines.
    pub(super) fn header(&mut self, lines: &str) -> Result<Vec<u8>, Refusal> {
        let mut out = Vec::new();
        for line in lines.lines() {
            match line.strip_prefix('(').and_then(|line| line.strip_suffix(')')) {
                Some(words) => {
                    for line in comments(self.dialect, words) {
                        self.comment_line(&mut out, &line);
                    }
                }
                None => out.extend(self.express(line.as_bytes())?),
            }
        }
        Ok(out)
    }

    /// Returns a line that is copied. `words` are the words that it has for the correction.
    pub(super) fn copied(&mut self, line: &str, words: &str) -> Vec<u8> {
        let mut out = Vec::new();
        self.follow(&block(words).unwrap_or_default());
        if words.is_empty() && line.starts_with(self.dialect.text.comment_begins.trim()) {
            self.comment_line(&mut out, line);
        } else {
            self.line(&mut out, line);
        }
        out
    }

    /// Returns corrected lines in the dialect.
    ///
    /// # Errors
    /// A coordinate beyond the limit of the dialect.
    pub(super) fn express(&mut self, text: &[u8]) -> Result<Vec<u8>, Refusal> {
        let text = String::from_utf8_lossy(text);
        let mut out = Vec::new();
        for line in text.lines() {
            let block = block(line)?;
            self.follow(&block);
            for comment in &block.comments {
                let words = comment.trim_start_matches([';', '(']).trim_end_matches(')');
                for line in comments(self.dialect, words) {
                    self.comment_line(&mut out, &line);
                }
            }
            let code = |word: &GcodeWord| if word.letter == b'G' { word.value } else { f64::NAN };
            let motion = block.words.iter().find(|word| [0.0, 1.0, 2.0, 3.0].contains(&code(word)));
            let is_machine = block.words.iter().any(|word| [28.0, 30.0, 53.0].contains(&code(word)));
            let moves = block.words.iter().any(|word| b"XYZ".contains(&word.letter));
            match motion {
                Some(motion) if moves && !is_machine => self.motion(&mut out, motion.value as u8, &block)?,
                _ if has_g_words(self.dialect) => {
                    let words: Vec<String> = block.words.iter().map(|word| self.own_word(word)).collect();
                    if !words.is_empty() {
                        self.line(&mut out, &words.join(" "));
                    }
                }
                _ => self.functions(&mut out, &block),
            }
        }
        if let Some(feed) = self.feed.take() {
            let line = format!("{}{feed}", self.dialect.words.line);
            self.line(&mut out, &line);
        }
        Ok(out)
    }

    /// Returns a word of LinuxCNC as a dialect of G words has it.
    fn own_word(&self, word: &GcodeWord) -> String {
        let words = &self.dialect.words;
        let own = match word.letter {
            b'X' | b'Y' | b'Z' => &words.axes[usize::from(word.letter - b'X')],
            b'F' => &words.feed,
            b'G' if word.value == 20.0 || word.value == 21.0 => {
                let unit = own_unit(self.dialect, word.value == 20.0);
                return unit.map_or_else(|| word.text.to_owned(), ToOwned::to_owned);
            }
            _ => return word.text.to_owned(),
        };
        format!("{own}{}", &word.text[1..])
    }

    /// Notes the unit and the plane that a line selects.
    fn follow(&mut self, block: &Block) {
        for word in block.words.iter().filter(|word| word.letter == b'G') {
            match word.value {
                17.0 => self.plane = 0,
                18.0 => self.plane = 1,
                19.0 => self.plane = 2,
                20.0 => self.inches = true,
                21.0 => self.inches = false,
                _ => {}
            }
        }
    }

    /// Writes functions in Klartext. A feed waits for a move of the same lines, or for their end; other words are those of
    /// the state, which Klartext does not have.
    fn functions(&mut self, out: &mut Vec<u8>, block: &Block) {
        for word in &block.words {
            match word.letter {
                b'F' => self.feed = Some(word.text.to_owned()),
                b'M' => self.line(out, word.text),
                _ => {}
            }
        }
    }

    fn motion(&mut self, out: &mut Vec<u8>, motion: u8, block: &Block) -> Result<(), Refusal> {
        let dialect = self.dialect;
        let words = &dialect.words;
        if let (2 | 3, Some(arcs)) = (motion, &dialect.arcs) {
            return self.arc(out, motion == 2, arcs, block);
        }
        let (begins, ends) = if motion == 0 { (&words.rapid, words.rapid_ends.as_str()) } else { (&words.line, "") };
        let mut line = begins.clone();
        self.coordinates(&mut line, block, [true; 3])?;
        self.finish(out, line, ends, motion > 0, block);
        Ok(())
    }

    fn arc(&mut self, out: &mut Vec<u8>, clockwise: bool, arcs: &ArcWords, block: &Block) -> Result<(), Refusal> {
        let dialect = self.dialect;
        let in_plane = [[true, true, false], [true, false, true], [false, true, true]][self.plane];
        let value = |letter: u8| block.words.iter().find(|word| word.letter == letter).map_or(0.0, |word| word.value);
        let centre = [b'I', b'J', b'K'].map(value);
        let axes = (0..3).filter(|&k| in_plane[k]);
        if let (CentreWords::BlockBefore, Some(begins)) = (arcs.centre, &arcs.centre_block) {
            let mut line = begins.clone();
            for (n, k) in axes.clone().enumerate() {
                line += if n > 0 { &dialect.words.between } else { "" };
                self.coordinate(&mut line, &dialect.words.axes[k], centre[k])?;
            }
            self.line(out, &line);
        }
        let mut line = if clockwise { arcs.clockwise.clone() } else { arcs.counter_clockwise.clone() };
        let written = if arcs.third_axis { [true; 3] } else { in_plane };
        self.coordinates(&mut line, block, written)?;
        for k in axes {
            if let Some(letters) = &arcs.centre_words {
                line += &dialect.words.between;
                self.coordinate(&mut line, &letters[k], centre[k])?;
            }
        }
        let ends = if clockwise { &arcs.clockwise_ends } else { &arcs.counter_clockwise_ends };
        self.finish(out, line, ends, true, block);
        Ok(())
    }

    /// Ends the line of a move: with rotary axes that stand at 0, the end of its words, and the feed.
    fn finish(&mut self, out: &mut Vec<u8>, mut line: String, ends: &str, is_feed: bool, block: &Block) {
        for word in block.words.iter().filter(|word| matches!(word.letter, b'A' | b'B' | b'C')) {
            line += &self.dialect.words.between;
            line += word.text;
        }
        line += ends;
        if let Some(feed) = self.feed.take_if(|_| is_feed) {
            line += &self.dialect.words.between;
            line += &feed;
        }
        self.line(out, &line);
    }

    fn coordinates(&self, line: &mut String, block: &Block, written: [bool; 3]) -> Result<(), Refusal> {
        let mut first = true;
        for (k, letter) in b"XYZ".iter().enumerate().filter(|(k, _)| written[*k]) {
            if let Some(word) = block.words.iter().find(|word| word.letter == *letter) {
                *line += if first { "" } else { &self.dialect.words.between };
                self.coordinate(line, &self.dialect.words.axes[k], word.value)?;
                first = false;
            }
        }
        Ok(())
    }

    fn coordinate(&self, line: &mut String, axis: &str, value: f64) -> Result<(), Refusal> {
        let numbers = &self.dialect.numbers;
        let mm = if self.inches { value * INCH_MM } else { value };
        if mm.abs() > numbers.max_mm {
            let found = format!("{axis} goes to {mm:.3} mm; the dialect has {} mm at most", numbers.max_mm);
            return Err((found, "check the program and the map"));
        }
        let decimals = decimals(self.dialect, self.inches);
        let count = (value * 10f64.powi(i32::from(decimals))).round() as i64;
        *line += axis;
        *line += if numbers.plus && count >= 0 { "+" } else { "" };
        let mut digits = Vec::new();
        push_decimals(&mut digits, count, decimals);
        *line += &String::from_utf8_lossy(&digits);
        Ok(())
    }

    fn line(&mut self, out: &mut Vec<u8>, line: &str) {
        // A percent sign, and the name behind it, is not a block and has no number.
        if !line.starts_with('%') {
            number(out, self.dialect, self.numbered);
            self.numbered += 1;
        }
        out.extend_from_slice(line.as_bytes());
        end_line(out, self.dialect);
    }

    fn comment_line(&mut self, out: &mut Vec<u8>, line: &str) {
        if self.dialect.blocks.as_ref().is_some_and(|blocks| blocks.all) {
            return self.line(out, line);
        }
        out.extend_from_slice(line.as_bytes());
        end_line(out, self.dialect);
    }
}
