//! The workbench: who may use it, what it finds in a text, what it saves, and what it simulates.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use regrind_testcell::browser::{Browser, Tab};
use regrind_testcell::http::{Answer, Visitor};
use regrind_testutils::sample::all;
use serde_json::{Value, json};

use crate::program::{PATIENCE, Running, regrind, replaced, run, run_folders, small_recipe};
use crate::{serve_with, users};

/// Begins a page with a folder of recipes, in which there is a small one.
fn begin(home: &Path, more: &[&str]) -> (Running, String) {
    let recipes = home.join("recipes");
    std::fs::create_dir_all(&recipes).unwrap();
    small_recipe(&recipes, 1e4);
    serve_with(home, &[&["--listen", "127.0.0.1:0", "--recipes", "recipes"], more].concat())
}

fn small_text(home: &Path) -> String {
    std::fs::read_to_string(home.join("recipes/small.toml")).unwrap()
}

fn draft(visitor: &Visitor, name: &str, text: &str) -> Vec<Value> {
    let answer = visitor.post(&format!("/recipes/{name}/draft"), &[("Origin", &visitor.origin())], text.as_bytes());
    assert_eq!(answer.status, 200, "{answer:?}");
    unchunked(&answer).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Returns the body of an answer that comes in pieces.
fn unchunked(answer: &Answer) -> String {
    if answer.header("transfer-encoding").is_empty() {
        return answer.text();
    }
    let (mut text, mut rest) = (Vec::new(), &answer.body[..]);
    loop {
        let end = rest.windows(2).position(|two| two == b"\r\n").unwrap();
        let length = usize::from_str_radix(std::str::from_utf8(&rest[..end]).unwrap(), 16).unwrap();
        if length == 0 {
            return String::from_utf8(text).unwrap();
        }
        text.extend(&rest[end + 2..end + 2 + length]);
        rest = &rest[end + 4 + length..];
    }
}

pub(crate) fn post(visitor: &Visitor, path: &str, body: &Value) -> (u16, Value) {
    let (origin, token) = (visitor.origin(), visitor.token());
    let answer = visitor.post(path, &[("Origin", &origin), ("X-Regrind-Token", &token)], body.to_string().as_bytes());
    (answer.status, serde_json::from_slice(&answer.body).unwrap_or(Value::Null))
}

#[test]
fn draft_tells_problems_plan_and_shape() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let visitor = Visitor::with_key(&url);
    let text = small_text(home.path());
    let told = draft(&visitor, "small.toml", &text);
    let kinds: Vec<&str> = told.iter().map(|line| line["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["checked", "planned", "shape"]);
    assert_eq!(told[0]["problems"], json!([]));
    assert_eq!(told[1]["plan"]["targets"], 16 * 12);
    let shape = &told[2];
    let [columns, rows] = ["columns", "rows"].map(|key| shape[key].as_u64().unwrap() as usize);
    assert_eq!(shape["heights_mm"].as_array().unwrap().len(), columns * rows);
    assert_eq!(shape["scallops_nm"].as_array().unwrap().len(), columns * rows);
    assert_eq!(shape["targets_mm"].as_array().unwrap().len(), 16 * 12);
    // The heights at the corners are those of the formula, which the recipe states.
    let of_formula = |x: f64, y: f64| {
        let [u, v] = [x / 50.0, y / 50.0];
        2.1 * u - 1.4 * v + 10.5 * u * u + 2.4 * u * v - 13.3 * v * v + 2.6 * u.powi(3) - 3.5 * u * u * v
            + 3.0 * u * v * v
            + 1.6 * v.powi(3)
            - 1.7 * u.powi(4)
            + 1.2 * u.powi(3) * v
            + 1.6 * u * u * v * v
            - 1.4 * u * v.powi(3)
            + 1.2 * v.powi(4)
    };
    for (k, at) in [(0, [-51.0, -31.0]), (columns - 1, [51.0, -31.0]), (columns * rows - 1, [51.0, 31.0])] {
        let found = shape["heights_mm"][k].as_f64().unwrap();
        assert!((found - of_formula(at[0], at[1])).abs() < 1e-4, "{at:?}: {found}");
    }
    // A wrong key and a wrong unit, each with its line.
    let wrong =
        text.replace("track_mm = 0.24", "trak_mm = 0.24").replace("probe_radius_mm = 1.5", "probe_radius_mm = 1500");
    let told = draft(&visitor, "small.toml", &wrong);
    assert_eq!(told.len(), 1, "{told:?}");
    let line_of = |words: &str| wrong.lines().position(|line| line.starts_with(words)).unwrap() + 1;
    let problems = told[0]["problems"].as_array().unwrap();
    let found: Vec<(u64, &str)> =
        problems.iter().map(|of| (of["line"].as_u64().unwrap(), of["key"].as_str().unwrap())).collect();
    let expected = [
        (line_of("probe_radius_mm") as u64, "measure.probe_radius_mm"),
        (line_of("trak_mm") as u64, "grinding.trak_mm"),
    ];
    assert_eq!(found, expected, "{problems:?}");
    assert!(problems[1]["remedy"].as_str().unwrap().contains("track_mm"), "{problems:?}");
    // A text that is no recipe at all, and one that the cell cannot make.
    assert_eq!(draft(&visitor, "small.toml", "")[0]["kind"], "checked");
    let too_fast = text.replace("feed_mm_min = 1000.0", "feed_mm_min = 50000.0");
    let told = draft(&visitor, "small.toml", &too_fast);
    assert_eq!(told[1]["kind"], "refused", "{told:?}");
    assert!(told[1]["reason"].as_str().unwrap().contains("grinding.feed_mm_min"), "{told:?}");
    assert_eq!(small_text(home.path()), text, "a draft changes no file");
}

/// A cell file with a problem is told in place of the plan.
#[test]
fn draft_for_broken_cell_tells_reason() {
    let home = tempfile::tempdir().unwrap();
    std::fs::write(home.path().join("cell.toml"), "[cell]\nnonsense = 1\n").unwrap();
    let (_page, url) = begin(home.path(), &["--cell", "cell.toml"]);
    let told = draft(&Visitor::with_key(&url), "small.toml", &small_text(home.path()));
    let kinds: Vec<&str> = told.iter().map(|line| line["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["checked", "refused"]);
    assert!(told[1]["reason"].as_str().unwrap().contains("nonsense"), "{told:?}");
}

/// A problem of a file quotes the file, so a text from a browser names only files beside the recipe.
#[test]
fn draft_reads_no_file_elsewhere() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    std::fs::write(home.path().join("secret.csv"), "password-of-the-shop\n").unwrap();
    std::os::unix::fs::symlink("../secret.csv", home.path().join("recipes/link.csv")).unwrap();
    std::fs::write(home.path().join("recipes/own.csv"), "not-a-number\n").unwrap();
    let visitor = Visitor::with_key(&url);
    let begin = "[part]\nname = \"a\"\n[nominal]\nfile = ";
    let rest = small_text(home.path());
    let rest = &rest[rest.find("[measure]").unwrap()..];
    let absolute = home.path().join("secret.csv").display().to_string();
    for (file, is_read) in [("own.csv", true), ("../secret.csv", false), (&absolute[..], false), ("link.csv", false)] {
        let told = draft(&visitor, "small.toml", &format!("{begin}\"{file}\"\n{rest}"));
        let problems = told[0]["problems"].to_string();
        assert!(problems.contains("nominal.file") && !problems.contains("password"), "{file}: {problems}");
        assert_eq!(problems.contains("not-a-number"), is_read, "{file}: {problems}");
    }
}

#[test]
fn saved_text_is_file_and_version() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let visitor = Visitor::with_key(&url);
    let text = small_text(home.path());
    let next = text.replace("rows = 12", "rows = 13");
    let (status, saved) = post(&visitor, "/recipes/small.toml/save", &json!({ "text": next, "replaces": text }));
    // Version 1 is the text that was in the file before.
    assert_eq!((status, &saved["version"]), (200, &json!(2)), "{saved}");
    assert_eq!(small_text(home.path()), next);
    assert_eq!(visitor.get("/recipes/small.toml/versions/1").text(), text);
    let versions: Value = serde_json::from_slice(&visitor.get("/recipes/small.toml/versions").body).unwrap();
    assert_eq!(versions.as_array().unwrap().len(), 2);
    // Another program changes the file, and the page does not overwrite it.
    std::fs::write(home.path().join("recipes/small.toml"), format!("{next}# by hand\n")).unwrap();
    let (status, said) = post(&visitor, "/recipes/small.toml/save", &json!({ "text": text, "replaces": next }));
    assert_eq!(status, 409, "{said}");
    assert!(small_text(home.path()).ends_with("# by hand\n"));
    // A new recipe, and names that lead elsewhere.
    let (status, _) = post(&visitor, "/recipes/new%20part.toml/save", &json!({ "text": text, "replaces": null }));
    assert_eq!(status, 200);
    assert_eq!(run(&["check", "recipes/new part.toml"], home.path()).0, 0);
    for name in ["..%2Fx.toml", "%2e%2e%2fx.toml", ".hidden.toml", "x.txt", "a%00.toml"] {
        let (status, said) =
            post(&visitor, &format!("/recipes/{name}/save"), &json!({ "text": text, "replaces": null }));
        assert_eq!(status, 400, "{name}: {said}");
        assert_eq!(visitor.get(&format!("/recipes/{name}/text")).status, 404, "{name}");
    }
    assert!(!home.path().join("x.toml").exists());
}

#[test]
fn only_engineers_use_workbench() {
    let home = tempfile::tempdir().unwrap();
    for role in ["operator", "engineer"] {
        assert_eq!(users::add(home.path(), role, role, users::PASSWORD).0, 0);
    }
    let (_page, url) = begin(home.path(), &["--users", "users.toml"]);
    let text = small_text(home.path());
    let operator = Visitor::signed_in(&url, "operator", users::PASSWORD).unwrap();
    let engineer = Visitor::signed_in(&url, "engineer", users::PASSWORD).unwrap();
    let stranger = Visitor::stranger(&url);
    let save = json!({ "text": format!("{text}#\n"), "replaces": text });
    for path in
        ["/recipes/small.toml/save", "/recipes/small.toml/simulation", "/recipes/small.toml/simulation/end?id=1"]
    {
        assert_eq!(post(&operator, path, &save).0, 403, "{path}");
        assert_eq!(stranger.post(path, &[("Origin", &stranger.origin())], b"{}").status, 401, "{path}");
        // Without a token, or from another page, even an engineer changes nothing.
        assert_eq!(engineer.post(path, &[("Origin", &engineer.origin())], save.to_string().as_bytes()).status, 403);
        let token = engineer.token();
        let headers = [("Origin", "http://elsewhere.example"), ("X-Regrind-Token", &token[..])];
        assert_eq!(engineer.post(path, &headers, save.to_string().as_bytes()).status, 403, "{path}");
    }
    let path = "/recipes/small.toml/draft";
    assert_eq!(operator.post(path, &[("Origin", &operator.origin())], text.as_bytes()).status, 403);
    assert_eq!(engineer.post(path, &[("Origin", "http://elsewhere.example")], text.as_bytes()).status, 403);
    for path in [
        "/recipes/small.toml/text",
        "/recipes/small.toml/versions",
        "/recipe-schema",
        "/recipes/small.toml/simulation/report?id=1",
    ] {
        assert_eq!(operator.get(path).status, 403, "{path}");
    }
    assert!(!operator.get("/recipes").text().contains("small.toml"));
    assert_eq!(small_text(home.path()), text);
    assert!(engineer.get("/recipes").text().contains("/recipes/small.toml"));
    assert_eq!(post(&engineer, "/recipes/small.toml/save", &save).0, 200);
    let versions: Value = serde_json::from_slice(&engineer.get("/recipes/small.toml/versions").body).unwrap();
    assert_eq!(versions[1]["saved_by"], "engineer");
}

/// Starts a simulation of a text. Returns its number.
pub(crate) fn simulate(visitor: &Visitor, text: &str) -> u64 {
    let (status, said) = post(visitor, "/recipes/small.toml/simulation", &json!({ "text": text, "seed": 7 }));
    assert_eq!(status, 200, "{said}");
    said["id"].as_u64().unwrap()
}

/// Returns the address of a part of a simulation.
pub(crate) fn of_simulation(part: &str, id: u64) -> String {
    format!("/recipes/small.toml/simulation/{part}?id={id}")
}

/// Reads the events of a simulation to their end. Returns the last one.
fn last_event(visitor: &Visitor, id: u64) -> Value {
    let answer = visitor.get(&of_simulation("events", id));
    assert_eq!(answer.status, 200, "{answer:?}");
    let text = unchunked(&answer);
    let last = text.lines().filter_map(|line| line.strip_prefix("data: ")).next_back().expect("an event");
    serde_json::from_str(last).unwrap()
}

#[test]
fn text_is_simulated_without_saving() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let visitor = Visitor::with_key(&url);
    let text = small_text(home.path()).replace("rows = 12", "rows = 14");
    let id = simulate(&visitor, &text);
    let last = last_event(&visitor, id);
    assert_eq!(last["isOver"], true);
    let html = last["html"].as_str().unwrap();
    assert!(html.contains("ACCEPTED") && !html.contains("NOT ACCEPTED") && html.contains("SIMULATION"), "{html}");
    let map = visitor.get(&of_simulation("map", id));
    assert!(map.status == 200 && map.body.starts_with(b"\x89PNG"), "{}", map.status);
    let report = visitor.get(&of_simulation("report", id));
    assert!(report.status == 200 && report.text().contains("SIMULATION"));
    // The runs of the cell, the file and its versions are unchanged.
    assert_eq!(std::fs::read_dir(home.path().join("runs")).unwrap().count(), 0);
    assert!(!small_text(home.path()).contains("rows = 14"));
    // A recipe that cannot run is a failure with its reason.
    let later = simulate(&visitor, &text.replace("[part]", "[pert]"));
    let last = last_event(&visitor, later);
    assert!(last["isOver"] == true && last["html"].as_str().unwrap().contains("pert"), "{last}");
    // The result of an earlier simulation is not that of a later one.
    assert_eq!(visitor.get(&of_simulation("map", id)).status, 404);
    assert_eq!(last_event(&visitor, id)["isOver"], true);
    assert_eq!(post(&visitor, &of_simulation("end", later), &json!(null)).0, 204);
    assert_eq!(visitor.get(&of_simulation("report", later)).status, 404);
}

/// A simulation that holds waits for a person who is not there: it ends with the alarm.
#[test]
fn simulation_that_holds_ends_with_its_alarm() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let visitor = Visitor::with_key(&url);
    // No pass reaches these limits, and no pass after the first improves by as much.
    let text = replaced(&small_text(home.path()), "pv_um = 7.0", "pv_um = 0.08");
    let text = replaced(&text, "rms_um = 1.0", "rms_um = 0.02");
    let text = replaced(&text, "stall_um = 0.1", "stall_um = 5.0");
    let text = replaced(&text, "on_stall = \"stop\"", "on_stall = \"hold\"");
    let last = last_event(&visitor, simulate(&visitor, &text));
    let html = last["html"].as_str().unwrap();
    assert!(last["isOver"] == true && html.contains("the cell holds"), "{html}");
}

/// A page without users knows its browsers by secrets, which no other browser gets.
#[test]
fn replaced_simulation_tells_no_secret() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let [first, second] = [(); 2].map(|()| Visitor::with_key(&url));
    assert_ne!(first.cookies, second.cookies);
    let text = std::fs::read_to_string(small_recipe(home.path(), 1.0)).unwrap();
    let [earlier, later] = [&first, &second].map(|visitor| simulate(visitor, &text));
    let last = last_event(&first, earlier);
    let html = last["html"].as_str().unwrap();
    assert!(last["isOver"] == true && html.contains("another browser"), "{html}");
    let secrets = second.cookies.split("; ").filter_map(|cookie| cookie.split_once('=')).map(|(_, secret)| secret);
    let shown = format!("{html}{}", first.get("/recipes/small.toml").text());
    for secret in secrets {
        assert!(!shown.contains(secret), "{shown}");
    }
    assert_eq!(post(&second, &of_simulation("end", later), &json!(null)).0, 204);
}

/// The list of users and the cell file can stand beside the recipes.
#[test]
fn other_files_are_not_read_or_written() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let visitor = Visitor::with_key(&url);
    let cell = "[cell]\nname = \"cell-2\"\n";
    std::fs::write(home.path().join("recipes/cell.toml"), cell).unwrap();
    assert_eq!(visitor.get("/recipes/cell.toml/text").status, 403);
    assert_eq!(visitor.get("/recipes/cell.toml").status, 403);
    let small = small_text(home.path());
    for text in ["[cell]\n", &small] {
        let task = json!({ "text": text, "replaces": cell });
        assert_ne!(post(&visitor, "/recipes/cell.toml/save", &task).0, 200);
    }
    assert_eq!(std::fs::read_to_string(home.path().join("recipes/cell.toml")).unwrap(), cell);
    // A text with a problem is not saved, whatever the browser sends.
    let wrong = small.replace("track_mm", "trak_mm");
    let (status, said) = post(&visitor, "/recipes/small.toml/save", &json!({ "text": wrong, "replaces": small }));
    assert!(status == 422 && said["message"].as_str().unwrap().contains("trak_mm"), "{status} {said}");
    assert_eq!(small_text(home.path()), small);
    // The second of two equal saves is no conflict.
    let good = small.replace("rows = 12", "rows = 13");
    let task = json!({ "text": good, "replaces": small });
    let saves: Vec<(u16, Value)> = (0..2).map(|_| post(&visitor, "/recipes/small.toml/save", &task)).collect();
    assert!(saves[0].0 == 200 && saves[0] == saves[1], "{saves:?}");
}

/// A page that is killed takes its simulation along, and the next one deletes the folder.
#[test]
fn killed_page_leaves_no_simulation() {
    let home = tempfile::tempdir().unwrap();
    let temporary = home.path().join("t");
    for folder in ["t", "recipes", "runs"] {
        std::fs::create_dir(home.path().join(folder)).unwrap();
    }
    let serve = || {
        let mut command = regrind(&["serve", "--listen", "127.0.0.1:0", "--recipes", "recipes"], home.path());
        command.env("TMPDIR", &temporary);
        let mut page = Running::new(command);
        let line = page.line("address of the page", |line| line.starts_with("page "));
        (page, line.trim_start_matches("page").trim().to_owned())
    };
    let folders = || -> Vec<PathBuf> {
        std::fs::read_dir(&temporary).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_dir()).collect()
    };
    let (mut page, url) = serve();
    let visitor = Visitor::with_key(&url);
    // At the speed of real machines it takes an hour.
    let text = std::fs::read_to_string(small_recipe(home.path(), 1.0)).unwrap();
    simulate(&visitor, &text);
    page.until("a run", |_| folders().iter().any(|folder| !run_folders(&folder.join("runs")).is_empty()).then_some(()));
    let [simulation] = page.children()[..] else { panic!("one child") };
    page.signal("KILL");
    let killed = Instant::now();
    while is_alive(simulation) {
        assert!(killed.elapsed() < PATIENCE, "the simulation goes on");
        std::thread::park_timeout(Duration::from_millis(20));
    }
    assert_eq!(folders().len(), 1);
    let (_page, _) = serve();
    assert_eq!(folders(), Vec::<PathBuf>::new());
}

/// Returns true if a process works, also if nobody has asked for its exit code yet.
fn is_alive(process: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    stat.rsplit(')').next().is_some_and(|rest| !rest.trim().is_empty() && !rest.trim().starts_with('Z'))
}

/// A cell file with a real machine is refused for a draft, so that a text from a browser moves nothing.
#[test]
fn draft_runs_on_simulated_machines_only() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e4).display().to_string();
    let cell = crate::program::root().join("config/modbus-tcp.toml").display().to_string();
    let (code, _, errors) = run(&["run", &recipe, "--draft", &recipe, "--cell", &cell], home.path());
    assert!(code == 2 && errors.contains("simulated machines only"), "{code} {errors}");
}

/// Recipe that a person writes from nothing, with a wrong key and a wrong unit. Its shape determines y poorly.
const FROM_NOTHING: &str = r#"[part]
name = "mirror"

[nominal.surface]
kind = "xy-polynomial"
normalisation_radius_mm = 50.0
terms = [[2, 0, 10.5], [1, 1, 2.4], [0, 2, -13.3], [3, 0, 2.6], [0, 3, 1.6], [4, 0, -1.7], [0, 4, 1.2]]

[nominal.aperture]
kind = "rectangle"
width_mm = 102.0
height_mm = 62.0

[nominal.sampling]
spacing_mm = 0.5

[measure]
probe_radius_mm = 1500
side = "above"
pattern = "grid"
columns = 16
rows = 12

[acceptance]
pv_um = 7.0

[compensation]
cutoff_mm = 14.0
max_correction_um = 60.0
removal_budget_um = 400.0
depth_of_cut_um = 20.0

[grinding]
feed_mm_min = 1000.0
trak_mm = 0.24
allowance_um = 20.0

[grinding.wheel]
shape = "sphere"
radius_mm = 12.5
"#;

fn editor_text(text: &str) -> String {
    format!("window.regrindOpened.editor.setText({})", json!(text))
}

const PROBLEMS: &str = "[...document.querySelector('#editor').shadowRoot.querySelectorAll('.regrind-problem')].map((of) => of.textContent)";

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn recipe_is_written_from_nothing() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&url, [1366, 768]);
    tab.until(&mut browser, "document.querySelector('nav')");
    let place = url.split("/?").next().unwrap();
    tab.send(&mut browser, "Page.navigate", json!({ "url": format!("{place}/recipes") }));
    tab.until(&mut browser, "document.querySelector('#new-recipe')");
    tab.read(&mut browser, "document.querySelector('#new-recipe input').value = 'mirror'");
    tab.click(&mut browser, "#new-recipe button");
    tab.until(
        &mut browser,
        "window.regrindOpened && document.querySelector('#problem-count').classList.contains('has-problems')",
    );
    // Keys are completed from the schema: a table is typed, and a key is chosen.
    tab.read(&mut browser, &editor_text("[measure]\n"));
    tab.read(&mut browser, "(() => { const { view } = window.regrindOpened.editor; view.dispatch({ selection: { anchor: view.state.doc.length } }); view.focus(); })()");
    tab.send(&mut browser, "Input.insertText", json!({ "text": "probe_r" }));
    tab.until(&mut browser, "document.querySelector('#editor').shadowRoot.querySelector('.cm-completionLabel')?.textContent === 'probe_radius_mm'");
    // A key is taken only some time after the list has opened; the mouse is taken at once.
    let choose = "document.querySelector('#editor').shadowRoot.querySelector('.cm-completionLabel')\
                  .dispatchEvent(new MouseEvent('mousedown', { bubbles: true }))";
    tab.read(&mut browser, choose);
    tab.until(&mut browser, "window.regrindOpened.text().includes('probe_radius_mm = ')");
    // A wrong key and a wrong unit stand below their lines before anything runs.
    tab.read(&mut browser, &editor_text(FROM_NOTHING));
    tab.until(&mut browser, &format!("{PROBLEMS}.length === 2"));
    let problems = tab.read(&mut browser, PROBLEMS);
    assert!(problems[0].as_str().unwrap().contains("measure.probe_radius_mm is 1500"), "{problems}");
    assert!(problems[1].as_str().unwrap().contains("track_mm"), "{problems}");
    assert_eq!(tab.read(&mut browser, "document.querySelector('#save').disabled"), true);
    // The repaired recipe shows its plan, its picture, and the direction that its shape does not determine.
    let good = FROM_NOTHING.replace("= 1500", "= 1.5").replace("trak_mm", "track_mm");
    tab.read(&mut browser, &editor_text(&good));
    tab.until(&mut browser, "document.querySelector('#plan .weak') && document.querySelector('#no-picture').hidden");
    let weak = tab.read(&mut browser, "document.querySelector('#plan .weak').innerText");
    assert!(weak.as_str().unwrap().contains("y position"), "{weak}");
    // It is simulated, accepted and saved.
    tab.click(&mut browser, "#simulate");
    tab.until(&mut browser, "/(^|[^ T])ACCEPTED/.test(document.querySelector('#simulation .good')?.innerText) && !document.querySelector('#last-map').hidden");
    tab.click(&mut browser, "#save");
    tab.until(&mut browser, "document.querySelector('#version').innerText.endsWith(' 1')");
    assert_eq!(std::fs::read_to_string(home.path().join("recipes/mirror.toml")).unwrap(), good);
    assert_eq!(run(&["check", "recipes/mirror.toml"], home.path()).0, 0);
    // Versions stand side by side.
    tab.read(&mut browser, &editor_text(&good.replace("rows = 12", "rows = 18")));
    tab.read(&mut browser, "(() => { const c = document.querySelector('#compared'); c.value = '1'; c.dispatchEvent(new Event('change')); })()");
    tab.until(
        &mut browser,
        "document.querySelector('#texts').shadowRoot.querySelectorAll('.cm-changedLine').length === 2",
    );
    assert_eq!(tab.problems(&browser), Vec::<String>::new());
}

/// The text of a person is neither lost nor written over the change of another program.
#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn editor_loses_no_text() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let file = home.path().join("recipes/small.toml");
    let read = || std::fs::read_to_string(&file).unwrap();
    let small = small_text(home.path());
    // As an editor on Windows writes it.
    std::fs::write(&file, small.replace('\n', "\r\n")).unwrap();
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&url, [1366, 768]);
    tab.until(&mut browser, "document.querySelector('nav')");
    let place = url.split("/?").next().unwrap();
    tab.send(&mut browser, "Page.navigate", json!({ "url": format!("{place}/recipes/small.toml") }));
    let is_good = "window.regrindOpened && !document.querySelector('#simulate').disabled";
    tab.until(&mut browser, is_good);
    // Only the line ends differ from the text in the editor: that is no change.
    assert_eq!(
        tab.read(&mut browser, "document.querySelector('#changed').hidden && document.querySelector('#save').disabled"),
        true
    );
    // Ctrl-S before the check has ended saves after it, once, with the line ends of the file.
    let keys =
        "for (let k = 0; k < 3; k++) document.dispatchEvent(new KeyboardEvent('keydown', { key: 's', ctrlKey: true }))";
    tab.read(&mut browser, &format!("{}; {keys}", editor_text(&format!("{small}# mine\n"))));
    tab.until(&mut browser, "document.querySelector('#version').innerText.endsWith(' 2')");
    assert_eq!(read(), format!("{small}# mine\n").replace('\n', "\r\n"));
    assert_eq!(tab.read(&mut browser, "document.querySelector('#said').classList.contains('no')"), false);
    // A text that the browser has kept does not overwrite what another program has written since.
    tab.read(&mut browser, &editor_text(&format!("{small}# draft\n")));
    tab.until(&mut browser, is_good);
    let other = format!("{small}# other\n");
    std::fs::write(&file, &other).unwrap();
    tab.read(&mut browser, "window.isOld = true");
    tab.send(&mut browser, "Page.reload", json!({}));
    tab.until(
        &mut browser,
        &format!("!window.isOld && {is_good} && window.regrindOpened.text().endsWith('# draft\\n')"),
    );
    tab.read(&mut browser, "document.querySelector('#said').replaceChildren()");
    tab.click(&mut browser, "#save");
    tab.until(&mut browser, "document.querySelector('#said.no')?.innerText");
    assert_eq!(read(), other);
    // After a look at both texts it is saved, and the other text is a version.
    tab.read(&mut browser, "(() => { const c = document.querySelector('#compared'); c.value = 'file'; c.dispatchEvent(new Event('change')); })()");
    tab.until(
        &mut browser,
        "document.querySelector('#texts').shadowRoot.querySelectorAll('.cm-changedLine').length === 2",
    );
    tab.click(&mut browser, "#close-comparison");
    tab.click(&mut browser, "#save");
    tab.until(&mut browser, "document.querySelector('#version').innerText.endsWith(' 4')");
    assert_eq!(read(), format!("{small}# draft\n"));
    assert_eq!(std::fs::read_to_string(home.path().join("recipes/.versions/small.toml/3.toml")).unwrap(), other);
    // The browser reports the save that was refused.
    let problems = tab.problems(&browser);
    assert!(problems.len() == 1 && problems[0].contains("409"), "{problems:?}");
}

/// Nothing is wider than the screen, in each size and theme, with problems and without.
#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn workbench_fits_every_screen() {
    let home = tempfile::tempdir().unwrap();
    let (_page, url) = begin(home.path(), &[]);
    let text = small_text(home.path());
    let sizes: &[[u32; 2]] = if all() { &[[1920, 1080], [1366, 768], [390, 844]] } else { &[[1366, 768], [390, 844]] };
    let languages: &[&str] = if all() { &["en", "de", "zh"] } else { &["de"] };
    let place = url.split("/?").next().unwrap();
    let mut browser = Browser::start(home.path());
    for size in sizes {
        let tab = browser.open(&url, *size);
        tab.until(&mut browser, "document.querySelector('nav')");
        for language in languages {
            tab.read(&mut browser, &format!("document.cookie = 'regrind_language={language}; path=/'"));
            tab.send(&mut browser, "Page.navigate", json!({ "url": format!("{place}/recipes/small.toml") }));
            let is_shown = format!(
                "document.documentElement.lang === '{language}' && window.regrindOpened && !document.querySelector('#simulate').disabled"
            );
            tab.until(&mut browser, &is_shown);
            assert_fits(&tab, &mut browser, *size);
            tab.read(&mut browser, &editor_text(&text.replace("track_mm", "trak_mm")));
            tab.until(&mut browser, "document.querySelector('#problem-count').classList.contains('has-problems')");
            // Only the lines on the screen are in the page.
            tab.click(&mut browser, "#problem-count");
            tab.until(&mut browser, &format!("{PROBLEMS}.length === 1"));
            assert_fits(&tab, &mut browser, *size);
            tab.read(&mut browser, &editor_text(&text));
        }
        assert_eq!(tab.problems(&browser), Vec::<String>::new());
    }
}

fn assert_fits(tab: &Tab, browser: &mut Browser, size: [u32; 2]) {
    let wrong = tab.read(
        browser,
        "(() => { const wrong = []; \
         if (document.documentElement.scrollWidth > innerWidth) wrong.push(document.documentElement.scrollWidth); \
         for (const e of document.querySelectorAll('main button, header button, select')) \
         if (innerWidth < 500 && e.getClientRects().length && e.getBoundingClientRect().height < 43.5) wrong.push(e.outerHTML.slice(0, 80)); \
         return wrong; })()",
    );
    assert_eq!(wrong, json!([]), "{size:?}");
}
