//! Report of a run: one HTML file that opens without a network, made from the journal and the files on record.
//!
//! It is made only from a record that passes verification. It ends with the hash of the last record, so that a reader
//! of the report can check if a journal is the one that the report was made from.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::ReportError;
use super::convergence::convergence;
use super::equipment::{equipment, last_model, last_registration, registered, signatures};
use super::form::form;
use super::maps::{maps, within_html};
use super::run_history::{Measurement, PassHistory, RunHistory};
use super::words::{alarm_words, ending_words, home_words, judgement_words, role_words, verdict_words};
use regrind_cell::{ComparedFigure, Conformity, Ending, Figures, JobResult, RecordedParameter, Tolerance};
use regrind_formats::run_files::RunFile;
use regrind_formats::{escaped, write_atomic};
use regrind_journal::Verified;
use regrind_record::TouchCounts;

const STYLE: &str = "body{font:15px/1.45 Helvetica,Arial,sans-serif;color:#222;max-width:62em;margin:2em auto;padding:0 1em}\
h1{font-size:1.6em;margin:0}h2{font-size:1.15em;margin:2em 0 .5em}table{border-collapse:collapse}\
td,th{padding:.25em .8em;text-align:left;border-bottom:1px solid #ddd;vertical-align:top}td.n,th.n{text-align:right;\
white-space:nowrap;font-variant-numeric:tabular-nums}td.t{white-space:nowrap}\
.mark{background:#222;color:#fff;padding:.4em .8em;font-weight:bold;letter-spacing:.15em}\
.good,.bad{padding:.6em .8em;font-weight:bold}.good{background:#d5ead0}.bad{background:#f7d9d0}\
#judged td{font-size:1.1em}tr.of td{border-bottom:none;padding-top:.6em}figure{display:inline-block;margin:0 .5em 1em 0;max-width:100%}figure svg{max-width:100%;height:auto}\
figcaption{color:#555}code{font-size:.85em;word-break:break-all}\
footer{margin-top:2.5em;border-top:1px solid #ddd;color:#555}\
#signatures td{min-width:11em;height:2.6em;border-bottom:1px solid #222}\
@page{size:auto;margin:14mm}@media print{body{font-size:10.5pt;max-width:none;margin:0;padding:0}\
h2{break-after:avoid}figure,tr,#signatures,footer{break-inside:avoid}.good,.bad,.mark{print-color-adjust:exact}\
td,th{padding:.2em .5em}}";

/// Verifies the record in the run folder `folder`, writes the HTML report of the run (`report.html`) into this folder,
/// and returns its path.
///
/// # Errors
/// Fails if the record is missing or does not pass verification, if a file on record cannot be read, or if the report
/// cannot be written.
pub fn write_run_report(folder: &Path) -> Result<PathBuf, ReportError> {
    let path = folder.join(RunFile::Report.name());
    write_atomic(&path, run_report(folder)?.as_bytes())?;
    Ok(path)
}

/// Verifies the record in the run folder `folder` and returns the report of the run as HTML.
///
/// # Errors
/// Fails if the record is missing or does not pass verification, or if a file on record cannot be read.
pub fn run_report(folder: &Path) -> Result<String, ReportError> {
    let (story, verified) = RunHistory::read_verified(folder)?;
    html(&story, folder, &verified)
}

fn html(story: &RunHistory, folder: &Path, verified: &Verified) -> Result<String, ReportError> {
    let [name, ..] = story.start.content.names();
    let (name, run) = (escaped(name.unwrap_or("Part")), escaped(story.start.run.as_deref().unwrap_or_default()));
    let serial = story.begin.as_ref().map_or(String::new(), |begin| format!(", {}", escaped(&begin.part)));
    let mark = if story.start.simulation == Some(true) { "<p class=\"mark\">SIMULATION</p>\n" } else { "" };
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n<title>{name}, {run}</title>\n\
         <style>{STYLE}</style>\n</head>\n<body>\n{mark}<h1>{name}{serial}</h1>\n"
    );
    html += &verdict(story);
    html += &broken_off_pass(story);
    html += &judged(story);
    let registration = last_registration(story, folder)?;
    html += &facts(story);
    html += &equipment(story, registration.as_ref().map(|(_, found)| found));
    html += &cycles(story);
    if let Some(plot) = convergence(story) {
        let _ = writeln!(html, "<figure>{}</figure>", within_html(&plot));
    }
    html += &maps(story, folder)?;
    html += &registration
        .map_or(String::new(), |(cycle, found)| registered(cycle, &found, last_model(story, folder).as_ref()));
    html += &form(story, folder)?;
    html += &alarms(story);
    html += &orders(story);
    html += &signatures();
    let Verified { records, head, closed, signed, .. } = verified;
    let end = if *closed { "closed" } else { "not closed yet" };
    let by = verified.keys.iter().map(|key| format!("<br/><code>{key}</code>")).collect::<String>();
    let by = if by.is_empty() { "Not signed.".into() } else { format!("Signed up to record {signed} with:{by}") };
    let _ = write!(
        html,
        "<footer><p>Made from {records} records in an unbroken chain ({end}). Hash of the last record:<br/><code>{head}</code><br/>{by}<br/>\
         To verify the record again: <code>regrind audit verify</code></p></footer>\n</body>\n</html>\n"
    );
    Ok(html)
}

fn verdict(story: &RunHistory) -> String {
    let (class, words) = match (&story.ending, story.home) {
        (Some(ending @ Ending::Accepted { .. }), _) => ("good", ending_words(ending)),
        (Some(ending), _) => ("bad", ending_words(ending)),
        (None, Some(home)) => (if home == [true, true] { "good" } else { "bad" }, home_words(home)),
        (None, None) => ("bad", "The run has not ended.".to_owned()),
    };
    let unrecorded = story.ending.is_some() && story.end.is_none();
    let more = if unrecorded { "<p>The record of the run is incomplete: its end is missing.</p>\n" } else { "" };
    format!("<p class=\"{class}\">{}</p>\n{more}", escaped(&words))
}

/// Returns an HTML paragraph about an incomplete last pass: how the pass ended, and which percentage of its path was
/// ground, if the grinder reported this. Returns an empty text if the last pass is complete, or if no pass was started.
fn broken_off_pass(story: &RunHistory) -> String {
    let Some(PassHistory { cycle, ground, result }) = story.pass else { return String::new() };
    let how = match result {
        Some(JobResult::Complete) => return String::new(),
        Some(JobResult::Stopped) => "was stopped",
        Some(JobResult::Aborted) => "was aborted",
        Some(JobResult::Failed) => "failed",
        None => "has no end on record",
    };
    let far = match ground {
        Some([done, total]) if total > 0 => {
            format!(
                "{:.0} % of the path was ground, according to the last report of the grinder",
                100.0 * f64::from(done) / f64::from(total)
            )
        }
        _ => "the share of the path that was ground is not known".to_owned(),
    };
    format!("<p id=\"pass\">The pass of cycle {cycle} {how}: {far}; the rest of the part is unchanged.</p>\n")
}

/// Returns the HTML table of the judged figures of the last measurement, with their uncertainty, their limits and the
/// decision rule. Returns an empty text if there is no tolerance or no measurement on record.
fn judged(story: &RunHistory) -> String {
    let (Some(tolerance), Some((cycle, of, figures))) = (story.tolerance(), story.last_measured()) else {
        return String::new();
    };
    let judged = if of.judgements.is_empty() { "measured and not judged" } else { "judged" };
    let mut html = format!(
        "<table id=\"judged\">\n<tr><th>{judged}, cycle {cycle}</th><th class=\"n\">found, \u{b5}m</th>\
         <th class=\"n\">U (k = 2), \u{b5}m</th><th class=\"n\">95 % credible interval, \u{b5}m</th><th class=\"n\">limit, \u{b5}m</th><th></th><th></th></tr>\n"
    );
    for compared in tolerance.compare(figures) {
        let ComparedFigure { name, median_mm: found_mm, expanded_mm, interval_mm: [low_mm, high_mm], limit_mm, .. } =
            compared;
        let limit = if limit_mm.is_finite() { um(limit_mm) } else { "no limit".to_owned() };
        let within = escaped(&compared.probability_in_words().unwrap_or_default());
        let _ = writeln!(
            html,
            "<tr><td>{name}</td><td class=\"n\"><strong>{}</strong></td><td class=\"n\">\u{b1} {}</td>\
             <td class=\"n\">{} to {}</td><td class=\"n\">{limit}</td><td>{within}</td><td>{}</td></tr>",
            um(found_mm),
            um(expanded_mm),
            um(low_mm),
            um(high_mm),
            comparison(&compared, tolerance.with_uncertainty)
        );
    }
    html + &format!("</table>\n<p>{}</p>\n", decision_rule(&tolerance))
}

fn um(mm: f64) -> String {
    format!("{:.2}", 1e3 * mm)
}

/// Returns a text that says if a figure is within its limit, beyond it, or not decided. The text includes the compared
/// values in micrometres, such as "within the limit: at most 3.10 ≤ 7.00". `with_uncertainty` is true if the decision
/// rule uses the uncertainty of the figure. Returns an empty text if the figure has no limit.
fn comparison(compared: &ComparedFigure, with_uncertainty: bool) -> String {
    let ComparedFigure { median_mm: found_mm, compared_mm: [low_mm, high_mm], limit_mm, conformity, .. } = *compared;
    if !limit_mm.is_finite() {
        return String::new();
    }
    let words = match conformity {
        Conformity::Within => "within the limit",
        Conformity::Undecided => "not decided",
        Conformity::Beyond => "beyond the limit",
    };
    let beside = |what: &str, value: f64| {
        let is = if value <= limit_mm { "\u{2264}" } else { "&gt;" };
        // Two different numbers must not be shown as the same number.
        let alike = um(value) == um(limit_mm) && value != limit_mm;
        let digits = if alike { 5 } else { 2 };
        let [value, limit] = [value, limit_mm].map(|mm| format!("{:.digits$}", 1e3 * mm));
        format!("{what}{value} {is} {limit}")
    };
    let sums = match (with_uncertainty, conformity) {
        (false, _) => beside("", found_mm),
        (true, Conformity::Within) => beside("at most ", high_mm),
        (true, Conformity::Beyond) => beside("at least ", low_mm),
        (true, Conformity::Undecided) => format!("{}, {}", beside("at most ", high_mm), beside("at least ", low_mm)),
    };
    format!("{words}: {sums}")
}

fn decision_rule(tolerance: &Tolerance) -> String {
    let rule = if tolerance.with_uncertainty {
        format!(
            "Decision rule, after ISO 14253-1 and JCGM 106: the part is accepted only if each figure is within its limit with a \
             probability of at least {:.1} %. The part is out of tolerance only if at least one figure is \
             beyond its limit with at least this probability. In all other cases, the result is undecided.",
            1e2 * tolerance.probability
        )
    } else {
        "Decision rule: each figure is compared with its limit. The uncertainty of the figure is shown, but the comparison \
         does not use this uncertainty."
            .to_owned()
    };
    format!(
        "{rule} The figures describe the form of the part after the best fit of the form, without the noise of the probe. The \
         uncertainty of each figure includes the noise of the probe and the uncertainty of the pose. If no form error is detectable, only an \
         upper bound of a figure is known. U is half of the 95 % credible interval of the figure. PV is the largest deviation minus the \
         smallest deviation along the normal of the surface{}.",
        match tolerance.pv_points {
            regrind_cell::PvPoints::All => ", of the measured points",
            regrind_cell::PvPoints::MostPoints =>
                "; PV 99.8 % is the PV over the aperture (the measured points and the positions between the points). The lowest 0.1 % and the highest 0.1 % are left out, but never a measured point",
        }
    )
}

fn facts(story: &RunHistory) -> String {
    let Some(first) = &story.begin else { return String::new() };
    let [_, recipe, cell] = story.start.content.names();
    let part = story.start.content.part();
    let hashes = part.map_or([None, None], |part| [part.recipe_sha256.as_deref(), part.cell_sha256.as_deref()]);
    let source = |texts: [Option<&str>; 2]| {
        let [path, sha256] = texts.map(|text| text.unwrap_or("not recorded"));
        format!("{path}, sha256 {sha256}")
    };
    let ended = story.end.as_ref().map_or("not yet".to_owned(), |end| when(&end.utc));
    let facts = [
        ("Serial number", first.part.clone()),
        ("Run", story.start.run.clone().unwrap_or_default()),
        ("Recipe", source([recipe, hashes[0]])),
        ("Cell", source([cell, hashes[1]])),
        ("Operator", format!("{} at {}", first.actor, first.station)),
        ("Began", when(&first.utc)),
        ("Ended", ended),
        ("Regrind", story.start.regrind.clone().unwrap_or_default()),
    ];
    let rows = facts.iter().map(|(key, value)| format!("<tr><th>{key}</th><td>{}</td></tr>\n", escaped(value)));
    format!("<h2>Run</h2>\n<table>\n{}</table>\n", rows.collect::<String>())
}

/// Formats a time from a record in a readable form, without fractions of a second, such as "2026-01-31 09:15:00 UTC".
/// `utc` is a time in UTC in the format RFC 3339.
pub(super) fn when(utc: &str) -> String {
    let second: String = utc.chars().take(19).collect();
    format!("{} UTC", second.replacen('T', " ", 1))
}

/// Returns the HTML table of the cycles. Each measurement has a row with its verdict and figures, and a second row with
/// the reason for the verdict and remarks.
fn cycles(story: &RunHistory) -> String {
    let tolerance = story.tolerance();
    let named = |m: &Measurement| Some(tolerance.as_ref()?.compare(m.figures.as_ref()?)[0].name);
    let named = story.cycles.values().flat_map(|cycle| &cycle.measurements).filter_map(named).next_back();
    let mut html = format!(
        "<h2>Cycles</h2>\n<table id=\"cycles\">\n<tr><th class=\"n\">cycle</th><th>judged</th><th class=\"n\">{}, \u{b5}m</th>\
         <th class=\"n\">RMS, \u{b5}m</th><th class=\"n\">points</th><th class=\"n\">outliers</th>\
         <th class=\"n\">coverage</th><th class=\"n\">level, \u{b5}m</th></tr>\n",
        named.unwrap_or("PV")
    );
    for (number, cycle) in &story.cycles {
        let level = cycle.level_um.map_or("-".to_owned(), |level| format!("{level:.1}"));
        let none = [Measurement { unusable: Some("not measured".into()), ..Measurement::default() }];
        let measurements = if cycle.measurements.is_empty() { &none[..] } else { &cycle.measurements };
        html.extend(measurements.iter().map(|of| measurement(*number, of, tolerance.as_ref(), &level)));
    }
    let touches = story.touches.map_or(String::new(), |TouchCounts { taken, whole_patterns }| {
        format!("<p>Adaptive measurement: {taken} touches; whole patterns would need {whole_patterns}.</p>\n")
    });
    html + "</table>\n"
        + &touches
        + &parameters(story)
        + "<p>Deviations are along the normal, positive where material is proud; \u{b1} is the expanded uncertainty \
            (k = 2). The level is the height of the target surface above the nominal surface.</p>\n"
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
fn parameters(story: &RunHistory) -> String {
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
        format!(
            "<tr><td class=\"n\">{number}</td><td>{}</td><td class=\"n\">{estimate:.2} \u{b1} {expanded_uncertainty:.2} {unit}</td>\
             <td class=\"n\">{compensated:.2} {unit}</td><td class=\"n\">{total_correction:.2} {unit}</td><td class=\"n\">{rms_reduction_um:.2}</td></tr>\n",
            escaped(name)
        )
    };
    let rows: String =
        story.cycles.iter().flat_map(|(number, cycle)| cycle.parameters.iter().map(|of| row(*number, of))).collect();
    if rows.is_empty() {
        return String::new();
    }
    let stated = story.cycles.iter().filter(|(_, cycle)| !cycle.parameters.is_empty());
    let left = stated.filter_map(|(number, cycle)| Some((number, cycle.map_rms_mm?)));
    let left: String = left
        .map(|(number, mm)| {
            format!("<p>Error that remains for the correction map after cycle {number}: {} µm RMS.</p>\n", um(mm))
        })
        .collect();
    format!(
        "<h3>Parameters of the machine</h3>\n<table id=\"parameters\">\n<tr><th class=\"n\">cycle</th><th>parameter</th>\
         <th class=\"n\">deviation</th><th class=\"n\">compensated</th><th class=\"n\">correction of the next pass</th>\
         <th class=\"n\">reduces the error by, \u{b5}m rms</th></tr>\n{rows}</table>\n{left}"
    )
}

fn measurement(number: u32, of: &Measurement, tolerance: Option<&Tolerance>, level: &str) -> String {
    let (judged, reason) = judgement_of(of);
    let figures = match &of.figures {
        Some(figures) => figures_row(figures, tolerance, level),
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
fn figures_row(f: &Figures, tolerance: Option<&Tolerance>, level: &str) -> String {
    // Each record contains the tolerance of the run; if the run ended before that, the figures of the points are shown.
    let points = || [[f.pv_mm, f.pv_expanded_mm], [f.rms_mm, f.rms_expanded_mm]];
    let of = |tolerance: &Tolerance| tolerance.compare(f).map(|compared| [compared.median_mm, compared.expanded_mm]);
    let [[pv_mm, pv_expanded_mm], [rms_mm, rms_expanded_mm]] = tolerance.map_or_else(points, of);
    format!(
        "<td class=\"n\">{} \u{b1} {}</td><td class=\"n\">{:.3} \u{b1} {:.3}</td><td class=\"n\">{}</td><td class=\"n\">{}</td>\
         <td class=\"n\">{:.1} %</td><td class=\"n\">{level}</td>",
        um(pv_mm),
        um(pv_expanded_mm),
        1e3 * rms_mm,
        1e3 * rms_expanded_mm,
        f.points,
        f.outliers,
        1e2 * f.coverage
    )
}

/// Returns two texts about a measurement: the verdict of its last judgement, and the reason for it. The earlier
/// judgements of the same measurement follow after the reason. If the measurement was not judged, the verdict is "not
/// judged", or "no figures" if the measurement has no figures. The second text is then the reason why the measurement
/// is not usable, or empty.
fn judgement_of(measurement: &Measurement) -> (String, String) {
    let unusable = || measurement.unusable.clone().unwrap_or_default();
    let Some((last, earlier)) = measurement.judgements.split_last() else {
        let found = if measurement.figures.is_some() { "not judged" } else { "no figures" };
        return (found.to_owned(), unusable());
    };
    let earlier: String = earlier.iter().map(|earlier| format!("; first {}", judgement_words(earlier))).collect();
    (verdict_words(last), format!("{}{earlier}", last.reason))
}

fn alarms(story: &RunHistory) -> String {
    let row = |told: &super::run_history::AlarmHistory| {
        let withdrawn = told.withdrawn.as_deref().map_or("not withdrawn".to_owned(), when);
        [when(&told.raised), withdrawn, alarm_words(&told.alarm), role_words(&told.alarm)]
    };
    let heads = ["raised", "withdrawn", "cause, consequence, remedy", "cleared by"];
    table("Alarms", "alarms", "No alarm was raised.", heads, story.alarms.iter().map(row))
}

fn orders(story: &RunHistory) -> String {
    let row = |order: &super::run_history::Order| {
        let record = &order.record;
        [when(&record.utc), format!("{} at {}", record.actor, record.station), order.words(), order.answer()]
    };
    let heads = ["given", "by", "order", "answer"];
    table("Orders and confirmations", "orders", "No order was given.", heads, story.orders.iter().map(row))
}

fn table(title: &str, id: &str, none: &str, heads: [&str; 4], rows: impl Iterator<Item = [String; 4]>) -> String {
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
    let heads: String = heads.iter().map(|head| format!("<th>{head}</th>")).collect();
    format!("<h2>{title}</h2>\n<table id=\"{id}\">\n<tr>{heads}</tr>\n{rows}</table>\n")
}
