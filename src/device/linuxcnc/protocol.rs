//! Protocol of linuxcncrsh: requests are written strictly, answers are parsed leniently, without any I/O.
//!
//! A request is one line. After `echo` is off and `verbose` is on, each request has one line as its answer, in the
//! order of the requests; nothing else links the two. So an answer must name what was requested. A line that names
//! something else belongs to no request.

use std::collections::VecDeque;
use std::fmt;

/// Maximum length of a line, in both directions.
const MAX_LINE_LENGTH: usize = 4096;
/// Maximum number of successive lines that answer nothing; more are not this protocol.
const MAX_UNMATCHED: u32 = 100;

/// Query that needs no control and changes nothing, except that each error is reported once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the words of the protocol")]
pub enum Get {
    Enable,
    Inifile,
    Estop,
    Machine,
    Mode,
    JointHomed,
    Program,
    ProgramStatus,
    ProgramLine,
    AbsActPos,
    Error,
}

impl Get {
    fn word(self) -> &'static str {
        match self {
            Self::Enable => "enable",
            Self::Inifile => "inifile",
            Self::Estop => "estop",
            Self::Machine => "machine",
            Self::Mode => "mode",
            Self::JointHomed => "joint_homed",
            Self::Program => "program",
            Self::ProgramStatus => "program_status",
            Self::ProgramLine => "program_line",
            Self::AbsActPos => "abs_act_pos",
            Self::Error => "error",
        }
    }
}

/// Mode of the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the words of the protocol")]
pub enum ControllerMode {
    Manual,
    Auto,
    Mdi,
}

impl ControllerMode {
    fn word(self) -> &'static str {
        match self {
            Self::Manual => "manual",
            Self::Auto => "auto",
            Self::Mdi => "mdi",
        }
    }

    /// Returns the mode with the name `word`: `manual`, `auto` or `mdi`. Upper and lower case letters are treated as
    /// equal. Returns `None` for any other name.
    pub fn from_name(word: &str) -> Option<Self> {
        [Self::Manual, Self::Auto, Self::Mdi].into_iter().find(|mode| mode.word().eq_ignore_ascii_case(word))
    }
}

/// Order to a controller. Nothing else is ever sent: no jog, no emergency stop, no override, no homing.
#[derive(Clone, PartialEq, Eq)]
#[expect(missing_docs, reason = "the words of the protocol")]
pub enum Set {
    Verbose,
    /// Takes control from any other client.
    Enable {
        password: String,
    },
    /// Releases control.
    Disable,
    Mode(ControllerMode),
    Mdi(String),
    Open(String),
    Run,
    Pause,
    Resume,
    Abort,
}

impl Set {
    fn words(&self) -> (&'static str, &str) {
        match self {
            Self::Verbose => ("verbose", "on"),
            Self::Enable { password } => ("enable", password),
            Self::Disable => ("enable", "off"),
            Self::Mode(mode) => ("mode", mode.word()),
            Self::Mdi(line) => ("mdi", line),
            Self::Open(path) => ("open", path),
            Self::Run => ("run", ""),
            Self::Pause => ("pause", ""),
            Self::Resume => ("resume", ""),
            Self::Abort => ("abort", ""),
        }
    }
}

impl fmt::Debug for Set {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.words() {
            ("enable", password) if password != "off" => f.write_str("set enable ..."),
            (word, rest) => write!(f, "set {word} {rest}"),
        }
    }
}

/// Line to the controller.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the words of the protocol")]
pub enum RshRequest {
    Hello { password: String },
    EchoOff,
    Get(Get),
    Set(Set),
}

/// Content of an answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RshReply {
    /// Requested value.
    Value(String),
    /// Acknowledged. This does not mean that it succeeded.
    Acknowledged,
    /// Refused.
    Refused,
}

impl RshRequest {
    /// Returns the line of the request, with its line end. Returns `None` if the line is too long or has a character
    /// other than printable ASCII.
    pub fn line(&self) -> Option<String> {
        let line = match self {
            Self::Hello { password } => format!("hello {password} regrind 1.1"),
            Self::EchoOff => "set echo off".to_owned(),
            Self::Get(get) => format!("get {}", get.word()),
            Self::Set(set) => {
                let (word, rest) = set.words();
                format!("set {word} {rest}").trim_end().to_owned()
            }
        };
        let plain = line.chars().all(|c| c == ' ' || c.is_ascii_graphic());
        (plain && line.len() < MAX_LINE_LENGTH).then(|| line + "\r\n")
    }

    /// Returns the reply that a line contains for this request, or `None` if the line does not answer it.
    pub fn answer(&self, line: &str) -> Option<RshReply> {
        match self {
            Self::Hello { .. } => said(line, "hello"),
            // The answer is the echo of the request itself.
            Self::EchoOff => None,
            Self::Get(get) => match (after(line, get.word()), after(line, "get")) {
                (Some(value), _) => Some(RshReply::Value(value.to_owned())),
                (_, Some(rest)) => refused(rest, get.word()),
                _ => None,
            },
            Self::Set(set) => {
                let rest = after(line, "set")?;
                let (word, _) = set.words();
                match after(rest, word) {
                    Some(rest) if rest.eq_ignore_ascii_case("ack") => Some(RshReply::Acknowledged),
                    _ => refused(rest, word),
                }
            }
        }
    }
}

/// Returns the text that follows `word`, without blanks at its ends, if `line` begins with `word` as a complete word.
/// Returns `None` for any other line. Upper and lower case letters are treated as equal.
fn after<'a>(line: &'a str, word: &str) -> Option<&'a str> {
    let (head, rest) = line.split_at_checked(word.len())?;
    let ends = rest.is_empty() || rest.starts_with([' ', '\t']);
    (ends && head.eq_ignore_ascii_case(word)).then(|| rest.trim())
}

/// Parses `line` as the answer to the request `hello`. `word` is the name of this request. Returns the name and version
/// of the server from `HELLO ACK name version`. Returns a refusal for `HELLO NAK`. Returns `None` for any other line.
fn said(line: &str, word: &str) -> Option<RshReply> {
    let rest = after(line, word)?;
    match after(rest, "ack") {
        Some(value) => Some(RshReply::Value(value.to_owned())),
        None => rest.eq_ignore_ascii_case("nak").then_some(RshReply::Refused),
    }
}

/// Returns a refusal if `rest` is `NAK`, or `word` followed by `NAK`. Returns `None` for any other text. A server
/// answers only `NAK` if it refuses a request before it evaluates `word`.
fn refused(rest: &str, word: &str) -> Option<RshReply> {
    let rest = after(rest, word).unwrap_or(rest);
    rest.eq_ignore_ascii_case("nak").then_some(RshReply::Refused)
}

/// Splitter of a byte stream into lines. An incomplete line waits for its rest. CR or LF ends a line; empty lines are
/// ignored.
#[derive(Debug, Default)]
pub struct LineSplitter {
    bytes: Vec<u8>,
}

impl LineSplitter {
    /// Adds `bytes` to the stored incomplete line. Returns the lines that these bytes complete, without line ends and
    /// without empty lines. Returns `None` if a line is longer than 4096 bytes, which is too long for this protocol.
    pub fn push(&mut self, bytes: &[u8]) -> Option<Vec<String>> {
        self.bytes.extend_from_slice(bytes);
        let mut lines = Vec::new();
        while let Some(end) = self.bytes.iter().position(|byte| matches!(byte, b'\r' | b'\n')) {
            if end > MAX_LINE_LENGTH {
                return None;
            }
            let line: Vec<u8> = self.bytes.drain(..=end).take(end).collect();
            // Every byte becomes a character: some answers contain garbage.
            let line: String = line.into_iter().map(char::from).collect();
            lines.extend(Some(line.trim().to_owned()).filter(|line| !line.is_empty()));
        }
        (self.bytes.len() <= MAX_LINE_LENGTH).then_some(lines)
    }
}

/// Pending requests in order, each with an attached value.
#[derive(Debug)]
pub struct PendingRequests<T> {
    requests: VecDeque<(RshRequest, T)>,
    unmatched: u32,
}

/// Meaning of a received line.
#[derive(Debug, PartialEq)]
pub enum LineMatch<T> {
    /// Answer to the oldest pending request.
    Answer(T, RshReply),
    /// Line of no pending request.
    Unmatched,
    /// Line of no pending request, one of more than `MAX_UNMATCHED` in a row: this is not the protocol.
    NotProtocol,
}

impl<T> Default for PendingRequests<T> {
    fn default() -> Self {
        Self { requests: VecDeque::new(), unmatched: 0 }
    }
}

impl<T> PendingRequests<T> {
    /// Appends `request`, which was sent, to the pending requests. `kept` is any value of the caller;
    /// [`PendingRequests::match_line`] returns it together with the answer.
    pub fn push(&mut self, request: RshRequest, kept: T) {
        self.requests.push_back((request, kept));
    }

    /// Returns the value that the caller attached to the oldest pending request. Returns `None` if no request is
    /// pending.
    pub fn first(&self) -> Option<&T> {
        self.requests.front().map(|(_, kept)| kept)
    }

    /// Removes all pending requests and returns the values attached to them.
    pub fn drain(&mut self) -> impl Iterator<Item = T> + '_ {
        self.requests.drain(..).map(|(_, kept)| kept)
    }

    /// Checks if `line` answers the oldest pending request. If it does, removes this request and returns the answer and
    /// the value that the caller attached to the request. Otherwise returns `Unmatched`. Returns `NotProtocol` after
    /// more than 100 unmatched lines in a row, because the server then does not use this protocol.
    pub fn match_line(&mut self, line: &str) -> LineMatch<T> {
        match self.requests.front().and_then(|(request, _)| request.answer(line)) {
            Some(reply) => {
                self.unmatched = 0;
                match self.requests.pop_front() {
                    Some((_, kept)) => LineMatch::Answer(kept, reply),
                    None => LineMatch::Unmatched,
                }
            }
            None => {
                self.unmatched += 1;
                if self.unmatched > MAX_UNMATCHED { LineMatch::NotProtocol } else { LineMatch::Unmatched }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Recorded session with LinuxCNC 2.9, byte by byte.
    const SESSION: [(&str, &str); 17] = [
        ("hello EMC regrind 1.1\r\n", "HELLO ACK EMCNETSVR 1.1\r\n"),
        ("set echo off\r\n", "set echo off\r\n"),
        ("set verbose on\r\n", "SET VERBOSE ACK\n\r"),
        ("get inifile\r\n", "INIFILE /home/cnc/Grinder A/grinder.ini\r\n"),
        ("set run\r\n", "SET RUN NAK\n\r"),
        ("set enable EMCTOO\r\n", "SET ENABLE ACK\n\r"),
        ("get enable\r\n", "ENABLE ON\r\n"),
        ("set mode auto\r\n", "SET MODE ACK\n\r"),
        ("get mode\r\n", "MODE AUTO\r\n"),
        ("set open /srv/regrind/Part-c1.ngc\r\n", "SET OPEN ACK\n\r"),
        ("get program\r\n", "PROGRAM /srv/regrind/Part-c1.ngc\r\n"),
        ("get error\r\n", "ERROR Linear move on line 3 would exceed X's positive limit\r\n"),
        ("get error\r\n", "ERROR OK\r\n"),
        ("get program_status\r\n", "PROGRAM_STATUS RUNNING\r\n"),
        ("get program_line\r\n", "PROGRAM_LINE 528\r\n"),
        ("get joint_homed\r\n", "JOINT_HOMED YES YES YES NO NO NO\r\n"),
        ("set abort\r\n", "SET ABORT ACK\n\r"),
    ];

    fn requests() -> Vec<RshRequest> {
        let password = String::from;
        let path = "/srv/regrind/Part-c1.ngc".to_owned();
        vec![
            RshRequest::Hello { password: password("EMC") },
            RshRequest::EchoOff,
            RshRequest::Set(Set::Verbose),
            RshRequest::Get(Get::Inifile),
            RshRequest::Set(Set::Run),
            RshRequest::Set(Set::Enable { password: password("EMCTOO") }),
            RshRequest::Get(Get::Enable),
            RshRequest::Set(Set::Mode(ControllerMode::Auto)),
            RshRequest::Get(Get::Mode),
            RshRequest::Set(Set::Open(path)),
            RshRequest::Get(Get::Program),
            RshRequest::Get(Get::Error),
            RshRequest::Get(Get::Error),
            RshRequest::Get(Get::ProgramStatus),
            RshRequest::Get(Get::ProgramLine),
            RshRequest::Get(Get::JointHomed),
            RshRequest::Set(Set::Abort),
        ]
    }

    fn replies() -> Vec<RshReply> {
        let value = |text: &str| RshReply::Value(text.to_owned());
        vec![
            value("EMCNETSVR 1.1"),
            RshReply::Acknowledged,
            value("/home/cnc/Grinder A/grinder.ini"),
            RshReply::Refused,
            RshReply::Acknowledged,
            value("ON"),
            RshReply::Acknowledged,
            value("AUTO"),
            RshReply::Acknowledged,
            value("/srv/regrind/Part-c1.ngc"),
            value("Linear move on line 3 would exceed X's positive limit"),
            value("OK"),
            value("RUNNING"),
            value("528"),
            value("YES YES YES NO NO NO"),
            RshReply::Acknowledged,
        ]
    }

    #[test]
    fn request_lines_match_session() {
        let sent: Vec<_> = requests().iter().map(|request| request.line().unwrap()).collect();
        assert_eq!(sent, SESSION.map(|(asked, _)| asked));
    }

    #[test]
    fn replies_match_for_any_chunking() {
        let all: String = SESSION.map(|(_, answer)| answer).concat();
        for size in [1, 2, 3, 7, 16, 1000] {
            let (mut lines, mut waiting, mut found) = (LineSplitter::default(), PendingRequests::default(), Vec::new());
            for request in requests().into_iter().filter(|request| *request != RshRequest::EchoOff) {
                waiting.push(request, ());
            }
            for bytes in all.as_bytes().chunks(size) {
                for line in lines.push(bytes).unwrap() {
                    match waiting.match_line(&line) {
                        LineMatch::Answer((), reply) => found.push(reply),
                        LineMatch::Unmatched => assert_eq!(line, "set echo off"),
                        LineMatch::NotProtocol => panic!("{line}"),
                    }
                }
            }
            assert_eq!(found, replies(), "in pieces of {size}");
            assert!(waiting.first().is_none());
        }
    }

    #[test]
    fn unrelated_line_is_no_answer() {
        let run = RshRequest::Set(Set::Run);
        assert_eq!(run.answer("SET NAK"), Some(RshReply::Refused));
        assert_eq!(run.answer("set run ack"), Some(RshReply::Acknowledged));
        for line in
            ["SET OPEN ACK", "SET RUNNING ACK", "SET RUN", "SET ACK", "RUN ACK", "\u{fffd}", "", "SET RUN ACK ACK"]
        {
            assert_eq!(run.answer(line), None, "{line}");
        }
        let line = RshRequest::Get(Get::Program);
        assert_eq!(line.answer("GET PROGRAM NAK"), Some(RshReply::Refused));
        assert_eq!(line.answer("GET NAK"), Some(RshReply::Refused));
        // One word is the beginning of the other.
        assert_eq!(line.answer("PROGRAM_LINE 3"), None);
        assert_eq!(line.answer("GET PROGRAM_LINE NAK"), None);
        assert_eq!(RshRequest::Hello { password: "x".into() }.answer("HELLO NAK"), Some(RshReply::Refused));
    }

    #[test]
    fn request_line_refuses_injection() {
        for path in ["/a\r\nset run", "/a\nb", "/\u{e4}", &"x".repeat(5000)] {
            assert_eq!(RshRequest::Set(Set::Open(path.to_owned())).line(), None, "{path}");
        }
        assert!(!format!("{:?}", Set::Enable { password: "SECRET".into() }).contains("SECRET"));
    }

    #[test]
    fn line_flood_is_not_protocol() {
        let mut waiting = PendingRequests::default();
        waiting.push(RshRequest::Get(Get::Mode), ());
        let told: Vec<_> = (0..102).map(|_| waiting.match_line("ERROR what")).collect();
        assert_eq!((&told[0], &told[101]), (&LineMatch::Unmatched, &LineMatch::NotProtocol));
        assert!(LineSplitter::default().push(&[b'x'; 5000]).is_none());
        assert!(LineSplitter::default().push(&[0xff, b'\n']).is_some());
    }
}
