//! Plant file of a command, and the connection to the database that the file names.

use std::path::{Path, PathBuf};

use clap::Args;
use regrind::config::PlantConfig;
use regrind_plant::{DatabaseLink, DatabaseSettings};

use super::super::check;
use super::super::failure::Failure;

/// Plant to use.
#[derive(Args, Clone, Debug)]
pub(super) struct Where {
    /// Plant file: address and user of the database
    #[arg(long = "plant", value_name = "FILE")]
    file: PathBuf,
}

impl Where {
    pub(super) fn read(&self) -> Result<PlantConfig, Failure> {
        read(&self.file)
    }
}

/// Reads a plant file. If it is invalid, prints its problems and returns a failure.
pub(super) fn read(file: &Path) -> Result<PlantConfig, Failure> {
    check::or_show(PlantConfig::read(file))
}

/// Returns the table `[database]` of a plant file. If there is none, prints this problem and returns a failure.
pub(super) fn database(config: &PlantConfig) -> Result<&DatabaseSettings, Failure> {
    let missing = || {
        config.problem(
            "database",
            "is missing",
            "",
            "add the table [database] with the address of the database and the user that signs in",
        )
    };
    check::or_show(config.database.as_ref().ok_or_else(missing))
}

/// Signs in to the database that the plant file names, without a check of the table layout (version of the tables) in
/// this database. Returns an error if the plant file names no database, or if the sign-in fails.
pub(super) async fn open_any(config: &PlantConfig) -> Result<DatabaseLink, Failure> {
    Ok(DatabaseLink::open(database(config)?).await?)
}

/// Signs in to the database that the plant file names, and checks the table layout (version of the tables) in this
/// database. Returns an error if the sign-in fails, or if this program does not support the layout.
pub(super) async fn open(config: &PlantConfig) -> Result<DatabaseLink, Failure> {
    let link = open_any(config).await?;
    regrind_plant::check_layout(link.client()).await?;
    Ok(link)
}
