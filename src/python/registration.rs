//! Registration of measured points.

use pyo3::prelude::*;
use regrind_core::geometry::Pose;
use regrind_core::registration::{
    Coordinate, Loss, Method, PointStatus, ProbeSide, Registration, RegistrationOptions, Start,
};
use regrind_core::surface::DistanceModel;

use super::arrays::{ArrayLike, Output1, Output2, output, points, rows, square, vectors};
use super::errors::{DataError, RegistrationError};
use super::nominal::PyNominal;

/// Result of a registration.
#[pyclass(name = "Registration", module = "regrind", frozen)]
pub(crate) struct PyRegistration {
    pub(crate) found: Registration,
}

/// Registers measured points to the offset of a nominal surface, without an initial guess.
///
/// Finds the pose g that minimises the sum of the squared distances of the measured points from the offset surface, as
/// eq. (7) of the method, exactly between the points of the nominal surface.
///
/// Shapes: `measured` is (N, 3), in mm, in the frame of the measuring machine, in any order. `probe_radius` is in mm; 0
/// means contact points. `side` is "auto", "above" or "below". `lock` names coordinates of the motion that stay 0, such as
/// "x,y,rz" or ["x", "y"]: shifts along and rotations about the axes of the model frame, from `initial`, or from the
/// identity if that is not given. `loss` is "none", "huber" or "tukey"; `initial` is a pose (4, 4) at which the search
/// starts; `method` is "offset", "contact" or "subtract-radius"; `distance` is "curved" or "triangle". Points beyond
/// `outlier_sigmas` robust standard deviations do not move the pose; `max_rms` in mm refuses a worse fit.
///
/// Raises DataError for arguments that cannot be used, and RegistrationError with the reason if the points cannot be
/// registered.
///
/// >>> x = np.linspace(-20, 20, 81)
/// >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
/// >>> nominal = regrind.Nominal.from_function(saddle, x, x)
/// >>> measured = nominal.offset(1.5)[::7] + [3, 2, 1]
/// >>> found = regrind.register(nominal, measured, probe_radius=1.5)
/// >>> found.pose[:3, 3].round(5)
/// array([3., 2., 1.])
#[pyfunction]
#[pyo3(signature = (nominal, measured, *, probe_radius, side: "Literal['auto', 'above', 'below']" = "auto", lock: "str | list[str] | None" = None,
    loss: "Literal['none', 'huber', 'tukey']" = "none", initial = None,
    method: "Literal['offset', 'contact', 'subtract-radius']" = "offset",
    distance: "Literal['curved', 'triangle']" = "curved", outlier_sigmas = 6.0, max_rms = None))]
#[expect(clippy::too_many_arguments, reason = "Python names each of them")]
pub(crate) fn register(
    py: Python,
    nominal: &PyNominal,
    measured: ArrayLike,
    probe_radius: f64,
    side: &str,
    lock: Option<Bound<PyAny>>,
    loss: &str,
    initial: Option<ArrayLike>,
    method: &str,
    distance: &str,
    outlier_sigmas: f64,
    max_rms: Option<f64>,
) -> PyResult<PyRegistration> {
    let measured = points(&measured.0, "measured")?;
    let method = choice("method", method, &METHODS)?;
    let locked = lock.map_or(Ok(Vec::new()), |names| locked(&names))?;
    let start = match initial {
        Some(rows) => Start::Pose(pose(&rows.0)?),
        None if locked.is_empty() => Start::Search,
        // A search would choose the locked coordinates at random.
        None => Start::Pose(Pose::identity()),
    };
    if !(probe_radius >= 0.0 && probe_radius.is_finite()) {
        return Err(DataError::new_err(format!(
            "probe_radius is {probe_radius}; it must be a finite number of mm, 0 or more"
        )));
    }
    let options = RegistrationOptions {
        method: if probe_radius == 0.0 { Method::Contact } else { method },
        distance_model: choice("distance", distance, &DISTANCES)?,
        loss: choice("loss", loss, &LOSSES)?,
        side: choice("side", side, &SIDES)?,
        locked: Coordinate::locked_flags(&locked),
        start,
        outlier_sigmas: above_zero("outlier_sigmas", outlier_sigmas)?,
        rms_limit_mm: max_rms.map(|mm| above_zero("max_rms", mm)).transpose()?,
        ..RegistrationOptions::new(probe_radius)
    };
    let found = py.detach(|| regrind_core::registration::register(&nominal.nominal, &measured, &options));
    found.map(|found| PyRegistration { found }).map_err(|error| RegistrationError::new_err(error.to_string()))
}

const METHODS: [(&str, Method); 3] =
    [("offset", Method::Offset), ("contact", Method::Contact), ("subtract-radius", Method::SubtractRadius)];
const DISTANCES: [(&str, DistanceModel); 2] =
    [("curved", DistanceModel::Curved), ("triangle", DistanceModel::Triangle)];
const LOSSES: [(&str, Loss); 3] = [("none", Loss::None), ("huber", Loss::Huber), ("tukey", Loss::Tukey)];
pub(crate) const SIDES: [(&str, ProbeSide); 3] =
    [("auto", ProbeSide::Auto), ("above", ProbeSide::Above), ("below", ProbeSide::Below)];
const COORDINATES: [(&str, Coordinate); 6] = [
    ("x", Coordinate::X),
    ("y", Coordinate::Y),
    ("z", Coordinate::Z),
    ("rx", Coordinate::Rx),
    ("ry", Coordinate::Ry),
    ("rz", Coordinate::Rz),
];

/// Returns a number that must be above 0; the text of a refusal names it by `name`.
pub(crate) fn above_zero(name: &str, value: f64) -> PyResult<f64> {
    match value > 0.0 {
        true => Ok(value),
        false => Err(DataError::new_err(format!("{name} is {value}; it must be above 0"))),
    }
}

/// Returns the value of one of the words of an argument; the text of a refusal names it by `name`.
pub(crate) fn choice<T: Copy>(name: &str, given: &str, of: &[(&str, T)]) -> PyResult<T> {
    of.iter().find(|(word, _)| *word == given).map(|(_, value)| *value).ok_or_else(|| {
        let words: Vec<String> = of.iter().map(|(word, _)| format!("{word:?}")).collect();
        DataError::new_err(format!("{name} is {given:?}; it must be one of {}", words.join(", ")))
    })
}

fn locked(names: &Bound<PyAny>) -> PyResult<Vec<Coordinate>> {
    let listed = match names.extract::<String>() {
        Ok(text) => text.split(',').map(|name| name.trim().to_owned()).filter(|name| !name.is_empty()).collect(),
        Err(_) => names.extract::<Vec<String>>().map_err(|_| {
            DataError::new_err(format!("lock is {names}; it must be names such as \"x,y\" or [\"x\", \"y\"]"))
        })?,
    };
    listed.iter().map(|name| choice("lock", name, &COORDINATES)).collect()
}

fn pose(given: &Bound<PyAny>) -> PyResult<Pose> {
    let rows = rows(given, "initial")?;
    let array = rows.as_array();
    if array.shape() != [4, 4] {
        let [rows, columns] = [array.nrows(), array.ncols()];
        return Err(DataError::new_err(format!("initial has the shape ({rows}, {columns}); a pose is (4, 4)")));
    }
    let rows: [[f64; 4]; 4] = std::array::from_fn(|row| std::array::from_fn(|column| array[(row, column)]));
    Pose::from_rows(rows).map_err(|error| DataError::new_err(format!("initial: {error}")))
}

#[pymethods]
impl PyRegistration {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// Pose that maps coordinates of the model to coordinates of the measuring machine, (4, 4), in mm: g of the method.
    #[getter]
    fn pose<'py>(&self, py: Python<'py>) -> Output2<'py> {
        square(py, self.found.cmm_from_model.to_rows())
    }

    /// Covariance of the pose, (6, 6): of the twist [translation; rotation] in the model frame, in mm and rad. Locked and
    /// undetermined directions have no variance.
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> Output2<'py> {
        let covariance = &self.found.quality.covariance;
        square::<6>(py, std::array::from_fn(|row| std::array::from_fn(|column| covariance[(row, column)])))
    }

    /// Directions in words that the surface determines badly or not at all.
    #[getter]
    fn weak_directions(&self) -> Vec<String> {
        self.found.quality.weak_directions.iter().map(|weak| weak.description.clone()).collect()
    }

    /// Signed deviation of each measured point from the nominal surface in mm, (N,), in the order given; positive where
    /// material stands proud.
    #[getter]
    fn deviations<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.found.deviations.iter().map(|of| of.deviation_mm).collect())
    }

    /// Standard uncertainty of each deviation in mm, (N,).
    #[getter]
    fn uncertainty<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.found.deviations.iter().map(|of| of.uncertainty_mm).collect())
    }

    /// Contact points in the model frame in mm, (N, 3).
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> Output2<'py> {
        vectors(py, self.found.deviations.iter().map(|of| of.point.coords))
    }

    /// Unit normals of the nominal surface at the contact points, (N, 3).
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> Output2<'py> {
        vectors(py, self.found.deviations.iter().map(|of| of.normal))
    }

    /// True for each point that counts in every figure, (N,).
    #[getter]
    fn used<'py>(&self, py: Python<'py>) -> Output1<'py, bool> {
        let used = self.found.deviations.iter().map(|of| of.status == PointStatus::Inlier);
        output(py, used.collect())
    }

    /// Indices of the points that were left out, with the reason: "outlier" or "off part".
    #[getter]
    fn left_out(&self) -> Vec<(usize, &'static str)> {
        let reason = |status: PointStatus| match status {
            PointStatus::Inlier => None,
            PointStatus::Outlier => Some("outlier"),
            _ => Some("off part"),
        };
        self.found.deviations.iter().enumerate().filter_map(|(k, of)| Some((k, reason(of.status)?))).collect()
    }

    /// Root mean square of the deviations of the used points, in mm.
    #[getter]
    fn rms(&self) -> f64 {
        self.found.quality.rms_mm
    }

    /// Largest minus smallest deviation of the used points, in mm.
    #[getter]
    fn pv(&self) -> f64 {
        self.found.quality.pv_mm
    }

    /// Share of the nominal surface that is covered by used points, from 0 to 1.
    #[getter]
    fn coverage(&self) -> f64 {
        self.found.quality.coverage
    }

    /// Number of steps of the iteration.
    #[getter]
    fn iterations(&self) -> usize {
        self.found.quality.iterations
    }

    /// Sum of the squared deviations after each step that was tried, in mm²; eq. (15).
    #[getter]
    fn objectives<'py>(&self, py: Python<'py>) -> Output1<'py> {
        output(py, self.found.trace.iter().map(|step| step.objective_mm2).collect())
    }

    /// Sum of the squared deviations of the used points, in mm²; eq. (7).
    #[getter]
    fn objective(&self) -> f64 {
        self.found.quality.objective_mm2
    }

    /// Warnings to read before the pose is trusted.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.found.quality.warnings.clone()
    }

    /// Other poses that fit about as well, each with its rms in mm for a sample of the points.
    #[getter]
    fn alternatives<'py>(&self, py: Python<'py>) -> Vec<(Output2<'py>, f64)> {
        self.found.quality.alternatives.iter().map(|(pose, rms)| (square(py, pose.to_rows()), *rms)).collect()
    }

    fn __len__(&self) -> usize {
        self.found.deviations.len()
    }

    fn __repr__(&self) -> String {
        let quality = &self.found.quality;
        format!(
            "Registration({} of {} points, RMS {:.3} um, PV {:.3} um)",
            quality.inliers,
            self.found.deviations.len(),
            1e3 * quality.rms_mm,
            1e3 * quality.pv_mm
        )
    }
}
