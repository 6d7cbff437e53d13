//! Numbers as people read them.

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

#[cfg(test)]
mod tests {
    use super::*;

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
