//! Settings of the plant file: database, folder of large files, approvers of recipes.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::Deserialize;

/// The database of the plant.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DatabaseSettings {
    /// Name or address of its computer; a value that begins with `/` is the folder of a socket.
    #[schemars(length(min = 1, max = 255), example = &"plant.example")]
    pub host: String,
    /// Port of the database.
    #[serde(default = "port")]
    #[schemars(range(min = 1))]
    pub port: u16,
    /// Name of the database.
    #[serde(default = "database")]
    #[schemars(length(min = 1, max = 63))]
    pub name: String,
    /// Role with which this computer signs in.
    #[schemars(length(min = 1, max = 63), example = &"cell_1")]
    pub user: String,
    /// File with the password of the role and nothing else, readable by its owner only; relative to this file.
    pub password_file: Option<PathBuf>,
    /// Certificates in PEM that authenticate the database. Without them, the database must be on this computer.
    pub certificates: Option<PathBuf>,
}

fn port() -> u16 {
    5432
}

fn database() -> String {
    "regrind".to_owned()
}

/// Store for files of runs that are too large for the database.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArtefactSettings {
    /// Folder that all cells and the plant can access; relative to this file.
    pub folder: PathBuf,
    /// Minimum size of a file in the folder; smaller files are in the database.
    #[serde(default = "from_mb")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub from_mb: f64,
}

fn from_mb() -> f64 {
    8.0
}

/// Archive of the runs of earlier months.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArchiveSettings {
    /// Folder of the archive; relative to this file.
    pub folder: PathBuf,
    /// Number of whole months that stay in the database before the present one.
    #[serde(default = "keep_months")]
    #[schemars(range(min = 1, max = 1200))]
    pub keep_months: u16,
}

fn keep_months() -> u16 {
    24
}

/// Person whose signature approves a recipe.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Approver {
    /// Name of the person, as in the signature.
    #[schemars(length(min = 1, max = 80), example = &"A. Smith")]
    pub name: String,
    /// The public half of the person's key, as `regrind audit key --key FILE` prints it.
    #[schemars(regex(pattern = "^[0-9a-f]{64}$"))]
    pub key: String,
}
