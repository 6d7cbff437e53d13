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

use data_encoding::HEXLOWER;
use tokio_postgres::types::ToSql;

use super::error::{PlantError, refused};
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
    /// Leases the queued part with the earliest due date, for the duration [`LEASE`]. Considers only parts that
    /// are free, that this cell may make, and whose recipe is approved. Returns `None` if there is no such part.
    ///
    /// # Errors
    /// Fails if this computer did not sign in as a cell, or if the plant cannot be reached.
    pub async fn acquire(link: &DatabaseLink) -> Result<Option<Self>, PlantError> {
        let text = "SELECT id, serial, recipe, due::text, lease FROM take_work($1)";
        let row = link.client().query_opt(text, &[&seconds()]).await.map_err(refused("a part"))?;
        Ok(row.map(|row| Self {
            work: row.get(0),
            serial: row.get(1),
            recipe_sha256: HEXLOWER.encode(row.get(2)),
            due: row.get(3),
            number: row.get(4),
        }))
    }

    /// Extends the lease, so that it ends after the duration [`LEASE`] from now.
    ///
    /// # Errors
    /// Fails if this lease of the part is no longer valid, for example because another cell has leased the part. Also
    /// fails if the plant cannot be reached.
    pub async fn renew(&self, link: &DatabaseLink) -> Result<(), PlantError> {
        self.ask(link, "SELECT renew_work($1, $2, $3)", &[&self.work, &self.number, &seconds()]).await
    }

    /// Registers in the plant that the run with the name `run` begins to make the leased part. From then on the part
    /// belongs to this run. Idempotent: a retry after a lost answer succeeds again.
    ///
    /// # Errors
    /// Fails if the lease has ended, if another run has the part, if the part was withdrawn, or if its recipe is no
    /// longer approved. Also fails if this cell already has another run with the name `run`, or if the plant cannot be
    /// reached.
    pub async fn begin(&self, link: &DatabaseLink, run: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT begin_work($1, $2, $3)", &[&self.work, &self.number, &run]).await
    }

    /// Returns the leased part to the queue before a run has begun to make it. `reason` is the reason, which the plant
    /// stores.
    ///
    /// # Errors
    /// Fails if this lease of the part is no longer valid, for example because another cell has leased the part. Also
    /// fails if the plant cannot be reached.
    pub async fn hand_back(&self, link: &DatabaseLink, reason: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT return_work($1, $2, $3)", &[&self.work, &self.number, &reason]).await
    }

    /// Returns the leased part to the queue because this cell cannot prove its recipe. The plant offers this part to this
    /// cell after all others. `reason` is the reason, which the plant stores.
    ///
    /// # Errors
    /// The same as for [`Lease::hand_back`].
    pub async fn refuse_recipe(&self, link: &DatabaseLink, reason: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT refuse_recipe($1, $2, $3)", &[&self.work, &self.number, &reason]).await
    }

    async fn ask(&self, link: &DatabaseLink, text: &str, values: &[&(dyn ToSql + Sync)]) -> Result<(), PlantError> {
        answered(link, self.work, text, values).await
    }
}

impl StartedPart {
    /// Returns the parts that this cell has begun to make, and whose end of run the plant has not received yet. The
    /// part that was begun first comes first.
    ///
    /// # Errors
    /// Fails if the plant cannot be reached or refuses the query.
    pub async fn all(link: &DatabaseLink) -> Result<Vec<Self>, PlantError> {
        let text =
            "SELECT id, serial, recipe, due::text, lease, run FROM work WHERE state = 'begun' ORDER BY begun_at, id";
        let rows = link.client().query(text, &[]).await.map_err(refused("the parts of this cell"))?;
        let begun = rows.iter().map(|row| Self {
            lease: Lease {
                work: row.get(0),
                serial: row.get(1),
                recipe_sha256: HEXLOWER.encode(row.get(2)),
                due: row.get(3),
                number: row.get(4),
            },
            run: row.get(5),
        });
        Ok(begun.collect())
    }

    /// Returns the part to the queue because its run has commanded no machine. The caller must have checked this in the
    /// journal of the run. `reason` is the reason, which the plant stores.
    ///
    /// # Errors
    /// Fails if the plant's copy shows that the run has commanded a machine or has ended. Fails if this cell has not
    /// begun the part in this run, or if the plant cannot be reached.
    pub async fn give_back(&self, link: &DatabaseLink, reason: &str) -> Result<(), PlantError> {
        answered(link, self.lease.work, "SELECT give_back_work($1, $2, $3)", &[&self.lease.work, &self.run, &reason])
            .await
    }

    /// Marks the part as ended in the plant, because its run does not continue. The part gets no other run, unless a
    /// planner puts it into the queue again. `reason` is the reason, which the plant stores.
    ///
    /// # Errors
    /// Fails if this cell has not begun the part in the run [`StartedPart::run`], or if the plant cannot be reached.
    pub async fn give_up(&self, link: &DatabaseLink, reason: &str) -> Result<(), PlantError> {
        answered(link, self.lease.work, "SELECT give_up_work($1, $2, $3)", &[&self.lease.work, &self.run, &reason])
            .await
    }
}

/// Runs the SQL query `text` with the parameters `values`. The query changes the state of the part with the number
/// `work` in the queue. Returns an error if the database answers with a reason why it refuses the change, or if the
/// plant cannot be reached.
async fn answered(
    link: &DatabaseLink,
    work: i64,
    text: &str,
    values: &[&(dyn ToSql + Sync)],
) -> Result<(), PlantError> {
    let row = link.client().query_one(text, values).await.map_err(refused("a part"))?;
    match row.get::<_, Option<String>>(0) {
        Some(reason) => Err(PlantError::Work { work, reason }),
        None => Ok(()),
    }
}

fn seconds() -> i32 {
    i32::try_from(LEASE.as_secs()).unwrap_or(i32::MAX)
}
