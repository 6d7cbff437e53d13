//! File of lines that a program appends to, and at times writes anew.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

/// Maximum length of a line that is read, in bytes. A longer line is read as several ones.
const LONGEST_LINE: u64 = 1 << 20;

/// File of lines. After an error, the next write writes the whole file anew.
#[derive(Debug)]
pub struct LineFile {
    path: PathBuf,
    /// Open for appending; `None` before the first write and after an error.
    file: Option<File>,
    count: usize,
}

impl LineFile {
    /// Returns the file at `path`, which need not exist. Writes nothing.
    pub fn at(path: PathBuf) -> Self {
        Self { path, file: None, count: 0 }
    }

    /// Reads the lines of the file, without their line feeds. A file that does not exist has none.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn lines(&self) -> io::Result<Vec<Vec<u8>>> {
        let mut read = match File::open(&self.path) {
            Ok(file) => BufReader::new(file),
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(error),
        };
        let mut lines = Vec::new();
        loop {
            let mut line = Vec::new();
            if (&mut read).take(LONGEST_LINE).read_until(b'\n', &mut line)? == 0 {
                return Ok(lines);
            }
            line.pop_if(|last| *last == b'\n');
            lines.push(line);
        }
    }

    /// Appends `line`, which has no line feed, in one write.
    ///
    /// # Errors
    /// A file that cannot be written. [`Self::write_anew`] is necessary then.
    pub fn append(&mut self, line: &str) -> io::Result<()> {
        let Some(mut file) = self.file.take() else {
            return Err(io::Error::other("the file is not open"));
        };
        file.write_all(format!("{line}\n").as_bytes())?;
        (self.file, self.count) = (Some(file), self.count + 1);
        Ok(())
    }

    /// Waits until the disk has all lines.
    ///
    /// # Errors
    /// A file that cannot be written, or is not open.
    pub fn sync(&self) -> io::Result<()> {
        self.file.as_ref().ok_or_else(|| io::Error::other("the file is not open"))?.sync_data()
    }

    /// Writes the file with `lines` and nothing else. A reader finds the earlier lines or these, also after a loss of
    /// power.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write_anew(&mut self, lines: &[String]) -> io::Result<()> {
        self.file = None;
        if !lines.is_empty() {
            let beside = self.path.with_extension("new");
            let mut file = File::create(&beside)?;
            file.write_all(lines.iter().map(|line| format!("{line}\n")).collect::<String>().as_bytes())?;
            file.sync_all()?;
            fs::rename(&beside, &self.path)?;
        }
        let file = OpenOptions::new().append(true).create(true).open(&self.path)?;
        if lines.is_empty() {
            file.set_len(0)?;
        }
        (self.file, self.count) = (Some(file), lines.len());
        Ok(())
    }

    /// Returns true if lines can be appended.
    pub fn is_open(&self) -> bool {
        self.file.is_some()
    }

    /// Returns the number of lines that were written.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_file_appends_and_replaces() {
        let home = tempfile::tempdir().unwrap();
        let mut file = LineFile::at(home.path().join("lines"));
        assert!(file.lines().unwrap().is_empty());
        assert!(file.append("too early").is_err());
        file.write_anew(&["a".into(), "b".into()]).unwrap();
        file.append("c").unwrap();
        assert_eq!((file.lines().unwrap(), file.count()), (vec![b"a".to_vec(), b"b".to_vec(), b"c".to_vec()], 3));
        file.write_anew(&[]).unwrap();
        file.append("d").unwrap();
        assert_eq!((file.lines().unwrap(), file.count()), (vec![b"d".to_vec()], 1));
    }
}
