//! Polynomial bases for the decomposition of form.

use crate::geometry::{Aperture, DeviationSample};
use crate::surface::analytic::{ZernikeNumbering, jacobi_values};

use super::FormError;

/// Maximum number of terms of a Legendre series: complete up to degree 13.
const MAX_LEGENDRE_TERMS: usize = 105;
/// Maximum number of terms of a Zernike series in Noll's and the ANSI numbering.
const MAX_ZERNIKE_TERMS: usize = 105;

/// Sequence of polynomials over x and y.
///
/// Frame: model. Units: millimetres. Each term has a mean square of 1 over its own domain, the full disc or rectangle.
/// On another aperture, least squares over the points separates the terms ([`super::fit_polynomials`]).
#[derive(Clone, Debug, PartialEq)]
pub enum PolynomialBasis {
    /// Zernike polynomials, from the first index of the numbering on. Fringe terms have the same normalisation as the
    /// others.
    Zernike {
        /// Numbering that assigns an index to each term.
        numbering: ZernikeNumbering,
        /// Centre of the disc.
        centre_mm: [f64; 2],
        /// Radius of the disc.
        radius_mm: f64,
    },
    /// Products L_i(x) L_j(y) of Legendre polynomials, in order of rising i + j, then of falling i.
    Legendre {
        /// Centre of the rectangle.
        centre_mm: [f64; 2],
        /// Half of the size of the rectangle along x and y.
        half_mm: [f64; 2],
    },
}

impl PolynomialBasis {
    /// Returns the polynomials that suit an aperture: Zernike for a disc, a ring and an ellipse, Legendre for a
    /// rectangle and a polygon.
    pub fn for_aperture(aperture: &Aperture) -> Self {
        match aperture {
            Aperture::Circle { .. } | Aperture::Annulus { .. } | Aperture::Ellipse { .. } => Self::zernike(aperture),
            Aperture::Rectangle { .. } | Aperture::Polygon { .. } => Self::legendre(aperture.bounds()),
        }
    }

    /// Returns the Fringe Zernike polynomials on a disc that contains the aperture. The centre of the disc is the
    /// centre of the bounding rectangle of `aperture`. The radius is the smallest one for which the disc contains the
    /// whole aperture.
    pub fn zernike(aperture: &Aperture) -> Self {
        let (centre_mm, half_mm) = centre_and_half(aperture.bounds());
        let radius_mm = match aperture {
            Aperture::Circle { .. } | Aperture::Annulus { .. } | Aperture::Ellipse { .. } => half_mm[0].max(half_mm[1]),
            Aperture::Rectangle { .. } => half_mm[0].hypot(half_mm[1]),
            Aperture::Polygon { corners_mm } => {
                corners_mm.iter().map(|[x, y]| (x - centre_mm[0]).hypot(y - centre_mm[1])).fold(0.0, f64::max)
            }
        };
        Self::Zernike { numbering: ZernikeNumbering::Fringe, centre_mm, radius_mm }
    }

    /// Returns the Legendre polynomials on a rectangle. `bounds_mm` has the lower and the upper corner of the
    /// rectangle, each as x and y in mm.
    pub fn legendre(bounds_mm: [[f64; 2]; 2]) -> Self {
        let (centre_mm, half_mm) = centre_and_half(bounds_mm);
        Self::Legendre { centre_mm, half_mm }
    }

    /// Returns the name of the polynomials for a report, such as `Zernike (Fringe)` or `Legendre`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Zernike { numbering: ZernikeNumbering::Noll, .. } => "Zernike (Noll)",
            Self::Zernike { numbering: ZernikeNumbering::Ansi, .. } => "Zernike (ANSI)",
            Self::Zernike { numbering: ZernikeNumbering::Fringe, .. } => "Zernike (Fringe)",
            Self::Legendre { .. } => "Legendre",
        }
    }

    /// Returns the name of the term with index `k`, from 0: `Z4 (2, 0)` for Zernike index 4 of degree 2 and azimuthal
    /// order 0, or `L2(x) L1(y)` for a product of Legendre polynomials.
    pub fn term_name(&self, k: usize) -> String {
        match self {
            Self::Zernike { numbering, .. } => {
                let index = first(*numbering) + k as u32;
                let (n, m) = numbering.degree_and_order(index).unwrap_or_default();
                format!("Z{index} ({n}, {m})")
            }
            Self::Legendre { .. } => {
                let [i, j] = degrees(k);
                format!("L{i}(x) L{j}(y)")
            }
        }
    }

    /// Returns the number of terms that the basis has: 37 for Fringe Zernike, otherwise 105.
    pub(super) fn max_terms(&self) -> usize {
        match self {
            Self::Zernike { numbering: ZernikeNumbering::Fringe, .. } => 37,
            Self::Zernike { .. } => MAX_ZERNIKE_TERMS,
            Self::Legendre { .. } => MAX_LEGENDRE_TERMS,
        }
    }

    /// Returns the largest number of terms, at most `most`, that contains only complete orders of the basis. An order
    /// is a group of terms that belong together, for example all Legendre terms of the same total degree. The number is
    /// also at most [`Self::max_terms`]. Returns 0 if `most` is 0.
    ///
    /// The possible numbers are 1, 4, 9, 16 and so on for Fringe Zernike. For all other polynomials they are 1, 3, 6,
    /// 10 and so on: all terms up to a degree.
    pub(super) fn complete_terms(&self, most: usize) -> usize {
        let counts =
            |fringe: bool| (0..).map(move |n: usize| if fringe { (n + 1) * (n + 1) } else { (n + 1) * (n + 2) / 2 });
        let fringe = matches!(self, Self::Zernike { numbering: ZernikeNumbering::Fringe, .. });
        counts(fringe).take_while(|count| *count <= most.min(self.max_terms())).last().unwrap_or(0)
    }

    /// Prepares the first `terms` polynomials for evaluation at many samples.
    ///
    /// # Errors
    /// Returns [`FormError::Terms`] if `terms` is 0 or above [`Self::max_terms`], and [`FormError::NoArea`] if the disc
    /// or the rectangle of the basis has no area.
    pub(super) fn prepare_terms(&self, terms: usize) -> Result<Terms, FormError> {
        if !(1..=self.max_terms()).contains(&terms) {
            return Err(FormError::Terms { terms, basis: self.name(), max_terms: self.max_terms() });
        }
        match self {
            Self::Zernike { radius_mm, .. } if !(*radius_mm > 0.0 && radius_mm.is_finite()) => Err(FormError::NoArea),
            Self::Zernike { numbering, centre_mm, radius_mm } => {
                let index = |k: u32| numbering.degree_and_order(first(*numbering) + k).unwrap_or_default();
                let orders = AzimuthalOrder::grouped((0..terms as u32).map(index));
                Ok(Terms::Zernike { orders, terms, centre_mm: *centre_mm, radius_mm: *radius_mm })
            }
            Self::Legendre { half_mm, .. } if !(half_mm[0] > 0.0 && half_mm[1] > 0.0) => Err(FormError::NoArea),
            Self::Legendre { centre_mm, half_mm } => {
                let degrees = (0..terms).map(degrees).collect();
                Ok(Terms::Legendre { degrees, centre_mm: *centre_mm, half_mm: *half_mm })
            }
        }
    }
}

/// First terms of a basis, ready for evaluation.
pub(super) enum Terms {
    Zernike { orders: Vec<AzimuthalOrder>, terms: usize, centre_mm: [f64; 2], radius_mm: f64 },
    Legendre { degrees: Vec<[usize; 2]>, centre_mm: [f64; 2], half_mm: [f64; 2] },
}

impl Terms {
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Zernike { terms, .. } => *terms,
            Self::Legendre { degrees, .. } => degrees.len(),
        }
    }

    /// Evaluates every term of the basis at the position of `sample`, and writes the values to `row`. `row` has one
    /// entry for each term. `index` is the index of the sample; it is used only in the error.
    ///
    /// # Errors
    /// Returns [`FormError::FarOut`] with `index` if the basis is Zernike and the sample is more than 1.5 radii from
    /// the centre of the disc.
    pub(super) fn values(&self, index: usize, sample: &DeviationSample, row: &mut [f64]) -> Result<(), FormError> {
        let [x, y] = sample.place_mm;
        match self {
            Self::Zernike { orders, centre_mm, radius_mm, .. } => {
                let (x, y) = (x - centre_mm[0], y - centre_mm[1]);
                let (u, v) = (x / radius_mm, y / radius_mm);
                let q = u * u + v * v;
                if q > MAX_RADIUS_RATIO * MAX_RADIUS_RATIO {
                    return Err(FormError::FarOut { index, distance_mm: x.hypot(y), radius_mm: *radius_mm });
                }
                zernike(orders, [u, v], q, row);
            }
            Self::Legendre { degrees, centre_mm, half_mm } => {
                let [u, v] = [(x - centre_mm[0]) / half_mm[0], (y - centre_mm[1]) / half_mm[1]];
                let [along_x, along_y] = [legendre(u), legendre(v)];
                for (value, [i, j]) in row.iter_mut().zip(degrees) {
                    *value = along_x[*i] * along_y[*j];
                }
            }
        }
        Ok(())
    }
}

/// Largest distance from the centre of the disc, in radii, at which Zernike polynomials are evaluated.
const MAX_RADIUS_RATIO: f64 = 1.5;
/// Maximum number of radial polynomials of one azimuthal order: up to degree 13, and Fringe's term of degree 12.
const MAX_RADIAL_TERMS: usize = 7;

/// Zernike terms of one azimuthal order.
pub(super) struct AzimuthalOrder {
    m: u32,
    /// Number of radial polynomials needed.
    radial: usize,
    /// For each term: its index in the row, the index (n - m) / 2 of its radial polynomial, true if it is a sine, and
    /// the factor that scales its mean square to 1.
    terms: Vec<(usize, usize, bool, f64)>,
}

impl AzimuthalOrder {
    /// Groups Zernike terms by the absolute value of their azimuthal order. `terms` has the degree n and the azimuthal
    /// order m of each term.
    ///
    /// Returns one group for each value of |m| from 0 to the largest; the group of |m| has the index |m|. A group can
    /// be empty.
    fn grouped(terms: impl Iterator<Item = (u32, i32)>) -> Vec<Self> {
        let mut orders: Vec<Self> = Vec::new();
        for (place, (n, m)) in terms.enumerate() {
            let k = ((n - m.unsigned_abs()) / 2) as usize;
            let factor = (f64::from(n + 1) * if m == 0 { 1.0 } else { 2.0 }).sqrt();
            while orders.len() <= m.unsigned_abs() as usize {
                orders.push(Self { m: orders.len() as u32, radial: 0, terms: Vec::new() });
            }
            let order = &mut orders[m.unsigned_abs() as usize];
            order.radial = order.radial.max(k + 1);
            order.terms.push((place, k, m < 0, factor));
        }
        orders
    }
}

/// Evaluates all Zernike terms in `orders` at one point, and writes the values to `row`. Each term has a mean square of
/// 1 over the disc.
///
/// `[u, v]` is the position of the point relative to the centre of the disc, in radii; `q` is u^2 + v^2. The term of
/// degree n and azimuthal order m is, apart from a constant factor, the product of two functions. One is the Jacobi
/// polynomial P_k^(0, |m|)(2 q - 1) with k = (n - |m|) / 2. The other is the real part (m >= 0) or the imaginary part
/// (m < 0) of (u + i v)^|m|.
fn zernike(orders: &[AzimuthalOrder], [u, v]: [f64; 2], q: f64, row: &mut [f64]) {
    let mut power = [1.0, 0.0];
    let mut radial = [0.0; MAX_RADIAL_TERMS];
    for order in orders {
        jacobi_values(order.m, 2.0 * q - 1.0, &mut radial[..order.radial]);
        for &(place, k, sine, factor) in &order.terms {
            row[place] = factor * radial[k] * power[usize::from(sine)];
        }
        power = [power[0] * u - power[1] * v, power[0] * v + power[1] * u];
    }
}

/// Number of Legendre polynomials in one variable: degrees 0 to 13.
const DEGREES: usize = 14;

/// Returns the Legendre polynomials P_0 to P_13 at `t`, computed by Bonnet's recurrence. Each P_n is multiplied by
/// sqrt(2 n + 1), so that its mean square from -1 to 1 is 1.
fn legendre(t: f64) -> [f64; DEGREES] {
    let mut plain = [1.0; DEGREES];
    plain[1] = t;
    for n in 1..DEGREES - 1 {
        let k = n as f64;
        plain[n + 1] = ((2.0 * k + 1.0) * t * plain[n] - k * plain[n - 1]) / (k + 1.0);
    }
    std::array::from_fn(|n| plain[n] * (2.0 * n as f64 + 1.0).sqrt())
}

/// Returns the degrees in x and y of the Legendre term with index `k`. The terms are sorted by rising total degree,
/// then by falling degree of x.
fn degrees(k: usize) -> [usize; 2] {
    let sum = ((8 * k + 1).isqrt() - 1) / 2;
    let j = k - sum * (sum + 1) / 2;
    [sum - j, j]
}

fn first(numbering: ZernikeNumbering) -> u32 {
    u32::from(numbering != ZernikeNumbering::Ansi)
}

fn centre_and_half([low, high]: [[f64; 2]; 2]) -> ([f64; 2], [f64; 2]) {
    (std::array::from_fn(|k| 0.5 * (low[k] + high[k])), std::array::from_fn(|k| 0.5 * (high[k] - low[k])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terms_are_named_and_ordered() {
        let rectangle = PolynomialBasis::legendre([[-2.0, 0.0], [4.0, 2.0]]);
        assert_eq!((rectangle.term_name(0), rectangle.term_name(4)), ("L0(x) L0(y)".into(), "L1(x) L1(y)".into()));
        assert_eq!((0..6).map(degrees).collect::<Vec<_>>(), [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]);
        assert_eq!([1, 2, 3, 9, 36, 200].map(|most| rectangle.complete_terms(most)), [1, 1, 3, 6, 36, 105]);
        let ring = Aperture::Annulus { centre_mm: [1.0, 2.0], inner_radius_mm: 3.0, outer_radius_mm: 9.0 };
        let PolynomialBasis::Zernike { centre_mm, radius_mm, .. } = PolynomialBasis::for_aperture(&ring) else {
            panic!("discs have Zernike's")
        };
        assert_eq!((centre_mm, radius_mm), ([1.0, 2.0], 9.0));
        assert_eq!(
            (
                PolynomialBasis::for_aperture(&ring).term_name(8),
                PolynomialBasis::for_aperture(&ring).complete_terms(40)
            ),
            ("Z9 (4, 0)".into(), 36)
        );
        let square = Aperture::Rectangle { centre_mm: [0.0; 2], width_mm: 6.0, height_mm: 8.0 };
        assert!(matches!(PolynomialBasis::zernike(&square), PolynomialBasis::Zernike { radius_mm: 5.0, .. }));
        assert!(matches!(rectangle.prepare_terms(0), Err(FormError::Terms { max_terms: 105, .. })));
    }

    #[test]
    fn zernike_basis_matches_surface() {
        use crate::surface::analytic::{Zernike, ZernikeDefinition, ZernikeNormalisation};
        for numbering in [ZernikeNumbering::Fringe, ZernikeNumbering::Noll, ZernikeNumbering::Ansi] {
            let basis = PolynomialBasis::Zernike { numbering, centre_mm: [1.0, -2.0], radius_mm: 20.0 };
            let terms = basis.prepare_terms(basis.max_terms()).unwrap();
            let mut row = vec![f64::NAN; terms.len()];
            for at_mm in [[1.0, -2.0], [8.0, 3.0], [-12.0, 11.5], [21.0, -2.0], [1.0, -27.0]] {
                terms.values(0, &DeviationSample { place_mm: at_mm, deviation_mm: 0.0 }, &mut row).unwrap();
                for (k, value) in row.iter().enumerate() {
                    let written = ZernikeDefinition {
                        numbering,
                        normalisation_radius_mm: 20.0,
                        coefficients_mm: [((first(numbering) + k as u32).to_string(), 1.0)].into(),
                        normalisation: Some(ZernikeNormalisation::Orthonormal),
                        base: None,
                    };
                    let surface = Zernike::try_from(&written).unwrap();
                    let (expected, _) = surface.sag_and_gradient(at_mm[0] - 1.0, at_mm[1] + 2.0).unwrap();
                    assert!(
                        (value - expected).abs() <= 1e-11 * expected.abs().max(1.0),
                        "{}: {value}",
                        basis.term_name(k)
                    );
                }
            }
        }
    }

    #[test]
    fn legendre_by_hand() {
        let [l0, l1, l2, l3, ..] = legendre(0.5);
        assert_eq!((l0, l1), (1.0, 3f64.sqrt() * 0.5));
        assert!((l2 + 5f64.sqrt() * 0.125).abs() < 1e-15 && (l3 + 7f64.sqrt() * 0.4375).abs() < 1e-15);
        assert!((legendre(1.0)[13] - 27f64.sqrt()).abs() < 1e-13);
    }
}
