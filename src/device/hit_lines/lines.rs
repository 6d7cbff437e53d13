//! Bytes put together to lines. A line ends with CR, LF or both; one without anything in it is none.

/// Longest line.
const LONGEST: usize = 200;

/// What bytes came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Gathered {
    /// A line without its end.
    Line(String),
    /// Something that goes on for longer than any line; its beginning.
    Endless(String),
}

/// Bytes on their way to lines.
#[derive(Clone, Debug, Default)]
pub struct Lines {
    begun: Vec<u8>,
    /// The rest of what has been given up, up to the next end of a line.
    overlong: bool,
}

impl Lines {
    /// Takes bytes as they come, and returns what they bring to an end.
    pub fn take(&mut self, bytes: &[u8]) -> Vec<Gathered> {
        let mut gathered = Vec::new();
        for &byte in bytes {
            match byte {
                b'\r' | b'\n' if self.overlong => self.overlong = false,
                b'\r' | b'\n' => {
                    let line = std::mem::take(&mut self.begun);
                    // Blanks alone are no line either.
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

    /// Whether a line has begun and not ended.
    pub fn has_begun(&self) -> bool {
        !self.begun.is_empty()
    }

    /// Gives up a line that has begun, and returns what there is of it.
    pub fn give_up(&mut self) -> Option<String> {
        self.overlong = false;
        let line = std::mem::take(&mut self.begun);
        (!line.trim_ascii().is_empty()).then(|| text(&line))
    }
}

/// Bytes that are no text become a mark that no format has.
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
