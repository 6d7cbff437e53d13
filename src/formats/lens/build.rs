//! Surfaces of design programs as surfaces of the core, in millimetres.

use std::collections::BTreeMap;

use regrind_core::surface::analytic::{
    AnalyticSurface, Asphere, Biconic, BiconicDefinition, Conic, ConicDefinition, DefinitionError, Qbfs,
    QbfsDefinition, Qcon, QconDefinition, SurfaceSum, Toroid, XyPolynomial, XyPolynomialDefinition, Zernike,
    ZernikeDefinition, ZernikeNormalisation, ZernikeNumbering,
};

/// Result with the reason in words.
pub(super) type Built = Result<AnalyticSurface, String>;

/// Base of a surface: curvature in 1/mm and conic constant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Base {
    pub curvature_per_mm: f64,
    pub conic: f64,
}

impl Base {
    /// Returns the radius in mm, infinite for a plane.
    fn radius_mm(self) -> f64 {
        if self.curvature_per_mm == 0.0 { f64::INFINITY } else { 1.0 / self.curvature_per_mm }
    }

    fn definition(self) -> ConicDefinition {
        ConicDefinition { radius_mm: self.radius_mm(), conic: self.conic }
    }

    pub(super) fn conic(self) -> Built {
        Conic::new(self.radius_mm(), self.conic).map(AnalyticSurface::Conic).map_err(in_words)
    }

    /// Returns the asphere with the terms (power of the distance from the axis, coefficient in mm^(1 - power)).
    pub(super) fn asphere(self, terms: &[(u32, f64)]) -> Built {
        self.asphere_curve(terms).map(AnalyticSurface::Asphere)
    }

    fn asphere_curve(self, terms: &[(u32, f64)]) -> Result<Asphere, String> {
        let terms: Vec<(u32, f64)> = terms.iter().copied().filter(|(_, a)| *a != 0.0).collect();
        if terms.iter().any(|(power, _)| *power < 2) {
            return Err("its term of the first power makes a peak on the axis".to_owned());
        }
        let base = Conic::new(self.radius_mm(), self.conic).map_err(in_words)?;
        Asphere::new(base, &terms).map_err(in_words)
    }

    /// Returns the toroid: this curve in y, turned about a line parallel to y at the distance `radius_x_mm`, infinite for
    /// a cylinder.
    pub(super) fn toroid(self, radius_x_mm: f64, terms: &[(u32, f64)]) -> Built {
        Toroid::new(radius_x_mm, self.asphere_curve(terms)?).map(AnalyticSurface::Toroid).map_err(in_words)
    }

    /// Returns the biconic with this curve in y, and a radius (infinite for none) and a conic constant in x.
    pub(super) fn biconic(self, radius_x_mm: f64, conic_x: f64) -> Built {
        let (radius_y_mm, conic_y) = (self.radius_mm(), self.conic);
        let written = BiconicDefinition { radius_x_mm, radius_y_mm, conic_x, conic_y };
        Biconic::try_from(&written).map(AnalyticSurface::Biconic).map_err(in_words)
    }

    /// Returns the polynomial of x / N and y / N with terms [i, j, coefficient in mm].
    pub(super) fn xy_polynomial(self, normalisation_radius_mm: f64, terms: Vec<(u32, u32, f64)>) -> Built {
        let terms = terms.into_iter().filter(|(.., a)| *a != 0.0).collect();
        let written = XyPolynomialDefinition { normalisation_radius_mm, terms, base: Some(self.definition()) };
        XyPolynomial::try_from(&written).map(AnalyticSurface::XyPolynomial).map_err(in_words)
    }

    /// Returns Forbes' polynomials.
    pub(super) fn forbes(self, is_qcon: bool, normalisation_radius_mm: f64, coefficients_mm: Vec<f64>) -> Built {
        let (radius_mm, conic) = (self.radius_mm(), self.conic);
        if is_qcon {
            let written = QconDefinition { radius_mm, conic, normalisation_radius_mm, coefficients_mm };
            return Qcon::try_from(&written).map(AnalyticSurface::Qcon).map_err(in_words);
        }
        if conic != 0.0 {
            return Err("its Qbfs polynomials have a conic constant; it must be 0".to_owned());
        }
        let written = QbfsDefinition { radius_mm, normalisation_radius_mm, coefficients_mm };
        Qbfs::try_from(&written).map(AnalyticSurface::Qbfs).map_err(in_words)
    }
}

/// Returns Zernike polynomials without a base. `coefficients_mm` begins with the first term of the numbering.
pub(super) fn zernike(is_fringe: bool, normalisation_radius_mm: f64, coefficients_mm: &[f64]) -> Built {
    let named = (1..).zip(coefficients_mm).filter(|(_, a)| **a != 0.0);
    let coefficients_mm: BTreeMap<String, f64> = named.map(|(n, a)| (format!("Z{n}"), *a)).collect();
    let (numbering, normalisation) = if is_fringe {
        (ZernikeNumbering::Fringe, ZernikeNormalisation::Unnormalised)
    } else {
        (ZernikeNumbering::Noll, ZernikeNormalisation::Orthonormal)
    };
    let written = ZernikeDefinition {
        numbering,
        normalisation_radius_mm,
        coefficients_mm,
        normalisation: Some(normalisation),
        base: None,
    };
    Zernike::try_from(&written).map(AnalyticSurface::Zernike).map_err(in_words)
}

/// Returns the sum of two surfaces, the second shifted by `shift_mm`.
pub(super) fn sum(first: Built, second: Built, shift_mm: [f64; 2]) -> Built {
    Ok(AnalyticSurface::Sum(SurfaceSum::new(vec![(first?, [0.0; 2]), (second?, shift_mm)])))
}

/// Returns the power pairs (i, j) of a polynomial in the order x, y, x^2, x y, y^2, x^3 ..., without a constant.
pub(super) fn polynomial_order() -> impl Iterator<Item = (u32, u32)> {
    (1..=60).flat_map(|degree| (0..=degree).map(move |j| (degree - j, j)))
}

fn in_words(error: DefinitionError) -> String {
    error.to_string()
}
