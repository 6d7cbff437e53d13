//! Web page of a plant: all its cells, the parts that they made, and the results. The page only reads; it commands
//! nothing.
//!
//! ```text
//!  browser --GET--> sign-in (regrind-page) --> queries of a page --> pool --> views of migrations/, as a reader
//!                                          --> proofs: fetch a run, verify it, and make its report
//! ```
//!
//! All figures of the page are in the views, which Grafana reads too. Texts from a cell are shown as text, never as
//! HTML.

mod bars;
mod cells;
mod compare;
mod control_chart;
mod export;
mod home;
mod maps;
mod parts;
mod pool;
mod proof;
mod rank;
mod run;
mod selection;
mod trend;
mod words;

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use maud::{Markup, html};
use regrind_page::{Session, plant_document};

use super::error::PlantError;
use super::settings::{ArtefactSettings, DatabaseSettings};
use pool::{Lease, Pool};
use proof::Proofs;

/// Path of the style sheet for the parts that the page of a cell does not have.
const STYLE: &str = "/plant.css";
/// Time limit for making a page.
const PATIENCE: Duration = Duration::from_secs(15);
/// Seconds until the browser retries a page that could not be made.
const AGAIN_S: u32 = 5;

/// State of the page of a plant.
pub struct PlantPage {
    pool: Pool,
    proofs: Proofs,
    artefacts: Option<ArtefactSettings>,
}

/// Page state shared by all handlers.
type Shared = Arc<PlantPage>;

impl PlantPage {
    /// Creates the state of the plant's web page. `database` contains the settings for the connection to the plant's
    /// database. `artefacts` names the folder for files that are too large for the database; it is `None` if there is
    /// no such folder. Does not connect yet, so the database need not be reachable.
    pub fn new(database: DatabaseSettings, artefacts: Option<ArtefactSettings>) -> Self {
        Self { pool: Pool::new(database), proofs: Proofs::default(), artefacts }
    }

    /// Returns the router with all addresses of the plant's web page. The caller must let only people who have signed
    /// in reach these addresses, and must attach their [`Session`] to each request as an extension.
    pub fn routes(self) -> Router {
        Router::new()
            .route("/", get(home::home))
            .route("/trend", get(trend::trend))
            .route("/trend.dfq", get(export::dfq))
            .route("/cells", get(compare::cells))
            .route("/parts", get(parts::parts))
            .route("/export.csv", get(export::csv))
            .route("/run", get(run::by_name))
            .route("/runs/{id}", get(run::run))
            .route("/runs/{id}/report", get(run::report))
            .route("/runs/{id}/qif", get(run::qif))
            .route("/runs/{id}/dfq", get(run::dfq))
            .route("/maps", get(maps::maps))
            .route(STYLE, get(style))
            .with_state(Arc::new(self))
    }

    /// Takes a database connection from the pool for a few queries. The connection returns to the pool when the lease
    /// is dropped. Returns an error if no connection becomes free in time or if the database cannot be reached.
    async fn lease(&self) -> Result<Lease<'_>, PlantError> {
        self.pool.lease().await
    }
}

async fn style() -> Response {
    ([(CONTENT_TYPE, "text/css; charset=utf-8"), (CACHE_CONTROL, "no-cache")], include_str!("plant.css"))
        .into_response()
}

/// Finished page.
struct PageContent {
    title: String,
    again_s: Option<u32>,
    main: Markup,
}

/// Reason why a page is not made.
enum PageError {
    /// The database cannot be reached, or refuses.
    Plant(Box<PlantError>),
    /// The requested object does not exist.
    NotHere(String),
    /// The request is invalid.
    Nonsense(String),
}

impl From<PlantError> for PageError {
    fn from(error: PlantError) -> Self {
        Self::Plant(Box::new(error))
    }
}

/// Returns the HTML page whose content the future `making` computes. If `making` fails, or takes longer than the time
/// limit (15 s), returns a page with the reason. `session` is the session of the person who has signed in.
async fn page(session: &Session, making: impl Future<Output = Result<PageContent, PageError>>) -> Response {
    match within(making).await {
        Ok(PageContent { title, again_s, main }) => plant_document(&title, session, again_s, STYLE, main),
        Err(reason) => unmade(session, &reason),
    }
}

/// Waits for the future `making` and returns its result. Returns an error if `making` does not finish within the time
/// limit of a page (15 s).
async fn within<T>(making: impl Future<Output = Result<T, PageError>>) -> Result<T, PageError> {
    let late = || {
        let what = format!("no answer within {} s", PATIENCE.as_secs());
        PageError::from(PlantError::Unreachable { place: "the other end".into(), what })
    };
    tokio::time::timeout(PATIENCE, making).await.unwrap_or_else(|_| Err(late()))
}

/// Returns an error page. `reason` is the reason why the requested page cannot be shown. The page contains the reason,
/// and the reason determines the HTTP status. If the plant cannot be reached, the browser requests the page again every
/// 5 s. `session` is the session of the person who has signed in.
fn unmade(session: &Session, reason: &PageError) -> Response {
    let (status, again_s, title, words) = match reason {
        PageError::Plant(error) if error.may_pass() => (
            StatusCode::SERVICE_UNAVAILABLE,
            Some(AGAIN_S),
            "The database of the plant cannot be reached",
            error.to_string(),
        ),
        PageError::Plant(error) => (
            StatusCode::INTERNAL_SERVER_ERROR,
            None,
            "The database of the plant refused the request",
            error.to_string(),
        ),
        PageError::NotHere(what) => (StatusCode::NOT_FOUND, None, "Not found", what.clone()),
        PageError::Nonsense(what) => (StatusCode::BAD_REQUEST, None, "Invalid request", what.clone()),
    };
    let main = html! {
        main .list .plant {
            h1 { (title) }
            p role="alert" { (words::shown(&words)) }
            @if again_s.is_some() {
                p { "Cells grind, hold and accept without the database; their records wait at the cells. The present state of the cells is not known here. "
                    "This page tries again by itself every " (AGAIN_S) " s." }
            }
        }
    };
    (status, plant_document(title, session, again_s, STYLE, main)).into_response()
}
