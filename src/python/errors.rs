//! Exceptions of the package.

use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(regrind, RegrindError, PyException, "Any refusal by Regrind.");
create_exception!(
    regrind,
    DataError,
    RegrindError,
    "Data or arguments that cannot be used: the text says where and why."
);
create_exception!(regrind, RegistrationError, RegrindError, "Measured points that could not be registered.");
create_exception!(regrind, ModelError, RegrindError, "Deviations of which no model of the form could be made.");

/// Adds the exceptions to the module.
pub(crate) fn add_to(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("RegrindError", py.get_type::<RegrindError>())?;
    module.add("DataError", py.get_type::<DataError>())?;
    module.add("RegistrationError", py.get_type::<RegistrationError>())?;
    module.add("ModelError", py.get_type::<ModelError>())
}

/// Returns a [`DataError`] with the words of an error of the core.
pub(crate) fn data(error: impl std::fmt::Display) -> PyErr {
    DataError::new_err(error.to_string())
}
