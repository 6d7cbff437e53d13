//! What a registration found.

use crate::geometry::Pose;
use crate::surface::Side;

use super::deviation::Deviation;
use super::iterate::Iteration;
use super::verdict::Verdict;

/// What a registration found.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Takes model coordinates to CMM coordinates: the paper's g.
    pub cmm_from_model: Pose,
    /// One for each measured point, in the order given.
    pub deviations: Vec<Deviation>,
    /// The trace of the iteration, steps taken back included.
    pub trace: Vec<Iteration>,
    /// The side on which the probe was.
    pub side: Side,
    /// How well the pose is known, and what to think of it.
    pub verdict: Verdict,
}
