//! Files that stand for a machine: plans, maps and hand-overs out, results and confirmations in.
//!
//! Most shops have no wire to their measuring machine and none to their grinder, but a folder each can reach. What a handshake does
//! on a wire is done here by names: a hand-over is a folder that appears whole, by one rename; a result is taken when it has
//! stopped growing, has an end, and says, by its name or in itself, that it belongs to this part and this cycle; what does not belong
//! is left where it is, and said.

mod cmm;
mod error;
mod grinder;
mod outbox;
mod pattern;
mod references;
mod result;
mod stations;
mod watch;

pub use cmm::{CmmExchange, CmmFolders, StationFiles, Stations};
pub use error::ExchangeError;
pub use grinder::{GrinderExchange, GrinderFolders};
pub use pattern::{Pattern, file_word};
pub use references::{Reference, References, parse_references, read_references};
pub use result::{
    Content, Coordinates, DecimalMark, ResultFile, Statements, is_ended, parse_result, read_bytes, read_statements,
};
pub use stations::{PlacedStation, place_station};
pub use watch::{Found, Look, Watch};
