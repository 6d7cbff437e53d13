//! What a run begins with that other cells of the plant have learned.

use std::path::Path;
use std::time::Duration;

use regrind::compensation::Alike;
use regrind::drive::Task;
use regrind::formats::Learned;
use regrind_plant::Knowledge;

use super::super::failure::Failure;

/// How long a run waits for the plant before it begins without.
const PATIENCE: Duration = Duration::from_secs(5);

/// What became of the question.
#[derive(Default)]
pub(in super::super) struct Told {
    /// What the task can begin with, where others tell anything of it.
    pub(in super::super) learned: Option<Learned>,
    /// What is to be said of it.
    pub(in super::super) words: Vec<String>,
}

/// Asks the plant what other cells have learned of parts like that of a task. A plant that cannot be reached is in nobody's way.
pub(in super::super) fn ask(plant: &Path, task: &Task) -> Result<Told, Failure> {
    let config = super::read(plant)?;
    let asked = async {
        let link = super::open(&config).await?;
        let of_this = (task.kind.as_str(), task.simulation);
        Ok::<_, Failure>(Knowledge::ask(&link, config.artefacts.as_ref(), of_this).await?)
    };
    let within = async { tokio::time::timeout(PATIENCE, asked).await };
    let knowledge = match super::super::runtime()?.block_on(within) {
        Ok(Ok(knowledge)) => knowledge,
        Ok(Err(error)) => return Ok(without(&error.to_string())),
        Err(_) => return Ok(without(&format!("nothing came within {} s", PATIENCE.as_secs()))),
    };
    let mut alike = Alike::default();
    if let Some(share) = config.machines_differ {
        alike.state(share);
    }
    for ([one, other], is_own) in &knowledge.pairs {
        alike.compare([&one.known, &other.known], *is_own);
    }
    let words = knowledge.left_alone;
    Ok(Told { learned: task.from_others(&knowledge.lessons, &alike), words })
}

fn without(why: &str) -> Told {
    Told { learned: None, words: vec![format!("the plant does not tell what other cells have learned: {why}")] }
}
