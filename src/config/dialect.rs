//! Dialect of a cell's programs: a built-in one, or a file of the shop.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use crate::document::{Document, Problems, RenamedKey, read_text, schema_of, sha256};
use crate::formats::gcode::Dialect;

/// Keys that have a new name since version 0.2.
const RENAMED: &[RenamedKey] = &[
    RenamedKey { old: "text.longest_line", new: "text.max_line_length" },
    RenamedKey { old: "numbers.largest_mm", new: "numbers.max_mm" },
    RenamedKey { old: "program.longest_name", new: "program.max_name_length" },
];

/// Dialect with the state of its file.
#[derive(Clone, Debug, PartialEq)]
pub struct DialectFile {
    /// Program format of the machine control.
    pub dialect: Dialect,
    /// SHA-256 of the text of the file.
    pub source_sha256: [u8; 32],
    /// One note for each key that the file has under its old name. The note states the line and the new name.
    pub renamed_keys: Vec<String>,
}

static SCHEMA: LazyLock<serde_json::Value> = LazyLock::new(schema_of::<Dialect>);

/// Built-in dialects, by name.
const BUILT_IN_DIALECTS: [(&str, &str); 4] = [
    ("linuxcnc", include_str!("../../config/dialects/linuxcnc.toml")),
    ("fanuc", include_str!("../../config/dialects/fanuc.toml")),
    ("sinumerik", include_str!("../../config/dialects/sinumerik.toml")),
    ("heidenhain", include_str!("../../config/dialects/heidenhain.toml")),
];

/// Returns the JSON schema of a dialect file. A dialect is the format of the programs of one kind of machine control.
pub fn dialect_schema() -> &'static serde_json::Value {
    &SCHEMA
}

/// Returns the names of the built-in dialects.
pub fn dialects() -> impl Iterator<Item = &'static str> {
    BUILT_IN_DIALECTS.iter().map(|(name, _)| *name)
}

/// Returns the path of the dialect file that the cell file `cell` names. A dialect is the program format of a machine
/// control. `dialect` is the text in the cell file: the name of a built-in dialect, or a path. A relative path is
/// resolved against the folder of `cell`.
///
/// Returns `None` if `dialect` is the name of a built-in dialect, because there is no file for it.
pub(super) fn dialect_path(dialect: &str, cell: &Path) -> Option<PathBuf> {
    let is_built_in = dialects().any(|name| name == dialect);
    (!is_built_in).then(|| cell.parent().unwrap_or(Path::new("")).join(dialect))
}

/// Returns the dialect (format of the programs of a machine control) that a cell file names. `dialect` is the name of a
/// built-in dialect, or else the path of a dialect file. A relative path is resolved against the folder of the cell
/// file `cell`.
///
/// # Errors
/// Returns an error if the file cannot be read. Otherwise returns all errors found in its text.
pub fn read_named_dialect(dialect: &str, cell: &Path) -> Result<DialectFile, Problems> {
    match BUILT_IN_DIALECTS.iter().find(|(name, _)| name.eq_ignore_ascii_case(dialect)) {
        Some((name, text)) => parse_dialect(Path::new(name), text),
        None => read_dialect(&dialect_path(dialect, cell).unwrap_or_default()),
    }
}

/// Reads a dialect file. A dialect is the program format of a machine control.
///
/// # Errors
/// Returns an error if the file cannot be read. Otherwise returns all errors found in its text.
pub fn read_dialect(path: &Path) -> Result<DialectFile, Problems> {
    let text = read_text(path)?;
    parse_dialect(path, &text)
}

/// Parses a dialect (the program format of a machine control) from the content `text` of its file. `path` is the path
/// of the file and appears only in error messages.
///
/// # Errors
/// Returns all errors found in the text.
pub fn parse_dialect(path: &Path, text: &str) -> Result<DialectFile, Problems> {
    let mut document = Document::parse(path, text)?;
    let renamed_keys = document.rename_keys(RENAMED);
    document.check_schema(&SCHEMA);
    let written: Option<Dialect> = document.deserialize();
    for fault in written.iter().flat_map(Dialect::faults) {
        // A missing key is already reported.
        if !document.has_problem(&fault.key) {
            document.report(&fault.key, fault.found, fault.allowed, fault.remedy);
        }
    }
    document.finish()?;
    let missing =
        || Problems::whole(path, text, "a required value is missing".into(), "compare it with a shipped dialect");
    Ok(DialectFile { dialect: written.ok_or_else(missing)?, source_sha256: sha256(text), renamed_keys })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_dialects_read_by_name() {
        for name in dialects() {
            let dialect =
                read_named_dialect(name, Path::new("cell.toml")).unwrap_or_else(|problems| panic!("{problems}"));
            assert_eq!(dialect.dialect.dialect.name, name);
            assert_eq!(dialect.renamed_keys, [""; 0], "{name}");
        }
    }

    #[test]
    fn old_dialect_keys_are_read_with_notes() {
        let new = parse_dialect(Path::new("ours.toml"), BUILT_IN_DIALECTS[1].1).unwrap();
        let text = RENAMED.iter().fold(BUILT_IN_DIALECTS[1].1.to_owned(), |text, key| {
            let name = |path: &str| format!("\n{} = ", path.split('.').next_back().unwrap());
            assert!(text.contains(&name(key.new)), "{}", key.new);
            text.replace(&name(key.new), &name(key.old))
        });
        let old = parse_dialect(Path::new("ours.toml"), &text).unwrap();
        assert_eq!(old.dialect, new.dialect);
        assert_eq!(old.renamed_keys.len(), RENAMED.len());
        for (note, key) in old.renamed_keys.iter().zip(RENAMED) {
            assert!(note.contains(key.old) && note.contains(key.new), "{note}");
        }
    }

    #[test]
    fn dialect_problems_have_place_and_key() {
        let text = BUILT_IN_DIALECTS[1]
            .1
            .replace("\ndecimals = 4 ", "\ndecimals = 9 ")
            .replace("\nline = ", "\nlines = ")
            .replace("G21 G90", "G20 G90");
        let problems = parse_dialect(Path::new("ours.toml"), &text).unwrap_err();
        let told = problems.to_string();
        let at = |what: &str| 1 + text.lines().position(|line| line.contains(what)).unwrap();
        for (key, what) in
            [("numbers.decimals", "decimals = 9 "), ("words.lines", "lines = "), ("program.setup[0]", "G20")]
        {
            let begins = format!("ours.toml:{}:", at(what));
            assert!(told.lines().any(|line| line.starts_with(&begins) && line.contains(key)), "{key}: {told}");
        }
        assert!(told.contains("did you mean `line`?"), "{told}");
        assert_eq!(told.lines().count(), 3, "{told}");
    }

    #[test]
    fn dialect_arcs_require_centre_words() {
        for (k, missing) in [(1, "centre_words"), (3, "centre_block")] {
            let lines = BUILT_IN_DIALECTS[k].1.lines().filter(|line| !line.starts_with(missing));
            let text = lines.collect::<Vec<_>>().join("\n");
            let problems = parse_dialect(Path::new("ours.toml"), &text).unwrap_err().to_string();
            let at = 1 + text.lines().position(|line| line.starts_with("[arcs]")).unwrap();
            assert!(problems.starts_with(&format!("ours.toml:{at}:")), "{problems}");
            let key = format!("arcs.{missing}");
            assert!(
                problems.contains(&key) && problems.contains("write ") && problems.lines().count() == 1,
                "{problems}"
            );
        }
    }
}
