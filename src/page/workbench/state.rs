//! State of the workbench, and the programs that work for it.

use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

use regrind_formats::RecipeFolder;
use serde_json::Value;
use tokio::sync::Semaphore;

use super::running::Simulation;

/// Maximum number of drafts that are checked at the same time.
const MAX_DRAFTS: usize = 2;

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
    /// Last simulation that a browser has started; it ends when the next one begins.
    simulation: Mutex<Option<Simulation>>,
}

impl Workbench {
    /// Creates the workbench for the recipes in `recipes`.
    pub fn new(recipes: RecipeFolder, programs: Box<dyn RecipePrograms>) -> Self {
        Self { recipes, programs, drafts: Arc::new(Semaphore::new(MAX_DRAFTS)), simulation: Mutex::default() }
    }

    /// Returns the last simulation. The lock must not be held while anything is awaited.
    pub(super) fn simulation(&self) -> std::sync::MutexGuard<'_, Option<Simulation>> {
        self.simulation.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
