//! Path that an external controller executes, as a helper program reports it.
//!
//! The program prints a line for every servo cycle, oldest first, and none is left out:
//!
//! ```text
//!  number  x  y  z  homed  mark        number of the cycle, place in mm in the frame of the part, 1 or 0, an integer
//! ```
//!
//! The program also reads lines with a number each, and returns each number as the mark of a later cycle. A reader that
//! has seen its mark has seen everything that the controller executed before it sent the number. In this way a
//! measuring machine knows that the part has come out of the grinder, however long lines wait in a pipe:
//! [`ExecutedPath::caught_up`].

use std::io::{self, BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use tokio::sync::watch;
use tokio::time::timeout;

use crate::executed_wheel::Wheel;

/// Duration of a servo cycle, in s.
const CYCLE_S: f64 = 1e-3;
/// Time after a mark was sent within which [`ExecutedPath::caught_up`] does not send another: no pass can be loaded,
/// begun and ended within it.
const QUESTION_VALIDITY: Duration = Duration::from_millis(500);
/// Time without a mark after which a program counts as gone.
const LOST_AFTER: Duration = Duration::from_secs(30);
/// Time between two attempts to start the program: at first, and at most, after several programs in a row that reported
/// nothing. A restarted controller is followed before anybody can make it grind.
const RESTART_DELAY: Duration = Duration::from_millis(200);
const MAX_RESTART_DELAY: Duration = Duration::from_secs(2);

/// Wheel that follows the executed path of a controller. It stops following when this is dropped.
pub struct ExecutedPath {
    shared: Arc<Shared>,
    last_question: Mutex<(u32, Option<Instant>)>,
}

struct Shared {
    ended: AtomicBool,
    /// Program, while it runs.
    child: Mutex<Option<Child>>,
    input: Mutex<Option<ChildStdin>>,
    report: watch::Sender<HelperReport>,
}

/// Last report of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum HelperReport {
    /// There is no program.
    Gone,
    /// The program has started, and has reported nothing.
    Nothing,
    /// The program has returned this mark.
    Mark(u32),
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ExecutedPath {
    /// Starts the helper program `command` and moves `wheel` in a background thread. The program reports the path that
    /// the external controller executes, and the wheel follows this path. Restarts the program whenever it ends, until
    /// the returned value is dropped.
    ///
    /// # Errors
    /// Returns an error if the program cannot be started the first time.
    pub fn follow(command: Command, wheel: Wheel) -> io::Result<Self> {
        let mut command = command;
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut first = command.spawn()?;
        let (ended, input) = (AtomicBool::new(false), Mutex::new(first.stdin.take()));
        // From here on, a caller waits for an answer.
        let told = watch::Sender::new(HelperReport::Nothing);
        let shared = Arc::new(Shared { ended, child: Mutex::default(), input, report: told });
        let following = Arc::clone(&shared);
        thread::spawn(move || follow(&following, &mut command, first, wheel));
        Ok(Self { shared, last_question: Mutex::new((rand::random(), None)) })
    }

    /// Waits until the wheel has followed the whole path that the controller executed before this call.
    ///
    /// Returns at once in two cases: no helper program runs, so no path is reported, or another call began less than
    /// 0.5 s before and has its answer. Also returns if the helper program ends, or if it does not answer within 30 s.
    pub async fn caught_up(&self) {
        let (question, is_new) = {
            let (question, when) = &mut *locked(&self.last_question);
            let is_new = when.is_none_or(|when| when.elapsed() >= QUESTION_VALIDITY);
            if is_new {
                *question = question.wrapping_add(1).max(1);
                *when = Some(Instant::now());
            }
            (*question, is_new)
        };
        let mut told = self.shared.report.subscribe();
        if !is_new && *told.borrow() == HelperReport::Mark(question) {
            return;
        }
        // Asked again while the answer is open: the program can have been started anew.
        let asked = locked(&self.shared.input).as_mut().is_some_and(|input| writeln!(input, "{question}").is_ok());
        if asked {
            let seen =
                told.wait_for(|told| matches!(*told, HelperReport::Gone) || *told == HelperReport::Mark(question));
            // Without an answer by then, the wait ends.
            let _ = timeout(LOST_AFTER, seen).await;
        }
    }
}

impl Drop for ExecutedPath {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::SeqCst);
        // The program ends when its input closes; otherwise it is killed.
        *locked(&self.shared.input) = None;
        if let Some(child) = &mut *locked(&self.shared.child) {
            let _ = child.kill();
        }
    }
}

/// Runs the helper program that reports the executed path, and restarts it whenever it ends, until `shared.ended` is
/// set. Moves the wheel along the reported path.
fn follow(shared: &Shared, command: &mut Command, first: Child, mut wheel: Wheel) {
    let mut next = Ok(first);
    // Number of consecutive programs that reported nothing.
    let mut silent = 0;
    while !shared.ended.load(Ordering::SeqCst) {
        let mut has_told = false;
        if let Ok(mut child) = next {
            if let Some(input) = child.stdin.take() {
                *locked(&shared.input) = Some(input);
                shared.report.send_replace(HelperReport::Nothing);
            }
            let lines = child.stdout.take();
            *locked(&shared.child) = Some(child);
            if let Some(lines) = lines {
                has_told = read(shared, BufReader::new(lines), &mut wheel);
            }
            *locked(&shared.input) = None;
            wheel.set_position_unknown();
            shared.report.send_replace(HelperReport::Gone);
            if let Some(mut child) = locked(&shared.child).take() {
                let _ = child.kill();
                let _ = child.wait();
            }
        }
        silent = if has_told { 0 } else { silent + 1 };
        // The first of these programs has already printed why it reports nothing.
        command.stderr(if silent > 0 { Stdio::null() } else { Stdio::inherit() });
        thread::sleep(pause_after(silent));
        next = command.spawn();
    }
    if let Ok(mut child) = next {
        let _ = child.kill();
        let _ = child.wait();
    }
}

/// Returns the pause before the next start of the helper program. `silent` is the number of consecutive starts after
/// which it reported nothing.
fn pause_after(silent: u32) -> Duration {
    (RESTART_DELAY * 2u32.pow(silent.min(8))).min(MAX_RESTART_DELAY)
}

/// Moves the wheel to the positions in `lines`, with one line for each servo cycle, until the lines end. Marks the path
/// as lost if a line is invalid or a cycle is missing. Returns true if at least one line was valid.
fn read(shared: &Shared, lines: impl BufRead, wheel: &mut Wheel) -> bool {
    let mut expected = None;
    for line in lines.lines().map_while(Result::ok) {
        let Some(ServoCycle { number, place_mm, homed, mark }) = ServoCycle::parse(&line) else {
            wheel.path_lost();
            continue;
        };
        if expected.is_some_and(|expected| expected != number) {
            wheel.path_lost();
        }
        expected = Some(number + 1);
        match homed {
            true => wheel.move_to(place_mm, number as f64 * CYCLE_S),
            false => wheel.set_position_unknown(),
        }
        if *shared.report.borrow() != HelperReport::Mark(mark) {
            wheel.finish_waiting_track();
            shared.report.send_replace(HelperReport::Mark(mark));
        }
    }
    expected.is_some()
}

/// Content of a line.
#[derive(Debug, PartialEq)]
struct ServoCycle {
    number: u64,
    place_mm: [f64; 3],
    homed: bool,
    mark: u32,
}

impl ServoCycle {
    fn parse(line: &str) -> Option<Self> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let [number, x, y, z, homed, mark] = words[..] else { return None };
        let place = |word: &str| word.parse().ok().filter(|mm: &f64| mm.is_finite());
        let homed = match homed {
            "1" => true,
            "0" => false,
            _ => return None,
        };
        let (number, mark) = (number.parse().ok()?, mark.parse().ok()?);
        Some(Self { number, place_mm: [place(x)?, place(y)?, place(z)?], homed, mark })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::WorldSpec;
    use crate::world::World;

    #[test]
    fn servo_cycle_parse_refuses_partial() {
        let cycle = ServoCycle { number: 7, place_mm: [1.5, -2.0, 30.000001], homed: true, mark: 3 };
        assert_eq!(ServoCycle::parse("7 1.500000 -2.000000 30.000001 1 3 "), Some(cycle));
        for broken in ["", "overrun", "7 1 2 3 1", "7 1 2 nan 1 0", "7 1 2 3 2 0", "-7 1 2 3 1 0", "7 1 2 3 1 0 0"] {
            assert_eq!(ServoCycle::parse(broken), None, "{broken:?}");
        }
    }

    #[test]
    fn pause_after_doubles_to_2_s() {
        assert_eq!([0, 1, 2, 3, 4, u32::MAX].map(|n| pause_after(n).as_millis()), [200, 400, 800, 1600, 2000, 2000]);
    }

    #[cfg(unix)]
    #[test]
    fn helper_error_printed_once() {
        let folder = tempfile::tempdir().unwrap();
        let [begun, said] = ["begun", "said"].map(|name| folder.path().join(name));
        assert!(Command::new("mkfifo").arg(&begun).status().unwrap().success());
        let mut command = Command::new("sh");
        command.args(["-c", "echo no controller >&2; echo >\"$0\""]).arg(&begun);
        command.stderr(std::fs::File::create(&said).unwrap());
        let world = World::new(WorldSpec::default()).unwrap();
        let _path = ExecutedPath::follow(command, world.wheel(12.5).unwrap()).unwrap();
        // Each started program writes a line here, and waits until it is read.
        for _ in 0..3 {
            assert_eq!(std::fs::read_to_string(&begun).unwrap(), "\n");
        }
        assert_eq!(std::fs::read_to_string(&said).unwrap(), "no controller\n");
    }

    #[cfg(unix)]
    #[tokio::test]
    async fn caught_up_follows_prior_motion() {
        // A controller that prints lines only when asked: first a motion, then the mark.
        let told = "n=0; while read mark; do for z in 90 80 70; do n=$((n+1)); echo $n 0 0 $z 1 0; done; n=$((n+1)); echo $n 0 0 60 1 $mark; done";
        let mut command = Command::new("sh");
        command.args(["-c", told]);
        let world = World::new(WorldSpec::default()).unwrap();
        let path = ExecutedPath::follow(command, world.wheel(12.5).unwrap()).unwrap();
        path.caught_up().await;
        let question = locked(&path.last_question).0;
        assert_eq!(*path.shared.report.borrow(), HelperReport::Mark(question));
        // A question is not repeated within a short time.
        path.caught_up().await;
        assert_eq!(locked(&path.last_question).0, question);
    }

    /// A second caller waits too, although the question of the first is new.
    #[cfg(unix)]
    #[tokio::test]
    async fn second_caller_waits_for_open_answer() {
        // A controller that answers the second question only.
        let told = "read first; read second; echo 1 0 0 90 1 $second; cat >/dev/null";
        let mut command = Command::new("sh");
        command.args(["-c", told]);
        let world = World::new(WorldSpec::default()).unwrap();
        let path = ExecutedPath::follow(command, world.wheel(12.5).unwrap()).unwrap();
        tokio::join!(path.caught_up(), path.caught_up());
        assert_eq!(*path.shared.report.borrow(), HelperReport::Mark(locked(&path.last_question).0));
    }
}
