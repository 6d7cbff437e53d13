//! The outline of a part in the plane.

/// Outline.
#[derive(Clone, Debug)]
pub struct Aperture;
impl Aperture {
    /// x
    pub fn contains(&self, _x: f64, _y: f64) -> bool {
        true
    }
}
