//! The report of a run, compared with its result and its record: the end, the cycles, the alarms and the orders.

use std::fs;
use std::path::{Path, PathBuf};

use crate::program::{Running, only_run, records_with, regrind, root, run, small_recipe};
use regrind::cell::{
    Actor, AlarmId, Command, Ending, Event, Figures, GateFailure, GateResult, Judgement, Phase, State, Tolerance,
    Verdict, sample_events,
};
use regrind::formats::read_error_map;
use regrind::journal::{Entry, Header, Journal, Reader, RecordKind};
use regrind::report::{ReportOptions, run_report, write_run_report};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Visible content of a report.
pub struct Page {
    html: String,
}

impl Page {
    /// Returns the report in the folder of a run, after a check that it equals the one generated from the record.
    pub fn read(folder: &Path) -> Self {
        let html = fs::read_to_string(folder.join("report.html")).unwrap();
        assert_eq!(html, run_report(folder, &ReportOptions::default()).unwrap());
        Self { html }
    }

    /// Returns the text of every element that satisfies a condition.
    fn texts(&self, will_do: impl Fn(&roxmltree::Node) -> bool) -> Vec<String> {
        let document = roxmltree::Document::parse(self.html.strip_prefix("<!DOCTYPE html>\n").unwrap()).unwrap();
        document.descendants().filter(will_do).map(text_of).collect()
    }

    /// Returns how the run ended, and true if the report shows that as good.
    pub fn verdict(&self) -> (String, bool) {
        let [good, bad] = ["good", "bad"].map(|class| {
            let found = self.texts(|node| node.has_tag_name("p") && node.attribute("class") == Some(class));
            found.into_iter().next()
        });
        let is_good = good.is_some();
        (good.or(bad).expect("a verdict"), is_good)
    }

    /// Returns the rows of a table, cell by cell, without its head.
    pub fn rows(&self, table: &str) -> Vec<Vec<String>> {
        let document = roxmltree::Document::parse(self.html.strip_prefix("<!DOCTYPE html>\n").unwrap()).unwrap();
        let table =
            document.descendants().find(|node| node.has_tag_name("table") && node.attribute("id") == Some(table));
        let rows = table.into_iter().flat_map(|table| table.descendants().filter(|node| node.has_tag_name("tr")));
        let cells = |row: roxmltree::Node| row.children().filter(|node| node.has_tag_name("td")).map(text_of).collect();
        rows.map(cells).filter(|cells: &Vec<String>| !cells.is_empty()).collect()
    }

    /// Returns the measurements of the cycles: number, verdict, figures and reason.
    fn cycles(&self) -> Vec<Vec<String>> {
        self.rows("cycles").chunks(2).map(<[Vec<String>]>::concat).collect()
    }

    pub fn says(&self, words: &str) -> bool {
        self.texts(|node| node.has_tag_name("body"))[0].contains(words)
    }
}

fn text_of(node: roxmltree::Node) -> String {
    node.descendants().filter(|node| node.is_text()).filter_map(|node| node.text()).collect()
}

pub fn json_in(folder: &Path, name: &str) -> Value {
    serde_json::from_slice(&fs::read(folder.join(name)).unwrap()).unwrap()
}

pub fn the_run(home: &Path) -> PathBuf {
    only_run(&home.join("runs"))
}

pub fn arguments(recipe: &Path) -> Vec<String> {
    let cell = root().join("config/sim.toml").display().to_string();
    let fixed = ["--cell", &cell, "--runs", "runs", "--part", "SN 12", "--operator", "Ada"].map(str::to_owned);
    ["run".to_owned(), recipe.display().to_string()].into_iter().chain(fixed).collect()
}

/// Starts a run that grinds so slowly that it still grinds when the test ends.
fn grinding(home: &Path) -> (Running, PathBuf) {
    let arguments = arguments(&small_recipe(home, 100.0));
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let mut running = Running::new(regrind(&arguments, home));
    let folder = running.folder(home);
    running.line("grinding", |line| line.contains("grinding"));
    (running, folder)
}

/// Returns the words of each record of a run, as `audit show` prints them, with the kinds.
fn shown(folder: &Path) -> Vec<(String, String)> {
    let (code, out, errors) = run(&["audit", "show", folder.to_str().unwrap()], folder);
    assert_eq!(code, 0, "{errors}");
    let row = |line: &str| {
        let kind = line.split_whitespace().find(|word| word.parse::<RecordKind>().is_ok())?.to_owned();
        Some((kind, line.to_owned()))
    };
    out.lines().skip(2).filter_map(row).collect()
}

/// The pictures of a map name the part, the cycle, the sign, the unit and the extremes, and are marked as a simulation.
fn map_pictures_can_stand_alone(folder: &Path, last: usize) {
    let svg = fs::read_to_string(folder.join(format!("cycle-{last}/error_map.svg"))).unwrap();
    let [low, high] = read_error_map(&folder.join(format!("cycle-{last}/error_map.csv"))).unwrap().iter().fold(
        [f64::INFINITY, f64::NEG_INFINITY],
        |[low, high], node| {
            let [.., error_mm] = node.error();
            [low.min(error_mm), high.max(error_mm)]
        },
    );
    let three_digits = |um: f64| format!("{um:.*}", if um < 1.0 { 3 } else { 2 - usize::from(um >= 10.0) });
    let extremes = [format!(">\u{2212}{}<", three_digits(-1e3 * low)), format!(">+{}<", three_digits(1e3 * high))];
    let title = format!(">Error of form, cycle {last}<");
    let words = [
        &title,
        "free-form mirror, serial SN 12<",
        "Red stands proud",
        "deviation / \u{b5}m",
        "x / mm",
        ">SIMULATION<",
    ];
    for words in words.into_iter().chain(extremes.iter().map(String::as_str)) {
        assert!(svg.contains(words), "{words}: {svg}");
    }
    // The picture in pixels is the same one: its header has the width and height.
    let png = fs::read(folder.join(format!("cycle-{last}/error_map.png"))).unwrap();
    let length = |at: usize| f64::from(u32::from_be_bytes(png[at..at + 4].try_into().unwrap()));
    let of_svg = |key: &str| svg.split(key).nth(1).unwrap().split('"').next().unwrap().parse::<f64>().unwrap();
    assert_eq!([length(16), length(20)], [" width=\"", " height=\""].map(|key| (1.5 * of_svg(key)).ceil()));
}

#[test]
fn report_of_accepted_run_matches_result() {
    let home = tempfile::tempdir().unwrap();
    let arguments = arguments(&small_recipe(home.path(), 1e4));
    let (code, out, errors) = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), home.path());
    assert_eq!(code, 0, "{out}{errors}");
    let folder = the_run(home.path());
    let page = Page::read(&folder);
    let result = json_in(&folder, "result.json");
    let reason = result["ending"]["reason"].as_str().unwrap();
    assert_eq!(page.verdict(), (format!("ACCEPTED: {reason}"), true));
    let (rows, cycles) = (page.cycles(), result["cycles"].as_array().unwrap());
    assert_eq!(rows.len(), cycles.len(), "{rows:?}");
    for (row, cycle) in rows.iter().zip(cycles) {
        let number = &cycle["cycle"];
        let of_cycle = json_in(&folder, &format!("cycle-{number}/result.json"));
        let row = row.join("|");
        assert!(row.starts_with(&format!("{number}|")), "{row}");
        let verdict = match of_cycle["verdict"].as_str().unwrap() {
            "continue" => "correct again".to_owned(),
            verdict => verdict.replace('_', " "),
        };
        let form = |key: &str| 1e3 * of_cycle["figures"]["form"]["pv_robust"][key].as_f64().unwrap();
        let expanded = format!("{:.2}", 0.5 * (form("high_mm") - form("low_mm")));
        for words in [&format!("{:.2}", form("median_mm")), &expanded, &verdict, of_cycle["reason"].as_str().unwrap()] {
            assert!(row.contains(words), "{words}: {row}");
        }
    }
    assert!(page.says("No alarm was raised."));
    map_pictures_can_stand_alone(&folder, cycles.len());
    means_registration_and_signatures(&page, &folder, cycles.len());
    let orders = page.rows("orders");
    assert!(orders[0][1].starts_with("Ada at ") && orders[0][2] == "start", "{orders:?}");
    let shown = shown(&folder);
    for (kind, words) in &shown {
        assert!(!words.contains('{'), "a {kind} is raw: {words}");
    }
    assert!(shown.iter().any(|(kind, _)| kind == "note"), "{shown:#?}");
    maps_are_drawn(&page, cycles.len());
    let said = |words: &str| shown.iter().any(|(kind, row)| kind == "note" && row.contains(words));
    for words in ["judged, continue: ", "judged, accept: ", &format!("finish, ACCEPTED: {reason}")] {
        assert!(said(words), "{words}: {shown:#?}");
    }
}

/// Checks the equipment, the quality of the registration, and the fields for signatures.
fn means_registration_and_signatures(page: &Page, folder: &Path, cycles: usize) {
    let cells = |table: &str| page.rows(table).into_iter().map(|row| row.join("|")).collect::<Vec<_>>();
    let means = cells("means");
    for (row, name) in means.iter().zip(["SIMULATED CMM 1, ", "SIMULATED GRINDER 1, "]) {
        assert!(row.starts_with(name) && row.contains("127.0.0.1:"), "{means:?}");
    }
    assert!(means[2].starts_with("radius 12.5000 mm") && means[2].contains("grinder"), "{means:?}");
    let found = json_in(folder, &format!("cycle-{cycles}/registration.json"));
    let radius = format!("radius {:.5} mm", found["probe_radius_mm"].as_f64().unwrap());
    assert!(means[3].starts_with(&radius), "{means:?}");
    for piece in ["reference sphere", &format!("cycle {cycles}: ")] {
        assert!(means[3].contains(piece), "{piece}: {means:?}");
    }
    let strategy = "192 targets, all are touched; 25 points on the reference sphere; speed towards a target 5.00 mm/s; approach distance 2.00 mm";
    assert_eq!(means[4], strategy);
    assert!(means[5].ends_with(" \u{b0}C"), "{means:?}");
    assert!(page.texts(|node| node.attribute("id") == Some("zernike")).is_empty(), "a rectangle is not round");
    let registration = cells("registration");
    let used = format!("{} / {} points used", found["used"], found["points"]);
    assert!(registration[0].contains("converged, ") && registration[0].contains(&used), "{registration:?}");
    let x = 1e3 * found["standard_uncertainty"]["x_mm"].as_f64().unwrap();
    assert!(registration[1].starts_with(&format!("shift along x, y, z: {x:.2} \u{b5}m; ")), "{registration:?}");
    let fields = page.texts(|node| node.attribute("id") == Some("signatures")).concat();
    for field in ["recipe approved by", "made by", "checked by", "released by"] {
        assert!(fields.contains(field), "{field}: {fields}");
    }
}

/// Checks that the last map is drawn on the scale of the tolerance and on its own, and the first map on its own, each with
/// axes, its extremes and its scale in words; and that the sections, the convergence and the distribution are drawn.
fn maps_are_drawn(page: &Page, cycles: usize) {
    let figures = page.texts(|node| node.has_tag_name("figure"));
    let (maps, charts): (Vec<_>, Vec<_>) = figures.into_iter().partition(|figure| figure.contains("scale"));
    assert_eq!((maps.len(), charts.len()), (3, 4), "{charts:?}");
    let scales = [(cycles, "scale of the tolerance"), (cycles, "own scale"), (1, "scale of this map")];
    for (figure, (cycle, scale)) in maps.iter().zip(scales) {
        for words in [&format!("Cycle {cycle}, {scale}."), "mm", "\u{b5}m", "+"] {
            assert!(figure.contains(words), "{words}: {figure}");
        }
    }
    for (figure, words) in
        charts.iter().zip(["along x, at y", "along y, at x", "Convergence", "Distribution of the error"])
    {
        assert!(figure.contains(words), "{words}: {figure}");
    }
    assert!(charts[2].contains("RMS limit 1.00") && charts[3].contains(" nodes"), "{charts:?}");
}

#[test]
fn report_shows_figures_with_limits() {
    let home = tempfile::tempdir().unwrap();
    let arguments = arguments(&small_recipe(home.path(), 1e4));
    let (code, out, errors) = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), home.path());
    assert_eq!(code, 0, "{out}{errors}");
    let folder = the_run(home.path());
    let page = Page::read(&folder);
    let last = json_in(&folder, "result.json")["ending"]["cycle"].clone();
    let figures = json_in(&folder, &format!("cycle-{last}/result.json"))["figures"].clone();
    let um = |key: &str| 1e3 * figures[key].as_f64().unwrap();
    let judged = page.rows("judged");
    let form = |figure: &str| {
        ["median_mm", "low_mm", "high_mm"].map(|key| 1e3 * figures["form"][figure][key].as_f64().unwrap())
    };
    let expected = [("PV 99.8 %", form("pv_robust"), 7.0), ("RMS", form("rms"), 1.0)];
    assert_eq!(judged.len(), 2, "{judged:?}");
    for (row, (name, [found, low, high], limit)) in judged.iter().zip(expected) {
        assert!(row[0].starts_with(name), "{row:?}");
        let (expanded, between) = (format!("\u{b1} {:.2}", 0.5 * (high - low)), format!("{low:.2} \u{2026} {high:.2}"));
        assert_eq!(row[1..5], [format!("{found:.2}"), expanded, between, format!("{limit:.2}")], "{row:?}");
        assert!(row[6].starts_with("> 9") && row[6].ends_with(" %"), "{row:?}");
        assert!(row[7].contains("within the limit") && row[7].contains(&format!("at most {high:.2}")), "{row:?}");
    }
    let large = page.texts(|node| node.attribute("class") == Some("n big"));
    let medians = ["pv_robust", "rms"].map(|figure| format!("{:.2}", form(figure)[0]));
    assert_eq!(large, medians, "one figure of each judges");
    assert_eq!(page.texts(|node| node.has_tag_name("strong")), ["ACCEPTED"]);
    assert!(page.says("ISO 14253-1"));
    // Estimated figures of the form, each next to the raw figure.
    let told = json_in(&folder, &format!("cycle-{last}/figures.json"))["form"].clone();
    let rows = page.rows("told");
    assert_eq!(rows.len(), told.as_array().unwrap().len());
    assert!(rows.len() == 12, "{rows:?}");
    for (row, told) in rows.iter().zip(told.as_array().unwrap()) {
        assert_eq!(row[0], told["name"].as_str().unwrap());
        assert!(row[row.len() - 4].contains(" \u{2026} "), "{row:?}");
        let [low, median, high] = ["low", "median", "high"].map(|key| told[key].as_f64().unwrap());
        assert!(low <= median && median <= high && told["raw"].is_number(), "{told}");
    }
    // Figures with the same name have the same value everywhere.
    let points = json_in(&folder, &format!("cycle-{last}/figures.json"))["figures"].clone();
    let named = |name: &str| points.as_array().unwrap().iter().find(|row| row["name"] == name).unwrap().clone();
    for (name, key) in [("PV 99.8 %", "pv_robust_mm"), ("PV", "pv_mm"), ("RMS", "rms_mm")] {
        let name = &format!("{name} of the points");
        let value = named(name)["value"].as_f64().unwrap();
        assert!((value / um(key) - 1.0).abs() < 1e-9, "{name}: {value} beside {}", um(key));
    }
    for name in [
        "PV of the points",
        "PVr",
        "PV 99.8 % of the points",
        "RMS of the points",
        "highest (stock left)",
        "lowest (undercut)",
    ] {
        assert!(!named(name)["made"].as_str().unwrap().is_empty(), "{name} does not say what it is");
    }
}

#[test]
fn report_of_stopped_run() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    running.signal("TERM");
    assert_eq!(running.end().0, 1);
    let page = Page::read(&folder);
    let ending = json_in(&folder, "result.json")["ending"].clone();
    assert_eq!(ending["ending"], "stopped");
    assert_eq!(page.verdict(), (format!("STOPPED: {}", ending["reason"].as_str().unwrap()), false));
    let orders = page.rows("orders");
    let stop = orders.last().unwrap();
    assert!(stop[1].starts_with("Ada at ") && stop[2] == "stop, SIGTERM" && stop[3] == "accepted", "{orders:?}");
    let cycles = page.cycles();
    assert!(cycles.len() == 1 && cycles[0].join("|").contains("not measured"), "{cycles:?}");
    // The amount ground is the last value that the grinder reported.
    let mut told = records_with(&folder, "done").into_iter().filter(|event| event["event"] == "progressed");
    let last = told.rfind(|event| event["device"] == "grinder").expect("a pass that moves tells how far it is");
    let share = 100.0 * last["done"].as_f64().unwrap() / last["total"].as_f64().unwrap();
    for piece in ["The pass was stopped (cycle 1)", &format!(" {share:.0} % of the path")] {
        assert!(page.says(piece), "{piece}: {last}");
    }
}

#[test]
fn report_of_aborted_run() {
    let home = tempfile::tempdir().unwrap();
    let (mut running, folder) = grinding(home.path());
    let path = folder.to_str().unwrap();
    let (code, out, refused) = run(&["resume", path, "--reason", "too early"], home.path());
    assert_eq!(code, 3, "{out}{refused}");
    let (code, out, errors) = run(&["abort", path, "--reason", "smoke"], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    assert_eq!(running.end().0, 3);
    // The terminal of the run shows the refusal, and does not show that the cell went on.
    let said = running.output_lines.join("\n");
    assert!(said.contains("refused: ") && said.contains("ABORT ") && !said.contains("RESUME "), "{said}");
    let page = Page::read(&folder);
    let ending = json_in(&folder, "result.json")["ending"].clone();
    assert_eq!((&ending["ending"], &ending["confirmed"]), (&json!("aborted"), &json!(true)));
    assert_eq!(page.verdict(), (format!("ABORTED: {}", ending["reason"].as_str().unwrap()), false));
    let orders = page.rows("orders");
    let [.., resume, abort] = orders.as_slice() else { panic!("{orders:?}") };
    assert!(resume[2] == "resume, too early" && resume[3].starts_with("refused: "), "{orders:?}");
    assert!(abort[2] == "abort, smoke" && abort[3] == "accepted", "{orders:?}");
}

/// Record that this test writes as a drive writes it: events, commands with an answer as intents, and all others as
/// notes.
pub struct RecordWriter {
    home: TempDir,
    journal: Journal,
    at: u64,
}

impl RecordWriter {
    pub fn new(content: Value) -> Self {
        let home = tempfile::tempdir().unwrap();
        let header = Header {
            run: "mirror-1".into(),
            part: "SN 7".into(),
            actor: "Ada".into(),
            station: "console".into(),
            simulation: false,
            first_command_id: 1,
            content,
        };
        let journal = Journal::create(home.path().join("runs/mirror-1"), header).unwrap();
        Self { home, journal, at: 0 }
    }

    pub fn entry(&mut self, kind: RecordKind, payload: Value) -> Entry {
        self.at += 1;
        Entry::new(kind, self.at, 1, payload)
    }

    pub fn event(&mut self, event: Event) {
        let (actor, station) = event.origin();
        let entry = self.entry(RecordKind::Event, serde_json::to_value(event).unwrap());
        self.journal.append(Entry { actor, station, ..entry }).unwrap();
    }

    pub fn command(&mut self, command: Command) {
        let entry = self.entry(RecordKind::Note, serde_json::to_value(command).unwrap());
        self.journal.append(entry).unwrap();
    }

    pub fn note(&mut self, payload: Value) {
        let entry = self.entry(RecordKind::Note, payload);
        self.journal.append(entry).unwrap();
    }

    pub fn ended(self, ending: &Ending) -> (TempDir, PathBuf) {
        let Self { home, journal, at } = self;
        let folder = journal.folder().to_owned();
        journal.close(at, 1, json!({ "simulation": false, "ending": ending, "cycles": [] })).unwrap();
        write_run_report(&folder, &regrind::report::ReportOptions::default()).unwrap();
        (home, folder)
    }
}

pub fn ada() -> Actor {
    Actor { name: "Ada".into(), station: "console".into() }
}

/// Returns an alarm as the cell raises it.
fn raised(id: &str, what: &str) -> Command {
    let alarm = json!({ "command": "raise", "id": id, "what": what, "consequence": "The cell is held.",
        "remedy": ["Look at it.", "Resume."], "clears": "operator" });
    serde_json::from_value(alarm).unwrap()
}

pub fn aborted() -> Ending {
    Ending::Aborted { cycle: 1, confirmed: false, reason: "smoke".into() }
}

#[test]
fn report_lists_alarms_with_times() {
    let mut written = RecordWriter::new(Value::Null);
    written.event(Event::Start { actor: ada() });
    written.command(raised("link_lost", "The link to a machine is lost: grinder."));
    written.command(Command::Withdraw { alarm: AlarmId::LinkLost });
    written.command(raised("link_lost", "The link to a machine is lost: CMM."));
    written.command(raised("machine_fault", "A machine is in fault: grinder."));
    written.command(Command::Withdraw { alarm: AlarmId::LinkLost });
    written.command(Command::Finish(aborted()));
    let (_home, folder) = written.ended(&aborted());
    let page = Page::read(&folder);
    let alarms = page.rows("alarms");
    let [grinder, of_grinder, cmm, of_cmm, fault, of_fault] = alarms.as_slice() else { panic!("{alarms:?}") };
    for (row, words) in [(of_grinder, "lost: grinder."), (of_cmm, "lost: CMM."), (of_fault, "in fault: grinder.")] {
        for piece in [words, "The cell is held.", "Look at it.", "Resume."] {
            assert!(row[0].contains(piece), "{piece}: {row:?}");
        }
    }
    let times: Vec<String> =
        Reader::open(&folder).unwrap().records(1).map(|r| r.unwrap().utc[11..19].to_owned()).collect();
    assert!(grinder[0].contains(&times[2]) && grinder[1].contains(&times[3]), "{grinder:?} {times:?}");
    assert!(cmm[1].contains(&times[6]), "{cmm:?} {times:?}");
    assert_eq!(fault[1], "not withdrawn");
    let (verdict, is_good) = page.verdict();
    assert!(verdict.starts_with("ABORTED") && !is_good, "{verdict}");
    for piece in ["standstill", "smoke"] {
        assert!(verdict.contains(piece), "{piece}: {verdict}");
    }
    let shown = shown(&folder);
    for pieces in [&["ALARM ", "in fault: grinder.", "The cell is held."][..], &["alarm withdrawn", "link lost"]] {
        let said = shown.iter().any(|(_, row)| pieces.iter().all(|piece| row.contains(piece)));
        assert!(said, "{pieces:?}: {shown:#?}");
    }
}

#[test]
fn report_of_failed_and_amended_cycles() {
    let mut written = RecordWriter::new(Value::Null);
    written.event(Event::Start { actor: ada() });
    let failed = |words: &str| GateResult::Failed(GateFailure::Coverage(words.into()));
    written.event(Event::Collected { cycle: 1, targets: 100, found: 12, gate: failed("12 % found, 95 % are needed") });
    written.event(Event::Collected { cycle: 1, targets: 100, found: 100, gate: GateResult::Passed });
    written.event(Event::Registered { cycle: 1, figures: figures() });
    let judged = |verdict, reason: &str| Command::Announce(Judgement { cycle: 1, verdict, reason: reason.into() });
    written.command(judged(Verdict::Continue, "not yet in tolerance"));
    written.command(judged(Verdict::BudgetSpent, "no material is left"));
    written.event(Event::Collected { cycle: 2, targets: 100, found: 100, gate: GateResult::Passed });
    written.event(Event::RegistrationFailed { cycle: 2, reason: "it did not converge".into() });
    let (_home, folder) = written.ended(&Ending::NotAccepted { cycle: 2, reason: "no material is left".into() });
    let page = Page::read(&folder);
    let rows: Vec<String> = page.cycles().iter().map(|row| row.join("|")).collect();
    assert_eq!(rows.len(), 3, "{rows:?}");
    assert!(rows[0].contains("12 % found, 95 %") && rows[2].contains("it did not converge"), "{rows:?}");
    let last = ["removal budget used", "no material is left", "first judged, continue", "not yet in tolerance"];
    assert!(last.iter().all(|words| rows[1].contains(words)), "{rows:?}");
    // The end is on record even if the command to finish is not.
    assert_eq!(page.verdict(), ("NOT ACCEPTED: no material is left".into(), false));
}

pub fn figures() -> Figures {
    let found = sample_events(1).into_iter().find_map(|event| match event {
        Event::Registered { figures, .. } => Some(figures),
        _ => None,
    });
    found.unwrap()
}

#[test]
fn report_shows_no_raw_record() {
    let mut written = RecordWriter::new(Value::Null);
    sample_events(1).into_iter().for_each(|event| written.event(event));
    let refused = Event::Resume { actor: ada(), reason: "go".into() };
    let state = State::Execute(Phase::Load);
    written.command(Command::Refuse { event: Box::new(refused), state, reason: "it is not held".into() });
    for command in [raised("link_lost", "Lost."), Command::Withdraw { alarm: AlarmId::LinkLost }] {
        written.command(command);
    }
    for payload in [
        json!({ "pass_record": { "path_mm": 1250.0, "removed_mm3": 12.5, "deepest_mm": 0.02, "idle_share": 0.25,
            "spindle_load": null, "wheel_radius_mm": 12.5, "temperature_c": 21.0, "duration_s": 75.0 } }),
        json!({ "transfer": { "points": 812, "seconds": 0.5, "ms_per_point": 0.616, "coordinates": "centres" } }),
        json!({ "device": "cmm", "notes": ["waits for a file", "left alone: old.csv"] }),
        json!({ "confirmed": "done", "device": "grinder", "map": "3fa9c210", "file": null }),
    ] {
        written.note(payload);
    }
    let step = written.entry(RecordKind::Intent, json!({ "recover": "CLEAR", "device": "grinder", "seen": "FAULTED" }));
    let command_id = Some(written.journal.intend(step).unwrap());
    let found = written.entry(RecordKind::Outcome, json!({ "found": "IDLE" }));
    written.journal.append(Entry { command_id, ..found }).unwrap();
    let (_home, folder) = written.ended(&aborted());
    let shown = shown(&folder);
    for (kind, words) in &shown {
        assert!(!words.contains('{') && !words.contains("  null"), "a {kind} is raw: {words}");
    }
    let lines: [&[&str]; 6] = [
        &["pass: path 1250 mm", "12.5 mm³", "20.0 µm", "25 %", "12.5000 mm", "21.0 °C", "75 s"],
        &["812 points", "0.50 s", "0.616 ms", "centres"],
        &["CMM: waits for a file", "left alone: old.csv"],
        &["grinder: done", "map 3fa9c210"],
        &["grinder: order CLEAR", "FAULTED"],
        &["answered: IDLE"],
    ];
    for pieces in lines {
        let said = shown.iter().any(|(_, row)| pieces.iter().all(|piece| row.contains(piece)));
        assert!(said, "{pieces:?}: {shown:#?}");
    }
    // A person's confirmation about a machine is an order like any other. The report shows why an order was refused.
    let orders: Vec<String> = Page::read(&folder).rows("orders").iter().map(|row| row.join("|")).collect();
    for pieces in [["grinder: done", "map 3fa9c210"], ["grinder: ", "order CLEAR"]] {
        let listed = orders.iter().any(|row| pieces.iter().all(|piece| row.contains(piece)));
        assert!(listed, "{pieces:?}: {orders:#?}");
    }
}

#[test]
fn report_without_limits_invents_none() {
    let tolerance = Tolerance { pv_mm: f64::INFINITY, ..tolerance() };
    let of = |content: Value| {
        let mut written = RecordWriter::new(content);
        written.event(Event::Registered { cycle: 1, figures: figures() });
        written.ended(&aborted())
    };
    let (_home, folder) = of(json!({ "plan": { "tolerance": tolerance } }));
    let judged = Page::read(&folder).rows("judged");
    assert!(judged[0][4] == "no limit" && judged[0][6].is_empty(), "{judged:?}");
    assert!(judged[1][4] == "1.00" && !judged[1][6].is_empty(), "{judged:?}");
    let (_home, folder) = of(Value::Null);
    let page = Page::read(&folder);
    assert!(page.rows("judged").is_empty() && page.cycles().len() == 1);
}

pub fn tolerance() -> Tolerance {
    use regrind::cell::PvPoints;
    Tolerance {
        pv_mm: 0.007,
        rms_mm: 0.001,
        with_uncertainty: true,
        probability: Tolerance::DEFAULT_PROBABILITY,
        pv_points: PvPoints::MostPoints,
    }
}

/// The report in each language: its texts and numbers are in the language, and `audit verify` knows it as unchanged.
#[test]
fn report_in_every_language() {
    let home = tempfile::tempdir().unwrap();
    let arguments = arguments(&small_recipe(home.path(), 1e4));
    let (code, out, errors) = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), home.path());
    assert_eq!(code, 0, "{out}{errors}");
    let folder = the_run(home.path());
    let path = folder.to_str().unwrap();
    for (language, words) in [
        (
            "de",
            [
                "ANGENOMMEN",
                "Beurteilte Kenngrößen",
                "Schnitte durch die Extremwerte",
                "7,00",
                "counter(page) \" von \"",
            ],
        ),
        ("zh", ["合格", "判定的指标", "经过极值的截面", "7.00", "counter(page) \" / \""]),
        ("en", ["ACCEPTED", "Judged figures", "Sections through the extremes", "7.00", "counter(page) \" of \""]),
    ] {
        assert_eq!(run(&["report", path, "--language", language], home.path()).0, 0);
        let html = fs::read_to_string(folder.join("report.html")).unwrap();
        roxmltree::Document::parse(html.strip_prefix("<!DOCTYPE html>\n").unwrap()).unwrap();
        for piece in words {
            assert!(html.contains(piece), "{language}: {piece}");
        }
        let (code, said, _) = run(&["audit", "verify", path], home.path());
        assert!(code == 0 && !said.contains("report.html"), "{said}");
        // No figure of ISO 10110 and no hash of a key breaks within itself.
        assert!(html.contains("<code class=\"whole\">3/"), "{language}");
    }
    let (code, _, errors) = run(&["report", path, "--language", "fr"], home.path());
    assert!(code == 2 && errors.contains("en, de, zh"), "{errors}");
}

/// A header of a shop: in the report with its logo and its fields, and known by `audit verify`. A bad one is refused with
/// its reason, and leaves the report as it was.
#[test]
fn report_with_header_of_shop() {
    let home = tempfile::tempdir().unwrap();
    let arguments = arguments(&small_recipe(home.path(), 1e4));
    let (code, out, errors) = run(&arguments.iter().map(String::as_str).collect::<Vec<_>>(), home.path());
    assert_eq!(code, 0, "{out}{errors}");
    let folder = the_run(home.path());
    let path = folder.to_str().unwrap();
    let write = |text: &str| fs::write(home.path().join("shop.toml"), text).unwrap();
    let report = || run(&["report", path, "--header", "shop.toml"], home.path());
    fs::write(home.path().join("logo.svg"), "<svg xmlns='http://www.w3.org/2000/svg'/>").unwrap();
    let good = "name = \"Optics <&> Co\"\naddress = [\"1 Lens Lane\"]\nlogo = \"logo.svg\"\n[[fields]]\nname = \"Order\"\ntext = \"4711\"\n";
    write(good);
    assert_eq!(report().0, 0);
    let html = fs::read_to_string(folder.join("report.html")).unwrap();
    roxmltree::Document::parse(html.strip_prefix("<!DOCTYPE html>\n").unwrap()).unwrap();
    for piece in ["Optics &lt;&amp;&gt; Co", "1 Lens Lane", "data:image/svg+xml;base64,", "<th>Order</th><td>4711</td>"]
    {
        assert!(html.contains(piece), "{piece}");
    }
    let verify = || run(&["audit", "verify", path], home.path());
    // The header is in the report alone, and is named as such.
    let (code, said, _) = verify();
    assert!(
        code == 0 && said.contains("header      of report.html: Optics <&> Co") && !said.contains("differs"),
        "{said}"
    );
    // Another number of the order is another report.
    fs::write(folder.join("report.html"), html.replace("<td>4711</td>", "<td>4712</td>")).unwrap();
    assert!(verify().1.contains("report.html differs"), "{:?}", verify());
    for (bad, words) in [
        ("nam = \"a\"", "unknown field"),
        ("name = \"\"", "1 to 200"),
        ("name = \"a\"\nlogo = \"shop.toml\"", "the logo shop.toml"),
        ("name = \"a\"\nlogo = \"nothing.png\"", "nothing.png"),
    ] {
        write(bad);
        let (code, _, errors) = report();
        assert!(code == 2 && errors.contains(words), "{bad}: {errors}");
    }
    assert!(fs::read_to_string(folder.join("report.html")).unwrap().contains("<td>4712</td>"), "left as it was");
}
