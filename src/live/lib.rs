//! The live values of a cell, for whoever speaks Sparkplug B or OPC UA. Both look and never order: a command is refused, and said so.

mod settings;

pub use settings::{OpcUaSettings, SparkplugSettings};
