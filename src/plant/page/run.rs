//! `/runs/{id}`: page of a run, with the figures of each cycle, the proof of the plant's copy, and the documents made
//! from that copy.

use std::sync::Arc;
use std::time::Duration;

use axum::Extension;
use axum::extract::{Path, Query, State};
use axum::http::header::{CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::http::{HeaderName, StatusCode};
use axum::response::{IntoResponse, Redirect, Response};
use maud::{Markup, html};
use regrind_page::Session;
use serde::Deserialize;

use super::super::Row;
use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::content::{PageContent, page};
use super::page_error::{PageError, unmade, within};
use super::proof::proven;
use super::proofs::Proof;
use super::selection::mark;
use super::shared::{PlantPage, Shared};
use super::words::{encoded, shown, um};

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
        let row =
            rows.pop().ok_or_else(|| PageError::NotHere(format!("the plant has no run {id} that made a part")))?;
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
    id.parse().map_err(|_| PageError::NotHere("give the number of a run, as in /runs/17".into()))
}

/// Query of `/run`: the name of a cell, and the name of one of its runs.
#[derive(Debug, Deserialize)]
pub(super) struct Named {
    cell: String,
    name: String,
}

pub(super) async fn by_name(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Query(Named { cell, name }): Query<Named>,
) -> Response {
    let found = async {
        let link = plant.lease().await?;
        let [cell, name] = [cell, name].map(|text| text.replace('\0', ""));
        let rows = link.query("SELECT id FROM part_run WHERE cell = $1 AND run = $2", &[&cell, &name]).await?;
        let missing = || PageError::NotHere(format!("the plant has no record of the run {name} of {cell} yet"));
        rows.first().map(|row| row.get::<_, i32>(0)).ok_or_else(missing)
    };
    match within(found).await {
        Ok(id) => Redirect::to(&format!("/runs/{id}")).into_response(),
        Err(reason) => unmade(&session, &reason),
    }
}

pub(super) async fn run(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
) -> Response {
    page(&session, async { made(&plant, number(&id)?).await }).await
}

async fn made(plant: &Shared, id: i32) -> Result<PageContent, PageError> {
    let (run, cycles, maps) = {
        let link = plant.lease().await?;
        let run = Run::read(&link, id).await?;
        (run, cycles(&link, id).await?, maps_of(&link, id).await?)
    };
    // The proof continues in its own task after this page is shown without it.
    let (shared, cell, name, head) = (Arc::clone(plant), run.cell.clone(), run.name.clone(), run.head.clone());
    let proving = tokio::spawn(async move { proven(&shared, id, &cell, &name, &head).await });
    let proof = match tokio::time::timeout(WAITS, proving).await {
        Ok(Ok(proof)) => Some(proof?),
        _ => None,
    };
    let title = if run.text(4).is_empty() { run.name.clone() } else { run.text(4).to_owned() };
    let main = html! {
        main .list .plant {
            h1 { (shown(&title)) " " (mark(run.is_simulated())) }
            (about(&run))
            h2 { "The copy of the plant" }
            (proof_text(proof.as_deref()))
            @if let Some(proof) = proof.as_ref().filter(|proof| proof.outcome.is_ok()) { (made_of_it(&run, proof)) }
            h2 { "Cycles" }
            (cycles)
            @if let Some(first) = maps.first() {
                p {
                    "Maps: " a href=(format!("/maps?run={id}")) { "the last" }
                    @if maps.len() > 1 { " · " a href=(format!("/maps?run={id}:{first}&run={id}:{}", maps[maps.len() - 1])) { "the first and the last on one scale" } }
                }
            }
        }
    };
    Ok(PageContent { title: shown(&title), again_s: proof.is_none().then_some(AGAIN_S), main })
}

fn about(run: &Run) -> Markup {
    let result = run.text(12);
    // The verdict in the record begins with the word of the result.
    let verdict = run.text(13);
    let reason = verdict.split_once(": ").filter(|(word, _)| word.chars().all(|c| !c.is_lowercase()));
    let verdict = reason.map_or(verdict, |(_, reason)| reason);
    let row = |what: &str, text: &str| html! { @if !text.is_empty() { dt { (what) } dd { (shown(text)) } } };
    html! {
        p .verdict.good[result == "accepted"] { strong { (shown(if result.is_empty() { "open" } else { result })) } @if !verdict.is_empty() { ": " (shown(verdict)) } }
        dl .about {
            (row("Part", run.text(5)))
            dt { "Cell" } dd { (shown(&run.cell)) }
            dt { "Recipe" } dd { a href=(format!("/trend?recipe={}", encoded(run.text(6)))) { (shown(run.text(6))) } " " span .id { (shown(run.text(7))) } }
            (row("Operator", run.text(8)))
            (row("Began, UTC", run.text(10))) (row("Ended, UTC", run.text(11)))
            (row("Grinder", run.text(14))) (row("CMM", run.text(15))) (row("Wheel", run.text(16))) (row("Probe", run.text(17)))
            dt { "Alarms" } dd { (run.row.get::<_, Option<i32>>(18).map_or("not told".to_owned(), |n| n.to_string())) }
            dt { "Run" } dd .id { (shown(&run.name)) }
        }
        p .quiet { "As reported by the cell; the report shows the content of the record." }
    }
}

/// Describes the result of the verification of a run in words, as HTML. The verification checks the plant's copy of the
/// run. If `proof` is `None`, says that the verification has not ended yet.
fn proof_text(proof: Option<&Proof>) -> Markup {
    let Some(proof) = proof else {
        return html! { p role="status" { "The copy is being fetched and verified; this page then shows the result by itself." } };
    };
    html! {
        @match &proof.outcome {
            Ok(found) => {
                p .proven[proof.is_signed_to_end()] {
                    strong { @if proof.is_signed_to_end() { "Proven" } @else { "Unbroken, but not proven" } }
                    " at " (proof.at) " UTC: " (found.records) " records in an unbroken chain and " (found.artefacts) " unchanged files"
                    @if found.signed == 0 { "; not signed, so whoever can write into the plant can have made them" }
                    @else if proof.keys == 0 { "; signatures up to record " (found.signed) ", with a key that is not enrolled at the plant" }
                    @else if proof.is_signed_to_end() { "; signed to the end, with a key that is enrolled for the cell" }
                    @else { "; signatures up to record " (found.signed) " only, with a key that is enrolled for the cell: nothing proves the records after it" }
                    @if found.closed { "." } @else { ". The run has no recorded end: it is still active, or its record was cut before the end arrived." }
                }
                @if !proof.differences.is_empty() {
                    p .no role="alert" { strong { "The report of the cell differs from the record" } ": " (shown(&proof.differences.join("; "))) }
                }
            }
            Err(reason) => {
                p .no role="alert" { strong { "NOT PROVEN" } " at " (proof.at) " UTC: " (shown(reason)) }
                p { "Keep the plant and the cell as they are, and compare: regrind audit verify --plant" }
            }
        }
    }
}

fn made_of_it(run: &Run, proof: &Proof) -> Markup {
    let id = run.id;
    let one = |path: &str, name: &str, made: &Result<String, String>| {
        html! {
            @match made {
                Ok(_) => { li { a href=(format!("/runs/{id}/{path}")) { (name) } } }
                Err(reason) => { li .quiet { (name) ": " (shown(reason)) } }
            }
        }
    };
    html! {
        ul .made { (one("report", "Report", &proof.report)) (one("qif", "Results as QIF 3.0", &proof.qif)) (one("dfq", "Results as DFQ (Q-DAS)", &proof.dfq)) }
    }
}

async fn cycles(link: &DatabaseLink, id: i32) -> Result<Markup, PlantError> {
    let text = "SELECT cycle, pv_um, pv_u_um, rms_um, rms_u_um, verdict, reason, expected_pv_um, pv_limit_um, rms_limit_um FROM cycle_figure
        WHERE run_id = $1 ORDER BY cycle LIMIT 1000";
    let rows = link.query(text, &[&id]).await?;
    let limits = rows.last().map(|row| [row.get::<_, Option<f64>>(8), row.get(9)]);
    Ok(html! {
        @if rows.is_empty() { p .quiet { "No cycle is reported yet." } } @else {
            div .wide { table {
                tr { th .n { "Cycle" } th .n { "PV, µm" } th .n { "± U" } th .n { "RMS, µm" } th .n { "± U" } th .n { "expected PV" } th { "Judged" } }
                @for row in &rows {
                    @let [verdict, reason] = [5, 6].map(|k| row.get::<_, Option<&str>>(k).unwrap_or_default());
                    tr {
                        td .n { (row.get::<_, i32>(0)) }
                        td .n { strong { (um(row.get(1), 2)) } } td .n { (um(row.get(2), 2)) }
                        td .n { strong { (um(row.get(3), 3)) } } td .n { (um(row.get(4), 3)) }
                        td .n { (um(row.get(7), 2)) }
                        td { @if verdict.is_empty() { (shown(reason)) } @else { strong { (shown(verdict)) } @if !reason.is_empty() { ": " (shown(reason)) } } }
                    }
                }
                @if let Some([pv, rms]) = limits {
                    tr .limit { td .n { "allowed" } td .n { (um(pv, 2)) } td {} td .n { (um(rms, 3)) } td {} td {} td {} }
                }
            } }
            p .quiet { "U: expanded uncertainty, k = 2. Expected: PV that was predicted to remain after the correction from this cycle." }
        }
    })
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

pub(super) async fn report(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
) -> Response {
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
            Err(reason) => not_made(&session, reason),
        },
        Err(reason) => unmade(&session, &reason),
    }
}

pub(super) async fn qif(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
) -> Response {
    results(&plant, &session, &id, "qif", "application/xml", |proof| &proof.qif).await
}

pub(super) async fn dfq(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
) -> Response {
    results(&plant, &session, &id, "dfq", "text/plain; charset=utf-8", |proof| &proof.dfq).await
}

async fn results(
    plant: &PlantPage,
    session: &Session,
    id: &str,
    ending: &str,
    kind: &'static str,
    of: fn(&Proof) -> &Result<String, String>,
) -> Response {
    match proof_of(plant, id).await {
        Ok((run, proof)) => match of(&proof) {
            Ok(text) => file(&format!("run-{}.{ending}", run.id), kind, text.clone()),
            Err(reason) => not_made(session, reason),
        },
        Err(reason) => unmade(session, &reason),
    }
}

/// Returns a response that the browser saves as the file `name`, which must consist of letters, digits and dots only.
/// `kind` is the media type of `content`.
pub(super) fn file(name: &str, kind: &'static str, content: String) -> Response {
    ([(CONTENT_TYPE, kind.to_owned()), (CONTENT_DISPOSITION, format!("attachment; filename=\"{name}\""))], content)
        .into_response()
}

/// Returns an error page with HTTP status 422 for a document that cannot be created from the plant's copy of a run.
/// `reason` is the reason that the page shows. `session` is the session of the person who has signed in.
fn not_made(session: &Session, reason: &str) -> Response {
    let mut response = unmade(session, &PageError::NotHere(reason.to_owned()));
    *response.status_mut() = StatusCode::UNPROCESSABLE_ENTITY;
    response
}
