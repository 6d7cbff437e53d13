//! The language of the sources: identifiers and first words of doc comments that hide what a thing is. Their number may
//! only fall.
//!
//! docs/glossary.md has the words to use. A serialised name, an alias of the command line and a unit file are no
//! identifiers here.

use std::fs;
use std::path::{Path, PathBuf};

/// Folders of sources, with the number of banned types, banned functions and banned first words that each still has.
/// Lower a number when it falls; never raise one.
const ALLOWED: [(&str, [usize; 3]); 26] = [
    ("src/cell", [0, 0, 0]),
    ("src/cli", [0, 0, 0]),
    ("src/config", [0, 0, 0]),
    ("src/control", [0, 0, 0]),
    ("src/core", [0, 0, 0]),
    ("src/device", [0, 0, 0]),
    ("src/document", [0, 0, 0]),
    ("src/drive", [0, 0, 0]),
    ("src/figures", [0, 0, 0]),
    ("src/formats", [0, 0, 0]),
    ("src/journal", [0, 0, 0]),
    ("src/language", [0, 0, 0]),
    ("src/live", [0, 0, 0]),
    ("src/notify", [0, 0, 0]),
    ("src/page", [0, 0, 0]),
    ("src/plant", [0, 0, 0]),
    ("src/python", [0, 0, 0]),
    ("src/recipe", [0, 0, 0]),
    ("src/record", [0, 0, 0]),
    ("src/report", [0, 0, 0]),
    ("src/trust", [0, 0, 0]),
    ("src/windows", [0, 0, 0]),
    ("sim", [0, 0, 0]),
    ("tests", [0, 0, 0]),
    ("examples", [0, 0, 0]),
    ("benches", [0, 0, 0]),
];

/// Names of types that say what happened to a thing, or name two things.
const TYPES: [&str; 36] = [
    "Asked",
    "Beside",
    "Births",
    "Deed",
    "Drawn",
    "Foretold",
    "Given",
    "Growing",
    "Hearing",
    "Hyper",
    "Kept",
    "Lay",
    "Lean",
    "Ledger",
    "Lesson",
    "Look",
    "Making",
    "News",
    "Now",
    "PageOf",
    "Pace",
    "Pulse",
    "Scribe",
    "Seen",
    "SoFar",
    "Story",
    "TakenBack",
    "Taught",
    "Ticket",
    "Told",
    "Turn",
    "Wanted",
    "Why",
    "Wired",
    "Witness",
    "Word",
];

/// Names of functions of which the same holds.
const FUNCTIONS: [&str; 12] =
    ["of", "told", "tell", "take", "look", "climb", "surprise", "foretell", "imagine", "hearing", "dial", "beside"];

/// First words of a doc comment whose subject comes late.
const FIRST_WORDS: [&str; 4] = ["What", "Whoever", "Who", "Of"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the Rust files below a folder.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![folder.to_owned()];
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Returns the identifier that a line defines after one of some keywords.
fn defined<'a>(line: &'a str, keywords: &[&str]) -> Option<&'a str> {
    let line = line.trim_start();
    // Visibility and qualifiers come before the keyword.
    let line = match line.strip_prefix("pub") {
        Some(rest) if rest.starts_with('(') => rest.split_once(") ")?.1,
        Some(rest) => rest.trim_start(),
        None => line,
    };
    let line = ["const ", "async ", "unsafe "].iter().fold(line, |line, word| line.strip_prefix(word).unwrap_or(line));
    let name = keywords.iter().find_map(|keyword| line.strip_prefix(keyword))?;
    let end = name.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(name.len());
    Some(&name[..end])
}

/// Counts banned types, banned functions and banned first words of doc comments in a source text.
fn counted(text: &str) -> [usize; 3] {
    let (mut types, mut functions, mut words) = (0, 0, 0);
    let mut before = "";
    for line in text.lines().map(str::trim_start) {
        let is_doc = |line: &str| line.starts_with("///") || line.starts_with("//!");
        if is_doc(line) && !is_doc(before) {
            let first = line[3..].trim_start().split(|c: char| !c.is_alphanumeric()).next().unwrap_or("");
            words += usize::from(FIRST_WORDS.contains(&first));
        }
        let of = defined(line, &["struct ", "enum ", "trait ", "type "]);
        types += usize::from(of.is_some_and(|name| TYPES.contains(&name)));
        functions += usize::from(defined(line, &["fn "]).is_some_and(|name| FUNCTIONS.contains(&name)));
        before = line;
    }
    [types, functions, words]
}

#[test]
fn definitions_and_docs_are_counted() {
    let text = "/// Of a part.\n/// What it is.\npub(super) struct Told<'a> {\n    /// What.\n    a: u8,\n}\npub const fn of() {}\n\
        fn often() {}\n    async fn tell(&self) {}\n// What is no doc.\nstruct Tolds;\nlet of = told();\n";
    assert_eq!(counted(text), [1, 2, 2]);
    assert_eq!(counted("pub enum Why {\n"), [1, 0, 0]);
    assert_eq!(counted(""), [0; 3]);
}

#[test]
fn banned_names_only_decrease() {
    let found: Vec<(&str, [usize; 3])> = ALLOWED
        .iter()
        .map(|(folder, _)| {
            let files = sources(&root().join(folder));
            assert!(!files.is_empty(), "no sources in {folder}");
            let counts = files.iter().map(|path| counted(&fs::read_to_string(path).unwrap()));
            (*folder, counts.fold([0; 3], |sum, of| [0, 1, 2].map(|k| sum[k] + of[k])))
        })
        .collect();
    assert!(found == ALLOWED, "types, functions and first words by folder are now\n{found:#?}\nand were\n{ALLOWED:#?}");
}
