//! First page of a report, which can be filed alone: verdict, judged figures, maps, cycles, machines, record and fields
//! for signatures.

use std::fmt::Write;

use serde_json::Value;

use super::ReportError;
use super::interval_bar::interval_bar;
use super::report_content::{Report, when};
use super::run_history::{Measurement, PassHistory};
use super::shop_header::ShopHeader;
use super::texts::{self, ReportText as Text};
use super::words::{ending_words, home_words};
use regrind_cell::{ComparedFigure, Conformity, Device, Ending, Figures, JobResult, Tolerance};
use regrind_formats::escaped;
use regrind_language::{decimal, localised};

/// Returns the first page as HTML. `registration` is the content of the newest file `registration.json`, if there is one.
///
/// # Errors
/// Fails if a map cannot be drawn because of a file.
pub(super) fn first_page(report: &Report, registration: Option<&Value>) -> Result<String, ReportError> {
    let mut html = String::from("<article class=\"first\">\n");
    html += &report.header.map_or(String::new(), ShopHeader::html);
    html += &head(report);
    html += &broken_off_pass(report);
    html += &judged(report);
    html += &maps(report)?;
    html += &how_it_got_there(report)?;
    html += &made_by_and_record(report, registration);
    html += &signatures(report);
    html += "</article>\n";
    Ok(html)
}

/// Returns the part, its identity, the verdict in a box, and the reason of the end.
fn head(report: &Report) -> String {
    let story = report.story;
    let [name, ..] = story.start.content.names();
    let identity: Vec<String> = identity(report).iter().map(|text| escaped(text)).collect();
    let mark = if story.start.simulation == Some(true) { " <span class=\"mark\">SIMULATION</span>" } else { "" };
    let (class, verdict, words, is_good) = outcome(report);
    let unrecorded = story.ending.is_some() && story.end.is_none();
    let more = if unrecorded { format!("<p>{}</p>\n", report.say(Text::RecordIncomplete)) } else { String::new() };
    format!(
        "<div class=\"head\">\n<div>\n<h1>{}</h1>\n<p>{}{mark}</p>\n<p>{}</p>\n</div>\n\
         <div class=\"verdict {class}\"><strong>{}</strong></div>\n</div>\n<p class=\"{}\">{}</p>\n{more}",
        escaped(name.unwrap_or("Part")),
        identity.join(" \u{b7} "),
        escaped(&inspection(report)),
        report.say(verdict),
        if is_good { "good" } else { "bad" },
        escaped(&words)
    )
}

/// Returns serial number, drawing and material, each with its name.
pub(super) fn identity(report: &Report) -> Vec<String> {
    let part = report.story.start.content.part();
    let stated = [
        (Text::Serial, Some(report.serial())),
        (Text::Drawing, part.and_then(|part| part.drawing.as_deref())),
        (Text::Material, part.and_then(|part| part.material.as_deref())),
    ];
    stated.into_iter().filter_map(|(text, of)| Some(format!("{} {}", report.say(text), of?))).collect()
}

/// Returns the kind of the report, the judged cycle, and the time of the end.
pub(super) fn inspection(report: &Report) -> String {
    let story = report.story;
    let last = story.cycles.keys().next_back().copied().unwrap_or(0);
    let judged = story.last_measured().map_or(last, |(cycle, ..)| cycle);
    let at = story.end.as_ref().map_or(&story.last, |end| &end.utc);
    let kind = report.say(if story.home.is_some() { Text::Recovery } else { Text::FormInspection });
    let cycle = match judged {
        0 => String::new(),
        judged => format!(", {} {judged} {} {last}", report.say(Text::Cycle), report.say(Text::CountOf)),
    };
    format!("{kind}{cycle}, {}", when(at))
}

/// Returns how the run ended: the class of the box, its word, the reason, and true if the end is good.
pub(super) fn outcome(report: &Report) -> (&'static str, Text, String, bool) {
    match (&report.story.ending, report.story.home) {
        (Some(ending), _) => {
            let (class, text) = match ending {
                Ending::Accepted { .. } => ("passed", Text::Accepted),
                Ending::NotAccepted { .. } => ("failed", Text::NotAccepted),
                Ending::Stopped { .. } => ("ended", Text::Stopped),
                Ending::Aborted { .. } => ("failed", Text::Aborted),
            };
            (class, text, ending_words(ending), class == "passed")
        }
        (None, Some([true, true])) => ("ended", Text::MachinesHome, home_words([true, true]), true),
        (None, Some(home)) => ("failed", Text::MachinesNotHome, home_words(home), false),
        (None, None) => ("open", Text::NotEnded, report.say(Text::RunHasNotEnded).to_owned(), false),
    }
}

/// Returns an HTML paragraph about an incomplete last pass: how the pass ended, and which percentage of its path was
/// ground, if the grinder reported this. Returns an empty text if the last pass is complete, or if no pass was started.
fn broken_off_pass(report: &Report) -> String {
    let Some(PassHistory { cycle, ground, result }) = report.story.pass else { return String::new() };
    let how = match result {
        Some(JobResult::Complete) => return String::new(),
        Some(JobResult::Stopped) => Text::PassStopped,
        Some(JobResult::Aborted) => Text::PassAborted,
        Some(JobResult::Failed) => Text::PassFailed,
        None => Text::PassWithoutEnd,
    };
    let far = match ground {
        Some([done, total]) if total > 0 => {
            format!("{:.0} % {}", 100.0 * f64::from(done) / f64::from(total), report.say(Text::ShareGround))
        }
        _ => report.say(Text::ShareNotKnown).to_owned(),
    };
    let [cycle_word, how, rest] = [Text::Cycle, how, Text::RestUnchanged].map(|text| report.say(text));
    format!("<p id=\"pass\">{how} ({cycle_word} {cycle}): {far}. {rest}</p>\n")
}

/// Returns the table of the judged figures of the last measurement, with their uncertainty, their limits and the
/// decision rule. Returns an empty text if there is no tolerance or no measurement on record.
fn judged(report: &Report) -> String {
    let (Some(tolerance), Some((cycle, of, figures))) = (report.story.tolerance(), report.story.last_measured()) else {
        return String::new();
    };
    let title = report.say(if of.judgements.is_empty() { Text::MeasuredFigures } else { Text::JudgedFigures });
    let heads = [
        (Text::Result, ", \u{b5}m", " class=\"n\""),
        (Text::Uncertainty, "", " class=\"n\""),
        (Text::CredibleInterval, "", " class=\"n\""),
        (Text::Limit, "", " class=\"n\""),
        (Text::AgainstLimit, "", ""),
        (Text::InTolerance, "", " class=\"n\""),
        (Text::Decision, "", ""),
    ];
    let head = |(text, unit, class): (Text, &str, &str)| format!("<th{class}>{}{unit}</th>", report.say(text));
    let mut html = format!(
        "<h2>{title}, {} {cycle}</h2>\n<table id=\"judged\">\n<thead><tr><th>{}</th>{}</tr></thead>\n",
        report.say(Text::Cycle),
        report.say(Text::Figure),
        heads.map(head).concat()
    );
    html.extend(tolerance.compare(figures).iter().map(|compared| judged_row(report, compared, &tolerance)));
    html + &format!("</table>\n<p class=\"caption\">{}</p>\n", decision_rule(report, &tolerance))
}

fn judged_row(report: &Report, compared: &ComparedFigure, tolerance: &Tolerance) -> String {
    let ComparedFigure { name, median_mm: found_mm, expanded_mm, interval_mm: [low_mm, high_mm], limit_mm, .. } =
        *compared;
    let um = |mm: f64| um(report, mm);
    let limit = if limit_mm.is_finite() { um(limit_mm) } else { report.say(Text::NoLimit).to_owned() };
    let bar = interval_bar([low_mm, found_mm, high_mm], Some(limit_mm), compared.conformity == Conformity::Within);
    let within = compared.probability_in_words().unwrap_or_default();
    let within = escaped(&localised(within.strip_prefix("P(in tolerance) ").unwrap_or(&within), report.language));
    format!(
        "<tr><td class=\"t\">{name}</td><td class=\"n big\">{}</td><td class=\"n\">\u{b1} {}</td><td class=\"n\">{} \u{2026} {}</td>\
         <td class=\"n\">{limit}</td><td>{bar}</td><td class=\"n\">{within}</td><td>{}</td></tr>\n",
        um(found_mm),
        um(expanded_mm),
        um(low_mm),
        um(high_mm),
        comparison(report, compared, tolerance.with_uncertainty)
    )
}

/// Formats a length in micrometres with two decimals.
pub(super) fn um(report: &Report, mm: f64) -> String {
    decimal(1e3 * mm, 2, report.language)
}

/// Returns a text that says if a figure is within its limit, beyond it, or not decided. The text includes the compared
/// values in micrometres, such as "within the limit: at most 3.10 ≤ 7.00". `with_uncertainty` is true if the decision
/// rule uses the uncertainty of the figure. Returns an empty text if the figure has no limit.
fn comparison(report: &Report, compared: &ComparedFigure, with_uncertainty: bool) -> String {
    let ComparedFigure { median_mm: found_mm, compared_mm: [low_mm, high_mm], limit_mm, conformity, .. } = *compared;
    if !limit_mm.is_finite() {
        return String::new();
    }
    let words = report.say(conformity_text(conformity));
    let beside = |text: Option<Text>, value: f64| {
        let is = if value <= limit_mm { "\u{2264}" } else { "&gt;" };
        // Two different numbers must not be shown as the same number.
        let alike = um(report, value) == um(report, limit_mm) && value != limit_mm;
        let digits = if alike { 5 } else { 2 };
        let [value, limit] = [value, limit_mm].map(|mm| decimal(1e3 * mm, digits, report.language));
        let what = text.map_or(String::new(), |text| format!("{} ", report.say(text)));
        format!("<span class=\"whole\">{what}{value} {is} {limit}</span>")
    };
    let sums = match (with_uncertainty, conformity) {
        (false, _) => beside(None, found_mm),
        (true, Conformity::Within) => beside(Some(Text::AtMost), high_mm),
        (true, Conformity::Beyond) => beside(Some(Text::AtLeast), low_mm),
        (true, Conformity::Undecided) => {
            format!("{}, {}", beside(Some(Text::AtMost), high_mm), beside(Some(Text::AtLeast), low_mm))
        }
    };
    format!("{words}: {sums}")
}

/// Returns the text for the comparison of a figure with its limit.
pub(super) fn conformity_text(conformity: Conformity) -> Text {
    match conformity {
        Conformity::Within => Text::WithinLimit,
        Conformity::Undecided => Text::Undecided,
        Conformity::Beyond => Text::BeyondLimit,
    }
}

fn decision_rule(report: &Report, tolerance: &Tolerance) -> String {
    if tolerance.with_uncertainty {
        let percent = decimal(1e2 * tolerance.probability, 1, report.language);
        format!("{} {percent} %.", report.say(Text::RuleWithUncertainty))
    } else {
        report.say(Text::RuleWithoutUncertainty).to_owned()
    }
}

/// Returns the map of the last cycle on the scale of the tolerance and on its own. Without a limit of the PV there is
/// only the latter.
fn maps(report: &Report) -> Result<String, ReportError> {
    let Some(last) = report.maps.last() else { return Ok(String::new()) };
    let tolerance_um = report.story.tolerance().map(|tolerance| 0.5e3 * tolerance.pv_mm).filter(|um| um.is_finite());
    let scales = [(tolerance_um, Text::ScaleOfTolerance), (Some(last.own_limit_um()), Text::ScaleOfMap)];
    let mut html = format!("<h2>{}</h2>\n<div class=\"two\">\n", report.say(Text::ErrorOfForm));
    for (limit_um, text) in scales {
        let Some(limit_um) = limit_um else { continue };
        let cycle = report.say(Text::Cycle);
        let caption = format!("{} {}, {}.{}", capitalized(cycle), last.cycle, report.say(text), report.mark());
        let _ = writeln!(
            html,
            "<figure class=\"map\">{}<figcaption>{caption}</figcaption></figure>",
            last.picture(limit_um, report.language)?
        );
    }
    let [sign, filtered] = [Text::SignOfMap, Text::MapsFiltered].map(|text| report.say(text));
    Ok(html + &format!("</div>\n<p class=\"caption\">{sign} {filtered}</p>\n"))
}

/// Returns the map of the first cycle beside the figures and decisions of all cycles.
fn how_it_got_there(report: &Report) -> Result<String, ReportError> {
    let story = report.story;
    if story.cycles.is_empty() {
        return Ok(String::new());
    }
    let picture = match &report.maps[..] {
        [first, _] => {
            let caption = format!(
                "{} {}, {}.{}",
                capitalized(report.say(Text::Cycle)),
                first.cycle,
                report.say(Text::ScaleOfFirst),
                report.mark()
            );
            format!(
                "<figure class=\"map\">{}<figcaption>{caption}</figcaption></figure>\n",
                first.picture(first.own_limit_um(), report.language)?
            )
        }
        _ => String::new(),
    };
    let tolerance = story.tolerance();
    let row = |(number, measurement): (u32, Option<&Measurement>)| {
        let figures = measurement.and_then(|of| of.figures.as_ref());
        let [pv, rms] = figures
            .map_or(["\u{2013}".to_owned(), "\u{2013}".to_owned()], |of| figures_um(report, of, tolerance.as_ref()));
        let verdict = measurement.and_then(|of| of.judgements.last()).and_then(|of| texts::verdict(of.verdict));
        let verdict = verdict.map_or("\u{2013}", |text| report.say(text));
        format!(
            "<tr><td class=\"n\">{number}</td><td class=\"n\">{pv}</td><td class=\"n\">{rms}</td><td>{verdict}</td></tr>\n"
        )
    };
    let rows: String = story.cycles.iter().map(|(number, cycle)| row((*number, cycle.measurements.last()))).collect();
    let limits = tolerance.as_ref().map_or(String::new(), |tolerance| {
        let limit = |mm: f64| if mm.is_finite() { um(report, mm) } else { "\u{2013}".to_owned() };
        let [pv, rms] = [tolerance.pv_mm, tolerance.rms_mm].map(limit);
        format!(
            "<tr><td>{}</td><td class=\"n\">{pv}</td><td class=\"n\">{rms}</td><td></td></tr>\n",
            report.say(Text::Limit)
        )
    });
    Ok(format!(
        "<h2>{}</h2>\n<div class=\"two\">\n{picture}<div><table id=\"progress\">\n<thead><tr><th class=\"n\">{}</th><th class=\"n\">{}, \u{b5}m</th>\
         <th class=\"n\">RMS, \u{b5}m</th><th>{}</th></tr></thead>\n{rows}{limits}</table></div>\n</div>\n",
        report.say(Text::HowItGotThere),
        report.say(Text::Cycle),
        name_of_pv(report),
        report.say(Text::Decision),
    ))
}

/// Returns the name of the judged peak-to-valley, such as "PV 99.8 %".
fn name_of_pv(report: &Report) -> &'static str {
    let last = report.story.tolerance().zip(report.story.last_measured());
    last.map_or("PV", |(tolerance, (.., figures))| tolerance.compare(figures)[0].name)
}

/// Returns PV and RMS with two decimals, as they are compared with the limits.
fn figures_um(report: &Report, figures: &Figures, tolerance: Option<&Tolerance>) -> [String; 2] {
    let of = |tolerance: &Tolerance| tolerance.compare(figures).map(|compared| compared.median_mm);
    tolerance.map_or([figures.pv_mm, figures.rms_mm], of).map(|mm| um(report, mm))
}

/// Returns who made and measured the part, and the identity of the record, side by side.
fn made_by_and_record(report: &Report, registration: Option<&Value>) -> String {
    let (story, verified) = (report.story, report.verified);
    let machine = |device: Device| story.machines[device as usize].as_ref().map(|[name, _]| name.clone());
    let mm = |value: f64, digits: usize| {
        format!("{} {} mm", report.say(Text::Radius), decimal(value, digits, report.language))
    };
    let radius = registration.and_then(|found| found["probe_radius_mm"].as_f64()).filter(|mm| *mm > 0.0);
    let points =
        registration.and_then(|found| found["points"].as_u64()).map(|n| format!("{n} {}", report.say(Text::Points)));
    let probe: Vec<String> = radius.map(|value| mm(value, 5)).into_iter().chain(points).collect();
    let operator = story.begin.as_ref().map(|begin| format!("{} at {}", begin.actor, begin.station));
    let [_, recipe, _] = story.start.content.names();
    let made = [
        (Text::Grinder, machine(Device::Grinder)),
        (Text::Wheel, story.wheel_radius_mm.map(|value| mm(value, 4))),
        (Text::MeasuringMachine, machine(Device::Cmm)),
        (Text::Probe, Some(probe.join(", ")).filter(|text| !text.is_empty())),
        (Text::Operator, operator),
        (Text::Recipe, recipe.map(str::to_owned)),
    ];
    let end = report.say(if verified.closed { Text::Closed } else { Text::NotClosed });
    let records = format!("{}, {}, {end}", verified.records, report.say(Text::Unbroken));
    let signed = match verified.keys.first() {
        None => report.say(Text::NotSigned).to_owned(),
        Some(key) => {
            let key = key.to_string();
            format!("{} {}: {}\u{2026}", report.say(Text::Signed), verified.signed, key.get(..12).unwrap_or(&key))
        }
    };
    let alarms = match story.alarms.len() {
        0 => report.say(Text::None).to_owned(),
        count => count.to_string(),
    };
    let began = story.begin.as_ref().map(|begin| when(&begin.utc));
    let record = [
        (Text::Run, Some(report.run().to_owned())),
        (Text::Began, began),
        (Text::Ended, Some(story.end.as_ref().map_or(report.say(Text::NotYet).to_owned(), |end| when(&end.utc)))),
        (Text::Records, Some(records)),
        (Text::Identity, Some(signed)),
        (Text::Alarms, Some(alarms)),
    ];
    let facts = |title: Text, rows: &[(Text, Option<String>)]| {
        let row = |(text, value): &(Text, Option<String>)| {
            let value = value.as_deref().unwrap_or(report.say(Text::NotReported));
            format!("<tr><th>{}</th><td>{}</td></tr>\n", capitalized(report.say(*text)), escaped(value))
        };
        let rows: String = rows.iter().map(row).collect();
        format!("<div><h2>{}</h2>\n<table class=\"facts\">\n{rows}</table></div>\n", report.say(title))
    };
    format!("<div class=\"two\">\n{}{}</div>\n", facts(Text::MadeBy, &made), facts(Text::Record, &record))
}

/// Returns the fields in which the responsible people sign.
fn signatures(report: &Report) -> String {
    let fields = [Text::ApprovedByDate, Text::MadeByDate, Text::CheckedByDate, Text::ReleasedByDate];
    let fields: String = fields.iter().map(|text| format!("<div>{}</div>", report.say(*text))).collect();
    format!("<div class=\"signatures\" id=\"signatures\">{fields}</div>\n")
}

fn capitalized(word: &str) -> String {
    let mut letters = word.chars();
    letters.next().map(|first| first.to_uppercase().chain(letters).collect()).unwrap_or_default()
}
