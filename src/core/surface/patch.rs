//! One patch of a nominal surface: points, unit normals, and the triangles between them.
//!
//! A grid computes its triangles from indices and has all its normals, each stored next to its point. A mesh stores its
//! triangles in flat arrays and fits a normal when it is first needed. So the work depends on the measured region and
//! not on the whole cloud.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use crate::geometry::{Point, Vector};

use super::facet::{Facets, Vertex};
use super::grid_topology::GridTopology;
use super::mesh_topology::MeshTopology;
use super::normals;
use super::simd::LANES;

/// Smooth piece of a surface, covered by the triangles of one grid or one mesh.
#[derive(Debug)]
pub(crate) struct Patch {
    pub(crate) topology: Topology,
    vertices: Vertices,
}

/// Triangles of a patch.
#[derive(Debug)]
pub(crate) enum Topology {
    /// Two triangles in each cell of a grid, computed from indices.
    Grid(GridTopology),
    /// Triangles and their neighbours in flat arrays.
    Mesh(MeshTopology),
}

#[derive(Debug)]
enum Vertices {
    Ready(Vec<Vertex>),
    Lazy(Vec<Point>, Vec<NormalCell>),
}

impl Patch {
    /// Creates a patch from a grid and its nodes. The normals of all nodes are known.
    pub(crate) fn grid(nodes: Vec<Vertex>, lattice: GridTopology) -> Self {
        Self { topology: Topology::Grid(lattice), vertices: Vertices::Ready(nodes) }
    }

    /// Returns the number of triangles if the patch is a mesh without border, which encloses a solid; otherwise `None`.
    pub(crate) fn closed_triangles(&self) -> Option<usize> {
        match &self.topology {
            Topology::Mesh(mesh) if mesh.is_closed() => Some(mesh.facet_count() as usize),
            _ => None,
        }
    }

    /// Creates a patch from a mesh. A normal is fitted when it is first needed.
    pub(crate) fn mesh(points: Vec<Point>, lattice: MeshTopology) -> Self {
        let cells = points.par_iter().map(|_| NormalCell::unknown()).collect();
        Self { topology: Topology::Mesh(lattice), vertices: Vertices::Lazy(points, cells) }
    }

    /// Returns the number of vertices, holes of a grid included.
    pub(crate) fn len(&self) -> usize {
        match &self.vertices {
            Vertices::Ready(nodes) => nodes.len(),
            Vertices::Lazy(points, _) => points.len(),
        }
    }

    /// Returns the point of a vertex; NaN at a hole of a grid.
    #[inline(always)]
    pub(crate) fn point(&self, vertex: u32) -> &Point {
        match &self.vertices {
            Vertices::Ready(nodes) => &nodes[vertex as usize].point,
            Vertices::Lazy(points, _) => &points[vertex as usize],
        }
    }

    /// Returns the unit normal at a vertex; NaN at a hole of a grid.
    #[inline(always)]
    pub(crate) fn normal(&self, vertex: u32) -> Vector {
        self.vertex(vertex).normal
    }

    /// Returns a vertex: its point and its unit normal.
    #[inline(always)]
    pub(crate) fn vertex(&self, vertex: u32) -> Vertex {
        match &self.vertices {
            Vertices::Ready(nodes) => nodes[vertex as usize],
            Vertices::Lazy(points, cells) => {
                let cell = &cells[vertex as usize];
                let normal = cell.get().unwrap_or_else(|| cell.set(self.fitted_normal(vertex)));
                Vertex { point: points[vertex as usize], normal }
            }
        }
    }

    /// Returns the indices of about `count` vertices, spread over the patch. Holes of a grid are omitted.
    pub(crate) fn sample(&self, count: usize) -> impl Iterator<Item = u32> {
        let n = self.len();
        let (columns, step_i, step_j) = match &self.topology {
            Topology::Grid(grid) => {
                let step = ((n as f64 / count as f64).sqrt() as usize).clamp(1, grid.columns().min(grid.rows()) / 3);
                (grid.columns(), step, step)
            }
            Topology::Mesh(_) => (n, n.div_ceil(count), 1),
        };
        (0..n / columns)
            .step_by(step_j)
            .flat_map(move |j| (0..columns).step_by(step_i).map(move |i| (j * columns + i) as u32))
            .filter(|&v| self.point(v).x.is_finite() && (self.has_scattered_normals() || self.normal(v).x.is_finite()))
    }

    /// Returns a facet at or near a vertex, from which a search can start.
    pub(crate) fn facet_at(&self, vertex: u32) -> u32 {
        match &self.topology {
            Topology::Grid(grid) => grid.facet_near(vertex),
            Topology::Mesh(mesh) => mesh.start(self.point(vertex)),
        }
    }

    /// Returns true if the patch is a mesh, whose normals are fitted to neighbouring points; false for a grid.
    pub(crate) fn has_scattered_normals(&self) -> bool {
        matches!(self.vertices, Vertices::Lazy(..))
    }

    /// Returns the nodes of a grid, whose normals are all known; returns an empty slice for a mesh.
    pub(crate) fn nodes(&self) -> &[Vertex] {
        match &self.vertices {
            Vertices::Ready(nodes) => nodes,
            Vertices::Lazy(..) => &[],
        }
    }

    /// Returns the points of a mesh; returns an empty slice for a grid, whose points are stored in its nodes.
    pub(crate) fn mesh_points(&self) -> &[Point] {
        match &self.vertices {
            Vertices::Ready(_) => &[],
            Vertices::Lazy(points, _) => points,
        }
    }

    /// Fits the normal at a vertex of a mesh. Panics for a grid, whose normals are all known.
    #[cold]
    fn fitted_normal(&self, vertex: u32) -> Vector {
        match &self.topology {
            Topology::Mesh(mesh) => {
                pulp::Arch::new().dispatch(NormalFitX4 { patch: self, mesh, vertices: [vertex; LANES] })[0]
            }
            Topology::Grid(_) => unreachable!("a grid has its normals ready"),
        }
    }

    /// Fits the missing normals of the vertices `vertices` of a mesh and stores them. Works on all cores, four vertices
    /// at a time. Does nothing for a grid, and for vertices whose normal is already fitted.
    ///
    /// This is several times faster than fitting each normal when it is first needed. The results are identical to the
    /// last bit.
    pub(crate) fn fit_normals(&self, vertices: &[u32]) {
        /// Number of vertices per task.
        const CHUNK: usize = 256;
        let (Vertices::Lazy(_, cells), Topology::Mesh(mesh)) = (&self.vertices, &self.topology) else { return };
        let arch = pulp::Arch::new();
        vertices.par_chunks(CHUNK).for_each(|chunk| {
            let unknown: Vec<u32> = chunk.iter().copied().filter(|&v| cells[v as usize].get().is_none()).collect();
            for few in unknown.chunks(LANES) {
                let vertices = std::array::from_fn(|l| few[l.min(few.len() - 1)]);
                let normals = arch.dispatch(NormalFitX4 { patch: self, mesh, vertices });
                for (&vertex, normal) in few.iter().zip(normals) {
                    cells[vertex as usize].set(normal);
                }
            }
        });
    }

    /// Returns the three corners of a facet, as indices of vertices. The facet must exist.
    pub(crate) fn corners(&self, facet: u32) -> [u32; 3] {
        match &self.topology {
            Topology::Grid(grid) => grid.corners(facet),
            Topology::Mesh(mesh) => mesh.corners(facet),
        }
    }
}

/// Fit of the normals of four vertices, in a form that is compiled once for each set of vector instructions.
struct NormalFitX4<'a> {
    patch: &'a Patch,
    mesh: &'a MeshTopology,
    vertices: [u32; LANES],
}

impl pulp::NullaryFnOnce for NormalFitX4<'_> {
    type Output = [Vector; LANES];

    // This must be inlined into the caller that has the instructions: a function that is called runs code without them.
    #[inline(always)]
    fn call(self) -> Self::Output {
        normals::fit_normals_x4(self.patch.mesh_points(), self.mesh, &self.vertices)
    }
}

/// Normal that is computed once, by the thread that first needs it.
///
/// Every thread that finds the normal unknown computes the same value, so that a race costs time but changes nothing.
/// NaN means unknown.
#[derive(Debug)]
struct NormalCell([AtomicU64; 3]);

impl NormalCell {
    /// Creates a cell whose normal is not yet computed.
    fn unknown() -> Self {
        Self(std::array::from_fn(|_| AtomicU64::new(f64::NAN.to_bits())))
    }

    /// Returns the normal; `None` if it is not yet computed.
    #[inline]
    fn get(&self) -> Option<Vector> {
        let [x, y, z] = [0, 1, 2].map(|k| f64::from_bits(self.0[k].load(Ordering::Relaxed)));
        (!(x + y + z).is_nan()).then(|| Vector::new(x, y, z))
    }

    /// Stores the normal and returns it.
    fn set(&self, normal: Vector) -> Vector {
        for (cell, c) in self.0.iter().zip(normal.iter()) {
            cell.store(c.to_bits(), Ordering::Relaxed);
        }
        normal
    }
}
