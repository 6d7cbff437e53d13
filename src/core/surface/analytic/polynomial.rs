//! XY polynomial.

use serde::{Deserialize, Serialize};

use super::conic::{Conic, ConicDefinition};
use super::error::{self, DefinitionError};

/// Maximum power of x or y.
const MAX_POWER: u32 = 60;

/// XY polynomial: a conic plus a sum of products of powers, `z = conic + sum a_ij (x / Rn)^i (y / Rn)^j` with the
/// normalisation radius Rn.
///
/// The normalisation radius is only a unit of length: the polynomial is valid for all x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct XyPolynomial {
    base: Conic,
    normalisation_radius_mm: f64,
    /// Power of x, power of y, and coefficient in millimetres, for each term.
    terms: Vec<(u32, u32, f64)>,
}

/// Definition of an XY polynomial in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct XyPolynomialDefinition {
    /// Normalisation radius by which x and y are divided, in millimetres; 1 for coefficients in mm^(1 - i - j).
    pub normalisation_radius_mm: f64,
    /// Terms [i, j, coefficient in millimetres].
    #[cfg_attr(feature = "schema", schemars(schema_with = "terms_schema"))]
    pub terms: Vec<(u32, u32, f64)>,
    /// Conic to which the polynomial is added; a plane if it is not given.
    pub base: Option<ConicDefinition>,
}

/// Returns the JSON schema of the list of terms [i, j, coefficient], with powers i and j up to [`MAX_POWER`].
#[cfg(feature = "schema")]
fn terms_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
    let power = schemars::json_schema!({ "type": "integer", "minimum": 0, "maximum": MAX_POWER });
    let term = [power.clone(), power, schemars::json_schema!({ "type": "number" })];
    schemars::json_schema!({
        "type": "array",
        "items": { "type": "array", "prefixItems": term.as_slice(), "minItems": 3, "maxItems": 3 }
    })
}

impl XyPolynomial {
    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (x, y); `None` at the edge of the base conic and beyond.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let (sag, slope) = self.base.sag_and_derivative(x * x + y * y)?;
        let scale = 1.0 / self.normalisation_radius_mm;
        let (u, v) = (x * scale, y * scale);
        let (mut z, mut gx, mut gy) = (sag, 2.0 * x * slope, 2.0 * y * slope);
        for &(i, j, a) in &self.terms {
            let (ui, vj) = (u.powi(i as i32), v.powi(j as i32));
            z += a * ui * vj;
            if i > 0 {
                gx += a * f64::from(i) * u.powi(i as i32 - 1) * vj * scale;
            }
            if j > 0 {
                gy += a * f64::from(j) * v.powi(j as i32 - 1) * ui * scale;
            }
        }
        Some((z, [gx, gy]))
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time: the base conic and all
    /// powers.
    pub(super) fn term_count(&self) -> usize {
        1 + self.terms.len()
    }
}

impl TryFrom<&XyPolynomialDefinition> for XyPolynomial {
    type Error = DefinitionError;

    fn try_from(written: &XyPolynomialDefinition) -> Result<Self, DefinitionError> {
        let normalisation_radius_mm =
            error::check_positive("normalisation_radius_mm", written.normalisation_radius_mm)?;
        let mut terms = written.terms.clone();
        terms.sort_by_key(|term| (term.0, term.1));
        for (n, &(i, j, coefficient)) in terms.iter().enumerate() {
            let key = || format!("terms.[{i}, {j}]");
            if i.max(j) > MAX_POWER {
                let expected = "a term is [i, j, coefficient_mm] with powers from 0 to 60";
                return Err(DefinitionError::Term { key: key(), expected });
            }
            if n > 0 && (terms[n - 1].0, terms[n - 1].1) == (i, j) {
                return Err(DefinitionError::RepeatedTerm { key: key() });
            }
            error::check_finite(&key(), coefficient)?;
        }
        let base = super::conic::base_conic(written.base.as_ref())?;
        Ok(Self { base, normalisation_radius_mm, terms })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::test_support::{disc, gradient_error};

    fn polynomial(terms: &[(u32, u32, f64)], base: Option<ConicDefinition>) -> Result<XyPolynomial, DefinitionError> {
        let written = XyPolynomialDefinition { normalisation_radius_mm: 10.0, terms: terms.to_vec(), base };
        XyPolynomial::try_from(&written)
    }

    #[test]
    fn polynomial_terms_by_hand() {
        // u = 2, v = -1: 0.5 u^2 v + 3 v^3 = -2 - 3; slopes (u v, 0.5 u^2 + 9 v^2) / 10.
        let (z, [gx, gy]) =
            polynomial(&[(2, 1, 0.5), (0, 3, 3.0)], None).unwrap().sag_and_gradient(20.0, -10.0).unwrap();
        assert!((z + 5.0).abs() < 1e-15 && (gx + 0.2).abs() < 1e-16 && (gy - 1.1).abs() < 1e-15);
    }

    #[test]
    fn polynomial_without_terms_is_base() {
        let base = ConicDefinition { radius_mm: -70.0, conic: 0.5 };
        let conic = Conic::try_from(&base).unwrap();
        for [x, y] in disc(50.0) {
            let found = polynomial(&[], Some(base)).unwrap().sag_and_gradient(x, y).map(|(z, _)| z);
            assert_eq!(found, conic.sag_and_derivative(x * x + y * y).map(|(z, _)| z));
        }
    }

    #[test]
    fn polynomial_gradient_matches_sag() {
        let terms = [(0, 0, 1.0), (1, 0, 0.2), (0, 1, -0.1), (3, 2, 0.01), (0, 6, -0.004), (5, 5, 1e-4)];
        let surface = polynomial(&terms, Some(ConicDefinition { radius_mm: 200.0, conic: -1.2 })).unwrap();
        assert!(gradient_error(&|x, y| surface.sag_and_gradient(x, y), 15.0) < 1e-11);
    }

    #[test]
    fn polynomial_refuses_degenerate_values() {
        assert!(matches!(polynomial(&[(61, 0, 1.0)], None), Err(DefinitionError::Term { .. })));
        assert!(matches!(polynomial(&[(1, 2, 1.0), (1, 2, 1.0)], None), Err(DefinitionError::RepeatedTerm { .. })));
        let bad = polynomial(&[(1, 2, f64::NAN)], None).unwrap_err();
        assert_eq!(bad.key().as_deref(), Some("terms.[1, 2]"));
        let flat = ConicDefinition { radius_mm: 0.0, conic: 0.0 };
        assert_eq!(polynomial(&[], Some(flat)).unwrap_err().key().as_deref(), Some("base.radius_mm"));
        for normalisation_radius_mm in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let written = XyPolynomialDefinition { normalisation_radius_mm, terms: vec![], base: None };
            assert!(XyPolynomial::try_from(&written).is_err());
        }
    }
}
