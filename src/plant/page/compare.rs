//! `/cells`: comparison of the cells for one recipe: the results of their parts, and whether a difference is more than
//! chance.

use axum::Extension;
use axum::extract::{Query, RawQuery, State};
use axum::response::Response;
use maud::{Markup, html};
use regrind_figures::statistics::quantile;
use regrind_page::Session;

use super::super::ToSql;
use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::content::{PageContent, page};
use super::page_error::PageError;
use super::rank::{ENOUGH, holm, rank_sum};
use super::selection::{NEWEST_FIRST, Selection, SelectionQuery, mark};
use super::shared::Shared;
use super::words::{encoded, interval, share, shown, um};

/// Maximum number of cells compared at once, and of parts of each cell (the newest).
const CELLS: usize = 40;
const PARTS: i64 = 200;
/// Significance level: a smaller probability is reported as more than chance.
const CHANCE: f64 = 0.05;

/// Parts of a cell.
#[derive(Default)]
struct Cell {
    name: String,
    /// PV of the parts, in µm, in ascending order.
    pv_um: Vec<f64>,
    cycles: Vec<i32>,
    ended: i64,
    accepted: i64,
    at_once: i64,
}

pub(super) async fn cells(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Query(asked): Query<SelectionQuery>,
    RawQuery(query): RawQuery,
) -> Response {
    let after = query.as_deref().unwrap_or_default().split('&').find_map(|pair| pair.strip_prefix("after="));
    page(&session, made(&plant, &asked, after.and_then(|after| after.parse().ok()).unwrap_or(0))).await
}

async fn made(plant: &Shared, asked: &SelectionQuery, after: usize) -> Result<PageContent, PageError> {
    let link = plant.lease().await?;
    let selection = Selection::from_query(&link, asked).await?;
    let form = selection.form(&link, "/cells", &["recipe", "grinder", "cmm", "wheel", "probe"]).await?;
    let mut cells = read(&link, &selection, after).await?;
    let more = cells.len() > CELLS;
    cells.truncate(CELLS);
    cells.retain(|cell| cell.ended > 0 || !cell.pv_um.is_empty());
    let chances = chances(&cells);
    let main = html! {
        main .list .plant {
            h1 { "Cells compared " (mark(selection.simulated)) }
            (form)
            p .quiet { (selection.words()) ", of each cell the newest " (PARTS) " at most." }
            @if selection.recipe().is_empty() {
                p .no { "Parts of several recipes are compared: a difference between cells can come from their recipes. Choose a recipe." }
            }
            @if cells.is_empty() { p { "No cell has made such a part." } } @else { div .wide { (table(&cells, &chances, &selection)) } }
            @if more { p { a href=(format!("/cells?{}&after={}", selection.query(), after + CELLS)) { "Further cells" } } }
            p .quiet {
                "The last column compares the PV of a cell with those of all other cells that are shown: rank-sum test of Mann and Whitney (two-sided, at \
                 least " (ENOUGH) " parts in each group), p-value corrected for the number of cells (Holm-Bonferroni). A p-value below "
                (format!("{:.0} %", 100.0 * CHANCE)) " is reported as more than chance. The test assumes independent parts: a drift within a cell looks like a \
                 difference too. The box shows the middle half of the values, its line the median; the whiskers reach from the minimum to the maximum."
            }
        }
    };
    Ok(PageContent { title: "Cells".into(), again_s: None, main })
}

/// Reads the newest runs that ended, or whose part was given up, and that match `selection`, at most `PARTS` runs for each cell. The cells are sorted by
/// name. The first `after` cells are skipped. Retired cells are not included. Returns at most `CELLS` + 1 cells. A page
/// shows only `CELLS` cells; if there is one more, the caller knows that a next page exists. The PV values of each cell
/// are sorted in ascending order.
async fn read(link: &DatabaseLink, selection: &Selection, after: usize) -> Result<Vec<Cell>, PlantError> {
    let (condition, values) = selection.condition_within_cell();
    let n = values.len();
    // Reads one cell at a time, each from the end of its own index.
    let text = format!(
        "SELECT c.name, p.pv_um, p.cycles, p.result, p.given_up FROM (SELECT id, name FROM cell WHERE retired_at IS NULL ORDER BY name LIMIT ${} OFFSET ${}) c
            LEFT JOIN LATERAL (SELECT pv_um, cycles, result, given_up FROM part_run WHERE cell_id = c.id AND (ended IS NOT NULL OR given_up) AND {condition}
                ORDER BY {NEWEST_FIRST} LIMIT {PARTS}) p ON true ORDER BY c.name",
        n + 1,
        n + 2
    );
    let (most, after) = (CELLS as i64 + 1, after as i64);
    let mut given: Vec<&(dyn ToSql + Sync)> = values.iter().map(|value| value as &(dyn ToSql + Sync)).collect();
    given.extend([&most as &(dyn ToSql + Sync), &after]);
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
        cell.cycles.extend(cycles.filter(|_| is_finished));
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

fn table(cells: &[Cell], chances: &[Option<f64>], selection: &Selection) -> Markup {
    let all = || cells.iter().flat_map(|cell| cell.pv_um.iter().copied());
    let scale = [all().fold(f64::INFINITY, f64::min), all().fold(0.0, f64::max)];
    let mean = |cycles: &[i32]| cycles.iter().map(|n| f64::from(*n)).sum::<f64>() / cycles.len() as f64;
    html! {
        table .compared {
            tr {
                th { "Cell" } th .n { "n" } th .n { "median PV, µm" } th { "PV, " (um(Some(scale[0]), 2)) " to " (um(Some(scale[1]), 2)) " µm" } th .n { "yield" } th .n { "first pass" }
                th .n { "95 %" } th .n { "cycles a part" } th { "differs from the others" }
            }
            @for (cell, chance) in cells.iter().zip(chances) {
                tr data-cell=(cell.name) {
                    td { a href=(format!("/trend?{}&cell={}", selection.query(), encoded(&cell.name))) { (shown(&cell.name)) } }
                    td .n { (cell.ended) } td .n { strong { (um(quantile(&cell.pv_um, 0.5), 3)) } }
                    td .box { (drawn(&cell.pv_um, scale)) }
                    td .n { (share(cell.accepted, cell.ended)) } td .n { (share(cell.at_once, cell.ended)) } td .n .quiet { (interval(cell.at_once, cell.ended)) }
                    td .n { @if cell.cycles.is_empty() { "–" } @else { (format!("{:.2}", mean(&cell.cycles))) } }
                    td { (significance(*chance)) }
                }
            }
        }
    }
}

fn significance(chance: Option<f64>) -> Markup {
    html! {
        @match chance {
            None => { span .quiet { "too few parts" } }
            Some(chance) if chance < CHANCE => { strong { "more than chance" } " (" (probability(chance)) ")" }
            Some(chance) => { "no more than chance (" (probability(chance)) ")" }
        }
    }
}

fn probability(p: f64) -> String {
    if p < 0.0001 { "p < 0.0001".to_owned() } else { format!("p = {p:.4}") }
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
