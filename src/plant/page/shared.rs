//! State of the page of a plant, which all its handlers share.

use std::sync::Arc;

use super::super::error::PlantError;
use super::super::settings::{ArtefactSettings, DatabaseSettings};
use super::pool::{Lease, Pool};
use super::proofs::Proofs;

/// State of the page of a plant.
pub struct PlantPage {
    pub(super) pool: Pool,
    pub(super) proofs: Proofs,
    pub(super) artefacts: Option<ArtefactSettings>,
}

/// Page state shared by all handlers.
pub(super) type Shared = Arc<PlantPage>;

impl PlantPage {
    /// Creates the state of the plant's web page. `database` contains the settings for the connection to the plant's
    /// database. `artefacts` names the folder for files that are too large for the database; it is `None` if there is
    /// no such folder. Does not connect yet, so the database need not be reachable.
    pub fn new(database: DatabaseSettings, artefacts: Option<ArtefactSettings>) -> Self {
        Self { pool: Pool::new(database), proofs: Proofs::default(), artefacts }
    }

    /// Takes a database connection from the pool for a few queries. The connection returns to the pool when the lease
    /// is dropped. Returns an error if no connection becomes free in time or if the database cannot be reached.
    pub(super) async fn lease(&self) -> Result<Lease<'_>, PlantError> {
        self.pool.lease().await
    }
}
