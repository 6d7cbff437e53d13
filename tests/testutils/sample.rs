//! Number of seeds that a test draws: a few that are the same in every run, or more if `REGRIND_SEEDS` is set.

/// Returns true if tests draw all their cases, that is, if `REGRIND_SEEDS` is set.
pub fn all() -> bool {
    std::env::var_os("REGRIND_SEEDS").is_some()
}

/// Returns all cases if tests draw all; otherwise one case in every `one_in`, beginning with the first.
pub fn cases<T>(cases: impl IntoIterator<Item = T>, one_in: usize) -> impl Iterator<Item = T> {
    cases.into_iter().step_by(if all() { 1 } else { one_in })
}

/// Returns the number of seeds that a test draws: `few`, or the value of `REGRIND_SEEDS`.
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
