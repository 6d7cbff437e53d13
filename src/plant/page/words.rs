//! Formatting of the page: texts of cells, times, figures, addresses.

use std::fmt::Write;

use maud::{Markup, html};
use regrind_document::visible;
use regrind_language::{Language, decimal, filled};

use super::texts::Text;

/// Number of characters from which a text is clamped.
const LONG: usize = 90;

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
pub(super) fn ago(seconds: f64, language: Language) -> String {
    match seconds {
        s if s < 90.0 => format!("{:.0} s", s.max(0.0)),
        s if s < 5400.0 => format!("{:.0} min", s / 60.0),
        s if s < 129_600.0 => format!("{:.0} h", s / 3600.0),
        s => filled(Text::Days.to(language), &[("count", &format!("{:.0}", s / 86_400.0))]),
    }
}

/// Formats the range of durations from `least` to `most`, both in seconds, as text, such as `5 – 8 min`. Both numbers
/// get the same unit: s if `most` is below 90 s, min if `most` is below 90 min, otherwise h. If both numbers are equal
/// after rounding, the text contains only one.
pub(super) fn range([least, most]: [f64; 2], language: Language) -> String {
    let (unit, per) = match most {
        most if most < 90.0 => ("s", 1.0),
        most if most < 5400.0 => ("min", 60.0),
        _ => ("h", 3600.0),
    };
    let digits = usize::from(unit == "h");
    let [least, most] = [least, most].map(|seconds| decimal(seconds / per, digits, language));
    if least == most { format!("{most} {unit}") } else { format!("{least} – {most} {unit}") }
}

/// Returns the HTML of a time, such as `2026-07-04 12:00:00` (UTC). A browser shows it in its own time zone; without
/// scripts it reads `2026-07-04 12:00:00 UTC`. Returns empty HTML for an empty text.
pub(super) fn when(utc: &str) -> Markup {
    html! { @if !utc.is_empty() { time datetime=(rfc3339(utc)) { (utc) " UTC" } } }
}

/// Returns a time such as `2026-07-04 12:00:00` (UTC) as `2026-07-04T12:00:00Z`.
pub(super) fn rfc3339(utc: &str) -> String {
    format!("{}Z", utc.replacen(' ', "T", 1))
}

/// Returns the HTML of a text of any length. A long text shows its first two lines, and the whole of it on demand.
pub(super) fn clamped(text: &str) -> Markup {
    let text = shown(text);
    html! {
        @if text.chars().count() > LONG { details .clamp { summary { (text) } } } @else { (text) }
    }
}

/// Returns the HTML of a name on one line. A name that is too long for its place ends with an ellipsis; the pointer shows
/// the whole name.
pub(super) fn name(text: &str) -> Markup {
    let text = shown(text);
    html! { span .one-line title=(text) { (text) } }
}

/// Formats a number in µm with `digits` decimals, without the unit. Returns a dash if `value` is `None` or not finite.
pub(super) fn um(value: Option<f64>, digits: usize, language: Language) -> String {
    value.filter(|value| value.is_finite()).map_or("–".to_owned(), |value| decimal(value, digits, language))
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
    fn times_and_long_texts() {
        let html = when("2026-07-04 12:00:00").into_string();
        assert_eq!(html, "<time datetime=\"2026-07-04T12:00:00Z\">2026-07-04 12:00:00 UTC</time>");
        assert_eq!(when("").into_string(), "");
        assert_eq!(clamped("short <b>").into_string(), "short &lt;b&gt;");
        assert!(clamped(&"<i>".repeat(60)).into_string().starts_with("<details class=\"clamp\"><summary>&lt;i&gt;"));
    }

    #[test]
    fn durations_in_each_language() {
        assert_eq!([5.0, 600.0, 7200.0, 864_000.0].map(|s| ago(s, Language::De)), ["5 s", "10 min", "2 h", "10 Tage"]);
        assert_eq!(range([80.0, 130.0], Language::En), "1 – 2 min");
        assert_eq!(range([5400.0, 9000.0], Language::De), "1,5 – 2,5 h");
        assert_eq!(um(Some(1.25), 1, Language::De), "1,2");
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
