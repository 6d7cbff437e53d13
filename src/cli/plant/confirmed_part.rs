//! Part from the queue of the plant that a person at the cell has confirmed.

use std::path::Path;

use regrind::config::PlantConfig;
use regrind_plant::Lease;

use super::super::failure::Failure;
use super::plant_file::open;

/// Confirmed part, before its run begins.
#[derive(Clone, Debug)]
pub(super) struct ConfirmedPart {
    pub(super) config: PlantConfig,
    pub(super) lease: Lease,
}

impl ConfirmedPart {
    /// Tells the plant that the leased part (the part reserved for this cell) is made by the run in the folder `run`.
    /// Returns after the plant has confirmed this assignment. The run must not begin earlier. If the answer of the
    /// plant is lost, repeats the request once. Returns an error if the plant refuses the assignment or cannot be
    /// reached.
    pub(super) async fn begin(&self, run: &Path) -> Result<(), Failure> {
        let name = run.file_name().unwrap_or_default().to_string_lossy();
        let link = open(&self.config).await?;
        match self.lease.begin(&link, &name).await {
            // It is unknown whether the plant made the assignment. The request is idempotent: a retry returns the same
            // answer.
            Err(error) if error.may_pass() => {
                let link = open(&self.config).await?;
                Ok(self.lease.begin(&link, &name).await?)
            }
            other => Ok(other?),
        }
    }
}
