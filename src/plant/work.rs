//! The queue of parts, as a cell uses it: a cell leases a part, confirms the lease, and begins a run; from then on the
//! part belongs to that run.
//!
//! ```text
//!  open --take--> leased --begin--> begun --the run's end arrives--> ended
//!    ^               |                 |
//!    +--return, or --+                 |     an expired lease is void: the next has another number
//!    |  its time is over               |
//!    +--give back, if its run did nothing                  ended <--give up, if its run does not continue
//! ```

use std::time::Duration;

use tokio_postgres::types::ToSql;

use super::error::{PlantError, refused};
use super::hex::digits;
use super::link::DatabaseLink;

/// Duration of a lease.
pub const LEASE: Duration = Duration::from_secs(300);

/// Part that a cell has leased.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lease {
    /// Number of the part in the queue.
    pub work: i64,
    /// Serial number of the part.
    pub serial: String,
    /// Hash of the recipe, in hexadecimal digits.
    pub recipe_sha256: String,
    /// Due date, if a planner gave one.
    pub due: Option<String>,
    /// Number of this lease of the part.
    pub number: i32,
}

/// Part whose run a cell has started.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StartedPart {
    /// Lease under which the part was begun.
    pub lease: Lease,
    /// Name of the run.
    pub run: String,
}

impl Lease {
    /// Leases the part that is due first, for the duration [`LEASE`]. Returns `None` if there is no part for this cell.
    ///
    /// # Errors
    /// This computer did not sign in as a cell, or the plant cannot be reached.
    pub async fn acquire(link: &DatabaseLink) -> Result<Option<Self>, PlantError> {
        let text = "SELECT id, serial, recipe, due::text, lease FROM take_work($1)";
        let row = link.client().query_opt(text, &[&seconds()]).await.map_err(refused("a part"))?;
        Ok(row.map(|row| Self {
            work: row.get(0),
            serial: row.get(1),
            recipe_sha256: digits(row.get(2)),
            due: row.get(3),
            number: row.get(4),
        }))
    }

    /// Renews the lease: it then ends [`LEASE`] from now.
    ///
    /// # Errors
    /// The lease has ended, or the plant cannot be reached.
    pub async fn renew(&self, link: &DatabaseLink) -> Result<(), PlantError> {
        self.ask(link, "SELECT renew_work($1, $2, $3)", &[&self.work, &self.number, &seconds()]).await
    }

    /// Begins the part in a run of this name. Idempotent: a retry after a lost answer returns the same answer.
    ///
    /// # Errors
    /// The lease has ended, another run has the part, or the recipe was withdrawn; or the plant cannot be reached.
    pub async fn begin(&self, link: &DatabaseLink, run: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT begin_work($1, $2, $3)", &[&self.work, &self.number, &run]).await
    }

    /// Returns the leased part to the queue, before a run was begun. `why` is the reason, for the plant.
    ///
    /// # Errors
    /// The lease has ended, or the plant cannot be reached.
    pub async fn hand_back(&self, link: &DatabaseLink, why: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT return_work($1, $2, $3)", &[&self.work, &self.number, &why]).await
    }

    async fn ask(&self, link: &DatabaseLink, text: &str, values: &[&(dyn ToSql + Sync)]) -> Result<(), PlantError> {
        answered(link, self.work, text, values).await
    }
}

impl StartedPart {
    /// Returns the parts whose runs this cell has started, and whose end has not arrived at the plant yet.
    ///
    /// # Errors
    /// This computer did not sign in as a cell, or the plant cannot be reached.
    pub async fn all(link: &DatabaseLink) -> Result<Vec<Self>, PlantError> {
        let text =
            "SELECT id, serial, recipe, due::text, lease, run FROM work WHERE state = 'begun' ORDER BY begun_at, id";
        let rows = link.client().query(text, &[]).await.map_err(refused("the parts of this cell"))?;
        let begun = rows.iter().map(|row| Self {
            lease: Lease {
                work: row.get(0),
                serial: row.get(1),
                recipe_sha256: digits(row.get(2)),
                due: row.get(3),
                number: row.get(4),
            },
            run: row.get(5),
        });
        Ok(begun.collect())
    }

    /// Returns the part to the queue after its run did nothing, which the caller has checked. `why` is the reason, for
    /// the plant.
    ///
    /// # Errors
    /// The run has commanded a machine, or the plant cannot be reached.
    pub async fn give_back(&self, link: &DatabaseLink, why: &str) -> Result<(), PlantError> {
        answered(link, self.lease.work, "SELECT give_back_work($1, $2, $3)", &[&self.lease.work, &self.run, &why]).await
    }

    /// Gives the part up, because its run does not continue. The part gets no other run, unless a planner queues it
    /// again. `why` is the reason, for the plant.
    ///
    /// # Errors
    /// This cell has not started the part in the run [`StartedPart::run`], or the plant cannot be reached.
    pub async fn give_up(&self, link: &DatabaseLink, why: &str) -> Result<(), PlantError> {
        answered(link, self.lease.work, "SELECT give_up_work($1, $2, $3)", &[&self.lease.work, &self.run, &why]).await
    }
}

/// Runs a query of the database that changes the state of the part `work`. If the answer contains a reason, the
/// database has refused, and this reason is returned as an error.
async fn answered(
    link: &DatabaseLink,
    work: i64,
    text: &str,
    values: &[&(dyn ToSql + Sync)],
) -> Result<(), PlantError> {
    let row = link.client().query_one(text, values).await.map_err(refused("a part"))?;
    match row.get::<_, Option<String>>(0) {
        Some(why) => Err(PlantError::Work { work, why }),
        None => Ok(()),
    }
}

fn seconds() -> i32 {
    i32::try_from(LEASE.as_secs()).unwrap_or(i32::MAX)
}
