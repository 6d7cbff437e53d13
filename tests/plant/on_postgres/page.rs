//! The page of a plant: it shows the planted data, treats text from a cell as text only, and changes nothing.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use regrind::journal::sha256_hex;
use regrind_testcell::browser::{Browser, Tab};
use regrind_testcell::http::{Answer, Visitor, raw};
use serde_json::Value;

use super::records::made;
use crate::Plant;
use crate::only_run;
use crate::program::{PATIENCE, Running, regrind, root, small_recipe};

/// Text that would inject an element of a page, end an attribute and an SQL string, and change the reading direction.
const HOSTILE: &str =
    "<script>alert(1)</script>'\"><img src=x onerror=alert(2)>&\u{202e}'); DROP TABLE regrind.run; --";

/// The ten values of NIST/SEMATECH e-Handbook 6.3.2.2, which gives these limits: 45.8159 and 55.8041 about 50.81.
const FLOW: [f64; 10] = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1];

/// Page of a plant, and its visitor.
struct ServedPage {
    _page: Running,
    url: String,
    visitor: Visitor,
}

impl ServedPage {
    fn serve(plant: &Plant) -> Self {
        if !plant.path("page.toml").is_file() {
            plant.somebody("page", "reader");
        }
        let arguments = ["plant", "serve", "--plant", "page.toml", "--listen", "127.0.0.1:0"];
        let mut page = Running::new(regrind(&arguments, plant.home.path()));
        let line = page.line("address of the page", |line| line.starts_with("page "));
        let url = line.trim_start_matches("page").trim().to_owned();
        Self { _page: page, visitor: Visitor::with_key(&url), url }
    }

    /// Returns the address of the page without its key, with a slash at its end.
    fn base(&self) -> String {
        self.url.split("?key=").next().unwrap().to_owned()
    }

    /// Returns the text of the page at a path.
    fn text(&self, path: &str) -> String {
        let answer = self.visitor.get(path);
        assert_eq!(answer.status, 200, "{path}: {}", answer.text());
        body(&answer)
    }
}

/// Returns a body that is sent in chunks or with its length.
fn body(answer: &Answer) -> String {
    answer.text()
}

/// Returns the text between the tags, with a space for each tag, in one line.
fn words(html: &str) -> String {
    let mut inside = false;
    let text: String = html
        .chars()
        .filter_map(|c| {
            let was = inside;
            inside = (inside || c == '<') && c != '>';
            if was || inside { (c == '<').then_some(' ') } else { Some(c) }
        })
        .collect();
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', "''"))
}

/// Registers a cell that nobody signs in as.
fn cell(plant: &Plant, name: &str) -> i32 {
    let role = format!("role_{}", plant.sql("SELECT count(*) FROM cell"));
    plant
        .sql(&format!("INSERT INTO cell (name, role) VALUES ({}, '{role}') RETURNING id", quoted(name)))
        .parse()
        .unwrap()
}

/// Run in the database after its cell has shipped everything.
struct Planted<'a> {
    cell: i32,
    serial: &'a str,
    recipe: &'a str,
    /// Hours since the start of the run, which took one hour.
    hours: u32,
    result: &'a str,
    cycles: i32,
    pv_um: f64,
    real: bool,
}

impl Default for Planted<'_> {
    fn default() -> Self {
        Self {
            cell: 1,
            serial: "SN-1",
            recipe: "mirror",
            hours: 24,
            result: "accepted",
            cycles: 1,
            pv_um: 4.0,
            real: true,
        }
    }
}

/// Plants runs; returns the number of the first.
fn plant_runs(plant: &Plant, runs: &[Planted]) -> i32 {
    let row = |(k, run): (usize, &Planted)| {
        let Planted { cell, serial, recipe, hours, result, cycles, pv_um, real } = run;
        let [serial, recipe] = [quoted(serial), quoted(recipe)];
        format!(
            "({cell}, 'run-{cell}-{hours}-{k}-{result}', {serial}, {}, 'Ada', now() - interval '{hours} hours', now() - interval '{} hours', {recipe}, '00',
              'Mirror', '{result}', 'as planted', 7, 1, 'Grinder A', 'CMM A', 'R 5.000 mm', 'R 1.500 mm', 0, {cycles}, {pv_um}, 0.4, {}, 0.03)",
            !real,
            hours - 1,
            pv_um / 8.0
        )
    };
    let rows: Vec<String> = runs.iter().enumerate().map(row).collect();
    let first = plant.sql(&format!(
        "WITH made AS (INSERT INTO run (cell, name, part, simulation, operator, began, ended, recipe, recipe_sha256, part_name, result, verdict, pv_limit_um,
            rms_limit_um, grinder, cmm, wheel, probe, alarms, cycles, pv_um, pv_u_um, rms_um, rms_u_um) VALUES {} RETURNING id),
         told AS (SELECT min(id) AS first FROM made) SELECT first FROM told",
        rows.join(",")
    ));
    plant.sql(
        "INSERT INTO cycle (run, cycle, verdict, reason, pv_um, pv_u_um, rms_um, rms_u_um)
            SELECT r.id, y, 'continue', 'as planted', r.pv_um + 10 * (r.cycles - y), 0.4, r.rms_um, 0.03 FROM run r, generate_series(1, r.cycles) y
            WHERE r.verdict = 'as planted' ON CONFLICT DO NOTHING",
    );
    first.parse().unwrap()
}

fn store_state(plant: &Plant, cell: i32, ago: &str, run: Option<&str>, snapshot: &Value) {
    let run = run.map_or("NULL".into(), quoted);
    let snapshot = quoted(&snapshot.to_string());
    plant.sql(&format!(
        "INSERT INTO cell_state (cell, at, run, snapshot) VALUES ({cell}, now() - interval '{ago}', {run}, {snapshot})"
    ));
}

/// Returns the status that a cell publishes while it grinds.
fn grinding(serial: &str) -> Value {
    serde_json::json!({ "state": "Execute", "phase": { "grind": "run" }, "words": "grinding", "simulation": false, "part": "Mirror", "serial": serial,
        "cycle": 2, "max_cycles": 6, "next_step": { "step": "nothing" },
        "progress": { "device": "Grinder", "done": 30, "total": 100, "left_s": [140.0, 210.0] }, "alarms": [] })
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn malformed_cell_state_is_isolated() {
    let plant = Plant::new();
    let [one, two] = ["cell-1", "cell-2"].map(|name| cell(&plant, name));
    store_state(&plant, one, "1 second", Some("run"), &grinding("SN-0042"));
    let odd = serde_json::json!({ "state": "Execute", "words": "odd", "simulation": "perhaps", "cycle": 3_000_000_000_u64, "max_cycles": -1,
        "progress": { "done": 1e300, "total": "many", "left_s": [true, {}] }, "alarms": {}, "phase": [["grind"]], "next_step": "load" });
    store_state(&plant, two, "1 second", Some("run"), &odd);
    let said = words(&ServedPage::serve(&plant).text("/"));
    let piece = "cell-1 Grinding SN-0042, cycle 2 of at most 6, Mirror 30 of 100, 2 – 4 min";
    assert!(said.contains(piece), "{piece}: {said}");
    assert!(said.contains("cell-2 odd run heard"), "{said}");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn overview_shows_cells_and_yield() {
    let plant = Plant::new();
    let [one, two, three] = ["cell-1", "cell-2", "cell-3"].map(|name| cell(&plant, name));
    store_state(&plant, one, "1 second", Some("run"), &grinding("SN-0042"));
    store_state(&plant, two, "3 hours", Some("run"), &grinding("SN-0043"));
    let of = |result, cycles| Planted { cell: one, result, cycles, ..Planted::default() };
    let mut runs: Vec<Planted> = (0..5).map(|_| of("accepted", 1)).collect();
    runs.extend((0..2).map(|_| of("accepted", 3)));
    runs.extend([of("not accepted", 4), of("aborted", 1), of("stopped", 2)]);
    // Simulated runs, old runs and unfinished runs are not counted.
    runs.push(Planted { real: false, ..of("accepted", 1) });
    runs.push(Planted { hours: 24 * 40, ..of("accepted", 1) });
    runs.push(of("open", 1));
    runs.push(Planted { cell: three, recipe: "lens", ..of("not accepted", 2) });
    plant_runs(&plant, &runs);
    plant.sql("INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256('mirror', 3, 'a', '{}'), 'mirror', 3, 'a')");
    // Three parts were given up: one whose run broke off, one of whose run nothing arrived, and one whose run ended.
    let ended = "SELECT name FROM run WHERE cell = 3 AND result = 'not accepted'";
    plant_runs(&plant, &[Planted { cell: three, recipe: "prism", ..of("open", 1) }]);
    plant.sql("UPDATE run SET ended = NULL WHERE result = 'open'");
    for run in ["SELECT name FROM run WHERE cell = 3 AND result = 'open'", "SELECT 'nothing-arrived'", ended] {
        plant.sql(&format!(
            "WITH made AS (INSERT INTO work (serial, recipe, state, cell, run) SELECT 'SN-UP', sha256, 'ended', 3, ({run}) FROM recipe RETURNING id)
             INSERT INTO work_step (work, step, words) SELECT id, 'given up', 'the wheel broke' FROM made"
        ));
    }
    plant.sql("INSERT INTO work (serial, recipe, due) SELECT 'SN-0099', sha256, current_date - 3 FROM recipe");
    plant.sql("INSERT INTO incident (cell, run, what, words) VALUES (2, 'run-7', 'a broken chain', 'record 12 does not follow')");

    let shown = ServedPage::serve(&plant);
    let html = shown.text("/");
    let said = words(&html);
    for piece in [
        "2 silent",
        "1 at work",
        "cell-1 Grinding SN-0042, cycle 2 of at most 6, Mirror",
        "Mirror 30 of 100",
        "2 – 4 min left heard",
        "cell-2 no report",
        "no report for 3 h",
        "report: grinding SN-0043",
        "No cell needs a person",
    ] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    assert!(said.contains("cell-3 no report yet"), "{said}");
    // Ten ended, seven were accepted, five of these after one pass: 24 to 76 % by Wilson.
    // The part of whose run nothing arrived counts by the recipe of the queue.
    // Seven accepted parts took (5 + 2 * 3) / 7 cycles on average.
    let cycles = "1.57 Parts by cycles: 1: 5, 3: 2";
    assert!(said.contains(&format!("mirror 11 7 64 % {cycles} 45 %")) && said.contains("lens 1 0 0 % – 0 %"), "{said}");
    assert!(said.contains("prism 1 0 0 % – 0 %"), "{said}");
    assert!(said.contains(&format!("cell-1 10 7 70 % {cycles} 50 % 24 – 76 %")), "{said}");
    assert!(said.contains("cell-3 3 0 0 %"), "{said}");
    assert!(html.contains("11 ended, 7 accepted, 5"), "the bar of the day");
    let compared = words(&shown.text("/cells?recipe="));
    assert!(compared.contains("cell-3 2 4.0") && compared.contains("0 %"), "{compared}");
    assert!(
        said.contains("SN-0099 mirror v3 any")
            && said.contains("late")
            && said.contains("run-7 record 12")
            && said.contains("Incidents a broken chain"),
        "{said}"
    );
    assert!(html.contains("http-equiv=\"refresh\"") && !said.contains("SIMULATION"), "{said}");
    let simulated = words(&shown.text("/?parts=simulated"));
    assert!(
        simulated.contains("SIMULATION") && simulated.contains("mirror 1 1 100 % 1.00 Parts by cycles: 1: 1 100 %"),
        "{simulated}"
    );
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn trend_control_limits_and_export() {
    let plant = Plant::new();
    let [one, two] = ["cell-1", "cell-2"].map(|name| cell(&plant, name));
    let serials: Vec<String> = (0..FLOW.len()).map(|k| format!("SN-{k:02}")).collect();
    let runs = FLOW.iter().zip(&serials).zip(0..);
    let mut runs: Vec<Planted> = runs
        .map(|((pv_um, serial), k)| Planted {
            cell: one,
            serial,
            hours: 100 - k,
            pv_um: *pv_um,
            cycles: 2,
            ..Planted::default()
        })
        .collect();
    // Other parts, none of which is in the chart.
    runs.push(Planted { cell: two, recipe: "lens", pv_um: 900.0, hours: 200, ..Planted::default() });
    runs.push(Planted { cell: one, pv_um: 900.0, real: false, ..Planted::default() });
    runs.push(Planted { cell: one, pv_um: 900.0, hours: 24 * 100, ..Planted::default() });
    // Parts that nobody judged for good.
    for result in ["open", "stopped", "aborted"] {
        runs.push(Planted { cell: one, pv_um: 900.0, hours: 95, cycles: 2, result, ..Planted::default() });
    }
    let first = plant_runs(&plant, &runs);
    let shown = ServedPage::serve(&plant);
    let html = shown.text("/trend");
    let said = words(&html);
    assert!(said.contains("Recipe mirror, begun") && said.contains(": 10 parts."), "{said}");
    for piece in [
        "mean 50.810 µm",
        "45.815 – 55.805 µm",
        "range 1.878 µm (≤ 6.135)",
        "above tolerance 10 of 10",
        "No point breaks a rule",
        "preliminary",
        "not given below 50 parts",
    ] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    assert!(!said.contains("900.000") && html.contains(&format!("href=\"/runs/{first}\"")), "{said}");
    // The first measurement is 10 um above the one after the first correction.
    plant.sql("DELETE FROM cycle WHERE run IN (SELECT id FROM run WHERE result IN ('open', 'stopped', 'aborted'))");
    let said = words(&shown.text("/trend?at=first&cell=cell-1&recipe=mirror"));
    assert!(said.contains("mean 60.810 µm") && said.contains("55.815 – 65.805 µm"), "{said}");
    let said = words(&shown.text("/trend?recipe=lens"));
    assert!(said.contains(": 1 part.") && said.contains("too few parts"), "{said}");
    let said = words(&shown.text("/trend?recipe="));
    assert!(said.contains("Parts of several recipes"), "{said}");
    for (name, value) in
        [("wheel", "R%205.000%20mm"), ("probe", "R%201.500%20mm"), ("grinder", "Grinder%20A"), ("cmm", "CMM%20A")]
    {
        assert!(shown.text(&format!("/trend?{name}={value}")).contains("50.810"), "{name}");
        assert!(words(&shown.text(&format!("/trend?{name}=other"))).contains(": 0 parts"), "{name}");
    }
    // One more part outside the control limits.
    plant_runs(&plant, &[Planted { cell: one, serial: "SN-OUT", hours: 2, pv_um: 80.0, ..Planted::default() }]);
    let html = shown.text("/trend");
    let said = words(&html);
    assert!(html.contains("class=\"out\""), "{said}");
    for piece in [
        "1 one point beyond 3 sigma: points: 1, the newest first SN-OUT",
        "1 of 10 ranges are above their limit. The parts after the step, the newest first: SN-OUT",
    ] {
        assert!(said.contains(piece), "{piece}: {said}");
    }

    let csv = shown.text("/export.csv?recipe=mirror");
    let lines: Vec<&str> = csv.lines().collect();
    assert!(lines[0].starts_with("id,cell,run,serial,") && lines.len() == 15, "{csv}");
    assert!(lines[1].contains("\"SN-OUT\"") && lines[2].contains(",52.1,0.4,7,"), "{csv}");
    let answer = shown.visitor.get("/trend.dfq?recipe=mirror");
    assert!(answer.header("content-disposition")[0].contains("parts.dfq"), "{answer:?}");
    let path = plant.path("parts.dfq");
    fs::write(&path, &answer.body).unwrap();
    let told = read_dfq(&path);
    let values = told["characteristics"][0]["values"].as_array().unwrap();
    let found: Vec<f64> = values.iter().map(|value| (1e6 * value["value"].as_f64().unwrap()).round() / 1e3).collect();
    assert_eq!(found, [&FLOW[..], &[80.0]].concat());
    assert_eq!((&values[0]["part"], &told["characteristics"][0]["upper"]), (&"SN-00".into(), &0.007.into()));
    assert_eq!(told["characteristics"][1]["values"].as_array().unwrap().len(), 11);
}

fn read_dfq(path: &Path) -> Value {
    let said = Command::new("python3").arg(root().join("tests/common/read_dfq.py")).arg(path).output().unwrap();
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    serde_json::from_slice(&said.stdout).unwrap()
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn cell_difference_and_part_search() {
    let plant = Plant::new();
    let cells = ["cell-1", "cell-2", "cell-3"].map(|name| cell(&plant, name));
    let serials: Vec<String> = (0..120).map(|k| format!("SN-{k:03}")).collect();
    // The parts of the third machine are worse by more than the spread of all.
    let run = |k: u32| {
        let cell = cells[(k % 3) as usize];
        let worse = if k % 3 == 2 { 0.8 } else { 0.0 };
        let pv_um = 3.0 + f64::from(k * 7 % 20) / 20.0 + worse;
        Planted { cell, serial: &serials[k as usize], hours: 2 + k, pv_um, cycles: 2, ..Planted::default() }
    };
    let runs: Vec<Planted> = (0..120).map(run).collect();
    plant_runs(&plant, &runs);
    let shown = ServedPage::serve(&plant);
    let said = words(&shown.text("/cells"));
    for cell in ["cell-1 40 3.4", "cell-2 40 3.4", "cell-3 40 4.2"] {
        assert!(said.contains(cell), "{cell}: {said}");
    }
    let of_third = said.split("cell-3 40").nth(1).unwrap();
    for piece in ["2.00 Parts by cycles: 2: 40 0 %", "more than chance (p &lt; 0.0001)"] {
        assert!(of_third.contains(piece), "{piece}: {said}");
    }
    let said = words(&shown.text("/parts?serial=SN-11"));
    assert!(said.contains("SN-110") && said.contains("SN-119") && !said.contains("SN-109"), "{said}");
    assert!(words(&shown.text("/parts?serial=sn-11")).contains("No serial number begins"), "small letters are others");
    // Over all result pages, everything appears once.
    let found = |path: &str| -> (Vec<String>, Option<String>) {
        let html = shown.text(path);
        let serials = words(&html).split(' ').filter(|word| word.starts_with("SN-")).map(str::to_owned).collect();
        (
            serials,
            html.split("href=\"/parts?serial=")
                .nth(1)
                .map(|rest| format!("/parts?serial={}", rest.split('"').next().unwrap().replace("&amp;", "&"))),
        )
    };
    for begin in ["", "SN-"] {
        let (mut all, next) = found(&format!("/parts?serial={begin}"));
        let (rest, none) = found(&next.unwrap());
        assert_eq!((all.len(), rest.len(), none), (100, 20, None), "{begin}");
        all.extend(rest);
        all.sort();
        assert_eq!(all, serials);
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn hostile_text_is_escaped_on_pages() {
    let plant = Plant::new();
    let one = cell(&plant, &HOSTILE[..80]);
    let mut told = grinding(HOSTILE);
    for key in ["words", "part", "next"] {
        told[key] = HOSTILE.into();
    }
    store_state(&plant, one, "1 second", Some(HOSTILE), &told);
    let run = |hours| Planted { cell: one, serial: HOSTILE, recipe: HOSTILE, hours, ..Planted::default() };
    let first = plant_runs(&plant, &[run(2), run(3), run(4)]);
    let text = quoted(HOSTILE);
    plant.sql(&format!("UPDATE run SET part_name = {text}, verdict = {text}, grinder = {text}, cmm = {text}, wheel = {text}, probe = {text}, operator = {text}"));
    plant.sql(&format!("UPDATE cycle SET verdict = {text}, reason = {text}, map = {text}"));
    plant.sql(&format!(
        "INSERT INTO incident (cell, run, what, words) VALUES (1, {text}, {}, {text})",
        quoted(&HOSTILE[..80])
    ));
    plant.sql(&format!(
        "INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256({0}, 1, 'a', '{{}}'), {0}, 1, 'a')",
        quoted(&HOSTILE[..80])
    ));
    plant.sql(&format!("INSERT INTO work (serial, recipe) SELECT {text}, sha256 FROM recipe"));
    let shown = ServedPage::serve(&plant);
    let encoded: String = HOSTILE.bytes().map(|byte| format!("%{byte:02x}")).collect();
    let pages = [
        "/".to_owned(),
        "/trend".to_owned(),
        format!("/trend?recipe={encoded}&wheel={encoded}&at={encoded}"),
        "/cells".to_owned(),
        "/parts".to_owned(),
        format!("/parts?serial={encoded}"),
        format!("/runs/{first}"),
        format!("/maps?run={first}&run={encoded}"),
    ];
    for path in &pages {
        let html = shown.text(path);
        assert!(
            !html.contains("<script>alert") && !html.contains("<img") && !words(&html).contains('\u{202e}'),
            "{path}: {html}"
        );
        assert!(!html.contains("onerror=alert(2)\"") && html.contains("&lt;script&gt;alert(1)"), "{path}: {html}");
    }
    for (path, status) in [
        (format!("/trend?since={encoded}"), 400),
        (format!("/run?cell={encoded}&name={encoded}"), 404),
        (format!("/runs/{encoded}"), 404),
        (format!("/{encoded}"), 404),
        ("/parts?serial=%00".into(), 200),
        ("/trend?recipe=%00&cell=%00".into(), 200),
        ("/runs/2147483647".into(), 404),
        ("/maps".into(), 400),
    ] {
        let answer = shown.visitor.get(&path);
        assert_eq!(answer.status, status, "{path}: {}", answer.text());
        assert!(!answer.text().contains("<script>alert"), "{path}: {}", answer.text());
    }
    let csv = shown.text("/export.csv");
    assert!(csv.contains("<script>alert(1)</script>'\"\"><img"), "a text is itself: {csv}");
    assert_eq!(plant.sql("SELECT count(*) FROM run"), "3");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn unproven_run_gives_no_report() {
    let plant = Plant::new();
    let (folder, name) = made(&plant);
    plant.does(&["ship", "--once", "--plant", "cell-1.toml"]);
    // An attacker with all rights has changed a record.
    plant.sql("UPDATE record SET text = replace(text, 'Ada', 'Eve') WHERE seq = 1");
    {
        let shown = ServedPage::serve(&plant);
        let said = words(&until_proven(&shown, "/runs/1"));
        assert!(said.contains("NOT PROVEN") && said.contains("record 1") && !said.contains("regrind-page-"), "{said}");
        for made in ["report", "qif", "dfq"] {
            assert_eq!(shown.visitor.get(&format!("/runs/1/{made}")).status, 422, "{made}");
        }
    }
    plant.sql("UPDATE record SET text = replace(text, 'Eve', 'Ada') WHERE seq = 1");
    // Somebody with the password of the cell reports a better figure than the record has.
    let was = plant.sql("SELECT pv_um FROM cycle WHERE cycle = 1");
    plant.sql("UPDATE cycle SET pv_um = 0.5 WHERE cycle = 1");
    {
        let said = words(&until_proven(&ServedPage::serve(&plant), "/runs/1"));
        assert!(
            said.contains("The report of the cell differs") && said.contains("PV of cycle 1 is 0.500 µm"),
            "{said}"
        );
        let run = folder.display().to_string();
        let (_, told) = plant.ends(&["audit", "verify", &run, "--plant", "cell-1.toml"], 1);
        assert!(told.contains("PV of cycle 1"), "{told}");
    }
    plant.sql(&format!("UPDATE cycle SET pv_um = {was} WHERE cycle = 1"));
    // A copy without its end: the last records are covered by no signature.
    plant.sql(
        "CREATE TABLE kept AS SELECT * FROM record; CREATE TABLE kept_run AS SELECT * FROM run;
        DELETE FROM record WHERE seq > (SELECT max(seq) - 3 FROM record);
        UPDATE run SET (records, head) = (SELECT seq, hash FROM record ORDER BY seq DESC LIMIT 1)",
    );
    {
        let html = until_proven(&ServedPage::serve(&plant), "/runs/1");
        let said = words(&html);
        assert!(said.contains("Unbroken, but not proven 20") && said.contains("nothing proves the records"), "{said}");
        assert!(!html.contains("class=\"proven\""), "{said}");
    }
    plant.sql(
        "INSERT INTO record SELECT * FROM kept ON CONFLICT DO NOTHING;
        UPDATE run r SET (records, head) = (SELECT k.records, k.head FROM kept_run k); DROP TABLE kept, kept_run",
    );
    let shown = ServedPage::serve(&plant);
    let answer = shown.visitor.get(&format!("/run?cell=cell-1&name={name}"));
    assert_eq!((answer.status, answer.header("location")), (303, vec!["/runs/1"]));
    let said = words(&until_proven(&shown, "/runs/1"));
    let records = plant.sql("SELECT count(*) FROM record");
    assert!(said.contains("Proven 20") && said.contains(&format!(" {records} records ")), "{said}");
    assert!(said.contains("Signed to the end") && said.contains("SIMULATION"), "{said}");

    // The report from the copy equals the report at the cell.
    let report = shown.visitor.get("/runs/1/report");
    assert!(report.header("content-security-policy")[0].starts_with("default-src 'none'"), "{report:?}");
    assert!(report.text() == fs::read_to_string(folder.join("report.html")).unwrap(), "the report of the cell itself");
    let path = folder.display().to_string();
    plant.does(&["report", &path, "--qif", "--dfq"]);
    for (made, file) in [("qif", "results.qif"), ("dfq", "results.dfq")] {
        assert_eq!(shown.text(&format!("/runs/1/{made}")), fs::read_to_string(folder.join(file)).unwrap(), "{made}");
    }
    let told = read_dfq(&folder.join("results.dfq"));
    assert_eq!(told["characteristics"][0]["values"][0]["part"], "SN-0042");

    let html = shown.text("/maps?run=1:1&run=1");
    assert_eq!(html.matches("<svg").count(), 2 + html.matches("class=\"shape\"").count(), "{}", words(&html));
    let said = words(&html);
    for piece in ["SN-0042 , Cycle 1", "Cycle 1, cell-1", "One scale for all: ±"] {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    plant.sql("UPDATE artefact SET content = 'other' WHERE sha256 = (SELECT sha256 FROM run_artefact WHERE name = 'cycle-1/error_map.csv')");
    let said = words(&shown.text("/maps?run=1:1"));
    assert!(said.contains("was changed"), "{said}");
}

/// Returns the page of a run after it shows the result of its verification.
fn until_proven(shown: &ServedPage, path: &str) -> String {
    let began = Instant::now();
    loop {
        let html = shown.text(path);
        if !html.contains("role=\"status\"") {
            return html;
        }
        assert!(began.elapsed() < PATIENCE, "never: {html}");
        std::thread::park_timeout(std::time::Duration::from_millis(100));
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn page_recovers_from_lost_database() {
    let mut plant = Plant::new();
    let one = cell(&plant, "cell-1");
    plant_runs(&plant, &[Planted { cell: one, ..Planted::default() }]);
    let shown = ServedPage::serve(&plant);
    for _ in 0..2 {
        assert!(shown.text("/").contains("cell-1"));
        plant.postgres.kill();
        for path in ["/", "/trend", "/cells", "/parts", "/runs/1", "/export.csv"] {
            let answer = shown.visitor.get(path);
            let said = words(&answer.text());
            assert_eq!(answer.status, 503, "{path}: {said}");
            for piece in ["database", "cannot be reached", "not known here"] {
                assert!(said.contains(piece), "{path}: {piece}: {said}");
            }
            assert!(answer.text().contains("http-equiv=\"refresh\" content=\"5\""), "{path}");
        }
        plant.postgres.go_on();
    }
    assert!(shown.text("/").contains("cell-1"));
    // A page that started without the database waits for it.
    plant.postgres.kill();
    let late = ServedPage::serve(&plant);
    assert_eq!(late.visitor.get("/").status, 503);
    plant.postgres.go_on();
    assert!(late.text("/").contains("cell-1"));
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn plant_page_needs_key_and_is_read_only() {
    let plant = Plant::new();
    let one = cell(&plant, "cell-1");
    plant_runs(&plant, &[Planted { cell: one, ..Planted::default() }]);
    let shown = ServedPage::serve(&plant);
    let stranger = Visitor::stranger(&shown.url);
    for path in [
        "/",
        "/trend",
        "/trend.dfq",
        "/cells",
        "/parts",
        "/export.csv",
        "/runs/1",
        "/runs/1/report",
        "/maps?run=1",
        "/plant.css",
        "/?key=wrong",
    ] {
        let answer = stranger.get(path);
        assert_eq!(answer.status, 401, "{path}");
        assert!(!answer.text().contains("cell-1"), "{path}");
    }
    let other = Visitor { place: shown.visitor.place.clone(), ..shown.visitor.clone() };
    let foreign =
        format!("GET / HTTP/1.1\r\nHost: plant.example\r\nCookie: {}\r\nConnection: close\r\n\r\n", other.cookies);
    assert_eq!(regrind_testcell::http::raw(&other.place, foreign.as_bytes()).status, 421);
    // The page accepts no orders.
    let origin = shown.visitor.origin();
    for path in ["/", "/trend", "/runs/1", "/runs/1/orders", "/parts"] {
        let token = shown.visitor.token();
        let answer = shown.visitor.post(path, &[("Origin", &origin), ("X-Regrind-Token", &token)], b"{}");
        assert!([404, 405].contains(&answer.status), "{path}: {answer:?}");
    }
    // Its role does not allow it, whatever the query.
    for text in [
        "UPDATE run SET part = 'x'",
        "DELETE FROM record",
        "INSERT INTO incident (what, words) VALUES ('x', 'y')",
        "SELECT queue_work('SN', '', NULL, NULL)",
        "SELECT tell_state(NULL, '{}')",
        "CREATE TABLE regrind.mine (a int)",
        "DROP VIEW choice",
    ] {
        assert!(plant.asked_by("page", text).is_err(), "{text}");
    }
    // For other computers there is no page without a certificate and users.
    let (_, told) = plant.ends(&["plant", "serve", "--plant", "page.toml", "--listen", "0.0.0.0:0"], 2);
    assert!(told.contains("open to other computers"), "{told}");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn grafana_queries_return_rows() {
    let plant = Plant::new();
    let one = cell(&plant, "cell-1");
    store_state(&plant, one, "1 second", None, &grinding("SN-1"));
    let runs: Vec<Planted> = (2..30).map(|hours| Planted { cell: one, hours, ..Planted::default() }).collect();
    plant_runs(&plant, &runs);
    plant.sql("INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256('mirror', 1, 'a', '{}'), 'mirror', 1, 'a')");
    plant.sql("INSERT INTO work (serial, recipe) SELECT 'SN-9', sha256 FROM recipe; INSERT INTO incident (what, words) VALUES ('x', 'y')");
    plant.somebody("grafana", "reader");
    let text = fs::read_to_string(root().join("config/plant/grafana.json")).unwrap();
    let dashboard: Value = serde_json::from_str(&text).unwrap();
    let panels = dashboard["panels"].as_array().unwrap().iter();
    let of_panel = |panel: &Value| {
        panel["targets"]
            .as_array()
            .unwrap()
            .iter()
            .map(|of| of["rawSql"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    let mut questions: Vec<String> = panels.flat_map(of_panel).collect();
    let variables = dashboard["templating"]["list"].as_array().unwrap().iter().filter(|of| of["type"] == "query");
    questions.extend(variables.map(|of| of["query"].as_str().unwrap().to_owned()));
    assert_eq!(questions.len(), 9, "seven panels and two variables");
    for question in questions {
        // As Grafana does before a query: it replaces its macros, then its variables.
        let (from, to) = ("'2000-01-01T00:00:00Z'", "'2999-01-01T00:00:00Z'");
        let mut asked = question.clone();
        for column in ["began", "at"] {
            asked = asked.replace(&format!("$__timeFilter({column})"), &format!("{column} BETWEEN {from} AND {to}"));
        }
        let variables = [
            ("$__timeFrom()", from),
            ("$__timeTo()", to),
            ("${parts}", "real"),
            ("${recipe:sqlstring}", "'mirror','lens'"),
            ("${cell:sqlstring}", "'cell-1'"),
        ];
        for (variable, value) in variables {
            asked = asked.replace(variable, value);
        }
        assert!(!asked.contains('$'), "{asked}");
        let password = plant.password("grafana");
        let rows = plant
            .postgres
            .ask_as("grafana", &password, "regrind", &asked)
            .unwrap_or_else(|error| panic!("{asked}: {error}"));
        assert!(!rows.is_empty(), "no row: {asked}");
    }
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn cells_in_natural_order_keep_their_places() {
    let plant = Plant::new();
    // Enrolled in another order than the natural one.
    for k in [10, 2, 1, 12, 3, 11, 4, 9, 5, 8, 6, 7] {
        let cell = cell(&plant, &format!("cell-{k}"));
        store_state(&plant, cell, "-1 hours", Some("run"), &grinding(&format!("SN-{k}")));
    }
    let natural: Vec<String> = (1..=12).map(|k| format!("cell-{k}")).collect();
    let shown = ServedPage::serve(&plant);
    let places = |html: &str| -> Vec<String> {
        html.split("data-cell=\"").skip(1).map(|rest| rest.split('"').next().unwrap().to_owned()).collect()
    };
    assert_eq!(places(&shown.text("/")), natural);
    let state = |name: &str, state: Value| {
        let mut told = grinding("SN-7");
        told.as_object_mut().unwrap().extend(state.as_object().unwrap().clone());
        let told = quoted(&told.to_string());
        plant.sql(&format!(
            "UPDATE cell_state SET snapshot = {told} WHERE cell = (SELECT id FROM cell WHERE name = '{name}')"
        ));
    };
    state("cell-10", serde_json::json!({ "state": "Held", "alarms": [{}], "next_step": { "step": "clear_alarm" } }));
    state("cell-2", serde_json::json!({ "phase": "load", "next_step": { "step": "load" } }));
    state("cell-3", serde_json::json!({ "phase": "judge" }));
    state("cell-4", serde_json::json!({ "state": "Idle" }));
    let html = shown.text("/");
    assert_eq!(places(&html), natural, "a cell keeps its place whatever its state");
    let said = words(&html);
    let needs = said.split("Needs a person").nth(1).unwrap().split("cell-1 ").next().unwrap();
    for piece in [
        "cell-10 Held · 1 alarm SN-7, cycle 2",
        "Follow the steps of the alarm",
        "cell-2 Loading SN-7",
        "Load and clamp the part",
    ] {
        assert!(needs.contains(piece), "{piece}: {needs}");
    }
    assert!(needs.find("cell-10").unwrap() < needs.find("cell-2").unwrap(), "alarms come first: {needs}");
    for piece in
        ["1 with an alarm or aborted · 1 waiting for a person · 9 at work · 1 idle", "cell-3 Evaluating", "cell-4 Idle"]
    {
        assert!(said.contains(piece), "{piece}: {said}");
    }
    // The comparison and the choice of a cell have the same order.
    plant_runs(&plant, &(1..=12).map(|cell| Planted { cell, ..Planted::default() }).collect::<Vec<_>>());
    assert_eq!(places(&shown.text("/cells")), natural);
    let form = shown.text("/trend");
    let options = form.split("select name=\"cell\"").nth(1).unwrap().split("</select>").next().unwrap();
    let named: Vec<&str> = options.split("value=\"").skip(2).map(|rest| rest.split('"').next().unwrap()).collect();
    assert_eq!(named, natural);
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn pages_in_each_language() {
    let plant = Plant::new();
    let one = cell(&plant, "cell-1");
    store_state(&plant, one, "-1 hours", Some("run"), &grinding("SN-0042"));
    let runs: Vec<Planted> = (2..30).map(|hours| Planted { cell: one, hours, ..Planted::default() }).collect();
    let first = plant_runs(&plant, &runs);
    let shown = ServedPage::serve(&plant);
    let paths =
        ["/".to_owned(), "/trend".into(), "/cells".into(), "/parts".into(), format!("/runs/{first}"), "/maps".into()];
    let in_language = |tag: &str, path: &str| {
        let (host, cookies) = (shown.visitor.host(), &shown.visitor.cookies);
        let request =
            format!("GET {path} HTTP/1.0\r\nHost: {host}\r\nCookie: {cookies}; regrind_language={tag}\r\n\r\n");
        raw(&shown.visitor.place, request.as_bytes()).text()
    };
    for (tag, pieces) in [
        (
            "en",
            [
                "Grinding",
                "Nelson's rules",
                "differs from the others",
                "Serial number",
                "Convergence",
                "Invalid request",
            ],
        ),
        (
            "de",
            [
                "Schleifen",
                "Regeln von Nelson",
                "weicht von den anderen ab",
                "Seriennummer",
                "Konvergenz",
                "Ungültige Anfrage",
            ],
        ),
        ("zh", ["磨削", "Nelson 判异准则", "与其他单元的差异", "序列号", "收敛", "无效请求"]),
    ] {
        for (path, piece) in paths.iter().zip(pieces) {
            let html = in_language(tag, path);
            assert!(
                html.contains(&format!("<html lang=\"{tag}\">")) && words(&html).contains(piece),
                "{tag}, {path}: {piece}: {html}"
            );
            let empty = words(&html).matches("{").count();
            assert_eq!(empty, 0, "{tag}, {path}: a place without its value: {}", words(&html));
        }
    }
    assert!(words(&in_language("de", "/trend")).contains("4,000 µm"), "the decimal sign of the language");
}

/// The first measurements of a process that shifts: the rules of Nelson mark the shift, and the capability is given with
/// its interval and with a warning.
#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn trend_marks_shift_and_gives_capability() {
    let plant = Plant::new();
    let one = cell(&plant, "cell-1");
    // Sixty values without a trend, of a normal distribution, in an order that repeats every 60.
    let calm =
        |k: u32| 4.0 + 0.5 * [-1.6, 0.3, 1.2, -0.4, 0.8, -0.9, 0.1, 1.7, -1.2, -0.1, 0.5, -0.6][(k * 5 % 12) as usize];
    let planted = |hours: u32, pv_um: f64| Planted { cell: one, hours, pv_um, ..Planted::default() };
    let runs: Vec<Planted> = (0..60).map(|k| planted(200 - k, calm(k))).collect();
    plant_runs(&plant, &runs);
    let shown = ServedPage::serve(&plant);
    let said = words(&shown.text("/trend"));
    let index = |said: &str| -> [f64; 3] {
        let rest = said.split("Cpk ").nth(2).unwrap();
        let numbers: Vec<f64> = rest.split([' ', '(', ')']).filter_map(|word| word.parse().ok()).collect();
        [numbers[0], numbers[1], numbers[2]]
    };
    let [cpk, low, high] = index(&said);
    assert!(low < cpk && cpk < high && (0.8..3.0).contains(&cpk), "{said}");
    assert!(said.contains("Cp – not defined: there is only an upper limit"), "{said}");
    // Nine parts above the mean after two that were too: rule 2 marks the ninth and the two after it.
    let above = [0.05, 0.4, 0.9, 0.1, 0.6, 0.2, 1.3, 0.5, 0.15];
    plant_runs(&plant, &(0..).zip(above).map(|(k, more)| planted(20 - k, 4.15 + 0.5 * more)).collect::<Vec<_>>());
    let html = shown.text("/trend");
    let said = words(&html);
    assert!(
        html.contains("data-rule=\"2\"") && said.contains("nine in a row on one side of the mean: points: 3"),
        "{said}"
    );
    assert!(said.contains("of 69 points break a rule"), "{said}");
    // The parts have different limits: no index.
    plant.sql("UPDATE run SET pv_limit_um = 8 WHERE id = (SELECT max(id) FROM run)");
    let said = words(&shown.text("/trend"));
    assert!(said.contains("Cpk – not given: the parts have different limits"), "{said}");
}

/// Returns an expression for everything that is wider than the screen, for names that are not on one line, and for tiles
/// that are not of one size.
const WRONG: &str = "(() => { const wrong = []; const d = document.documentElement, m = document.querySelector('main'); \
    if (d.scrollWidth > innerWidth || m.scrollWidth > m.clientWidth) wrong.push(`page ${d.scrollWidth}, main ${m.scrollWidth} of ${m.clientWidth}`); \
    for (const e of document.querySelectorAll('main *')) { const b = e.getBoundingClientRect(); \
        if (b.right > innerWidth + 1 && b.width && !e.closest('.wide') && !e.closest('svg')) wrong.push(e.outerHTML.slice(0, 80)); } \
    const tops = [...document.querySelectorAll('.cells > .cell')].map((e) => Math.round(e.getBoundingClientRect().top)); \
    const rows = [...new Set(tops)]; const steps = rows.slice(1).map((top, k) => top - rows[k]); \
    if (Math.max(...steps) - Math.min(...steps) > 1) wrong.push(`rows of several heights: ${[...new Set(steps)]}`); \
    return wrong.slice(0, 5); })()";

/// Expression for whether the last point of the first chart is on the screen.
const NEWEST_IS_SHOWN: &str = "(() => { const points = [...document.querySelector('.figure .newest').querySelectorAll('circle, path')]; \
    const b = points.pop().getBoundingClientRect(); return b.left >= 0 && b.right <= innerWidth; })()";

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql) and a browser (Debian package chromium)"]
fn plant_pages_fit_every_screen() {
    let (plant, run) = plant_with_long_texts();
    let paths = ["", "trend", "cells", "parts?serial=SN", &format!("maps?run={run}"), &format!("runs/{run}")];
    let (mut browser, tab, shown) = fits_every_screen(&plant, 20, &paths);
    shows_local_time_and_keeps_details(&mut browser, &tab, &shown.base());
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql) and a browser (Debian package chromium)"]
fn thousand_cells_fit_every_screen() {
    let (plant, _) = plant_with_long_texts();
    // The others are as one of the first twenty.
    plant.sql(
        "WITH made AS (INSERT INTO cell (name, role) SELECT 'cell-' || n, 'role_' || n FROM generate_series(21, 1000) n RETURNING id)
         INSERT INTO cell_state (cell, at, run, snapshot) SELECT m.id, s.at, s.run, s.snapshot FROM made m JOIN cell_state s ON s.cell = 1 + m.id % 20",
    );
    fits_every_screen(&plant, 1000, &["", "trend", "cells"]);
}

/// Returns a plant of twenty cells in each state, some with long names, and with long serial numbers and incidents; and
/// the number of its first run.
fn plant_with_long_texts() -> (Plant, i32) {
    let plant = Plant::new();
    let name = |k: u32| if k == 3 { format!("cell-3 {}", "long".repeat(18)) } else { format!("cell-{k}") };
    let state = |k: u32| match k % 5 {
        0 => serde_json::json!({ "state": "Held", "alarms": [{}], "next_step": { "step": "clear_alarm" } }),
        1 => serde_json::json!({ "state": "Idle" }),
        2 | 3 => serde_json::json!({ "next_step": { "step": "load" }, "phase": "load" }),
        _ => serde_json::json!({}),
    };
    for k in 1..=20 {
        let mut told = grinding(&format!("SN-{k}{}", if k == 4 { "-4".repeat(100) } else { String::new() }));
        told.as_object_mut().unwrap().extend(state(k).as_object().unwrap().clone());
        store_state(&plant, cell(&plant, &name(k)), "-1 hours", Some("run"), &told);
    }
    let serial = format!("SN-{}", "7".repeat(200));
    let runs: Vec<Planted> = (2..90)
        .map(|hours| Planted { cell: (1 + hours % 20) as i32, serial: &serial, hours, cycles: 2, ..Planted::default() })
        .collect();
    let first = plant_runs(&plant, &runs);
    let long = quoted(&"a chain that is broken ".repeat(80));
    plant.sql(&format!(
        "INSERT INTO incident (cell, run, what, words) VALUES (3, repeat('run-', 60), 'a broken chain', {long})"
    ));
    plant.sql("INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256('mirror', 1, 'a', '{}'), 'mirror', 1, 'a')");
    plant.sql(&format!("INSERT INTO work (serial, recipe) SELECT '{serial}', sha256 FROM recipe"));
    (plant, first)
}

/// Looks at pages of a plant of `cells` cells at three widths. Nothing may be wider than the screen. Returns the browser,
/// its tab, and the address of the page.
fn fits_every_screen(plant: &Plant, cells: usize, paths: &[&str]) -> (Browser, Tab, ServedPage) {
    let shown = ServedPage::serve(plant);
    let base = shown.base();
    let mut browser = Browser::start(plant.home.path());
    let tab = browser.open(&shown.url, [1366, 768]);
    tab.until(&mut browser, &format!("document.querySelectorAll('.cells > .cell').length == {cells}"));
    for [width, height] in [[1920, 1080], [1366, 768], [390, 844]] {
        let size =
            serde_json::json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600 });
        tab.send(&mut browser, "Emulation.setDeviceMetricsOverride", size);
        for path in paths {
            tab.send(&mut browser, "Page.navigate", serde_json::json!({ "url": format!("{base}{path}") }));
            tab.until(&mut browser, &format!("document.readyState == 'complete' && location.href == '{base}{path}'"));
            let wrong = tab.read(&mut browser, WRONG);
            assert_eq!(wrong, serde_json::json!([]), "/{path} with {cells} cells at {width} px");
            if *path == "trend" {
                assert_eq!(tab.read(&mut browser, NEWEST_IS_SHOWN), true, "the newest point at {width} px");
            }
        }
    }
    assert_eq!(tab.problems(&browser), Vec::<String>::new());
    (browser, tab, shown)
}

/// Checks that times are those of the reader, and that an open detail stays open while the page fetches itself again.
fn shows_local_time_and_keeps_details(browser: &mut Browser, tab: &Tab, base: &str) {
    tab.send(browser, "Emulation.setTimezoneOverride", serde_json::json!({ "timezoneId": "Asia/Kolkata" }));
    tab.send(browser, "Page.navigate", serde_json::json!({ "url": base }));
    tab.until(browser, "document.readyState == 'complete' && document.querySelector('.incidents time[title]')");
    let time = "(() => { const t = document.querySelector('.incidents time'); const u = new Date(t.dateTime); \
        const local = new Date(u.getTime() + 330 * 60000); const mm = String(local.getUTCMinutes()).padStart(2, '0'); \
        return t.title.endsWith('UTC') && t.textContent.includes(`:${mm}:`) && !t.textContent.includes('UTC'); })()";
    assert_eq!(tab.read(browser, time), true, "half an hour beside UTC");
    tab.read(browser, "(() => { document.getElementById('more-needs').open = true; document.querySelector('main .cell').id = 'old-one'; })()");
    // The page has fetched itself again when the changed cell is gone.
    tab.until(browser, "!document.getElementById('old-one')");
    assert_eq!(tab.read(browser, "document.getElementById('more-needs').open"), true);
}

/// Makes the picture in the documentation from the current page.
#[test]
#[ignore = "writes into docs"]
fn plant_pictures_are_made() {
    let plant = Plant::new();
    let states = [
        serde_json::json!({}),
        serde_json::json!({ "state": "Held", "alarms": [{}], "next_step": { "step": "clear_alarm" } }),
        serde_json::json!({ "phase": { "measure": "run" }, "progress": { "device": "Cmm", "done": 1210, "total": 1800, "left_s": [240.0, 300.0] } }),
        serde_json::json!({ "phase": "load", "next_step": { "step": "load" }, "progress": null, "cycle": 0 }),
        serde_json::json!({ "state": "Idle", "part": "", "serial": "", "progress": null }),
        serde_json::json!({ "phase": "judge", "progress": null }),
        serde_json::json!({}),
        serde_json::json!({ "state": "Idle", "part": "", "serial": "", "progress": null }),
    ];
    for (k, state) in (1..).zip(&states) {
        let cell = cell(&plant, &format!("cell-{k}"));
        let mut told = grinding(&format!("SN-040{k}"));
        told.as_object_mut().unwrap().extend(state.as_object().unwrap().clone());
        told["simulation"] = true.into();
        let run = (state["state"] != "Idle").then_some("run");
        store_state(&plant, cell, if k == 7 { "4 hours" } else { "-1 hours" }, run, &told);
    }
    let serials: Vec<String> = (0..160).map(|k| format!("SN-{k:04}")).collect();
    let run = |k: u32| Planted {
        cell: (1 + k % 6) as i32,
        serial: &serials[k as usize],
        recipe: if k.is_multiple_of(5) { "biconic" } else { "freeform-mirror" },
        hours: 3 + 2 * k,
        result: if k % 17 == 4 { "not accepted" } else { "accepted" },
        cycles: [2, 3, 1, 2, 2, 4, 2, 1][(k * 5 % 8) as usize],
        pv_um: 3.0 + f64::from(k * 7 % 20) / 10.0,
        real: false,
    };
    plant_runs(&plant, &(0..160).map(run).collect::<Vec<_>>());
    plant.sql("INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256('freeform-mirror', 3, 'a', '{}'), 'freeform-mirror', 3, 'a')");
    plant.sql("INSERT INTO work (serial, recipe, due) SELECT 'SN-050' || n, sha256, current_date + n FROM recipe, generate_series(-1, 2) n");
    plant.sql("INSERT INTO incident (cell, run, what, words) VALUES (2, 'run-77', 'a broken chain', 'record 12 does not follow the one before it, or its content is not what was hashed')");
    let shown = ServedPage::serve(&plant);
    let mut browser = Browser::start(plant.home.path());
    let tab = browser.open(&shown.url, [1366, 1000]);
    tab.until(&mut browser, "document.querySelectorAll('.cells > .cell').length == 8");
    tab.send(&mut browser, "Page.bringToFront", serde_json::json!({}));
    let shot = tab.send(&mut browser, "Page.captureScreenshot", serde_json::json!({ "format": "png" }));
    let decode = format!("base64 -d > '{}'", root().join("docs/plant-page.png").display());
    let mut shell = Command::new("sh").args(["-c", &decode]).stdin(std::process::Stdio::piped()).spawn().unwrap();
    std::io::Write::write_all(&mut shell.stdin.take().unwrap(), shot["data"].as_str().unwrap().as_bytes()).unwrap();
    assert!(shell.wait().unwrap().success());
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn page_is_compressed_where_accepted() {
    let plant = Plant::new();
    let one = cell(&plant, "cell-1");
    let runs: Vec<Planted> = (2..60).map(|hours| Planted { cell: one, hours, ..Planted::default() }).collect();
    plant_runs(&plant, &runs);
    let shown = ServedPage::serve(&plant);
    let asked = |path: &str, accepts: &str| {
        let (host, cookies) = (shown.visitor.host(), &shown.visitor.cookies);
        // By HTTP 1.0 a body without a length ends with the connection.
        raw(
            &shown.visitor.place,
            format!("GET {path} HTTP/1.0\r\nHost: {host}\r\nCookie: {cookies}\r\n{accepts}\r\n").as_bytes(),
        )
    };
    for path in [
        "/trend",
        "/cells",
        "/export.csv",
        "/trend.dfq",
        "/plant.css",
        "/assets/page.css",
        "/assets/page.js",
        "/assets/icon.svg",
    ] {
        let plain = asked(path, "");
        assert_eq!((plain.status, plain.header("content-encoding")), (200, vec![]), "{path}");
        for accepts in ["Accept-Encoding: gzip\r\n", "Accept-Encoding: br;q=1.0, gzip;q=0.5\r\n"] {
            let packed = asked(path, accepts);
            if plain.body.len() < 1024 {
                assert_eq!(packed.header("content-encoding"), Vec::<&str>::new(), "{path} is short");
                continue;
            }
            assert_eq!(packed.header("content-encoding"), ["gzip"], "{path}: {}", packed.head);
            assert!(
                packed.header("vary").iter().any(|vary| vary.eq_ignore_ascii_case("accept-encoding")),
                "{path}: {}",
                packed.head
            );
            assert!(
                3 * packed.body.len() < 2 * plain.body.len(),
                "{path}: {} of {} bytes",
                packed.body.len(),
                plain.body.len()
            );
            assert!(unpacked(&plant, &packed.body) == plain.body, "{path} is another text");
        }
        for accepts in ["Accept-Encoding: identity\r\n", "Accept-Encoding: gzip;q=0\r\n"] {
            assert_eq!(asked(path, accepts).header("content-encoding"), Vec::<&str>::new(), "{path}, {accepts}");
        }
    }
    // A token is a secret: its answer is never compressed.
    assert_eq!(asked("/token", "Accept-Encoding: gzip\r\n").header("content-encoding"), Vec::<&str>::new());
}

/// Unpacks gzip by an independent program.
fn unpacked(plant: &Plant, bytes: &[u8]) -> Vec<u8> {
    let path = plant.path("answer.gz");
    fs::write(&path, bytes).unwrap();
    let done = Command::new("gzip").arg("-dc").arg(&path).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    done.stdout
}

/// Difference of the counts by day from a count of all parts: rows that only one of them has.
const MISCOUNTED: &str = "WITH counted AS (
        SELECT day, cell, recipe, simulation, count(*) FILTER (WHERE result = 'accepted') AS accepted,
            count(*) FILTER (WHERE result = 'accepted' AND cycles = 1) AS accepted_at_once, count(*) FILTER (WHERE result = 'not accepted') AS not_accepted,
            count(*) FILTER (WHERE result = 'stopped') AS stopped, count(*) FILTER (WHERE result = 'aborted') AS aborted,
            count(*) FILTER (WHERE result = 'given up') AS given_up
        FROM counted_part GROUP BY day, cell, recipe, simulation),
    kept AS (SELECT * FROM parts_of_day WHERE (accepted, accepted_at_once, not_accepted, stopped, aborted, given_up) <> (0, 0, 0, 0, 0, 0))
    SELECT 'only counted', x.* FROM (SELECT * FROM counted EXCEPT SELECT * FROM kept) x
    UNION ALL SELECT 'only kept', x.* FROM (SELECT * FROM kept EXCEPT SELECT * FROM counted) x";

/// Steps of a cell in one session, at random: its runs begin and end, their figures come before or after the end and
/// again with others, parts are leased, begun and given up, and their runs end afterwards. Each step is a transaction.
const RANDOM_STEPS: &str = r#"DO $do$
DECLARE
    deed float; of_run text; found record; got record; stood record; lines text[]; hashes bytea[]; line text; payload text; given text;
    results text[] := '{accepted,"not accepted",stopped,aborted,open,recovery}';
BEGIN
    PERFORM set_config('search_path', 'regrind', false), setseed(SEED);
    FOR k IN 1..STEPS LOOP
        deed := random();
        IF deed < 0.1 THEN
            SELECT * INTO got FROM take_work(600);
            IF got.id IS NOT NULL THEN
                -- The other session may begin a run of that name.
                BEGIN
                    given := begin_work(got.id, got.lease, 'work-' || floor(200 * random()));
                EXCEPTION WHEN unique_violation THEN
                    given := 'there is a run of that name';
                END;
                IF given IS NOT NULL THEN
                    PERFORM return_work(got.id, got.lease, given);
                END IF;
            END IF;
        ELSIF deed < 0.16 THEN
            SELECT w.id, w.run INTO got FROM work w WHERE w.state = 'begun' AND w.cell = own_cell() ORDER BY random() LIMIT 1;
            IF got.id IS NOT NULL THEN
                PERFORM give_up_work(got.id, got.run, 'broken');
            END IF;
        ELSE
            of_run := coalesce((SELECT w.run FROM work w WHERE w.run IS NOT NULL AND random() < 0.5 ORDER BY random() LIMIT 1), 'run-' || floor(30 * random()));
            SELECT * INTO stood FROM open_run(of_run);
            IF deed < 0.45 THEN
                PERFORM tell_run(stood.id, jsonb_build_object('result', (results || NULL::text)[1 + floor(7 * random())::int], 'alarms', 0, 'cycles',
                    (SELECT coalesce(jsonb_agg(jsonb_build_object('cycle', c, 'pv_um', 1)), '[]') FROM generate_series(1, floor(3 * random())::int) c)));
            ELSE
                lines := '{}'; hashes := '{}';
                IF stood.records = 0 THEN
                    payload := format('{"content":{%s"part_name":"P"},"run":"%s"%s}', CASE floor(3 * random()) WHEN 0 THEN '' WHEN 1 THEN '"recipe":"lens.toml",'
                        ELSE '"recipe":"mirror.toml",' END, of_run, CASE floor(3 * random()) WHEN 0 THEN '' WHEN 1 THEN ',"simulation":true' ELSE ',"simulation":false' END);
                    lines := lines || format('{"actor":"a","kind":"begin","mono_ns":1,"part":"P","payload":%s,"seq":1,"utc":"%s"}', payload, now() - random() * interval '3 days');
                END IF;
                IF NOT stood.is_ended AND random() < 0.6 THEN
                    lines := lines || format('{"actor":"a","kind":"end","mono_ns":1,"part":"P","payload":{},"seq":%s,"utc":"%s"}',
                        stood.records + cardinality(lines) + 1, now() - random() * interval '3 days');
                END IF;
                FOREACH line IN ARRAY lines LOOP
                    given := encode(CASE WHEN cardinality(hashes) = 0 THEN stood.head ELSE hashes[cardinality(hashes)] END, 'hex');
                    hashes := hashes || sha256(convert_to('regrind journal record 1' || chr(10) || given || chr(10) || line, 'UTF8'));
                END LOOP;
                IF cardinality(lines) > 0 THEN
                    SELECT * INTO found FROM ship(stood.id, stood.records + 1, hashes, lines);
                END IF;
            END IF;
        END IF;
        COMMIT;
    END LOOP;
END $do$"#;

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn counts_by_day_match_runs_after_any_events() {
    let plant = Plant::new();
    let cells = ["cell-1", "cell-2"];
    for name in cells {
        plant.cell(name, &[]);
    }
    plant.sql("INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256('mirror', 1, 'a', '{}'), 'mirror', 1, 'a')");
    plant.sql("INSERT INTO approval (recipe, person, key, signature) SELECT sha256, 'p' || n, repeat(n::text, 64), repeat('a', 128) FROM recipe, generate_series(1, 2) n");
    plant.sql("INSERT INTO work (serial, recipe) SELECT 'SN-' || n, sha256 FROM recipe, generate_series(1, 200) n");
    let seed = rand::random::<u32>();
    println!("seed {seed}");
    for round in 0..4_u32 {
        // Two sessions of each cell, and the owner, who changes many runs at once.
        std::thread::scope(|scope| {
            for (session, name) in [cells, cells].concat().into_iter().enumerate() {
                let drawn = f64::from(seed.wrapping_add(8 * round + session as u32).wrapping_mul(2_654_435_761))
                    / f64::from(u32::MAX);
                let text = RANDOM_STEPS.replace("SEED", &drawn.to_string()).replace("STEPS", "150");
                let plant = &plant;
                scope.spawn(move || {
                    let (role, password) = (name.replace('-', "_"), plant.password(name));
                    // One statement, so that it can end its transactions itself.
                    let said = plant.postgres.ask_as(&role, &password, "regrind", &text);
                    said.unwrap_or_else(|error| panic!("seed {seed}, {name}: {error}"))
                });
            }
            for k in 0..10_u32 {
                plant.sql(&format!("UPDATE run SET result = (ARRAY['accepted', 'stopped', NULL])[1 + (id + {k}) % 3] WHERE id % 3 = {k} % 3 AND ended IS NOT NULL"));
            }
        });
        assert_eq!(plant.sql(MISCOUNTED), "", "seed {seed}, round {round}");
        let kinds = "SELECT count(*) > 10, count(*) FILTER (WHERE result = 'given up') > 0, count(*) FILTER (WHERE simulation IS NULL) > 0 FROM counted_part";
        assert_eq!(plant.sql(kinds), "t|t|t", "seed {seed}, round {round}");
        // Changes that only an owner makes: a run that has not ended after all, another recipe, and runs that are gone.
        plant.sql("UPDATE run SET ended = NULL WHERE id % 5 = 0");
        plant.sql("UPDATE run SET recipe = 'prism', simulation = NOT simulation WHERE id % 7 = 0");
        plant.sql("DELETE FROM cycle WHERE run % 11 = 0; DELETE FROM run WHERE id % 11 = 0");
        assert_eq!(plant.sql(MISCOUNTED), "", "seed {seed}, round {round}, by the owner");
    }
    // The page shows these counts.
    let [ended, accepted] = ["ended", "accepted"]
        .map(|of| plant.sql(&format!("SELECT sum({of}) FROM parts_by_day WHERE NOT simulation AND cell = 'cell-1'")));
    let said = words(&ServedPage::serve(&plant).text("/?parts=real"));
    assert!(said.contains(&format!("cell-1 {ended} {accepted} ")), "seed {seed}: {said}");
    // The remedy for a count that somebody has changed by hand.
    plant.sql("UPDATE parts_of_day SET accepted = accepted + 1");
    assert_ne!(plant.sql(MISCOUNTED), "");
    plant.sql("SELECT count_parts_again()");
    assert_eq!(plant.sql(MISCOUNTED), "");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn counts_by_day_begin_with_runs_of_earlier_layout() {
    let plant = Plant::new();
    plant.sql("DROP SCHEMA regrind CASCADE");
    let folder = root().join("src/plant/migrations");
    let mut files: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let version = |path: &Path| path.file_name().unwrap().to_str().unwrap()[..4].parse::<i32>().unwrap();
    let earlier: Vec<_> = files.into_iter().filter(|path| version(path) < 11).collect();
    let mut text =
        "CREATE SCHEMA regrind; CREATE TABLE regrind.migration (version integer PRIMARY KEY, sha256 text NOT NULL,
            applied_at timestamptz NOT NULL DEFAULT now()); SET search_path = regrind, pg_temp; "
            .to_owned();
    for path in &earlier {
        let sql = fs::read_to_string(path).unwrap();
        text += &format!(
            "{sql}; INSERT INTO migration (version, sha256) VALUES ({}, '{}'); ",
            version(path),
            sha256_hex(sql.as_bytes())
        );
    }
    plant.postgres.ask_as(crate::postgres::OWNER, &plant.password("owner"), "regrind", &text).unwrap();
    let one = cell(&plant, "cell-1");
    let of = |result, hours| Planted { cell: one, result, hours, ..Planted::default() };
    plant_runs(
        &plant,
        &[
            of("accepted", 3),
            of("accepted", 60),
            of("stopped", 4),
            of("open", 5),
            Planted { real: false, ..of("aborted", 2) },
        ],
    );
    plant.sql("UPDATE run SET ended = NULL WHERE result = 'open'");
    plant.sql("INSERT INTO recipe (sha256, name, version, text) VALUES (recipe_sha256('mirror', 1, 'a', '{}'), 'mirror', 1, 'a')");
    for run in ["SELECT name FROM run WHERE result = 'open'", "SELECT 'nothing-arrived'"] {
        plant.sql(&format!(
            "WITH made AS (INSERT INTO work (serial, recipe, state, cell, run) SELECT 'SN-UP', sha256, 'ended', 1, ({run}) FROM recipe RETURNING id)
             INSERT INTO work_step (work, step) SELECT id, 'given up' FROM made"
        ));
    }
    let counts = "SELECT simulation, sum(ended), sum(accepted) FROM parts_by_day GROUP BY 1 ORDER BY 1";
    let before = plant.sql(counts);
    // The newest run of the cell is simulated, and so is the part of whose run nothing arrived.
    assert_eq!(before, "f|4|2\nt|2|0");
    plant.does(&["plant", "init", "--plant", "owner.toml"]);
    assert_eq!(plant.sql(counts), before);
    assert_eq!(plant.sql(MISCOUNTED), "");
    // It stays so when the cell makes real parts.
    plant_runs(&plant, &[Planted { hours: 1, ..of("accepted", 1) }]);
    assert_eq!(plant.sql(counts), "f|5|3\nt|2|0");
}

#[test]
#[ignore = "needs PostgreSQL (Debian package postgresql)"]
fn filled_plant_is_proven_and_every_query_has_an_index() {
    let plant = Plant::new();
    let home = plant.path("at-cell");
    fs::create_dir(&home).unwrap();
    let recipe = small_recipe(&home, 1000.0).display().to_string();
    let (code, out, errors) = crate::program::run(&["run", &recipe, "--cell", "sim", "--part", "SN-0042"], &home);
    assert_eq!(code, 0, "{out}{errors}");
    let (folder, _) = only_run(&home.join("runs"));
    let like = folder.display().to_string();
    let fill = |more: &str| format!("plant fill --plant owner.toml --cells 20 --years 1 {more}");
    let does = |command: String| plant.does(&command.split(' ').collect::<Vec<_>>());
    let refused = |command: String| plant.ends(&command.split(' ').collect::<Vec<_>>(), 2).1;
    let said = does(fill(&format!("--runs 12000 --seed 7 --records 40 --like {like}")));
    assert!(said.contains("seed 7") && said.contains("12,000 runs of 20 cells"), "{said}");
    assert_eq!(
        plant.sql("SELECT count(*), bool_and(simulation), bool_and(name LIKE 'SIMULATION-%') FROM run"),
        "12000|t|t"
    );
    assert_eq!(plant.sql("SELECT count(*), bool_and(name LIKE 'SIMULATION-%') FROM cell"), "20|t");
    assert_eq!(
        plant.sql("SELECT max(began) - min(began) BETWEEN interval '364 days' AND interval '367 days' FROM run"),
        "t"
    );
    assert_eq!(plant.sql(MISCOUNTED), "");
    let drawn = "SELECT md5(string_agg(pv_um || ' ' || result, ',' ORDER BY name)) FROM run WHERE records = 0";
    let first = plant.sql(drawn);
    // They arrived when they were made, so earlier months can be archived.
    let earlier = "SELECT count(*) > 20, bool_and(is_over) FROM archivable WHERE month < date_trunc('month', now() - interval '2 days')";
    assert_eq!(plant.sql(earlier), "t|t");
    // The chains, files and figures of the runs with whole records are those of the run that they repeat.
    let whole = plant.sql("SELECT name FROM run WHERE records > 100 ORDER BY id");
    assert_eq!(whole.lines().count(), 40, "{whole}");
    for name in whole.lines().step_by(15) {
        let told = plant.does(&["audit", "verify", name, "--plant", "owner.toml"]);
        assert!(told.contains("files of SIMULATION-"), "{told}");
    }
    plant.sql("UPDATE record SET text = replace(text, 'SN', 'SM') WHERE seq = 5; UPDATE cycle SET pv_um = 0.1 WHERE run = (SELECT max(id) FROM run WHERE records > 0)");
    let (_, told) = plant.ends(&["audit", "verify", whole.lines().last().unwrap(), "--plant", "owner.toml"], 1);
    assert!(!told.is_empty());

    // A seed is used once; the same seed draws the same in another database.
    let told = refused(fill("--runs 10 --seed 7"));
    assert!(told.contains("another seed"), "{told}");
    does(fill("--runs 4000 --seed 8"));
    assert_ne!(plant.sql(drawn), first);
    // No page reads the whole table of runs, also with a few real runs of one cell beside the simulated ones.
    let real = cell(&plant, "cell-1");
    plant_runs(
        &plant,
        &[
            Planted { cell: real, hours: 900, ..Planted::default() },
            Planted { cell: real, hours: 901, result: "recovery", ..Planted::default() },
        ],
    );
    let told = refused(fill("--runs 10"));
    assert!(told.contains("cell-1") && told.contains("another database"), "{told}");
    // Most runs of a plant come from its queue.
    plant.sql("INSERT INTO work (serial, recipe, state, cell, run) SELECT 'SN-' || n, sha256, 'ended', 1, 'run-' || n FROM recipe, generate_series(1, 20000) n");
    plant.sql("ANALYZE");
    every_query_has_an_index(&plant);
}

/// Requests every page, and checks the plan of each of its queries.
fn every_query_has_an_index(plant: &Plant) {
    plant.somebody("page", "reader");
    for setting in [
        "session_preload_libraries = 'auto_explain'",
        "auto_explain.log_min_duration = 0",
        "auto_explain.log_analyze = on",
    ] {
        plant.sql(&format!("ALTER ROLE page SET {setting}"));
    }
    let shown = ServedPage::serve(plant);
    let run = plant.sql("SELECT max(id) FROM run WHERE simulation");
    let before = plant.postgres.log().len();
    let selections = [
        "",
        "recipe=",
        "recipe=mirror-1",
        "recipe=mirror-1&cell=SIMULATION-0003",
        "recipe=&grinder=Grinder%200003",
        "recipe=&cmm=CMM%202",
        "recipe=&wheel=R%2018.000%20mm",
        "recipe=&probe=R%201.500%20mm",
        "recipe=&cell=SIMULATION-0003",
        "at=first",
        "recipe=&at=first",
        "recipe=mirror-1&at=first&since=2000-01-01",
    ];
    let mut pages: Vec<String> = [
        "/",
        "/?parts=real",
        "/?parts=simulated",
        "/parts",
        "/parts?serial=SIMULATION-0000",
        &format!("/parts?after={run}"),
        &format!("/runs/{run}"),
        &format!("/maps?run={run}"),
        "/run?cell=SIMULATION-0003&name=none",
    ]
    .map(str::to_owned)
    .into();
    for selection in selections {
        for parts in ["", "&parts=real", "&parts=simulated"] {
            for page in ["/trend", "/cells", "/export.csv", "/trend.dfq"] {
                pages.push(format!("{page}?{selection}{parts}"));
            }
        }
    }
    for path in &pages {
        let status = shown.visitor.get(path).status;
        assert!([200, 303, 404].contains(&status), "{path}: {status}");
    }
    let log = plant.postgres.log()[before..].to_owned();
    assert!(log.matches("Query Text").count() > pages.len(), "the plans are in the log");
    // One cell after the other: its runs on a wheel are not sought among those of all cells.
    assert!(!log.contains("BitmapAnd"), "two indexes at once");
    for table in ["run r", "run", "cycle y", "record", "run_artefact", "artefact", "work w", "work w_1", "work_step s"]
    {
        let scan = format!("Seq Scan on {table} ");
        let plan = log.split("Query Text").find(|plan| plan.contains(&scan));
        assert!(plan.is_none(), "{}", plan.unwrap());
    }
}
