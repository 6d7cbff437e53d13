//! The rules of absence: what each room must not contain.

use std::fs;
use std::path::{Path, PathBuf};

/// Rooms that compute and decide, and do nothing else.
const PURE: [&str; 7] = ["geometry", "surface", "measuring", "registration", "compensation", "form", "cell"];

/// What a pure room has no word for.
const IMPURE: [&str; 13] = [
    "tokio",
    "async ",
    ".await",
    "std::fs",
    "std::net",
    "std::io",
    "Instant",
    "SystemTime",
    "rand::",
    "println!",
    "tracing",
    "log::",
    "std::process",
];

/// A source file and its code, without comments and without its tests.
struct Source {
    path: PathBuf,
    code: String,
}

fn sources(room: &str) -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join(room);
    let mut found = Vec::new();
    let mut open = vec![root];
    while let Some(path) = open.pop() {
        if path.is_dir() {
            open.extend(fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path()));
        } else if path.extension().is_some_and(|e| e == "rs") {
            let code = code_of(&fs::read_to_string(&path).unwrap());
            found.push(Source { path, code });
        }
    }
    found
}

/// Drops comments, and the tests, which stand at the end of a file.
fn code_of(text: &str) -> String {
    let before_tests = text.split("#[cfg(test)]\nmod ").next().unwrap_or(text);
    before_tests.lines().map(|line| line.split("//").next().unwrap_or(line)).fold(String::new(), |mut code, line| {
        code.push_str(line);
        code.push('\n');
        code
    })
}

fn assert_absent<'a>(sources: impl IntoIterator<Item = &'a Source>, words: &[&str]) {
    for Source { path, code } in sources {
        for word in words {
            let line = code.lines().find(|line| line.contains(word));
            assert!(line.is_none(), "{} must not say `{word}`: {}", path.display(), line.unwrap_or_default().trim());
        }
    }
}

fn in_room(source: &Source, room: &str) -> bool {
    source.path.starts_with(Path::new(env!("CARGO_MANIFEST_DIR")).join(room))
}

#[test]
fn pure_rooms_have_no_file_no_clock_no_chance_and_no_log() {
    for room in PURE {
        let found = sources(&format!("src/{room}"));
        assert_absent(&found, &IMPURE);
    }
    assert!(!sources("src/geometry").is_empty() && !sources("src/registration").is_empty());
}

#[test]
fn the_simulator_knows_nothing_of_the_controller() {
    let found = sources("sim");
    assert!(!found.is_empty());
    assert_absent(&found, &["regrind::", "extern crate regrind"]);
    let manifest = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("sim/Cargo.toml")).unwrap();
    assert!(!manifest.lines().any(|line| line.starts_with("regrind ") || line.starts_with("regrind=")));
}

#[test]
fn only_the_command_line_prints_or_exits() {
    let found = sources("src");
    let words =
        ["println!", "print!", "eprint", "io::stdout", "io::stderr", "process::exit", "ExitCode::", "anyhow", "miette"];
    assert_absent(found.iter().filter(|s| !in_room(s, "src/cli")), &words);
}

#[test]
fn only_formats_report_journal_and_the_file_exchange_write_files() {
    let found = sources("src");
    let words = ["File::create", "OpenOptions", "fs::write", "fs::rename", "fs::remove", "fs::create_dir"];
    let may = ["src/formats", "src/report", "src/journal", "src/device/exchange"];
    assert_absent(found.iter().filter(|s| !may.iter().any(|room| in_room(s, room))), &words);
}

#[test]
fn the_library_does_not_know_its_command_line() {
    let found = sources("src");
    let others = found.iter().filter(|s| !in_room(s, "src/cli") && !s.path.ends_with("src/main.rs"));
    assert_absent(others, &["clap", "crate::cli", "mod cli"]);
}
