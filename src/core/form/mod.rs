//! Form figures of the deviations: PV, PVr, RMS, stock left and undercut, slopes, polynomials, ISO 10110-5.
//!
//! ```text
//!  deviations (x, y, d) --+--> RemovedForm --> DeviationFigures    each with removed forms, direction and cut-off
//!                         +--> PolynomialFit     Zernike or Legendre coefficients, orthogonal on the true aperture
//!  error map (on a grid) ----> Slope             over a stated integration length
//! ```
//!
//! Pure: no file, no clock, no randomness. Frames: x and y of the model frame {M}. Units: millimetres and radians
//! inside, nanometres and micrometres only in text. Signs: positive where material is above the nominal surface, along
//! the outward normal. The figures describe the surface. A wavefront reflected by a mirror has twice the error.

mod error;
mod figures;
mod fit;
mod iso;
mod iso_fits;
mod labels;
mod polynomial_basis;
mod removed_forms;
mod slope;
mod slope_operator;

pub use error::FormError;
pub use figures::{Coverage, DeviationFigures, Extreme, FormOptions, RobustPv, compute_figures, pv_998};
pub use fit::{PolynomialFit, fit_determined_terms, fit_polynomials};
pub use iso::{Iso10110, iso_10110, iso_10110_notation};
pub use iso_fits::{IsoFits, IsoFormValues};
pub use labels::{DIRECTION, LabelledFigure, NO_CUT_OFF, RemovedParts, label_figures, label_slope};
pub use polynomial_basis::PolynomialBasis;
pub use removed_forms::RemovedForm;
pub use slope::{Slope, slope};
pub use slope_operator::SlopeOperator;
