//! The numerical core of Regrind: where is the part, and what is to be ground away next?
//!
//! ```text
//!  nominal ---> surface ----+
//!                           +--> registration --> compensation --> error map, correction, path of the wheel
//!  probe's centres ---------+          |
//!  (measuring: where to touch)         +--> form: what is left on the part
//! ```
//!
//! Pure: no file, no clock, no randomness, no machine, no logging; the same input gives the same bits on any number of threads.
//!
//! Conventions: millimetres and radians. Frames are the model's {M} and the CMM's {W}; a pose is named for what it does,
//! `cmm_from_model`. A deviation is positive where material stands proud, along the outward normal, the probe's side.
//!
//! Where is a part whose probe centres were measured? Here a dome of 60 mm radius, touched by a ball of 1.5 mm:
//!
//! ```
//! use regrind_core::geometry::Point;
//! use regrind_core::registration::{Options, register};
//! use regrind_core::surface::{Nominal, Projection};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let (dome_mm, probe_mm) = (60.0_f64, 1.5);
//! let grid = |n: i32, step: f64| (0..n * n).map(move |k| (f64::from(k % n - n / 2) * step, f64::from(k / n - n / 2) * step));
//! let height = |r: f64, x: f64, y: f64| (r * r - x * x - y * y).sqrt();
//!
//! let nominal: Vec<Point> = grid(81, 0.5).map(|(x, y)| Point::new(x, y, height(dome_mm, x, y))).collect();
//! let nominal = Nominal::from_points(nominal, Projection::Auto)?;
//!
//! // The centres lie on a dome that is larger by the probe's radius; the part stands 250 mm off, and lower.
//! let centres: Vec<Point> =
//!     grid(20, 1.5).map(|(x, y)| Point::new(x + 250.0, y, height(dome_mm + probe_mm, x, y) - 40.0)).collect();
//!
//! let found = register(&nominal, &centres, &Options::new(probe_mm))?;
//! assert!((found.cmm_from_model.translation_mm.x - 250.0).abs() < 1e-3);
//! assert!(found.verdict.rms_mm < 1e-5);
//! // No measurement tells how a sphere is turned, and that is said.
//! assert!(!found.verdict.weak_directions.is_empty());
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
pub mod surface;
