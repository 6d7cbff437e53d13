//! Label of a part: serial number, verdict and the hash of the record, for people and as a QR code.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use qrcode::{Color, EcLevel, QrCode};

use super::ReportError;
use super::first_page::outcome;
use super::report_content::{Report, ReportOptions, when};
use super::run::with_report;
use super::texts::ReportText as Text;
use regrind_formats::run_files::RunFile;
use regrind_formats::{escaped, write_atomic};
use regrind_language::Language;

/// Width and height of the label, in millimetres.
const SIZE_MM: [f64; 2] = [80.0, 30.0];
/// Place and width of the code without its quiet zone, in millimetres.
const CODE_MM: [f64; 2] = [3.0, 24.0];
/// Place and largest width of the texts, in millimetres.
const TEXT_MM: [f64; 2] = [31.0, 47.0];

/// Verifies the record in the run folder `folder`, writes the label of its part as SVG to `path`, or to `label.svg` in
/// this folder, and returns the path.
///
/// # Errors
/// As [`run_label`], and if the file cannot be written.
pub fn write_run_label(folder: &Path, options: &ReportOptions, path: Option<&Path>) -> Result<PathBuf, ReportError> {
    let path = path.map_or_else(|| folder.join(RunFile::Label.name()), Path::to_owned);
    write_atomic(&path, run_label(folder, options)?.as_bytes())?;
    Ok(path)
}

/// Verifies the record in the run folder `folder`, and returns the label of its part as SVG, 80 mm by 30 mm. The code
/// contains three lines: the serial number, the name of the run, and the hash of the last record.
///
/// # Errors
/// Fails if the record is missing or does not pass verification, or if the texts are too long for a code.
pub fn run_label(folder: &Path, options: &ReportOptions) -> Result<String, ReportError> {
    with_report(folder, options, label)
}

/// Begin of the comment with the language of a label.
const LANGUAGE_MARK: &str = "<!--language:";

/// Returns the language of a label from the text of its file; the default one if the text states none.
pub fn label_language(svg: &str) -> Language {
    let tag = svg.split(LANGUAGE_MARK).nth(1).and_then(|rest| rest.split("-->").next());
    tag.and_then(Language::first_of).unwrap_or_default()
}

fn label(report: &Report) -> Result<String, ReportError> {
    if report.story.home.is_some() {
        return Err(ReportError::NoPart { run: report.run().to_owned() });
    }
    let head = &report.verified.head;
    let content = format!("{}\n{}\n{head}", report.serial(), report.run());
    let code = QrCode::with_error_correction_level(&content, EcLevel::M)
        .map_err(|error| ReportError::Label { run: report.run().to_owned(), reason: error.to_string() })?;
    let [width, height] = SIZE_MM;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"Inter, Helvetica, Arial, sans-serif\" fill=\"#000000\">\n\
         {LANGUAGE_MARK}{}-->\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n<path d=\"{}\"/>\n",
        report.language.tag(),
        modules(&code)
    );
    for (size, y, text) in lines(report, head) {
        svg += &line(size, y, &text);
    }
    Ok(svg + "</svg>\n")
}

/// Returns the lines beside the code: size and base line in millimetres, and the text.
fn lines(report: &Report, head: &str) -> Vec<(f64, f64, String)> {
    let story = report.story;
    let [name, ..] = story.start.content.names();
    let drawing = story.start.content.part().and_then(|part| part.drawing.as_ref());
    let part = [name, drawing.map(String::as_str)].into_iter().flatten().collect::<Vec<_>>().join(" \u{b7} ");
    let (_, verdict, ..) = outcome(report);
    let at = story.end.as_ref().map_or(&story.last, |end| &end.utc);
    let mark = if report.mark().is_empty() { "" } else { " \u{b7} SIMULATION" };
    let (first, second) = head.split_at(head.len() / 2);
    vec![
        (5.0, 6.4, format!("{} {}", report.say(Text::Serial), report.serial())),
        (3.4, 11.2, format!("{}{mark}", report.say(verdict))),
        (2.4, 15.0, part),
        (2.0, 18.3, when(at)),
        (2.0, 21.2, report.run().to_owned()),
        (1.9, 24.4, in_groups(first)),
        (1.9, 27.0, in_groups(second)),
    ]
}

/// Returns a text element. A text that would be wider than its place gets a smaller size.
fn line(size: f64, y: f64, text: &str) -> String {
    let [left, width] = TEXT_MM;
    let size = size.min(width / text.chars().map(width_of).sum::<f64>().max(1.0));
    format!("<text x=\"{left}\" y=\"{y}\" font-size=\"{size:.2}\">{}</text>\n", escaped(text))
}

/// Returns the width of a letter in the widest of the named fonts, as a share of the size of the font.
fn width_of(c: char) -> f64 {
    match c {
        'i' | 'j' | 'l' | '.' | ',' | ':' | ';' | ' ' | '\'' | '|' => 0.4,
        'W' | 'M' | 'm' | 'w' | '@' | '%' => 1.0,
        'A'..='Z' => 0.8,
        c if u32::from(c) < 0x250 => 0.64,
        _ => 1.05,
    }
}

/// Returns hexadecimal digits in groups of eight.
fn in_groups(digits: &str) -> String {
    let groups: Vec<&str> =
        (0..digits.len()).step_by(8).filter_map(|k| digits.get(k..(k + 8).min(digits.len()))).collect();
    groups.join(" ")
}

/// Returns the dark modules of a code as the path of an SVG: one rectangle for each run of modules in a row.
fn modules(code: &QrCode) -> String {
    let ([corner, width], columns, mut path) = (CODE_MM, code.width(), String::new());
    let module = width / columns as f64;
    let colours = code.to_colors();
    for (row, modules) in colours.chunks(columns).enumerate() {
        let mut column = 0;
        for same in modules.chunk_by(|a, b| a == b) {
            if same[0] == Color::Dark {
                let [x, y] = [column, row].map(|count| corner + module * count as f64);
                let length = module * same.len() as f64;
                let _ = write!(path, "M{x:.3},{y:.3}h{length:.3}v{module:.3}h-{length:.3}z");
            }
            column += same.len();
        }
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_are_grouped() {
        assert_eq!(in_groups("0123456789abcdef01"), "01234567 89abcdef 01");
        assert_eq!(in_groups(""), "");
    }

    #[test]
    fn long_text_is_smaller() {
        assert!(line(5.0, 1.0, "SN-1").contains("\"5.00\""));
        assert!(line(5.0, 1.0, &"W".repeat(40)).contains("\"1.18\""));
        assert!(line(5.0, 1.0, &"\u{9554}".repeat(12)).contains("\"3.73\""));
        assert!(line(5.0, 1.0, "").contains("\"5.00\""));
    }

    /// The rectangles of the path have the area of the dark modules.
    #[test]
    fn modules_have_their_area() {
        let code = QrCode::new("a").unwrap();
        let dark = code.to_colors().iter().filter(|colour| **colour == Color::Dark).count() as f64;
        let path = modules(&code);
        let lengths =
            path.split('h').skip(1).step_by(2).map(|rest| rest.split('v').next().unwrap().parse::<f64>().unwrap());
        let module = CODE_MM[1] / code.width() as f64;
        assert!((lengths.sum::<f64>() / module - dark).abs() < 0.1);
    }
}
