//! A client that says exactly what it is told to, and keeps the cookies that it is given.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use serde_json::Value;

/// An answer.
#[derive(Debug)]
pub struct Answer {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    /// The values of a header.
    pub fn header(&self, name: &str) -> Vec<&str> {
        let pairs = self.head.lines().filter_map(|line| line.split_once(':'));
        pairs.filter(|(known, _)| known.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim()).collect()
    }
}

/// Sends a request as it stands, and reads the answer to its end.
pub fn raw(place: &str, request: &[u8]) -> Answer {
    let mut stream = TcpStream::connect(place).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    stream.write_all(request).unwrap();
    let mut bytes = Vec::new();
    // A server may close on who says too much.
    let _ = stream.read_to_end(&mut bytes);
    let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").map_or(bytes.len(), |at| at + 4);
    let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok()).unwrap_or(0);
    Answer { status, head, body: bytes[end..].to_vec() }
}

/// A browser, but for its eyes.
#[derive(Clone, Debug)]
pub struct Visitor {
    pub place: String,
    pub cookies: String,
    pub language: String,
}

impl Visitor {
    /// One that has no key.
    pub fn stranger(url: &str) -> Self {
        let place = url.trim_start_matches("http://").split('/').next().unwrap().to_owned();
        Self { place, cookies: String::new(), language: "en".into() }
    }

    /// One that came by the address with the key.
    pub fn with_key(url: &str) -> Self {
        let mut visitor = Self::stranger(url);
        let path = url.trim_start_matches("http://").trim_start_matches(&visitor.place).to_owned();
        let answer = visitor.get(&path);
        assert_eq!(answer.status, 303, "{answer:?}");
        let cookies = answer.header("set-cookie").into_iter().map(|cookie| cookie.split(';').next().unwrap());
        visitor.cookies = cookies.collect::<Vec<_>>().join("; ");
        visitor
    }

    pub fn get(&self, path: &str) -> Answer {
        let Self { place, cookies, language } = self;
        let request = format!(
            "GET {path} HTTP/1.1\r\nHost: {place}\r\nCookie: {cookies}\r\nAccept-Language: {language}\r\nConnection: close\r\n\r\n"
        );
        raw(place, request.as_bytes())
    }

    pub fn post(&self, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Answer {
        let Self { place, cookies, .. } = self;
        let more: String = headers.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let length = body.len();
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: {place}\r\nCookie: {cookies}\r\n{more}Content-Length: {length}\r\nConnection: close\r\n\r\n"
        );
        raw(place, &[head.as_bytes(), body].concat())
    }

    /// The token that stands in a page.
    pub fn token(&self, run: &str) -> String {
        let page = self.get(&format!("/runs/{run}")).text();
        let begin = page.split("name=\"regrind-token\" content=\"").nth(1).expect("a page with a token");
        begin.split('"').next().unwrap().to_owned()
    }

    /// Gives an order as the page does; returns whether it was taken, and what was said to it.
    pub fn order(&self, run: &str, order: &Value) -> (u16, bool, String) {
        self.give(&format!("/runs/{run}/orders"), run, order.to_string().as_bytes())
    }

    pub fn take_control(&self, run: &str) -> (u16, bool, String) {
        self.give(&format!("/runs/{run}/control"), run, b"")
    }

    fn give(&self, path: &str, run: &str, body: &[u8]) -> (u16, bool, String) {
        let (origin, token) = (format!("http://{}", self.place), self.token(run));
        let answer = self.post(path, &[("Origin", &origin), ("X-Regrind-Token", &token)], body);
        let said: Value = serde_json::from_slice(&answer.body).unwrap_or_else(|_| panic!("{answer:?}"));
        (answer.status, said["accepted"] == true, said["message"].as_str().unwrap_or_default().to_owned())
    }
}
