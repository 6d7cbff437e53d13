//! Formatting of the page: texts of cells, times, figures, addresses.

use std::fmt::Write;

use regrind_document::visible;

/// Replaces each invisible or misleading character in a text from a cell or a person by its code, such as `<U+202E>`.
/// Such characters can hide or reorder other letters. Does not escape HTML, because the template engine Maud does this.
pub(super) fn shown(text: &str) -> String {
    visible(text)
}

/// Percent-encodes a value for the query of an address.
pub(super) fn encoded(text: &str) -> String {
    text.bytes().fold(String::new(), |mut out, byte| {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.' | b'~' => out.push(char::from(byte)),
            byte => drop(write!(out, "%{byte:02X}")),
        }
        out
    })
}

/// Formats a duration, given in seconds, as a rounded number with a unit. The unit is s below 90 s, min below 90 min, h
/// below 36 h, and days otherwise. A negative duration becomes `0 s`.
pub(super) fn ago(seconds: f64) -> String {
    match seconds {
        s if s < 90.0 => format!("{:.0} s", s.max(0.0)),
        s if s < 5400.0 => format!("{:.0} min", s / 60.0),
        s if s < 129_600.0 => format!("{:.0} h", s / 3600.0),
        s => format!("{:.0} days", s / 86_400.0),
    }
}

/// Formats the range of durations from `least` to `most`, both in seconds, as text, such as `5 – 8 min`. Both numbers
/// get the same unit: s if `most` is below 90 s, min if `most` is below 90 min, otherwise h. If both numbers are equal
/// after rounding, the text contains only one.
pub(super) fn range([least, most]: [f64; 2]) -> String {
    let (unit, per) = match most {
        most if most < 90.0 => ("s", 1.0),
        most if most < 5400.0 => ("min", 60.0),
        _ => ("h", 3600.0),
    };
    let digits = usize::from(unit == "h");
    let [least, most] = [least, most].map(|seconds| format!("{:.digits$}", seconds / per));
    if least == most { format!("{most} {unit}") } else { format!("{least} – {most} {unit}") }
}

/// Formats a number in µm with `digits` decimals, without the unit. Returns a dash if `value` is `None` or not finite.
pub(super) fn um(value: Option<f64>, digits: usize) -> String {
    value.filter(|value| value.is_finite()).map_or("–".to_owned(), |value| format!("{value:.digits$}"))
}

/// Formats the proportion `of` / `all` as a percentage without decimals, such as `25 %`. `of` is the count of a part of
/// the items, and `all` is the count of all items. Returns a dash if `all` is 0 or negative.
pub(super) fn share(of: i64, all: i64) -> String {
    if all <= 0 {
        return "–".to_owned();
    }
    format!("{:.0} %", 100.0 * of as f64 / all as f64)
}

/// Formats the 95 % Wilson score interval of the proportion `of` / `all`, in per cent; empty if `all` is 0.
pub(super) fn interval(of: i64, all: i64) -> String {
    if all <= 0 {
        return String::new();
    }
    let [low, high] = wilson(of as f64, all as f64);
    format!("{:.0} – {:.0} %", 100.0 * low, 100.0 * high)
}

/// Returns the lower and the upper limit of the 95 % Wilson score interval of the proportion `of` / `all` (E. B.
/// Wilson, JASA 22, 1927). `of` is the count of a part of the items, and `all`, which must be above 0, is the count of
/// all items. Both limits are from 0 to 1.
fn wilson(of: f64, all: f64) -> [f64; 2] {
    const Z: f64 = 1.959_964;
    let (p, z2) = (of / all, Z * Z);
    let middle = (p + z2 / (2.0 * all)) / (1.0 + z2 / all);
    let half = Z / (1.0 + z2 / all) * (p * (1.0 - p) / all + z2 / (4.0 * all * all)).sqrt();
    [(middle - half).max(0.0), (middle + half).min(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn encoded_escapes_any_text() {
        assert_eq!(encoded("a b&c=<\u{e4}>'"), "a%20b%26c%3D%3C%C3%A4%3E%27");
    }

    #[test]
    fn wilson_interval_matches_table() {
        // 8 of 10: 0.4902 to 0.9433, as in published tables.
        let [low, high] = wilson(8.0, 10.0);
        assert!((low - 0.4902).abs() < 1e-4 && (high - 0.9433).abs() < 1e-4, "{low} {high}");
        assert_eq!((share(2, 3), share(0, 0), interval(0, 0)), ("67 %".into(), "–".into(), String::new()));
        assert!(wilson(0.0, 5.0)[0] < 1e-12);
    }
}
