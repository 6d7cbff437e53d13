//! A deviation of a part from its nominal surface, and where it is.

/// One deviation and where it was measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// x and y of the contact point in the model frame, in millimetres.
    pub at_mm: [f64; 2],
    /// Positive where material stands proud, in millimetres.
    pub deviation_mm: f64,
}

impl Sample {
    /// Whether all of its numbers are finite.
    pub fn is_finite(&self) -> bool {
        (self.at_mm[0] + self.at_mm[1] + self.deviation_mm).is_finite()
    }
}
