//! `/`: overview of all cells, the parts of the last days, the queue, and the incidents.

use axum::Extension;
use axum::extract::{Query, State};
use axum::response::Response;
use jiff::ToSpan;
use maud::{Markup, html};
use regrind_page::Session;
use serde::Deserialize;

use super::super::Row;
use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::bars::{Count, Day, bars};
use super::cells;
use super::content::{PageContent, page};
use super::page_error::PageError;
use super::selection::{is_simulated, mark, today};
use super::shared::Shared;
use super::words::{encoded, interval, share, shown};

/// Number of days over which parts are counted.
const DAYS: i64 = 14;
/// Maximum number of rows of the queue, of the incidents, and of a table that is open at first.
const QUEUED: i64 = 40;
const INCIDENTS: i64 = 15;
const OPEN: usize = 12;
/// Seconds until the browser reloads the page.
const AGAIN_S: u32 = 10;

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct HomeQuery {
    parts: String,
}

pub(super) async fn home(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Query(asked): Query<HomeQuery>,
) -> Response {
    page(&session, made(&plant, &asked)).await
}

async fn made(plant: &Shared, asked: &HomeQuery) -> Result<PageContent, PageError> {
    let link = plant.lease().await?;
    let cells = cells::read(&link).await?;
    let simulated = is_simulated(&link, &asked.parts).await?;
    let counted = Counted::read(&link, simulated).await?;
    let (queue, incidents) = (queue(&link).await?, incidents(&link).await?);
    let main = html! {
        main .list .plant {
            h1 { "Cells" }
            p .tally { (cells::tally(&cells)) }
            (cells::cards(&cells))
            h2 { "Parts in " (DAYS) " days " (mark(simulated)) }
            (counted.render(simulated))
            h2 #queue { "Queue" }
            (queue)
            h2 #incidents { "Incidents" }
            (incidents)
            p .quiet { "This page only shows the cells; it gives no orders. The browser reloads it every " (AGAIN_S) " s. Days are those of UTC." }
        }
    };
    Ok(PageContent { title: "Plant".into(), again_s: Some(AGAIN_S), main })
}

/// Counts of the parts that ended in the last days, by day, by recipe and by cell.
#[derive(Default)]
struct Counted {
    days: Vec<Day>,
    recipes: Vec<(String, Count)>,
    cells: Vec<(String, Count)>,
}

impl Counted {
    async fn read(link: &DatabaseLink, simulated: bool) -> Result<Self, PlantError> {
        let first = today().checked_sub((DAYS - 1).days()).unwrap_or_default();
        // One query for all three: `grouping` shows whether a row is a sum by day, by recipe or by cell; the other
        // columns are null in it.
        let text = "SELECT to_char(day, 'YYYY-MM-DD'), recipe, cell, sum(ended)::bigint, sum(accepted)::bigint, sum(accepted_at_once)::bigint,
                grouping(day, recipe, cell)
            FROM parts_by_day WHERE day >= $1::text::date AND simulation = $2
            GROUP BY GROUPING SETS ((day), (recipe), (cell)) ORDER BY 7, 1, 2, 3";
        let mut counted = Self::default();
        let mut by_day = Vec::new();
        for row in link.query(text, &[&first.to_string(), &simulated]).await? {
            let count = Count { ended: row.get(3), accepted: row.get(4), at_once: row.get(5) };
            let name = |k: usize| row.get::<_, Option<String>>(k).unwrap_or_else(|| "not told".into());
            match row.get::<_, i32>(6) {
                0b011 => by_day.push((name(0), count)),
                0b101 => counted.recipes.push((name(1), count)),
                _ => counted.cells.push((name(2), count)),
            }
        }
        // Days on which no part ended are included too.
        counted.days = (0..DAYS)
            .filter_map(|k| first.checked_add(k.days()).ok())
            .map(|day| {
                let found = by_day.iter().find(|(name, _)| *name == day.to_string());
                Day {
                    day: day.strftime("%m-%d").to_string(),
                    count: found.map_or_else(Count::default, |(_, count)| *count),
                }
            })
            .collect();
        Ok(counted)
    }

    fn render(&self, simulated: bool) -> Markup {
        let other = if simulated { "real" } else { "simulated" };
        html! {
            div .counted {
                div .wide { (bars(&self.days)) }
                div { (yields("Recipe", "recipe", &self.recipes)) (yields("Cell", "cell", &self.cells)) }
            }
            p .quiet {
                "First-pass yield: share of the ended parts that were accepted at the first measurement, with its 95 % interval (Wilson). Only "
                @if simulated { "simulated" } @else { "real" } " parts are counted: " a href=(format!("/?parts={other}")) { "show " (other) " ones" } "."
            }
        }
    }
}

fn yields(what: &str, kind: &str, counts: &[(String, Count)]) -> Markup {
    let table = html! {
        table .yields data-by=(kind) {
            tr { th { (what) } th .n { "ended" } th .n { "accepted" } th .n { "yield" } th .n { "first-pass yield" } th .n { "95 %" } }
            @for (name, Count { ended, accepted, at_once }) in counts {
                tr {
                    td { a href=(format!("/trend?{}{kind}={}", if kind == "recipe" { "" } else { "recipe=&" }, encoded(name))) { (shown(name)) } }
                    td .n { (ended) } td .n { (accepted) } td .n { (share(*accepted, *ended)) }
                    td .n { strong { (share(*at_once, *ended)) } } td .n .quiet { (interval(*at_once, *ended)) }
                }
            }
        }
    };
    html! {
        @if counts.is_empty() { p .quiet { "No part has ended." } }
        @else if counts.len() > OPEN { details { summary { "By " (kind) ": " (counts.len()) } div .wide { (table) } } }
        @else { div .wide { (table) } }
    }
}

async fn queue(link: &DatabaseLink) -> Result<Markup, PlantError> {
    let text = "SELECT serial, recipe, version, coalesce(for_cell, 'any'), coalesce(to_char(due, 'YYYY-MM-DD'), ''), state, coalesce(cell, ''),
            coalesce(to_char(leased_until, 'YYYY-MM-DD HH24:MI:SS'), ''), coalesce(run, ''), due < (now() AT TIME ZONE 'UTC')::date
        FROM work_now ORDER BY due NULLS LAST, id LIMIT $1";
    let rows = link.query(text, &[&QUEUED]).await?;
    let line = |row: &Row| {
        let [serial, recipe, for_cell, due, state, cell, until, run] =
            [0, 1, 3, 4, 5, 6, 7, 8].map(|k| row.get::<_, &str>(k));
        let late = row.get::<_, Option<bool>>(9) == Some(true);
        html! {
            tr {
                td { (shown(serial)) } td { (shown(recipe)) " v" (row.get::<_, i32>(2)) } td { (shown(for_cell)) }
                td { (due) @if late { " " strong { "late" } } }
                td {
                    @match state {
                        "begun" => { "being made by " (shown(cell)) ": " a href=(format!("/run?cell={}&name={}", encoded(cell), encoded(run))) { (shown(run)) } }
                        "leased" => { "leased to " (shown(cell)) " until " (until) }
                        other => { (other) }
                    }
                }
            }
        }
    };
    Ok(html! {
        @if rows.is_empty() { p .quiet { "The queue is empty." } } @else {
            div .wide { table {
                tr { th { "Part" } th { "Recipe" } th { "For" } th { "Due" } th { "State" } }
                @for row in &rows { (line(row)) }
            } }
            @if rows.len() as i64 == QUEUED { p .quiet { "The first " (QUEUED) "." } }
        }
    })
}

async fn incidents(link: &DatabaseLink) -> Result<Markup, PlantError> {
    let text = "SELECT to_char(at, 'YYYY-MM-DD HH24:MI:SS'), coalesce(cell, by), coalesce(run, ''), what, words FROM incident_told
        ORDER BY at DESC LIMIT $1";
    let rows = link.query(text, &[&INCIDENTS]).await?;
    Ok(html! {
        @if rows.is_empty() { p .quiet { "No incident: no broken chain, no refusal." } } @else {
            div .wide { table {
                tr { th { "When" } th { "By" } th { "Run" } th { "What" } th { "In words" } }
                @for row in &rows {
                    @let [at, by, run, what, words] = [0, 1, 2, 3, 4].map(|k| row.get::<_, &str>(k));
                    tr { td { (at) } td { (shown(by)) } td .id { (shown(run)) } td { strong { (shown(what)) } } td { (shown(words)) } }
                }
            } }
        }
    })
}
