//! Initial knowledge of a run that other cells of the plant have learned.

use std::path::Path;
use std::time::Duration;

use regrind::compensation::MachineSimilarity;
use regrind::document::visible_line;
use regrind::drive::Task;
use regrind::formats::Learned;
use regrind_plant::Knowledge;

use super::super::failure::Failure;
use super::plant_file::{open, read};

/// Timeout for the plant, after which a run begins without its knowledge.
const PATIENCE: Duration = Duration::from_secs(5);

/// Queries the database of the plant for the results that other cells have learned about parts of the same kind.
/// Combines these results into an initial state for the run of `task`. `plant` is the path of the plant file. Adds a
/// message for the operator to `messages` for each result that cannot be used.
///
/// Returns `None` if the other cells have no usable result, or if the plant file names no database. Also returns `None`,
/// and adds a message with the reason, if the plant does not answer within [`PATIENCE`] or answers with an error.
///
/// Returns an error only if the plant file is invalid.
pub(super) fn query_knowledge(
    plant: &Path,
    task: &Task,
    messages: &mut Vec<String>,
) -> Result<Option<Learned>, Failure> {
    let config = read(plant)?;
    // A plant file for live values only has no database to query.
    if config.database.is_none() {
        return Ok(None);
    }
    let (to, answer) = std::sync::mpsc::channel();
    let (kind, simulation) = (task.kind.clone(), task.simulation);
    // Own thread, which is abandoned if it hangs: neither a name lookup nor a file on a lost network share can be
    // cancelled.
    std::thread::spawn(move || {
        let asked = super::super::runtime().and_then(|runtime| {
            runtime.block_on(async {
                let link = open(&config).await?;
                let of_this = (&kind, simulation);
                let knowledge = Knowledge::query(&link, config.artefacts.as_ref(), of_this).await?;
                let alike = alike(&knowledge, config.machines_differ);
                Ok::<_, Failure>((knowledge, alike))
            })
        });
        // The run can have begun without the answer.
        let _ = to.send(asked.map_err(|error| error.to_string()));
    });
    let late = |_| Err(format!("no answer within {} s", PATIENCE.as_secs()));
    match answer.recv_timeout(PATIENCE).unwrap_or_else(late) {
        Ok((knowledge, alike)) => {
            messages.extend(knowledge.skipped.iter().map(|words| visible_line(words)));
            Ok(task.learned_from_others(&knowledge.results, &alike))
        }
        Err(reason) => {
            messages.push(format!("the plant sends no learned results of other cells: {reason}"));
            Ok(None)
        }
    }
}

/// Estimates how similar the machines of the cells are. The measure is the share of the repeatable error that only one
/// machine has. The result collects this share from two sources:
///
/// - For each pair of cells in `knowledge` that ground the same kind of part, compares the results of these two cells.
/// - `machines_differ` is an assumption that the plant file can state; `None` means not stated. The value (0 to 1) is
///   the rms of the repeatable error that only one machine has, divided by the rms of its whole repeatable error.
fn alike(knowledge: &Knowledge, machines_differ: Option<f64>) -> MachineSimilarity {
    let mut alike = MachineSimilarity::default();
    if let Some(share) = machines_differ {
        alike.add_statement(share);
    }
    for ([one, other], is_own) in &knowledge.pairs {
        alike.compare([&one.known, &other.known], *is_own);
    }
    alike
}
