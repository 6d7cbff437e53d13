//! Runs of the cells that the plant has not got: the first record of each run has the number of the run in its folder, and
//! the name of the run before it. A gap shows a run that was never shipped.
//!
//! A cell can have several folders of runs, each with its own numbers from 1. A folder that was restored from a backup uses
//! numbers again, and early versions wrote none. So a number of one folder can stand for that of another, and the name of
//! the run before decides: a run whose predecessor the plant has is in no gap.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::ops::Bound;

use data_encoding::HEXLOWER;
use serde::Deserialize;

use super::error::{PlantError, refused};
use super::link::DatabaseLink;

/// Place of a run in its folder, from its first record.
#[derive(Clone, Debug, PartialEq, Eq)]
struct RunPlace {
    cell: String,
    run: String,
    /// Number of the run in its folder, from 1; `None` for a run of an early version.
    number: Option<u64>,
    /// Run before it, if the first record names one.
    before: Option<Predecessor>,
}

/// Run before another one, as the first record of that one names it.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Deserialize)]
struct Predecessor {
    run: String,
    /// Number of its records then, and the hash of the last of them.
    records: u64,
    head: String,
}

/// Numbers of runs of a cell that the plant has not got.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunGap {
    /// Name of the cell.
    pub cell: String,
    /// First and last missing number.
    pub numbers: [u64; 2],
    /// Run at the plant with the number before; `None` if the plant has no run of the cell with a lower number.
    pub after: Option<String>,
    /// Run at the plant with the number after. Its first record proves the gap.
    pub before: String,
    /// Name of the last missing run and the number of records that it had at least, if the run after it names them.
    pub named: Option<(String, u64)>,
}

impl RunGap {
    /// Finds the gaps in the numbers of the runs of all cells that this role may read, by the first records at the plant.
    /// Runs that are under way to the plant are missing until they arrive.
    ///
    /// # Errors
    /// The plant cannot be reached or refuses the query.
    pub async fn all(link: &DatabaseLink) -> Result<Vec<Self>, PlantError> {
        let text = "SELECT c.name, r.name, coalesce(r.numbering, e.text) FROM run r JOIN cell c ON c.id = r.cell
            LEFT JOIN record e ON e.run = r.id AND e.seq = 1 AND r.numbering IS NULL
            WHERE r.numbering IS NOT NULL OR e.text IS NOT NULL ORDER BY r.id";
        let rows = link.client().query(text, &[]).await.map_err(refused("the first records"))?;
        let places: Vec<RunPlace> = rows.iter().map(|row| place_of(row.get(0), row.get(1), row.get(2))).collect();
        let absent = absent(&places);
        let elsewhere = found_elsewhere(link, &absent).await?;
        Ok(gaps(&places, &elsewhere))
    }
}

/// Reads the place of a run from the text of its first record. A member that cannot be read is taken as missing.
fn place_of(cell: &str, run: &str, text: &str) -> RunPlace {
    #[derive(Deserialize)]
    struct First {
        payload: serde_json::Value,
    }
    let first = serde_json::from_str::<First>(text).map(|first| first.payload).unwrap_or_default();
    let content = first.get("content").cloned().unwrap_or_default();
    RunPlace {
        cell: cell.to_owned(),
        run: run.to_owned(),
        number: content["number"].as_u64(),
        before: Predecessor::deserialize(&content["before"]).ok(),
    }
}

/// Returns the runs that first records name and that the plant has not got from the same cell.
fn absent(places: &[RunPlace]) -> Vec<Predecessor> {
    let known: HashSet<(&str, &str)> = places.iter().map(|place| (&*place.cell, &*place.run)).collect();
    let named = places.iter().filter_map(|place| Some((&place.cell, place.before.as_ref()?)));
    let absent: HashSet<&Predecessor> =
        named.filter(|(cell, before)| !known.contains(&(cell, &before.run))).map(|(_, before)| before).collect();
    absent.into_iter().cloned().collect()
}

/// Returns those of the runs `absent` that the plant has from another cell: the cell was enrolled under another name then.
/// The hash of a record proves this.
async fn found_elsewhere(link: &DatabaseLink, absent: &[Predecessor]) -> Result<HashSet<Predecessor>, PlantError> {
    let asked: Vec<&Predecessor> = absent.iter().filter(|run| i32::try_from(run.records).is_ok()).collect();
    if asked.is_empty() {
        return Ok(HashSet::new());
    }
    let names: Vec<&str> = asked.iter().map(|run| &*run.run).collect();
    let records: Vec<i32> = asked.iter().map(|run| i32::try_from(run.records).unwrap_or(i32::MAX)).collect();
    let heads: Vec<Vec<u8>> =
        asked.iter().map(|run| HEXLOWER.decode(run.head.as_bytes()).unwrap_or_default()).collect();
    let text =
        "SELECT DISTINCT n FROM unnest($1::text[], $2::integer[], $3::bytea[]) WITH ORDINALITY AS a (run, seq, hash, n)
        JOIN run r ON r.name = a.run LEFT JOIN record e ON e.run = r.id AND e.seq = a.seq
        WHERE e.hash = a.hash OR (r.archived_at IS NOT NULL AND (r.records > a.seq OR (r.records = a.seq AND r.head = a.hash)))";
    let rows =
        link.client().query(text, &[&names, &records, &heads]).await.map_err(refused("the runs of other cells"))?;
    let place = |row: &tokio_postgres::Row| usize::try_from(row.get::<_, i64>(0) - 1).ok();
    Ok(rows.iter().filter_map(|row| asked.get(place(row)?).map(|run| (*run).clone())).collect())
}

/// Returns the gaps that `places` prove, in the order of cells and numbers. `elsewhere` are the runs that the plant has
/// from another cell.
///
/// A run with the number n and a predecessor that the plant has not got proves that number n - 1 is missing. Lower numbers
/// belong to the same gap down to the next number that any run of the cell has, because that run can be of the same
/// folder. A run that names no predecessor, because its anchor could not be read, proves a gap only if no run of the cell
/// has the number before.
fn gaps(places: &[RunPlace], elsewhere: &HashSet<Predecessor>) -> Vec<RunGap> {
    let known: HashSet<(&str, &str)> = places.iter().map(|place| (&*place.cell, &*place.run)).collect();
    let mut numbers: BTreeMap<&str, BTreeMap<u64, Vec<&str>>> = BTreeMap::new();
    for place in places {
        if let Some(number) = place.number {
            numbers.entry(&place.cell).or_default().entry(number).or_default().push(&place.run);
        }
    }
    let followed: BTreeSet<(&str, &str)> =
        places.iter().filter_map(|place| Some((&*place.cell, &*place.before.as_ref()?.run))).collect();
    let mut found: BTreeMap<(&str, u64, Option<&str>), RunGap> = BTreeMap::new();
    for place in places {
        let Some(last) = place.number.and_then(|number| number.checked_sub(1)).filter(|last| *last > 0) else {
            continue;
        };
        let of_cell = &numbers[&*place.cell];
        let is_missing = match &place.before {
            Some(before) => !known.contains(&(&*place.cell, &*before.run)) && !elsewhere.contains(before),
            None => !of_cell.contains_key(&last),
        };
        if !is_missing {
            continue;
        }
        let lower = of_cell.range((Bound::Unbounded, Bound::Excluded(last))).next_back();
        // A run that no other one follows is more likely the last one before the gap.
        let after = lower
            .and_then(|(_, runs)| runs.iter().find(|run| !followed.contains(&(&*place.cell, **run))).or(runs.first()));
        let gap = RunGap {
            cell: place.cell.clone(),
            numbers: [lower.map_or(1, |(number, _)| number + 1), last],
            after: after.map(|run| (*run).to_owned()),
            before: place.run.clone(),
            named: place.before.as_ref().map(|before| (before.run.clone(), before.records)),
        };
        // Two runs that name the same one, after a folder was restored, prove one gap.
        found.entry((&place.cell, last, place.before.as_ref().map(|before| &*before.run))).or_insert(gap);
    }
    found.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the place of the run `run` of a cell: `number` 0 is no number, and an empty `before` no predecessor.
    fn place(cell: &str, run: &str, number: u64, before: &str) -> RunPlace {
        let head = "ab".repeat(32);
        let before = (!before.is_empty()).then(|| Predecessor { run: before.into(), records: 7, head });
        RunPlace { cell: cell.into(), run: run.into(), number: (number > 0).then_some(number), before }
    }

    fn all_of(places: &[(&str, &str, u64, &str)]) -> Vec<RunPlace> {
        places.iter().map(|(cell, run, number, before)| place(cell, run, *number, before)).collect()
    }

    fn found(places: &[(&str, &str, u64, &str)]) -> Vec<(String, [u64; 2], Option<String>, String)> {
        let gaps = gaps(&all_of(places), &HashSet::new()).into_iter();
        gaps.map(|gap| (gap.cell, gap.numbers, gap.after, gap.before)).collect()
    }

    #[test]
    fn no_gap_without_proof() {
        let cases: [&[(&str, &str, u64, &str)]; 6] = [
            &[("c", "a1", 1, ""), ("c", "a2", 2, "a1"), ("c", "a3", 3, "a2")],
            // Two folders of one cell.
            &[("c", "a1", 1, ""), ("c", "a2", 2, "a1"), ("c", "b1", 1, ""), ("c", "b2", 2, "b1"), ("c", "b3", 3, "b2")],
            // A folder that was restored from a backup: its number 2 is used again.
            &[("c", "a1", 1, ""), ("c", "a2", 2, "a1"), ("c", "r2", 2, "a1"), ("c", "r3", 3, "r2")],
            // Runs of an early version, and one whose predecessor had no anchor.
            &[("c", "old", 0, ""), ("c", "a1", 1, ""), ("c", "a2", 2, "")],
            &[("c", "a1", 1, ""), ("d", "b1", 1, "")],
            // A number that no folder can have.
            &[("c", "a0", 1, "")],
        ];
        for case in cases {
            assert_eq!(found(case), [], "{case:?}");
        }
    }

    #[test]
    fn gap_has_the_runs_on_both_sides() {
        let gap = |cell: &str, numbers, after: Option<&str>, before: &str| {
            (cell.to_owned(), numbers, after.map(str::to_owned), before.to_owned())
        };
        assert_eq!(found(&[("c", "a1", 1, ""), ("c", "a3", 3, "a2")]), [gap("c", [2, 2], Some("a1"), "a3")]);
        assert_eq!(found(&[("c", "a1", 1, ""), ("c", "a7", 7, "a6")]), [gap("c", [2, 6], Some("a1"), "a7")]);
        assert_eq!(found(&[("c", "a3", 3, "a2")]), [gap("c", [1, 2], None, "a3")]);
        // No anchor could be read.
        assert_eq!(found(&[("c", "a1", 1, ""), ("c", "a4", 4, "")]), [gap("c", [2, 3], Some("a1"), "a4")]);
        // The missing number 2 of the folder a is not that of the folder b.
        let two = [("c", "b1", 1, ""), ("c", "b2", 2, "b1"), ("c", "a1", 1, ""), ("c", "a3", 3, "a2")];
        assert_eq!(found(&two), [gap("c", [2, 2], Some("a1"), "a3")]);
        // Two runs after a restored backup name the same missing run.
        let fork = [("c", "a1", 1, ""), ("c", "a3", 3, "a2"), ("c", "r3", 3, "a2")];
        assert_eq!(found(&fork), [gap("c", [2, 2], Some("a1"), "a3")]);
        // Gaps of two cells, one with the largest number.
        let many = [("d", "x", u64::MAX, "w"), ("c", "a2", 2, "a1")];
        assert_eq!(found(&many), [gap("c", [1, 1], None, "a2"), gap("d", [1, u64::MAX - 1], None, "x")]);
    }

    #[test]
    fn run_of_the_cell_under_another_name_is_no_gap() {
        let places = all_of(&[("new", "a9", 9, "a8"), ("new", "a10", 10, "a9")]);
        let elsewhere = absent(&places).into_iter().collect();
        assert_eq!(gaps(&places, &elsewhere), []);
    }

    #[test]
    fn place_is_read_from_first_record() {
        let text = r#"{"payload":{"content":{"number":4,"before":{"run":"a3","records":7,"head":"ab"}}},"seq":1}"#;
        let read = place_of("c", "a4", text);
        assert_eq!((read.number, read.before.map(|before| before.run)), (Some(4), Some("a3".into())));
        for text in ["", "{}", r#"{"payload":7}"#, r#"{"payload":{"content":{"number":-1,"before":7}}}"#] {
            let read = place_of("c", "a", text);
            assert_eq!((read.number, read.before), (None, None), "{text}");
        }
    }
}
