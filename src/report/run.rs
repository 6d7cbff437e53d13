//! Report of a run: one HTML file that opens without a network, made from the journal and the files on record.
//!
//! ```text
//!  page 1, which can be filed alone   verdict, judged figures, maps, cycles, machines, record, signatures
//!  the pages after it                 sections, uncertainty, form, cycles, machines, alarms, orders, definitions
//! ```
//!
//! It is made only from a record that passes verification. It ends with the hash of the last record, so that a reader
//! of the report can check if a journal is the one that the report was made from.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;

use super::ReportError;
use super::chart::PAPER;
use super::convergence::convergence;
use super::equipment::{equipment, last_model, last_registration, registered};
use super::first_page::first_page;
use super::form::form;
use super::maps::read_maps;
use super::report_content::{Report, ReportOptions, when};
use super::run_history::{AlarmHistory, Measurement, Order, RunHistory};
use super::shop_header::ShopHeader;
use super::texts::{self, ReportText as Text};
use super::words::judgement_words;
use regrind_cell::{Figures, PvPoints, RecordedParameter, Tolerance};
use regrind_formats::run_files::RunFile;
use regrind_formats::{escaped, write_atomic};
use regrind_language::{Language, decimal};
use regrind_record::TouchCounts;

pub(super) const STYLE: &str = include_str!("report.css");

/// Verifies the record in the run folder `folder`, writes the HTML report of the run (`report.html`) into this folder, and returns its path.
///
/// # Errors
/// Fails if the record is missing or does not pass verification, if a file on record cannot be read, or if the report
/// cannot be written.
pub fn write_run_report(folder: &Path, options: &ReportOptions) -> Result<PathBuf, ReportError> {
    let path = folder.join(RunFile::Report.name());
    write_atomic(&path, run_report(folder, options)?.as_bytes())?;
    Ok(path)
}

/// Verifies the record in the run folder `folder` and returns the report of the run as HTML.
///
/// # Errors
/// Fails if the record is missing or does not pass verification, or if a file on record cannot be read.
pub fn run_report(folder: &Path, options: &ReportOptions) -> Result<String, ReportError> {
    with_report(folder, options, |report| html(report, folder))
}

/// Verifies the record in the run folder `folder`, and calls `write` with the content of the report of the run.
pub(super) fn with_report<T>(
    folder: &Path,
    options: &ReportOptions,
    write: impl FnOnce(&Report) -> Result<T, ReportError>,
) -> Result<T, ReportError> {
    let (story, verified) = RunHistory::read_verified(folder)?;
    let ReportOptions { language, header } = options;
    let maps = read_maps(&story, folder)?;
    write(&Report { story: &story, verified: &verified, maps, language: *language, header: header.as_ref() })
}

/// Returns the options with which a report was made, from the text of its file: its language, and its header. Returns
/// `None` if it states none of the languages, or a header that Regrind would not write.
pub fn report_options(html: &str) -> Option<ReportOptions> {
    let tag = html.split("<html lang=\"").nth(1)?.split('"').next()?;
    let language = Language::first_of(tag)?;
    let Some(written) = html.split(HEADER_MARK).nth(1) else { return Some(ReportOptions { language, header: None }) };
    let text = BASE64.decode(written.split('"').next()?.as_bytes()).ok()?;
    let header: ShopHeader = serde_json::from_slice(&text).ok()?;
    header.check().ok()?;
    Some(ReportOptions { language, header: Some(header) })
}

/// Begin of the element in which a report states its header, so that the same report can be made from the record again.
const HEADER_MARK: &str = "<meta name=\"regrind-header\" content=\"";

pub(super) fn html(report: &Report, folder: &Path) -> Result<String, ReportError> {
    let Report { story, verified, language, .. } = report;
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"{}\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n{}<title>{}</title>\n\
         <style>{STYLE}{PAPER}{}</style>\n</head>\n<body>\n",
        language.tag(),
        header_element(report),
        escaped(&report.title()),
        running_foot(report),
    );
    let registration = last_registration(story, folder)?;
    html += &first_page(report, registration.as_ref().map(|(_, found)| found))?;
    let _ = writeln!(
        html,
        "<section class=\"details\">\n<p class=\"caption\">{} {}, {}{}</p>",
        report.say(Text::Serial),
        escaped(report.serial()),
        escaped(report.run()),
        report.mark()
    );
    html += &charts(report);
    html += &registration
        .map_or(String::new(), |(cycle, found)| registered(report, cycle, &found, last_model(story, folder).as_ref()));
    html += &form(report, folder)?;
    html += &cycles(report);
    html += &equipment(report, last_registration(story, folder)?.as_ref().map(|(_, found)| found), folder);
    html += &alarms(report);
    html += &orders(report);
    html += &definitions(report);
    html += &traceability(report);
    let (records, head, signed) = (verified.records, &verified.head, verified.signed);
    let by = verified.keys.iter().map(|key| format!("<br/><code>{key}</code>")).collect::<String>();
    let end = report.say(if verified.closed { Text::Closed } else { Text::NotClosed });
    let by = if by.is_empty() {
        report.say(Text::NotSigned).to_owned()
    } else {
        format!("{} {signed}:{by}", report.say(Text::Signed))
    };
    let _ = write!(
        html,
        "</section>\n<footer><p>{records} {}, {}, {end}. {}:<br/><code>{head}</code><br/>{by}<br/>{}</p></footer>\n</body>\n</html>\n",
        report.say(Text::Records),
        report.say(Text::Unbroken),
        report.say(Text::HashOfLast),
        report.say(Text::VerifyHint),
    );
    Ok(html)
}

/// Returns the element with the header of the shop, in JSON and base 64.
fn header_element(report: &Report) -> String {
    let Some(header) = report.header else { return String::new() };
    // The header has texts only, so the conversion cannot fail.
    let text = serde_json::to_vec(header).unwrap_or_default();
    format!("{HEADER_MARK}{}\"/>\n", BASE64.encode(text))
}

/// Returns the style of the margins of printed pages: the serial number, the mark of a simulation, and the number of the
/// page.
fn running_foot(report: &Report) -> String {
    // Within a string of a style sheet, each character can be written by its number.
    let quoted = |text: &str| {
        let number = |c: char| match c {
            c if c.is_ascii_alphanumeric() || " -_.,:/".contains(c) => c.to_string(),
            // The blank belongs to the number.
            c => format!("\\{:06x} ", u32::from(c)),
        };
        text.chars().map(number).collect::<String>()
    };
    let [left, right] = report.foot().map(|text| quoted(&text));
    format!(
        "@page{{@bottom-left{{content:\"{left}\"}}@bottom-right{{content:\"{right} {} \" counter(page) \" {} \" counter(pages)}}}}",
        quoted(&format!("\u{b7} {}", report.say(Text::Page))),
        quoted(report.say(Text::CountOf)),
    )
}

/// Returns the charts: the sections of the last map, the convergence, and the distribution of the last map.
fn charts(report: &Report) -> String {
    let language = report.language;
    let figure = |svg: &str| format!("<figure>{svg}</figure>\n");
    let mut html = String::new();
    if let Some(last) = report.maps.last() {
        let sections: String = last.sections(language).iter().map(|svg| figure(svg)).collect();
        let _ = write!(html, "<h2>{}</h2>\n<div class=\"two\">\n{sections}</div>\n", report.say(Text::Sections));
    }
    let others =
        convergence(report.story, language).into_iter().chain(report.maps.last().map(|m| m.distribution(language)));
    let others: String = others.map(|svg| figure(&svg)).collect();
    if others.is_empty() { html } else { format!("{html}<div class=\"two\">\n{others}</div>\n") }
}

/// Returns the HTML table of the cycles. Each measurement has a row with its verdict and figures, and a second row with
/// the reason for the verdict and remarks.
fn cycles(report: &Report) -> String {
    let story = report.story;
    let tolerance = story.tolerance();
    let named = |m: &Measurement| Some(tolerance.as_ref()?.compare(m.figures.as_ref()?)[0].name);
    let named = story.cycles.values().flat_map(|cycle| &cycle.measurements).filter_map(named).next_back();
    let mut html = format!(
        "<h2>{}</h2>\n<table id=\"cycles\">\n<thead><tr><th class=\"n\">{}</th><th>{}</th><th class=\"n\">{}, \u{b5}m</th>\
         <th class=\"n\">RMS, \u{b5}m</th><th class=\"n\">{}</th><th class=\"n\">{}</th>\
         <th class=\"n\">{}</th><th class=\"n\">{}, \u{b5}m</th></tr></thead>\n",
        report.say(Text::Cycles),
        report.say(Text::Cycle),
        report.say(Text::Judged),
        named.unwrap_or("PV"),
        report.say(Text::Points),
        report.say(Text::Outliers),
        report.say(Text::Coverage),
        report.say(Text::Level),
    );
    for (number, cycle) in &story.cycles {
        let level = cycle.level_um.map_or("-".to_owned(), |level| decimal(level, 1, report.language));
        let none = [Measurement { unusable: Some(report.say(Text::NotMeasured).into()), ..Measurement::default() }];
        let measurements = if cycle.measurements.is_empty() { &none[..] } else { &cycle.measurements };
        html.extend(measurements.iter().map(|of| measurement(report, *number, of, tolerance.as_ref(), &level)));
    }
    let touches = story.touches.map_or(String::new(), |TouchCounts { taken, whole_patterns }| {
        let [touches, whole] = [Text::Touches, Text::WholePatterns].map(|text| report.say(text));
        format!("<p>{touches}: {taken}; {whole} {whole_patterns}.</p>\n")
    });
    html + "</table>\n" + &touches + &parameters(report)
}

/// Returns the HTML table of the estimated errors of machine parameters, such as the error of the wheel radius. Each
/// row is for one parameter in one cycle. A row shows these values:
///
/// - the estimated error with its expanded uncertainty (k = 2);
/// - the part of the error that is compensated;
/// - the total correction of the parameter for the next pass;
/// - the reduction of the rms error of the part by this compensation, in micrometres.
///
/// Below the table is a line for each cycle with the rms of the error that remains for the correction map. Returns an
/// empty text if the record contains no parameters.
fn parameters(report: &Report) -> String {
    let story = report.story;
    let two_digits = |value: f64| decimal(value, 2, report.language);
    let row = |number: u32, of: &RecordedParameter| {
        let RecordedParameter {
            name,
            unit,
            estimate,
            expanded_uncertainty,
            compensated,
            total_correction,
            rms_reduction_um,
        } = of;
        let unit = escaped(unit);
        format!(
            "<tr><td class=\"n\">{number}</td><td>{}</td><td class=\"n\">{} \u{b1} {} {unit}</td>\
             <td class=\"n\">{} {unit}</td><td class=\"n\">{} {unit}</td><td class=\"n\">{}</td></tr>\n",
            escaped(name),
            two_digits(*estimate),
            two_digits(*expanded_uncertainty),
            two_digits(*compensated),
            two_digits(*total_correction),
            two_digits(*rms_reduction_um)
        )
    };
    let rows: String =
        story.cycles.iter().flat_map(|(number, cycle)| cycle.parameters.iter().map(|of| row(*number, of))).collect();
    if rows.is_empty() {
        return String::new();
    }
    let stated = story.cycles.iter().filter(|(_, cycle)| !cycle.parameters.is_empty());
    let left = stated.filter_map(|(number, cycle)| Some((number, cycle.map_rms_mm?)));
    let [cycle, left_for_map] = [Text::Cycle, Text::ErrorLeftForMap].map(|text| report.say(text));
    let left: String = left
        .map(|(number, mm)| format!("<p>{left_for_map}, {cycle} {number}: {}</p>\n", two_digits(1e3 * mm)))
        .collect();
    let heads = [
        (Text::Parameter, ""),
        (Text::EstimatedError, " class=\"n\""),
        (Text::Compensated, " class=\"n\""),
        (Text::CorrectionOfNextPass, " class=\"n\""),
        (Text::ReducesRmsBy, " class=\"n\""),
    ];
    let heads = heads.map(|(text, class)| format!("<th{class}>{}</th>", report.say(text))).concat();
    format!(
        "<h3>{}</h3>\n<table id=\"parameters\">\n<thead><tr><th class=\"n\">{cycle}</th>{heads}</tr></thead>\n{rows}</table>\n{left}",
        report.say(Text::ParametersOfMachine)
    )
}

fn measurement(report: &Report, number: u32, of: &Measurement, tolerance: Option<&Tolerance>, level: &str) -> String {
    let (judged, reason) = judgement_of(report, of);
    let figures = match &of.figures {
        Some(figures) => figures_row(report, figures, tolerance, level),
        None => "<td class=\"n\">-</td>".repeat(6),
    };
    let remarks = of.figures.iter().flat_map(|figures| figures.weak_directions.iter().chain(&figures.warnings));
    let remarks: String = remarks.map(|remark| format!("<br/>{}", escaped(remark))).collect();
    format!(
        "<tr class=\"of\"><td class=\"n\">{number}</td><td class=\"t\">{}</td>{figures}</tr>\n\
         <tr><td></td><td colspan=\"7\">{}{remarks}</td></tr>\n",
        escaped(&judged),
        escaped(&reason)
    )
}

/// Returns the HTML table cells for the figures `f` of a measurement: PV and RMS with their expanded uncertainties in
/// micrometres, the number of points, the number of outliers, the coverage in percent, and `level`. `level` is the text
/// of the last cell: the height of the target surface above the nominal surface in micrometres, or "-". With a
/// `tolerance`, PV and RMS are the figures that are compared with the limits. Without a `tolerance`, PV and RMS are
/// those of all measured points.
fn figures_row(report: &Report, f: &Figures, tolerance: Option<&Tolerance>, level: &str) -> String {
    let number = |value: f64, digits: usize| decimal(value, digits, report.language);
    // Each record contains the tolerance of the run; if the run ended before that, the figures of the points are shown.
    let points = || [[f.pv_mm, f.pv_expanded_mm], [f.rms_mm, f.rms_expanded_mm]];
    let of = |tolerance: &Tolerance| tolerance.compare(f).map(|compared| [compared.median_mm, compared.expanded_mm]);
    let [[pv_mm, pv_expanded_mm], [rms_mm, rms_expanded_mm]] = tolerance.map_or_else(points, of);
    format!(
        "<td class=\"n\">{} \u{b1} {}</td><td class=\"n\">{} \u{b1} {}</td><td class=\"n\">{}</td><td class=\"n\">{}</td>\
         <td class=\"n\">{} %</td><td class=\"n\">{level}</td>",
        number(1e3 * pv_mm, 2),
        number(1e3 * pv_expanded_mm, 2),
        number(1e3 * rms_mm, 3),
        number(1e3 * rms_expanded_mm, 3),
        f.points,
        f.outliers,
        number(1e2 * f.coverage, 1)
    )
}

/// Returns two texts about a measurement: the verdict of its last judgement, and the reason for it. The earlier
/// judgements of the same measurement follow after the reason. If the measurement was not judged, the first text says so,
/// and the second one is the reason why the measurement is not usable, or empty.
fn judgement_of(report: &Report, measurement: &Measurement) -> (String, String) {
    let Some((last, earlier)) = measurement.judgements.split_last() else {
        let found = if measurement.figures.is_some() { Text::NotJudged } else { Text::NoFigures };
        return (report.say(found).to_owned(), measurement.unusable.clone().unwrap_or_default());
    };
    let earlier: String = earlier.iter().map(|earlier| format!("; first {}", judgement_words(earlier))).collect();
    (texts::verdict_in_words(last.verdict, report.language), format!("{}{earlier}", last.reason))
}

/// Returns the definitions of the figures, with the rule by which the part was judged.
fn definitions(report: &Report) -> String {
    let Some(tolerance) = report.story.tolerance() else { return String::new() };
    let pv = report.say(match tolerance.pv_points {
        PvPoints::All => Text::PvOfPoints,
        PvPoints::MostPoints => Text::PvOfAperture,
    });
    let [title, text] = [Text::Definitions, Text::Definition].map(|text| report.say(text));
    let rule = if tolerance.with_uncertainty { report.say(Text::RuleOfRejection) } else { "" };
    format!("<h2>{title}</h2>\n<p>{text} {pv} {rule}</p>\n")
}

/// Returns the files from which the run was made, with their hashes, the person and the program.
fn traceability(report: &Report) -> String {
    let story = report.story;
    let Some(first) = &story.begin else { return String::new() };
    let [_, recipe, cell] = story.start.content.names();
    let part = story.start.content.part();
    let hashes = part.map_or([None, None, None], |part| {
        [&part.recipe_sha256, &part.cell_sha256, &part.nominal_sha256].map(Option::as_deref)
    });
    let missing = report.say(Text::NotOnRecord);
    let source = |[path, sha256]: [Option<&str>; 2]| {
        format!("{}, sha256 {}", path.unwrap_or(missing), sha256.unwrap_or(missing))
    };
    let facts = [
        (Text::Recipe, source([recipe, hashes[0]])),
        (Text::Cell, source([cell, hashes[1]])),
        (Text::NominalSurface, format!("sha256 {}", hashes[2].unwrap_or(missing))),
        (Text::Operator, format!("{} at {}", first.actor, first.station)),
        (Text::Program, format!("Regrind {}", story.start.regrind.as_deref().unwrap_or_default())),
    ];
    let row =
        |(key, value): &(Text, String)| format!("<tr><th>{}</th><td>{}</td></tr>\n", report.say(*key), escaped(value));
    let rows: String = facts.iter().map(row).collect();
    format!("<h2>{}</h2>\n<table id=\"sources\">\n{rows}</table>\n", report.say(Text::Traceability))
}

/// Returns the table of the alarms. Each alarm has a row with its times and the people who can clear it, and a second row
/// with its cause, consequence and remedy.
fn alarms(report: &Report) -> String {
    let title = report.say(Text::Alarms);
    if report.story.alarms.is_empty() {
        return format!("<h2>{title}</h2>\n<p>{}</p>\n", report.say(Text::NoAlarm));
    }
    let row = |told: &AlarmHistory| {
        let withdrawn = told.withdrawn.as_deref().map_or(report.say(Text::NotWithdrawn).to_owned(), when);
        format!(
            "<tr class=\"of\"><td class=\"t\">{}</td><td class=\"t\">{}</td><td class=\"t\">{}</td></tr>\n<tr><td colspan=\"3\">{}</td></tr>\n",
            escaped(&when(&told.raised)),
            escaped(&withdrawn),
            escaped(&texts::role(told.alarm.cleared_by, report.language)),
            escaped(&texts::alarm(&told.alarm, report.language))
        )
    };
    let rows: String = report.story.alarms.iter().map(row).collect();
    let heads = [Text::Raised, Text::Withdrawn, Text::ClearedBy];
    let heads = heads.map(|head| format!("<th>{}</th>", report.say(head))).concat();
    format!("<h2>{title}</h2>\n<table id=\"alarms\">\n<thead><tr>{heads}</tr></thead>\n{rows}</table>\n")
}

/// Returns the answer to an order of a person: accepted, or refused with the reason. An order that went directly to a
/// machine and not to the cell has no answer of its own, because later records show its result.
fn answer(report: &Report, order: &Order) -> String {
    match (&order.refused, &order.event) {
        (Some(reason), _) => format!("{}: {reason}", report.say(Text::AnswerRefused)),
        (None, Some(_)) => report.say(Text::AnswerAccepted).to_owned(),
        (None, None) => report.say(Text::AnswerOnRecord).to_owned(),
    }
}

fn orders(report: &Report) -> String {
    let row = |order: &Order| {
        let record = &order.record;
        [when(&record.utc), format!("{} at {}", record.actor, record.station), order.words(), answer(report, order)]
    };
    let heads = [Text::Given, Text::By, Text::Order, Text::Answer];
    table(report, [Text::OrdersAndConfirmations, Text::NoOrder], "orders", heads, report.story.orders.iter().map(row))
}

fn table(
    report: &Report,
    [title, none]: [Text; 2],
    id: &str,
    heads: [Text; 4],
    rows: impl Iterator<Item = [String; 4]>,
) -> String {
    let [title, none] = [title, none].map(|text| report.say(text));
    let rows: String = rows
        .map(|row| {
            let [first, second, third, fourth] = row.map(|cell| escaped(&cell));
            format!(
                "<tr><td class=\"t\">{first}</td><td class=\"t\">{second}</td><td>{third}</td><td>{fourth}</td></tr>\n"
            )
        })
        .collect();
    if rows.is_empty() {
        return format!("<h2>{title}</h2>\n<p>{none}</p>\n");
    }
    let heads: String = heads.iter().map(|head| format!("<th>{}</th>", report.say(*head))).collect();
    format!("<h2>{title}</h2>\n<table id=\"{id}\">\n<thead><tr>{heads}</tr></thead>\n{rows}</table>\n")
}
