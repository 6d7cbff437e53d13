//! The numerical core of Regrind: finds the pose of the part, and computes what to grind away next.
//!
//! ```text
//!  nominal ---> surface ----+
//!                           +--> registration --> compensation --> error map, correction, path of the wheel
//!  probe's centres ---------+          |
//!  (stitching: several maps at once)   |
//!  (measuring: where to touch)         +--> form: residual error of the part
//! ```
//!
//! Pure: no file, no clock, no randomness, no machine, no logging. The same input gives the same bits on any number of
//! threads.
//!
//! Conventions: millimetres and radians. The frames are the model's {M} and the CMM's {W}. The name of a pose says what
//! it does: `cmm_from_model` transforms model coordinates to CMM coordinates. A deviation is signed along the outward
//! normal, towards the probe's side, and is positive where there is too much material.
//!
//! Example: the pose of a part from measured probe centres. The part is a dome of 60 mm radius; the ball has a radius
//! of 1.5 mm:
//!
//! ```
//! use regrind_core::geometry::Point;
//! use regrind_core::registration::{RegistrationOptions, register};
//! use regrind_core::surface::{Nominal, PlaneProjection};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let (dome_mm, probe_mm) = (60.0_f64, 1.5);
//! let grid = |n: i32, step: f64| (0..n * n).map(move |k| (f64::from(k % n - n / 2) * step, f64::from(k / n - n / 2) * step));
//! let height = |r: f64, x: f64, y: f64| (r * r - x * x - y * y).sqrt();
//!
//! let nominal: Vec<Point> = grid(81, 0.5).map(|(x, y)| Point::new(x, y, height(dome_mm, x, y))).collect();
//! let nominal = Nominal::from_points(nominal, PlaneProjection::Auto)?;
//!
//! // The centres lie on a dome that is larger by the probe's radius; the part is shifted by 250 mm, and lower.
//! let centres: Vec<Point> =
//!     grid(20, 1.5).map(|(x, y)| Point::new(x + 250.0, y, height(dome_mm + probe_mm, x, y) - 40.0)).collect();
//!
//! let found = register(&nominal, &centres, &RegistrationOptions::new(probe_mm))?;
//! assert!((found.cmm_from_model.translation_mm.x - 250.0).abs() < 1e-3);
//! assert!(found.quality.rms_mm < 1e-5);
//! // No measurement can determine the rotation of a sphere, and the verdict says so.
//! assert!(!found.quality.weak_directions.is_empty());
//! # Ok(())
//! # }
//! ```

pub mod compensation;
pub mod form;
pub mod geometry;
pub mod measuring;
pub mod model;
pub mod registration;
mod sparse;
pub mod stitching;
pub mod surface;
