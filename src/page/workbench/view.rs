//! HTML of the workbench: the list of recipes, and the page on which one is written.

use std::collections::HashMap;
use std::sync::Arc;

use axum::Extension;
use axum::extract::{Path, Query, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Redirect, Response};
use maud::{Markup, PreEscaped, html};
use regrind_formats::{FormatError, RecipeFolder, RecipeVersion};
use regrind_language::Language;
use regrind_report::RunSummary;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::task::spawn_blocking;

use super::super::guard::Session;
use super::super::pieces::{in_path, when};
use super::super::reader::language;
use super::super::shared::Shared;
use super::super::subject::PageSubject;
use super::super::texts::{self, Text};
use super::super::view::{harmless, not_here, plain_document, workbench_document};
use super::saving;
use super::state::Workbench;
use super::texts::WorkbenchText;

/// Recipe in the list.
struct ListedRecipe {
    name: String,
    last_version: Option<RecipeVersion>,
    last_run: Option<Arc<RunSummary>>,
}

/// Serves the list of the recipes.
pub(crate) async fn list(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let language = language(&headers);
    let workbench = match available(&page, &session, language) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    let mut last_runs = last_runs(&page).await;
    let listed = saving::with_recipes(workbench.recipes.clone(), move |recipes| {
        let recipe = |name: String| {
            let last_version = recipes.versions(&name)?.pop();
            let last_run = last_runs.remove(stem(&name));
            Ok(ListedRecipe { name, last_version, last_run })
        };
        recipes.names()?.into_iter().map(recipe).collect::<Result<Vec<_>, FormatError>>()
    });
    let main = match listed.await {
        Ok(listed) => recipe_list(workbench, &listed, language),
        Err((status, reason)) => return failed(status, &reason, &session, language),
    };
    plain_document(Text::Recipes.to(language), &session, language, main)
}

/// Name of a recipe that a person has typed.
#[derive(Deserialize)]
pub(crate) struct TypedName {
    name: String,
}

/// Leads to the page of the recipe with the typed name, which need not exist. The extension can be left out.
pub(crate) async fn open(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Query(TypedName { name }): Query<TypedName>,
    headers: HeaderMap,
) -> Response {
    let workbench = match available(&page, &session, language(&headers)) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    let name = name.trim();
    let name = if name.ends_with(".toml") { name.to_owned() } else { format!("{name}.toml") };
    match workbench.recipes.file(&name) {
        Some(_) => Redirect::to(&format!("/recipes/{}", in_path(&name))).into_response(),
        None => {
            let reason = FormatError::RecipeName { name }.to_string();
            failed(StatusCode::BAD_REQUEST, &reason, &session, language(&headers))
        }
    }
}

/// Returns the page that tells why a recipe is not shown.
fn failed(status: StatusCode, reason: &str, session: &Session, language: Language) -> Response {
    let title = Text::Recipes.to(language);
    let main = html! { main .list { h1 { (title) } p .warns { (reason) } p { a href="/recipes" { (title) } } } };
    (status, plain_document(title, session, language, main)).into_response()
}

/// Returns the workbench if the person of `session` may use it.
///
/// # Errors
/// Returns the page that says why not.
fn available<'p>(page: &'p Shared, session: &Session, language: Language) -> Result<&'p Workbench, Box<Response>> {
    let reason = match &page.workbench {
        Some(workbench) if session.is_engineer() => return Ok(workbench),
        Some(_) => WorkbenchText::OnlyEngineer,
        None => WorkbenchText::NoFolder,
    };
    let title = Text::Recipes.to(language);
    let main = html! { main .list { h1 { (title) } p { (reason.to(language)) } } };
    Err(Box::new(plain_document(title, session, language, main)))
}

fn recipe_list(workbench: &Workbench, listed: &[ListedRecipe], language: Language) -> Markup {
    let say = |text: WorkbenchText| text.to(language);
    html! {
        main .list {
            h1 { (Text::Recipes.to(language)) }
            p .quiet { (workbench.recipes.path().display()) }
            form #new-recipe .filter method="get" action="/recipes/open" {
                label { (say(WorkbenchText::NameOfRecipe)) " " input name="name" required maxlength="95" placeholder="mirror" autocomplete="off"; }
                button { (say(WorkbenchText::NewRecipe)) }
            }
            @if listed.is_empty() { p { (say(WorkbenchText::NoRecipes)) } } @else {
                div .wide {
                    table {
                        tr {
                            th { (Text::Recipe.to(language)) } th .n { (say(WorkbenchText::Version)) }
                            th { (say(WorkbenchText::SavedBy)) } th { (say(WorkbenchText::LastRun)) }
                        }
                        @for ListedRecipe { name, last_version, last_run } in listed {
                            tr {
                                td { a href=(format!("/recipes/{}", in_path(name))) { (name) } }
                                td .n { @if let Some(last) = last_version { (last.version) } }
                                td { @if let Some(last) = last_version.as_ref().filter(|last| !last.saved_at.is_empty()) { (when(&last.saved_at)) " " (last.saved_by) } }
                                td { @if let Some(run) = last_run { (last_run_words(run, language)) } }
                            }
                        }
                    }
                }
            }
        }
    }
}

fn last_run_words(run: &RunSummary, language: Language) -> Markup {
    let result = texts::result(run.result).to(language);
    html! {
        a href=(format!("/runs/{}", in_path(&run.run))) { (result) }
        @if run.simulation { " " span .simulation { "SIMULATION" } }
        " " span .quiet { (WorkbenchText::InCycles.to(language)) " " (run.cycles.len()) " · " (when(&run.began)) }
    }
}

/// Returns the newest run of each recipe, by the name of the recipe without extension.
async fn last_runs(page: &Shared) -> HashMap<String, Arc<RunSummary>> {
    let history = Arc::clone(&page.history);
    let listed = spawn_blocking(move || history.list()).await.unwrap_or_default();
    let mut newest: HashMap<String, Arc<RunSummary>> = HashMap::new();
    for run in listed {
        let recipe = stem(&run.summary.recipe).to_owned();
        let is_newer = newest.get(&recipe).is_none_or(|known| known.began < run.summary.began);
        if is_newer {
            newest.insert(recipe, run.summary);
        }
    }
    newest
}

/// Returns the name of a recipe without its folder and its extension.
fn stem(name: &str) -> &str {
    let name = name.rsplit(['/', '\\']).next().unwrap_or_default();
    name.strip_suffix(".toml").unwrap_or(name)
}

/// Serves the page on which the recipe named `name` is written. A recipe that does not exist begins with a skeleton.
pub(crate) async fn recipe(
    State(page): State<Shared>,
    Extension(session): Extension<Session>,
    Path(name): Path<String>,
    headers: HeaderMap,
) -> Response {
    drop(page.viewers.enter());
    let language = language(&headers);
    let workbench = match available(&page, &session, language) {
        Ok(workbench) => workbench,
        Err(response) => return *response,
    };
    if workbench.recipes.file(&name).is_none() {
        return not_here(PageSubject::Cell, &headers);
    }
    let of = name.clone();
    let read = move |recipes: &RecipeFolder| Ok((recipes.text(&of)?, recipes.versions(&of)?));
    let (text, versions) = match saving::with_recipes(workbench.recipes.clone(), read).await {
        Ok(read) => read,
        Err((status, reason)) => return failed(status, &reason, &session, language),
    };
    let last_run = last_runs(&page).await.remove(stem(&name));
    let simulated = {
        let simulation = workbench.simulation();
        let own =
            simulation.as_ref().filter(|of| of.task.name == name && of.task.person_key == session.key_of_person());
        own.map(|of| json!({ "id": of.task.id, "text": of.task.text, "seed": of.task.seed }))
    };
    let data = json!({
        "name": name, "text": text, "simulated": simulated, "folder": workbench.recipes.path().display().to_string(),
        "person": session.person.as_ref().map_or("", |person| &person.name), "skeleton": workbench.programs.skeleton(), "versions": versions,
        "language": language.tag(), "texts": script_texts(language),
    });
    let main = editor(&name, &versions, last_run.as_deref(), &data, language);
    workbench_document(&name, &session, language, main)
}

fn editor(
    name: &str,
    versions: &[RecipeVersion],
    last_run: Option<&RunSummary>,
    data: &Value,
    language: Language,
) -> Markup {
    let say = |text: WorkbenchText| text.to(language);
    let of_file = |path: &str| format!("/recipes/{}/{path}", in_path(name));
    html! {
        header .recipe-head {
            div .subject {
                h1 { (name) }
                p .quiet {
                    span #version { (present_version(versions, data["text"].as_str(), language)) }
                    " " span #changed hidden { (say(WorkbenchText::IsChanged)) }
                    @if let Some(run) = last_run {
                        @if data["text"].is_null() || !versions.is_empty() { " · " }
                        (say(WorkbenchText::LastRun)) ": " (last_run_words(run, language))
                    }
                }
            }
            label .versions { (say(WorkbenchText::CompareWith)) " " select #compared { option value="" { "–" } option value="file" { (say(WorkbenchText::PresentFile)) } } }
            button #save type="button" disabled { (say(WorkbenchText::Save)) }
            button #simulate .next-action type="button" disabled { (say(WorkbenchText::Simulate)) }
        }
        p #said role="status" {}
        main .workbench {
            section .card .text aria-label=(say(WorkbenchText::Editor)) {
                div .state { button #problem-count type="button" { (say(WorkbenchText::Checks)) } }
                div #editor {}
                div #comparison hidden {
                    div .tools { button #take-text type="button" { (say(WorkbenchText::TakeText)) } button #close-comparison type="button" { (say(WorkbenchText::CloseComparison)) } }
                    div #texts {}
                }
            }
            section .card .picture {
                div .views role="group" {
                    button type="button" data-view="surface" aria-pressed="true" { (say(WorkbenchText::TargetsAndTracks)) }
                    button type="button" data-view="plain" aria-pressed="false" { (say(WorkbenchText::Surface)) }
                    button type="button" data-view="scallops" aria-pressed="false" { (say(WorkbenchText::Scallops)) }
                    button #whole type="button" { (say(WorkbenchText::WholeView)) }
                }
                div .scene {
                    canvas #solid tabindex="0" role="img" aria-label=(say(WorkbenchText::SceneHelp)) {}
                    canvas #marks aria-hidden="true" {}
                    p #no-picture .quiet { (say(WorkbenchText::NoPicture)) }
                }
                p #legend .foot {}
            }
            div .column {
                section .card {
                    h2 { (say(WorkbenchText::Plan)) }
                    div #plan { p .quiet { (say(WorkbenchText::NoPlan)) } }
                }
                section .card {
                    h2 { (say(WorkbenchText::Simulation)) }
                    div .row { label { (say(WorkbenchText::Seed)) " " input #seed type="number" min="0" max="4294967295" step="1" value="1"; } button #end-simulation type="button" hidden { (say(WorkbenchText::EndSimulation)) } }
                    p #earlier-text .warns role="status" hidden { (say(WorkbenchText::EarlierText)) }
                    div #simulation tabindex="0" role="region" aria-label=(say(WorkbenchText::Simulation)) { p .quiet { (say(WorkbenchText::NotSimulated)) } }
                    figure #last-map hidden { img alt=(say(WorkbenchText::LastMap)) data-src=(of_file("simulation/map")); figcaption { a href="" data-href=(of_file("simulation/report")) target="_blank" { (say(WorkbenchText::Report)) } } }
                }
            }
        }
        script #data type="application/json" { (PreEscaped(harmless(data))) }
    }
}

/// Returns the number of the version that the file has, in words.
fn present_version(versions: &[RecipeVersion], text: Option<&str>, language: Language) -> String {
    let say = |text: WorkbenchText| text.to(language);
    match (versions.last(), text) {
        (_, None) => say(WorkbenchText::NotSaved).to_owned(),
        (None, Some(_)) => String::new(),
        (Some(last), Some(text)) if last.is_text(text) => format!("{} {}", say(WorkbenchText::Version), last.version),
        (Some(_), Some(_)) => say(WorkbenchText::OtherProgram).to_owned(),
    }
}

/// Texts that the scripts show, by the names that they use.
const SCRIPT_TEXTS: &[(&str, WorkbenchText)] = &[
    ("version", WorkbenchText::Version),
    ("saved", WorkbenchText::Saved),
    ("otherProgram", WorkbenchText::OtherProgram),
    ("editor", WorkbenchText::EditorHelp),
    ("noProblem", WorkbenchText::NoProblem),
    ("problems", WorkbenchText::ProblemCount),
    ("checks", WorkbenchText::Checks),
    ("draftKept", WorkbenchText::DraftKept),
    ("discardDraft", WorkbenchText::DiscardDraft),
    ("targets", WorkbenchText::Targets),
    ("tracks", WorkbenchText::Tracks),
    ("everyNth", WorkbenchText::EveryNth),
    ("heightsTimes", WorkbenchText::HeightsTimes),
    ("scallops", WorkbenchText::ScallopHeight),
    ("noPlan", WorkbenchText::NoPlan),
    ("noAnswer", WorkbenchText::NoAnswer),
    ("measuring", WorkbenchText::Measuring),
    ("touches", WorkbenchText::TouchCount),
    ("atLeastMinutes", WorkbenchText::AtLeastMinutes),
    ("pass", WorkbenchText::Pass),
    ("trackCount", WorkbenchText::TrackCount),
    ("minutes", WorkbenchText::Minutes),
    ("allPasses", WorkbenchText::AllPasses),
    ("atMostCycles", WorkbenchText::AtMostCycles),
    ("ofLimit", WorkbenchText::OfLimit),
    ("wheelLoss", WorkbenchText::WheelLoss),
    ("removed", WorkbenchText::Removed),
    ("budget", WorkbenchText::Budget),
    ("weak", WorkbenchText::Weak),
    ("weakRemedy", WorkbenchText::WeakRemedy),
    ("warning", WorkbenchText::Warning),
    ("simulates", WorkbenchText::Simulates),
    ("earlierText", WorkbenchText::EarlierText),
    ("badSeed", WorkbenchText::BadSeed),
    ("signedOut", WorkbenchText::SignedOut),
    ("pageGone", WorkbenchText::PageGone),
    ("draftOfOldFile", WorkbenchText::DraftOfOldFile),
    ("hasProblems", WorkbenchText::HasProblems),
    ("damaged", WorkbenchText::Damaged),
    ("noDifference", WorkbenchText::NoDifference),
    ("unchangedLines", WorkbenchText::UnchangedLines),
    ("before", WorkbenchText::Before),
    ("after", WorkbenchText::After),
];

/// Returns, as JSON, the texts in `language` that the scripts show.
fn script_texts(language: Language) -> Value {
    SCRIPT_TEXTS.iter().map(|(name, text)| ((*name).to_owned(), Value::from(text.to(language)))).collect()
}
