//! Pages as HTML, in the language of the reader: the frame around every page, the page of a run, the list of runs, the
//! comparison, and the pages for a client without access.

use axum::Extension;
use axum::extract::{Path, Query, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Redirect, Response};
use data_encoding::HEXLOWER;
use maud::{DOCTYPE, Markup, html};
use regrind_cell::{Device, StateName};
use regrind_control::{NextStep, Snapshot};
use regrind_formats::operator_step::StepConfirmation;
use regrind_formats::result::read_bytes;
use regrind_formats::run_files::RunFile;
use regrind_report::{ColourMap, ReportOptions, RunResult, report_options};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::task::spawn_blocking;

use super::chart::chart;
use super::guard::{Denied, Session};
use super::history::Listed;
use super::live::{ObservedRun, verdict};
use super::pieces::{Piece, about, banner, figures, in_path, is_over, lacks_reason, run_pieces, verdict_reason, when};
use super::reader::{Reader, language};
use super::shared::Shared;
use super::subject::PageSubject;
use super::texts::{self, Text};
use super::users::Person;
use regrind_language::{Language, decimal};

/// Returns the state of a run as JSON for the scripts of the page. `seen` is the current status of the run. `session`
/// decides which orders are allowed. `has_control` is true if the browser has control of the cell, or if no browser has
/// control.
pub(crate) fn state(seen: &ObservedRun, session: &Session, has_control: bool) -> Value {
    let live = seen.snapshot.as_deref().filter(|_| seen.answers);
    let cycles: Vec<_> = seen
        .summary
        .cycles
        .iter()
        .map(|of| {
            json!({
                "cycle": of.cycle, "map": of.map, "points": of.deviations,
            })
        })
        .collect();
    let tolerance = seen.summary.tolerance.as_ref();
    let progress = live.and_then(|live| live.progress);
    let measures = progress.filter(|progress| progress.device == Device::Cmm);
    json!({
        "answers": seen.answers,
        "lost": seen.is_lost(),
        "last": seen.summary.last,
        "machinesWithin": seen.summary.machines_within,
        "over": seen.summary.ended.is_some() && !seen.answers,
        "number": live.map(|live| live.state_number),
        "can": live.map_or_else(Vec::new, |live| {
            let mut can = can(live, session, has_control);
            can.extend(Some("reason").filter(|_| lacks_reason(seen, live) && session.may("hold")));
            can
        }),
        "cycle": live.map(|live| live.cycle),
        "cycles": cycles,
        "toleranceUm": tolerance.map(|tolerance| 1e3 * tolerance.pv_mm).filter(|um| um.is_finite()),
        "deviations": [seen.touches.cycle as usize, seen.touches.batch as usize, seen.touches.deviations_um.len()],
        "ground": progress.filter(|progress| progress.device == Device::Grinder).map(|progress| [progress.done, progress.total]),
        "touched": measures.map(|progress| [progress.done, progress.total]),
        "alarms": live.map_or(0, |live| live.alarms.len()),
        "verdict": verdict(seen),
    })
}

/// Returns the names of the orders that the browser can give now, such as `hold`. `live` is the current state of the
/// cell, and the role of the person of `session` limits the orders. `has_control` is true if the browser has control of
/// the cell, or if no browser has control. Without control, only `hold`, `stop`, `abort` and `remark` are possible.
fn can(live: &Snapshot, session: &Session, has_control: bool) -> Vec<&'static str> {
    let mut can = vec!["hold", "stop", "abort", "remark"];
    if is_over(live.state) {
        can.clear();
    }
    // The next order is RESUME: a HOLD changes nothing now.
    if matches!(live.state, StateName::Holding | StateName::Held) {
        can.retain(|order| *order != "hold");
    }
    if has_control && live.state == StateName::Held {
        can.push("resume");
    }
    match live.next_step {
        NextStep::Load if has_control => can.push("loaded"),
        NextStep::SeeClear { .. } if has_control => can.push("clear"),
        NextStep::SeeWhetherItStands { .. } if has_control => can.push("over"),
        NextStep::AtMachine { .. } if has_control => {
            let confirmation = live.operator_step.as_ref().and_then(|step| step.confirmation);
            can.extend(confirmation.map(|confirmation| match confirmation {
                StepConfirmation::Started => "started",
                StepConfirmation::Done => "done",
                StepConfirmation::DoneWithFile => "measurement",
                StepConfirmation::Still => "still",
            }));
        }
        _ => {}
    }
    can.retain(|order| session.may(order));
    can
}

/// Serves the page of the run that the page shows first, or else the list of runs.
pub(crate) async fn home(State(page): State<Shared>) -> Response {
    let path = first_run(&page).await.map_or("/runs".to_owned(), |run| format!("/runs/{}", in_path(&run)));
    Redirect::to(&path).into_response()
}

/// Returns the name of the run that the page was started for, or of the active run, or of the last run if none is
/// active. Returns `None` if there is no run, or if several are active.
pub(super) async fn first_run(page: &Shared) -> Option<String> {
    if let Some(first) = page.first_run.as_ref().filter(|run| page.history.folder(run).is_some()) {
        return Some(first.clone());
    }
    let history = std::sync::Arc::clone(&page.history);
    let listed = spawn_blocking(move || history.list()).await.unwrap_or_default();
    let live = listed.iter().filter(|run| run.is_live).count();
    listed.first().filter(|_| live <= 1).map(|first| first.id.clone())
}

pub(crate) async fn run(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(id): Path<String>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let language = language(&headers);
    let Some(folder) = page.history.folder(&id) else { return not_here(PageSubject::Cell, &headers) };
    let mut looked = page.run_watcher.subscribe(&folder);
    let known = looked.borrow().summary.run.is_empty();
    if known {
        // An active run reports its status at once. For a run that has ended, the record contains it.
        drop(tokio::time::timeout(std::time::Duration::from_secs(2), looked.changed()).await);
    }
    let seen = looked.borrow().clone();
    let has_control = page.guard.has_control(&session, false);
    let main = cell(&seen, &id, &session, has_control, language);
    let title = format!("{} {}", seen.summary.part, seen.summary.name);
    document(&title, &Frame { language, person: session.person.as_ref(), kind: Kind::WithMaps }, main)
}

/// Returns the HTML of the page of the run named `id`. While the run is active, the page shows the cell and its
/// controls. Afterwards it shows the result. `seen` is the current status of the run. `has_control` is true if the
/// browser has control of the cell, or if no browser has control.
fn cell(seen: &ObservedRun, id: &str, session: &Session, has_control: bool, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let made = run_pieces(seen, has_control || !session.may("control"), language);
    let piece = |piece: Piece| {
        let html = made.iter().find(|(made, _)| *made == piece).map_or("", |(_, html)| html);
        maud::PreEscaped(html.to_owned())
    };
    let state = state(seen, session, has_control);
    let data = json!({ "run": id, "state": state, "colours": colours(ColourMap::Diverging), "unsigned": colours(ColourMap::Sequential), "texts": script_texts(language) });
    html! {
        a .skip href="#orders" { (say(Text::SkipToOrders)) }
        div #old role="alert" hidden {}
        header #banner { (piece(Piece::Banner)) }
        p #state-said .unseen role="status" {}
        main .cell data-run=(id) {
            section .flow {
                div #steps aria-label=(say(Text::StepsOfCycle)) role="group" { (piece(Piece::Steps)) }
                div #next role="group" aria-live="polite" aria-label=(say(Text::NextAction)) { (piece(Piece::Next)) }
            }
            section .card .map aria-label=(say(Text::Map)) { (map(language)) }
            div .column {
                section .card .of-alarms { h2 { (say(Text::Alarms)) } div #alarms aria-live="assertive" { (piece(Piece::Alarms)) } }
                section .card { h2 { (say(Text::LastJudged)) } div #judged { (piece(Piece::Judged)) } }
                section .card { h2 { (say(Text::Convergence)) } div #convergence { (piece(Piece::Convergence)) } }
                section .card { h2 { (say(Text::Cycles)) } div #cycles { (piece(Piece::Cycles)) } }
                section .card {
                    h2 { (say(Text::ThisRun)) }
                    div #about { (piece(Piece::About)) }
                    p .links {
                        a href=(format!("/runs/{}/report", in_path(id))) { (say(Text::Report)) }
                        " " a href=(format!("/runs/{}/record", in_path(id))) { (say(Text::Record)) }
                        " " a href=(format!("/runs/{}/record?show=people", in_path(id))) { (say(Text::ShiftLog)) }
                    }
                }
            }
        }
        section #orders .orders {
            button .hold type="button" data-order="hold" disabled { (say(Text::Hold)) }
            button .resume type="button" data-order="resume" disabled { (say(Text::Resume)) }
            button .stop type="button" data-order="stop" disabled { (say(Text::Stop)) }
            div .said tabindex="0" role="group" aria-label=(say(Text::Answer)) {
                p #control { (piece(Piece::Control)) }
                p #answer role="status" { (say(Text::NoButtonStops)) }
            }
            button .abort type="button" data-order="abort" disabled { (say(Text::Abort)) }
        }
        script #data type="application/json" { (maud::PreEscaped(harmless(&data))) }
    }
}

/// Returns `data` as JSON that is safe within an HTML script element: it contains no `<`.
pub(super) fn harmless(data: &Value) -> String {
    data.to_string().replace('<', "\\u003c")
}

fn map(language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        div .tools role="group" aria-label=(say(Text::Map)) {
            div .views {
                button type="button" data-view="map" aria-pressed="true" { (say(Text::Map)) }
                button type="button" data-view="difference" aria-pressed="false" { (say(Text::Difference)) }
                button type="button" data-view="sigma" aria-pressed="false" { (say(Text::Sigma)) }
                button type="button" data-view="relief" aria-pressed="false" { (say(Text::Relief)) }
                button type="button" data-points aria-pressed="false" { (say(Text::Points)) }
            }
            div .zoom role="group" aria-label=(say(Text::Map)) {
                button type="button" data-zoom="in" aria-label=(say(Text::ZoomIn)) title=(say(Text::ZoomIn)) { "+" }
                button type="button" data-zoom="out" aria-label=(say(Text::ZoomOut)) title=(say(Text::ZoomOut)) { "−" }
                button type="button" data-zoom="whole" { (say(Text::WholePart)) }
            }
            label { (say(Text::Scale)) " "
                select #scale {
                    option value="first" { (say(Text::ScaleOfFirst)) }
                    option value="own" { (say(Text::ScaleOfMap)) }
                    option value="tolerance" { (say(Text::ScaleOfTolerance)) }
                }
            }
            label { (say(Text::Cycle)) " " select #cycle {} }
        }
        canvas #map tabindex="0" role="img" aria-label=(say(Text::MapHelp)) {}
        div .solid {
            canvas #relief tabindex="0" role="img" aria-label=(say(Text::MapHelp)) hidden {}
            canvas #frame aria-hidden="true" hidden {}
        }
        div .foot { output #caption {} output #reading {} }
        div .under {
            canvas #histogram role="img" aria-label=(say(Text::Histogram)) {}
            canvas #sections role="img" aria-label=(say(Text::Sections)) hidden {}
        }
        p #saved .saved hidden {
            (say(Text::SaveMap)) ": "
            @for (file, name) in [("error_map.png", "PNG"), ("error_map.svg", "SVG"), ("error_map.csv", "CSV"), ("error_map.x3p", "X3P")] {
                a data-file=(file) download { (name) } " "
            }
            a data-file="deviations.csv" download { (say(Text::Deviations)) }
        }
    }
}

/// Returns, as JSON, the texts in `language` that the scripts show.
fn script_texts(language: Language) -> Value {
    let say = |text: Text| text.to(language);
    json!({
        "noData": say(Text::NotConnected), "pageGone": say(Text::PageGone), "programGone": say(Text::ProgramGone), "simulationGone": say(Text::SimulationGone),
        "noRelief": say(Text::NoRelief), "notMeasured": say(Text::NotMeasured), "planned": say(Text::Planned),
        "touched": say(Text::Touched), "filtered": say(Text::Filtered), "known": say(Text::KnownTo), "order": say(Text::NoButtonStops),
        "sign": say(Text::SignOfMap), "noCycleBefore": say(Text::NoCycleBefore), "preliminary": say(Text::PreliminaryDots), "sectionHelp": say(Text::SectionHelp), "heights": say(Text::HeightFactor), "wheel": say(Text::WheelOnPath),
    })
}

/// Returns the 255 colours of a colour map, from the lowest value to the highest, as hexadecimal digits: three bytes
/// (red, green, blue) for each.
fn colours(of: ColourMap) -> String {
    let colour = |k: u32| of.at(f64::from(k) / 254.0);
    HEXLOWER.encode(&(0..255).flat_map(colour).collect::<Vec<u8>>())
}

/// Returns a page of the cell without maps.
pub(super) fn plain_document(title: &str, session: &Session, language: Language, main: Markup) -> Response {
    document(title, &Frame { language, person: session.person.as_ref(), kind: Kind::Plain(PageSubject::Cell) }, main)
}

/// Returns a page on which a recipe is written.
pub(super) fn workbench_document(title: &str, session: &Session, language: Language, main: Markup) -> Response {
    document(title, &Frame { language, person: session.person.as_ref(), kind: Kind::Workbench }, main)
}

/// Filter for a list of runs. An empty field matches all runs.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct RunFilter {
    part: String,
    recipe: String,
    result: String,
    /// First and last day of the start of the run, `2026-07-04`, in UTC.
    since: String,
    until: String,
}

impl RunFilter {
    fn fits(&self, run: &Listed) -> bool {
        let has = |value: &str, wanted: &str| {
            wanted.is_empty() || value.to_lowercase().contains(&wanted.trim().to_lowercase())
        };
        let result = self.result.is_empty() || self.result == run.summary.result.name();
        let day = run.summary.began.get(..10).unwrap_or_default();
        let in_time =
            (self.since.is_empty() || day >= self.since.trim()) && (self.until.is_empty() || day <= self.until.trim());
        has(&run.summary.part, &self.part) && has(&run.summary.recipe, &self.recipe) && result && in_time
    }
}

/// Serves the page with the list of runs. `wanted` is the filter from the address: only runs that match the filter are
/// listed, and an empty field of the filter matches all runs. `session` contains the person who has signed in, and
/// `headers` determine the language.
pub(crate) async fn runs(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Query(wanted): Query<RunFilter>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let language = language(&headers);
    let say = |text: Text| text.to(language);
    let history = std::sync::Arc::clone(&page.history);
    let listed = spawn_blocking(move || history.list()).await.unwrap_or_default();
    const RESULTS: [RunResult; 5] =
        [RunResult::Open, RunResult::Accepted, RunResult::NotAccepted, RunResult::Stopped, RunResult::Aborted];
    let main = html! {
        main .list {
            h1 { (say(Text::Runs)) }
            form .filter method="get" action="/runs" {
                label { (say(Text::Part)) " " input name="part" value=(wanted.part); }
                label { (say(Text::Recipe)) " " input name="recipe" value=(wanted.recipe); }
                label { (say(Text::Result)) " "
                    select name="result" {
                        option value="" { (say(Text::All)) }
                        @for result in RESULTS {
                            @let name = result.name();
                            option value=(name) selected[name == wanted.result] { (say(texts::result(result))) }
                        }
                    }
                }
                label { (say(Text::Since)) " " input type="date" name="since" value=(wanted.since); }
                label { (say(Text::Until)) " " input type="date" name="until" value=(wanted.until); }
                button { (say(Text::Show)) }
            }
            form method="get" action="/compare" {
                (table_of(listed.iter().filter(|run| wanted.fits(run)), language))
                p { (say(Text::TwoSideBySide)) " " button { (say(Text::Compare)) } }
            }
        }
    };
    document(
        say(Text::Runs),
        &Frame { language, person: session.person.as_ref(), kind: Kind::Plain(PageSubject::Cell) },
        main,
    )
}

fn table_of<'a>(runs: impl Iterator<Item = &'a Listed>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        table {
            tr {
                th {} th { (say(Text::Part)) } th { (say(Text::Recipe)) } th { (say(Text::Began)) }
                th .n { (say(Text::Cycle)) } th .n { "PV, µm" } th .n { "RMS, µm" } th .n { (say(Text::Alarms)) } th { (say(Text::Result)) } th { (say(Text::Run)) }
            }
            @for Listed { id, is_live, summary } in runs {
                @let figures = summary.cycles.iter().rev().find_map(|of| of.figures);
                tr {
                    td { input type="checkbox" name="run" value=(id) aria-label=(id); }
                    @let address = format!("/runs/{}", in_path(id));
                    td { a href=(address) { @if summary.part.is_empty() { (summary.name) } @else { (summary.part) } } }
                    td { (summary.recipe) } td { (when(&summary.began)) }
                    td .n { (summary.cycles.len()) }
                    @for k in 0..2 {
                        td .n { @if let Some(figures) = figures { (decimal(figures[k][0], 2, language)) } @else { "–" } }
                    }
                    td .n { (summary.alarms.len()) }
                    td class=(if summary.result == RunResult::Accepted { "good" } else { "" }) {
                        @if *is_live { strong { (say(Text::Live)) } } @else { (say(texts::result(summary.result))) }
                    }
                    td .id { a href=(address) { (id) } }
                }
            }
        }
    }
}

/// Serves the page with two runs side by side. The query of the address names them: `run=A&run=B`. Without two existing
/// runs, redirects to the list of runs.
pub(crate) async fn compare(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    axum::extract::RawQuery(query): axum::extract::RawQuery,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let language = language(&headers);
    let say = |text: Text| text.to(language);
    let query = query.unwrap_or_default();
    let ids: Vec<String> = query.split('&').filter_map(|pair| pair.strip_prefix("run=")).map(str::to_owned).collect();
    let history = std::sync::Arc::clone(&page.history);
    let found = spawn_blocking(move || {
        let of = |id: &String| Some((id.clone(), history.summary(&history.folder(id)?)?));
        ids.iter().filter_map(of).take(2).collect::<Vec<_>>()
    });
    let found = found.await.unwrap_or_default();
    if found.len() < 2 {
        return Redirect::to("/runs").into_response();
    }
    let main = html! {
        main .compare {
            @for (id, summary) in &found {
                @let seen = ObservedRun { summary: std::sync::Arc::clone(summary), ..ObservedRun::default() };
                @let tolerance = summary.tolerance.as_ref();
                section data-compared=(id) {
                    h2 { a href=(format!("/runs/{}", in_path(id))) { (id) } }
                    (banner(&seen, language))
                    p .quiet { (verdict_reason(summary)) }
                    canvas role="img" aria-label=(say(Text::Map)) {}
                    (chart(&summary.cycles, tolerance, false, language))
                    (figures(&summary.cycles, tolerance, language))
                    (about(&seen, language))
                }
            }
        }
        figure .difference .card {
            figcaption { (say(Text::DifferenceOfRuns)) ": " strong { (found[1].0) } " − " strong { (found[0].0) } }
            canvas #difference role="img" aria-label=(say(Text::DifferenceOfRuns)) {}
        }
        @let maps: Vec<_> = found.iter().map(|(id, summary)| {
            json!({ "run": id, "cycle": summary.cycles.iter().rev().find(|of| of.map.is_some()).map(|of| of.cycle) })
        }).collect();
        script #data type="application/json" {
            (maud::PreEscaped(harmless(&json!({ "compared": maps, "colours": colours(ColourMap::Diverging), "texts": script_texts(language) }))))
        }
    };
    document(say(Text::Compare), &Frame { language, person: session.person.as_ref(), kind: Kind::WithMaps }, main)
}

/// Serves the report of the run named `id` in the language of the reader. Uses the report file in the folder of the run.
/// If there is no such file, or if it has another language, creates the report from the record. Responds with the status 404 if the run does not exist, and 422 if the report
/// cannot be created.
pub(crate) async fn report(State(page): State<Shared>, Path(id): Path<String>, headers: HeaderMap) -> Response {
    drop(page.viewers.enter());
    let Some(folder) = page.history.folder(&id) else { return not_here(PageSubject::Cell, &headers) };
    let language = language(&headers);
    let read = spawn_blocking(move || {
        let file = read_bytes(&folder.join(RunFile::Report.name())).ok();
        let options = file.as_ref().and_then(|html| report_options(&String::from_utf8_lossy(html))).unwrap_or_default();
        let is_wanted = options.language == language;
        match file.filter(|_| is_wanted) {
            Some(html) => Ok(html),
            None => {
                let options = ReportOptions { language, ..options };
                regrind_report::run_report(&folder, &options).map(String::into_bytes)
            }
        }
    });
    match read.await {
        Ok(Ok(html)) => report_document(html),
        Ok(Err(error)) => (StatusCode::UNPROCESSABLE_ENTITY, error.to_string()).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// Returns the response with a report. The report contains its style. It must not run scripts and must not fetch
/// anything.
pub(crate) fn report_document(html: Vec<u8>) -> Response {
    let policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'";
    let headers =
        [(CONTENT_TYPE, "text/html; charset=utf-8"), (HeaderName::from_static("content-security-policy"), policy)];
    (headers, html).into_response()
}

/// Returns the page for an address that does not exist, with the status 404. `of` says whether the server shows one
/// cell or the plant; it determines the links at the top of the page. `headers` are the headers of the request; they
/// determine the language.
pub(crate) fn not_here(of: PageSubject, headers: &HeaderMap) -> Response {
    let language = language(headers);
    let main = html! { main .list { h1 { "404" } p { (Text::NotHere.to(language)) } } };
    (StatusCode::NOT_FOUND, document("404", &Frame { language, person: None, kind: Kind::Plain(of) }, main))
        .into_response()
}

/// Returns the page for a client without access. `reason` decides what the page asks for: the key, or a sign-in. `of`
/// says whether the server shows one cell or the plant; it determines the links at the top of the page. `headers` are
/// the headers of the request; they determine the language.
pub(crate) fn denied(reason: Denied, of: PageSubject, headers: &HeaderMap) -> Response {
    match reason {
        Denied::NoKey => key_needed(StatusCode::UNAUTHORIZED, of, headers),
        Denied::TooManyKeys => key_needed(StatusCode::TOO_MANY_REQUESTS, of, headers),
        Denied::NotSignedIn => sign_in(StatusCode::UNAUTHORIZED, of, headers, None),
    }
}

/// Returns the page on which a person enters the access key. A client without a valid key gets this page. `status` is
/// the HTTP status of the response. `of` says whether the server shows one cell or the plant; it determines the links
/// at the top of the page. `headers` are the headers of the request; they determine the language.
fn key_needed(status: StatusCode, of: PageSubject, headers: &HeaderMap) -> Response {
    let language = language(headers);
    let main = html! {
        main .list {
            h1 { "Regrind" }
            p { (Text::KeyNeeded.to(language)) }
            form method="get" action="/" { label { "key " input name="key" type="password" autocomplete="off"; } " " button { "OK" } }
        }
    };
    (status, document("Regrind", &Frame { language, person: None, kind: Kind::Plain(of) }, main)).into_response()
}

/// Returns the sign-in page. `status` is the HTTP status of the response. `of` says whether the server shows one cell
/// or the plant; it determines the links at the top of the page. `headers` are the headers of the request; they
/// determine the language. `told` is the message after a failed sign-in; without a message it is `None`.
pub(crate) fn sign_in(status: StatusCode, of: PageSubject, headers: &HeaderMap, told: Option<Text>) -> Response {
    let language = language(headers);
    let say = |text: Text| text.to(language);
    let main = html! {
        main .list .sign-in {
            h1 { (say(Text::SignIn)) }
            @if let Some(told) = told { p .no role="alert" { (say(told)) } }
            form method="post" action="/sign-in" {
                label { (say(Text::UserName)) " " input name="name" autocomplete="username" required maxlength="64" autofocus; }
                label { (say(Text::Password)) " " input name="password" type="password" autocomplete="current-password" required maxlength="256"; }
                button { (say(Text::SignIn)) }
            }
            p .quiet { (say(Text::WhoMakesUsers)) }
        }
    };
    (status, document(say(Text::SignIn), &Frame { language, person: None, kind: Kind::Plain(of) }, main))
        .into_response()
}

/// Themes of the page by their names, with their texts. The first is that of the system.
pub(super) const THEMES: [(&str, Text); 4] =
    [("", Text::AsTheSystem), ("light", Text::Light), ("dark", Text::Dark), ("contrast", Text::HighContrast)];

/// Frame around every page.
struct Frame<'a> {
    language: Language,
    /// Person who has signed in.
    person: Option<&'a Person>,
    kind: Kind<'a>,
}

/// Kind of a page: which scripts and styles it needs.
#[derive(Clone, Copy)]
enum Kind<'a> {
    Plain(PageSubject),
    /// Page of the cell with maps.
    WithMaps,
    /// Page on which a recipe is written.
    Workbench,
    /// Page of the plant, which is reloaded after some seconds if it changes.
    Plant {
        again_s: Option<u32>,
        style: &'a str,
    },
}

impl Kind<'_> {
    fn subject(self) -> PageSubject {
        match self {
            Self::Plain(of) => of,
            Self::WithMaps | Self::Workbench => PageSubject::Cell,
            Self::Plant { .. } => PageSubject::Plant,
        }
    }

    /// Returns the time in milliseconds after which a browser fetches the content of a page of the plant again.
    fn refresh_ms(self) -> Option<u32> {
        match self {
            Self::Plant { again_s, .. } => again_s.map(|seconds| 1000 * seconds),
            _ => None,
        }
    }
}

/// Returns a complete web page of the plant. `main` is the content. The function adds the parts that all pages have:
/// the title `title`, the links at the top, and the person who has signed in, in the language of `reader`. The browser
/// fetches the content again every `again_s` seconds; if `again_s` is `None`, it does not. `style` is the address of an
/// additional style sheet.
pub fn plant_document(title: &str, reader: &Reader, again_s: Option<u32>, style: &str, main: Markup) -> Response {
    let kind = Kind::Plant { again_s, style };
    document(title, &Frame { language: reader.language, person: reader.session.person.as_ref(), kind }, main)
}

fn document(title: &str, frame: &Frame, main: Markup) -> Response {
    let Frame { language, person, kind } = *frame;
    let say = |text: Text| text.to(language);
    let markup = html! {
        (DOCTYPE)
        html lang=(language.tag()) {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) " · Regrind" }
                link rel="icon" href="/assets/icon.svg";
                link rel="stylesheet" href="/assets/page.css";
                @if let Kind::Plant { again_s, style } = kind {
                    link rel="stylesheet" href=(style);
                    // With scripts the content is replaced in its place: what is open stays open.
                    @if let Some(again_s) = again_s { noscript { meta http-equiv="refresh" content=(again_s); } }
                }
                script src="/assets/theme.js" {}
                script src="/assets/post.js" defer {}
                @if matches!(kind, Kind::Plain(PageSubject::Cell) | Kind::Plant { .. }) { script src="/assets/refresh.js" defer {} }
                @if matches!(kind, Kind::Workbench) {
                    link rel="stylesheet" href="/assets/workbench.css";
                    script src="/assets/codemirror.js" defer {}
                    script src="/assets/scene.js" defer {}
                    script src="/assets/workbench.js" defer {}
                }
                @if matches!(kind, Kind::WithMaps) {
                    script src="/assets/map.js" defer {}
                    script src="/assets/relief.js" defer {}
                    script src="/assets/page.js" defer {}
                }
            }
            body data-refresh-ms=[kind.refresh_ms()] {
                nav {
                    span .brand { "Regrind" }
                    @match kind.subject() {
                        PageSubject::Cell => { a href="/" { (say(Text::Cell)) } " " a href="/runs" { (say(Text::Runs)) } " " a href="/parts" { (say(Text::Parts)) } " " a href="/recipes" { (say(Text::Recipes)) } " " a href="/machines" { (say(Text::Machines)) } " " a href="/settings" { (say(Text::Settings)) } }
                        PageSubject::Plant => {
                            @for (path, name) in [("/", Text::Plant), ("/trend", Text::Trend), ("/cells", Text::Compare), ("/parts", Text::Parts)] { a href=(path) { (say(name)) } " " }
                        }
                    }
                    span .settings {
                        @if let Some(person) = person {
                            span .person { (person.name) " · " (say(texts::role(person.role))) } " "
                            button #sign-out type="button" { (say(Text::SignOut)) } " "
                        }
                        label { (say(Text::Language)) " "
                            select #language {
                                @for &each in Language::ALL {
                                    option value=(each.tag()) lang=(each.tag()) selected[each == language] { (each.name()) }
                                }
                            }
                        }
                        " "
                        label { (say(Text::Appearance)) " "
                            select #theme {
                                @for (value, text) in THEMES {
                                    option value=(value) { (say(text)) }
                                }
                            }
                        }
                    }
                }
                @if kind.refresh_ms().is_some() { p #lost role="alert" hidden { (say(Text::PlantGone)) } }
                (main)
            }
        }
    };
    ([(CONTENT_TYPE, "text/html; charset=utf-8")], markup.into_string()).into_response()
}
