//! Workbench of the process engineer: recipes are written, checked, planned, simulated and saved.
//!
//! ```text
//!  browser --text--> draft -------> child program: problems, plan, shape    (lines of JSON, as soon as each is known)
//!                    simulation --> child program: a run on simulated machines, in a folder of its own
//!                    saving ------> RecipeFolder: the file, and a version of it
//! ```
//!
//! The child programs have the lowest priority, and they end with the browser or with the page. A recipe that is large
//! or wrong can therefore stop neither the page nor a cell.

mod draft;
mod saving;
mod simulation;
mod texts;
mod view;

use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

use axum::Json;
use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use regrind_formats::RecipeFolder;
use serde::Serialize;
use serde_json::Value;
use tokio::sync::Semaphore;

use super::guard::Session;
use super::shared::{Page, Shared};
use simulation::Simulation;

/// Maximum number of drafts that are checked at the same time.
const MAX_DRAFTS: usize = 2;
/// Maximum size of a request. In JSON, a character of a recipe can need several bytes.
const MAX_REQUEST_BYTES: usize = 4 * RecipeFolder::MAX_BYTES as usize;

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
    recipes: RecipeFolder,
    programs: Box<dyn RecipePrograms>,
    drafts: Arc<Semaphore>,
    /// Last simulation that a browser has started; it ends when the next one begins.
    simulation: Mutex<Option<Simulation>>,
}

impl Workbench {
    /// Creates the workbench for the recipes in `recipes`.
    pub fn new(recipes: RecipeFolder, programs: Box<dyn RecipePrograms>) -> Self {
        Self { recipes, programs, drafts: Arc::new(Semaphore::new(MAX_DRAFTS)), simulation: Mutex::default() }
    }

    fn simulation(&self) -> std::sync::MutexGuard<'_, Option<Simulation>> {
        self.simulation.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the routes of the workbench.
pub(crate) fn routes() -> Router<Shared> {
    Router::new()
        .route("/recipes", get(view::list))
        .route("/recipes/open", get(view::open))
        .route("/recipes/{name}", get(view::recipe))
        .route("/recipe-schema", get(schema))
        .route("/recipes/{name}/draft", post(draft::draft))
        .route("/recipes/{name}/save", post(saving::save))
        .route("/recipes/{name}/text", get(saving::text))
        .route("/recipes/{name}/versions", get(saving::versions))
        .route("/recipes/{name}/versions/{number}", get(saving::version))
        .route("/recipes/{name}/simulation", post(simulation::begin))
        .route("/recipes/{name}/simulation/end", post(simulation::end))
        .route("/recipes/{name}/simulation/events", get(simulation::events))
        .route("/recipes/{name}/simulation/map", get(simulation::map))
        .route("/recipes/{name}/simulation/report", get(simulation::report))
        .layer(DefaultBodyLimit::max(MAX_REQUEST_BYTES))
}

async fn schema(
    axum::extract::State(page): axum::extract::State<Shared>,
    axum::Extension(session): axum::Extension<Session>,
) -> Response {
    match for_engineer(&page, &session) {
        Ok(workbench) => Json(workbench.programs.schema()).into_response(),
        Err(refused) => refused,
    }
}

/// Answer to a request of the workbench that is not carried out.
#[derive(Serialize)]
struct Refusal {
    message: String,
}

fn refused(status: StatusCode, message: impl Into<String>) -> Response {
    (status, Json(Refusal { message: message.into() })).into_response()
}

/// Returns the workbench of `page` if the person of `session` may use it.
///
/// # Errors
/// Returns the response to the browser if the page has no folder of recipes, or if the person is no engineer.
fn for_engineer<'p>(page: &'p Page, session: &Session) -> Result<&'p Workbench, Response> {
    let Some(workbench) = &page.workbench else {
        let message = "this page has no folder of recipes; start it with `regrind serve --recipes DIR`";
        return Err(refused(StatusCode::NOT_FOUND, message));
    };
    if !session.is_engineer() {
        let who = session.person.as_ref().map(ToString::to_string).unwrap_or_default();
        // The refusal is in the log of the page; it concerns no run.
        page.guard.refused(&format!("a request of the workbench from {who}"));
        return Err(refused(StatusCode::FORBIDDEN, "only an engineer can use the recipes"));
    }
    Ok(workbench)
}

/// Returns the response with a text that is no page.
fn plain(text: String) -> Response {
    ([(CONTENT_TYPE, "text/plain; charset=utf-8")], text).into_response()
}
