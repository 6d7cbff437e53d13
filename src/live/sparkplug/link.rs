//! Connection to the broker: credentials, authentication, and the last will that the broker publishes when this end is
//! gone.

use std::sync::Arc;
use std::time::Duration;

use regrind_trust::{read_password, tls_config};
use rumqttc::{LastWill, MqttOptions, QoS, TlsConfiguration, Transport};

use crate::error::LiveError;
use crate::settings::SparkplugSettings;

/// Keep-alive interval. The broker publishes the death after one and a half intervals of silence.
const KEEP_ALIVE: Duration = Duration::from_secs(10);
/// Maximum size of a received message, in bytes.
const LONGEST_MESSAGE: usize = 1 << 20;

/// Connection options of a broker, without the last will.
pub(super) struct BrokerOptions {
    options: MqttOptions,
    pub(super) place: String,
}

impl BrokerOptions {
    pub(super) fn new(settings: &SparkplugSettings, client: &str) -> Result<Self, LiveError> {
        let SparkplugSettings { broker, port, user, password_file, certificates, .. } = settings;
        let proof = tls_config(broker, certificates.as_deref(), "[sparkplug]")?;
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
            options.set_credentials(user, password_file.as_deref().map(read_password).transpose()?.unwrap_or_default());
        }
        Ok(Self { options, place: format!("{broker}:{port}") })
    }

    /// Returns the options of an MQTT connection with a last will (a message that the broker publishes if the
    /// connection breaks). `death` is the content of this message, and `topic` is its topic.
    pub(super) fn with_last_will(&self, topic: &str, death: Vec<u8>) -> MqttOptions {
        let mut options = self.options.clone();
        options.set_last_will(LastWill::new(topic, death, QoS::AtLeastOnce, false));
        options
    }
}
