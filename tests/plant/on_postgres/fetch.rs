//! Runs that are fetched from the plant, and lists of what it has: whatever names and texts a cell has sent, nothing is
//! written outside of the folder, and nothing is sent to the terminal that changes it.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::Value;
use tempfile::TempDir;

use super::forged::Forged;
use crate::Plant;

/// Returns all paths below a folder.
fn below(folder: &Path) -> BTreeSet<PathBuf> {
    let mut found = BTreeSet::new();
    for path in fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path()) {
        if path.is_dir() && !path.is_symlink() {
            found.append(&mut below(&path));
        }
        found.insert(path);
    }
    found
}

/// Returns the names that no folder and no file of a run may have. `absolute` is an absolute path.
fn bad_names(absolute: &str) -> Vec<String> {
    let names = [
        "../evil",
        "../../evil",
        "..",
        ".",
        "a/../../evil",
        "..\\evil",
        "C:evil",
        "C:\\evil",
        "a\nb",
        "a\u{1b}[2Jb",
        "a\u{9b}2Jb",
        "a\u{202e}b",
    ];
    names.map(str::to_owned).into_iter().chain([absolute.to_owned()]).collect()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn fetch_refuses_names_that_lead_elsewhere() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.somebody("office", "reader");
    let elsewhere = TempDir::new().unwrap();
    let absolute = elsewhere.path().join("evil").display().to_string();
    let fetch =
        |name: &str, code| plant.ends(&["plant", "fetch", name, "--plant", "office.toml", "--out", "back"], code);
    let before = below(plant.home.path());
    for name in bad_names(&absolute).iter().map(String::as_str).chain(["a/b", "a\\b", ".hidden"]) {
        assert_eq!(Forged::named(name).ship(&plant, "cell-1"), Ok(String::new()), "{name:?}");
        fetch(name, 1);
        assert_eq!((below(plant.home.path()), below(elsewhere.path())), (before.clone(), BTreeSet::new()), "{name:?}");
    }
    let of_journal = [
        "journal.sqlite",
        "journal.sqlite-wal",
        "JOURNAL.sqlite",
        "journal.anchor.",
        ".lock",
        "a/",
        "con",
        "a/Lpt1.txt",
    ];
    let of_files = bad_names(&absolute);
    for (k, name) in of_files.iter().map(String::as_str).chain(of_journal).enumerate() {
        let run = format!("run-{k}");
        let forged = Forged { files: &["cycle-1/points.csv", name], ..Forged::named(&run) };
        assert_eq!(forged.ship(&plant, "cell-1"), Ok(String::new()), "{name:?}");
        fetch(&run, 1);
        plant.ends(&["audit", "verify", &run, "--plant", "office.toml"], 1);
        assert_eq!((below(plant.home.path()), below(elsewhere.path())), (before.clone(), BTreeSet::new()), "{name:?}");
    }
    // A name in another language leads nowhere else.
    let name = "Spiegel \u{e4}\u{6f22} (2) 20260704T120000Z";
    let forged = Forged { files: &["cycle-1/\u{e4} 1.csv"], ..Forged::named(name) };
    assert_eq!(forged.ship(&plant, "cell-1"), Ok(String::new()));
    fetch(name, 0);
    assert_eq!(fs::read(plant.path("back").join(name).join("cycle-1/\u{e4} 1.csv")).unwrap(), b"hello");
    // A link that somebody made in the folder.
    let other = "other-20260704T120000Z";
    Forged::named(other).ship(&plant, "cell-1").unwrap();
    std::os::unix::fs::symlink(elsewhere.path(), plant.path("back").join(other)).unwrap();
    fetch(other, 2);
    assert_eq!(below(elsewhere.path()), BTreeSet::new());
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn lists_send_no_escape_codes_to_terminal() {
    let plant = Plant::new();
    plant.cell("cell-1", &[]);
    plant.somebody("office", "reader");
    let harm = "x\u{1b}]0;owned\u{7}\u{9b}31m\u{202e}\r\n2026-01-01  forged line\t";
    let run = format!("run {}", harm.replace('\r', ""));
    assert_eq!(Forged { part: harm, ..Forged::named(&run) }.ship(&plant, "cell-1"), Ok(String::new()));
    plant
        .asked_by(
            "cell-1",
            &format!(
                "SELECT tell_run(1, '{{\"cycles\": []}}'); SELECT complain($a${run}$a$, $a${harm}$a$, $a${harm}$a$)"
            ),
        )
        .unwrap();
    let is_clean =
        |text: &str| text.chars().all(|c| c == '\n' || regrind::document::misleading(&c.to_string()).is_none());
    for (command, key) in [("runs", "run"), ("incidents", "words")] {
        let text = plant.does(&["plant", command, "--plant", "office.toml"]);
        assert!(is_clean(&text) && text.lines().count() == 1, "{command}: {text:?}");
        let json = plant.does(&["plant", command, "--json", "--plant", "office.toml"]);
        assert!(is_clean(&json), "{command}: {json:?}");
        let told: Vec<Value> = serde_json::from_str(&json).unwrap();
        assert_eq!(told[0][key], if key == "run" { &*run } else { harm }, "the same value as JSON");
    }
    let (out, errors) = plant.ends(&["plant", "fetch", &run, "--plant", "office.toml", "--out", "back"], 1);
    assert!(is_clean(&out) && is_clean(&errors), "{out:?} {errors:?}");
}
