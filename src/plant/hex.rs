//! Conversion of hashes between bytes (database) and lower-case hexadecimal digits (people and journals).

/// Returns the bytes as lower-case hexadecimal digits.
pub(crate) fn digits(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Parses hexadecimal digits into bytes. Returns `None` if the number of digits is odd, or if a character is neither a
/// digit nor a letter from `a` to `f`. Capital letters are not accepted.
pub(crate) fn unhex(digits: &str) -> Option<Vec<u8>> {
    let nibble = |digit: u8| match digit {
        b'0'..=b'9' => Some(digit - b'0'),
        b'a'..=b'f' => Some(digit - b'a' + 10),
        _ => None,
    };
    let pairs = digits.as_bytes().chunks(2);
    pairs.map(|pair| Some(nibble(pair[0])? << 4 | nibble(*pair.get(1)?)?)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hex_round_trip_and_refusals() {
        assert_eq!(unhex(&digits(&[0, 9, 10, 255])), Some(vec![0, 9, 10, 255]));
        assert!(["0", "0A", "0g", "\u{b5}"].iter().all(|bad| unhex(bad).is_none()) && unhex("") == Some(vec![]));
    }
}
