//! Names of files with `*` for any characters, and with the part, the job and the cycle filled in.

/// A pattern for the names of files in one folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern(String);

impl Pattern {
    /// Takes a pattern as it is written: `*` stands for any characters, `{part}`, `{job}` and `{cycle}` for what they say.
    pub fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }

    /// Fills in part, job and cycle.
    pub fn filled(&self, part: &str, job: u32, cycle: u16) -> Self {
        let filled = self.0.replace("{part}", &file_word(part)).replace("{job}", &job.to_string());
        Self(filled.replace("{cycle}", &cycle.to_string()))
    }

    /// Returns whether a name fits; case matters.
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

    /// Returns what the one star of a pattern stands for in a name; nothing if the name does not fit or there is not one star.
    pub fn star<'n>(&self, name: &'n str) -> Option<&'n str> {
        let (before, after) = self.0.split_once('*').filter(|(_, after)| !after.contains('*'))?;
        name.strip_prefix(before)?.strip_suffix(after)
    }

    /// Puts a text in the place of the star.
    pub fn with_star(&self, text: &str) -> Self {
        Self(self.0.replacen('*', text, 1))
    }

    /// The pattern as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Returns a text as a word that every file system takes.
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
    fn stars_stand_for_anything() {
        let fits = |pattern: &str, name: &str| Pattern::new(pattern).fits(name);
        assert!(fits("M1_1.txt", "M1_1.txt") && !fits("M1_1.txt", "M1_1.txt~") && !fits("M1_1.txt", "xM1_1.txt"));
        assert!(fits("M1_*.txt", "M1_.txt") && fits("M1_*.txt", "M1_12.txt") && !fits("M1_*.txt", "ref_1.txt"));
        assert!(fits("*a*b*", "xaxbx") && !fits("*a*b*", "xbxax") && fits("*", ""));
        // One character cannot serve two pieces.
        assert!(!fits("ab*ba", "aba") && fits("ab*ba", "abba"));
    }

    #[test]
    fn one_star_pairs_two_names() {
        let points = Pattern::new("M1_*.txt");
        assert_eq!(points.star("M1_12.txt"), Some("12"));
        assert_eq!(
            (points.star("M2_1.txt"), Pattern::new("a*b*").star("axbx"), Pattern::new("a").star("a")),
            (None, None, None)
        );
        assert_eq!(Pattern::new("ref_*.yaml").with_star("12").as_str(), "ref_12.yaml");
    }

    #[test]
    fn part_and_cycle_are_filled_in_and_cannot_leave_the_folder() {
        let filled = Pattern::new("{part}_c{cycle}.*").filled("../A 7", 3, 2);
        assert_eq!(filled.as_str(), "_.._A_7_c2.*");
        assert_eq!(file_word(""), "_");
        assert_eq!(file_word("SN-0042.b"), "SN-0042.b");
    }
}
