//! Result file of a measurement: points, and what the file states about its measurement (part, plan, cycle, probe).
//!
//! Any point file that the library reads is accepted. The file can also make statements in comments above the points:
//!
//! ```text
//! # part: SN-0042          # cycle: 2              # plan: 5f3c... (the identity from plan.json)
//! # coordinates: centres   # units: mm             # probe radius mm: 1.5     # temperature c: 20.1
//! ```
//!
//! and in columns with a header: `index` (the number of the plan's target), `enabled` (rows marked as unchecked are
//! skipped, as laser trackers export them), `probe` (the *diameter* of a tracker's reflector in mm) or
//! `probe_radius_mm`, and `name` or `feature`.
//!
//! Points in QIF (`QIFDocument`) or DMIS output are accepted too; `qif.rs` and `dmis.rs` describe the statements of
//! these formats.
//!
//! A map of an interferometer or profilometer (X3P, SDF, MetroPro) makes no statements. Its measured samples are points
//! of contact, in millimetres whatever the unit of other files.

use std::path::Path;

use super::columns::Table;
use super::error::excerpt;
use super::height_map::MapPoints;
use super::layout::{Fields, Layout, Preamble, is_comment};
use super::measured_map::map_format;
use super::number::{Decimal, coordinate};
use super::points::parse_points_with;
use super::unit::Unit;
use super::{FormatError, dmis, ply, qif, whole};
pub use crate::result_content::{Content, Coordinates, DecimalMark, ResultFile, Statements};

/// Largest result file that is read, in bytes.
pub(super) const MAX_BYTES: u64 = 512 << 20;
/// Bytes at the beginning of a file in which statements are searched.
const PREAMBLE_BYTES: usize = 64 << 10;

/// Checks that the last line of `text`, a result file, has a line end. If the line end is missing, the file may be cut
/// within its last number. Formats that have another end mark (PLY, maps, QIF, DMIS) are always accepted. `path` only
/// names the file in messages.
///
/// # Errors
/// A last line without a line end.
pub fn check_ended(path: &Path, text: &[u8]) -> Result<(), FormatError> {
    // An XML or DMIS document has its own end mark.
    let is_document = ply::is_ply(text) || map_format(text).is_some() || qif::is_xml(text) || dmis::is_dmis(text);
    if is_document || text.ends_with(b"\n") {
        return Ok(());
    }
    let line = text.split(|&b| b == b'\n').count() as u64;
    let found = excerpt(text.rsplit(|&b| b == b'\n').next().unwrap_or_default());
    Err(FormatError::CutLine { path: path.to_owned(), line, found })
}

/// Reads all bytes of a result file.
///
/// # Errors
/// A file that cannot be read, or that is larger than 512 MiB.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>, FormatError> {
    whole::open(path)?.read_all(path, MAX_BYTES)
}

/// Reads the properties of the measurement that a result file states, such as the part and the cycle. Does not read the
/// points. `text` is the content of the file. `path` only names the file in messages.
///
/// # Errors
/// A property with an impossible value; a QIF or DMIS file that is not valid.
pub fn read_statements(path: &Path, text: &[u8]) -> Result<Statements, FormatError> {
    if map_format(text).is_some() {
        return Ok(Statements { coordinates: Some(Coordinates::Contacts), ..Statements::default() });
    }
    if qif::is_xml(text) {
        return qif::read_statements(path, text);
    }
    if dmis::is_dmis(text) {
        return dmis::read_statements(path, text);
    }
    let head = &text[..text.len().min(PREAMBLE_BYTES)];
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    let is_ply = ply::is_ply(head);
    let mut found = Statements::default();
    for (line, number) in head.split(|&b| b == b'\n').zip(1..) {
        let line = String::from_utf8_lossy(line.trim_ascii()).into_owned();
        let comment = match (is_ply, line.strip_prefix("comment ")) {
            (true, Some(comment)) => comment,
            (true, None) if line == "end_header" => break,
            (false, _) if is_comment(line.as_bytes()) => line.trim_start_matches(['#', '/']),
            // Statements are above the points; a header can be between them.
            (false, _) if line.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c)) => break,
            _ => continue,
        };
        if let Some((key, value)) = comment.split_once([':', '=']) {
            found.read_statement(path, number, key, value.trim())?;
        }
    }
    Ok(found)
}

impl Statements {
    /// Stores `value`, the text that a result file gives for the property `key`, such as `cycle`. Does nothing if `key`
    /// is not a known property, because the line is then a comment. `line` is the line number.
    ///
    /// # Errors
    /// A value that is impossible for this property.
    pub(super) fn read_statement(&mut self, path: &Path, line: u64, key: &str, value: &str) -> Result<(), FormatError> {
        let wrong = |key, expected| FormatError::Statement {
            path: path.to_owned(),
            line,
            key,
            found: excerpt(value.as_bytes()),
            expected,
        };
        let number = |key, range: std::ops::RangeInclusive<f64>, expected| {
            let number = value.parse::<f64>().ok().filter(|v| range.contains(v));
            number.map(Some).ok_or_else(|| wrong(key, expected))
        };
        let key = key.trim().to_lowercase().replace(['_', '-'], " ");
        match key.as_str() {
            "part" | "serial" | "part serial" => self.part = Some(value.to_owned()).filter(|v| !v.is_empty()),
            "cycle" => {
                self.cycle = Some(value.parse().map_err(|_| wrong("cycle", "a whole number from 0 to 65535"))?);
            }
            "plan" | "plan identity" => {
                let is_hash = value.len() == 64 && value.bytes().all(|b| b.is_ascii_hexdigit());
                let hash = is_hash.then(|| value.to_lowercase());
                self.plan = Some(hash.ok_or_else(|| wrong("plan", "the 64 hexadecimal digits from plan.json"))?);
            }
            "coordinates" | "points are" => {
                let kind = value.to_lowercase();
                let (centres, contacts) = (kind.contains("cent"), kind.contains("contact"));
                self.coordinates = match (centres, contacts) {
                    (true, false) => Some(Coordinates::Centres),
                    (false, true) => Some(Coordinates::Contacts),
                    _ => return Err(wrong("coordinates", "`centres` or `contacts`")),
                };
            }
            "unit" | "units" => {
                let word = value.trim_end_matches('.').parse();
                self.unit =
                    Some(word.map_err(|_| wrong("units", "`mm`, or another unit that is also in the cell file"))?);
            }
            "probe radius mm" => {
                self.probe_radius_mm = number("probe radius mm", 1e-3..=1e3, "a radius from 0.001 to 1000 mm")?;
            }
            "temperature c" => {
                self.temperature_c = number("temperature c", -40.0..=120.0, "a temperature from -40 to 120 °C")?;
            }
            _ => {}
        }
        Ok(())
    }
}

/// Parses `text`, the content of a result file: the points in millimetres, and the properties of the measurement.
/// `content` gives the properties that the configuration of the cell states for all its result files. `path` only names
/// the file in messages.
///
/// # Errors
/// The same as for [`super::read_points`]; properties or columns of the file that contradict `content` or each other.
pub fn parse_result(path: &Path, text: &[u8], content: &Content) -> Result<ResultFile, FormatError> {
    let statements = read_statements(path, text)?;
    let coordinates = agreed_coordinates(path, &statements, content)?;
    if let Some(format) = map_format(text) {
        let MapPoints { points, notes } = format.parse_points(path, text, content.sample_spacing_mm)?;
        return Ok(ResultFile { points, coordinates, notes, statements, ..ResultFile::default() });
    }
    if content.sample_spacing_mm.is_some() {
        return Err(FormatError::NotAMap { path: path.to_owned() });
    }
    // Both formats state their own unit.
    if qif::is_xml(text) {
        return qif::parse(path, text, content);
    }
    if dmis::is_dmis(text) {
        return dmis::parse(path, text, content);
    }
    let unit = agreed_unit(path, &statements, content)?;
    let is_ply = ply::is_ply(text);
    let decimal = match content.decimal {
        DecimalMark::Auto => None,
        DecimalMark::Point => Some(Decimal::Point),
        DecimalMark::Comma => Some(Decimal::Comma),
    };
    let height_unit = content.height_unit;
    let unit_or_mm = (unit != Unit::Millimetre).then_some(unit);
    let table = Table { columns: content.columns.clone(), unit: unit_or_mm, height_unit, ..Table::default() };
    let (points, columns) = if is_ply {
        let mut points = ply::parse_ply_in(path, text, [unit, height_unit.unwrap_or(unit)])?.points;
        table.to_mm(&mut points);
        (points, OtherColumns::default())
    } else {
        let points = parse_points_with(path, text, decimal, &table)?;
        let columns = OtherColumns::read(path, text, points.len(), decimal, &table)?;
        (points, columns)
    };
    let on = |k: usize| columns.enabled.get(k).copied().unwrap_or(true);
    let kept: Vec<usize> = (0..points.len()).filter(|&k| on(k)).collect();
    let switched_off = points.len() - kept.len();
    if kept.is_empty() {
        return Err(FormatError::NoData { path: path.to_owned(), expected: "points that are switched on" });
    }
    Ok(ResultFile {
        indices: columns.indices.map(|all| kept.iter().map(|&k| all[k]).collect()),
        names: columns.names.map(|all| kept.iter().map(|&k| all[k].clone()).collect()),
        points: kept.iter().map(|&k| points[k]).collect(),
        coordinates,
        probe_radius_mm: agreed_radius(path, statements.probe_radius_mm, columns.probe_radius_mm)?,
        switched_off,
        notes: Vec::new(),
        statements,
    })
}

fn agreed_coordinates(path: &Path, says: &Statements, cell: &Content) -> Result<Option<Coordinates>, FormatError> {
    match (says.coordinates, cell.coordinates) {
        (Some(found), Some(expected)) if found != expected => Err(FormatError::Contradiction {
            path: path.to_owned(),
            key: "coordinates",
            found: found.words().to_owned(),
            by: "cell file",
            expected: expected.words().to_owned(),
        }),
        (found, expected) => Ok(found.or(expected)),
    }
}

fn agreed_unit(path: &Path, says: &Statements, cell: &Content) -> Result<Unit, FormatError> {
    match says.unit {
        Some(found) if found != cell.unit => Err(FormatError::Contradiction {
            path: path.to_owned(),
            key: "the unit",
            found: found.to_string(),
            by: "cell file",
            expected: cell.unit.to_string(),
        }),
        _ => Ok(cell.unit),
    }
}

fn agreed_radius(path: &Path, stated: Option<f64>, column: Option<f64>) -> Result<Option<f64>, FormatError> {
    match (stated, column) {
        (Some(stated), Some(column)) if (stated - column).abs() > 1e-6 => Err(FormatError::Contradiction {
            path: path.to_owned(),
            key: "the probe radius",
            found: format!("{stated} mm"),
            by: "column of the same file",
            expected: format!("{column} mm"),
        }),
        (stated, column) => Ok(stated.or(column)),
    }
}

/// Data of the columns other than the coordinates.
#[derive(Default)]
struct OtherColumns {
    indices: Option<Vec<u32>>,
    names: Option<Vec<String>>,
    /// Empty if no row is switched off.
    enabled: Vec<bool>,
    probe_radius_mm: Option<f64>,
}

/// Returns the indices in `names` of the five columns other than the coordinates. Their order is: index, name, enabled,
/// radius of the probe, diameter of the probe. An index is `None` if `names`, the names of the header, does not contain
/// the column.
fn other_column_indices(names: &[String]) -> [Option<usize>; 5] {
    let wanted: [&[&str]; 5] = [
        &["index", "target"],
        &["name", "point", "feature"],
        &["enabled"],
        &["probe_radius_mm", "probe radius [mm]"],
        &["probe"],
    ];
    wanted.map(|wanted| names.iter().position(|name| wanted.contains(&name.trim())))
}

impl OtherColumns {
    /// Reads the columns other than the coordinates from `text`, the content of a table: index, name, enabled, and the
    /// radius or diameter of the probe. `points` is the number of points in the table. `decimal` is the decimal mark.
    /// If `decimal` is `None`, the mark is detected from the numbers. `table` has the columns and units that a person
    /// gave, because the file does not state them clearly. Returns an empty value if the header names none of these
    /// columns.
    ///
    /// # Errors
    /// An index that is not a whole number; more than one probe; a probe of an impossible size.
    fn read(
        path: &Path,
        text: &[u8],
        points: usize,
        decimal: Option<Decimal>,
        table: &Table,
    ) -> Result<Self, FormatError> {
        let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text);
        let mut preamble = Preamble::new(path, false, table);
        let mut lines = text.split(|&b| b == b'\n').map(|l| l.strip_suffix(b"\r").unwrap_or(l)).zip(1..);
        let (first, mut layout) = loop {
            let Some((line, number)) = lines.next() else { return Ok(Self::default()) };
            if let Some(layout) = preamble.read_line(line, number)? {
                break ((line, number), layout);
            }
        };
        let columns = other_column_indices(&preamble.names(layout.separator));
        if columns.iter().all(Option::is_none) {
            return Ok(Self::default());
        }
        match decimal {
            Some(decimal) => layout.decimal = decimal,
            None => {
                let data = text.splitn(first.1 as usize, |&b| b == b'\n').last().unwrap_or_default();
                layout.settle_decimal(path, data)?;
            }
        }
        let [index, name, enabled, radius, diameter] = columns;
        let mut found = Self {
            indices: index.map(|_| Vec::with_capacity(points)),
            names: name.map(|_| Vec::with_capacity(points)),
            ..Self::default()
        };
        let mut probe: Option<Vec<u8>> = None;
        for (line, number) in std::iter::once(first).chain(lines) {
            if line.trim_ascii().is_empty() || is_comment(line) {
                continue;
            }
            let field = |column: usize| Fields::new(line, layout.separator).nth(column).unwrap_or_default();
            found.enabled.push(enabled.is_none_or(|c| is_on(field(c))));
            if let (Some(column), Some(indices)) = (index, &mut found.indices) {
                indices.push(whole_number(path, number, field(column))?);
            }
            if let (Some(column), Some(names)) = (name, &mut found.names) {
                names.push(String::from_utf8_lossy(field(column)).into_owned());
            }
            if let Some(column) = radius.or(diameter) {
                same_probe(path, number, field(column), &mut probe)?;
            }
        }
        if let Some(text) = probe {
            let size_mm = probe_size_mm(path, &layout, &text)?;
            found.probe_radius_mm = Some(if radius.is_some() { size_mm } else { 0.5 * size_mm });
        }
        Ok(found)
    }
}

/// Parses `text`, the radius or the diameter of a probe, and returns the size in millimetres. First reads `text` with
/// the decimal mark of the table, which `layout` contains. If this fails, reads `text` with a decimal point. `path`
/// only names the file in messages.
///
/// # Errors
/// A text that is not a number above 0.
fn probe_size_mm(path: &Path, layout: &Layout, text: &[u8]) -> Result<f64, FormatError> {
    let size_mm = coordinate(&layout.separator.ungrouped(text), layout.decimal)
        .or_else(|_| coordinate(text, Decimal::Point))
        .ok()
        .filter(|v| *v > 0.0);
    size_mm.ok_or_else(|| FormatError::Statement {
        path: path.to_owned(),
        line: layout.first_line,
        key: "probe",
        found: excerpt(text),
        expected: "a size in mm",
    })
}

fn is_on(field: &[u8]) -> bool {
    !["unchecked", "false", "no", "0", "off", "disabled"].iter().any(|off| field.eq_ignore_ascii_case(off.as_bytes()))
}

fn whole_number(path: &Path, line: u64, field: &[u8]) -> Result<u32, FormatError> {
    std::str::from_utf8(field).ok().and_then(|text| text.parse().ok()).ok_or_else(|| FormatError::Index {
        path: path.to_owned(),
        line,
        found: excerpt(field),
        reason: "is not a whole number",
    })
}

/// Checks that all rows of a table state the same size of the probe. `field` is the size as written in line number
/// `line`. Stores `field` in `first` if `first` is `None`. Otherwise returns an error if `field` differs from `first`.
fn same_probe(path: &Path, line: u64, field: &[u8], first: &mut Option<Vec<u8>>) -> Result<(), FormatError> {
    match first {
        Some(first) if first != field => {
            Err(FormatError::ProbeVaries { path: path.to_owned(), line, found: excerpt(field), first: excerpt(first) })
        }
        Some(_) => Ok(()),
        None => {
            *first = Some(field.to_owned());
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use regrind_core::geometry::Point;

    use super::*;

    fn parse(text: &str, content: &Content) -> Result<ResultFile, FormatError> {
        parse_result(Path::new("r.csv"), text.as_bytes(), content)
    }

    #[test]
    fn tracker_export_is_read() {
        let text = "Enabled\tFeature\tID\tx         \ty          \tz         \ti\tj\tk\tDev From Fit\tDevice Position  \tProbe\tDevice Name\r\n\
             Checked\tM1_1   \t1  \t2,512.1218\t2,217.6752 \t2,370.7970\t \t \t \t21.4291     \tDevice Position 1\t38.1 \tV2\r\n\
             Unchecked\tM1_1   \t2  \t2,512.3458\t2,217.6435 \t2,370.7684\t \t \t \t21.4669     \tDevice Position 1\t38.1 \tV2\r\n\
             Checked\tM1_1   \t3  \t-182.1032 \t-2,527.9733\t4,785.0571\t \t \t \t-4.9837     \tDevice Position 1\t38.1 \tV2\r\n";
        let found = parse(text, &Content::default()).unwrap();
        assert_eq!(
            found.points,
            [Point::new(2512.1218, 2217.6752, 2370.797), Point::new(-182.1032, -2527.9733, 4785.0571)]
        );
        assert_eq!((found.switched_off, found.probe_radius_mm, found.coordinates), (1, Some(19.05), None));
        assert_eq!(found.names.unwrap(), ["M1_1", "M1_1"]);
        let two = text.replacen("38.1 ", "12.7 ", 1);
        assert!(matches!(parse(&two, &Content::default()), Err(FormatError::ProbeVaries { line: 3, .. })));
    }

    #[test]
    fn probe_radius_uses_decimal_mark() {
        let text = "# a comment\nname;x;y;z;probe\na;1,5;2,5;3,5;38,1\nb;4;5;6;38,1\n";
        let comma = Content { decimal: DecimalMark::Comma, ..Content::default() };
        for content in [&Content::default(), &comma] {
            assert_eq!(parse(text, content).unwrap().probe_radius_mm, Some(19.05));
        }
        // Coordinates without decimals do not show the decimal mark; the cell states it.
        let whole = "name;x;y;z;probe\na;1;2;3;1.500,5\n";
        assert_eq!(parse(whole, &comma).unwrap().probe_radius_mm, Some(750.25));
    }

    #[test]
    fn statements_checked_against_cell() {
        let text = "# Part: SN 7\n# cycle = 2\n# coordinates: probe centres\n# Probe_radius_mm: 1.5\n# temperature c: 20.5\n\
                    index,x,y,z\n4,1,2,3\n9,4,5,6\n";
        let found = parse(text, &Content::default()).unwrap();
        let says = &found.statements;
        assert_eq!((says.part.as_deref(), says.cycle, says.temperature_c), (Some("SN 7"), Some(2), Some(20.5)));
        assert_eq!((found.coordinates, found.probe_radius_mm), (Some(Coordinates::Centres), Some(1.5)));
        assert_eq!(found.indices.unwrap(), [4, 9]);
        let contacts = Content { coordinates: Some(Coordinates::Contacts), ..Content::default() };
        let error = parse(text, &contacts).unwrap_err();
        assert!(matches!(error, FormatError::Contradiction { key: "coordinates", .. }), "{error}");
        for (line, expected) in [
            ("# cycle: two", "line 1: `cycle` is `two`"),
            ("# coordinates: centres of contact", "`coordinates` is"),
            ("# probe radius mm: NaN", "`probe radius mm` is `NaN`"),
            ("# plan: abc", "64 hexadecimal digits"),
            ("# units: furlong", "`units` is `furlong`"),
        ] {
            let message = parse(&format!("{line}\n1,2,3\n"), &Content::default()).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
        assert!(matches!(
            parse("index,x,y,z\n1.5,1,2,3\n", &Content::default()),
            Err(FormatError::Index { line: 2, .. })
        ));
    }

    #[test]
    fn inches_require_cell_unit() {
        let text = "# units: inch\n1,2,4\n";
        assert!(matches!(parse(text, &Content::default()), Err(FormatError::Contradiction { key: "the unit", .. })));
        let inch = Content { unit: Unit::Inch, ..Content::default() };
        assert_eq!(parse(text, &inch).unwrap().points, [Point::new(25.4, 50.8, 101.6)]);
        assert_eq!(parse("1,2,4\n", &inch).unwrap().points, [Point::new(25.4, 50.8, 101.6)]);
        assert!(matches!(parse("# units: mm\n1,2,3\n", &inch), Err(FormatError::Contradiction { .. })));
        assert!(parse("x_inch,y_inch,z_inch\n1,2,3\n", &Content::default()).is_err());
    }

    #[test]
    fn cell_selects_columns_and_units() {
        let text = "index,X_nom,Y_nom,Z_nom,X_act,Y_act,Z_act\n4,1,2,3,1.5,2.5,3.5\n9,4,5,6,4.5,5.5,6.5\n";
        assert!(matches!(parse(text, &Content::default()), Err(FormatError::HeaderNames { line: 1, .. })));
        let columns = "x=X_act,y=Y_act,z=Z_act".parse().ok();
        let found = parse(text, &Content { columns, unit: Unit::Micrometre, ..Content::default() }).unwrap();
        let wanted = [Point::new(1.5e-3, 2.5e-3, 3.5e-3), Point::new(4.5e-3, 5.5e-3, 6.5e-3)];
        assert!(found.points.iter().zip(&wanted).all(|(a, b)| (a - b).norm() < 1e-15), "{:?}", found.points);
        assert_eq!(found.indices.unwrap(), [4, 9]);
        let heights = Content { height_unit: Some(Unit::Nanometre), ..Content::default() };
        assert_eq!(parse("x,y,z [nm]\n1,2,5e5\n", &heights).unwrap().points, [Point::new(1.0, 2.0, 0.5)]);
        let ply = "ply\nformat ascii 1.0\ncomment units: inch\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\nend_header\n1 2 4\n";
        let inch = Content { unit: Unit::Inch, ..Content::default() };
        assert_eq!(parse(ply, &inch).unwrap().points, [Point::new(25.4, 50.8, 101.6)]);
        assert!(parse(ply, &Content::default()).is_err());
    }

    #[test]
    fn decimal_marks_of_every_locale() {
        let read = |text: &str| parse(text, &Content::default()).map(|f| f.points);
        let expected = [Point::new(1234.56, -2.5, 3.0), Point::new(7.25, 8.5, 1e6)];
        for text in [
            "1.234,56;-2,5;3\n7,25;8,5;1.000.000,0\n",
            "1,234.56\t-2.5\t3\n7.25\t8.5\t1,000,000.0\n",
            "1 234,56;-2,5;3\n7,25;8,5;1 000 000\n",
            "1\u{a0}234,56\t-2,5\t3\n7,25\t8,5\t1\u{202f}000\u{202f}000,0\n",
            "\"1,234.56\",\"-2.5\",3\n7.25,8.5,\"1,000,000.0\"\n",
        ] {
            assert_eq!(read(text).unwrap(), expected, "{text}");
        }
        let ambiguous = read("1,234;5,678;9,012\n").unwrap_err();
        assert!(matches!(ambiguous, FormatError::AmbiguousComma { line: 1, column: 1, .. }), "{ambiguous}");
        let stated = Content { decimal: DecimalMark::Comma, ..Content::default() };
        assert_eq!(parse("1,234;5,678;9,012\n", &stated).unwrap().points, [Point::new(1.234, 5.678, 9.012)]);
        assert!(parse("1.5;2.5;3.5\n", &stated).unwrap_err().to_string().contains("decimal comma"));
    }

    #[test]
    fn check_ended_requires_line_end() {
        let is_ended = |text: &str| check_ended(Path::new("r.csv"), text.as_bytes()).is_ok();
        assert!(is_ended("1,2,3\n") && !is_ended("1,2,3") && !is_ended(""));
    }
}
