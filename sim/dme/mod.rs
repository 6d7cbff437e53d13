//! Server of I++ DME for a simulated measuring machine: its answer to each line, and the time of the answer. This
//! module contains no wire; `wire/lines` has one.
//!
//! ```text
//!  line     parser of received commands, implemented independently
//!  machine  what the machine is and does: tools, frames, motion, touches
//!  scan     scans: curves followed in contact
//!  faults   faults, by command
//!  event    events of the machine
//!  simulator  the machine of a simulated cell
//! ```
//!
//! Commands are acknowledged when they arrive and carried out one after another; those whose name ends in E are carried
//! out at once. After an error, the server accepts only ClearAllErrors. Each command that an abort ends gets error
//! 0006.

pub mod event;
pub mod faults;
pub mod line;
pub mod machine;
mod scan;
pub(crate) mod simulator;

use std::collections::VecDeque;
use std::time::Duration;

use event::{MachineEvent, Observer};
use faults::{CommandFaults, Fault};
use line::{Command, DmeError, Tag};
use machine::{CommandResult, DmeMachine};

use crate::line_server::{LineServer, Outgoing, take_due};

/// Command that is being carried out.
struct Running {
    tag: Tag,
    command: Command,
    began: Duration,
    ends: Duration,
    done: Result<CommandResult, DmeError>,
    /// True if the client has disconnected, so that the result is not sent.
    client_gone: bool,
}

impl Running {
    /// Returns the time at which this command sends its next output, in real time on the caller's clock. The output is
    /// the next line of a scan. If no line of a scan is left, the output is the end of the command. `speed` is the
    /// number of simulated seconds in a real second.
    fn next(&self, speed: f64) -> Duration {
        let line = self.done.as_ref().ok().and_then(|done| done.scanned.front());
        line.map_or(self.ends, |line| {
            self.began + Duration::try_from_secs_f64(line.seconds / speed).unwrap_or_default()
        })
    }
}

/// Server with its client and its machine.
pub struct Server {
    machine: DmeMachine,
    faults: CommandFaults,
    /// Seconds of the machine's time in a real second.
    speed: f64,
    waiting: VecDeque<(Tag, Command)>,
    running: Option<Running>,
    latched: bool,
    in_session: bool,
    out: VecDeque<Outgoing>,
    observer: Option<Observer>,
}

impl Server {
    /// Creates a server for a machine. `speed` is the number of simulated seconds in a real second. `faults` happen at
    /// the commands that they name.
    pub fn new(machine: DmeMachine, speed: f64, faults: CommandFaults) -> Self {
        Self {
            machine,
            faults,
            speed,
            waiting: VecDeque::new(),
            running: None,
            latched: false,
            in_session: false,
            out: VecDeque::new(),
            observer: None,
        }
    }

    /// Returns the simulated machine, to read or change it without a command.
    pub fn machine(&mut self) -> &mut DmeMachine {
        &mut self.machine
    }

    /// Restarts the server at the time `now`. The running command is interrupted where the machine is at that time.
    /// Waiting commands are dropped, and the session ends. The machine must be homed again.
    pub fn restart(&mut self, now: Duration) {
        self.client_lost(0, now);
        self.abandon(now, &DmeError::new(500, "restart"));
        self.out.clear();
        self.latched = false;
        self.machine.restart();
        self.notify(&[MachineEvent::Restarted]);
    }

    /// Sets an observer of all events of the machine from now on.
    pub fn set_observer(&mut self, observer: Observer) {
        self.observer = Some(observer);
    }

    fn notify(&mut self, events: &[MachineEvent]) {
        if let Some(observer) = &mut self.observer {
            events.iter().for_each(observer);
        }
    }

    /// Returns true if the running command is one that moves the machine, for example GoTo or PtMeas.
    pub fn is_moving(&self) -> bool {
        self.running.as_ref().is_some_and(|running| machine::moves(&running.command.name))
    }

    /// Simulates an emergency stop at the time `now`. The running command and all waiting commands end with error 500.
    /// The server then refuses commands until the client sends ClearAllErrors.
    pub fn emergency_stop(&mut self, now: Duration) {
        self.abandon(now, &DmeError::new(500, "emergency"));
        self.notify(&[MachineEvent::Stopped]);
        self.latched = true;
        self.say(now, format!("E0000 ! {}", DmeError::new(500, "emergency")));
    }

    fn run_event_command(&mut self, tag: Tag, command: &Command, now: Duration) {
        let fault = self.faults.next_at(|name| *name == command.name);
        self.say(now, format!("{tag} &"));
        match command.name.as_str() {
            "AbortE" if fault == Some(Fault::AbortIgnored) => return,
            "AbortE" => {
                self.notify(&[MachineEvent::Aborted]);
                if self.abandon(now, &DmeError::new(6, "")) {
                    self.latched = true;
                }
            }
            "GetErrStatusE" => self.say(now, format!("{tag} # ErrStatus({})", u8::from(self.latched))),
            _ => self.fail(tag, &DmeError::new(501, &command.name), now),
        }
        self.say(now, format!("{tag} %"));
    }

    /// Aborts the running command and all waiting commands at the time `now`. A motion stops where the machine is.
    /// Queues `error` for the client once for each aborted command, with the name of the command as the cause. Returns
    /// false if there was no command to answer.
    fn abandon(&mut self, now: Duration, error: &DmeError) -> bool {
        let running = self.running.take();
        if let Some(running) = running.as_ref().filter(|running| machine::moves(&running.command.name)) {
            let whole = running.ends.saturating_sub(running.began).as_secs_f64();
            let so_far = now.saturating_sub(running.began).as_secs_f64();
            self.machine.stop_short(if whole > 0.0 { (so_far / whole).min(1.0) } else { 1.0 });
            self.notify(&[MachineEvent::MotionEnded { at_mm: self.machine.at_mm() }]);
        }
        let running = running.filter(|running| !running.client_gone).map(|running| (running.tag, running.command));
        let victims: Vec<(Tag, Command)> = running.into_iter().chain(self.waiting.drain(..)).collect();
        for (tag, command) in &victims {
            self.fail(*tag, &DmeError { cause: command.name.clone(), ..error.clone() }, now);
            self.say(now, format!("{tag} %"));
        }
        !victims.is_empty()
    }

    fn begin_next(&mut self, now: Duration) {
        let Some((tag, command)) = self.waiting.pop_front() else { return };
        if command.fault == Some(Fault::InRealTime) {
            self.speed = 1.0;
        }
        let done = self.carry_out(&command);
        let lasts = done.as_ref().map_or(0.0, |done| done.seconds) / self.speed;
        let ends = now + Duration::try_from_secs_f64(lasts).unwrap_or_default();
        self.notify_machine_events();
        self.running = Some(Running { tag, command, began: now, ends, done, client_gone: false });
    }

    /// Carries out a command. The server itself handles sessions and errors, the machine all other commands.
    ///
    /// # Errors
    /// Returns the error with which the server refuses the command, for example 514 before the errors are cleared.
    fn carry_out(&mut self, command: &Command) -> Result<CommandResult, DmeError> {
        let name = command.name.as_str();
        let no = |number| Err(DmeError::new(number, name));
        if self.latched && !matches!(name, "ClearAllErrors" | "GetXtdErrStatus") {
            return no(514);
        }
        match name {
            "ClearAllErrors" => {
                self.latched = false;
                self.machine.arm();
            }
            "StartSession" if self.in_session => return no(8),
            "StartSession" => {
                self.in_session = true;
                self.machine.begin_session();
            }
            "EndSession" => self.in_session = false,
            _ if !self.in_session => return no(508),
            _ => return self.machine.carry_out(command),
        }
        Ok(CommandResult::default())
    }

    /// Queues the next data line of the running scan for the client, and moves the probe to the position of that line.
    /// If the client has disconnected, only moves the probe. Returns false and does nothing if no command runs or no
    /// line of a scan is left.
    fn say_scanned(&mut self) -> bool {
        let Some(running) = &mut self.running else { return false };
        let at = running.next(self.speed);
        let Some(line) = running.done.as_mut().ok().and_then(|done| done.scanned.pop_front()) else { return false };
        let (tag, fault, client_gone) = (running.tag, running.command.fault.clone(), running.client_gone);
        let cut = fault == Some(Fault::CutInScan);
        if cut {
            running.command.fault = None;
        }
        self.machine.set_position(line.at_mm);
        if client_gone {
            return true;
        }
        self.say_data(tag, &scan::spoilt(line, fault.as_ref()), fault.as_ref(), at);
        self.out.back_mut().into_iter().for_each(|out| out.closes = cut);
        true
    }

    fn notify_machine_events(&mut self) {
        let events = std::mem::take(&mut self.machine.events);
        self.notify(&events);
    }

    fn finish(&mut self) {
        let Some(Running { tag, command, ends, done, client_gone, .. }) = self.running.take() else { return };
        if done.is_ok() {
            self.machine.arrive();
            let touched = done.as_ref().ok().and_then(|done| done.touched.clone());
            self.notify(touched.as_slice());
        }
        if machine::moves(&command.name) {
            self.notify(&[MachineEvent::MotionEnded { at_mm: self.machine.at_mm() }]);
        }
        if client_gone {
            return;
        }
        let fault = command.fault.clone();
        match done {
            Ok(done) => {
                for warning in &done.warnings {
                    self.say(ends, format!("{tag} ! {warning}"));
                }
                for data in &done.data {
                    self.say_data(tag, data, fault.as_ref(), ends);
                }
            }
            Err(mut error) => {
                if let Some(Fault::Severity(severity)) = fault {
                    error.severity = severity;
                }
                self.fail(tag, &error, ends);
            }
        }
        match fault {
            Some(Fault::NoCompletion) => {}
            Some(Fault::Disconnect) => {
                self.say(ends, String::new());
                self.out.back_mut().into_iter().for_each(|out| out.closes = true);
            }
            _ => self.say(ends, format!("{tag} %")),
        }
    }

    /// Queues one data line for the client, to be sent at the time `at`. `tag` is the tag of the command, and `data`
    /// contains the fields of the line. Some values of `fault` change the output:
    ///
    /// - `Reordered` reverses the order of the fields.
    /// - `UnaskedQuality` adds the field `Q(0)` before the other fields, if the first field contains a parenthesis.
    /// - `Garbled` removes all closing parentheses.
    /// - `Twice` sends the line twice, and `Split` sends the line byte by byte.
    /// - `Stranger` adds a line with the tag of a command that was never sent.
    ///
    /// Any other fault changes nothing.
    fn say_data(&mut self, tag: Tag, data: &[String], fault: Option<&Fault>, at: Duration) {
        let mut fields = data.to_vec();
        match fault {
            Some(Fault::Reordered) => fields.reverse(),
            Some(Fault::UnaskedQuality) if data[0].contains('(') => fields.insert(0, "Q(0)".to_owned()),
            _ => {}
        }
        let text = format!("{tag} # {}", fields.join(", "));
        self.say(at, text.clone());
        match fault {
            Some(Fault::Twice) => self.say(at, text),
            Some(Fault::Split) => self.out.back_mut().into_iter().for_each(|out| out.split = true),
            Some(Fault::Garbled) => {
                self.out.pop_back();
                self.say(at, text.replace(')', ""));
            }
            Some(Fault::Stranger) => self.say(at, format!("77777 # {}", fields.join(", "))),
            _ => {}
        }
    }

    fn fail(&mut self, tag: Tag, error: &DmeError, at: Duration) {
        self.latched |= error.severity >= 2;
        self.say(at, format!("{tag} ! {error}"));
    }

    fn say(&mut self, at: Duration, text: String) {
        // Lines are sent in the order in which they were queued.
        let at = self.out.back().map_or(at, |last| last.at.max(at));
        let text = if text.is_empty() { text } else { text + "\r\n" };
        self.out.push_back(Outgoing { at, text, split: false, closes: false });
    }
}

impl LineServer for Server {
    const LINE_ENDS: &'static [u8] = b"\n";
    const MAX_LINE_LENGTH: usize = 65_536;
    const ONE_CLIENT_AT_A_TIME: bool = true;

    /// Returns true for an event command, which is carried out at once, before the queued commands.
    fn is_urgent(line: &str) -> bool {
        line.starts_with('E')
    }

    fn connected(&mut self, _client: u64) {}

    /// Handles the loss of the client. The running command continues to its end, and the waiting commands are dropped.
    fn client_lost(&mut self, _client: u64, now: Duration) {
        self.waiting.clear();
        self.out.clear();
        // A command whose acknowledgement was delayed has not begun yet, so it is dropped.
        if self.running.as_ref().is_some_and(|running| running.began > now) {
            self.abandon(now, &DmeError::new(6, ""));
            self.out.clear();
        }
        self.running.iter_mut().for_each(|running| running.client_gone = true);
        (self.in_session, self.latched) = (false, false);
    }

    fn serves(&self, _client: u64) -> bool {
        true
    }

    fn due(&self, _client: u64) -> Option<Duration> {
        let running = self.running.as_ref().map(|running| running.next(self.speed));
        running.into_iter().chain(self.out.front().map(|out| out.at)).min()
    }

    /// Handles a line from the client. An event command is carried out at once, any other command is queued. An invalid
    /// line is answered with an error.
    fn receive(&mut self, _client: u64, text: &str, now: Duration) {
        match line::read(text) {
            Err((tag, error)) => {
                let tag = tag.unwrap_or(Tag::UNSOLICITED);
                self.say(now, format!("{tag} &"));
                self.fail(tag, &error, now);
                self.say(now, format!("{tag} %"));
            }
            Ok((tag, command)) if tag.is_event() => self.run_event_command(tag, &command, now),
            Ok((tag, command)) => {
                let fault = self.faults.next_at(|name| *name == command.name);
                if fault == Some(Fault::EmergencyStop) {
                    return self.emergency_stop(now);
                }
                let late = if let Some(Fault::LateAcknowledgement(late)) = fault { late } else { Duration::ZERO };
                let ack = Outgoing { at: now + late, text: format!("{tag} &\r\n"), split: false, closes: false };
                self.out.push_back(ack);
                self.waiting.push_back((tag, command.with(fault)));
                if self.running.is_none() {
                    self.begin_next(now + late);
                }
            }
        }
    }

    fn tick(&mut self, _client: u64, now: Duration) -> Vec<Outgoing> {
        self.advance_time(now);
        take_due(&mut self.out, now)
    }

    /// Advances the simulation to the time `now`. The lines that become due stay queued for [`Self::tick`].
    fn advance_time(&mut self, now: Duration) {
        while self.running.as_ref().is_some_and(|running| running.next(self.speed) <= now) {
            if self.say_scanned() {
                continue;
            }
            self.finish();
            self.begin_next(now);
        }
    }
}
