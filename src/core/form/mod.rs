//! Form figures of the deviations: PV, PVr, RMS, stock left and undercut, slopes, polynomials, ISO 10110-5.
//!
//! ```text
//!  deviations (x, y, d) --+--> removed terms --> Figures    each with removed forms, direction and cut-off
//!                         +--> Fit              Zernike or Legendre coefficients, orthogonal on the true aperture
//!  error map (on a grid) ----> Slope             over a stated integration length
//! ```
//!
//! Pure: no file, no clock, no randomness. Frames: x and y of the model frame {M}. Units: millimetres and radians
//! inside, nanometres and micrometres only in text. Signs: positive where material is above the nominal surface, along
//! the outward normal. The figures describe the surface. A wavefront reflected by a mirror has twice the error.

mod basis;
mod error;
mod figures;
mod fit;
mod iso;
mod labels;
mod of_many;
mod removed;
mod slope;
mod slope_of_many;

pub use basis::Basis;
pub use error::FormError;
pub use figures::{Coverage, Extreme, Figures, FormOptions, RobustPv, figures, pv_of_most};
pub use fit::{Fit, fit, fit_most};
pub use iso::{Iso10110, iso_10110, iso_10110_notation};
pub use labels::{DIRECTION, EVERY_POINT, Labelled, TakenOut, labelled, labelled_slope};
pub use of_many::{IsoFits, IsoOfForm};
pub use removed::Removed;
pub use slope::{Slope, slope};
pub use slope_of_many::SlopesAt;
