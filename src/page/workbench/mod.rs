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

mod access;
mod draft;
mod running;
mod saving;
mod simulation;
pub(crate) mod state;
mod texts;
mod view;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};
use regrind_formats::RecipeFolder;

use super::shared::Shared;

/// Maximum size of a request. In JSON, a character of a recipe can need several bytes.
const MAX_REQUEST_BYTES: usize = 4 * RecipeFolder::MAX_BYTES as usize;

/// Returns the routes of the workbench.
pub(crate) fn routes() -> Router<Shared> {
    Router::new()
        .route("/recipes", get(view::list))
        .route("/recipes/open", get(view::open))
        .route("/recipes/{name}", get(view::recipe))
        .route("/recipe-schema", get(saving::schema))
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
