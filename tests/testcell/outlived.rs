//! Programs that are killed in the middle of a run, and machines that outlive them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use regrind::cell::StateName;
use regrind::drive::{Request, send_request};
use serde_json::Value;

use crate::program::{PATIENCE, Running, changed};

/// Follows a program until it has printed this number of lines and then kills it, or follows it to its end. Resumes the
/// cell wherever it holds, as a person would. Returns the exit code if the program reached its end.
pub fn follow(running: &mut Running, folder: &dyn Fn() -> Option<PathBuf>, lines: usize) -> Option<i32> {
    let began = std::time::Instant::now();
    loop {
        if running.line_count() >= lines {
            running.signal("KILL");
            running.end();
            return None;
        }
        if running.is_over() {
            return Some(running.end().0);
        }
        if let Some(status) = folder().and_then(|folder| send_request(&folder, &Request::Status).ok())
            && status.status.state == StateName::Held
        {
            let resume = Request::Resume { reason: "seen".into(), state_number: Some(status.status.state_number) };
            // The program may have been killed meanwhile, or may still wait for a machine.
            let _ = send_request(&folder().unwrap(), &resume);
        }
        assert!(began.elapsed() < PATIENCE, "it comes to no end: {:#?}", running.output_lines);
        std::thread::park_timeout(std::time::Duration::from_millis(5));
    }
}

/// Starts simulated machines on serial lines, served by the program itself, and writes a cell file for them and this
/// recipe. `regrind` is the function of that name in the test binary.
pub fn on_serial_lines(regrind: fn(&[&str], &Path) -> Command, home: &Path, recipe: impl AsRef<[u8]>) -> Running {
    fs::write(home.join("part.toml"), recipe).unwrap();
    let devices = format!("device = \"{}/", home.display());
    let cell = changed("config/serial-rtu.toml", &[("device = \"/tmp/regrind-", &devices)]);
    fs::write(home.join("cell.toml"), cell).unwrap();
    let mut serving =
        Running::new(regrind(&["simulate", "part.toml", "--cell", "cell.toml", "--log", "machines.jsonl"], home));
    serving.line("its last word", |line| line.starts_with("Ctrl-C"));
    serving
}

/// Checks in the log of those machines that each pass and each measurement started exactly once. Returns their number.
pub fn began_once(home: &Path) -> usize {
    let log = fs::read_to_string(home.join("machines.jsonl")).unwrap();
    let seen = log.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let began = seen.filter(|seen| seen["what"] == "began");
    let mut began: Vec<_> = began.map(|b| format!("{} {} {}", b["machine"], b["job"], b["cycle"])).collect();
    let all = began.len();
    began.sort();
    began.dedup();
    assert_eq!(began.len(), all, "{log}");
    all
}
