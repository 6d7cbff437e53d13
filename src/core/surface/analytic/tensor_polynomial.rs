//! Products of Chebyshev or Legendre polynomials in x and y.

use serde::{Deserialize, Serialize};

use super::conic::{Conic, ConicDefinition};
use super::error::{self, DefinitionError};

/// Maximum degree in x or y.
const MAX_DEGREE: u32 = 60;

/// Family of the polynomials.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolynomialFamily {
    /// Chebyshev polynomials of the first kind: T_0 = 1, T_1 = t, T_(n+1) = 2 t T_n - T_(n-1).
    Chebyshev,
    /// Legendre polynomials: P_0 = 1, P_1 = t, (n+1) P_(n+1) = (2n+1) t P_n - n P_(n-1).
    Legendre,
}

/// Conic plus a sum of products of polynomials: `z = conic + sum a_ij P_i(x / Nx) P_j(y / Ny)`.
///
/// The polynomials are orthogonal over the rectangle of the half-widths Nx and Ny, and are valid for all x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct TensorPolynomial {
    family: PolynomialFamily,
    base: Conic,
    half_widths_mm: [f64; 2],
    /// Degree in x, degree in y, and coefficient in millimetres, for each term.
    terms: Vec<(u32, u32, f64)>,
    /// Largest degrees in x and y.
    degrees: [u32; 2],
}

/// Definition of a sum of products of polynomials in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TensorPolynomialDefinition {
    /// Half-widths Nx and Ny by which x and y are divided, in millimetres.
    pub half_widths_mm: [f64; 2],
    /// Terms [i, j, coefficient in millimetres], with degrees i in x and j in y.
    #[cfg_attr(feature = "schema", schemars(schema_with = "terms_schema"))]
    pub terms: Vec<(u32, u32, f64)>,
    /// Conic to which the polynomials are added; a plane if it is not given.
    pub base: Option<ConicDefinition>,
}

#[cfg(feature = "schema")]
fn terms_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
    let degree = schemars::json_schema!({ "type": "integer", "minimum": 0, "maximum": MAX_DEGREE });
    let term = [degree.clone(), degree, schemars::json_schema!({ "type": "number" })];
    schemars::json_schema!({
        "type": "array",
        "items": { "type": "array", "prefixItems": term.as_slice(), "minItems": 3, "maxItems": 3 }
    })
}

impl TensorPolynomial {
    /// Checks a definition.
    ///
    /// # Errors
    /// Returns an error about the first half-width, degree or coefficient that is not valid, or a term that is repeated.
    pub fn new(family: PolynomialFamily, written: &TensorPolynomialDefinition) -> Result<Self, DefinitionError> {
        let mut half_widths_mm = [0.0; 2];
        for (k, half_width_mm) in half_widths_mm.iter_mut().enumerate() {
            *half_width_mm = error::check_positive(&format!("half_widths_mm.{k}"), written.half_widths_mm[k])?;
        }
        let mut terms = written.terms.clone();
        terms.sort_by_key(|term| (term.0, term.1));
        for (n, &(i, j, coefficient)) in terms.iter().enumerate() {
            let key = || format!("terms.[{i}, {j}]");
            if i.max(j) > MAX_DEGREE {
                let expected = "a term is [i, j, coefficient_mm] with degrees from 0 to 60";
                return Err(DefinitionError::Term { key: key(), expected });
            }
            if n > 0 && (terms[n - 1].0, terms[n - 1].1) == (i, j) {
                return Err(DefinitionError::RepeatedTerm { key: key() });
            }
            error::check_finite(&key(), coefficient)?;
        }
        let largest = |degree: fn(&(u32, u32, f64)) -> u32| terms.iter().map(degree).max().unwrap_or(0);
        let degrees = [largest(|term| term.0), largest(|term| term.1)];
        let base = super::conic::base_conic(written.base.as_ref())?;
        Ok(Self { family, base, half_widths_mm, terms, degrees })
    }

    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (x, y); `None` at the edge of the base conic and beyond.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let (sag, slope) = self.base.sag_and_derivative(x * x + y * y)?;
        let [nx, ny] = self.half_widths_mm;
        let [px, py] = [(x / nx, self.degrees[0]), (y / ny, self.degrees[1])].map(|(t, degree)| self.values(t, degree));
        let (mut z, mut gx, mut gy) = (sag, 2.0 * x * slope, 2.0 * y * slope);
        for &(i, j, a) in &self.terms {
            let ((p, dp), (q, dq)) = (px[i as usize], py[j as usize]);
            z += a * p * q;
            gx += a * dp * q / nx;
            gy += a * p * dq / ny;
        }
        Some((z, [gx, gy]))
    }

    /// Returns the polynomials up to a degree at `t`, with their derivatives.
    fn values(&self, t: f64, degree: u32) -> [(f64, f64); MAX_DEGREE as usize + 1] {
        let mut values = [(0.0, 0.0); MAX_DEGREE as usize + 1];
        values[0] = (1.0, 0.0);
        values[1] = (t, 1.0);
        for n in 1..degree as usize {
            let (before, here) = (values[n - 1], values[n]);
            let m = n as f64;
            let [a, b] = match self.family {
                PolynomialFamily::Chebyshev => [2.0, 1.0],
                PolynomialFamily::Legendre => [(2.0 * m + 1.0) / (m + 1.0), m / (m + 1.0)],
            };
            values[n + 1] = (a * t * here.0 - b * before.0, a * (here.0 + t * here.1) - b * before.1);
        }
        values
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time.
    pub(super) fn term_count(&self) -> usize {
        1 + self.terms.len() + self.degrees.iter().sum::<u32>() as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::test_support::gradient_error;

    fn surface(family: PolynomialFamily, terms: &[(u32, u32, f64)]) -> Result<TensorPolynomial, DefinitionError> {
        let base = Some(ConicDefinition { radius_mm: 300.0, conic: -0.5 });
        let written = TensorPolynomialDefinition { half_widths_mm: [20.0, 10.0], terms: terms.to_vec(), base };
        TensorPolynomial::new(family, &written)
    }

    fn flat(family: PolynomialFamily, i: u32, j: u32) -> TensorPolynomial {
        let written = TensorPolynomialDefinition { half_widths_mm: [20.0, 10.0], terms: vec![(i, j, 1.0)], base: None };
        TensorPolynomial::new(family, &written).unwrap()
    }

    #[test]
    fn polynomials_by_hand() {
        // At t = 0.6 and u = -0.3: T_3 = 4 t^3 - 3 t, T_4 = 8 u^4 - 8 u^2 + 1; P_3 = (5 t^3 - 3 t) / 2,
        // P_4 = (35 u^4 - 30 u^2 + 3) / 8.
        let chebyshev = flat(PolynomialFamily::Chebyshev, 3, 4).sag_and_gradient(12.0, -3.0).unwrap();
        assert!((chebyshev.0 - (4.0 * 0.216 - 1.8) * (8.0 * 0.0081 - 0.72 + 1.0)).abs() < 1e-15);
        assert!((chebyshev.1[0] - (12.0 * 0.36 - 3.0) / 20.0 * 0.3448).abs() < 1e-15);
        let legendre = flat(PolynomialFamily::Legendre, 3, 4).sag_and_gradient(12.0, -3.0).unwrap();
        assert!((legendre.0 - 0.5 * (5.0 * 0.216 - 1.8) * (35.0 * 0.0081 - 2.7 + 3.0) / 8.0).abs() < 1e-15);
    }

    #[test]
    fn values_at_ends_are_one() {
        for family in [PolynomialFamily::Chebyshev, PolynomialFamily::Legendre] {
            for degree in [0, 1, 2, 7, 60] {
                let at = |x: f64| flat(family, degree, 0).sag_and_gradient(x, 0.0).unwrap().0;
                assert!((at(20.0) - 1.0).abs() < 1e-12);
                assert!((at(-20.0) - if degree % 2 == 0 { 1.0 } else { -1.0 }).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn gradient_matches_sag() {
        let terms = [(0, 0, 1.0), (1, 0, 0.2), (0, 1, -0.1), (3, 2, 0.01), (0, 6, -0.004), (5, 5, 1e-4)];
        for family in [PolynomialFamily::Chebyshev, PolynomialFamily::Legendre] {
            let surface = surface(family, &terms).unwrap();
            assert!(gradient_error(&|x, y| surface.sag_and_gradient(x, y), 9.0) < 1e-10);
        }
    }

    #[test]
    fn degenerate_values_are_refused() {
        let family = PolynomialFamily::Legendre;
        assert!(matches!(surface(family, &[(61, 0, 1.0)]), Err(DefinitionError::Term { .. })));
        assert!(matches!(surface(family, &[(1, 2, 1.0), (1, 2, 1.0)]), Err(DefinitionError::RepeatedTerm { .. })));
        assert!(surface(family, &[(1, 2, f64::NAN)]).is_err());
        let written = TensorPolynomialDefinition { half_widths_mm: [1.0, 0.0], terms: vec![], base: None };
        let error = TensorPolynomial::new(family, &written).unwrap_err();
        assert_eq!(error.key().as_deref(), Some("half_widths_mm.1"));
    }
}
