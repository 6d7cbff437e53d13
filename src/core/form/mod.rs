//! What is left on the part, in the field's figures: PV, PVr, RMS, stock left and undercut, slopes, polynomials, ISO 10110-5.
//!
//! ```text
//!  deviations (x, y, d) --+--> removed terms --> Figures    each with what was removed, its direction and its cut-off
//!                         +--> Fit              Zernike or Legendre coefficients, orthogonal on the true aperture
//!  error map (on a grid) ----> Slope             over a stated integration length
//! ```
//!
//! Pure: no file, no clock, no randomness. Frames: x and y of the model frame {M}. Units: millimetres and radians inside, nanometres
//! and micrometres only where words are made. Signs: positive where material stands proud, along the outward normal. Figures are those of the
//! surface and not of a wavefront, which a mirror doubles.

mod basis;
mod error;
mod figures;
mod fit;
mod iso;
mod labels;
mod slope;

pub use basis::Basis;
pub use error::FormError;
pub use figures::{Coverage, Extreme, Figures, FormOptions, Removed, RobustPv, figures};
pub use fit::{Fit, fit, fit_most};
pub use iso::{Iso10110, iso_10110};
pub use labels::{DIRECTION, EVERY_POINT, Labelled, TakenOut, labelled, labelled_slope};
pub use slope::{Slope, slope};

/// A deviation and where on the part it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// x and y in the model frame, in millimetres.
    pub at_mm: [f64; 2],
    /// Positive where material stands proud, in millimetres.
    pub deviation_mm: f64,
}

/// Refuses samples that no figure can be made of.
fn check(samples: &[Sample], least: usize) -> Result<(), FormError> {
    if samples.len() < least {
        return Err(FormError::TooFewPoints { points: samples.len(), least });
    }
    let finite = |s: &Sample| (s.at_mm[0] + s.at_mm[1] + s.deviation_mm).is_finite();
    match samples.iter().position(|sample| !finite(sample)) {
        Some(index) => Err(FormError::NotFinite { index }),
        None => Ok(()),
    }
}

/// Returns the smallest rectangle along the axes that holds all samples: [[x least, y least], [x most, y most]].
fn bounds(samples: &[Sample]) -> [[f64; 2]; 2] {
    samples.iter().fold([[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]], |[low, high], s| {
        let [x, y] = s.at_mm;
        [[low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]]
    })
}
