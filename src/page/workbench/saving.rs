//! Saves recipes, and serves their versions.

use axum::Extension;
use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use regrind_formats::{FormatError, RecipeFolder};
use serde::Deserialize;
use tokio::task::spawn_blocking;

use super::super::guard::{Session, foreign};
use super::super::shared::Shared;
use super::access::{TOO_LONG, for_engineer, plain, refused};
use super::draft::checked;

/// Text that a browser saves.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ToSave {
    text: String,
    /// Text that the file had when the person read it; absent for a new recipe.
    replaces: Option<String>,
}

/// Saves a text as the recipe named `name` and as its next version. Refuses this if the text has a problem, or if the
/// file was changed since the person has read it. Responds with the version.
pub(crate) async fn save(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    if let Some(what) = foreign(&page.guard, &headers, &session) {
        page.guard.refused(&what);
        return refused(StatusCode::FORBIDDEN, what);
    }
    let workbench = match for_engineer(&page, &session) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    let Ok(ToSave { text, replaces }) = serde_json::from_slice(&body) else {
        return refused(StatusCode::BAD_REQUEST, "the request is not that of this page; load the page again");
    };
    let Some(path) = workbench.recipes.file(&name) else {
        return refused(StatusCode::BAD_REQUEST, FormatError::RecipeName { name }.to_string());
    };
    if text.len() as u64 > RecipeFolder::MAX_BYTES {
        return refused(StatusCode::PAYLOAD_TOO_LARGE, TOO_LONG);
    }
    let _saving = workbench.saving.lock().await;
    if let Err(response) = checked(workbench, &path, &text).await {
        return response;
    }
    let by = session.person.as_ref().map_or_else(String::new, |person| person.name.clone());
    let now = regrind_report::now();
    on_disk(workbench.recipes.clone(), move |recipes| recipes.save(&name, &text, replaces.as_deref(), [&by, &now]))
        .await
        .map_or_else(|response| response, |saved| Json(saved).into_response())
}

/// Serves the JSON schema of a recipe.
pub(crate) async fn schema(State(page): State<Shared>, Extension(session): Extension<Session>) -> Response {
    match for_engineer(&page, &session) {
        Ok(workbench) => Json(workbench.programs.schema()).into_response(),
        Err(response) => *response,
    }
}

/// Serves the present text of the recipe named `name`.
pub(crate) async fn text(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
) -> Response {
    served(&page, &session, move |recipes| recipes.text(&name)).await
}

/// Serves the list of the saved versions of the recipe named `name`.
pub(crate) async fn versions(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
) -> Response {
    let recipes = match for_engineer(&page, &session) {
        Ok(workbench) => workbench.recipes.clone(),
        Err(response) => return *response,
    };
    on_disk(recipes, move |recipes| recipes.versions(&name))
        .await
        .map_or_else(|response| response, |versions| Json(versions).into_response())
}

/// Serves the text of a saved version of the recipe named `name`.
pub(crate) async fn version(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path((name, number)): Path<(String, u32)>,
) -> Response {
    served(&page, &session, move |recipes| recipes.text_of_version(&name, number)).await
}

/// Responds with the text that `read` finds, or with the status 404 if there is none.
async fn served(
    page: &Shared,
    session: &Session,
    read: impl FnOnce(&RecipeFolder) -> Result<Option<String>, FormatError> + Send + 'static,
) -> Response {
    let recipes = match for_engineer(page, session) {
        Ok(workbench) => workbench.recipes.clone(),
        Err(response) => return *response,
    };
    match on_disk(recipes, read).await {
        Ok(Some(text)) => plain(text),
        Ok(None) => refused(StatusCode::NOT_FOUND, "there is no such text"),
        Err(response) => response,
    }
}

/// Works with the folder of recipes without blocking other requests.
///
/// # Errors
/// Returns the response to the browser: a conflict with another person or program, a name that is not plain, or a disk
/// that fails.
pub(super) async fn on_disk<T: Send + 'static>(
    recipes: RecipeFolder,
    work: impl FnOnce(&RecipeFolder) -> Result<T, FormatError> + Send + 'static,
) -> Result<T, Response> {
    with_recipes(recipes, work).await.map_err(|(status, reason)| refused(status, reason))
}

/// Works with the folder of recipes without blocking other requests.
///
/// # Errors
/// Returns the status of the response, and the reason.
pub(super) async fn with_recipes<T: Send + 'static>(
    recipes: RecipeFolder,
    work: impl FnOnce(&RecipeFolder) -> Result<T, FormatError> + Send + 'static,
) -> Result<T, (StatusCode, String)> {
    match spawn_blocking(move || work(&recipes)).await {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(error)) => Err((status_of(&error), error.to_string())),
        Err(error) => Err((StatusCode::INTERNAL_SERVER_ERROR, error.to_string())),
    }
}

fn status_of(error: &FormatError) -> StatusCode {
    match error {
        FormatError::ChangedMeanwhile { .. } => StatusCode::CONFLICT,
        FormatError::RecipeName { .. } => StatusCode::BAD_REQUEST,
        FormatError::NoRecipe { .. } | FormatError::RecipeElsewhere { .. } => StatusCode::FORBIDDEN,
        FormatError::RecipeBusy { .. } => StatusCode::SERVICE_UNAVAILABLE,
        FormatError::TooLarge { .. } => StatusCode::PAYLOAD_TOO_LARGE,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    }
}
