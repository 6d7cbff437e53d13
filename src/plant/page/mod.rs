//! Web page of a plant: all its cells, the parts that they made, and the results. The page only reads; it commands
//! nothing.
//!
//! ```text
//!  browser --GET--> sign-in (regrind-page) --> queries of a page --> pool --> views of migrations/, as a reader
//!                                          --> proofs: fetch a run, verify it, and make its report
//! ```
//!
//! All figures of the page are in the views, which Grafana reads too. Texts from a cell are shown as text, never as
//! HTML. The texts of the page are in the files of the languages (regrind-language).

mod bars;
mod board;
mod capability;
mod cells;
mod compare;
mod content;
mod control_chart;
mod convergence;
mod cycle_counts;
#[cfg(test)]
mod draws;
mod export;
mod home;
mod maps;
mod natural;
mod nelson;
mod page_error;
mod parts;
mod pool;
mod proof;
mod proofs;
mod rank;
mod run;
mod selection;
mod shared;
mod style;
mod texts;
mod trend;
mod words;

use std::sync::Arc;

use axum::Router;
use axum::routing::get;

pub use shared::PlantPage;
use style::{STYLE, style};

impl PlantPage {
    /// Returns the router with all addresses of the plant's web page. The caller must let only people who have signed
    /// in reach these addresses, and must attach their [`Session`](regrind_page::Session) to each request as an extension.
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
}
