//! Output to the terminal, and the answers of the person at the terminal.

use std::fmt::Write as _;
use std::io::{self, BufRead, Write};

use regrind::document::misleading;

use super::failure::Failure;

/// Prints text to standard output. It is not an error if the program that reads the output has ended.
pub(super) fn print(text: &str) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    // A question has no line end, so it needs a flush.
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Failure::Terminal(error)),
        _ => Ok(()),
    }
}

/// Writes a value to the terminal as indented JSON. Characters that a terminal can take as an order are written as their
/// codes, such as `\u009b`, which is the same text for a reader of JSON.
pub(super) fn print_json(value: &impl serde::Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(value).map_err(|e| Failure::Terminal(e.into()))?;
    print(&(coded(&text) + "\n"))
}

/// Writes a value to the terminal as one line of JSON.
pub(super) fn print_json_line(value: &impl serde::Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string(value).map_err(|e| Failure::Terminal(e.into()))?;
    print(&(coded(&text) + "\n"))
}

/// Returns JSON with each invisible or misleading character replaced by its code. Line feeds stay: within a text of JSON
/// there is none.
fn coded(json: &str) -> String {
    json.chars().fold(String::with_capacity(json.len()), |mut coded, c| {
        if c == '\n' || misleading(c.encode_utf8(&mut [0; 4])).is_none() {
            coded.push(c);
        } else {
            for unit in c.encode_utf16(&mut [0; 2]) {
                // Writing into a string does not fail.
                let _ = write!(coded, "\\u{unit:04x}");
            }
        }
        coded
    })
}

/// Reads a line from standard input, trimmed. The end of the input gives an empty answer.
pub(super) fn answer() -> Result<String, Failure> {
    let mut line = String::new();
    io::stdin().lock().read_line(&mut line).map_err(Failure::Terminal)?;
    Ok(line.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coded_json_is_the_same_value() {
        let value = serde_json::json!({ "a\u{9b}": ["b\u{202e}\n\u{e0041}\u{1b}", "\u{e4}\u{6f22}"] });
        let text = coded(&serde_json::to_string_pretty(&value).unwrap());
        assert!(text.chars().all(|c| c == '\n' || misleading(&c.to_string()).is_none()), "{text:?}");
        assert!(text.contains("\u{e4}\u{6f22}"));
        assert_eq!(serde_json::from_str::<serde_json::Value>(&text).unwrap(), value);
    }
}
