//! Events of a console, and what Windows tells of itself.

use std::io;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind};
use tokio::signal::windows::{CtrlBreak, CtrlClose, CtrlLogoff, CtrlShutdown};
use tokio::signal::windows::{ctrl_break, ctrl_close, ctrl_logoff, ctrl_shutdown};

use super::Ending;

/// The flag with which a program begins a group of its own (CREATE_NEW_PROCESS_GROUP).
const NEW_GROUP: u32 = 0x0000_0200;

/// What ends a program from outside: Ctrl-Break, a console that is closed, a session or a computer that ends. But for Ctrl-Break, Windows
/// ends the program itself a few seconds after it was told, whatever it does by then.
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

    /// Waits for the next; none where there will be none.
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

/// Throws away what was typed before somebody was asked.
pub(crate) fn forget_what_was_typed() -> io::Result<()> {
    while event::poll(Duration::ZERO)? {
        event::read()?;
    }
    Ok(())
}

/// Waits a while for Enter, no longer than it takes to come while this program has the terminal: none where it has not come yet.
pub(crate) fn enter_within(patience: Duration, has_terminal: impl Fn() -> bool) -> Option<bool> {
    if !event::poll(patience).is_ok_and(|typed| typed && has_terminal()) {
        return None;
    }
    let enter = KeyEvent { kind: KeyEventKind::Press, ..KeyEvent::from(KeyCode::Enter) };
    event::read().is_ok_and(|typed| typed == Event::Key(enter)).then_some(true)
}

/// Whether the terminal is this program's at the moment: a console gives what is typed to whoever reads.
pub(crate) fn is_in_front() -> bool {
    true
}

/// Other programs go first where the system says so; here it is left to it.
#[cfg(feature = "plant")]
pub(crate) fn give_way() {}

/// Keeps Ctrl-C at this program's terminal from a program that it starts.
pub(crate) fn set_apart(command: &mut Command) {
    std::os::windows::process::CommandExt::creation_flags(command, NEW_GROUP);
}

/// The name by which the operating system knows who started this program.
pub(crate) fn own_name() -> String {
    regrind_windows::own_name().unwrap_or_else(|_| "unknown".into())
}

/// The name of this computer, if it has one.
pub(crate) fn host() -> Option<String> {
    std::env::var("COMPUTERNAME").ok().filter(|host| !host.is_empty())
}

/// Where programs keep their settings for this user on this computer, if anywhere.
pub(crate) fn settings_folder() -> Option<PathBuf> {
    std::env::var_os("LOCALAPPDATA").filter(|value| !value.is_empty()).map(PathBuf::from)
}
