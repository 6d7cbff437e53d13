//! Folder of a shop's recipes, with every version that was saved from the page.
//!
//! ```text
//!  recipes/mirror.toml                  what runs use
//!  recipes/.versions/mirror.toml/1.toml the text of version 1
//!                                1.json who saved it, and when
//! ```
//!
//! A text that another program has changed becomes a version of its own before it is replaced, so no text is lost.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use data_encoding::HEXLOWER;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::FormatError;
use super::folder::ResultFolder;
use super::registration::write_atomic;

/// Folder of the versions, below the folder of the recipes.
const VERSIONS: &str = ".versions";
/// Maximum length of the name of a recipe, in bytes.
const MAX_NAME_BYTES: usize = 100;
/// Extension of a recipe.
const EXTENSION: &str = ".toml";

/// Folder of recipes.
#[derive(Clone, Debug)]
pub struct RecipeFolder(PathBuf);

/// Saved version of a recipe.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecipeVersion {
    /// Number, from 1.
    pub version: u32,
    /// Person who saved it; empty if another program had changed the file.
    pub saved_by: String,
    /// Time at which it was saved, UTC; empty if another program had changed the file.
    pub saved_at: String,
    /// SHA-256 of its text, in hexadecimal digits.
    pub sha256: String,
}

impl RecipeFolder {
    /// Maximum size of a recipe, in bytes.
    pub const MAX_BYTES: u64 = 1 << 20;

    /// Creates the value for the folder `path`. Does not read the disk.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Returns the path of the recipe named `name`. Does not check that it exists. Returns `None` if the name is not
    /// plain: empty, longer than 100 bytes, without `.toml` at its end, with a dot at its beginning, or with a character
    /// that a system does not allow in names.
    pub fn file(&self, name: &str) -> Option<PathBuf> {
        let stem = name.strip_suffix(EXTENSION)?;
        let is_plain = |c: char| !c.is_control() && !matches!(c, '/' | '\\' | ':' | '*' | '?' | '"' | '<' | '>' | '|');
        let is_good = !stem.trim().is_empty()
            && name.len() <= MAX_NAME_BYTES
            && !name.starts_with(['.', ' '])
            && !stem.ends_with(['.', ' '])
            && name.chars().all(is_plain)
            && !is_device_name(stem);
        is_good.then(|| self.0.join(name))
    }

    /// Returns the names of the recipes in the folder, sorted. A recipe is a file with a table `[part]`.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn names(&self) -> Result<Vec<String>, FormatError> {
        let entries = fs::read_dir(&self.0).map_err(|source| unreadable(&self.0, source))?;
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let is_recipe = |name: &String| {
            let text = self.file(name).and_then(|path| read_text(&path).ok());
            text.is_some_and(|text| text.lines().any(|line| line.trim_start().starts_with("[part]")))
        };
        let mut names: Vec<String> = names.filter(is_recipe).collect();
        names.sort();
        Ok(names)
    }

    /// Returns the text of the recipe named `name`. Returns `None` if there is no such file.
    ///
    /// # Errors
    /// The file cannot be read, is larger than [`Self::MAX_BYTES`], or is not text.
    pub fn text(&self, name: &str) -> Result<Option<String>, FormatError> {
        let Some(path) = self.file(name) else { return Ok(None) };
        match read_text(&path) {
            Ok(text) => Ok(Some(text)),
            Err(FormatError::Unreadable { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Returns the saved versions of the recipe named `name`, the first one first. The list is empty if none was saved.
    ///
    /// # Errors
    /// The folder of the versions cannot be read, or the description of a version is damaged.
    pub fn versions(&self, name: &str) -> Result<Vec<RecipeVersion>, FormatError> {
        let Some(folder) = self.folder_of_versions(name) else { return Ok(Vec::new()) };
        let entries = match fs::read_dir(&folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(source) => return Err(unreadable(&folder, source)),
        };
        let number = |entry: fs::DirEntry| entry.file_name().to_str()?.strip_suffix(".json")?.parse::<u32>().ok();
        let mut numbers: Vec<u32> = entries.filter_map(|entry| number(entry.ok()?)).collect();
        numbers.sort_unstable();
        numbers.into_iter().map(|number| read_version(&folder, number)).collect()
    }

    /// Returns the text of the saved version `number` of the recipe named `name`. Returns `None` if there is no such
    /// version.
    ///
    /// # Errors
    /// The file cannot be read, or differs from its description.
    pub fn text_of_version(&self, name: &str, number: u32) -> Result<Option<String>, FormatError> {
        let Some(folder) = self.folder_of_versions(name) else { return Ok(None) };
        let path = folder.join(format!("{number}{EXTENSION}"));
        if !path.exists() {
            return Ok(None);
        }
        let text = read_text(&path)?;
        match read_version(&folder, number)?.sha256 == sha256(&text) {
            true => Ok(Some(text)),
            false => Err(FormatError::ChangedVersion { path }),
        }
    }

    /// Saves `text` as the recipe named `name`, and as its next version. `replaces` is the text that the person has seen:
    /// it must be the present one, or `None` for a new recipe. `saved_by` is the person, and `saved_at` the time in UTC.
    /// If the text is already that of the file and of the newest version, saves nothing and returns that version.
    ///
    /// # Errors
    /// A name that is not plain; a text that is too long; a file that was changed meanwhile; a file that cannot be read
    /// or written.
    pub fn save(
        &self,
        name: &str,
        text: &str,
        replaces: Option<&str>,
        [saved_by, saved_at]: [&str; 2],
    ) -> Result<RecipeVersion, FormatError> {
        let (Some(path), Some(folder)) = (self.file(name), self.folder_of_versions(name)) else {
            return Err(FormatError::RecipeName { name: name.to_owned() });
        };
        let found = text.len() as u64;
        if found > Self::MAX_BYTES {
            return Err(FormatError::TooLarge { path, found, limit: Self::MAX_BYTES, unit: "bytes" });
        }
        ResultFolder::prepare(&folder)?.keep();
        let _lock = SavingLock::acquire(&folder)?;
        let present = self.text(name)?;
        if present.as_deref() != replaces {
            return Err(FormatError::ChangedMeanwhile { path });
        }
        let mut versions = self.versions(name)?;
        if let Some(present) = &present
            && versions.last().is_none_or(|last| last.sha256 != sha256(present))
        {
            versions.push(write_version(&folder, next(&versions), present, [""; 2])?);
        }
        if let Some(last) = versions.last()
            && present.as_deref() == Some(text)
        {
            return Ok(last.clone());
        }
        let saved = write_version(&folder, next(&versions), text, [saved_by, saved_at])?;
        write_atomic(&path, text.as_bytes())?;
        Ok(saved)
    }

    fn folder_of_versions(&self, name: &str) -> Option<PathBuf> {
        self.file(name).map(|_| self.0.join(VERSIONS).join(name))
    }
}

fn next(versions: &[RecipeVersion]) -> u32 {
    versions.last().map_or(1, |last| last.version.saturating_add(1))
}

/// Lock that lets one program save a recipe at a time.
struct SavingLock(File);

impl SavingLock {
    fn acquire(folder: &Path) -> Result<Self, FormatError> {
        let path = folder.join("lock");
        let failed = |source| FormatError::Unwritable { path: path.clone(), action: "locking it", source };
        let file = File::options().create(true).truncate(false).write(true).open(&path).map_err(failed)?;
        file.lock().map_err(failed)?;
        Ok(Self(file))
    }
}

impl Drop for SavingLock {
    fn drop(&mut self) {
        // A program that was started meanwhile has a copy of the file, so closing it is not enough.
        let _ = self.0.unlock();
    }
}

/// Writes a version: its text first, so that a description never stands alone.
fn write_version(
    folder: &Path,
    number: u32,
    text: &str,
    [saved_by, saved_at]: [&str; 2],
) -> Result<RecipeVersion, FormatError> {
    let version = RecipeVersion {
        version: number,
        saved_by: saved_by.to_owned(),
        saved_at: saved_at.to_owned(),
        sha256: sha256(text),
    };
    write_atomic(&folder.join(format!("{number}{EXTENSION}")), text.as_bytes())?;
    let path = folder.join(format!("{number}.json"));
    let description = serde_json::to_vec_pretty(&version).map_err(|error| unreadable(&path, error.into()))?;
    write_atomic(&path, &description)?;
    Ok(version)
}

fn read_version(folder: &Path, number: u32) -> Result<RecipeVersion, FormatError> {
    let path = folder.join(format!("{number}.json"));
    let text = read_text(&path)?;
    let version: RecipeVersion = serde_json::from_str(&text).map_err(|error| unreadable(&path, error.into()))?;
    match version.version == number {
        true => Ok(version),
        false => Err(FormatError::ChangedVersion { path }),
    }
}

/// Reads a text file that is not larger than a recipe. A pipe or a device is refused before it is opened, because reading
/// it can wait for ever.
fn read_text(path: &Path) -> Result<String, FormatError> {
    let failed = |source| unreadable(path, source);
    if !fs::metadata(path).map_err(failed)?.is_file() {
        return Err(failed(io::Error::new(io::ErrorKind::InvalidInput, "it is not a file")));
    }
    let mut bytes = Vec::new();
    let file = File::open(path).map_err(failed)?;
    file.take(RecipeFolder::MAX_BYTES + 1).read_to_end(&mut bytes).map_err(failed)?;
    if bytes.len() as u64 > RecipeFolder::MAX_BYTES {
        let (found, limit) = (bytes.len() as u64, RecipeFolder::MAX_BYTES);
        return Err(FormatError::TooLarge { path: path.to_owned(), found, limit, unit: "bytes" });
    }
    String::from_utf8(bytes).map_err(|error| failed(io::Error::new(io::ErrorKind::InvalidData, error)))
}

/// Returns true for a name that Windows gives to a device, such as `CON`.
fn is_device_name(stem: &str) -> bool {
    let first = stem.split('.').next().unwrap_or_default().to_ascii_uppercase();
    let numbered =
        |of: &str| first.strip_prefix(of).is_some_and(|n| n.len() == 1 && n.chars().all(|c| c.is_ascii_digit()));
    matches!(first.as_str(), "CON" | "PRN" | "AUX" | "NUL") || numbered("COM") || numbered("LPT")
}

fn unreadable(path: &Path, source: io::Error) -> FormatError {
    FormatError::Unreadable { path: path.to_owned(), source }
}

fn sha256(text: &str) -> String {
    HEXLOWER.encode(&Sha256::digest(text))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAME: &str = "mirror.toml";
    const BY: [&str; 2] = ["A. Smith", "2026-01-02T03:04:05Z"];

    fn folder() -> (tempfile::TempDir, RecipeFolder) {
        let home = tempfile::tempdir().unwrap();
        let recipes = RecipeFolder::at(home.path());
        (home, recipes)
    }

    #[test]
    fn each_saved_text_is_a_version() {
        let (_home, recipes) = folder();
        assert_eq!(recipes.text(NAME).unwrap(), None);
        assert_eq!(recipes.versions(NAME).unwrap(), []);
        let first = recipes.save(NAME, "[part]\n", None, BY).unwrap();
        assert_eq!((first.version, first.saved_by.as_str(), first.saved_at.as_str()), (1, BY[0], BY[1]));
        let second = recipes.save(NAME, "[part]\nname = \"a\"\n", Some("[part]\n"), BY).unwrap();
        assert_eq!(recipes.text(NAME).unwrap().unwrap(), "[part]\nname = \"a\"\n");
        assert_eq!(recipes.versions(NAME).unwrap(), [first, second.clone()]);
        assert_eq!(recipes.text_of_version(NAME, 1).unwrap().unwrap(), "[part]\n");
        assert_eq!(recipes.text_of_version(NAME, 3).unwrap(), None);
        // The same text again is no new version.
        let same = "[part]\nname = \"a\"\n";
        assert_eq!(recipes.save(NAME, same, Some(same), BY).unwrap(), second);
        assert_eq!(recipes.names().unwrap(), [NAME]);
    }

    #[test]
    fn text_of_another_program_is_kept_and_not_overwritten() {
        let (home, recipes) = folder();
        fs::write(home.path().join(NAME), "[part]\n# by hand\n").unwrap();
        let error = recipes.save(NAME, "[part]\n", None, BY).unwrap_err();
        assert!(matches!(error, FormatError::ChangedMeanwhile { .. }), "{error}");
        assert_eq!(recipes.text(NAME).unwrap().unwrap(), "[part]\n# by hand\n");
        let saved = recipes.save(NAME, "[part]\n", Some("[part]\n# by hand\n"), BY).unwrap();
        assert_eq!(saved.version, 2);
        assert_eq!(recipes.text_of_version(NAME, 1).unwrap().unwrap(), "[part]\n# by hand\n");
        assert_eq!(recipes.versions(NAME).unwrap()[0].saved_by, "");
    }

    #[test]
    fn damaged_version_is_refused() {
        let (home, recipes) = folder();
        recipes.save(NAME, "[part]\n", None, BY).unwrap();
        let versions = home.path().join(VERSIONS).join(NAME);
        fs::write(versions.join("1.toml"), "[part]\nname = \"forged\"\n").unwrap();
        assert!(matches!(recipes.text_of_version(NAME, 1), Err(FormatError::ChangedVersion { .. })));
        fs::write(versions.join("1.json"), "{}").unwrap();
        assert!(recipes.versions(NAME).is_err());
    }

    #[test]
    fn names_that_lead_elsewhere_are_refused() {
        let (_home, recipes) = folder();
        let long = format!("{}.toml", "a".repeat(100));
        let bad = [
            "",
            ".toml",
            "..toml",
            "../a.toml",
            "a/b.toml",
            "a\\b.toml",
            "c:a.toml",
            "a.txt",
            ".hidden.toml",
            "con.toml",
            "COM1.x.toml",
            "a\n.toml",
            "a .toml",
            "a..toml",
            " a.toml",
            &long,
        ];
        for name in bad {
            assert_eq!(recipes.file(name), None, "{name:?}");
            let error = recipes.save(name, "[part]\n", None, BY).unwrap_err();
            assert!(matches!(error, FormatError::RecipeName { .. }), "{name:?}: {error}");
        }
        for name in ["a.toml", "Spiegel 3 größer.toml", "镜.toml", "com10.toml"] {
            assert!(recipes.file(name).is_some(), "{name}");
        }
    }

    #[test]
    fn other_files_are_no_recipes() {
        let (home, recipes) = folder();
        fs::write(home.path().join("cell.toml"), "[cell]\n").unwrap();
        fs::write(home.path().join("big.toml"), vec![b'#'; RecipeFolder::MAX_BYTES as usize + 1]).unwrap();
        fs::create_dir(home.path().join("folder.toml")).unwrap();
        assert_eq!(recipes.names().unwrap(), Vec::<String>::new());
        assert!(matches!(recipes.text("big.toml"), Err(FormatError::TooLarge { .. })));
    }
}
