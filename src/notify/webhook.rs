//! Receiver by HTTP. A request has one notification as JSON, and is signed as Standard Webhooks describes it.

use std::time::{SystemTime, UNIX_EPOCH};

use data_encoding::BASE64;
use hmac::{Hmac, KeyInit, Mac};
use http_body_util::Full;
use hyper::body::Bytes;
use hyper::client::conn::http1;
use hyper::header::{CONNECTION, CONTENT_TYPE, HOST, USER_AGENT};
use hyper::{Request, StatusCode};
use hyper_util::rt::TokioIo;
use regrind_trust::read_secret;
use sha2::Sha256;
use tokio::task::JoinSet;

use crate::error::NotifyError;
use crate::notification::Notification;
use crate::settings::{Target, UrlFlaw, WebhookSettings};
use crate::tls::{Connection, Tls};

/// Maximum length of the head of an answer, in bytes.
const MAX_HEAD_BYTES: usize = 16 << 10;
/// Allowed lengths of a secret, in bytes.
const SECRET_BYTES: std::ops::RangeInclusive<usize> = 24..=64;
/// Begin of a secret in its file.
const SECRET_PREFIX: &str = "whsec_";

/// Receiver by HTTP.
pub(crate) struct Webhook {
    target: Target,
    tls: Option<Tls>,
    secret: Option<Vec<u8>>,
}

impl Webhook {
    /// Creates the receiver of `settings`, whose paths are resolved. Reads its files, and connects to nothing.
    ///
    /// # Errors
    /// A file cannot be read or is open to other users; the address or the secret is not valid.
    pub(crate) fn new(settings: &WebhookSettings) -> Result<Self, NotifyError> {
        let receiver = || settings.name.clone();
        let read = |path, name, key| {
            read_secret(path, name, key)
                .map_err(|source| NotifyError::Trust { receiver: receiver(), source: Box::new(source) })
        };
        let url = match &settings.url_file {
            Some(path) => read(path, "the address of a receiver", "url_file")?,
            None => settings.url.clone().unwrap_or_default(),
        };
        let target = Target::parse(&url, settings.unencrypted)
            .map_err(|UrlFlaw { found, remedy }| NotifyError::Address { receiver: receiver(), found, remedy })?;
        let secret = settings.secret_file.as_ref().map(|path| {
            let text = read(path, "the secret of a receiver", "secret_file")?;
            decode_secret(&text).map_err(|found| NotifyError::Secret { receiver: receiver(), found })
        });
        let tls = target
            .is_encrypted
            .then(|| Tls::new(&settings.name, &target.host, settings.certificates.as_deref()))
            .transpose()?;
        Ok(Self { tls, secret: secret.transpose()?, target })
    }

    /// Returns the computer of the receiver, for messages.
    pub(crate) fn place(&self) -> String {
        self.target.place()
    }

    /// Sends one notification. Returns the reason in words if the receiver has not accepted it.
    pub(crate) async fn send(&self, notification: &Notification) -> Result<(), String> {
        let request = self.request(notification).map_err(|error| error.to_string())?;
        let stream = self.connect().await?;
        let mut builder = http1::Builder::new();
        builder.max_buf_size(MAX_HEAD_BYTES);
        let (mut sender, connection) = builder.handshake(TokioIo::new(stream)).await.map_err(|error| words(&error))?;
        // The task ends with this value.
        let mut serving = JoinSet::new();
        serving.spawn(connection);
        let answer = sender.send_request(request).await.map_err(|error| words(&error))?;
        match answer.status() {
            status if status.is_success() => Ok(()),
            status if status.is_redirection() => Err(format!(
                "it answers {status}, a redirection, which is not followed; write the address to which it redirects"
            )),
            StatusCode::UNAUTHORIZED | StatusCode::FORBIDDEN => {
                Err(format!("it answers {}; compare the secret at both ends", answer.status()))
            }
            status => Err(format!("it answers {status}")),
        }
    }

    /// Connects to the receiver without a request, and closes the connection.
    pub(crate) async fn try_server(&self) -> Result<(), String> {
        self.connect().await.map(drop)
    }

    async fn connect(&self) -> Result<Connection, String> {
        let connected = async {
            let stream = Connection::open(&self.target.host, self.target.port).await?;
            match &self.tls {
                Some(tls) => tls.encrypt(stream).await,
                None => Ok(stream),
            }
        };
        connected.await.map_err(|error| error.to_string())
    }

    /// Returns the request with `notification`, with its time and its signature.
    fn request(&self, notification: &Notification) -> hyper::http::Result<Request<Full<Bytes>>> {
        let body = serde_json::to_vec(notification).unwrap_or_default();
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        let mut request = Request::post(&self.target.path)
            .header(HOST, &self.target.authority)
            .header(CONTENT_TYPE, "application/json")
            .header(USER_AGENT, concat!("regrind/", env!("CARGO_PKG_VERSION")))
            .header(CONNECTION, "close")
            .header("webhook-id", &notification.id)
            .header("webhook-timestamp", now_s);
        if let Some(secret) = &self.secret {
            request = request.header("webhook-signature", signature(secret, &notification.id, now_s, &body));
        }
        request.body(Full::new(body.into()))
    }
}

/// Returns the signature of a request as Standard Webhooks describes it: HMAC-SHA256 of the id, the time in seconds since
/// 1970 and the body.
fn signature(secret: &[u8], id: &str, time_s: u64, body: &[u8]) -> String {
    // A key of any length is valid.
    let Ok(mut mac) = Hmac::<Sha256>::new_from_slice(secret) else { return String::new() };
    mac.update(format!("{id}.{time_s}.").as_bytes());
    mac.update(body);
    format!("v1,{}", BASE64.encode(&mac.finalize().into_bytes()))
}

/// Returns the secret in `text`, the content of its file. Returns the flaw in words if it is not valid.
fn decode_secret(text: &str) -> Result<Vec<u8>, &'static str> {
    let encoded = text.trim().strip_prefix(SECRET_PREFIX).ok_or("does not begin with `whsec_`")?;
    let secret = BASE64.decode(encoded.as_bytes()).map_err(|_| "is not base64 after `whsec_`")?;
    if SECRET_BYTES.contains(&secret.len()) { Ok(secret) } else { Err("does not have 24 to 64 bytes") }
}

/// Returns the message of an error of the HTTP client, followed by the messages of its causes.
fn words(error: &(dyn std::error::Error + 'static)) -> String {
    let causes = std::iter::successors(error.source(), |cause| cause.source());
    causes.fold(error.to_string(), |words, cause| format!("{words}: {cause}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signature_is_that_of_standard_webhooks() {
        // The example of the specification.
        let secret = decode_secret("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw\n").unwrap();
        let body = br#"{"test": 2432232314}"#;
        let signed = signature(&secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, body);
        assert_eq!(signed, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }

    #[test]
    fn secrets_are_checked() {
        for text in [
            "",
            "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw",
            "whsec_",
            "whsec_MfKQ9r8GKYqr",
            "whsec_!",
            "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaS",
        ] {
            assert!(decode_secret(text).is_err(), "{text}");
        }
    }
}
