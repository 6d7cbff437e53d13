//! The numerical core against truths that were planted, worked out by hand, or found by other means.

mod accuracy;
mod common;
mod defects;
mod distance;
mod doubts;
mod exact;
mod form;
mod learning;
mod map;
mod model;
mod narrow;
mod paper;
mod parameters;
mod parts;
#[path = "../../../../tests/common/sample.rs"]
mod sample;
mod search;
mod taught;
mod touches;
mod unknown;
