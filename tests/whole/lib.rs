//! Has nothing of its own: `cargo test --workspace` builds `regrind` with the features that this crate asks for, as the packages have it,
//! while `cargo run` and `cargo install` build it without them.
