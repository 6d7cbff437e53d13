//! Arrays of points between numpy and the core.

use std::convert::Infallible;

use numpy::ndarray::{Array1, Array2, Dimension, Ix1, Ix2};
use numpy::{AllowTypeChange, Element, IntoPyArray, PyArray, PyArrayLike2};
use pyo3::exceptions::PyOverflowError;
use pyo3::inspect::PyStaticExpr;
use pyo3::prelude::*;
use regrind_core::geometry::{Grid, Point, Vector};

use super::errors::DataError;

/// Argument of which numpy can make an array.
pub(crate) struct ArrayLike<'py>(pub(crate) Bound<'py, PyAny>);

impl<'py> FromPyObject<'_, 'py> for ArrayLike<'py> {
    type Error = Infallible;

    const INPUT_TYPE: PyStaticExpr = name(&NUMPY_TYPING, "ArrayLike");

    fn extract(given: Borrowed<'_, 'py, PyAny>) -> Result<Self, Infallible> {
        Ok(Self(given.to_owned()))
    }
}

/// Array for Python, with its type for the stubs.
pub(crate) struct Output<'py, T, D>(Bound<'py, PyArray<T, D>>);
pub(crate) type Output1<'py, T = f64> = Output<'py, T, Ix1>;
pub(crate) type Output2<'py, T = f64> = Output<'py, T, Ix2>;

/// Element of an array, with its name in numpy.
pub(crate) trait NamedElement: Element {
    const NAME: PyStaticExpr;
}

impl NamedElement for f64 {
    const NAME: PyStaticExpr = name(&NUMPY, "float64");
}

impl NamedElement for bool {
    const NAME: PyStaticExpr = name(&NUMPY, "bool_");
}

impl NamedElement for u32 {
    const NAME: PyStaticExpr = name(&NUMPY, "uint32");
}

impl<'py, T: NamedElement, D: Dimension> IntoPyObject<'py> for Output<'py, T, D> {
    type Target = PyArray<T, D>;
    type Output = Bound<'py, Self::Target>;
    type Error = Infallible;

    const OUTPUT_TYPE: PyStaticExpr =
        PyStaticExpr::Subscript { value: &name(&NUMPY_TYPING, "NDArray"), slice: &T::NAME };

    fn into_pyobject(self, _: Python<'py>) -> Result<Self::Output, Infallible> {
        Ok(self.0)
    }
}

const NUMPY: PyStaticExpr = PyStaticExpr::Name { id: "numpy" };
const NUMPY_TYPING: PyStaticExpr = PyStaticExpr::Name { id: "numpy.typing" };

const fn name(module: &'static PyStaticExpr, attr: &'static str) -> PyStaticExpr {
    PyStaticExpr::Attribute { value: module, attr }
}

/// Returns values as an array with one axis.
pub(crate) fn output<T: NamedElement>(py: Python<'_>, values: Vec<T>) -> Output1<'_, T> {
    Output(Array1::from_vec(values).into_pyarray(py))
}

/// Returns values, row after row, as an array with two axes. There are as many values as the array has.
pub(crate) fn output2<T: NamedElement>(py: Python<'_>, shape: (usize, usize), values: Vec<T>) -> Output2<'_, T> {
    // Another number of values would be a mistake of the caller.
    Output(Array2::from_shape_vec(shape, values).expect("as many values as nodes").into_pyarray(py))
}

/// Reads an argument as an array with two axes: any layout, and any type of real numbers.
///
/// # Errors
/// The argument is no array, has complex numbers, texts or objects, or another number of axes. The text names it by
/// `name`.
pub(crate) fn rows<'py>(given: &Bound<'py, PyAny>, name: &str) -> PyResult<PyArrayLike2<'py, f64, AllowTypeChange>> {
    let wrong =
        |what: String| DataError::new_err(format!("{name} {what}; it must be an array of real numbers with two axes"));
    let array = unmasked(given).map_err(|error| wrong(format!("is not an array ({error})")))?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    if !["f", "i", "u"].contains(&kind.as_str()) {
        return Err(wrong(format!("has the type {}", array.getattr("dtype")?)));
    }
    if array.getattr("ndim")?.extract::<usize>()? != 2 {
        return Err(wrong(format!("has the shape {}", array.getattr("shape")?)));
    }
    array.extract().map_err(|error: PyErr| wrong(format!("cannot be read ({error})")))
}

/// Returns an argument as an array; NaN stands for what is masked.
fn unmasked<'py>(given: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let py = given.py();
    let masked = py.import("numpy.ma")?;
    if !masked.call_method1("isMaskedArray", (given,))?.extract::<bool>()? {
        return py.import("numpy")?.call_method1("asarray", (given,));
    }
    given.call_method1("astype", ("float64",))?.call_method1("filled", (f64::NAN,))
}

/// Reads an argument as two finite numbers, such as a place; one number counts for both.
///
/// # Errors
/// The argument is neither. The text names it by `name`.
pub(crate) fn pair(given: &ArrayLike, name: &str) -> PyResult<[f64; 2]> {
    let wrong = || DataError::new_err(format!("{name} is {}; it must be two finite numbers (x, y) in mm", given.0));
    let flat = given.0.py().import("numpy")?.call_method1("ravel", (&given.0,)).map_err(|_| wrong())?;
    let numbers = flat.extract::<Vec<f64>>().map_err(|_| wrong())?;
    match numbers[..] {
        [one] if one.is_finite() => Ok([one, one]),
        [x, y] if x.is_finite() && y.is_finite() => Ok([x, y]),
        _ => Err(wrong()),
    }
}

/// Argument that is a whole number. One that no machine can hold is the nearest that it can.
pub(crate) struct Whole(pub(crate) i64);

impl<'py> FromPyObject<'_, 'py> for Whole {
    type Error = PyErr;

    const INPUT_TYPE: PyStaticExpr = name(&PyStaticExpr::Name { id: "typing" }, "SupportsIndex");

    fn extract(given: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        match given.extract::<i64>() {
            Err(error) if error.is_instance_of::<PyOverflowError>(given.py()) => {
                Ok(Self(if given.lt(0)? { i64::MIN } else { i64::MAX }))
            }
            read => read.map(Self),
        }
    }
}

impl Whole {
    /// Returns the number.
    ///
    /// # Errors
    /// It is below `least` or above `most`. The text names it by `name`.
    pub(crate) fn within(&self, name: &str, least: usize, most: usize) -> PyResult<usize> {
        let number = usize::try_from(self.0).ok().filter(|number| (least..=most).contains(number));
        number.ok_or_else(|| DataError::new_err(format!("{name} is {}; it must be {least} to {most}", self.0)))
    }
}

/// Reads an argument as an array with one axis, as [`rows`] reads one with two.
///
/// # Errors
/// As [`rows`].
pub(crate) fn column(given: &Bound<PyAny>, name: &str) -> PyResult<Vec<f64>> {
    let wrong = || DataError::new_err(format!("{name} must be an array of real numbers with one axis: (N,)"));
    let array = unmasked(given).map_err(|_| wrong())?;
    if array.getattr("ndim")?.extract::<usize>()? != 1 {
        return Err(wrong());
    }
    let column = array.call_method1("reshape", ((-1, 1),))?;
    Ok(rows(&column, name).map_err(|_| wrong())?.as_array().iter().copied().collect())
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
    let point = |[x, y, z]: [f64; 3]| Point::new(x, y, z);
    let points: Vec<Point> = match rows.as_slice() {
        Some(flat) => flat.as_chunks().0.iter().copied().map(point).collect(),
        None => rows.outer_iter().map(|row| point([row[0], row[1], row[2]])).collect(),
    };
    match points.iter().position(|point| !point.coords.iter().all(|c| c.is_finite())) {
        None => Ok(points),
        Some(k) => {
            let [x, y, z] = points[k].coords.into();
            Err(DataError::new_err(format!("{name}: row {k} is ({x}, {y}, {z}); remove rows that are not finite")))
        }
    }
}

/// Returns vectors as an array with one row for each.
pub(crate) fn vectors(py: Python<'_>, rows: impl ExactSizeIterator<Item = Vector>) -> Output2<'_> {
    let count = rows.len();
    output2(py, (count, 3), rows.flat_map(|row| [row.x, row.y, row.z]).collect())
}

/// Returns rows of a fixed length as an array.
pub(crate) fn square<const N: usize>(py: Python<'_>, rows: [[f64; N]; N]) -> Output2<'_> {
    output2(py, (N, N), rows.concat())
}

/// Returns the places of the nodes of a grid along x (0) or y (1), in mm.
pub(crate) fn axis_places_mm(grid: &Grid, axis: usize) -> Vec<f64> {
    let count = [grid.columns, grid.rows][axis];
    (0..count).map(|node| grid.first_mm[axis] + grid.spacing_mm[axis] * node as f64).collect()
}

/// Returns values at the nodes of a grid as an array with one row for each y.
pub(crate) fn on_grid<'py>(py: Python<'py>, grid: &Grid, values: Vec<f64>) -> Output2<'py> {
    output2(py, (grid.rows, grid.columns), values)
}
