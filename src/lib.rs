//! Regrind closes the loop of a precision grinding cell: a free-form part is ground, measured, registered to the offset of
//! its nominal surface, corrected and ground again until it is accepted.
//!
//! The numerical core is a library of its own: pure functions and plain data, no file, no clock, no logging.
//!
//! ```text
//!  registration -> surface -> geometry          formats, report: files and pictures
//!       ^                                           ^
//!       +----------------- cli ---------------------+
//! ```

pub mod formats;
pub mod geometry;
pub mod registration;
pub mod report;
pub mod surface;
