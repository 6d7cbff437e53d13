//! Display of text and numbers that a person wrote: invisible characters become visible, long numbers become short.

use std::fmt::Write;

/// Maximum number of digits before the decimal point (`MAX_DIGITS`), and of zeros after it (`MAX_ZEROS`), that a person
/// can count.
const MAX_DIGITS: usize = 15;
const MAX_ZEROS: usize = 9;

/// Returns the first character that is invisible or that changes how the rest of the text is displayed: control
/// characters, direction marks, and characters of zero width. Returns `None` if there is no such character.
pub fn misleading(text: &str) -> Option<char> {
    text.chars().find(|c| is_misleading(*c))
}

fn is_misleading(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{ad}' | '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}')
        || matches!(c, '\u{2060}'..='\u{2069}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// Returns a text in which each invisible or misleading character ([`misleading`]) is replaced by its code, such as
/// `<U+202E>`. Line feeds and tabs stay unchanged.
pub fn visible(text: &str) -> String {
    shown(text, |c| matches!(c, '\n' | '\t'))
}

/// Returns a text as [`visible`] does, with line feeds and tabs replaced too. Use it for a field of a line, so that a text
/// from elsewhere cannot look like a further line or column.
pub fn visible_line(text: &str) -> String {
    shown(text, |_| false)
}

fn shown(text: &str, stays: impl Fn(char) -> bool) -> String {
    text.chars().fold(String::with_capacity(text.len()), |mut shown, c| {
        if is_misleading(c) && !stays(c) {
            let _ = write!(shown, "<U+{:04X}>", u32::from(c));
        } else {
            shown.push(c);
        }
        shown
    })
}

/// Returns `text` with long numbers written with an exponent, such as `1e300`. A number is long if it has more than 15
/// digits before the decimal point, or if `0.` is followed by more than 9 zeros and then other digits. Digits within a
/// word, such as a hash, stay unchanged.
pub fn countable(text: &str) -> String {
    let is_of_number = |c: char| c.is_ascii_digit() || c == '.';
    let mut shown = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(begin) = rest.find(|c: char| c.is_ascii_digit()) {
        let length = rest[begin..].find(|c| !is_of_number(c)).unwrap_or(rest.len() - begin);
        let (before, number, after) = (&rest[..begin], &rest[begin..begin + length], &rest[begin + length..]);
        // Digits within a word, such as a hash or a name, are not a number.
        let alone = !before.ends_with(|c: char| c.is_alphanumeric() || c == '_')
            && !after.starts_with(|c: char| c.is_alphanumeric() || c == '_');
        shown.push_str(before);
        match number.parse::<f64>() {
            Ok(value) if alone && is_long(number) => {
                let _ = write!(shown, "{value:e}");
            }
            _ => shown.push_str(number),
        }
        rest = after;
    }
    shown + rest
}

fn is_long(number: &str) -> bool {
    let (whole, fraction) = number.split_once('.').unwrap_or((number, ""));
    let zeros = fraction.len() - fraction.trim_start_matches('0').len();
    whole.len() > MAX_DIGITS || (whole == "0" && zeros > MAX_ZEROS && zeros < fraction.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn countable_uses_exponents() {
        for (text, expected) in [
            (format!("is {} mm", 1e300), "is 1e300 mm".to_owned()),
            (format!("is {} mm, more than {}", -2.5e22, 0.5), "is -2.5e22 mm, more than 0.5".into()),
            (format!("is {} um", 3e-12), "is 3e-12 um".into()),
            ("sha256 12345678901234567890123456789012345678901234567890abcdef".into(), String::new()),
            ("1800 points at 16.7 mm/min, 0.000001 mm, 123456789012345".into(), String::new()),
            ("run-20261123T004625Z 0.0 ... 1.".into(), String::new()),
        ] {
            let expected = if expected.is_empty() { text.clone() } else { expected };
            assert_eq!(countable(&text), expected);
        }
    }

    #[test]
    fn misleading_finds_hidden_characters() {
        for (text, found) in [
            ("free\u{202e}form", Some('\u{202e}')),
            ("bell\u{7}", Some('\u{7}')),
            ("SN\u{200b}1", Some('\u{200b}')),
            ("Spiegel, groß, 镜子, مرآة, é", None),
            ("", None),
        ] {
            assert_eq!(misleading(text), found, "{text:?}");
        }
        assert_eq!(visible("a\u{202e}b\n\tc\u{7}"), "a<U+202E>b\n\tc<U+0007>");
        assert_eq!(visible_line("a\u{9b}b\n\tc"), "a<U+009B>b<U+000A><U+0009>c");
    }
}
