//! Nominal surfaces.

use std::path::PathBuf;

use numpy::PyArray2;
use pyo3::prelude::*;
use regrind_core::surface::{DefinedSurface, Nominal, NominalKind, PlaneProjection};
use regrind_formats::{NominalFile, Table, read_measured_with_notes, read_nominal_as};

use super::arrays::{points, rows, vectors};
use super::errors::{DataError, data};

/// Nominal surface: the ideal shape of a part.
#[pyclass(name = "Nominal", module = "regrind", frozen)]
pub(crate) struct PyNominal {
    pub(crate) nominal: Nominal,
}

#[pymethods]
impl PyNominal {
    /// Surface through points: a grid if the points form one, otherwise a triangulation.
    ///
    /// Shapes: `points` is (N, 3), in mm, in any order. `projection` selects the plane of the triangulation of scattered
    /// points: "auto", "xy", "best-fit" or "spherical".
    ///
    /// Raises DataError if no surface can be built from the points.
    #[staticmethod]
    #[pyo3(signature = (points, projection = "auto"))]
    fn from_points(py: Python, points: &Bound<PyAny>, projection: &str) -> PyResult<Self> {
        let points = self::points(points, "points")?;
        let projection = plane(projection)?;
        let nominal = py.detach(|| Nominal::from_points(points, projection)).map_err(data)?;
        Ok(Self { nominal })
    }

    /// Surface of a function z = function(x, y) on a grid.
    ///
    /// Shapes: `x` is (M,) and `y` is (N,), in mm. `function` gets two arrays (N, M) and returns the heights in mm in the
    /// same shape.
    ///
    /// Raises DataError if the heights have another shape, or if no surface can be built from them.
    #[staticmethod]
    fn from_function(
        py: Python,
        function: Bound<'_, PyAny>,
        x: Bound<'_, PyAny>,
        y: Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let numpy = py.import("numpy")?;
        let grid = numpy.call_method1("meshgrid", (x, y))?;
        let [x, y] = [grid.get_item(0)?, grid.get_item(1)?];
        let z = numpy.call_method1("asarray", (function.call1((&x, &y))?,))?;
        let [wanted, found] = [x.getattr("shape")?, z.getattr("shape")?];
        if !wanted.eq(&found)? {
            return Err(DataError::new_err(format!(
                "function returned the shape {found}; x and y have the shape {wanted}"
            )));
        }
        let columns = [x, y, z].map(|column| column.call_method0("ravel"));
        let [x, y, z] = columns;
        Self::from_points(py, &numpy.call_method1("column_stack", ((x?, y?, z?),))?, "xy")
    }

    /// Surface of a triangle mesh, oriented by its corners.
    ///
    /// Shapes: `points` is (N, 3), in mm; `triangles` is (M, 3), with indices of points.
    ///
    /// Raises DataError if the mesh is closed or has a mistake.
    #[staticmethod]
    fn from_mesh(py: Python, points: &Bound<PyAny>, triangles: &Bound<PyAny>) -> PyResult<Self> {
        let points = self::points(points, "points")?;
        let rows = rows(triangles, "triangles")?;
        let rows = rows.as_array();
        if rows.ncols() != 3 {
            return Err(DataError::new_err(format!("triangles has the shape {:?}; it must be (M, 3)", rows.shape())));
        }
        let corner = |index: f64| {
            let is_one = index >= 0.0 && index < points.len() as f64 && index.fract() == 0.0;
            is_one.then_some(index as u32).ok_or_else(|| {
                DataError::new_err(format!("triangles: there is no point {index}; there are {} points", points.len()))
            })
        };
        let triangles: Vec<[u32; 3]> = rows
            .outer_iter()
            .map(|row| Ok([corner(row[0])?, corner(row[1])?, corner(row[2])?]))
            .collect::<PyResult<_>>()?;
        let nominal = py
            .detach(|| {
                let nominal = Nominal::from_mesh(points, triangles)?;
                nominal.check_is_open()?;
                Ok(nominal)
            })
            .map_err(|error: regrind_core::surface::SurfaceError| data(error))?;
        Ok(Self { nominal })
    }

    /// Surface of the definition in a TOML text, such as an asphere or a free form with its aperture.
    ///
    /// Raises DataError with the place of every mistake.
    #[staticmethod]
    fn from_toml(py: Python, text: &str) -> PyResult<Self> {
        py.detach(|| defined(text)).map(|nominal| Self { nominal })
    }

    /// Surface in a file: points as text or PLY, a mesh as STL or PLY, or a TOML definition.
    ///
    /// Raises DataError with the path, the place and the reason.
    #[staticmethod]
    #[pyo3(signature = (path, projection = "auto"))]
    fn from_file(py: Python, path: PathBuf, projection: &str) -> PyResult<Self> {
        let projection = plane(projection)?;
        let nominal = py.detach(|| match read_nominal_as(&path, &Table::default()).map_err(data)? {
            NominalFile::Points(points) => Nominal::from_points(points, projection).map_err(data),
            NominalFile::Mesh { points, triangles } => {
                let nominal = Nominal::from_mesh(points, triangles).map_err(data)?;
                nominal.check_is_open().map_err(data)?;
                Ok(nominal)
            }
            NominalFile::Definition(text) => defined(&text),
        })?;
        Ok(Self { nominal })
    }

    /// Points of the surface, (N, 3), in mm.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let points: Vec<_> = self.nominal.points().map(|point| point.coords).collect();
        vectors(py, points.into_iter())
    }

    /// Points of the offset surface, (N, 3), in mm: the points moved along their normals by `distance` in mm; eq. (3).
    fn offset<'py>(&self, py: Python<'py>, distance: f64) -> PyResult<Bound<'py, PyArray2<f64>>> {
        if !distance.is_finite() {
            return Err(DataError::new_err(format!("distance is {distance}; it must be a finite number in mm")));
        }
        let points: Vec<_> = self.nominal.offset_points(distance).map(|point| point.coords).collect();
        Ok(vectors(py, points.into_iter()))
    }

    fn __len__(&self) -> usize {
        self.nominal.len()
    }

    fn __repr__(&self) -> String {
        let kind = match self.nominal.kind() {
            NominalKind::Grid { columns, rows } => format!("grid of {columns} x {rows}"),
            NominalKind::Scattered { .. } => "scattered".to_owned(),
            NominalKind::Mesh => "mesh".to_owned(),
            NominalKind::Patches { count } => format!("{count} patches"),
        };
        format!("Nominal({} points, {kind})", self.nominal.len())
    }
}

fn defined(text: &str) -> PyResult<Nominal> {
    let surface = DefinedSurface::from_toml(text).map_err(data)?;
    let grid = surface.spacing_mm().and_then(|spacing_mm| surface.sample(spacing_mm)).map_err(data)?;
    let nominal = Nominal::from_grid_with_normals(grid.columns, grid.rows, grid.points, grid.normals).map_err(data)?;
    Ok(nominal.with_outline(surface.aperture().clone()))
}

fn plane(name: &str) -> PyResult<PlaneProjection> {
    Ok(match name {
        "auto" => PlaneProjection::Auto,
        "xy" => PlaneProjection::Xy,
        "best-fit" => PlaneProjection::BestFit,
        "spherical" => PlaneProjection::Spherical,
        _ => {
            return Err(DataError::new_err(format!(
                "projection is {name:?}; it must be \"auto\", \"xy\", \"best-fit\" or \"spherical\""
            )));
        }
    })
}

/// Measured points of a file: text, PLY, or the map of an interferometer or a profilometer. The array is (N, 3), in mm.
///
/// Raises DataError with the path, the place and the reason.
#[pyfunction]
pub(crate) fn read_points(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyArray2<f64>>> {
    let read = py.detach(|| read_measured_with_notes(&path, &Table::default())).map_err(data)?;
    Ok(vectors(py, read.points.iter().map(|point| point.coords).collect::<Vec<_>>().into_iter()))
}
