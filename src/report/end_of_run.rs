//! First lines of a report as text, for the end of a run at a terminal.

use std::path::Path;

use super::ReportError;
use super::first_page::{conformity_text, identity, inspection, outcome, um};
use super::report_content::{Report, ReportOptions};
use super::run::with_report;
use super::texts::ReportText as Text;
use regrind_cell::{ComparedFigure, Tolerance};

/// Verifies the record in the run folder `folder`, and returns the first lines of the report of the run: verdict with its
/// reason, part, cycle and time, and the table of the judged figures. The table has fewer columns
/// if a line of it would have more than `columns` characters. Other lines are as long as their texts.
///
/// # Errors
/// As [`run_report`](crate::run_report).
pub fn first_lines(folder: &Path, columns: usize) -> Result<Vec<String>, ReportError> {
    with_report(folder, &ReportOptions::default(), |report| Ok(lines(report, columns)))
}

fn lines(report: &Report, columns: usize) -> Vec<String> {
    let mark = if report.mark().is_empty() { "" } else { "SIMULATION  " };
    let [name, ..] = report.story.start.content.names();
    let (_, _, reason, _) = outcome(report);
    let mut lines = vec![format!("{mark}{reason}")];
    let mut identity = identity(report);
    identity.insert(0, name.unwrap_or("Part").to_owned());
    lines.extend(joined(&identity, columns));
    lines.push(inspection(report));
    if let (Some(tolerance), Some((_, _, figures))) = (report.story.tolerance(), report.story.last_measured()) {
        let compared = tolerance.compare(figures);
        lines.push(String::new());
        let table = wide(report, &compared, &tolerance);
        let is_too_wide = table.iter().any(|line| line.chars().count() > columns);
        lines.extend(if is_too_wide { narrow(report, &compared) } else { table });
    }
    lines
}

/// Joins texts by dots to lines of at most `columns` characters.
fn joined(texts: &[String], columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for text in texts {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 3 + text.chars().count() <= columns => {
                line.push_str(" \u{b7} ");
                line.push_str(text);
            }
            _ => lines.push(text.clone()),
        }
    }
    lines
}

fn wide(report: &Report, compared: &[ComparedFigure], tolerance: &Tolerance) -> Vec<String> {
    let row = |[name, result, u, interval, limit, within, decision]: [&str; 7]| {
        format!("{name:<9} {result:>9} {u:>7} {interval:>13} {limit:>6} {within:>12}  {decision}").trim_end().to_owned()
    };
    let head = ["figure", "result \u{b5}m", "U", "95 % interval", "limit", "in tolerance", "decision"];
    let figure = |of: &ComparedFigure| {
        let within = of.probability_in_words().unwrap_or_default();
        row([
            of.name,
            &um(report, of.median_mm),
            &format!("\u{b1} {}", um(report, of.expanded_mm)),
            &format!("{} \u{2026} {}", um(report, of.interval_mm[0]), um(report, of.interval_mm[1])),
            &limit(report, of),
            within.strip_prefix("P(in tolerance) ").unwrap_or(&within),
            if of.limit_mm.is_finite() { report.say(conformity_text(of.conformity)) } else { "" },
        ])
    };
    let mut lines = vec![row(head)];
    lines.extend(compared.iter().map(figure));
    if !tolerance.with_uncertainty {
        lines.push(report.say(Text::RuleWithoutUncertainty).to_owned());
    }
    lines
}

fn narrow(report: &Report, compared: &[ComparedFigure]) -> Vec<String> {
    let line = |of: &ComparedFigure| {
        let value = format!("{} \u{b1} {}", um(report, of.median_mm), um(report, of.expanded_mm));
        let decision = if of.limit_mm.is_finite() { report.say(conformity_text(of.conformity)) } else { "" };
        format!("{:<10} {value:>14} {:>8}  {decision}", of.name, limit(report, of)).trim_end().to_owned()
    };
    let head = format!("{:<10} {:>14} {:>8}  decision", "figure", "result \u{b5}m", "limit");
    std::iter::once(head).chain(compared.iter().map(line)).collect()
}

fn limit(report: &Report, of: &ComparedFigure) -> String {
    if of.limit_mm.is_finite() { um(report, of.limit_mm) } else { "\u{2013}".to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_joined_to_the_width() {
        let texts = ["mirror", "serial 1", "drawing 2"].map(str::to_owned);
        assert_eq!(joined(&texts, 80), ["mirror \u{b7} serial 1 \u{b7} drawing 2"]);
        assert_eq!(joined(&texts, 20), ["mirror \u{b7} serial 1", "drawing 2"]);
        assert_eq!(joined(&texts, 1).len(), 3);
    }
}
