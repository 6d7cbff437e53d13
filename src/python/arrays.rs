//! Arrays of points between numpy and the core.

use numpy::ndarray::{Array2, ArrayView1};
use numpy::{AllowTypeChange, PyArray2, PyArrayLike2, ToPyArray};
use pyo3::prelude::*;
use regrind_core::geometry::{Point, Vector};

use super::errors::DataError;

/// Reads an argument as an array with two axes: any layout, and any type of real numbers.
///
/// # Errors
/// The argument is no array, has complex numbers, texts or objects, or another number of axes. The text names it by
/// `name`.
pub(crate) fn rows<'py>(given: &Bound<'py, PyAny>, name: &str) -> PyResult<PyArrayLike2<'py, f64, AllowTypeChange>> {
    let wrong =
        |what: String| DataError::new_err(format!("{name} {what}; it must be an array of real numbers with two axes"));
    let array = given
        .py()
        .import("numpy")?
        .call_method1("asarray", (given,))
        .map_err(|error| wrong(format!("is not an array ({error})")))?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    if !["f", "i", "u"].contains(&kind.as_str()) {
        return Err(wrong(format!("has the type {}", array.getattr("dtype")?)));
    }
    if array.getattr("ndim")?.extract::<usize>()? != 2 {
        return Err(wrong(format!("has the shape {}", array.getattr("shape")?)));
    }
    array.extract().map_err(|error: PyErr| wrong(format!("cannot be read ({error})")))
}

/// Reads an argument as an array with one axis, as [`rows`] reads one with two.
///
/// # Errors
/// As [`rows`].
pub(crate) fn column(given: &Bound<PyAny>, name: &str) -> PyResult<Vec<f64>> {
    let numpy = given.py().import("numpy")?;
    let column = numpy.call_method1("asarray", (given,)).and_then(|array| array.call_method1("reshape", ((-1, 1),)));
    let is_flat = numpy.call_method1("ndim", (given,)).and_then(|axes| axes.extract::<usize>());
    match (column, is_flat) {
        (Ok(column), Ok(1)) => Ok(rows(&column, name)?.as_array().iter().copied().collect()),
        _ => Err(DataError::new_err(format!("{name} must be an array of real numbers with one axis: (N,)"))),
    }
}

/// Reads an argument as points: an array with one row of x, y, z for each, in mm.
///
/// # Errors
/// Those of [`rows`]; another number of columns, or a number that is not finite. The text names the row.
pub(crate) fn points(given: &Bound<PyAny>, name: &str) -> PyResult<Vec<Point>> {
    let rows = rows(given, name)?;
    let rows = rows.as_array();
    if rows.ncols() != 3 {
        return Err(DataError::new_err(format!(
            "{name} has the shape ({}, {}); it must have one row of x, y, z for each point: (N, 3)",
            rows.nrows(),
            rows.ncols()
        )));
    }
    let point = |(k, row): (usize, ArrayView1<f64>)| {
        let [x, y, z] = [row[0], row[1], row[2]];
        if [x, y, z].iter().all(|c| c.is_finite()) {
            Ok(Point::new(x, y, z))
        } else {
            Err(DataError::new_err(format!("{name}: row {k} is ({x}, {y}, {z}); remove rows that are not finite")))
        }
    };
    rows.outer_iter().enumerate().map(point).collect()
}

/// Returns vectors as an array with one row for each.
pub(crate) fn vectors<'py>(py: Python<'py>, rows: impl ExactSizeIterator<Item = Vector>) -> Bound<'py, PyArray2<f64>> {
    let count = rows.len();
    let flat: Vec<f64> = rows.flat_map(|row| [row.x, row.y, row.z]).collect();
    let array = Array2::from_shape_vec((count, 3), flat).unwrap_or_default();
    array.to_pyarray(py)
}

/// Returns rows of a fixed length as an array.
pub(crate) fn square<'py, const N: usize>(py: Python<'py>, rows: [[f64; N]; N]) -> Bound<'py, PyArray2<f64>> {
    let array = Array2::from_shape_fn((N, N), |(row, column)| rows[row][column]);
    array.to_pyarray(py)
}
