//! Live page of a cell: one screen for the person at the cell, the history of its runs, and orders through the same
//! socket as those of the terminal.
//!
//! ```text
//!  run folder: control.sock ==watch==> live ---> Seen --> view (HTML in user's language) --> stream --> every browser
//!              journal.sqlite --------> history --^        shape (maps and points in bytes) ------------> the canvas
//!  journal.sqlite, control.sock -> history, live -> api (JSON, events, metrics) ------------------------> other programs
//!  browser ==POST==> guard (key or user, Host, Origin, token, control) --> orders ==control.sock==> the drive
//! ```
//!
//! The page runs independently of the run. It reads the status that the run publishes and the record, and it can crash
//! without effect on the run. The program contains everything that a browser needs; nothing is fetched from elsewhere.

mod alarms;
mod api;
mod assets;
mod attachment;
mod chart;
mod components;
mod compression;
mod connections;
mod gauge;
mod guard;
mod guarded_server;
mod history;
mod live;
mod machines_view;
mod operator_step;
mod orders;
mod parts_view;
mod pieces;
mod problem;
mod program_access;
mod program_tokens;
mod rate;
mod reader;
mod record_view;
mod sessions;
mod settings_view;
mod shape;
mod shared;
mod sign_in;
mod stream;
mod subject;
mod texts;
mod tls;
mod users;
mod view;
mod viewers;
mod workbench;
mod write_timeout;

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

pub use gauge::gauge;
pub use guard::{Entrance, Session};
pub use guarded_server::GuardedServer;
pub use reader::Reader;
pub use shared::{Equipment, Page, RunPlan};
pub use subject::PageSubject;
pub use tls::{Tls, TlsError};
pub use users::{PageRole, Person, Users, UsersError, UsersFile};
pub use view::plant_document;
pub use viewers::Viewers;
pub use workbench::state::{RecipePrograms, Workbench};

use guard::Guard;
use history::History;
use live::RunWatcher;
use shared::{MAX_STREAMS, Shared};

/// Maximum size of the file of a measurement that a browser sends.
const MAX_MEASUREMENT_BYTES: usize = 64 << 20;

impl Page {
    /// Creates the page for the runs in the folder `runs`. `entrance` contains the address and the access rules of the
    /// page. `plan` plans the runs again, for what their folders do not contain. `log` gets the messages that are in no other record.
    ///
    /// # Errors
    /// The operating system has no random numbers for the key.
    pub fn new(
        runs: PathBuf,
        entrance: Entrance,
        plan: Box<dyn RunPlan>,
        log: Box<dyn Fn(&str) + Send + Sync>,
    ) -> io::Result<Self> {
        let history = Arc::new(History::new(runs));
        let live = RunWatcher::new(Arc::clone(&history));
        let runs = Arc::clone(&history);
        let on_record = Box::new(move |what| drop(orders::write_down(&runs, None, what)));
        let guard = Arc::new(Guard::new(entrance, PageSubject::Cell, log, on_record)?);
        let viewers = Viewers::new();
        let streams = Arc::new(Semaphore::new(MAX_STREAMS));
        Ok(Self { guard, run_watcher: live, history, plan, viewers, workbench: None, streams, first_run: None })
    }

    /// Shows the run named `run` first, even if other runs are active.
    pub fn with_first_run(self, run: Option<String>) -> Self {
        Self { first_run: run, ..self }
    }

    /// Adds the workbench, in which an engineer writes recipes.
    pub fn with_workbench(self, workbench: Option<Workbench>) -> Self {
        Self { workbench, ..self }
    }

    /// Returns the browsers that show a run now.
    pub fn viewers(&self) -> Viewers {
        self.viewers.clone()
    }

    /// Returns the address (URL) that opens the page. It contains the key if there is no list of users.
    pub fn url(&self) -> String {
        self.guard.url()
    }

    /// Serves the page to clients that connect to `listener`, as long as the returned future is polled.
    pub async fn serve(self, listener: TcpListener) {
        let guard = Arc::clone(&self.guard);
        let page = Arc::new(self);
        guarded_server::serve(listener, guard, routes(Arc::clone(&page)), api::routes(page)).await;
    }
}

/// Returns the routes of the page for authorised clients.
fn routes(page: Shared) -> Router {
    Router::new()
        .route("/", get(view::home))
        .route("/runs", get(view::runs))
        .route("/parts", get(parts_view::parts))
        .route("/parts/{serial}", get(parts_view::part))
        .route("/compare", get(view::compare))
        .route("/runs/{run}", get(view::run))
        .route("/runs/{run}/events", get(stream::events))
        .route("/runs/{run}/orders", post(orders::order))
        .route("/runs/{run}/measurement", post(orders::measurement).layer(DefaultBodyLimit::max(MAX_MEASUREMENT_BYTES)))
        .route("/runs/{run}/control", post(orders::take_control))
        .route("/runs/{run}/step-file", get(operator_step::step_file))
        .route("/runs/{run}/report", get(view::report))
        .route("/runs/{run}/record", get(record_view::record))
        .route("/machines", get(machines_view::home))
        .route("/runs/{run}/machines", get(machines_view::machines))
        .route("/settings", get(settings_view::settings))
        .route("/components", get(components::components))
        .route("/runs/{run}/planned", get(shape::planned))
        .route("/runs/{run}/path", get(shape::path))
        .route("/runs/{run}/touched", get(shape::touched))
        .route("/runs/{run}/cycles/{cycle}/map", get(shape::map))
        .route("/runs/{run}/cycles/{cycle}/points", get(shape::points))
        .route("/runs/{run}/cycles/{cycle}/files/{name}", get(shape::saved_file))
        .merge(workbench::routes())
        .with_state(page)
}
