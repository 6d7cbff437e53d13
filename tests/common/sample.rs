//! How much of what could be drawn a test draws: a small sample that is the same in every run, or more where somebody asks for it.

/// Returns how many seeds a test draws: `few`, or as many as `REGRIND_SEEDS` says.
pub fn seeds(few: u64) -> u64 {
    match std::env::var("REGRIND_SEEDS") {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("REGRIND_SEEDS is no number: {text}")),
        Err(_) => few,
    }
}
