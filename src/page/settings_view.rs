//! View of the settings: language and appearance of this browser, the person who has signed in, who may sign in, and
//! the program.

use axum::Extension;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use maud::html;

use super::guard::Session;
use super::reader::language;
use super::shared::Shared;
use super::texts::{self, Text};
use super::view::{THEMES, plain_document};
use regrind_language::Language;

/// Serves the settings. The list of the users is for engineers only.
pub(crate) async fn settings(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let language = language(&headers);
    let say = |text: Text| text.to(language);
    let users = page.guard.users().filter(|_| session.is_engineer());
    let main = html! {
        main .list .settings-view {
            h1 { (say(Text::Settings)) }
            section .card {
                h2 { (say(Text::ThisBrowser)) }
                div .choices role="group" aria-label=(say(Text::Language)) {
                    @for &each in Language::ALL {
                        button type="button" data-language=(each.tag()) lang=(each.tag()) aria-pressed=(each == language) { (each.name()) }
                    }
                }
                div .choices role="group" aria-label=(say(Text::Appearance)) {
                    @for (value, text) in THEMES { button type="button" data-theme-choice=(value) aria-pressed="false" { (say(text)) } }
                }
                p .quiet { (say(Text::SettingsStay)) }
            }
            section .card {
                h2 { (say(Text::Who)) }
                @match &session.person {
                    Some(person) => p { strong { (person.name) } " · " (say(texts::role(person.role))) },
                    None => p { (say(Text::WithKey)) },
                }
                @if let Some(users) = users {
                    table {
                        tr { th { (say(Text::UserName)) } th { (say(Text::Role)) } }
                        @for (name, role) in users { tr { td { (name) } td { (say(texts::role(role))) } } }
                    }
                    p .quiet { (say(Text::WhoMakesUsers)) }
                }
            }
            section .card {
                h2 { (say(Text::Program)) }
                dl {
                    dt { "Regrind" } dd { (env!("CARGO_PKG_VERSION")) }
                    dt { (say(Text::FolderOfRuns)) } dd { (page.history.home().display()) }
                }
                p { a href="/components" { (say(Text::Components)) } }
            }
        }
    };
    plain_document(say(Text::Settings), &session, language, main)
}
