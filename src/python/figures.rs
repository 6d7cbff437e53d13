//! Figures and maps of deviations: ISO 10110-5, Zernike polynomials, the filtered map.

use pyo3::prelude::*;
use regrind_core::compensation::{ErrorMap, FilterOrder, MapOptions, Smoothing, filter_grid};
use regrind_core::form::{FormOptions, Iso10110, PolynomialBasis, PolynomialFit, compute_figures, fit_polynomials};
use regrind_core::geometry::{Aperture, DeviationSample, Grid, GridMap};

use super::arrays::{ArrayLike, Output1, Output2, Whole, axis_places_mm, column, on_grid, output, pair, rows};
use super::errors::{DataError, data};

/// Power, irregularity and symmetric part by ISO 10110-5, in nanometres.
#[pyclass(name = "Iso10110", module = "regrind", frozen)]
pub(crate) struct PyIso10110 {
    iso: Iso10110,
}

#[pymethods]
impl PyIso10110 {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// A: peak to valley of the power, in nm.
    #[getter]
    fn power_nm(&self) -> f64 {
        self.iso.power_nm
    }

    /// B: peak to valley of the irregularity, in nm.
    #[getter]
    fn irregularity_nm(&self) -> f64 {
        self.iso.irregularity_nm
    }

    /// C: peak to valley of the part of the irregularity that is symmetric about the centre, in nm.
    #[getter]
    fn symmetric_nm(&self) -> f64 {
        self.iso.symmetric_nm
    }

    /// RMSt, RMSi and RMSa, in nm.
    #[getter]
    fn rms_nm(&self) -> (f64, f64, f64) {
        (self.iso.rms_total_nm, self.iso.rms_irregularity_nm, self.iso.rms_varying_nm)
    }

    /// Tightest indication of a drawing that the surface meets.
    #[getter]
    fn notation(&self) -> &str {
        &self.iso.notation
    }

    fn __repr__(&self) -> String {
        format!("Iso10110({})", self.iso.notation)
    }
}

/// Fit of polynomials to deviations.
#[pyclass(name = "PolynomialFit", module = "regrind", frozen)]
pub(crate) struct PyPolynomialFit {
    fit: PolynomialFit,
}

#[pymethods]
impl PyPolynomialFit {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// Coefficients in mm, (K,); each polynomial has the mean square 1 over the full disc.
    #[getter]
    fn coefficients<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.fit.coefficients_mm.clone())
    }

    /// Contribution of each polynomial to the root mean square in mm, (K,), after it was made orthogonal at the points.
    #[getter]
    fn orthogonal<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.fit.orthogonal_mm.clone())
    }

    /// Name of each polynomial, such as "Z5 (2, 2)".
    #[getter]
    fn terms(&self) -> Vec<String> {
        (0..self.fit.coefficients_mm.len()).map(|k| self.fit.basis.term_name(k)).collect()
    }

    /// Root mean square of the residuals, in mm.
    #[getter]
    fn residual_rms(&self) -> f64 {
        self.fit.residual_rms_mm
    }

    fn __repr__(&self) -> String {
        let um = 1e3 * self.fit.residual_rms_mm;
        format!("PolynomialFit({} terms, residual RMS {um:.3} um)", self.fit.coefficients_mm.len())
    }
}

/// Map of the error on a grid, filtered by a Gaussian filter of ISO 16610-61.
#[pyclass(name = "ErrorMap", module = "regrind", frozen)]
pub(crate) struct PyErrorMap {
    pub(crate) map: ErrorMap,
    /// Options of the map.
    pub(crate) options: MapOptions,
}

#[pymethods]
impl PyErrorMap {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// Places of the columns along x in mm, (M,).
    #[getter]
    fn x<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.axis(0))
    }

    /// Places of the rows along y in mm, (N,).
    #[getter]
    fn y<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.axis(1))
    }

    /// Error at each node in mm, (N, M); NaN where too few points are near.
    #[getter]
    fn values<'py>(&self, py: Python<'py>) -> Output2<'py> {
        let nodes = &self.map.nodes;
        let known =
            nodes.values_mm.iter().zip(&nodes.valid).map(|(value, valid)| if *valid { *value } else { f64::NAN });
        self.array(py, known.collect())
    }

    /// Standard uncertainty of the error at each node from the noise of the points in mm, (N, M); NaN where the error is.
    #[getter]
    fn uncertainty<'py>(&self, py: Python<'py>) -> Output2<'py> {
        let nodes = &self.map.nodes;
        let known =
            self.map.sigma_mm.iter().zip(&nodes.valid).map(|(sigma, valid)| if *valid { *sigma } else { f64::NAN });
        self.array(py, known.collect())
    }

    /// Standard deviation of the deviations from the map in mm: the part that the filter removed.
    #[getter]
    fn residual_sigma(&self) -> f64 {
        self.map.residual_sigma_mm
    }

    /// Indices of the points that were left out as outliers.
    #[getter]
    fn outliers(&self) -> Vec<usize> {
        self.map.outliers.clone()
    }

    /// Advice on the measurement and the cut-off.
    #[getter]
    fn advice(&self) -> Vec<String> {
        self.map.advice.clone()
    }

    fn __repr__(&self) -> String {
        let grid = self.map.nodes.grid;
        format!("ErrorMap({} x {} nodes)", grid.columns, grid.rows)
    }
}

impl PyErrorMap {
    fn axis(&self, k: usize) -> Vec<f64> {
        axis_places_mm(&self.map.nodes.grid, k)
    }

    fn array<'py>(&self, py: Python<'py>, values: Vec<f64>) -> Output2<'py> {
        on_grid(py, &self.map.nodes.grid, values)
    }
}

/// Figures of ISO 10110-5 of deviations, without piston and tilt.
///
/// Shapes: `places` is (N, 2) or (N, 3), of which x and y are used, in mm; `deviations` is (N,), in mm. `radius` is that of
/// a round part about `centre`, by default the origin, in mm; without it, the centre is that of the bounds of the points.
/// `wavelength` is in mm and only appears in the notation.
///
/// Raises DataError if the points do not determine the figures.
///
/// >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
/// >>> places = np.column_stack([x.ravel(), y.ravel()])
/// >>> round(regrind.iso10110(places, 1e-5 * (x**2 + y**2).ravel()).power_nm)
/// 2000
#[pyfunction]
#[pyo3(signature = (places, deviations, *, radius = None, centre = None, wavelength = 632.8e-6))]
pub(crate) fn iso10110(
    py: Python,
    places: ArrayLike,
    deviations: ArrayLike,
    radius: Option<f64>,
    centre: Option<ArrayLike>,
    wavelength: f64,
) -> PyResult<PyIso10110> {
    let samples = samples(&places.0, &deviations.0)?;
    let aperture = match radius {
        Some(radius_mm) => Some(disc(radius_mm, centre)?),
        None if centre.is_some() => {
            return Err(DataError::new_err("centre is given without radius; give both or none"));
        }
        None => None,
    };
    if !(1e-5..=0.1).contains(&wavelength) {
        return Err(DataError::new_err(format!("wavelength is {wavelength}; it must be 1e-5 to 0.1 mm")));
    }
    // In picometres it is a whole number, as drawings state it.
    let wavelength_nm = (1e9 * wavelength).round() / 1e3;
    let options = FormOptions { aperture, wavelength_nm, ..FormOptions::default() };
    let figures = py.detach(|| compute_figures(&samples, &options)).map_err(data)?;
    Ok(PyIso10110 { iso: figures.iso_10110 })
}

/// Fits Fringe Zernike polynomials to deviations by least squares at the places of the points.
///
/// Shapes: `places` is (N, 2) or (N, 3), in mm; `deviations` is (N,), in mm. `radius` and `centre` are those of the disc, by default about the origin, in
/// mm. `terms` is the number of polynomials, 1 to 37.
///
/// Raises DataError if the points do not determine the polynomials.
///
/// >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
/// >>> places = np.column_stack([x.ravel(), y.ravel()])
/// >>> fit = regrind.zernike_fit(places, 1e-5 * x.ravel(), radius=10, terms=4)
/// >>> fit.terms[1], (1e6 * fit.coefficients[1]).round(3).item()
/// ('Z2 (1, 1)', 50.0)
#[pyfunction]
#[pyo3(signature = (places, deviations, *, radius, centre = None, terms = 36))]
pub(crate) fn zernike_fit(
    py: Python,
    places: ArrayLike,
    deviations: ArrayLike,
    radius: f64,
    centre: Option<ArrayLike>,
    terms: i64,
) -> PyResult<PyPolynomialFit> {
    let terms = Whole(terms).within("terms", 1, 37)?;
    let samples = samples(&places.0, &deviations.0)?;
    let basis = PolynomialBasis::zernike(&disc(radius, centre)?);
    let fit = py.detach(|| fit_polynomials(&basis, terms, &samples)).map_err(data)?;
    Ok(PyPolynomialFit { fit })
}

/// Map of the error on a grid, by a Gaussian regression filter of ISO 16610-61 at scattered points.
///
/// Shapes: `places` is (N, 2) or (N, 3), in mm; `deviations` is (N,), in mm. `cutoff` is the wavelength in mm at which half
/// of the amplitude passes, `spacing` the distance of the nodes in mm; without it, it is a fifth of the cut-off. `robust`
/// selects the robust filter of ISO 16610-71.
///
/// Raises DataError if the points are too few or too far apart for the cut-off.
///
/// >>> x, y = np.meshgrid(np.linspace(-10, 10, 41), np.linspace(-10, 10, 41))
/// >>> places = np.column_stack([x.ravel(), y.ravel()])
/// >>> map = regrind.error_map(places, 1e-4 * x.ravel(), cutoff=4, spacing=2)
/// >>> (1e3 * map.values[5]).round(3).tolist()
/// [-1.0, -0.8, -0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
#[pyfunction]
#[pyo3(signature = (places, deviations, *, cutoff, spacing = None, robust = false))]
pub(crate) fn error_map(
    py: Python,
    places: ArrayLike,
    deviations: ArrayLike,
    cutoff: f64,
    spacing: Option<f64>,
    robust: bool,
) -> PyResult<PyErrorMap> {
    let samples = samples(&places.0, &deviations.0)?;
    let cutoff = cutoff_within(cutoff)?;
    let smoothing = if robust { Smoothing::RobustGaussian } else { Smoothing::Gaussian };
    let options = MapOptions { smoothing, ..MapOptions::new(cutoff, spacing.unwrap_or(0.2 * cutoff)) };
    let map = py.detach(|| regrind_core::compensation::error_map(&samples, &options)).map_err(data)?;
    Ok(PyErrorMap { map, options })
}

/// Filters a map of heights by the areal Gaussian filter of ISO 16610-61.
///
/// Shapes: `values` is (N, M); NaN marks nodes without a value. `spacing` is the distance of the nodes along x and y, or one number for both, and
/// `cutoff` the wavelength at which half of the amplitude passes, in mm. `order` is that of the polynomial that passes
/// unchanged: 0, 1 or 2. `robust` selects the robust filter of ISO 16610-71. The result is (N, M); nodes with too few
/// values around them are NaN. A node without a value gets that of the filter if enough nodes around it have one.
///
/// Raises DataError for arguments that cannot be used.
///
/// >>> heights = np.tile([1.0, -1.0], (20, 10))
/// >>> round(abs(regrind.gaussian(heights, spacing=(1, 1), cutoff=8)[:, 6:14]).max().item(), 2)
/// 0.0
#[pyfunction]
#[pyo3(signature = (values, *, spacing, cutoff, order: "Literal[0, 1, 2]" = 1, robust = false))]
pub(crate) fn gaussian<'py>(
    py: Python<'py>,
    values: ArrayLike<'py>,
    spacing: ArrayLike,
    cutoff: f64,
    order: i64,
    robust: bool,
) -> PyResult<Output2<'py>> {
    let spacing = pair(&spacing, "spacing")?;
    let cutoff = cutoff_within(cutoff)?;
    let heights = rows(&values.0, "values")?;
    let heights = heights.as_array();
    let order = match Whole(order).within("order", 0, 2)? {
        0 => FilterOrder::Constant,
        1 => FilterOrder::Plane,
        _ => FilterOrder::Quadric,
    };
    if spacing.iter().any(|mm| *mm <= 0.0) {
        return Err(DataError::new_err(format!("spacing is {spacing:?}; both must be above 0, in mm")));
    }
    let grid = Grid { columns: heights.ncols(), rows: heights.nrows(), first_mm: [0.0, 0.0], spacing_mm: spacing };
    let values_mm: Vec<f64> = heights.iter().copied().collect();
    let valid = values_mm.iter().map(|value| !value.is_nan()).collect();
    let map = GridMap { grid, values_mm, valid };
    let filtered = py.detach(|| filter_grid(&map, cutoff, order, robust)).map_err(data)?.nodes;
    let known =
        filtered.values_mm.iter().zip(&filtered.valid).map(|(value, valid)| if *valid { *value } else { f64::NAN });
    Ok(on_grid(py, &grid, known.collect()))
}

fn cutoff_within(cutoff: f64) -> PyResult<f64> {
    match cutoff > 0.0 && cutoff <= 1e6 {
        true => Ok(cutoff),
        false => Err(DataError::new_err(format!("cutoff is {cutoff}; it must be above 0, and 1e6 mm at most"))),
    }
}

fn disc(radius_mm: f64, centre: Option<ArrayLike>) -> PyResult<Aperture> {
    let centre_mm = centre.map_or(Ok([0.0, 0.0]), |centre| pair(&centre, "centre"))?;
    if radius_mm > 0.0 && radius_mm.is_finite() && centre_mm.iter().all(|c| c.is_finite()) {
        Ok(Aperture::Circle { centre_mm, radius_mm })
    } else {
        let [x, y] = centre_mm;
        Err(DataError::new_err(format!(
            "radius is {radius_mm} mm about ({x}, {y}); it must be a finite number above 0 about a finite place"
        )))
    }
}

fn samples(places: &Bound<PyAny>, deviations: &Bound<PyAny>) -> PyResult<Vec<DeviationSample>> {
    let places = rows(places, "places")?;
    let places = places.as_array();
    if !(2..=3).contains(&places.ncols()) {
        return Err(DataError::new_err(format!(
            "places has the shape ({}, {}); it must be (N, 2) or (N, 3)",
            places.nrows(),
            places.ncols()
        )));
    }
    let deviations = column(deviations, "deviations")?;
    if deviations.len() != places.nrows() {
        return Err(DataError::new_err(format!(
            "there are {} places and {} deviations; each place has one",
            places.nrows(),
            deviations.len()
        )));
    }
    let sample = |(k, (row, deviation_mm)): (usize, (numpy::ndarray::ArrayView1<f64>, f64))| {
        let sample = DeviationSample { place_mm: [row[0], row[1]], deviation_mm };
        if sample.is_finite() {
            Ok(sample)
        } else {
            Err(DataError::new_err(format!("row {k} has a number that is not finite; remove such rows")))
        }
    };
    places.outer_iter().zip(deviations).enumerate().map(sample).collect()
}
