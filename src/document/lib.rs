//! TOML file written by a person, and its problems: all of them together, each with its line and column.
//!
//! ```text
//!  text -> syntax -> shape (the JSON schema: keys, types, ranges) -> what is left, as written -> the reader's own checks
//! ```
//!
//! Editors complete from the same schema that checks the files, so the two always agree. A value that does not fit the
//! schema is reported and removed. The checks between values then still run on the rest.

mod read;
mod schema;
mod shown;

use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

pub use read::Document;
pub use read::{problem_at, read_text, sha256};
pub use schema::schema_of;
pub use shown::{countable, misleading, visible, visible_line};

/// Key that has a new name. Both names are paths from the root of the file, without indices.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RenamedKey {
    /// Name in earlier versions.
    pub old: &'static str,
    /// Present name.
    pub new: &'static str,
}

/// All problems of one file.
#[derive(Clone, Debug, PartialEq)]
pub struct Problems {
    /// The file.
    pub file: PathBuf,
    /// Text of the file. Empty if it could not be read.
    pub text: String,
    /// Problems in the order of the text. Never empty.
    pub problems: Vec<Problem>,
}

/// One problem of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Problem {
    /// Position as a range of bytes in the text.
    pub span: Range<usize>,
    /// Key as a path, such as `measure.probe_radius_mm`. Empty for the file as a whole.
    pub key: String,
    /// Value that was found.
    pub found: String,
    /// Allowed values.
    pub allowed: String,
    /// Action that solves the problem.
    pub remedy: String,
}

impl Problems {
    /// Creates a list with one problem that concerns the whole file and has no position. `text` is the content of the
    /// file, `found` describes the problem, and `remedy` describes how to solve it.
    pub fn whole(file: &Path, text: &str, found: String, remedy: &str) -> Self {
        let problem =
            Problem { span: 0..0, key: String::new(), found, allowed: String::new(), remedy: remedy.to_owned() };
        Self { file: file.to_owned(), text: text.to_owned(), problems: vec![problem] }
    }

    /// Returns line and column of a problem. Both count from 1; the column counts characters.
    pub fn place(&self, problem: &Problem) -> (usize, usize) {
        line_and_column(&self.text, problem.span.start)
    }
}

impl std::error::Error for Problems {}

impl fmt::Display for Problems {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (k, problem) in self.problems.iter().enumerate() {
            let (line, column) = self.place(problem);
            let newline = if k > 0 { "\n" } else { "" };
            write!(out, "{newline}{}:{line}:{column}: {problem}", self.file.display())?;
        }
        Ok(())
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.key.is_empty() {
            write!(out, "`{}` ", self.key)?;
        }
        write!(out, "{}", self.found)?;
        if !self.allowed.is_empty() {
            write!(out, "; {}", self.allowed)?;
        }
        if !self.remedy.is_empty() {
            write!(out, "; {}", self.remedy)?;
        }
        Ok(())
    }
}

/// Returns the line and the column of the byte at index `byte` of `text`. Both count from 1; the column counts
/// characters.
fn line_and_column(text: &str, byte: usize) -> (usize, usize) {
    let before = text.get(..byte).unwrap_or(text);
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    (before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}
