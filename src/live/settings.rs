//! Where live values go, as a person writes it.

use std::net::SocketAddr;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::Deserialize;

/// A broker of MQTT, which is told as a Sparkplug B edge node.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SparkplugSettings {
    /// Name or address of the broker's computer.
    #[schemars(length(min = 1, max = 255), example = &"plant.example")]
    pub broker: String,
    /// Its port; 8883 where it proves itself by certificates, else 1883.
    #[schemars(range(min = 1))]
    pub port: Option<u16>,
    /// The group of the node, without `+`, `/` and `#`.
    #[schemars(length(min = 1, max = 80), example = &"plant")]
    pub group: String,
    /// By which the node signs in.
    pub user: Option<String>,
    /// The file that holds the password, and nothing else, for nobody else to read; beside this file where it is relative.
    pub password_file: Option<PathBuf>,
    /// The certificates in PEM by which the broker proves itself. Without them it is reached on this computer alone.
    pub certificates: Option<PathBuf>,
}

/// A server of OPC UA, which shows the cell and takes nothing.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OpcUaSettings {
    /// Address, of this computer alone, and port; a port of 0 takes any that is free.
    #[schemars(with = "String", example = &"127.0.0.1:4840")]
    pub listen: SocketAddr,
}
