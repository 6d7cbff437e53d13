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
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::middleware::from_fn_with_state;
use axum::routing::{get, post};
use hyper::body::Incoming;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

pub use guard::Entrance;
pub use tls::{Tls, TlsError};
pub use users::{PageRole, Person, Users, UsersError, UsersFile};

use guard::{Guard, Peer};
use history::History;
use live::Live;

/// Most connections at a time, and the longest a client may take to say what it wants.
const CONNECTIONS: usize = 512;
const PATIENCE: Duration = Duration::from_secs(10);
/// Longest body of an order.
const LONGEST_BODY: usize = 4096;

/// Where the probe is to touch in a run, in the order in which it does: x and y in millimetres, model frame.
pub type PlannedPoints = dyn Fn(&Path) -> Option<Vec<[f64; 2]>> + Send + Sync;

/// What the page is made of.
pub struct Page {
    guard: Guard,
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
        Ok(Self { guard: Guard::new(entrance, log)?, live, history, planned })
    }

    /// Returns the address that opens the page, with its key where there are no users.
    pub fn url(&self) -> String {
        self.guard.url()
    }

    /// Shows the page to whoever comes, for as long as it is polled.
    pub async fn serve(self, listener: TcpListener) {
        let tls = self.guard.entrance.tls.clone();
        let service = TowerToHyperService::new(router(Arc::new(self)));
        let places = Arc::new(Semaphore::new(CONNECTIONS));
        loop {
            let Ok(place) = Arc::clone(&places).acquire_owned().await else { return };
            let Ok((stream, peer)) = listener.accept().await else {
                // No descriptor is left, or the client has gone: that passes.
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            };
            let (service, tls) = (service.clone(), tls.clone());
            tokio::spawn(async move {
                let _place = place;
                // A client that goes away or misbehaves is no concern of anybody else.
                match tls {
                    None => answer(stream, peer.ip(), service).await,
                    Some(tls) => {
                        if let Ok(Ok(stream)) = tokio::time::timeout(PATIENCE, tls.accept(stream)).await {
                            answer(stream, peer.ip(), service).await;
                        }
                    }
                }
            });
        }
    }
}

/// Answers what comes over one connection.
async fn answer(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    from: IpAddr,
    service: TowerToHyperService<Router>,
) {
    let mut http = hyper::server::conn::http1::Builder::new();
    let http = http.timer(TokioTimer::new()).header_read_timeout(PATIENCE);
    let service = service_fn(move |mut request: hyper::Request<Incoming>| {
        request.extensions_mut().insert(Peer(from));
        service.call(request)
    });
    drop(http.serve_connection(TokioIo::new(stream), service).await);
}

fn router(page: Shared) -> Router {
    Router::new()
        .route("/", get(view::home))
        .route("/token", get(guard::token))
        .route("/sign-out", post(sign_in::sign_out))
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
        .fallback(view::not_here)
        .layer(from_fn_with_state(Arc::clone(&page), guard::let_in))
        .route("/sign-in", post(sign_in::sign_in))
        .route("/assets/{name}", get(assets::asset))
        .layer(from_fn_with_state(Arc::clone(&page), guard::names_this_page))
        .layer(DefaultBodyLimit::max(LONGEST_BODY))
        .with_state(page)
}
