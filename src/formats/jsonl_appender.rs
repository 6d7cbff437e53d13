//! Files to which lines are appended as events occur.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::sync::{Arc, Mutex};

use serde::Serialize;

use super::FormatError;

/// File to which lines of JSON are appended. Clones append to the same file, from any thread.
#[derive(Clone, Debug)]
pub struct JsonlAppender {
    file: Arc<Mutex<File>>,
}

impl JsonlAppender {
    /// Opens a file for appending, or creates it. Existing content is preserved.
    ///
    /// # Errors
    /// A file that is not writable.
    pub fn open(path: &Path) -> Result<Self, FormatError> {
        let file = OpenOptions::new().append(true).create(true).open(path);
        let file =
            file.map_err(|source| FormatError::Unwritable { path: path.to_owned(), action: "opening it", source })?;
        Ok(Self { file: Arc::new(Mutex::new(file)) })
    }

    /// Appends `line` as one line of JSON, in one write. Errors are ignored, for example if the disk is full: a lost
    /// line of a log must not stop the program.
    pub fn append(&self, line: &impl Serialize) {
        let Ok(mut text) = serde_json::to_string(line) else { return };
        text.push('\n');
        if let Ok(mut file) = self.file.lock() {
            let _ = file.write_all(text.as_bytes());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jsonl_appender_appends_lines() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lines");
        for line in 1..=2 {
            let lines = JsonlAppender::open(&path).unwrap();
            lines.append(&[line]);
            lines.clone().append(&"more");
        }
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "[1]\n\"more\"\n[2]\n\"more\"\n");
        assert!(JsonlAppender::open(folder.path()).unwrap_err().to_string().contains("opening it"));
    }
}
