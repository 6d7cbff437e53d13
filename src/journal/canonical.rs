//! Canonical JSON (one text for one value), and the hashes computed from it.

use std::fmt::Write;

use data_encoding::HEXLOWER;
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
    HEXLOWER.encode(&Sha256::digest(bytes))
}

/// Returns the hash of a record: a SHA-256 as 64 lowercase hexadecimal digits. `text` is the JSON text of this record
/// without its hashes. `prev_hash` is the hash of the previous record. The hash is computed from four texts, one after
/// the other: [`DOMAIN`] (a constant line that states the purpose of the hash), `prev_hash`, a line feed, and `text`.
pub(super) fn chain(prev_hash: &str, text: &str) -> String {
    let mut digest = Sha256::new();
    for part in [DOMAIN, prev_hash, "\n", text] {
        digest.update(part.as_bytes());
    }
    HEXLOWER.encode(&digest.finalize())
}

/// Converts `2 N` lowercase hexadecimal digits to `N` bytes. Returns `None` for another number of digits or other
/// characters. Uppercase digits are rejected, so that each value has only one text.
pub(super) fn unhex<const N: usize>(digits: &str) -> Option<[u8; N]> {
    HEXLOWER.decode(digits.as_bytes()).ok()?.try_into().ok()
}
