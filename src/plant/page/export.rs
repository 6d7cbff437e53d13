//! Exports for other programs: the parts of a selection as CSV and as DFQ.

use std::fmt::Write;

use axum::extract::{Query, State};
use axum::response::Response;
use regrind_language::Language;
use regrind_page::Reader;
use regrind_report::{DfqPart, dfq_of_parts};

use super::super::{Row, ToSql};
use super::control_chart::Value;
use super::page_error::{PageError, unmade, within};
use super::run::file;
use super::selection::{NEWEST_FIRST, Selection, SelectionQuery};
use super::shared::{PlantPage, Shared};
use super::texts::Text;
use super::trend::parts;

/// Maximum number of parts in a file.
const MAX_PARTS: i64 = 20_000;

/// Columns of the file, in order: those of the view `part_run`.
const COLUMNS: [&str; 27] = [
    "id",
    "cell",
    "run",
    "serial",
    "part_name",
    "recipe",
    "recipe_sha256",
    "operator",
    "simulation",
    "began",
    "ended",
    "result",
    "verdict",
    "cycles",
    "pv_um",
    "pv_u_um",
    "pv_limit_um",
    "rms_um",
    "rms_u_um",
    "rms_limit_um",
    "grinder",
    "cmm",
    "wheel",
    "probe",
    "alarms",
    "head",
    "given_up",
];
/// Columns that contain numbers or words of this program. All other columns can contain any text.
const NUMBERS: [&str; 12] = [
    "id",
    "given_up",
    "simulation",
    "cycles",
    "pv_um",
    "pv_u_um",
    "pv_limit_um",
    "rms_um",
    "rms_u_um",
    "rms_limit_um",
    "alarms",
    "head",
];

pub(super) async fn csv(State(plant): State<Shared>, reader: Reader, Query(asked): Query<SelectionQuery>) -> Response {
    match within(csv_of(&plant, &asked)).await {
        Ok(text) => file("parts.csv", "text/csv; charset=utf-8", text),
        Err(reason) => unmade(&reader, &reason),
    }
}

async fn csv_of(plant: &PlantPage, asked: &SelectionQuery) -> Result<String, PageError> {
    let link = plant.lease().await?;
    let selection = Selection::from_query(&link, asked).await?;
    let (condition, values) = selection.condition();
    let column = |name: &&str| match *name {
        time @ ("began" | "ended") => format!("to_char({time}, 'YYYY-MM-DD\"T\"HH24:MI:SS\"Z\"')"),
        other => format!("{other}::text"),
    };
    let columns = COLUMNS.iter().map(column).collect::<Vec<_>>().join(", ");
    let text = format!("SELECT {columns} FROM part_run WHERE {condition} ORDER BY {NEWEST_FIRST} LIMIT {MAX_PARTS}");
    let values: Vec<_> = values.iter().map(|value| value as &(dyn ToSql + Sync)).collect();
    let rows = link.query(&text, &values).await?;
    let mut file = format!("{}\r\n", COLUMNS.join(","));
    for row in &rows {
        line(&mut file, row);
    }
    Ok(file)
}

fn line(file: &mut String, row: &Row) {
    for (k, name) in COLUMNS.iter().enumerate() {
        let text = row.get::<_, Option<&str>>(k).unwrap_or_default();
        let comma = if k == 0 { "" } else { "," };
        let _ = match NUMBERS.contains(name) {
            true => write!(file, "{comma}{text}"),
            false => write!(file, "{comma}{}", quoted(text)),
        };
    }
    file.push_str("\r\n");
}

/// Quotes a text as a field of a CSV file (RFC 4180). Puts an apostrophe before a text that a spreadsheet would execute
/// as a formula.
fn quoted(text: &str) -> String {
    let formula = text.starts_with(['=', '+', '-', '@', '\t', '\r']);
    format!("\"{}{}\"", if formula { "'" } else { "" }, text.replace('"', "\"\""))
}

pub(super) async fn dfq(State(plant): State<Shared>, reader: Reader, Query(asked): Query<SelectionQuery>) -> Response {
    match within(dfq_of(&plant, &asked)).await {
        Ok(text) => file("parts.dfq", "text/plain; charset=utf-8", text),
        Err(reason) => unmade(&reader, &reason),
    }
}

async fn dfq_of(plant: &PlantPage, asked: &SelectionQuery) -> Result<String, PageError> {
    let link = plant.lease().await?;
    let selection = Selection::from_query(&link, asked).await?;
    let parts = parts(&link, &selection, MAX_PARTS).await?;
    if parts.is_empty() {
        return Err(PageError::not_here(Text::NothingMeasured, Vec::new()));
    }
    let figure = |value: &Value| [1e-3 * value.um, 1e-3 * value.u_um.unwrap_or(f64::NAN)];
    let rows: Vec<DfqPart> = parts
        .iter()
        .map(|part| DfqPart {
            serial: part.pv.serial.clone(),
            utc: part.pv.when.replacen(' ', "T", 1),
            words: format!("cell {}", part.pv.cell),
            figures: [Some(figure(&part.pv)), part.rms.as_ref().map(figure)],
            limits_mm: [Some(&part.pv), part.rms.as_ref()]
                .map(|value| value.and_then(|value| value.limit_um).map(|um| 1e-3 * um)),
        })
        .collect();
    let mark = if selection.simulated { "SIMULATION. " } else { "" };
    let when = if selection.first { "measured before any correction" } else { "as judged last" };
    let name = if selection.recipe().is_empty() { "several recipes" } else { selection.recipe() };
    Ok(dfq_of_parts(name, &format!("{mark}{}, {when}", selection.words(Language::En)), &rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_quoting_and_formula_guard() {
        assert_eq!(quoted("a \"b\",\r\nc"), "\"a \"\"b\"\",\r\nc\"");
        assert_eq!(quoted("=1+1"), "\"'=1+1\"");
        assert!(NUMBERS.iter().all(|name| COLUMNS.contains(name)));
    }
}
