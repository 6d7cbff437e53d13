//! Surfaces with two radii of curvature: the toroid and the biconic.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::conic::{Asphere, AsphereDefinition};
use super::error::{self, DefinitionError};

/// Toroid: a curve in the (y, z) plane, rotated about a line parallel to y.
///
/// The curve g(y) is that of an asphere with |y| in place of h. The line of rotation meets the z axis at z = R, with
/// the radius of rotation R. If R is infinite (`inf`), the curve is shifted along x, which makes a cylinder. With C =
/// 1/R and w = 1 - C g(y), `z = g + C x^2 / (w + sqrt(w^2 - C^2 x^2))`. This is the root of (z - R)^2 + x^2 = (R - g)^2
/// near the vertex.
#[derive(Clone, Debug, PartialEq)]
pub struct Toroid {
    rotation_per_mm: f64,
    curve: Asphere,
}

/// Definition of a toroid in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ToroidDefinition {
    /// Radius of rotation in millimetres: the radius of the section at y = 0; `inf` for a cylinder.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_x_mm: f64,
    /// Radius of the curve in the (y, z) plane at its vertex, in millimetres; `inf` for a curve without curvature.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_y_mm: f64,
    /// Conic constant of the curve in the (y, z) plane.
    #[serde(default)]
    pub conic_y: f64,
    /// Coefficients of the curve in the (y, z) plane by power of |y|, as for an asphere, in mm^(1 - power).
    #[serde(default)]
    pub coefficients: BTreeMap<String, f64>,
}

impl Toroid {
    /// Creates a toroid. The curve `curve` in the (y, z) plane is rotated about a line that is parallel to y and meets
    /// the z axis at z = `radius_x_mm`. A negative radius puts this line on the -z side. An infinite radius makes a
    /// cylinder along x.
    ///
    /// # Errors
    /// Returns an error if the radius is NaN or less than 1e-6 mm in magnitude.
    pub fn new(radius_x_mm: f64, curve: Asphere) -> Result<Self, DefinitionError> {
        Ok(Self { rotation_per_mm: error::checked_curvature("radius_x_mm", radius_x_mm)?, curve })
    }

    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (`x`, `y`). The toroid arises if a curve z = g(y) is
    /// rotated about a line that is parallel to y and meets the z axis at z = R. So the curve point at `y` moves on a
    /// circle of the radius |R - g(y)|.
    ///
    /// Returns `None` in three cases:
    ///
    /// - `y` is at or beyond the edge of the curve.
    /// - |`x`| is not less than the radius of the circle.
    /// - The curve point at `y` and the vertex of the curve are not on the same side of the line.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let c = self.rotation_per_mm;
        let (g, slope) = self.curve.sag_and_derivative(y * y)?;
        let w = 1.0 - c * g;
        let root = w * w - c * c * x * x;
        if !(w > 0.0 && root > 0.0) {
            return None;
        }
        let root = root.sqrt();
        Some((g + c * x * x / (w + root), [c * x / root, w * 2.0 * y * slope / root]))
    }

    /// Returns the number of terms that one evaluation of the sag sums, as a measure of its time: the terms of the
    /// curve plus 1 for the rotation.
    pub(super) fn term_count(&self) -> usize {
        1 + self.curve.term_count()
    }
}

impl TryFrom<&ToroidDefinition> for Toroid {
    type Error = DefinitionError;

    fn try_from(written: &ToroidDefinition) -> Result<Self, DefinitionError> {
        error::checked_curvature("radius_y_mm", written.radius_y_mm)?;
        error::check_finite("conic_y", written.conic_y)?;
        let curve = AsphereDefinition {
            radius_mm: written.radius_y_mm,
            conic: written.conic_y,
            coefficients: written.coefficients.clone(),
        };
        Self::new(written.radius_x_mm, Asphere::try_from(&curve)?)
    }
}

/// Biconic: a conic in x joined with a conic in y,
/// `z = (cx x^2 + cy y^2) / (1 + sqrt(1 - (1 + kx) cx^2 x^2 - (1 + ky) cy^2 y^2))`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Biconic {
    curvatures_per_mm: [f64; 2],
    conics: [f64; 2],
}

/// Definition of a biconic in a file.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct BiconicDefinition {
    /// Radius of the section at y = 0 at the vertex, in millimetres; `inf` for a straight section.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_x_mm: f64,
    /// Radius of the section at x = 0 at the vertex, in millimetres; `inf` for a straight section.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_y_mm: f64,
    /// Conic constant of the section at y = 0.
    #[serde(default)]
    pub conic_x: f64,
    /// Conic constant of the section at x = 0.
    #[serde(default)]
    pub conic_y: f64,
}

impl Biconic {
    /// Returns the sag z of the biconic and its gradient (dz/dx, dz/dy) at (`x`, `y`). Returns `None` at the edge of
    /// the surface and beyond. There, the square root in the formula of the biconic is zero or not real: 1 - (1 + kx)
    /// cx^2 x^2 - (1 + ky) cy^2 y^2 is not positive. Here cx and cy are the curvatures at the vertex, and kx and ky the
    /// conic constants.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let [cx, cy] = self.curvatures_per_mm;
        let [fall_x, fall_y] = [(1.0 + self.conics[0]) * cx * cx * x, (1.0 + self.conics[1]) * cy * cy * y];
        let root = 1.0 - fall_x * x - fall_y * y;
        if root.is_nan() || root <= 0.0 {
            return None;
        }
        let root = root.sqrt();
        let z = (cx * x * x + cy * y * y) / (1.0 + root);
        let slope = |c: f64, v: f64, fall: f64| (2.0 * c * v + z * fall / root) / (1.0 + root);
        Some((z, [slope(cx, x, fall_x), slope(cy, y, fall_y)]))
    }
}

impl TryFrom<&BiconicDefinition> for Biconic {
    type Error = DefinitionError;

    fn try_from(written: &BiconicDefinition) -> Result<Self, DefinitionError> {
        let cx = error::checked_curvature("radius_x_mm", written.radius_x_mm)?;
        let cy = error::checked_curvature("radius_y_mm", written.radius_y_mm)?;
        let conics =
            [error::check_finite("conic_x", written.conic_x)?, error::check_finite("conic_y", written.conic_y)?];
        Ok(Self { curvatures_per_mm: [cx, cy], conics })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::conic::Conic;
    use crate::surface::analytic::test_support::{disc, gradient_error};

    fn toroid(radius_x_mm: f64, radius_y_mm: f64) -> Toroid {
        Toroid::new(radius_x_mm, Asphere::new(Conic::new(radius_y_mm, 0.0).unwrap(), &[]).unwrap()).unwrap()
    }

    #[test]
    fn toroid_by_hand() {
        // At y = 3 the curve of radius 5 has risen by 1, so 13 - 1 = 12 is left to the line at 13; at x = 7.2 the
        // circle of radius 12 (3-4-5) stands 9.6 below the line.
        let (z, [gx, gy]) = toroid(13.0, 5.0).sag_and_gradient(7.2, 3.0).unwrap();
        assert!((z - 3.4).abs() < 1e-14 && (gx - 0.75).abs() < 1e-14);
        assert!((gy - 12.0 / 9.6 * 0.75).abs() < 1e-14);
        assert_eq!(toroid(13.0, 5.0).sag_and_gradient(0.0, 5.0), None);
        assert_eq!(toroid(13.0, 5.0).sag_and_gradient(12.5, 3.0), None);
    }

    #[test]
    fn toroid_limits_sphere_and_cylinder() {
        let sphere = Conic::new(-80.0, 0.0).unwrap();
        for [x, y] in disc(70.0) {
            let (sag, slope) = sphere.sag_and_derivative(x * x + y * y).unwrap();
            let (z, [gx, gy]) = toroid(-80.0, -80.0).sag_and_gradient(x, y).unwrap();
            assert!((z - sag).abs() < 1e-13 && (gx - 2.0 * x * slope).abs() < 1e-13);
            assert!((gy - 2.0 * y * slope).abs() < 1e-13);
            let (along_x, _) = toroid(80.0, f64::INFINITY).sag_and_gradient(x, y).unwrap();
            assert!((along_x + sphere.sag_and_derivative(x * x).unwrap().0).abs() < 1e-13);
            let (along_y, _) = toroid(f64::INFINITY, 80.0).sag_and_gradient(x, y).unwrap();
            assert!((along_y + sphere.sag_and_derivative(y * y).unwrap().0).abs() < 1e-13);
        }
    }

    #[test]
    fn biconic_with_equal_radii_is_conic() {
        let conic = Conic::new(60.0, -0.7).unwrap();
        let written = BiconicDefinition { radius_x_mm: 60.0, radius_y_mm: 60.0, conic_x: -0.7, conic_y: -0.7 };
        let biconic = Biconic::try_from(&written).unwrap();
        for [x, y] in disc(50.0) {
            let (sag, slope) = conic.sag_and_derivative(x * x + y * y).unwrap();
            let (z, [gx, gy]) = biconic.sag_and_gradient(x, y).unwrap();
            assert!((z - sag).abs() < 1e-14 && (gx - 2.0 * x * slope).abs() < 1e-14);
            assert!((gy - 2.0 * y * slope).abs() < 1e-14);
        }
    }

    #[test]
    fn biconic_by_hand() {
        let written = BiconicDefinition { radius_x_mm: 5.0, radius_y_mm: f64::INFINITY, conic_x: 0.0, conic_y: 3.0 };
        let biconic = Biconic::try_from(&written).unwrap();
        let (z, [gx, gy]) = biconic.sag_and_gradient(3.0, 1e5).unwrap();
        assert!((z - 1.0).abs() < 1e-15 && (gx - 0.75).abs() < 1e-15 && gy == 0.0);
        assert_eq!(biconic.sag_and_gradient(5.0, 0.0), None);
    }

    #[test]
    fn toroid_gradients_match_sag() {
        let curve = Asphere::new(Conic::new(-90.0, -2.0).unwrap(), &[(4, 2e-7), (6, 1e-10)]).unwrap();
        let toroid = Toroid::new(150.0, curve).unwrap();
        assert!(gradient_error(&|x, y| toroid.sag_and_gradient(x, y), 40.0) < 1e-11);
        let written = BiconicDefinition { radius_x_mm: 60.0, radius_y_mm: -95.0, conic_x: 1.5, conic_y: -3.0 };
        let biconic = Biconic::try_from(&written).unwrap();
        assert!(gradient_error(&|x, y| biconic.sag_and_gradient(x, y), 30.0) < 1e-11);
    }

    #[test]
    fn toroid_refuses_degenerate_values() {
        let good = BiconicDefinition { radius_x_mm: 60.0, radius_y_mm: -95.0, conic_x: 1.5, conic_y: -3.0 };
        for (bad, name) in [
            (BiconicDefinition { radius_x_mm: 0.0, ..good }, "radius_x_mm"),
            (BiconicDefinition { radius_y_mm: f64::NAN, ..good }, "radius_y_mm"),
            (BiconicDefinition { conic_y: f64::INFINITY, ..good }, "conic_y"),
        ] {
            assert_eq!(Biconic::try_from(&bad).unwrap_err().key().as_deref(), Some(name));
        }
        let curve = Asphere::new(Conic::PLANE, &[]).unwrap();
        assert_eq!(Toroid::new(0.0, curve).unwrap_err().key().as_deref(), Some("radius_x_mm"));
    }
}
