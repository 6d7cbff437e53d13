//! Forbes' aspheres: Qcon for strong and Qbfs for mild aspheres.
//!
//! G. W. Forbes, Shape specification for axially symmetric optical surfaces, Opt. Express 15, 5218 (2007), and Robust,
//! efficient computational methods for axially symmetric optical aspheres, Opt. Express 18, 19700 (2010). With u = h /
//! Rn
//!
//! - Qcon: `z = conic + u^4 sum a_m Qcon_m(u^2)`, with Qcon_m(x) = P_m^(0, 4)(2x - 1);
//! - Qbfs: `z = sphere + u^2 (1 - u^2) / sqrt(1 - c^2 h^2) sum a_m Qbfs_m(u^2)`, the polynomials chosen so that the slope of the
//!   departure along the sphere's normal is orthonormal under the weight 1 / sqrt(1 - u^2).

use serde::{Deserialize, Serialize};

use super::conic::Conic;
use super::error::{self, DefinitionError};
use super::jacobi::{self, MAX_EXTRAPOLATION};

/// Maximum number of coefficients of one surface.
const MAX_COEFFICIENTS: usize = 200;

/// Qcon asphere: a conic plus a sum of Qcon polynomials.
#[derive(Clone, Debug, PartialEq)]
pub struct Qcon {
    base: Conic,
    pub(super) normalisation_radius_mm: f64,
    coefficients_mm: Vec<[f64; 1]>,
}

/// Definition of a Qcon asphere in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct QconDefinition {
    /// Radius of curvature at the vertex in millimetres, positive if the centre is at +z; `inf` for a flat surface.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_mm: f64,
    /// Conic constant.
    #[serde(default)]
    pub conic: f64,
    /// Normalisation radius Rn, at which u = h / Rn is 1, in millimetres.
    pub normalisation_radius_mm: f64,
    /// The coefficients a_0, a_1, ... in millimetres.
    pub coefficients_mm: Vec<f64>,
}

impl Qcon {
    /// Returns the sag z of the Qcon asphere and its derivative dz/dq, where `q` = h^2 and h is the distance from the
    /// axis. Returns `None` at the edge of the base conic (where its slope is infinite) and beyond. Also returns `None`
    /// farther than 1.5 normalisation radii from the axis.
    ///
    /// Units: `q` in mm^2, the sag in mm, the derivative in 1/mm.
    pub fn sag_and_derivative(&self, q: f64) -> Option<(f64, f64)> {
        let (sag, slope) = self.base.sag_and_derivative(q)?;
        let [v, per_mm2] = square(q, self.normalisation_radius_mm)?;
        let [(sum, sum_slope)] = jacobi::series(&self.coefficients_mm, 4, 2.0 * v - 1.0);
        Some((sag + v * v * sum, slope + 2.0 * v * (sum + v * sum_slope) * per_mm2))
    }

    /// Returns the number of terms that one evaluation of the sag sums, as a measure of its computing time: the base
    /// conic counts 1, and each coefficient counts 1.
    pub(super) fn term_count(&self) -> usize {
        1 + self.coefficients_mm.len()
    }
}

impl TryFrom<&QconDefinition> for Qcon {
    type Error = DefinitionError;

    fn try_from(written: &QconDefinition) -> Result<Self, DefinitionError> {
        Ok(Self {
            base: Conic::new(written.radius_mm, written.conic)?,
            normalisation_radius_mm: error::check_positive("normalisation_radius_mm", written.normalisation_radius_mm)?,
            coefficients_mm: check_coefficients(&written.coefficients_mm)?.iter().map(|&a| [a]).collect(),
        })
    }
}

/// Qbfs asphere: a best-fit sphere plus a sum of Qbfs polynomials.
#[derive(Clone, Debug, PartialEq)]
pub struct Qbfs {
    sphere: Conic,
    pub(super) normalisation_radius_mm: f64,
    /// Coefficients of the polynomials P_m of [`p_coefficients`], in millimetres.
    p_coefficients_mm: Vec<f64>,
}

/// Definition of a Qbfs asphere in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct QbfsDefinition {
    /// Radius of the best-fit sphere in millimetres, positive if the centre is at +z; `inf` for a plane.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_mm: f64,
    /// Normalisation radius Rn, at which u = h / Rn is 1, in millimetres.
    pub normalisation_radius_mm: f64,
    /// The coefficients a_0, a_1, ... in millimetres.
    pub coefficients_mm: Vec<f64>,
}

impl Qbfs {
    /// Returns the sag z of the Qbfs asphere and its derivative dz/dq, where `q` = h^2 and h is the distance from the
    /// axis. Returns `None` at the edge of the best-fit sphere (where its slope is infinite) and beyond. Also returns
    /// `None` farther than 1.5 normalisation radii from the axis.
    ///
    /// Units: `q` in mm^2, the sag in mm, the derivative in 1/mm.
    pub fn sag_and_derivative(&self, q: f64) -> Option<(f64, f64)> {
        let (sag, slope) = self.sphere.sag_and_derivative(q)?;
        let [v, per_mm2] = square(q, self.normalisation_radius_mm)?;
        let c = self.sphere.curvature_per_mm();
        let cosine = (1.0 - c * c * q).sqrt();
        let (sum, sum_slope) = p_series(&self.p_coefficients_mm, v);
        let bump = v * (1.0 - v) * sum;
        let bump_slope = ((1.0 - 2.0 * v) * sum + v * (1.0 - v) * sum_slope) * per_mm2;
        let steeper = 0.5 * c * c * bump / (cosine * cosine);
        Some((sag + bump / cosine, slope + (bump_slope + steeper) / cosine))
    }

    /// Returns the number of terms that one evaluation of the sag sums, as a measure of its computing time: the
    /// best-fit sphere counts 1, and each coefficient counts 1.
    pub(super) fn term_count(&self) -> usize {
        1 + self.p_coefficients_mm.len()
    }
}

impl TryFrom<&QbfsDefinition> for Qbfs {
    type Error = DefinitionError;

    fn try_from(written: &QbfsDefinition) -> Result<Self, DefinitionError> {
        Ok(Self {
            sphere: Conic::new(written.radius_mm, 0.0)?,
            normalisation_radius_mm: error::check_positive("normalisation_radius_mm", written.normalisation_radius_mm)?,
            p_coefficients_mm: p_coefficients(check_coefficients(&written.coefficients_mm)?),
        })
    }
}

/// Returns [u^2, d(u^2)/dq], where u = h / `normalisation_radius_mm`, h is the distance from the axis in mm, and `q` =
/// h^2 in mm^2. The derivative is in 1/mm^2. Returns `None` farther than 1.5 normalisation radii from the axis.
fn square(q: f64, normalisation_radius_mm: f64) -> Option<[f64; 2]> {
    let per_mm2 = 1.0 / (normalisation_radius_mm * normalisation_radius_mm);
    let v = q * per_mm2;
    (v <= MAX_EXTRAPOLATION * MAX_EXTRAPOLATION).then_some([v, per_mm2])
}

/// Returns the coefficients unchanged if there are at most 200 and all are finite.
///
/// # Errors
/// Returns an error that names the first coefficient that is not finite, or coefficient 200 (counted from 0) if there
/// are more than 200.
fn check_coefficients(coefficients_mm: &[f64]) -> Result<&[f64], DefinitionError> {
    let expected = "at most 200 coefficients are summed";
    if coefficients_mm.len() > MAX_COEFFICIENTS {
        return Err(DefinitionError::Term { key: format!("coefficients_mm.{MAX_COEFFICIENTS}"), expected });
    }
    for (m, &a) in coefficients_mm.iter().enumerate() {
        error::check_finite(&format!("coefficients_mm.{m}"), a)?;
    }
    Ok(coefficients_mm)
}

/// Converts the coefficients `a` of a series in the Forbes polynomials Qbfs_m to the coefficients of the same series in
/// the polynomials P_m, by Forbes 2010, eq. (A.13) to (A.16) and (3.8). Both lists start at m = 0 and have the same
/// length and unit.
///
/// The polynomials P_m are simpler to sum. With v = (h / normalisation radius)^2 and h the distance from the axis: P_0
/// = 2, P_1 = 6 - 8v, P_(m+1) = (2 - 4v) P_m - P_(m-1). [`p_series`] sums them.
///
/// P_m = f_m Qbfs_m + g_(m-1) Qbfs_(m-1) + h_(m-2) Qbfs_(m-2), with the constants f, g and h of Forbes. So the
/// coefficients of P are computed from the last one to the first.
fn p_coefficients(a: &[f64]) -> Vec<f64> {
    let count = a.len();
    let (mut f, mut g, mut h) = (vec![2.0, 19f64.sqrt() / 2.0], vec![-0.5], vec![]);
    for m in 2..count {
        let n = m as f64;
        h.push(-n * (n - 1.0) / (2.0 * f[m - 2]));
        g.push(-(1.0 + g[m - 2] * h[m - 2]) / f[m - 1]);
        f.push((n * (n + 1.0) + 3.0 - g[m - 1] * g[m - 1] - h[m - 2] * h[m - 2]).sqrt());
    }
    let mut b = vec![0.0; count];
    for m in (0..count).rev() {
        let above = if m + 1 < count { g[m] * b[m + 1] } else { 0.0 };
        let twice_above = if m + 2 < count { h[m] * b[m + 2] } else { 0.0 };
        b[m] = (a[m] - above - twice_above) / f[m];
    }
    b
}

/// Returns the sum of b_m P_m(v) over all m, and the derivative of this sum with respect to `v`. `b` contains the
/// coefficients b_m. Uses Clenshaw's recurrence, Forbes 2010, eq. (3.9) and (3.10).
///
/// P_0 = 2, P_1 = 6 - 8v, P_(m+1) = (2 - 4v) P_m - P_(m-1).
fn p_series(b: &[f64], v: f64) -> (f64, f64) {
    let factor = 2.0 - 4.0 * v;
    let [mut here, mut above] = [(0.0, 0.0); 2];
    for coefficient in b.iter().rev() {
        let next = (coefficient + factor * here.0 - above.0, factor * here.1 - 4.0 * here.0 - above.1);
        (above, here) = (here, next);
    }
    (2.0 * (here.0 + above.0), 2.0 * (here.1 + above.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::test_support::gradient_error;

    fn unit(m: usize) -> Vec<f64> {
        (0..=m).map(|i| f64::from(u8::from(i == m))).collect()
    }

    /// Qbfs_m(v) and its derivative.
    fn qbfs(m: usize, v: f64) -> (f64, f64) {
        p_series(&p_coefficients(&unit(m)), v)
    }

    #[test]
    fn forbes_polynomials_match_tables() {
        for i in 0..=20 {
            let x = f64::from(i) / 20.0;
            for (m, expected) in [
                (0, 1.0),
                (1, (13.0 - 16.0 * x) / 19f64.sqrt()),
                (2, (2.0 / 95f64).sqrt() * (29.0 - 4.0 * x * (25.0 - 19.0 * x))),
                (3, (2.0 / 2545f64).sqrt() * (207.0 - 4.0 * x * (315.0 - x * (577.0 - 320.0 * x)))),
            ] {
                assert!((qbfs(m, x).0 - expected).abs() < 1e-13, "Qbfs_{m}({x})");
            }
            let con: Vec<[f64; 1]> = unit(3).iter().map(|&a| [a]).collect();
            let [(value, _)] = jacobi::series(&con, 4, 2.0 * x - 1.0);
            let expected = -(35.0 - 12.0 * x * (14.0 - x * (21.0 - 10.0 * x)));
            assert!((value - expected).abs() < 1e-13, "Qcon_3({x}): {value} {expected}");
        }
    }

    #[test]
    fn qbfs_slopes_are_orthonormal() {
        // With u = sin(t) the weight 1 / sqrt(1 - u^2) is that of equidistant t; the integrand is a polynomial in
        // cos(2t).
        let count = 200;
        for m in 0..20 {
            for n in 0..=m {
                let sum: f64 = (0..count)
                    .map(|i| {
                        let u = (std::f64::consts::FRAC_PI_2 * (f64::from(i) + 0.5) / f64::from(count)).sin();
                        let slope = |m| {
                            let (value, derivative) = qbfs(m, u * u);
                            2.0 * u * ((1.0 - 2.0 * u * u) * value + u * u * (1.0 - u * u) * derivative)
                        };
                        slope(m) * slope(n) / f64::from(count)
                    })
                    .sum();
                assert!((sum - f64::from(u8::from(m == n))).abs() < 1e-11, "{m} {n}: {sum}");
            }
        }
    }

    #[test]
    fn forbes_terms_by_hand() {
        let con = QconDefinition {
            radius_mm: f64::INFINITY,
            conic: 0.0,
            normalisation_radius_mm: 10.0,
            coefficients_mm: vec![0.0, 0.5],
        };
        // u^2 = 1/2: 1/4 * 0.5 * (6/2 - 5).
        assert!((Qcon::try_from(&con).unwrap().sag_and_derivative(50.0).unwrap().0 + 0.25).abs() < 1e-16);
        let bfs = QbfsDefinition { radius_mm: 10.0, normalisation_radius_mm: 8.0, coefficients_mm: vec![0.01] };
        // h = 6: sphere 2, cosine 0.8, u^2 = 9/16.
        let expected = 2.0 + 0.01 * 9.0 / 16.0 * 7.0 / 16.0 / 0.8;
        assert!((Qbfs::try_from(&bfs).unwrap().sag_and_derivative(36.0).unwrap().0 - expected).abs() < 1e-15);
    }

    #[test]
    fn forbes_without_terms_is_base_conic() {
        let con =
            QconDefinition { radius_mm: 50.0, conic: -2.0, normalisation_radius_mm: 30.0, coefficients_mm: vec![] };
        assert_eq!(
            Qcon::try_from(&con).unwrap().sag_and_derivative(400.0),
            Conic::new(50.0, -2.0).unwrap().sag_and_derivative(400.0)
        );
        let sphere = Conic::new(50.0, 0.0).unwrap();
        let mut bfs = QbfsDefinition { radius_mm: 50.0, normalisation_radius_mm: 30.0, coefficients_mm: vec![] };
        assert_eq!(Qbfs::try_from(&bfs).unwrap().sag_and_derivative(400.0), sphere.sag_and_derivative(400.0));
        bfs.coefficients_mm = vec![0.3, -0.2, 0.1];
        let departing = Qbfs::try_from(&bfs).unwrap();
        assert_eq!(departing.sag_and_derivative(900.0).unwrap().0, sphere.sag_and_derivative(900.0).unwrap().0);
        assert_eq!(departing.sag_and_derivative(0.0).unwrap().0, 0.0);
        assert_eq!(departing.sag_and_derivative(46.0 * 46.0), None);
    }

    #[test]
    fn forbes_derivatives_match_sag() {
        let coefficients_mm: Vec<f64> = (0..8).map(|m| 0.02 / f64::from(m + 1)).collect();
        let con = Qcon::try_from(&QconDefinition {
            radius_mm: -60.0,
            conic: 0.4,
            normalisation_radius_mm: 30.0,
            coefficients_mm: coefficients_mm.clone(),
        });
        let bfs = Qbfs::try_from(&QbfsDefinition { radius_mm: -60.0, normalisation_radius_mm: 30.0, coefficients_mm });
        let (con, bfs) = (con.unwrap(), bfs.unwrap());
        let radial = |x: f64, y: f64, slope: f64| [2.0 * x * slope, 2.0 * y * slope];
        let con = |x: f64, y: f64| con.sag_and_derivative(x * x + y * y).map(|(z, slope)| (z, radial(x, y, slope)));
        let bfs = |x: f64, y: f64| bfs.sag_and_derivative(x * x + y * y).map(|(z, slope)| (z, radial(x, y, slope)));
        assert!(gradient_error(&con, 29.9) < 1e-9, "{}", gradient_error(&con, 29.9));
        assert!(gradient_error(&bfs, 29.9) < 1e-9, "{}", gradient_error(&bfs, 29.9));
    }

    #[test]
    fn forbes_refuses_degenerate_values() {
        let good = QbfsDefinition { radius_mm: 10.0, normalisation_radius_mm: 8.0, coefficients_mm: vec![0.01] };
        for (bad, name) in [
            (QbfsDefinition { radius_mm: 0.0, ..good.clone() }, "radius_mm"),
            (QbfsDefinition { normalisation_radius_mm: -8.0, ..good.clone() }, "normalisation_radius_mm"),
            (QbfsDefinition { coefficients_mm: vec![0.0, f64::NAN], ..good.clone() }, "coefficients_mm.1"),
            (QbfsDefinition { coefficients_mm: vec![0.0; 201], ..good }, "coefficients_mm.200"),
        ] {
            assert_eq!(Qbfs::try_from(&bad).unwrap_err().key().as_deref(), Some(name));
        }
    }
}
