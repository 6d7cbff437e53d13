//! Sessions of signed-in users, and the limits of their attempts to sign in. Passwords are checked one at a time. The
//! attempts of each place are limited; a place is an IPv4 address or an IPv6 network.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::rate::Rate;
use super::users::{AuthenticatedUser, Person, UsersFile};

/// Duration of a session: a shift and its handover.
const SESSION_LIFETIME: Duration = Duration::from_secs(12 * 3600);
/// Maximum number of browsers that are signed in at a time. Beyond it, the oldest session ends.
const MAX_SESSIONS: usize = 256;
/// Maximum number of attempts within a minute under one name from one place. Further attempts are not checked. Other
/// users at that place can still sign in.
const TRIES: u32 = 10;
/// Maximum number of pairs of name and place whose attempts are counted, and maximum number of names for one place. The
/// pair with the fewest attempts is forgotten first.
const COUNTED: usize = 4096;
const NAMES_OF_PLACE: usize = 64;
/// Maximum number of password checks that one place can have waiting, so that its guesses do not delay the sign-in of
/// others.
const WAITING_OF_PLACE: usize = 2;
/// Maximum time that a sign-in waits for the password checks of others, and interval at which it tries again.
const WAITS: Duration = Duration::from_secs(5);
const ASKED_EVERY: Duration = Duration::from_millis(20);

/// Sessions of signed-in users, and attempts to sign in.
pub(crate) struct SignedIn {
    /// Sessions of the browsers, in the order in which they began.
    sessions: Mutex<Vec<(String, AuthenticatedUser, Instant)>>,
    tries: Mutex<HashMap<(IpAddr, String), Rate>>,
    /// Number of waiting password checks for each place.
    waiting: Mutex<HashMap<IpAddr, usize>>,
    /// A password check costs time and memory by design. Only one runs at a time, so guesses cost the computer no more.
    proving: Arc<Semaphore>,
}

impl Default for SignedIn {
    fn default() -> Self {
        Self {
            sessions: Mutex::default(),
            tries: Mutex::default(),
            waiting: Mutex::default(),
            proving: Arc::new(Semaphore::new(1)),
        }
    }
}

impl SignedIn {
    /// Returns the person who signed in with the browser session `session`. Returns `None` if nobody signed in, or if
    /// the session is older than `SESSION_LIFETIME`. Also returns `None` if the entry of the person in `users` has
    /// changed since the sign-in.
    pub(crate) fn person(&self, session: &str, users: &UsersFile) -> Option<Person> {
        let mut sessions = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        sessions.retain(|(.., since)| since.elapsed() < SESSION_LIFETIME);
        let (_, proven, _) = sessions.iter().find(|(id, ..)| id == session)?;
        users.has(proven).then(|| proven.person())
    }

    pub(crate) fn add(&self, session: &str, proven: AuthenticatedUser) {
        let mut sessions = self.sessions.lock().unwrap_or_else(PoisonError::into_inner);
        if sessions.len() >= MAX_SESSIONS {
            sessions.remove(0);
        }
        sessions.push((session.to_owned(), proven, Instant::now()));
    }

    pub(crate) fn remove(&self, session: &str) {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner).retain(|(id, ..)| id != session);
    }

    /// Counts an attempt to sign in with the user name `name` from the address `from`. Returns true if the password may
    /// be checked. Returns false if there were more than `TRIES` attempts with this name and address within a minute.
    pub(crate) fn may_try(&self, from: IpAddr, name: &str) -> bool {
        let mut tries = self.tries.lock().unwrap_or_else(PoisonError::into_inner);
        tries.retain(|_, rate| !rate.is_over());
        let this = (place(from), name.to_owned());
        if !tries.contains_key(&this) {
            // The pair with the fewest attempts is removed. A name under attack therefore stays, however many other
            // names are tried.
            let least = |of: &mut dyn Iterator<Item = (&(IpAddr, String), &Rate)>| {
                of.min_by_key(|(_, rate)| (rate.current_count(), Reverse(rate.age()))).map(|(tried, _)| tried.clone())
            };
            let is_here = |(tried, _): &(&(IpAddr, String), &Rate)| tried.0 == this.0;
            let forgotten = match tries.iter().filter(is_here).count() >= NAMES_OF_PLACE {
                true => least(&mut tries.iter().filter(is_here)),
                false if tries.len() >= COUNTED => least(&mut tries.iter()),
                false => None,
            };
            if let Some(forgotten) = forgotten {
                tries.remove(&forgotten);
            }
        }
        tries.entry(this).or_insert_with(Rate::new).count() <= TRIES
    }

    /// Resets the count of sign-in attempts with the user name `name` from the address `from`. The caller calls this
    /// after a correct password.
    pub(crate) fn forget_tries(&self, from: IpAddr, name: &str) {
        self.tries.lock().unwrap_or_else(PoisonError::into_inner).remove(&(place(from), name.to_owned()));
    }

    /// Reserves a slot in the queue of password checks for a client at the address `from`. Each IPv4 address and each
    /// IPv6 /64 network has a limited number of slots. If all slots of the client are in use, waits until one is free.
    /// Returns `None` if no slot becomes free within the time [`WAITS`]. The slot is released when the returned value
    /// is dropped.
    pub(crate) async fn wait_a_while(&self, from: IpAddr) -> Option<Waiting<'_>> {
        let began = Instant::now();
        loop {
            match self.wait(from) {
                None if began.elapsed() < WAITS => tokio::time::sleep(ASKED_EVERY).await,
                waiting => return waiting,
            }
        }
    }

    /// Reserves a slot in the queue of password checks for a client at the address `from`, without waiting. Each IPv4
    /// address and each IPv6 /64 network has `WAITING_OF_PLACE` slots. Returns `None` if all slots of the client are in
    /// use. The slot is released when the returned value is dropped.
    fn wait(&self, from: IpAddr) -> Option<Waiting<'_>> {
        let place = place(from);
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let count = waiting.entry(place).or_default();
        if *count >= WAITING_OF_PLACE {
            return None;
        }
        *count += 1;
        Some(Waiting { of: self, place })
    }

    /// Waits until no other password check runs, and returns the permit to run a password check. Only one check runs at
    /// a time. The next check can begin when the permit is dropped. Returns `None` if the wait takes longer than
    /// [`WAITS`].
    pub(crate) async fn turn(&self) -> Option<OwnedSemaphorePermit> {
        let turn = Arc::clone(&self.proving).acquire_owned();
        tokio::time::timeout(WAITS, turn).await.ok()?.ok()
    }
}

/// Slot in the queue of password checks. It is released on drop.
pub(crate) struct Waiting<'s> {
    of: &'s SignedIn,
    place: IpAddr,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        let mut waiting = self.of.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = waiting.get_mut(&self.place) {
            *count -= 1;
            if *count == 0 {
                waiting.remove(&self.place);
            }
        }
    }
}

/// Returns the address under which the attempts and connections of a client are counted: the address itself for IPv4,
/// and its /64 network for IPv6, where one client can use all addresses of a network.
pub(crate) fn place(from: IpAddr) -> IpAddr {
    match from.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX))),
        address => address,
    }
}
