//! Sign-in and sign-out, if there are users.

use std::sync::Arc;

use axum::extract::State;
use axum::http::header::LOCATION;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Form};
use serde::Deserialize;
use tokio::sync::OwnedSemaphorePermit;
use tokio::task::spawn_blocking;

use super::guard::{Guard, Peer, Session, foreign, foreign_origin, printable, random_word};
use super::texts::Text;
use super::users::AuthenticatedUser;
use super::view;

/// Name and password from the sign-in form.
#[derive(Deserialize)]
pub(crate) struct Credentials {
    name: String,
    password: String,
}

pub(crate) async fn sign_in(
    State(guard): State<Arc<Guard>>,
    Extension(Peer(from, _)): Extension<Peer>,
    headers: HeaderMap,
    Form(given): Form<Credentials>,
) -> Response {
    if guard.entrance.users.is_none() {
        return view::not_here(guard.subject, &headers);
    }
    let refuse = |status, what: String, told: Text| {
        guard.record_refusal(&what);
        view::sign_in(status, guard.subject, &headers, Some(told))
    };
    if let Some(what) = foreign_origin(&guard, &headers) {
        return refuse(StatusCode::FORBIDDEN, what, Text::SignInRefused);
    }
    let (who, name) = (printable(&given.name), given.name.trim().to_lowercase());
    if !guard.signed_in.may_try(from, &name) {
        let what = format!(
            "a sign-in that is not allowed because of too many attempts within one minute, with the name {who} from the address {from}"
        );
        return refuse(StatusCode::TOO_MANY_REQUESTS, what, Text::TooManyTries);
    }
    let waiting = guard.signed_in.wait_a_while(from).await;
    let turn = match &waiting {
        Some(_) => guard.signed_in.turn().await,
        None => None,
    };
    let Some(turn) = turn else {
        let what = format!(
            "a sign-in that is not possible now because other sign-ins are in progress, with the name {who} from the address {from}"
        );
        return refuse(StatusCode::SERVICE_UNAVAILABLE, what, Text::TooManyTries);
    };
    let Some(proven) = prove(&guard, turn, given).await else {
        let what = format!(
            "a sign-in that is not allowed because of a wrong name or password, with the name {who} from the address {from}"
        );
        return refuse(StatusCode::UNAUTHORIZED, what, Text::SignInRefused);
    };
    guard.signed_in.forget_tries(from, &name);
    let signed_in = format!("{} signed in at the page, from {from}", proven.person());
    guard.log_sign_in(&signed_in);
    guard.record(signed_in);
    // The session gets a new random name, which nobody can have known before.
    let Ok(session) = random_word() else { return StatusCode::INTERNAL_SERVER_ERROR.into_response() };
    guard.signed_in.add(&session, proven);
    let mut response = (StatusCode::SEE_OTHER, [(LOCATION, "/")]).into_response();
    guard.set_session(&mut response, &session);
    response
}

/// Checks the name and the password in `given` against the list of users. Returns the user if both are correct. Returns
/// `None` if one of them is wrong, or if the page has no list of users. `turn` is the permit to run a password check;
/// it is released at the end of the check.
async fn prove(guard: &Arc<Guard>, turn: OwnedSemaphorePermit, given: Credentials) -> Option<AuthenticatedUser> {
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
