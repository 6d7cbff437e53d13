//! Plant of several cells: their records and their queue in one PostgreSQL database, and a page that shows them.
//!
//! A cell never needs the plant to run, hold or accept, and the plant never commands a motion. A cell sends its record
//! to the plant, and fetches work from it.
#![cfg(feature = "plant")]

mod archive;
mod copy;
mod error;
mod fill;
mod gaps;
mod knowledge;
mod link;
mod page;
mod recipes;
mod replication;
mod reported;
mod schema;
mod settings;
mod studies;
mod work;

pub use archive::{ArchiveResult, archive_runs, restore_run};
pub use copy::{PlantRun, content};
pub use error::PlantError;
pub use fill::{Filling, RunPattern, TableSize, table_sizes};
pub use gaps::RunGap;
pub use knowledge::Knowledge;
pub use link::DatabaseLink;
pub use page::PlantPage;
pub use recipes::{Approval, PlantRecipe};
pub use replication::{ReplicationResult, Replicator, run_overview};
pub use reported::Reported;
pub use schema::{NewMember, PlantRole, add_cell_keys, check_layout, enrol, enrol_cell, migrate, retire_cell};
pub use settings::{Approver, ArchiveSettings, ArtefactSettings, DatabaseSettings};
pub use studies::{LeasedRun, RENEWAL, Study};
pub use tokio_postgres::Row;
pub use tokio_postgres::types::ToSql;
pub use work::{LEASE, Lease, StartedPart};
