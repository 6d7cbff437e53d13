//! Many cells: their records, work and knowledge in one PostgreSQL.
//!
//! A cell never needs the plant to run, hold or accept, and the plant never commands a motion. What leaves the cell is its record; what
//! comes in is work and knowledge, both asked for.

mod error;
mod link;
mod schema;
mod settings;

pub use error::PlantError;
pub use link::Link;
pub use schema::{PlantRole, enrol, enrol_cell, is_known, migrate, retire_cell};
pub use settings::{ArtefactSettings, DatabaseSettings};
