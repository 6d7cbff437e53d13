//! Splitter of bytes into lines. CR, LF or both end a line; an empty line is ignored.

/// Maximum length of a line, in bytes.
const MAX_LINE_LENGTH: usize = 200;

/// Line or overlong data found in the received bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReceivedLine {
    /// Line without its line end.
    Line(String),
    /// Beginning of data that exceed the maximum length of a line.
    Endless(String),
}

/// Splitter of received bytes into lines. Stores the bytes of an incomplete line.
#[derive(Clone, Debug, Default)]
pub struct LineSplitter {
    partial: Vec<u8>,
    /// True while the rest of an overlong line is skipped, up to the next line end.
    overlong: bool,
}

impl LineSplitter {
    /// Adds `bytes` to the stored incomplete line. Returns the lines that these bytes complete, without empty lines. If
    /// a line exceeds the maximum length of 200 bytes, returns its beginning as overlong data and ignores its rest.
    pub fn push(&mut self, bytes: &[u8]) -> Vec<ReceivedLine> {
        let mut gathered = Vec::new();
        for &byte in bytes {
            match byte {
                b'\r' | b'\n' if self.overlong => self.overlong = false,
                b'\r' | b'\n' => {
                    let line = std::mem::take(&mut self.partial);
                    // A line of blanks is ignored too.
                    if !line.trim_ascii().is_empty() {
                        gathered.push(ReceivedLine::Line(text(&line)));
                    }
                }
                _ if self.overlong => {}
                _ => self.partial.push(byte),
            }
            if self.partial.len() > MAX_LINE_LENGTH {
                self.overlong = true;
                gathered.push(ReceivedLine::Endless(text(&std::mem::take(&mut self.partial))));
            }
        }
        gathered
    }

    /// Returns true if a line has begun and not ended.
    pub fn has_partial_line(&self) -> bool {
        !self.partial.is_empty()
    }

    /// Discards the stored line that has begun and not ended. Returns the text of this line. Returns `None` if no line
    /// has begun, or if the line contains only blanks.
    pub fn give_up(&mut self) -> Option<String> {
        self.overlong = false;
        let line = std::mem::take(&mut self.partial);
        (!line.trim_ascii().is_empty()).then(|| text(&line))
    }
}

/// Converts `bytes` (UTF-8) to text. Invalid bytes become the replacement character U+FFFD, which no line format
/// accepts.
fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> ReceivedLine {
        ReceivedLine::Line(text.to_owned())
    }

    #[test]
    fn line_splitter_any_chunks_and_endings() {
        let bytes = b"1,2,3\r\n4,5,6\r7,8,9\n\r\n  \r\n10,11";
        for piece in 1..bytes.len() {
            let mut lines = LineSplitter::default();
            let gathered: Vec<ReceivedLine> = bytes.chunks(piece).flat_map(|piece| lines.push(piece)).collect();
            assert_eq!(gathered, [line("1,2,3"), line("4,5,6"), line("7,8,9")], "{piece}");
            assert!(lines.has_partial_line());
            assert_eq!(lines.give_up().as_deref(), Some("10,11"));
            assert_eq!((lines.has_partial_line(), lines.give_up()), (false, None));
        }
    }

    #[test]
    fn line_splitter_drops_endless_line() {
        let mut lines = LineSplitter::default();
        let gathered = lines.push(&[[b'7'; 1000].as_slice(), b"\r\n1,2,3\r\n"].concat());
        assert!(
            matches!(&gathered[..], [ReceivedLine::Endless(_), ReceivedLine::Line(line)] if line == "1,2,3"),
            "{gathered:?}"
        );
        assert!(matches!(&lines.push(b"\xff\xfe\n")[..], [ReceivedLine::Line(line)] if line.contains('\u{fffd}')));
    }
}
