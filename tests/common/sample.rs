//! The number of seeds that a test draws: few, the same in every run, or more by `REGRIND_SEEDS`.
#![allow(dead_code, reason = "not every test that includes this uses all of it")]

/// Returns whether tests draw all that they can: `REGRIND_SEEDS` is set.
pub fn all() -> bool {
    std::env::var_os("REGRIND_SEEDS").is_some()
}

/// Returns all cases where tests draw all, and otherwise one in so many, beginning with the first.
pub fn cases<T>(cases: impl IntoIterator<Item = T>, one_in: usize) -> impl Iterator<Item = T> {
    cases.into_iter().step_by(if all() { 1 } else { one_in })
}

/// Returns how many seeds a test draws: `few`, or as many as `REGRIND_SEEDS` says.
pub fn seeds(few: u64) -> u64 {
    match std::env::var("REGRIND_SEEDS") {
        Ok(text) => text
            .parse::<u64>()
            .ok()
            .filter(|seeds| *seeds > 0)
            .unwrap_or_else(|| panic!("REGRIND_SEEDS is no number above 0: {text}")),
        Err(_) => few,
    }
}
