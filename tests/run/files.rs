//! Runs the commands of docs/file-exchange.md as they are written there.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use regrind::recipe::Recipe;
use regrind_sim::spec::WorldSpec;
use regrind_sim::world::World;

use crate::first_touches::{file_cell, hand_in, measured, open_plan};
use crate::program::{Running, only_run, regrind, replaced, root, run, small_recipe};

/// Creates a folder with all shipped files, prepared as the page says. Returns the arguments of the run that the page
/// starts.
fn shop() -> (tempfile::TempDir, Vec<String>) {
    let home = tempfile::tempdir().unwrap();
    for folder in ["config", "recipes"] {
        fs::create_dir(home.path().join(folder)).unwrap();
        for entry in fs::read_dir(root().join(folder)).unwrap().map(Result::unwrap) {
            if entry.path().is_file() {
                fs::copy(entry.path(), home.path().join(folder).join(entry.file_name())).unwrap();
            }
        }
    }
    let page = fs::read_to_string(root().join("docs/file-exchange.md")).unwrap();
    let block = page.split("```sh\n").nth(1).and_then(|rest| rest.split("```").next()).expect("a block of commands");
    let (prepare, begin) = block.trim().split_once('\n').expect("two commands");
    assert!(Command::new("bash").args(["-c", prepare]).current_dir(home.path()).status().unwrap().success());
    let arguments = begin.split_whitespace().skip_while(|word| *word == "regrind").map(str::to_owned).collect();
    (home, arguments)
}

/// Waits until the plan is in the outbox.
fn until_handed_over(running: &mut Running, home: &Path) {
    let outbox = home.join("exchange/cmm/out");
    running.until("a plan in the outbox", |_| {
        let names = fs::read_dir(&outbox).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let is_plan = |name: &String| name.starts_with("SN-0042_") && outbox.join(name).join("plan.json").exists();
        names.into_iter().any(|name| is_plan(&name)).then_some(())
    });
}

#[test]
fn file_exchange_guide_starts_run() {
    let (home, arguments) = shop();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let mut running = Running::new(regrind(&arguments, home.path()));
    let folder = running.folder(home.path()).display().to_string();
    let status = || run(&["status", &folder], home.path()).1;
    running.until("a run that asks for the part", |_| status().contains("confirm loaded").then_some(()));
    let said = status();
    assert!(said.contains(", SN-0042, run "), "{said}");
    assert_eq!(run(&["confirm", "loaded"], home.path()).0, 0);
    until_handed_over(&mut running, home.path());
    assert_eq!(run(&["stop"], home.path()).0, 0);
    assert_eq!(running.end().0, 1);
}

#[test]
fn enter_key_confirms_loading() {
    let (home, arguments) = shop();
    let program = regrind(&[], home.path());
    // `script` gives the program its own terminal.
    let typed = format!("{} {}", program.get_program().display(), arguments.join(" "));
    let mut command = Command::new("script");
    command.args(["-qec", &typed, "/dev/null"]).current_dir(home.path()).env("REGRIND_KEY", "").stdin(Stdio::piped());
    let mut running = Running::new(command);
    let mut keys = running.keys();
    running.line("the question", |line| line.contains("press Enter here"));
    let folder = only_run(&home.path().join("runs")).display().to_string();
    let asks = || run(&["status", &folder], home.path()).1.contains("confirm loaded");
    running.until("a run that asks for the part", |_| asks().then_some(()));
    keys.write_all(b"\n").unwrap();
    until_handed_over(&mut running, home.path());
    assert_eq!(run(&["stop"], home.path()).0, 0);
    assert_eq!(running.end().0, 1);
}

/// Each wrong result is ignored, and the plan stays open for the right one.
#[test]
fn wrong_result_file_uses_no_cycle() {
    let home = tempfile::tempdir().unwrap();
    let home = home.path();
    let recipe = small_recipe(home, 3000.0);
    let text = replaced(&fs::read_to_string(&recipe).unwrap(), "[cycle]\n", "[cycle]\nbegin_with = \"measure\"\n");
    fs::write(&recipe, replaced(&text, "qualify = true", "qualify = false")).unwrap();
    file_cell(home);
    let table = Recipe::read(&recipe).unwrap().simulation.unwrap();
    let world = World::new(table.try_into::<WorldSpec>().unwrap()).unwrap();
    let mut running = Running::new(regrind(&["run", "small.toml", "--cell", "cell.toml", "--loaded", "--json"], home));

    // The plan's own positions instead of the measured ones, a truncated file, and rows in another order.
    let given_back = |plan: &Path, _: &str| {
        let rows = fs::read_to_string(plan.join("plan.csv")).unwrap();
        let rows = rows.lines().filter(|row| !row.starts_with('#')).skip(1);
        rows.map(|row| row.split(',').take(4).collect::<Vec<_>>().join(",") + "\n").collect()
    };
    let broken_off = |_: &Path, rows: &str| rows[..rows.len() / 2].rsplit_once('\n').unwrap().0.to_owned() + "\n";
    let turned = |_: &Path, rows: &str| {
        let mut places: Vec<&str> = rows.lines().map(|row| row.split_once(',').unwrap().1).collect();
        places.reverse();
        places.iter().zip(0..).map(|(place, index)| format!("{index},{place}\n")).collect()
    };
    type Wrong<'a> = &'a dyn Fn(&Path, &str) -> String;
    let wrong: [(&str, Wrong<'_>); 3] = [("given back", &given_back), ("broken off", &broken_off), ("turned", &turned)];
    let plan = open_plan(&mut running, home);
    let right = measured(&plan, &world);
    let (head, rows) = right.split_once("index,x,y,z\n").unwrap();
    for (what, make) in wrong {
        hand_in(home, &format!("{head}index,x,y,z\n{}", make(&plan, rows)));
        running.line(what, |line| line.contains("not accepted: ") && line.contains("result.csv"));
        assert_eq!(open_plan(&mut running, home), plan, "{what}");
    }
    hand_in(home, &right);
    // The result is judged, and the next pass is handed over.
    let outbox = home.join("exchange/grinder/out");
    running.until("a pass in the outbox of the grinder", |_| {
        let mut names = fs::read_dir(&outbox).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        names.any(|name| name.ends_with("_c2")).then_some(())
    });
    assert_eq!(run(&["stop"], home).0, 0);
    running.end();
}
