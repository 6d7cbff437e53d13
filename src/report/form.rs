//! Figures of the form in the report of a run, and figures of the points as they were measured.

use std::fmt::Write;
use std::fs;
use std::io;
use std::path::Path;

use serde_json::Value;

use super::ReportError;
use super::axis::three_digits;
use super::report_content::Report;
use super::texts::ReportText as Text;
use regrind_formats::{FormatError, escaped};
use regrind_language::{decimal, localised};

/// Returns the HTML section about the form of the surface. Its tables have a row for each figure, such as PV, and a
/// column for each cycle that has figures. `folder` is the run folder. Returns an empty text if no cycle has figures.
///
/// # Errors
/// Fails if a file of figures cannot be read or is not JSON.
pub(super) fn form(report: &Report, folder: &Path) -> Result<String, ReportError> {
    let mut cycles = Vec::new();
    for (number, cycle) in &report.story.cycles {
        let Some(name) = &cycle.form else { continue };
        cycles.push((*number, read_figures(&folder.join(name))?));
    }
    let Some((_, last)) = cycles.last() else { return Ok(String::new()) };
    let shown = first_and_last(&cycles);
    let left_out = if shown.len() < cycles.len() {
        format!("<p class=\"caption\">{}</p>\n", report.say(Text::CyclesOfTable))
    } else {
        String::new()
    };
    let title = report.say(Text::FormOfSurface);
    let html =
        format!("<h2>{title}</h2>\n{left_out}{}{}", estimated_figures(report, &shown, last), raw(report, &shown, last));
    Ok(html + &notations(report, &cycles) + &zernike(report, last))
}

/// Returns the first and the last two cycles: a page has no room for the columns of more.
fn first_and_last(cycles: &[(u32, Value)]) -> Vec<(u32, Value)> {
    /// Number of columns for cycles.
    const COLUMNS: usize = 3;
    let late = cycles.len().saturating_sub(COLUMNS - 1).max(1);
    cycles.iter().take(1).chain(cycles.iter().skip(late)).cloned().collect()
}

/// Reads a file `figures.json`, which holds the figures of a cycle.
///
/// # Errors
/// Fails if the file cannot be read or is not JSON.
pub(super) fn read_figures(path: &Path) -> Result<Value, ReportError> {
    let unreadable = |source| FormatError::Unreadable { path: path.to_owned(), source };
    let bytes = fs::read(path).map_err(unreadable)?;
    Ok(serde_json::from_slice(&bytes).map_err(|source| unreadable(io::Error::from(source)))?)
}

fn listed<'a>(figures: &'a Value, list: &str) -> &'a [Value] {
    figures[list].as_array().map_or(&[], Vec::as_slice)
}

fn named<'a>(figures: &'a Value, list: &str, name: &Value) -> Option<&'a Value> {
    listed(figures, list).iter().find(|row| row["name"] == *name)
}

fn heads(report: &Report, cycles: &[(u32, Value)]) -> String {
    let word = report.say(Text::Cycle);
    cycles.iter().map(|(number, _)| format!("<th class=\"n\">{word} {number}</th>")).collect()
}

/// Returns the HTML table of the figures of the form that the model estimates without the noise of the probe. Each
/// figure has its median and its 95 % credible interval. `cycles` contains the number and the figures of each cycle.
/// `last` contains the figures of the last cycle, which determine the rows of the table. Returns an empty text if
/// `last` has no estimated figures, as in files of earlier versions.
fn estimated_figures(report: &Report, cycles: &[(u32, Value)], last: &Value) -> String {
    let list = listed(last, "form");
    if list.is_empty() {
        return String::new();
    }
    let mut html = format!(
        "<table id=\"told\">\n<thead><tr><th>{}</th>{}<th class=\"n\">{}</th><th>{}</th><th>{}</th></tr></thead>\n",
        report.say(Text::Figure),
        heads(report, cycles),
        report.say(Text::RawLastCycle),
        report.say(Text::Unit),
        report.say(Text::Meaning),
    );
    for row in list {
        let text = |key: &str| escaped(&with_micro(row[key].as_str().unwrap_or_default()));
        let cell = |(_, figures): &(u32, Value)| match named(figures, "form", &row["name"])
            .and_then(|row| interval(report, row))
        {
            Some([median, low, high]) => {
                format!("<td class=\"n\">{median}<br/><small>{low} \u{2026} {high}</small></td>")
            }
            None => "<td class=\"n\">-</td>".to_owned(),
        };
        let cells: String = cycles.iter().map(cell).collect();
        let _ = writeln!(
            html,
            "<tr><td>{}</td>{cells}<td class=\"n\">{}</td><td>{}</td><td>{}</td></tr>",
            text("name"),
            in_unit(report, row, "raw").unwrap_or_else(|| "-".to_owned()),
            unit(row),
            text("made")
        );
    }
    let removed = escaped(list[0]["removed"].as_str().unwrap_or_default());
    html + &format!("</table>\n<p>{}: {removed}.</p>\n", report.say(Text::FormNote))
}

/// Returns three texts from a row of `figures.json`: the median of a figure, and the lower and upper end of its
/// credible interval. Returns `None` if one of the three is missing.
fn interval(report: &Report, row: &Value) -> Option<[String; 3]> {
    Some([in_unit(report, row, "median")?, in_unit(report, row, "low")?, in_unit(report, row, "high")?])
}

/// Returns a number of a row in the unit that [`unit`] names. Lengths are in micrometres throughout the report.
fn in_unit(report: &Report, row: &Value, key: &str) -> Option<String> {
    let scale = if row["unit"] == "nm" { 1e-3 } else { 1.0 };
    row[key].as_f64().map(|value| localised(&three_digits(scale * value), report.language))
}

/// Returns the unit of a row.
fn unit(row: &Value) -> String {
    match row["unit"].as_str().unwrap_or_default() {
        "nm" | "um" => "\u{b5}m".to_owned(),
        "urad" => "\u{b5}rad".to_owned(),
        other => escaped(other),
    }
}

/// Returns a text of `figures.json` with the signs of its units, which the file has in ASCII.
fn with_micro(text: &str) -> String {
    text.replace(" um", " \u{b5}m").replace(" urad", " \u{b5}rad")
}

/// Returns the HTML table of the figures that were computed directly from the measured points and from the map. These
/// figures include the noise of the probe. `cycles` contains the number and the figures of each cycle. `last` contains
/// the figures of the last cycle, which determine the rows of the table.
fn raw(report: &Report, cycles: &[(u32, Value)], last: &Value) -> String {
    let rows = listed(last, "figures");
    let title = format!("<h3>{}</h3>\n", report.say(Text::RawAsMeasured));
    let title = if listed(last, "form").is_empty() { "" } else { &title };
    let mut html = format!(
        "{title}<table id=\"form\">\n<thead><tr><th>{}</th>{}<th>{}</th><th>{}</th></tr></thead>\n",
        report.say(Text::Figure),
        heads(report, cycles),
        report.say(Text::Unit),
        report.say(Text::Meaning),
    );
    // The most figures have the same removed and the same wavelengths left out. Only others state theirs.
    let usual = ["removed", "cut_off"].map(|key| rows.first().and_then(|row| row[key].as_str()).unwrap_or_default());
    for row in rows {
        let text = |key: &str| with_micro(row[key].as_str().unwrap_or_default());
        let cell = |(_, figures): &(u32, Value)| {
            let value = named(figures, "figures", &row["name"]).and_then(|row| in_unit(report, row, "value"));
            format!("<td class=\"n\">{}</td>", value.unwrap_or_else(|| "-".to_owned()))
        };
        let cells: String = cycles.iter().map(cell).collect();
        let mut made = text("made");
        for ((key, word), usual) in [("removed", "removed"), ("cut_off", "left out")].into_iter().zip(usual) {
            let of_row = text(key);
            if of_row != with_micro(usual) {
                let _ = write!(made, "; {word}: {of_row}");
            }
        }
        let _ = writeln!(
            html,
            "<tr><td>{}</td>{cells}<td>{}</td><td>{}</td></tr>",
            escaped(&text("name")),
            unit(row),
            escaped(&made)
        );
    }
    let [removed, cut_off] = usual.map(|text| escaped(&with_micro(text)));
    let [unless, waves] = [Text::UnlessStated, Text::WavesLeftOut].map(|text| report.say(text));
    html + &format!("</table>\n<p>{unless} {removed}; {waves}: {cut_off}.</p>\n")
}

/// Returns an HTML list with the tolerance indications of ISO 10110-5 (texts such as "3/A(B/C)") for each cycle. Each
/// entry contains two indications. The form of the part meets the first one with a probability of 97.5 %. The measured
/// points just meet the second one. The first one is omitted if the figures do not contain it. `cycles` contains the
/// number of each cycle and its figures (the content of `figures.json`).
fn notations(report: &Report, cycles: &[(u32, Value)]) -> String {
    let [intro, raw, word] = [Text::Iso10110, Text::Raw, Text::Cycle].map(|text| report.say(text));
    let mut html = format!("<p>{intro}</p>\n<ul>\n");
    for (number, figures) in cycles {
        let notation = figures["iso_10110_5"]["notation"].as_str().unwrap_or("-");
        let of_form = figures["form_iso_10110_5"].as_str();
        let of_form =
            of_form.map_or(String::new(), |of| format!("<code class=\"whole\">{}</code>; {raw} ", escaped(of)));
        let missing = figures["missing"].as_array().into_iter().flatten().filter_map(Value::as_str);
        let missing: String = missing.map(|why| format!("; no {}", escaped(why))).collect();
        let _ = writeln!(
            html,
            "<li>{word} {number}: {of_form}<code class=\"whole\">{}</code>{missing}</li>",
            escaped(notation)
        );
    }
    html + "</ul>\n"
}

/// Returns the table of the Zernike coefficients of the last cycle. Returns an empty text if the part is not round, because
/// the polynomials of a disc that it does not fill have no meaning of their own.
fn zernike(report: &Report, last: &Value) -> String {
    /// Number of coefficients side by side.
    const BESIDE: usize = 4;
    let fit = &last["zernike"];
    let Some(radius_mm) = fit["half_size_mm"][0].as_f64() else { return String::new() };
    let centre_mm = [0, 1].map(|k| fit["centre_mm"][k].as_f64().unwrap_or(f64::NAN));
    let has_hole = report.maps.last().is_none_or(|map| map.distance_mm(centre_mm) > 0.1 * radius_mm);
    if has_hole || !is_round(radius_mm, &last["legendre"]) {
        return String::new();
    }
    let um = |nm: &Value| nm.as_f64().map_or("-".to_owned(), |nm| decimal(1e-3 * nm, 4, report.language));
    let cells: Vec<String> = listed(fit, "terms")
        .iter()
        .map(|term| {
            let name = escaped(term["term"].as_str().unwrap_or_default());
            format!("<td class=\"t\">{name}</td><td class=\"n\">{}</td>", um(&term["coefficient_nm"]))
        })
        .collect();
    // The order runs down the columns.
    let rows = cells.len().div_ceil(BESIDE);
    let row =
        |first: usize| format!("<tr>{}</tr>\n", cells.iter().skip(first).step_by(rows).cloned().collect::<String>());
    let rows: String = (0..rows).map(row).collect();
    let [title, note, residual] = [Text::Zernike, Text::ZernikeNote, Text::Residual].map(|text| report.say(text));
    format!(
        "<h3>{title}</h3>\n<table id=\"zernike\" class=\"narrow\">\n{rows}</table>\n<p>{note}, {} {} mm; {residual} {} \u{b5}m RMS.</p>\n",
        report.say(Text::Radius),
        decimal(radius_mm, 3, report.language),
        um(&fit["residual_rms_nm"])
    )
}

/// Returns true if a part is round: the rectangle around its points has sides of the diameter of the disc around them.
/// `around` is the fit of Legendre polynomials, which has this rectangle.
fn is_round(radius_mm: f64, around: &Value) -> bool {
    /// The outermost points are a little within the edge.
    const TOLERANCE: f64 = 0.05;
    let half = |k: usize| around["half_size_mm"][k].as_f64().unwrap_or(0.0);
    [0, 1].iter().all(|k| (half(*k) / radius_mm - 1.0).abs() < TOLERANCE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn tables_have_three_cycles_at_most() {
        let numbers = |count: u32| {
            let cycles: Vec<(u32, Value)> = (1..=count).map(|cycle| (cycle, Value::Null)).collect();
            first_and_last(&cycles).iter().map(|(cycle, _)| *cycle).collect::<Vec<u32>>()
        };
        assert_eq!([1, 2, 3].map(numbers), [vec![1], vec![1, 2], vec![1, 2, 3]]);
        assert_eq!((numbers(4), numbers(11)), (vec![1, 3, 4], vec![1, 10, 11]));
    }

    #[test]
    fn only_round_parts_are_round() {
        let around = |sides: [f64; 2]| json!({ "half_size_mm": sides });
        assert!(is_round(20.0, &around([19.6, 20.0])));
        // A square, a rectangle, an ellipse, and figures without this fit.
        for sides in [[14.1, 14.1], [18.0, 8.7], [20.0, 12.0]] {
            assert!(!is_round(20.0, &around(sides)), "{sides:?}");
        }
        assert!(!is_round(20.0, &Value::Null));
    }
}
