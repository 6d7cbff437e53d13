//! Console events and system information on Windows.

use std::io;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind};
use tokio::signal::windows::{CtrlBreak, CtrlClose, CtrlLogoff, CtrlShutdown};
use tokio::signal::windows::{ctrl_break, ctrl_close, ctrl_logoff, ctrl_shutdown};

use super::Ending;

/// Flag that starts a program in its own process group (CREATE_NEW_PROCESS_GROUP).
const NEW_GROUP: u32 = 0x0000_0200;

/// Events that end a program from outside: Ctrl-Break, a closed console, the end of a session or a shutdown. Except
/// after Ctrl-Break, Windows itself ends the program a few seconds after the event, in any case.
pub(crate) struct Endings {
    interrupt: CtrlBreak,
    close: CtrlClose,
    log_off: CtrlLogoff,
    shut_down: CtrlShutdown,
}

impl Endings {
    pub(crate) fn new() -> io::Result<Self> {
        Ok(Self {
            interrupt: ctrl_break()?,
            close: ctrl_close()?,
            log_off: ctrl_logoff()?,
            shut_down: ctrl_shutdown()?,
        })
    }

    /// Waits for the next event that asks this program to end: Ctrl-Break, a closed console, a log-off, or the shutdown
    /// of the computer. Returns `None` if no further event can arrive.
    pub(crate) async fn next(&mut self) -> Option<Ending> {
        tokio::select! {
            Some(()) = self.interrupt.recv() => Some(Ending { by: "Ctrl-Break", hung_up: false }),
            Some(()) = self.close.recv() => Some(Ending { by: "the console was closed", hung_up: true }),
            Some(()) = self.log_off.recv() => Some(Ending { by: "the user logged off", hung_up: true }),
            Some(()) = self.shut_down.recv() => Some(Ending { by: "the computer shuts down", hung_up: true }),
            else => None,
        }
    }
}

/// Discards input that was typed at the terminal and not yet read.
pub(crate) fn forget_what_was_typed() -> io::Result<()> {
    while event::poll(Duration::ZERO)? {
        event::read()?;
    }
    Ok(())
}

/// Waits until a key is pressed at the terminal, but at most for the time `patience`. Returns `Some(true)` if the key
/// is Enter. Returns `None` if no key or another key was pressed.
///
/// When a key was pressed, calls `has_terminal` before reading the key. `has_terminal` must return true if this program
/// may read from the terminal. If it returns false, reads nothing and returns `None`.
pub(crate) fn enter_within(patience: Duration, has_terminal: impl Fn() -> bool) -> Option<bool> {
    if !event::poll(patience).is_ok_and(|typed| typed && has_terminal()) {
        return None;
    }
    let enter = KeyEvent { kind: KeyEventKind::Press, ..KeyEvent::from(KeyCode::Enter) };
    event::read().is_ok_and(|typed| typed == Event::Key(enter)).then_some(true)
}

/// Always returns true: on Windows, a program does not have to be in the foreground to read the keyboard of its
/// terminal.
pub(crate) fn is_in_front() -> bool {
    true
}

/// Does nothing. On Unix this function lowers the priority of the process; on Windows the system decides.
pub(crate) fn give_way(_steps: i32) {}

/// Does nothing, like [`give_way`].
pub(crate) fn give_way_to_all() {}

/// Does nothing: a program ends when it writes and nobody reads.
pub(crate) fn end_with_reader(_code: i32) {}

/// Sets the start options of a child program so that Ctrl-C at the terminal of this program does not end the child.
pub(crate) fn set_apart(command: &mut Command) {
    std::os::windows::process::CommandExt::creation_flags(command, NEW_GROUP);
}

/// Returns the name of the user who started this program, from the operating system.
pub(crate) fn own_name() -> String {
    regrind_windows::own_name().unwrap_or_else(|_| "unknown".into())
}

/// Returns the name of this computer, if it has one.
pub(crate) fn host() -> Option<String> {
    std::env::var("COMPUTERNAME").ok().filter(|host| !host.is_empty())
}

/// Returns the folder of this user's settings on this computer, if there is one.
pub(crate) fn settings_folder() -> Option<PathBuf> {
    std::env::var_os("LOCALAPPDATA").filter(|value| !value.is_empty()).map(PathBuf::from)
}
