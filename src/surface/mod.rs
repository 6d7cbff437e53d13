//! Nominal surfaces: what the part should be.

pub mod analytic;
