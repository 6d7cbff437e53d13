//! `/parts`: parts whose serial numbers begin with a text; without a text, the newest parts.

use axum::Extension;
use axum::extract::{Query, State};
use axum::response::Response;
use maud::{Markup, html};
use regrind_page::Session;
use serde::Deserialize;

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::super::{Row, ToSql};
use super::content::{PageContent, page};
use super::page_error::PageError;
use super::shared::Shared;
use super::words::{encoded, shown, um};

/// Maximum number of parts on a page.
const MAX_ROWS: usize = 100;
/// Last character of Unicode. A beginning with this character appended is an upper bound of all texts with that
/// beginning.
const LAST: char = char::MAX;

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct PartsQuery {
    serial: String,
    /// Id of the run after which this page begins.
    after: Option<i32>,
}

pub(super) async fn parts(
    State(plant): State<Shared>,
    Extension(session): Extension<Session>,
    Query(asked): Query<PartsQuery>,
) -> Response {
    page(&session, made(&plant, &asked)).await
}

async fn made(plant: &Shared, asked: &PartsQuery) -> Result<PageContent, PageError> {
    let serial = asked.serial.trim().replace('\0', "");
    let link = plant.lease().await?;
    let rows = read(&link, &serial, asked.after).await?;
    let next = (rows.len() > MAX_ROWS).then(|| rows[MAX_ROWS - 1].get::<_, i32>(0));
    let main = html! {
        main .list .plant {
            h1 { "Parts" }
            form .filter method="get" action="/parts" {
                label { "Serial number begins with " input name="serial" value=(serial) autofocus; } button { "Search" }
            }
            @if rows.is_empty() { p { "No serial number begins with this text. Capital and small letters are different." } } @else {
                form method="get" action="/maps" {
                    div .wide { (table(&rows[..rows.len().min(MAX_ROWS)])) }
                    p { "Tick two to four: " button { "Maps side by side" } }
                }
            }
            @if let Some(next) = next { p { a href=(format!("/parts?serial={}&after={next}", encoded(&serial))) { "More" } } }
            p .quiet { @if serial.is_empty() { "The newest first." } @else { "By serial number, of each the newest first." } }
        }
    };
    Ok(PageContent { title: "Parts".into(), again_s: None, main })
}

const COLUMNS: &str = "id, serial, part_name, recipe, cell, run, to_char(began, 'YYYY-MM-DD HH24:MI:SS'), cycles, pv_um, rms_um, result, simulation";

/// Reads the runs of parts whose serial number begins with `serial`. An empty `serial` selects all parts. Returns the
/// rows in the order of the list:
///
/// - with an empty `serial`, the newest run first;
/// - otherwise by serial number, and the newest run of each part first.
///
/// If `after` is given, begins with the run that follows the run with this id. Returns at most one row more than a page
/// shows. The caller thus knows whether there is a next page. A database index has the same order, so that the database
/// need not sort the rows.
async fn read(link: &DatabaseLink, serial: &str, after: Option<i32>) -> Result<Vec<Row>, PlantError> {
    let most = MAX_ROWS as i64 + 1;
    let (place, mut values): (_, Vec<&(dyn ToSql + Sync)>) = (after, vec![&most]);
    let last = format!("{serial}{LAST}");
    let mut text = format!("SELECT {COLUMNS} FROM part_run WHERE true");
    if !serial.is_empty() {
        values.extend([&serial as &(dyn ToSql + Sync), &last]);
        text += " AND serial ~>=~ $2::text AND serial ~<~ $3::text";
    }
    if let Some(after) = &place {
        values.push(after);
        let n = values.len();
        text += &match serial.is_empty() {
            true => format!(" AND (began, id) < (SELECT began, id FROM part_run WHERE id = ${n})"),
            // Continues with the other runs of the same part, or with a later serial number.
            false => format!(
                " AND serial ~>=~ (SELECT serial FROM part_run WHERE id = ${n}) AND (serial <> (SELECT serial FROM part_run WHERE id = ${n})
                    OR (began, id) < (SELECT began, id FROM part_run WHERE id = ${n}))"
            ),
        };
    }
    text += match serial.is_empty() {
        true => " ORDER BY began DESC, id DESC LIMIT $1",
        false => " ORDER BY serial USING ~<~, began DESC, id DESC LIMIT $1",
    };
    link.query(&text, &values).await
}

fn table(rows: &[Row]) -> Markup {
    html! {
        table .parts {
            tr {
                th {} th { "Serial number" } th { "Part" } th { "Recipe" } th { "Cell" } th { "Began, UTC" } th .n { "Cycles" } th .n { "PV, µm" } th .n { "RMS, µm" } th { "Result" }
            }
            @for row in rows {
                @let id = row.get::<_, i32>(0);
                @let [serial, part, recipe, cell, run] = [1, 2, 3, 4, 5].map(|k| row.get::<_, Option<&str>>(k).unwrap_or_default());
                @let result = row.get::<_, Option<&str>>(10).unwrap_or("open");
                tr {
                    td { input type="checkbox" name="run" value=(id) aria-label=(run); }
                    td { a href=(format!("/runs/{id}")) { @if serial.is_empty() { (shown(run)) } @else { (shown(serial)) } } }
                    td { (shown(part)) } td { (shown(recipe)) } td { (shown(cell)) }
                    td { (row.get::<_, Option<&str>>(6).unwrap_or_default()) }
                    td .n { (row.get::<_, Option<i32>>(7).map_or("–".to_owned(), |cycles| cycles.to_string())) }
                    td .n { (um(row.get(8), 2)) } td .n { (um(row.get(9), 3)) }
                    td class=(if result == "accepted" { "good" } else { "" }) {
                        (shown(result)) @if row.get::<_, Option<bool>>(11) == Some(true) { " " span .quiet { "(simulated)" } }
                    }
                }
            }
        }
    }
}
