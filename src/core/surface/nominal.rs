//! Nominal surface, created from points, a grid, a mesh or several patches, with its properties.

use std::fmt;
use std::sync::OnceLock;

use rayon::prelude::*;

use super::curvature_feature::{CurvatureFeature, fit_features};
use super::delaunay;
use super::error::SurfaceError;
use super::facet::FacetIndex;
use super::facet::Vertex;
use super::grid_topology::{GridTopology, fit_grid_nodes, reorder_to_grid};
use super::mesh_topology::MeshTopology;
use super::nominal_noise;
use super::normals;
use super::patch::{Patch, Topology};
use super::plane_projection::{PlaneProjection, is_line, principal_axes};
use crate::geometry::grid_recognition::recognise_ordered_grid;
use crate::geometry::{Aperture, Point, PointTree, Vector, recognise_grid};

/// Nominal surface: one or several patches of points with normals, to which distances can be computed.
#[derive(Debug)]
pub struct Nominal {
    patches: Vec<Patch>,
    kind: NominalKind,
    outline: Option<Aperture>,
    /// Curvature features of some places; computed when a pose is searched for the first time.
    features: OnceLock<Vec<CurvatureFeature>>,
    /// Rms distances of the points from their centroid and from their best-fit plane.
    extent_mm: OnceLock<[f64; 2]>,
    /// Sample of the points with a facet at each; computed when a projection without a start facet is searched for the
    /// first time.
    start_facets: OnceLock<(PointTree, Vec<FacetIndex>)>,
}

/// Source from which a nominal surface was created.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NominalKind {
    /// Points on a regular grid, or a grid of (u, v) parameters.
    Grid {
        /// Nodes along the first direction.
        columns: usize,
        /// Nodes along the second direction.
        rows: usize,
    },
    /// Scattered points, triangulated in a projection.
    Scattered {
        /// The projection, never `Auto`.
        projection: PlaneProjection,
    },
    /// A mesh that was given with its triangles.
    Mesh,
    /// Several patches.
    Patches {
        /// Number of patches.
        count: usize,
    },
}

impl fmt::Display for NominalKind {
    /// Writes the kind as `registration.json` has it. Replays compare this text with the recorded one.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Grid { columns, rows } => write!(f, "Grid {{ columns: {columns}, rows: {rows} }}"),
            Self::Scattered { projection } => {
                let projection = match projection {
                    PlaneProjection::Auto => "Auto",
                    PlaneProjection::Xy => "Xy",
                    PlaneProjection::BestFit => "BestFit",
                    PlaneProjection::Spherical => "Spherical",
                };
                write!(f, "Scattered {{ projection: {projection} }}")
            }
            Self::Mesh => f.write_str("Mesh"),
            Self::Patches { count } => write!(f, "Patches {{ count: {count} }}"),
        }
    }
}

impl Nominal {
    /// Creates a surface from points in any order. If `projection` is `Auto` or `Xy`, and the points form a regular
    /// grid in x and y, the grid is used directly. Otherwise the points are triangulated in the plane of `projection`.
    /// A projection is one-to-one if no two parts of the surface lie on the same place of the plane. `Auto` takes the
    /// first one-to-one projection of these: the xy plane, the best-fit plane, the sphere.
    ///
    /// Shapes: at least 9 points.
    ///
    /// # Errors
    /// Returns an error if there are fewer than 9 points, if a coordinate is not finite, if all points lie on one line,
    /// or if no allowed projection is one-to-one. Points that are triangulated also cause an error if two of them
    /// coincide or nearly coincide, or if one point is far from all other points.
    pub fn from_points(points: Vec<Point>, projection: PlaneProjection) -> Result<Self, SurfaceError> {
        const MIN_POINTS: usize = 9;
        if points.len() < MIN_POINTS {
            return Err(SurfaceError::TooFewPoints { points: points.len(), min_points: MIN_POINTS });
        }
        let may_be_grid = matches!(projection, PlaneProjection::Auto | PlaneProjection::Xy);
        if may_be_grid && let Some(found) = recognise_ordered_grid(&points) {
            return Ok(Self::from_grid_topology(GridTopology::from_ordered_grid(&found), &points));
        }
        if let Some(index) = points.iter().position(|p| !(p.x + p.y + p.z).is_finite()) {
            return Err(SurfaceError::NotFinite { index });
        }
        if may_be_grid && let Some(order) = recognise_grid(&points) {
            let points = reorder_to_grid(points, &order);
            return Ok(Self::from_grid_topology(GridTopology::new(order.columns, order.rows, &points, true), &points));
        }
        Self::from_triangulated_points(points, projection)
    }

    /// Creates a surface from scattered points by triangulation in the plane of `projection`, even if the points form a
    /// grid.
    ///
    /// # Errors
    /// Returns an error if a coordinate is not finite, if two points coincide or nearly coincide in the plane, if all
    /// points lie on one line, if one point is far from all other points, or if no allowed projection is one-to-one.
    pub fn from_triangulated_points(points: Vec<Point>, projection: PlaneProjection) -> Result<Self, SurfaceError> {
        if points.len() > 3 && is_line(&points) {
            return Err(SurfaceError::Collinear { points: points.len() });
        }
        let (projection, map) = projection.choose(&points)?;
        let (points, triangles) = delaunay::triangulate(&points, &map)?;
        let lattice = MeshTopology::from_parts(&points, triangles.corners, triangles.neighbours)?;
        Ok(Self::new(Patch::mesh(points, lattice), NominalKind::Scattered { projection }))
    }

    /// Creates a surface from a structured grid of points, one for each pair of parameters (u, v). Fits the normals.
    ///
    /// Shapes: `columns * rows` points, row by row with u fastest; a NaN point is a hole. The directions of u, v and
    /// the normal are right-handed.
    ///
    /// # Errors
    /// Returns an error if the number of points is not `columns * rows`, or if an axis has fewer than 3 nodes.
    pub fn from_parameter_grid(columns: usize, rows: usize, points: Vec<Point>) -> Result<Self, SurfaceError> {
        check_grid(columns, rows, points.len())?;
        Ok(Self::from_grid_topology(GridTopology::new(columns, rows, &points, false), &points))
    }

    /// Creates a surface from a grid of points that is regular in x and y, with known unit normals.
    ///
    /// Shapes: `columns * rows` points and normals, row by row with x fastest; a NaN point is a hole.
    ///
    /// # Errors
    /// Returns an error if the number of points or normals is not `columns * rows`, or if an axis has fewer than 3
    /// nodes.
    pub fn from_grid_with_normals(
        columns: usize,
        rows: usize,
        points: Vec<Point>,
        normals: Vec<Vector>,
    ) -> Result<Self, SurfaceError> {
        check_grid(columns, rows, points.len().min(normals.len()))?;
        let lattice = GridTopology::new(columns, rows, &points, true);
        let nodes = points.into_par_iter().zip(normals).map(|(point, normal)| Vertex { point, normal }).collect();
        Ok(Self::new(Patch::grid(nodes, lattice), NominalKind::Grid { columns, rows }))
    }

    /// Creates a surface from a mesh. Each triangle is given by the indices of its corners in `points`. The normals are
    /// on the side from which the triangles are counter-clockwise.
    ///
    /// # Errors
    /// Returns an error if a coordinate is not finite, there is no triangle, an index is out of range, more than two
    /// triangles share an edge, a triangle is given twice, or neighbours have opposite orientation.
    pub fn from_mesh(points: Vec<Point>, triangles: Vec<[u32; 3]>) -> Result<Self, SurfaceError> {
        if let Some(index) = points.iter().position(|p| !(p.x + p.y + p.z).is_finite()) {
            return Err(SurfaceError::NotFinite { index });
        }
        let lattice = MeshTopology::new(&points, triangles)?;
        Ok(Self::new(Patch::mesh(points, lattice), NominalKind::Mesh))
    }

    /// Joins several surfaces into one surface of several patches. A measured point belongs to the patch that contains
    /// its projection. The outlines of the surfaces are dropped.
    ///
    /// # Errors
    /// Returns an error if the list is empty.
    pub fn from_patches(surfaces: Vec<Nominal>) -> Result<Self, SurfaceError> {
        let patches: Vec<Patch> = surfaces.into_iter().flat_map(|s| s.patches).collect();
        if patches.is_empty() {
            return Err(SurfaceError::NoPatches);
        }
        let kind = NominalKind::Patches { count: patches.len() };
        Ok(Self {
            patches,
            kind,
            outline: None,
            features: OnceLock::new(),
            extent_mm: OnceLock::new(),
            start_facets: OnceLock::new(),
        })
    }

    /// Sets the outline of the part in x and y: a point whose projection lies outside it is off the part.
    pub fn with_outline(self, outline: Aperture) -> Self {
        Self { outline: Some(outline), ..self }
    }

    /// Creates a surface from the points of a grid, in the order of its nodes. Fits the normals.
    fn from_grid_topology(lattice: GridTopology, points: &[Point]) -> Self {
        let kind = NominalKind::Grid { columns: lattice.columns(), rows: lattice.rows() };
        Self::new(Patch::grid(fit_grid_nodes(points, &lattice), lattice), kind)
    }

    /// Creates a surface of one patch without an outline.
    fn new(patch: Patch, kind: NominalKind) -> Self {
        Self {
            patches: vec![patch],
            kind,
            outline: None,
            features: OnceLock::new(),
            extent_mm: OnceLock::new(),
            start_facets: OnceLock::new(),
        }
    }

    /// Checks that the surface does not enclose a solid. A closed surface does not show which side of the part is
    /// ground.
    ///
    /// # Errors
    /// Returns [`SurfaceError::ClosedSolid`] if a mesh patch has no border.
    pub fn check_is_open(&self) -> Result<(), SurfaceError> {
        match self.patches.iter().find_map(Patch::closed_triangles) {
            Some(triangles) => Err(SurfaceError::ClosedSolid { triangles }),
            None => Ok(()),
        }
    }

    /// Returns the source of the surface: a grid, scattered points, a mesh or several patches.
    pub fn kind(&self) -> NominalKind {
        self.kind
    }

    /// Returns the outline of the part; `None` if none was set.
    pub fn outline(&self) -> Option<&Aperture> {
        self.outline.as_ref()
    }

    pub(crate) fn patches(&self) -> &[Patch] {
        &self.patches
    }

    /// Returns every point of the surface; holes are skipped.
    pub fn points(&self) -> impl Iterator<Item = &Point> {
        self.patches
            .iter()
            .flat_map(|patch| (0..patch.len()).map(move |v| patch.point(v as u32)))
            .filter(|p| p.x.is_finite())
    }

    /// Returns every point shifted along its normal by `by_mm`, eq. (3) of the paper; a negative length shifts against
    /// the normal. Holes are skipped.
    pub fn offset_points(&self, by_mm: f64) -> impl Iterator<Item = Point> {
        let moved = move |vertex: Vertex| vertex.point + vertex.normal * by_mm;
        self.patches
            .iter()
            .flat_map(move |patch| (0..patch.len()).map(move |v| moved(patch.vertex(v as u32))))
            .filter(|p| p.x.is_finite())
    }

    /// Returns the number of points of all patches; holes do not count.
    pub fn len(&self) -> usize {
        self.points().count()
    }

    /// Returns true if there is no point; the constructors never return such a surface.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns about `count` vertices with their normals, spread over the surface.
    fn sampled_vertices(&self, count: usize) -> Vec<(Point, Vector)> {
        let share = count / self.patches.len();
        self.patches
            .iter()
            .flat_map(|patch| patch.sample(share.max(1)).map(|v| patch.vertex(v)))
            .map(|vertex| (vertex.point, vertex.normal))
            .collect()
    }

    /// Returns the largest angle between the unit normal and +z, in radians from 0 to π: the maximum slope against the
    /// xy plane. The maximum is taken over a sample of about 4096 vertices spread over the surface.
    pub fn max_slope_rad(&self) -> f64 {
        let normals = self.sampled_vertices(SAMPLE).into_iter().map(|(_, n)| n.z.clamp(-1.0, 1.0).acos());
        normals.fold(0.0, f64::max)
    }

    /// Returns about `count` points, spread over the surface.
    pub(crate) fn sample(&self, count: usize) -> Vec<Point> {
        let share = (count / self.patches.len()).max(1);
        self.patches.iter().flat_map(|patch| patch.sample(share).map(|v| *patch.point(v))).collect()
    }

    /// Returns the rms distance of the points from their centroid, in millimetres.
    pub fn size_mm(&self) -> f64 {
        self.extent_mm()[0]
    }

    /// Returns the rms distance of the points from their best-fit plane, in millimetres. Near 0 the surface is flat,
    /// and a registration cannot determine every direction of the pose. It is computed from a sample of about 4096
    /// points.
    pub(crate) fn relief_mm(&self) -> f64 {
        self.extent_mm()[1]
    }

    /// Returns the rms distances of the points from their centroid and from their best-fit plane, in mm. Computes them
    /// from a sample at the first call.
    fn extent_mm(&self) -> [f64; 2] {
        *self.extent_mm.get_or_init(|| {
            let sample = self.sample(SAMPLE);
            let (middle, eigen) = principal_axes(&sample);
            let squares = sample.iter().map(|p| (p - middle).norm_squared()).sum::<f64>();
            [squares, eigen.eigenvalues.min().max(0.0)].map(|sum| (sum / sample.len() as f64).sqrt())
        })
    }

    /// Returns the normalised mean of the normals; z if their sum is nearly zero, as for a closed surface.
    pub(crate) fn mean_normal(&self) -> Vector {
        let sum: Vector = self.sampled_vertices(512).iter().map(|(_, n)| n).sum();
        if sum.norm() > 1e-6 { sum.normalize() } else { Vector::z() }
    }

    /// Returns the estimated rms error of the normals that are fitted to scattered points, in radians. Returns 0 if all
    /// patches are grids.
    ///
    /// Fits the normal at about 256 vertices of each mesh patch again, with twice as many neighbours. The estimate is
    /// the rms change of these normals.
    pub(crate) fn normal_error_rad(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        for patch in self.patches.iter().filter(|p| p.has_scattered_normals()) {
            let Topology::Mesh(mesh) = &patch.topology else { continue };
            for vertex in patch.sample(256) {
                let wider = normals::fit_to_ring(patch.mesh_points(), mesh, vertex, 2 * normals::NEIGHBOURS);
                sum += (wider.normal - patch.normal(vertex)).norm_squared();
                count += 1;
            }
        }
        if count == 0 { 0.0 } else { (sum / f64::from(count)).sqrt() }
    }

    /// Returns the standard deviation in millimetres of the noise of the nominal points, along the normal of a smooth
    /// surface fitted locally. Returns 0 if the residuals show the form of the surface and not noise, or if no local
    /// fit is possible.
    pub(crate) fn noise_sigma_mm(&self) -> f64 {
        nominal_noise::noise_sigma_mm(&self.patches)
    }

    /// Returns one facet at each of the three sample points nearest to `p`, the nearest first; fewer facets if the
    /// sample is smaller. The sample has about 20,000 points of the nominal surface and is drawn at the first call.
    pub(crate) fn facets_near(&self, p: &Point) -> impl Iterator<Item = FacetIndex> {
        /// Number of points in the search tree, and number of facets returned.
        const TREE_POINTS: usize = 20_000;
        const RETURNED: u32 = 3;
        let (nearest, places) = self.start_facets.get_or_init(|| {
            let share = (TREE_POINTS / self.patches.len()).max(1);
            let of_patch = |(number, patch): (usize, &Patch)| {
                let place =
                    move |vertex| (*patch.point(vertex), FacetIndex::new(number as u32, patch.facet_at(vertex)));
                patch.sample(share).map(place).collect::<Vec<_>>()
            };
            let (points, places): (Vec<Point>, Vec<FacetIndex>) =
                self.patches.iter().enumerate().flat_map(of_patch).unzip();
            (PointTree::new(points.into_iter()), places)
        });
        nearest.nearest(p, RETURNED).map(|(k, _)| places[k])
    }

    /// Returns the surface made of every second node of its grid, with normals fitted anew. Returns `None` if the
    /// surface is not a single grid, or if fewer than 3 nodes would remain along an axis.
    pub(crate) fn coarsened(&self) -> Option<Self> {
        let [patch] = &self.patches[..] else { return None };
        let Topology::Grid(grid) = &patch.topology else { return None };
        let [columns, rows] = [grid.columns(), grid.rows()].map(|nodes| nodes.div_ceil(2));
        let node = |k: usize| *patch.point((2 * (k / columns) * grid.columns() + 2 * (k % columns)) as u32);
        let points: Vec<Point> = (0..columns * rows).map(node).collect();
        check_grid(columns, rows, points.len()).ok()?;
        Some(Self::from_grid_topology(GridTopology::new(columns, rows, &points, grid.is_regular()), &points))
    }

    /// Returns the curvature features (principal curvatures with their directions) at about 3000 places spread over the
    /// surface. Computes them at the first call.
    pub(crate) fn features(&self) -> &[CurvatureFeature] {
        self.features.get_or_init(|| {
            let (points, normals): (Vec<_>, Vec<_>) = self.sampled_vertices(FEATURES).into_iter().unzip();
            fit_features(&points, Some(&normals))
        })
    }
}

/// Number of points for the size of the surface, and number of places for the search of a pose.
const SAMPLE: usize = 4096;
const FEATURES: usize = 3000;

/// Checks the size of a grid.
///
/// # Errors
/// Returns [`SurfaceError::GridSize`] if an axis has fewer than 3 nodes, or if `points` is not `columns * rows`.
pub(super) fn check_grid(columns: usize, rows: usize, points: usize) -> Result<(), SurfaceError> {
    if columns < 3 || rows < 3 || columns.checked_mul(rows) != Some(points) {
        return Err(SurfaceError::GridSize { columns, rows, points });
    }
    Ok(())
}
