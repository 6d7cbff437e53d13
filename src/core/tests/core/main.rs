//! The numerical core against truths that were planted, worked out by hand, or found by other means.

mod accuracy;
mod common;
mod defects;
mod degenerate;
mod distance;
mod exact;
mod form;
mod learning;
mod limitations;
mod map;
mod model;
mod paper;
mod parameters;
mod part_priors;
mod part_shapes;
mod plausibility;
mod search;
mod stitching;
mod stopping;
