//! The warm case of the point location, four points at a time.
//!
//! Once a registration has settled, nearly every point stays on its facet from one iteration to the next. For those the
//! arithmetic of [`super::offset`] is the same straight line of products and sums, which the compiler turns into vector
//! instructions when four points stand side by side. A point that left its facet is told from its weights and walks alone.
//! The operations are those of the single point, so the two agree to rounding.

use crate::geometry::Point;

use super::offset::{Distance, INSIDE, Lookup, OffsetSurface, Place};
use super::patch::{Facets, Lattice, Patch};

/// Points handled at a time.
pub(crate) const LANES: usize = 4;

/// One number of each of four points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Lane(pub(crate) [f64; LANES]);

/// A vector of each of four points: x, y, z.
pub(crate) type Lane3 = [Lane; 3];

macro_rules! lanewise {
    ($trait:ident, $method:ident, $op:tt) => {
        impl std::ops::$trait for Lane {
            type Output = Lane;

            #[inline(always)]
            fn $method(self, other: Lane) -> Lane {
                Lane([
                    self.0[0] $op other.0[0],
                    self.0[1] $op other.0[1],
                    self.0[2] $op other.0[2],
                    self.0[3] $op other.0[3],
                ])
            }
        }
    };
}

lanewise!(Add, add, +);
lanewise!(Sub, sub, -);
lanewise!(Mul, mul, *);
lanewise!(Div, div, /);

impl Lane {
    #[inline(always)]
    pub(crate) fn splat(value: f64) -> Self {
        Lane([value; LANES])
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Lane([self.0[0].sqrt(), self.0[1].sqrt(), self.0[2].sqrt(), self.0[3].sqrt()])
    }

    #[inline(always)]
    fn min(self, other: Self) -> Self {
        let least = |a: f64, b: f64| if a < b { a } else { b };
        Lane([
            least(self.0[0], other.0[0]),
            least(self.0[1], other.0[1]),
            least(self.0[2], other.0[2]),
            least(self.0[3], other.0[3]),
        ])
    }
}

#[inline(always)]
pub(crate) fn dot(a: &Lane3, b: &Lane3) -> Lane {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross(a: &Lane3, b: &Lane3) -> Lane3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
pub(crate) fn minus(a: &Lane3, b: &Lane3) -> Lane3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
fn times(a: &Lane3, b: Lane) -> Lane3 {
    [a[0] * b, a[1] * b, a[2] * b]
}

#[inline(always)]
fn weighted(v: &[Lane3; 3], b: &[Lane; 3]) -> Lane3 {
    let at = |k: usize| v[0][k] * b[0] + v[1][k] * b[1] + v[2][k] * b[2];
    [at(0), at(1), at(2)]
}

/// The feet of four points on the facets where they last were.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WarmFeet {
    pub(crate) distance_mm: Lane,
    pub(crate) normal: Lane3,
    /// Which points are still on their facet; the others' numbers mean nothing.
    pub(crate) stays: [bool; LANES],
}

impl OffsetSurface<'_> {
    /// Whether [`OffsetSurface::warm_feet`] answers for this surface: one patch, the curved distance at the foot.
    pub(crate) fn has_warm_feet(&self) -> bool {
        self.nominal().patches().len() == 1 && self.distance() == Distance::Curved && self.lookup() == Lookup::Foot
    }

    /// Finds the feet of four points that have not left their facets.
    #[inline(always)]
    pub(crate) fn warm_feet(&self, p: &Lane3, places: &[Place; LANES]) -> WarmFeet {
        let patch = &self.nominal().patches()[0];
        match &patch.lattice {
            Lattice::Grid(grid) => self.warm_feet_on(patch, grid, p, places),
            Lattice::Mesh(mesh) => self.warm_feet_on(patch, mesh, p, places),
        }
    }

    #[inline(always)]
    fn warm_feet_on<F: Facets>(&self, patch: &Patch, facets: &F, p: &Lane3, places: &[Place; LANES]) -> WarmFeet {
        let known = places.map(|place| place != Place::UNKNOWN);
        let (x, n) = self.gathered(patch, facets, places);
        let (e1, e2) = (minus(&x[1], &x[0]), minus(&x[2], &x[0]));
        let turned = cross(&e1, &e2);
        let squared = dot(&turned, &turned);
        let flat = times(&turned, Lane::splat(self.side().sign()) / squared.sqrt());
        let per_squared = Lane::splat(1.0) / squared;
        let w = minus(p, &x[0]);
        let b1 = dot(&cross(&w, &e2), &turned) * per_squared;
        let b2 = dot(&cross(&e1, &w), &turned) * per_squared;
        let b = [Lane::splat(1.0) - b1 - b2, b1, b2];
        let least = b[0].min(b[1]).min(b[2]);
        let mean = weighted(&n, &b);
        let normal = times(&mean, Lane::splat(1.0) / dot(&mean, &mean).sqrt());
        let distance_mm = dot(&w, &flat) * dot(&normal, &flat) - height(&x, &n, &b);
        let stays = std::array::from_fn(|l| known[l] && least.0[l] >= INSIDE);
        WarmFeet { distance_mm, normal, stays }
    }

    /// Corners on the offset surface, eq. (3), and their normals.
    #[inline(always)]
    fn gathered<F: Facets>(&self, patch: &Patch, facets: &F, places: &[Place; LANES]) -> ([Lane3; 3], [Lane3; 3]) {
        let corners = |place: &Place| facets.corners(if *place == Place::UNKNOWN { 0 } else { place.facet() });
        let [a, b, c, d] = [corners(&places[0]), corners(&places[1]), corners(&places[2]), corners(&places[3])];
        let first = self.corner(patch, [a[0], b[0], c[0], d[0]]);
        let second = self.corner(patch, [a[1], b[1], c[1], d[1]]);
        let third = self.corner(patch, [a[2], b[2], c[2], d[2]]);
        ([first.0, second.0, third.0], [first.1, second.1, third.1])
    }

    /// One corner of each of four facets: its place on the offset surface and its normal.
    ///
    /// Every lane is built from registers; built through an array in memory it would wait for four narrow stores.
    #[inline(always)]
    fn corner(&self, patch: &Patch, [a, b, c, d]: [u32; LANES]) -> (Lane3, Lane3) {
        let (sign, radius) = (Lane::splat(self.side().sign()), Lane::splat(self.radius_mm()));
        let point = |vertex: u32| &patch.points[vertex as usize];
        let (pa, pb, pc, pd) = (point(a), point(b), point(c), point(d));
        let (na, nb, nc, nd) = (patch.normal(a), patch.normal(b), patch.normal(c), patch.normal(d));
        let normal = [
            Lane([na.x, nb.x, nc.x, nd.x]) * sign,
            Lane([na.y, nb.y, nc.y, nd.y]) * sign,
            Lane([na.z, nb.z, nc.z, nd.z]) * sign,
        ];
        let on_offset = [
            Lane([pa.x, pb.x, pc.x, pd.x]) + normal[0] * radius,
            Lane([pa.y, pb.y, pc.y, pd.y]) + normal[1] * radius,
            Lane([pa.z, pb.z, pc.z, pd.z]) + normal[2] * radius,
        ];
        (on_offset, normal)
    }
}

/// Height of the curved surface over the flat facet.
#[inline(always)]
fn height(x: &[Lane3; 3], n: &[Lane3; 3], b: &[Lane; 3]) -> Lane {
    let zero = Lane::splat(0.0);
    let mut along = zero;
    let mut total = zero;
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        let edge = minus(&x[j], &x[i]);
        let (leaving, arriving) = (zero - dot(&n[i], &edge), dot(&n[j], &edge));
        along = along + b[i] * b[j] * (b[i] * leaving + b[j] * arriving);
        total = total + (leaving + arriving);
    }
    along + Lane::splat(0.5) * total * b[0] * b[1] * b[2]
}

/// Four points side by side.
#[inline(always)]
pub(crate) fn side_by_side(points: &[Point; LANES]) -> Lane3 {
    [0, 1, 2].map(|c| Lane([points[0][c], points[1][c], points[2][c], points[3][c]]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{Nominal, Projection, Side};

    #[test]
    fn four_at_a_time_agree_with_one_at_a_time() {
        let z = |x: f64, y: f64| 3.0 * (0.11 * x + 0.2).sin() * (0.07 * y - 0.4).cos();
        let cloud: Vec<Point> = (0..41 * 31)
            .map(|k| (f64::from(k % 41) * 0.8 - 16.0, f64::from(k / 41) * 0.9 - 13.0))
            .map(|(x, y)| Point::new(x, y, z(x, y)))
            .collect();
        for nominal in [
            Nominal::from_points(cloud.clone(), Projection::Auto).unwrap(),
            Nominal::scattered(cloud, Projection::Auto).unwrap(),
        ] {
            for side in [Side::Normal, Side::Opposite] {
                let surface = OffsetSurface::new(&nominal, 1.5, side).unwrap();
                for k in 0..400 {
                    let points: [Point; LANES] = std::array::from_fn(|l| {
                        let t = f64::from(4 * k + l as i32);
                        let (x, y) = (13.0 * (t * 0.613).sin(), 11.0 * (t * 0.377).cos());
                        Point::new(x, y, z(x, y) + side.sign() * (1.5 + 0.01 * t.sin()))
                    });
                    let feet = points.map(|p| surface.foot(&p, Place::UNKNOWN));
                    let warm = surface.warm_feet(&side_by_side(&points), &feet.map(|f| f.place));
                    for (l, foot) in feet.iter().enumerate().filter(|(l, _)| warm.stays[*l]) {
                        assert!((warm.distance_mm.0[l] - foot.distance_mm).abs() < 1e-14);
                        assert!((0..3).all(|c| (warm.normal[c].0[l] - foot.normal[c]).abs() < 1e-14));
                    }
                    assert!(warm.stays.iter().filter(|s| **s).count() >= 3, "{:?}", warm.stays);
                }
            }
        }
    }

    #[test]
    fn who_left_or_was_never_there_does_not_stay() {
        let cloud = (0..100).map(|k| Point::new(f64::from(k % 10), f64::from(k / 10), 0.0)).collect();
        let nominal = Nominal::from_points(cloud, Projection::Auto).unwrap();
        let surface = OffsetSurface::new(&nominal, 0.5, Side::Normal).unwrap();
        let at = |x: f64| Point::new(x, 4.3, 0.5);
        let place = surface.foot(&at(2.6), Place::UNKNOWN).place;
        let points = [at(2.6), at(3.6), at(2.6), at(2.7)];
        let warm = surface.warm_feet(&side_by_side(&points), &[place, place, Place::UNKNOWN, place]);
        assert_eq!(warm.stays, [true, false, false, true]);
    }
}
