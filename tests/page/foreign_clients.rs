//! Interface for programs, read by clients that other people wrote: schemathesis tries it against its own description,
//! the Prometheus client parses its metrics, and curl runs the examples of the book. They run in a Python environment that
//! is made once below the target folder, or with the Python that REGRIND_PYTHON names, which must have the packages.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use regrind_testutils::python::with_packages;
use serde_json::Value;

use crate::api::{Reader, two_parts};
use crate::program::root;
use crate::{CellPage, serve};

fn scripts() -> PathBuf {
    root().join("tests/page/peers")
}

/// Returns a Python with the packages that the clients need, installed once.
fn python() -> &'static Path {
    static PYTHON: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    PYTHON
        .get_or_init(|| {
            let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("api-python");
            let import = "import openapi_spec_validator, prometheus_client, schemathesis";
            with_packages(import, &scripts().join("requirements.txt"), &home)
        })
        .as_deref()
        .unwrap_or_else(|why| panic!("no Python with schemathesis: {why}"))
}

/// Runs a script with a text as its input, and returns its output.
fn script(name: &str, arguments: &[&str], input: &[u8]) -> String {
    let mut command = Command::new(python());
    command.arg(scripts().join(name)).args(arguments);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    child.stdin.take().unwrap().write_all(input).unwrap();
    let done = child.wait_with_output().unwrap();
    assert!(done.status.success(), "{name}: {}", String::from_utf8_lossy(&done.stderr));
    String::from_utf8(done.stdout).unwrap()
}

/// Number of examples of each kind for each address: few in every run, more in .ci/long.
fn example_count() -> u32 {
    std::env::var("REGRIND_API_EXAMPLES").map_or(3, |count| count.parse().unwrap())
}

/// Tries all addresses by schemathesis, except the one that is left out. Its seed is fixed.
fn try_all(reader: &Reader, run: &str, left_out: Option<&str>, home: &Path) {
    let settings = home.join("schemathesis.toml");
    let text = format!("[parameters]\n\"path.run\" = {run:?}\n\"path.cycle\" = 1\n");
    std::fs::write(&settings, text).unwrap();
    let mut command = Command::new(python());
    command.args(["-m", "schemathesis.cli", "--config-file"]).arg(&settings).arg("run");
    command.arg(format!("http://{}/api/openapi.json", reader.place));
    command.args(["--header", &format!("Authorization: Bearer {}", reader.token), "--checks", "all", "--seed", "1"]);
    command.args(["--max-examples", &example_count().to_string(), "--generation-database", "none", "--no-color"]);
    command.args(["--phases", "examples,coverage,fuzzing", "--workers", "4"]);
    command.args(left_out.iter().flat_map(|path| ["--exclude-path", path]));
    let done = command.current_dir(home).output().unwrap();
    assert!(
        done.status.success(),
        "{}{}",
        String::from_utf8_lossy(&done.stdout),
        String::from_utf8_lossy(&done.stderr)
    );
}

#[test]
#[ignore = "needs Python with venv and pip"]
fn schemathesis_finds_nothing_in_finished_run() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    try_all(&Reader::with_key(&url), &ids[0], None, home.path());
}

/// The stream of a run under way does not end, so the tests of the interface itself read it.
#[test]
#[ignore = "needs Python with venv and pip"]
fn schemathesis_finds_nothing_in_run_under_way() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 1.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    try_all(&Reader::with_key(&shown.url), &shown.id, Some("/api/v1/runs/{run}/stream"), home.path());
    assert!(!shown.run.is_over());
    shown.run.signal("KILL");
}

#[test]
#[ignore = "needs Python with venv and pip"]
fn description_is_valid_openapi() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = serve(home.path());
    script("check_openapi.py", &[], &Reader::with_key(&url).ask("GET", "/api/openapi.json", "").body);
}

/// Returns the samples of the metrics, by their names and labels, and checks that both formats have the same ones.
fn samples(reader: &Reader) -> BTreeMap<String, f64> {
    let parsed = |accept: &str, format: &str| {
        let answer = reader.ask("GET", "/metrics", &format!("Accept: {accept}\r\n"));
        assert_eq!(answer.status, 200, "{answer:?}");
        serde_json::from_str::<Value>(&script("read_metrics.py", &[format], &answer.body)).unwrap()
    };
    let (plain, open) = (parsed("*/*", "prometheus"), parsed("application/openmetrics-text", "openmetrics"));
    let by_name = |of: &Value| {
        let samples = of["samples"].as_array().unwrap().iter();
        let pair =
            |sample: &Value| (format!("{}{}", sample[0].as_str().unwrap(), sample[1]), sample[2].as_f64().unwrap());
        samples.map(pair).collect::<BTreeMap<_, _>>()
    };
    let (found, other) = (by_name(&plain), by_name(&open));
    assert_eq!(found.keys().collect::<Vec<_>>(), other.keys().collect::<Vec<_>>());
    let types = plain["types"].as_object().unwrap();
    assert!(types.values().all(|kind| ["gauge", "counter", "summary"].contains(&kind.as_str().unwrap())), "{types:?}");
    found
}

#[test]
#[ignore = "needs Python with venv and pip"]
fn prometheus_parses_metrics_of_finished_runs() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let found = samples(&reader);
    let cycles = reader.json(&format!("/api/v1/runs/{}/figures", ids[1]))["cycles"].as_array().unwrap().clone();
    let last = cycles.last().unwrap();
    for (name, figure, key) in [
        ("regrind_form_pv_meters{}", "pv", "median_um"),
        ("regrind_form_pv_low_meters{}", "pv", "low_um"),
        ("regrind_form_rms_high_meters{}", "rms", "high_um"),
        ("regrind_form_rms_limit_meters{}", "rms", "limit_um"),
    ] {
        let um = last[figure][key].as_f64().unwrap();
        assert!((found[name] - 1e-6 * um).abs() < 1e-15, "{name}: {} {um}", found[name]);
    }
    for (name, expected) in [
        ("regrind_parts_total{\"result\":\"accepted\"}", 2.0),
        ("regrind_parts_total{\"result\":\"aborted\"}", 0.0),
        ("regrind_cell_state{\"state\":\"Idle\"}", 1.0),
        ("regrind_cell_state{\"state\":\"Execute\"}", 0.0),
        ("regrind_simulation{}", 1.0),
        ("regrind_runs_active{}", 0.0),
        ("regrind_page_connections{\"access\":\"authorised\"}", 1.0),
        ("regrind_form_cycle{}", cycles.len() as f64),
    ] {
        assert_eq!(found.get(name), Some(&expected), "{name}: {found:#?}");
    }
    let all: Vec<Value> = ids
        .iter()
        .flat_map(|id| reader.json(&format!("/api/v1/runs/{id}/figures"))["cycles"].as_array().unwrap().clone())
        .collect();
    for (name, key) in [("pass", "pass_duration_s"), ("measurement", "measurement_duration_s")] {
        let sum: f64 = all.iter().map(|cycle| cycle[key].as_f64().unwrap()).sum();
        assert_eq!(found[&format!("regrind_{name}_duration_seconds_count{{}}")], all.len() as f64);
        assert!((found[&format!("regrind_{name}_duration_seconds_sum{{}}")] - sum).abs() < 1e-9);
    }
}

#[test]
#[ignore = "needs Python with venv and pip"]
fn prometheus_parses_metrics_of_run_under_way() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let visitor = shown.visitor();
    assert!(visitor.order(&shown.id, &serde_json::json!({ "order": "hold", "reason": "" })).1);
    let reader = Reader::with_key(&shown.url);
    shown.run.until("Held", |_| (reader.json("/api/v1/cell")["state"] == "Held").then_some(()));
    let found = samples(&reader);
    let info = found.keys().find(|name| name.starts_with("regrind_run_info")).unwrap();
    assert!(info.contains(&shown.id) && info.contains("SN-0042"), "{info}");
    for (name, expected) in [
        ("regrind_cell_state{\"state\":\"Held\"}", 1.0),
        ("regrind_cell_state{\"state\":\"Idle\"}", 0.0),
        ("regrind_cell_answers{}", 1.0),
        ("regrind_runs_active{}", 1.0),
        ("regrind_runs_interrupted{}", 0.0),
        ("regrind_cycle{}", 1.0),
        ("regrind_alarm_active{\"code\":\"link_lost\"}", 0.0),
        ("regrind_machine_connected{\"machine\":\"cmm\"}", 1.0),
        ("regrind_parts_total{\"result\":\"accepted\"}", 0.0),
    ] {
        assert_eq!(found.get(name), Some(&expected), "{name}: {found:#?}");
    }
    assert!(found["regrind_status_age_seconds{}"] < 60.0 && found["regrind_run_elapsed_seconds{}"] > 0.0, "{found:#?}");
    assert!(!found.contains_key("regrind_form_pv_meters{}"), "nothing was measured: {found:#?}");
    shown.run.signal("KILL");
}

/// Every example by curl of the book gets what it asks for.
#[test]
#[ignore = "needs curl"]
fn examples_of_the_book_run() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let book = std::fs::read_to_string(root().join("docs/api.md")).unwrap();
    let examples: Vec<&str> = book.lines().filter(|line| line.starts_with("curl ")).collect();
    assert!(examples.len() > 8, "{examples:?}");
    for example in examples {
        let mut command = Command::new("bash");
        command.args(["-c", &example.replacen("curl", "curl --fail", 1)]).current_dir(home.path());
        command.env("CELL", format!("http://{}", reader.place)).env("TOKEN", &reader.token).env("RUN", &ids[0]);
        let done = command.output().unwrap();
        assert!(done.status.success(), "{example}: {}", String::from_utf8_lossy(&done.stderr));
    }
    assert!(std::fs::metadata(home.path().join("map.x3p")).unwrap().len() > 0);
}
