//! Pool of connections to the database. The connections are read-only and limit the time of each query.

use std::ops::Deref;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::{Semaphore, SemaphorePermit};

use super::super::error::{PlantError, refused};
use super::super::link::DatabaseLink;
use super::super::schema::check_layout;
use super::super::settings::DatabaseSettings;

/// Maximum number of connections.
const LINKS: usize = 4;
/// Time limit to wait for a free connection, and time limit for a pooled connection to answer a check.
const TURN: Duration = Duration::from_secs(5);
const SIGN_OF_LIFE: Duration = Duration::from_secs(2);
/// Settings of each connection, in SQL. JIT is off because compiling a query would take longer than running it.
const RULES: &str = "SET statement_timeout = '5s'; SET default_transaction_read_only = on; SET jit = off";

pub(super) struct Pool {
    database: DatabaseSettings,
    places: Semaphore,
    idle: Mutex<Vec<DatabaseLink>>,
}

/// Connection that returns to the pool when it is dropped, if it is still usable.
pub(super) struct Lease<'p> {
    link: Option<DatabaseLink>,
    pool: &'p Pool,
    _place: SemaphorePermit<'p>,
}

impl Pool {
    pub(super) fn new(database: DatabaseSettings) -> Self {
        Self { database, places: Semaphore::new(LINKS), idle: Mutex::default() }
    }

    /// Takes a connection that still answers from the pool. If there is none, opens a new connection.
    ///
    /// Returns an error if all connections are in use and none becomes free within 5 s, or if a new connection cannot
    /// be opened.
    pub(super) async fn lease(&self) -> Result<Lease<'_>, PlantError> {
        let busy = || PlantError::Unreachable {
            place: "the other end".into(),
            what: format!("all {LINKS} connections of the page are busy"),
        };
        let place = tokio::time::timeout(TURN, self.places.acquire()).await;
        let place = place.ok().and_then(Result::ok).ok_or_else(busy)?;
        let lease = |link| Lease { link: Some(link), pool: self, _place: place };
        while let Some(link) = self.kept() {
            let answer = tokio::time::timeout(SIGN_OF_LIFE, link.client().simple_query("")).await;
            if matches!(answer, Ok(Ok(_))) {
                return Ok(lease(link));
            }
        }
        Ok(lease(self.open().await?))
    }

    fn kept(&self) -> Option<DatabaseLink> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner).pop()
    }

    /// Opens a new read-only connection to the database and limits the time of its queries.
    ///
    /// Returns an error if the database cannot be reached, or if its layout (its tables and functions) is not the one
    /// that this program uses.
    pub(super) async fn open(&self) -> Result<DatabaseLink, PlantError> {
        let link = DatabaseLink::open(&self.database).await?;
        check_layout(link.client()).await?;
        link.client().batch_execute(RULES).await.map_err(refused("to keep to reading"))?;
        Ok(link)
    }
}

impl Deref for Lease<'_> {
    type Target = DatabaseLink;

    fn deref(&self) -> &DatabaseLink {
        match &self.link {
            Some(link) => link,
            None => unreachable!("it is given back when this is dropped, and not before"),
        }
    }
}

impl Drop for Lease<'_> {
    fn drop(&mut self) {
        if let Some(link) = self.link.take().filter(|link| !link.is_closed()) {
            self.pool.idle.lock().unwrap_or_else(PoisonError::into_inner).push(link);
        }
    }
}
