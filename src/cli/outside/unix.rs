//! Signals, terminals and process groups on Unix.

use std::io;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::{Ending, LOWEST_STEPS};

/// Memory that each child program may use, also on a small computer.
const MIN_MEMORY_BYTES: u64 = 1 << 30;

/// Events that end a program from outside: a closed terminal, a stopped service.
pub(crate) struct Endings {
    /// `None` if the program was started to outlive its terminal (`nohup`).
    hangup: Option<Signal>,
    terminate: Signal,
}

impl Endings {
    pub(crate) fn new() -> io::Result<Self> {
        let hangup = if ignores_hangup() { None } else { Some(signal(SignalKind::hangup())?) };
        Ok(Self { hangup, terminate: signal(SignalKind::terminate())? })
    }

    /// Waits for the next event that asks this program to end: SIGTERM, or SIGHUP after the terminal was closed.
    /// Returns `None` if no further event can arrive.
    pub(crate) async fn next(&mut self) -> Option<Ending> {
        tokio::select! {
            Some(()) = self.terminate.recv() => Some(Ending { by: "SIGTERM", hung_up: false }),
            Some(()) = async { self.hangup.as_mut()?.recv().await }, if self.hangup.is_some() => {
                Some(Ending { by: "SIGHUP, the terminal was closed", hung_up: true })
            }
            else => None,
        }
    }
}

/// Returns true if this process ignores SIGHUP (signal 1, sent when the terminal is closed), because the parent process
/// requested this, for example `nohup`. Reads the state from `/proc/self/status`. Returns false if this file cannot be
/// read.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

/// Discards input that was typed at the terminal and not yet read.
pub(crate) fn forget_what_was_typed() -> io::Result<()> {
    Ok(rustix::termios::tcflush(io::stdin(), rustix::termios::QueueSelector::IFlush)?)
}

/// Waits until a person presses Enter at the terminal, but at most for the time `patience`. `patience` must be below 1
/// s. Returns `Some(true)` after Enter. Returns `Some(false)` if the input has ended or cannot be read.
///
/// Returns `None` if nothing was typed in this time. When input has arrived, calls `has_terminal` before reading.
/// `has_terminal` must return true if this program may read from the terminal. If it returns false, reads nothing and
/// returns `None`.
pub(crate) fn enter_within(patience: Duration, has_terminal: impl Fn() -> bool) -> Option<bool> {
    let mut terminal = [PollFd::from_borrowed_fd(rustix::stdio::stdin(), PollFlags::IN)];
    let patience = Timespec { tv_sec: 0, tv_nsec: i64::from(patience.subsec_nanos()) };
    let typed = poll(&mut terminal, Some(&patience)).is_ok_and(|ready| ready > 0) && has_terminal();
    typed.then(|| io::stdin().read_line(&mut String::new()).is_ok_and(|read| read > 0))
}

/// Returns true if this program is in the foreground of its terminal, so that this program can read keys. Returns false
/// in the background or without a terminal. Callers must check this before reading, because the system stops a
/// background process that reads from the terminal. This would also stop a process that controls machines.
pub(crate) fn is_in_front() -> bool {
    rustix::termios::tcgetpgrp(io::stdin()).is_ok_and(|group| group == rustix::process::getpgrp())
}

/// Lowers the scheduling priority of this process by `steps`, if the system permits it.
pub(crate) fn give_way(steps: i32) {
    // Without the permission the program continues at its priority.
    let _ = rustix::process::nice(steps);
}

/// Lowers the scheduling priority of this process below all others, if the system permits it, and limits its memory to a
/// quarter of that of the computer. A process that a person started in a shell stays in the session of the shell.
pub(crate) fn give_way_to_all() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let memory = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let total_kb =
        memory.lines().find_map(|line| line.strip_prefix("MemTotal:")?.trim().strip_suffix(" kB")?.parse().ok());
    let limit =
        total_kb.map(|kb: u64| (kb << 10) / 4).map_or(MIN_MEMORY_BYTES, |quarter| quarter.max(MIN_MEMORY_BYTES));
    // A limit that is lower already stays.
    let limit = getrlimit(Resource::Data).maximum.map_or(limit, |present| present.min(limit));
    let _ = setrlimit(Resource::Data, Rlimit { current: Some(limit), maximum: Some(limit) });
    // When memory is short, the system ends this process first.
    let _ = tell_system("oom_score_adj", "1000");
    // Linux shares the processor between sessions first, and regards priorities only within a session. A process that
    // leads a process group cannot leave its session.
    if rustix::process::setsid().is_ok() {
        // A system without autogroups has no such file.
        let _ = tell_system("autogroup", &LOWEST_STEPS.to_string());
    }
    give_way(LOWEST_STEPS);
}

/// Gives the system a setting of this process, by the name of its file in `/proc`.
fn tell_system(name: &str, value: &str) -> io::Result<()> {
    use std::io::Write;
    let path = PathBuf::from("/proc/self").join(name);
    std::fs::File::options().write(true).open(path)?.write_all(value.as_bytes())
}

/// Ends this process when nobody reads its output any more: the program that started it has gone.
pub(crate) fn end_with_reader(code: i32) {
    std::thread::spawn(move || {
        let stdout = rustix::stdio::stdout();
        // Without a wish for events, a pipe tells only that its other end was closed.
        let wait = || poll(&mut [PollFd::from_borrowed_fd(stdout, PollFlags::empty())], None);
        let mut told = wait();
        while told == Err(rustix::io::Errno::INTR) {
            told = wait();
        }
        // A system that cannot tell it lets the process go on.
        if told.is_ok() {
            std::process::exit(code);
        }
    });
}

/// Puts a child program, before its start, into a process group of its own. Ctrl-C at the terminal of this program then
/// does not end the child.
pub(crate) fn set_apart(command: &mut Command) {
    std::os::unix::process::CommandExt::process_group(command, 0);
}

/// Returns the name of the user who started this program. Asks the operating system, because the environment variables
/// of a service can lack the name. Returns `uid` with the user number if the user has no name, and `unknown` if the
/// number cannot be read.
pub(crate) fn own_name() -> String {
    use std::os::unix::fs::MetadataExt;
    let Ok(uid) = std::fs::metadata("/proc/self").map(|own| own.uid()) else { return "unknown".into() };
    regrind::formats::user_name(uid).unwrap_or_else(|| format!("uid {uid}"))
}

/// Returns the name of this computer, if it has one.
pub(crate) fn host() -> Option<String> {
    let host = std::fs::read_to_string("/etc/hostname").unwrap_or_default();
    Some(host.trim().to_owned()).filter(|host| !host.is_empty())
}

/// Returns the folder of this user's settings, if there is one.
pub(crate) fn settings_folder() -> Option<PathBuf> {
    let folder = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    folder("XDG_CONFIG_HOME").or_else(|| Some(folder("HOME")?.join(".config")))
}
