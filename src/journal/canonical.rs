//! Canonical JSON (one text for one value), and the hashes computed from it.

use std::fmt::Write;

use serde_json::Value;
use sha2::{Digest, Sha256};

/// Domain separator: keeps this hash distinct from every other use of SHA-256.
const DOMAIN: &str = "regrind journal record 1\n";

/// Returns a value as JSON with sorted keys and no whitespace. Numbers have the form that `serde_json` gives them.
pub fn canonical_json(value: &Value) -> String {
    let mut text = String::new();
    write_value(&mut text, value);
    text
}

fn write_value(text: &mut String, value: &Value) {
    match value {
        Value::Array(items) => {
            text.push('[');
            for (i, item) in items.iter().enumerate() {
                if i > 0 {
                    text.push(',');
                }
                write_value(text, item);
            }
            text.push(']');
        }
        Value::Object(members) => {
            // A map keeps the order of insertion if another crate enables that feature of serde_json.
            let mut sorted: Vec<_> = members.iter().collect();
            sorted.sort_by_key(|(key, _)| key.as_str());
            text.push('{');
            for (i, (key, item)) in sorted.into_iter().enumerate() {
                if i > 0 {
                    text.push(',');
                }
                write_string(text, key);
                text.push(':');
                write_value(text, item);
            }
            text.push('}');
        }
        Value::String(string) => write_string(text, string),
        scalar => {
            // Writing into a string does not fail.
            let _ = write!(text, "{scalar}");
        }
    }
}

/// Appends a string to `text` as JSON: in quotes and with escapes.
pub(super) fn write_string(text: &mut String, string: &str) {
    let is_plain = |byte: u8| byte >= 0x20 && byte != b'"' && byte != b'\\';
    if string.bytes().all(is_plain) {
        text.extend(["\"", string, "\""]);
    } else {
        // A string always has a JSON form.
        text.push_str(&serde_json::to_string(string).unwrap_or_default());
    }
}

/// Returns the SHA-256 of bytes, in lowercase hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// Returns the hash of a record: a SHA-256 as 64 lowercase hexadecimal digits. `text` is the JSON text of this record
/// without its hashes. `prev_hash` is the hash of the previous record. The hash is computed from four texts, one after
/// the other: [`DOMAIN`] (a constant line that states the purpose of the hash), `prev_hash`, a line feed, and `text`.
pub(super) fn chain(prev_hash: &str, text: &str) -> String {
    let mut digest = Sha256::new();
    for part in [DOMAIN, prev_hash, "\n", text] {
        digest.update(part.as_bytes());
    }
    hex(&digest.finalize())
}

/// Converts `2 N` lowercase hexadecimal digits to `N` bytes. Returns `None` for another number of digits or other
/// characters. Uppercase digits are rejected, so that each value has only one text.
pub(super) fn unhex<const N: usize>(digits: &str) -> Option<[u8; N]> {
    let nibble = |digit: u8| match digit {
        b'0'..=b'9' => Some(digit - b'0'),
        b'a'..=b'f' => Some(digit - b'a' + 10),
        _ => None,
    };
    let digits = digits.as_bytes();
    let mut bytes = [0; N];
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
        *byte = nibble(pair[0])? << 4 | nibble(pair[1])?;
    }
    (digits.len() == 2 * N).then_some(bytes)
}

pub(super) fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    let digit = |nibble: u8| char::from(DIGITS[usize::from(nibble)]);
    bytes.iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 15)]).collect()
}
