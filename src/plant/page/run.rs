//! `/runs/{id}`: page of a run, with the figures of each cycle, the proof of the plant's copy, and the documents made
//! from that copy.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Path, Query, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{HeaderName, StatusCode};
use axum::response::{IntoResponse, Redirect, Response};
use maud::{Markup, html};
use regrind_language::{Language, filled};
use regrind_page::{Reader, gauge};
use serde::Deserialize;
use tokio::task::spawn_blocking;

use super::super::Row;
use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::content::{PageContent, page};
use super::convergence::convergence;
use super::maps::{self, MapRequest, map_of_run};
use super::page_error::{Message, PageError, unmade, within};
use super::proof::proven;
use super::proofs::Proof;
use super::selection::mark;
use super::shared::{PlantPage, Shared};
use super::texts::{Text, result_word};
use super::words::{clamped, encoded, shown, um, when};

/// Time that the page waits for the proof before it is shown without it, and seconds until the browser then retries.
const WAITS: Duration = Duration::from_secs(3);
const AGAIN_S: u32 = 3;

/// Summary of a run, as the plant has it.
struct Run {
    id: i32,
    cell: String,
    name: String,
    head: String,
    row: Row,
}

impl Run {
    const COLUMNS: &str = "id, cell, run, head, serial, part_name, recipe, recipe_sha256, operator, simulation, to_char(began, 'YYYY-MM-DD HH24:MI:SS'),
        to_char(ended, 'YYYY-MM-DD HH24:MI:SS'), result, verdict, grinder, cmm, wheel, probe, alarms, records, pv_limit_um, rms_limit_um";

    async fn read(link: &DatabaseLink, id: i32) -> Result<Self, PageError> {
        let text = format!("SELECT {} FROM part_run WHERE id = $1", Self::COLUMNS);
        let mut rows = link.query(&text, &[&id]).await?;
        let row = rows.pop().ok_or_else(|| PageError::no_run(id))?;
        Ok(Self { id: row.get(0), cell: row.get(1), name: row.get(2), head: row.get(3), row })
    }

    /// Returns the text in column `k` of the row; empty if the column has no value.
    fn text(&self, k: usize) -> &str {
        self.row.get::<_, Option<&str>>(k).unwrap_or_default()
    }

    fn is_simulated(&self) -> bool {
        self.row.get::<_, Option<bool>>(9) == Some(true)
    }
}

/// Parses the id of a run from the text `id` in an address. Returns an error for the reader of the page if `id` is not
/// an integer.
fn number(id: &str) -> Result<i32, PageError> {
    id.parse().map_err(|_| PageError::not_here(Text::GiveNumber, Vec::new()))
}

/// Query of `/run`: the name of a cell, and the name of one of its runs.
#[derive(Debug, Deserialize)]
pub(super) struct Named {
    cell: String,
    name: String,
}

pub(super) async fn by_name(
    State(plant): State<Shared>,
    reader: Reader,
    Query(Named { cell, name }): Query<Named>,
) -> Response {
    let found = async {
        let link = plant.lease().await?;
        let [cell, name] = [cell, name].map(|text| text.replace('\0', ""));
        let rows = link.query("SELECT id FROM part_run WHERE cell = $1 AND run = $2", &[&cell, &name]).await?;
        let missing = || PageError::not_here(Text::NoRecordYet, vec![("run", name.clone()), ("cell", cell.clone())]);
        rows.first().map(|row| row.get::<_, i32>(0)).ok_or_else(missing)
    };
    match within(found).await {
        Ok(id) => Redirect::to(&format!("/runs/{id}")).into_response(),
        Err(reason) => unmade(&reader, &reason),
    }
}

pub(super) async fn run(State(plant): State<Shared>, reader: Reader, Path(id): Path<String>) -> Response {
    page(&reader, async { made(&plant, number(&id)?, reader.language).await }).await
}

async fn made(plant: &Shared, id: i32, language: Language) -> Result<PageContent, PageError> {
    let say = |text: Text| text.to(language);
    let (run, cycles, maps, map) = {
        let link = plant.lease().await?;
        let run = Run::read(&link, id).await?;
        let (cycles, maps) = (cycles(&link, id).await?, maps_of(&link, id).await?);
        // A run without a map has no picture; the reason of a map that cannot be drawn is in its place.
        let map = if maps.is_empty() {
            None
        } else {
            Some(maps::read(plant, &link, MapRequest { run: id, cycle: None }).await?)
        };
        (run, cycles, maps, map)
    };
    let shown_cycle = map.as_ref().map(|map| map.cycle);
    let drawn = spawn_blocking(move || map.map(|map| map_of_run(&map, language))).await.unwrap_or_default();
    // The proof continues in its own task after this page is shown without it.
    let (shared, cell, name, head) = (Arc::clone(plant), run.cell.clone(), run.name.clone(), run.head.clone());
    let proving = tokio::spawn(async move { proven(&shared, id, &cell, &name, &head).await });
    let proof = match tokio::time::timeout(WAITS, proving).await {
        Ok(Ok(proof)) => Some(proof?),
        _ => None,
    };
    let title = if run.text(4).is_empty() { run.name.clone() } else { run.text(4).to_owned() };
    let main = html! {
        main .list .plant .of-run {
            div .head { h1 { (shown(&title)) " " (mark(run.is_simulated(), language)) } (verdict(&run, language)) }
            div .run-grid {
                section .card .map {
                    h2 { (say(Text::ErrorMap)) @if let Some(cycle) = shown_cycle { ", " (say(Text::Cycle)) " " (cycle) } " " (mark(run.is_simulated(), language)) }
                    @match drawn { Some(drawn) => { (drawn) } None => { p .quiet { (say(Text::NoMapReported)) } } }
                    @if let [first, .., last] = maps[..] {
                        p { a href=(format!("/maps?run={id}:{first}&run={id}:{last}")) { (say(Text::FirstAndLastMap)) } }
                    }
                }
                div .column {
                    section .card { h2 { (say(Text::LastJudged)) } (figures(&cycles, language)) }
                    section .card #convergence { h2 { (say(Text::Convergence)) } (convergence(&cycles, limits(&cycles), language)) }
                }
            }
            section .card { h2 { (say(Text::Cycles)) } (table(&cycles, language)) }
            div .pair {
                section .card { h2 { (say(Text::CopyOfPlant)) } (proof_text(proof.as_deref(), language)) @if let Some(proof) = proof.as_ref().filter(|proof| proof.outcome.is_ok()) { (made_of_it(&run, proof, language)) } }
                section .card { h2 { (say(Text::Run)) } (about(&run, language)) }
            }
        }
    };
    Ok(PageContent { title: shown(&title), again_s: proof.is_none().then_some(AGAIN_S), main })
}

/// Returns the result of a run as the page of a cell shows it, and its reason.
fn verdict(run: &Run, language: Language) -> Markup {
    let result = run.text(12);
    // The verdict in the record begins with the word of the result.
    let verdict = run.text(13);
    let reason = verdict.split_once(": ").filter(|(word, _)| word.chars().all(|c| !c.is_lowercase()));
    let reason = reason.map_or(verdict, |(_, reason)| reason);
    let class = match result {
        "accepted" => "good",
        "not accepted" => "rejected",
        "aborted" => "bad",
        _ => "",
    };
    html! {
        div .banner .(class) { div .state { div { strong { (result_word(if result.is_empty() { "open" } else { result }, language)) } } } }
        @if !reason.is_empty() { div .reason-of-verdict { (clamped(reason)) } }
    }
}

fn about(run: &Run, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let row = |what: Text, text: &str| html! { @if !text.is_empty() { dt { (say(what)) } dd { (shown(text)) } } };
    let time = |what: Text, utc: &str| html! { @if !utc.is_empty() { dt { (say(what)) } dd { (when(utc)) } } };
    html! {
        dl .about {
            (row(Text::Part, run.text(5)))
            dt { (say(Text::Cell)) } dd { (shown(&run.cell)) }
            dt { (say(Text::Recipe)) } dd { a href=(format!("/trend?recipe={}", encoded(run.text(6)))) { (shown(run.text(6))) } " " span .id { (shown(run.text(7))) } }
            (row(Text::Operator, run.text(8)))
            (time(Text::Began, run.text(10))) (time(Text::Ended, run.text(11)))
            (row(Text::Grinder, run.text(14))) (row(Text::Cmm, run.text(15))) (row(Text::Wheel, run.text(16))) (row(Text::Probe, run.text(17)))
            dt { (say(Text::Alarms)) } dd { (run.row.get::<_, Option<i32>>(18).map_or(say(Text::NotTold).to_owned(), |n| n.to_string())) }
            dt { (say(Text::Run)) } dd .id { (shown(&run.name)) }
        }
        p .quiet { (say(Text::AsReported)) }
    }
}

/// Describes the result of the verification of a run in words, as HTML. The verification checks the plant's copy of the
/// run. If `proof` is `None`, says that the verification has not ended yet.
fn proof_text(proof: Option<&Proof>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let Some(proof) = proof else {
        return html! { p role="status" { (say(Text::CopyIsVerified)) } };
    };
    let found = match &proof.outcome {
        Ok(found) => found,
        Err(reason) => {
            return html! {
                p .no role="alert" { strong { (say(Text::NotProven)) } " " (when(&proof.at)) ": " (shown(reason)) }
                p { (say(Text::KeepAndCompare)) }
            };
        }
    };
    let is_signed = proof.is_signed_to_end();
    let signatures = match (found.signed, proof.keys, is_signed) {
        (0, ..) => Text::CopyNotSigned,
        (_, 0, _) => Text::SignedByUnknownKey,
        (.., true) => Text::SignedToEnd,
        _ => Text::SignedInPart,
    };
    let counts: [(&str, &dyn std::fmt::Display); 3] =
        [("records", &found.records), ("files", &found.artefacts), ("signed", &found.signed)];
    html! {
        p .proven[is_signed] {
            strong { (say(if is_signed { Text::Proven } else { Text::Unbroken })) } " " (when(&proof.at)) ": "
            (filled(say(Text::ChainAndFiles), &counts)) " " (filled(say(signatures), &counts)) " "
            @if !found.closed { (say(Text::NoRecordedEnd)) }
        }
        @if !proof.differences.is_empty() {
            p .no role="alert" { strong { (say(Text::ReportDiffers)) } " " (shown(&proof.differences.join("; "))) }
        }
    }
}

fn made_of_it(run: &Run, proof: &Proof, language: Language) -> Markup {
    let id = run.id;
    let one = |path: &str, text: Text, made: &Result<String, String>| {
        let name = text.to(language);
        html! {
            @match made {
                Ok(_) => { li { a href=(format!("/runs/{id}/{path}")) { (name) } } }
                Err(reason) => { li .quiet { (name) ": " (shown(reason)) } }
            }
        }
    };
    html! {
        ul .made { (one("report", Text::Report, &proof.report)) (one("qif", Text::ResultsAsQif, &proof.qif)) (one("dfq", Text::ResultsAsDfq, &proof.dfq)) }
    }
}

/// Reads the cycles of a run in order: the cycle, PV, its expanded uncertainty, RMS, its expanded uncertainty, the
/// verdict, its reason, the expected PV, and the limits of PV and RMS.
async fn cycles(link: &DatabaseLink, id: i32) -> Result<Vec<Row>, PlantError> {
    let text = "SELECT cycle, pv_um, pv_u_um, rms_um, rms_u_um, verdict, reason, expected_pv_um, pv_limit_um, rms_limit_um FROM cycle_figure
        WHERE run_id = $1 ORDER BY cycle LIMIT 1000";
    link.query(text, &[&id]).await
}

/// Returns the limits of PV and RMS in µm from the cycles of a run.
fn limits(cycles: &[Row]) -> [Option<f64>; 2] {
    cycles.last().map_or([None; 2], |row| [8, 9].map(|k| row.get::<_, Option<f64>>(k).filter(|um| um.is_finite())))
}

/// Shows PV and RMS of the last measured cycle, each with its uncertainty, its limit, and a bar of all three.
fn figures(cycles: &[Row], language: Language) -> Markup {
    let number = |row: &Row, k: usize| row.get::<_, Option<f64>>(k).filter(|um| um.is_finite());
    let last = cycles.iter().rev().find(|row| number(row, 1).is_some());
    html! {
        @match last {
            None => { p .quiet { (Text::NoCycleReported.to(language)) } }
            Some(row) => {
                @for (name, k, digits, limit) in [("PV", 1, 2, limits(cycles)[0]), ("RMS", 3, 3, limits(cycles)[1])] {
                    @if let Some(value) = number(row, k) { (gauge(name, [value, number(row, k + 1).unwrap_or(f64::NAN)], limit, digits, language)) }
                }
            }
        }
    }
}

fn table(cycles: &[Row], language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let [pv, rms] = limits(cycles);
    html! {
        @if cycles.is_empty() { p .quiet { (say(Text::NoCycleReported)) } } @else {
            div .wide { table {
                tr { th .n { (say(Text::Cycle)) } th .n { "PV, µm" } th .n { "± U" } th .n { "RMS, µm" } th .n { "± U" } th .n { (say(Text::ExpectedPv)) } th { (say(Text::Judged)) } }
                @for row in cycles {
                    @let [verdict, reason] = [5, 6].map(|k| row.get::<_, Option<&str>>(k).unwrap_or_default());
                    tr {
                        td .n { (row.get::<_, i32>(0)) }
                        td .n { strong { (um(row.get(1), 2, language)) } } td .n { (um(row.get(2), 2, language)) }
                        td .n { strong { (um(row.get(3), 3, language)) } } td .n { (um(row.get(4), 3, language)) }
                        td .n { (um(row.get(7), 2, language)) }
                        td { @if !verdict.is_empty() { strong { (shown(verdict)) } @if !reason.is_empty() { ": " } } (clamped(reason)) }
                    }
                }
                @if pv.is_some() || rms.is_some() {
                    tr .limit { td .n { (say(Text::Allowed)) } td .n { (um(pv, 2, language)) } td {} td .n { (um(rms, 3, language)) } td {} td {} td {} }
                }
            } }
            p .quiet { (say(Text::UncertaintyIs)) }
        }
    }
}

/// Returns the numbers of the cycles that have an error map, in ascending order. `id` is the id of the run in the
/// plant. Returns at most 1000 numbers. Returns an error if the plant cannot be reached or refuses the query.
async fn maps_of(link: &DatabaseLink, id: i32) -> Result<Vec<i32>, PlantError> {
    let rows = link
        .query("SELECT cycle FROM cycle_figure WHERE run_id = $1 AND map IS NOT NULL ORDER BY cycle LIMIT 1000", &[&id])
        .await?;
    Ok(rows.iter().map(|row| row.get(0)).collect())
}

/// Returns the run with this `id`, and the result of the verification of the plant's copy of the run. Waits for the
/// verification if there is no recent result in the cache.
///
/// Returns an error if `id` is not an integer, if the plant has no such run, or if the plant cannot be reached.
async fn proof_of(plant: &PlantPage, id: &str) -> Result<(Run, Arc<Proof>), PageError> {
    let run = {
        let link = plant.lease().await?;
        Run::read(&link, number(id)?).await?
    };
    let proof = proven(plant, run.id, &run.cell, &run.name, &run.head).await?;
    Ok((run, proof))
}

pub(super) async fn report(State(plant): State<Shared>, reader: Reader, Path(id): Path<String>) -> Response {
    match proof_of(&plant, &id).await {
        Ok((_, proof)) => match &proof.report {
            Ok(html) => {
                // The report contains its own style. Scripts in it must not run, and nothing may be fetched.
                let policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'";
                let headers = [
                    (CONTENT_TYPE, "text/html; charset=utf-8"),
                    (HeaderName::from_static("content-security-policy"), policy),
                ];
                (headers, html.clone()).into_response()
            }
            Err(reason) => not_made(&reader, reason),
        },
        Err(reason) => unmade(&reader, &reason),
    }
}

pub(super) async fn qif(State(plant): State<Shared>, reader: Reader, Path(id): Path<String>) -> Response {
    results(&plant, &reader, &id, "qif", "application/xml", |proof| &proof.qif).await
}

pub(super) async fn dfq(State(plant): State<Shared>, reader: Reader, Path(id): Path<String>) -> Response {
    results(&plant, &reader, &id, "dfq", "text/plain; charset=utf-8", |proof| &proof.dfq).await
}

async fn results(
    plant: &PlantPage,
    reader: &Reader,
    id: &str,
    ending: &str,
    kind: &'static str,
    of: fn(&Proof) -> &Result<String, String>,
) -> Response {
    match proof_of(plant, id).await {
        Ok((run, proof)) => match of(&proof) {
            Ok(text) => file(&format!("run-{}.{ending}", run.id), kind, text.clone()),
            Err(reason) => not_made(reader, reason),
        },
        Err(reason) => unmade(reader, &reason),
    }
}

/// Returns a response that the browser saves as the file `name`, which must consist of letters, digits and dots only.
/// `kind` is the media type of `content`.
pub(super) fn file(name: &str, kind: &'static str, content: String) -> Response {
    ([(CONTENT_TYPE, kind.to_owned()), (CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\""))], content)
        .into_response()
}

/// Returns an error page with HTTP status 422 for a document that cannot be created from the plant's copy of a run.
/// `reason` is the reason that the page shows. `reader` is the reader of the page.
fn not_made(reader: &Reader, reason: &str) -> Response {
    let mut response = unmade(reader, &PageError::NotHere(Message::Words(reason.to_owned())));
    *response.status_mut() = StatusCode::UNPROCESSABLE_ENTITY;
    response
}
