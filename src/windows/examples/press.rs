//! Presses Ctrl-C or Ctrl-Break at the console of a program once it has said a word: what a script cannot do to a program of Windows.
//!
//! ```text
//! press c|break WORD PROGRAM [ARGUMENT...]
//! ```
//! Ends with the exit code of the program; whatever the program says is said on. Needs a console.

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
    // SAFETY: the function stays for as long as the program, and may be called at any time.
    unsafe { SetConsoleCtrlHandler(Some(is_for_the_child), 1) };
    let mut pressed = false;
    for line in BufReader::new(child.stdout.take().expect("it is piped")).lines() {
        let line = line?;
        println!("{line}");
        if !pressed && line.contains(word.as_str()) {
            pressed = true;
            // Not before the program has its work.
            std::thread::sleep(std::time::Duration::from_secs(2));
            // SAFETY: two numbers are handed over, and nothing is kept.
            if unsafe { GenerateConsoleCtrlEvent(event, 0) } == 0 {
                return Err(std::io::Error::last_os_error());
            }
        }
    }
    exit(child.wait()?.code().unwrap_or(-1))
}

/// Every program of the console gets what is pressed; this one lets it pass.
#[cfg(windows)]
unsafe extern "system" fn is_for_the_child(_: u32) -> i32 {
    1
}

#[cfg(not(windows))]
fn main() {}
