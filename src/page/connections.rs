//! Open connections of a page, with their limits.

use std::net::IpAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::task::AbortHandle;

use super::sessions::place;

/// Maximum number of simultaneous connections: of authorised clients, of clients that are not yet authorised, and of
/// the latter from one address.
const KNOWN: usize = 512;
const STRANGERS: usize = 384;
const STRANGERS_OF_ADDRESS: usize = 64;

/// Connections of a page.
///
/// If the limit for clients that are not yet authorised is reached, a new connection ends the oldest of
/// them: of the same address or network, or of the address that has most. A client that opens many idle connections
/// therefore locks out no client elsewhere and no authorised client.
#[derive(Default)]
pub(crate) struct Connections(Mutex<Open>);

#[derive(Default)]
struct Open {
    /// Connections of clients that are not yet authorised, in the order in which they came.
    strangers: Vec<(u64, IpAddr, AbortHandle)>,
    known: Vec<(u64, AbortHandle)>,
}

impl Connections {
    fn open(&self) -> MutexGuard<'_, Open> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds the connection with the number `number` from the address `from`, which `serving` can end. If there are then too
    /// many connections of clients that are not yet authorised, ends the oldest of them.
    pub(crate) fn add(&self, number: u64, from: IpAddr, serving: AbortHandle) {
        self.open().add(number, from, serving);
    }

    /// Returns the number of connections of authorised clients, and of clients that are not yet authorised.
    pub(crate) fn counts(&self) -> [usize; 2] {
        let open = self.open();
        [open.known.len(), open.strangers.len()]
    }

    /// Marks the connection with the number `number` as a connection of an authorised client. If there are then too
    /// many connections of authorised clients, ends the oldest of them. Does nothing if the connection is unknown or
    /// already marked.
    pub(crate) fn know(&self, number: u64) {
        let mut open = self.open();
        if let Some(at) = open.strangers.iter().position(|(of, ..)| *of == number) {
            let (_, _, serving) = open.strangers.remove(at);
            open.known.push((number, serving));
            if open.known.len() > KNOWN {
                open.known.remove(0).1.abort();
            }
        }
    }

    fn end(&self, number: u64) {
        let mut open = self.open();
        open.strangers.retain(|(of, ..)| *of != number);
        open.known.retain(|(of, _)| *of != number);
    }
}

impl Open {
    fn add(&mut self, number: u64, from: IpAddr, serving: AbortHandle) {
        self.strangers.push((number, place(from), serving));
        let count = |from: IpAddr| self.strangers.iter().filter(|(_, of, _)| *of == from).count();
        let most = match count(place(from)) > STRANGERS_OF_ADDRESS {
            true => Some(place(from)),
            false if self.strangers.len() > STRANGERS => {
                self.strangers.iter().map(|(_, of, _)| *of).max_by_key(|of| count(*of))
            }
            false => None,
        };
        let oldest = most.and_then(|from| self.strangers.iter().position(|(_, of, _)| *of == from));
        if let Some(oldest) = oldest {
            self.strangers.remove(oldest).2.abort();
        }
    }
}

/// Connection in the list, until it ends.
pub(crate) struct Place {
    connections: Arc<Connections>,
    number: u64,
}

impl Place {
    /// Returns the place of the connection with the number `number`.
    pub(crate) fn new(connections: &Arc<Connections>, number: u64) -> Self {
        Self { connections: Arc::clone(connections), number }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.connections.end(self.number);
    }
}
