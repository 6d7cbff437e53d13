//! View of the record of a run: each record in words, the log of a shift, and whether the record is as it was written.

use axum::Extension;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use maud::{Markup, html};
use regrind_control::is_live;
use regrind_report::{RecordChoice, RecordLine, RecordVerification, record_lines, verify_record};
use serde::Deserialize;
use tokio::task::spawn_blocking;

use super::guard::Session;
use super::pieces::{in_path, when};
use super::reader::language;
use super::shared::Shared;
use super::subject::PageSubject;
use super::texts::Text;
use super::view::{not_here, plain_document};
use regrind_language::Language;

/// Number of records on a page.
const COUNT: usize = 100;

/// Choice of records in the address.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct RecordQuery {
    show: String,
    /// Only records before this number.
    before: Option<u64>,
}

/// Choices, with their name in the address and their text.
const CHOICES: [(RecordChoice, &str, Text); 3] = [
    (RecordChoice::All, "all", Text::All),
    (RecordChoice::Events, "events", Text::Events),
    (RecordChoice::People, "people", Text::ShiftLog),
];

/// Serves the record of the run named `id`, from the newest record to the oldest. `wanted` selects the records.
/// Responds with the status 404 if the run does not exist, and 422 if its record cannot be read.
pub(crate) async fn record(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
    Query(wanted): Query<RecordQuery>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let Some(folder) = page.history.folder(&id) else { return not_here(PageSubject::Cell, &headers) };
    let choice = CHOICES.iter().find(|(_, name, _)| *name == wanted.show).map_or(RecordChoice::All, |found| found.0);
    let before = wanted.before;
    let read = spawn_blocking(move || {
        let lines = record_lines(&folder, choice, before, COUNT).map_err(|error| error.to_string())?;
        Ok::<_, String>((lines, verify_record(&folder), is_live(&folder)))
    });
    let (lines, verification, is_live) = match read.await {
        Ok(Ok(found)) => found,
        Ok(Err(reason)) => return (StatusCode::UNPROCESSABLE_ENTITY, reason).into_response(),
        Err(_) => return StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    };
    let language = language(&headers);
    let main = markup(&id, choice, &lines, &verification, (is_live && session.may("remark"), language));
    plain_document(Text::Record.to(language), &session, language, main)
}

fn markup(
    id: &str,
    choice: RecordChoice,
    lines: &[RecordLine],
    verification: &RecordVerification,
    (may_add, language): (bool, Language),
) -> Markup {
    let say = |text: Text| text.to(language);
    let run = format!("/runs/{}", in_path(id));
    let name = CHOICES.iter().find(|(of, ..)| *of == choice).map_or("all", |found| found.1);
    html! {
        main .list .record data-run=(id) {
            h1 { (say(Text::Record)) " " a href=(run) { (id) } }
            (verified(verification, language))
            div .choices role="group" aria-label=(say(Text::Record)) {
                @for (of, name, text) in CHOICES {
                    a href=(format!("{run}/record?show={name}")) aria-current=[(of == choice).then_some("page")] { (say(text)) }
                }
            }
            @if may_add {
                form #remark {
                    label { (say(Text::NewEntry)) " " input name="what" maxlength="400" required autocomplete="off"; }
                    button { (say(Text::AddEntry)) }
                    output #remarked role="status" {}
                }
            }
            div .wide {
                table {
                    tr { th .n { "#" } th { (say(Text::Time)) } th { (say(Text::Who)) } th { (say(Text::Kind)) } th .n { (say(Text::Cycle)) } th { (say(Text::What)) } }
                    @for line in lines {
                        tr {
                            td .n { (line.number) }
                            td { (when(&line.utc)) }
                            td { (line.who) @if !line.station.is_empty() { small { " " (line.station) } } }
                            td { (line.kind) }
                            td .n { @if line.cycle > 0 { (line.cycle) } }
                            td .words { (line.words) }
                        }
                    }
                }
            }
            @if let Some(last) = lines.last().filter(|last| lines.len() == COUNT && last.number > 1) {
                p { a href=(format!("{run}/record?show={name}&before={}", last.number)) { (say(Text::Older)) } }
            }
        }
    }
}

/// Returns the HTML that states whether the record is as it was written.
fn verified(verification: &RecordVerification, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    match verification {
        RecordVerification::Intact { records, signed } => html! {
            p .verified {
                (say(Text::RecordIntact)) " " (records) ". "
                @if *signed > 0 { (say(Text::SignedUpTo)) " " (signed) "." } @else { (say(Text::NotSigned)) }
            }
        },
        RecordVerification::Broken(reason) => html! {
            p .broken role="alert" { (say(Text::RecordBroken)) " " (reason) }
        },
    }
}
