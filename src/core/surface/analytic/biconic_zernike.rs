//! Biconic plus Zernike polynomials.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::error::DefinitionError;
use super::toroid::{Biconic, BiconicDefinition};
use super::zernike::{Zernike, ZernikeDefinition, ZernikeNormalisation, ZernikeNumbering};

/// Biconic plus a sum of Zernike polynomials: `z = biconic + sum a_n Z_n(x / Rn, y / Rn)`.
#[derive(Clone, Debug, PartialEq)]
pub struct BiconicZernike {
    biconic: Biconic,
    zernike: Zernike,
}

/// Definition of a biconic with Zernike polynomials in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct BiconicZernikeDefinition {
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
    /// Numbering of the coefficients.
    pub numbering: ZernikeNumbering,
    /// Normalisation radius: radius of the disc in millimetres.
    pub normalisation_radius_mm: f64,
    /// Coefficient by index, `{ Z4 = 1e-3 }` or `{ 4 = 1e-3 }`, in millimetres.
    pub coefficients_mm: BTreeMap<String, f64>,
    /// Normalisation of the terms; the default of the numbering if it is not given.
    pub normalisation: Option<ZernikeNormalisation>,
}

impl BiconicZernike {
    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (x, y). Returns `None` at the edge of the biconic and beyond,
    /// and farther than 1.5 normalisation radii from the axis.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let (z, [gx, gy]) = self.biconic.sag_and_gradient(x, y)?;
        let (more, [hx, hy]) = self.zernike.sag_and_gradient(x, y)?;
        Some((z + more, [gx + hx, gy + hy]))
    }

    pub(super) fn normalisation_radius_mm(&self) -> f64 {
        self.zernike.normalisation_radius_mm
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time.
    pub(super) fn term_count(&self) -> usize {
        1 + self.zernike.term_count()
    }
}

impl TryFrom<&BiconicZernikeDefinition> for BiconicZernike {
    type Error = DefinitionError;

    fn try_from(written: &BiconicZernikeDefinition) -> Result<Self, DefinitionError> {
        let BiconicZernikeDefinition { radius_x_mm, radius_y_mm, conic_x, conic_y, .. } = *written;
        let zernike = ZernikeDefinition {
            numbering: written.numbering,
            normalisation_radius_mm: written.normalisation_radius_mm,
            coefficients_mm: written.coefficients_mm.clone(),
            normalisation: written.normalisation,
            base: None,
        };
        let biconic = BiconicDefinition { radius_x_mm, radius_y_mm, conic_x, conic_y };
        Ok(Self { biconic: Biconic::try_from(&biconic)?, zernike: Zernike::try_from(&zernike)? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::test_support::gradient_error;

    fn definition() -> BiconicZernikeDefinition {
        BiconicZernikeDefinition {
            radius_x_mm: 100.0,
            radius_y_mm: f64::INFINITY,
            conic_x: -1.0,
            conic_y: 0.0,
            numbering: ZernikeNumbering::Fringe,
            normalisation_radius_mm: 20.0,
            coefficients_mm: [("Z5".to_owned(), 0.01), ("9".to_owned(), -2e-3)].into(),
            normalisation: None,
        }
    }

    #[test]
    fn sum_by_hand() {
        let surface = BiconicZernike::try_from(&definition()).unwrap();
        // Parabola x^2 / 200; Z5 = u^2 cos 2t and Z9 = 6 u^4 - 6 u^2 + 1 at u = 0.5, t = 0.
        let (z, _) = surface.sag_and_gradient(10.0, 0.0).unwrap();
        assert!((z - (0.5 + 0.01 * 0.25 - 2e-3 * (0.375 - 1.5 + 1.0))).abs() < 1e-15);
        assert!(gradient_error(&|x, y| surface.sag_and_gradient(x, y), 19.0) < 1e-11);
        assert_eq!(surface.sag_and_gradient(31.0, 0.0), None);
        assert_eq!(surface.normalisation_radius_mm(), 20.0);
    }

    #[test]
    fn degenerate_values_are_refused() {
        let key = |written: &BiconicZernikeDefinition| BiconicZernike::try_from(written).unwrap_err().key();
        let bad = BiconicZernikeDefinition { radius_x_mm: 0.0, ..definition() };
        assert_eq!(key(&bad).as_deref(), Some("radius_x_mm"));
        let bad = BiconicZernikeDefinition { normalisation_radius_mm: -1.0, ..definition() };
        assert_eq!(key(&bad).as_deref(), Some("normalisation_radius_mm"));
        let bad = BiconicZernikeDefinition { coefficients_mm: [("Z38".to_owned(), 0.01)].into(), ..definition() };
        assert!(BiconicZernike::try_from(&bad).is_err());
    }
}
