//! The report of a run: one HTML file that opens without a network, made from the journal and the pictures on record.
//!
//! It is made only from a record that can be believed, and it ends with the hash of the last record: whoever holds the
//! report can tell whether a journal is the one that it was made from.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

use super::ReportError;
use super::axis::three_digits;
use super::words::{ending_words, words};
use regrind_cell::{Alarm, Command, Ending, Event, Figures, Judgement};
use regrind_formats::{FormatError, escaped, write_atomic};
use regrind_journal::{Kind, Reader, Record, Verified, verify};

/// The report in a run folder.
pub const RUN_REPORT: &str = "report.html";

/// The picture of a cycle.
const PICTURE: &str = "error_map.png";

/// The figures of a cycle.
const FIGURES: &str = "figures.json";

const STYLE: &str = "body{font:15px/1.45 Helvetica,Arial,sans-serif;color:#222;max-width:62em;margin:2em auto;padding:0 1em}\
h1{font-size:1.6em;margin:0}h2{font-size:1.15em;margin:2em 0 .5em}table{border-collapse:collapse}\
td,th{padding:.25em .8em;text-align:left;border-bottom:1px solid #ddd;vertical-align:top}td.n,th.n{text-align:right;\
font-variant-numeric:tabular-nums}.mark{background:#222;color:#fff;padding:.4em .8em;font-weight:bold;letter-spacing:.15em}\
.good,.bad{padding:.6em .8em;font-weight:bold}.good{background:#d5ead0}.bad{background:#f7d9d0}figure{display:inline-block;\
margin:0 1em 1em 0}figure img{width:18em;image-rendering:pixelated;border:1px solid #ddd;display:block}\
code{font-size:.85em;word-break:break-all}footer{margin-top:2.5em;border-top:1px solid #ddd;color:#555}";

/// What the journal tells of a run, as far as a report shows it.
#[derive(Default)]
struct Story {
    begin: Option<Record>,
    end: Option<Record>,
    ending: Option<Ending>,
    cycles: BTreeMap<u32, CycleStory>,
    alarms: Vec<(String, Alarm)>,
    orders: Vec<Record>,
}

#[derive(Default)]
struct CycleStory {
    figures: Option<Figures>,
    judgement: Option<Judgement>,
    /// Height of the surface that was wanted over the nominal one.
    level_um: Option<f64>,
    /// Name of the picture within the run folder.
    picture: Option<String>,
    /// Name of the file of figures within the run folder.
    form: Option<String>,
}

/// Proves the record of a run, writes its report beside it and returns the name of the report.
///
/// # Errors
/// A record that is not there or cannot be believed, a picture that cannot be read, a folder that cannot be written.
pub fn write_run_report(folder: &Path) -> Result<PathBuf, ReportError> {
    let path = folder.join(RUN_REPORT);
    write_atomic(&path, run_report(folder)?.as_bytes())?;
    Ok(path)
}

/// Makes the report of a run from its record.
///
/// # Errors
/// A record that cannot be believed, a picture that cannot be read.
pub fn run_report(folder: &Path) -> Result<String, ReportError> {
    let verified = verify(folder)?;
    let mut story = Story::default();
    for record in Reader::open(folder)?.records(0).take(verified.records as usize) {
        story.take(record?);
    }
    story.html(folder, &verified)
}

impl Story {
    fn take(&mut self, record: Record) {
        let value = record.value();
        match record.kind {
            Kind::Begin => self.begin = Some(record),
            Kind::Intent => self.take_command(record, value),
            Kind::Event => match serde_json::from_value(value) {
                Ok(Event::Registered { cycle, figures }) => self.cycle(cycle).figures = Some(figures),
                Ok(event) if event.actor().is_some() => self.orders.push(record),
                _ => {}
            },
            Kind::Artefact => {
                let name = value["name"].as_str().unwrap_or_default();
                // What was computed again after an interruption stands in a folder of its own; the last counts.
                let of_cycle = name.starts_with(&format!("cycle-{}/", record.cycle));
                if of_cycle && name.ends_with(&format!("/{PICTURE}")) {
                    self.cycle(record.cycle).picture = Some(name.to_owned());
                }
                if of_cycle && name.ends_with(&format!("/{FIGURES}")) {
                    self.cycle(record.cycle).form = Some(name.to_owned());
                }
            }
            Kind::End => {
                for row in value["ending"]["cycles"].as_array().into_iter().flatten() {
                    if let Some(cycle) = row["cycle"].as_u64().and_then(|cycle| u32::try_from(cycle).ok()) {
                        self.cycle(cycle).level_um = row["level_um"].as_f64();
                    }
                }
                self.end = Some(record);
            }
            Kind::Reopen | Kind::Outcome | Kind::Note | Kind::Seal => {}
        }
    }

    fn take_command(&mut self, record: Record, value: Value) {
        match serde_json::from_value(value) {
            Ok(Command::Raise(alarm)) => self.alarms.push((record.utc, alarm)),
            Ok(Command::Announce(judgement)) => {
                let cycle = judgement.cycle;
                self.cycle(cycle).judgement = Some(judgement);
            }
            Ok(Command::Finish(ending)) => self.ending = Some(ending),
            _ => {}
        }
    }

    fn cycle(&mut self, number: u32) -> &mut CycleStory {
        self.cycles.entry(number).or_default()
    }

    fn html(&self, folder: &Path, verified: &Verified) -> Result<String, ReportError> {
        let begin = self.begin.as_ref().map(Record::value).unwrap_or_default();
        let name = begin["content"]["part_name"].as_str().unwrap_or("Part");
        let run = begin["run"].as_str().unwrap_or_default();
        let (name, run) = (escaped(name), escaped(run));
        let mark = if begin["simulation"] == true { "<p class=\"mark\">SIMULATION</p>\n" } else { "" };
        let mut html = format!(
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n<title>{name}, {run}</title>\n\
             <style>{STYLE}</style>\n</head>\n<body>\n{mark}<h1>{name}</h1>\n"
        );
        html += &self.verdict();
        html += &self.facts(&begin);
        html += &self.figures();
        html += &self.form(folder)?;
        html += &self.pictures(folder)?;
        html += &self.happenings();
        let Verified { records, head, closed, signed, .. } = verified;
        let end = if *closed { "closed" } else { "not closed yet" };
        let by = verified.keys.iter().map(|key| format!("<br/><code>{key}</code>")).collect::<String>();
        let by = if by.is_empty() { "Not signed.".into() } else { format!("Signed up to record {signed} with:{by}") };
        let _ = write!(
            html,
            "<footer><p>Made from {records} records in an unbroken chain ({end}). Hash of the last:<br/><code>{head}</code><br/>{by}<br/>\
             To prove it again: <code>regrind audit verify</code></p></footer>\n</body>\n</html>\n"
        );
        Ok(html)
    }

    fn verdict(&self) -> String {
        match &self.ending {
            Some(ending) => {
                let class = if matches!(ending, Ending::Accepted { .. }) { "good" } else { "bad" };
                format!("<p class=\"{class}\">{}</p>\n", escaped(&ending_words(ending)))
            }
            None => "<p class=\"bad\">The run has not come to its end.</p>\n".to_owned(),
        }
    }

    fn facts(&self, begin: &Value) -> String {
        let Some(first) = &self.begin else { return String::new() };
        let content = |key: &str| begin["content"][key].as_str().unwrap_or("not recorded").to_owned();
        let source = |key: &str| format!("{}, sha256 {}", content(key), content(&format!("{key}_sha256")));
        let ended = self.end.as_ref().map_or("not yet".to_owned(), |end| end.utc.clone());
        let facts = [
            ("Serial number", first.part.clone()),
            ("Run", begin["run"].as_str().unwrap_or_default().to_owned()),
            ("Recipe", source("recipe")),
            ("Cell", source("cell")),
            ("Operator", format!("{} at {}", first.actor, first.station)),
            ("Began (UTC)", first.utc.clone()),
            ("Ended (UTC)", ended),
            ("Regrind", begin["regrind"].as_str().unwrap_or_default().to_owned()),
        ];
        let rows = facts.iter().map(|(key, value)| format!("<tr><th>{key}</th><td>{}</td></tr>\n", escaped(value)));
        format!("<table>\n{}</table>\n", rows.collect::<String>())
    }

    fn figures(&self) -> String {
        let mut html = "<h2>Cycles</h2>\n<table>\n<tr><th class=\"n\">cycle</th><th class=\"n\">PV, \u{b5}m</th>\
             <th class=\"n\">rms, \u{b5}m</th><th class=\"n\">points</th><th class=\"n\">outliers</th>\
             <th class=\"n\">coverage</th><th class=\"n\">level, \u{b5}m</th><th>judged</th></tr>\n"
            .to_owned();
        for (number, cycle) in &self.cycles {
            let Some(f) = &cycle.figures else { continue };
            let level = cycle.level_um.map_or("-".to_owned(), |level| format!("{level:.1}"));
            let judged = cycle.judgement.as_ref().map_or("-", |judgement| judgement.reason.as_str());
            let _ = writeln!(
                html,
                "<tr><td class=\"n\">{number}</td><td class=\"n\">{:.2} \u{b1} {:.2}</td><td class=\"n\">{:.3} \u{b1} {:.3}</td>\
                 <td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{:.1} %</td><td class=\"n\">{level}</td><td>{}</td></tr>",
                1e3 * f.pv_mm,
                1e3 * f.pv_expanded_mm,
                1e3 * f.rms_mm,
                1e3 * f.rms_expanded_mm,
                f.points,
                f.outliers,
                1e2 * f.coverage,
                escaped(judged)
            );
        }
        html + "</table>\n<p>PV and rms are those of the deviations along the normal, positive where material stands proud; \
                \u{b1} is the expanded uncertainty (k = 2) by the scatter of the points. The level is the height of the surface \
                that was wanted over the nominal one.</p>\n"
    }

    /// A row a figure, a column a cycle, and what must be known of each figure.
    fn form(&self, folder: &Path) -> Result<String, ReportError> {
        let mut cycles = Vec::new();
        for (number, cycle) in &self.cycles {
            let Some(name) = &cycle.form else { continue };
            let path = folder.join(name);
            let bytes = fs::read(&path).map_err(|source| FormatError::Unreadable { path: path.clone(), source })?;
            let figures: Value = serde_json::from_slice(&bytes)
                .map_err(|source| FormatError::Unreadable { path, source: io::Error::from(source) })?;
            cycles.push((number, figures));
        }
        let listed = |figures: &Value| figures["figures"].as_array().cloned().unwrap_or_default();
        let named = |figures: &Value, name: &Value| listed(figures).into_iter().find(|row| row["name"] == *name);
        let Some((_, last)) = cycles.last() else { return Ok(String::new()) };
        let heads: String = cycles.iter().map(|(number, _)| format!("<th class=\"n\">cycle {number}</th>")).collect();
        let mut html = format!(
            "<h2>Form of the surface</h2>\n<table>\n<tr><th>figure</th>{heads}<th>unit</th><th>removed</th><th>waves left \
             out</th><th>how</th></tr>\n"
        );
        for row in listed(last) {
            let text = |key: &str| escaped(row[key].as_str().unwrap_or_default());
            let cell = |(_, figures): &(&u32, Value)| {
                let value = named(figures, &row["name"]).and_then(|row| row["value"].as_f64());
                format!("<td class=\"n\">{}</td>", value.map_or("-".to_owned(), three_digits))
            };
            let cells: String = cycles.iter().map(cell).collect();
            let _ = writeln!(
                html,
                "<tr><td>{}</td>{cells}<td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
                text("name"),
                text("unit"),
                text("removed"),
                text("cut_off"),
                text("made")
            );
        }
        html += "</table>\n<p>All along the outward normal, positive where material stands proud; figures of the surface, not \
                 of a wavefront. ISO 10110-5, in nanometres, that the surface just meets:</p>\n<ul>\n";
        for (number, figures) in &cycles {
            let notation = figures["iso_10110_5"]["notation"].as_str().unwrap_or("-");
            let missing = figures["missing"].as_array().into_iter().flatten().filter_map(Value::as_str);
            let missing: String = missing.map(|why| format!("; no {}", escaped(why))).collect();
            let _ = writeln!(html, "<li>cycle {number}: <code>{}</code>{missing}</li>", escaped(notation));
        }
        Ok(html + "</ul>\n")
    }

    fn pictures(&self, folder: &Path) -> Result<String, ReportError> {
        let mut html = String::new();
        for (number, cycle) in &self.cycles {
            let Some(name) = &cycle.picture else { continue };
            let path = folder.join(name);
            let bytes = fs::read(&path).map_err(|source| FormatError::Unreadable { path, source })?;
            let data = STANDARD.encode(bytes);
            let _ = writeln!(
                html,
                "<figure><img alt=\"Error map of cycle {number}\" src=\"data:image/png;base64,{data}\"/>\
                 <figcaption>Cycle {number}</figcaption></figure>"
            );
        }
        Ok(if html.is_empty() { html } else { format!("<h2>Error of the part, filtered</h2>\n{html}") })
    }

    fn happenings(&self) -> String {
        let mut html = String::new();
        let alarms = self.alarms.iter().map(|(utc, alarm)| {
            let remedy = alarm.remedy.join(" ");
            (utc, format!("{} {} {remedy}", alarm.what, alarm.consequence))
        });
        html += &table("Alarms", "No alarm was raised.", alarms.collect());
        let orders = self.orders.iter().map(|r| (&r.utc, format!("{} at {}: {}", r.actor, r.station, words(r))));
        html + &table("Orders of people", "No order was given.", orders.collect())
    }
}

fn table(title: &str, none: &str, rows: Vec<(&String, String)>) -> String {
    if rows.is_empty() {
        return format!("<h2>{title}</h2>\n<p>{none}</p>\n");
    }
    let rows =
        rows.iter().map(|(utc, words)| format!("<tr><td>{}</td><td>{}</td></tr>\n", escaped(utc), escaped(words)));
    format!("<h2>{title}</h2>\n<table>\n{}</table>\n", rows.collect::<String>())
}
