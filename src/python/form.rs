//! Model of the form: the error of the part without the noise of the probe.

use numpy::{PyArray1, PyArray2, ToPyArray};
use pyo3::prelude::*;
use regrind_core::model::{Form, ModelInputs};
use regrind_figures::Interval;

use super::arrays::square;
use super::errors::ModelError;
use super::registration::PyRegistration;

/// Median and 95 % interval of a figure, in mm.
#[pyclass(name = "Interval", module = "regrind", frozen, get_all)]
#[derive(Clone)]
pub(crate) struct PyInterval {
    /// Median, in mm.
    median: f64,
    /// Quantile at 2.5 %, in mm; 0 if only an upper bound is known.
    low: f64,
    /// Quantile at 97.5 %, in mm.
    high: f64,
}

#[pymethods]
impl PyInterval {
    fn __repr__(&self) -> String {
        let [median, low, high] = [self.median, self.low, self.high].map(|mm| 1e3 * mm);
        format!("Interval({median:.3} um, {low:.3} to {high:.3})")
    }
}

impl From<&Interval> for PyInterval {
    fn from(of: &Interval) -> Self {
        Self { median: of.median_mm, low: of.low_mm, high: of.high_mm }
    }
}

/// Form of a part with its figures and their uncertainty.
#[pyclass(name = "Form", module = "regrind", frozen)]
pub(crate) struct PyForm {
    form: Form,
}

/// Separates the form from the noise of the probe by a Gaussian process, and states PV and RMS with 95 % intervals.
///
/// Raises ModelError with the reason if the deviations give no model.
#[pyfunction]
pub(crate) fn model(py: Python, registration: &PyRegistration) -> PyResult<PyForm> {
    let form = py.detach(|| Form::estimate(&registration.found, &ModelInputs::default()));
    form.map(|form| PyForm { form }).map_err(|error| ModelError::new_err(error.to_string()))
}

#[pymethods]
impl PyForm {
    /// Peak to valley at the used points.
    #[getter]
    fn pv(&self) -> PyInterval {
        (&self.form.figures.pv).into()
    }

    /// Peak to valley over the aperture, without the outermost 0.1 % at each end.
    #[getter]
    fn pv_998(&self) -> PyInterval {
        (&self.form.figures.pv_998).into()
    }

    /// Root mean square.
    #[getter]
    fn rms(&self) -> PyInterval {
        (&self.form.figures.rms).into()
    }

    /// Standard deviation of the noise of a single point, in mm.
    #[getter]
    fn noise_sigma(&self) -> f64 {
        self.form.figures.noise_sigma_mm
    }

    /// True if the points show a form. If false, the intervals are upper bounds.
    #[getter]
    fn is_detected(&self) -> bool {
        self.form.is_detected
    }

    /// Form at each used point in mm, (M,). A scan of more than 6,000 points is reduced to 6,000.
    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.form.points.iter().map(|of| of.form.mean_mm).collect::<Vec<_>>().to_pyarray(py)
    }

    /// Standard uncertainty of the form at each of these points in mm, (M,).
    #[getter]
    fn uncertainty<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        self.form.points.iter().map(|of| of.form.sigma_mm).collect::<Vec<_>>().to_pyarray(py)
    }

    /// Covariance of the pose of the nominal frame including the uncertainty of the form, (6, 6), in mm and rad.
    #[getter]
    fn frame_covariance<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let covariance = &self.form.frame_covariance;
        square::<6>(py, std::array::from_fn(|row| std::array::from_fn(|column| covariance[(row, column)])))
    }

    fn __repr__(&self) -> String {
        format!("Form(PV {}, RMS {})", self.pv().__repr__(), self.rms().__repr__())
    }
}
