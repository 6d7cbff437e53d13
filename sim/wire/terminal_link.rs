//! Link to a pseudo-terminal, at the path that the configuration of a client names.

use std::io;
use std::path::{Path, PathBuf};

use super::pty;

/// Symbolic link to a pseudo-terminal. It is removed when this is dropped.
#[derive(Debug)]
pub struct TerminalLink {
    at: PathBuf,
    terminal: PathBuf,
}

impl TerminalLink {
    /// Creates a symbolic link at the path `at` to the pseudo-terminal at the path `terminal`. Replaces an existing
    /// link at `at`, for example from an earlier simulation.
    ///
    /// # Errors
    /// Returns the reason as text if `at` is an existing file that is not a link, or if the link cannot be created.
    pub fn place(terminal: &Path, at: impl Into<PathBuf>) -> Result<Self, String> {
        let link = Self { at: at.into(), terminal: terminal.to_path_buf() };
        let failed = |error| {
            let (at, terminal) = (link.at.display(), terminal.display());
            format!(
                "a link at {at} to {terminal} cannot be created: {error}; remove the file at this path, or name another device"
            )
        };
        link.create().map_err(failed)?;
        Ok(link)
    }

    fn create(&self) -> io::Result<()> {
        if std::fs::symlink_metadata(&self.at).is_ok_and(|found| found.is_symlink()) {
            std::fs::remove_file(&self.at)?;
        }
        pty::link(&self.terminal, &self.at)
    }
}

impl Drop for TerminalLink {
    fn drop(&mut self) {
        if std::fs::read_link(&self.at).is_ok_and(|to| to == self.terminal) {
            // There is nobody to report an error to; the next simulator replaces a link that stays.
            let _ = std::fs::remove_file(&self.at);
        }
    }
}
