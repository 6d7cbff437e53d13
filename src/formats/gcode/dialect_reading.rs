//! Reading of programs in a dialect: each line becomes a line in the words of LinuxCNC, which the correction executes.
//!
//! A line that the dialect's file describes, such as the selection of a path mode, is recognised and copied. A line with
//! other words is refused: the correction must know what it does.

use super::dialect::{CentreWords, Dialect, LINUXCNC, NAME, NUMBER, TOLERANCE};
use super::number::push_decimals;
use super::read::{Refusal, block};

/// Line of a program in the words of LinuxCNC.
#[derive(Debug, Default, PartialEq)]
pub(super) struct NeutralLine {
    /// Words that the line has for the correction; empty if it has none.
    pub(super) words: String,
    /// Text that is copied in place of the words, without the number of the block.
    pub(super) copied: Option<String>,
    /// True for a line before the first block: the name or the number of the program.
    pub(super) is_frame: bool,
}

impl NeutralLine {
    pub(super) fn new(words: impl Into<String>) -> Self {
        Self { words: words.into(), ..Self::default() }
    }

    fn copied(text: &str, words: impl Into<String>) -> Self {
        Self { words: words.into(), copied: Some(text.to_owned()), is_frame: false }
    }
}

/// Reader of programs in a dialect.
pub(super) struct DialectReader<'a> {
    dialect: &'a Dialect,
    /// Texts of the lines that the dialect describes, without blanks and in capital letters.
    templates: Vec<String>,
    /// The same for the lines before the header.
    frame: Vec<String>,
    /// Letters of LinuxCNC for the words of the dialect, the longest word first.
    letters: Vec<(String, char)>,
    inches: bool,
    /// Centre of the next arcs in Klartext: the words, and the plane.
    centre: Option<String>,
}

/// Returns true if the words of a dialect are letters with numbers, as in G1 X2. Otherwise the dialect is Klartext.
pub(super) fn has_g_words(dialect: &Dialect) -> bool {
    let line = dialect.words.line.trim();
    line.strip_prefix(['G', 'g']).is_some_and(|code| code.bytes().all(|b| b.is_ascii_digit()))
}

/// Returns the dialect, if it is not that of LinuxCNC, in which the correction works.
pub(super) fn foreign(dialect: Option<&Dialect>) -> Option<&Dialect> {
    dialect.filter(|dialect| dialect.dialect.name != LINUXCNC)
}

impl<'a> DialectReader<'a> {
    pub(super) fn new(dialect: &'a Dialect) -> Self {
        let modes = [&dialect.path.blend, &dialect.path.exact_path, &dialect.path.exact_stop].into_iter().flatten();
        let arcs = dialect.arcs.iter().flat_map(|arcs| arcs.begin.iter().chain(&arcs.end));
        let lines = modes.flat_map(|mode| mode.begin.iter().chain(&mode.end)).chain(arcs);
        let lines = lines.chain(&dialect.program.setup).chain(&dialect.program.end);
        let (templates, frame) = (
            lines.map(|line| squeezed(line)).collect(),
            dialect.program.begin.iter().map(|line| squeezed(line)).collect(),
        );
        Self { dialect, templates, frame, letters: letters_of(dialect), inches: false, centre: None }
    }

    /// Reads a line.
    ///
    /// # Errors
    /// A line that the dialect does not describe, and whose effect is not known.
    pub(super) fn neutral(&mut self, line: &str) -> Result<NeutralLine, Refusal> {
        let text = without_number(line.trim(), self.dialect);
        if text == "%" {
            return Ok(NeutralLine::copied(text, "%"));
        }
        let (code, comment) = self.divided(text)?;
        let squeezed_text = squeezed(text);
        if code.is_empty() {
            // The folder of a Sinumerik archive stands directly behind its name.
            let is_frame = has_g_words(self.dialect) && squeezed_text.starts_with(";$PATH=");
            return Ok(NeutralLine { is_frame, ..NeutralLine::copied(text, "") });
        }
        // The first block of Klartext also selects the unit.
        let selects_unit = !has_g_words(self.dialect) && squeezed_text.starts_with("BEGINPGM");
        let is_frame = !selects_unit
            && (self.frame.iter().any(|template| fits(template, &squeezed_text)) || self.is_name(&squeezed_text));
        let is_described = self.templates.iter().any(|template| fits(template, &squeezed(code)));
        if is_frame || is_described || self.is_unit(code) {
            let words = known_words(code);
            self.inches =
                words.split(' ').fold(self.inches, |inches, word| (word == "G20") || (inches && word != "G21"));
            return Ok(NeutralLine { is_frame, ..NeutralLine::copied(text, words) });
        }
        let words = if has_g_words(self.dialect) { self.g_words(text, code)? } else { self.klartext(text, code)? };
        // A line that is copied has its comment.
        let comment = comment.filter(|_| words.copied.is_none());
        let comment = comment.map_or(String::new(), |words| format!(" ;{words}"));
        Ok(NeutralLine { words: words.words + &comment, ..words })
    }

    /// Returns true for a line with the name or the number of a program.
    pub(super) fn is_name_line(&self, line: &str) -> bool {
        self.is_name(&squeezed(line.trim()))
    }

    /// Returns a line without the number of its block.
    pub(super) fn without_number<'l>(&self, line: &'l str) -> &'l str {
        without_number(line.trim(), self.dialect)
    }

    /// Divides a line into its words, and the words of its comment.
    fn divided<'l>(&self, text: &'l str) -> Result<(&'l str, Option<&'l str>), Refusal> {
        let marks = &self.dialect.text;
        let Some((code, rest)) = text.split_once(marks.comment_begins.trim()) else { return Ok((text, None)) };
        if marks.comment_ends.is_empty() {
            return Ok((code.trim(), Some(rest.trim())));
        }
        let close = ("a comment has no end".to_owned(), "close it");
        let (comment, after) = rest.split_once(&marks.comment_ends).ok_or(close)?;
        if !after.trim().is_empty() {
            return Err(("words follow a comment in the same line".into(), "write the comment last"));
        }
        Ok((code.trim(), Some(comment.trim())))
    }

    /// Returns true for the number of a Fanuc program, or the first line of a Sinumerik archive.
    fn is_name(&self, text: &str) -> bool {
        let numbered = self.dialect.program.numbers.is_some();
        let digits = text.strip_prefix(['O', ':']).filter(|_| numbered);
        let is_number = digits.is_some_and(|digits| {
            let rest = digits.trim_start_matches(|c: char| c.is_ascii_digit());
            rest.len() < digits.len() && (rest.is_empty() || rest.starts_with(self.dialect.text.comment_begins.trim()))
        });
        is_number || (has_g_words(self.dialect) && text.starts_with("%_N_"))
    }

    /// Returns true for a line that selects the unit by words of Sinumerik, and has no other words than those of the state.
    fn is_unit(&self, code: &str) -> bool {
        let mut setup = self.dialect.program.setup.iter().flat_map(|line| line.split_whitespace());
        let tokens: Vec<&str> = code.split_whitespace().collect();
        setup.any(|word| unit_word(word).is_some())
            && tokens.iter().any(|token| unit_word(token).is_some())
            && tokens.iter().all(|token| !known_words(token).is_empty())
    }

    /// Reads words of letters and numbers.
    fn g_words(&mut self, text: &str, code: &str) -> Result<NeutralLine, Refusal> {
        if code.contains(['(', ')']) {
            return Err((
                "brackets call a function of the control".into(),
                "remove the call, or write out what it does",
            ));
        }
        let upper = code.to_ascii_uppercase();
        let plain = plain_words(&upper, &self.letters)?;
        let block = block(&plain).map_err(|refusal| self.unknown_word(&upper).unwrap_or(refusal))?;
        // A dwell in seconds, which Fanuc names by the letter of an axis.
        let is_dwell = block.words.iter().any(|word| word.letter == b'G' && word.value == 4.0);
        if is_dwell && block.words.iter().all(|word| matches!(word.letter, b'G' | b'X' | b'P' | b'F' | b'S')) {
            return match block.words.iter().filter(|word| word.letter == b'G').count() {
                1 => Ok(NeutralLine::copied(text, "")),
                _ => Err(("a dwell stands with other G words".into(), "write G4 in a line of its own")),
            };
        }
        let mut words = String::new();
        for word in &block.words {
            if !words.is_empty() {
                words.push(' ');
            }
            match (word.letter, word.value) {
                (b'G', 20.0) => self.inches = true,
                (b'G', 21.0) => self.inches = false,
                (b'G', code @ (0.0 | 1.0 | 2.0 | 3.0)) => {
                    words += &format!("G{}", motion_of(self.dialect, code));
                    continue;
                }
                _ => {}
            }
            words += &self.with_point(word.letter, word.value, word.text);
        }
        Ok(NeutralLine::new(words))
    }

    /// Returns the refusal of the first word of a line that is not a letter with a number.
    fn unknown_word(&self, upper: &str) -> Option<Refusal> {
        let is_unknown = |token: &&str| {
            plain_words(token, &self.letters).is_ok_and(|plain| block(&plain).is_err())
                && !token.starts_with(['/', '#'])
        };
        let token = upper.split_whitespace().find(is_unknown)?;
        let remedy = "remove it if it does not move the tool, or write it into `setup` of a dialect of your own";
        Some((format!("{token:?} is not known"), remedy))
    }

    /// Returns a word with its point: a coordinate without one counts increments on controls that say so.
    fn with_point(&self, letter: u8, value: f64, text: &str) -> String {
        let counts = self.dialect.numbers.feed_point && b"XYZIJKR".contains(&letter) && !text.contains('.');
        if !counts {
            return text.to_owned();
        }
        let mut written = vec![letter];
        push_decimals(&mut written, value as i64, decimals(self.dialect, self.inches));
        String::from_utf8_lossy(&written).into_owned()
    }

    /// Reads a line in Klartext.
    fn klartext(&mut self, text: &str, code: &str) -> Result<NeutralLine, Refusal> {
        let upper = code.to_ascii_uppercase();
        let tokens: Vec<&str> = upper.split_whitespace().collect();
        match tokens[..] {
            ["BEGIN", "PGM", .., unit @ ("MM" | "INCH")] => {
                self.inches = unit == "INCH";
                let words = if self.inches { "G20" } else { "G21" };
                Ok(NeutralLine { is_frame: true, ..NeutralLine::copied(text, words) })
            }
            ["END", "PGM", ..] => Ok(NeutralLine::copied(text, "")),
            ["BLK", "FORM", ..] | ["TOOL", "DEF", ..] | ["*", "-", ..] => Ok(NeutralLine::copied(text, "")),
            // The tool moves to where it is changed, and has another length.
            ["TOOL", "CALL", ..] => Ok(NeutralLine::copied(text, "M6")),
            ["L", ref rest @ ..] => straight(rest).map(NeutralLine::new),
            ["CC", ref rest @ ..] => {
                self.centre = Some(centre(rest)?);
                Ok(NeutralLine::default())
            }
            ["C", ref rest @ ..] => self.round(rest).map(NeutralLine::new),
            _ if tokens.iter().all(|token| is_m_word(token)) => Ok(NeutralLine::new(upper)),
            _ => Err((
                format!("{code:?} is not known"),
                "remove it if it does not move the tool, or write it into `setup` of a dialect of your own",
            )),
        }
    }

    /// Reads an arc about the last centre.
    fn round(&self, tokens: &[&str]) -> Result<String, Refusal> {
        let centre = self.centre.as_ref().ok_or(("the arc has no centre".to_owned(), "write a CC block before it"))?;
        let sense = tokens.iter().find_map(|token| match *token {
            "DR-" => Some("G2"),
            "DR+" => Some("G3"),
            _ => None,
        });
        let sense = sense.ok_or(("the arc has no sense of rotation".to_owned(), "write DR+ or DR-"))?;
        let rest: Vec<&str> = tokens.iter().copied().filter(|token| !token.starts_with("DR")).collect();
        let (words, is_rapid) = axis_words(&rest)?;
        if is_rapid {
            return Err(("an arc is made in rapid traverse".into(), "write a feed"));
        }
        let plane = ["G17", "G18", "G19"].into_iter().find(|plane| centre.starts_with(plane)).unwrap_or("G17");
        Ok(format!("{plane} {sense} {words} {}", &centre[plane.len() + 1..]))
    }
}

/// Returns the letters of LinuxCNC for the words of a dialect of G words, the longest first.
fn letters_of(dialect: &Dialect) -> Vec<(String, char)> {
    let axes = dialect.words.axes.iter().zip(['X', 'Y', 'Z']);
    let centres = dialect.arcs.iter().filter_map(|arcs| arcs.centre_words.as_ref());
    let centres = centres.flat_map(|words| words.iter().zip(['I', 'J', 'K']));
    let feed = [(&dialect.words.feed, 'F')];
    let own = axes.chain(centres).chain(feed).map(|(word, letter)| (squeezed(word), letter));
    let mut letters: Vec<(String, char)> = own.collect();
    // An assignment to an axis and the radius of an arc of Sinumerik, and the plain letters for which it stands.
    letters.push(("CR=".to_owned(), 'R'));
    for letter in ['X', 'Y', 'Z', 'I', 'J', 'K', 'F'] {
        let is_another =
            |(word, of): &(String, char)| word.trim_end_matches('=') == letter.to_string() && *of != letter;
        let is_own = letters.iter().any(|(word, of)| word.trim_end_matches('=') == letter.to_string() && *of == letter);
        if !letters.iter().any(is_another) && is_own {
            letters.extend([(letter.to_string(), letter), (format!("{letter}="), letter)]);
        }
    }
    letters.sort_by_key(|(word, _)| std::cmp::Reverse(word.len()));
    letters
}

/// Returns a line, in capital letters, with the letters of LinuxCNC in place of the words of a dialect, as [`letters_of`]
/// gives them.
///
/// # Errors
/// The letter of an axis, of a centre or of the feed that is no word of the dialect.
fn plain_words(upper: &str, letters: &[(String, char)]) -> Result<String, Refusal> {
    let has_centres = letters.iter().any(|(_, letter)| *letter == 'I');
    let mut plain = String::with_capacity(upper.len());
    let mut rest = upper;
    while let Some(first) = rest.chars().next() {
        let is_value =
            |text: &str| text.trim_start().starts_with(|c: char| c.is_ascii_digit() || matches!(c, '.' | '+' | '-'));
        let own = letters.iter().find_map(|(word, letter)| {
            rest.strip_prefix(word.as_str()).filter(|behind| is_value(behind)).map(|behind| (*letter, behind))
        });
        match own {
            Some((letter, behind)) => {
                plain.push(letter);
                rest = behind;
            }
            None if (matches!(first, 'X' | 'Y' | 'Z' | 'F') || (has_centres && matches!(first, 'I' | 'J' | 'K')))
                && is_value(&rest[1..]) =>
            {
                let remedy = "write the words that the dialect's file has, or correct that file";
                return Err((format!("{first} is no word of an axis, a centre or the feed in this dialect"), remedy));
            }
            None => {
                plain.push(first);
                rest = &rest[first.len_utf8()..];
            }
        }
    }
    Ok(plain)
}

/// Returns the G code of LinuxCNC for the motion that a G code of the dialect means.
fn motion_of(dialect: &Dialect, code: f64) -> u8 {
    let number = |text: &str| -> Option<f64> {
        let word = text.trim();
        word.strip_prefix(['G', 'g']).and_then(|digits| digits.parse().ok())
    };
    let arcs = dialect.arcs.as_ref();
    let own = [
        number(&dialect.words.rapid),
        number(&dialect.words.line),
        arcs.and_then(|arcs| number(&arcs.clockwise)),
        arcs.and_then(|arcs| number(&arcs.counter_clockwise)),
    ];
    own.iter().position(|own| *own == Some(code)).map_or(code as u8, |motion| motion as u8)
}

/// Returns the word by which a dialect selects the unit of a G word of LinuxCNC, if it has other words than G20 and G21.
pub(super) fn own_unit(dialect: &Dialect, is_inches: bool) -> Option<&'static str> {
    let mut words = dialect.program.setup.iter().flat_map(|line| line.split_whitespace());
    let found = words.find(|word| unit_word(word).is_some())?.to_ascii_uppercase();
    // With three digits, feeds have the unit too.
    Some(match (found.len() == "G710".len(), is_inches) {
        (true, false) => "G710",
        (true, true) => "G700",
        (false, false) => "G71",
        (false, true) => "G70",
    })
}

/// Returns the number of decimals of a coordinate: one more in inches.
pub(super) fn decimals(dialect: &Dialect, inches: bool) -> u8 {
    dialect.numbers.decimals + u8::from(inches)
}

/// Returns true if arcs of a dialect have absolute centres for the correction.
pub(super) fn has_absolute_centres(dialect: &Dialect) -> bool {
    dialect.arcs.as_ref().is_some_and(|arcs| arcs.centre != CentreWords::FromStart)
}

/// Returns a line without the number of its block.
fn without_number<'l>(line: &'l str, dialect: &Dialect) -> &'l str {
    let letter = dialect.blocks.as_ref().map_or("N", |blocks| blocks.letter.as_str());
    let Some(rest) =
        line.get(..letter.len()).filter(|begin| begin.eq_ignore_ascii_case(letter)).map(|_| &line[letter.len()..])
    else {
        return line;
    };
    let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
    if digits > 0 { rest[digits..].trim_start() } else { line }
}

/// Returns a text in capital letters and without blanks. G05 and G5 are one code, so zeros ahead of it are left out.
fn squeezed(text: &str) -> String {
    let plain: Vec<char> = text.chars().filter(|c| !c.is_whitespace()).map(|c| c.to_ascii_uppercase()).collect();
    let mut squeezed = String::with_capacity(plain.len());
    for (at, &c) in plain.iter().enumerate() {
        let is_code = matches!(squeezed.chars().last(), Some('G' | 'M'));
        let goes_on = plain.get(at + 1).is_some_and(char::is_ascii_digit);
        if !(c == '0' && is_code && goes_on) {
            squeezed.push(c);
        }
    }
    squeezed
}

/// Tells whether a text fits a line of the dialect, in which placeholders stand for any text.
fn fits(template: &str, text: &str) -> bool {
    const MARK: char = '\u{1}';
    let placeholders = [NAME, NUMBER, TOLERANCE].map(squeezed);
    let marked = placeholders.iter().fold(template.to_owned(), |line, name| line.replace(name, &MARK.to_string()));
    let pieces: Vec<&str> = marked.split(MARK).collect();
    let [first, ref others @ ..] = pieces[..] else { return false };
    let Some((last, middle)) = others.split_last() else { return first == text };
    let Some(rest) = text.strip_prefix(first).and_then(|rest| rest.strip_suffix(last)) else { return false };
    middle.iter().try_fold(rest, |rest, piece| rest.find(piece).map(|at| &rest[at + piece.len()..])).is_some()
}

/// Returns those words of a line of the dialect's file that the correction knows. The others select how exactly the
/// control follows the path.
fn known_words(code: &str) -> String {
    /// G words by their numbers.
    const KNOWN: [f64; 18] =
        [17.0, 18.0, 19.0, 20.0, 21.0, 40.0, 49.0, 54.0, 55.0, 56.0, 57.0, 58.0, 59.0, 80.0, 90.0, 94.0, 97.0, 98.0];
    let upper = code.to_ascii_uppercase();
    let known = upper.split_whitespace().filter_map(|token| {
        if let Some(unit) = unit_word(token) {
            return Some(unit);
        }
        let words = block(token).ok()?.words;
        let is_known = |letter: u8, value: f64| match letter {
            b'G' => KNOWN.contains(&value),
            b'M' => value == 2.0 || value == 30.0,
            _ => false,
        };
        words.iter().all(|word| is_known(word.letter, word.value)).then_some(token)
    });
    known.collect::<Vec<&str>>().join(" ")
}

/// Returns the word of LinuxCNC for a unit of Sinumerik.
fn unit_word(token: &str) -> Option<&'static str> {
    match token.to_ascii_uppercase().as_str() {
        "G710" | "G71" => Some("G21"),
        "G700" | "G70" => Some("G20"),
        _ => None,
    }
}

fn is_m_word(token: &str) -> bool {
    token.strip_prefix('M').is_some_and(|digits| !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit()))
}

/// Reads the words of a straight line in Klartext.
fn straight(tokens: &[&str]) -> Result<String, Refusal> {
    let (words, is_rapid) = axis_words(tokens)?;
    let moves = words.split(' ').any(|word| word.starts_with(['X', 'Y', 'Z']));
    Ok(match (moves, is_rapid) {
        (false, _) => words,
        (true, true) => format!("G0 {words}"),
        (true, false) => format!("G1 {words}"),
    })
}

/// Reads coordinates, feed and functions in Klartext. Returns them as words, and whether the move is rapid.
fn axis_words(tokens: &[&str]) -> Result<(String, bool), Refusal> {
    let (mut words, mut is_rapid) = (Vec::new(), false);
    for token in tokens {
        let (letter, number) = token.split_at_checked(1).unwrap_or((token, ""));
        let is_number = number.parse::<f64>().is_ok_and(f64::is_finite) && !number.contains(['E', 'e']);
        match (letter, *token) {
            (_, "R0") => {}
            (_, "FMAX") => is_rapid = true,
            ("X" | "Y" | "Z" | "F", _) if is_number => words.push((*token).to_owned()),
            ("A" | "B" | "C", _) if is_number => words.push((*token).to_owned()),
            _ if is_m_word(token) => words.push((*token).to_owned()),
            ("I", _) if token.len() > 1 => {
                return Err((format!("{token} is a distance from the last place"), "write absolute coordinates"));
            }
            (_, "RL" | "RR") => {
                let remedy = "let the CAM system write the path of the tool's centre (R0)";
                return Err((format!("{token} lets the control move the path by a radius"), remedy));
            }
            _ => return Err((format!("{token:?} is not known"), "write coordinates, R0, FMAX, F and M only")),
        }
    }
    Ok((words.join(" "), is_rapid))
}

/// Reads the centre of arcs in Klartext: the plane, and the words of the centre.
fn centre(tokens: &[&str]) -> Result<String, Refusal> {
    let refused =
        || (format!("the centre CC {} is not known", tokens.join(" ")), "write two of X, Y and Z with numbers");
    let [a, b] = *tokens else { return Err(refused()) };
    let (Some((a, a_number)), Some((b, b_number))) = (a.split_at_checked(1), b.split_at_checked(1)) else {
        return Err(refused());
    };
    let (plane, letters) = match (a, b) {
        ("X", "Y") => ("G17", ["I", "J"]),
        ("X", "Z") => ("G18", ["I", "K"]),
        ("Y", "Z") => ("G19", ["J", "K"]),
        _ => return Err(refused()),
    };
    let numbers = [a_number, b_number];
    if numbers.iter().any(|number| !number.parse::<f64>().is_ok_and(f64::is_finite)) {
        return Err(refused());
    }
    Ok(format!("{plane} {}{} {}{}", letters[0], numbers[0], letters[1], numbers[1]))
}
