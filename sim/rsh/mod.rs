//! LinuxCNC controller with linuxcncrsh: its answer to each line, and the program that it runs. This module contains no
//! wire; `wire/lines` has one.
//!
//! ```text
//!  program  a program as the interpreter reads it: ahead of the motion
//!  faults   faults, by line
//!  event     events of the controller
//!  simulator  the grinder of a simulated cell
//! ```
//!
//! The acknowledgement of a `set` means only that the line was received. Whether it succeeded follows from the errors,
//! which can be read once, and from later queries. One client has control: the one that took it last. A set takes a
//! tenth of a second. If a program cannot be opened, the one before stays open.

pub mod event;
pub mod faults;
mod program;
pub(crate) mod simulator;

use std::collections::{BTreeMap, VecDeque};
use std::fs::OpenOptions;
use std::io::Write;
use std::time::Duration;

use crate::Vec3;
use crate::executed_wheel::Wheel;
use crate::vector::distance;
use event::{ControllerEvent, Observer};
use faults::{Fault, LineFaults};
use program::{LogAction, Program, Step, says};

use crate::line_server::{LineServer, Outgoing, take_due};

/// Duration of every `set`.
const SET_DURATION: Duration = Duration::from_millis(100);
/// Maximum distance between two samples of the wheel along its path, in mm.
const STEP_MM: f64 = 0.5;
/// Position of the wheel's centre when it is away from everything.
const AWAY_MM: Vec3 = [0.0, 0.0, 100.0];

#[derive(Default)]
struct Client {
    greeted: bool,
    verbose: bool,
    quiet: bool,
    lines: VecDeque<String>,
    /// Time at which the next line of this client is handled.
    free_at: Duration,
    out: VecDeque<Outgoing>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Interpreter {
    Idle,
    Running,
    Paused,
}

/// Controller, and the machine that it moves.
pub struct Controller {
    wheel: Wheel,
    /// Passwords of `hello` and of `set enable`.
    passwords: [String; 2],
    faults: LineFaults,
    /// Seconds of the machine's time in a real second.
    speed: f64,
    clients: BTreeMap<u64, Client>,
    owner: Option<u64>,
    stopped: bool,
    on: bool,
    homed: bool,
    mode: &'static str,
    interpreter: Interpreter,
    program: Option<Program>,
    steps: VecDeque<Step>,
    /// Number of the line that is carried out.
    line: u32,
    /// Number of the line at which a travel limit is reached.
    limit_at: Option<u32>,
    at_mm: Vec3,
    /// Time of the machine at this position, in s.
    clock_s: f64,
    errors: VecDeque<String>,
    log: Option<String>,
    last_time: Duration,
    moving: bool,
    observer: Option<Observer>,
}

impl Controller {
    /// Creates a controller that is switched on and homed, with no program open. `wheel` is the simulated wheel that
    /// the controller moves. `speed` is the number of simulated seconds in one real second. `faults` contains the
    /// faults that happen at certain lines of a client.
    pub fn new(wheel: Wheel, speed: f64, faults: LineFaults) -> Self {
        Self {
            wheel,
            passwords: ["EMC", "EMCTOO"].map(str::to_owned),
            faults,
            speed,
            clients: BTreeMap::new(),
            owner: None,
            stopped: false,
            on: true,
            homed: true,
            mode: "MANUAL",
            interpreter: Interpreter::Idle,
            program: None,
            steps: VecDeque::new(),
            line: 0,
            limit_at: None,
            at_mm: AWAY_MM,
            clock_s: 0.0,
            errors: VecDeque::new(),
            log: None,
            last_time: Duration::ZERO,
            moving: false,
            observer: None,
        }
    }

    /// Sets the passwords of `hello`, with which a client connects, and of `set enable`, with which it takes control.
    pub fn set_passwords(&mut self, passwords: [String; 2]) {
        self.passwords = passwords;
    }

    /// Sets an observer, which receives all events of the controller from now on.
    pub fn set_observer(&mut self, observer: Observer) {
        self.observer = Some(observer);
    }

    fn notify(&mut self, event: ControllerEvent) {
        if let Some(observer) = &mut self.observer {
            observer(&event);
        }
    }

    /// Returns true if the machine moves.
    pub fn is_moving(&self) -> bool {
        self.moving
    }

    /// Returns true if a program is active, that is, if it runs or is paused.
    pub fn is_busy(&self) -> bool {
        self.interpreter != Interpreter::Idle
    }

    // ---- people at the machine ----------------------------------------------------------------------------------------------------

    /// Simulates an emergency stop: opens the stop circuit, switches the drives off and ends the active program.
    pub fn emergency_stop(&mut self) {
        (self.stopped, self.on) = (true, false);
        self.break_off();
        self.notify(ControllerEvent::Stopped);
    }

    /// Switches the drives off and ends the active program.
    pub fn switch_off(&mut self) {
        self.on = false;
        self.break_off();
        self.notify(ControllerEvent::Stopped);
    }

    /// Closes the stop circuit, switches the drives on and homes the machine, as a person would.
    pub fn make_ready(&mut self) {
        (self.stopped, self.on, self.homed) = (false, true, true);
    }

    /// Switches the controller to the mode `mode` (`MANUAL`, `MDI` or `AUTO`), as a person at the machine would. Does
    /// nothing while a program is active.
    pub fn set_mode(&mut self, mode: &'static str) {
        if !self.is_busy() {
            self.mode = mode;
        }
    }

    /// Presses the button that resumes a paused program.
    pub fn press_resume(&mut self) {
        if self.interpreter == Interpreter::Paused && self.program.is_some() {
            self.interpreter = Interpreter::Running;
        }
    }

    /// Moves the wheel away from the part, as an operator would, so that the other machine can take the part. Does
    /// nothing while a program is active.
    pub fn lead_away(&mut self) {
        if !self.is_busy() {
            self.at_mm = AWAY_MM;
            self.wheel.release_part();
        }
    }

    /// Simulates another client that takes control. If `aborts` is true, this other client first aborts the active
    /// program. Then, if no program is active, it opens the file at the path `program`. With `program` = `None`, it
    /// opens no file.
    pub fn steal(&mut self, program: Option<&str>, aborts: bool) {
        self.owner = Some(u64::MAX);
        if aborts {
            self.abort();
        }
        if let Some(path) = program.filter(|_| !self.is_busy()) {
            self.open(path);
        }
    }

    /// Simulates a crash and a restart of the controller. After the restart, no client is connected and no program is
    /// open. The stop circuit is open, the drives are off, and the machine is not homed.
    pub fn kill(&mut self) {
        self.break_off();
        (self.clients, self.owner, self.program, self.log) = (BTreeMap::new(), None, None, None);
        (self.stopped, self.on, self.homed, self.mode) = (true, false, false, "MANUAL");
        (self.line, self.interpreter) = (0, Interpreter::Idle);
        self.errors.clear();
        self.notify(ControllerEvent::Killed);
    }

    // ---- lines --------------------------------------------------------------------------------------------------------------------

    /// Advances the simulation to the time `now`, and carries out the queued lines of the client `number` that are due.
    fn attend(&mut self, number: u64, now: Duration) {
        self.advance_time(now);
        loop {
            let Some(client) = self.clients.get_mut(&number).filter(|client| client.free_at <= now) else { return };
            let Some(line) = client.lines.pop_front() else { return };
            let begins = now.max(client.free_at);
            self.carry_out(number, &line, begins);
        }
    }

    fn carry_out(&mut self, number: u64, line: &str, now: Duration) {
        let fault = self.faults.next_at(|begins| line.starts_with(begins));
        let word = |k: usize| line.split_whitespace().nth(k).unwrap_or_default().to_ascii_lowercase();
        let is_set = word(0) == "set";
        let nak = || if is_set { format!("SET {} NAK\n\r", word(1).to_uppercase()) } else { "GET NAK\r\n".to_owned() };
        let ack = || format!("SET {} ACK\n\r", word(1).to_uppercase());
        let mut late = if is_set { SET_DURATION } else { Duration::ZERO };
        if let Some(Fault::Limit(thousandths)) = fault
            && let Some(program) = &self.program
        {
            self.limit_at = Some((program.len() as u32 * thousandths / 1000).max(6));
        }
        let answer = match fault {
            Some(Fault::Lost | Fault::CutBefore) => None,
            Some(Fault::Refused) => Some(nak()),
            Some(Fault::Ignored) => Some(ack()),
            Some(Fault::Fails) => {
                self.errors.push_back(format!("can't do that ({line})"));
                Some(ack())
            }
            _ => self.obey(number, line),
        };
        let answer = match fault {
            Some(Fault::Unanswered | Fault::CutAfter) => None,
            Some(Fault::DoneAndRefused) => Some(nak()),
            Some(Fault::UnmatchedLines) => answer.map(|answer| format!("AXIS 7\r\n\u{e9}\r\n{answer}")),
            _ => answer,
        };
        if let Some(Fault::Late(by)) = fault {
            late += by;
        }
        let closes = matches!(fault, Some(Fault::CutBefore | Fault::CutAfter));
        let Some(client) = self.clients.get_mut(&number) else { return };
        client.free_at = now + late;
        if answer.is_some() || closes {
            let text = answer.unwrap_or_default();
            client.out.push_back(Outgoing { at: now + late, text, split: false, closes });
        }
    }

    /// Carries out a line of the client `number`, and returns the answer with its line end. Returns `None` if the line
    /// has no answer, for example `quit` or an unknown command.
    fn obey(&mut self, number: u64, line: &str) -> Option<String> {
        let mut words = line.split_whitespace();
        let first = words.next().unwrap_or_default().to_ascii_lowercase();
        let second = words.next().unwrap_or_default().to_ascii_lowercase();
        let rest = line.splitn(3, ' ').nth(2).unwrap_or_default().trim();
        let upper = second.to_uppercase();
        match first.as_str() {
            "hello" => {
                let client = self.clients.get_mut(&number)?;
                client.greeted = second.eq_ignore_ascii_case(&self.passwords[0]);
                Some(if client.greeted { "HELLO ACK EMCNETSVR 1.1\r\n" } else { "HELLO NAK\r\n" }.to_owned())
            }
            "get" => Some(match self.query(number, &second) {
                Some(told) => format!("{upper} {told}\r\n"),
                None => format!("GET {upper} NAK\r\n"),
            }),
            "set" => {
                let client = self.clients.get_mut(&number)?;
                let (greeted, verbose) = (client.greeted, client.verbose);
                let echo = if client.quiet { String::new() } else { format!("{line}\r\n") };
                let done = if greeted { self.set(number, &second, rest) } else { None };
                let said = match done {
                    None => "SET NAK\n\r".to_owned(),
                    Some(true) if verbose || second == "verbose" => format!("SET {upper} ACK\n\r"),
                    Some(true) => String::new(),
                    Some(false) => format!("SET {upper} NAK\n\r"),
                };
                Some(echo + &said).filter(|answer| !answer.is_empty())
            }
            "quit" => {
                self.clients.remove(&number);
                None
            }
            _ => None,
        }
    }

    fn query(&mut self, number: u64, what: &str) -> Option<String> {
        let switch = |on: bool| if on { "ON" } else { "OFF" }.to_owned();
        Some(match what {
            "enable" => switch(self.owner == Some(number)),
            "inifile" => "/home/cnc/grinder/grinder.ini".to_owned(),
            "estop" => switch(self.stopped),
            "machine" => switch(self.on),
            "mode" => self.mode.to_owned(),
            "joint_homed" => if self.homed { "YES YES YES NO NO NO" } else { "NO NO NO NO NO NO" }.to_owned(),
            "program" => self.program.as_ref().map_or("NONE".to_owned(), |program| program.path.clone()),
            "program_status" => format!("{:?}", self.interpreter).to_uppercase(),
            "program_line" => self.line.to_string(),
            "abs_act_pos" => {
                let [x, y, z] = self.at_mm;
                format!("{x:.6} {y:.6} {z:.6} 0.000000 0.000000 0.000000")
            }
            "error" => self.errors.pop_front().unwrap_or("OK".to_owned()),
            _ => return None,
        })
    }

    /// Carries out a `set` command of the client `number`. `what` is the word after `set`, and `rest` is the text after
    /// that word. Returns `Some(true)` if the command is acknowledged. An acknowledged command can still fail; its
    /// error is then queued. Returns `Some(false)` if the command is refused. Returns `None` if the client does not
    /// have control or is not connected.
    fn set(&mut self, number: u64, what: &str, rest: &str) -> Option<bool> {
        let client = self.clients.get_mut(&number)?;
        match (what, rest.to_ascii_lowercase().as_str()) {
            ("echo", off) => client.quiet = off == "off",
            ("verbose", on) => client.verbose = on == "on",
            ("enable", "off") => self.owner = self.owner.filter(|owner| *owner != number),
            ("enable", _) if rest != self.passwords[1] => return Some(false),
            ("enable", _) => self.owner = Some(number),
            _ if self.owner != Some(number) => return None,
            _ if self.stopped || !self.on => return Some(false),
            ("mode", mode) => self.change_mode(mode),
            ("mdi", _) if self.mode == "MDI" && !self.is_busy() => {
                let said = says(rest);
                said.into_iter().for_each(|said| self.say(said));
            }
            ("open", _) if !self.is_busy() => self.open(rest),
            ("run", _) if self.mode == "AUTO" && !self.is_busy() && self.program.is_some() => self.run(),
            ("pause", _) => self.interpreter = Interpreter::Paused,
            ("resume", _) if self.program.is_some() && self.interpreter == Interpreter::Paused => {
                self.interpreter = Interpreter::Running;
            }
            ("abort", _) => self.abort(),
            _ => self.errors.push_back(format!("can't do that ({what}) in {} mode", self.mode.to_lowercase())),
        }
        self.update_motion();
        Some(true)
    }

    fn change_mode(&mut self, mode: &str) {
        match mode {
            _ if self.is_busy() => self.errors.push_back("can't change mode while a program runs".to_owned()),
            "auto" => self.mode = "AUTO",
            "mdi" => self.mode = "MDI",
            _ => self.mode = "MANUAL",
        }
    }

    fn open(&mut self, path: &str) {
        match std::fs::read_to_string(path) {
            Ok(text) => {
                (self.program, self.line) = (Some(Program::new(path, text)), 0);
                self.notify(ControllerEvent::Opened { path: path.to_owned() });
            }
            Err(_) => self.errors.push_back(format!("can't open {path}")),
        }
    }

    // ---- the program ----------------------------------------------------------------------------------------------------------------

    fn run(&mut self) {
        let at_mm = self.at_mm;
        let Some(program) = &mut self.program else { return };
        program.rewind(at_mm);
        let (path, text) = (program.path.clone(), program.text.clone());
        (self.interpreter, self.line) = (Interpreter::Running, 1);
        self.steps.clear();
        if !self.wheel.clamp_part() {
            self.errors.push_back("the clamp is empty".to_owned());
        }
        self.notify(ControllerEvent::Began { path, text });
        self.read_on();
    }

    fn read_on(&mut self) {
        let Some(program) = &mut self.program else { return };
        for said in program.read_on(&mut self.steps) {
            self.say(said);
        }
    }

    fn say(&mut self, said: LogAction) {
        let log = |path: &str, anew: bool| {
            OpenOptions::new().create(true).write(true).append(!anew).truncate(anew).open(path)
        };
        let done = match said {
            LogAction::Open { path, truncate: anew } => {
                let opened = log(&path, anew).map(drop);
                self.log = Some(path);
                opened
            }
            LogAction::Log(text) => match &self.log {
                Some(path) => log(path, false).and_then(|mut file| writeln!(file, "{text}")),
                None => Ok(()),
            },
            LogAction::Close => {
                self.log = None;
                Ok(())
            }
        };
        if let Err(error) = done {
            self.errors.push_back(error.to_string());
        }
    }

    fn abort(&mut self) {
        self.break_off();
        self.notify(ControllerEvent::Aborted);
    }

    /// Ends the active program, with the machine at its present position.
    fn break_off(&mut self) {
        self.interpreter = Interpreter::Idle;
        self.steps.clear();
        (self.limit_at, self.log) = (None, None);
        self.update_motion();
    }

    fn update_motion(&mut self) {
        let moves = self.interpreter == Interpreter::Running;
        if std::mem::replace(&mut self.moving, moves) != moves {
            self.notify(if moves { ControllerEvent::MotionStarted } else { ControllerEvent::MotionEnded });
        }
    }

    /// Moves the wheel at the speed `mm_s` along the first `goes_mm` of the straight way to `to_mm`, which is `way_mm`
    /// long.
    fn go(&mut self, to_mm: Vec3, [way_mm, goes_mm]: [f64; 2], mm_s: f64) {
        let from = self.at_mm;
        let place = |mm: f64| -> Vec3 {
            std::array::from_fn(|k| if mm >= way_mm { to_mm[k] } else { from[k] + (to_mm[k] - from[k]) * mm / way_mm })
        };
        let pieces = (goes_mm / STEP_MM).ceil().max(1.0) as u32;
        for piece in 1..=pieces {
            let mm = goes_mm * f64::from(piece) / f64::from(pieces);
            self.wheel.move_to(place(mm), self.clock_s + mm / mm_s);
        }
        (self.at_mm, self.clock_s) = (place(goes_mm), self.clock_s + goes_mm / mm_s);
    }

    fn end(&mut self) {
        let path = self.program.as_ref().map(|program| program.path.clone()).unwrap_or_default();
        self.wheel.release_part();
        self.notify(ControllerEvent::Ended { path });
        self.break_off();
    }
}

impl LineServer for Controller {
    const LINE_ENDS: &'static [u8] = b"\r\n";
    const MAX_LINE_LENGTH: usize = 4096;
    const ONE_CLIENT_AT_A_TIME: bool = false;

    fn is_urgent(_line: &str) -> bool {
        true
    }

    fn connected(&mut self, client: u64) {
        self.clients.insert(client, Client::default());
    }

    /// Removes a client. A running program continues.
    fn client_lost(&mut self, client: u64, _now: Duration) {
        self.clients.remove(&client);
    }

    /// Returns true if the client is connected and has not sent `quit`.
    fn serves(&self, client: u64) -> bool {
        self.clients.contains_key(&client)
    }

    fn due(&self, client: u64) -> Option<Duration> {
        let client = self.clients.get(&client)?;
        let next = client.lines.front().map(|_| client.free_at);
        next.into_iter().chain(client.out.front().map(|out| out.at)).min()
    }

    /// Queues a line, and carries out the queued lines that are due. Ignores an empty line, and a line of a client that
    /// is not connected.
    fn receive(&mut self, client: u64, line: &str, now: Duration) {
        let line = line.trim();
        if let Some(client) = self.clients.get_mut(&client).filter(|_| !line.is_empty()) {
            client.lines.push_back(line.to_owned());
        }
        self.attend(client, now);
    }

    fn tick(&mut self, client: u64, now: Duration) -> Vec<Outgoing> {
        self.attend(client, now);
        self.clients.get_mut(&client).map_or_else(Vec::new, |client| take_due(&mut client.out, now))
    }

    /// Advances the simulation to the time `now`. If a program runs, moves the wheel along the program for the
    /// simulated time since the previous call.
    fn advance_time(&mut self, now: Duration) {
        let mut left_s = now.saturating_sub(self.last_time).as_secs_f64() * self.speed;
        self.last_time = now;
        self.update_motion();
        while self.interpreter == Interpreter::Running {
            self.read_on();
            let Some(step) = self.steps.front().cloned() else {
                return self.end();
            };
            match step {
                Step::Move { to_mm, mm_s, line } => {
                    self.line = line;
                    if self.limit_at.is_some_and(|limit| limit <= line) {
                        self.errors.push_back(format!("Linear move on line {line} would exceed X's positive limit"));
                        return self.break_off();
                    }
                    let way_mm = distance(self.at_mm, to_mm);
                    let goes_mm = (left_s * mm_s).min(way_mm);
                    self.go(to_mm, [way_mm, goes_mm], mm_s);
                    if goes_mm < way_mm {
                        return;
                    }
                    left_s -= way_mm / mm_s;
                }
                Step::Refused { reason, line } => {
                    self.line = line;
                    self.errors.push_back(reason);
                    return self.break_off();
                }
                Step::Wait { line } => {
                    self.line = line;
                    self.wheel.finish_waiting_track();
                    self.program.iter_mut().for_each(Program::go_on);
                }
                Step::End { line } => {
                    self.line = line;
                    return self.end();
                }
            }
            self.steps.pop_front();
        }
    }
}
