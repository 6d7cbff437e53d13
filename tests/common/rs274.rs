//! LinuxCNC's own interpreter: `rs274 -g` of the package linuxcnc-uspace.

use std::io::ErrorKind;
use std::path::Path;
use std::process::{Command, Stdio};

/// Lets the interpreter read a program; returns what it would have the machine do, or what it said against it. `None` where it is not
/// installed, unless REGRIND_LINUXCNC is set. It writes files into the program's folder.
pub fn interpret(program: &Path) -> Option<Result<String, String>> {
    let folder = program.parent().expect("a program stands in a folder");
    let mut command = Command::new("rs274");
    // It keeps its tools in a file that it maps into memory in the home folder: two at once with one home kill each other (SIGBUS).
    command.arg("-g").arg(program).current_dir(folder).env("HOME", folder).stdin(Stdio::null());
    let output = match command.output() {
        Ok(output) => output,
        Err(error) => {
            let left_out = error.kind() == ErrorKind::NotFound && std::env::var_os("REGRIND_LINUXCNC").is_none();
            assert!(left_out, "rs274 does not start, {error}: apt-get install linuxcnc-uspace");
            eprintln!("left out: rs274 is not installed (Debian package linuxcnc-uspace)");
            return None;
        }
    };
    let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Some(match output.status.success() {
        true => Ok(said(&output.stdout)),
        false => Err(format!("{}: {}", output.status, said(&output.stderr))),
    })
}
