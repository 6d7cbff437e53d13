//! Surfaces given by a formula.
