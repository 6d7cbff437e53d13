//! Errors of publishing live values as the plant file configures it, with the remedy.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;

use regrind_formats::FormatError;
use regrind_trust::TrustError;
use thiserror::Error;

/// Reason why live values cannot be published as the plant file configures it.
#[derive(Debug, Error)]
#[expect(missing_docs, reason = "the messages tell them")]
#[non_exhaustive]
pub enum LiveError {
    #[error(transparent)]
    Trust(#[from] TrustError),
    #[error(
        "the name {name:?} of {of} cannot be a part of an MQTT topic, because the name is empty or contains +, / or #; choose another name"
    )]
    Topic { of: &'static str, name: String },
    #[error("{}: the state of the publisher cannot be stored in this folder: {source}; check that the folder exists, and that you have the right to write in it", .path.display())]
    Folder { path: PathBuf, source: io::Error },
    #[error(
        "{listen} is open to other computers, and this OPC UA server has no encryption; listen at 127.0.0.1, and connect from other computers \
         through a tunnel: ssh -L 4840:127.0.0.1:4840 CELL"
    )]
    ForOthers { listen: SocketAddr },
    #[error(
        "{listen} is open to other computers, and the protocol of MTConnect adapters has no encryption; listen at 127.0.0.1, run the agent on \
         this computer, or connect it through a tunnel: ssh -L 7878:127.0.0.1:7878 CELL"
    )]
    AgentsElsewhere { listen: SocketAddr },
    #[error("the OPC UA server cannot continue: {what}")]
    Server { what: String },
    #[error(transparent)]
    File(#[from] FormatError),
}
