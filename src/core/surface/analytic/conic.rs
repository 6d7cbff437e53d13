//! Surfaces of revolution: plane, sphere, conic, and the asphere of ISO 10110-12.
//!
//! Sign conventions of ISO 10110-12: z runs along the optical axis from the vertex; a radius is positive when the
//! centre of curvature lies at +z. With h^2 = x^2 + y^2 and c = 1/R `z = c h^2 / (1 + sqrt(1 - (1 + k) c^2 h^2)) + sum
//! A_i h^i`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::error::{self, DefinitionError};

/// Largest power of an asphere.
const MAX_POWER: u32 = 60;

/// Conic of revolution about z with its vertex at the origin. A sphere has the conic constant 0, and a plane the
/// curvature 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conic {
    curvature_per_mm: f64,
    conic: f64,
}

/// Definition of a conic in a file.
///
/// Units: millimetres; the conic constant has none.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct ConicDefinition {
    /// Radius of curvature at the vertex, positive if the centre is at +z; `inf` for a flat surface.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_mm: f64,
    /// Conic constant k: 0 sphere, -1 paraboloid, less than -1 hyperboloid.
    #[serde(default)]
    pub conic: f64,
}

impl Conic {
    /// The plane z = 0.
    pub const PLANE: Self = Self { curvature_per_mm: 0.0, conic: 0.0 };

    /// Creates a conic of revolution. `radius_mm` is the radius of curvature at the vertex, which may be infinite;
    /// `conic` is the conic constant.
    ///
    /// # Errors
    /// Returns an error if the radius is NaN or less than 1e-6 mm in magnitude, or if the conic constant is not finite.
    pub fn new(radius_mm: f64, conic: f64) -> Result<Self, DefinitionError> {
        let curvature_per_mm = error::checked_curvature("radius_mm", radius_mm)?;
        Ok(Self { curvature_per_mm, conic: error::check_finite("conic", conic)? })
    }

    /// Returns the curvature at the vertex in 1/mm: positive if the centre of curvature is at +z, 0 for a plane.
    pub fn curvature_per_mm(&self) -> f64 {
        self.curvature_per_mm
    }

    /// Returns the sag z and the derivative dz/dq for q = h^2, where h is the distance from the axis. Returns `None` at
    /// the edge of the conic and beyond.
    ///
    /// Units: q in mm^2, the sag in mm, the derivative in 1/mm.
    pub fn sag_and_derivative(&self, q: f64) -> Option<(f64, f64)> {
        let c = self.curvature_per_mm;
        let root = 1.0 - (1.0 + self.conic) * c * c * q;
        if root.is_nan() || root <= 0.0 {
            return None;
        }
        let root = root.sqrt();
        // With this form nothing cancels: dz/dq = c / (2 root) exactly.
        Some((c * q / (1.0 + root), 0.5 * c / root))
    }
}

impl TryFrom<&ConicDefinition> for Conic {
    type Error = DefinitionError;

    fn try_from(written: &ConicDefinition) -> Result<Self, DefinitionError> {
        Self::new(written.radius_mm, written.conic)
    }
}

/// Checks the conic `written` in the definition, to which polynomials are added, and returns it. Returns the plane if
/// `written` is `None`.
///
/// # Errors
/// Returns an error if the radius or the conic constant is not valid. The key in the error starts with `base`.
pub(super) fn base_conic(written: Option<&ConicDefinition>) -> Result<Conic, DefinitionError> {
    written.map_or(Ok(Conic::PLANE), |conic| Conic::try_from(conic).map_err(|error| error.in_table("base")))
}

/// Asphere: a conic plus a sum of powers of the distance from the axis, ISO 10110-12.
///
/// Even and odd powers from 2 up are allowed. Power 1 would make a peak on the axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Asphere {
    base: Conic,
    /// Power and coefficient of each term; the unit of the coefficient is mm^(1 - power).
    terms: Vec<(u32, f64)>,
}

/// Definition of an asphere in a file.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct AsphereDefinition {
    /// Radius of curvature at the vertex in millimetres, positive if the centre is at +z; `inf` for a flat surface.
    #[cfg_attr(feature = "schema", schemars(extend("x-infinite" = true)))]
    pub radius_mm: f64,
    /// Conic constant.
    #[serde(default)]
    pub conic: f64,
    /// Coefficient by power, `{ A4 = 1e-8, A6 = -2e-13 }` or `{ 4 = 1e-8 }`, in mm^(1 - power).
    #[serde(default)]
    pub coefficients: BTreeMap<String, f64>,
}

impl Asphere {
    /// Creates an asphere from a conic and the terms (power of the distance from the axis, coefficient in mm^(1 -
    /// power)).
    ///
    /// # Errors
    /// Returns an error if a power is below 2, above 60 or given twice, or if a coefficient is not finite.
    pub fn new(base: Conic, terms: &[(u32, f64)]) -> Result<Self, DefinitionError> {
        let mut sorted = terms.to_vec();
        sorted.sort_by_key(|term| term.0);
        for (i, &(power, coefficient)) in sorted.iter().enumerate() {
            let key = || format!("coefficients.A{power}");
            if !(2..=MAX_POWER).contains(&power) {
                return Err(DefinitionError::Term { key: key(), expected: "a power is a whole number from 2 to 60" });
            }
            if i > 0 && sorted[i - 1].0 == power {
                return Err(DefinitionError::RepeatedTerm { key: key() });
            }
            error::check_finite(&key(), coefficient)?;
        }
        Ok(Self { base, terms: sorted })
    }

    /// Returns the sag z of the asphere (the conic plus the terms) and its derivative dz/dq, where `q` = h^2 and h is
    /// the distance from the axis. Returns `None` at the edge of the conic (where its slope is infinite) and beyond.
    ///
    /// Units: `q` in mm^2, the sag in mm, the derivative in 1/mm.
    pub fn sag_and_derivative(&self, q: f64) -> Option<(f64, f64)> {
        let (mut sag, mut slope) = self.base.sag_and_derivative(q)?;
        let h = q.sqrt();
        for &(power, coefficient) in &self.terms {
            let below = q.powi((power / 2) as i32 - 1) * if power % 2 == 0 { 1.0 } else { h };
            sag += coefficient * below * q;
            slope += 0.5 * f64::from(power) * coefficient * below;
        }
        Some((sag, slope))
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time: the conic and all
    /// powers.
    pub(super) fn term_count(&self) -> usize {
        1 + self.terms.len()
    }
}

impl TryFrom<&AsphereDefinition> for Asphere {
    type Error = DefinitionError;

    fn try_from(written: &AsphereDefinition) -> Result<Self, DefinitionError> {
        let expected = "a coefficient is named by its power, as in `A4` or `4`";
        let terms = parse_coefficients("coefficients", 'A', expected, &written.coefficients)?;
        Self::new(Conic::new(written.radius_mm, written.conic)?, &terms)
    }
}

/// Converts a table of coefficients to (number, coefficient) pairs, sorted by number. A key is a number with or without
/// `letter` before it, such as `A4` or `4`. `table` is the name of the table, and `expected` describes a valid key;
/// both are for messages.
///
/// # Errors
/// Returns an error if a key is not a number, if a number is given twice, or if a coefficient is not finite.
pub(super) fn parse_coefficients(
    table: &str,
    letter: char,
    expected: &'static str,
    coefficients: &BTreeMap<String, f64>,
) -> Result<Vec<(u32, f64)>, DefinitionError> {
    let mut terms = BTreeMap::new();
    for (written, &coefficient) in coefficients {
        let digits = written.strip_prefix(letter).unwrap_or(written);
        let key = || format!("{table}.{written}");
        // `parse` would take a sign as well.
        let number = digits.parse::<u32>().ok().filter(|_| digits.bytes().all(|b| b.is_ascii_digit()));
        let number = number.ok_or_else(|| DefinitionError::Term { key: key(), expected })?;
        error::check_finite(&key(), coefficient)?;
        if terms.insert(number, coefficient).is_some() {
            return Err(DefinitionError::RepeatedTerm { key: key() });
        }
    }
    Ok(terms.into_iter().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conic_sag_by_hand() {
        // 3-4-5: at h = 3 a sphere of radius 5 has risen by 1, at slope 3/4; dz/dq = slope / 2h.
        for (radius_mm, conic, q, sag, slope) in
            [(5.0, 0.0, 9.0, 1.0, 0.125), (-5.0, 0.0, 9.0, -1.0, -0.125), (150.0, -1.0, 900.0, 3.0, 1.0 / 300.0)]
        {
            let found = Conic::new(radius_mm, conic).unwrap().sag_and_derivative(q).unwrap();
            assert!((found.0 - sag).abs() < 1e-15 && (found.1 - slope).abs() < 1e-16, "{found:?}");
        }
        assert_eq!(Conic::new(f64::INFINITY, 0.0).unwrap().sag_and_derivative(1e12), Some((0.0, 0.0)));
    }

    #[test]
    fn conic_ends_at_its_edge() {
        let sphere = Conic::new(5.0, 0.0).unwrap();
        assert!(sphere.sag_and_derivative(24.99).is_some());
        assert!([25.0, 26.0, f64::NAN].iter().all(|&q| sphere.sag_and_derivative(q).is_none()));
        assert!(Conic::new(5.0, -1.0).unwrap().sag_and_derivative(1e9).is_some());
    }

    #[test]
    fn asphere_powers_by_hand() {
        let asphere = Asphere::new(Conic::PLANE, &[(4, 1e-3), (3, 1e-2)]).unwrap();
        // At h = 2: 0.016 + 0.08, slope 0.032 + 0.12 over 2h = 4.
        let (sag, slope) = asphere.sag_and_derivative(4.0).unwrap();
        assert!((sag - 0.096).abs() < 1e-16 && (slope - 0.038).abs() < 1e-16);
        assert_eq!(asphere.sag_and_derivative(0.0), Some((0.0, 0.0)));
        let paraboloid = Asphere::new(Conic::PLANE, &[(2, 0.01)]).unwrap();
        assert_eq!(paraboloid.sag_and_derivative(0.0), Some((0.0, 0.01)));
    }

    #[test]
    fn conic_refuses_degenerate_values() {
        for bad in [0.0, -0.0, f64::NAN, 1e-9] {
            let error = Conic::new(bad, 0.0).unwrap_err();
            assert!(matches!(&error, DefinitionError::OutOfRange { key, .. } if key == "radius_mm"), "{error}");
        }
        assert!(Conic::new(1.0, f64::INFINITY).is_err());
        assert!(matches!(Asphere::new(Conic::PLANE, &[(1, 1.0)]), Err(DefinitionError::Term { .. })));
        assert!(matches!(Asphere::new(Conic::PLANE, &[(61, 1.0)]), Err(DefinitionError::Term { .. })));
        assert!(matches!(Asphere::new(Conic::PLANE, &[(4, 1.0), (4, 1.0)]), Err(DefinitionError::RepeatedTerm { .. })));
        assert!(Asphere::new(Conic::PLANE, &[(4, f64::NAN)]).is_err());
    }
}
