//! Nominal surfaces.

use std::path::PathBuf;
use std::sync::OnceLock;

use pyo3::prelude::*;
use regrind_core::geometry::Point;
use regrind_core::surface::parametric::FaceFrame;
use regrind_core::surface::{DefinedSurface, Nominal, NominalKind, PlaneProjection, SurfaceChoice, SurfaceSelection};
use regrind_formats::{NominalFile, Table, read_nominal_with_identity};
use sha2::{Digest, Sha256};

use super::arrays::{ArrayLike, Output2, points, rows, vectors};
use super::errors::{DataError, data};

/// Number or name of a face.
#[derive(FromPyObject)]
enum FaceKey {
    Number(usize),
    Name(String),
}

/// Nominal surface: the ideal shape of a part.
#[pyclass(name = "Nominal", module = "regrind", frozen)]
pub(crate) struct PyNominal {
    pub(crate) nominal: Nominal,
    /// SHA-256 of the file or of the text; empty for points until it is asked for.
    identity: OnceLock<[u8; 32]>,
}

impl PyNominal {
    fn new(nominal: Nominal, identity: Option<[u8; 32]>) -> Self {
        Self { nominal, identity: identity.map_or_else(OnceLock::new, OnceLock::from) }
    }

    /// Returns the SHA-256 of the file, of the text or of the points: maps and programs name the part by it.
    pub(crate) fn identity(&self) -> [u8; 32] {
        *self.identity.get_or_init(|| {
            let mut hash = Sha256::new();
            for point in self.nominal.points() {
                point.coords.iter().for_each(|c| hash.update(c.to_le_bytes()));
            }
            hash.finalize().into()
        })
    }
}

#[pymethods]
impl PyNominal {
    /// Returns the same object: it never changes.
    fn __copy__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    /// Returns the same object: it never changes.
    fn __deepcopy__(slf: Py<Self>, _memo: &Bound<PyAny>) -> Py<Self> {
        slf
    }

    /// Surface through points: a grid if the points form one, otherwise a triangulation.
    ///
    /// Shapes: `points` is (N, 3), in mm, in any order. `projection` selects the plane of the triangulation of scattered
    /// points: "auto", "xy", "best-fit" or "spherical".
    ///
    /// Raises DataError if no surface can be built from the points.
    ///
    /// >>> x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    /// >>> regrind.Nominal.from_points(np.column_stack([x.ravel(), y.ravel(), 0.01 * x.ravel() ** 2]))
    /// Nominal(20 points, grid of 5 x 4)
    #[staticmethod]
    #[pyo3(signature = (points, projection: "Literal['auto', 'xy', 'best-fit', 'spherical']" = "auto"))]
    fn from_points(py: Python, points: ArrayLike, projection: &str) -> PyResult<Self> {
        let points = self::points(&points.0, "points")?;
        check_size(&points)?;
        let projection = plane(projection)?;
        let nominal = py.detach(|| Nominal::from_points(points, projection)).map_err(data)?;
        Ok(Self::new(nominal, None))
    }

    /// Surface of a function z = function(x, y) on a grid.
    ///
    /// Shapes: `x` is (M,) and `y` is (N,), in mm. `function` gets two arrays (N, M) and returns the heights in mm in the
    /// same shape.
    ///
    /// Raises DataError if the heights have another shape, or if no surface can be built from them.
    ///
    /// >>> x = np.linspace(-20, 20, 81)
    /// >>> saddle = lambda x, y: 4e-3 * x**2 - 3e-3 * y**2 + 1e-4 * x**3 + 8e-5 * x * y**2
    /// >>> nominal = regrind.Nominal.from_function(saddle, x, x)
    /// >>> nominal
    /// Nominal(6561 points, grid of 81 x 81)
    #[staticmethod]
    #[pyo3(signature = (function: "Callable[[NDArray[float64], NDArray[float64]], ArrayLike]", x, y))]
    fn from_function(py: Python, function: Bound<'_, PyAny>, x: ArrayLike, y: ArrayLike) -> PyResult<Self> {
        let numpy = py.import("numpy")?;
        let grid = numpy.call_method1("meshgrid", (x.0, y.0))?;
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
        Self::from_points(py, ArrayLike(numpy.call_method1("column_stack", ((x?, y?, z?),))?), "xy")
    }

    /// Surface of a triangle mesh, oriented by its corners.
    ///
    /// Shapes: `points` is (N, 3), in mm; `triangles` is (M, 3), with indices of points.
    ///
    /// Raises DataError if the mesh is closed or has a mistake.
    ///
    /// >>> corners = [[0, 0, 0], [10, 0, 0], [10, 10, 1], [0, 10, 1]]
    /// >>> regrind.Nominal.from_mesh(corners, [[0, 1, 2], [0, 2, 3]])
    /// Nominal(4 points, mesh)
    #[staticmethod]
    fn from_mesh(py: Python, points: ArrayLike, triangles: ArrayLike) -> PyResult<Self> {
        let points = self::points(&points.0, "points")?;
        let rows = rows(&triangles.0, "triangles")?;
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
        check_corners(&points, &triangles)?;
        let nominal = py
            .detach(|| {
                let nominal = Nominal::from_mesh(points, triangles)?;
                nominal.check_is_open()?;
                Ok(nominal)
            })
            .map_err(|error: regrind_core::surface::SurfaceError| data(error))?;
        Ok(Self::new(nominal, None))
    }

    /// Surface of the definition in a TOML text, such as an asphere or a free form with its aperture.
    ///
    /// Raises DataError with the place of every mistake.
    ///
    /// >>> regrind.Nominal.from_toml("""
    /// ... [surface]
    /// ... kind = "asphere"
    /// ... radius_mm = 180.0
    /// ... conic = -1.2
    /// ... coefficients = { A4 = 2.0e-8 }
    /// ... [aperture]
    /// ... kind = "circle"
    /// ... radius_mm = 10.0
    /// ... [sampling]
    /// ... spacing_mm = 0.5
    /// ... """)
    /// Nominal(1457 points, grid of 43 x 43)
    #[staticmethod]
    fn from_toml(py: Python, text: &str) -> PyResult<Self> {
        let identity = Sha256::digest(text).into();
        py.detach(|| defined(text)).map(|nominal| Self::new(nominal, Some(identity)))
    }

    /// Surface in a file: points as text or PLY, a mesh as STL or PLY, a CAD model as STEP or IGES, or a TOML definition.
    ///
    /// `face` chooses a face of a CAD model by its number from 1 or by its name; without it, it is the largest.
    /// `face_frame` is "file", or "face" for a frame in the middle of the face with z along its outward normal.
    ///
    /// Raises DataError with the path, the place and the reason.
    #[staticmethod]
    #[pyo3(signature = (
        path,
        projection: "Literal['auto', 'xy', 'best-fit', 'spherical']" = "auto",
        *,
        face: "int | str | None" = None,
        face_frame: "Literal['file', 'face']" = "file",
    ))]
    fn from_file(
        py: Python,
        path: PathBuf,
        projection: &str,
        face: Option<FaceKey>,
        face_frame: &str,
    ) -> PyResult<Self> {
        let projection = plane(projection)?;
        let frame = match face_frame {
            "file" => FaceFrame::File,
            "face" => FaceFrame::Face,
            other => {
                return Err(DataError::new_err(format!("face_frame is {other:?}; it must be \"file\" or \"face\"")));
            }
        };
        let choice = face.map(|face| match face {
            FaceKey::Number(number) => SurfaceChoice::Number(number),
            FaceKey::Name(name) => SurfaceChoice::Name(name),
        });
        let selection = SurfaceSelection { choice, frame, ..SurfaceSelection::default() };
        py.detach(|| {
            let (read, identity) = read_nominal_with_identity(&path, &Table::default(), &selection).map_err(data)?;
            if let Some(surface) = read.defined_surface(&selection).map_err(data)? {
                return sampled(&surface).map(|nominal| Self::new(nominal, Some(identity)));
            }
            let nominal = match read {
                NominalFile::Points(points) => Nominal::from_points(points, projection).map_err(data)?,
                NominalFile::Mesh { points, triangles } => {
                    let nominal = Nominal::from_mesh(points, triangles).map_err(data)?;
                    nominal.check_is_open().map_err(data)?;
                    nominal
                }
                NominalFile::Definition(_) | NominalFile::Faces(_) | NominalFile::Lens(_) => {
                    unreachable!("they define a surface")
                }
            };
            Ok(Self::new(nominal, Some(identity)))
        })
    }

    /// Points of the surface, (N, 3), in mm.
    #[getter]
    fn points<'py>(&self, py: Python<'py>) -> Output2<'py> {
        let points: Vec<_> = self.nominal.points().map(|point| point.coords).collect();
        vectors(py, points.into_iter())
    }

    /// Points of the offset surface, (N, 3), in mm: the points moved along their normals by `distance` in mm; eq. (3).
    fn offset<'py>(&self, py: Python<'py>, distance: f64) -> PyResult<Output2<'py>> {
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

/// Refuses points that are so close together that no surface of a part is meant.
fn check_size(points: &[Point]) -> PyResult<()> {
    const MIN_SIZE_MM: f64 = 1e-6;
    let extent = |axis: usize| {
        let (low, high) = points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), point| {
            (low.min(point[axis]), high.max(point[axis]))
        });
        high - low
    };
    let size_mm = (0..3).map(extent).fold(0.0, f64::max);
    match points.is_empty() || size_mm >= MIN_SIZE_MM {
        true => Ok(()),
        false => {
            Err(DataError::new_err(format!("points are within {size_mm:e} mm; a part has {MIN_SIZE_MM:e} mm at least")))
        }
    }
}

/// Refuses triangles without an area, and points that belong to no triangle.
fn check_corners(points: &[Point], triangles: &[[u32; 3]]) -> PyResult<()> {
    let mut is_corner = vec![false; points.len()];
    for (k, corners) in triangles.iter().enumerate() {
        let [a, b, c] = corners.map(|corner| points[corner as usize]);
        if (b - a).cross(&(c - a)).norm() == 0.0 {
            return Err(DataError::new_err(format!("triangles: row {k}, {corners:?}, has no area; remove it")));
        }
        corners.iter().for_each(|corner| is_corner[*corner as usize] = true);
    }
    match is_corner.iter().position(|is_corner| !is_corner) {
        Some(k) if !triangles.is_empty() => {
            Err(DataError::new_err(format!("points: row {k} belongs to no triangle; remove it")))
        }
        _ => Ok(()),
    }
}

fn defined(text: &str) -> PyResult<Nominal> {
    sampled(&DefinedSurface::from_toml(text).map_err(data)?)
}

fn sampled(surface: &DefinedSurface) -> PyResult<Nominal> {
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
