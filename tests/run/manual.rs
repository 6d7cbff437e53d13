//! A whole part on machines that a person operates. The test plays the person: it follows the prompts, types the
//! commands in them, makes the simulated machines grind from the files of the run, and measures by its plan.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use regrind::formats::user_name;
use regrind::journal::{Reader, Record};
use regrind_sim::payload::{Feature, Map, Pass, Plan, PointRecord, Status, Target};
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;
use regrind_testcell::http::Visitor;
use regrind_testcell::study::{grind, touch};
use serde_json::Value;
use sha2::{Digest, Sha256};

use crate::program::{PATIENCE, Running, changed, regrind, replaced, root, run};

const RADIUS_MM: f64 = 1.5;
/// Interval in which a person looks at the page.
const BETWEEN_LOOKS: Duration = Duration::from_millis(50);

/// Returns the shipped mirror with 300 points. The probe is not checked on a sphere.
fn recipe(home: &Path) -> (PathBuf, WorldSpec) {
    let text = changed(
        "recipes/freeform-mirror.toml",
        &[
            ("columns = 60", "columns = 20"),
            ("rows = 30", "rows = 15"),
            ("accuracy_nm = 0.5", "spacing_mm = 0.5"),
            ("cutoff_mm = 5.0", "cutoff_mm = 11.0"),
            ("qualify = true", "qualify = false"),
        ],
    );
    let path = home.join("mirror.toml");
    fs::write(&path, &text).unwrap();
    let table: toml::Table = toml::from_str(&text).unwrap();
    assert_eq!(table["measure"]["probe_radius_mm"].as_float(), Some(RADIUS_MM));
    (path, table["simulation"].clone().try_into::<WorldSpec>().unwrap())
}

/// Returns the rows of numbers below the comments and the header of a file.
fn rows(path: &Path) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(path).unwrap();
    let lines = text.lines().filter(|l| l.starts_with(|c: char| c.is_ascii_digit() || c == '-'));
    lines.map(|line| line.split(',').map(|field| field.parse().unwrap()).collect()).collect()
}

/// Returns the text that follows these words in the lines above the numbers.
fn stated(path: &Path, words: &str) -> String {
    let text = fs::read_to_string(path).unwrap();
    let line = text.lines().find(|line| line.contains(words)).unwrap_or_else(|| panic!("no {words:?} in {path:?}"));
    line.split(words).nth(1).unwrap().trim().to_owned()
}

struct Person {
    home: tempfile::TempDir,
    world: World,
    measured: u32,
}

impl Person {
    /// Types a command as a prompt shows it.
    fn types(&self, command: &str) -> (i32, String) {
        let words: Vec<&str> = command.split(' ').collect();
        let (code, out, err) = run(&words, self.home.path());
        (code, out + &err)
    }

    fn does(&self, command: &str) {
        let (code, told) = self.types(command);
        assert_eq!(code, 0, "{command}: {told}");
    }

    /// Grinds by the map in a cycle's folder, as the prompt names it.
    fn grinds(&self, correction: &Path, cycle: u16) {
        let nodes = rows(correction);
        let columns = nodes.iter().take_while(|node| node[1] == nodes[0][1]).count();
        let spacing_mm = [nodes[1][0] - nodes[0][0], nodes[columns][1] - nodes[0][1]];
        let map = Map {
            columns: columns as u32,
            rows: (nodes.len() / columns) as u32,
            first_mm: [nodes[0][0], nodes[0][1]],
            spacing_mm,
            nominal: [7; 32],
            values_mm: nodes.iter().map(|node| node[2]).collect(),
        };
        let level = stated(correction, "# level over the nominal surface:");
        let pass = Pass {
            spark_out: 1,
            wheel_radius_mm: 25.0,
            feed_mm_min: 1000.0,
            track_spacing_mm: 0.24,
            level_mm: level.trim_end_matches("mm").trim().parse().unwrap(),
            depth_of_cut_mm: 0.02,
            extent_mm: [-51.0, 51.0, -31.0, 31.0],
            nominal: [7; 32],
        };
        grind(&mut self.world.grinder(), 1, cycle, &map, &pass);
    }

    /// Measures by the plan that the prompt names, and saves the points as a measuring program would.
    fn measures(&mut self, plan: &Path) -> PathBuf {
        let target = |row: Vec<f64>| Target {
            index: row[0] as u32,
            feature: Feature::Part,
            point_mm: [row[1], row[2], row[3]],
            normal: [row[4], row[5], row[6]],
        };
        let (approach_mm, search_mm, speed_mm_s, safe_height_mm) = (2.0, 2.0, 5.0, 50.0);
        let targets = rows(plan).into_iter().map(target).collect();
        let plan = Plan {
            probe_radius_mm: RADIUS_MM,
            approach_mm,
            search_mm,
            speed_mm_s,
            safe_height_mm,
            targets,
            careful: (0, 0.0),
        };
        let points = touch(&self.world, 1, &plan);
        let touched = points.iter().zip(&plan.targets).filter(|(point, _)| point.status == Status::Touched);
        let row = |(p, t): (&PointRecord, &Target)| {
            format!("{},{},{},{}\n", t.index, p.position_mm[0], p.position_mm[1], p.position_mm[2])
        };
        self.measured += 1;
        let path = self.home.path().join(format!("measured-{}.csv", self.measured));
        fs::write(&path, "index,x,y,z\n".to_owned() + &touched.map(row).collect::<String>()).unwrap();
        path
    }
}

/// Holds the run in the middle of a pass. The state is not Held before a person has confirmed that the grinder is at
/// rest.
fn hold_and_go_on(person: &Person, program: &mut Running) {
    person.does("hold");
    let still = program.line("prompt to hold", |line| {
        line.split_once("then: regrind ").is_some_and(|(_, command)| command.starts_with("confirm still"))
    });
    let state = || person.types("status").1;
    // The status output also shows which confirmation the cell waits for.
    assert!(state().starts_with("Holding") && state().contains("regrind confirm still"), "{}", state());
    person.does(still.split("then: regrind ").nth(1).unwrap());
    let began = Instant::now();
    while !state().starts_with("Held") {
        assert!(began.elapsed() < PATIENCE, "{}", state());
    }
    person.does("resume");
}

/// With manual machines, a rehearsal returns the plan as the measurement. All of its files are marked, and no other
/// kind of cell is rehearsed.
#[test]
fn rehearsal_is_marked_simulation() {
    let home = tempfile::tempdir().unwrap();
    let (recipe, _) = recipe(home.path());
    let text = fs::read_to_string(&recipe).unwrap();
    fs::write(&recipe, replaced(&text, "[cycle]\n", "[cycle]\nbegin_with = \"measure\"\n")).unwrap();
    let (recipe, cell) = (recipe.display().to_string(), root().join("config/manual.toml").display().to_string());
    let (code, _, refused) = run(&["run", &recipe, "--rehearsal"], home.path());
    assert!(code == 2 && refused.contains("rehearsal"), "{refused}");

    let begin = ["run", &*recipe, "--cell", &*cell, "--part", "SN-7", "--loaded", "--rehearsal"];
    let mut program = Running::new(regrind(&begin, home.path()));
    let folder = program.folder(home.path());
    program.line("the prompt to measure", |line| line.contains("confirm done --file"));
    let centre = |row: Vec<f64>| {
        let at: Vec<String> = (1..4).map(|k| (row[k] + RADIUS_MM * row[k + 3]).to_string()).collect();
        format!("{},{}\n", row[0], at.join(","))
    };
    let given_back: String = rows(&folder.join("cycle-1/plan.csv")).into_iter().map(centre).collect();
    fs::write(home.path().join("rehearsal.csv"), format!("index,x,y,z\n{given_back}")).unwrap();
    let (code, _, refused) = run(&["confirm", "done", "--file", "rehearsal.csv"], home.path());
    assert_eq!(code, 0, "{refused}");
    assert_eq!(program.end(), (0, String::new()), "{:?}", program.output_lines);
    let begun = Reader::open(&folder).unwrap().records(1).next().unwrap().unwrap().value();
    assert_eq!((&begun["simulation"], &begun["content"]["rehearsal"]), (&Value::Bool(true), &Value::Bool(true)));
    assert!(folder.to_str().unwrap().ends_with("-SIMULATION"));
    assert!(fs::read_to_string(folder.join("report.html")).unwrap().contains(">SIMULATION<"));
}

/// A person at the page loads, grinds and measures a part: each step with its file comes from the page, and each
/// confirmation and each measurement goes through it. `at_once` is true if a file that is not good is refused when it
/// is sent; otherwise the page shows the reason afterwards.
fn make_part_by_page(home: tempfile::TempDir, cell: &Path, at_once: bool) {
    let (recipe, spec) = recipe(home.path());
    let (recipe, cell) = (recipe.display().to_string(), cell.display().to_string());
    let mut program = Running::new(regrind(&["run", &recipe, "--cell", &cell, "--part", "SN-7"], home.path()));
    let folder = program.folder(home.path());
    let run = folder.file_name().unwrap().to_str().unwrap().to_owned();
    let mut page = Running::new(regrind(&["serve", "--runs", "runs", "--listen", "127.0.0.1:0"], home.path()));
    let url = page.line("address of the page", |line| line.starts_with("page "));
    let visitor = Visitor::with_key(url.trim_start_matches("page").trim());
    let mut person = Person { home, world: World::new(spec).unwrap(), measured: 0 };
    assert_eq!(visitor.take_control(&run).0, 200);
    let shown = || visitor.get(&format!("/runs/{run}")).text();
    let (mut cycle, mut last) = (0, String::new());
    while !program.is_over() {
        let shown_now = shown();
        let attribute = |name: &str| shown_now.split(&format!("{name}=\"")).nth(1)?.split('"').next();
        let order =
            |order: &str| visitor.order(&run, &serde_json::json!({ "order": order, "map": attribute("data-map") }));
        // The page follows the cell: the step that was just confirmed can still stand on it.
        let steps = ["loaded", "started", "done", "measurement"];
        let step = steps.into_iter().find(|order| shown_now.contains(&format!("data-order=\"{order}\"")));
        let step = step.unwrap_or_default().to_owned();
        if std::mem::replace(&mut last, step.clone()) == step {
            std::thread::park_timeout(BETWEEN_LOOKS);
            continue;
        }
        let step_file = || {
            let answer = visitor.get(&format!("/runs/{run}/step-file"));
            assert_eq!(answer.status, 200, "{step}");
            answer.body
        };
        match step.as_str() {
            "loaded" | "done" => assert!(order(&step).1),
            "started" => {
                cycle += 1;
                let before = folder.join(format!("cycle-{}", cycle - 1));
                // The page gives the program of this pass.
                assert!(shown_now.contains("toolpath.ngc"), "{shown_now}");
                assert!(step_file() == fs::read(before.join("toolpath.ngc")).unwrap());
                // A browser names no file of this computer.
                let named = serde_json::json!({ "order": "done", "file": "/etc/hostname" });
                assert_eq!(visitor.order(&run, &named).0, 400);
                assert!(order("started").1);
                person.grinds(&before.join("correction.csv"), cycle);
            }
            "measurement" => {
                let list = person.home.path().join("plan-of-the-page.csv");
                fs::write(&list, step_file()).unwrap();
                let measured = fs::read(person.measures(&list)).unwrap();
                let name = format!("half-{cycle}.csv");
                let (status, accepted, why) = visitor.send_measurement(&run, &name, &measured[..measured.len() / 2]);
                assert!(status == 200 && accepted != at_once && !why.contains("/.uploaded"), "{why}");
                assert!(!at_once || why.contains(&name), "{why}");
                let began = Instant::now();
                let is_refused = |text: &str| text.contains("not accepted");
                while !at_once && !is_refused(&shown()) {
                    assert!(began.elapsed() < PATIENCE, "{}", shown());
                    std::thread::park_timeout(BETWEEN_LOOKS);
                }
                let (_, accepted, why) = visitor.send_measurement(&run, &format!("whole-{cycle}.csv"), &measured);
                assert!(accepted, "{why}");
            }
            _ => {}
        }
    }
    let (code, errors) = program.end();
    assert_eq!(code, 0, "{errors}");
    assert!(cycle > 1 && program.output_lines.iter().any(|line| line.starts_with("ACCEPTED")));
    // An old confirmation in the inbox is no news.
    let complains = |line: &&String| line.contains("was in the inbox before");
    assert_eq!(program.output_lines.iter().find(complains), None);
    // Nothing of what was sent is left beside the record.
    assert!(!folder.join(".uploaded").exists());
    let (code, told) = person.types("audit verify");
    assert_eq!(code, 0, "{told}");
}

#[test]
fn manual_part_by_page_alone() {
    make_part_by_page(tempfile::tempdir().unwrap(), &root().join("config/manual.toml"), true);
}

#[test]
fn file_exchange_part_by_page_alone() {
    let home = tempfile::tempdir().unwrap();
    let folders = ["cmm/out", "cmm/in", "grinder/out", "grinder/in"].map(|folder| home.path().join(folder));
    folders.iter().for_each(|folder| fs::create_dir_all(folder).unwrap());
    let cell = home.path().join("cell.toml");
    let in_home = format!("\"{}/", home.path().display());
    let text = changed(
        "config/file-exchange.toml",
        &[("\"../exchange/", &in_home), ("stable_for_s = 2.0", "stable_for_s = 0.05")],
    );
    // The simulated machine measures in the frame of the part.
    let text: String = text
        .lines()
        .filter(|line| !line.contains("_mm = [0.0, 0.0, 3600.0]") && !line.contains("rotation_deg"))
        .map(|line| format!("{line}\n"))
        .collect();
    fs::write(&cell, text).unwrap();
    make_part_by_page(home, &cell, false);
}

#[test]
fn manual_part_with_recorded_steps() {
    let home = tempfile::tempdir().unwrap();
    let (recipe, spec) = recipe(home.path());
    let cell = root().join("config/manual.toml");
    let (recipe, cell) = (recipe.display().to_string(), cell.display().to_string());
    let begin = ["run", &*recipe, "--cell", &*cell, "--part", "SN-7"];
    let mut program = Running::new(regrind(&begin, home.path()));
    let folder = program.folder(home.path());
    let mut person = Person { home, world: World::new(spec).unwrap(), measured: 0 };
    let (mut cycle, mut said) = (1, Vec::new());
    loop {
        let line = program.line("prompt", |line| line.contains("then: regrind ") || line.starts_with("ACCEPTED"));
        let Some(command) = line.split("then: regrind ").nth(1) else { break };
        let asks = |line: &&String| line.contains("GRIND SN-7") || line.contains("MEASURE SN-7");
        let asked = program.output_lines.iter().rev().find(asks).cloned().unwrap_or_default();
        // The file that the prompt names.
        let file = |before: &str, after: &str| {
            let rest = asked.split(before).nth(1).unwrap_or_else(|| panic!("no {before:?} in {asked:?}"));
            person.home.path().join(rest.split(after).next().unwrap())
        };
        match command {
            "confirm started" => {
                // A step that has not started cannot end, and a confirmation that names another map is refused.
                let (code, told) = person.types("confirm done");
                assert!(code == 3 && told.contains("regrind confirm started"), "{told}");
                let (code, told) = person.types("confirm started --map 0123456789abcdef");
                assert!(code == 3 && told.contains("the confirmation names"), "{told}");
                let ngc = file(": with ", " (map");
                let correction = ngc.with_file_name("correction.csv");
                let map = stated(&correction, "# map: sha256");
                assert!(asked.contains(&format!("(map {})", &map[..8])), "{asked}");
                assert!(ngc.ends_with("toolpath.ngc") && fs::read_to_string(&ngc).unwrap().contains(&map));
                person.does(command);
                if cycle == 1 {
                    hold_and_go_on(&person, &mut program);
                }
                person.grinds(&correction, cycle);
            }
            "confirm done --file RESULT" => {
                let plan = file(" points of ", "\n");
                let measured = person.measures(&plan);
                if cycle == 1 {
                    let whole = fs::read_to_string(&measured).unwrap();
                    fs::write(person.home.path().join("half.csv"), &whole[..whole.len() / 2]).unwrap();
                    // The plan itself is not a measurement, and neither are its points in another order.
                    let (head, body) = whole.split_once('\n').unwrap();
                    let mut rows: Vec<&str> = body.lines().map(|row| row.split_once(',').unwrap().1).collect();
                    rows.reverse();
                    let turned: String = rows.iter().map(|row| format!("{row}\n")).collect();
                    let head = head.strip_prefix("index,").unwrap();
                    fs::write(person.home.path().join("turned.csv"), format!("{head}\n{turned}")).unwrap();
                    let given_back = format!("confirm done --file {}", plan.display());
                    let refused = [
                        ("confirm done --file half.csv", "half.csv"),
                        ("confirm done", "--file"),
                        (&given_back, "identical to the plan"),
                        ("confirm done --file turned.csv", "order of the plan"),
                    ];
                    for (command, why) in refused {
                        let (code, told) = person.types(command);
                        assert!(code == 3 && told.contains(why), "{told}");
                    }
                }
                person.does(&command.replace("RESULT", &format!("measured-{cycle}.csv")));
                cycle += 1;
            }
            _ => person.does(command),
        }
        said.push(command.to_owned());
    }
    let (code, errors) = program.end();
    assert_eq!(code, 0, "{errors}");
    println!("{}", program.output_lines.join("\n"));
    assert!(cycle > 2 && said[0] == "confirm loaded", "{said:?}");

    crate::contents::assert_known(&folder);
    // The record contains the person and the time of each step.
    let reader = Reader::open(&folder).unwrap();
    let records: Vec<Record> = reader.records(1).map(Result::unwrap).collect();
    let uid = std::os::unix::fs::MetadataExt::uid(&fs::metadata("/proc/self").unwrap());
    let user = user_name(uid).map_or_else(|| format!("uid {uid}"), |name| format!("{name} (uid {uid})"));
    let by_a_person = |record: &&Record| {
        assert!(record.actor == user && record.utc.ends_with('Z'), "{record:?}");
        true
    };
    let count = |device: &str, confirmed: &str| {
        let is = |r: &&Record| r.value()["confirmed"] == confirmed && r.value()["device"] == device;
        records.iter().filter(is).filter(by_a_person).count()
    };
    let cycles = usize::from(cycle - 1);
    // The five refused confirmations are on record too.
    assert_eq!((count("grinder", "started"), count("grinder", "still")), (cycles, 1));
    assert_eq!((count("grinder", "done"), count("cmm", "done")), (2 * cycles, cycles + 4));
    let loaded = |r: &&Record| r.value()["event"] == "load_confirmed" && r.value()["actor"].is_object();
    assert_eq!(records.iter().filter(loaded).filter(by_a_person).count(), 1);
    // The record keeps the incoming files unchanged, by their hashes. Data that nobody entered is not in it.
    for k in 1..cycle {
        let bytes = fs::read(person.home.path().join(format!("measured-{k}.csv"))).unwrap();
        assert!(fs::read(folder.join(format!("cycle-{k}/result.csv"))).unwrap() == bytes);
        let hash: String = Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect();
        let kept = |r: &Record| r.payload.contains(&format!("cycle-{k}/result.csv")) && r.payload.contains(&hash);
        assert!(records.iter().any(kept), "{k}");
    }
    let pass = records.iter().find(|r| r.value().get("pass_record").is_some()).unwrap().value();
    assert!(pass["pass_record"]["removed_mm3"].is_null() && pass["pass_record"]["duration_s"].is_number(), "{pass}");
    let (code, told) = person.types("audit verify");
    assert_eq!(code, 0, "{told}");
}
