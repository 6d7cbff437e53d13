//! Independent clients for live values and receivers of notifications, in Python. They run in an environment that is made once below the target
//! folder, or with the Python that REGRIND_PYTHON names, which must have the required packages.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, Command, Stdio};
use std::sync::OnceLock;

use serde_json::Value;

use crate::program::{Running, root};
use regrind_testutils::python::with_packages;

fn scripts() -> PathBuf {
    root().join("tests/plant/peers")
}

/// Returns a Python with the packages that a peer needs, installed once.
fn python(script: &str) -> &'static Path {
    static LIVE: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    static NOTIFY: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    let is_live = ["opcua_client.py", "sparkplug_host.py"].contains(&script);
    let (python, import, requirements, home) = match is_live {
        true => (&LIVE, "import asyncua, pysparkplug", "requirements.txt", "live-python"),
        false => {
            let import = "import aiosmtpd, pymtconnect, standardwebhooks";
            (&NOTIFY, import, "notify-requirements.txt", "notify-python")
        }
    };
    python
        .get_or_init(|| {
            let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join(home);
            with_packages(import, &scripts().join(requirements), &home)
        })
        .as_deref()
        .unwrap_or_else(|why| panic!("no Python for `{import}`: {why}"))
}

/// Python program that prints lines of JSON, and reads them.
pub struct Peer {
    running: Running,
    to: ChildStdin,
}

impl Peer {
    pub fn start(script: &str, arguments: &[&str], folder: &Path) -> Self {
        let mut command = Command::new(python(script));
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

    /// Waits until the peer listens, and returns its port.
    pub fn port(&mut self) -> u16 {
        let listens = |said: &[Value]| said.iter().find_map(|line| line["listens"].as_u64());
        u16::try_from(self.until(0, "a port", listens)).unwrap()
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
