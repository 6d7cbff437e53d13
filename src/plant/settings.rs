//! Where the plant is, as a person writes it.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::Deserialize;

/// The database of the plant.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DatabaseSettings {
    /// Name or address of its computer; the folder of a socket where it begins with `/`.
    #[schemars(length(min = 1, max = 255), example = &"plant.example")]
    pub host: String,
    /// Its port.
    #[serde(default = "port")]
    #[schemars(range(min = 1))]
    pub port: u16,
    /// The database.
    #[serde(default = "database")]
    #[schemars(length(min = 1, max = 63))]
    pub name: String,
    /// The role by which this computer signs in.
    #[schemars(length(min = 1, max = 63), example = &"cell_1")]
    pub user: String,
    /// The file that holds its password, and nothing else, for nobody else to read; beside this file where it is relative.
    pub password_file: Option<PathBuf>,
    /// The certificates in PEM by which the database proves itself. Without them it is reached on this computer alone.
    pub certificates: Option<PathBuf>,
}

fn port() -> u16 {
    5432
}

fn database() -> String {
    "regrind".to_owned()
}

/// Where files of runs are kept that are too large for the database.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArtefactSettings {
    /// A folder that all cells and the plant see; beside this file where it is relative.
    pub folder: PathBuf,
    /// Files of this size and larger are kept there; smaller ones in the database.
    #[serde(default = "from_mb")]
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub from_mb: f64,
}

fn from_mb() -> f64 {
    8.0
}

/// Somebody whose signature under a recipe counts.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Approver {
    /// What the person is called, as the signature has it.
    #[schemars(length(min = 1, max = 80), example = &"A. Smith")]
    pub name: String,
    /// The public half of the person's key, as `regrind audit key --key FILE` prints it.
    #[schemars(regex(pattern = "^[0-9a-f]{64}$"))]
    pub key: String,
}
