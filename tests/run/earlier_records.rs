//! Records of earlier versions of the program: `tests/records` has a run folder of each, and the text that the program
//! which wrote it, or the one after, showed of it.

use std::fs;
use std::path::{Path, PathBuf};

use crate::contents;
use crate::program::{regrind, root};
use regrind::journal::verify;
use regrind::report::{RunResult, run_report, run_summary};

/// Name of each sample, number of its records and of its files, and how the run ended.
const SAMPLES: [(&str, u64, u64, RunResult); 6] = [
    ("layout-1", 5, 1, RunResult::Open),
    ("figures", 179, 0, RunResult::Aborted),
    ("table-9", 60, 3, RunResult::Aborted),
    ("table-10", 39, 3, RunResult::Stopped),
    ("recovery", 2, 0, RunResult::Recovery),
    ("table-12", 20, 3, RunResult::Stopped),
];

/// Copies a sample: a reader of a database may write beside it.
fn copied(name: &str) -> (tempfile::TempDir, PathBuf) {
    let home = tempfile::tempdir().unwrap();
    let folder = home.path().join(name);
    fs::create_dir(&folder).unwrap();
    for file in fs::read_dir(sample(name)).unwrap().map(|entry| entry.unwrap().path()) {
        fs::copy(&file, folder.join(file.file_name().unwrap())).unwrap();
    }
    (home, folder)
}

fn sample(name: &str) -> PathBuf {
    root().join("tests/records").join(name)
}

/// Runs a command on the run in `folder`. Returns the exit code and the text of the standard output.
fn printed(arguments: &[&str], folder: &Path) -> (i32, String) {
    let output = regrind(arguments, folder).output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stdout).unwrap())
}

#[test]
fn earlier_records_verify_and_read_as_before() {
    for (name, records, files, result) in SAMPLES {
        let (_home, folder) = copied(name);
        let verified = verify(&folder).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!((verified.records, verified.artefacts, verified.closed), (records, files, true), "{name}");
        let (code, said) = printed(&["audit", "show", "."], &folder);
        let before = fs::read_to_string(sample(name).with_extension("txt")).unwrap();
        assert_eq!((code, said.as_str()), (0, before.as_str()), "{name}");
        let summary = run_summary(&folder).unwrap();
        assert_eq!(summary.result, result, "{name}");
        let report = run_report(&folder, &regrind::report::ReportOptions::default()).unwrap();
        assert!(report.contains(&summary.run) && report.contains(&summary.verdict), "{name}");
        let cell = if ["figures", "layout-1"].contains(&name) { "not on record" } else { "cell.toml" };
        let cell = if name == "table-9" { "sim" } else { cell };
        assert!(report.contains(&format!("<th>cell</th><td>{cell}, sha256 ")), "{name}");
        if name != "layout-1" {
            contents::assert_known(&folder);
        }
        // A run that is over is not resumed, whatever its version.
        let (code, _) = printed(&["resume", "."], &folder);
        assert_ne!(code, 0, "{name}");
    }
}
