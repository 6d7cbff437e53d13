//! Many cells: their records, work and knowledge in one PostgreSQL.
//!
//! A cell never needs the plant to run, hold or accept, and the plant never commands a motion. What leaves the cell is its record; what
//! comes in is work and knowledge, both asked for.

mod copy;
mod error;
mod hex;
mod link;
mod page;
mod schema;
mod settings;
mod ship;

pub use copy::{PlantRun, content};
pub use error::PlantError;
pub use link::Link;
pub use page::PlantPage;
pub use schema::{PlantRole, enrol, enrol_cell, is_known, migrate, retire_cell};
pub use settings::{ArtefactSettings, DatabaseSettings};
pub use ship::{Shipped, Shipper};
pub use tokio_postgres::Row;
pub use tokio_postgres::types::ToSql;
