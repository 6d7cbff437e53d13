//! Numbers of a program: a sign, digits, a point, six decimals. No exponent, because LinuxCNC reads it as an E word.

/// Number of units of the last written decimal in a millimetre: six decimals, so that the last one is a nanometre.
pub(super) const PER_MM: f64 = 1e6;
/// Largest coordinate that is written, in millimetres.
pub(super) const MAX_COORDINATE_MM: f64 = 1e9;

/// Returns a length in millimetres as a whole number of millionths of a millimetre, rounded to the nearest.
#[inline]
pub(super) fn rounded(value_mm: f64) -> i64 {
    (value_mm * PER_MM).round() as i64
}

/// Appends a number with six decimals to `text`. `millionths` is one million times the number.
#[inline]
pub(super) fn push_fixed(text: &mut Vec<u8>, millionths: i64) {
    // At most nineteen digits, a point and a sign; filled from the end.
    let mut digits = [0u8; 24];
    let mut at = digits.len();
    let mut rest = millionths.unsigned_abs();
    for _ in 0..3 {
        let pair = (rest % 100) as usize;
        rest /= 100;
        at -= 2;
        digits[at..at + 2].copy_from_slice(&PAIRS[pair]);
    }
    at -= 1;
    digits[at] = b'.';
    loop {
        at -= 1;
        digits[at] = b'0' + (rest % 10) as u8;
        rest /= 10;
        if rest == 0 {
            break;
        }
    }
    if millionths < 0 {
        at -= 1;
        digits[at] = b'-';
    }
    text.extend_from_slice(&digits[at..]);
}

/// Appends the number `count` / 10^`decimals` to `text`, with all its decimals.
#[inline]
pub(super) fn push_decimals(text: &mut Vec<u8>, count: i64, decimals: u8) {
    if decimals == 6 {
        return push_fixed(text, count);
    }
    let mut digits = [0u8; 32];
    let (mut at, mut rest, mut written) = (digits.len(), count.unsigned_abs(), 0);
    // There is at least one digit before the point.
    while written <= decimals || rest > 0 {
        if written == decimals && decimals > 0 {
            at -= 1;
            digits[at] = b'.';
        }
        at -= 1;
        digits[at] = b'0' + (rest % 10) as u8;
        rest /= 10;
        written += 1;
    }
    if count < 0 {
        at -= 1;
        digits[at] = b'-';
    }
    text.extend_from_slice(&digits[at..]);
}

const PAIRS: [[u8; 2]; 100] = {
    let mut pairs = [[0; 2]; 100];
    let mut k = 0;
    while k < 100 {
        pairs[k] = [b'0' + (k / 10) as u8, b'0' + (k % 10) as u8];
        k += 1;
    }
    pairs
};

/// Formats a number with at most six decimals, without zeros at the end, for headers of programs.
pub(super) fn short(value: f64) -> String {
    let mut text = Vec::new();
    push_fixed(&mut text, rounded(value));
    let kept = text.iter().rposition(|b| *b != b'0').map_or(0, |k| if text[k] == b'.' { k } else { k + 1 });
    text.truncate(kept);
    String::from_utf8_lossy(&text).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn push_fixed_six_decimals() {
        let text = |v: f64| {
            let mut text = Vec::new();
            push_fixed(&mut text, rounded(v));
            String::from_utf8(text).unwrap()
        };
        for (value, expected) in [
            (0.0, "0.000000"),
            (-0.0, "0.000000"),
            (-1e-9, "0.000000"),
            (1.0 / 3.0, "0.333333"),
            (-12.345_678_5, "-12.345679"),
            (1e-6, "0.000001"),
            (-1e-6, "-0.000001"),
            (999.999_999_9, "1000.000000"),
            (1e9, "1000000000.000000"),
        ] {
            assert_eq!(text(value), expected);
        }
        for k in 0..20_000 {
            let value = f64::from(k) * 0.013_577_1 - 131.0;
            assert!((text(value).parse::<f64>().unwrap() - value).abs() <= 0.5e-6 + 1e-12);
        }
    }

    #[test]
    fn push_decimals_matches_format() {
        for decimals in 0..=6 {
            for count in [0, 1, -1, 9, 10, -10, 123_456_789, -1_000_000, 999_999] {
                let mut text = Vec::new();
                push_decimals(&mut text, count, decimals);
                let expected = format!("{:.1$}", count as f64 / 10f64.powi(i32::from(decimals)), usize::from(decimals));
                assert_eq!(String::from_utf8(text).unwrap(), expected);
            }
        }
    }

    #[test]
    fn short_trims_trailing_zeros() {
        assert_eq!([short(1000.0), short(0.0001), short(-2.5), short(0.0)], ["1000", "0.0001", "-2.5", "0"]);
    }
}
