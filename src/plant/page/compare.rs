//! `/cells`: comparison of the cells for one recipe: the results of their parts, and whether a difference is more than
//! chance.

use axum::extract::{Query, RawQuery, State};
use axum::response::Response;
use maud::{Markup, html};
use regrind_figures::statistics::quantile;
use regrind_language::{Language, decimal, filled};
use regrind_page::Reader;

use super::super::ToSql;
use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::content::{PageContent, page};
use super::cycle_counts::CycleCounts;
use super::natural::natural_order;
use super::page_error::PageError;
use super::rank::{ENOUGH, holm, rank_sum};
use super::selection::{NEWEST_FIRST, Selection, SelectionQuery, mark};
use super::shared::Shared;
use super::texts::Text;
use super::words::{encoded, interval, name, share, um};

/// Maximum number of cells compared at once, and of parts of each cell (the newest).
const CELLS: usize = 40;
const PARTS: i64 = 200;
/// Maximum number of cells of a plant.
const MAX_CELLS: i64 = 5000;
/// Significance level: a smaller probability is reported as more than chance.
const CHANCE: f64 = 0.05;

/// Parts of a cell.
#[derive(Default)]
struct Cell {
    name: String,
    /// PV of the parts, in µm, in ascending order.
    pv_um: Vec<f64>,
    /// Cycles of the accepted parts.
    cycles: CycleCounts,
    ended: i64,
    accepted: i64,
    at_once: i64,
}

pub(super) async fn cells(
    State(plant): State<Shared>,
    reader: Reader,
    Query(asked): Query<SelectionQuery>,
    RawQuery(query): RawQuery,
) -> Response {
    let after = query.as_deref().unwrap_or_default().split('&').find_map(|pair| pair.strip_prefix("after="));
    let after = after.and_then(|after| after.parse().ok()).unwrap_or(0);
    page(&reader, made(&plant, &asked, after, reader.language)).await
}

async fn made(
    plant: &Shared,
    asked: &SelectionQuery,
    after: usize,
    language: Language,
) -> Result<PageContent, PageError> {
    let say = |text: Text| text.to(language);
    let link = plant.lease().await?;
    let selection = Selection::from_query(&link, asked).await?;
    let form = selection.form(&link, "/cells", &["recipe", "grinder", "cmm", "wheel", "probe"], language).await?;
    let mut cells = read(&link, &selection, after).await?;
    let more = cells.len() > CELLS;
    cells.truncate(CELLS);
    cells.retain(|cell| cell.ended > 0 || !cell.pv_um.is_empty());
    let chances = chances(&cells);
    let main = html! {
        main .list .plant {
            h1 { (say(Text::CellsCompared)) " " (mark(selection.simulated, language)) }
            (form)
            p .quiet { (filled(say(Text::OfEachCellNewest), &[("selection", &selection.words(language)), ("count", &PARTS)])) }
            @if selection.recipe().is_empty() {
                p .warns { (say(Text::RecipesCompared)) }
            }
            @if cells.is_empty() { p { (say(Text::NoCellMadeSuch)) } } @else { div .wide { (table(&cells, &chances, &selection, language)) } }
            @if more { p { a href=(format!("/cells?{}&after={}", selection.query(), after + CELLS)) { (say(Text::FurtherCells)) } } }
            p .quiet { (filled(say(Text::TestOfCells), &[("parts", &ENOUGH), ("chance", &format!("{:.0} %", 100.0 * CHANCE))])) }
        }
    };
    Ok(PageContent { title: say(Text::CellsCompared).into(), again_s: None, main })
}

/// Reads the newest runs that ended, or whose part was given up, and that match `selection`, at most `PARTS` runs for each cell. The cells are in the
/// natural order of their names. The first `after` cells are skipped. Retired cells are not included. Returns at most `CELLS` + 1 cells. A page
/// shows only `CELLS` cells; if there is one more, the caller knows that a next page exists. The PV values of each cell
/// are sorted in ascending order.
async fn read(link: &DatabaseLink, selection: &Selection, after: usize) -> Result<Vec<Cell>, PlantError> {
    let rows =
        link.query("SELECT id, name FROM cell WHERE retired_at IS NULL ORDER BY name LIMIT $1", &[&MAX_CELLS]).await?;
    let mut named: Vec<(i32, String)> = rows.iter().map(|row| (row.get(0), row.get(1))).collect();
    named.sort_by(|(_, a), (_, b)| natural_order(a, b));
    let (condition, values) = selection.condition_within_cell();
    let n = values.len();
    // Reads one cell at a time, each from the end of its own index.
    let text = format!(
        "SELECT c.name, p.pv_um, p.cycles, p.result, p.given_up FROM unnest(${}::integer[], ${}::text[]) WITH ORDINALITY AS c (id, name, place)
            LEFT JOIN LATERAL (SELECT pv_um, cycles, result, given_up FROM part_run WHERE cell_id = c.id AND (ended IS NOT NULL OR given_up) AND {condition}
                ORDER BY {NEWEST_FIRST} LIMIT {PARTS}) p ON true ORDER BY c.place",
        n + 1,
        n + 2
    );
    let (ids, names): (Vec<i32>, Vec<String>) = named.into_iter().skip(after).take(CELLS + 1).unzip();
    let mut given: Vec<&(dyn ToSql + Sync)> = values.iter().map(|value| value as &(dyn ToSql + Sync)).collect();
    given.extend([&ids as &(dyn ToSql + Sync), &names]);
    let mut cells: Vec<Cell> = Vec::new();
    for row in link.query(&text, &given).await? {
        let name: String = row.get(0);
        if cells.last().is_none_or(|last| last.name != name) {
            cells.push(Cell { name, ..Cell::default() });
        }
        let Some(cell) = cells.last_mut() else { continue };
        let (cycles, result): (Option<i32>, Option<&str>) = (row.get(2), row.get(3));
        let given_up = row.get::<_, Option<bool>>(4) == Some(true);
        let result = result.unwrap_or("open");
        if result == "open" && !given_up {
            continue;
        }
        cell.ended += 1;
        // The figures of an unfinished part say nothing of the cell.
        let is_finished = matches!(result, "accepted" | "not accepted");
        cell.accepted += i64::from(result == "accepted");
        cell.at_once += i64::from(result == "accepted" && cycles == Some(1));
        cell.cycles.add(i64::from(cycles.unwrap_or_default()), i64::from(result == "accepted"));
        cell.pv_um.extend(row.get::<_, Option<f64>>(1).filter(|um| is_finished && um.is_finite()));
    }
    for cell in &mut cells {
        cell.pv_um.sort_by(f64::total_cmp);
    }
    Ok(cells)
}

/// Returns a p-value for each cell, in the order of `cells`. The p-value compares the PV values of the cell with those
/// of all other cells. It is the probability of a difference at least as large as the observed one, if all cells are
/// equal. The p-values come from the [`rank_sum`] test and are corrected by [`holm`] for the number of cells. The value
/// is `None` for a cell with too few parts.
fn chances(cells: &[Cell]) -> Vec<Option<f64>> {
    let others = |k: usize| -> Vec<f64> {
        cells
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != k)
            .flat_map(|(_, cell)| cell.pv_um.iter().copied())
            .collect()
    };
    let found: Vec<_> = (0..cells.len()).map(|k| rank_sum(&cells[k].pv_um, &others(k))).collect();
    holm(&found)
}

fn table(cells: &[Cell], chances: &[Option<f64>], selection: &Selection, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    let all = || cells.iter().flat_map(|cell| cell.pv_um.iter().copied());
    let scale = [all().fold(f64::INFINITY, f64::min), all().fold(0.0, f64::max)];
    let [from, to] = scale.map(|end| um(Some(end), 2, language));
    html! {
        table .compared {
            tr {
                th { (say(Text::Cell)) } th .n { "n" } th .n { (say(Text::MedianPv)) } th { (filled(say(Text::PvFromTo), &[("from", &from), ("to", &to)])) }
                th .n { (say(Text::Yield)) } th .n { (say(Text::CyclesAPart)) } th { "1 · 2 · 3 · 4 · 5+" } th .n { (say(Text::FirstPassYield)) } th .n { "95 %" } th { (say(Text::DiffersFromOthers)) }
            }
            @for (cell, chance) in cells.iter().zip(chances) {
                tr data-cell=(cell.name) {
                    td { a href=(format!("/trend?{}&cell={}", selection.query(), encoded(&cell.name))) { (name(&cell.name)) } }
                    td .n { (cell.ended) } td .n { strong { (um(quantile(&cell.pv_um, 0.5), 3, language)) } }
                    td .box { (drawn(&cell.pv_um, scale)) }
                    td .n { (share(cell.accepted, cell.ended)) } td .n { strong { (cell.cycles.mean(language)) } } td { (cell.cycles.bar(language)) }
                    td .n { (share(cell.at_once, cell.ended)) } td .n .quiet { (interval(cell.at_once, cell.ended)) }
                    td { (significance(*chance, language)) }
                }
            }
        }
    }
}

fn significance(chance: Option<f64>, language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        @match chance {
            None => { span .quiet { (say(Text::TooFewParts)) } }
            Some(chance) if chance < CHANCE => { strong { (say(Text::MoreThanChance)) } " (" (probability(chance, language)) ")" }
            Some(chance) => { (say(Text::NoMoreThanChance)) " (" (probability(chance, language)) ")" }
        }
    }
}

fn probability(p: f64, language: Language) -> String {
    if p < 0.0001 {
        format!("p < {}", decimal(0.0001, 4, language))
    } else {
        format!("p = {}", decimal(p, 4, language))
    }
}

/// Draws a box plot of `sorted` as SVG. `sorted` contains values in micrometres, in ascending order. The box extends
/// from the first to the third quartile, and the whiskers extend from the minimum to the maximum. The axis goes from
/// `from` to `to` in micrometres; it is the same for all cells. Returns empty HTML if there are no values.
fn drawn(sorted: &[f64], [from, to]: [f64; 2]) -> Markup {
    let [Some(least), Some(low), Some(median), Some(high), Some(largest)] =
        [0.0, 0.25, 0.5, 0.75, 1.0].map(|share| quantile(sorted, share))
    else {
        return Markup::default();
    };
    let per_um = 232.0 / (to - from).max(1e-9);
    let x = |value: f64| format!("{:.1}", 4.0 + per_um * (value - from));
    let width = |from: f64, to: f64| format!("{:.1}", (per_um * (to - from)).max(1.0));
    html! {
        svg viewBox="0 0 240 22" role="img" aria-label=(format!("{least:.2}, {low:.2}, {median:.2}, {high:.2}, {largest:.2} µm")) {
            line .whisker x1=(x(least)) x2=(x(largest)) y1="11" y2="11" {}
            rect .middle x=(x(low)) width=(width(low, high)) y="4" height="14" {}
            line .median x1=(x(median)) x2=(x(median)) y1="2" y2="20" {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chances_flag_worse_cell() {
        let cell = |shift: f64| Cell {
            pv_um: (0..30).map(|k| 3.0 + shift + 0.05 * f64::from(k)).collect(),
            ..Cell::default()
        };
        let told = chances(&[cell(0.0), cell(0.01), cell(1.5), cell(0.02)]);
        assert!(told[2].unwrap() < 1e-4 && told[1].unwrap() > 0.01, "{told:?}");
    }
}
