//! Python with packages that a test needs, installed once below the target folder.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Returns a Python in which the statement `import` works: the one that REGRIND_PYTHON names, or else one in the folder
/// `home`, in which the packages of the file `requirements` are installed. `home` outlives the test.
///
/// # Errors
/// Returns the reason as text if no Python can be had, or a package cannot be installed.
pub fn with_packages(import: &str, requirements: &Path, home: &Path) -> Result<PathBuf, String> {
    let imports = |python: &Path| run(Command::new(python).args(["-c", import])).is_ok();
    if let Some(named) = std::env::var_os("REGRIND_PYTHON").map(PathBuf::from).filter(|named| imports(named)) {
        return Ok(named);
    }
    let wanted = std::fs::read_to_string(requirements).map_err(|error| error.to_string())?;
    let python = home.join(if cfg!(windows) { "Scripts/python.exe" } else { "bin/python" });
    let mark = home.join("has");
    if std::fs::read_to_string(&mark).is_ok_and(|has| has == wanted) && imports(&python) {
        return Ok(python);
    }
    let base = if cfg!(windows) { "python" } else { "python3" };
    run(Command::new(base).args(["-m", "venv", "--clear"]).arg(home))?;
    // A single network failure must not fail the tests.
    let mut install = Command::new(&python);
    install.args(["-m", "pip", "install", "--quiet", "--retries", "10", "--timeout", "60", "-r"]).arg(requirements);
    (0..2).find_map(|_| run(&mut install).ok()).map_or_else(|| run(&mut install), Ok)?;
    std::fs::write(&mark, wanted).map_err(|error| error.to_string())?;
    Ok(python)
}

fn run(command: &mut Command) -> Result<(), String> {
    let done = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    match done.status.success() {
        true => Ok(()),
        false => Err(format!("{command:?}: {}", String::from_utf8_lossy(&done.stderr).trim())),
    }
}
