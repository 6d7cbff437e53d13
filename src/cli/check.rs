//! `regrind check`: checks recipes and cell files, and shows every problem at its position.

use std::fs::File;
use std::io::{self, IsTerminal, Read, Write};
use std::path::{Path, PathBuf};

use annotate_snippets::renderer::DecorStyle;
use annotate_snippets::{AnnotationKind, Level, Origin, Renderer, Snippet};
use clap::Args;
use console::Term;
use data_encoding::HEXLOWER;
use regrind::config::{CellConfig, DialectFile, read_dialect};
use regrind::document::{Problem, Problems};
use regrind::recipe::{MeasuringPattern, NominalSource, Recipe};
use regrind::setup::{defined_from_file, nominal_table_format, plan_table_format, read_nominal};
use regrind::surface::PlaneProjection;
use serde::Serialize;

use super::failure::Failure;
use super::file_kind::CheckedPlantFile;
use super::{Outcome, nominal, plant, truth};

/// Check recipes, cell files and dialects: every problem with line, column and remedy
#[derive(Args, Debug)]
#[command(after_help = "\
A file with a table [cell] is a cell file. A file with a table [dialect] describes a dialect of machine programs. A
file with a table [plant] is a plant file. Any other file is a recipe. For a recipe, the command also checks the files that the recipe names and the table
[simulation], which gives the true shape of the simulated part.

Example:
  regrind check recipes/*.toml config/*.toml

Exit codes: 0 all files are good; 2 a file has a problem; 3 fault.")]
pub(super) struct Arguments {
    /// Recipes, cell files and dialects
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
}

/// Result of the check of one file.
#[derive(Serialize)]
struct CheckedFile {
    file: PathBuf,
    kind: &'static str,
    good: bool,
    sha256: Option<String>,
    /// Notes that do not make the file invalid, for example a serial port that this computer does not have.
    notes: Vec<String>,
    problems: Vec<ProblemDocument>,
}

/// Summary of a valid file.
struct Good {
    sha256: String,
    notes: Vec<String>,
}

/// One problem, as JSON.
#[derive(Serialize)]
pub(super) struct ProblemDocument {
    line: usize,
    column: usize,
    key: String,
    found: String,
    allowed: String,
    remedy: String,
}

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let mut found = Vec::new();
    for path in &arguments.files {
        if is_no_settings_file(path) {
            let failure = Failure::NotToCheck { path: path.clone() };
            if !arguments.json {
                super::print(&format!("{failure}\n"))?;
            }
            let problem = ProblemDocument::of_file(failure.to_string());
            let problems = vec![problem];
            found.push(CheckedFile {
                file: path.clone(),
                kind: "unknown",
                good: false,
                sha256: None,
                notes: Vec::new(),
                problems,
            });
            continue;
        }
        let (kind, checked) = check(path);
        if !arguments.json {
            match &checked {
                Ok(good) => {
                    super::print(&format!("{}: a good {kind}\n", path.display()))?;
                    for note in &good.notes {
                        super::print(&format!("    note: {note}\n"))?;
                    }
                }
                Err(problems) => show(problems)?,
            }
        }
        let (sha256, problems) = match &checked {
            Ok(good) => (Some(good.sha256.clone()), Vec::new()),
            Err(problems) => (None, ProblemDocument::all(problems)),
        };
        let notes = checked.as_ref().map_or(Vec::new(), |good| good.notes.clone());
        found.push(CheckedFile { file: path.clone(), kind, good: checked.is_ok(), sha256, notes, problems });
    }
    if arguments.json {
        super::print_json(&found)?;
    }
    match found.iter().filter(|found| !found.good).count() {
        0 => Ok(Outcome::Accepted),
        bad => Err(Failure::Checked { bad, files: found.len() }),
    }
}

/// Returns true if the file at `path` has text, but no line of a settings file: none with an equals sign, and no head of
/// a table.
fn is_no_settings_file(path: &Path) -> bool {
    let text = std::fs::read(path).map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).unwrap_or_default();
    !text.trim().is_empty() && !text.lines().any(|line| line.contains('=') || line.trim_start().starts_with('['))
}

/// Returns true if the file at `path` is a recipe: it has the table of a part.
pub(super) fn is_recipe(path: &Path) -> bool {
    has_table(path, &["[part]"])
}

/// Checks the file at `path`. Returns the kind of the file ("dialect", "plant file", "cell file" or "recipe") and the result. The
/// result is the SHA-256 hash of the file with notes for people, or all problems of the file.
fn check(path: &Path) -> (&'static str, Result<Good, Problems>) {
    if has_table(path, &["[dialect]"]) {
        let good = |file: DialectFile| Good { sha256: HEXLOWER.encode(&file.source_sha256), notes: file.renamed_keys };
        return ("dialect", read_dialect(path).map(good));
    }
    if has_table(path, &["[plant]"])
        && let Some(checked) = plant::check_plant(path)
    {
        let good =
            |CheckedPlantFile { sha256, notes }: CheckedPlantFile| Good { sha256: HEXLOWER.encode(&sha256), notes };
        return ("plant file", checked.map(good));
    }
    if has_table(path, &["[cell]", "[cmm", "[[cmm", "[grinder]", "[grinder.", "[[grinder"]) {
        let good = |cell: CellConfig| Good { sha256: HEXLOWER.encode(cell.source_sha256()), notes: cell_notes(&cell) };
        return ("cell file", CellConfig::read(path).map(good));
    }
    let good =
        |recipe: Recipe| Good { sha256: HEXLOWER.encode(recipe.source_sha256()), notes: recipe.notes().to_vec() };
    ("recipe", Recipe::read(path).and_then(with_good_files).map(good))
}

/// Returns `recipe` if the files that it names and its table `[simulation]` have no problem. Otherwise returns the
/// problems.
pub(super) fn with_good_files(recipe: Recipe) -> Result<Recipe, Problems> {
    check_files(&recipe)?;
    check_simulation(&recipe)?;
    Ok(recipe)
}

/// Returns the notes of a cell file, with a note for each machine whose calibration is overdue today.
pub(super) fn cell_notes(cell: &CellConfig) -> Vec<String> {
    cell.notes().into_iter().chain(cell.calibration_notes(&regrind::report::today())).collect()
}

/// Returns true if the file at `path` has one of the tables whose heads are in `heads`. In a file that is not correct
/// TOML, a line that begins with the head counts as the table. Only the first MiB is read. Returns false if the file
/// cannot be read, or is a pipe or a device, which has no kind and possibly no end.
pub(super) fn has_table(path: &Path, heads: &[&str]) -> bool {
    const ENOUGH_BYTES: u64 = 1 << 20;
    let mut bytes = Vec::new();
    if !path.metadata().is_ok_and(|there| there.is_file()) {
        return false;
    }
    let read = File::open(path).and_then(|file| file.take(ENOUGH_BYTES).read_to_end(&mut bytes));
    let text = String::from_utf8_lossy(&bytes);
    if let Ok(tables) = text.parse::<toml::Table>() {
        let is_table = |value: &toml::Value| value.is_table() || value.is_array();
        let name = |head: &&str| head.trim_matches(['[', ']', '.']).to_owned();
        return heads.iter().any(|head| tables.get(&name(head)).is_some_and(is_table));
    }
    // A file that is not correct yet has the heads of its tables at the beginnings of lines.
    read.is_ok() && text.lines().any(|line| heads.iter().any(|head| line.trim_start().starts_with(head)))
}

/// Reads the files of the nominal surface and of the measuring plan, if `recipe` names such files. Returns `Ok` if all
/// these files can be used. Returns an error with the problems of all files that cannot be used.
fn check_files(recipe: &Recipe) -> Result<(), Problems> {
    let mut problems: Option<Problems> = None;
    let mut add = |key: &str, failure: &dyn std::fmt::Display| {
        let more = recipe.problem(key, &format!("cannot be used: {failure}"), "", "");
        match &mut problems {
            None => problems = Some(more),
            Some(problems) => problems.problems.extend(more.problems),
        }
    };
    if let NominalSource::File { path, table, selection, .. } = &recipe.nominal {
        match nominal_table_format(table) {
            Err((key, what)) => add(key, &what),
            Ok(table) => match nominal::read(path, PlaneProjection::Auto, &table) {
                Err(failure) => add("nominal.file", &failure),
                Ok(file) => {
                    if let Err(failure) = defined_from_file(path, &file, selection) {
                        add("nominal.file", &failure);
                    }
                }
            },
        }
    }
    if let MeasuringPattern::File { path, table } = &recipe.pattern {
        match plan_table_format(table) {
            Err((key, what)) => add(key, &what),
            Ok(table) => {
                if let Err(failure) = regrind::formats::read_plan(path, &table) {
                    add("measure.file", &failure);
                }
            }
        }
    }
    problems.map_or(Ok(()), Err)
}

/// Checks the table `[simulation]` of `recipe`, which describes the simulated part and machines: with the limits of the
/// simulator, and against the nominal surface. Returns the first problem as an error. Returns `Ok` if there is no such
/// table.
fn check_simulation(recipe: &Recipe) -> Result<(), Problems> {
    if recipe.simulation.is_none() {
        return Ok(());
    }
    let nominal = read_nominal(recipe)
        .map_err(|failure| recipe.problem("nominal", &format!("cannot be used: {failure}"), "", ""))?;
    truth::world_spec(recipe, &nominal, None).map(drop)
}

/// Returns the value of `read`. If it is an error, prints all problems of the file with their positions, and returns
/// [`Failure::Checked`].
pub(super) fn or_show<T>(read: Result<T, Problems>) -> Result<T, Failure> {
    read.map_err(|problems| match show(&problems) {
        Ok(()) => Failure::Checked { bad: 1, files: 1 },
        Err(failure) => failure,
    })
}

/// Prints `problems` to standard error. If standard error is a terminal, each problem is shown with the line of the
/// file in which it is. Otherwise each problem is one line of text. Returns an error if the text cannot be written.
fn show(problems: &Problems) -> Result<(), Failure> {
    let text = if io::stderr().is_terminal() {
        let columns = Term::stderr().size_checked().map_or(100, |(_, columns)| usize::from(columns));
        let renderer = Renderer::styled().decor_style(DecorStyle::Unicode).term_width(columns);
        problems.problems.iter().map(|problem| picture(problems, problem, &renderer)).collect()
    } else {
        format!("{problems}\n")
    };
    match io::stderr().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(Failure::Terminal(error)),
        _ => Ok(()),
    }
}

/// Draws one problem of `problems` as text for a terminal: the error, its position, the line of the file, the allowed
/// values, and the remedy.
fn picture(problems: &Problems, problem: &Problem, renderer: &Renderer) -> String {
    let key = if problem.key.is_empty() { String::new() } else { format!("`{}` ", problem.key) };
    let title = Level::ERROR.primary_title(format!("{key}{}", problem.found));
    let file = problems.file.display().to_string();
    let place = AnnotationKind::Primary.span(problem.span.clone());
    let place = if problem.allowed.is_empty() { place } else { place.label(&problem.allowed) };
    let group = if problems.text.is_empty() {
        title.element(Origin::path(file))
    } else {
        title.element(Snippet::source(&problems.text).path(file).annotation(place))
    };
    let remedy = (!problem.remedy.is_empty()).then(|| Level::HELP.message(&problem.remedy));
    format!("{}\n\n", renderer.render(&[group.elements(remedy)]))
}

impl ProblemDocument {
    /// Creates the problem of a file as a whole.
    fn of_file(found: String) -> Self {
        let none = String::new;
        Self { line: 1, column: 1, key: none(), found, allowed: none(), remedy: none() }
    }

    /// Returns the documents of all `problems`.
    pub(super) fn all(problems: &Problems) -> Vec<Self> {
        problems.problems.iter().map(|problem| Self::new(problems, problem)).collect()
    }

    fn new(problems: &Problems, problem: &Problem) -> Self {
        let (line, column) = problems.place(problem);
        let Problem { key, found, allowed, remedy, .. } = problem.clone();
        Self { line, column, key, found, allowed, remedy }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn picture_shows_place_marker_and_remedy() {
        let text = "[measure]\nprobe_radius_mm = 1500\n".to_owned();
        let problem = Problem {
            span: 28..32,
            key: "measure.probe_radius_mm".into(),
            found: "is 1500".into(),
            allowed: "it must be at most 50 mm".into(),
            remedy: "write 1.5".into(),
        };
        let mut problems = Problems { file: "part.toml".into(), text, problems: vec![problem.clone()] };
        let drawn = picture(&problems, &problem, &Renderer::plain());
        let lines: Vec<&str> = drawn.lines().collect();
        assert_eq!(lines[0], format!("error: `{}` {}", problem.key, problem.found));
        assert!(lines[1].ends_with("part.toml:2:19"), "{drawn}");
        let at = |line: &str, what: &str| lines.iter().find(|l| l.contains(line)).and_then(|l| l.find(what));
        assert_eq!(at("probe_radius_mm =", "1500"), at("^^^^", "^^^^"), "{drawn}");
        for piece in [format!("^^^^ {}", problem.allowed), format!("help: {}", problem.remedy)] {
            assert!(drawn.contains(&piece), "{drawn}");
        }
        problems.text.clear();
        assert!(picture(&problems, &problem, &Renderer::plain()).contains("part.toml"));
    }
}
