//! Temporary folder of a simulation: the text of its recipe, and its run.

use std::path::PathBuf;

use tempfile::TempDir;

use super::error::FormatError;
use super::registration::write_private;
use super::system::create_owners_folder;

/// Temporary folder that only its owner can read. It is deleted with its content when the value is dropped.
#[derive(Debug)]
pub struct SimulationFolder(TempDir);

impl SimulationFolder {
    /// Creates a folder with the text of a recipe. Its path is short: the path of a socket must fit into some hundred
    /// bytes.
    ///
    /// # Errors
    /// A folder or a file that cannot be written.
    pub fn create(text: &str) -> Result<Self, FormatError> {
        let home = std::env::temp_dir();
        let failed = |source| FormatError::Unwritable { path: home.clone(), action: "creating a folder in it", source };
        let folder = Self(create_owners_folder("regrind-", &home).map_err(failed)?);
        write_private(&folder.draft(), text.as_bytes())?;
        Ok(folder)
    }

    /// Returns the path of the file with the text.
    pub fn draft(&self) -> PathBuf {
        self.0.path().join("recipe.toml")
    }

    /// Returns the path of the folder for the run. The folder is created with the run.
    pub fn runs(&self) -> PathBuf {
        self.0.path().join("runs")
    }
}

#[cfg(test)]
mod tests {
    use super::super::system::readable_by_others;
    use super::*;

    #[test]
    fn simulation_folder_is_private_and_deleted() {
        let folder = SimulationFolder::create("[part]\n").unwrap();
        assert_eq!(std::fs::read_to_string(folder.draft()).unwrap(), "[part]\n");
        let home = folder.draft().parent().unwrap().to_owned();
        assert_eq!(readable_by_others(&home).unwrap().map(|open| open.how), None);
        drop(folder);
        assert!(!home.exists());
    }
}
