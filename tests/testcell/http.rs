//! HTTP client that sends exactly the given bytes, and keeps the cookies that it receives.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use rustls::{ClientConfig, ClientConnection, StreamOwned};

use serde_json::Value;

/// HTTP response.
#[derive(Debug)]
pub struct Answer {
    /// Status code, or 0 if there was no response.
    pub status: u16,
    /// Status line and headers.
    pub head: String,
    /// Bytes after the headers.
    pub body: Vec<u8>,
}

impl Answer {
    /// Returns the body as text.
    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    /// Returns the values of a header.
    pub fn header(&self, name: &str) -> Vec<&str> {
        let pairs = self.head.lines().filter_map(|line| line.split_once(':'));
        pairs.filter(|(known, _)| known.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim()).collect()
    }
}

/// Sends a request unchanged, and reads the response to its end.
pub fn raw(place: &str, request: &[u8]) -> Answer {
    asked(connected(place), request)
}

/// Sends a request over TLS to a host that proves its name.
pub fn raw_by_tls(place: &str, tls: &Arc<ClientConfig>, name: &str, request: &[u8]) -> Answer {
    let client = ClientConnection::new(Arc::clone(tls), ServerName::try_from(name.to_owned()).unwrap()).unwrap();
    asked(StreamOwned::new(client, connected(place)), request)
}

fn connected(place: &str) -> TcpStream {
    let stream = TcpStream::connect(place).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    stream
}

fn asked(mut stream: impl Read + Write, request: &[u8]) -> Answer {
    // A server that rejects the name closes the connection.
    let _ = stream.write_all(request);
    let mut bytes = Vec::new();
    // A server closes the connection if a request is too long.
    let _ = stream.read_to_end(&mut bytes);
    let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").map_or(bytes.len(), |at| at + 4);
    let head = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok()).unwrap_or(0);
    Answer { status, head, body: bytes[end..].to_vec() }
}

/// Browser without a display.
#[derive(Clone, Debug)]
pub struct Visitor {
    /// Host and port to connect to.
    pub place: String,
    /// Value of the header `Cookie`.
    pub cookies: String,
    /// Value of the header `Accept-Language`.
    pub language: String,
    /// Trusted certificates, and the name by which the client knows the page, if the connection is encrypted.
    pub tls: Option<(Arc<ClientConfig>, String)>,
}

impl Visitor {
    /// Returns a visitor without a key.
    pub fn stranger(url: &str) -> Self {
        let place = url.trim_start_matches("http://").split('/').next().unwrap().to_owned();
        Self { place, cookies: String::new(), language: "en".into(), tls: None }
    }

    /// Returns a visitor that opened the address with the key.
    pub fn with_key(url: &str) -> Self {
        let mut visitor = Self::stranger(url);
        let path = url.trim_start_matches("http://").trim_start_matches(&visitor.place).to_owned();
        let answer = visitor.get(&path);
        assert_eq!(answer.status, 303, "{answer:?}");
        let cookies = answer.header("set-cookie").into_iter().map(|cookie| cookie.split(';').next().unwrap());
        visitor.cookies = cookies.collect::<Vec<_>>().join("; ");
        visitor
    }

    /// Returns a visitor that signed in with a name and a password; none if the page refuses.
    pub fn signed_in(url: &str, name: &str, password: &str) -> Option<Self> {
        let visitor = Self::stranger(url);
        visitor.sign_in(name, password)
    }

    /// Signs in with a name and a password; none if the page refuses.
    pub fn sign_in(mut self, name: &str, password: &str) -> Option<Self> {
        let answer = self.try_to_sign_in(name, password);
        let cookie = answer.header("set-cookie").first().copied().filter(|_| answer.status == 303)?.to_owned();
        self.cookies = cookie.split(';').next().unwrap().to_owned();
        Some(self)
    }

    /// Sends a name and a password, and returns the response.
    pub fn try_to_sign_in(&self, name: &str, password: &str) -> Answer {
        let escaped = |text: &str| text.bytes().map(|byte| format!("%{byte:02x}")).collect::<String>();
        let body = format!("name={}&password={}", escaped(name), escaped(password));
        let form = ("Content-Type", "application/x-www-form-urlencoded");
        self.post("/sign-in", &[form, ("Origin", &self.origin())], body.as_bytes())
    }

    /// Returns the host name and port of the requests.
    pub fn host(&self) -> String {
        let port = self.place.rsplit(':').next().unwrap();
        self.tls.as_ref().map_or(self.place.clone(), |(_, name)| format!("{name}:{port}"))
    }

    /// Returns the value of the header `Origin`.
    pub fn origin(&self) -> String {
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        format!("{scheme}://{}", self.host())
    }

    fn ask(&self, request: &[u8]) -> Answer {
        match &self.tls {
            Some((tls, name)) => raw_by_tls(&self.place, tls, name, request),
            None => raw(&self.place, request),
        }
    }

    /// Gets a page.
    pub fn get(&self, path: &str) -> Answer {
        let (Self { cookies, language, .. }, host) = (self, self.host());
        let request = format!(
            "GET {path} HTTP/1.1\r\nHost: {host}\r\nCookie: {cookies}\r\nAccept-Language: {language}\r\nConnection: close\r\n\r\n"
        );
        self.ask(request.as_bytes())
    }

    /// Posts a body with additional headers.
    pub fn post(&self, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Answer {
        let (Self { cookies, .. }, host) = (self, self.host());
        let more: String = headers.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let length = body.len();
        let head = format!(
            "POST {path} HTTP/1.1\r\nHost: {host}\r\nCookie: {cookies}\r\n{more}Content-Length: {length}\r\nConnection: close\r\n\r\n"
        );
        self.ask(&[head.as_bytes(), body].concat())
    }

    /// Returns a token for the next order.
    pub fn token(&self) -> String {
        let answer = self.get("/token");
        assert_eq!(answer.status, 200, "{answer:?}");
        answer.text()
    }

    /// Gives an order as the page does. Returns the status, whether the order was accepted, and the message.
    pub fn order(&self, run: &str, order: &Value) -> (u16, bool, String) {
        self.give(&format!("/runs/{run}/orders"), order.to_string().as_bytes())
    }

    /// Takes control of a run. Returns the same as [`Visitor::order`].
    pub fn take_control(&self, run: &str) -> (u16, bool, String) {
        self.give(&format!("/runs/{run}/control"), b"")
    }

    /// Sends the file of a measurement as the page does. Returns the same as [`Visitor::order`].
    pub fn send_measurement(&self, run: &str, name: &str, bytes: &[u8]) -> (u16, bool, String) {
        self.give(&format!("/runs/{run}/measurement?name={name}"), bytes)
    }

    fn give(&self, path: &str, body: &[u8]) -> (u16, bool, String) {
        let (origin, token) = (self.origin(), self.token());
        let answer = self.post(path, &[("Origin", &origin), ("X-Regrind-Token", &token)], body);
        let said: Value = serde_json::from_slice(&answer.body).unwrap_or_else(|_| panic!("{answer:?}"));
        (answer.status, said["accepted"] == true, said["message"].as_str().unwrap_or_default().to_owned())
    }
}
