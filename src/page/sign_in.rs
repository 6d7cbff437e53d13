//! Signing in and out, where there are users: one password at a time, and of a stranger's guesses only the first few.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Form};
use serde::Deserialize;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;

use super::guard::{Guard, Peer, Rate, Session, foreign, foreign_origin, printable, random_word};
use super::texts::Text;
use super::users::{Person, Proven, UsersFile};
use super::view;

/// How long somebody stays signed in: a shift and its handover.
const LASTS: Duration = Duration::from_secs(12 * 3600);
/// Most browsers that are signed in at a time; the one that signed in first goes.
const MOST: usize = 256;
/// Tries within a minute from one place; more are not looked at.
const TRIES: u32 = 10;
/// Places of which the tries are counted.
const PLACES: usize = 4096;
/// Longest time that somebody waits for the guesses of others.
const WAITS: Duration = Duration::from_secs(5);

/// Who has signed in, and who tries to.
pub(crate) struct SignedIn {
    /// By the session of the browser, in the order in which they came.
    sessions: Mutex<Vec<(String, Proven, Instant)>>,
    tries: Mutex<HashMap<IpAddr, Rate>>,
    /// A proof costs time and memory by design: one at a time, so that guesses cost the computer no more than that.
    proving: Arc<Semaphore>,
}

impl Default for SignedIn {
    fn default() -> Self {
        Self { sessions: Mutex::default(), tries: Mutex::default(), proving: Arc::new(Semaphore::new(1)) }
    }
}

impl SignedIn {
    /// Who has signed in with a browser; nobody any more whose line on the list has changed since.
    pub(crate) fn person(&self, session: &str, users: &UsersFile) -> Option<Person> {
        let mut sessions = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        sessions.retain(|(.., since)| since.elapsed() < LASTS);
        let (_, proven, _) = sessions.iter().find(|(id, ..)| id == session)?;
        users.has(proven).then(|| proven.person())
    }

    fn add(&self, session: &str, proven: Proven) {
        let mut sessions = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        if sessions.len() >= MOST {
            sessions.remove(0);
        }
        sessions.push((session.to_owned(), proven, Instant::now()));
    }

    fn remove(&self, session: &str) {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner).retain(|(id, ..)| id != session);
    }

    /// Counts a try from a place; returns whether it is looked at.
    fn may_try(&self, from: IpAddr) -> bool {
        let mut tries = self.tries.lock().unwrap_or_else(PoisonError::into_inner);
        if tries.len() >= PLACES {
            tries.retain(|_, rate| !rate.is_over());
        }
        let known = tries.contains_key(&place(from));
        (known || tries.len() < PLACES) && tries.entry(place(from)).or_insert_with(Rate::new).count() <= TRIES
    }

    /// Who knows their password has all tries again.
    fn forget_tries(&self, from: IpAddr) {
        self.tries.lock().unwrap_or_else(PoisonError::into_inner).remove(&place(from));
    }
}

/// The place from which somebody tries: one who has an IPv6 network has all its addresses.
fn place(from: IpAddr) -> IpAddr {
    match from.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX))),
        address => address,
    }
}

/// What somebody signs in with.
#[derive(Deserialize)]
pub(crate) struct Credentials {
    name: String,
    password: String,
}

pub(crate) async fn sign_in(
    State(guard): State<Arc<Guard>>,
    Extension(Peer(from)): Extension<Peer>,
    headers: HeaderMap,
    Form(given): Form<Credentials>,
) -> Response {
    if guard.entrance.users.is_none() {
        return view::not_here(guard.of, &headers);
    }
    let refuse = |status, what: String, told: Text| {
        guard.record_refusal(&what);
        view::sign_in(status, guard.of, &headers, Some(told))
    };
    if let Some(what) = foreign_origin(&guard, &headers) {
        return refuse(StatusCode::FORBIDDEN, what, Text::SignInRefused);
    }
    let who = printable(&given.name);
    if !guard.signed_in.may_try(from) {
        let what = format!("one of too many tries to sign in within a minute, as {who}, from {from}");
        return refuse(StatusCode::TOO_MANY_REQUESTS, what, Text::TooManyTries);
    }
    let Some(proven) = prove(&guard, given).await else {
        let what = format!("a wrong name or password, {who}, from {from}");
        return refuse(StatusCode::UNAUTHORIZED, what, Text::SignInRefused);
    };
    guard.signed_in.forget_tries(from);
    guard.record(format!("{} signed in at the page, from {from}", proven.person()));
    // A name of this sign-in alone: nobody can have known it before.
    let Ok(session) = random_word() else { return StatusCode::INTERNAL_SERVER_ERROR.into_response() };
    guard.signed_in.add(&session, proven);
    let mut response = (StatusCode::SEE_OTHER, [(LOCATION, "/")]).into_response();
    guard.set_session(&mut response, &session);
    response
}

/// Sees whether a name and a password belong together, in its turn.
async fn prove(guard: &Arc<Guard>, given: Credentials) -> Option<Proven> {
    let turn = Arc::clone(&guard.signed_in.proving).acquire_owned();
    let turn = tokio::time::timeout(WAITS, turn).await.ok()?.ok()?;
    let guard = Arc::clone(guard);
    let proven = spawn_blocking(move || {
        let _turn = turn;
        guard.entrance.users.as_ref()?.signs_in(given.name.trim(), &given.password)
    });
    proven.await.ok()?
}

pub(crate) async fn sign_out(
    State(guard): State<Arc<Guard>>,
    Extension(session): Extension<Session>,
    headers: HeaderMap,
) -> Response {
    if let Some(what) = foreign(&guard, &headers, &session) {
        guard.record_refusal(&what);
        return StatusCode::FORBIDDEN.into_response();
    }
    guard.signed_in.remove(&session.id);
    guard.leave_control(&session);
    let mut response = StatusCode::NO_CONTENT.into_response();
    guard.set_session(&mut response, "");
    response
}
