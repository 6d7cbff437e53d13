//! File that a browser has sent, until the machine for which it is has read it.

use std::path::{Path, PathBuf};

use super::error::FormatError;
use super::folder::{ResultFolder, ScratchFolder};
use super::registration::write_private;

/// Maximum length of the name of a file.
const MAX_NAME_LENGTH: usize = 80;

/// File in a folder of its own below the folder of a run. Both are removed when the value is dropped.
#[derive(Debug)]
pub struct UploadedFile {
    folder: ScratchFolder,
    path: PathBuf,
}

impl UploadedFile {
    /// Stores `bytes` below the folder `run`, so that only its owner can read them. `name` is the name of the file at the
    /// computer of the person; characters other than letters, digits, `.`, `-` and `_` are replaced. Replaces a file
    /// that was stored before and not removed.
    ///
    /// # Errors
    /// A folder or a file that cannot be written.
    pub fn store(run: &Path, name: &str, bytes: &[u8]) -> Result<Self, FormatError> {
        // The program that reads it can have another working folder.
        let run = std::path::absolute(run).unwrap_or_else(|_| run.to_owned());
        let folder = ScratchFolder::at(run.join(".uploaded"))?;
        ResultFolder::prepare(folder.path())?.keep();
        let path = folder.path().join(plain_name(name));
        write_private(&path, bytes)?;
        Ok(Self { folder, path })
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the message `message` with the name of the file in place of its path.
    pub fn without_folder(&self, message: &str) -> String {
        message.replace(&format!("{}/", self.folder.path().display()), "")
    }
}

/// Returns the last part of a path, in characters that are plain in each system and each message.
fn plain_name(name: &str) -> String {
    let last = name.rsplit(['/', '\\']).next().unwrap_or_default();
    let plain: String =
        last.chars().map(|c| if c.is_alphanumeric() || matches!(c, '.' | '-' | '_') { c } else { '_' }).collect();
    let begins = plain.chars().count().saturating_sub(MAX_NAME_LENGTH);
    // The end has the kind of the file.
    let plain: String = plain.chars().skip(begins).collect();
    if plain.chars().all(|c| c == '.') { "measurement.txt".to_owned() } else { plain }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uploaded_file_removed_after_use() {
        let run = tempfile::tempdir().unwrap();
        let file = UploadedFile::store(run.path(), "points of the part.csv", b"1 2 3").unwrap();
        assert_eq!(std::fs::read(file.path()).unwrap(), b"1 2 3");
        let message = format!("{}: line 3 has two numbers", file.path().display());
        assert_eq!(file.without_folder(&message), "points_of_the_part.csv: line 3 has two numbers");
        drop(file);
        assert_eq!(std::fs::read_dir(run.path()).unwrap().count(), 0);
    }

    #[test]
    fn uploaded_file_replaces_one_left_behind() {
        let run = tempfile::tempdir().unwrap();
        std::mem::forget(UploadedFile::store(run.path(), "a.csv", b"old").unwrap());
        let file = UploadedFile::store(run.path(), "b.csv", b"new").unwrap();
        assert_eq!(std::fs::read_dir(file.path().parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn uploaded_name_stays_in_folder() {
        for (name, plain) in [
            ("../../etc/passwd", "passwd"),
            ("C:\\data\\part 1.TXT", "part_1.TXT"),
            ("", "measurement.txt"),
            ("..", "measurement.txt"),
            ("messung-Ä.csv", "messung-Ä.csv"),
        ] {
            assert_eq!(plain_name(name), plain, "{name}");
        }
        assert!(plain_name(&format!("{}.csv", "a".repeat(300))).ends_with("a.csv"));
        assert_eq!(plain_name(&"b".repeat(300)).len(), MAX_NAME_LENGTH);
    }
}
