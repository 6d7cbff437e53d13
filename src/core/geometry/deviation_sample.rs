//! Deviation of a part from its nominal surface, with its position.

/// One deviation and the place where it was measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviationSample {
    /// x and y of the contact point in the model frame, in millimetres.
    pub place_mm: [f64; 2],
    /// Deviation in millimetres; positive where there is too much material.
    pub deviation_mm: f64,
}

impl DeviationSample {
    /// Returns true if x, y and the deviation are finite numbers.
    pub fn is_finite(&self) -> bool {
        (self.place_mm[0] + self.place_mm[1] + self.deviation_mm).is_finite()
    }
}
