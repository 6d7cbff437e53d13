//! State of the workbench, and the programs that work for it.

use std::collections::HashMap;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use regrind_formats::RecipeFolder;
use serde_json::Value;
use tokio::sync::Semaphore;

use super::running::Simulation;

/// Maximum number of drafts that are checked at the same time, of all people together.
const MAX_DRAFTS: usize = 4;

/// Programs that work on recipes outside the page.
pub trait RecipePrograms: Send + Sync {
    /// Returns the program that reads the text of a recipe from its standard input, as if it were the file `recipe`, and
    /// that prints problems, plan and shape as lines of JSON.
    fn draft(&self, recipe: &Path) -> Command;

    /// Returns the program that runs a recipe on simulated machines. It reads the text from the file `draft`, as if it
    /// were the file `recipe`, and creates the folder of the run in `runs`.
    fn simulation(&self, recipe: &Path, draft: &Path, runs: &Path, seed: u64) -> Command;

    /// Returns the JSON schema of a recipe.
    fn schema(&self) -> &Value;

    /// Returns the text with which a new recipe begins.
    fn skeleton(&self) -> &str;
}

/// State of the workbench.
pub struct Workbench {
    pub(super) recipes: RecipeFolder,
    pub(super) programs: Box<dyn RecipePrograms>,
    pub(super) drafts: Arc<Semaphore>,
    /// For each person at a browser, one permit: one text of a person is checked at a time.
    turns: Mutex<HashMap<String, Arc<Semaphore>>>,
    /// Held while a recipe is saved, so that waiting saves occupy no threads.
    pub(super) saving: tokio::sync::Mutex<()>,
    /// Last simulation that a browser has started; it ends when the next one begins.
    simulation: Mutex<Option<Simulation>>,
    last_number: AtomicU64,
}

impl Workbench {
    /// Creates the workbench for the recipes in `recipes`.
    pub fn new(recipes: RecipeFolder, programs: Box<dyn RecipePrograms>) -> Self {
        Self {
            recipes,
            programs,
            drafts: Arc::new(Semaphore::new(MAX_DRAFTS)),
            turns: Mutex::default(),
            saving: tokio::sync::Mutex::default(),
            simulation: Mutex::default(),
            last_number: AtomicU64::new(0),
        }
    }

    /// Returns a number that was not returned before.
    pub(super) fn next_number(&self) -> u64 {
        self.last_number.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Returns the last simulation. The lock must not be held while anything is awaited.
    pub(super) fn simulation(&self) -> MutexGuard<'_, Option<Simulation>> {
        self.simulation.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the permit of a person: the text of its holder is the only one of this person that is checked.
    pub(super) fn turn_of(&self, person: &str) -> Arc<Semaphore> {
        let mut turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        // Nobody uses the permits that are known only here.
        turns.retain(|_, turn| Arc::strong_count(turn) > 1);
        Arc::clone(turns.entry(person.to_owned()).or_insert_with(|| Arc::new(Semaphore::new(1))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct NoPrograms;

    impl RecipePrograms for NoPrograms {
        fn draft(&self, _recipe: &Path) -> Command {
            Command::new("false")
        }

        fn simulation(&self, _recipe: &Path, _draft: &Path, _runs: &Path, _seed: u64) -> Command {
            Command::new("false")
        }

        fn schema(&self) -> &Value {
            &Value::Null
        }

        fn skeleton(&self) -> &str {
            ""
        }
    }

    #[test]
    fn one_text_of_a_person_is_checked_at_a_time() {
        let workbench = Workbench::new(RecipeFolder::at("recipes"), Box::new(NoPrograms));
        let first = workbench.turn_of("A. Smith").try_acquire_owned().unwrap();
        assert!(workbench.turn_of("A. Smith").try_acquire_owned().is_err());
        assert!(workbench.turn_of("B. Jones").try_acquire_owned().is_ok());
        drop(first);
        assert!(workbench.turn_of("A. Smith").try_acquire_owned().is_ok());
        // People who check nothing are not kept.
        drop(workbench.turn_of("C. Brown"));
        assert_eq!(workbench.turns.lock().unwrap().len(), 1);
    }
}
