//! `regrind plant runs|fetch|incidents`: the plant's copies of the runs of its cells.

use std::path::PathBuf;

use clap::Args;
use regrind::document::visible_line;
use regrind_plant::{PlantRun, RunGap};
use serde_json::json;

use super::super::Outcome;
use super::super::failure::Failure;
use super::plant_file::{Where, open};

/// List the newest runs of all cells, or those of one part, or the runs that never arrived
#[derive(Args, Debug)]
#[command(after_help = "\
A run whose time is in the future, by a wrong clock of its cell, comes last.

The first record of each run has the number of the run in its folder, and names the run before it. With --missing, the
command lists the numbers that the plant has not got, with the runs at the plant before and after them. A run that a
cell has not shipped yet is missing too: first ship the runs of the cell with `regrind ship --once`. The newest runs of
a cell are not missed, because no later run names them.

Examples:
  regrind plant runs --plant planner.toml
  regrind plant runs --part SN-00 --plant planner.toml
  regrind plant runs --missing --plant planner.toml

Exit codes: 0 listed, with --missing: no run is missing; 1 with --missing: runs are missing; 2 the database refuses the
command; 3 the database cannot be reached.")]
pub(super) struct ToList {
    /// Serial number of the part, or its first characters
    #[arg(long, value_name = "SERIAL")]
    part: Option<String>,
    /// Maximum number of entries
    #[arg(long, alias = "most", value_name = "N", default_value_t = 40)]
    max_rows: u32,
    /// List the runs that never arrived, by the gaps in the numbers of the runs of each cell
    #[arg(long, conflicts_with_all = ["part", "max_rows"])]
    missing: bool,
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// Fetch a run from the plant as a run folder, and verify it
#[derive(Args, Debug)]
#[command(after_help = "\
Records and files are the same as at the cell: `regrind report`, `regrind audit` and other readers of a run can read the
folder.

Example:
  regrind plant fetch freeform-mirror-20260704T120000Z --plant planner.toml --out runs

Exit codes: 0 fetched and verified; 1 the run is invalid or incomplete, or a name on its record can lead to another
folder; 2 no such run; 3 the plant cannot be reached.")]
pub(super) struct ToFetch {
    /// Name of the run
    #[arg(value_name = "RUN")]
    run: String,
    /// Cell of the run, if several cells have a run of this name
    #[arg(long, value_name = "NAME")]
    cell: Option<String>,
    /// Folder in which to create the folder of the run
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    plant: Where,
}

/// List incidents: cut journals, refused work, broken chains
#[derive(Args, Debug)]
#[command(after_help = "\
Example:
  regrind plant incidents --plant planner.toml

Exit codes: 0 listed; 2 the database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToListIncidents {
    /// Maximum number of entries
    #[arg(long, alias = "most", value_name = "N", default_value_t = 40)]
    max_rows: u32,
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

pub(super) fn list(arguments: &ToList) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        if arguments.missing {
            return print_gaps(&RunGap::all(&link).await?, arguments.json);
        }
        // Each part is found by the index of the times. A run of the far future must not hide the others.
        let text = "SELECT cell, run, serial, coalesce(result, 'open'), coalesce(to_char(began, 'YYYY-MM-DD HH24:MI:SS'), ''), records FROM (
            (SELECT 1 AS place, * FROM part_run WHERE began < now() + interval '1 day' AND ($1::text IS NULL OR starts_with(serial, $1))
                ORDER BY began DESC LIMIT $2)
            UNION ALL
            (SELECT 2, * FROM part_run WHERE began >= now() + interval '1 day' AND ($1::text IS NULL OR starts_with(serial, $1))
                ORDER BY began DESC LIMIT $2)
            ) AS both_of ORDER BY place, began DESC LIMIT $2";
        let found = link.query(text, &[&arguments.part, &i64::from(arguments.max_rows)]).await?;
        let told = found.iter().map(|row| ([0, 1, 2, 3, 4].map(|k| row.get::<_, String>(k)), row.get::<_, i32>(5)));
        if arguments.json {
            let told = told.map(|([cell, run, serial, result, began], records)| {
                json!({ "cell": cell, "run": run, "part": serial, "result": result, "began": began, "records": records })
            });
            super::super::print_json(&told.collect::<Vec<_>>())?;
        } else {
            let line = |(row, records): ([String; 5], i32)| {
                let [cell, run, serial, result, began] = row.map(|field| visible_line(&field));
                format!("{began}  {cell:<16}  {serial:<16}  {result:<12}  {records:>6} records  {run}\n")
            };
            super::super::print(&told.map(line).collect::<String>())?;
        }
        Ok(Outcome::Accepted)
    })
}

/// Prints the numbers of runs that the plant has not got. Returns `NotInTolerance` if there are any.
fn print_gaps(gaps: &[RunGap], json: bool) -> Result<Outcome, Failure> {
    if json {
        let told = gaps.iter().map(|RunGap { cell, numbers: [first, last], after, before, named }| {
            let (named, records) = named.as_ref().map(|(run, records)| (run, records)).unzip();
            json!({ "cell": cell, "first": first, "last": last, "after": after, "before": before, "named": named, "records": records })
        });
        super::super::print_json(&told.collect::<Vec<_>>())?;
    } else {
        let line = |gap: &RunGap| {
            let RunGap { cell, numbers: [first, last], after, before, named } = gap;
            let numbers =
                if first == last { format!("number {first} is") } else { format!("numbers {first} to {last} are") };
            let after = after.as_ref().map_or("the beginning".to_owned(), |run| visible_line(run));
            let named = named.as_ref().map_or(String::new(), |(run, records)| {
                format!("; the last missing run is {} with at least {records} records", visible_line(run))
            });
            format!(
                "{:<16}  {numbers} missing between {after} and {}{named}\n",
                visible_line(cell),
                visible_line(before)
            )
        };
        super::super::print(&gaps.iter().map(line).collect::<String>())?;
    }
    Ok(if gaps.is_empty() { Outcome::Accepted } else { Outcome::NotInTolerance })
}

pub(super) fn fetch(arguments: &ToFetch) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let run = PlantRun::find(&link, arguments.cell.as_deref(), &arguments.run).await?;
        let folder = run.folder_in(&arguments.out)?;
        run.fetch(&link, config.artefacts.as_ref(), &folder).await?;
        let proven = run.prove(&folder, &[])?;
        let files = super::super::words::counted(proven.artefacts as usize, "file");
        super::super::print(&format!(
            "{}: {} records of {}, {files}; verified\n",
            visible_line(&folder.display().to_string()),
            run.records,
            visible_line(&run.cell)
        ))?;
        Ok(Outcome::Accepted)
    })
}

pub(super) fn incidents(arguments: &ToListIncidents) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let link = open(&config).await?;
        let text = "SELECT to_char(last_at, 'YYYY-MM-DD HH24:MI:SS'), coalesce(cell, by), coalesce(run, ''), what, words, times
            FROM incident_told ORDER BY last_at DESC, id DESC LIMIT $1";
        let found = link.query(text, &[&i64::from(arguments.max_rows)]).await?;
        let told = found.iter().map(|row| ([0, 1, 2, 3, 4].map(|k| row.get::<_, String>(k)), row.get::<_, i32>(5)));
        if arguments.json {
            let told = told.map(|([at, by, run, what, words], times)| {
                json!({ "at": at, "by": by, "run": run, "what": what, "words": words, "times": times })
            });
            super::super::print_json(&told.collect::<Vec<_>>())?;
        } else {
            let line = |(row, times): ([String; 5], i32)| {
                let [at, by, run, what, words] = row.map(|field| visible_line(&field));
                let times = if times > 1 { format!("  ({times} times)") } else { String::new() };
                format!("{at}  {by:<16}  {what}: {words}  {run}{times}\n")
            };
            super::super::print(&told.map(line).collect::<String>())?;
        }
        Ok(Outcome::Accepted)
    })
}
