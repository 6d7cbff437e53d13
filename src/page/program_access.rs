//! Access of programs: a token in the header `Authorization`, or the session of a browser in which a person looks at the
//! interface. A token gives no orders.

use std::net::IpAddr;
use std::sync::Arc;

use axum::Extension;
use axum::extract::{Request, State};
use axum::http::HeaderMap;
use axum::http::header::AUTHORIZATION;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::guard::{Guard, Peer, Session, printable};
use super::problem::{Problem, ProblemKind};
use super::users::ProgramToken;

/// Access of a client to the interface for programs.
#[derive(Clone, Debug)]
pub(crate) enum ProgramAccess {
    /// Session of a browser.
    Browser(Session),
    /// Key of the page.
    Key,
    /// Token of a program.
    Token(ProgramToken),
}

impl ProgramAccess {
    /// Returns true if the client still has access: its token is still in the list, or its person is still signed in.
    pub(crate) fn holds(&self, guard: &Guard) -> bool {
        match self {
            Self::Browser(session) => guard.has_access(session),
            Self::Key => true,
            Self::Token(token) => guard.entrance.users.as_ref().is_some_and(|users| users.has_program(token)),
        }
    }
}

/// Middleware that checks the access of a client to the interface for programs. Passes the request to `next` with the
/// access of the client. Any other client gets a problem document.
pub(crate) async fn let_in(
    State(guard): State<Arc<Guard>>,
    Extension(Peer(from, is_known)): Extension<Peer>,
    mut request: Request,
    next: Next,
) -> Response {
    match admit(&guard, request.headers(), request.uri().path(), from) {
        Ok(access) => {
            is_known();
            request.extensions_mut().insert(access);
            next.run(request).await
        }
        Err(problem) => problem.into_response(),
    }
}

/// Returns the access of the client at the address `from` that sent `headers` with a request for `path`. A token, if there
/// is one, decides alone. Counts wrong tokens, and records the first one of a place within a minute.
///
/// # Errors
/// Returns the refusal if the client has no access.
fn admit(guard: &Guard, headers: &HeaderMap, path: &str, from: IpAddr) -> Result<ProgramAccess, Problem> {
    let Some(token) = bearer(headers) else {
        return guard.session(headers, from).map(ProgramAccess::Browser).ok_or_else(|| {
            Problem::new(ProblemKind::NoAccess, "the request has no token, and no session of a browser")
        });
    };
    let access = token.and_then(|token| match &guard.entrance.users {
        Some(users) => users.program(token).map(ProgramAccess::Token),
        None => guard.is_own_key(token).then_some(ProgramAccess::Key),
    });
    access.ok_or_else(|| {
        let wrong = guard.wrong_tokens.count(from);
        if wrong.is_first {
            guard.record_refusal(&format!("a wrong token for {} from the address {from}", printable(path)));
        }
        let kind = if wrong.is_too_many { ProblemKind::TooManyTokens } else { ProblemKind::WrongToken };
        Problem::new(kind, "the page does not know this token")
    })
}

/// Returns the token in the header `Authorization`. Returns `None` if no such header names the scheme `Bearer`, and
/// `Some(None)` if the header has this scheme but is given twice or has no readable token.
fn bearer(headers: &HeaderMap) -> Option<Option<&str>> {
    const SCHEME: &str = "bearer";
    let is_bearer = |value: &[u8]| {
        let (scheme, rest) = value.split_at(SCHEME.len().min(value.len()));
        scheme.eq_ignore_ascii_case(SCHEME.as_bytes()) && rest.first().is_none_or(|byte| *byte == b' ')
    };
    let all: Vec<_> = headers.get_all(AUTHORIZATION).iter().collect();
    if !all.iter().any(|value| is_bearer(value.as_bytes())) {
        return None;
    }
    let token = match all[..] {
        [only] => only.to_str().ok().and_then(|value| value.get(SCHEME.len()..)),
        _ => None,
    };
    Some(token.map(str::trim).filter(|token| !token.is_empty()))
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn bearer_is_read_whole_or_not() {
        let of = |values: &[&'static str]| {
            let pairs = values.iter().map(|value| (AUTHORIZATION, HeaderValue::from_static(value)));
            let mut headers = HeaderMap::new();
            for (name, value) in pairs {
                headers.append(name, value);
            }
            bearer(&headers).map(|token| token.map(str::to_owned))
        };
        assert_eq!(of(&[]), None);
        assert_eq!(of(&["Basic YTpi"]), None);
        assert_eq!(of(&["Bearerly x"]), None);
        assert_eq!(of(&["Bearer abc"]), Some(Some("abc".into())));
        assert_eq!(of(&["bEARER  abc "]), Some(Some("abc".into())));
        for unusable in [&["Bearer"][..], &["Bearer "], &["Bearer a", "Bearer a"], &["Basic x", "Bearer a"]] {
            assert_eq!(of(unusable), Some(None), "{unusable:?}");
        }
    }
}
