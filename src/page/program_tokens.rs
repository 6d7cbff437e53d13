//! Attempts of programs with wrong tokens. Their number is limited for each place, an IPv4 address or an IPv6 network. They
//! are counted apart from the attempts of people, so that a program with a wrong token locks out no person.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};

use super::rate::Rate;
use super::sessions::place;

/// Maximum number of wrong tokens within a minute from one place. Each further one gets the answer that there were too
/// many. A correct token is always accepted: it is too long to be guessed.
const WRONG_TOKENS: u32 = 10;
/// Maximum number of places whose attempts are counted. The place with the fewest attempts is forgotten first.
const COUNTED: usize = 4096;

/// Number of wrong tokens of each place within a minute.
#[derive(Default)]
pub(crate) struct WrongTokens(Mutex<HashMap<IpAddr, Rate>>);

/// Result of a further wrong token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct WrongToken {
    /// True for the first wrong token of a place within a minute, which is recorded.
    pub(crate) is_first: bool,
    /// True if there were too many.
    pub(crate) is_too_many: bool,
}

impl WrongTokens {
    /// Counts a wrong token from the address `from`.
    pub(crate) fn count(&self, from: IpAddr) -> WrongToken {
        let mut counted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        counted.retain(|_, rate| !rate.is_over());
        let this = place(from);
        if counted.len() >= COUNTED && !counted.contains_key(&this) {
            let least = counted.iter().min_by_key(|(_, rate)| (rate.current_count(), Reverse(rate.age())));
            if let Some(least) = least.map(|(of, _)| *of) {
                counted.remove(&least);
            }
        }
        let count = counted.entry(this).or_insert_with(Rate::new).count();
        WrongToken { is_first: count == 1, is_too_many: count > WRONG_TOKENS }
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, Ipv6Addr};

    use super::*;

    #[test]
    fn wrong_tokens_are_counted_by_place() {
        let wrong = WrongTokens::default();
        let [one, other] = [1, 2].map(|last| IpAddr::from(Ipv4Addr::new(192, 0, 2, last)));
        let found: Vec<WrongToken> = (0..12).map(|_| wrong.count(one)).collect();
        assert_eq!(found.iter().filter(|of| of.is_first).count(), 1);
        assert_eq!(
            found.iter().map(|of| of.is_too_many).collect::<Vec<_>>(),
            [[false; 10].as_slice(), &[true; 2]].concat()
        );
        assert_eq!(wrong.count(other), WrongToken { is_first: true, is_too_many: false });
        // All addresses of an IPv6 network are one place.
        let far = |last: u16| IpAddr::from(Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, last));
        assert!((0..10).all(|last| !wrong.count(far(last)).is_too_many) && wrong.count(far(10)).is_too_many);
        // A place under attack stays, however many others come.
        for k in 0..COUNTED as u32 + 10 {
            wrong.count(IpAddr::from(Ipv4Addr::from(0x0a00_0000 + k)));
        }
        assert!(wrong.count(one).is_too_many && wrong.0.lock().unwrap().len() <= COUNTED);
    }
}
