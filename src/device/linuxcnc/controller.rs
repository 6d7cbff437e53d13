//! Exchange with a controller: identity, state, orders.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::link::{Link, LinkFault};
use super::protocol::{ControllerMode, Get, RshReply, RshRequest, Set};
use super::settings::LinuxcncSettings;
use crate::error::{DeviceError, DeviceResult};
use crate::handshake::Fault;
use crate::handshake::{Answer, MachineCommand, MachineState};
use crate::{Connector, LineAddress};

/// Interval between two queries while waiting for something.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Maximum number of errors read at once.
const MAX_ERRORS: usize = 32;

/// State of the interpreter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Interpreter {
    Idle,
    Running,
    Paused,
}

/// State of a controller, read in one exchange.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ControllerState {
    /// True if this client has control.
    pub(super) has_control: bool,
    /// True if the stop circuit is open.
    pub(super) stop_circuit_open: bool,
    /// True if the drives are on.
    pub(super) drives_on: bool,
    pub(super) mode: ControllerMode,
    pub(super) homed: bool,
    pub(super) interpreter: Interpreter,
    /// Program that is open.
    pub(super) program: Option<String>,
    pub(super) line: u32,
    /// Position, as the controller reports it.
    pub(super) position: String,
    /// Errors that it reports, each once.
    pub(super) errors: Vec<String>,
}

impl ControllerState {
    /// Returns the fault that prevents any job: an open stop circuit, or drives that are off. Returns `None` if there
    /// is neither.
    pub(super) fn standing_fault(&self) -> Option<Fault> {
        match (self.stop_circuit_open, self.drives_on) {
            (true, _) => Some(Fault::StopCircuit),
            (false, false) => Some(Fault::Supplies),
            (false, true) => None,
        }
    }
}

/// Controller at the other end of a connection.
#[derive(Debug)]
pub(super) struct Controller {
    pub(super) name: Arc<str>,
    settings: LinuxcncSettings,
    connector: Box<dyn Connector>,
    link: Option<Link>,
    /// Reason why the connection was lost. A later request returns this error, and not "never connected".
    link_error: Option<DeviceError>,
    /// True if this client has taken control on this connection.
    pub(super) has_control: bool,
    /// Machine configuration, which serves as its name.
    configuration: Option<String>,
}

impl Controller {
    pub(super) fn new(settings: LinuxcncSettings, dial: Box<dyn Connector>) -> Self {
        let name = format!("grinder at {}:{} (LinuxCNC)", settings.host, settings.port).into();
        Self { name, settings, connector: dial, link: None, link_error: None, has_control: false, configuration: None }
    }

    /// Closes an existing connection, connects to the controller again and checks the identity of the machine. Sends no
    /// order to the machine; only turns off the echo and turns on the acknowledgements for this connection. Returns the
    /// name of the machine: the name of the server and the path of its INI file.
    ///
    /// # Errors
    /// Returns an error if the controller cannot be reached, if the password for the connection is wrong, if the
    /// answers are not those of LinuxCNC, or if the machine has another name than expected.
    pub(super) async fn connect(&mut self) -> DeviceResult<String> {
        (self.link, self.has_control) = (None, false);
        let LinuxcncSettings { host, port, answer_timeout, connect_password, .. } = &self.settings;
        let line = LineAddress::Tcp { host: host.clone(), port: *port };
        let link = Link::open(&line, self.connector.as_mut(), *answer_timeout).await;
        let link = link.map_err(|fault| self.fault(fault, "a connection"))?;
        let hello = RshRequest::Hello { password: connect_password.clone() };
        let server = match link.ask(hello, *answer_timeout).answer().await {
            Ok(RshReply::Value(server)) => server,
            Ok(_) => return Err(DeviceError::Password { machine: self.machine(), key: "connect_password" }),
            Err(LinkFault::NotProtocol | LinkFault::TimedOut) => {
                return Err(self.not_linuxcnc("hello", "no valid answer"));
            }
            Err(fault) => return Err(self.fault(fault, "hello")),
        };
        link.send_unanswered(RshRequest::EchoOff);
        let verbose = link.ask(RshRequest::Set(Set::Verbose), *answer_timeout).answer().await;
        match verbose.map_err(|fault| self.fault(fault, "set verbose"))? {
            RshReply::Acknowledged => {}
            other => return Err(self.not_linuxcnc("set verbose", &format!("{other:?}"))),
        }
        (self.link, self.link_error) = (Some(link), None);
        let configuration = self.get(Get::Inifile).await?;
        self.check_name(&server, &configuration)?;
        self.read_state(false).await?;
        let name = format!("{server}, {configuration}");
        self.configuration = Some(configuration);
        Ok(name)
    }

    fn check_name(&mut self, server: &str, configuration: &str) -> DeviceResult<()> {
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

    /// Reads the complete state of the controller and returns it. If `errors` is true, also reads the error messages.
    /// The controller reports each message only once and to only one client. If `errors` is false, the list of messages
    /// in the result is empty.
    ///
    /// # Errors
    /// Returns an error if the connection fails or if an answer is not valid.
    pub(super) async fn read_state(&mut self, errors: bool) -> DeviceResult<ControllerState> {
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
        let asked = WHAT.map(|what| (what, link.ask(RshRequest::Get(what), self.settings.answer_timeout)));
        let mut told = Vec::with_capacity(WHAT.len());
        for (what, asked) in asked {
            let answer = asked.answer().await;
            told.push(self.value(what, answer)?);
        }
        let errors = if errors { self.errors().await? } else { Vec::new() };
        self.decode_state(&told, errors)
    }

    fn decode_state(&self, told: &[String], errors: Vec<String>) -> DeviceResult<ControllerState> {
        let [enable, estop, machine, mode, homed, program, interpreter, line, at] = told else {
            return Err(self.not_linuxcnc("its status", "an incomplete answer"));
        };
        let switch = |what: &'static str, told: &str| match told {
            "ON" => Ok(true),
            "OFF" => Ok(false),
            other => Err(self.not_linuxcnc(what, other)),
        };
        let interpreter = match interpreter.as_str() {
            "IDLE" => Interpreter::Idle,
            "RUNNING" => Interpreter::Running,
            "PAUSED" => Interpreter::Paused,
            other => return Err(self.not_linuxcnc("get program_status", other)),
        };
        let homed: Vec<&str> = homed.split_whitespace().take(self.settings.joints).collect();
        Ok(ControllerState {
            has_control: switch("get enable", enable)?,
            stop_circuit_open: switch("get estop", estop)?,
            drives_on: switch("get machine", machine)?,
            mode: ControllerMode::from_name(mode).ok_or_else(|| self.not_linuxcnc("get mode", mode))?,
            homed: homed.len() == self.settings.joints && homed.iter().all(|joint| *joint == "YES"),
            interpreter,
            program: Some(program.clone()).filter(|program| program != "NONE"),
            line: line.parse().map_err(|_| self.not_linuxcnc("get program_line", line))?,
            position: at.clone(),
            errors,
        })
    }

    /// Reads the error messages that the controller has not yet reported, oldest first and at most 32. The controller
    /// reports each message only once. Returns an empty list if there are no messages.
    ///
    /// # Errors
    /// Returns an error if the connection fails or if an answer is not valid.
    pub(super) async fn errors(&mut self) -> DeviceResult<Vec<String>> {
        let mut errors = Vec::new();
        while errors.len() < MAX_ERRORS {
            match self.get(Get::Error).await? {
                none if none == "OK" => break,
                error => errors.push(error),
            }
        }
        Ok(errors)
    }

    pub(super) async fn get(&mut self, what: Get) -> DeviceResult<String> {
        let asked = self.link("a question")?.ask(RshRequest::Get(what), self.settings.answer_timeout);
        let answer = asked.answer().await;
        self.value(what, answer)
    }

    fn value(&mut self, what: Get, answer: Result<RshReply, LinkFault>) -> DeviceResult<String> {
        match answer {
            Ok(RshReply::Value(value)) => Ok(value),
            Ok(other) => Err(self.not_linuxcnc("a question", &format!("{other:?} to {what:?}"))),
            Err(fault) => Err(self.broken(fault, "its status")),
        }
    }

    /// Sends the order `set` to the controller and waits for its acknowledgement. The acknowledgement means only that
    /// the order was received, not that it succeeded. `command` is the name of the order in errors.
    ///
    /// # Errors
    /// Returns an error if the controller refuses the order, if another client has control, or if the connection fails.
    pub(super) async fn order(&mut self, set: Set, command: MachineCommand) -> DeviceResult<()> {
        let asked = self.link("an order")?.ask(RshRequest::Set(set), self.settings.answer_timeout);
        let answer = asked.answer().await;
        self.check_acknowledged(answer, command).await
    }

    async fn check_acknowledged(
        &mut self,
        answer: Result<RshReply, LinkFault>,
        command: MachineCommand,
    ) -> DeviceResult<()> {
        match answer {
            Ok(RshReply::Acknowledged) => Ok(()),
            Ok(_) => Err(self.denied(command).await?),
            Err(fault) => Err(self.broken(fault, "an order")),
        }
    }

    /// Finds out why the controller has refused the order of `command`, and returns the reason as an error value. The
    /// reason is that another client has control, or that the state of the controller does not allow the order.
    ///
    /// # Errors
    /// Returns `Err` if the connection fails during this query.
    async fn denied(&mut self, command: MachineCommand) -> DeviceResult<DeviceError> {
        if self.get(Get::Enable).await? != "ON" {
            return Ok(self.control_taken());
        }
        let machine = self.machine();
        Ok(DeviceError::Refused { machine, command, answer: Answer::WrongState, state: MachineState::Idle })
    }

    /// Takes control of the controller, so that it accepts orders of this client.
    pub(super) async fn take_control(&mut self) -> DeviceResult<()> {
        let enable = Set::Enable { password: self.settings.control_password.clone() };
        let asked = self.link("control")?.ask(RshRequest::Set(enable), self.settings.answer_timeout);
        match asked.answer().await {
            Ok(RshReply::Acknowledged) => self.has_control = true,
            Ok(_) => return Err(DeviceError::Password { machine: self.machine(), key: "control_password" }),
            Err(fault) => return Err(self.broken(fault, "control")),
        }
        Ok(())
    }

    /// Aborts the program of the controller, even if another client has control. Sends two orders directly after each
    /// other: one takes control, the other aborts. Sends the second order without waiting for the answer to the first,
    /// then waits for both answers.
    ///
    /// # Errors
    /// Returns an error if the password for control is wrong, if the controller does not acknowledge the abort, or if
    /// the connection fails.
    pub(super) async fn abort(&mut self) -> DeviceResult<()> {
        let enable = Set::Enable { password: self.settings.control_password.clone() };
        let within = self.settings.answer_timeout;
        let link = self.link("an abort")?;
        let (taken, aborted) =
            (link.ask(RshRequest::Set(enable), within), link.ask(RshRequest::Set(Set::Abort), within));
        if let Ok(RshReply::Refused) = taken.answer().await {
            return Err(DeviceError::Password { machine: self.machine(), key: "control_password" });
        }
        self.has_control = true;
        let answer = aborted.answer().await;
        self.check_acknowledged(answer, MachineCommand::Abort).await
    }

    /// Switches the controller to a mode, and waits until it reports that mode and no active program. `command` names
    /// the order in errors.
    pub(super) async fn enter(&mut self, mode: ControllerMode, command: MachineCommand) -> DeviceResult<()> {
        self.order(Set::Mode(mode), command).await?;
        self.wait_until("the mode", |seen| seen.mode == mode && seen.interpreter == Interpreter::Idle).await.map(drop)
    }

    /// Opens the program `path` at the controller. Then checks that the controller reports this program as the open
    /// one. The check is necessary because the controller also acknowledges a failed attempt; the previous program then
    /// stays open. `command` is the name of the order for error messages.
    ///
    /// # Errors
    /// Returns an error if the controller reports an error, if it does not open the program within `settle_timeout`, or
    /// if the connection fails.
    pub(super) async fn open(&mut self, path: &str, command: MachineCommand) -> DeviceResult<()> {
        self.errors().await?;
        self.order(Set::Open(path.to_owned()), command).await?;
        let opened =
            self.wait_until("the program", |seen| seen.program.as_deref() == Some(path) && seen.line == 0).await;
        if !self.is_connected() {
            return opened.map(drop);
        }
        let errors = self.errors().await?;
        match opened {
            Ok(_) if errors.is_empty() => Ok(()),
            Err(error) if errors.is_empty() => Err(error),
            _ => Err(DeviceError::ControllerErrors {
                machine: self.machine(),
                occasion: "the program was opened",
                errors: errors.join("; "),
            }),
        }
    }

    /// Reads the state of the controller repeatedly until `holds` returns true for this state. Returns this state.
    /// `what` is the name of the awaited state for error messages.
    ///
    /// # Errors
    /// Returns an error if `holds` is still false after `settle_timeout`, if another client takes control, or if the
    /// connection fails.
    pub(super) async fn wait_until(
        &mut self,
        what: &'static str,
        holds: impl Fn(&ControllerState) -> bool,
    ) -> DeviceResult<ControllerState> {
        let began = Instant::now();
        loop {
            let seen = self.read_state(false).await?;
            if self.has_control && !seen.has_control {
                return Err(self.control_taken());
            }
            if holds(&seen) {
                return Ok(seen);
            }
            if began.elapsed() > self.settings.settle_timeout {
                return Err(DeviceError::TimedOut {
                    machine: self.machine(),
                    operation: what,
                    limit: self.settings.settle_timeout,
                });
            }
            sleep(POLL_INTERVAL).await;
        }
    }

    /// Releases control and closes the connection.
    pub(super) async fn disconnect(&mut self) {
        if self.has_control && self.link.is_some() {
            let _ = self.order(Set::Disable, MachineCommand::Release).await;
        }
        (self.link, self.has_control) = (None, false);
    }

    pub(super) fn is_connected(&self) -> bool {
        self.link.is_some()
    }

    pub(super) fn machine(&self) -> Arc<str> {
        Arc::clone(&self.name)
    }

    pub(super) fn control_taken(&self) -> DeviceError {
        DeviceError::ControlTaken { machine: self.machine() }
    }

    fn link(&self, what: &'static str) -> DeviceResult<&Link> {
        let never = || DeviceError::NotConnected { machine: self.machine(), operation: what };
        self.link.as_ref().ok_or_else(|| self.link_error.clone().unwrap_or_else(never))
    }

    fn not_linuxcnc(&self, asked: &'static str, told: &str) -> DeviceError {
        DeviceError::NotLinuxcnc { machine: self.machine(), request: asked, reply: told.chars().take(80).collect() }
    }

    /// Converts `fault`, the reason why a request has no answer, to an error. `what` is the name of the request for the
    /// error message. Also closes the connection, except if the request was not sent because it is not one plain line.
    fn broken(&mut self, fault: LinkFault, what: &'static str) -> DeviceError {
        let error = self.fault(fault, what);
        if fault != LinkFault::Unsendable {
            (self.link, self.has_control, self.link_error) = (None, false, Some(error.clone()));
        }
        error
    }

    fn fault(&self, fault: LinkFault, what: &'static str) -> DeviceError {
        let (machine, limit) = (self.machine(), self.settings.answer_timeout);
        match fault {
            LinkFault::Unreachable(reason) => DeviceError::Unreachable { machine, kind: reason, limit },
            LinkFault::TimedOut => DeviceError::TimedOut { machine, operation: what, limit },
            LinkFault::Disconnected => DeviceError::Disconnected { machine, operation: what },
            LinkFault::NotProtocol => {
                DeviceError::NotLinuxcnc { machine, request: what, reply: "lines without end".into() }
            }
            LinkFault::Unsendable => DeviceError::Unsendable { machine, operation: what },
        }
    }
}
