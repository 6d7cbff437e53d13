//! Results as DMIS output (ISO 22093): the actual points of features, `FA(P17) = FEAT/POINT,CART,x,y,z,i,j,k`.
//!
//! A statement ends with its line unless the line ends with `$`; `$$` begins a comment. `UNITS` gives the unit and must
//! come before the first point. Text that a program wrote with `TEXT/OUTFIL` states what the file belongs to, such as
//! `'plan: 5f3c...'`. `PRCOMP/ON` means that the machine has compensated the radius of the probe. `PRCOMP/OFF` means
//! that it has not.

use std::path::Path;

use regrind_core::geometry::Point;

use super::error::{FormatError, excerpt};
use super::number::is_believable;
use super::result_content::{Content, ResultFile, Statements};

/// Maximum number of points that are read.
const MAX_POINTS: usize = 5_000_000;
/// Millimetres per inch.
const INCH_MM: f64 = 25.4;
/// Words that begin a DMIS file.
const BEGINNINGS: [&[u8]; 5] = [b"DMISMN/", b"DMISMD/", b"FILNAM/", b"UNITS/", b"$$"];

/// Returns true if `head`, the beginning of a file, starts with a DMIS statement or a DMIS comment (`$$`). Blanks and a
/// byte order mark before it are ignored.
pub(super) fn is_dmis(head: &[u8]) -> bool {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    BEGINNINGS.iter().any(|word| head.get(..word.len()).is_some_and(|begins| begins.eq_ignore_ascii_case(word)))
}

/// Words that begin a line of DMIS, and not of a table with a line of DMIS above it, such as `UNITS/INCH`.
const STATEMENTS: [&[u8]; 5] = [b"DMISMN/", b"DMISMD/", b"FILNAM/", b"OUTPUT/", b"ENDFIL"];

/// Returns true if `head`, the beginning of a file, is that of a DMIS file. A table with a line of DMIS above it is none.
pub(super) fn is_dmis_file(head: &[u8]) -> bool {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    let begins =
        |line: &[u8], word: &[u8]| line.get(..word.len()).is_some_and(|begin| begin.eq_ignore_ascii_case(word));
    let is_feature = |line: &[u8]| {
        let kind = line.iter().position(|b| *b == b'=').map(|at| line[at + 1..].trim_ascii_start());
        (begins(line, b"FA(") || begins(line, b"F(")) && kind.is_some_and(|kind| begins(kind, b"FEAT/"))
    };
    let is_statement = |line: &[u8]| is_feature(line) || STATEMENTS.iter().any(|word| begins(line, word));
    let mut lines = head.split(|b| *b == b'\n').map(<[u8]>::trim_ascii).filter(|line| !line.is_empty());
    lines.next().is_some_and(|first| is_statement(first) || is_dmis(first) && lines.any(is_statement))
}

/// Statement, joined into one line, and the number of the line where it began.
struct Statement {
    text: String,
    line: u64,
}

/// Content of the statements that were read so far.
#[derive(Default)]
struct Reading {
    unit_mm: Option<f64>,
    points: Vec<Point>,
    names: Vec<String>,
    /// True if there is a nominal feature, `F(...) = FEAT`.
    has_nominal: bool,
    statements: Statements,
    is_ended: bool,
    /// True if another coordinate system was defined or recalled behind a point.
    is_frame_changed: bool,
}

/// Reads the general statements of a DMIS file about its measurement, such as the plan, the cycle and the kind of
/// coordinates. The points are not returned. `text` is the content of the file, and `path` only names the file in
/// messages.
///
/// # Errors
/// Those of [`parse`], except that a file without points is accepted.
pub(super) fn read_statements(path: &Path, text: &[u8]) -> Result<Statements, FormatError> {
    read(path, text).map(|reading| reading.statements)
}

/// Reads the points of a DMIS file, in mm, with their names. `text` is the content of the file, and `path` only names
/// the file in messages.
///
/// The file can state whether its coordinates are centres of the probe ball or contact points. If it does not, the
/// setting in `content` is used.
///
/// # Errors
/// A file without `ENDFIL`, without a point or with nominal features alone, or without `UNITS` before its first point; a
/// point that is not cartesian or has text in place of a number; a statement with an impossible value.
pub(super) fn parse(path: &Path, text: &[u8], content: &Content) -> Result<ResultFile, FormatError> {
    let Reading { points, names, statements, has_nominal, .. } = read(path, text)?;
    if points.is_empty() && has_nominal {
        return Err(FormatError::WrongKind {
            path: path.to_owned(),
            expected: "DMIS output with actual points, FA(...) = FEAT/POINT",
            found: "DMIS with nominal features alone, F(...) = FEAT, such as a program",
            remedy: "give the output that the program writes",
        });
    }
    if points.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "actual points, FA(...) = FEAT/POINT" });
    }
    let indices: Option<Vec<u32>> = names.iter().map(|name| index_of(name)).collect();
    Ok(ResultFile {
        points,
        indices,
        names: Some(names),
        coordinates: statements.coordinates.or(content.coordinates),
        probe_radius_mm: statements.probe_radius_mm,
        statements,
        ..ResultFile::default()
    })
}

/// Returns the number of the target in the measuring plan, from the name of its feature: 17 for `P17`. Returns `None`
/// for a name of any other form.
pub(super) fn index_of(name: &str) -> Option<u32> {
    let digits = name.trim().strip_prefix(['P', 'p'])?;
    digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok()).flatten()
}

fn read(path: &Path, text: &[u8]) -> Result<Reading, FormatError> {
    if let Some(at) = text.iter().position(|b| *b == 0) {
        let line = text[..at].iter().filter(|b| **b == b'\n').count() as u64 + 1;
        return Err(FormatError::NotText { path: path.to_owned(), line, value: 0 });
    }
    let mut reading = Reading::default();
    for statement in statements(&String::from_utf8_lossy(text)) {
        reading.read_statement(path, &statement)?;
    }
    if !reading.is_ended {
        let place = format!("line {}", text.split(|b| *b == b'\n').count());
        return Err(FormatError::Cut { path: path.to_owned(), place, expected: "ENDFIL at the end".to_owned() });
    }
    Ok(reading)
}

/// Splits the text of a DMIS file into statements. A `$` at the end of a line joins it to the next line. Comments are
/// omitted.
fn statements(text: &str) -> Vec<Statement> {
    let (mut all, mut begun): (Vec<Statement>, Option<Statement>) = (Vec::new(), None);
    for (line, number) in text.lines().zip(1..) {
        let line = line.trim_start_matches('\u{feff}').trim();
        if line.starts_with("$$") || line.is_empty() {
            continue;
        }
        let (part, goes_on) = match line.strip_suffix('$') {
            Some(part) => (part.trim_end(), true),
            None => (line, false),
        };
        let statement = begun.get_or_insert_with(|| Statement { text: String::new(), line: number });
        statement.text.push_str(part);
        if !goes_on {
            all.extend(begun.take());
        }
    }
    all.extend(begun);
    all
}

impl Reading {
    fn read_statement(&mut self, path: &Path, statement: &Statement) -> Result<(), FormatError> {
        let text = statement.text.as_str();
        let (before, after) = text.split_once('/').unwrap_or((text, ""));
        let keyword = before.trim().to_ascii_uppercase();
        if self.is_ended {
            return Err(unexpected(path, statement, "nothing behind ENDFIL: one measurement in a file", text));
        }
        if changes_frame(&keyword, after) {
            self.is_frame_changed = !self.points.is_empty();
        }
        match keyword.as_str() {
            "UNITS" => self.unit(path, statement, after),
            "PRCOMP" => {
                let is_on = after.trim().eq_ignore_ascii_case("ON");
                self.say(path, statement, "coordinates", if is_on { "contacts" } else { "centres" })
            }
            "TEXT" => self.written(path, statement, after),
            "ENDFIL" => {
                self.is_ended = true;
                Ok(())
            }
            _ if keyword.starts_with("FA(") && keyword.contains('=') => self.actual(path, statement, before, after),
            _ if keyword.starts_with("F(") && keyword.contains('=') => {
                self.has_nominal = true;
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn unit(&mut self, path: &Path, statement: &Statement, after: &str) -> Result<(), FormatError> {
        let unit = after.split(',').next().unwrap_or_default().trim().to_ascii_uppercase();
        let unit_mm = match unit.as_str() {
            "MM" => 1.0,
            "CM" => 10.0,
            "M" => 1000.0,
            "INCH" => INCH_MM,
            "FEET" => 12.0 * INCH_MM,
            _ => return Err(unexpected(path, statement, "a unit of length: MM, CM, M, INCH or FEET", &unit)),
        };
        if self.unit_mm.is_some_and(|before| before != unit_mm) && !self.points.is_empty() {
            return Err(unexpected(path, statement, "one unit for all points", &unit));
        }
        self.unit_mm = Some(unit_mm);
        Ok(())
    }

    /// Reads the property in `after`, and stores its value in `self`. `after` is the text that follows `TEXT/` in a
    /// DMIS statement, such as `OUTFIL,'plan: 5f3c...'`. The measuring program writes the properties of the measurement
    /// in this way. The text in quotes has the form `key: value`. A text without quotes, without a colon or with an
    /// unknown key is ignored.
    ///
    /// `statement` is the complete statement. It and `path` only give the position of an error.
    ///
    /// # Errors
    /// An impossible value; a kind of coordinates (centres or contacts) that contradicts an earlier statement.
    fn written(&mut self, path: &Path, statement: &Statement, after: &str) -> Result<(), FormatError> {
        let quoted = after.split_once('\'').and_then(|(_, rest)| rest.rsplit_once('\''));
        match quoted.and_then(|(text, _)| text.split_once(':')) {
            Some((key, value)) => self.say(path, statement, key, value.trim()),
            None => Ok(()),
        }
    }

    fn say(&mut self, path: &Path, statement: &Statement, key: &str, value: &str) -> Result<(), FormatError> {
        let before = self.statements.coordinates;
        self.statements.read_statement(path, statement.line, key, value)?;
        if before.is_some() && before != self.statements.coordinates {
            return Err(unexpected(path, statement, "one kind of coordinates in a file, centres or contacts", value));
        }
        Ok(())
    }

    fn actual(&mut self, path: &Path, statement: &Statement, before: &str, after: &str) -> Result<(), FormatError> {
        let kind = before.rsplit_once('=').map_or("", |(_, kind)| kind).trim();
        let mut fields = after.split(',').map(str::trim);
        let is_point =
            kind.eq_ignore_ascii_case("FEAT") && fields.next().is_some_and(|f| f.eq_ignore_ascii_case("POINT"));
        if !is_point {
            return Ok(()); // An actual of another feature, or none of its coordinates.
        }
        let coordinates = fields.next().unwrap_or_default();
        if !coordinates.eq_ignore_ascii_case("CART") {
            return Err(unexpected(path, statement, "cartesian coordinates (CART)", coordinates));
        }
        let unit_mm =
            self.unit_mm.ok_or_else(|| unexpected(path, statement, "UNITS above the first point", &statement.text))?;
        let fields: Vec<&str> = fields.collect();
        // The three numbers of a direction follow; they must not replace a missing coordinate.
        if !matches!(fields.len(), 3 | 6) {
            let found = format!("{} numbers", fields.len());
            return Err(unexpected(path, statement, "3 numbers after CART, or 6 with a direction", &found));
        }
        let mut at_mm = [0.0; 3];
        for (value, field) in at_mm.iter_mut().zip(&fields) {
            let number =
                field.parse::<f64>().ok().map(|number| number * unit_mm).filter(|number| is_believable(*number));
            *value = number.ok_or_else(|| unexpected(path, statement, "a coordinate", field))?;
        }
        if self.points.len() == MAX_POINTS {
            let (found, limit) = (MAX_POINTS as u64 + 1, MAX_POINTS as u64);
            return Err(FormatError::TooLarge { path: path.to_owned(), found, limit, unit: "points" });
        }
        if self.is_frame_changed {
            let expected =
                "all points in one coordinate system; export the points of each system in a file of their own";
            return Err(unexpected(
                path,
                statement,
                expected,
                "points behind a change of the system (D, DA or RECALL)",
            ));
        }
        let name = before.split_once('(').and_then(|(_, rest)| rest.split_once(')')).map_or("", |(name, _)| name);
        self.points.push(Point::from(at_mm));
        self.names.push(name.trim().to_owned());
        Ok(())
    }
}

/// Returns true for a statement that defines or recalls a coordinate system, which the points behind it are in.
fn changes_frame(keyword: &str, after: &str) -> bool {
    let is_system = |label: &str| label.starts_with("D(") || label.starts_with("DA(");
    (is_system(keyword) && keyword.contains('='))
        || (keyword == "RECALL" && is_system(&after.trim().to_ascii_uppercase()))
}

fn unexpected(path: &Path, statement: &Statement, expected: &str, found: &str) -> FormatError {
    FormatError::Unexpected {
        path: path.to_owned(),
        place: format!("line {}", statement.line),
        expected: expected.to_owned(),
        found: excerpt(found.as_bytes()),
    }
}

#[cfg(test)]
mod tests {
    use super::super::result::{Coordinates, parse_result};
    use super::*;

    const PLAN: &str = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff";

    fn parsed(text: &str) -> Result<ResultFile, FormatError> {
        parse_result(Path::new("SN-7_c2.res"), text.as_bytes(), &Content::default())
    }

    fn file() -> String {
        format!(
            "FILNAM/'SN-7'\n$$ a comment\nUNITS/MM, ANGDEC\nTEXT/OUTFIL,'part: SN-7'\nTEXT/OUTFIL,'cycle: 2'\n\
             TEXT/OUTFIL,'plan: {PLAN}'\nPRCOMP/OFF\nOUTPUT/FA(P7)\nFA(P7) = FEAT/POINT, CART,  $\n  1.50000, -2.25000, 3.00000, 0.0, 0.0, 1.0\n\
             FA(A_CIRCLE) = FEAT/CIRCLE,INNER,CART,50.0,50.0,40.0,0.0,0.0,1.0,50.0\nFA(P9)=FEAT/POINT,CART,4,5,6,0,0,1\nENDFIL\n"
        )
    }

    #[test]
    fn dmis_reads_points_and_targets() {
        let found = parsed(&file()).unwrap();
        assert_eq!(found.points, [Point::new(1.5, -2.25, 3.0), Point::new(4.0, 5.0, 6.0)]);
        assert_eq!((found.indices.as_deref(), found.coordinates), (Some(&[7, 9][..]), Some(Coordinates::Centres)));
        let says = &found.statements;
        assert_eq!((says.part.as_deref(), says.cycle, says.plan.as_deref()), (Some("SN-7"), Some(2), Some(PLAN)));
        let inches = parsed(&file().replace("UNITS/MM", "UNITS/INCH")).unwrap();
        assert_eq!(inches.points[1], Point::new(4.0 * 25.4, 5.0 * 25.4, 6.0 * 25.4));
        assert_eq!(
            parsed(&file().replace("PRCOMP/OFF", "PRCOMP/ON")).unwrap().coordinates,
            Some(Coordinates::Contacts)
        );
        // A feature name that is not a target's leaves only the order to identify the target.
        assert_eq!(parsed(&file().replace("FA(P9)", "FA(TOP)")).unwrap().indices, None);
    }

    #[test]
    fn dmis_reads_actual_points_alone() {
        let nominal = "F(P7)=FEAT/POINT,CART,91,92,93,0,0,1\nFA(P7) =";
        let found = parsed(&file().replace("FA(P7) =", nominal)).unwrap();
        assert_eq!(found.points, parsed(&file()).unwrap().points);
        let alone = "UNITS/MM\nF(P7)=FEAT/POINT,CART,91,92,93,0,0,1\nOUTPUT/FA(P7)\nENDFIL\n";
        assert!(matches!(parsed(alone), Err(FormatError::WrongKind { .. })));
        assert!(matches!(parsed("UNITS/MM\nENDFIL\n"), Err(FormatError::NoData { .. })));
    }

    #[test]
    fn points_of_another_frame_are_refused() {
        let point = "FA(P8)=FEAT/POINT,CART,1,2,3\n";
        let with = |between: &str| parsed(&file().replace("ENDFIL", &format!("{between}\n{point}ENDFIL")));
        let points = with("$$ nothing").unwrap().points.len();
        for change in ["D(2)=TRANS/XORIG,100", "DA(2)=ROTATE/ZAXIS,90", "RECALL/DA(2)", "recall/ d(2)"] {
            assert!(matches!(with(change), Err(FormatError::Unexpected { .. })), "{change}");
            // Ahead of all points, and behind them, it changes none.
            let ahead = file().replace("UNITS/", &format!("{change}\nUNITS/"));
            assert_eq!(parsed(&ahead).unwrap().points.len() + 1, points, "{change}");
            let behind = file().replace("ENDFIL", &format!("{change}\nENDFIL"));
            assert_eq!(parsed(&behind).unwrap().points.len() + 1, points, "{change}");
        }
        let joined = file() + &file();
        assert!(matches!(parsed(&joined), Err(FormatError::Unexpected { .. })));
    }

    #[test]
    fn dmis_files_are_told_from_tables() {
        for head in [
            "DMISMN/'p', 05.2\n",
            "\u{feff}\r\nfilnam/'SN-7'\r\n",
            "UNITS/MM\nFA(P7) = FEAT/POINT,CART,1,2,3\n",
            "$$ made by a program\nunits/mm\nENDFIL\n",
            "F(P7)=FEAT/POINT,CART,1,2,3\n",
        ] {
            assert!(is_dmis_file(head.as_bytes()), "{head}");
        }
        for head in
            ["UNITS/INCH\nx,y,z\n1,2,3\n", "$$ points\n1,2,3\n", "F(x) = 3 z\n1,2,3\n", "DIM LOC1= LOCATION\n", ""]
        {
            assert!(!is_dmis_file(head.as_bytes()), "{head}");
        }
    }

    #[test]
    fn dmis_errors_name_their_line() {
        for (of, with, reason) in [
            ("ENDFIL\n", "", "expected ENDFIL at the end"),
            ("UNITS/MM, ANGDEC\n", "", "line 8: expected UNITS above the first point"),
            ("UNITS/MM", "UNITS/FURLONG", "line 3: expected a unit of length"),
            ("4,5,6", "4,5", "line 12: expected 3 numbers after CART, or 6 with a direction, found `5 numbers`"),
            ("4,5,6", "4,NaN,6", "line 12: expected a coordinate, found `NaN`"),
            ("4,5,6", "4,1e9,6", "found `1e9`"),
            ("POINT,CART,4", "POINT,POL,4", "line 12: expected cartesian"),
            ("cycle: 2", "cycle: two", "`cycle` is `two`"),
            ("OUTPUT/FA(P7)", "PRCOMP/ON", "one kind of coordinates"),
        ] {
            let text = file().replace(of, with);
            assert_ne!(text, file());
            let error = parsed(&text).unwrap_err().to_string();
            assert!(error.contains(reason), "{with:?}: {error}");
        }
    }
}
