//! The way to the broker: who signs in, by what it proves itself, and what it publishes when this end has gone.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use regrind_formats::readable_by_others;
use rumqttc::{LastWill, MqttOptions, QoS, TlsConfiguration, Transport};
use rustls::crypto::ring;
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use rustls::{ClientConfig, RootCertStore};

use crate::error::LiveError;
use crate::settings::SparkplugSettings;

/// A broker that hears nothing for one and a half of it publishes the death.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Longest message of somebody else that is looked at.
const LONGEST_MESSAGE: usize = 1 << 20;

/// The way to a broker, without what it publishes when this end has gone.
pub(super) struct Way {
    options: MqttOptions,
    pub(super) place: String,
}

impl Way {
    pub(super) fn of(settings: &SparkplugSettings, client: &str) -> Result<Self, LiveError> {
        let SparkplugSettings { broker, port, user, password_file, certificates, .. } = settings;
        let is_here = broker == "localhost" || broker.parse().is_ok_and(|ip: std::net::IpAddr| ip.is_loopback());
        if certificates.is_none() && !is_here {
            return Err(LiveError::Unproven { broker: broker.clone() });
        }
        let port = port.unwrap_or(if certificates.is_some() { 8883 } else { 1883 });
        let mut options = MqttOptions::new(client, broker, port);
        options
            .set_keep_alive(KEEP_ALIVE)
            .set_clean_session(true)
            .set_max_packet_size(LONGEST_MESSAGE, LONGEST_MESSAGE);
        if let Some(path) = certificates {
            options.set_transport(Transport::Tls(TlsConfiguration::Rustls(Arc::new(tls(path)?))));
        }
        if let Some(user) = user {
            options.set_credentials(user, password_file.as_deref().map(password).transpose()?.unwrap_or_default());
        }
        Ok(Self { options, place: format!("{broker}:{port}") })
    }

    /// The options of a connection whose death is published so.
    pub(super) fn with_death(&self, topic: &str, death: Vec<u8>) -> MqttOptions {
        let mut options = self.options.clone();
        options.set_last_will(LastWill::new(topic, death, QoS::AtLeastOnce, false));
        options
    }
}

/// Reads a password that nobody else may read; the end of its line is none of it.
fn password(path: &Path) -> Result<String, LiveError> {
    let unread = |source| LiveError::Password { path: path.to_owned(), source };
    if let Some(open) = readable_by_others(path).map_err(unread)? {
        return Err(LiveError::PasswordIsOpen { path: path.to_owned(), open });
    }
    let text = fs::read_to_string(path).map_err(unread)?;
    Ok(text.trim_end_matches(['\r', '\n']).to_owned())
}

fn tls(path: &Path) -> Result<ClientConfig, LiveError> {
    let unread = |what: String| LiveError::Certificates { path: path.to_owned(), what };
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_file_iter(path).map_err(|error| unread(error.to_string()))? {
        let certificate = certificate.map_err(|error| unread(error.to_string()))?;
        roots.add(certificate).map_err(|error| unread(error.to_string()))?;
    }
    if roots.is_empty() {
        return Err(unread("there is none in it".into()));
    }
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|error| unread(error.to_string()))?;
    Ok(config.with_root_certificates(roots).with_no_client_auth())
}
