//! The door of a page: what stands behind it is for who is let in, over TLS or on this computer, one connection at a time.

use std::io;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::{DefaultBodyLimit, State};
use axum::http::HeaderMap;
use axum::middleware::from_fn_with_state;
use axum::routing::{get, post};
use hyper::body::Incoming;
use hyper::service::{Service, service_fn};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use super::guard::{self, Entrance, Guard, Peer};
use super::view::{self, PageOf};
use super::{assets, sign_in};

/// Most connections at a time, and the longest a client may take to say what it wants.
const CONNECTIONS: usize = 512;
const PATIENCE: Duration = Duration::from_secs(10);
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
}
