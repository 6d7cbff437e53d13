//! What docs/file-exchange.md says to type, typed.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::program::{Running, regrind, root, run};

/// A folder with all that ships, prepared as the page says; returns the arguments of the run that it begins.
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

/// Waits until the plan lies in the outbox.
fn until_handed_over(running: &mut Running, home: &Path) {
    let outbox = home.join("exchange/cmm/out");
    running.until("a plan in the outbox", |_| {
        let names = fs::read_dir(&outbox).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let is_plan = |name: &String| name.starts_with("SN-0042_") && outbox.join(name).join("plan.json").exists();
        names.into_iter().any(|name| is_plan(&name)).then_some(())
    });
}

#[test]
fn the_commands_of_the_page_begin_a_run_that_hands_over_its_first_plan() {
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
fn enter_at_the_terminal_that_asks_confirms_the_part() {
    let (home, arguments) = shop();
    let program = regrind(&[], home.path());
    // `script` gives it a terminal of its own.
    let typed = format!("{} {}", program.get_program().display(), arguments.join(" "));
    let mut command = Command::new("script");
    command.args(["-qec", &typed, "/dev/null"]).current_dir(home.path()).env("REGRIND_KEY", "").stdin(Stdio::piped());
    let mut running = Running::new(command);
    let mut keys = running.keys();
    running.line("the question", |line| line.contains("press Enter here"));
    let folder = fs::read_dir(home.path().join("runs")).unwrap().next().unwrap().unwrap().path().display().to_string();
    let asks = || run(&["status", &folder], home.path()).1.contains("confirm loaded");
    running.until("a run that asks for the part", |_| asks().then_some(()));
    keys.write_all(b"\n").unwrap();
    until_handed_over(&mut running, home.path());
    assert_eq!(run(&["stop"], home.path()).0, 0);
    assert_eq!(running.end().0, 1);
}
