//! Who is let in: whoever has the key, under the name of this page, and with orders only from the page itself.
//!
//! A page on the loopback address is open to every program of the computer, and to every page in every browser on it. So the address
//! that opens it carries a key, which becomes a cookie; a request must name this page as its host (a foreign name that leads here is
//! refused); and an order must come from this page by its `Origin` and carry the token that only this page knows.

use std::io;
use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::{Request, State};
use axum::http::header::{COOKIE, HOST, LOCATION, ORIGIN, REFERRER_POLICY, SET_COOKIE, X_CONTENT_TYPE_OPTIONS};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use sha2::{Digest, Sha256};

use super::{Shared, view};

/// The cookies of a page, by its port: a browser keeps one set for all pages of a computer.
const KEY_COOKIE: &str = "regrind_key";
const SESSION_COOKIE: &str = "regrind_session";
/// The header in which an order carries its token.
const TOKEN: &str = "x-regrind-token";

/// Wrong keys within a minute that are answered as such; to more it is said that there are too many.
const WRONG_KEYS: u32 = 20;
/// Refusals that are told within a minute; more are counted.
const TOLD: u32 = 10;
const MINUTE: Duration = Duration::from_secs(60);

/// What a page of this program may do in a browser: nothing from elsewhere, nothing within others.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
                      form-action 'self'; frame-ancestors 'none'; base-uri 'none'";

pub(crate) struct Guard {
    address: SocketAddr,
    key: String,
    wrong: Mutex<Rate>,
    refusals: Mutex<Rate>,
    /// The browser that has control.
    holder: Mutex<Option<String>>,
    log: Box<dyn Fn(&str) + Send + Sync>,
}

/// How often something happened within a minute.
struct Rate {
    began: Instant,
    count: u32,
}

impl Rate {
    fn new() -> Self {
        Self { began: Instant::now(), count: 0 }
    }

    fn count(&mut self) -> u32 {
        if self.began.elapsed() > MINUTE {
            *self = Self::new();
        }
        self.count += 1;
        self.count
    }
}

impl Guard {
    pub(crate) fn new(address: SocketAddr, log: Box<dyn Fn(&str) + Send + Sync>) -> io::Result<Self> {
        Ok(Self {
            address,
            key: random_word()?,
            wrong: Mutex::new(Rate::new()),
            refusals: Mutex::new(Rate::new()),
            holder: Mutex::new(None),
            log,
        })
    }

    pub(crate) fn url(&self) -> String {
        format!("http://{}/?key={}", self.address, self.key)
    }

    /// The cookie of that name that is this page's.
    fn cookie<'h>(&self, headers: &'h HeaderMap, name: &str) -> Option<&'h str> {
        let name = self.cookie_name(name);
        let pairs = text(headers, COOKIE)?.split(';').filter_map(|pair| pair.trim().split_once('='));
        pairs.filter(|(known, _)| *known == name).map(|(_, value)| value).next()
    }

    fn cookie_name(&self, name: &str) -> String {
        format!("{name}_{}", self.address.port())
    }

    /// Whether a request names this page as its host.
    fn is_host(&self, host: &str) -> bool {
        let port = self.address.port();
        let here = [
            self.address.to_string(),
            format!("localhost:{port}"),
            format!("127.0.0.1:{port}"),
            format!("[::1]:{port}"),
        ];
        here.iter().any(|name| name.eq_ignore_ascii_case(host))
    }

    /// Whether a key is right; none where it is one wrong one of many. The right one is let in however many wrong ones come: nobody
    /// finds it by trying, and nobody shall keep an operator out.
    fn is_key(&self, key: &str) -> Option<bool> {
        if same(key, &self.key) {
            return Some(true);
        }
        let wrong = self.wrong.lock().unwrap_or_else(PoisonError::into_inner).count();
        (wrong <= WRONG_KEYS).then_some(false)
    }

    /// The token of the orders of a browser.
    pub(crate) fn token(&self, session: &str) -> String {
        hex(&Sha256::digest(format!("regrind order {} {session}", self.key)))
    }

    /// Tells that something was refused, to who keeps it; returns whether it should be on record too.
    pub(crate) fn refused(&self, what: &str) -> bool {
        let told = self.refusals.lock().unwrap_or_else(PoisonError::into_inner).count();
        if told <= TOLD {
            (self.log)(what);
        } else if told == TOLD + 1 {
            (self.log)("more was refused within the same minute and is not told one by one");
        }
        told <= TOLD
    }

    /// Whether a browser has control; one that nobody else has is taken by who asks.
    pub(crate) fn has_control(&self, session: &str, asks: bool) -> bool {
        let mut holder = self.holder.lock().unwrap_or_else(PoisonError::into_inner);
        match &*holder {
            Some(holder) => holder == session,
            None if asks => {
                *holder = Some(session.to_owned());
                true
            }
            None => true,
        }
    }

    /// Gives control to a browser.
    pub(crate) fn take_control(&self, session: &str) {
        *self.holder.lock().unwrap_or_else(PoisonError::into_inner) = Some(session.to_owned());
    }
}

/// Refuses a request that names another page than this one, and puts on every answer what a browser may make of it.
pub(crate) async fn names_this_page(State(page): State<Shared>, request: Request, next: Next) -> Response {
    let host = text(request.headers(), HOST).unwrap_or_default();
    let mut response = if page.guard.is_host(host) {
        next.run(request).await
    } else {
        page.guard.refused(&format!("a request for the host {}", printable(host)));
        (StatusCode::MISDIRECTED_REQUEST, "this page goes by another name\n").into_response()
    };
    let headers = response.headers_mut();
    let policy = HeaderName::from_static("content-security-policy");
    headers.entry(policy).or_insert(HeaderValue::from_static(POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    response
}

/// Lets in who has the key, and turns a key in the address into a cookie.
pub(crate) async fn let_in(State(page): State<Shared>, mut request: Request, next: Next) -> Response {
    let guard = &page.guard;
    if let Some(key) = key_in(request.uri().query()) {
        return match guard.is_key(key) {
            Some(true) => welcome(guard, &request),
            told => shut_out(guard, &request, told),
        };
    }
    let told = guard.cookie(request.headers(), KEY_COOKIE).map(|key| guard.is_key(key));
    match (told, guard.cookie(request.headers(), SESSION_COOKIE)) {
        (Some(Some(true)), Some(session)) => {
            let session = Session(session.to_owned());
            request.extensions_mut().insert(session);
            next.run(request).await
        }
        (told, _) => shut_out(guard, &request, told.unwrap_or(Some(false))),
    }
}

/// The browser that a request comes from.
#[derive(Clone, Debug)]
pub(crate) struct Session(pub(crate) String);

/// Why an order is refused before anybody looks at it; none where it comes from this page.
pub(crate) fn foreign(guard: &Guard, headers: &HeaderMap, session: &Session) -> Option<String> {
    let origin = text(headers, ORIGIN).unwrap_or_default();
    if !origin.strip_prefix("http://").is_some_and(|host| guard.is_host(host)) {
        return Some(format!("an order from the origin {}", printable(origin)));
    }
    let token = text(headers, HeaderName::from_static(TOKEN)).unwrap_or_default();
    (!same(token, &guard.token(&session.0))).then(|| "an order without the token of the page".to_owned())
}

/// Gives a browser the key to keep, and a name; one that has a name goes by it in all its tabs.
fn welcome(guard: &Guard, request: &Request) -> Response {
    let headers = request.headers();
    let is_known = guard.cookie(headers, KEY_COOKIE).is_some_and(|key| same(key, &guard.key));
    let session = match guard.cookie(headers, SESSION_COOKIE).filter(|_| is_known) {
        Some(session) => session.to_owned(),
        None => match random_word() {
            Ok(session) => session,
            Err(_) => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
        },
    };
    let path = request.uri().path().to_owned();
    let mut response = (StatusCode::SEE_OTHER, [(LOCATION, path)]).into_response();
    for (name, value) in [(KEY_COOKIE, &guard.key), (SESSION_COOKIE, &session)] {
        let name = guard.cookie_name(name);
        let cookie = format!("{name}={value}; HttpOnly; SameSite=Strict; Path=/");
        if let Ok(cookie) = HeaderValue::from_str(&cookie) {
            response.headers_mut().append(SET_COOKIE, cookie);
        }
    }
    response
}

fn shut_out(guard: &Guard, request: &Request, told: Option<bool>) -> Response {
    let gave = guard.cookie(request.headers(), KEY_COOKIE).is_some() || key_in(request.uri().query()).is_some();
    if gave || request.method() != "GET" {
        let what = if gave { "a wrong key" } else { "an order without a key" };
        guard.refused(&format!("{what} for {}", printable(request.uri().path())));
    }
    let status = if told.is_none() { StatusCode::TOO_MANY_REQUESTS } else { StatusCode::UNAUTHORIZED };
    view::key_needed(status, request.headers())
}

fn key_in(query: Option<&str>) -> Option<&str> {
    query?.split('&').find_map(|pair| pair.strip_prefix("key="))
}

pub(crate) fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name)?.to_str().ok()
}

/// What a stranger sent, for a line of a log.
fn printable(text: &str) -> String {
    text.chars().take(80).map(|c| if c.is_ascii_graphic() { c } else { '?' }).collect()
}

/// Compares two secrets without telling by the time it takes how much of them is alike.
fn same(one: &str, other: &str) -> bool {
    Sha256::digest(one) == Sha256::digest(other)
}

fn random_word() -> io::Result<String> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(|error| io::Error::other(error.to_string()))?;
    Ok(hex(&bytes))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
