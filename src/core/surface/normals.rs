//! Normals of scattered points: a local cubic at each vertex, fitted to its neighbours in the triangulation.

use crate::geometry::{Point, Vector};

use super::facet::Facets;
use super::mesh_topology::MeshTopology;
use super::simd::{F64x4, LANES, Real, Vector3x4};

/// Number of neighbours that a fit requires: nine unknowns and a margin. Two rings of a triangulation have eighteen; at
/// a border they have about ten, so that a third ring is added there.
pub(crate) const NEIGHBOURS: usize = 14;

/// Maximum number of neighbours in a fit.
const MAX_NEIGHBOURS: usize = 64;

/// Minimum ratio of a pivot to the largest diagonal entry. A smaller pivot means that the neighbours do not determine
/// the cubic.
const WEAK_PIVOT: f64 = 1e-9;

/// Result of a local fit: the surface at a vertex.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LocalFit {
    /// Unit normal on the side from which the triangles turn counter-clockwise.
    pub(crate) normal: Vector,
    /// Principal curvatures in 1/mm, the smaller first; positive where the surface bends towards its normal (a bowl).
    pub(crate) curvatures: [f64; 2],
    /// Direction of the first principal curvature.
    pub(crate) direction: Vector,
}

/// Fits the normal and the principal curvatures of the surface at the vertex `vertex` to its neighbours. Ring k around
/// a vertex holds the vertices k edges away. The neighbours are whole rings; rings are added until there are `wanted`
/// neighbours or more (at most 64).
///
/// Frame: the origin is the vertex. The axis w is the mean normal of the facets around the vertex. The axes u and v are
/// two tangents. The fit is the cubic w = p u + q v + quadratic and cubic terms, by weighted least squares.
///
/// A neighbour at the distance s has the weight 1/(1 + (s/h)^2), where h is the mean distance of the neighbours. The
/// weight reduces the effect of far neighbours.
///
/// At a border, the neighbours may not determine a cubic. Then a quadric is fitted. If they do not determine a quadric,
/// a plane is fitted. If they do not determine a plane, the normal is the mean normal of the facets.
pub(crate) fn fit_to_ring(points: &[Point], mesh: &MeshTopology, vertex: u32, wanted: usize) -> LocalFit {
    let mut ring = [0u32; MAX_NEIGHBOURS];
    let found = collect_rings(mesh, vertex, wanted, &mut ring);
    let mean = mean_facet_normal(points, mesh, vertex);
    fit_to_neighbours(points[vertex as usize], mean, ring[..found].iter().map(|&i| points[i as usize]))
}

/// Fits the normal and the principal curvatures of the surface at the point `at`. The fit uses the points `neighbours`
/// (at most the first 64). `mean` is the approximate unit normal at `at`.
///
/// Fits a cubic w(u, v) by weighted least squares; a near neighbour has a larger weight. The origin of the frame is
/// `at`, the axis w is `mean`, and the axes u and v are two tangents. The weights, and the simpler fits for few
/// neighbours, are those of [`fit_to_ring`].
pub(crate) fn fit_to_neighbours(at: Point, mean: Vector, neighbours: impl Iterator<Item = Point>) -> LocalFit {
    let [tu, tv] = tangents(&mean);
    let mut local = [[0.0; 3]; MAX_NEIGHBOURS];
    let mut count = 0;
    let mut spread = 0.0;
    for p in neighbours.take(MAX_NEIGHBOURS) {
        let d = p - at;
        local[count] = [d.dot(&tu), d.dot(&tv), d.dot(&mean)];
        spread += (local[count][0].powi(2) + local[count][1].powi(2)).sqrt();
        count += 1;
    }
    let h = spread / count.max(1) as f64;
    let local = &mut local[..count];
    for c in local.iter_mut().flatten() {
        *c /= h;
    }
    let solved = solve::<9>(local).or_else(|| solve::<5>(local)).or_else(|| solve::<2>(local));
    let c = solved.unwrap_or([0.0; 9]);
    LocalFit::new(&mean, &tu, &tv, &[c[0], c[1], c[2] / h, c[3] / h, c[4] / h])
}

/// Fits the unit normals of four vertices in parallel, one vertex per SIMD lane. Each normal equals the result of
/// [`fit_to_ring`] except for rounding. Each normal is independent of the other three vertices.
#[inline(always)]
pub(crate) fn fit_normals_x4(points: &[Point], mesh: &MeshTopology, vertices: &[u32; LANES]) -> [Vector; LANES] {
    let mut rings = Rings { local: [[F64x4::splat(0.0); 3]; MAX_NEIGHBOURS], max_count: 0 };
    let mut last = (None, [Vector::zeros(); 3]);
    let frames: [[Vector; 3]; LANES] = std::array::from_fn(|l| {
        if last.0 == Some(vertices[l]) {
            rings.repeat(l);
        } else {
            last = (Some(vertices[l]), rings.add(points, mesh, vertices[l], l));
        }
        last.1
    });
    let (slopes, determined) = rings.slopes();
    std::array::from_fn(|l| {
        if !determined[l] {
            return fit_to_ring(points, mesh, vertices[l], NEIGHBOURS).normal;
        }
        let [mean, tu, tv] = frames[l];
        let (p, q) = (slopes[0].0[l], slopes[1].0[l]);
        (mean - tu * p - tv * q) / (1.0 + p * p + q * q).sqrt()
    })
}

/// Neighbours of four vertices, each in the frame of its vertex and in units of the mean distance of its neighbours.
/// Shorter rings are padded with zeros.
struct Rings {
    local: [Vector3x4; MAX_NEIGHBOURS],
    max_count: usize,
}

impl Rings {
    /// Writes the neighbours of a vertex into SIMD lane `lane`. Their coordinates are in the frame of the vertex,
    /// divided by the mean distance of the neighbours from the vertex. Returns the axes of this frame: the mean normal
    /// of the facets around the vertex, and two tangents.
    #[inline(always)]
    fn add(&mut self, points: &[Point], mesh: &MeshTopology, vertex: u32, lane: usize) -> [Vector; 3] {
        let mut ring = [0u32; MAX_NEIGHBOURS];
        let count = collect_rings(mesh, vertex, NEIGHBOURS, &mut ring);
        let mean = mean_facet_normal(points, mesh, vertex);
        let [tu, tv] = tangents(&mean);
        let at = points[vertex as usize];
        let mut spread = 0.0;
        for (local, &i) in self.local.iter_mut().zip(&ring[..count]) {
            let d = points[i as usize] - at;
            let (u, v) = (d.dot(&tu), d.dot(&tv));
            spread += (u * u + v * v).sqrt();
            (local[0].0[lane], local[1].0[lane], local[2].0[lane]) = (u, v, d.dot(&mean));
        }
        let per_mean = count as f64 / spread;
        for c in self.local[..count].iter_mut().flatten() {
            c.0[lane] *= per_mean;
        }
        self.max_count = self.max_count.max(count);
        [mean, tu, tv]
    }

    /// Copies the neighbours from SIMD lane `lane - 1` into lane `lane`, because both lanes have the same vertex.
    /// `lane` must not be 0.
    fn repeat(&mut self, lane: usize) {
        for c in self.local[..self.max_count].iter_mut().flatten() {
            c.0[lane] = c.0[lane - 1];
        }
    }

    /// Fits a cubic to the neighbours in each SIMD lane. Returns the slopes of the cubic along u and v at the vertex.
    /// Also returns for each lane true if the neighbours determine a cubic; the slopes of a lane with false must not be
    /// used.
    ///
    /// The matrix of the normal equations contains only 25 different numbers: the weighted sums of the monomials of
    /// degrees 2 to 6.
    #[inline(always)]
    fn slopes(&self) -> ([F64x4; 2], [bool; LANES]) {
        let one = F64x4::splat(1.0);
        let mut moments = [F64x4::splat(0.0); MOMENTS];
        let mut right = [F64x4::splat(0.0); TERMS.len()];
        for [u, v, w] in &self.local[..self.max_count] {
            let weight = one / (one + *u * *u + *v * *v);
            let powers = monomials::<MOMENTS>([weight * *u * *u, weight * *u * *v, weight * *v * *v], *u, *v);
            for (sum, power) in moments.iter_mut().zip(powers) {
                *sum = *sum + power;
            }
            let (wu, wv) = (weight * *w * *u, weight * *w * *v);
            let rest = monomials::<7>([wu * *u, wu * *v, wv * *v], *u, *v);
            for (sum, power) in right.iter_mut().zip([wu, wv].into_iter().chain(rest)) {
                *sum = *sum + power;
            }
        }
        let moment = |i: usize, j: usize| {
            let (of_u, of_v) = (TERMS[i][0] + TERMS[j][0], TERMS[i][1] + TERMS[j][1]);
            moments[(of_u + of_v) * (of_u + of_v + 1) / 2 - 3 + of_v]
        };
        let gram = std::array::from_fn(|i| std::array::from_fn(|j| moment(i, j)));
        solve_x4(gram, right)
    }
}

/// Powers of u and v in the cubic, in the order of [`solve`].
const TERMS: [[usize; 2]; 9] = [[1, 0], [0, 1], [2, 0], [1, 1], [0, 2], [3, 0], [2, 1], [1, 2], [0, 3]];

/// Number of monomials of u and v of degrees 2 to 6.
const MOMENTS: usize = 25;

/// Returns the first N of the weighted monomials in u and v of degree 2, 3 and higher. Degree n has the monomials u^n,
/// u^(n-1) v, ..., v^n, in this order. `squares` are the weighted monomials of degree 2: u^2, u v and v^2, each times
/// the weight. The number N must end with a complete degree.
#[inline(always)]
fn monomials<const N: usize>(squares: [F64x4; 3], u: F64x4, v: F64x4) -> [F64x4; N] {
    let mut all = [F64x4::splat(0.0); N];
    all[..3].copy_from_slice(&squares);
    let (mut begin, mut end) = (0, 3);
    while end < N {
        for k in begin..end {
            all[k + end - begin] = all[k] * u;
        }
        all[2 * end - begin] = all[end - 1] * v;
        (begin, end) = (end, 2 * end - begin + 1);
    }
    all
}

/// Solves four linear systems M x = b by Cholesky decomposition, one per SIMD lane. `m` holds the symmetric matrices M,
/// and `x` holds the right-hand sides b. Returns the first two unknowns of each system. Also returns for each system
/// true if its pivots are large enough for a solution.
#[inline(always)]
fn solve_x4<const N: usize>(mut m: [[F64x4; N]; N], mut x: [F64x4; N]) -> ([F64x4; 2], [bool; LANES]) {
    let min_pivot: [f64; LANES] =
        std::array::from_fn(|l| WEAK_PIVOT * (0..N).map(|i| m[i][i].0[l]).fold(0.0, f64::max));
    let mut determined = [true; LANES];
    for j in 0..N {
        let mut pivot = m[j][j];
        for factor in &m[j][..j] {
            pivot = pivot - *factor * *factor;
        }
        for l in 0..LANES {
            // NaN is not determined either.
            determined[l] &= pivot.0[l] > min_pivot[l];
        }
        let inverse = F64x4::splat(1.0) / F64x4(pivot.0.map(f64::sqrt));
        for i in j + 1..N {
            for k in 0..j {
                m[i][j] = m[i][j] - m[i][k] * m[j][k];
            }
            m[i][j] = m[i][j] * inverse;
        }
        for k in 0..j {
            x[j] = x[j] - m[j][k] * x[k];
        }
        x[j] = x[j] * inverse;
        m[j][j] = inverse;
    }
    for i in (0..N).rev() {
        for k in i + 1..N {
            x[i] = x[i] - m[k][i] * x[k];
        }
        x[i] = x[i] * m[i][i];
    }
    ([x[0], x[1]], determined)
}

impl LocalFit {
    /// Computes the normal and the principal curvatures at the origin of w = p u + q v + a u^2 + b uv + c v^2. The axes
    /// of u, v and w are `tu`, `tv` and `mean`.
    fn new(mean: &Vector, tu: &Vector, tv: &Vector, [p, q, a, b, c]: &[f64; 5]) -> Self {
        let root = (1.0 + p * p + q * q).sqrt();
        let normal = (mean - tu * *p - tv * *q) / root;
        // First and second fundamental forms; the shape operator's eigenvalues are the principal curvatures.
        let (e, f, g) = (1.0 + p * p, p * q, 1.0 + q * q);
        let (l, m, n) = (2.0 * a / root, b / root, 2.0 * c / root);
        let det = e * g - f * f;
        let mean_curvature = (e * n - 2.0 * f * m + g * l) / (2.0 * det);
        let gauss = (l * n - m * m) / det;
        let half = (mean_curvature * mean_curvature - gauss).max(0.0).sqrt();
        let k = mean_curvature - half;
        let (x, y) = null_direction(l - k * e, m - k * f, n - k * g);
        let along = (tu + mean * *p) * x + (tv + mean * *q) * y;
        Self { normal, curvatures: [k, mean_curvature + half], direction: along.normalize() }
    }
}

/// Returns the unit vector (x, y) in the null space of the singular symmetric matrix `[[a, b], [b, c]]`; (1, 0) for the
/// zero matrix.
fn null_direction(a: f64, b: f64, c: f64) -> (f64, f64) {
    let (x, y) = if a.abs() > c.abs() { (-b, a) } else { (c, -b) };
    let norm = x.hypot(y);
    if norm > 0.0 { (x / norm, y / norm) } else { (1.0, 0.0) }
}

/// Returns two unit vectors perpendicular to the unit vector `n` and to each other. The two and `n` are right-handed,
/// in this order.
pub(crate) fn tangents(n: &Vector) -> [Vector; 2] {
    let axis = if n.x.abs() < 0.6 { Vector::x() } else { Vector::y() };
    let tu = (axis - n * n.dot(&axis)).normalize();
    [tu, n.cross(&tu)]
}

/// Fits the first N terms of a cubic w(u, v) to neighbours by weighted least squares. N is 2 (plane), 5 (quadric) or 9
/// (cubic). `local` holds the positions [u, v, w] of the neighbours, divided by their mean distance.
///
/// Returns nine coefficients, in the order u, v, u^2, u v, v^2, u^3, u^2 v, u v^2, v^3; those beyond the first N are 0.
/// Returns `None` if there are fewer than N neighbours, or if they do not determine the N coefficients.
///
/// The arrays have fixed bounds, so that the compiler unrolls and vectorises the loops. This makes the fit several
/// times faster.
fn solve<const N: usize>(local: &[[f64; 3]]) -> Option<[f64; 9]> {
    if local.len() < N {
        return None;
    }
    let mut gram = [[0.0; N]; N];
    let mut right = [0.0; N];
    for &[u, v, w] in local {
        let weight = 1.0 / (1.0 + u * u + v * v);
        let all = [u, v, u * u, u * v, v * v, u * u * u, u * u * v, u * v * v, v * v * v];
        let terms: &[f64; N] = all.first_chunk().expect("N is 9 at most");
        for i in 0..N {
            let scaled = weight * terms[i];
            for j in 0..N {
                gram[i][j] += scaled * terms[j];
            }
            right[i] += scaled * w;
        }
    }
    let scale = (0..N).map(|i| gram[i][i]).fold(0.0, f64::max);
    let inverse_pivots = cholesky(&mut gram, WEAK_PIVOT * scale)?;
    substitute(&gram, &inverse_pivots, &mut right);
    let mut solution = [0.0; 9];
    solution[..N].copy_from_slice(&right);
    Some(solution)
}

/// Computes the Cholesky factor L of the symmetric matrix `m`. Writes the entries of L below the diagonal into `m`.
/// Returns the inverses of the diagonal entries of L. Returns `None` if a pivot (the square of a diagonal entry) is NaN
/// or is not above `min_pivot`.
#[inline(always)]
fn cholesky<const N: usize>(m: &mut [[f64; N]; N], min_pivot: f64) -> Option<[f64; N]> {
    let mut inverse_pivots = [0.0; N];
    for j in 0..N {
        let row_j = m[j];
        let pivot = row_j[j] - (0..j).map(|k| row_j[k] * row_j[k]).sum::<f64>();
        if pivot.is_nan() || pivot <= min_pivot {
            return None;
        }
        inverse_pivots[j] = 1.0 / pivot.sqrt();
        for row in &mut m[j + 1..] {
            let sum = row[j] - (0..j).map(|k| row[k] * row_j[k]).sum::<f64>();
            row[j] = sum * inverse_pivots[j];
        }
    }
    Some(inverse_pivots)
}

/// Solves L L^T x = b by forward and backward substitution. `l` holds the Cholesky factor L below its diagonal, and
/// `inverse_pivots` the inverses of its diagonal, as [`cholesky`] gives them. `x` holds the right-hand side b at the
/// call, and the solution afterwards.
#[inline(always)]
fn substitute<const N: usize>(l: &[[f64; N]; N], inverse_pivots: &[f64; N], x: &mut [f64; N]) {
    for i in 0..N {
        let sum: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
        x[i] = (x[i] - sum) * inverse_pivots[i];
    }
    for i in (0..N).rev() {
        let sum: f64 = (i + 1..N).map(|k| l[k][i] * x[k]).sum();
        x[i] = (x[i] - sum) * inverse_pivots[i];
    }
}

/// Returns the vertices around a vertex, ring by ring, nearest ring first. Ring k holds the vertices k edges away. Adds
/// whole rings until there are `wanted` vertices or more. Returns fewer if the mesh has no more vertices, and never
/// more than [`MAX_NEIGHBOURS`].
pub(super) fn ring_around(mesh: &MeshTopology, vertex: u32, wanted: usize) -> Vec<u32> {
    let mut ring = [0; MAX_NEIGHBOURS];
    let found = collect_rings(mesh, vertex, wanted, &mut ring);
    ring[..found].to_vec()
}

/// Writes the vertices around `vertex` into `ring`, ring by ring, nearest first (ring k holds the vertices k edges
/// away). Adds whole rings until there are `wanted` vertices or more, or until `ring` is full or the mesh has no more.
/// Returns the number of written vertices.
fn collect_rings(mesh: &MeshTopology, vertex: u32, wanted: usize, ring: &mut [u32; MAX_NEIGHBOURS]) -> usize {
    let (mut begin, mut count) = match mesh.two_rings(vertex, ring) {
        Some([first, _]) if first >= wanted => return first,
        Some([first, both]) => (first, both),
        None => (0, add_ring(mesh, vertex, vertex, ring, 0)),
    };
    while count < wanted && begin < count {
        let end = count;
        for k in begin..end {
            count = add_ring(mesh, ring[k], vertex, ring, count);
        }
        begin = end;
    }
    count
}

/// Appends the neighbours of the vertex `of` to the list `ring` of the vertices around `vertex`. `count` is the number
/// of entries that `ring` already has. Omits `vertex` itself and neighbours that are already in the list. Omits all
/// further neighbours if `ring` is full. Returns the new number of entries.
#[inline(always)]
fn add_ring(mesh: &MeshTopology, of: u32, vertex: u32, ring: &mut [u32; MAX_NEIGHBOURS], mut count: usize) -> usize {
    mesh.visit_neighbours(of, |candidate| {
        if candidate != vertex && count < MAX_NEIGHBOURS && !ring[..count].contains(&candidate) {
            ring[count] = candidate;
            count += 1;
        }
    });
    count
}

/// Returns the normalised mean of the normals of the facets around a vertex, weighted by their areas; z if there is no
/// facet.
fn mean_facet_normal(points: &[Point], mesh: &MeshTopology, vertex: u32) -> Vector {
    let mut sum = Vector::zeros();
    mesh.visit_facets_around(vertex, |facet, _| {
        let [a, b, c] = mesh.corners(facet).map(|i| points[i as usize]);
        sum += (b - a).cross(&(c - a));
    });
    let norm = sum.norm();
    if norm > 0.0 && norm.is_finite() { sum / norm } else { Vector::z() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn around(at: Point, z: impl Fn(f64, f64) -> f64, count: usize) -> Vec<Point> {
        (0..count)
            .map(|k| {
                let (r, phi) = (0.3 + 0.05 * k as f64, 2.399_963 * k as f64);
                let (x, y) = (at.x + r * phi.cos(), at.y + r * phi.sin());
                Point::new(x, y, z(x, y))
            })
            .collect()
    }

    #[test]
    fn normal_fit_of_cubic_is_exact() {
        let z = |x: f64, y: f64| 0.4 * x - 0.2 * y + 0.05 * x * x - 0.02 * x * y + 0.01 * y * y * y;
        let at = Point::new(1.0, 2.0, z(1.0, 2.0));
        let exact = Vector::new(-(0.4 + 0.1 - 0.04), -(-0.2 - 0.02 + 0.12), 1.0).normalize();
        let fitted = fit_to_neighbours(at, Vector::z(), around(at, z, 24).into_iter());
        assert!((fitted.normal - exact).norm() < 1e-12, "{}", fitted.normal);
    }

    #[test]
    fn normal_fit_curvature_of_bowl() {
        let radius = 40.0f64;
        let z = |x: f64, y: f64| radius - (radius * radius - x * x - y * y).sqrt();
        let at = Point::new(6.0, -3.0, z(6.0, -3.0));
        let fitted = fit_to_neighbours(at, Vector::z(), around(at, z, 24).into_iter());
        for k in fitted.curvatures {
            assert!((k - 1.0 / radius).abs() < 2e-5, "{k}");
        }
        assert!((fitted.normal - Vector::new(-6.0, 3.0, radius - at.z) / radius).norm() < 1e-5);
    }

    #[test]
    fn normal_fit_direction_of_cylinder() {
        // A gutter along x: it bends towards +z in y (curvature 1/20) and not at all in x.
        let z = |_x: f64, y: f64| y * y / 40.0;
        let fitted = fit_to_neighbours(Point::origin(), Vector::z(), around(Point::origin(), z, 24).into_iter());
        assert!(fitted.curvatures[0].abs() < 1e-12 && (fitted.curvatures[1] - 0.05).abs() < 1e-12);
        assert!(fitted.direction.x.abs() > 1.0 - 1e-12);
    }

    #[test]
    fn normal_fit_with_few_neighbours() {
        // Points on a line do not determine even a plane: the fit returns the mean normal.
        let line = (1..30).map(|k| Point::new(f64::from(k) * 0.1, 0.0, 0.0));
        assert_eq!(fit_to_neighbours(Point::origin(), Vector::z(), line).normal, Vector::z());
        // Six points: a quadric.
        let z = |x: f64, y: f64| 0.1 * x + 0.02 * x * y;
        let few = fit_to_neighbours(Point::origin(), Vector::z(), around(Point::origin(), z, 6).into_iter());
        assert!((few.normal - Vector::new(-0.1, 0.0, 1.0).normalize()).norm() < 1e-12);
        assert_eq!(fit_to_neighbours(Point::origin(), Vector::z(), std::iter::empty()).normal, Vector::z());
    }

    #[test]
    fn two_rings_match_plain_walk() {
        let points: Vec<Point> = around(Point::origin(), |x, y| 0.1 * x * y, 600);
        let map = crate::surface::plane_projection::PlaneProjection::Xy.choose(&points).unwrap().1;
        let (points, t) = crate::surface::delaunay::triangulate(&points, &map).unwrap();
        let mesh = MeshTopology::from_parts(&points, t.corners, t.neighbours).unwrap();
        let mut inside = 0;
        for v in 0..points.len() as u32 {
            let mut plain = [0; MAX_NEIGHBOURS];
            let first = add_ring(&mesh, v, v, &mut plain, 0);
            let both = (0..first).fold(first, |count, k| add_ring(&mesh, plain[k], v, &mut plain, count));
            let mut ring = [0; MAX_NEIGHBOURS];
            let Some(counts) = mesh.two_rings(v, &mut ring) else { continue };
            inside += 1;
            assert_eq!(counts, [first, both], "{v}");
            for part in [0..first, first..both] {
                let sorted = |ring: &[u32]| {
                    let mut ring = ring[part.clone()].to_vec();
                    ring.sort_unstable();
                    ring
                };
                assert_eq!(sorted(&ring), sorted(&plain), "{v}");
            }
        }
        assert!(inside > 400, "only {inside} vertices have their rings on the part");
    }

    #[test]
    fn four_normals_match_single() {
        let z = |x: f64, y: f64| 0.3 * x - 0.02 * x * y + 0.01 * y * y * y;
        let points: Vec<Point> = around(Point::origin(), z, 400);
        let map = crate::surface::plane_projection::PlaneProjection::Xy.choose(&points).unwrap().1;
        let (points, t) = crate::surface::delaunay::triangulate(&points, &map).unwrap();
        let mesh = MeshTopology::from_parts(&points, t.corners, t.neighbours).unwrap();
        for v in 0..points.len() as u32 {
            let four = fit_normals_x4(&points, &mesh, &[v, v / 2, v, 0]);
            let one = fit_to_ring(&points, &mesh, v, NEIGHBOURS).normal;
            assert!((four[0] - one).norm() < 1e-9, "{v}: {}", four[0] - one);
            // The result does not depend on the other lanes.
            assert_eq!(four[0], four[2]);
            assert_eq!(four[0], fit_normals_x4(&points, &mesh, &[v; LANES])[3]);
        }
    }
}
