//! Settings of the plant file for the receivers of notifications.

use std::fmt;
use std::net::IpAddr;
use std::path::{Path, PathBuf};

use hyper::Uri;
use lettre::Address;
use lettre::message::Mailbox;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Receivers of notifications, and limits of their queues.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NotifySettings {
    /// Receivers by HTTP: each notification is a POST request.
    #[serde(default)]
    #[schemars(length(max = 20))]
    pub webhook: Vec<WebhookSettings>,
    /// Receivers by mail.
    #[serde(default)]
    #[schemars(length(max = 20))]
    pub mail: Vec<MailSettings>,
    /// Maximum number of notifications that wait for one receiver; the oldest are dropped.
    #[serde(default = "default_keep_notifications")]
    #[schemars(range(min = 1, max = 100_000), default = "default_keep_notifications")]
    pub keep_notifications: u32,
    /// Time after which a notification that cannot be delivered is given up, in hours.
    #[serde(default = "default_give_up_hours")]
    #[schemars(range(min = 1, max = 8760), default = "default_give_up_hours")]
    pub give_up_hours: u32,
}

fn default_keep_notifications() -> u32 {
    1000
}

fn default_give_up_hours() -> u32 {
    72
}

/// Receiver of notifications by HTTP.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WebhookSettings {
    /// Name of the receiver in messages and in its files: letters, digits, `-` and `_`.
    #[serde(default)]
    #[schemars(length(min = 1, max = 40), extend("x-required" = true), example = &"chat")]
    pub name: String,
    /// Address of the receiver, with `https://`, or with `http://` on this computer. `url_file` can name a file with
    /// the address instead.
    #[schemars(length(min = 1, max = 2000), example = &"https://chat.example/hooks/cell-1")]
    pub url: Option<String>,
    /// File with the address and nothing else, readable by its owner only; relative to this file. For an address that
    /// is a secret itself.
    pub url_file: Option<PathBuf>,
    /// Events that are sent to this receiver.
    #[serde(default)]
    #[schemars(length(min = 1, max = 20), extend("x-required" = true))]
    pub events: Vec<EventKind>,
    /// File with the secret that signs the requests (Standard Webhooks: `whsec_` and base64), readable by its owner
    /// only; relative to this file. Default: requests are not signed.
    pub secret_file: Option<PathBuf>,
    /// Certificates in PEM that authenticate the receiver. Default: those of the operating system.
    pub certificates: Option<PathBuf>,
    /// True: send without encryption to another computer; everybody on the network can then read and change the
    /// notifications.
    #[serde(default)]
    pub unencrypted: bool,
}

/// Receiver of notifications by mail.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MailSettings {
    /// Name of the receiver in messages and in its files: letters, digits, `-` and `_`.
    #[serde(default)]
    #[schemars(length(min = 1, max = 40), extend("x-required" = true), example = &"shift")]
    pub name: String,
    /// Name or address of the mail server (SMTP).
    #[serde(default)]
    #[schemars(length(min = 1, max = 255), extend("x-required" = true), example = &"mail.example")]
    pub server: String,
    /// Port of the mail server. Default: 587 with `starttls`, 465 with `tls`, 25 with `none`.
    #[schemars(range(min = 1))]
    pub port: Option<u16>,
    /// Encryption of the connection. Without it, the server must be on this computer.
    #[serde(default)]
    pub encryption: Encryption,
    /// Address of the sender.
    #[serde(default)]
    #[schemars(length(min = 3, max = 320), extend("x-required" = true), example = &"cell-1@shop.example")]
    pub from: String,
    /// Addresses of the receivers.
    #[serde(default)]
    #[schemars(length(min = 1, max = 50), extend("x-required" = true))]
    pub to: Vec<String>,
    /// Events that are sent to these receivers.
    #[serde(default)]
    #[schemars(length(min = 1, max = 20), extend("x-required" = true))]
    pub events: Vec<EventKind>,
    /// User name with which the cell signs in to the mail server.
    pub user: Option<String>,
    /// File with the password and nothing else, readable by its owner only; relative to this file.
    pub password_file: Option<PathBuf>,
    /// Certificates in PEM that authenticate the mail server. Default: those of the operating system.
    pub certificates: Option<PathBuf>,
}

/// Encryption of the connection to a mail server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Encryption {
    /// The connection begins without encryption, and STARTTLS is required before anything is sent.
    #[default]
    Starttls,
    /// The connection is encrypted from its begin.
    Tls,
    /// No encryption; only for a server on this computer.
    None,
}

impl Encryption {
    /// Returns the usual port of a mail server with this encryption.
    pub(crate) fn port(self) -> u16 {
        match self {
            Self::Starttls => 587,
            Self::Tls => 465,
            Self::None => 25,
        }
    }
}

/// Kind of event of which a cell notifies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// A run has begun.
    Started,
    /// The cell is held: a person must resume or end the run.
    Held,
    /// An alarm was raised.
    Alarm,
    /// The run ended, and the part is accepted.
    Accepted,
    /// The run ended in order, and the part is not in tolerance or was never judged.
    NotAccepted,
    /// The run could not begin, or was stopped.
    Stopped,
    /// The run was aborted.
    Aborted,
    /// The program of the run has gone, and the record has no end: the state of the machines is unknown.
    Interrupted,
}

impl EventKind {
    /// All kinds.
    pub const ALL: [Self; 8] = [
        Self::Started,
        Self::Held,
        Self::Alarm,
        Self::Accepted,
        Self::NotAccepted,
        Self::Stopped,
        Self::Aborted,
        Self::Interrupted,
    ];

    /// Returns the name of the kind in the plant file and in notifications.
    pub fn name(self) -> &'static str {
        match self {
            Self::Started => "started",
            Self::Held => "held",
            Self::Alarm => "alarm",
            Self::Accepted => "accepted",
            Self::NotAccepted => "not_accepted",
            Self::Stopped => "stopped",
            Self::Aborted => "aborted",
            Self::Interrupted => "interrupted",
        }
    }
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Problem of the settings that their schema does not find.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SettingsProblem {
    /// Key, as a path from the table `notify`.
    pub key: String,
    /// Value that was found.
    pub found: String,
    /// Allowed values.
    pub allowed: &'static str,
    /// Action that solves the problem.
    pub remedy: &'static str,
}

impl NotifySettings {
    /// Returns these settings with their file paths resolved against the folder `at` of the plant file.
    pub fn resolved(mut self, at: &Path) -> Self {
        let files =
            self.webhook.iter_mut().flat_map(|of| [&mut of.url_file, &mut of.secret_file, &mut of.certificates]);
        files
            .chain(self.mail.iter_mut().flat_map(|of| [&mut of.password_file, &mut of.certificates]))
            .flatten()
            .for_each(|file| *file = at.join(&*file));
        self
    }

    /// Returns the problems that the schema does not find: a name that is not unique, or an address that is not valid.
    /// Reads no file.
    pub fn problems(&self) -> Vec<SettingsProblem> {
        let mut problems = Vec::new();
        let names: Vec<_> = self.webhook.iter().map(|of| &of.name).chain(self.mail.iter().map(|of| &of.name)).collect();
        let first_mail = self.webhook.len();
        for (k, name) in names.iter().enumerate() {
            let key = match k.checked_sub(first_mail) {
                None => format!("webhook[{k}].name"),
                Some(k) => format!("mail[{k}].name"),
            };
            problems.extend(name_problem(key, name, names[..k].contains(name)));
        }
        for (k, webhook) in self.webhook.iter().enumerate() {
            problems.extend(webhook.problem(&format!("webhook[{k}]")));
        }
        for (k, mail) in self.mail.iter().enumerate() {
            mail.problems(&format!("mail[{k}]"), &mut problems);
        }
        problems
    }
}

/// Returns the problem of the name `name` of a receiver, if it is not usable as the name of a file or not unique.
fn name_problem(key: String, name: &str, is_double: bool) -> Option<SettingsProblem> {
    let is_valid = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
    let problem = |allowed, remedy| Some(SettingsProblem { key, found: format!("is {name:?}"), allowed, remedy });
    match (is_valid, is_double) {
        _ if name.is_empty() => None,
        (false, _) => problem("it may have letters, digits, `-` and `_`", "choose a name such as \"chat\""),
        (true, true) => problem("another receiver has this name", "give each receiver a name of its own"),
        (true, false) => None,
    }
}

impl WebhookSettings {
    fn problem(&self, at: &str) -> Option<SettingsProblem> {
        let of = |key: &str, found: &str, allowed, remedy| {
            Some(SettingsProblem { key: format!("{at}.{key}"), found: found.to_owned(), allowed, remedy })
        };
        match (&self.url, &self.url_file) {
            (None, None) => of("url", "is missing", "", "write the address of the receiver, or `url_file`"),
            (Some(_), Some(_)) => {
                of("url_file", "is given in addition to `url`", "only one of them is allowed", "delete one of them")
            }
            (Some(url), None) => match Target::parse(url, self.unencrypted) {
                Err(UrlFlaw { found, remedy }) => of("url", found, "", remedy),
                Ok(_) => None,
            },
            (None, Some(_)) => None,
        }
    }
}

impl MailSettings {
    fn problems(&self, at: &str, problems: &mut Vec<SettingsProblem>) {
        let addresses = self.to.iter().enumerate().map(|(k, to)| (format!("{at}.to[{k}]"), to));
        for (key, address) in std::iter::once((format!("{at}.from"), &self.from)).chain(addresses) {
            // The schema has reported an empty one.
            if !address.is_empty() && mailbox(address).is_none() {
                let found = format!("{address:?} is not a mail address");
                problems.push(SettingsProblem {
                    key,
                    found,
                    allowed: "",
                    remedy: "write it as in cell-1@shop.example",
                });
            }
        }
        if self.encryption == Encryption::None && !self.server.is_empty() && !is_this_computer(&self.server) {
            let (found, remedy) = ("is \"none\", but the server is another computer", "write \"starttls\" or \"tls\"");
            let key = format!("{at}.encryption");
            problems.push(SettingsProblem { key, found: found.into(), allowed: "", remedy });
        }
        if self.user.is_some() != self.password_file.is_some() {
            let found = "user and password_file belong together, and one of them is missing";
            let key = format!("{at}.user");
            problems.push(SettingsProblem { key, found: found.into(), allowed: "", remedy: "write both, or none" });
        }
    }
}

/// Returns the mailbox of an address, with or without a name of its person; `None` if it is not valid.
pub(crate) fn mailbox(address: &str) -> Option<Mailbox> {
    address.parse::<Mailbox>().ok().or_else(|| Some(Mailbox::new(None, address.parse::<Address>().ok()?)))
}

/// Returns true if `host` is certainly this computer.
pub(crate) fn is_this_computer(host: &str) -> bool {
    let host = host.trim_start_matches('[').trim_end_matches(']');
    host == "localhost" || host.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

/// Address of a receiver by HTTP, checked.
#[derive(Clone, Debug)]
pub(crate) struct Target {
    pub(crate) is_encrypted: bool,
    pub(crate) host: String,
    pub(crate) port: u16,
    /// Host, and port if the address names it: the header `Host`.
    pub(crate) authority: String,
    pub(crate) path: String,
}

/// Reason why an address is refused. It does not repeat the address, which can be a secret.
#[derive(Debug)]
pub(crate) struct UrlFlaw {
    pub(crate) found: &'static str,
    pub(crate) remedy: &'static str,
}

impl Target {
    /// Parses the address `url` of a receiver. An address without encryption must be on this computer, or `unencrypted`
    /// must be true.
    pub(crate) fn parse(url: &str, unencrypted: bool) -> Result<Self, UrlFlaw> {
        let flaw = |found, remedy| UrlFlaw { found, remedy };
        let malformed = || flaw("is not an address", "write it as in https://chat.example/hooks/cell-1");
        let uri: Uri = url.parse().map_err(|_| malformed())?;
        let (Some(scheme), Some(authority)) = (uri.scheme_str(), uri.authority()) else { return Err(malformed()) };
        let is_encrypted = match scheme {
            "https" => true,
            "http" => false,
            _ => return Err(flaw("is neither https:// nor http://", "write an address with https://")),
        };
        if authority.as_str().contains('@') {
            return Err(flaw("has a user name or password", "sign the requests with `secret_file` instead"));
        }
        if authority.host().is_empty() {
            return Err(malformed());
        }
        if !is_encrypted && !unencrypted && !is_this_computer(authority.host()) {
            return Err(flaw(
                "is not encrypted, and the receiver is another computer",
                "write https://, or `unencrypted = true` if everybody on the network may read and change it",
            ));
        }
        let host = authority.host().trim_start_matches('[').trim_end_matches(']').to_owned();
        let port = authority.port_u16().unwrap_or(if is_encrypted { 443 } else { 80 });
        let path = uri.path_and_query().map_or("/", |path| path.as_str()).to_owned();
        Ok(Self { is_encrypted, host, port, authority: authority.as_str().to_owned(), path })
    }

    /// Returns the host and port, for messages. The path can be a secret.
    pub(crate) fn place(&self) -> String {
        format!("{}://{}", if self.is_encrypted { "https" } else { "http" }, self.authority)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(url: &str) -> Result<(bool, String, u16, String), &'static str> {
        let target = Target::parse(url, false).map_err(|flaw| flaw.found)?;
        Ok((target.is_encrypted, target.host, target.port, target.path))
    }

    #[test]
    fn addresses_are_parsed_or_refused() {
        let of =
            |is_encrypted, host: &str, port, path: &str| Ok((is_encrypted, host.to_owned(), port, path.to_owned()));
        assert_eq!(parsed("https://chat.example/a?b=c"), of(true, "chat.example", 443, "/a?b=c"));
        assert_eq!(parsed("http://127.0.0.1:8080"), of(false, "127.0.0.1", 8080, "/"));
        assert_eq!(parsed("http://[::1]:81/x"), of(false, "::1", 81, "/x"));
        assert_eq!(parsed("http://localhost/x"), of(false, "localhost", 80, "/x"));
        for refused in [
            "",
            "chat.example/a",
            "/hook",
            "ftp://chat.example/",
            "file:///etc/passwd",
            "https://user:word@chat.example/",
            "http://chat.example/",
            "http://10.0.0.1/",
            "http://localhost.example/",
            "https://chat.example/a b",
            "https://chat.example/\r\nx: y",
        ] {
            assert!(parsed(refused).is_err(), "{refused}");
        }
        assert!(Target::parse("http://10.0.0.1/", true).is_ok());
    }

    #[test]
    fn settings_problems_have_their_keys() {
        let text = r#"{
            "webhook": [
                {"name": "chat", "url": "http://127.0.0.1:1/", "events": ["held"]},
                {"name": "chat", "events": ["held"]},
                {"name": "../x", "url": "https://a.example", "url_file": "b", "events": ["held"]}
            ],
            "mail": [
                {"name": "shift", "server": "mail.example", "encryption": "none", "from": "cell", "to": ["a@b.example", "a b"],
                 "events": ["alarm"], "user": "x"}
            ]
        }"#;
        let settings: NotifySettings = serde_json::from_str(text).unwrap();
        let keys: Vec<_> = settings.problems().into_iter().map(|problem| problem.key).collect();
        let wanted = [
            "webhook[1].name",
            "webhook[2].name",
            "webhook[1].url",
            "webhook[2].url_file",
            "mail[0].from",
            "mail[0].to[1]",
            "mail[0].encryption",
            "mail[0].user",
        ];
        assert_eq!(keys, wanted);
    }
}
