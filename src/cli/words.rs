//! Numbers as people read them.

use regrind::cell::Compared;

/// A count with its thousands apart: 451,401.
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

/// A count with its noun: 1 point, 2 points.
pub(super) fn counted(n: usize, noun: &str) -> String {
    format!("{} {noun}{}", count(n), if n == 1 { "" } else { "s" })
}

/// Three significant digits, without an exponent between a thousandth and a million.
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

/// Writes a figure that is judged, beside its limit if it has one.
pub(super) fn judged(compared: &Compared) -> String {
    let um = |mm: f64| three_digits(1e3 * mm);
    let Compared { name, found_mm, limit_mm, .. } = compared;
    let of = if limit_mm.is_finite() { format!(" of {}", um(*limit_mm)) } else { String::new() };
    format!("{name} {}{of} um", um(*found_mm))
}

/// Writes the least and the most time that something will take.
pub(super) fn time_left([least_s, most_s]: [f64; 2]) -> String {
    let (unit, name) = match most_s {
        s if s < 90.0 => (1.0, "s"),
        s if s < 5400.0 => (60.0, "min"),
        _ => (3600.0, "h"),
    };
    let digits = usize::from(name == "h");
    let [least, most] = [least_s, most_s].map(|s| format!("{:.digits$}", s / unit));
    if least == most { format!("{most} {name}") } else { format!("{least} to {most} {name}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_that_is_left_is_said_as_a_range() {
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
    fn numbers_read_well() {
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
