//! Numbers in a readable form.

use regrind::cell::ComparedFigure;

/// Returns the number `n` as text, with a comma before each group of three digits, for example "451,401".
pub(super) fn count(n: usize) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Returns the number `n` followed by `noun`, which is a word in the singular. Adds an "s" to the word if `n` is not 1,
/// for example "1 point" and "2 points". Puts a comma before each group of three digits of the number.
pub(super) fn counted(n: usize, noun: &str) -> String {
    format!("{} {noun}{}", count(n), if n == 1 { "" } else { "s" })
}

/// Formats `value` with three significant digits. Uses an exponent if the absolute value is below 0.001 or at least a
/// million: "2.00e-5". Returns "0" for 0. Digits before the decimal point are never removed: "1234".
pub(super) fn three_digits(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 {
        return "0".into();
    }
    if !(1e-3..1e6).contains(&size) {
        return format!("{value:.2e}");
    }
    let before_point = size.log10().floor() as i32 + 1;
    format!("{value:.*}", (3 - before_point).max(0) as usize)
}

/// Returns a text about one compared figure, such as PV or RMS. The text states the name of the figure, its median in
/// µm, its limit in µm, and the probability that the figure is within the limit. Omits the limit and the probability if
/// the figure has no limit.
pub(super) fn judged(compared: &ComparedFigure) -> String {
    let um = |mm: f64| three_digits(1e3 * mm);
    let ComparedFigure { name, median_mm: found_mm, limit_mm, .. } = compared;
    let of = if limit_mm.is_finite() { format!(", limit {} µm", um(*limit_mm)) } else { String::new() };
    let within = compared.probability_in_words().map_or(String::new(), |words| format!(", {words}"));
    format!("{name}: {} µm{of}{within}", um(*found_mm))
}

/// Formats the remaining time of a job as a range: "3 to 5 min". The argument holds the minimum and the maximum in
/// seconds.
///
/// The maximum selects the unit: s below 90 s, min below 90 min, otherwise h with one decimal. If minimum and maximum
/// are equal after rounding, returns one number: "50 s".
pub(super) fn time_left([min_s, max_s]: [f64; 2]) -> String {
    let (unit, name) = match max_s {
        s if s < 90.0 => (1.0, "s"),
        s if s < 5400.0 => (60.0, "min"),
        _ => (3600.0, "h"),
    };
    let digits = usize::from(name == "h");
    let [least, most] = [min_s, max_s].map(|s| format!("{:.digits$}", s / unit));
    if least == most { format!("{most} {name}") } else { format!("{least} to {most} {name}") }
}

/// Wraps each line of `text` between words, so that no line has more than `columns` characters. A word that is longer
/// than a line is not divided.
///
/// Continuation lines have the indentation of the wrapped line. If the line consists of a label, at least two spaces
/// and a text, they are indented to the start of this text.
pub(super) fn wrapped(text: &str, columns: usize) -> String {
    let mut out = String::new();
    for line in text.lines() {
        let indent = " ".repeat(text_begins(line, columns));
        let (mut left, mut room) = (line, columns);
        while let Some((end, _)) = left.char_indices().nth(room) {
            let first_word = left.len() - left.trim_start().len();
            let space = match left[end..].starts_with(' ') {
                true => Some(end),
                false => left[..end].rfind(' ').filter(|at| *at > first_word),
            };
            let space = space.or_else(|| left[first_word..].find(' ').map(|at| first_word + at));
            let Some(at) = space.filter(|at| !left[*at..].trim().is_empty()) else { break };
            out += left[..at].trim_end();
            out += "\n";
            out += &indent;
            (left, room) = (left[at..].trim_start(), columns.saturating_sub(indent.len()));
        }
        out += left;
        out += "\n";
    }
    out
}

/// Returns the number of spaces before each continuation line of the wrapped line `line`. `columns` is the maximum
/// width of a line.
///
/// If `line` has a label, then at least two spaces and a text, returns the position of the text. If this position is
/// not in the left half of `columns`, or if there is no label, returns the indentation of `line`, but at most half of
/// `columns`.
fn text_begins(line: &str, columns: usize) -> usize {
    let begin = line.len() - line.trim_start().len();
    let label = line[begin..].find("  ").map(|at| begin + at);
    let text = label.map(|label| line.len() - line[label..].trim_start().len());
    text.filter(|text| *text < columns / 2).unwrap_or(begin.min(columns / 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_as_range() {
        let cases = [
            ([50.2, 50.4], "50 s"),
            ([28.0, 81.0], "28 to 81 s"),
            ([80.0, 100.0], "1 to 2 min"),
            ([3000.0, 3010.0], "50 min"),
            ([5000.0, 9000.0], "1.4 to 2.5 h"),
            ([0.0, 0.0], "0 s"),
        ];
        for (left_s, text) in cases {
            assert_eq!(time_left(left_s), text);
        }
    }

    #[test]
    fn wrapped_breaks_between_words() {
        assert_eq!(wrapped("short\n  also short", 20), "short\n  also short\n");
        assert_eq!(wrapped("ALARM  one two three four", 16), "ALARM  one two\n       three\n       four\n");
        assert_eq!(wrapped("   one two three", 10), "   one two\n   three\n");
        assert_eq!(wrapped("record in /a/very/long/path/indeed", 12), "record in\n/a/very/long/path/indeed\n");
        assert_eq!(wrapped("\u{b5}m \u{b1} \u{b5}m \u{b1}", 4), "\u{b5}m \u{b1}\n\u{b5}m \u{b1}\n");
        assert_eq!(wrapped("", 4), "");
        assert_eq!(wrapped("any length", usize::MAX), "any length\n");
        for columns in 0..40 {
            let text = "cycle 1: PV 99.8 % 28.8 of 7.00 µm, RMS 5.28 of 1.00 µm \u{b1} 0.01  ";
            let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
            let broken = wrapped(text, columns);
            assert_eq!(words(&broken), words(text), "{columns}");
            assert!(
                columns < 8 || broken.lines().all(|line| line.trim_end().chars().count() <= columns),
                "{columns}: {broken}"
            );
        }
    }

    #[test]
    fn count_and_digits_formatting() {
        assert_eq!(count(451_401), "451,401");
        assert_eq!(count(28), "28");
        assert_eq!(counted(1, "point"), "1 point");
        assert_eq!(counted(1000, "point"), "1,000 points");
        let cases = [(6.6571, "6.66"), (0.012_345, "0.0123"), (1234.5, "1234"), (0.0, "0"), (2e-5, "2.00e-5")];
        for (value, text) in cases {
            assert_eq!(three_digits(value), text);
        }
    }
}
