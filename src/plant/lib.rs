//! Many cells: their records, work and knowledge in one PostgreSQL.
//!
//! A cell never needs the plant to run, hold or accept, and the plant never commands a motion. What leaves the cell is its record; what
//! comes in is work and knowledge, both asked for.

mod settings;

pub use settings::{ArtefactSettings, DatabaseSettings};
