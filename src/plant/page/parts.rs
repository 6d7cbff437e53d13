//! `/parts`: parts whose serial numbers begin with a text; without a text, the newest parts.

use axum::extract::{Query, State};
use axum::response::Response;
use maud::{Markup, html};
use regrind_language::Language;
use regrind_page::Reader;
use serde::Deserialize;

use super::super::error::PlantError;
use super::super::link::DatabaseLink;
use super::super::{Row, ToSql};
use super::content::{PageContent, page};
use super::page_error::PageError;
use super::shared::Shared;
use super::texts::{Text, result_word};
use super::words::{encoded, name, um, when};

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

pub(super) async fn parts(State(plant): State<Shared>, reader: Reader, Query(asked): Query<PartsQuery>) -> Response {
    page(&reader, made(&plant, &asked, reader.language)).await
}

async fn made(plant: &Shared, asked: &PartsQuery, language: Language) -> Result<PageContent, PageError> {
    let say = |text: Text| text.to(language);
    let serial = asked.serial.trim().replace('\0', "");
    let link = plant.lease().await?;
    let rows = read(&link, &serial, asked.after).await?;
    let next = (rows.len() > MAX_ROWS).then(|| rows[MAX_ROWS - 1].get::<_, i32>(0));
    let main = html! {
        main .list .plant {
            h1 { (say(Text::Parts)) }
            form .filter method="get" action="/parts" {
                label { (say(Text::SerialBegins)) " " input name="serial" value=(serial) autofocus; } button { (say(Text::Search)) }
            }
            @if rows.is_empty() { p { (say(Text::NoSerialBegins)) } } @else {
                form method="get" action="/maps" {
                    div .wide { (table(&rows[..rows.len().min(MAX_ROWS)], language)) }
                    p { (say(Text::TickTwoToFour)) " " button { (say(Text::MapsSideBySide)) } }
                }
            }
            @if let Some(next) = next { p { a href=(format!("/parts?serial={}&after={next}", encoded(&serial))) { (say(Text::More)) } } }
            p .quiet { (say(if serial.is_empty() { Text::NewestFirst } else { Text::BySerialNewestFirst })) }
        }
    };
    Ok(PageContent { title: say(Text::Parts).into(), again_s: None, main })
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

fn table(rows: &[Row], language: Language) -> Markup {
    let say = |text: Text| text.to(language);
    html! {
        table .parts {
            tr {
                th {} th { (say(Text::SerialNumber)) } th { (say(Text::Part)) } th { (say(Text::Recipe)) } th { (say(Text::Cell)) } th { (say(Text::Began)) } th .n { (say(Text::Cycles)) } th .n { "PV, µm" } th .n { "RMS, µm" } th { (say(Text::Result)) }
            }
            @for row in rows {
                @let id = row.get::<_, i32>(0);
                @let [serial, part, recipe, cell, run] = [1, 2, 3, 4, 5].map(|k| row.get::<_, Option<&str>>(k).unwrap_or_default());
                @let result = row.get::<_, Option<&str>>(10).unwrap_or("open");
                tr {
                    td { input type="checkbox" name="run" value=(id) aria-label=(run); }
                    td { a href=(format!("/runs/{id}")) { (name(if serial.is_empty() { run } else { serial })) } }
                    td { (name(part)) } td { (name(recipe)) } td { (name(cell)) }
                    td { (when(row.get::<_, Option<&str>>(6).unwrap_or_default())) }
                    td .n { (row.get::<_, Option<i32>>(7).map_or("–".to_owned(), |cycles| cycles.to_string())) }
                    td .n { (um(row.get(8), 2, language)) } td .n { (um(row.get(9), 3, language)) }
                    td class=(if result == "accepted" { "good" } else { "" }) {
                        (result_word(result, language)) @if row.get::<_, Option<bool>>(11) == Some(true) { " " span .quiet { "(" (say(Text::Simulated)) ")" } }
                    }
                }
            }
        }
    }
}
