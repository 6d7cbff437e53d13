//! Settings of the plant file for the receivers of live values.

use std::net::SocketAddr;
use std::path::PathBuf;

use schemars::JsonSchema;
use serde::Deserialize;

/// MQTT broker to which the cell publishes as a Sparkplug B edge node.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SparkplugSettings {
    /// Name or address of the broker's computer.
    #[schemars(length(min = 1, max = 255), example = &"plant.example")]
    pub broker: String,
    /// Port of the broker. Default: 8883 with `certificates`, otherwise 1883.
    #[schemars(range(min = 1))]
    pub port: Option<u16>,
    /// The group of the node, without `+`, `/` and `#`.
    #[schemars(length(min = 1, max = 80), example = &"plant")]
    pub group: String,
    /// User name with which the node signs in.
    pub user: Option<String>,
    /// File with the password and nothing else, readable by its owner only; relative to this file.
    pub password_file: Option<PathBuf>,
    /// Certificates in PEM that authenticate the broker. Without them, the broker must be on this computer.
    pub certificates: Option<PathBuf>,
    /// Host id of the primary host, without `+`, `/` and `#`. The cell is published only while this host is online.
    #[schemars(length(min = 1, max = 80), example = &"scada")]
    pub primary_host: Option<String>,
    /// Maximum number of changes that are kept while they cannot be published; the oldest are dropped.
    #[serde(default = "default_keep_changes")]
    #[schemars(range(min = 1, max = 1_000_000), default = "default_keep_changes")]
    pub keep_changes: u32,
    /// Time for which such changes are kept, in hours.
    #[serde(default = "default_keep_hours")]
    #[schemars(range(min = 1, max = 8760), default = "default_keep_hours")]
    pub keep_hours: u32,
}

fn default_keep_changes() -> u32 {
    50_000
}

fn default_keep_hours() -> u32 {
    168
}

/// OPC UA server that shows the cell and accepts no writes.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OpcUaSettings {
    /// Address, of this computer only, and port; port 0 selects a free port.
    #[schemars(with = "String", example = &"127.0.0.1:4840")]
    pub listen: SocketAddr,
}

/// Adapter for an agent of MTConnect, which accepts no writes.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MtConnectSettings {
    /// Address, of this computer only, and port of the adapter (SHDR); port 0 selects a free port.
    #[schemars(with = "String", example = &"127.0.0.1:7878")]
    pub listen: SocketAddr,
    /// Identity of the device in the devices file, unique among all devices. Default: `regrind-` and the name of the cell.
    #[schemars(length(min = 1, max = 80), example = &"regrind-cell-1")]
    pub uuid: Option<String>,
}
