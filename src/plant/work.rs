//! The queue of parts, as a cell takes from it: leased, confirmed, begun, and then its run's for good.
//!
//! ```text
//!  open --take--> leased --begin--> begun --the run's end arrives--> ended
//!    ^               |                 |
//!    +--return, or --+                 |     a lease that ran out opens nothing: the next has another number
//!    |  its time is over               |
//!    +--give back, where nothing came of its run           ended <--give up, where its run is not gone on with
//! ```

use std::time::Duration;

use tokio_postgres::types::ToSql;

use super::error::{PlantError, refused};
use super::hex::digits;
use super::link::Link;

/// How long a part is kept for a cell that has taken it.
pub const LEASE: Duration = Duration::from_secs(300);

/// A part that a cell has taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lease {
    /// Its number in the queue.
    pub work: i64,
    /// The serial number of the part.
    pub serial: String,
    /// The hash of the recipe, in hexadecimal digits.
    pub recipe_sha256: String,
    /// When it is due, if somebody said so.
    pub due: Option<String>,
    /// Which lease of the part this is.
    pub number: i32,
}

/// A part that a cell has begun.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Begun {
    /// The part, as it was taken.
    pub lease: Lease,
    /// What its run is called.
    pub run: String,
}

impl Lease {
    /// Takes the part that is due first, for some minutes; none where there is none for this cell.
    ///
    /// # Errors
    /// A role that is no cell's, a plant that cannot be reached.
    pub async fn take(link: &Link) -> Result<Option<Self>, PlantError> {
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

    /// Keeps the part for some minutes more, from now.
    ///
    /// # Errors
    /// A lease that is over, a plant that cannot be reached.
    pub async fn renew(&self, link: &Link) -> Result<(), PlantError> {
        self.ask(link, "SELECT renew_work($1, $2, $3)", &[&self.work, &self.number, &seconds()]).await
    }

    /// Begins the part in a run of this name. The same again has the same answer, so that one that was lost can be asked for.
    ///
    /// # Errors
    /// A lease that is over, a part that another run has, a recipe that was withdrawn; a plant that cannot be reached.
    pub async fn begin(&self, link: &Link, run: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT begin_work($1, $2, $3)", &[&self.work, &self.number, &run]).await
    }

    /// Gives the part back, unbegun.
    ///
    /// # Errors
    /// A lease that is over, a plant that cannot be reached.
    pub async fn hand_back(&self, link: &Link, why: &str) -> Result<(), PlantError> {
        self.ask(link, "SELECT return_work($1, $2, $3)", &[&self.work, &self.number, &why]).await
    }

    async fn ask(&self, link: &Link, text: &str, values: &[&(dyn ToSql + Sync)]) -> Result<(), PlantError> {
        answered(link, self.work, text, values).await
    }
}

impl Begun {
    /// Finds what this cell has begun and whose end has not arrived.
    ///
    /// # Errors
    /// A role that is no cell's, a plant that cannot be reached.
    pub async fn all(link: &Link) -> Result<Vec<Self>, PlantError> {
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

    /// Gives the part back, of whose run nothing came: the cell has looked.
    ///
    /// # Errors
    /// A run in which something was asked of a machine, a plant that cannot be reached.
    pub async fn give_back(&self, link: &Link, why: &str) -> Result<(), PlantError> {
        answered(link, self.lease.work, "SELECT give_back_work($1, $2, $3)", &[&self.lease.work, &self.run, &why]).await
    }

    /// Gives the part up: its run is not gone on with, and no other takes its place unless a planner says so.
    ///
    /// # Errors
    /// A part that this cell has not begun in that run, a plant that cannot be reached.
    pub async fn give_up(&self, link: &Link, why: &str) -> Result<(), PlantError> {
        answered(link, self.lease.work, "SELECT give_up_work($1, $2, $3)", &[&self.lease.work, &self.run, &why]).await
    }
}

/// Asks for a step of a part, which is refused in words.
async fn answered(link: &Link, work: i64, text: &str, values: &[&(dyn ToSql + Sync)]) -> Result<(), PlantError> {
    let row = link.client().query_one(text, values).await.map_err(refused("a part"))?;
    match row.get::<_, Option<String>>(0) {
        Some(why) => Err(PlantError::Work { work, why }),
        None => Ok(()),
    }
}

fn seconds() -> i32 {
    i32::try_from(LEASE.as_secs()).unwrap_or(i32::MAX)
}
