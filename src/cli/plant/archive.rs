//! `regrind plant archive|unarchive`: the runs of earlier months, from the database to a folder and back.

use std::path::PathBuf;

use clap::Args;
use jiff::Timestamp;
use jiff::civil::Date;
use jiff::tz::TimeZone;
use regrind::config::PlantConfig;
use regrind_plant::{ArchiveResult, archive_runs, restore_run};
use serde_json::json;

use super::super::failure::Failure;
use super::super::words::counted;
use super::super::{Outcome, check};
use super::plant_file::{Where, open};

/// Move the runs of earlier months from the database to a folder, as its owner
#[derive(Args, Debug)]
#[command(after_help = "\
Each run becomes a run folder FOLDER/YYYY-MM/CELL/RUN, which `regrind audit verify` proves without the plant. A run leaves
the database when its folder is on the disk and proven. Its row and its figures stay, so lists, yields and trends are
unchanged. The table [archive] of the plant file names the folder and the number of months that stay. A timer can
run this command every month (config/systemd/regrind-archive.timer).

Examples:
  regrind plant archive --plant owner.toml
  regrind plant archive --before 2025-01 --out /srv/archive --plant owner.toml

Exit codes: 0 archived; 1 a run stays because it has not ended or cannot be proven; 2 bad arguments, or the database
refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToArchive {
    /// First month that stays in the database; by default from `keep_months` of the table [archive]
    #[arg(long, value_name = "YYYY-MM", value_parser = month)]
    before: Option<Date>,
    /// Folder of the archive; by default `folder` of the table [archive]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    plant: Where,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// Bring archived runs back to the database, as its owner
#[derive(Args, Debug)]
#[command(after_help = "\
Each folder must prove its run with the keys of its cell, and must have the record that the plant had. The folder stays.

Example:
  regrind plant unarchive /srv/archive/2024-11/cell-1/mirror-20241130T154824Z --plant owner.toml

Exit codes: 0 the runs are back; 1 a folder proves nothing; 2 the plant has no such archived run, or the
database refuses the command; 3 the database cannot be reached.")]
pub(super) struct ToRestore {
    /// Run folder in the archive
    #[arg(value_name = "DIR", required = true)]
    runs: Vec<PathBuf>,
    #[command(flatten)]
    plant: Where,
}

fn month(text: &str) -> Result<Date, String> {
    let date = format!("{text}-01").parse::<Date>();
    let is_month = text.len() == "2025-01".len();
    date.ok().filter(|_| is_month).ok_or_else(|| "give a year and a month, such as 2025-01".to_owned())
}

pub(super) fn archive(arguments: &ToArchive) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    let (folder, before) = check::or_show(chosen(arguments, &config, Timestamp::now().to_zoned(TimeZone::UTC).date()))?;
    super::super::runtime()?.block_on(async {
        let mut link = open(&config).await?;
        let before = before.strftime("%Y-%m").to_string();
        let result = archive_runs(&mut link, config.artefacts.as_ref(), (&folder, &before)).await?;
        print(arguments.json, &result)?;
        Ok(if result.kept.is_empty() { Outcome::Accepted } else { Outcome::NotInTolerance })
    })
}

/// Returns the folder of the archive, and the first day of the first month that stays in the database. `today` is the
/// present day. Returns an error if neither the arguments nor the plant file state one of them, or if the month is not
/// before the present one.
fn chosen(
    arguments: &ToArchive,
    config: &PlantConfig,
    today: Date,
) -> Result<(PathBuf, Date), regrind::document::Problems> {
    let missing =
        |what: &str| config.problem("archive", "is missing", "", &format!("add the table [archive], or give {what}"));
    let set = config.archive.as_ref();
    let folder = arguments.out.clone().or_else(|| set.map(|set| set.folder.clone()));
    let kept =
        set.map(|set| today.first_of_month().saturating_sub(jiff::Span::new().months(i64::from(set.keep_months))));
    let before = arguments.before.or(kept).ok_or_else(|| missing("--before"))?;
    Ok((folder.ok_or_else(|| missing("--out"))?, before.min(today.first_of_month())))
}

fn print(json: bool, result: &ArchiveResult) -> Result<(), Failure> {
    let ArchiveResult { runs, records, contents, kept } = result;
    if json {
        let kept: Vec<_> = kept.iter().map(|(run, reason)| json!({ "run": run, "reason": reason })).collect();
        let told = json!({ "runs": runs, "records_removed": records, "files_removed": contents, "kept": kept });
        return super::super::print_json(&told);
    }
    let runs = counted(usize::try_from(*runs).unwrap_or(usize::MAX), "run");
    let mut text = format!("{runs} archived; {records} records and {contents} files left the database\n");
    for (run, reason) in kept {
        text += &format!("stays: {run}: {reason}\n");
    }
    super::super::print(&regrind::document::visible(&text))
}

pub(super) fn unarchive(arguments: &ToRestore) -> Result<Outcome, Failure> {
    let config = arguments.plant.read()?;
    super::super::runtime()?.block_on(async {
        let mut link = open(&config).await?;
        for folder in &arguments.runs {
            let name = restore_run(&mut link, folder).await?;
            super::super::print(&regrind::document::visible(&format!("{name} is back\n")))?;
        }
        Ok(Outcome::Accepted)
    })
}
