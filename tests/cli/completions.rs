//! Completion of words in real shells, by the scripts that the program prints.

use std::ffi::OsString;
use std::fs;
use std::path::Path;
use std::process::Command;

use tempfile::TempDir;

use crate::program::{Running, regrind, root, run, small_recipe};

/// Folder with runs, recipes and cell files, and names that a shell would execute.
fn folder() -> TempDir {
    let home = TempDir::new().unwrap();
    for run in ["mirror-20260101T000000Z", "mirror-20260202T000000Z", "$(touch taken)", "a b"] {
        fs::create_dir_all(home.path().join("runs").join(run)).unwrap();
    }
    for (from, to) in [("recipes/freeform-mirror.toml", "part.toml"), ("config/sim.toml", "cell.toml")] {
        fs::copy(root().join(from), home.path().join(to)).unwrap();
    }
    fs::write(home.path().join("plant.toml"), "[plant]\ncell = \"cell-1\"\n").unwrap();
    fs::write(home.path().join("notes.txt"), "[part]\n").unwrap();
    // Reading a pipe waits for its writer.
    assert!(Command::new("mkfifo").arg(home.path().join("pipe.toml")).status().unwrap().success());
    home
}

/// Returns the PATH with the folder of the program first.
fn path() -> OsString {
    let program = Path::new(env!("CARGO_BIN_EXE_regrind")).parent().unwrap().to_owned();
    let others = std::env::var_os("PATH").unwrap_or_default();
    std::env::join_paths(std::iter::once(program).chain(std::env::split_paths(&others))).unwrap()
}

/// Runs a script of a shell in a folder, and returns the lines that it prints.
fn lines(shell: &str, arguments: &[&str], script: &str, home: &Path) -> Vec<String> {
    let mut command = Command::new(shell);
    command.args(arguments).arg(script).current_dir(home).env("PATH", path()).env("REGRIND_KEY", "");
    let output = command.output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && errors.is_empty(), "{shell}: {}{errors}", output.status);
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| line.trim().to_owned()).filter(|line| !line.is_empty()).collect()
}

/// Returns the candidates of bash for the last of `words`. Options are left out, unless the word begins with `-`.
fn in_bash(words: &[&str], home: &Path) -> Vec<String> {
    let quoted: Vec<_> = words.iter().map(|word| format!("'{word}'")).collect();
    let last = words.len() - 1;
    let script = format!(
        "source <(regrind completions bash)\nCOMP_WORDS=(regrind {})\nCOMP_CWORD={}\nCOMP_TYPE=9\n\
         _clap_complete_regrind regrind {} {} 2>&1\nprintf '%s\\n' \"${{COMPREPLY[@]}}\"",
        quoted.join(" "),
        words.len(),
        quoted[last],
        if last > 0 { &quoted[last - 1] } else { "regrind" },
    );
    let mut found = lines("bash", &["--norc", "--noprofile", "-c"], &script, home);
    found.retain(|word| words[last].starts_with('-') || !word.starts_with('-'));
    found
}

#[test]
fn bash_completes_runs_recipes_and_cells() {
    let home = folder();
    let sorted = |words: &[&str]| {
        let mut found = in_bash(words, home.path());
        found.sort();
        found
    };
    let both = ["runs/mirror-20260101T000000Z", "runs/mirror-20260202T000000Z"];
    assert_eq!(sorted(&["report", ""]), both, "no name that a shell would execute");
    assert_eq!(sorted(&["report", "runs/mirror-202602"]), &both[1..]);
    assert_eq!(sorted(&["report", "mirror-202602"]), &both[1..], "the name alone is enough");
    assert_eq!(sorted(&["audit", "verify", "mirror-202601"]), &both[..1]);
    assert_eq!(sorted(&["run", "p"]), ["part.toml"]);
    assert_eq!(sorted(&["run", "part.toml", "--cell", "c"]), ["cell.toml"]);
    assert_eq!(sorted(&["run", "part.toml", "--cell", "s"]), ["sim"]);
    assert_eq!(sorted(&["ho"]), ["hold"]);
    assert_eq!(sorted(&["confirm", "st"]), ["started", "still"], "no run asks for anything");
    assert!(sorted(&["run", "--ope"]).contains(&"--operator".to_owned()));
    assert!(!home.path().join("taken").exists());
}

#[test]
fn orders_complete_the_active_run() {
    let home = folder();
    let recipe = small_recipe(home.path(), 1.0).display().to_string();
    let mut running = Running::new(regrind(&["run", &recipe, "--cell", "sim"], home.path()));
    let active = running.folder(home.path()).file_name().unwrap().to_str().unwrap().to_owned();
    let active = format!("runs/{active}");
    running.until("an answer", |_| (run(&["status", &active], home.path()).0 == 0).then_some(()));
    for order in ["hold", "stop", "abort", "status", "watch"] {
        assert_eq!(in_bash(&[order, ""], home.path()), [&*active], "{order}");
    }
    assert!(in_bash(&["report", ""], home.path()).len() > 1);
    assert!(in_bash(&["confirm", "seen", "--alarm", ""], home.path()).is_empty(), "no alarm is active");
    let (code, out, errors) = run(&["abort", &active], home.path());
    assert_eq!(code, 0, "{out}{errors}");
    running.end();
}

#[test]
#[ignore = "needs fish (Debian package)"]
fn fish_completes_runs() {
    let home = folder();
    let script = "regrind completions fish | source; complete -C 'regrind report mirror-202602'";
    assert_eq!(lines("fish", &["--no-config", "-c"], script, home.path()), ["runs/mirror-20260202T000000Z"]);
}

#[test]
#[ignore = "needs zsh (Debian package)"]
fn zsh_completes_runs() {
    let home = folder();
    // The function that zsh calls for the candidates, with the words of the line; `_describe` shows them.
    let script = "compdef() {}\n_describe() { print -rl -- ${(P)3} }\nsource <(regrind completions zsh)\n\
                  words=(regrind report mirror-202602)\nCURRENT=3\n_clap_dynamic_completer_regrind";
    let found = lines("zsh", &["-f", "-c"], script, home.path());
    assert_eq!(found, ["runs/mirror-20260202T000000Z"]);
}

#[test]
fn other_commands_ignore_the_variable_of_other_programs() {
    let home = folder();
    let mut command = regrind(&["--version"], home.path());
    command.env("COMPLETE", "bash");
    let output = command.output().unwrap();
    assert!(String::from_utf8(output.stdout).unwrap().starts_with("regrind "));
}
