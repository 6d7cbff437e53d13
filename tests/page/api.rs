//! Interface for programs: the content of its answers, and the answer to everything that it refuses.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::path::Path;

use regrind_testcell::http::{Answer, Visitor, raw};
use serde_json::{Value, json};

use crate::program::{PATIENCE, run, run_folders, small_recipe};
use crate::users::{PASSWORD, add};
use crate::{CellPage, serve, serve_with};

/// Program that reads the page with a token.
pub struct Reader {
    pub place: String,
    pub token: String,
}

impl Reader {
    /// Returns a program with the key in the address that opens a page.
    pub fn with_key(url: &str) -> Self {
        let (address, token) = url.trim_start_matches("http://").split_once("/?key=").unwrap();
        Self { place: address.to_owned(), token: token.to_owned() }
    }

    /// Sends a request with additional headers, each with its line end.
    pub fn ask(&self, method: &str, path: &str, headers: &str) -> Answer {
        let Self { place, token } = self;
        let access = if token.is_empty() { String::new() } else { format!("Authorization: Bearer {token}\r\n") };
        let request =
            format!("{method} {path} HTTP/1.1\r\nHost: {place}\r\n{access}{headers}Connection: close\r\n\r\n");
        raw(place, request.as_bytes())
    }

    /// Returns the document at an address.
    pub fn json(&self, path: &str) -> Value {
        let answer = self.ask("GET", path, "");
        assert_eq!(
            (answer.status, answer.header("content-type")),
            (200, vec!["application/json"]),
            "{path}: {answer:?}"
        );
        serde_json::from_slice(&answer.body).unwrap()
    }

    /// Opens the stream of a run. HTTP/1.0 has no chunks in the stream.
    fn stream(&self, path: &str, headers: &str) -> Events {
        let Self { place, token } = self;
        let mut stream = TcpStream::connect(place).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = format!("GET {path} HTTP/1.0\r\nHost: {place}\r\nAuthorization: Bearer {token}\r\n{headers}\r\n");
        stream.write_all(request.as_bytes()).unwrap();
        let mut lines = BufReader::new(stream);
        let mut head = String::new();
        while !head.ends_with("\r\n\r\n") && lines.read_line(&mut head).unwrap() > 0 {}
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        Events { status, lines }
    }
}

/// Open stream of events.
struct Events {
    status: u16,
    lines: BufReader<TcpStream>,
}

/// Event of a stream: its name, its number and its data.
type Event = (String, Option<u64>, Value);

impl Iterator for Events {
    type Item = Event;

    fn next(&mut self) -> Option<Event> {
        let (mut name, mut number, mut data) = (String::new(), None, Value::Null);
        loop {
            let mut line = String::new();
            if self.lines.read_line(&mut line).unwrap() == 0 {
                return None;
            }
            match line.trim_end().split_once(": ") {
                Some(("event", value)) => name = value.to_owned(),
                Some(("id", value)) => number = Some(value.parse().unwrap()),
                Some(("data", value)) => data = serde_json::from_str(value).unwrap(),
                _ if line == "\n" && !name.is_empty() => return Some((name, number, data)),
                _ => {}
            }
        }
    }
}

/// Makes two parts, and returns the names of their runs.
pub fn two_parts(home: &Path) -> Vec<String> {
    let recipe = small_recipe(home, 1e5).display().to_string();
    for part in ["SN-0001", "SN-0002"] {
        let (code, said, errors) =
            run(&["run", &recipe, "--cell", "sim", "--part", part, "--operator", "A. Smith"], home);
        assert_eq!(code, 0, "{said}{errors}");
    }
    let folders = run_folders(&home.join("runs"));
    folders.iter().map(|folder| folder.file_name().unwrap().to_str().unwrap().to_owned()).collect()
}

fn keys(value: &Value) -> BTreeSet<&str> {
    value.as_object().unwrap().keys().map(String::as_str).collect()
}

#[test]
fn programs_read_finished_runs() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);

    let cell = reader.json("/api/v1/cell");
    let expected = json!({ "state": "Idle", "active_runs": [], "run": null, "last_run": cell["last_run"] });
    assert_eq!((&cell, &cell["last_run"]["run"]), (&expected, &json!(ids[1])));

    // One run a page, from the newest to the oldest.
    let first = reader.json("/api/v1/runs?limit=1");
    let cursor = first["next_cursor"].as_str().unwrap();
    let second = reader.json(&format!("/api/v1/runs?limit=1&cursor={}", cursor.replace('~', "%7E")));
    let names = [&first, &second].map(|page| page["runs"][0]["run"].as_str().unwrap());
    assert_eq!((names, &second["next_cursor"], &first["unreadable"]), ([&*ids[1], &*ids[0]], &Value::Null, &json!([])));
    for (query, expected) in [("part=SN-0001", 1), ("part=SN-000", 0), ("result=accepted", 2), ("result=aborted", 0)] {
        let found = reader.json(&format!("/api/v1/runs?{query}"));
        assert_eq!(found["runs"].as_array().unwrap().len(), expected, "{query}");
    }

    let base = format!("/api/v1/runs/{}", ids[0]);
    let shown = reader.json(&base);
    let told = ["part", "result", "operator", "is_active", "simulation"].map(|key| shown[key].clone());
    assert_eq!(told, [json!("SN-0001"), json!("accepted"), json!("A. Smith"), json!(false), json!(true)]);
    let state = &shown["state"];
    assert_eq!(
        (&state["state"], &state["is_active"], &state["elapsed_s"]),
        (&json!("Complete"), &json!(false), &Value::Null)
    );

    let folder = home.path().join("runs").join(&ids[0]);
    let result: Value = serde_json::from_slice(&std::fs::read(folder.join("result.json")).unwrap()).unwrap();
    let figures = reader.json(&format!("{base}/figures"));
    let cycles = figures["cycles"].as_array().unwrap();
    assert_eq!(cycles.len(), result["cycles"].as_array().unwrap().len());
    for (found, recorded) in cycles.iter().zip(result["cycles"].as_array().unwrap()) {
        for (figure, judged) in [(&found["pv"], &recorded["judged_pv_um"]), (&found["rms"], &recorded["judged_rms_um"])]
        {
            let um = |key: &str| figure[key].as_f64().unwrap();
            assert!((um("median_um") - judged.as_f64().unwrap()).abs() < 1e-9, "{figure} {judged}");
            assert!(
                um("low_um") <= um("median_um") && um("median_um") <= um("high_um") && um("limit_um") > 0.0,
                "{figure}"
            );
        }
        assert_eq!(found["points"].as_u64().unwrap(), recorded["points"].as_u64().unwrap());
        assert!(found["pass_duration_s"].as_f64().unwrap() > 0.0, "{found}");
        assert!(found["measurement_duration_s"].as_f64().unwrap() > 0.0, "{found}");
    }
    assert_eq!(
        (&cycles.last().unwrap()["verdict"], &cycles.last().unwrap()["pv"]["conformity"]),
        (&json!("accept"), &json!("within"))
    );
}

#[test]
fn programs_read_maps_and_files() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let folder = home.path().join("runs").join(&ids[0]);
    let maps = reader.json(&format!("/api/v1/runs/{}/maps", ids[0]));
    let map = &maps["maps"][0];
    let files = map["files"].as_array().unwrap();
    assert_eq!((maps["maps"].as_array().unwrap().len(), files.len()), (2, 5), "{maps}");
    for file in files {
        let answer = reader.ask("GET", file["href"].as_str().unwrap(), "");
        let bytes = std::fs::read(folder.join("cycle-1").join(file["name"].as_str().unwrap())).unwrap();
        let media = file["media_type"].as_str().unwrap();
        assert_eq!((answer.status, answer.header("content-type")), (200, vec![media]), "{file}");
        assert!(answer.body == bytes && file["bytes"] == bytes.len(), "{file}");
        let tag = answer.header("etag")[0].to_owned();
        let again = reader.ask("GET", file["href"].as_str().unwrap(), &format!("If-None-Match: \"other\", {tag}\r\n"));
        assert_eq!((again.status, again.body.len(), again.header("etag")), (304, 0, vec![&*tag]), "{again:?}");
    }
    let grid = reader.json(map["href"].as_str().unwrap());
    let number = |key: &str| grid[key].as_f64().unwrap();
    let text = std::fs::read_to_string(folder.join("cycle-1/error_map.csv")).unwrap();
    let mut measured = 0;
    for line in text.lines().filter(|line| !line.starts_with(['#', 'x']) && line.ends_with(",1")) {
        let values: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let index =
            |k: usize, first: &str, spacing: &str| ((values[k] - number(first)) / number(spacing)).round() as usize;
        let (column, row) = (index(0, "first_x_mm", "spacing_x_mm"), index(1, "first_y_mm", "spacing_y_mm"));
        let found = [&grid["error_um"], &grid["sigma_um"]].map(|rows| rows[row][column].as_f64().unwrap());
        assert!(
            (found[0] - 1e3 * values[2]).abs() < 1e-6 && (found[1] - 1e3 * values[3]).abs() < 1e-6,
            "{line} {found:?}"
        );
        measured += 1;
    }
    let rows = grid["error_um"].as_array().unwrap();
    let all: Vec<&Value> = rows.iter().flat_map(|row| row.as_array().unwrap()).collect();
    assert_eq!((rows.len(), all.len()), (number("rows") as usize, (number("rows") * number("columns")) as usize));
    assert_eq!(all.iter().filter(|value| !value.is_null()).count(), measured);
}

#[test]
fn programs_read_record_by_number() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let journal = regrind::journal::Reader::open(home.path().join("runs").join(&ids[0])).unwrap();
    let records: Vec<_> = journal.records(1).map(|record| record.unwrap()).collect();
    let (mut found, mut after) = (Vec::new(), 0);
    loop {
        let page = reader.json(&format!("/api/v1/runs/{}/events?after={after}&limit=37", ids[0]));
        assert_eq!(page["last"], records.len());
        let events = page["events"].as_array().unwrap().clone();
        after = page["next_after"].as_u64().unwrap();
        if events.is_empty() {
            break;
        }
        found.extend(events);
    }
    assert_eq!(found.len(), records.len());
    for (event, record) in found.iter().zip(&records) {
        let told = ["sequence", "kind", "hash", "content", "utc"].map(|key| event[key].clone());
        let expected =
            [json!(record.seq), json!(record.kind.as_str()), json!(record.hash), record.value(), json!(record.utc)];
        assert_eq!(told, expected);
    }
    let events = reader.json(&format!("/api/v1/runs/{}/events?show=events&limit=1000", ids[0]));
    assert!(events["events"].as_array().unwrap().iter().all(|event| event["kind"] == "event"), "{events}");
    // The same records as a stream, after one of them.
    let path = format!("/api/v1/runs/{}/stream", ids[0]);
    let all: Vec<Event> = reader.stream(&format!("{path}?after=3"), "").collect();
    let numbers: Vec<u64> =
        all.iter().filter(|(name, ..)| name == "record").map(|(_, number, _)| number.unwrap()).collect();
    assert_eq!(numbers, (4..=records.len() as u64).collect::<Vec<_>>());
    assert_eq!(all[0].2, found[3]);
    let [.., (state, None, content), (end, Some(last), _)] = &all[..] else { panic!("{:?}", all.last()) };
    assert_eq!((&**state, &**end, *last), ("state", "end", records.len() as u64));
    assert_eq!(content, &reader.json(&format!("/api/v1/runs/{}", ids[0]))["state"]);
    // A client that has all of it is told not to come back.
    assert_eq!(reader.stream(&path, &format!("Last-Event-ID: {last}\r\n")).status, 204);
}

/// Answer that must be a problem document of this type.
fn problem(answer: &Answer, context: &str) -> Value {
    assert_eq!(answer.header("content-type"), ["application/problem+json"], "{context}: {answer:?}");
    let document: Value = serde_json::from_slice(&answer.body).unwrap();
    assert_eq!(document["status"], answer.status, "{context}");
    for key in ["type", "title", "detail", "remedy"] {
        assert!(document[key].as_str().is_some_and(|text| !text.is_empty()), "{context}: {document}");
    }
    document
}

#[test]
fn refusals_are_problem_documents() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    std::fs::write(home.path().join("secret.csv"), "secret").unwrap();
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let (run, long) = (format!("/api/v1/runs/{}", ids[0]), "x".repeat(5000));
    let cases = [
        (404, "unknown-address", "/api/v1/nothing".to_owned()),
        (404, "unknown-address", "/api".into()),
        (404, "unknown-run", "/api/v1/runs/some".into()),
        (404, "unknown-run", "/api/v1/runs/%2e%2e".into()),
        (404, "unknown-run", "/api/v1/runs/..%2fruns/events".into()),
        (404, "unknown-run", "/api/v1/runs/%2Fetc/maps".into()),
        (404, "unknown-run", "/api/v1/runs/%00/figures".into()),
        (404, "unknown-run", "/api/v1/runs/.lock/stream".into()),
        (400, "parameter", "/api/v1/runs/%ff".into()),
        (400, "parameter", format!("/api/v1/runs/{long}")),
        (400, "parameter", "/api/v1/cell?key=0".into()),
        (400, "parameter", "/api/openapi.json?x".into()),
        (400, "parameter", "/metrics?name=up".into()),
        (400, "parameter", "/api/v1/runs?limit=0".into()),
        (400, "parameter", "/api/v1/runs?limit=501".into()),
        (400, "parameter", "/api/v1/runs?limit=1&limit=1".into()),
        (400, "parameter", "/api/v1/runs?cursor=".into()),
        (400, "parameter", format!("/api/v1/runs?cursor=2026-07-04T12:00:00Z~{long}")),
        (400, "parameter", "/api/v1/runs?result=Accepted".into()),
        (400, "parameter", format!("{run}/events?after=9007199254740992")),
        (400, "parameter", format!("{run}/events?after=-1")),
        (400, "parameter", format!("{run}/stream?after=9007199254740992")),
        (409, "beyond-record", format!("{run}/stream?after=9007199254740991")),
        (400, "parameter", format!("{run}/cycles/x/map")),
        (400, "parameter", format!("{run}/cycles/0/map")),
        (400, "parameter", format!("{run}/cycles/1/files/..%2f..%2fjournal.sqlite")),
        (400, "parameter", format!("{run}/cycles/1/files/recipe.toml")),
        (404, "unknown-cycle", format!("{run}/cycles/4294967295/map")),
        (404, "unknown-cycle", format!("{run}/cycles/9/files/error_map.png")),
    ];
    for (status, name, path) in &cases {
        let answer = reader.ask("GET", path, "");
        assert_eq!(answer.status, *status, "{path}: {answer:?}");
        assert_eq!(problem(&answer, path)["type"], format!("urn:regrind:problem:{name}"), "{path}");
        assert!(answer.body.len() < 2000 && !answer.text().contains("secret"), "{path}");
    }
    let wrong = problem(&reader.ask("GET", "/api/v1/runs?limit=501", ""), "limit");
    assert_eq!(["parameter", "value"].map(|key| wrong[key].clone()), [json!("limit"), json!("501")]);
    // An event that was never sent, one that is given twice, and one that is no number.
    for (status, headers) in [
        (409, "Last-Event-ID: 99999\r\n"),
        (400, "Last-Event-ID: 1\r\nLast-Event-ID: 1\r\n"),
        (400, "Last-Event-ID: x\r\n"),
    ] {
        assert_eq!(problem(&reader.ask("GET", &format!("{run}/stream"), headers), headers)["status"], status);
    }
    for (path, accept) in [
        ("/api/v1/cell", "text/html"),
        ("/metrics", "application/json"),
        (&format!("{run}/cycles/1/files/error_map.csv"), "image/png"),
        (&format!("{run}/stream"), "application/json"),
    ] {
        let refused = problem(&reader.ask("GET", path, &format!("Accept: {accept}\r\n")), path);
        assert_eq!((&refused["status"], &refused["type"]), (&json!(406), &json!("urn:regrind:problem:not-acceptable")));
    }
    for method in ["POST", "PUT", "PATCH", "DELETE", "OPTIONS", "TRACE", "BREW"] {
        for path in ["/api/v1/cell", "/metrics", &run] {
            let answer = reader.ask(method, path, "Content-Length: 0\r\n");
            assert_eq!(
                (answer.status, answer.header("allow")),
                (405, vec!["GET, HEAD"]),
                "{method} {path}: {answer:?}"
            );
            problem(&answer, path);
        }
    }
    let other = format!(
        "GET /api/v1/cell HTTP/1.1\r\nHost: evil.example\r\nAuthorization: Bearer {}\r\nConnection: close\r\n\r\n",
        reader.token
    );
    assert_eq!(problem(&raw(&reader.place, other.as_bytes()), "host")["status"], 421);
}

#[test]
fn half_deleted_run_is_told() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let folder = home.path().join("runs").join(&ids[0]);
    std::fs::remove_file(folder.join("cycle-1/error_map.csv")).unwrap();
    let broken = home.path().join("runs/broken");
    std::fs::create_dir(&broken).unwrap();
    std::fs::write(broken.join("journal.sqlite"), "this is no database, and it is long enough to be one ".repeat(100))
        .unwrap();
    std::fs::create_dir(home.path().join("runs/empty")).unwrap();
    // A file that is a pipe must not block the page.
    let pipe = folder.join("cycle-1/error_map.png");
    std::fs::remove_file(&pipe).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let runs = reader.json("/api/v1/runs");
    assert_eq!((&runs["unreadable"], runs["runs"].as_array().unwrap().len()), (&json!(["broken"]), 2));
    for path in ["", "/figures", "/events", "/stream", "/maps"] {
        let answer = reader.ask("GET", &format!("/api/v1/runs/broken{path}"), "");
        let told = problem(&answer, path);
        assert_eq!(
            (&told["status"], &told["type"]),
            (&json!(500), &json!("urn:regrind:problem:unreadable-record")),
            "{path}"
        );
        assert!(!answer.text().contains(home.path().to_str().unwrap()), "{answer:?}");
    }
    assert_eq!(reader.ask("GET", "/api/v1/runs/empty", "").status, 404);
    let base = format!("/api/v1/runs/{}/cycles/1", ids[0]);
    for path in ["map", "files/error_map.csv", "files/error_map.png"] {
        let told = problem(&reader.ask("GET", &format!("{base}/{path}"), ""), path);
        assert_eq!((&told["status"], &told["type"]), (&json!(404), &json!("urn:regrind:problem:no-file")), "{path}");
    }
    let maps = reader.json(&format!("/api/v1/runs/{}/maps", ids[0]));
    let files = maps["maps"][0]["files"].as_array().unwrap();
    assert_eq!(files.len(), 3, "{files:?}");
    // A map that somebody has changed.
    std::fs::write(folder.join("cycle-2/error_map.csv"), "x_mm,y_mm,error_mm,sigma_mm,valid\n0,0,NaN,0,1\n").unwrap();
    let told = problem(&reader.ask("GET", &format!("/api/v1/runs/{}/cycles/2/map", ids[0]), ""), "changed map");
    assert_eq!((&told["status"], &told["type"]), (&json!(500), &json!("urn:regrind:problem:unreadable-file")));
    assert!(!told.to_string().contains(home.path().to_str().unwrap()), "{told}");
    assert_eq!(reader.json("/api/v1/cell")["last_run"]["run"], ids[1]);
    assert!(reader.ask("GET", "/metrics", "").text().contains("\nregrind_runs_unreadable 1\n"));
}

#[test]
fn head_equals_get() {
    let home = tempfile::tempdir().unwrap();
    let ids = two_parts(home.path());
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let run = format!("/api/v1/runs/{}", ids[1]);
    for path in [
        "/api/v1/cell",
        "/api/v1/runs",
        &run,
        &format!("{run}/maps"),
        &format!("{run}/cycles/1/map"),
        "/api/openapi.json",
    ] {
        let (get, head) = (reader.ask("GET", path, ""), reader.ask("HEAD", path, ""));
        assert_eq!((head.status, head.body.len()), (200, 0), "{path}: {head:?}");
        for name in ["content-type", "content-length", "etag", "cache-control"] {
            assert_eq!(head.header(name), get.header(name), "{path}");
        }
        let cached = if get.header("etag").is_empty() { "no-store" } else { "private, no-cache" };
        assert_eq!(get.header("cache-control"), [cached], "{path}");
    }
}

#[test]
fn description_lists_every_endpoint_and_error() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = serve(home.path());
    let reader = Reader::with_key(&url);
    let document = reader.json("/api/openapi.json");
    assert_eq!((&document["openapi"], &document["security"]), (&json!("3.1.0"), &json!([{ "token": [] }])));
    let paths = document["paths"].as_object().unwrap();
    assert_eq!(paths.len(), 11);
    let stranger = Reader { place: reader.place.clone(), token: String::new() };
    for (path, item) in paths {
        let operation = &item["get"];
        assert_eq!(keys(item), BTreeSet::from(["get"]), "{path}");
        for status in ["200", "400", "401", "406", "421", "429", "500"] {
            assert!(operation["responses"][status].is_object(), "{path}: {status}");
        }
        for parameter in operation["parameters"].as_array().unwrap() {
            let schema = &parameter["schema"];
            let is_limited = ["maximum", "maxLength", "enum", "pattern"].iter().any(|key| !schema[key].is_null());
            assert!(
                is_limited && !parameter["example"].is_null() && parameter["description"].is_string(),
                "{path}: {parameter}"
            );
        }
        let place = path.replace("{run}", "some").replace("{cycle}", "1").replace("{file}", "error_map.csv");
        let refused = stranger.ask("GET", &place, "");
        assert_eq!(problem(&refused, path)["type"], "urn:regrind:problem:no-access", "{path}");
        assert_eq!((refused.status, refused.header("www-authenticate")), (401, vec!["Bearer realm=\"regrind\""]));
        if path.contains("{run}") {
            assert_eq!(reader.ask("GET", &place, "").status, 404, "{path}");
        }
    }
    // Each reference leads to a schema, and no schema is only a reference.
    let schemas = document["components"]["schemas"].as_object().unwrap();
    assert!(
        schemas.values().all(|schema| schema["$ref"].is_null() && schema.as_object().unwrap().len() > 1),
        "{schemas:?}"
    );
    let text = document.to_string();
    for reference in text.split("\"$ref\":\"#").skip(1).map(|rest| rest.split('"').next().unwrap()) {
        assert!(document.pointer(reference).is_some(), "{reference}");
    }
}

/// Returns the token of a program, as `regrind users token` prints it.
fn token_of(home: &Path, name: &str) -> String {
    let (code, said, errors) = run(&["users", "token", name], home);
    assert_eq!(code, 0, "{errors}");
    said.trim_end().to_owned()
}

#[test]
fn program_token_reads_and_gives_no_order() {
    let home = tempfile::tempdir().unwrap();
    assert_eq!(add(home.path(), "operator", "operator", PASSWORD).0, 0);
    let token = token_of(home.path(), "prometheus");
    let written = std::fs::read_to_string(home.path().join("users.toml")).unwrap();
    assert!(token.starts_with("regrind_") && token.len() == 51 && !written.contains(&token[8..]), "{written}");
    assert_eq!(run(&["users", "list"], home.path()).1, "operator   operator\nprogram    prometheus\n");
    let listed: Value = serde_json::from_str(&run(&["users", "list", "--json"], home.path()).1).unwrap();
    assert_eq!(listed[1], json!({ "name": "prometheus", "role": "viewer", "kind": "program" }));
    // One name belongs to a person or to a program.
    assert_eq!(run(&["users", "token", "operator"], home.path()).0, 2);
    assert_eq!(add(home.path(), "prometheus", "viewer", PASSWORD).0, 2);
    let recipe = small_recipe(home.path(), 20.0).display().to_string();
    let mut run_of_part =
        crate::program::Running::new(crate::program::regrind(&["run", &recipe, "--cell", "sim"], home.path()));
    let folder = run_of_part.folder(home.path());
    let id = folder.file_name().unwrap().to_str().unwrap().to_owned();
    run_of_part.line("grinding", |line| line.contains("grinding"));
    let (_page, url) = serve_with(home.path(), &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let place = url.trim_start_matches("http://").trim_end_matches('/').to_owned();
    let reader = Reader { place, token };
    assert_eq!(reader.json("/api/v1/cell")["state"], "Execute");
    // A token opens no page for people, and gives no order, not even with the headers of one.
    for path in ["/", "/runs", "/token", &format!("/runs/{id}")] {
        assert_eq!(reader.ask("GET", path, "").status, 401, "{path}");
    }
    let origin = format!("Origin: http://{}\r\nX-Regrind-Token: 0\r\nContent-Length: 0\r\n", reader.place);
    for path in ["orders", "control", "measurement?name=a"] {
        assert_eq!(reader.ask("POST", &format!("/runs/{id}/{path}"), &origin).status, 401, "{path}");
    }
    assert_eq!(reader.ask("POST", &format!("/api/v1/runs/{id}"), &origin).status, 405);
    // The session of a person reads too. A wrong token is not made good by a session.
    let person = Visitor::signed_in(&url, "operator", PASSWORD).unwrap();
    assert_eq!(person.get("/api/v1/cell").status, 200);
    let both = format!("Cookie: {}\r\n", person.cookies);
    assert_eq!(Reader { token: "wrong".into(), place: reader.place.clone() }.ask("GET", "/metrics", &both).status, 401);
    // A stream ends when its token is removed.
    let mut events = reader.stream(&format!("/api/v1/runs/{id}/stream"), "");
    assert_eq!(events.next().unwrap().1, Some(1));
    assert_eq!(run(&["users", "remove", "prometheus"], home.path()).0, 0);
    assert_eq!(reader.ask("GET", "/api/v1/cell", "").status, 401);
    assert!(events.all(|(name, ..)| name != "end"), "it ended before the run");
    assert!(person.order(&id, &json!({ "order": "stop", "reason": "" })).1);
    assert_eq!(run_of_part.end().0, 1);
}

#[test]
fn wrong_tokens_lock_out_nobody() {
    let home = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(home.path().join("runs")).unwrap();
    assert_eq!(add(home.path(), "operator", "operator", PASSWORD).0, 0);
    let replaced = token_of(home.path(), "grafana");
    let token = token_of(home.path(), "grafana");
    let (mut page, url) = serve_with(home.path(), &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let place = url.trim_start_matches("http://").trim_end_matches('/').to_owned();
    let reader = |token: &str| Reader { place: place.clone(), token: token.to_owned() };
    let tries: Vec<Answer> = (0..50).map(|_| reader(&replaced).ask("GET", "/metrics", "")).collect();
    let statuses: Vec<u16> = tries.iter().map(|answer| answer.status).collect();
    assert_eq!(statuses, [[401; 10].as_slice(), &[429; 40]].concat());
    assert_eq!(tries[0].header("www-authenticate"), ["Bearer realm=\"regrind\", error=\"invalid_token\""]);
    assert_eq!(
        (problem(&tries[49], "tokens")["status"].clone(), tries[49].header("retry-after")),
        (json!(429), vec!["60"])
    );
    // The program with the right token, and people, still have access.
    assert_eq!(reader(&token).ask("GET", "/metrics", "").status, 200);
    assert!(Visitor::signed_in(&url, "operator", PASSWORD).is_some());
    page.interrupt();
    let (_, log) = page.end();
    assert_eq!(log.matches("wrong token").count(), 1, "{log}");
}

#[test]
fn damaged_tokens_refused() {
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("users.toml");
    let proof = format!("sha256:{}", "0".repeat(64));
    for (text, expected) in [
        ("[[token]]\nname = \"a\"\nproof = \"sha256:00\"".to_owned(), "token 1 (\"a\")"),
        (format!("[[token]]\nname = \"a\"\nproof = \"{}\"", &proof[7..]), "token 1 (\"a\")"),
        (
            format!("[[token]]\nname = \"a\"\nproof = \"{proof}\"\n[[token]]\nname = \"a\"\nproof = \"{proof}\""),
            "same name",
        ),
        (format!("[[token]]\nname = \"a\"\nproof = \"{proof}\"\nrole = \"engineer\""), "unknown field `role`"),
        (format!("[[token]]\nname = \"\"\nproof = \"{proof}\""), "not allowed"),
    ] {
        std::fs::write(&path, text).unwrap();
        #[cfg(unix)]
        std::fs::set_permissions(&path, std::os::unix::fs::PermissionsExt::from_mode(0o600)).unwrap();
        let (code, _, errors) = run(&["serve", "--users", "users.toml", "--listen", "127.0.0.1:0"], home.path());
        assert!(code == 2 && errors.contains(expected), "{expected}: {errors}");
    }
}

#[test]
fn stream_follows_run_and_resumes() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let reader = Reader::with_key(&shown.url);
    let path = format!("/api/v1/runs/{}/stream", shown.id);
    let mut events = reader.stream(&path, "");
    let mut numbers = Vec::new();
    let state = loop {
        let (name, number, content) = events.next().unwrap();
        match &*name {
            "record" => numbers.push(number.unwrap()),
            "state" => break content,
            other => panic!("{other}: {content}"),
        }
    };
    assert_eq!(numbers, (1..=numbers.len() as u64).collect::<Vec<_>>());
    let told = ["run", "state", "phase", "part", "is_active", "cycle"].map(|key| state[key].clone());
    let expected = [json!(shown.id), json!("Execute"), json!("Grind"), json!("SN-0042"), json!(true), json!(1)];
    assert_eq!(told, expected);
    let cell = reader.json("/api/v1/cell");
    assert_eq!((&cell["active_runs"], &cell["state"]), (&json!([shown.id]), &json!("Execute")));
    assert_eq!(keys(&cell["run"]), keys(&state));
    drop(events);
    // The rest of the record after a lost connection, to the end of the run.
    let last = *numbers.last().unwrap();
    let events = reader.stream(&path, &format!("Last-Event-ID: {last}\r\n"));
    assert!(shown.visitor().order(&shown.id, &json!({ "order": "stop", "reason": "" })).1);
    assert_eq!(shown.run.end().0, 1);
    let rest: Vec<Event> = events.collect();
    let further: Vec<u64> =
        rest.iter().filter(|(name, ..)| name == "record").filter_map(|(_, number, _)| *number).collect();
    let journal = regrind::journal::Reader::open(&shown.folder).unwrap();
    let count = journal.last().unwrap().unwrap().seq;
    assert_eq!(further, (last + 1..=count).collect::<Vec<_>>());
    assert_eq!(rest.last().unwrap().0, "end");
    let last_state = rest.iter().rev().find(|(name, ..)| name == "state").unwrap();
    assert_eq!((&last_state.2["state"], &last_state.2["result"]), (&json!("Stopped"), &json!("stopped")));
}

#[test]
fn streams_are_limited() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let reader = Reader::with_key(&shown.url);
    let path = format!("/api/v1/runs/{}/stream", shown.id);
    // Clients that read nothing.
    let mut open: Vec<Events> = (0..32).map(|_| reader.stream(&path, "")).collect();
    assert!(open.iter().all(|events| events.status == 200));
    let refused = reader.ask("GET", &path, "");
    assert_eq!((refused.status, refused.header("retry-after")), (503, vec!["10"]));
    assert_eq!(problem(&refused, "streams")["type"], "urn:regrind:problem:too-many-streams");
    assert!(reader.ask("GET", "/metrics", "").text().contains("\nregrind_page_streams 32\n"));
    assert_eq!(shown.visitor().get("/runs").status, 200, "people are not limited");
    drop(open.pop());
    let mut again = None;
    shown.run.until("a free place", |_| {
        again = Some(reader.stream(&path, "")).filter(|events| events.status == 200);
        again.is_some().then_some(())
    });
    assert!(again.unwrap().next().is_some());
    shown.run.signal("KILL");
}
