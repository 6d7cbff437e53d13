//! Check of a plant file by `regrind check`.

use std::path::Path;

use regrind::config::PlantConfig;
use regrind::document::Problems;

use super::super::file_kind::CheckedPlantFile;

/// Checks the plant file at `path`. Returns its SHA-256 and notes for people, or all its problems.
pub(in super::super) fn check_plant(path: &Path) -> Option<Result<CheckedPlantFile, Problems>> {
    Some(
        PlantConfig::read(path)
            .map(|config| CheckedPlantFile { sha256: *config.source_sha256(), notes: notes(&config) }),
    )
}

/// Returns a note for each secret of a receiver that cannot be read on this computer. This is not an error, because the
/// file can be checked on another computer.
fn notes(config: &PlantConfig) -> Vec<String> {
    let receivers = config.notify.as_ref().map(regrind_notify::Receiver::all);
    receivers.and_then(Result::err).map(|error| error.to_string()).into_iter().collect()
}
