//! Independent clients for live values, in Python. They run in an environment that is made once below the target
//! folder, or with the Python that REGRIND_PYTHON names, which must have the required packages.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, Command, Stdio};
use std::sync::OnceLock;

use serde_json::Value;

use crate::program::{Running, root};

const NEEDED: &str = "import asyncua, pysparkplug";

fn scripts() -> PathBuf {
    root().join("tests/plant/peers")
}

/// Returns a Python with the packages that the peers need, installed once.
fn python() -> &'static Path {
    static PYTHON: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    PYTHON
        .get_or_init(find_python)
        .as_deref()
        .unwrap_or_else(|why| panic!("no Python with asyncua and pysparkplug: {why}"))
}

fn find_python() -> Result<PathBuf, String> {
    if let Some(named) = std::env::var_os("REGRIND_PYTHON") {
        let named = PathBuf::from(named);
        if done(Command::new(&named).args(["-c", NEEDED])).is_ok() {
            return Ok(named);
        }
    }
    let list = scripts().join("requirements.txt");
    let wanted = std::fs::read_to_string(&list).map_err(|error| error.to_string())?;
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("live-python");
    let (python, mark) = (home.join("bin/python"), home.join("has"));
    let works = || done(Command::new(&python).args(["-c", NEEDED]));
    if std::fs::read_to_string(&mark).is_ok_and(|has| has == wanted) && works().is_ok() {
        return Ok(python);
    }
    done(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&home))?;
    // A single network failure must not fail the tests.
    let mut install = Command::new(&python);
    install.args(["-m", "pip", "install", "--quiet", "--retries", "10", "--timeout", "60", "-r"]).arg(list);
    (0..2).find_map(|_| done(&mut install).ok()).map_or_else(|| done(&mut install), Ok)?;
    std::fs::write(&mark, wanted).map_err(|error| error.to_string())?;
    Ok(python)
}

fn done(command: &mut Command) -> Result<(), String> {
    let done = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    match done.status.success() {
        true => Ok(()),
        false => Err(format!("{command:?}: {}", String::from_utf8_lossy(&done.stderr).trim())),
    }
}

/// Python program that prints lines of JSON, and reads them.
pub struct Peer {
    running: Running,
    to: ChildStdin,
}

impl Peer {
    pub fn start(script: &str, arguments: &[&str], folder: &Path) -> Self {
        let mut command = Command::new(python());
        command.arg(scripts().join(script)).args(arguments).current_dir(folder).stdin(Stdio::piped());
        let mut running = Running::new(command);
        let to = running.keys();
        Self { running, to }
    }

    /// Sends a command to the peer.
    pub fn does(&mut self, what: &Value) {
        writeln!(self.to, "{what}").unwrap();
    }

    /// Returns the number of messages so far: a position from which to search later.
    pub fn place(&mut self) -> usize {
        self.running.line_count()
    }

    /// Waits until the messages from a position on satisfy a condition.
    pub fn until<T>(&mut self, from: usize, what: &str, is_so: impl Fn(&[Value]) -> Option<T>) -> T {
        self.running.until(what, |said| is_so(&parsed(&said[from.min(said.len())..])))
    }

    /// Returns all messages of the peer.
    pub fn said(&mut self) -> Vec<Value> {
        self.running.line_count();
        parsed(&self.running.output_lines)
    }
}

fn parsed(lines: &[String]) -> Vec<Value> {
    lines.iter().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"))).collect()
}
