//! Primary host: the host application without which a node is not born (Sparkplug 3.0, STATE messages).

use serde_json::Value as Json;

/// Primary host of a node.
#[derive(Debug)]
pub(super) struct PrimaryHost {
    /// Topic of its STATE messages.
    pub(super) topic: String,
    /// True if the host is online. False at the begin of a connection, until the broker has told its state.
    pub(super) is_online: bool,
    /// Largest time in a STATE message, in milliseconds since 1970.
    last_ms: Option<u64>,
}

/// STATE message that is not used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unused {
    /// The message has another form than the specification.
    Invalid,
    /// The message is older than the last one.
    Outdated,
}

impl PrimaryHost {
    pub(super) fn new(id: &str) -> Self {
        Self { topic: format!("spBv1.0/STATE/{id}"), is_online: false, last_ms: None }
    }

    /// Sets the state of the host from the STATE message `payload`.
    ///
    /// # Errors
    /// The message is not valid, or is older than the last one. Nothing changes then.
    pub(super) fn apply_state(&mut self, payload: &[u8]) -> Result<(), Unused> {
        let json: Json = serde_json::from_slice(payload).map_err(|_| Unused::Invalid)?;
        let (Some(is_online), Some(at_ms)) = (json["online"].as_bool(), json["timestamp"].as_u64()) else {
            return Err(Unused::Invalid);
        };
        if self.last_ms.is_some_and(|last| at_ms < last) {
            return Err(Unused::Outdated);
        }
        (self.is_online, self.last_ms) = (is_online, Some(at_ms));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn older_or_invalid_state_ignored() {
        let mut host = PrimaryHost::new("scada");
        assert_eq!((&*host.topic, host.is_online), ("spBv1.0/STATE/scada", false));
        for (payload, taken, is_online) in [
            (&br#"{"online":true,"timestamp":100}"#[..], Ok(()), true),
            (br#"{"online":false,"timestamp":99}"#, Err(Unused::Outdated), true),
            (b"OFFLINE", Err(Unused::Invalid), true),
            (br#"{"online":"false","timestamp":200}"#, Err(Unused::Invalid), true),
            (br#"{"online":false}"#, Err(Unused::Invalid), true),
            (br#"{"online":false,"timestamp":-1}"#, Err(Unused::Invalid), true),
            (br#"{"online":false,"timestamp":100}"#, Ok(()), false),
            (br#"{"online":true,"timestamp":101}"#, Ok(()), true),
        ] {
            assert_eq!((host.apply_state(payload), host.is_online), (taken, is_online), "{}", payload.escape_ascii());
        }
    }
}
