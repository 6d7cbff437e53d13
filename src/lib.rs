//! Regrind closes the loop of a precision grinding cell: a free-form part is ground, measured, registered to the offset of
//! its nominal surface, corrected and ground again until it is accepted.
//!
//! What stands today is the numerical heart: given measured probe centres and a nominal surface, [`registration::register`]
//! finds the pose, the deviation of every point and what to think of them.
//!
//! ```text
//!  cli ----> formats, report          files in and out, pictures
//!   |
//!   +------> registration -> surface -> geometry        pure: no file, no clock, no randomness, no logging
//! ```
//!
//! Conventions: millimetres, radians, seconds. Frames are the model's {M} and the CMM's {W}; a pose is named for what it does,
//! `cmm_from_model`. A deviation is positive where material stands proud, along the outward normal, the probe's side.

pub mod device;
pub mod formats;
pub mod geometry;
pub mod registration;
pub mod report;
pub mod surface;

/// The example of the README is run as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
