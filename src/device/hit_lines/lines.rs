//! Splitter of bytes into lines. CR, LF or both end a line; an empty line is ignored.

/// Maximum length of a line, in bytes.
const LONGEST: usize = 200;

/// Result of the received bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Gathered {
    /// Line without its line end.
    Line(String),
    /// Beginning of data that are longer than any line.
    Endless(String),
}

/// Bytes of incomplete lines.
#[derive(Clone, Debug, Default)]
pub struct Lines {
    begun: Vec<u8>,
    /// True while the rest of an overlong line is skipped, up to the next line end.
    overlong: bool,
}

impl Lines {
    /// Adds bytes and returns the lines completed by them.
    pub fn take(&mut self, bytes: &[u8]) -> Vec<Gathered> {
        let mut gathered = Vec::new();
        for &byte in bytes {
            match byte {
                b'\r' | b'\n' if self.overlong => self.overlong = false,
                b'\r' | b'\n' => {
                    let line = std::mem::take(&mut self.begun);
                    // A line of blanks is ignored too.
                    if !line.trim_ascii().is_empty() {
                        gathered.push(Gathered::Line(text(&line)));
                    }
                }
                _ if self.overlong => {}
                _ => self.begun.push(byte),
            }
            if self.begun.len() > LONGEST {
                self.overlong = true;
                gathered.push(Gathered::Endless(text(&std::mem::take(&mut self.begun))));
            }
        }
        gathered
    }

    /// Returns true if a line has begun and not ended.
    pub fn has_begun(&self) -> bool {
        !self.begun.is_empty()
    }

    /// Discards an incomplete line and returns its text so far.
    pub fn give_up(&mut self) -> Option<String> {
        self.overlong = false;
        let line = std::mem::take(&mut self.begun);
        (!line.trim_ascii().is_empty()).then(|| text(&line))
    }
}

/// Converts bytes to text; invalid bytes become a character that no format contains.
fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str) -> Gathered {
        Gathered::Line(text.to_owned())
    }

    #[test]
    fn lines_are_the_same_however_their_bytes_come_and_whatever_ends_them() {
        let bytes = b"1,2,3\r\n4,5,6\r7,8,9\n\r\n  \r\n10,11";
        for piece in 1..bytes.len() {
            let mut lines = Lines::default();
            let gathered: Vec<Gathered> = bytes.chunks(piece).flat_map(|piece| lines.take(piece)).collect();
            assert_eq!(gathered, [line("1,2,3"), line("4,5,6"), line("7,8,9")], "{piece}");
            assert!(lines.has_begun());
            assert_eq!(lines.give_up().as_deref(), Some("10,11"));
            assert_eq!((lines.has_begun(), lines.give_up()), (false, None));
        }
    }

    #[test]
    fn what_never_ends_is_given_up_once_and_the_next_line_is_whole_again() {
        let mut lines = Lines::default();
        let gathered = lines.take(&[[b'7'; 1000].as_slice(), b"\r\n1,2,3\r\n"].concat());
        assert!(
            matches!(&gathered[..], [Gathered::Endless(_), Gathered::Line(line)] if line == "1,2,3"),
            "{gathered:?}"
        );
        assert!(matches!(&lines.take(b"\xff\xfe\n")[..], [Gathered::Line(line)] if line.contains('\u{fffd}')));
    }
}
