//! Model of the form: the error of the part without the noise of the probe.

use pyo3::prelude::*;
use regrind_core::model::{Form, ModelInputs};
use regrind_figures::Interval;

use super::arrays::{Output1, Output2, Whole, output, output2, square};
use super::errors::{DataError, ModelError};
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
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

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

/// Form of a part after its own best fit, with its figures and their uncertainty.
#[pyclass(name = "Form", module = "regrind", frozen)]
pub(crate) struct PyForm {
    form: Form,
    /// Registration and inputs from which samples are drawn.
    registration: Py<PyRegistration>,
    inputs: ModelInputs,
}

/// Maximum number of values of all samples of one call: 160 MB. Twelve times as much is needed meanwhile.
const MAX_SAMPLED_VALUES: usize = 20_000_000;

/// Separates the form from the noise of the probe by a Gaussian process, and states PV and RMS with 95 % intervals.
///
/// `radius_uncertainty` is the standard uncertainty of the radius of the probe in mm, and `length_uncertainty` the
/// relative standard uncertainty of all lengths. No point can show them, so both are 0 unless they are stated.
///
/// The form is that after its best fit: the motion of the part that is closest to it does not count.
///
/// Raises DataError for an uncertainty beyond its limit, and ModelError with the reason if the deviations give no model.
///
/// >>> x = np.linspace(-20, 20, 81)
/// >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
/// >>> nominal = regrind.Nominal.from_function(saddle, x, x)
/// >>> noise = np.random.default_rng(1).normal(0, 2e-4, nominal.points[::7].shape)
/// >>> found = regrind.register(nominal, nominal.offset(1.5)[::7] + noise, probe_radius=1.5)
/// >>> form = regrind.model(found)
/// >>> print(f"noise of the probe: {1e3 * form.noise_sigma:.1f} um")
/// noise of the probe: 0.2 um
#[pyfunction]
#[pyo3(signature = (registration, *, radius_uncertainty = 0.0, length_uncertainty = 0.0))]
pub(crate) fn model(
    py: Python,
    registration: Py<PyRegistration>,
    radius_uncertainty: f64,
    length_uncertainty: f64,
) -> PyResult<PyForm> {
    let within = |name: &str, value: f64, most: f64, unit: &str| match (0.0..=most).contains(&value) {
        true => Ok(value),
        false => Err(DataError::new_err(format!("{name} is {value}; it must be 0 to {most}{unit}"))),
    };
    let radius_uncertainty = within("radius_uncertainty", radius_uncertainty, 1.0, " mm")?;
    let length_uncertainty = within("length_uncertainty", length_uncertainty, 0.1, ", a share of each length")?;
    let inputs =
        ModelInputs { radius_sigma_mm: radius_uncertainty, scale_sigma: length_uncertainty, ..ModelInputs::default() };
    let found = &registration.get().found;
    let form = py.detach(|| Form::estimate(found, &inputs)).map_err(refused)?;
    Ok(PyForm { form, registration, inputs })
}

fn refused(error: regrind_core::model::ModelError) -> PyErr {
    ModelError::new_err(error.to_string())
}

#[pymethods]
impl PyForm {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

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

    /// Places of these points over x and y of the model frame in mm, (M, 2).
    #[getter]
    fn places<'py>(&self, py: Python<'py>) -> Output2<'py> {
        let flat: Vec<f64> = self.form.points.iter().flat_map(|of| of.place_mm).collect();
        output2(py, (self.form.points.len(), 2), flat)
    }

    /// Form at each used point in mm, (M,). A scan of more than 6,000 points is reduced to 6,000.
    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.form.points.iter().map(|of| of.form.mean_mm).collect())
    }

    /// Standard uncertainty of the form at each of these points in mm, (M,).
    #[getter]
    fn uncertainty<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.form.points.iter().map(|of| of.form.sigma_mm).collect())
    }

    /// Covariance of the pose of the nominal frame including the uncertainty of the form, (6, 6), in mm and rad.
    #[getter]
    fn frame_covariance<'py>(&self, py: Python<'py>) -> Output2<'py> {
        let covariance = &self.form.frame_covariance;
        square::<6>(py, std::array::from_fn(|row| std::array::from_fn(|column| covariance[(row, column)])))
    }

    /// Samples of the form from its posterior at the same points in mm, (`count`, M). Each row is a form that the
    /// points allow. The same `count` gives the same samples; 1000 are those from which the figures come.
    ///
    /// Raises DataError for 0 samples, and for more than 2e7 values.
    fn sample<'py>(&self, py: Python<'py>, count: Whole) -> PyResult<Output2<'py>> {
        let count = count.within("count", 1, MAX_SAMPLED_VALUES / self.form.points.len().max(1))?;
        let found = &self.registration.get().found;
        let samples = py.detach(|| Form::sample(found, &self.inputs, count)).map_err(refused)?;
        // Samples are columns, one after the other: the rows of the array.
        Ok(output2(py, (samples.ncols(), samples.nrows()), samples.as_slice().to_vec()))
    }

    fn __repr__(&self) -> String {
        format!("Form(PV {}, RMS {})", self.pv().__repr__(), self.rms().__repr__())
    }
}
