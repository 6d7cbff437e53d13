//! The way to the broker: who signs in, by what it proves itself, and what it publishes when this end has gone.

use std::sync::Arc;
use std::time::Duration;

use regrind_trust::{password, proof};
use rumqttc::{LastWill, MqttOptions, QoS, TlsConfiguration, Transport};

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
        let proof = proof(broker, certificates.as_deref(), "[sparkplug]")?;
        let port = port.unwrap_or(if proof.is_some() { 8883 } else { 1883 });
        let mut options = MqttOptions::new(client, broker, port);
        options
            .set_keep_alive(KEEP_ALIVE)
            .set_clean_session(true)
            .set_max_packet_size(LONGEST_MESSAGE, LONGEST_MESSAGE);
        if let Some(proof) = proof {
            options.set_transport(Transport::Tls(TlsConfiguration::Rustls(Arc::new(proof))));
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
