//! Parameters of the interface for programs: one table of them reads the requests and describes them in OpenAPI. An
//! unknown parameter, a second one of the same name, and a value outside the limits are refused.

use axum::http::HeaderMap;
use serde_json::{Value, json};

use crate::problem::{Problem, ProblemKind, shortened};

/// Parameter of an address.
pub(super) struct Parameter {
    pub(super) name: &'static str,
    pub(super) place: Place,
    pub(super) kind: Kind,
    pub(super) description: &'static str,
    pub(super) example: &'static str,
}

/// Place of a parameter in a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    Path,
    Query,
    Header,
}

/// Allowed values of a parameter.
pub(super) enum Kind {
    /// Whole number from `min` to `max`.
    Number { min: u64, max: u64, default: Option<u64> },
    /// Text of 1 to `max` characters.
    Text { max: usize },
    /// One of some words.
    Words(&'static [&'static str]),
    /// Position in the list of runs: the time at which a run began and its name, with `~` in between.
    Cursor,
}

/// Largest number that every reader of JSON understands exactly: 2^53 - 1.
pub(super) const MAX_EXACT: u64 = 9_007_199_254_740_991;
/// Maximum length of the name of a run, in characters.
const MAX_NAME: usize = 255;
/// Pattern of a cursor in OpenAPI, which [`is_cursor`] checks.
const CURSOR: &str =
    r"^[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{1,9})?Z~[^\u0000-\u001f/]{1,255}$";

pub(super) const RUN: Parameter = Parameter {
    name: "run",
    place: Place::Path,
    kind: Kind::Text { max: MAX_NAME },
    description: "Name of the run: the name of its folder.",
    example: "freeform-mirror-20260704T120000Z-SIMULATION",
};
pub(super) const CYCLE: Parameter = Parameter {
    name: "cycle",
    place: Place::Path,
    kind: Kind::Number { min: 1, max: u32::MAX as u64, default: None },
    description: "Number of the cycle.",
    example: "1",
};

impl Kind {
    /// Returns the JSON schema of the values.
    pub(super) fn schema(&self) -> Value {
        match self {
            Self::Number { min, max, default: None } => json!({ "type": "integer", "minimum": min, "maximum": max }),
            Self::Number { min, max, default } => {
                json!({ "type": "integer", "minimum": min, "maximum": max, "default": default })
            }
            Self::Text { max } => json!({ "type": "string", "minLength": 1, "maxLength": max }),
            Self::Words(words) => json!({ "type": "string", "enum": words }),
            Self::Cursor => json!({ "type": "string", "pattern": CURSOR }),
        }
    }

    /// Returns the allowed values in words.
    fn words(&self) -> String {
        match self {
            Self::Number { min, max, .. } => format!("a whole number from {min} to {max}"),
            Self::Text { max } => format!("a text of 1 to {max} characters"),
            Self::Words(words) => words.join(", "),
            Self::Cursor => "the next_cursor of an earlier answer".into(),
        }
    }

    /// Returns the value in `text`; `None` if it is not allowed.
    fn parse(&self, text: &str) -> Option<Argument> {
        let is = match self {
            Self::Number { min, max, .. } => {
                // The number parser would accept a sign.
                let is_plain = text.bytes().all(|byte| byte.is_ascii_digit());
                let number = text.parse::<u64>().ok().filter(|_| is_plain);
                return number.filter(|number| (*min..=*max).contains(number)).map(Argument::Number);
            }
            Self::Text { max } => (1..=*max).contains(&text.chars().count()),
            Self::Words(words) => words.contains(&text),
            Self::Cursor => is_cursor(text),
        };
        is.then(|| Argument::Text(text.to_owned()))
    }
}

/// Returns true if `text` has the form of [`CURSOR`].
fn is_cursor(text: &str) -> bool {
    let Some((began, name)) = text.split_once('~') else { return false };
    let (whole, fraction) = match began.split_at_checked(19) {
        Some((whole, rest)) => (whole, rest),
        None => return false,
    };
    let fits = |byte: u8, form: u8| if form == b'0' { byte.is_ascii_digit() } else { byte == form };
    let is_time = whole.bytes().zip(*b"0000-00-00T00:00:00").all(|(byte, form)| fits(byte, form));
    let is_fraction = match fraction.strip_suffix('Z') {
        Some("") => true,
        Some(rest) => rest
            .strip_prefix('.')
            .is_some_and(|digits| (1..=9).contains(&digits.len()) && digits.bytes().all(|byte| byte.is_ascii_digit())),
        None => false,
    };
    let is_name = (1..=MAX_NAME).contains(&name.chars().count()) && name.chars().all(|c| c > '\u{1f}' && c != '/');
    is_time && is_fraction && is_name
}

/// Value of a parameter.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Argument {
    Number(u64),
    Text(String),
}

/// Values of the parameters of a request.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Arguments(Vec<(&'static str, Argument)>);

impl Arguments {
    /// Reads the values of `parameters` from the path, the query and the headers of a request.
    ///
    /// # Errors
    /// An unknown parameter in the query, a parameter that is given twice, a value that is not allowed, and an escape that
    /// is not UTF-8.
    pub(super) fn read(
        parameters: &[Parameter],
        path: &[(String, String)],
        query: Option<&str>,
        headers: &HeaderMap,
    ) -> Result<Self, Problem> {
        let mut read = Self::default();
        for (name, value) in path {
            read.add(parameters, Place::Path, name, value)?;
        }
        for pair in query.filter(|query| !query.is_empty()).into_iter().flat_map(|query| query.split('&')) {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            let [name, value] = [name, value]
                .map(|text| decoded(text).ok_or_else(|| Problem::with_parameter(name, value, "percent-encoded UTF-8")));
            read.add(parameters, Place::Query, &name?, &value?)?;
        }
        for Parameter { name, .. } in parameters.iter().filter(|of| of.place == Place::Header) {
            for value in headers.get_all(*name) {
                read.add(parameters, Place::Header, name, value.to_str().unwrap_or("\u{fffd}"))?;
            }
        }
        for Parameter { name, kind, .. } in parameters {
            let is_missing = read.0.iter().all(|(known, _)| known != name);
            if let (true, Kind::Number { default: Some(default), .. }) = (is_missing, kind) {
                read.0.push((name, Argument::Number(*default)));
            }
        }
        Ok(read)
    }

    fn add(&mut self, parameters: &[Parameter], place: Place, name: &str, value: &str) -> Result<(), Problem> {
        let Some(of) = parameters.iter().find(|of| of.place == place && of.name == name) else {
            let known: Vec<&str> = parameters.iter().filter(|of| of.place == place).map(|of| of.name).collect();
            let known = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
            let detail = format!("there is no parameter {:?} here; the parameters are: {known}", shortened(name));
            return Err(Problem::new(ProblemKind::Parameter, detail).with_parameter_name(name).with_allowed(known));
        };
        if self.0.iter().any(|(given, _)| *given == of.name) {
            let detail = format!("the parameter {name} is given twice; give it once");
            return Err(Problem::new(ProblemKind::Parameter, detail).with_parameter_name(name));
        }
        let argument = of.kind.parse(value).ok_or_else(|| Problem::with_parameter(name, value, of.kind.words()))?;
        self.0.push((of.name, argument));
        Ok(())
    }

    /// Returns the number of the parameter `name`; `None` if it was not given and has no default.
    pub(super) fn number(&self, name: &str) -> Option<u64> {
        self.0.iter().find_map(|(of, argument)| match argument {
            Argument::Number(number) if *of == name => Some(*number),
            _ => None,
        })
    }

    /// Returns the text of the parameter `name`; `None` if it was not given.
    pub(super) fn text(&self, name: &str) -> Option<&str> {
        self.0.iter().find_map(|(of, argument)| match argument {
            Argument::Text(text) if *of == name => Some(text.as_str()),
            _ => None,
        })
    }
}

/// Decodes a part of a query: `+` is a space, and `%` begins a byte in two hexadecimal digits. Returns `None` if the
/// result is not UTF-8, or if digits are missing.
fn decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let [first, after @ ..] = rest {
        rest = after;
        bytes.push(match first {
            b'+' => b' ',
            b'%' => {
                let (digits, after) = rest.split_first_chunk::<2>()?;
                rest = after;
                let digit = |byte: u8| char::from(byte).to_digit(16);
                u8::try_from(16 * digit(digits[0])? + digit(digits[1])?).ok()?
            }
            other => *other,
        });
    }
    String::from_utf8(bytes).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const OWN: [Parameter; 4] = [
        RUN,
        Parameter {
            name: "limit",
            place: Place::Query,
            kind: Kind::Number { min: 1, max: 500, default: Some(50) },
            description: "",
            example: "",
        },
        Parameter {
            name: "result",
            place: Place::Query,
            kind: Kind::Words(&["open", "accepted"]),
            description: "",
            example: "",
        },
        Parameter {
            name: "Last-Event-ID",
            place: Place::Header,
            kind: Kind::Number { min: 0, max: MAX_EXACT, default: None },
            description: "",
            example: "",
        },
    ];

    fn read(query: &str) -> Result<Arguments, Problem> {
        Arguments::read(&OWN, &[("run".into(), "a b".into())], Some(query), &HeaderMap::new())
    }

    #[test]
    fn arguments_are_read_with_defaults() {
        let found = read("").unwrap();
        assert_eq!((found.text("run"), found.number("limit"), found.text("result")), (Some("a b"), Some(50), None));
        let found = read("limit=7&result=%61ccepted").unwrap();
        assert_eq!((found.number("limit"), found.text("result")), (Some(7), Some("accepted")));
        assert_eq!((found.number("Last-Event-ID"), found.number("result")), (None, None));
        let headers = HeaderMap::from_iter([("last-event-id".parse().unwrap(), "12".parse().unwrap())]);
        assert_eq!(Arguments::read(&OWN, &[], None, &headers).unwrap().number("Last-Event-ID"), Some(12));
    }

    #[test]
    fn unknown_and_impossible_arguments_refused() {
        for query in [
            "limit=0",
            "limit=501",
            "limit=-1",
            "limit=%2B1",
            "limit=1.0",
            "limit=",
            "limit",
            "limit=18446744073709551616",
            "limit=1&limit=1",
            "result=",
            "result=Accepted",
            "other=1",
            "=",
            "&",
            "limit=1&",
            "limit=%zz",
            "limit=%3",
            "result=%ff",
            "run=a",
            "Last-Event-ID=1",
            "limit[]=1",
        ] {
            assert!(read(query).is_err(), "{query}");
        }
        let long = "x".repeat(256);
        assert!(Arguments::read(&OWN, &[("run".into(), long)], None, &HeaderMap::new()).is_err());
        let mut headers = HeaderMap::new();
        for value in ["1", "2"] {
            headers.append("last-event-id", value.parse().unwrap());
        }
        assert!(Arguments::read(&OWN, &[], None, &headers).is_err());
        headers.remove("last-event-id");
        headers.insert("last-event-id", axum::http::HeaderValue::from_bytes(b"\xff").unwrap());
        assert!(Arguments::read(&OWN, &[], None, &headers).is_err());
    }

    #[test]
    fn cursors_have_time_and_name() {
        for good in ["2026-07-04T12:00:00Z~a", "2026-07-04T12:00:00.123456789Z~a~b \u{e9}"] {
            assert!(is_cursor(good), "{good}");
        }
        let long = format!("2026-07-04T12:00:00Z~{}", "x".repeat(256));
        for bad in [
            "",
            "~",
            "2026-07-04T12:00:00Z",
            "2026-07-04T12:00:00Z~",
            "2026-07-04T12:00:00~a",
            "2026-07-04T12:00:00.Z~a",
            "2026-07-04T12:00:00.1234567890Z~a",
            "2026-07-04 12:00:00Z~a",
            "2026-07-04T12:00:00Z~a/b",
            "2026-07-04T12:00:00Z~a\nb",
            "\u{e9}\u{e9}\u{e9}\u{e9}\u{e9}\u{e9}\u{e9}\u{e9}\u{e9}\u{e9}~a",
            &long,
        ] {
            assert!(!is_cursor(bad), "{bad}");
        }
    }
}
