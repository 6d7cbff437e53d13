//! Exchange with a controller: identity, state, orders.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::link::{Link, LinkFault};
use super::protocol::{Get, Mode, Reply, Request, Set};
use super::settings::LinuxcncSettings;
use crate::error::{Answered, DeviceError};
use crate::words::{Answer, Command, State};
use crate::{Dial, Line};

/// Interval between two queries while waiting for something.
const ASKED_EVERY: Duration = Duration::from_millis(20);
/// Maximum number of errors read at once.
const MOST_ERRORS: usize = 32;

/// State of the interpreter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Interpreter {
    Idle,
    Running,
    Paused,
}

/// State of a controller, read in one exchange.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Seen {
    /// True if this client has control.
    pub(super) ours: bool,
    /// True if the stop circuit is open.
    pub(super) stopped: bool,
    /// True if the drives are on.
    pub(super) on: bool,
    pub(super) mode: Mode,
    pub(super) homed: bool,
    pub(super) interpreter: Interpreter,
    /// Program that is open.
    pub(super) program: Option<String>,
    pub(super) line: u32,
    /// Position, as the controller reports it.
    pub(super) at: String,
    /// Errors that it reports, each once.
    pub(super) errors: Vec<String>,
}

/// Controller at the other end of a connection.
#[derive(Debug)]
pub(super) struct Controller {
    pub(super) name: Arc<str>,
    settings: LinuxcncSettings,
    dial: Box<dyn Dial>,
    link: Option<Link>,
    /// Reason why the connection was lost. A later request returns this error, and not "never connected".
    lost: Option<DeviceError>,
    /// True if this client has taken control on this connection.
    pub(super) owned: bool,
    /// Machine configuration, which serves as its name.
    configuration: Option<String>,
}

impl Controller {
    pub(super) fn new(settings: LinuxcncSettings, dial: Box<dyn Dial>) -> Self {
        let name = format!("grinder at {}:{} (LinuxCNC)", settings.host, settings.port).into();
        Self { name, settings, dial, link: None, lost: None, owned: false, configuration: None }
    }

    /// Reconnects and checks the identity; changes only settings of this connection. Returns the name of the machine.
    pub(super) async fn meet(&mut self) -> Answered<String> {
        (self.link, self.owned) = (None, false);
        let LinuxcncSettings { host, port, answer_within, connect_password, .. } = &self.settings;
        let line = Line::Tcp { host: host.clone(), port: *port };
        let link = Link::open(&line, self.dial.as_mut(), *answer_within).await;
        let link = link.map_err(|fault| self.fault(fault, "a connection"))?;
        let hello = Request::Hello { password: connect_password.clone() };
        let server = match link.ask(hello, *answer_within).answer().await {
            Ok(Reply::Value(server)) => server,
            Ok(_) => return Err(DeviceError::Password { machine: self.machine(), key: "connect_password" }),
            Err(LinkFault::Nonsense | LinkFault::TimedOut) => return Err(self.foreign("hello", "nothing that fits")),
            Err(fault) => return Err(self.fault(fault, "hello")),
        };
        link.say(Request::EchoOff);
        let verbose = link.ask(Request::Set(Set::Verbose), *answer_within).answer().await;
        match verbose.map_err(|fault| self.fault(fault, "set verbose"))? {
            Reply::Acknowledged => {}
            other => return Err(self.foreign("set verbose", &format!("{other:?}"))),
        }
        (self.link, self.lost) = (Some(link), None);
        let configuration = self.get(Get::Inifile).await?;
        self.check_name(&server, &configuration)?;
        self.look(false).await?;
        let name = format!("{server}, {configuration}");
        self.configuration = Some(configuration);
        Ok(name)
    }

    fn check_name(&mut self, server: &str, configuration: &str) -> Answered<()> {
        let changed = self.configuration.as_ref().filter(|known| *known != configuration).cloned();
        let expected = changed.or_else(|| self.settings.expected_name.clone());
        let known = [configuration, server, server.split(' ').next().unwrap_or_default()];
        match expected.filter(|expected| !known.contains(&expected.as_str())) {
            Some(expected) => {
                self.link = None;
                Err(DeviceError::WrongName { machine: self.machine(), expected, found: configuration.to_owned() })
            }
            None => Ok(()),
        }
    }

    /// Reads the complete state. Errors are read only if `errors` is true, because the controller reports each error to
    /// one reader only.
    pub(super) async fn look(&mut self, errors: bool) -> Answered<Seen> {
        const WHAT: [Get; 9] = [
            Get::Enable,
            Get::Estop,
            Get::Machine,
            Get::Mode,
            Get::JointHomed,
            Get::Program,
            Get::ProgramStatus,
            Get::ProgramLine,
            Get::AbsActPos,
        ];
        let link = self.link("its status")?;
        let asked = WHAT.map(|what| (what, link.ask(Request::Get(what), self.settings.answer_within)));
        let mut told = Vec::with_capacity(WHAT.len());
        for (what, asked) in asked {
            let answer = asked.answer().await;
            told.push(self.value(what, answer)?);
        }
        let errors = if errors { self.errors().await? } else { Vec::new() };
        self.understand(&told, errors)
    }

    fn understand(&self, told: &[String], errors: Vec<String>) -> Answered<Seen> {
        let [enable, estop, machine, mode, homed, program, interpreter, line, at] = told else {
            return Err(self.foreign("its status", "less than was asked"));
        };
        let switch = |what: &'static str, told: &str| match told {
            "ON" => Ok(true),
            "OFF" => Ok(false),
            other => Err(self.foreign(what, other)),
        };
        let interpreter = match interpreter.as_str() {
            "IDLE" => Interpreter::Idle,
            "RUNNING" => Interpreter::Running,
            "PAUSED" => Interpreter::Paused,
            other => return Err(self.foreign("get program_status", other)),
        };
        let homed: Vec<&str> = homed.split_whitespace().take(self.settings.joints).collect();
        Ok(Seen {
            ours: switch("get enable", enable)?,
            stopped: switch("get estop", estop)?,
            on: switch("get machine", machine)?,
            mode: Mode::of(mode).ok_or_else(|| self.foreign("get mode", mode))?,
            homed: homed.len() == self.settings.joints && homed.iter().all(|joint| *joint == "YES"),
            interpreter,
            program: Some(program.clone()).filter(|program| program != "NONE"),
            line: line.parse().map_err(|_| self.foreign("get program_line", line))?,
            at: at.clone(),
            errors,
        })
    }

    /// Reads the errors since the last call.
    pub(super) async fn errors(&mut self) -> Answered<Vec<String>> {
        let mut errors = Vec::new();
        while errors.len() < MOST_ERRORS {
            match self.get(Get::Error).await? {
                none if none == "OK" => break,
                error => errors.push(error),
            }
        }
        Ok(errors)
    }

    pub(super) async fn get(&mut self, what: Get) -> Answered<String> {
        let asked = self.link("a question")?.ask(Request::Get(what), self.settings.answer_within);
        let answer = asked.answer().await;
        self.value(what, answer)
    }

    fn value(&mut self, what: Get, answer: Result<Reply, LinkFault>) -> Answered<String> {
        match answer {
            Ok(Reply::Value(value)) => Ok(value),
            Ok(other) => Err(self.foreign("a question", &format!("{other:?} to {what:?}"))),
            Err(fault) => Err(self.broken(fault, "its status")),
        }
    }

    /// Sends an order after the pending requests. An acknowledgement means that the order was received, not that it
    /// succeeded.
    pub(super) async fn order(&mut self, set: Set, command: Command) -> Answered<()> {
        let asked = self.link("an order")?.ask(Request::Set(set), self.settings.answer_within);
        let answer = asked.answer().await;
        self.heard(answer, command).await
    }

    async fn heard(&mut self, answer: Result<Reply, LinkFault>, command: Command) -> Answered<()> {
        match answer {
            Ok(Reply::Acknowledged) => Ok(()),
            Ok(_) => Err(self.denied(command).await?),
            Err(fault) => Err(self.broken(fault, "an order")),
        }
    }

    /// Returns the reason why an order was refused; without control every order is refused.
    async fn denied(&mut self, command: Command) -> Answered<DeviceError> {
        if self.get(Get::Enable).await? != "ON" {
            return Ok(self.taken());
        }
        let machine = self.machine();
        Ok(DeviceError::Refused { machine, command, answer: Answer::WrongState, state: State::Idle })
    }

    /// Takes control of the controller.
    pub(super) async fn take(&mut self) -> Answered<()> {
        let enable = Set::Enable { password: self.settings.control_password.clone() };
        let asked = self.link("control")?.ask(Request::Set(enable), self.settings.answer_within);
        match asked.answer().await {
            Ok(Reply::Acknowledged) => self.owned = true,
            Ok(_) => return Err(DeviceError::Password { machine: self.machine(), key: "control_password" }),
            Err(fault) => return Err(self.broken(fault, "control")),
        }
        Ok(())
    }

    /// Aborts at once, whichever client has control: the two lines go out together without waiting.
    pub(super) async fn abort(&mut self) -> Answered<()> {
        let enable = Set::Enable { password: self.settings.control_password.clone() };
        let within = self.settings.answer_within;
        let link = self.link("an abort")?;
        let (taken, aborted) = (link.ask(Request::Set(enable), within), link.ask(Request::Set(Set::Abort), within));
        if let Ok(Reply::Refused) = taken.answer().await {
            return Err(DeviceError::Password { machine: self.machine(), key: "control_password" });
        }
        self.owned = true;
        let answer = aborted.answer().await;
        self.heard(answer, Command::Abort).await
    }

    /// Switches to a mode and waits until the controller reports that mode and an idle interpreter.
    pub(super) async fn enter(&mut self, mode: Mode, command: Command) -> Answered<()> {
        self.order(Set::Mode(mode), command).await?;
        self.until("the mode", |seen| seen.mode == mode && seen.interpreter == Interpreter::Idle).await.map(drop)
    }

    /// Opens a program and checks that it is then the open one. A failed open is acknowledged too, and leaves the
    /// previous program open.
    pub(super) async fn open(&mut self, path: &str, command: Command) -> Answered<()> {
        self.errors().await?;
        self.order(Set::Open(path.to_owned()), command).await?;
        let opened = self.until("the program", |seen| seen.program.as_deref() == Some(path) && seen.line == 0).await;
        if !self.is_connected() {
            return opened.map(drop);
        }
        let errors = self.errors().await?;
        match opened {
            Ok(_) if errors.is_empty() => Ok(()),
            Err(error) if errors.is_empty() => Err(error),
            _ => Err(DeviceError::Reports {
                machine: self.machine(),
                what: "the program was opened",
                errors: errors.join("; "),
            }),
        }
    }

    /// Reads the state until a condition holds.
    pub(super) async fn until(&mut self, what: &'static str, holds: impl Fn(&Seen) -> bool) -> Answered<Seen> {
        let began = Instant::now();
        loop {
            let seen = self.look(false).await?;
            if self.owned && !seen.ours {
                return Err(self.taken());
            }
            if holds(&seen) {
                return Ok(seen);
            }
            if began.elapsed() > self.settings.settle_within {
                return Err(DeviceError::TimedOut {
                    machine: self.machine(),
                    what,
                    limit: self.settings.settle_within,
                });
            }
            sleep(ASKED_EVERY).await;
        }
    }

    /// Releases control and closes the connection.
    pub(super) async fn leave(&mut self) {
        if self.owned && self.link.is_some() {
            let _ = self.order(Set::Disable, Command::Release).await;
        }
        (self.link, self.owned) = (None, false);
    }

    pub(super) fn is_connected(&self) -> bool {
        self.link.is_some()
    }

    pub(super) fn machine(&self) -> Arc<str> {
        Arc::clone(&self.name)
    }

    pub(super) fn taken(&self) -> DeviceError {
        DeviceError::ControlTaken { machine: self.machine() }
    }

    fn link(&self, what: &'static str) -> Answered<&Link> {
        let never = || DeviceError::NotConnected { machine: self.machine(), what };
        self.link.as_ref().ok_or_else(|| self.lost.clone().unwrap_or_else(never))
    }

    fn foreign(&self, asked: &'static str, told: &str) -> DeviceError {
        DeviceError::NotLinuxcnc { machine: self.machine(), asked, told: told.chars().take(80).collect() }
    }

    /// Returns the error of an unanswered request, and closes a connection that cannot be used any more.
    fn broken(&mut self, fault: LinkFault, what: &'static str) -> DeviceError {
        let error = self.fault(fault, what);
        if fault != LinkFault::Unsendable {
            (self.link, self.owned, self.lost) = (None, false, Some(error.clone()));
        }
        error
    }

    fn fault(&self, fault: LinkFault, what: &'static str) -> DeviceError {
        let (machine, limit) = (self.machine(), self.settings.answer_within);
        match fault {
            LinkFault::Unreachable(why) => DeviceError::Unreachable { machine, why, limit },
            LinkFault::TimedOut => DeviceError::TimedOut { machine, what, limit },
            LinkFault::Disconnected => DeviceError::Disconnected { machine, what },
            LinkFault::Nonsense => DeviceError::NotLinuxcnc { machine, asked: what, told: "lines without end".into() },
            LinkFault::Unsendable => DeviceError::Unsendable { machine, what },
        }
    }
}
