//! Splitting of program lines into words and comments. Content that makes the position of the tool unknowable is
//! rejected.

/// Word of a line: a letter and its number, with the text as written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct GcodeWord<'a> {
    pub(super) letter: u8,
    pub(super) value: f64,
    pub(super) text: &'a str,
}

/// A line split into words and comments.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Block<'a> {
    pub(super) words: Vec<GcodeWord<'a>>,
    /// Comments as written, with their marks.
    pub(super) comments: Vec<&'a str>,
    /// True for a line that is only a percent sign.
    pub(super) percent: bool,
}

/// Fault of a line, and the remedy.
pub(super) type Refusal = (String, &'static str);

/// Longest line that LinuxCNC accepts.
const LONGEST_LINE: usize = 255;

/// Splits a line of a program into words and comments.
///
/// # Errors
/// A slash at the beginning (block delete); variables, expressions and O-words; a letter without a number; a comment
/// without an end; any other character; a line of more than 255 characters.
pub(super) fn block(line: &str) -> Result<Block<'_>, Refusal> {
    if line.len() > LONGEST_LINE {
        let found = format!("the line has {} characters, and controllers read at most {LONGEST_LINE}", line.len());
        return Err((found, "check that the file is a program, and divide the line"));
    }
    let mut block = Block::default();
    let bytes = line.as_bytes();
    let mut at = 0;
    while at < bytes.len() {
        match bytes[at] {
            b if b.is_ascii_whitespace() => at += 1,
            b'%' => (block.percent, at) = (true, at + 1),
            b';' => {
                block.comments.push(line.get(at..).unwrap_or_default());
                break;
            }
            b'(' => {
                let end = bytes[at..].iter().position(|b| *b == b')').map(|n| at + n + 1);
                let end = end.ok_or_else(|| ("a comment has no end".to_owned(), "close its bracket"))?;
                block.comments.push(line.get(at..end).unwrap_or_default());
                at = end;
            }
            letter if letter.is_ascii_alphabetic() => {
                let (word, end) = word(line, at)?;
                block.words.push(word);
                at = end;
            }
            b'/' => {
                let remedy = "delete the line or the slash: the correction must know whether the line runs";
                return Err(("the line begins with a slash, so a switch can skip it".into(), remedy));
            }
            b'#' | b'[' | b'<' | b'=' => return Err(expression()),
            other => {
                let found = format!("{:?} cannot be read", char::from(other));
                return Err((found, "remove it, or write the program out in plain words and numbers"));
            }
        }
    }
    Ok(block)
}

fn expression() -> Refusal {
    let remedy = "let the CAM system write the program out in plain numbers";
    ("the line has a variable or an expression; only the controller knows its value".into(), remedy)
}

/// Returns the word that begins at the byte `at` of `line`, and the index of the byte after the word.
///
/// # Errors
/// A letter without a number; an O-word; a variable or an expression in place of the number.
fn word(line: &str, at: usize) -> Result<(GcodeWord<'_>, usize), Refusal> {
    let bytes = line.as_bytes();
    let letter = bytes[at].to_ascii_uppercase();
    if letter == b'O' {
        let remedy = "let the CAM system write loops and subprograms out";
        return Err(("an O-word calls or repeats other lines".into(), remedy));
    }
    let mut begin = at + 1;
    while bytes.get(begin).is_some_and(u8::is_ascii_whitespace) {
        begin += 1;
    }
    let is_number = |b: &u8| b.is_ascii_digit() || matches!(b, b'+' | b'-' | b'.');
    let end = begin + bytes[begin..].iter().take_while(|b| is_number(b)).count();
    if matches!(bytes.get(begin), Some(b'#' | b'[' | b'<')) {
        return Err(expression());
    }
    let number = line.get(begin..end).unwrap_or_default();
    match number.parse::<f64>() {
        Ok(value) if value.abs() <= super::number::MAX_COORDINATE_MM => {
            Ok((GcodeWord { letter, value, text: line.get(at..end).unwrap_or_default() }, end))
        }
        _ => Err((
            format!("{} is followed by {number:?}, which is not a number", char::from(letter)),
            "write a number with a point and without an exponent",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn block_splits_words_and_comments() {
        let block = block("n10 G1x-1.5 Y + 2. (to (here) z.25;rest").map(|b| b.words.len());
        // Blanks within a number are not accepted.
        assert!(block.is_err());
        let block = super::block("n10 G1x-1.5 Y+2. (to here) z.25;rest (of it").unwrap();
        let words: Vec<(char, f64)> = block.words.iter().map(|w| (char::from(w.letter), w.value)).collect();
        assert_eq!(words, [('N', 10.0), ('G', 1.0), ('X', -1.5), ('Y', 2.0), ('Z', 0.25)]);
        assert_eq!(block.comments, ["(to here)", ";rest (of it"]);
        assert!(super::block("%").unwrap().percent);
    }

    #[test]
    fn block_refuses_unsupported_syntax() {
        for line in
            ["/G1 X1", "G1 X#5", "G1 X[1+2]", "O100 call", "G1 X", "G1 X--1", "(open", "G1 X1 $", "G1 X1e", "\u{e9}"]
        {
            assert!(block(line).is_err(), "{line}");
        }
        assert!(block(&"X1".repeat(200)).is_err());
    }
}
