//! The page of a plant: all its cells, what they made, and how it came out. It looks and orders nothing.
//!
//! ```text
//!  browser --GET--> door of regrind-page --> a question each page --> pool --> views of migrations/, as a reader
//!                                        --> proofs: a run brought back, proven, and its report made of it
//! ```
//!
//! Everything that it says stands in the views, which Grafana reads too. What comes from a cell is words and never HTML.

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

/// The look of what the page of a cell does not have.
const STYLE: &str = "/plant.css";
/// Longest time that a page is worked on.
const PATIENCE: Duration = Duration::from_secs(15);
/// How soon a page is asked for again that could not be made.
const AGAIN_S: u32 = 5;

/// What the page of a plant is made of.
pub struct PlantPage {
    pool: Pool,
    proofs: Proofs,
    artefacts: Option<ArtefactSettings>,
}

/// Shared by everything that answers.
type Shared = Arc<PlantPage>;

impl PlantPage {
    /// Makes ready to show the plant whose database this is. It need not be there yet.
    pub fn new(database: DatabaseSettings, artefacts: Option<ArtefactSettings>) -> Self {
        Self { pool: Pool::new(database), proofs: Proofs::default(), artefacts }
    }

    /// What is there for who is let in.
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

    /// A connection for a few questions.
    async fn lease(&self) -> Result<Lease<'_>, PlantError> {
        self.pool.lease().await
    }
}

async fn style() -> Response {
    ([(CONTENT_TYPE, "text/css; charset=utf-8"), (CACHE_CONTROL, "no-cache")], include_str!("plant.css"))
        .into_response()
}

/// A page, or why there is none.
struct Made {
    title: String,
    again_s: Option<u32>,
    main: Markup,
}

/// Why a page is not made.
enum Unmade {
    /// The database is not there, or says no.
    Plant(Box<PlantError>),
    /// There is nothing of that name.
    NotHere(String),
    /// What was asked makes no sense.
    Nonsense(String),
}

impl From<PlantError> for Unmade {
    fn from(error: PlantError) -> Self {
        Self::Plant(Box::new(error))
    }
}

/// Answers with a page, within the time that there is.
async fn page(session: &Session, making: impl Future<Output = Result<Made, Unmade>>) -> Response {
    match within(making).await {
        Ok(Made { title, again_s, main }) => plant_document(&title, session, again_s, STYLE, main),
        Err(why) => unmade(session, &why),
    }
}

/// Gives what is made within the time that there is.
async fn within<T>(making: impl Future<Output = Result<T, Unmade>>) -> Result<T, Unmade> {
    let late = || {
        let what = format!("nothing came within {} s", PATIENCE.as_secs());
        Unmade::from(PlantError::Unreachable { place: "the other end".into(), what })
    };
    tokio::time::timeout(PATIENCE, making).await.unwrap_or_else(|_| Err(late()))
}

/// Says why there is no page. One that may be there again is asked for again by itself.
fn unmade(session: &Session, why: &Unmade) -> Response {
    let (status, again_s, title, words) = match why {
        Unmade::Plant(error) if error.may_pass() => {
            (StatusCode::SERVICE_UNAVAILABLE, Some(AGAIN_S), "The database of the plant is away", error.to_string())
        }
        Unmade::Plant(error) => {
            (StatusCode::INTERNAL_SERVER_ERROR, None, "The database of the plant says no", error.to_string())
        }
        Unmade::NotHere(what) => (StatusCode::NOT_FOUND, None, "Not here", what.clone()),
        Unmade::Nonsense(what) => (StatusCode::BAD_REQUEST, None, "That cannot be asked", what.clone()),
    };
    let main = html! {
        main .list .plant {
            h1 { (title) }
            p role="alert" { (words::shown(&words)) }
            @if again_s.is_some() {
                p { "Cells grind, hold and accept without it; their records wait at the cells. What the cells do now is not known here. "
                    "This page tries again by itself every " (AGAIN_S) " s." }
            }
        }
    };
    (status, plant_document(title, session, again_s, STYLE, main)).into_response()
}
