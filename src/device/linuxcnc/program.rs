//! The program as the controller runs it: the program of the pass in a frame that records its progress.
//!
//! linuxcncrsh knows no jobs. It reports that a program runs, but not if one ran to its end. So the program reports
//! this itself: it appends a line to its own file, the record, when it begins and when its last motion has ended. Its
//! file name is derived from its content. Before that, the driver has the controller open the record with a token of
//! this preparation. Reading that token back proves that both see one folder, and that no line of the record is from an
//! earlier preparation.

use data_encoding::HEXLOWER;
use sha2::{Digest, Sha256};

/// Maximum length of a path; LinuxCNC reads lines of 255 characters.
const MAX_PATH_LENGTH: usize = 220;
/// Maximum length of the run's part of a name.
const MAX_RUN_LENGTH: usize = 60;

/// Program in its frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FramedProgram {
    /// Name that identifies run, cycle and content, without an extension.
    pub name: String,
    /// Cycle whose correction the program grinds; it is the pass of the next cycle.
    pub cycle: u32,
    /// Content of the file.
    pub text: Vec<u8>,
    /// First line of the pass in the file, counted from 1, and the number of its lines.
    pub lines: (u32, u32),
    /// Number of times that the pass is run.
    pub rounds: u32,
    /// Identity of the map that the program grinds.
    pub map: [u8; 32],
}

/// Inputs of a program.
#[derive(Clone, Copy, Debug)]
pub struct ProgramInputs<'a> {
    /// Name of the run, as in file names.
    pub run: &'a str,
    /// Cycle whose correction it is.
    pub cycle: u32,
    /// Program of the pass.
    pub pass: &'a [u8],
    /// Identity of the map that the program must be for.
    pub map: &'a [u8; 32],
    /// Number of times that the pass is run: one, plus one for each spark-out.
    pub rounds: u32,
    /// Folder of programs, as the controller sees it.
    pub folder: &'a str,
}

impl FramedProgram {
    /// Builds the program that the controller runs: the program of the pass, its repetitions, and lines that log its
    /// begin and its end.
    ///
    /// # Errors
    /// Returns the reason, as text, why the program must not be run.
    pub fn frame(order: ProgramInputs<'_>) -> Result<Self, String> {
        let body = body(order.pass, order.map)?;
        let mut content = Sha256::new();
        content.update(order.pass);
        content.update(order.rounds.to_be_bytes());
        let name = name_begins(order.run, order.cycle) + &HEXLOWER.encode(&content.finalize()[..8]);
        let record = path(order.folder, &name, RECORD);
        if record.len() > MAX_PATH_LENGTH {
            return Err(format!(
                "the path of the .log file is longer than {MAX_PATH_LENGTH} characters: {record}; use a folder with a shorter path"
            ));
        }
        let says = |word: &str| format!("(LOGAPPEND,{record})\n(LOG,{word})\n(LOGCLOSE)\n");
        let (repeat, again) = match order.rounds {
            0 | 1 => (String::new(), ""),
            rounds => (format!("{REPEAT}{rounds}]\n"), "o<regrind> endrepeat\n"),
        };
        let head = format!("({name})\n{}{repeat}", says(BEGIN));
        // The interpreter reads ahead of the motion. Reading an input makes it wait for all earlier motion; then the
        // end is logged.
        let tail = format!("{again}M66 P0 L0\n{}M2\n", says(END));
        let count = |text: &str| text.bytes().filter(|byte| *byte == b'\n').count() as u32;
        let lines = (count(&head) + 1, count(body).max(1));
        let text = [head.as_bytes(), body.as_bytes(), tail.as_bytes()].concat();
        Ok(Self { name, cycle: order.cycle, text, lines, rounds: order.rounds.max(1), map: *order.map })
    }

    /// Parses the complete program that [`FramedProgram::frame`] built in an earlier process. `name` is the file name
    /// without an extension, and `cycle` is the cycle of the program. Returns `None` if `text` has no valid map
    /// identity or too few lines, or is not UTF-8.
    pub(super) fn read(name: &str, cycle: u32, text: Vec<u8>) -> Option<Self> {
        let whole = std::str::from_utf8(&text).ok()?;
        let repeat = whole.lines().nth(4).and_then(|line| line.strip_prefix(REPEAT)?.strip_suffix(']')?.parse().ok());
        let map = whole.lines().find_map(|line| line.strip_prefix(MAP_COMMENT)?.strip_suffix(')'))?;
        let identity: [u8; 32] = HEXLOWER.decode(map.as_bytes()).ok()?.try_into().ok()?;
        let repeats = u32::from(repeat.is_some());
        let (head, tail) = (4 + repeats, 5 + repeats);
        let count = (whole.lines().count() as u32).checked_sub(head + tail)?;
        let (lines, rounds) = ((head + 1, count), repeat.unwrap_or(1));
        Some(Self { name: name.to_owned(), cycle, lines, rounds, map: identity, text })
    }

    /// Returns the progress within one run of the pass in thousandths, from 0 to 1000. `line` is the line of the
    /// program file that the controller executes, counted from 1.
    pub(super) fn thousandths(&self, line: u32) -> u32 {
        let (first, count) = self.lines;
        let done = line.saturating_sub(first).min(count);
        u32::try_from(u64::from(done) * 1000 / u64::from(count.max(1))).unwrap_or(1000)
    }
}

/// Returns the first part of the file name that all programs of a cycle have in common: the name of the run and the
/// cycle number. Replaces characters of `run` other than ASCII letters, digits, `-` and `_` by `_`, and uses at most 60
/// characters of `run`.
pub(super) fn name_begins(run: &str, cycle: u32) -> String {
    let run: String = run.chars().map(plain).take(MAX_RUN_LENGTH).collect();
    format!("{run}-c{cycle}-")
}

/// Extensions of a program and of its record.
pub(super) const PROGRAM: &str = "ngc";
pub(super) const RECORD: &str = "log";
const PREPARED: &str = "prepared";
const BEGIN: &str = "begin";
const END: &str = "end";
const REPEAT: &str = "o<regrind> repeat [";
const MAP_COMMENT: &str = "(map: sha256 ";

/// Returns the path `folder/name.extension` of a file at the controller. `folder` is the folder of programs as the
/// controller sees it. The separator is always `/`, because the controller is always a Unix system.
pub(super) fn path(folder: &str, name: &str, extension: &str) -> String {
    format!("{}/{name}.{extension}", folder.trim_end_matches('/'))
}

/// Returns three lines of G-code (log comments) for the controller. They create the new log file with the path
/// `record`, write `token` into it as eight hexadecimal digits, and close it.
pub(super) fn opening(record: &str, token: u32) -> [String; 3] {
    [format!("(LOGOPEN,{record})"), format!("(LOG,{PREPARED} {token:08x})"), "(LOGCLOSE)".to_owned()]
}

fn plain(c: char) -> char {
    if c.is_ascii_alphanumeric() || matches!(c, '-' | '_') { c } else { '_' }
}

/// Checks the program `pass` and returns its text without the final M2 (end of program). `map` is the SHA-256 identity
/// of the correction map for which the program must be made.
///
/// # Errors
/// Returns the reason as text if the program is not ASCII, is for another map, does not set its path mode and path
/// tolerance, does not end with M2, or contains M2, M30 or % before its end.
fn body<'a>(pass: &'a [u8], map: &[u8; 32]) -> Result<&'a str, String> {
    let text = std::str::from_utf8(pass).ok().filter(|text| text.is_ascii()).ok_or("the program is not plain text")?;
    let of_map = format!("{MAP_COMMENT}{})", HEXLOWER.encode(map));
    if !text.lines().any(|line| line.trim() == of_map) {
        return Err(format!("the program does not belong to the map {}", HEXLOWER.encode(&map[..4])));
    }
    let code = text.lines().map(code).filter(|words| !words.is_empty());
    let code: Vec<Vec<&str>> = code.collect();
    check_mode(&code)?;
    let body = text.trim_end().strip_suffix("M2").ok_or("the program does not end with M2")?;
    match body.ends_with('\n')
        && !code[..code.len() - 1].iter().flatten().any(|word| matches!(*word, "M2" | "M30" | "%"))
    {
        true => Ok(body),
        false => Err("the program has M2, M30 or % before its last line".to_owned()),
    }
}

/// Returns the words of a line of G-code, without comments.
fn code(line: &str) -> Vec<&str> {
    let line = line.split([';', '(']).next().unwrap_or_default();
    line.split_whitespace().collect()
}

/// Checks that a program sets its path mode (G61, G61.1, or G64 with a tolerance P) before its first motion. `code`
/// contains the words of each line. The check is necessary because LinuxCNC starts with G64 without a tolerance, which
/// rounds corners by a tenth of a millimetre.
///
/// # Errors
/// Returns the reason as text if the path mode is missing or set too late, or if G64 has no tolerance.
fn check_mode(code: &[Vec<&str>]) -> Result<(), String> {
    let mut says = false;
    for words in code {
        let has = |word: &str| words.iter().any(|w| w.eq_ignore_ascii_case(word));
        if has("G64") && !words.iter().any(|w| w.starts_with(['P', 'p'])) {
            return Err("the program sets G64 without a tolerance (P): corners are rounded without a limit".to_owned());
        }
        says |= has("G61") || has("G61.1") || has("G64");
        let moves = words.iter().any(|w| w.starts_with(['X', 'Y', 'Z', 'x', 'y', 'z']));
        if moves && !says {
            return Err("the program moves before the path mode is set (G61, G61.1, or G64 with P)".to_owned());
        }
    }
    match says {
        true => Ok(()),
        false => Err("the program does not set the path mode (G61, G61.1, or G64 with P)".to_owned()),
    }
}

/// Record that a program wrote.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProgramRecord {
    /// Token of the preparation that opened the record.
    pub token: Option<u32>,
    /// Number of times that the program began.
    pub begun: u32,
    /// Number of times that its last motion ended.
    pub ended: u32,
}

impl ProgramRecord {
    /// Parses the text of a log file that a program wrote. Returns the token of the preparation, and how often the
    /// program began and ended. Ignores unknown lines and an incomplete last line.
    pub fn read(text: &str) -> Self {
        let mut record = Self::default();
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        for line in whole.lines().map(str::trim) {
            match line.split_once(' ') {
                Some((PREPARED, token)) => record.token = u32::from_str_radix(token, 16).ok(),
                None if line == BEGIN => record.begun += 1,
                None if line == END => record.ended += 1,
                _ => {}
            }
        }
        record
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAP: [u8; 32] = [7; 32];

    fn pass(mode: &str, end: &str) -> String {
        format!("(part: x)\n(map: sha256 {})\nG21 G90\n{mode}\nG0 Z5\nG1 X1 Y2 F600\n{end}", HEXLOWER.encode(&MAP))
    }

    fn frame(pass: &str, rounds: u32) -> Result<FramedProgram, String> {
        let order =
            ProgramInputs { run: "A part/1", cycle: 2, pass: pass.as_bytes(), map: &MAP, rounds, folder: "/srv/nc/" };
        FramedProgram::frame(order)
    }

    #[test]
    fn framed_program_logs_begin_and_end() {
        let pass = pass("G64 P0.0001 Q0", "M2\n");
        let framed = frame(&pass, 1).unwrap();
        let text = String::from_utf8(framed.text.clone()).unwrap();
        let name = &framed.name;
        assert!(name.starts_with("A_part_1-c2-") && name.len() == "A_part_1-c2-".len() + 16, "{name}");
        let says = |word: &str| format!("(LOGAPPEND,/srv/nc/{name}.log)\n(LOG,{word})\n(LOGCLOSE)\n");
        let body = pass.strip_suffix("M2\n").unwrap();
        assert_eq!(text, format!("({name})\n{}{body}M66 P0 L0\n{}M2\n", says("begin"), says("end")));
        let (first, count) = framed.lines;
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines[first as usize - 1], "(part: x)");
        assert_eq!(lines[(first + count) as usize - 2], "G1 X1 Y2 F600");
        assert_eq!([first, first + 3, first + count + 4].map(|line| framed.thousandths(line)), [0, 500, 1000]);
    }

    #[test]
    fn framed_program_round_trip() {
        for rounds in [1, 2, 30] {
            let framed = frame(&pass("G61", "M2\n"), rounds).unwrap();
            assert_eq!(FramedProgram::read(&framed.name, 2, framed.text.clone()), Some(framed));
        }
        assert_eq!(FramedProgram::read("x", 1, b"M2\n".to_vec()), None);
    }

    #[test]
    fn spark_out_repeats_framed_program() {
        let pass = pass("G61", "M2\n");
        let (once, thrice) = (frame(&pass, 1).unwrap(), frame(&pass, 3).unwrap());
        assert_ne!(once.name, thrice.name);
        let text = String::from_utf8(thrice.text).unwrap();
        assert!(text.contains("(LOGCLOSE)\no<regrind> repeat [3]\n(part: x)\n"), "{text}");
        assert!(text.contains("F600\no<regrind> endrepeat\nM66 P0 L0\n"), "{text}");
    }

    #[test]
    fn frame_requires_path_control_mode() {
        for (mode, end) in [
            ("", "M2\n"),
            ("G64", "M2\n"),
            ("(G61)", "M2\n"),
            ("G1 X3\nG61", "M2\n"),
            ("G61\nG64", "M2\n"),
            ("G61", ""),
            ("G61", "M2\nG1 X4\n"),
            ("G61\nM2", "M2\n"),
            ("G61", "M2 X\n"),
        ] {
            assert!(frame(&pass(mode, end), 1).is_err(), "{mode:?} {end:?}");
        }
        for mode in ["G61", "G61.1", "G64 P0.001", "G64 P0.0001 Q0"] {
            assert!(frame(&pass(mode, "M2\n"), 1).is_ok(), "{mode}");
        }
        let other = pass("G61", "M2\n").replace("0707", "0708");
        assert!(frame(&other, 1).is_err());
    }

    #[test]
    fn program_record_ignores_partial_line() {
        let read = ProgramRecord::read;
        assert_eq!(read(""), ProgramRecord::default());
        assert_eq!(read("prepared 0000002a\nbegin"), ProgramRecord { token: Some(42), begun: 0, ended: 0 });
        assert_eq!(read("prepared 0000002a\nbegin\nen"), ProgramRecord { token: Some(42), begun: 1, ended: 0 });
        assert_eq!(read("prepared 0000002a\r\nbegin\nend\n"), ProgramRecord { token: Some(42), begun: 1, ended: 1 });
        assert_eq!(read("prepared x\nbeginning\nthe end\n"), ProgramRecord::default());
    }
}
