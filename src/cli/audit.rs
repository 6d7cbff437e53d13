//! `regrind audit`: verifies that the record of a run is unchanged, and prints it.

use std::io::{self, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand, ValueEnum};
use regrind::formats::result::read_bytes;
use regrind::formats::run_files::RunFile;
use regrind::journal::{
    Anchor, DATABASE, ExternalEvidence, JournalError, PublicKey, Reader, Record, RecordKind, Verified, verify_against,
};
use regrind::record::{Begin, RunContent, begin_of};
use regrind::report::{
    Paper, ReportOptions, label_language, pdf_language, report_options, run_label, run_report, run_report_pdf, words,
};
use serde_json::json;

use super::Outcome;
use super::completeness::is_whole;
use super::control::{folder_of, folders};
use super::failure::Failure;
use super::key;
use super::plant;
use super::succession;

/// Verify, show or export the record of a run; create the key that signs it
#[derive(Args, Debug)]
#[command(after_help = "\
Examples:
  regrind audit verify
  regrind audit key
  regrind audit show runs/freeform-mirror-20260704T120000Z --kind event --cycle 2
  regrind audit export runs/freeform-mirror-20260704T120000Z > record.jsonl")]
pub(super) struct Arguments {
    #[command(subcommand)]
    what: AuditCommand,
}

#[derive(Debug, Subcommand)]
enum AuditCommand {
    Verify(ToVerify),
    Show(ToShow),
    Export(ToExport),
    Key(key::Arguments),
}

/// Verify that the record is unchanged: every record, their order, the end, and every file by its hash
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; by default the newest under runs/. If RUN is a folder of runs, the command verifies
each run, and names missing, renamed and exchanged runs: each run has a number and refers to the run before.

The command detects some changes only with a copy from another place:
- The newest runs are missing. Needed: a copy of the anchor of these runs, or the records in the database of a plant.
- The end of a record was cut off, and the anchor was changed to fit. Needed: --anchor with a copy of journal.anchor.
- A record was rewritten from its beginning. Needed: --anchor with this copy, or --key with a copy of the public key.

Without --key, the signatures are checked against the key in the record itself. docs/journal.md shows how to verify a
record without this program.

Examples:
  regrind audit verify runs
  regrind audit verify runs/freeform-mirror-20260704T120000Z --key /mnt/quality/grinding-cell-2.key
  regrind audit verify runs/freeform-mirror-20260704T120000Z --anchor /mnt/quality/SN-0042.anchor

Exit codes: 0 the record is intact and closed; 1 the record is broken or incomplete, the message names the reason;
2 no such run, or no record in the run; 4 the record is intact so far, and the run is still active.")]
struct ToVerify {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Copy of journal.anchor that was kept elsewhere
    #[arg(long, value_name = "FILE")]
    anchor: Option<PathBuf>,
    /// Accepted public key, or the file with it; repeat the option for a run that another computer continued
    #[arg(long, value_name = "PUBLIC|FILE", value_parser = key::public)]
    key: Vec<PublicKey>,
    #[command(flatten)]
    plant: plant::AuditArguments,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// Print the record as a table
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; by default the newest under runs/. The run can still be active. This command does not verify
the record; to verify the record: `regrind audit verify`.

Example:
  regrind audit show --kind intent,event --cycle 2

Exit codes: 0 shown; 1 a record cannot be read; 2 no such run, or no record in the run.")]
struct ToShow {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Only records of these kinds: begin, reopen, intent, outcome, event, artefact, note, seal, end
    #[arg(long, value_name = "KIND,...", value_delimiter = ',', value_parser = kind)]
    kind: Vec<RecordKind>,
    /// Only records of this cycle
    #[arg(long, value_name = "N")]
    cycle: Option<u32>,
    /// Print a line of JSON for each record instead of the table
    #[arg(long)]
    json: bool,
}

/// Print the whole record: lines of JSON as they were hashed, or CSV
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; by default the newest under runs/. Each line ends with the members `prev_hash` and
`hash`. These members chain the records: `hash` is the SHA-256 of \"regrind journal record 1\", a line feed, prev_hash,
a line feed, and the line without these two members. docs/verify_journal.py verifies the exported lines. CSV follows RFC
4180: the first row names the columns, and each record is a row. The column of the payload has the JSON text of the
payload. No field is altered.

Examples:
  regrind audit export runs/freeform-mirror-20260704T120000Z > record.jsonl
  regrind audit export --format csv > record.csv

Exit codes: 0 printed; 1 a record cannot be read; 2 no such run, or no record in the run.")]
struct ToExport {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Format of the records
    #[arg(long, value_enum, default_value = "jsonl")]
    format: Format,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Format {
    /// A line of JSON for each record, with the hashes to verify it
    Jsonl,
    /// A row for each record, for spreadsheets and databases
    Csv,
}

fn kind(word: &str) -> Result<RecordKind, String> {
    let known = || RecordKind::ALL.map(RecordKind::as_str).join(", ");
    word.parse().map_err(|()| format!("give one of {}", known()))
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    match &arguments.what {
        AuditCommand::Verify(of) => prove(of),
        AuditCommand::Show(of) => show(of),
        AuditCommand::Export(of) => export(of),
        AuditCommand::Key(of) => key::run(of),
    }
}

fn export(arguments: &ToExport) -> Result<Outcome, Failure> {
    let folder = folder_of(arguments.run.as_deref())?;
    match arguments.format {
        Format::Jsonl => print_lines(folder, None, |_| true, Record::json_line),
        // Lines of CSV also end with a carriage return.
        Format::Csv => print_lines(folder, Some(Record::csv_head() + "\r"), |_| true, |record| record.csv_row() + "\r"),
    }
}

fn failure(error: JournalError) -> Failure {
    match error {
        JournalError::Broken { .. } | JournalError::NoAuthor { .. } => Failure::Broken(error),
        other => Failure::Journal(other),
    }
}

fn prove(arguments: &ToVerify) -> Result<Outcome, Failure> {
    let copy = match arguments.plant.prove(arguments.run.as_deref(), &arguments.key, arguments.json)? {
        ControlFlow::Continue(copy) => copy,
        ControlFlow::Break(outcome) => return Ok(outcome),
    };
    let folder = folder_of(arguments.run.as_deref())?;
    if is_folder_of_runs(&folder) {
        if let Some(anchor) = &arguments.anchor {
            let reason = "the anchor belongs to one run, but the argument is a folder of several runs: name the folder of the one run".to_owned();
            return Err(Failure::Anchor { path: anchor.clone(), reason });
        }
        return succession::prove(&folder, &arguments.key, arguments.json);
    }
    let anchor = arguments.anchor.as_deref().map(read_anchor).transpose()?;
    let found = verify_against(&folder, &ExternalEvidence { anchor, keys: arguments.key.clone() });
    let not_sound = match &found {
        Err(JournalError::Broken { seq, what, .. }) => Some((Some(seq), what)),
        Err(JournalError::NoAuthor { what, .. }) => Some((None, what)),
        _ => None,
    };
    if let (Some((record, what)), true) = (not_sound, arguments.json) {
        super::print_json(&json!({ "run": folder, "sound": false, "record": record, "what": what }))?;
    }
    let verified = found.map_err(failure)?;
    let begin = begin_of(&folder).map_err(failure)?;
    if arguments.json {
        let mut told = json!({
            "run": folder, "simulation": begin.simulation, "sound": true, "records": verified.records,
            "head": verified.head, "anchored": verified.anchored, "closed": verified.closed,
            "under_way": verified.under_way, "artefacts": verified.artefacts, "unrecorded": verified.unrecorded,
            "keys": verified.keys, "seals": verified.seals, "signed": verified.signed,
        });
        if let Some(copy) = copy {
            told["plant"] = copy;
        }
        super::print_json(&told)?;
    } else {
        super::print(&sound(&folder, &begin, &verified, !arguments.key.is_empty()))?;
    }
    match is_whole(&verified, &arguments.key) {
        Ok(true) => Ok(Outcome::Accepted),
        Ok(false) => Ok(Outcome::UnderWay),
        Err(lacks) => Err(Failure::NotWhole { run: folder, lacks }),
    }
}

/// Returns true if `folder` contains at least one run folder and is not a run folder itself. A run folder is a folder
/// that contains a journal.
fn is_folder_of_runs(folder: &Path) -> bool {
    let has_record = |folder: &Path| folder.join(DATABASE).exists();
    !has_record(folder) && folders(folder).any(|run| has_record(&run))
}

/// Returns lines of text about files in the run folder `folder` that the journal does not list. `unrecorded` contains
/// the names of these files. A report is named only if it differs from the report that is made from the journal now.
/// Returns an empty text if there is nothing to report.
fn unrecorded_text(folder: &Path, unrecorded: &[String]) -> String {
    let made = [RunFile::Report, RunFile::PdfReport, RunFile::Label].map(RunFile::name);
    let [html, pdf, label] = made;
    let has = |name: &str| unrecorded.iter().any(|found| found == name);
    // A pipe or a device is no file, and is not listed.
    let read = |name: &str| if has(name) { read_bytes(&folder.join(name)).unwrap_or_default() } else { Vec::new() };
    let text = String::from_utf8_lossy(&read(html)).into_owned();
    let options = report_options(&text).unwrap_or_default();
    // The header of a shop is in the file of the report alone, so anybody can change it.
    let mut lines = options.header.as_ref().map_or(String::new(), |header| {
        let name = regrind::document::visible(&header.name);
        format!(
            "header      of {html}: {name}; its name, address, logo and fields are not in the record, so not verified\n"
        )
    });
    if has(html) && run_report(folder, &options).ok().as_ref() != Some(&text) {
        lines += &changed_report(html, "");
    }
    let written = String::from_utf8_lossy(&read(label)).into_owned();
    let of_label = ReportOptions { language: label_language(&written), header: None };
    if has(label) && run_label(folder, &of_label).ok().as_ref() != Some(&written) {
        lines += &changed_report(label, "");
    }
    if has(pdf) {
        lines += &pdf_text(folder, pdf, &read(pdf), &options);
    }
    let others: Vec<&str> = unrecorded.iter().map(String::as_str).filter(|name| !made.contains(name)).collect();
    match others.len() {
        0 => lines,
        _ => format!("{lines}files       not in the record, so not verified: {}\n", others.join(", ")),
    }
}

/// Returns a line of text about the PDF report `name` if its content `written` differs from the report that is made from the journal now, in
/// the language of the PDF, on paper of either size, without a header or with that of `options`.
fn pdf_text(folder: &Path, name: &str, written: &[u8], options: &ReportOptions) -> String {
    let language = pdf_language(written);
    let headers = options.header.as_ref().map_or(vec![None], |header| vec![Some(header.clone()), None]);
    let mut failed = None;
    for header in headers {
        for paper in Paper::ALL {
            match run_report_pdf(folder, &ReportOptions { language, header: header.clone() }, paper) {
                Ok(made) if made == written => return String::new(),
                Ok(_) => {}
                Err(error) => failed = Some(error),
            }
        }
    }
    match failed {
        None => changed_report(name, ", its header is another one, or this computer has other fonts"),
        Some(error) => format!("report      {name} is not compared with the record: {error}\n"),
    }
}

fn changed_report(name: &str, or: &str) -> String {
    format!(
        "report      {name} differs from the report that Regrind now makes from the record: a person changed the file, the run went on after it was made, or the version of Regrind changed{or}\n"
    )
}

fn read_anchor(path: &Path) -> Result<Anchor, Failure> {
    let wrong = |reason: String| Failure::Anchor { path: path.to_owned(), reason };
    let bytes = std::fs::read(path).map_err(|error| wrong(error.to_string()))?;
    serde_json::from_slice(&bytes).map_err(|error| wrong(format!("not an anchor: {error}")))
}

fn mark(begin: &Begin<RunContent>) -> &'static str {
    if begin.simulation == Some(true) { "SIMULATION  " } else { "" }
}

/// Returns the text about the signatures of a verified journal: the number of the last signed record, or that all
/// records are signed, and the keys that signed. If the run had no key, the text says so.
///
/// `as_given` is true if the user gave the key with `--key`. If it is false, the text warns that only `--key` proves
/// that the key belongs to the cell.
fn signed(verified: &Verified, as_given: bool) -> String {
    let Verified { keys, signed, records, .. } = verified;
    let [first, others @ ..] = keys.as_slice() else {
        return "no: the run had no key (`regrind audit key` creates one)".to_owned();
    };
    let named = |key: &PublicKey| format!("{key} ({})", key.fingerprint());
    let then: String = others.iter().map(|key| format!(", then by {}", named(key))).collect();
    let given = if as_given { ", as given" } else { "; only --key proves that this is the key of your cell" };
    let reach = match verified.closed && !verified.lacks_last_seal() {
        true => "to its end".to_owned(),
        false => format!("up to record {signed} of {records}"),
    };
    format!("{reach}, by {}{then}{given}", named(first))
}

fn sound(folder: &Path, begin: &Begin<RunContent>, verified: &Verified, as_given: bool) -> String {
    let Verified { records, head, anchored, closed, artefacts, unrecorded, .. } = verified;
    let records = super::words::counted(*records as usize, "record");
    let files = super::words::counted(*artefacts as usize, "file");
    let end = match (closed, anchored) {
        (true, _) => "the run is closed: no record follows, and none was cut off".to_owned(),
        (false, 0) => {
            "the run is not closed and has no anchor: if records were cut off at the end, this is not detected"
                .to_owned()
        }
        (false, anchored) => {
            format!(
                "the run is not closed: nothing was cut off up to record {anchored}; if later records were cut off, this is not detected"
            )
        }
    };
    format!(
        "{}{}\nsound       {records} in an unbroken chain, {files} unchanged\nend         {end}\nsigned      {}\nhead        {head}\n{}",
        mark(begin),
        folder.display(),
        signed(verified, as_given),
        unrecorded_text(folder, unrecorded)
    )
}

fn show(arguments: &ToShow) -> Result<Outcome, Failure> {
    let folder = folder_of(arguments.run.as_deref())?;
    let wanted = |record: &Record| {
        (arguments.kind.is_empty() || arguments.kind.contains(&record.kind))
            && arguments.cycle.is_none_or(|cycle| record.cycle == cycle)
    };
    if arguments.json {
        return print_lines(folder, None, wanted, Record::json_line);
    }
    let begin = begin_of(&folder).map_err(failure)?;
    let [part, ..] = begin.content.names();
    let part = part.map_or(String::new(), |name| format!("; {name}"));
    let head = format!(
        "{}{}{part}\n{:>6}  {:<19}  {:<16}  {:<8}  {:>5}  what",
        mark(&begin),
        folder.display(),
        "record",
        "time (UTC)",
        "who",
        "kind",
        "cycle"
    );
    print_lines(folder, Some(head), wanted, row)
}

/// Formats a record as a line of the table: number, UTC time to the second, actor, kind, cycle, and description.
fn row(record: &Record) -> String {
    // Whole seconds without `T` and `Z`. Within a second the sequence numbers show the order, and --json has the full
    // time.
    let utc: String = record.utc.trim_end_matches('Z').replacen('T', " ", 1).chars().take(19).collect();
    let who: String = record.actor.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let cycle = if record.cycle == 0 { "-".to_owned() } else { record.cycle.to_string() };
    let kind = record.kind.as_str();
    format!("{:>6}  {utc:<19}  {who:<16}  {kind:<8}  {cycle:>5}  {}", record.seq, words(record))
}

/// Prints text about the run in `folder` to standard output. Prints `head` first, if there is one. Then prints one line
/// for each record for which `wanted` returns true: the text that `line` returns. Each line is written while the
/// journal is still being read. Ends without an error if the program that reads the output has ended.
///
/// Returns an error if the journal cannot be read or the output cannot be written.
fn print_lines(
    folder: PathBuf,
    head: Option<String>,
    wanted: impl Fn(&Record) -> bool,
    line: impl Fn(&Record) -> String,
) -> Result<Outcome, Failure> {
    let reader = Reader::open(&folder).map_err(failure)?;
    let mut out = io::BufWriter::with_capacity(1 << 16, io::stdout().lock());
    let written = head.map_or(Ok(()), |head| writeln!(out, "{head}"));
    let written = reader.records(0).try_fold(written, |written, record| match (written, record) {
        (Ok(()), Ok(record)) if wanted(&record) => Ok(writeln!(out, "{}", line(&record))),
        (Ok(()), Ok(_)) => Ok(Ok(())),
        (Ok(()), Err(error)) => Err(Ok(error)),
        (Err(error), _) => Err(Err(error)),
    });
    let flushed = out.flush();
    match written {
        Err(Ok(error)) => Err(failure(error)),
        Err(Err(error)) => gone_or(error),
        Ok(written) => written.and(flushed).map_or_else(gone_or, |()| Ok(Outcome::Accepted)),
    }
}

fn gone_or(error: io::Error) -> Result<Outcome, Failure> {
    match error.kind() {
        io::ErrorKind::BrokenPipe => Ok(Outcome::Accepted),
        _ => Err(Failure::Terminal(error)),
    }
}
