//! Sends Ctrl-C or Ctrl-Break to the console of a program after the program has printed a given word. A script cannot
//! do this on Windows.
//!
//! ```text
//! press c|break WORD PROGRAM [ARGUMENT...]
//! ```
//! Exits with the exit code of the program and passes its output on. Needs a console.

#[cfg(windows)]
fn main() -> std::io::Result<()> {
    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio, exit};
    use windows_sys::Win32::System::Console::{
        CTRL_BREAK_EVENT, CTRL_C_EVENT, GenerateConsoleCtrlEvent, SetConsoleCtrlHandler,
    };

    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [key, word, program, arguments @ ..] = &arguments[..] else { panic!("press c|break WORD PROGRAM ...") };
    let event = if key == "break" { CTRL_BREAK_EVENT } else { CTRL_C_EVENT };
    let mut child = Command::new(program).args(arguments).stdout(Stdio::piped()).spawn()?;
    // SAFETY: the function exists as long as the program, and can be called at any time.
    unsafe { SetConsoleCtrlHandler(Some(is_for_the_child), 1) };
    let mut pressed = false;
    for line in BufReader::new(child.stdout.take().expect("it is piped")).lines() {
        let line = line?;
        println!("{line}");
        if !pressed && line.contains(word.as_str()) {
            pressed = true;
            // Gives the program time to begin its work.
            std::thread::sleep(std::time::Duration::from_secs(2));
            // SAFETY: the call takes two numbers and keeps nothing.
            if unsafe { GenerateConsoleCtrlEvent(event, 0) } == 0 {
                return Err(std::io::Error::last_os_error());
            }
        }
    }
    exit(child.wait()?.code().unwrap_or(-1))
}

/// Ignores the event: every program of the console receives it, but it is meant for the child.
#[cfg(windows)]
unsafe extern "system" fn is_for_the_child(_: u32) -> i32 {
    1
}

#[cfg(not(windows))]
fn main() {}
