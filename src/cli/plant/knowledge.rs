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
    // Who only tells live values has nobody to ask.
    if config.database.is_none() {
        return Ok(Told::default());
    }
    let (to, answer) = std::sync::mpsc::channel();
    let (kind, simulation) = (task.kind.clone(), task.simulation);
    // A thread of its own, which is left where it hangs: neither a look for a name nor a file of a share that is gone can be called off.
    std::thread::spawn(move || {
        let asked = super::super::runtime().and_then(|runtime| {
            runtime.block_on(async {
                let link = super::open(&config).await?;
                let of_this = (kind.as_str(), simulation);
                let knowledge = Knowledge::ask(&link, config.artefacts.as_ref(), of_this).await?;
                let alike = alike(&knowledge, config.machines_differ);
                Ok::<_, Failure>((knowledge, alike))
            })
        });
        // The run may have begun without.
        let _ = to.send(asked.map_err(|error| error.to_string()));
    });
    let (knowledge, alike) = match answer.recv_timeout(PATIENCE) {
        Ok(Ok(told)) => told,
        Ok(Err(error)) => return Ok(without(&error)),
        Err(_) => return Ok(without(&format!("nothing came within {} s", PATIENCE.as_secs()))),
    };
    let words = knowledge.left_alone;
    Ok(Told { learned: task.from_others(&knowledge.lessons, &alike), words })
}

/// How alike machines are, by what somebody stated and by the recipes that two of them know.
fn alike(knowledge: &Knowledge, machines_differ: Option<f64>) -> Alike {
    let mut alike = Alike::default();
    if let Some(share) = machines_differ {
        alike.state(share);
    }
    for ([one, other], is_own) in &knowledge.pairs {
        alike.compare([&one.known, &other.known], *is_own);
    }
    alike
}

fn without(why: &str) -> Told {
    Told { learned: None, words: vec![format!("the plant does not tell what other cells have learned: {why}")] }
}
