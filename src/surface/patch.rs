//! One patch of a nominal surface: points, unit normals, and the triangles between them.
//!
//! A grid has its triangles by arithmetic and its normals ready; a mesh keeps its triangles in flat arrays and fits a normal
//! when a triangle is first touched, so that the work done is that of the measured region, not of the whole cloud.

use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use crate::geometry::{Point, Vector};

use super::grid::GridLattice;
use super::lanes::LANES;
use super::mesh::MeshLattice;
use super::normals;

/// A smooth piece of surface that one lattice of triangles covers.
#[derive(Debug)]
pub(crate) struct Patch {
    pub(crate) points: Vec<Point>,
    pub(crate) lattice: Lattice,
    normals: Normals,
}

/// How the triangles of a patch are known.
#[derive(Debug)]
pub(crate) enum Lattice {
    /// Two triangles a cell, by arithmetic.
    Grid(GridLattice),
    /// Triangles and their neighbours in flat arrays.
    Mesh(MeshLattice),
}

/// What a point location needs of the triangles; counter-clockwise seen from the side of the normals.
pub(crate) trait Facets: Sync {
    /// Returns the three corners of a facet.
    fn corners(&self, facet: u32) -> [u32; 3];

    /// Returns the facet to look at next for a point with these barycentric weights; `None` where the surface ends.
    fn advance(&self, facet: u32, weights: &[f64; 3]) -> Option<u32>;

    /// Returns a facet to start from.
    fn start(&self, p: &Point) -> u32;
}

#[derive(Debug)]
enum Normals {
    Ready(Vec<Vector>),
    WhenTouched(Vec<NormalCell>),
}

impl Patch {
    /// Joins a grid with normals that are known at every node.
    pub(crate) fn grid(points: Vec<Point>, normals: Vec<Vector>, lattice: GridLattice) -> Self {
        Self { points, lattice: Lattice::Grid(lattice), normals: Normals::Ready(normals) }
    }

    /// Joins a mesh with normals that are fitted when a triangle is first touched.
    pub(crate) fn mesh(points: Vec<Point>, lattice: MeshLattice) -> Self {
        let cells = points.par_iter().map(|_| NormalCell::unknown()).collect();
        Self { points, lattice: Lattice::Mesh(lattice), normals: Normals::WhenTouched(cells) }
    }

    /// Returns the unit normal at a vertex; NaN at a hole of a grid.
    #[inline(always)]
    pub(crate) fn normal(&self, vertex: u32) -> Vector {
        match &self.normals {
            Normals::Ready(normals) => normals[vertex as usize],
            Normals::WhenTouched(cells) => {
                let cell = &cells[vertex as usize];
                cell.get().unwrap_or_else(|| cell.set(self.fitted_normal(vertex)))
            }
        }
    }

    /// Returns about so many vertices, spread over the patch, holes left out.
    pub(crate) fn sample(&self, count: usize) -> impl Iterator<Item = u32> {
        let n = self.points.len();
        let (columns, step_i, step_j) = match &self.lattice {
            Lattice::Grid(grid) => {
                let step = ((n as f64 / count as f64).sqrt() as usize).clamp(1, grid.columns().min(grid.rows()) / 3);
                (grid.columns(), step, step)
            }
            Lattice::Mesh(_) => (n, n.div_ceil(count), 1),
        };
        (0..n / columns)
            .step_by(step_j)
            .flat_map(move |j| (0..columns).step_by(step_i).map(move |i| (j * columns + i) as u32))
            .filter(|&v| {
                self.points[v as usize].x.is_finite() && (self.has_scattered_normals() || self.normal(v).x.is_finite())
            })
    }

    /// Whether normals were given or exact rather than fitted to scattered neighbours.
    pub(crate) fn has_scattered_normals(&self) -> bool {
        matches!(self.normals, Normals::WhenTouched(_))
    }

    /// Returns the normals of a grid, which are all known; of a mesh none.
    pub(crate) fn known_normals(&self) -> &[Vector] {
        match &self.normals {
            Normals::Ready(normals) => normals,
            Normals::WhenTouched(_) => &[],
        }
    }

    #[cold]
    fn fitted_normal(&self, vertex: u32) -> Vector {
        match &self.lattice {
            Lattice::Mesh(mesh) => pulp::Arch::new().dispatch(Four { patch: self, mesh, vertices: [vertex; LANES] })[0],
            Lattice::Grid(_) => unreachable!("a grid has its normals ready"),
        }
    }

    /// Fits the normals of many vertices that are not known yet: on all cores and four at a time, several times faster than
    /// one by one when they are touched, and to the same bits.
    pub(crate) fn fit_normals(&self, vertices: &[u32]) {
        /// Vertices that a task takes at a time.
        const CHUNK: usize = 256;
        let (Normals::WhenTouched(cells), Lattice::Mesh(mesh)) = (&self.normals, &self.lattice) else { return };
        let arch = pulp::Arch::new();
        vertices.par_chunks(CHUNK).for_each(|chunk| {
            let unknown: Vec<u32> = chunk.iter().copied().filter(|&v| cells[v as usize].get().is_none()).collect();
            for few in unknown.chunks(LANES) {
                let vertices = std::array::from_fn(|l| few[l.min(few.len() - 1)]);
                let normals = arch.dispatch(Four { patch: self, mesh, vertices });
                for (&vertex, normal) in few.iter().zip(normals) {
                    cells[vertex as usize].set(normal);
                }
            }
        });
    }

    /// Returns the corners of a facet that exists.
    pub(crate) fn corners(&self, facet: u32) -> [u32; 3] {
        match &self.lattice {
            Lattice::Grid(grid) => grid.corners(facet),
            Lattice::Mesh(mesh) => mesh.corners(facet),
        }
    }
}

/// The normals of four vertices, in a form that is compiled once for each set of vector instructions.
struct Four<'a> {
    patch: &'a Patch,
    mesh: &'a MeshLattice,
    vertices: [u32; LANES],
}

impl pulp::NullaryFnOnce for Four<'_> {
    type Output = [Vector; LANES];

    // Inlined into the caller that has the instructions; a call from it would be to code without them.
    #[inline(always)]
    fn call(self) -> Self::Output {
        normals::four_normals(&self.patch.points, self.mesh, &self.vertices)
    }
}

/// A normal that is worked out once, by whichever thread first needs it.
///
/// Every thread that finds it unknown computes the same value, so a race costs time and changes nothing; NaN means unknown.
#[derive(Debug)]
struct NormalCell([AtomicU64; 3]);

impl NormalCell {
    fn unknown() -> Self {
        Self(std::array::from_fn(|_| AtomicU64::new(f64::NAN.to_bits())))
    }

    #[inline]
    fn get(&self) -> Option<Vector> {
        let [x, y, z] = [0, 1, 2].map(|k| f64::from_bits(self.0[k].load(Ordering::Relaxed)));
        (!(x + y + z).is_nan()).then(|| Vector::new(x, y, z))
    }

    fn set(&self, normal: Vector) -> Vector {
        for (cell, c) in self.0.iter().zip(normal.iter()) {
            cell.store(c.to_bits(), Ordering::Relaxed);
        }
        normal
    }
}
