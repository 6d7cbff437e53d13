//! Runs docs/plant.md unchanged, from an empty database to the second cell's part.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Stdio};

use tempfile::TempDir;

use crate::postgres::Postgres;
use crate::program::{root, small_recipe};

/// Returns the blocks of a language on a page, in order, each with the file name above it if it is a file.
fn blocks(page: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let mut open: Option<(String, String)> = None;
    for line in page.lines() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(_), Some(_)) => found.extend(open.take()),
            (Some(info), None) => open = Some((info.trim().to_owned(), String::new())),
            (None, Some((_, text))) => *text += &format!("{line}\n"),
            (None, None) => {}
        }
    }
    found
}

/// Types a block in a folder; returns its output.
fn typed(home: &Path, text: &str) -> String {
    let program = Path::new(env!("CARGO_BIN_EXE_regrind")).parent().unwrap().display().to_string();
    let path = format!("{program}:{}", std::env::var("PATH").unwrap());
    let mut shell = Command::new("bash");
    shell.args(["-e", "-o", "pipefail", "-c", text]).current_dir(home).stdin(Stdio::null());
    let done = shell.env("PATH", path).env("REGRIND_KEY", "").output().unwrap();
    let said = [done.stdout, done.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(done.status.success(), "{text}: {said:?}");
    said[0].clone()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn plant_guide_walked_through() {
    let mut postgres = Postgres::start();
    let home = TempDir::new().unwrap();
    let at = |name: &str| home.path().join(name);
    fs::create_dir(at("recipes")).unwrap();
    // A coarser grid, under the name on the page.
    fs::rename(small_recipe(home.path(), 1000.0), at("recipes/freeform-mirror.toml")).unwrap();
    postgres.write_owner_password(&at("owner.password"));
    let page = fs::read_to_string(root().join("docs/plant.md")).unwrap();
    let mut port = String::new();
    let mut said = Vec::new();
    for (language, text) in blocks(&page) {
        let here = text
            .replace("host = \"plant.example\"", &format!("host = \"localhost\"\nport = {port}"))
            .replace("--host plant.example", &format!("--host localhost --port {port}"))
            .replace("plant.example", "localhost");
        match (language.as_str(), here.strip_prefix("# ").and_then(|text| text.split_once('\n'))) {
            ("toml", Some((name, text))) => fs::write(at(name), text).unwrap(),
            ("sh", _) => said.push(typed(home.path(), &here)),
            _ => {}
        }
        if port.is_empty() && at("plant.pem").exists() {
            port = postgres.go_on_by_tls(&at("plant.pem"), &at("plant.key")).to_string();
        }
    }
    let all = said.concat();
    for words in ["layout", "signs in as cell_4", "the local journal", "SN-0001", "signed by two people"] {
        assert!(all.contains(words), "{words}: {all}");
    }
    let offer = ["by A. Smith and B. Jones", "2027-03-01"];
    assert!(all.lines().any(|line| offer.iter().all(|piece| line.contains(piece))), "{all}");
    assert!(at("regrind.dump").exists(), "{all}");
    let left = said.iter().rev().find(|said| said.contains("SN-0003")).unwrap();
    assert!(
        left.lines().last().unwrap().contains("open") && !left.contains("begun"),
        "the end of the other has arrived: {left}"
    );
    // A certificate of another computer is not accepted.
    let mode = fs::metadata(at("cell-1/plant.password")).unwrap().permissions().mode();
    assert_eq!(mode & 0o077, 0);
    let other = "openssl req -new -x509 -nodes -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -subj /CN=localhost -addext subjectAltName=DNS:localhost \
        -addext basicConstraints=critical,CA:FALSE -keyout /dev/null -out cell-1/plant.pem 2>/dev/null";
    typed(home.path(), other);
    let refused =
        typed(&at("cell-1"), "code=0; regrind ship --once --plant plant.toml 2>&1 || code=$?; test $code = 2");
    assert!(refused.contains("certificate"), "{refused}");
}
