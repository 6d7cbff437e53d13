//! The live page of a cell: one screen for who stands before it, the history of its runs, and orders through the same door as those
//! of the terminal.
//!
//! ```text
//!  run folder: control.sock ==watch==> live ---> Seen --> view (HTML in a person's language) --> stream --> every browser
//!              journal.sqlite --------> history --^        shape (maps and points in bytes) ------------> the canvas
//!  browser ==POST==> guard (key or user, Host, Origin, token, control) --> orders ==control.sock==> the drive
//! ```
//!
//! The page stands beside the run and never within it: it reads what the run tells and what is on record, and it can die without the
//! run noticing. Everything that a browser needs is in the program; nothing is fetched from elsewhere.

mod alarms;
mod assets;
mod chart;
mod door;
mod guard;
mod history;
mod live;
mod orders;
mod shape;
mod sign_in;
mod stream;
mod texts;
mod tls;
mod users;
mod view;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::Router;
use axum::routing::{get, post};
use tokio::net::TcpListener;

pub use door::Door;
pub use guard::{Entrance, Session};
pub use tls::{Tls, TlsError};
pub use users::{PageRole, Person, Users, UsersError, UsersFile};
pub use view::{PageOf, plant_document};

use guard::Guard;
use history::History;
use live::Live;

/// Where the probe is to touch in a run, in the order in which it does: x and y in millimetres, model frame.
pub type PlannedPoints = dyn Fn(&Path) -> Option<Vec<[f64; 2]>> + Send + Sync;

/// What the page is made of.
pub struct Page {
    guard: Arc<Guard>,
    live: Live,
    history: Arc<History>,
    planned: Box<PlannedPoints>,
}

/// Shared by everything that answers.
type Shared = Arc<Page>;

impl Page {
    /// Makes ready to show the runs in a folder. `planned` tells where the probe is to touch; `log` takes what nobody else would keep.
    ///
    /// # Errors
    /// No random numbers for the key.
    pub fn new(
        runs: PathBuf,
        entrance: Entrance,
        planned: Box<PlannedPoints>,
        log: Box<dyn Fn(&str) + Send + Sync>,
    ) -> io::Result<Self> {
        let history = Arc::new(History::new(runs));
        let live = Live::new(Arc::clone(&history));
        let runs = Arc::clone(&history);
        let on_record = Box::new(move |what| drop(orders::write_down(&runs, None, what)));
        let guard = Arc::new(Guard::new(entrance, PageOf::Cell, log, on_record)?);
        Ok(Self { guard, live, history, planned })
    }

    /// Returns the address that opens the page, with its key where there are no users.
    pub fn url(&self) -> String {
        self.guard.url()
    }

    /// Shows the page to whoever comes, for as long as it is polled.
    pub async fn serve(self, listener: TcpListener) {
        let guard = Arc::clone(&self.guard);
        door::serve(listener, guard, routes(Arc::new(self))).await;
    }
}

/// What is there for who is let in.
fn routes(page: Shared) -> Router {
    Router::new()
        .route("/", get(view::home))
        .route("/runs", get(view::runs))
        .route("/compare", get(view::compare))
        .route("/runs/{run}", get(view::run))
        .route("/runs/{run}/events", get(stream::events))
        .route("/runs/{run}/orders", post(orders::order))
        .route("/runs/{run}/control", post(orders::take_control))
        .route("/runs/{run}/report", get(view::report))
        .route("/runs/{run}/planned", get(shape::planned))
        .route("/runs/{run}/cycles/{cycle}/map", get(shape::map))
        .route("/runs/{run}/cycles/{cycle}/points", get(shape::points))
        .with_state(page)
}
