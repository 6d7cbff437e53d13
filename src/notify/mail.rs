//! Receiver by mail. A mail has all notifications that wait, so that a cell with many alarms sends few mails.

use std::io;
use std::net::SocketAddr;

use lettre::message::header::ContentType;
use lettre::message::{Mailbox, Message};
use lettre::transport::smtp::authentication::{Credentials, Mechanism};
use lettre::transport::smtp::client::AsyncSmtpConnection;
use lettre::transport::smtp::extension::ClientId;
use regrind_trust::{read_password, tls_config};
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use crate::error::NotifyError;
use crate::notification::Notification;
use crate::settings::{Encryption, MailSettings, mailbox};
use crate::tls::{Connection, Tls};

/// Maximum length of a line of a reply before the encryption begins, in bytes, and maximum number of its lines.
const MAX_LINE_BYTES: usize = 1000;
const MAX_LINES: usize = 100;
/// Greeting that lettre expects at the begin of a connection. After STARTTLS the server sends none.
const GREETING: &[u8] = b"220 encrypted\r\n";
/// Maximum length of a subject, in characters.
const MAX_SUBJECT: usize = 150;

/// Receiver by mail.
pub(crate) struct Mail {
    host: String,
    port: u16,
    encryption: Option<(Tls, Encryption)>,
    credentials: Option<Credentials>,
    from: Mailbox,
    to: Vec<Mailbox>,
}

impl Mail {
    /// Creates the receiver of `settings`, whose paths are resolved. Reads its files, and connects to nothing.
    ///
    /// # Errors
    /// A file cannot be read or is open to other users, or an address is not valid. The server is on another computer
    /// and the connection would not be encrypted.
    pub(crate) fn new(settings: &MailSettings) -> Result<Self, NotifyError> {
        let MailSettings { name, server, encryption, .. } = settings;
        let trust = |source| NotifyError::Trust { receiver: name.clone(), source: Box::new(source) };
        let address = |address: &String| {
            mailbox(address)
                .ok_or_else(|| NotifyError::MailAddress { receiver: name.clone(), address: address.clone() })
        };
        let encryption = match encryption {
            Encryption::None => {
                // Refuses a server on another computer.
                tls_config(server, None, "[[notify.mail]], with an `encryption`").map_err(trust)?;
                None
            }
            other => Some((Tls::new(name, server, settings.certificates.as_deref())?, *other)),
        };
        let password = settings.password_file.as_deref().map(read_password).transpose().map_err(trust)?;
        let credentials = settings.user.clone().zip(password).map(|(user, password)| Credentials::new(user, password));
        Ok(Self {
            host: server.clone(),
            port: settings.port.unwrap_or(settings.encryption.port()),
            encryption,
            credentials,
            from: address(&settings.from)?,
            to: settings.to.iter().map(address).collect::<Result<_, _>>()?,
        })
    }

    /// Returns the mail server, for messages.
    pub(crate) fn place(&self) -> String {
        format!("smtp://{}:{}", self.host, self.port)
    }

    /// Sends one mail with `notifications`. Returns the reason in words if the server has not accepted it.
    pub(crate) async fn send(&self, notifications: &[&Notification]) -> Result<(), String> {
        let message = self.message(notifications).map_err(|error| error.to_string())?;
        let mut connection = self.connect().await?;
        let sent = connection.send(message.envelope(), &message.formatted()).await;
        sent.map_err(|error| error.to_string())?;
        // The server has the mail, whatever it answers to this.
        let _ = connection.quit().await;
        Ok(())
    }

    /// Connects to the server, signs in, and closes the connection without a mail.
    pub(crate) async fn try_server(&self) -> Result<(), String> {
        let mut connection = self.connect().await?;
        let _ = connection.quit().await;
        Ok(())
    }

    async fn connect(&self) -> Result<AsyncSmtpConnection, String> {
        let stream = self.open().await.map_err(|error| error.to_string())?;
        let hello = client_id(stream.local());
        let mut connection = AsyncSmtpConnection::connect_with_transport(Box::new(stream), &hello)
            .await
            .map_err(|error| error.to_string())?;
        if let Some(credentials) = &self.credentials {
            let signed_in = connection.auth(&[Mechanism::Plain, Mechanism::Login], credentials).await;
            signed_in.map_err(|error| format!("the server does not accept the user: {error}"))?;
        }
        Ok(connection)
    }

    /// Opens the connection, encrypted if the settings say so.
    async fn open(&self) -> io::Result<Connection> {
        let stream = Connection::open(&self.host, self.port).await?;
        match &self.encryption {
            None => Ok(stream),
            Some((tls, Encryption::Starttls)) => {
                let stream = begin_encryption(stream).await?;
                Ok(tls.encrypt(stream).await?.with_before(GREETING))
            }
            Some((tls, _)) => tls.encrypt(stream).await,
        }
    }

    fn message(&self, notifications: &[&Notification]) -> Result<Message, lettre::error::Error> {
        let id = notifications.first().map_or("", |first| &first.id).replace(':', ".");
        let to = self.to.iter().cloned();
        let message = to.fold(Message::builder().from(self.from.clone()), |message, to| message.to(to));
        message
            .subject(subject(notifications))
            .message_id(Some(format!("<{id}@{}>", self.from.email.domain())))
            .header(ContentType::TEXT_PLAIN)
            .body(notifications.iter().map(|one| paragraph(one)).collect::<Vec<_>>().join("\n"))
    }
}

/// Reads the greeting and asks for encryption. Afterwards nothing of the server is read that is not encrypted: all bytes
/// are read one by one, so none after its reply is in a buffer.
async fn begin_encryption(mut stream: Connection) -> io::Result<Connection> {
    let refused = |what: String| io::Error::new(io::ErrorKind::ConnectionRefused, what);
    reply(&mut stream, 220).await?;
    let hello = format!("EHLO {}\r\n", client_id(stream.local()));
    stream.write_all(hello.as_bytes()).await?;
    let offered = reply(&mut stream, 250).await?;
    if !offered.iter().any(|line| line.eq_ignore_ascii_case("STARTTLS")) {
        return Err(refused("the server does not offer STARTTLS, so nothing is sent to it".into()));
    }
    stream.write_all(b"STARTTLS\r\n").await?;
    reply(&mut stream, 220).await?;
    Ok(stream)
}

/// Reads a reply, and returns the texts of its lines.
///
/// # Errors
/// The reply has another code than `code`, or is too long, or cannot be read.
async fn reply(stream: &mut Connection, code: u16) -> io::Result<Vec<String>> {
    let mut lines = Vec::new();
    loop {
        let mut line = Vec::new();
        while !line.ends_with(b"\n") {
            if line.len() > MAX_LINE_BYTES || lines.len() > MAX_LINES {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "the reply of the server is too long"));
            }
            line.push(stream.read_u8().await?);
        }
        let line = String::from_utf8_lossy(&line).trim_end().to_owned();
        let is_expected = line.get(..3) == Some(&*code.to_string());
        if !is_expected {
            let what = format!("the server answers {line:?}, and {code} was expected");
            return Err(io::Error::new(io::ErrorKind::InvalidData, what));
        }
        lines.push(line.get(4..).unwrap_or_default().to_owned());
        if line.as_bytes().get(3) != Some(&b'-') {
            return Ok(lines);
        }
    }
}

/// Returns the name with which this computer introduces itself: its address in the connection.
fn client_id(local: SocketAddr) -> ClientId {
    match local {
        SocketAddr::V4(address) => ClientId::Ipv4(*address.ip()),
        SocketAddr::V6(address) => ClientId::Ipv6(*address.ip()),
    }
}

fn subject(notifications: &[&Notification]) -> String {
    let first = notifications.first().map_or("", |first| first.text.lines().next().unwrap_or_default());
    let more = match notifications.len() {
        0 | 1 => String::new(),
        count => format!(" (and {} more)", count - 1),
    };
    let room = MAX_SUBJECT - more.len();
    let short: String = first.chars().take(room).collect();
    format!("{short}{more}")
}

/// Returns the lines of one notification in a mail.
fn paragraph(of: &Notification) -> String {
    let mut lines = vec![of.text.clone(), String::new()];
    let mut add = |name: &str, value: Option<String>| lines.extend(value.map(|value| format!("{name:<10} {value}")));
    add("cell", Some(of.cell.clone()));
    add("run", Some(of.run.clone()));
    add("part", of.part.clone());
    add("serial", of.serial.clone());
    add("time", Some(of.time.clone()));
    add("by", of.by.clone());
    if let Some(figures) = &of.figures {
        let limit = |um: Option<f64>| um.map_or(String::new(), |um| format!(" of {um:.2}"));
        add("PV", Some(format!("{:.2}{} µm", figures.pv_um, limit(figures.pv_limit_um))));
        add("RMS", Some(format!("{:.3}{} µm", figures.rms_um, limit(figures.rms_limit_um))));
    }
    if let Some(alarm) = &of.alarm {
        lines.push(alarm.consequence.clone());
        lines.extend(alarm.remedy.iter().enumerate().map(|(k, remedy)| format!("{}. {remedy}", k + 1)));
    }
    lines.extend([format!("{:<10} {}", "id", of.id), String::new()]);
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::notification::tests::notification;

    fn mail() -> Mail {
        let text = r#"{"name": "shift", "server": "127.0.0.1", "encryption": "none", "from": "Cell 1 <cell-1@shop.example>",
            "to": ["a@shop.example", "b@shop.example"], "events": ["held"]}"#;
        Mail::new(&serde_json::from_str(text).unwrap()).unwrap()
    }

    #[test]
    fn mail_has_all_notifications_and_no_foreign_header() {
        let mut second = notification(8);
        second.text = "line one\r\nBcc: x@foreign.example\r\n\r\nbody".into();
        let formatted = |all: &[&Notification]| String::from_utf8(mail().message(all).unwrap().formatted()).unwrap();
        let both = formatted(&[&notification(7), &second]);
        assert!(both.contains("Subject: SIMULATION cell-1: record 7 (and 1 more)"), "{both}");
        assert!(both.contains("Message-ID: <a-run.7@shop.example>"), "{both}");
        assert!(both.contains("a-run:7") && both.contains("a-run:8"), "{both}");
        let alone = formatted(&[&second]);
        let (head, _) = alone.split_once("\r\n\r\n").unwrap();
        assert!(!head.lines().any(|line| line.starts_with("Bcc")) && head.contains("Subject: line one"), "{head}");
    }

    #[test]
    fn unencrypted_server_must_be_here() {
        let text = r#"{"name": "shift", "server": "mail.example", "encryption": "none", "from": "a@b.example",
            "to": ["a@b.example"], "events": ["held"]}"#;
        assert!(matches!(Mail::new(&serde_json::from_str(text).unwrap()), Err(NotifyError::Trust { .. })));
    }
}
