//! A linuxcncrsh that stands in this process, does what a controller does with lines and programs, and goes wrong where
//! it is told to.

use std::collections::VecDeque;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::sync::{Arc, Mutex, MutexGuard};

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

/// Fault in the response to a line.
#[derive(Clone, Debug)]
pub enum Fault {
    /// The connection is closed, and nothing is done.
    Close,
    /// It is done, and the connection is closed.
    DoAndClose,
    /// Nothing is done, and it is refused.
    Nak,
    /// It is done, and refused.
    DoAndNak,
    /// Nothing is done, and it is acknowledged.
    Ignore,
    /// It is done; the answer waits until this is told.
    Late(Arc<Notify>),
    /// These bytes come before the answer.
    Say(&'static str),
    /// This comes instead of an answer.
    Instead(&'static str),
}

/// The controller.
#[derive(Default)]
pub struct FakeController {
    owner: Option<u64>,
    pub stopped: bool,
    pub off: bool,
    pub not_homed: bool,
    pub mode: String,
    pub interpreter: String,
    pub program: Option<String>,
    pub line: u32,
    pub errors: VecDeque<String>,
    log: Option<String>,
    /// Whether what programs and MDI write is written.
    pub writes_nothing: bool,
    /// The line, by its beginning, and what goes wrong with it, once.
    pub faults: Vec<(&'static str, Fault)>,
    /// The number of a line, of all that were heard, and what goes wrong with it.
    pub fault_at: Option<(usize, Fault)>,
    /// Every line that was heard.
    pub heard: Vec<String>,
    /// How often a program was begun.
    pub runs: u32,
}

/// A server of a plant, on a port that was free.
#[derive(Clone)]
pub struct FakeServer {
    pub port: u16,
    controller: Arc<Mutex<FakeController>>,
    heard: Arc<Notify>,
}

impl FakeServer {
    pub async fn serve() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let plant = FakeController { mode: "MANUAL".into(), interpreter: "IDLE".into(), ..FakeController::default() };
        let fake = Self {
            port: listener.local_addr().unwrap().port(),
            controller: Arc::new(Mutex::new(plant)),
            heard: Arc::default(),
        };
        let served = fake.clone();
        tokio::spawn(async move {
            for client in 1.. {
                let (stream, _) = listener.accept().await.unwrap();
                tokio::spawn(served.clone().attend(client, stream));
            }
        });
        fake
    }

    pub fn controller(&self) -> MutexGuard<'_, FakeController> {
        self.controller.lock().unwrap()
    }

    /// Waits until a line was heard that begins so.
    pub async fn has_heard(&self, begins: &str) {
        loop {
            let heard = self.heard.notified();
            if self.controller().heard.iter().any(|line| line.starts_with(begins)) {
                return;
            }
            heard.await;
        }
    }

    /// A second client takes control.
    pub fn steal(&self) {
        self.controller().owner = Some(u64::MAX);
    }

    async fn attend(self, client: u64, stream: TcpStream) {
        let (from, mut to) = stream.into_split();
        let mut lines = BufReader::new(from).lines();
        while let Ok(Some(line)) = lines.next_line().await {
            let line = line.trim().to_owned();
            let fault = self.controller().fault(&line);
            // Nobody else is heard between a line and what it does.
            let answer = match &fault {
                Some(Fault::Close) => return,
                Some(Fault::Nak) => nak(&line),
                Some(Fault::Ignore) => ack(&line),
                Some(Fault::DoAndNak) => self.controller().obey(client, &line).map(|_| nak(&line)).unwrap_or_default(),
                Some(Fault::Instead(bytes)) => (*bytes).to_owned(),
                _ => self.controller().obey(client, &line).unwrap_or_default(),
            };
            self.heard.notify_waiters();
            let answer = match fault {
                Some(Fault::DoAndClose) => return,
                Some(Fault::Late(told)) => {
                    told.notified().await;
                    answer
                }
                Some(Fault::Say(bytes)) => bytes.to_owned() + &answer,
                _ => answer,
            };
            // In halves: a line is whole when its end has come.
            let (half, other) = answer.split_at(answer.len() / 2);
            if to.write_all(half.as_bytes()).await.is_err() || to.write_all(other.as_bytes()).await.is_err() {
                return;
            }
        }
    }
}

fn words(line: &str) -> (String, String) {
    let mut words = line.split(' ');
    let [first, second] = [words.next(), words.next()].map(|word| word.unwrap_or_default().to_uppercase());
    (first, second)
}

fn ack(line: &str) -> String {
    format!("SET {} ACK\n\r", words(line).1)
}

fn nak(line: &str) -> String {
    let (first, second) = words(line);
    format!("{first} {second} NAK\n\r")
}

impl FakeController {
    fn fault(&mut self, line: &str) -> Option<Fault> {
        self.heard.push(line.to_owned());
        let number = self.heard.len() - 1;
        if self.fault_at.as_ref().is_some_and(|(at, _)| *at == number) {
            return self.fault_at.take().map(|(_, fault)| fault);
        }
        let found = self.faults.iter().position(|(begins, _)| line.starts_with(begins))?;
        Some(self.faults.remove(found).1)
    }

    /// Does what a line says, and returns the answer.
    fn obey(&mut self, client: u64, line: &str) -> Option<String> {
        let (first, second) = words(line);
        let rest = line.splitn(3, ' ').nth(2).unwrap_or_default();
        match first.as_str() {
            "HELLO" if second == "EMC" => Some("HELLO ACK EMCNETSVR 1.1\r\n".into()),
            "HELLO" => Some("HELLO NAK\r\n".into()),
            "GET" => Some(format!("{second} {}\r\n", self.query(client, &second))),
            "SET" if second == "ECHO" => Some(format!("{line}\r\n")),
            "SET" if second == "VERBOSE" => Some(ack(line)),
            "SET" if second == "ENABLE" => match rest {
                "EMCTOO" => {
                    self.owner = Some(client);
                    Some(ack(line))
                }
                "off" => {
                    self.owner = None;
                    Some(ack(line))
                }
                _ => Some(nak(line)),
            },
            "SET" if self.owner != Some(client) => Some("SET NAK\n\r".into()),
            "SET" if self.stopped || self.off => Some(nak(line)),
            "SET" => {
                self.act(&second, rest);
                Some(ack(line))
            }
            _ => None,
        }
    }

    fn query(&mut self, client: u64, what: &str) -> String {
        let switch = |on: bool| if on { "ON" } else { "OFF" }.to_owned();
        match what {
            "ENABLE" => switch(self.owner == Some(client)),
            "INIFILE" => "/etc/grinder/grinder.ini".into(),
            "ESTOP" => switch(self.stopped),
            "MACHINE" => switch(!self.off && !self.stopped),
            "MODE" => self.mode.clone(),
            "JOINT_HOMED" => if self.not_homed { "YES YES NO NO NO NO" } else { "YES YES YES NO NO NO" }.into(),
            "PROGRAM" => self.program.clone().unwrap_or("NONE".into()),
            "PROGRAM_STATUS" => self.interpreter.clone(),
            "PROGRAM_LINE" => self.line.to_string(),
            "ABS_ACT_POS" => "1.000000 2.000000 3.000000 0.000000 0.000000 0.000000".into(),
            "ERROR" => self.errors.pop_front().unwrap_or("OK".into()),
            _ => "NAK".into(),
        }
    }

    fn act(&mut self, what: &str, rest: &str) {
        let is_running = self.interpreter == "RUNNING";
        match what {
            "MODE" => self.mode = rest.to_uppercase(),
            "MDI" => self.write(rest),
            "OPEN" if self.interpreter == "IDLE" => match fs::metadata(rest) {
                Ok(_) => (self.program, self.line) = (Some(rest.to_owned()), 0),
                Err(_) => self.errors.push_back(format!("can't open {rest}")),
            },
            "RUN" if self.interpreter == "IDLE" && self.mode == "AUTO" => self.run(),
            "PAUSE" => self.interpreter = "PAUSED".into(),
            "RESUME" if !is_running => self.interpreter = "RUNNING".into(),
            "ABORT" => self.interpreter = "IDLE".into(),
            _ => self.errors.push_back(format!("can't do that ({what})")),
        }
    }

    fn text(&self) -> Vec<String> {
        let text = fs::read_to_string(self.program.as_deref().unwrap()).unwrap();
        text.lines().map(str::to_owned).collect()
    }

    fn run(&mut self) {
        self.runs += 1;
        (self.interpreter, self.line) = ("RUNNING".into(), 5);
        for line in &self.text()[..4] {
            self.write(line);
        }
    }

    /// Lets the program that runs come to its end.
    pub fn end(&mut self) {
        let text = self.text();
        for line in &text[text.len() - 4..] {
            self.write(line);
        }
        (self.interpreter, self.line) = ("IDLE".into(), text.len() as u32);
    }

    /// Breaks the program off that runs, with an error.
    pub fn fail(&mut self, error: &str) {
        self.errors.push_back(error.into());
        self.interpreter = "IDLE".into();
    }

    fn write(&mut self, line: &str) {
        let Some(comment) = line.strip_prefix('(').and_then(|line| line.strip_suffix(')')) else { return };
        if self.writes_nothing {
            return;
        }
        match comment.split_once(',') {
            Some(("LOGOPEN", path)) => {
                fs::write(path, "").unwrap();
                self.log = Some(path.to_owned());
            }
            Some(("LOGAPPEND", path)) => self.log = Some(path.to_owned()),
            Some(("LOG", text)) => {
                let mut file = OpenOptions::new().append(true).create(true).open(self.log.as_ref().unwrap()).unwrap();
                writeln!(file, "{text}").unwrap();
            }
            _ => {}
        }
    }
}
