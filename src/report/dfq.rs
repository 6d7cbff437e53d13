//! Results as Q-DAS ASCII (DFQ): description and values in one file, one K-field a line, values in the order of
//! measurement.
//!
//! ```text
//! K0100      how many characteristics          K2001/k .. K2402/k   each: number, name, digits, unit, limit, machine
//! K1001 ..   the part, its machine, remarks    K0001/k ..           each value: value, attribute, time, text, serial
//! ```
//!
//! Units: millimetres, so that a file is pure ASCII if the names in it are. Lines end as on Windows. A file with other
//! characters is UTF-8 and begins with the byte order mark.

use std::fmt::Write;

use super::results::{Kind, Measured, Results};

/// Attribute of a value: valid, or excluded from all statistics.
const VALID: u32 = 0;
const LEFT_OUT: u32 = 255;

pub(super) fn text(results: &Results) -> String {
    let mut file = Fields::default();
    let kinds: Vec<&Kind> = results.kinds().collect();
    file.field("K0100", &kinds.len().to_string());
    part(&mut file, results);
    for (number, kind) in (1..).zip(&kinds) {
        characteristic(&mut file, results, number, kind);
    }
    for of in results.measured.iter().filter(|of| !of.figures.is_empty()) {
        values(&mut file, results, of);
    }
    file.whole()
}

/// Part of a batch, as it was judged last. Units: millimetres.
#[derive(Clone, Debug, PartialEq)]
pub struct DfqPart {
    /// Serial number of the part.
    pub serial: String,
    /// Time of the start, RFC 3339 in UTC.
    pub utc: String,
    /// Text that is written with its values.
    pub words: String,
    /// PV and RMS, each with its expanded uncertainty; `None` if nothing was measured.
    pub figures: [Option<[f64; 2]>; 2],
    /// Limits of PV and RMS.
    pub limits_mm: [Option<f64>; 2],
}

/// Returns the text of a Q-DAS ASCII file (DFQ) with PV and RMS in mm of several parts of the same kind. Each part
/// gives one value of each figure, in the order of `parts`. A figure that is missing or not finite is omitted. `name`
/// is the name of the parts, and `remark` a remark about the file. The limit of a figure is written only if it is the
/// same for all parts.
pub fn dfq_of_parts(name: &str, remark: &str, parts: &[DfqPart]) -> String {
    let mut file = Fields::default();
    file.field("K0100", "2");
    for (key, value) in [("K1001", name), ("K1002", name), ("K1203", "closed-loop grinding"), ("K1900", remark)] {
        file.field(key, value);
    }
    for (k, (number, name)) in [("1", "PV"), ("2", "RMS")].into_iter().enumerate() {
        let mut field = |key: &str, value: &str| file.field(&format!("{key}/{number}"), value);
        for (key, value) in [("K2001", number), ("K2002", name), ("K2004", "0"), ("K2022", "6"), ("K2101", "0")] {
            field(key, value);
        }
        let mut limits = parts.iter().map(|part| part.limits_mm[k]);
        let first = limits.next().flatten();
        if let Some(limit) = first.filter(|first| limits.all(|limit| limit == Some(*first))) {
            for (key, value) in [("K2110", "0"), ("K2111", &mm(limit)), ("K2120", "2"), ("K2121", "1")] {
                field(key, value);
            }
        }
        field("K2142", "mm");
    }
    for part in parts {
        for (number, figure) in (1..).zip(&part.figures) {
            let mut field = |key: &str, value: &str| file.field(&format!("{key}/{number}"), value);
            let Some([found, expanded]) = figure.filter(|[found, _]| found.is_finite()) else { continue };
            field("K0001", &mm(found));
            field("K0002", &VALID.to_string());
            field("K0004", &when(&part.utc));
            field("K0009", &format!("{}; U (k = 2) {} mm", part.words, mm(expanded)));
            field("K0014", &part.serial);
        }
    }
    file.whole()
}

fn part(file: &mut Fields, results: &Results) {
    let mark = if results.simulation { "SIMULATION. " } else { "" };
    let remark = format!(
        "{mark}{} Recipe {} (sha256 {}), cell {} (sha256 {}). Hash of the last record: {}",
        results.verdict, results.recipe[0], results.recipe[1], results.cell[0], results.cell[1], results.head
    );
    let station = &results.station;
    for (key, value) in [
        ("K1001", &results.name),
        ("K1002", &results.name),
        ("K1053", &results.run),
        ("K1082", station),
        ("K1203", &"closed-loop grinding".to_owned()),
        ("K1222", &results.operator),
        ("K1900", &remark),
    ] {
        file.field(key, value);
    }
}

fn characteristic(file: &mut Fields, results: &Results, number: u32, kind: &Kind) {
    let mut field = |key: &str, value: &str| file.field(&format!("{key}/{number}"), value);
    field("K2001", &number.to_string());
    field("K2002", kind.name);
    // Variable with a one-sided natural limit: none of these figures is below 0.
    field("K2004", "0");
    field("K2022", "6");
    field("K2101", "0");
    if let Some(limit_mm) = kind.limit_mm {
        field("K2110", "0");
        field("K2111", &mm(limit_mm));
        field("K2120", "2");
        field("K2121", "1");
    }
    field("K2142", "mm");
    if let Some([name, address]) = &results.cmm {
        field("K2401", name);
        field("K2402", &format!("{name} at {address}"));
    }
    field("K2900", kind.what);
}

fn values(file: &mut Fields, results: &Results, of: &Measured) {
    for (number, figure) in (1..).zip(&of.figures) {
        let mut field = |key: &str, value: &str| file.field(&format!("{key}/{number}"), value);
        field("K0001", &mm(figure.found_mm));
        let attribute = if figure.found_mm.is_finite() { VALID } else { LEFT_OUT };
        field("K0002", &attribute.to_string());
        field("K0004", &when(&of.utc));
        let judged = if of.verdict.is_empty() { "not judged" } else { &of.verdict };
        field("K0009", &format!("cycle {}, {judged}; U (k = 2) {} mm", of.cycle, mm(figure.expanded_mm)));
        field("K0014", &results.part);
    }
}

/// Formats a length in millimetres with nine decimals (a picometre), without an exponent.
fn mm(value: f64) -> String {
    format!("{value:.9}")
}

/// Converts a time such as `2026-07-04T12:00:00Z` into the format of Q-DAS, such as `04.07.2026/12:00:00`.
fn when(utc: &str) -> String {
    let (date, time) = utc.split_once('T').unwrap_or((utc, ""));
    let mut date: Vec<&str> = date.split('-').collect();
    date.reverse();
    let time: String = time.chars().take(8).collect();
    format!("{}/{time}", date.join("."))
}

/// DFQ file, one field a line.
#[derive(Default)]
struct Fields {
    text: String,
}

impl Fields {
    /// Returns the complete text of the file. If it is not pure ASCII, it begins with the UTF-8 byte order mark.
    fn whole(self) -> String {
        if self.text.is_ascii() { self.text } else { format!("\u{feff}{}", self.text) }
    }

    /// Appends a line with the K-field `key` (a field of the Q-DAS format) and its `value`. Does nothing if the value
    /// is empty. Replaces control characters and the separator ¤ in the value by spaces. Also replaces µ by u and ± by
    /// +-, because some programs read only ASCII.
    fn field(&mut self, key: &str, value: &str) {
        let value = value
            .replace(|c: char| c.is_control() || c == '\u{a4}', " ")
            .replace('\u{b5}', "u")
            .replace('\u{b1}', "+-");
        if !value.trim().is_empty() {
            let _ = write!(self.text, "{key} {}\r\n", value.trim());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn field_strips_line_ends() {
        let mut file = Fields::default();
        file.field("K1001", "part\r\nK2111/1 9\u{f}\u{14}\u{a4}x");
        file.field("K1002", "\n");
        assert_eq!(file.text, "K1001 part  K2111/1 9   x\r\n");
    }

    #[test]
    fn a_time_is_written_day_first() {
        assert_eq!(when("2026-07-04T12:01:02.123456789Z"), "04.07.2026/12:01:02");
    }
}
