//! Exceptions of the package. They are defined in Python, `_errors.py`.

use pyo3::import_exception;
use pyo3::prelude::*;

import_exception!(regrind._errors, DataError);
import_exception!(regrind._errors, ModelError);
import_exception!(regrind._errors, RegistrationError);

/// Returns a [`DataError`] with the words of an error of the core.
pub(crate) fn data(error: impl std::fmt::Display) -> PyErr {
    DataError::new_err(error.to_string())
}
