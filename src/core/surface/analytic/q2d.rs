//! Forbes' polynomials for freeform surfaces.
//!
//! G. W. Forbes, Characterizing the shape of freeform optics, Opt. Express 20, 2483 (2012). With u = h / Rn, the azimuth t
//! and phi = sqrt(1 - c^2 h^2),
//!
//! `z = sphere + (u^2 (1 - u^2) sum a_n^0 Q_n^0(u^2) + sum_m u^m sum_n (a_n^m cos(m t) + b_n^m sin(m t)) Q_n^m(u^2)) / phi`.
//!
//! Q_n^0 is the Qbfs polynomial. The others come from auxiliary polynomials P_n^m by P_n = f_n Q_n + g_(n-1) Q_(n-1).

use serde::{Deserialize, Serialize};

use super::error::{self, DefinitionError};
use super::forbes::{Qbfs, QbfsDefinition};

/// Maximum azimuthal order m.
const MAX_ORDER: u32 = 60;

/// Maximum radial order n.
const MAX_RADIAL: u32 = 60;

/// Q2D surface: a sphere plus a sum of freeform polynomials.
#[derive(Clone, Debug, PartialEq)]
pub struct Q2d {
    symmetric: Qbfs,
    curvature_per_mm: f64,
    pub(super) normalisation_radius_mm: f64,
    orders: Vec<Order>,
}

/// Terms of one azimuthal order.
#[derive(Clone, Debug, PartialEq)]
struct Order {
    m: u32,
    /// Coefficients [cosine, sine] of the polynomials P_n^m in millimetres.
    coefficients_mm: Vec<[f64; 2]>,
}

/// Definition of a Q2D surface in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Q2dDefinition {
    /// Radius of the best-fit sphere in millimetres, positive if the centre is at +z; `inf` for a plane.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_mm: f64,
    /// Normalisation radius Rn, at which u = h / Rn is 1, in millimetres.
    pub normalisation_radius_mm: f64,
    /// The coefficients a_0^0, a_1^0, ... of the part that has rotational symmetry, in millimetres.
    #[serde(default)]
    pub coefficients_mm: Vec<f64>,
    /// Terms [n, m, a, b] with m from 1, and the coefficients of cos(m t) and sin(m t) in millimetres.
    #[cfg_attr(feature = "schema", schemars(schema_with = "terms_schema"))]
    pub terms: Vec<(u32, u32, f64, f64)>,
}

#[cfg(feature = "schema")]
fn terms_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
    let number = schemars::json_schema!({ "type": "number" });
    let radial = schemars::json_schema!({ "type": "integer", "minimum": 0, "maximum": MAX_RADIAL });
    let order = schemars::json_schema!({ "type": "integer", "minimum": 1, "maximum": MAX_ORDER });
    let term = [radial, order, number.clone(), number];
    schemars::json_schema!({
        "type": "array",
        "items": { "type": "array", "prefixItems": term.as_slice(), "minItems": 4, "maxItems": 4 }
    })
}

impl Q2d {
    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (x, y); `None` at the edge of the sphere and beyond, and
    /// farther than 1.5 normalisation radii from the axis.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let q = x * x + y * y;
        let (sag, slope) = self.symmetric.sag_and_derivative(q)?;
        let radius = self.normalisation_radius_mm;
        let [re, im] = [x / radius, y / radius];
        let v = re * re + im * im;
        // Value, and derivatives by x, y in units of the normalisation radius.
        let mut sum = [0.0; 3];
        // (x + i y)^(m - 1).
        let (mut power, mut m) = ([1.0, 0.0], 1);
        for order in &self.orders {
            while m < order.m {
                power = [power[0] * re - power[1] * im, power[0] * im + power[1] * re];
                m += 1;
            }
            let [cosine, sine] = [power[0] * re - power[1] * im, power[0] * im + power[1] * re];
            let [(a, da), (b, db)] = order.series(v);
            let along = 2.0 * (cosine * da + sine * db);
            let n = f64::from(order.m);
            sum[0] += cosine * a + sine * b;
            sum[1] += n * (power[0] * a + power[1] * b) + along * re;
            sum[2] += n * (power[0] * b - power[1] * a) + along * im;
        }
        let c2 = self.curvature_per_mm * self.curvature_per_mm;
        let per_cosine = 1.0 / (1.0 - c2 * q).sqrt();
        let steeper = sum[0] * c2 * per_cosine.powi(3);
        let gradient = |k: usize, at: f64| 2.0 * at * slope + sum[1 + k] / radius * per_cosine + steeper * at;
        Some((sag + sum[0] * per_cosine, [gradient(0, x), gradient(1, y)]))
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time.
    pub(super) fn term_count(&self) -> usize {
        self.symmetric.term_count() + self.orders.iter().map(|order| order.coefficients_mm.len()).sum::<usize>()
    }
}

impl Order {
    /// Creates the terms of the order `m` from the coefficients [cosine, sine] of the polynomials Q_n^m.
    fn new(m: u32, q_coefficients_mm: &[[f64; 2]]) -> Self {
        let count = q_coefficients_mm.len();
        let constants = Constants::new(m, count);
        let mut coefficients_mm = vec![[0.0; 2]; count];
        for n in (0..count).rev() {
            let above = coefficients_mm.get(n + 1).copied().unwrap_or_default();
            coefficients_mm[n] = [0, 1].map(|k| (q_coefficients_mm[n][k] - constants.g[n] * above[k]) / constants.f[n]);
        }
        Self { m, coefficients_mm }
    }

    /// Returns the sums of the cosine and of the sine terms at v = u^2, each with its derivative by v.
    fn series(&self, v: f64) -> [(f64, f64); 2] {
        let m = f64::from(self.m);
        let mut sums = [(0.0, 0.0); 2];
        let [mut before, mut here] = [(0.0, 0.0); 2];
        for (n, row) in self.coefficients_mm.iter().enumerate() {
            // Eq. (A.3) to (A.6).
            let next = match (self.m, n) {
                (_, 0) => (0.5, 0.0),
                (1, 1) => (1.0 - 0.5 * v, -0.5),
                (1, 2) => ((3.0 - v * (12.0 - 8.0 * v)) / 6.0, (16.0 * v - 12.0) / 6.0),
                (1, 3) => {
                    ((5.0 - v * (60.0 - v * (120.0 - 64.0 * v))) / 10.0, (-60.0 + v * (240.0 - 192.0 * v)) / 10.0)
                }
                (_, 1) => (m - 0.5 + (1.0 - m) * v, 1.0 - m),
                _ => {
                    let [a, b, c] = recurrence(n as f64 - 1.0, m);
                    let factor = a + b * v;
                    (factor * here.0 - c * before.0, factor * here.1 + b * here.0 - c * before.1)
                }
            };
            (before, here) = (here, next);
            for (sum, coefficient) in sums.iter_mut().zip(row) {
                sum.0 += coefficient * here.0;
                sum.1 += coefficient * here.1;
            }
        }
        sums
    }
}

/// Returns the factors of P_(n+1) = (A + B v) P_n - C P_(n-1), eq. (A.3).
fn recurrence(n: f64, m: f64) -> [f64; 3] {
    let s = m + 2.0 * n;
    let d = (4.0 * n * n - 1.0) * (m + n - 2.0) * (s - 3.0);
    let a = (2.0 * n - 1.0) * (s - 2.0) * (4.0 * n * (m + n - 2.0) + (m - 3.0) * (2.0 * m - 1.0));
    let b = -2.0 * (2.0 * n - 1.0) * (s - 3.0) * (s - 2.0) * (s - 1.0);
    let c = n * (2.0 * n - 3.0) * (s - 1.0) * (2.0 * m + 2.0 * n - 3.0);
    [a / d, b / d, c / d]
}

/// Constants f_n and g_n of P_n = f_n Q_n + g_(n-1) Q_(n-1), eq. (A.13) to (A.18).
struct Constants {
    f: Vec<f64>,
    g: Vec<f64>,
}

impl Constants {
    fn new(m: u32, count: usize) -> Self {
        let gammas = gammas(m, count);
        let (mut f, mut g): (Vec<f64>, Vec<f64>) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for n in 0..count {
            let before: f64 = if n > 0 { g[n - 1] } else { 0.0 };
            f.push((upper_f(n, m, &gammas) - before * before).sqrt());
            g.push(upper_g(n, m, &gammas) / f[n]);
        }
        Self { f, g }
    }
}

/// Returns the factors gamma_n^m of eq. (A.12) for m from 2; the first is not used.
fn gammas(m: u32, count: usize) -> Vec<f64> {
    let mut gammas = vec![0.0; count.max(2)];
    let order = f64::from(m);
    gammas[1] = (3..=m).fold(3.0 / 8.0, |gamma, k| {
        let k = f64::from(k);
        gamma * (2.0 * k - 1.0) / (2.0 * (k - 2.0))
    });
    for n in 2..gammas.len() {
        let i = n as f64;
        gammas[n] = gammas[n - 1] * i * (2.0 * order + 2.0 * i - 3.0) / ((order + i - 3.0) * (2.0 * i - 1.0));
    }
    gammas
}

/// Returns (2m + shift)!! / (2^(m + 1) (m - 1)!), for shift -1 or -3.
fn half_factorials(m: u32, shift: f64) -> f64 {
    (2..=m).map(f64::from).fold(0.25, |product, k| product * (2.0 * k + shift) / (2.0 * (k - 1.0)))
}

/// Returns F_n^m of eq. (A.13).
fn upper_f(n: usize, m: u32, gammas: &[f64]) -> f64 {
    let (order, i) = (f64::from(m), n as f64);
    match (n, m) {
        (0, _) => order * order * half_factorials(m, -3.0),
        (_, 1) => {
            let first = (4.0 * (i - 1.0).powi(2) * i * i + 1.0) / (8.0 * (2.0 * i - 1.0).powi(2));
            first + if n == 1 { 11.0 / 32.0 } else { 0.0 }
        }
        _ => {
            let chi = order + i - 2.0;
            let s = order + 2.0 * i;
            let numerator =
                2.0 * i * chi * (3.0 - 5.0 * order + 4.0 * i * chi) + order * order * (3.0 - order + 4.0 * i * chi);
            numerator / ((s - 3.0) * (s - 2.0) * (s - 1.0) * (2.0 * i - 1.0)) * gammas[n]
        }
    }
}

/// Returns G_n^m of eq. (A.15).
fn upper_g(n: usize, m: u32, gammas: &[f64]) -> f64 {
    let (order, i) = (f64::from(m), n as f64);
    match (n, m) {
        (0, _) => half_factorials(m, -1.0),
        (_, 1) => {
            let first = -(2.0 * i * i - 1.0) * (i * i - 1.0) / (8.0 * (4.0 * i * i - 1.0));
            first - if n == 1 { 1.0 / 24.0 } else { 0.0 }
        }
        _ => {
            let s = order + 2.0 * i;
            let numerator = (2.0 * i * (order + i - 1.0) - order) * (i + 1.0) * (2.0 * order + 2.0 * i - 1.0);
            -numerator / ((s - 2.0) * (s - 1.0) * s * (2.0 * i + 1.0)) * gammas[n]
        }
    }
}

impl TryFrom<&Q2dDefinition> for Q2d {
    type Error = DefinitionError;

    fn try_from(written: &Q2dDefinition) -> Result<Self, DefinitionError> {
        let Q2dDefinition { radius_mm, normalisation_radius_mm, .. } = *written;
        let coefficients_mm = written.coefficients_mm.clone();
        let symmetric = Qbfs::try_from(&QbfsDefinition { radius_mm, normalisation_radius_mm, coefficients_mm })?;
        let mut terms = written.terms.clone();
        terms.sort_by_key(|term| (term.1, term.0));
        let mut orders: Vec<(u32, Vec<[f64; 2]>)> = Vec::new();
        for (k, &(n, m, a, b)) in terms.iter().enumerate() {
            let key = || format!("terms.[{n}, {m}]");
            if m == 0 || m > MAX_ORDER || n > MAX_RADIAL {
                let expected = "a term is [n, m, a_mm, b_mm] with n from 0 to 60 and m from 1 to 60";
                return Err(DefinitionError::Term { key: key(), expected });
            }
            if k > 0 && (terms[k - 1].0, terms[k - 1].1) == (n, m) {
                return Err(DefinitionError::RepeatedTerm { key: key() });
            }
            error::check_finite(&key(), a + b)?;
            if orders.last().is_none_or(|(order, _)| *order != m) {
                orders.push((m, Vec::new()));
            }
            if let Some((_, row)) = orders.last_mut() {
                row.resize(n as usize + 1, [0.0; 2]);
                row[n as usize] = [a, b];
            }
        }
        let curvature_per_mm = if radius_mm.is_infinite() { 0.0 } else { 1.0 / radius_mm };
        let orders = orders.iter().map(|(m, row)| Order::new(*m, row)).collect();
        Ok(Self { symmetric, curvature_per_mm, normalisation_radius_mm, orders })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::test_support::gradient_error;

    fn q2d(radius_mm: f64, terms: &[(u32, u32, f64, f64)]) -> Result<Q2d, DefinitionError> {
        let coefficients_mm = vec![0.02, -0.01, 0.004];
        let written =
            Q2dDefinition { radius_mm, normalisation_radius_mm: 20.0, coefficients_mm, terms: terms.to_vec() };
        Q2d::try_from(&written)
    }

    /// Values of prysm 0.21.1, Q2d(n, m, u, t), at u = 0.6 and t = 0.7 rad.
    const VALUES: [(u32, u32, [f64; 2]); 10] = [
        (0, 1, [0.4589053123706931, 0.3865306123426146]),
        (1, 1, [0.31397786548326534, 0.2644599078191541]),
        (3, 1, [-0.23455084968560927, -0.19755945531793098]),
        (5, 1, [-0.017016614834526534, -0.014332896949937364]),
        (0, 2, [0.04326657095651882, 0.25085454717358524]),
        (1, 2, [0.060747316623681304, 0.35220587781172463]),
        (4, 2, [-0.032921271850753726, -0.19087370595647016]),
        (2, 3, [-0.14835088140596162, 0.2536572417088203]),
        (3, 7, [0.03060558765973192, -0.161214720773191]),
        (6, 12, [-0.05189062229665466, 0.08539695370424565]),
    ];

    #[test]
    fn polynomials_match_independent_program() {
        for (n, m, [cosine, sine]) in VALUES {
            let single = |a: f64, b: f64| {
                let written = Q2dDefinition {
                    radius_mm: f64::INFINITY,
                    normalisation_radius_mm: 20.0,
                    coefficients_mm: vec![],
                    terms: vec![(n, m, a, b)],
                };
                let surface = Q2d::try_from(&written).unwrap();
                surface.sag_and_gradient(12.0 * 0.7f64.cos(), 12.0 * 0.7f64.sin()).unwrap().0
            };
            assert!(
                (single(1.0, 0.0) - cosine).abs() < 1e-12 * cosine.abs().max(1.0),
                "{n}, {m}: {}",
                single(1.0, 0.0)
            );
            assert!((single(0.0, 1.0) - sine).abs() < 1e-12 * sine.abs().max(1.0), "{n}, {m}: {}", single(0.0, 1.0));
        }
    }

    #[test]
    fn gradient_matches_sag() {
        let terms =
            [(0, 1, 0.1, -0.2), (3, 1, 0.01, 0.0), (2, 2, 0.0, 0.03), (4, 5, 0.002, -0.001), (1, 7, 1e-3, 2e-3)];
        for radius_mm in [80.0, -60.0, f64::INFINITY] {
            let surface = q2d(radius_mm, &terms).unwrap();
            assert!(gradient_error(&|x, y| surface.sag_and_gradient(x, y), 19.0) < 1e-10);
        }
    }

    #[test]
    fn without_terms_it_is_qbfs() {
        let coefficients_mm = vec![0.02, -0.01, 0.004];
        let written = QbfsDefinition { radius_mm: 80.0, normalisation_radius_mm: 20.0, coefficients_mm };
        let qbfs = Qbfs::try_from(&written).unwrap();
        let found = q2d(80.0, &[]).unwrap().sag_and_gradient(9.0, -5.0).unwrap();
        let (sag, slope) = qbfs.sag_and_derivative(106.0).unwrap();
        assert_eq!(found, (sag, [18.0 * slope, -10.0 * slope]));
    }

    #[test]
    fn degenerate_values_are_refused() {
        assert!(matches!(q2d(80.0, &[(1, 0, 1.0, 0.0)]), Err(DefinitionError::Term { .. })));
        assert!(matches!(q2d(80.0, &[(61, 1, 1.0, 0.0)]), Err(DefinitionError::Term { .. })));
        assert!(matches!(q2d(80.0, &[(1, 2, 1.0, 0.0), (1, 2, 1.0, 0.0)]), Err(DefinitionError::RepeatedTerm { .. })));
        assert!(q2d(80.0, &[(1, 2, f64::NAN, 0.0)]).is_err());
        assert_eq!(q2d(80.0, &[(1, 2, 1.0, 0.0)]).unwrap().sag_and_gradient(31.0, 0.0), None);
    }
}
