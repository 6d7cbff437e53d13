//! Curvature features: places of a surface, distinguished by their curvature in any pose.

use rayon::prelude::*;
use regrind_figures::statistics::median;

use crate::geometry::{Point, PointTree, Vector};

use super::facet::Side;
use super::normals::fit_to_neighbours;
use super::plane_projection::principal_axes;

/// Place of a surface, with its normal and its principal curvatures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CurvatureFeature {
    pub(crate) point: Point,
    pub(crate) normal: Vector,
    /// Principal curvatures in 1/mm, the smaller first; positive where the surface bends towards its normal.
    pub(crate) curvatures: [f64; 2],
    /// Unit direction of the first principal curvature.
    pub(crate) direction: Vector,
}

impl CurvatureFeature {
    /// Returns the difference of the principal curvatures in 1/mm, at least 0.
    pub(crate) fn anisotropy(&self) -> f64 {
        self.curvatures[1] - self.curvatures[0]
    }

    /// Returns the same curvature feature (a place with its normal and principal curvatures) with the opposite normal.
    /// The principal curvatures change sign and order, so that the smaller one is still the first. The principal
    /// direction changes to the direction of the new first curvature.
    pub(crate) fn flipped(&self) -> Self {
        Self {
            point: self.point,
            normal: -self.normal,
            curvatures: [-self.curvatures[1], -self.curvatures[0]],
            direction: self.normal.cross(&self.direction),
        }
    }

    /// Moves the curvature feature (a place with its normal and principal curvatures) onto the offset surface: by the
    /// distance `radius_mm` (r) along the normal towards `side`. Returns the moved feature, with the normal towards
    /// `side` and the curvatures of the offset surface. Returns `None` if 1 - r k is not positive for a principal
    /// curvature k: the offset surface folds there.
    ///
    /// Equation: a principal curvature k, positive if the surface bends towards `side`, becomes k / (1 - r k). The
    /// principal directions do not change.
    pub(crate) fn offset(&self, radius_mm: f64, side: Side) -> Option<Self> {
        let seen = if side == Side::Normal { *self } else { self.flipped() };
        let room = seen.curvatures.map(|k| 1.0 - radius_mm * k);
        (room[0] > 0.0 && room[1] > 0.0).then(|| Self {
            point: seen.point + seen.normal * radius_mm,
            curvatures: [seen.curvatures[0] / room[0], seen.curvatures[1] / room[1]],
            ..seen
        })
    }
}

/// Number of nearest points that a local fit uses, including the point itself.
const NEIGHBOURS: u32 = 25;

/// Fits the normal and the principal curvatures at each of the `points` to its 24 nearest neighbours. If `normals` are
/// given, one unit normal per point, they are used instead of the fitted normals.
///
/// Returns one feature per point, in the order of the points. Omits a point if it has fewer than nine neighbours that
/// differ from it, or if its fit is not finite.
///
/// After a first fit, neighbours with large residuals are excluded, and the fit is repeated. So an outlier spoils only
/// the feature at the outlier itself, and not the features around it.
pub(crate) fn fit_features(points: &[Point], normals: Option<&[Vector]>) -> Vec<CurvatureFeature> {
    let tree = PointTree::new(points.iter().copied());
    (0..points.len())
        .into_par_iter()
        .with_min_len(64)
        .filter_map(|k| {
            let nearest = tree.nearest(&points[k], NEIGHBOURS).map(|(n, _)| points[n]);
            let around: Vec<Point> = nearest.filter(|p| *p != points[k]).collect();
            fit_feature(points[k], &around, normals.map(|n| n[k]))
        })
        .collect()
}

/// Fits the principal curvatures at the point `at` to the neighbours `around`, which do not contain `at`. `known` is
/// the unit normal at `at`; if it is `None`, the normal is fitted too. A second fit excludes the neighbours with a
/// residual above six times the median.
///
/// Returns `None` if there are fewer than nine neighbours, or if the fit is not finite.
fn fit_feature(at: Point, around: &[Point], known: Option<Vector>) -> Option<CurvatureFeature> {
    if around.len() < 9 {
        return None;
    }
    let mean = known.unwrap_or_else(|| {
        let (_, eigen) = principal_axes(around);
        eigen.eigenvectors.column(eigen.eigenvalues.imin()).into()
    });
    let first = fit_to_neighbours(at, mean, around.iter().copied());
    let distance = |p: &Point| {
        let d = p - at;
        let slope = d - first.normal * d.dot(&first.normal);
        let k = first.curvatures;
        let (a, b) = (slope.dot(&first.direction), slope.dot(&first.normal.cross(&first.direction)));
        (d.dot(&first.normal) - 0.5 * (k[0] * a * a + k[1] * b * b)).abs()
    };
    let mut residuals: Vec<f64> = around.iter().map(distance).collect();
    let usual = median(&mut residuals)?;
    let good = |p: &&Point| distance(p) <= 6.0 * usual;
    // With the same neighbours the second fit would equal the first.
    let second = if around.iter().all(|p| good(&p)) {
        first
    } else {
        fit_to_neighbours(at, mean, around.iter().filter(good).copied())
    };
    let finite = second.curvatures.iter().all(|k| k.is_finite()) && second.direction.iter().all(|c| c.is_finite());
    finite.then_some(CurvatureFeature {
        point: at,
        normal: known.unwrap_or(second.normal),
        curvatures: second.curvatures,
        direction: second.direction,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a saddle z = x^2/80 - y^2/50, sampled on a grid.
    fn saddle() -> Vec<Point> {
        (-15..=15)
            .flat_map(|j| (-15..=15).map(move |i| (f64::from(i) * 0.7, f64::from(j) * 0.7)))
            .map(|(x, y)| Point::new(x, y, x * x / 80.0 - y * y / 50.0))
            .collect()
    }

    fn middle(features: &[CurvatureFeature]) -> CurvatureFeature {
        *features.iter().find(|f| f.point.coords.norm() < 1e-9).unwrap()
    }

    #[test]
    fn feature_curvatures_of_saddle() {
        let points = saddle();
        let f = middle(&fit_features(&points, Some(&vec![Vector::z(); points.len()])));
        assert!((f.curvatures[0] + 1.0 / 25.0).abs() < 1e-9 && (f.curvatures[1] - 1.0 / 40.0).abs() < 1e-9);
        assert!(f.direction.y.abs() > 1.0 - 1e-9);
        let below = f.flipped();
        assert!((below.curvatures[0] + 1.0 / 40.0).abs() < 1e-9 && below.direction.x.abs() > 1.0 - 1e-9);
    }

    #[test]
    fn feature_offset_until_fold() {
        let points = saddle();
        let f = middle(&fit_features(&points, Some(&vec![Vector::z(); points.len()])));
        let up = f.offset(10.0, Side::Normal).unwrap();
        assert!((1.0 / up.curvatures[1] - 30.0).abs() < 1e-6 && (1.0 / up.curvatures[0] + 35.0).abs() < 1e-6);
        assert_eq!(f.offset(40.5, Side::Normal), None);
        assert_eq!(f.offset(25.5, Side::Opposite), None);
    }

    #[test]
    fn feature_ignores_outlier() {
        let mut points = saddle();
        let beside = points.iter().position(|p| (p.x - 0.7).abs() < 1e-9 && p.y.abs() < 1e-9).unwrap();
        points[beside].z += 3.0;
        let f = middle(&fit_features(&points, None));
        let mut k = f.curvatures.map(f64::abs);
        k.sort_by(f64::total_cmp);
        assert!((k[0] - 1.0 / 40.0).abs() < 2e-3 && (k[1] - 1.0 / 25.0).abs() < 2e-3, "{k:?}");
    }
}
