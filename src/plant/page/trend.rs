//! `/trend`: PV and RMS of consecutive parts, with control limits and tolerance.

use axum::Extension;
use axum::extract::{Query, State};
use axum::response::Response;
use maud::{Markup, html};
use regrind_page::Session;

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::content::{PageContent, page};
use super::control_chart::{ENOUGH, Limits, Value, individuals, moving_ranges, ranges};
use super::page_error::PageError;
use super::selection::{ALL_KINDS, NEWEST_FIRST, Selection, SelectionQuery, mark};
use super::shared::Shared;
use super::words::{shown, um};

/// Maximum number of parts in a chart, and of parts in the list of those out of limits.
const MAX_PARTS: i64 = 250;
const LISTED: usize = 20;

/// Query of parts by their last measurement, up to its first condition: those that were judged for good.
const LAST_MEASURED: &str = "SELECT id, serial, cell, to_char(began, 'YYYY-MM-DD HH24:MI:SS'), pv_um, pv_u_um, pv_limit_um, rms_um, rms_u_um, rms_limit_um
    FROM part_run WHERE result IN ('accepted', 'not accepted') AND pv_um IS NOT NULL";
/// Query of parts by their first measurement. The limit makes the database read one cycle of each run that it shows,
/// and never all cycles.
const FIRST_MEASURED: &str = "SELECT id, serial, cell, to_char(began, 'YYYY-MM-DD HH24:MI:SS'), y.pv_um, y.pv_u_um, pv_limit_um, y.rms_um, y.rms_u_um, rms_limit_um
    FROM (SELECT id, serial, cell, cell_id, began, recipe, grinder, cmm, wheel, probe, simulation, pv_limit_um, rms_limit_um FROM part_run) p
        CROSS JOIN LATERAL (SELECT pv_um, pv_u_um, rms_um, rms_u_um FROM cycle WHERE run = p.id AND cycle = 1 LIMIT 1) y
    WHERE y.pv_um IS NOT NULL";

/// Part with its two figures.
pub(super) struct Part {
    pub(super) pv: Value,
    pub(super) rms: Option<Value>,
}

pub(super) async fn trend(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Query(asked): Query<SelectionQuery>,
) -> Response {
    page(&session, made(&plant, &asked)).await
}

async fn made(plant: &Shared, asked: &SelectionQuery) -> Result<PageContent, PageError> {
    let link = plant.lease().await?;
    let selection = Selection::from_query(&link, asked).await?;
    let form = selection.form(&link, "/trend", &ALL_KINDS).await?;
    let parts = parts(&link, &selection, MAX_PARTS).await?;
    let main = html! {
        main .list .plant {
            h1 { "Trend " (mark(selection.simulated)) }
            (form)
            p .quiet { (selection.words()) ": " (parts.len()) @if parts.len() == 1 { " part" } @else { " parts" } @if parts.len() as i64 == MAX_PARTS { ", the newest" } "." }
            @if selection.recipe().is_empty() {
                p .no { "Parts of several recipes are in one chart, so its control limits have no meaning. Choose a recipe." }
            }
            (charts(&parts))
            p {
                a href=(format!("/export.csv?{}", selection.query())) { "CSV" } " · "
                a href=(format!("/trend.dfq?{}", selection.query())) { "DFQ (Q-DAS)" }
            }
        }
    };
    Ok(PageContent { title: "Trend".into(), again_s: None, main })
}

/// Reads the `most` newest parts of a selection, by the start of their run. Returns the parts from the oldest to the
/// newest. Omits a part without a finite PV. Where the last measurement is asked for, a part counts only if it was judged
/// for good: the figures of a run that is under way, was stopped or broke off are those of an unfinished part.
pub(super) async fn parts(link: &DatabaseLink, selection: &Selection, most: i64) -> Result<Vec<Part>, PlantError> {
    let (condition, values) = selection.condition();
    let text = if selection.first { FIRST_MEASURED } else { LAST_MEASURED };
    let text = format!("{text} AND {condition} ORDER BY {NEWEST_FIRST} LIMIT {most}");
    let values: Vec<_> = values.iter().map(|value| value as &(dyn super::super::ToSql + Sync)).collect();
    let rows = link.query(&text, &values).await?;
    let part = |row: &super::super::Row| {
        let value = |um: f64, k: usize| Value {
            run: row.get(0),
            serial: row.get(1),
            cell: row.get(2),
            when: row.get(3),
            um,
            u_um: row.get(k),
            limit_um: row.get(k + 1),
        };
        let finite = |k: usize| row.get::<_, Option<f64>>(k).filter(|um| um.is_finite());
        Some(Part { pv: value(finite(4)?, 5), rms: finite(7).map(|um| value(um, 8)) })
    };
    Ok(rows.iter().rev().filter_map(part).collect())
}

fn charts(parts: &[Part]) -> Markup {
    let pv: Vec<Value> = parts.iter().map(|part| part.pv.clone()).collect();
    let rms: Vec<Value> = parts.iter().filter_map(|part| part.rms.clone()).collect();
    html! {
        @if pv.len() < 2 { p { "There are too few parts for a chart: at least two are needed." } }
        @else if pv.len() < ENOUGH {
            p .no { "Limits of " (pv.len()) " parts are preliminary: below " (ENOUGH) " they change much with each further part." }
        }
        (figure("PV", "pv", &pv))
        (figure("RMS", "rms", &rms))
        p .quiet {
            "Limits: mean ± 2.660 times the mean moving range; limit of the range: 3.267 times its mean; from all parts of the chart. A triangle marks a point outside the limits. \
             There is no lower limit if it would be below 0. The dotted line is the tolerance of the recipe; it has no effect on the limits."
        }
    }
}

fn figure(name: &str, class: &str, values: &[Value]) -> Markup {
    let all: Vec<f64> = values.iter().map(|value| value.um).collect();
    let Some(limits) = Limits::from_values(&all) else { return Markup::default() };
    let out: Vec<&Value> = values.iter().rev().filter(|value| limits.is_out(value.um)).collect();
    let ranges_out: Vec<&Value> = ranges(&all)
        .iter()
        .zip(&values[1..])
        .rev()
        .filter(|(range, _)| **range > limits.range_upper)
        .map(|(_, value)| value)
        .collect();
    let over = values.iter().filter(|value| value.limit_um.is_some_and(|limit| value.um > limit)).count();
    html! {
        section data-figure=(name) {
            h2 { (name) }
            p .limits {
                "mean " strong { (um(Some(limits.mean), 3)) } " µm, limits "
                strong { (limits.lower.map_or("none".to_owned(), |lower| um(Some(lower), 3))) } " and " strong { (um(Some(limits.upper), 3)) }
                " µm; mean range " (um(Some(limits.mean_range), 3)) " µm, its limit " (um(Some(limits.range_upper), 3)) " µm"
            }
            div .wide { (individuals(name, class, values, &limits)) }
            div .wide { (moving_ranges(name, class, values, &limits)) }
            p {
                (over) " of " (values.len()) " above what is allowed; " (out.len()) " out of limits"
                @if !out.is_empty() { ", the newest first:" } @else { "." }
            }
            (list(&out))
            p {
                (ranges_out.len()) " of " (values.len() - 1) " ranges above their limit"
                @if !ranges_out.is_empty() { ", with the part after the step, the newest first:" } @else { "." }
            }
            (list(&ranges_out))
        }
    }
}

/// Renders a list of the first parts of `values`, with links to their runs.
fn list(values: &[&Value]) -> Markup {
    html! {
        @if !values.is_empty() {
            ul .out {
                @for value in values.iter().take(LISTED) {
                    li {
                        a href=(format!("/runs/{}", value.run)) { (shown(&value.serial)) } " " (value.when) ", " (shown(&value.cell)) ": "
                        (format!("{:.3}", value.um)) " µm" @if let Some(u) = value.u_um { (format!(" ± {u:.3} µm")) }
                    }
                }
            }
        }
    }
}
