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
mod form;
mod nominal;
mod registration;

use pyo3::prelude::*;

/// Adds the classes, the functions and the exceptions to the module.
#[pymodule]
fn _regrind(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    errors::add_to(module)?;
    module.add_class::<nominal::PyNominal>()?;
    module.add_class::<registration::PyRegistration>()?;
    module.add_class::<form::PyForm>()?;
    module.add_class::<form::PyInterval>()?;
    module.add_class::<figures::PyErrorMap>()?;
    module.add_class::<figures::PyIso10110>()?;
    module.add_class::<figures::PyPolynomialFit>()?;
    module.add_function(wrap_pyfunction!(figures::error_map, module)?)?;
    module.add_function(wrap_pyfunction!(figures::gaussian, module)?)?;
    module.add_function(wrap_pyfunction!(figures::iso10110, module)?)?;
    module.add_function(wrap_pyfunction!(figures::zernike_fit, module)?)?;
    module.add_function(wrap_pyfunction!(registration::register, module)?)?;
    module.add_function(wrap_pyfunction!(form::model, module)?)?;
    module.add_function(wrap_pyfunction!(nominal::read_points, module)?)
}
