//! Patterns for file names: `*` for any characters, and placeholders for the part, the job and the cycle.

/// Pattern for the names of files in one folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern(String);

impl Pattern {
    /// Creates a pattern for file names from `text`. In `text`, a star (`*`) matches any characters. The words
    /// `{part}`, `{job}` and `{cycle}` are placeholders for the name of the part, the number of the job and the number
    /// of the cycle.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// Returns this pattern with `part`, `job` and `cycle` in place of the placeholders. Characters of `part` that a
    /// file name must not contain become `_`.
    pub fn filled(&self, part: &str, job: u32, cycle: u16) -> Self {
        let filled = self.0.replace("{part}", &file_word(part)).replace("{job}", &job.to_string());
        Self(filled.replace("{cycle}", &cycle.to_string()))
    }

    /// Returns true if the whole `name` matches this pattern. Upper-case and lower-case letters are different.
    pub fn fits(&self, name: &str) -> bool {
        let mut pieces = self.0.split('*');
        let first = pieces.next().unwrap_or_default();
        let Some(mut rest) = name.strip_prefix(first) else { return false };
        let mut pieces: Vec<&str> = pieces.collect();
        let Some(last) = pieces.pop() else { return rest.is_empty() };
        for piece in pieces {
            match rest.find(piece) {
                Some(at) => rest = &rest[at + piece.len()..],
                None => return false,
            }
        }
        rest.ends_with(last)
    }

    /// Returns the characters of `name` that the `*` of this pattern matches. Returns `None` if `name` does not match,
    /// or if the pattern does not contain exactly one `*`.
    pub fn star<'n>(&self, name: &'n str) -> Option<&'n str> {
        let (before, after) = self.0.split_once('*').filter(|(_, after)| !after.contains('*'))?;
        name.strip_prefix(before)?.strip_suffix(after)
    }

    /// Returns this pattern with `text` in place of its first `*`. Returns the pattern unchanged if it contains no `*`.
    pub fn with_star(&self, text: &str) -> Self {
        Self(self.0.replacen('*', text, 1))
    }

    /// Returns the pattern as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Returns `text` in a form that every file system accepts as part of a file name. Any character other than letters,
/// digits, `-`, `_` and `.` becomes `_`. If the text is empty or begins with a dot, it gets an additional `_` at the
/// beginning, because a leading dot would hide the file.
pub fn file_word(text: &str) -> String {
    let word: String =
        text.chars().map(|c| if c.is_alphanumeric() || matches!(c, '-' | '_' | '.') { c } else { '_' }).collect();
    // A leading dot would hide the file.
    if word.is_empty() || word.starts_with('.') { format!("_{word}") } else { word }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pattern_star_matches_anything() {
        let fits = |pattern: &str, name: &str| Pattern::new(pattern).fits(name);
        assert!(fits("M1_1.txt", "M1_1.txt") && !fits("M1_1.txt", "M1_1.txt~") && !fits("M1_1.txt", "xM1_1.txt"));
        assert!(fits("M1_*.txt", "M1_.txt") && fits("M1_*.txt", "M1_12.txt") && !fits("M1_*.txt", "ref_1.txt"));
        assert!(fits("*a*b*", "xaxbx") && !fits("*a*b*", "xbxax") && fits("*", ""));
        // One character cannot match two pieces.
        assert!(!fits("ab*ba", "aba") && fits("ab*ba", "abba"));
    }

    #[test]
    fn pattern_star_pairs_names() {
        let points = Pattern::new("M1_*.txt");
        assert_eq!(points.star("M1_12.txt"), Some("12"));
        assert_eq!(
            (points.star("M2_1.txt"), Pattern::new("a*b*").star("axbx"), Pattern::new("a").star("a")),
            (None, None, None)
        );
        assert_eq!(Pattern::new("ref_*.yaml").with_star("12").as_str(), "ref_12.yaml");
    }

    #[test]
    fn pattern_fill_stays_in_folder() {
        let filled = Pattern::new("{part}_c{cycle}.*").filled("../A 7", 3, 2);
        assert_eq!(filled.as_str(), "_.._A_7_c2.*");
        assert_eq!(file_word(""), "_");
        assert_eq!(file_word("SN-0042.b"), "SN-0042.b");
    }
}
