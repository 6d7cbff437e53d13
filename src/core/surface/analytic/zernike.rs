//! Zernike polynomials, in the three usual numberings.
//!
//! With rho = h / Rn and the azimuth theta counted from x towards y, a term of degree n and azimuthal order m is
//! R_n^|m|(rho) cos(m theta) for m >= 0 and R_n^|m|(rho) sin(|m| theta) for m < 0, where R_n^m(1) = 1. Noll's (1976)
//! and the ANSI Z80.28 terms carry the factor sqrt(n + 1), times sqrt(2) unless m is 0, which makes their mean square
//! over the disc 1; the Fringe terms carry none.
//!
//! R_n^m(rho) = rho^m P_k^(0, m)(2 rho^2 - 1) with k = (n - m) / 2, and rho^m cos(m theta), rho^m sin(m theta) are the
//! real and imaginary part of (u + i v)^m: everything is a polynomial in u = x / Rn, v = y / Rn, without a special case
//! on the axis.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::conic::{self, Conic, ConicDefinition};
use super::error::{self, DefinitionError};
use super::jacobi::{self, MAX_EXTRAPOLATION};

/// Maximum degree n.
const MAX_DEGREE: u32 = 100;

/// Numbering of the terms: which degree and azimuthal order belong to an index.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum ZernikeNumbering {
    /// Noll 1976, from 1; orthonormal by default.
    Noll,
    /// ANSI Z80.28 and ISO 24157, from 0; orthonormal by default.
    Ansi,
    /// University of Arizona "Fringe", 1 to 37, where 37 is the term of degree 12 on the axis; unnormalised by default.
    Fringe,
}

impl ZernikeNumbering {
    /// Returns the degree n and the azimuthal order m of the term with this index; m is negative for a sine. Returns
    /// `None` if the numbering has no such index, or if n exceeds 100.
    pub fn degree_and_order(self, index: u32) -> Option<(u32, i32)> {
        let (n, m) = match self {
            Self::Noll => noll(index)?,
            Self::Ansi => ansi(index)?,
            Self::Fringe => fringe(index)?,
        };
        (n <= MAX_DEGREE).then_some((n, m))
    }

    /// Returns the normalisation that applies if a definition gives none: orthonormal for Noll and ANSI, unnormalised
    /// for Fringe.
    fn normalisation(self) -> ZernikeNormalisation {
        match self {
            Self::Noll | Self::Ansi => ZernikeNormalisation::Orthonormal,
            Self::Fringe => ZernikeNormalisation::Unnormalised,
        }
    }
}

/// Normalisation of a term.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum ZernikeNormalisation {
    /// Mean square 1 over the disc.
    Orthonormal,
    /// Radial part 1 at the rim.
    Unnormalised,
}

/// Zernike surface: a conic plus a sum of Zernike polynomials.
#[derive(Clone, Debug, PartialEq)]
pub struct Zernike {
    base: Conic,
    pub(super) normalisation_radius_mm: f64,
    /// Azimuthal order m, and the coefficients of cosine and sine in millimetres for k = (n - m) / 2 from 0 up.
    orders: Vec<(u32, Vec<[f64; 2]>)>,
}

/// Definition of a Zernike surface in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ZernikeDefinition {
    /// Numbering of the coefficients.
    pub numbering: ZernikeNumbering,
    /// Normalisation radius: radius of the disc in millimetres.
    pub normalisation_radius_mm: f64,
    /// Coefficient by index, `{ Z4 = 1e-3 }` or `{ 4 = 1e-3 }`, in millimetres.
    pub coefficients_mm: BTreeMap<String, f64>,
    /// Normalisation of the terms; the default of the numbering if it is not given.
    pub normalisation: Option<ZernikeNormalisation>,
    /// Conic to which the polynomials are added; a plane if it is not given.
    pub base: Option<ConicDefinition>,
}

impl Zernike {
    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (x, y). Returns `None` at the edge of the base conic and
    /// beyond, and farther than 1.5 normalisation radii from the axis.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let (sag, slope) = self.base.sag_and_derivative(x * x + y * y)?;
        let scale = 1.0 / self.normalisation_radius_mm;
        let (u, v) = (x * scale, y * scale);
        let q = u * u + v * v;
        if q.is_nan() || q > MAX_EXTRAPOLATION * MAX_EXTRAPOLATION {
            return None;
        }
        let (mut z, mut gu, mut gv) = (0.0, 0.0, 0.0);
        // (u + i v)^m and the power before it, which is its derivative but for the factor m.
        let [mut below, mut power, mut order] = [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]];
        for (m, coefficients) in &self.orders {
            while order[0] < f64::from(*m) {
                (below, power) = (power, [power[0] * u - power[1] * v, power[0] * v + power[1] * u]);
                order[0] += 1.0;
            }
            let [cosine, sine] = jacobi::series(coefficients, *m, 2.0 * q - 1.0);
            z += cosine.0 * power[0] + sine.0 * power[1];
            let radial = 4.0 * (cosine.1 * power[0] + sine.1 * power[1]);
            gu += radial * u + order[0] * (cosine.0 * below[0] + sine.0 * below[1]);
            gv += radial * v + order[0] * (sine.0 * below[0] - cosine.0 * below[1]);
        }
        Some((sag + z, [2.0 * x * slope + gu * scale, 2.0 * y * slope + gv * scale]))
    }

    /// Returns the number of terms that one evaluation of the sag sums, as a measure of its time. The base conic counts
    /// 1. For each |m| in use, every degree n up to the highest given one counts 2: a cosine and a sine.
    pub(super) fn term_count(&self) -> usize {
        1 + self.orders.iter().map(|(_, coefficients)| 2 * coefficients.len()).sum::<usize>()
    }
}

impl TryFrom<&ZernikeDefinition> for Zernike {
    type Error = DefinitionError;

    fn try_from(written: &ZernikeDefinition) -> Result<Self, DefinitionError> {
        let expected = "a coefficient is named by its index, as in `Z4` or `4`: from 1 in the noll numbering, from 0 in ansi, \
                        from 1 to 37 in fringe, of a degree up to 100";
        let normalisation = written.normalisation.unwrap_or(written.numbering.normalisation());
        let mut orders: BTreeMap<u32, Vec<[f64; 2]>> = BTreeMap::new();
        for (index, coefficient) in
            conic::parse_coefficients("coefficients_mm", 'Z', expected, &written.coefficients_mm)?
        {
            let Some((n, m)) = written.numbering.degree_and_order(index) else {
                return Err(DefinitionError::Term { key: format!("coefficients_mm.{index}"), expected });
            };
            let factor = match normalisation {
                ZernikeNormalisation::Unnormalised => 1.0,
                ZernikeNormalisation::Orthonormal => (f64::from(n + 1) * if m == 0 { 1.0 } else { 2.0 }).sqrt(),
            };
            let row = orders.entry(m.unsigned_abs()).or_default();
            let k = ((n - m.unsigned_abs()) / 2) as usize;
            row.resize(row.len().max(k + 1), [0.0; 2]);
            row[k][usize::from(m < 0)] = factor * coefficient;
        }
        Ok(Self {
            base: conic::base_conic(written.base.as_ref())?,
            normalisation_radius_mm: error::check_positive("normalisation_radius_mm", written.normalisation_radius_mm)?,
            orders: orders.into_iter().collect(),
        })
    }
}

/// Returns the degree n and the azimuthal order m of the term number `index` in Noll's numbering, which starts at 1.
/// Returns `None` for index 0.
///
/// The terms are sorted by n, then by |m|. If m is not 0, an even index is a cosine (m > 0) and an odd index is a sine
/// (m < 0).
fn noll(index: u32) -> Option<(u32, i32)> {
    let (n, place) = triangular(index.checked_sub(1)?);
    let m = if n % 2 == 0 { place.div_ceil(2) * 2 } else { place / 2 * 2 + 1 };
    Some((n, if index.is_multiple_of(2) { m as i32 } else { -(m as i32) }))
}

/// Returns the degree n and the azimuthal order m of the term number `index` in the ANSI numbering, which starts at 0.
/// Never returns `None`. The terms are sorted by n. Within a degree, m rises from -n to n in steps of 2.
fn ansi(index: u32) -> Option<(u32, i32)> {
    let (n, place) = triangular(index);
    Some((n, 2 * place as i32 - n as i32))
}

/// Returns the degree n and the azimuthal order m of an index in the Fringe numbering; `None` outside 1 to 37. The
/// terms are sorted by (n + |m|) / 2, then by falling |m|; the cosine precedes the sine.
fn fringe(index: u32) -> Option<(u32, i32)> {
    // The set stops after (n + |m|) / 2 = 5 and adds one more spherical term.
    if index == 37 {
        return Some((12, 0));
    }
    let place = index.checked_sub(1).filter(|&place| place < 36)?;
    let group = place.isqrt();
    let rest = place - group * group;
    let m = group - rest / 2;
    Some((2 * group - m, if rest % 2 == 0 { m as i32 } else { -(m as i32) }))
}

/// Returns the row of element `place`, and the position of the element in its row. The elements form a triangle whose
/// rows have 1, 2, 3, ... elements, and are numbered row by row. Elements, rows and positions are counted from 0.
fn triangular(place: u32) -> (u32, u32) {
    let row = ((8 * u64::from(place) + 1).isqrt() - 1) / 2;
    (row as u32, (u64::from(place) - row * (row + 1) / 2) as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::test_support::{disc, gradient_error};

    fn surface(numbering: ZernikeNumbering, terms: &[(u32, f64)]) -> Zernike {
        let written = ZernikeDefinition {
            numbering,
            normalisation_radius_mm: 20.0,
            coefficients_mm: terms.iter().map(|(j, c)| (j.to_string(), *c)).collect(),
            normalisation: None,
            base: None,
        };
        Zernike::try_from(&written).unwrap()
    }

    #[test]
    fn zernike_indices_match_tables() {
        // Numbering and first index, then the degrees and the azimuthal orders.
        let tables = [
            (
                ZernikeNumbering::Noll,
                1,
                [0, 1, 1, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4],
                [0, 1, -1, 0, -2, 2, -1, 1, -3, 3, 0, 2, -2, 4, -4],
            ),
            (
                ZernikeNumbering::Ansi,
                0,
                [0, 1, 1, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 4],
                [0, -1, 1, -2, 0, 2, -3, -1, 1, 3, -4, -2, 0, 2, 4],
            ),
            (
                ZernikeNumbering::Fringe,
                1,
                [0, 1, 1, 2, 2, 2, 3, 3, 4, 3, 3, 4, 4, 5, 5],
                [0, 1, -1, 0, 2, -2, 1, -1, 0, 3, -3, 2, -2, 1, -1],
            ),
        ];
        for (numbering, first, degrees, orders) in tables {
            for (index, term) in (first..).zip(degrees.into_iter().zip(orders)) {
                assert_eq!(numbering.degree_and_order(index), Some(term), "{numbering:?} {index}");
            }
        }
        // The last of each group, and the one that breaks the rule.
        for (index, term) in [(16, (6, 0)), (25, (8, 0)), (36, (10, 0)), (37, (12, 0)), (26, (5, 5)), (35, (9, -1))] {
            assert_eq!(ZernikeNumbering::Fringe.degree_and_order(index), Some(term));
        }
        assert_eq!(ZernikeNumbering::Noll.degree_and_order(22), Some((6, 0)));
        assert_eq!(ZernikeNumbering::Noll.degree_and_order(36), Some((7, 7)));
    }

    #[test]
    fn zernike_indices_without_term() {
        assert_eq!(ZernikeNumbering::Noll.degree_and_order(0), None);
        assert_eq!(ZernikeNumbering::Fringe.degree_and_order(0), None);
        assert_eq!(ZernikeNumbering::Fringe.degree_and_order(38), None);
        for numbering in [ZernikeNumbering::Noll, ZernikeNumbering::Ansi] {
            assert_eq!(numbering.degree_and_order(u32::MAX), None);
        }
    }

    #[test]
    fn zernike_terms_by_hand() {
        // At (12, 16) on a radius of 20: rho = 1, cos = 0.6, sin = 0.8; at (6, 8) rho = 1/2.
        let at = |numbering, index, x, y| surface(numbering, &[(index, 1.0)]).sag_and_gradient(x, y).unwrap().0;
        use ZernikeNumbering::{Ansi, Fringe, Noll};
        for (found, expected) in [
            (at(Noll, 4, 6.0, 8.0), 3f64.sqrt() * -0.5),
            (at(Noll, 5, 12.0, 16.0), 6f64.sqrt() * 0.96),
            (at(Noll, 6, 12.0, 16.0), 6f64.sqrt() * -0.28),
            (at(Noll, 8, 6.0, 8.0), 8f64.sqrt() * (3.0 / 8.0 - 1.0) * 0.6),
            (at(Ansi, 1, 12.0, 16.0), 2.0 * 0.8),
            (at(Ansi, 12, 6.0, 8.0), 5f64.sqrt() * (6.0 / 16.0 - 6.0 / 4.0 + 1.0)),
            (at(Fringe, 9, 6.0, 8.0), 6.0 / 16.0 - 6.0 / 4.0 + 1.0),
            (at(Fringe, 12, 6.0, 8.0), (4.0 / 16.0 - 3.0 / 4.0) * -0.28),
            (at(Fringe, 37, 12.0, 16.0), 1.0),
        ] {
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
    }

    #[test]
    fn noll_and_ansi_are_orthonormal() {
        // Exact quadrature for degree 16: equidistant azimuths and Gauss-Legendre nodes in rho^2, here by Newton's
        // method.
        let nodes: Vec<(f64, f64)> = (1..=12)
            .map(|i| {
                let last: Vec<[f64; 1]> = (0..=12).map(|k| [f64::from(k == 12)]).collect();
                let mut t = (std::f64::consts::PI * (i as f64 - 0.25) / 12.5).cos();
                for _ in 0..10 {
                    let [(p, dp)] = jacobi::series(&last, 0, t);
                    t -= p / dp;
                }
                let [(_, dp)] = jacobi::series(&last, 0, t);
                (0.5 * (t + 1.0), 1.0 / ((1.0 - t * t) * dp * dp))
            })
            .collect();
        for numbering in [ZernikeNumbering::Noll, ZernikeNumbering::Ansi] {
            let terms: Vec<_> = (1..=36).map(|j| surface(numbering, &[(j, 1.0)])).collect();
            let mut gram = vec![[0.0; 36]; 36];
            for i in 0..40 {
                let (sine, cosine) = (std::f64::consts::TAU * f64::from(i) / 40.0).sin_cos();
                for (q, weight) in &nodes {
                    let h = 20.0 * q.sqrt();
                    let values: Vec<f64> =
                        terms.iter().map(|s| s.sag_and_gradient(h * cosine, h * sine).unwrap().0).collect();
                    for (row, a) in gram.iter_mut().zip(&values) {
                        row.iter_mut().zip(&values).for_each(|(sum, b)| *sum += weight / 40.0 * a * b);
                    }
                }
            }
            for (i, row) in gram.iter().enumerate() {
                for (j, sum) in row.iter().enumerate() {
                    let expected = f64::from(u8::from(i == j));
                    assert!((sum - expected).abs() < 1e-12, "{numbering:?} {} {}: {sum}", i + 1, j + 1);
                }
            }
        }
    }

    #[test]
    fn defocus_is_a_paraboloid() {
        // 2 rho^2 - 1 less its piston is x^2 / 2R with R = Rn^2 / 4 c.
        let defocus = surface(ZernikeNumbering::Fringe, &[(4, 0.5), (1, 0.5)]);
        let paraboloid = Conic::new(200.0, -1.0).unwrap();
        for [x, y] in disc(20.0) {
            let (z, [gx, _]) = defocus.sag_and_gradient(x, y).unwrap();
            let (sag, slope) = paraboloid.sag_and_derivative(x * x + y * y).unwrap();
            assert!((z - sag).abs() < 1e-15 && (gx - 2.0 * x * slope).abs() < 1e-15);
        }
    }

    #[test]
    fn zernike_gradients_match_sag() {
        for (numbering, first) in
            [(ZernikeNumbering::Noll, 1), (ZernikeNumbering::Ansi, 0), (ZernikeNumbering::Fringe, 1)]
        {
            let all: Vec<_> = (first..37).map(|j| (j, 0.01 / f64::from(j + 1))).collect();
            let mut zernike = surface(numbering, &all);
            zernike.base = Conic::new(90.0, -0.3).unwrap();
            assert!(gradient_error(&|x, y| zernike.sag_and_gradient(x, y), 19.9) < 1e-11);
        }
        // ANSI 5100 is (100, 0): 1 at the rim and on the axis but for its factor sqrt(101).
        let high = surface(ZernikeNumbering::Ansi, &[(5100, 1.0)]);
        for x in [0.0, 20.0] {
            assert!((high.sag_and_gradient(x, 0.0).unwrap().0 - 101f64.sqrt()).abs() < 1e-10);
        }
    }

    #[test]
    fn zernike_ends_beyond_radius() {
        let tilt = surface(ZernikeNumbering::Noll, &[(2, 1.0)]);
        assert!(tilt.sag_and_gradient(29.9, 0.0).is_some());
        assert_eq!(tilt.sag_and_gradient(30.1, 0.0), None);
        assert_eq!(tilt.sag_and_gradient(f64::NAN, 0.0), None);
    }

    #[test]
    fn zernike_refuses_bad_indices() {
        for (numbering, key) in [
            (ZernikeNumbering::Noll, "0"),
            (ZernikeNumbering::Fringe, "Z38"),
            (ZernikeNumbering::Ansi, "-1"),
            (ZernikeNumbering::Ansi, "Z1.5"),
        ] {
            let written = ZernikeDefinition {
                numbering,
                normalisation_radius_mm: 20.0,
                coefficients_mm: [(key.to_owned(), 1.0)].into(),
                normalisation: None,
                base: None,
            };
            assert!(matches!(Zernike::try_from(&written), Err(DefinitionError::Term { .. })), "{key}");
        }
    }
}
