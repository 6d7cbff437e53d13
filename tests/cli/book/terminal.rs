//! Terminal in which a page is typed line by line, with its output.

use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use crate::program::PATIENCE;

/// Command that was typed and not yet waited for.
struct Typed {
    line: String,
    child: Child,
    lines: Receiver<String>,
    /// Expected exit code, as the page gives it after the command; 0 if it gives none.
    code: i32,
}

pub struct Terminal {
    home: PathBuf,
    folder: PathBuf,
    typed: Option<Typed>,
    /// Output since the start of the last block, without the lines that a screen of the page has already matched.
    shown: Vec<String>,
    /// The same output in full, for the message of a failed test.
    log: Vec<String>,
}

impl Terminal {
    pub fn new(home: &Path) -> Self {
        Self { home: home.to_owned(), folder: home.to_owned(), typed: None, shown: Vec::new(), log: Vec::new() }
    }

    /// Types a block: each line after the one before has ended. The last one continues to run.
    pub fn types(&mut self, block: &str) {
        self.shown.clear();
        for line in commands(block) {
            self.until_it_ends();
            self.log.push(format!("$ {line}"));
            match line.trim().strip_prefix("cd ") {
                Some(folder) => self.folder = self.folder.join(folder.trim()),
                None => self.begin(&line),
            }
        }
    }

    fn begin(&mut self, line: &str) {
        let digit = line.split("# exit code ").nth(1).and_then(|words| words.chars().next()?.to_digit(10));
        let code = digit.map_or(0, |digit| i32::try_from(digit).unwrap());
        let program = Path::new(env!("CARGO_BIN_EXE_regrind")).parent().unwrap();
        let mut path = OsString::from(program);
        path.push(":");
        path.push(std::env::var_os("PATH").unwrap_or_default());
        let mut command = Command::new("bash");
        command.args(["-c", line]).current_dir(&self.folder).env("PATH", path);
        // A separate user without a key and without settings.
        command.env_remove("REGRIND_KEY");
        for name in ["HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"] {
            command.env(name, self.home.join(".home"));
        }
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let (to, lines) = channel();
        let streams: [Box<dyn Read + Send>; 2] =
            [Box::new(child.stdout.take().unwrap()), Box::new(child.stderr.take().unwrap())];
        for stream in streams {
            let to = to.clone();
            std::thread::spawn(move || {
                BufReader::new(stream).lines().map_while(Result::ok).try_for_each(|line| to.send(line))
            });
        }
        self.typed = Some(Typed { line: line.to_owned(), child, lines, code });
    }

    fn show(&mut self, line: String) {
        self.log.push(line.clone());
        self.shown.push(line);
    }

    /// Waits for every line of a screen of the page. Presses `^C` after the lines before it have appeared.
    pub fn shows(&mut self, screen: &str) {
        let began = Instant::now();
        for expected in screen.lines().filter(|line| !line.trim().is_empty() && line.trim() != "...") {
            if expected.trim() == "^C" {
                self.interrupt();
                continue;
            }
            while !self.takes(expected) {
                let left = PATIENCE.saturating_sub(began.elapsed());
                let typed = self.typed.as_ref().unwrap_or_else(|| panic!("no {expected:?} in:\n{}", self.log()));
                match typed.lines.recv_timeout(left) {
                    Ok(line) => self.show(line),
                    Err(RecvTimeoutError::Disconnected) => panic!("it ended without {expected:?}:\n{}", self.log()),
                    Err(RecvTimeoutError::Timeout) => panic!("no {expected:?} in time:\n{}", self.log()),
                }
            }
        }
    }

    /// Removes the first line that matches the expected one.
    fn takes(&mut self, expected: &str) -> bool {
        let found = self.shown.iter().position(|line| fits(line, expected));
        found.map(|k| self.shown.remove(k)).is_some()
    }

    /// Presses Ctrl-C.
    fn interrupt(&self) {
        let typed = self.typed.as_ref().expect("a command that goes on");
        let began = Instant::now();
        // A person is never fast enough to press it before the program handles it.
        while !heeds_interrupts(typed.child.id()) && began.elapsed() < PATIENCE {
            std::thread::park_timeout(Duration::from_millis(5));
        }
        let done = Command::new("sh").args(["-c", &format!("kill -INT {}", typed.child.id())]).status().unwrap();
        assert!(done.success());
    }

    /// Waits for the end of the typed command, whose exit code must match the page.
    pub fn until_it_ends(&mut self) {
        let Some(mut typed) = self.typed.take() else { return };
        let began = Instant::now();
        loop {
            match typed.lines.recv_timeout(PATIENCE.saturating_sub(began.elapsed())) {
                Ok(line) => self.show(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {
                    let _ = typed.child.kill();
                    panic!("it does not end: {}\n{}", typed.line, self.log());
                }
            }
        }
        let status = typed.child.wait().unwrap();
        assert_eq!(status.code(), Some(typed.code), "{}\n{}", typed.line, self.log());
    }

    fn log(&self) -> String {
        self.log.join("\n")
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        if let Some(typed) = &mut self.typed {
            // The process has possibly ended already.
            let _ = typed.child.kill();
            let _ = typed.child.wait();
        }
    }
}

/// Returns true if a process handles Ctrl-C, or if the system does not report it.
fn heeds_interrupts(id: u32) -> bool {
    let Ok(status) = std::fs::read_to_string(format!("/proc/{id}/status")) else { return true };
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
    let caught = caught.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
    // SIGINT is signal 2.
    caught.is_none_or(|mask| mask & 0b10 != 0)
}

/// Returns the commands of a block, one per line. A backslash at the end or an open quote continues the line.
fn commands(block: &str) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    let mut open = String::new();
    for line in block.replace("\\\n", " ").lines() {
        open.push_str(line);
        if open.matches('\'').count() % 2 == 1 {
            open.push('\n');
        } else if !open.trim().is_empty() {
            found.push(std::mem::take(&mut open));
        }
    }
    assert!(open.trim().is_empty(), "a quote without its end: {open}");
    found
}

/// Returns true if a line matches a line of the page, in which `...` matches any characters.
fn fits(line: &str, expected: &str) -> bool {
    let mut pieces = expected.trim().split("...");
    let line = line.trim();
    let Some(mut rest) = pieces.next().and_then(|first| line.strip_prefix(first)) else { return false };
    let pieces: Vec<&str> = pieces.collect();
    for (k, piece) in pieces.iter().enumerate() {
        let last = k + 1 == pieces.len();
        match (last, rest.find(piece)) {
            (true, _) => return rest.ends_with(piece),
            (false, Some(at)) => rest = &rest[at + piece.len()..],
            (false, None) => return false,
        }
    }
    rest.is_empty()
}

#[test]
fn dots_match_any_output() {
    for (line, expected, so) in [
        ("record in runs/a-1", "record in runs/...", true),
        ("cycle 1: PV 3.6 of 7.00 µm", "cycle 1: PV ... of ... µm", true),
        ("cycle 1", "cycle 2", false),
        ("cycle 12", "cycle 1", false),
        ("a b c", "...b...", true),
        ("a b c", "a ... d", false),
    ] {
        assert_eq!(fits(line, expected), so, "{line:?} as {expected:?}");
    }
}
