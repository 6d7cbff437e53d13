//! Runs the program as a process that ends with the test.
//!
//! Only a test binary knows the path of the program: [`program!`](crate::program!) defines a module `program` there, with
//! the names of this module and the functions `regrind` and `run`.

use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

pub use regrind_testutils::root;
use serde_json::Value;

/// Defines the module `program` of a test binary: everything in [`mod@program`], and two functions that run the program
/// that cargo has built.
#[macro_export]
macro_rules! program {
    () => {
        mod program {
            use std::path::Path;
            use std::process::Command;

            pub use $crate::program::*;

            /// Returns the command that runs the program in a folder with these arguments.
            pub fn regrind(arguments: &[&str], folder: &Path) -> Command {
                command(env!("CARGO_BIN_EXE_regrind"), arguments, folder)
            }

            /// Runs the program to its end. Returns its exit code, its output and its error stream.
            pub fn run(arguments: &[&str], folder: &Path) -> (i32, String, String) {
                run_to_end(regrind(arguments, folder), folder)
            }
        }
    };
}

/// Longest wait for any event that must happen.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// Returns the text of a shipped file, with every occurrence of some strings replaced.
pub fn changed(file: &str, changes: &[(&str, &str)]) -> String {
    let mut text = fs::read_to_string(root().join(file)).unwrap();
    for (from, to) in changes {
        assert!(text.contains(from), "{file} has no {from:?}");
        text = text.replace(from, to);
    }
    text
}

/// Returns a text with every occurrence of a string replaced.
pub fn replaced(text: &str, from: &str, to: &str) -> String {
    assert!(text.contains(from), "no {from:?}");
    text.replace(from, to)
}

/// Number of points of the part that [`small_recipe`] measures.
pub const SMALL_RECIPE_POINTS: usize = 16 * 12;

/// Writes the shipped free-form mirror with few points as a recipe. Its machines need less than a second for a job.
pub fn small_recipe(folder: &Path, speed: f64) -> PathBuf {
    let speed = format!("[simulation]\nseed = 1\nspeed = {speed:.1}");
    let changes = [
        ("columns = 60", "columns = 16"),
        ("rows = 30", "rows = 12"),
        ("accuracy_nm = 0.5", "spacing_mm = 0.5"),
        ("cutoff_mm = 5.0", "cutoff_mm = 14.0"),
        ("[simulation]\nseed = 1", &speed),
    ];
    let path = folder.join("small.toml");
    fs::write(&path, changed("recipes/freeform-mirror.toml", &changes)).unwrap();
    path
}

/// Returns the command that runs a program in a folder with these arguments.
pub fn command(program: &str, arguments: &[&str], folder: &Path) -> Command {
    let mut command = Command::new(program);
    command.args(arguments).current_dir(folder).stdin(Stdio::null());
    // The person who runs the tests may have a key. Here records are signed only where a test asks for it.
    command.env("REGRIND_KEY", "");
    command
}

/// Process whose output lines are read as they arrive.
pub struct Running {
    child: Child,
    lines: Receiver<String>,
    errors: Option<std::thread::JoinHandle<String>>,
    folder: Option<PathBuf>,
    /// Lines that were read so far.
    pub output_lines: Vec<String>,
    /// Text of the error stream, once the process has ended.
    pub error_text: String,
}

impl Running {
    /// Starts a command.
    pub fn new(mut command: Command) -> Self {
        let folder = command.get_current_dir().map(Path::to_owned);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (to, lines) = channel();
        let out = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || out.lines().map_while(Result::ok).try_for_each(|line| to.send(line)));
        let mut errors = child.stderr.take().unwrap();
        let errors = std::thread::spawn(move || {
            let mut text = String::new();
            // Output that is not text is ignored.
            let _ = errors.read_to_string(&mut text);
            text
        });
        Self { child, lines, errors: Some(errors), folder, output_lines: Vec::new(), error_text: String::new() }
    }

    /// Waits for a line that satisfies a condition, and returns it.
    pub fn line(&mut self, what: &str, will_do: impl Fn(&str) -> bool) -> String {
        let began = Instant::now();
        while let Ok(line) = self.lines.recv_timeout(PATIENCE.saturating_sub(began.elapsed())) {
            self.output_lines.push(line.clone());
            if will_do(&line) {
                return line;
            }
        }
        let _ = self.child.kill();
        panic!("no {what}:\n{}\n{}", self.output_lines.join("\n"), self.errors.take().unwrap().join().unwrap());
    }

    /// Waits until a condition is true, while the program runs, and returns what it found.
    pub fn until<T>(&mut self, what: &str, mut is_so: impl FnMut(&[String]) -> Option<T>) -> T {
        let began = Instant::now();
        loop {
            self.output_lines.extend(self.lines.try_iter());
            if let Some(found) = is_so(&self.output_lines) {
                return found;
            }
            let ended = self.child.try_wait().unwrap();
            assert!(ended.is_none(), "the program ended with {ended:?} before {what}: {:#?}", self.output_lines);
            assert!(began.elapsed() < PATIENCE, "no {what}: {:#?}", self.output_lines);
            std::thread::park_timeout(Duration::from_millis(20));
        }
    }

    /// Returns the number of lines that the program has printed so far.
    pub fn line_count(&mut self) -> usize {
        self.output_lines.extend(self.lines.try_iter());
        self.output_lines.len()
    }

    /// Returns true if the process has ended.
    pub fn is_over(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Returns the standard input of the process, if it was started with a pipe for it.
    pub fn keys(&mut self) -> std::process::ChildStdin {
        self.child.stdin.take().expect("a pipe for what it reads")
    }

    /// Presses Ctrl-C.
    pub fn interrupt(&self) {
        self.signal("INT");
    }

    /// Sends a signal, such as `KILL`.
    pub fn signal(&self, name: &str) {
        // `kill` is built into the shell.
        let done = Command::new("sh").args(["-c", &format!("kill -{name} {}", self.child.id())]).status().unwrap();
        assert!(done.success());
    }

    /// Returns the number of the process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns the numbers of the child processes that live, from `/proc`.
    pub fn children(&self) -> Vec<u32> {
        let tasks = std::fs::read_dir(format!("/proc/{}/task", self.child.id())).unwrap();
        let children = tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("children")).unwrap());
        children.flat_map(|of| of.split_whitespace().map(|id| id.parse().unwrap()).collect::<Vec<_>>()).collect()
    }

    /// Waits for the end. Returns the exit code and the text of the error stream.
    pub fn end(&mut self) -> (i32, String) {
        let began = Instant::now();
        let code = loop {
            while let Ok(line) = self.lines.recv_timeout(Duration::from_millis(20)) {
                self.output_lines.push(line);
            }
            if let Some(status) = self.child.try_wait().unwrap() {
                break status.code().unwrap_or(-1);
            }
            if began.elapsed() > PATIENCE {
                let _ = self.child.kill();
                panic!("it does not end:\n{}", self.output_lines.join("\n"));
            }
        };
        while let Ok(line) = self.lines.recv() {
            self.output_lines.push(line);
        }
        self.error_text = self.errors.take().map(|e| e.join().unwrap()).unwrap_or_default();
        (code, self.error_text.clone())
    }

    /// Returns true if the error stream contains these words, once the process has ended.
    pub fn has_error_text(&self, words: &str) -> bool {
        self.error_text.contains(words)
    }

    /// Returns the folder of the run, once the program has printed it.
    pub fn folder(&mut self, home: &Path) -> PathBuf {
        let line = self.line("run folder", |line| line.starts_with("record in "));
        home.join(line.trim_start_matches("record in "))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // The process may have ended long ago.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.folder.iter().for_each(|folder| regrind_testutils::keep::keep(folder));
    }
}

/// Runs a command to its end in a folder. Returns its exit code, its output and its error stream.
pub fn run_to_end(mut command: Command, folder: &Path) -> (i32, String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    regrind_testutils::keep::keep(folder);
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (status.code().unwrap_or(-1), text(stdout), text(stderr))
}

/// Returns the run folders of a runs folder in order of their names, or an empty list if there is no runs folder. Files
/// whose name begins with a dot are not runs: a program that starts writes one for a moment to check that it can write.
pub fn run_folders(runs: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(runs).into_iter().flatten().map(|entry| entry.unwrap().path());
    let mut folders: Vec<PathBuf> =
        entries.filter(|path| !path.file_name().unwrap().as_encoded_bytes().starts_with(b".")).collect();
    folders.sort();
    folders
}

/// Returns the only run folder of a runs folder.
pub fn only_run(runs: &Path) -> PathBuf {
    let mut folders = run_folders(runs);
    assert_eq!(folders.len(), 1, "{folders:?}");
    folders.remove(0)
}

/// Returns the content of the journal's records that have this key.
pub fn records_with(folder: &Path, key: &str) -> Vec<Value> {
    let reader = regrind::journal::Reader::open(folder).unwrap();
    let values = reader.records(1).map(|record| record.unwrap().value());
    values.filter(|value| value.get(key).is_some()).collect()
}
