//! Projections to a plane in which a surface can be triangulated: each place of the surface has its own place in the
//! plane.

use nalgebra::{Matrix3, Matrix4, SymmetricEigen, Vector4};
use serde::{Deserialize, Serialize};

use crate::geometry::{Point, Vector, bounds};

use super::error::SurfaceError;
use super::normals::tangents;

/// Projection of scattered points to a plane, in which they are triangulated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum PlaneProjection {
    /// The first of these projections that is one-to-one: the xy plane, the best-fit plane, the sphere.
    #[default]
    Auto,
    /// The xy plane of the model frame.
    Xy,
    /// The plane that fits the points best.
    BestFit,
    /// Latitude and longitude about the centre of the best sphere, as a stereographic map, so that neither the pole nor
    /// the meridian of 180° is special; for more than a hemisphere.
    Spherical,
}

/// Projection with its parameters for one cloud.
#[derive(Clone, Debug)]
pub(crate) enum Projector {
    /// Origin of the plane, its two directions, and the direction of the height.
    Plane { origin: Point, axes: [Vector; 3] },
    /// Centre, radius, and the axes: two directions perpendicular to the pole, then the pole.
    Sphere { centre: Point, radius_mm: f64, axes: [Vector; 3] },
}

/// Maximum share of the bins of the plane that contain two sheets of the surface. With a larger share the projection is
/// not one-to-one.
const MAX_FOLDED_SHARE: f64 = 0.05;

impl PlaneProjection {
    /// Chooses a projection in which the surface through `points` is one-to-one: each place in the plane of the
    /// projection belongs to one place of the surface. Returns the kind of the projection and the projector for these
    /// points. The returned kind is never `Auto`.
    ///
    /// `Auto` tries the xy plane, the best-fit plane and the sphere, in this order, and takes the first one that is
    /// one-to-one.
    ///
    /// # Errors
    /// Returns [`SurfaceError::NoProjection`] if no tried projection is one-to-one. Without `Auto`, only the requested
    /// projection is tried.
    pub(crate) fn choose(self, points: &[Point]) -> Result<(Self, Projector), SurfaceError> {
        let candidates: &[Self] = match self {
            Self::Auto => &[Self::Xy, Self::BestFit, Self::Spherical],
            Self::Xy => &[Self::Xy],
            Self::BestFit => &[Self::BestFit],
            Self::Spherical => &[Self::Spherical],
        };
        let mut shares = Vec::new();
        for &candidate in candidates {
            let Some(map) = candidate.projector(points) else { continue };
            let folded = map.folded_share(points);
            if folded <= MAX_FOLDED_SHARE {
                return Ok((candidate, map));
            }
            shares.push((candidate, folded));
        }
        Err(SurfaceError::NoProjection { tried: describe(&shares) })
    }

    /// Returns the projector of this kind: the projection with the parameters that fit `points`. `Auto` gives the
    /// projector to the xy plane. Returns `None` only for the spherical projection, if the points determine no sphere.
    fn projector(self, points: &[Point]) -> Option<Projector> {
        match self {
            Self::Auto | Self::Xy => {
                Some(Projector::Plane { origin: Point::origin(), axes: [Vector::x(), Vector::y(), Vector::z()] })
            }
            Self::BestFit => Some(best_fit_plane(points)),
            Self::Spherical => best_fit_sphere(points),
        }
    }
}

/// Returns a text for an error message about the projections that were tried. Each pair in `shares` is a projection and
/// the fraction of the surface, from 0 to 1, that this projection folds. A surface is folded where two parts of it lie
/// on the same point of the plane. The text gives the name and the percentage of each projection.
fn describe(shares: &[(PlaneProjection, f64)]) -> String {
    let name = |p: &PlaneProjection| match p {
        PlaneProjection::Auto => "auto",
        PlaneProjection::Xy => "xy",
        PlaneProjection::BestFit => "best-fit",
        PlaneProjection::Spherical => "spherical",
    };
    let folds = |(p, s): &(PlaneProjection, f64)| format!("{} folds {:.0} % of the surface", name(p), 100.0 * s);
    shares.iter().map(folds).collect::<Vec<_>>().join(", ")
}

impl Projector {
    /// Projects the point `p`. Returns its coordinates (u, v) in the plane of the projection, and its height above the
    /// plane. For a sphere, (u, v) are the coordinates of the stereographic map, and the height is the height above the
    /// sphere. All values are in mm.
    pub(crate) fn project(&self, p: &Point) -> ([f64; 2], f64) {
        match self {
            Self::Plane { origin, axes } => {
                let d = p - origin;
                ([d.dot(&axes[0]), d.dot(&axes[1])], d.dot(&axes[2]))
            }
            Self::Sphere { centre, radius_mm, axes } => {
                let d = p - centre;
                let r = d.norm();
                // Stereographic from the opposite pole: 2 tan(colatitude / 2) at the longitude.
                let scale = 2.0 * radius_mm / (r + d.dot(&axes[2])).max(1e-9 * r);
                ([scale * d.dot(&axes[0]), scale * d.dot(&axes[1])], r - radius_mm)
            }
        }
    }

    /// Returns the fraction, from 0 to 1, of the surface that the projection folds. A surface is folded where two
    /// layers of it lie above the same point of the plane. The plane is divided into squares with ten points each on
    /// average. The fraction is the number of squares with more than one layer, divided by the number of squares with
    /// at least six points. Returns 1 if the projected points cover no area.
    ///
    /// A square has more than one layer if the rms residual of its points about their least-squares plane is more than
    /// 0.6 times the side of the square. One smooth layer has a small residual, even where the surface is steep. Two
    /// layers have a residual of about half the distance between the layers.
    fn folded_share(&self, points: &[Point]) -> f64 {
        let stride = points.len().div_ceil(200_000);
        let placed: Vec<_> = points.iter().step_by(stride).map(|p| self.project(p)).collect();
        let [low, high] = bounds(placed.iter().map(|(place, _)| *place));
        let (width, depth) = (high[0] - low[0], high[1] - low[1]);
        let size = (width * depth * 10.0 / placed.len() as f64).sqrt();
        if size.is_nan() || size <= 0.0 {
            return 1.0;
        }
        let columns = (width / size) as usize + 1;
        let mut bins: Vec<Sheet> = vec![Sheet::default(); columns * ((depth / size) as usize + 1)];
        for ([u, v], height) in &placed {
            let (i, j) = ((u - low[0]) / size, (v - low[1]) / size);
            bins[j as usize * columns + i as usize].add(i.fract() - 0.5, j.fract() - 0.5, height / size);
        }
        let residuals: Vec<f64> = bins.iter().filter_map(Sheet::residual).collect();
        residuals.iter().filter(|r| **r > 0.6).count() as f64 / residuals.len().max(1) as f64
    }
}

/// Sums for the least-squares plane through the heights of one neighbourhood.
#[derive(Clone, Default)]
struct Sheet {
    gram: Matrix4<f64>,
    count: usize,
}

impl Sheet {
    /// Adds a point to this neighbourhood. `u` and `v` are the coordinates of the point from the centre of the
    /// neighbourhood, and `w` is its height. The unit of all three is the size of the neighbourhood.
    fn add(&mut self, u: f64, v: f64, w: f64) {
        let row = Vector4::new(1.0, u, v, w);
        self.gram += row * row.transpose();
        self.count += 1;
    }

    /// Returns the rms residual of the heights about their least-squares plane, in units of the size of the
    /// neighbourhood. Returns `None` if there are fewer than six points.
    fn residual(&self) -> Option<f64> {
        if self.count < 6 {
            return None;
        }
        let normal: Matrix3<f64> = self.gram.fixed_view::<3, 3>(0, 0).into();
        let right: Vector = self.gram.fixed_view::<3, 1>(0, 3).into();
        let solution = (normal + Matrix3::identity() * 1e-9).cholesky()?.solve(&right);
        let sum = self.gram[(3, 3)] - solution.dot(&right);
        Some((sum.max(0.0) / self.count as f64).sqrt())
    }
}

/// Returns the projector onto the least-squares plane of `points`. The normal of the plane has a positive z component.
/// If the plane is nearly upright (parallel to z), the largest component of the normal is positive instead.
fn best_fit_plane(points: &[Point]) -> Projector {
    let (origin, eigen) = principal_axes(points);
    let least = eigen.eigenvalues.imin();
    let mut normal: Vector = eigen.eigenvectors.column(least).into();
    // The normal points to the side of +z, or along its largest component for an upright part.
    let sign = if normal.z.abs() > 0.1 { normal.z } else { normal[normal.iamax()] };
    normal *= sign.signum();
    let [tu, tv] = tangents(&normal);
    Projector::Plane { origin, axes: [tu, tv, normal] }
}

/// Returns the centroid of `points`, and the eigenvalues (in mm²) and eigenvectors of the scatter matrix of the points.
/// The eigenvectors are the principal axes.
///
/// Equation: the scatter matrix is the sum of d d^T, where d is the vector from the centroid to a point.
pub(crate) fn principal_axes(points: &[Point]) -> (Point, SymmetricEigen<f64, nalgebra::Const<3>>) {
    let centroid = centroid(points);
    let scatter = points.iter().map(|p| p - centroid).map(|d| d * d.transpose()).sum::<Matrix3<f64>>();
    (centroid, SymmetricEigen::new(scatter))
}

pub(crate) fn centroid(points: &[Point]) -> Point {
    Point::from(points.iter().map(|p| p.coords).sum::<Vector>() / points.len() as f64)
}

/// Returns the projector of the stereographic map of the least-squares sphere through `points`. The pole of the map is
/// in the direction from the centre of the sphere to the centroid of the points. Returns `None` if the points do not
/// determine a sphere.
///
/// Equation: the algebraic fit |p|^2 = 2 c.p + (r^2 - |c|^2), with a point p, the centre c and the radius r, is linear
/// in its four unknowns c and r^2 - |c|^2.
fn best_fit_sphere(points: &[Point]) -> Option<Projector> {
    let middle = centroid(points);
    let (mut gram, mut right) = (Matrix4::zeros(), Vector4::zeros());
    for p in points {
        let d = p - middle;
        let row = Vector4::new(2.0 * d.x, 2.0 * d.y, 2.0 * d.z, 1.0);
        gram += row * row.transpose();
        right += row * d.norm_squared();
    }
    let solution = gram.cholesky()?.solve(&right);
    let offset = Vector::new(solution[0], solution[1], solution[2]);
    let radius_mm = (solution[3] + offset.norm_squared()).sqrt();
    // The pole points from the centre to the centroid of the cloud. A whole sphere has no such direction, and any pole
    // works.
    let pole = if offset.norm() > 1e-6 * radius_mm { -offset.normalize() } else { Vector::z() };
    let [tu, tv] = tangents(&pole);
    radius_mm.is_finite().then(|| Projector::Sphere { centre: middle + offset, radius_mm, axes: [tu, tv, pole] })
}

/// Returns true if the points lie on one line, except for rounding. For speed, first tests a sample of at most 4096
/// points. Tests all points only if the sample lies on one line.
pub(crate) fn is_line(points: &[Point]) -> bool {
    const FEW: usize = 4096;
    // If a sample does not lie on a line, all points do not either.
    let some: Vec<Point> = points.iter().step_by(points.len().div_ceil(FEW).max(1)).copied().collect();
    are_on_line(&some) && (some.len() == points.len() || are_on_line(points))
}

/// Returns true if the points lie on one line, except for rounding. Always tests all points. Compares the second
/// largest eigenvalue of the scatter matrix of the points with the largest one; the limit of the ratio is 1e-18.
fn are_on_line(points: &[Point]) -> bool {
    let (_, eigen) = principal_axes(points);
    let mut spread: [f64; 3] = eigen.eigenvalues.into();
    spread.sort_by(f64::total_cmp);
    spread[1] <= 1e-18 * spread[2]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns points on a sphere of radius 20 about (5, -3, 40), up to a polar angle from +z, spread like a sunflower.
    fn cap(polar_deg: f64, count: usize) -> Vec<Point> {
        let lowest = polar_deg.to_radians().cos();
        (0..count)
            .map(|k| {
                let c = 1.0 - (1.0 - lowest) * (k as f64 + 0.5) / count as f64;
                let (s, phi) = ((1.0 - c * c).sqrt(), 2.399_963_229_728_653 * k as f64);
                Point::new(5.0 + 20.0 * s * phi.cos(), -3.0 + 20.0 * s * phi.sin(), 40.0 + 20.0 * c)
            })
            .collect()
    }

    #[test]
    fn auto_projection_picks_simplest() {
        let chosen = |points: &[Point]| PlaneProjection::Auto.choose(points).unwrap().0;
        assert_eq!(chosen(&cap(60.0, 4000)), PlaneProjection::Xy);
        assert_eq!(chosen(&cap(120.0, 4000)), PlaneProjection::Spherical);
        let upright: Vec<_> = cap(50.0, 4000).iter().map(|p| Point::new(p.z, p.x, p.y)).collect();
        assert_eq!(chosen(&upright), PlaneProjection::BestFit);
    }

    #[test]
    fn projection_refuses_fold() {
        let two_sheets: Vec<_> =
            cap(60.0, 2000).into_iter().flat_map(|p| [p, Point::new(p.x + 0.01, p.y, p.z - 30.0)]).collect();
        assert!(matches!(PlaneProjection::Xy.choose(&two_sheets), Err(SurfaceError::NoProjection { .. })));
        assert!(matches!(PlaneProjection::Xy.choose(&cap(120.0, 4000)), Err(SurfaceError::NoProjection { .. })));
    }

    #[test]
    fn stereographic_map_of_sphere() {
        let points = cap(120.0, 3000);
        let (_, map) = PlaneProjection::Spherical.choose(&points).unwrap();
        let Projector::Sphere { centre, radius_mm, axes } = &map else { panic!("{map:?}") };
        assert!((centre - Point::new(5.0, -3.0, 40.0)).norm() < 1e-9 && (radius_mm - 20.0).abs() < 1e-9);
        assert!(axes[2].z > 0.999);
        for p in &points {
            let ([u, v], height) = map.project(p);
            let colatitude = 2.0 * (u.hypot(v) / 40.0).atan();
            assert!((colatitude - ((p.z - 40.0) / 20.0).clamp(-1.0, 1.0).acos()).abs() < 0.02 && height.abs() < 1e-9);
        }
    }
}
