//! Figures of a part: what the numerical core estimates, the cell judges and the record keeps.
//!
//! The core and the cell do not know each other. Both use the types of this crate, so a figure has one definition from
//! its estimate to its record. Beneath the types are the normal distribution and a few statistics of lists of numbers.

mod forecast;
mod form_figures;
mod interval;
pub mod normal;
pub mod number;
mod part_response;
pub mod statistics;
mod student;

pub use forecast::Forecast;
pub use form_figures::FormFigures;
pub use interval::Interval;
pub use part_response::PartResponse;
pub use student::student_t_quantile;
