//! The Python package of Regrind: arrays in, arrays out.
//!
//! ```text
//!  numpy arrays -> arrays -> core (without the GIL) -> Registration, Form -> numpy arrays
//! ```
//!
//! Lengths are in millimetres and angles in radians. A refusal of the core is an exception with the words of the command
//! line.
#![cfg(feature = "module")]

mod arrays;
mod errors;
mod figures;
mod files;
mod form;
mod nominal;
mod path;
mod registration;

use pyo3::prelude::*;

/// Exact registration of measured probe centres to the offset of a nominal surface, with uncertainty.
#[pymodule]
mod _regrind {
    #[pymodule_export]
    use super::figures::{PyErrorMap, PyIso10110, PyPolynomialFit, error_map, gaussian, iso10110, zernike_fit};
    #[pymodule_export]
    use super::files::{read, write};
    #[pymodule_export]
    use super::form::{PyForm, PyInterval, model};
    #[pymodule_export]
    use super::nominal::PyNominal;
    #[pymodule_export]
    use super::path::{PyCorrection, PyToolPath, compensate, toolpath};
    #[pymodule_export]
    use super::registration::{PyRegistration, register};

    /// Version of the package.
    #[pymodule_export]
    #[expect(non_upper_case_globals, reason = "the name that Python packages use")]
    const __version__: &str = env!("CARGO_PKG_VERSION");
}
