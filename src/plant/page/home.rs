//! `/`: overview of all cells, the parts of the last days, the queue, and the incidents.

use std::cmp::Reverse;
use std::collections::HashMap;

use axum::extract::{Query, State};
use axum::response::Response;
use jiff::ToSpan;
use maud::{Markup, html};
use regrind_language::{Language, filled};
use regrind_page::Reader;
use serde::Deserialize;

use super::super::Row;
use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::bars::{Count, Day, bars};
use super::board::{board, is_all_simulated, needs_person};
use super::cells;
use super::content::{PageContent, page};
use super::cycle_counts::{COUNTED, CycleCounts, CyclesOfParts};
use super::natural::natural_order;
use super::page_error::PageError;
use super::selection::{is_simulated, mark, today};
use super::shared::Shared;
use super::texts::Text;
use super::words::{clamped, encoded, interval, name, share, shown, when};

/// Number of days over which parts are counted.
const DAYS: i64 = 14;
/// Maximum number of rows of the queue, of the incidents, of a table that is shown whole, of the beginning of a longer one,
/// and of a table whose rows have a distribution.
const QUEUED: i64 = 40;
const INCIDENTS: i64 = 15;
const OPEN: usize = 12;
const FIRST: usize = 6;
const WITH_BARS: usize = 60;
/// Seconds until the browser fetches the page again.
const AGAIN_S: u32 = 10;

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct HomeQuery {
    parts: String,
}

pub(super) async fn home(State(plant): State<Shared>, reader: Reader, Query(asked): Query<HomeQuery>) -> Response {
    page(&reader, made(&plant, &asked, reader.language)).await
}

async fn made(plant: &Shared, asked: &HomeQuery, language: Language) -> Result<PageContent, PageError> {
    let say = |text: Text| text.to(language);
    let link = plant.lease().await?;
    let cells = cells::read(&link).await?;
    let simulated = is_simulated(&link, &asked.parts).await?;
    let counted = Counted::read(&link, simulated).await?;
    let (queue, incidents) = (queue(&link, language).await?, incidents(&link, language).await?);
    let sections = [("parts", Text::PartsInDays), ("queue", Text::Queue), ("incidents", Text::Incidents)];
    let main = html! {
        main .list .plant .home {
            div .head {
                h1 { (say(Text::Cells)) " " (mark(is_all_simulated(&cells), language)) }
                p .tally { (cells::tally(&cells, language)) }
                p .jump { @for (id, text) in sections { a href=(format!("#{id}")) { (filled(say(text), &[("days", &DAYS)])) } " " } }
            }
            (needs_person(&cells, language))
            (board(&cells, language))
            section .card #parts {
                h2 { (filled(say(Text::PartsInDays), &[("days", &DAYS)])) " " (mark(simulated, language)) }
                (counted.render(simulated, language))
            }
            div .pair {
                section .card #queue { h2 { (say(Text::Queue)) } (queue) }
                section .card #incidents { h2 { (say(Text::Incidents)) } (incidents) }
            }
            p .quiet { (filled(say(Text::OnlyShows), &[("seconds", &AGAIN_S)])) }
        }
    };
    Ok(PageContent { title: say(Text::Plant).into(), again_s: Some(AGAIN_S), main })
}

/// Counts of the parts that ended in the last days, by day, by recipe and by cell.
#[derive(Default)]
struct Counted {
    days: Vec<Day>,
    recipes: Vec<(String, Count)>,
    cells: Vec<(String, Count)>,
    cycles: CyclesOfParts,
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
            let name = |k: usize| row.get::<_, Option<String>>(k).unwrap_or_default();
            match row.get::<_, i32>(6) {
                0b011 => by_day.push((name(0), count)),
                0b101 => counted.recipes.push((name(1), count)),
                _ => counted.cells.push((name(2), count)),
            }
        }
        for named in [&mut counted.recipes, &mut counted.cells] {
            named.sort_by(|(a, _), (b, _)| natural_order(a, b));
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
        counted.cycles = CyclesOfParts::read(link, &first.to_string(), simulated).await?;
        Ok(counted)
    }

    fn render(&self, simulated: bool, language: Language) -> Markup {
        let say = |text: Text| text.to(language);
        let other = if simulated { "real" } else { "simulated" };
        let (only, show) =
            if simulated { (Text::OnlySimulated, Text::ShowReal) } else { (Text::OnlyReal, Text::ShowSimulated) };
        let CyclesOfParts { recipes, cells, parts } = &self.cycles;
        html! {
            div .counted {
                (bars(&self.days, language))
                div {
                    (yields(Text::Recipe, "recipe", &self.recipes, recipes, language))
                    (yields(Text::Cell, "cell", &self.cells, cells, language))
                }
            }
            p .quiet {
                (say(Text::LoopIsNotFirstPass)) " "
                @if *parts >= COUNTED { (filled(say(Text::CyclesOfNewest), &[("count", &COUNTED)])) " " }
                (say(Text::FirstPassIs)) " " (say(only)) " " a href=(format!("/?parts={other}#parts")) { (say(show)) }
            }
        }
    }
}

/// Shows the yields by recipe or by cell. Of many, those with most parts are open, and all are on demand.
fn yields(
    what: Text,
    kind: &str,
    counts: &[(String, Count)],
    cycles: &HashMap<String, CycleCounts>,
    language: Language,
) -> Markup {
    if counts.is_empty() {
        return html! { p .quiet { (Text::NoPartEnded.to(language)) } };
    }
    let mut most: Vec<&(String, Count)> = counts.iter().collect();
    most.sort_by_key(|(_, count)| Reverse(count.ended));
    most.truncate(if counts.len() > OPEN { FIRST } else { OPEN });
    most.sort_by(|(a, _), (b, _)| natural_order(a, b));
    let table =
        |counts: &[&(String, Count)]| html! { div .wide { (yield_table(what, kind, counts, cycles, language)) } };
    html! {
        (table(&most))
        @if counts.len() > OPEN {
            details #(format!("by-{kind}")) {
                summary { (filled((if kind == "recipe" { Text::AllRecipes } else { Text::AllCells }).to(language), &[("count", &counts.len())])) }
                (table(&counts.iter().collect::<Vec<_>>()))
            }
        }
    }
}

fn yield_table(
    what: Text,
    kind: &str,
    counts: &[&(String, Count)],
    cycles: &HashMap<String, CycleCounts>,
    language: Language,
) -> Markup {
    let say = |text: Text| text.to(language);
    let has_bars = counts.len() <= WITH_BARS;
    let cycles_of = |name: &String| cycles.get(name).copied().unwrap_or_default();
    html! {
        table .yields data-by=(kind) {
            tr {
                th { (say(what)) } th .n { (say(Text::EndedParts)) } th .n { (say(Text::AcceptedParts)) } th .n { (say(Text::Yield)) }
                th .n { (say(Text::CyclesAPart)) } @if has_bars { th { "1 · 2 · 3 · 4 · 5+" } } th .n { (say(Text::FirstPassYield)) } th .n { "95 %" }
            }
            @for (named, Count { ended, accepted, at_once }) in counts {
                @let address = format!("/trend?{}{kind}={}", if kind == "recipe" { "" } else { "recipe=&" }, encoded(named));
                tr {
                    td { @if named.is_empty() { (say(Text::NotTold)) } @else { a .one-line href=(address) title=(shown(named)) { (shown(named)) } } }
                    td .n { (ended) } td .n { (accepted) } td .n { (share(*accepted, *ended)) }
                    td .n { strong { (cycles_of(named).mean(language)) } } @if has_bars { td { (cycles_of(named).bar(language)) } }
                    td .n { (share(*at_once, *ended)) } td .n .quiet { (interval(*at_once, *ended)) }
                }
            }
        }
    }
}

async fn queue(link: &DatabaseLink, language: Language) -> Result<Markup, PlantError> {
    let say = |text: Text| text.to(language);
    let text = "SELECT serial, recipe, version, coalesce(for_cell, ''), coalesce(to_char(due, 'YYYY-MM-DD'), ''), state, coalesce(cell, ''),
            coalesce(to_char(leased_until, 'YYYY-MM-DD HH24:MI:SS'), ''), coalesce(run, ''), due < (now() AT TIME ZONE 'UTC')::date
        FROM work_now ORDER BY due NULLS LAST, id LIMIT $1";
    let rows = link.query(text, &[&QUEUED]).await?;
    Ok(html! {
        @if rows.is_empty() { p .quiet { (say(Text::QueueIsEmpty)) } } @else {
            div .wide { table .stacked {
                tr { th { (say(Text::Part)) } th { (say(Text::Recipe)) } th { (say(Text::ForCell)) } th { (say(Text::Due)) } th { (say(Text::State)) } }
                @for row in &rows { (queued(row, language)) }
            } }
            @if rows.len() as i64 == QUEUED { p .quiet { (filled(say(Text::TheFirst), &[("count", &QUEUED)])) } }
        }
    })
}

fn queued(row: &Row, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let [serial, recipe, for_cell, due, state, cell, until, run] =
        [0, 1, 3, 4, 5, 6, 7, 8].map(|k| row.get::<_, &str>(k));
    let late = row.get::<_, Option<bool>>(9) == Some(true);
    html! {
        tr {
            td { (name(serial)) } td { (name(&format!("{recipe} v{}", row.get::<_, i32>(2)))) }
            td { @if for_cell.is_empty() { (say(Text::AnyCell)) } @else { (name(for_cell)) } }
            td { (due) @if late { " " strong { (say(Text::Late)) } } }
            td {
                @match state {
                    "begun" => { (filled(say(Text::MadeBy), &[("cell", &shown(cell))])) " " a href=(format!("/run?cell={}&name={}", encoded(cell), encoded(run))) { (name(run)) } }
                    "leased" => { (filled(say(Text::LeasedTo), &[("cell", &shown(cell))])) " " (when(until)) }
                    "open" => { (say(Text::OpenWork)) }
                    other => { (shown(other)) }
                }
            }
        }
    }
}

async fn incidents(link: &DatabaseLink, language: Language) -> Result<Markup, PlantError> {
    let say = |text: Text| text.to(language);
    let text = "SELECT to_char(at, 'YYYY-MM-DD HH24:MI:SS'), coalesce(cell, by), coalesce(run, ''), what, words, times FROM incident_told
        ORDER BY at DESC LIMIT $1";
    let rows = link.query(text, &[&INCIDENTS]).await?;
    Ok(html! {
        @if rows.is_empty() { p .quiet { (say(Text::NoIncident)) } } @else {
            ul .incidents {
                @for row in &rows {
                    @let [at, by, run, what, words] = [0, 1, 2, 3, 4].map(|k| row.get::<_, &str>(k));
                    @let times = row.get::<_, i32>(5);
                    li {
                        p .head-line {
                            strong { (name(what)) } @if times > 1 { " × " (times) } " "
                            span .quiet { (when(at)) " " (name(by)) @if !run.is_empty() { " " (name(run)) } }
                        }
                        div { (clamped(words)) }
                    }
                }
            }
        }
    })
}
