//! Presses Ctrl-C or Ctrl-Break for a program once it has said a word: what a script cannot do to a program of Windows.
//!
//! ```text
//! press c|break WORD PROGRAM [ARGUMENT...]
//! ```
//! Ends with the exit code of the program; whatever the program says is said on.

#[cfg(windows)]
fn main() -> std::io::Result<()> {
    use std::io::{BufRead, BufReader};
    use std::os::windows::process::CommandExt;
    use std::process::{Command, Stdio, exit};
    use windows_sys::Win32::System::Console::{CTRL_BREAK_EVENT, CTRL_C_EVENT, GenerateConsoleCtrlEvent, SetConsoleCtrlHandler};

    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [key, word, program, arguments @ ..] = &arguments[..] else { panic!("press c|break WORD PROGRAM ...") };
    let mut command = Command::new(program);
    command.args(arguments).stdout(Stdio::piped());
    if key == "break" {
        // Ctrl-Break can be sent to a group alone, and this one would go with it otherwise.
        command.creation_flags(windows_sys::Win32::System::Threading::CREATE_NEW_PROCESS_GROUP);
    }
    let mut child = command.spawn()?;
    let (event, group) = if key == "break" { (CTRL_BREAK_EVENT, child.id()) } else { (CTRL_C_EVENT, 0) };
    // Ctrl-C goes to every program of the console. Not before the child is there: it would be deaf for it too.
    // SAFETY: no function is handed over.
    unsafe { SetConsoleCtrlHandler(None, 1) };
    let mut pressed = false;
    for line in BufReader::new(child.stdout.take().expect("it is piped")).lines() {
        let line = line?;
        println!("{line}");
        if !pressed && line.contains(word.as_str()) {
            pressed = true;
            // SAFETY: two numbers are handed over, and nothing is kept.
            if unsafe { GenerateConsoleCtrlEvent(event, group) } == 0 {
                return Err(std::io::Error::last_os_error());
            }
        }
    }
    exit(child.wait()?.code().unwrap_or(-1))
}

#[cfg(not(windows))]
fn main() {}
