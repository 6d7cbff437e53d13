//! The door of a page: what stands behind it is for who is let in, over TLS or on this computer, one connection at a time.

use std::io;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::header::CONNECTION;
use axum::http::{HeaderMap, StatusCode};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use hyper::body::Incoming;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio::task::AbortHandle;

use super::guard::{self, Entrance, Guard, Peer};
use super::sign_in::place;
use super::view::{self, PageOf};
use super::{assets, sign_in};

/// Most connections at a time of those who are let in, of those who are not yet, and of the latter from one address.
const KNOWN: usize = 512;
const STRANGERS: usize = 384;
const STRANGERS_OF_ADDRESS: usize = 64;
/// The longest a client may take to say what it wants, and the longest until the answer to an order begins, for its body and for a cell that does
/// not answer at once.
const PATIENCE: Duration = Duration::from_secs(10);
const ANSWERS_WITHIN: Duration = Duration::from_secs(25);
/// Longest body of an order.
const LONGEST_BODY: usize = 4096;

/// The door of a page that gives no orders to a cell.
pub struct Door {
    guard: Arc<Guard>,
}

impl Door {
    /// Makes ready to let people in to a page. `log` takes what was refused, and who signed in.
    ///
    /// # Errors
    /// No random numbers for the key.
    pub fn new(entrance: Entrance, of: PageOf, log: Box<dyn Fn(&str) + Send + Sync>) -> io::Result<Self> {
        // It belongs to no run: what is refused is told, and stands nowhere else.
        Ok(Self { guard: Arc::new(Guard::new(entrance, of, log, Box::new(drop))?) })
    }

    /// Returns the address that opens the page, with its key where there are no users.
    pub fn url(&self) -> String {
        self.guard.url()
    }

    /// Shows what the routes show to whoever is let in, for as long as it is polled.
    pub async fn serve(self, listener: TcpListener, routes: Router) {
        serve(listener, self.guard, routes).await;
    }
}

/// Shows what stands behind a guard to whoever comes, for as long as it is polled.
pub(crate) async fn serve(listener: TcpListener, guard: Arc<Guard>, routes: Router) {
    let tls = guard.entrance.tls.clone();
    let service = TowerToHyperService::new(guarded(guard, routes));
    let connections = Arc::new(Connections::default());
    for number in 0.. {
        let Ok((stream, peer)) = listener.accept().await else {
            // No descriptor is left, or the client has gone: that passes.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let (service, tls) = (service.clone(), tls.clone());
        let place = Place { connections: Arc::clone(&connections), number };
        let (of, task) = (peer.ip(), Arc::clone(&connections));
        let is_known: Arc<dyn Fn() + Send + Sync> = Arc::new(move || task.know(number));
        let (is_listed, listed) = oneshot::channel::<()>();
        let serving = tokio::spawn(async move {
            let _place = place;
            // A connection that ends, or is let in, is on the list by then.
            if listed.await.is_err() {
                return;
            }
            // A client that goes away or misbehaves is no concern of anybody else.
            match tls {
                None => answer(stream, Peer(peer.ip(), is_known), service).await,
                Some(tls) => {
                    if let Ok(Ok(stream)) = tokio::time::timeout(PATIENCE, tls.accept(stream)).await {
                        answer(stream, Peer(peer.ip(), is_known), service).await;
                    }
                }
            }
        });
        connections.open().add(number, of, serving.abort_handle());
        // It may have ended with the program.
        let _ = is_listed.send(());
    }
}

/// The connections of a page. One more than there is room for of those who are not let in ends the oldest of them, of the same address or network, or of
/// that which has most: whoever opens many and says nothing keeps out nobody elsewhere, and nobody who has come in.
#[derive(Default)]
struct Connections(Mutex<Open>);

#[derive(Default)]
struct Open {
    /// In the order in which they came, those of strangers.
    strangers: Vec<(u64, IpAddr, AbortHandle)>,
    known: Vec<(u64, AbortHandle)>,
}

impl Connections {
    fn open(&self) -> MutexGuard<'_, Open> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whoever is at the other end has been let in.
    fn know(&self, number: u64) {
        let mut open = self.open();
        if let Some(at) = open.strangers.iter().position(|(of, ..)| *of == number) {
            let (_, _, serving) = open.strangers.remove(at);
            open.known.push((number, serving));
            if open.known.len() > KNOWN {
                open.known.remove(0).1.abort();
            }
        }
    }

    fn end(&self, number: u64) {
        let mut open = self.open();
        open.strangers.retain(|(of, ..)| *of != number);
        open.known.retain(|(of, _)| *of != number);
    }
}

impl Open {
    fn add(&mut self, number: u64, from: IpAddr, serving: AbortHandle) {
        self.strangers.push((number, place(from), serving));
        let count = |from: IpAddr| self.strangers.iter().filter(|(_, of, _)| *of == from).count();
        let most = match count(place(from)) > STRANGERS_OF_ADDRESS {
            true => Some(place(from)),
            false if self.strangers.len() > STRANGERS => {
                self.strangers.iter().map(|(_, of, _)| *of).max_by_key(|of| count(*of))
            }
            false => None,
        };
        let oldest = most.and_then(|from| self.strangers.iter().position(|(_, of, _)| *of == from));
        if let Some(oldest) = oldest {
            self.strangers.remove(oldest).2.abort();
        }
    }
}

/// A connection, until it ends.
struct Place {
    connections: Arc<Connections>,
    number: u64,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.connections.end(self.number);
    }
}

/// Answers what comes over one connection.
async fn answer(
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    peer: Peer,
    service: TowerToHyperService<Router>,
) {
    let mut http = hyper::server::conn::http1::Builder::new();
    let http = http.timer(TokioTimer::new()).header_read_timeout(PATIENCE);
    let service = service_fn(move |mut request: hyper::Request<Incoming>| {
        request.extensions_mut().insert(peer.clone());
        service.call(request)
    });
    drop(http.serve_connection(TokioIo::new(stream), service).await);
}

/// Puts the guard before some routes, and beside them what is for everybody.
fn guarded(guard: Arc<Guard>, routes: Router) -> Router {
    let own = Router::new()
        .route("/token", get(guard::token))
        .route("/sign-out", post(sign_in::sign_out))
        .fallback(async |State(guard): State<Arc<Guard>>, headers: HeaderMap| view::not_here(guard.of, &headers))
        .with_state(Arc::clone(&guard));
    own.merge(routes)
        .layer(from_fn_with_state(Arc::clone(&guard), guard::let_in))
        .route("/sign-in", post(sign_in::sign_in).with_state(Arc::clone(&guard)))
        .route("/assets/{name}", get(assets::asset))
        .layer(from_fn_with_state(guard, guard::names_this_page))
        .layer(DefaultBodyLimit::max(LONGEST_BODY))
        .layer(from_fn(in_time))
}

/// Gives up an order whose answer does not begin in time, be it that its body does not come.
async fn in_time(request: Request, next: Next) -> Response {
    // A request that only looks has no body that could stay away, and a proof of a large record takes its time.
    if request.method().is_safe() {
        return next.run(request).await;
    }
    match tokio::time::timeout(ANSWERS_WITHIN, next.run(request)).await {
        Ok(response) => response,
        // The connection has half a request on it, and is of no more use.
        Err(_) => (StatusCode::REQUEST_TIMEOUT, [(CONNECTION, "close")]).into_response(),
    }
}
