//! The numerical core against truths that were planted, worked out by hand, or found by other means.

mod accuracy;
mod common;
mod defects;
mod distance;
mod plausibility;
mod exact;
mod form;
mod learning;
mod map;
mod model;
mod degenerate;
mod paper;
mod parameters;
mod part_shapes;
#[path = "../../../../tests/common/sample.rs"]
mod sample;
mod search;
mod part_priors;
mod stopping;
mod limitations;
