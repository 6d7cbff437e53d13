//! Output to the terminal, and the answers of the person at the terminal.

use std::io::{self, BufRead, Write};

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

/// Writes a value to the terminal as indented JSON.
pub(super) fn print_json(value: &impl serde::Serialize) -> Result<(), Failure> {
    let mut text = serde_json::to_string_pretty(value).map_err(|e| Failure::Terminal(e.into()))?;
    text.push('\n');
    print(&text)
}

/// Reads a line from standard input, trimmed. The end of the input gives an empty answer.
pub(super) fn answer() -> Result<String, Failure> {
    let mut line = String::new();
    io::stdin().lock().read_line(&mut line).map_err(Failure::Terminal)?;
    Ok(line.trim().to_owned())
}
