//! Parsers of arguments: names, remarks and numbers.

use regrind::document::misleading;

/// Checks that `text` can be the name of a person, a part or a place. Returns the name without spaces at both ends.
/// Returns the reason as text if the name is empty or longer than 300 characters. Also returns the reason if the name
/// has characters that are invisible or that change the order of the letters.
pub(super) fn name(text: &str) -> Result<String, String> {
    const LONGEST: usize = 300;
    match (misleading(text), text.trim()) {
        (Some(hidden), _) => Err(format!(
            "the text has the character U+{:04X}, which is invisible or changes the order of the letters; type the text again",
            u32::from(hidden)
        )),
        (None, "") => Err("it is empty".into()),
        (None, name) if name.chars().count() > LONGEST => Err(format!("it is longer than {LONGEST} characters")),
        (None, name) => Ok(name.to_owned()),
    }
}

/// Checks that `text` can be the remark of a person. Returns the remark without spaces at both ends; the remark can be
/// empty. Returns the reason as text if the remark has invisible characters or is longer than 300 characters.
pub(super) fn remark(text: &str) -> Result<String, String> {
    if text.trim().is_empty() { Ok(String::new()) } else { name(text) }
}

/// Parses `text` as a number above 0. Accepts `inf` (infinity). Returns a text with the permitted values if `text` is
/// not such a number.
pub(super) fn above_zero(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value > 0.0 => Ok(value),
        _ => Err("give a number above 0; the decimal mark is a point, not a comma".into()),
    }
}

/// Parses `text` as a finite number above 0. Returns a text with the permitted values if `text` is not such a number.
pub(super) fn finite_above_zero(text: &str) -> Result<f64, String> {
    above_zero(text).and_then(|v| if v.is_finite() { Ok(v) } else { Err("give a finite number above 0".into()) })
}

/// Parses `text` as a finite number that is 0 or above. Returns a text with the permitted values if `text` is not such
/// a number.
pub(super) fn finite_from_zero(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(value) if value >= 0.0 && value.is_finite() => Ok(value.abs()),
        _ => Err(
            "give a finite number above 0, or 0 for a probe without a ball; the decimal mark is a point, not a comma"
                .into(),
        ),
    }
}
