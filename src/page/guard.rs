//! Access control: a client needs the key, or must sign in if there are users. It must use a name of this page, and
//! orders must come from the page itself.
//!
//! Every program on the computer, and every page in every browser on it, can reach a page on the loopback address. The
//! address that opens the page therefore contains a key, which becomes a cookie. A request must name this page as its
//! host, so a foreign name that leads here is refused. An order must come from this page by its `Origin`, and it must
//! carry a token that was fetched for it and that is valid once.

use std::collections::VecDeque;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::Extension;
use axum::extract::{Request, State};
use axum::http::header::{
    CACHE_CONTROL, COOKIE, HOST, LOCATION, ORIGIN, REFERRER_POLICY, SET_COOKIE, STRICT_TRANSPORT_SECURITY,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use data_encoding::HEXLOWER;
use sha2::{Digest, Sha256};

use super::connections::Connections;
use super::problem::{Problem, ProblemKind, is_for_programs};
use super::program_tokens::WrongTokens;
use super::rate::Rate;
use super::sessions::SignedIn;
use super::subject::PageSubject;
use super::tls::Tls;
use super::users::{PageRole, Person, UsersFile};

/// Cookies of a page; the port is part of their names, because a browser keeps one set for all pages of a computer.
const KEY_COOKIE: &str = "regrind_key";
const SESSION_COOKIE: &str = "regrind_session";
/// Header that carries the token of an order.
const TOKEN: &str = "x-regrind-token";
/// Lifetime of a token, and maximum number of tokens without an order.
const TOKEN_LASTS: Duration = Duration::from_secs(30);
const TOKENS: usize = 1024;

/// Maximum number of wrong keys within a minute. Each further wrong key gets the answer that there were too many.
const WRONG_KEYS: u32 = 20;
/// Maximum number of refusals that are logged within a minute. Further ones are only counted.
const MAX_LOGGED_REFUSALS: u32 = 10;

/// Names of the loopback address.
const IS_LOOPBACK: [&str; 3] = ["localhost", "127.0.0.1", "[::1]"];

/// Content security policy of a page: nothing from elsewhere, and no framing by other pages.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
                      form-action 'self'; frame-ancestors 'none'; base-uri 'none'";

/// Address of a page and its access rules.
pub struct Entrance {
    /// Address that the page listens on.
    pub address: SocketAddr,
    /// Certificate; `None` only on the loopback address.
    pub tls: Option<Tls>,
    /// Users who can sign in. Without users, access needs the key.
    pub users: Option<UsersFile>,
}

impl Entrance {
    fn scheme(&self) -> &'static str {
        if self.tls.is_some() { "https" } else { "http" }
    }

    /// Returns true if a request is addressed to this page. `named` is the host of the request: a name or an address,
    /// followed by the port. Without a port, the default port is assumed: 443 with TLS and 80 without. The port must be
    /// the port of this page. With TLS the certificate must be valid for the host. Without TLS the host must be the
    /// loopback address or the address of this page.
    fn is_host(&self, named: &str) -> bool {
        let port = self.address.port();
        let (host, at) = match named.rsplit_once(':') {
            // The number parser would accept a sign, so only digits are allowed.
            Some((host, at)) if !at.ends_with(']') => {
                (host, at.parse().ok().filter(|_| at.bytes().all(|byte| byte.is_ascii_digit())))
            }
            // Browsers omit the default port.
            _ => (named, Some(if self.tls.is_some() { 443 } else { 80 })),
        };
        let is_loopback = IS_LOOPBACK.iter().any(|name| name.eq_ignore_ascii_case(host));
        let is_here = match &self.tls {
            Some(tls) => tls.is_for(host),
            None => is_loopback || named == self.address.to_string(),
        };
        is_here && at == Some(port)
    }

    /// Returns the address (URL) at which a browser opens the page. The host is a name from the TLS certificate, if
    /// there is one, and otherwise the address of the page. The result does not contain the access key of the page.
    fn base(&self) -> String {
        let name = self.tls.as_ref().and_then(Tls::name);
        let at = name.map_or(self.address.to_string(), |name| format!("{name}:{}", self.address.port()));
        format!("{}://{at}/", self.scheme())
    }
}

pub(crate) struct Guard {
    pub(crate) entrance: Entrance,
    pub(crate) subject: PageSubject,
    pub(crate) signed_in: SignedIn,
    pub(crate) connections: Arc<Connections>,
    pub(crate) wrong_tokens: WrongTokens,
    key: String,
    wrong: Mutex<Rate>,
    refusals: Mutex<Rate>,
    /// Number of refused requests since the page began.
    refusal_count: AtomicU64,
    /// Tokens without an order: the browser, the token and its time.
    tokens: Mutex<VecDeque<(String, String, Instant)>>,
    /// Browser that has control.
    holder: Mutex<Option<String>>,
    log: Box<LogSink>,
    /// Function that writes a message to the record of each run that it concerns.
    on_record: Box<dyn Fn(String) + Send + Sync>,
}

/// Function that logs messages that are recorded nowhere else.
pub(crate) type LogSink = dyn Fn(&str) + Send + Sync;

impl Guard {
    /// Returns the names and roles of the people who can sign in; `None` if the page has a key instead.
    pub(crate) fn users(&self) -> Option<Vec<(String, PageRole)>> {
        self.entrance.users.as_ref().map(UsersFile::names)
    }

    pub(crate) fn new(
        entrance: Entrance,
        of: PageSubject,
        log: Box<LogSink>,
        on_record: Box<dyn Fn(String) + Send + Sync>,
    ) -> io::Result<Self> {
        Ok(Self {
            entrance,
            subject: of,
            signed_in: SignedIn::default(),
            connections: Arc::default(),
            wrong_tokens: WrongTokens::default(),
            refusal_count: AtomicU64::new(0),
            key: random_word()?,
            wrong: Mutex::new(Rate::new()),
            refusals: Mutex::new(Rate::new()),
            tokens: Mutex::default(),
            holder: Mutex::new(None),
            log,
            on_record,
        })
    }

    pub(crate) fn url(&self) -> String {
        let base = self.entrance.base();
        if self.entrance.users.is_some() { base } else { format!("{base}?key={}", self.key) }
    }

    /// Returns the value of a cookie that this page has set. `name` is the short name; the full name of the cookie also
    /// contains the port. `headers` are the headers of the request. Returns `None` if the browser has not sent this
    /// cookie.
    fn cookie<'h>(&self, headers: &'h HeaderMap, name: &str) -> Option<&'h str> {
        let name = self.cookie_name(name);
        let pairs = text(headers, COOKIE)?.split(';').filter_map(|pair| pair.trim().split_once('='));
        pairs.filter(|(known, _)| *known == name).map(|(_, value)| value).next()
    }

    fn cookie_name(&self, name: &str) -> String {
        format!("{name}_{}", self.entrance.address.port())
    }

    /// Adds a header that sets the cookie `name` for this page only. An empty `value` deletes the cookie.
    fn set_cookie(&self, headers: &mut HeaderMap, name: &str, value: &str) {
        let secure = if self.entrance.tls.is_some() { "; Secure" } else { "" };
        let ends = if value.is_empty() { "; Max-Age=0" } else { "" };
        let cookie = format!("{}={value}; HttpOnly; SameSite=Strict; Path=/{secure}{ends}", self.cookie_name(name));
        if let Ok(cookie) = HeaderValue::from_str(&cookie) {
            headers.append(SET_COOKIE, cookie);
        }
    }

    /// Sets the cookie of the browser session in a response. An empty `session` deletes the cookie.
    pub(crate) fn set_session(&self, response: &mut Response, session: &str) {
        self.set_cookie(response.headers_mut(), SESSION_COOKIE, session);
    }

    /// Compares `key` with the key of the page. Returns true if they are equal and false if they are not. After more
    /// than [`WRONG_KEYS`] wrong keys within a minute, returns `None` for each further wrong key.
    ///
    /// A correct key is always accepted, so that the wrong attempts of another client cannot lock out an operator. This
    /// is safe: the key is too long to be guessed.
    fn is_key(&self, key: &str) -> Option<bool> {
        if same(key, &self.key) {
            return Some(true);
        }
        let wrong = self.wrong.lock().unwrap_or_else(PoisonError::into_inner).count();
        (wrong <= WRONG_KEYS).then_some(false)
    }

    /// Checks the access of the client at the address `from`, which sends `request`. A client has access if it has signed
    /// in or, on a page without a list of users, if it has the key. If the address contains the correct key, the
    /// browser gets a redirection to the address without the key, and the key as a cookie. Records a wrong key, and an
    /// order without access.
    pub(crate) fn admit(&self, request: &Request, from: IpAddr) -> Result<Admission, Denied> {
        let id = self.cookie(request.headers(), SESSION_COOKIE).map(str::to_owned);
        if let Some(users) = &self.entrance.users {
            let person = id.as_ref().and_then(|id| self.signed_in.person(id, users));
            let session = id.zip(person).map(|(id, person)| Session { id, person: Some(person), from });
            return session.map(Admission::Admitted).ok_or_else(|| self.not_signed_in(request));
        }
        if let Some(key) = key_in(request.uri().query()) {
            return match self.is_key(key) {
                Some(true) => Ok(Admission::Redirected(self.welcome(request))),
                told => Err(self.shut_out(request, told)),
            };
        }
        let told = self.cookie(request.headers(), KEY_COOKIE).map(|key| self.is_key(key));
        let session = id.filter(|_| told == Some(Some(true))).map(|id| Session { id, person: None, from });
        session.map(Admission::Admitted).ok_or_else(|| self.shut_out(request, told.unwrap_or(Some(false))))
    }

    /// Returns the session of the browser that sent `headers` from the address `from`, if it has access by its cookies.
    /// Returns `None` if nobody has signed in there or, on a page without a list of users, if the key is missing or wrong.
    pub(crate) fn session(&self, headers: &HeaderMap, from: IpAddr) -> Option<Session> {
        let id = self.cookie(headers, SESSION_COOKIE)?.to_owned();
        let person = match &self.entrance.users {
            Some(users) => Some(self.signed_in.person(&id, users)?),
            None => self.cookie(headers, KEY_COOKIE).filter(|key| self.is_own_key(key)).map(|_| None)?,
        };
        Some(Session { id, person, from })
    }

    /// Returns true if `key` is the key of the page. Counts no wrong keys.
    pub(crate) fn is_own_key(&self, key: &str) -> bool {
        same(key, &self.key)
    }

    /// Returns the number of refused requests since the page began, whether they were logged or not.
    pub(crate) fn refusal_count(&self) -> u64 {
        self.refusal_count.load(Ordering::Relaxed)
    }

    /// Responds to a browser that gave the correct key in the address. Sets a cookie with the key and a cookie with the
    /// browser session. Redirects the browser to the same address without the key. If the browser already has a valid key
    /// cookie and a session, this session stays valid, so that all tabs of the browser share one session.
    fn welcome(&self, request: &Request) -> Response {
        let headers = request.headers();
        let is_known = self.cookie(headers, KEY_COOKIE).is_some_and(|key| same(key, &self.key));
        let session = match self.cookie(headers, SESSION_COOKIE).filter(|_| is_known) {
            Some(session) => session.to_owned(),
            None => match random_word() {
                Ok(session) => session,
                Err(_) => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
            },
        };
        let path = request.uri().path().to_owned();
        let mut response = (StatusCode::SEE_OTHER, [(LOCATION, path)]).into_response();
        self.set_cookie(response.headers_mut(), KEY_COOKIE, &self.key);
        self.set_session(&mut response, &session);
        response
    }

    /// Records the refusal of a client without a correct key, and returns its reason. `told` is the result of the check
    /// of the key by [`Self::is_key`].
    fn shut_out(&self, request: &Request, told: Option<bool>) -> Denied {
        let gave = self.cookie(request.headers(), KEY_COOKIE).is_some() || key_in(request.uri().query()).is_some();
        if gave || request.method() != "GET" {
            let what = if gave { "a wrong key" } else { "an order without a key" };
            self.record_refusal(&format!("{what} for {}", printable(request.uri().path())));
        }
        if told.is_none() { Denied::TooManyKeys } else { Denied::NoKey }
    }

    /// Records the refusal of an order from a browser at which nobody has signed in, and returns the reason.
    fn not_signed_in(&self, request: &Request) -> Denied {
        if request.method() != "GET" {
            let path = printable(request.uri().path());
            self.record_refusal(&format!(
                "an order to the address {path} that is not allowed, because the person has not signed in"
            ));
        }
        Denied::NotSignedIn
    }

    /// Creates a token with which the browser of `session` can give one order.
    ///
    /// # Errors
    /// The operating system has no random numbers.
    fn give_token(&self, session: &Session) -> io::Result<String> {
        let token = random_word()?;
        let mut tokens = self.tokens.lock().unwrap_or_else(PoisonError::into_inner);
        tokens.push_back((session.id.clone(), token.clone(), Instant::now()));
        while tokens.len() > TOKENS || tokens.front().is_some_and(|(.., since)| since.elapsed() > TOKEN_LASTS) {
            tokens.pop_front();
        }
        Ok(token)
    }

    /// Checks `token` and makes it invalid for further use. Returns true if the token was created for the browser of
    /// `session`, has not expired, and was not used before. This check prevents a replay attack: an order that is
    /// recorded and sent again is refused.
    fn takes_token(&self, session: &Session, token: &str) -> bool {
        let mut tokens = self.tokens.lock().unwrap_or_else(PoisonError::into_inner);
        let found = tokens
            .iter()
            .position(|(id, known, since)| *id == session.id && same(known, token) && since.elapsed() <= TOKEN_LASTS);
        found.and_then(|at| tokens.remove(at)).is_some()
    }

    /// Returns true if the browser of `session` still has access to the page. If the page has no list of users, the
    /// result is always true. If the page has a list of users, the result is true as long as the person is signed in
    /// and has the same name and role as in `session`.
    pub(crate) fn has_access(&self, session: &Session) -> bool {
        let person = |users| self.signed_in.person(&session.id, users);
        self.entrance.users.as_ref().is_none_or(|users| person(users) == session.person)
    }

    /// Counts a refused request. `what` describes the request for the log. Logs the first [`MAX_LOGGED_REFUSALS`]
    /// refused requests of each minute, and returns true for them. Returns false for the later ones, which are only
    /// counted. If the result is true, the caller should also record the refusal in the run.
    pub(crate) fn refused(&self, what: &str) -> bool {
        self.refusal_count.fetch_add(1, Ordering::Relaxed);
        let (told, untold) = {
            let mut refusals = self.refusals.lock().unwrap_or_else(PoisonError::into_inner);
            let untold =
                if refusals.is_over() { refusals.current_count().saturating_sub(MAX_LOGGED_REFUSALS) } else { 0 };
            (refusals.count(), untold)
        };
        if untold > 0 {
            (self.log)(&format!(
                "{untold} further requests were refused in the minute after the first refusal; the log does not list these requests"
            ));
        }
        if told <= MAX_LOGGED_REFUSALS {
            (self.log)(&format!("refused {what}"));
        } else if told == MAX_LOGGED_REFUSALS + 1 {
            (self.log)(
                "too many requests were refused in this minute; the log shows only the number of further refusals",
            );
        }
        told <= MAX_LOGGED_REFUSALS
    }

    /// Logs `what`, the description of a successful sign-in.
    pub(crate) fn log_sign_in(&self, what: &str) {
        (self.log)(what);
    }

    /// Logs a refused request and records it in each run concerned. `what` describes the request. Only the first
    /// [`MAX_LOGGED_REFUSALS`] refusals within a minute are logged and recorded; the later ones are only counted.
    pub(crate) fn record_refusal(&self, what: &str) {
        if self.refused(what) {
            self.record(format!("the page refused {what}"));
        }
    }

    /// Writes the message `what` to the record of each run that the message concerns. The function given to
    /// [`Self::new`] decides which runs these are.
    pub(crate) fn record(&self, what: String) {
        (self.on_record)(what);
    }

    /// Returns true if the browser of `session` has control of the cell, or if no browser has control. If no browser
    /// has control and `asks` is true, this browser gets control. Returns false if another browser has control.
    pub(crate) fn has_control(&self, session: &Session, asks: bool) -> bool {
        let mut holder = self.holder.lock().unwrap_or_else(PoisonError::into_inner);
        match &*holder {
            Some(holder) => *holder == session.id,
            None if asks => {
                *holder = Some(session.id.clone());
                true
            }
            None => true,
        }
    }

    /// Gives control of the cell to the browser of `session`, and takes it from any other browser.
    pub(crate) fn take_control(&self, session: &Session) {
        *self.holder.lock().unwrap_or_else(PoisonError::into_inner) = Some(session.id.clone());
    }

    /// Releases control of the cell if the browser of `session` has control. Otherwise does nothing. The caller calls
    /// this when the browser signs out. Afterwards the next browser that requests control gets it.
    pub(crate) fn leave_control(&self, session: &Session) {
        let mut holder = self.holder.lock().unwrap_or_else(PoisonError::into_inner);
        holder.take_if(|holder| *holder == session.id);
    }
}

/// Address of the client of a request, and function to call when the client is authorised.
#[derive(Clone)]
pub(crate) struct Peer(pub(crate) IpAddr, pub(crate) Arc<dyn Fn() + Send + Sync>);

/// Browser that a request comes from, and the person at it if users sign in. Each authorised request has a session.
#[derive(Clone, Debug)]
pub struct Session {
    pub(crate) id: String,
    pub(crate) person: Option<Person>,
    pub(crate) from: IpAddr,
}

impl Session {
    /// Returns true if the person at the browser can give the order named `order`, such as `hold`. A client with the
    /// key of the page acts for the operating-system user that serves the page, and can give all orders.
    pub(crate) fn may(&self, order: &str) -> bool {
        self.person.as_ref().is_none_or(|person| person.role.may(order))
    }
}

impl Session {
    /// Returns true if the person at the browser may see who else can sign in: an engineer, or whoever has the key of
    /// the page.
    pub(crate) fn is_engineer(&self) -> bool {
        self.person.as_ref().is_none_or(|person| person.role == PageRole::Engineer)
    }

    /// Returns a text that is different for each person: the name of a person who has signed in, or else the secret of
    /// the browser. It must not be shown.
    pub(crate) fn key_of_person(&self) -> String {
        self.person.as_ref().map_or_else(|| format!("session {}", self.id), |person| format!("person {}", person.name))
    }
}

/// Access of a client.
pub(crate) enum Admission {
    /// The client is authorised.
    Admitted(Session),
    /// The address contains the correct key: response that stores the key in a cookie and leads to the address without
    /// the key.
    Redirected(Response),
}

/// Reason why a client has no access. The view renders it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Denied {
    /// The client has not given the correct key.
    NoKey,
    /// The client has given a wrong key, after too many wrong keys within a minute.
    TooManyKeys,
    /// Nobody has signed in at this browser.
    NotSignedIn,
}

/// Middleware that checks the host of a request. Passes the request to `next` if it has exactly one `Host` header and
/// this header names this page. Refuses every other request with the status 421 (misdirected request). Adds the
/// security headers to each response.
pub(crate) async fn names_this_page(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let mut hosts = request.headers().get_all(HOST).iter();
    let host = hosts.next().and_then(|host| host.to_str().ok()).unwrap_or_default();
    // Strict-Transport-Security applies to all ports of a name. It is omitted on loopback, for other pages of this
    // computer.
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    let is_loopback = IS_LOOPBACK.iter().any(|known| known.eq_ignore_ascii_case(name));
    let mut response = if hosts.next().is_none() && guard.entrance.is_host(host) {
        next.run(request).await
    } else {
        guard.record_refusal(&format!("a request for the host {}", printable(host)));
        other_host(&guard, request.uri().path())
    };
    let headers = response.headers_mut();
    let policy = HeaderName::from_static("content-security-policy");
    headers.entry(policy).or_insert(HeaderValue::from_static(POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    // Without a referrer a form would have the origin `null`.
    headers.insert(REFERRER_POLICY, HeaderValue::from_static("same-origin"));
    // The content is soon out of date, and the next user of the computer must not see it.
    headers.entry(CACHE_CONTROL).or_insert(HeaderValue::from_static("no-store"));
    if guard.entrance.tls.is_some() && !is_loopback {
        headers.insert(STRICT_TRANSPORT_SECURITY, HeaderValue::from_static("max-age=31536000"));
    }
    response
}

/// Returns the response to a request for `path` whose host is not this page.
fn other_host(guard: &Guard, path: &str) -> Response {
    const MESSAGE: &str =
        "this page has another address; open it with the address that the program printed at its start";
    match guard.subject == PageSubject::Cell && is_for_programs(path) {
        true => Problem::new(ProblemKind::OtherHost, MESSAGE).into_response(),
        false => (StatusCode::MISDIRECTED_REQUEST, format!("{MESSAGE}\n")).into_response(),
    }
}

/// Answers with a new token for the next order of the browser.
pub(crate) async fn token(State(guard): State<Arc<Guard>>, Extension(session): Extension<Session>) -> Response {
    match guard.give_token(&session) {
        Ok(token) => ([(CACHE_CONTROL, "no-store")], token).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Checks the header `Origin` of a request that changes something. Returns `None` if the header shows that the request
/// comes from this page. Otherwise returns the reason to refuse the request, also if the header is missing.
pub(crate) fn foreign_origin(guard: &Guard, headers: &HeaderMap) -> Option<String> {
    let origin = text(headers, ORIGIN).unwrap_or_default();
    let host = origin.strip_prefix(guard.entrance.scheme()).and_then(|rest| rest.strip_prefix("://"));
    (!host.is_some_and(|host| guard.entrance.is_host(host)))
        .then(|| format!("an order from the origin {}", printable(origin)))
}

/// Checks an order for its origin and its token. Returns `None` if the order comes from this page and its token is
/// valid and was not used before. The check uses up the token. Otherwise returns the reason to refuse the order.
pub(crate) fn foreign(guard: &Guard, headers: &HeaderMap, session: &Session) -> Option<String> {
    foreign_origin(guard, headers).or_else(|| {
        let token = text(headers, HeaderName::from_static(TOKEN)).unwrap_or_default();
        (!guard.takes_token(session, token))
            .then(|| "an order that is not allowed, because its token of this page is missing or was already used; load the page again in the browser".into())
    })
}

fn key_in(query: Option<&str>) -> Option<&str> {
    query?.split('&').find_map(|pair| pair.strip_prefix("key="))
}

pub(crate) fn text(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    headers.get(name)?.to_str().ok()
}

/// Returns the first 80 characters of a text from an unknown client, with `?` for all but printable ASCII characters,
/// so that it is safe in a log.
pub(crate) fn printable(text: &str) -> String {
    text.chars().take(80).map(|c| if c.is_ascii_graphic() { c } else { '?' }).collect()
}

/// Returns true if two secrets are equal. Compares their hashes, so that the time does not reveal how much of them is
/// equal.
fn same(one: &str, other: &str) -> bool {
    Sha256::digest(one) == Sha256::digest(other)
}

pub(crate) fn random_word() -> io::Result<String> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(|error| io::Error::other(error.to_string()))?;
    Ok(HEXLOWER.encode(&bytes))
}
