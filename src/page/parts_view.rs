//! View of the parts: all runs of a part by its serial number, with all their maps.

use std::collections::BTreeMap;
use std::sync::Arc;

use axum::Extension;
use axum::extract::{Path, State};
use axum::http::HeaderMap;
use axum::response::Response;
use maud::{Markup, html};
use regrind_report::RunResult;
use tokio::task::spawn_blocking;

use super::guard::Session;
use super::history::Listed;
use super::pieces::{in_path, when};
use super::reader::language;
use super::shared::Shared;
use super::subject::PageSubject;
use super::texts::{self, Text};
use super::view::{not_here, plain_document};
use regrind_language::{Language, decimal};

/// Serves the list of the parts with a serial number, from the one that was made last.
pub(crate) async fn parts(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let (listed, language) = (listed(&page).await, language(&headers));
    let mut by_part: BTreeMap<&str, Vec<&Listed>> = BTreeMap::new();
    for run in listed.iter().filter(|run| !run.summary.part.is_empty()) {
        by_part.entry(&run.summary.part).or_default().push(run);
    }
    let mut parts: Vec<(&str, Vec<&Listed>)> = by_part.into_iter().collect();
    parts.sort_by(|a, b| b.1[0].summary.began.cmp(&a.1[0].summary.began));
    let say = |text: Text| text.to(language);
    let main = html! {
        main .list {
            h1 { (say(Text::Parts)) }
            div .wide {
                table {
                    tr {
                        th { (say(Text::Part)) } th { (say(Text::Recipe)) } th .n { (say(Text::Runs)) } th { (say(Text::Began)) }
                        th .n { "PV, µm" } th .n { "RMS, µm" } th { (say(Text::Result)) }
                    }
                    @for (serial, runs) in &parts {
                        @let last = &runs[0].summary;
                        tr {
                            td { a href=(format!("/parts/{}", in_path(serial))) { (serial) } " " (last.name) }
                            td { (last.recipe) } td .n { (runs.len()) } td { (when(&last.began)) }
                            (figures_and_result(runs[0], language))
                        }
                    }
                }
            }
        }
    };
    plain_document(say(Text::Parts), &session, language, main)
}

/// Serves all runs of the part with the number `serial`, each with the maps of its cycles. Responds with the status 404
/// if no run has made this part.
pub(crate) async fn part(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(serial): Path<String>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let (listed, language) = (listed(&page).await, language(&headers));
    let runs: Vec<&Listed> = listed.iter().filter(|run| run.summary.part == serial).collect();
    let Some(last) = runs.first() else { return not_here(PageSubject::Cell, &headers) };
    let say = |text: Text| text.to(language);
    let main = html! {
        main .list {
            h1 { (say(Text::Part)) " " (serial) }
            p .quiet { (last.summary.name) }
            @for run in &runs {
                section .card .part-run {
                    h2 { a href=(format!("/runs/{}", in_path(&run.id))) { (when(&run.summary.began)) } " · " (result_of(run, language)) }
                    (maps(run, language))
                }
            }
        }
    };
    plain_document(&serial, &session, language, main)
}

async fn listed(page: &Shared) -> Vec<Listed> {
    let history = Arc::clone(&page.history);
    spawn_blocking(move || history.list()).await.unwrap_or_default()
}

/// Returns the maps of the cycles of a run, each with its figures.
fn maps(run: &Listed, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let cycles = run.summary.cycles.iter().filter_map(|of| Some((of, of.figures?)));
    html! {
        div .maps-of-part {
            @for (of, [[pv_um, _], [rms_um, _]]) in cycles {
                figure {
                    img loading="lazy" alt=(format!("{} {}", say(Text::Map), of.cycle))
                        src=(format!("/runs/{}/cycles/{}/files/error_map.svg", in_path(&run.id), of.cycle));
                    figcaption {
                        (say(Text::Cycle)) " " (of.cycle) ": PV " (decimal(pv_um, 2, language)) " µm, RMS " (decimal(rms_um, 3, language)) " µm"
                    }
                }
            }
            @if run.summary.cycles.iter().all(|of| of.figures.is_none()) { p .quiet { (say(Text::NotMeasured)) } }
        }
    }
}

fn figures_and_result(run: &Listed, language: Language) -> Markup {
    let figures = run.summary.cycles.iter().rev().find_map(|of| of.figures);
    html! {
        @for k in 0..2 {
            td .n { @if let Some(figures) = figures { (decimal(figures[k][0], 2, language)) } @else { "–" } }
        }
        td class=(if run.summary.result == RunResult::Accepted { "good" } else { "" }) { (result_of(run, language)) }
    }
}

fn result_of(run: &Listed, language: Language) -> &'static str {
    if run.is_live { Text::Live.to(language) } else { texts::result(run.summary.result).to(language) }
}
