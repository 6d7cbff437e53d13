//! Numbers as people and programs write them: decimal point or comma, with or without thousands separators.

/// Largest accepted coordinate, in millimetres: ten kilometres.
pub const LIMIT_MM: f64 = 1e7;

/// Maximum length of a number with marks to remove or replace; plain numbers can be longer.
const LONGEST_MARKED: usize = 64;

/// Decimal mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Decimal {
    /// 2512.12, or 2,512.12 where the comma does not separate columns.
    Point,
    /// 2512,12 or 2.512,12.
    Comma,
}

/// Reason why a field is not a coordinate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NumberFault {
    Text,
    NotFinite,
    OutOfRange,
    AmbiguousComma,
    OtherMark,
}

/// Evidence in a field for the decimal mark of its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Evidence {
    Says(Decimal),
    Ambiguous,
    Nothing,
}

/// Parses `field` as a coordinate. `decimal` is the decimal mark of the file. The value stays in the unit of the file.
///
/// A field can have a sign, digits with at most one decimal mark, and an exponent of ten. Points or commas between
/// thousands are accepted only if the field also contains its decimal mark: `2,512.1` is accepted, but `2,512` is
/// ambiguous and is rejected if the decimal mark is a point.
///
/// # Errors
/// A field that is not a number, is not finite, exceeds [`LIMIT_MM`], is ambiguous, or has the other decimal mark.
pub(super) fn coordinate(field: &[u8], decimal: Decimal) -> Result<f64, NumberFault> {
    let value = match (decimal, field.contains(&b','), field.contains(&b'.')) {
        (Decimal::Point, false, _) | (Decimal::Comma, false, false) => plain(field)?,
        (Decimal::Comma, true, false) => plain_with_point(field, b',', None)?,
        (Decimal::Point, true, true) => plain_with_point(field, b'.', Some(b','))?,
        (Decimal::Comma, true, true) => plain_with_point(field, b',', Some(b'.'))?,
        (Decimal::Point, true, false) if is_one_group(field) => return Err(NumberFault::AmbiguousComma),
        (Decimal::Point, true, false) => {
            return Err(if looks_numeric(field) { NumberFault::OtherMark } else { NumberFault::Text });
        }
        (Decimal::Comma, false, true) => {
            return Err(if plain(field).is_ok() { NumberFault::OtherMark } else { NumberFault::Text });
        }
    };
    if is_believable(value) { Ok(value) } else { Err(NumberFault::OutOfRange) }
}

/// Returns true if a value can be a coordinate: its magnitude is at most [`LIMIT_MM`], and it is not NaN.
#[inline]
pub(super) fn is_believable(value: f64) -> bool {
    value.abs() <= LIMIT_MM
}

/// Parses a number with a decimal point. The result can be NaN or infinite. Returns `None` if `field` is not such a
/// number.
pub(super) fn any_number(field: &[u8]) -> Option<f64> {
    fast_float2::parse(field).ok()
}

/// Returns true if `field` is a number. The decimal mark can be a point or a comma, and thousands can be separated by
/// the other mark. NaN and infinity are numbers too.
pub(super) fn looks_numeric(field: &[u8]) -> bool {
    any_number(field).is_some() || plain_with_point(field, b',', None).is_ok() || {
        let grouped = |mark, group| plain_with_point(field, mark, Some(group)).is_ok();
        grouped(b'.', b',') || grouped(b',', b'.') || is_one_group(field)
    }
}

/// Returns true if `text` contains both a point and a comma. If `text` is one number, one of them is its decimal mark
/// and the other separates thousands.
pub(super) fn has_both_marks(text: &[u8]) -> bool {
    text.contains(&b'.') && text.contains(&b',')
}

/// Returns `[decimals, exponent]` for the number `field`: the number of digits after its decimal mark, and the number
/// of digits of its exponent. A count is 0 if the number has no mark or no exponent.
pub(super) fn digits_after(field: &[u8]) -> [usize; 2] {
    let begins = |is: fn(&u8) -> bool| field.iter().rposition(is).map(|at| &field[at + 1..]);
    let digits = |text: Option<&[u8]>| {
        let text = text.unwrap_or_default();
        let text = text.strip_prefix(b"-").or(text.strip_prefix(b"+")).unwrap_or(text);
        text.iter().take_while(|b| b.is_ascii_digit()).count()
    };
    [digits(begins(|b| matches!(b, b'.' | b','))), digits(begins(|b| matches!(b, b'e' | b'E')))]
}

/// Returns the evidence of `field` for the decimal mark of its file: the mark (point or comma), or that its comma can
/// be the decimal mark or a thousands separator, or nothing. A field that is not a number gives no evidence.
pub(super) fn evidence(field: &[u8]) -> Evidence {
    let last = |mark: u8| field.iter().rposition(|&b| b == mark);
    let count = |mark: u8| field.iter().filter(|&&b| b == mark).count();
    match (last(b'.'), last(b',')) {
        _ if !looks_numeric(field) => Evidence::Nothing,
        (None, None) => Evidence::Nothing,
        (Some(_), None) => Evidence::Says(Decimal::Point),
        (None, Some(_)) if count(b',') > 1 || is_one_group(field) => Evidence::Ambiguous,
        (None, Some(_)) => Evidence::Says(Decimal::Comma),
        (Some(dot), Some(comma)) if dot > comma => Evidence::Says(Decimal::Point),
        (Some(_), Some(_)) => Evidence::Says(Decimal::Comma),
    }
}

/// Returns the number in `field` without the blanks between its thousands: `1234,56` for `1 234,56`. The blank can be a
/// plain blank, a no-break space (U+00A0) or a narrow no-break space (U+202F).
///
/// Returns `None` if `field` is not a number with such blanks, has a blank at another position, or is longer than 64
/// bytes.
pub(super) fn without_blanks(field: &[u8]) -> Option<Vec<u8>> {
    let text = std::str::from_utf8(field).ok().filter(|text| text.len() <= LONGEST_MARKED)?;
    let is_blank = |c: char| matches!(c, ' ' | '\u{a0}' | '\u{202f}');
    let (whole, fraction) = text.split_at(text.find(['.', ',']).unwrap_or(text.len()));
    let marked: String = whole.chars().map(|c| if is_blank(c) { ' ' } else { c }).collect();
    if !is_grouped(marked.as_bytes(), b' ') || fraction.contains(is_blank) {
        return None;
    }
    Some(marked.bytes().filter(|&b| b != b' ').chain(fraction.bytes()).collect())
}

/// Parses a number with a decimal point and without thousands separators. The value can be infinite if the number has
/// too many digits.
///
/// # Errors
/// [`NumberFault::Text`] if `field` is not a number; [`NumberFault::NotFinite`] if `field` is the word for NaN or
/// infinity.
fn plain(field: &[u8]) -> Result<f64, NumberFault> {
    let value: f64 = fast_float2::parse(field).map_err(|_| NumberFault::Text)?;
    let spelt_out = field.iter().any(|b| matches!(b, b'n' | b'N'));
    // A number with too many digits overflows to infinity; the range check rejects it.
    if spelt_out { Err(NumberFault::NotFinite) } else { Ok(value) }
}

/// Parses `field`, a number that contains the decimal mark `mark` (a point or a comma). If `group` is given, the digits
/// before the mark must be in groups of three, separated by the byte `group`. If `group` is `None`, thousands
/// separators are rejected.
///
/// # Errors
/// [`NumberFault::Text`] if `field` does not have this form or is too long; [`NumberFault::NotFinite`] if it is the
/// word for NaN or infinity.
fn plain_with_point(field: &[u8], mark: u8, group: Option<u8>) -> Result<f64, NumberFault> {
    let at = field.iter().position(|&b| b == mark).ok_or(NumberFault::Text)?;
    let (whole, fraction) = (&field[..at], &field[at + 1..]);
    let grouped_well = group.is_none_or(|g| is_grouped(whole, g));
    if field.len() > LONGEST_MARKED || !grouped_well || fraction.contains(&b'.') || fraction.contains(&b',') {
        return Err(NumberFault::Text);
    }
    let mut text = [0; LONGEST_MARKED];
    let mut length = 0;
    for &byte in field.iter().filter(|&&b| Some(b) != group) {
        text[length] = if byte == mark { b'.' } else { byte };
        length += 1;
    }
    plain(&text[..length])
}

/// Returns true if `whole` is a whole number whose digits are in groups of three, such as `-1,234,567`. `group` is the
/// byte between the groups. At least one separator is required, and the first digit must not be 0.
fn is_grouped(whole: &[u8], group: u8) -> bool {
    let digits = whole.strip_prefix(b"-").or(whole.strip_prefix(b"+")).unwrap_or(whole);
    let mut parts = digits.split(|&b| b == group);
    let first = parts.next().unwrap_or_default();
    let mut rest = parts.peekable();
    let well_begun = matches!(first.len(), 1..=3) && first[0] != b'0' && first.iter().all(u8::is_ascii_digit);
    well_begun && rest.peek().is_some() && rest.all(|part| part.len() == 3 && part.iter().all(u8::is_ascii_digit))
}

/// Returns true if `field` is a whole number in groups of three digits separated by commas, such as `2,512`. Without
/// other evidence, such a comma can be a decimal mark or a thousands separator.
fn is_one_group(field: &[u8]) -> bool {
    is_grouped(field, b',')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinate_notations() {
        let point = |text: &str| coordinate(text.as_bytes(), Decimal::Point);
        let comma = |text: &str| coordinate(text.as_bytes(), Decimal::Comma);
        for (text, value) in [("1", 1.0), ("+.5", 0.5), ("-3.", -3.0), ("1e3", 1000.0), ("-2,512.1218", -2512.1218)] {
            assert_eq!(point(text), Ok(value), "{text}");
        }
        for (text, value) in
            [("1", 1.0), ("2,5", 2.5), ("-2,512", -2.512), ("1.234.567,5", 1234567.5), ("1,5e2", 150.0)]
        {
            assert_eq!(comma(text), Ok(value), "{text}");
        }
        let text = ["", "-", ".", "abc", "0x10", "1_0", "1e", "1 2", "12,34.5", "1,2,3", "1.2.3", "0,123.4"];
        for text in text {
            assert_eq!(point(text), Err(NumberFault::Text), "{text}");
        }
        for text in ["nan", "-NaN", "inf", "-Infinity"] {
            assert_eq!(point(text), Err(NumberFault::NotFinite), "{text}");
        }
        for text in ["1e300", "1e400", "-10000001"] {
            assert_eq!(point(text), Err(NumberFault::OutOfRange), "{text}");
        }
        assert_eq!(point("2,512"), Err(NumberFault::AmbiguousComma));
        assert_eq!(point("2,5"), Err(NumberFault::OtherMark));
        assert_eq!(comma("2.5"), Err(NumberFault::OtherMark));
    }

    #[test]
    fn digits_after_mark_and_exponent() {
        let cases = [
            ("12", [0, 0]),
            ("-1.25", [2, 0]),
            ("1.234,5", [1, 0]),
            ("1.5e-05", [1, 2]),
            ("1e+0", [0, 1]),
            ("", [0, 0]),
        ];
        for (text, digits) in cases {
            assert_eq!(digits_after(text.as_bytes()), digits, "{text}");
        }
    }

    #[test]
    fn without_blanks_groups_thousands() {
        let without = |text: &str| without_blanks(text.as_bytes()).map(|t| String::from_utf8(t).unwrap());
        assert_eq!(without("1 234,56").as_deref(), Some("1234,56"));
        assert_eq!(without("-1\u{a0}234\u{202f}567.5").as_deref(), Some("-1234567.5"));
        assert_eq!(without("12 345").as_deref(), Some("12345"));
        for text in ["1 2", "1 2345", "1234 567", "0 123", "1 234,5 6", "1 234 ", "a 123", "", "12"] {
            assert_eq!(without(text), None, "{text:?}");
        }
    }

    #[test]
    fn evidence_of_decimal_mark() {
        let says = |text: &str| evidence(text.as_bytes());
        assert_eq!(says("1.5"), Evidence::Says(Decimal::Point));
        assert_eq!(says("2,512.1"), Evidence::Says(Decimal::Point));
        assert_eq!(says("2.512,1"), Evidence::Says(Decimal::Comma));
        assert_eq!(says("0,123"), Evidence::Says(Decimal::Comma));
        assert_eq!(says("1234,567"), Evidence::Says(Decimal::Comma));
        assert_eq!(says("12,345"), Evidence::Ambiguous);
        assert_eq!(says("12"), Evidence::Nothing);
        assert_eq!(says("a,b"), Evidence::Nothing);
    }
}
