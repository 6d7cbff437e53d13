//! Access to a page: serves its routes to authorised clients, over TLS or on this computer, with limits on connections.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::header::CONNECTION;
use axum::http::{HeaderMap, StatusCode};
use axum::middleware::{Next, from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use hyper::body::Incoming;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::oneshot;

use super::compression::compression;
use super::connections::Place;
use super::guard::{self, Admission, Entrance, Guard, Peer};
use super::subject::PageSubject;
use super::write_timeout::ImpatientWriter;
use super::{assets, sign_in, view};

/// Timeout for a client to send its request, and timeout until the answer to an order begins. The second timeout
/// includes the time for the body of the order and for the answer of the cell.
const PATIENCE: Duration = Duration::from_secs(10);
const ANSWERS_WITHIN: Duration = Duration::from_secs(25);
/// Maximum length of the body of an order, in bytes.
const LONGEST_BODY: usize = 4096;

/// Access to a page that gives no orders to a cell.
pub struct GuardedServer {
    guard: Arc<Guard>,
}

impl GuardedServer {
    /// Creates the access control for a page that belongs to no run. Refused requests are therefore only logged, and
    /// not recorded in a run. `entrance` contains the address and the access rules of the page. `of` says whether the
    /// page shows one cell or the plant. `log` gets a message for each refused request and each sign-in.
    ///
    /// # Errors
    /// The operating system has no random numbers for the key.
    pub fn new(entrance: Entrance, of: PageSubject, log: Box<dyn Fn(&str) + Send + Sync>) -> io::Result<Self> {
        // The page belongs to no run, so refusals go to the log only.
        Ok(Self { guard: Arc::new(Guard::new(entrance, of, log, Box::new(drop))?) })
    }

    /// Returns the address (URL) that opens the page. It contains the key if there is no list of users.
    pub fn url(&self) -> String {
        self.guard.url()
    }

    /// Serves `routes` to authorised clients that connect to `listener`, as long as the returned future is polled.
    pub async fn serve(self, listener: TcpListener, routes: Router) {
        serve(listener, self.guard, routes, Router::new()).await;
    }
}

/// Serves `routes` behind the access control of `guard` to clients that connect to `listener`, as long as the returned
/// future is polled. `for_programs` are routes with an access control of their own.
pub(crate) async fn serve(listener: TcpListener, guard: Arc<Guard>, routes: Router, for_programs: Router) {
    let tls = guard.entrance.tls.clone();
    let connections = Arc::clone(&guard.connections);
    let service = TowerToHyperService::new(guarded(guard, routes, for_programs));
    for number in 0.. {
        let Ok((stream, peer)) = listener.accept().await else {
            // No file descriptor is free, or the client has gone. Both are temporary.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let (service, tls) = (service.clone(), tls.clone());
        let place = Place::new(&connections, number);
        let (of, task) = (peer.ip(), Arc::clone(&connections));
        let is_known: Arc<dyn Fn() + Send + Sync> = Arc::new(move || task.know(number));
        let (is_listed, listed) = oneshot::channel::<()>();
        let serving = tokio::spawn(async move {
            let _place = place;
            // Wait until the connection is on the list, so that it can be found there when it ends or is authorised.
            if listed.await.is_err() {
                return;
            }
            // An error of one client must not affect the others.
            match tls {
                None => answer(stream, Peer(peer.ip(), is_known), service).await,
                Some(tls) => {
                    if let Ok(Ok(stream)) = tokio::time::timeout(PATIENCE, tls.accept(stream)).await {
                        answer(stream, Peer(peer.ip(), is_known), service).await;
                    }
                }
            }
        });
        connections.add(number, of, serving.abort_handle());
        // The receiver may have ended with the program.
        let _ = is_listed.send(());
    }
}

/// Serves all HTTP requests on the connection `stream` until the connection ends. `service` creates the response to
/// each request. `peer` contains the address of the client; the function attaches it to each request as an extension.
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
    drop(http.serve_connection(TokioIo::new(ImpatientWriter::new(stream)), service).await);
}

/// Returns `routes` behind the access control of `guard`, together with the routes that everybody can use (sign-in and
/// assets) and with `for_programs`. Texts are compressed.
fn guarded(guard: Arc<Guard>, routes: Router, for_programs: Router) -> Router {
    let own = Router::new()
        .route("/token", get(guard::token))
        .route("/sign-out", post(sign_in::sign_out))
        .fallback(async |State(guard): State<Arc<Guard>>, headers: HeaderMap| view::not_here(guard.subject, &headers))
        .with_state(Arc::clone(&guard));
    own.merge(routes)
        .layer(from_fn_with_state(Arc::clone(&guard), let_in))
        .route("/sign-in", post(sign_in::sign_in).with_state(Arc::clone(&guard)))
        .route("/assets/{name}", get(assets::asset))
        .merge(for_programs)
        .layer(from_fn_with_state(guard, guard::names_this_page))
        .layer(compression())
        .layer(DefaultBodyLimit::max(LONGEST_BODY))
        .layer(from_fn(in_time))
}

/// Middleware that checks the access of a client. Passes the request to `next` if the client has signed in or, on a
/// page without a list of users, if the client has the key. Any other client gets the sign-in page, or the page that
/// asks for the key. If the address contains the correct key, redirects the browser to the address without the key and
/// stores the key in a cookie.
async fn let_in(
    State(guard): State<Arc<Guard>>,
    Extension(Peer(from, is_known)): Extension<Peer>,
    mut request: Request,
    next: Next,
) -> Response {
    match guard.admit(&request, from) {
        Ok(Admission::Admitted(session)) => {
            is_known();
            request.extensions_mut().insert(session);
            next.run(request).await
        }
        Ok(Admission::Redirected(response)) => response,
        Err(denied) => view::denied(denied, guard.subject, request.headers()),
    }
}

/// Middleware with a timeout for requests that change something, such as POST. If the response to such a request does
/// not begin within `ANSWERS_WITHIN`, for example because its body does not arrive, the client gets the status 408
/// (request timeout). A request that only reads has no timeout.
async fn in_time(request: Request, next: Next) -> Response {
    // A request that only reads has no body to wait for, and the verification of a large record takes time.
    if request.method().is_safe() {
        return next.run(request).await;
    }
    match tokio::time::timeout(ANSWERS_WITHIN, next.run(request)).await {
        Ok(response) => response,
        // The connection contains half a request, so it cannot be used again.
        Err(_) => (StatusCode::REQUEST_TIMEOUT, [(CONNECTION, "close")]).into_response(),
    }
}
