//! `regrind report`: one HTML file about a run, and its results in formats of other systems.

use std::io::Read;
use std::path::{Path, PathBuf};

use clap::Args;
use regrind::report::{
    Language, MAX_LOGO_BYTES, Paper, ReportOptions, ResultsFormat, ShopHeader, logo_uri, write_run_label,
    write_run_report, write_run_report_pdf, write_run_results,
};

use super::Outcome;
use super::control::folder_of;
use super::failure::Failure;

/// Write the report of a run as one HTML file that needs no network, and as PDF; write its results as QIF or DFQ
#[derive(Args, Debug)]
#[command(after_help = "\
RUN is the folder of a run; by default the newest under runs/. The record is verified first. The report is
RUN/report.html. Results for other systems have each measurement with its figures, limits, uncertainties and verdict.

A header file has these keys; only `name` is required, and the path of the logo is relative to the file:

  name = \"Optics Ltd\"
  address = [\"1 Lens Lane\", \"Jena\"]
  logo = \"logo.svg\"
  [[fields]]
  name = \"Order\"
  text = \"4711\"

Examples:
  regrind report runs/freeform-mirror-20260704T120000Z
  regrind report runs/freeform-mirror-20260704T120000Z --language de --header shop.toml --pdf
  regrind report runs/freeform-mirror-20260704T120000Z --qif --dfq=/srv/qdas/part-17.dfq

Exit codes: 0 written; 1 the record is broken; 2 no such run, no record in it, nothing measured (with --qif or --dfq), or a file
cannot be written.")]
pub(super) struct Arguments {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Also write the report as PDF/A-2b, to FILE or to RUN/report.pdf
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true)]
    pdf: Option<Option<PathBuf>>,
    /// Size of the pages of the PDF: a4 or letter
    #[arg(long, value_name = "SIZE", default_value = "a4", value_parser = paper)]
    paper: Paper,
    /// Also write a label of 80 mm by 30 mm with serial number, verdict and a QR code, to FILE or to RUN/label.svg
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true)]
    label: Option<Option<PathBuf>>,
    /// Also write the results as QIF 3.0, to FILE or to RUN/results.qif
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true)]
    qif: Option<Option<PathBuf>>,
    /// Also write the results as Q-DAS ASCII, to FILE or to RUN/results.dfq
    #[arg(long, value_name = "FILE", num_args = 0..=1, require_equals = true)]
    dfq: Option<Option<PathBuf>>,
    /// Language of the report: en, de or zh. Sentences of the record stay in its words
    #[arg(long, value_name = "LANGUAGE", default_value = "en", value_parser = language)]
    language: Language,
    /// TOML file with the header of the shop: name, address, logo and fields
    #[arg(long, value_name = "FILE")]
    header: Option<PathBuf>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// Reads the header of a shop, with the picture of its logo.
fn shop_header(path: &Path) -> Result<ShopHeader, Failure> {
    let wrong = |reason: String| Failure::ShopHeader { path: path.to_owned(), reason };
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    let mut header: ShopHeader = toml::from_str(&text).map_err(|error| wrong(error.to_string()))?;
    if let Some(logo) = &header.logo {
        let logo = path.parent().unwrap_or(Path::new("")).join(logo);
        let picture = std::fs::File::open(&logo).and_then(|file| {
            let mut bytes = Vec::new();
            // One byte more than is allowed shows that a file is too large.
            file.take(MAX_LOGO_BYTES as u64 + 1).read_to_end(&mut bytes)?;
            Ok(bytes)
        });
        let picture = picture.map_err(|error| wrong(format!("the logo {}: {error}", logo.display())))?;
        let uri = logo_uri(&picture);
        header.logo = Some(uri.ok_or_else(|| {
            wrong(format!(
                "the logo {} must be a PNG, a JPEG or an SVG of at most {} KiB; an SVG must have at most 128 elements within each other, 64 references and no entities; if it has more, export it as PNG",
                logo.display(),
                MAX_LOGO_BYTES >> 10
            ))
        })?);
    }
    header.check().map_err(wrong)?;
    Ok(header)
}

/// Reads the tag of a language of the report.
fn language(text: &str) -> Result<Language, String> {
    let tags: Vec<&str> = Language::ALL.iter().map(|language| language.tag()).collect();
    let found = Language::ALL.iter().copied().find(|language| language.tag() == text);
    found.ok_or_else(|| format!("this language does not exist; the languages are {}", tags.join(", ")))
}

/// Reads the size of the pages.
fn paper(text: &str) -> Result<Paper, String> {
    match text {
        "a4" => Ok(Paper::A4),
        "letter" => Ok(Paper::Letter),
        _ => Err("this size does not exist; the sizes are a4, letter".to_owned()),
    }
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let folder = folder_of(arguments.run.as_deref())?;
    let header = arguments.header.as_deref().map(shop_header).transpose()?;
    let options = ReportOptions { language: arguments.language, header };
    let mut written = vec![("report", write_run_report(&folder, &options).map_err(Failure::Report)?)];
    if let Some(path) = &arguments.pdf {
        let pdf = write_run_report_pdf(&folder, &options, arguments.paper, path.as_deref()).map_err(Failure::Report)?;
        written.push(("pdf", pdf));
    }
    if let Some(path) = &arguments.label {
        written.push(("label", write_run_label(&folder, &options, path.as_deref()).map_err(Failure::Report)?));
    }
    let wanted = [("qif", ResultsFormat::Qif, &arguments.qif), ("dfq", ResultsFormat::Dfq, &arguments.dfq)];
    for (key, format, path) in wanted {
        if let Some(path) = path {
            written.push((key, write_run_results(&folder, format, path.as_deref()).map_err(Failure::Report)?));
        }
    }
    if arguments.json {
        let named = written.into_iter().map(|(key, path)| (key.to_owned(), serde_json::json!(path))).collect();
        super::print_json(&serde_json::Value::Object(named))?;
    } else {
        super::print(&written.iter().map(|(_, path)| format!("{}\n", path.display())).collect::<String>())?;
    }
    Ok(Outcome::Accepted)
}
