//! State of the workbench, and the programs that work for it.

use std::collections::HashMap;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use regrind_formats::RecipeFolder;
use serde_json::Value;
use tokio::sync::{Semaphore, oneshot};

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
    /// Draft of each person that is being checked: its number, and what ends it when it is dropped.
    personal_drafts: Mutex<HashMap<String, (u64, oneshot::Sender<()>)>>,
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
            personal_drafts: Mutex::default(),
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

    /// Registers the draft number `number` as the one of a person, and ends the draft of this person before. The returned
    /// receiver tells the end by a later draft.
    pub(super) fn begin_draft(&self, person: &str, number: u64) -> oneshot::Receiver<()> {
        let (end, ended) = oneshot::channel();
        self.personal_drafts().insert(person.to_owned(), (number, end));
        ended
    }

    /// Forgets the draft number `number` of a person, if no later one has replaced it.
    pub(super) fn forget_draft(&self, person: &str, number: u64) {
        let mut drafts = self.personal_drafts();
        if drafts.get(person).is_some_and(|(present, _)| *present == number) {
            drafts.remove(person);
        }
    }

    fn personal_drafts(&self) -> MutexGuard<'_, HashMap<String, (u64, oneshot::Sender<()>)>> {
        self.personal_drafts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
