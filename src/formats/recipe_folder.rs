//! Folder of a shop's recipes, with every version that was saved from the page.
//!
//! ```text
//!  recipes/mirror.toml                  what runs use
//!  recipes/.versions/mirror.toml/1.toml the text of version 1
//!                                1.json who saved it, and when
//! ```
//!
//! A text that another program has changed becomes a version of its own before it is replaced. A change in the moment of
//! saving is noticed, and the file stays as that program wrote it. So no text is lost. This moment remains where the
//! system cannot exchange the names of two files (Windows, some network disks).
//!
//! Only recipes are read and written: files with a table `[part]`, in this folder. Other files beside them, such as cell
//! files and lists of users, are refused, and so are links that lead out of the folder.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use data_encoding::HEXLOWER;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::FormatError;
use super::folder::ResultFolder;
use super::registration::Draft;
use super::system;

/// Folder of the versions, below the folder of the recipes.
const VERSIONS: &str = ".versions";
/// Maximum length of the name of a recipe, in bytes.
const MAX_NAME_BYTES: usize = 100;
/// Maximum time for which a save waits for another one of the same recipe.
const MAX_LOCK_WAIT: Duration = Duration::from_secs(3);
const BETWEEN_LOCKS: Duration = Duration::from_millis(20);
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
    /// True if its description cannot be read. Only its number is then known.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub damaged: bool,
}

impl RecipeFolder {
    /// Maximum size of a recipe, in bytes.
    pub const MAX_BYTES: u64 = 256 << 10;

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
        let is_invisible = |c: char| matches!(c, '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2060}'..='\u{206f}' | '\u{feff}');
        let is_plain = |c: char| {
            !c.is_control() && !is_invisible(c) && !matches!(c, '/' | '\\' | ':' | '*' | '?' | '"' | '<' | '>' | '|')
        };
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
        let is_recipe = |name: &String| matches!(self.text(name), Ok(Some(_)));
        let mut names: Vec<String> = names.filter(is_recipe).collect();
        names.sort();
        Ok(names)
    }

    /// Returns the text of the recipe named `name`. Returns `None` if there is no such file.
    ///
    /// # Errors
    /// The file cannot be read, is larger than [`Self::MAX_BYTES`], is not text, is no recipe, or lies elsewhere.
    pub fn text(&self, name: &str) -> Result<Option<String>, FormatError> {
        let Some(path) = self.place(name)? else { return Ok(None) };
        match read_text(&path) {
            Ok(text) if has_part(&text) => Ok(Some(text)),
            Ok(_) => Err(FormatError::NoRecipe { path }),
            Err(FormatError::Unreadable { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Returns the place of the recipe named `name`, with all links followed. Returns `None` if the name is not plain.
    ///
    /// # Errors
    /// A link that leads out of the folder, or nowhere.
    fn place(&self, name: &str) -> Result<Option<PathBuf>, FormatError> {
        let Some(path) = self.file(name) else { return Ok(None) };
        let folder = self.0.canonicalize().map_err(|source| unreadable(&self.0, source))?;
        match path.canonicalize() {
            Ok(place) if place.starts_with(&folder) && !place.starts_with(folder.join(VERSIONS)) => Ok(Some(place)),
            Err(_) if path.symlink_metadata().is_err() => Ok(Some(path)),
            _ => Err(FormatError::RecipeElsewhere { path }),
        }
    }

    /// Returns the saved versions of the recipe named `name`, the first one first. The list is empty if none was saved.
    ///
    /// # Errors
    /// The folder of the versions cannot be read.
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
        let read = |number| read_version(&folder, number).unwrap_or_else(|_| RecipeVersion::damaged(number));
        Ok(numbers.into_iter().map(read).collect())
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
    /// An existing file keeps its owner and its permissions.
    ///
    /// # Errors
    /// A name that is not plain; a text that is too long or no recipe; a file that was changed meanwhile, that is no
    /// recipe or lies elsewhere; a program that saves the same recipe for a long time; a file that cannot be read or
    /// written.
    pub fn save(
        &self,
        name: &str,
        text: &str,
        replaces: Option<&str>,
        [saved_by, saved_at]: [&str; 2],
    ) -> Result<RecipeVersion, FormatError> {
        let (Some(path), Some(folder)) = (self.place(name)?, self.folder_of_versions(name)) else {
            return Err(FormatError::RecipeName { name: name.to_owned() });
        };
        let found = text.len() as u64;
        if found > Self::MAX_BYTES {
            return Err(FormatError::TooLarge { path, found, limit: Self::MAX_BYTES, unit: "bytes" });
        }
        if !has_part(text) {
            return Err(FormatError::NoRecipe { path });
        }
        ResultFolder::prepare(&folder)?.keep();
        let _lock = SavingLock::acquire(&folder)?;
        delete_unfinished_versions(&folder);
        let present = self.text(name)?;
        let mut versions = self.versions(name)?;
        if let Some(last) = versions.last().filter(|last| last.is_text(text))
            && present.as_deref() == Some(text)
        {
            return Ok(last.clone());
        }
        if present.as_deref() != replaces {
            return Err(FormatError::ChangedMeanwhile { path });
        }
        if let Some(present) = &present
            && versions.last().is_none_or(|last| !last.is_text(present))
        {
            let of_other = NewVersion::write(&folder, next(&versions), present, &path)?;
            versions.push(of_other.describe(["", ""])?);
            if present == text {
                return Ok(versions.swap_remove(versions.len() - 1));
            }
        }
        let version = NewVersion::write(&folder, next(&versions), text, &path)?;
        match replace(&path, text, present.as_deref()) {
            Ok(true) => version.describe([saved_by, saved_at]),
            Ok(false) => {
                version.withdraw();
                Err(FormatError::ChangedMeanwhile { path })
            }
            Err(error) => {
                version.withdraw();
                Err(error)
            }
        }
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
        let file = match system::create_owners(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                File::options().write(true).open(&path).map_err(failed)?
            }
            created => created.map_err(failed)?,
        };
        let until = Instant::now() + MAX_LOCK_WAIT;
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(Self(file)),
                Err(fs::TryLockError::WouldBlock) if Instant::now() < until => thread::sleep(BETWEEN_LOCKS),
                Err(fs::TryLockError::WouldBlock) => return Err(FormatError::RecipeBusy { path: path.clone() }),
                Err(fs::TryLockError::Error(error)) => return Err(failed(error)),
            }
        }
    }
}

impl Drop for SavingLock {
    fn drop(&mut self) {
        // A program that was started meanwhile has a copy of the file, so closing it is not enough.
        let _ = self.0.unlock();
    }
}

/// Version whose text is on the disk. Without a description it does not count.
struct NewVersion<'f> {
    folder: &'f Path,
    number: u32,
    sha256: String,
    /// Recipe, whose permissions the files of its versions have.
    like: &'f Path,
}

impl<'f> NewVersion<'f> {
    fn write(folder: &'f Path, number: u32, text: &str, like: &'f Path) -> Result<Self, FormatError> {
        write_like(&folder.join(format!("{number}{EXTENSION}")), text.as_bytes(), like)?;
        Ok(Self { folder, number, sha256: sha256(text), like })
    }

    fn describe(self, [saved_by, saved_at]: [&str; 2]) -> Result<RecipeVersion, FormatError> {
        let version = RecipeVersion {
            version: self.number,
            saved_by: saved_by.to_owned(),
            saved_at: saved_at.to_owned(),
            sha256: self.sha256,
            damaged: false,
        };
        let path = self.folder.join(format!("{}.json", self.number));
        let description = serde_json::to_vec_pretty(&version).map_err(|error| unreadable(&path, error.into()))?;
        write_like(&path, &description, self.like)?;
        Ok(version)
    }

    fn withdraw(self) {
        // The next version overwrites it, if it cannot be deleted.
        let _ = fs::remove_file(self.folder.join(format!("{}{EXTENSION}", self.number)));
    }
}

impl RecipeVersion {
    /// Returns true if this is the version of `text`.
    pub fn is_text(&self, text: &str) -> bool {
        !self.damaged && self.sha256 == sha256(text)
    }

    fn damaged(version: u32) -> Self {
        Self { version, saved_by: String::new(), saved_at: String::new(), sha256: String::new(), damaged: true }
    }
}

/// Replaces the text `present` of the file `path`, or creates the file. Returns false and changes nothing if another
/// program has changed or created the file meanwhile.
fn replace(path: &Path, text: &str, present: Option<&str>) -> Result<bool, FormatError> {
    let mut draft = if present.is_some() { Draft::create_private(path)? } else { Draft::create(path)? };
    draft.write(text.as_bytes())?;
    match present {
        Some(present) => draft.publish_over(present.as_bytes()),
        None => draft.publish_new(),
    }
}

/// Writes a file with the owner and the permissions of the file `like`, if that one exists.
fn write_like(path: &Path, bytes: &[u8], like: &Path) -> Result<(), FormatError> {
    let has_pattern = like.exists();
    let mut draft = if has_pattern { Draft::create_private(path)? } else { Draft::create(path)? };
    draft.write(bytes)?;
    if has_pattern {
        draft.copy_access(like)?;
    }
    draft.publish()
}

/// Deletes the temporary files that a killed program has left in a folder of versions. Those beside the recipe stay:
/// after a kill while two files exchange their names, one of them has the text of another program.
fn delete_unfinished_versions(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let name = name.to_string_lossy();
        if name.starts_with('.') && name.ends_with(".tmp") {
            // It takes room, and does no other harm.
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Returns true if a text has a table `[part]`, as every recipe has.
fn has_part(text: &str) -> bool {
    text.lines().any(|line| {
        let head = line.trim_start().strip_prefix('[').map(str::trim_start);
        let rest = head.and_then(|head| head.strip_prefix("part")).map(str::trim_start);
        rest.is_some_and(|rest| rest.starts_with(']'))
    })
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
        assert_eq!(recipes.versions(NAME).unwrap(), [RecipeVersion::damaged(1)]);
        // It blocks neither the recipe nor its next version.
        assert_eq!(recipes.text(NAME).unwrap().unwrap(), "[part]\n");
        let numbers: Vec<u32> = match recipes.save(NAME, "[part]\n# b\n", Some("[part]\n"), BY) {
            Ok(_) => recipes.versions(NAME).unwrap().iter().map(|version| version.version).collect(),
            Err(error) => panic!("{error}"),
        };
        assert_eq!(numbers, [1, 2, 3]);
        assert_eq!(recipes.text_of_version(NAME, 2).unwrap().unwrap(), "[part]\n");
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
            "a\u{202e}b.toml",
            "a\u{200b}.toml",
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
    #[test]
    fn only_recipes_are_read_and_written() {
        let (home, recipes) = folder();
        let users = "[[user]]\nname = \"A. Smith\"\n";
        fs::write(home.path().join("users.toml"), users).unwrap();
        assert!(matches!(recipes.text("users.toml"), Err(FormatError::NoRecipe { .. })));
        let saved = recipes.save("users.toml", "[part]\n", Some(users), BY);
        assert!(matches!(saved, Err(FormatError::NoRecipe { .. })), "{saved:?}");
        let saved = recipes.save("new.toml", "nonsense", None, BY);
        assert!(matches!(saved, Err(FormatError::NoRecipe { .. })), "{saved:?}");
        assert_eq!(fs::read_to_string(home.path().join("users.toml")).unwrap(), users);
        assert!(!home.path().join("new.toml").exists());
        recipes.save("spaced.toml", " [ part ] # of a mirror\n", None, BY).unwrap();
        assert_eq!(recipes.names().unwrap(), ["spaced.toml"]);
    }

    #[test]
    fn failed_save_leaves_no_version() {
        let (home, recipes) = folder();
        fs::write(home.path().join(NAME), "[part]\n# a\n").unwrap();
        recipes.save(NAME, "[part]\n# b\n", Some("[part]\n# a\n"), BY).unwrap();
        let before = recipes.versions(NAME).unwrap();
        // A program changes the file in the moment of saving.
        fs::write(home.path().join(NAME), "[part]\n# c\n").unwrap();
        let path = recipes.place(NAME).unwrap().unwrap();
        assert!(!replace(&path, "[part]\n# d\n", Some("[part]\n# b\n")).unwrap());
        assert!(!replace(&path, "[part]\n# d\n", None).unwrap());
        assert_eq!(recipes.text(NAME).unwrap().unwrap(), "[part]\n# c\n");
        assert_eq!(recipes.versions(NAME).unwrap(), before);
        let names = fs::read_dir(home.path()).unwrap().map(|entry| entry.unwrap().file_name());
        assert_eq!(names.filter(|name| name.to_string_lossy().ends_with(".tmp")).count(), 0);
    }

    #[test]
    fn second_save_of_one_text_is_no_conflict() {
        let (_home, recipes) = folder();
        let first = recipes.save(NAME, "[part]\n", None, BY).unwrap();
        assert_eq!(recipes.save(NAME, "[part]\n", None, BY).unwrap(), first);
    }

    #[test]
    fn held_lock_is_told() {
        let (home, recipes) = folder();
        recipes.save(NAME, "[part]\n", None, BY).unwrap();
        let lock = File::open(home.path().join(VERSIONS).join(NAME).join("lock")).unwrap();
        lock.lock().unwrap();
        let saved = recipes.save(NAME, "[part]\n# b\n", Some("[part]\n"), BY);
        assert!(matches!(saved, Err(FormatError::RecipeBusy { .. })), "{saved:?}");
    }

    #[cfg(unix)]
    mod on_unix {
        use std::os::unix::fs::{PermissionsExt, symlink};

        use super::*;

        fn mode(path: &Path) -> u32 {
            fs::metadata(path).unwrap().permissions().mode() & 0o777
        }

        #[test]
        fn saving_keeps_permissions_and_links() {
            let (home, recipes) = folder();
            let (file, link) = (home.path().join("real.toml"), home.path().join(NAME));
            fs::write(&file, "[part]\n").unwrap();
            fs::set_permissions(&file, fs::Permissions::from_mode(0o640)).unwrap();
            symlink("real.toml", &link).unwrap();
            recipes.save(NAME, "[part]\n# b\n", Some("[part]\n"), BY).unwrap();
            assert!(link.symlink_metadata().unwrap().is_symlink());
            assert_eq!(fs::read_to_string(&file).unwrap(), "[part]\n# b\n");
            let versions = home.path().join(VERSIONS).join(NAME);
            let files = ["1.toml", "1.json", "2.toml", "2.json"].map(|name| versions.join(name));
            assert_eq!(
                [mode(&file)].into_iter().chain(files.iter().map(|file| mode(file))).collect::<Vec<_>>(),
                [0o640; 5]
            );
        }

        #[test]
        fn links_out_of_the_folder_are_refused() {
            let (home, recipes) = folder();
            let elsewhere = tempfile::tempdir().unwrap();
            fs::write(elsewhere.path().join("a.toml"), "[part]\n").unwrap();
            symlink(elsewhere.path().join("a.toml"), home.path().join("leak.toml")).unwrap();
            symlink("nowhere", home.path().join("dangling.toml")).unwrap();
            for name in ["leak.toml", "dangling.toml"] {
                assert!(matches!(recipes.text(name), Err(FormatError::RecipeElsewhere { .. })), "{name}");
                let saved = recipes.save(name, "[part]\n# b\n", None, BY);
                assert!(matches!(saved, Err(FormatError::RecipeElsewhere { .. })), "{name}");
            }
            assert_eq!(recipes.names().unwrap(), Vec::<String>::new());
            assert_eq!(fs::read_to_string(elsewhere.path().join("a.toml")).unwrap(), "[part]\n");
        }
    }
}
