//! The number of seeds that a test draws: few, the same in every run, or more by `REGRIND_SEEDS`.

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
