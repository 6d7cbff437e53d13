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
    /// Chooses a projection in which the surface through the points is one-to-one. Returns its kind, never `Auto`, and
    /// the projector for these points. `Auto` takes the first suitable one of xy plane, best-fit plane and sphere.
    ///
    /// # Errors
    /// Returns [`SurfaceError::NoProjection`] if the requested projection folds the surface, or if with `Auto` every
    /// projection does.
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

    /// Returns the projector for these points; `None` if they determine no sphere for the spherical projection.
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

/// Describes for a message what share of the surface each projection folds.
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
    /// Returns the place (u, v) of a point in the plane of the projection, and its height over the plane; all in mm.
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

    /// Returns how much the projection folds the surface: the share, from 0 to 1, of small neighbourhoods in the plane
    /// that contain more than one sheet of the surface.
    ///
    /// In a neighbourhood of size s a smooth sheet deviates from its tangent plane by a small part of s, even where it
    /// is steep. Two sheets deviate from any plane by half their distance.
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
    /// Adds a point at (u, v) with the height w, in units of the size of the neighbourhood.
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

/// Returns the projection to the least-squares plane of the points. Its normal points to the side of +z, or, for an
/// upright plane, along its largest component.
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

/// Returns the centroid of the points, and the eigenvalues and eigenvectors of their scatter matrix, the sum of d d^T
/// over the vectors d from the centroid. The eigenvectors are the principal axes.
pub(crate) fn principal_axes(points: &[Point]) -> (Point, SymmetricEigen<f64, nalgebra::Const<3>>) {
    let centroid = centroid(points);
    let scatter = points.iter().map(|p| p - centroid).map(|d| d * d.transpose()).sum::<Matrix3<f64>>();
    (centroid, SymmetricEigen::new(scatter))
}

pub(crate) fn centroid(points: &[Point]) -> Point {
    Point::from(points.iter().map(|p| p.coords).sum::<Vector>() / points.len() as f64)
}

/// Returns the projection from the least-squares sphere through the points; `None` if they do not determine a sphere.
///
/// Equation: the algebraic fit |p|^2 = 2 c.p + (r^2 - |c|^2), with the centre c and the radius r, is linear in its four
/// unknowns.
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

/// Returns true if the points lie on one line, except for rounding.
pub(crate) fn is_line(points: &[Point]) -> bool {
    const FEW: usize = 4096;
    // If a sample does not lie on a line, all points do not either.
    let some: Vec<Point> = points.iter().step_by(points.len().div_ceil(FEW).max(1)).copied().collect();
    are_on_line(&some) && (some.len() == points.len() || are_on_line(points))
}

/// Returns true if the points lie on one line, except for rounding. Examines all points.
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
