//! Surfaces given by a formula: their sag and exact gradient, their definition in TOML, and their sampling.
//!
//! **The conventions, said once.** A surface is z = f(x, y) in its own frame, lengths in millimetres; z runs along the optical
//! axis, and a radius of curvature is positive when its centre lies at +z (ISO 10110-12). The unit normal is the one on
//! the +z side. Gradients come from closed forms or from the derivatives of the recurrences, never from differences.
//!
//! ```text
//!  text --from_toml--> SurfaceDefinition --resolve--> DefinedSurface --sample--> SampledSurface
//!                      (as written)                   (checked)                  (nodes on a grid)
//! ```

mod conic;
mod definition;
mod error;
mod forbes;
mod jacobi;
mod off_axis;
mod polynomial;
mod sampling;
mod toroid;
mod zernike;

pub use conic::{Asphere, AsphereDefinition, Conic, ConicDefinition};
pub use definition::{
    DefinedSurface, Formula, PlaneDefinition, Sampling, SamplingDefinition, SphereDefinition, SurfaceDefinition,
};
pub use error::DefinitionError;
pub use forbes::{Qbfs, QbfsDefinition, Qcon, QconDefinition};
pub(crate) use jacobi::values as jacobi_values;
pub use off_axis::{OffAxis, OffAxisDefinition, SectionFrame};
pub use polynomial::{XyPolynomial, XyPolynomialDefinition};
pub use sampling::SampledSurface;
pub use toroid::{Biconic, BiconicDefinition, Toroid, ToroidDefinition};
pub use zernike::{Zernike, ZernikeDefinition, ZernikeNormalisation, ZernikeNumbering};

use crate::geometry::{Aperture, Vector};

/// Maximum distance from the axis, in normalisation radii, at which polynomials on a disc are evaluated. It is more
/// than 1 because a sampling has one ring of nodes beyond the aperture.
const MAX_EXTRAPOLATION: f64 = 1.5;

/// Surface given by a formula, with checked numbers.
#[derive(Clone, Debug, PartialEq)]
pub enum AnalyticSurface {
    /// A conic of revolution; a sphere and a plane are conics too.
    Conic(Conic),
    /// A conic plus powers of the distance from the axis, ISO 10110-12.
    Asphere(Asphere),
    /// A section of a surface of another kind, away from its axis.
    OffAxis(OffAxis),
    /// A curve rotated about a line, or shifted along one.
    Toroid(Toroid),
    /// Two conics, one in x and one in y.
    Biconic(Biconic),
    /// Powers of x and y.
    XyPolynomial(XyPolynomial),
    /// Zernike polynomials.
    Zernike(Zernike),
    /// Forbes' polynomials for strong aspheres.
    Qcon(Qcon),
    /// Forbes' polynomials for mild aspheres.
    Qbfs(Qbfs),
}

impl AnalyticSurface {
    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (x, y); `None` if the formula has no value or no finite
    /// slope there.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let q = x * x + y * y;
        let around = |(z, slope): (f64, f64)| (z, [2.0 * x * slope, 2.0 * y * slope]);
        let found = match self {
            Self::Conic(conic) => conic.sag_and_derivative(q).map(around),
            Self::Asphere(asphere) => asphere.sag_and_derivative(q).map(around),
            Self::Qcon(qcon) => qcon.sag_and_derivative(q).map(around),
            Self::Qbfs(qbfs) => qbfs.sag_and_derivative(q).map(around),
            Self::OffAxis(section) => section.sag_and_gradient(x, y),
            Self::Toroid(toroid) => toroid.sag_and_gradient(x, y),
            Self::Biconic(biconic) => biconic.sag_and_gradient(x, y),
            Self::XyPolynomial(polynomial) => polynomial.sag_and_gradient(x, y),
            Self::Zernike(zernike) => zernike.sag_and_gradient(x, y),
        };
        found.filter(|(z, [gx, gy])| z.is_finite() && gx.is_finite() && gy.is_finite())
    }

    /// Returns the sag z at (x, y), all in millimetres; `None` if the formula has no value or no finite slope there.
    pub fn sag(&self, x: f64, y: f64) -> Option<f64> {
        self.sag_and_gradient(x, y).map(|(z, _)| z)
    }

    /// Returns the unit normal on the +z side of the surface at (`x`, `y`), which are in millimetres. Returns `None` if
    /// the formula has no value or no finite slope at this place.
    pub fn normal(&self, x: f64, y: f64) -> Option<Vector> {
        self.sag_and_gradient(x, y).map(|(_, gradient)| normal_from_gradient(gradient))
    }

    /// Returns the normalisation radius in mm: the radius of the disc on which the polynomials of the formula are
    /// defined. For an off-axis section, this is the radius of its parent (the whole surface). Returns `None` if the
    /// formula is not limited to a disc.
    fn normalisation_radius_mm(&self) -> Option<f64> {
        match self {
            Self::Zernike(zernike) => Some(zernike.normalisation_radius_mm),
            Self::Qcon(qcon) => Some(qcon.normalisation_radius_mm),
            Self::Qbfs(qbfs) => Some(qbfs.normalisation_radius_mm),
            Self::OffAxis(section) => section.parent().normalisation_radius_mm(),
            _ => None,
        }
    }

    /// Returns the largest distance, in mm, between the axis of the formula and a point of `aperture`. For an off-axis
    /// section, the axis is that of its parent (the whole surface).
    fn reach_mm(&self, aperture: &Aperture) -> f64 {
        let Self::OffAxis(section) = self else { return aperture.reach_mm() };
        let places = aperture.outline_mm(720).into_iter().filter_map(|[x, y]| section.parent_place(x, y));
        places.map(|[x, y]| x.hypot(y)).fold(0.0, f64::max)
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its time.
    fn term_count(&self) -> usize {
        match self {
            Self::Conic(_) | Self::Biconic(_) => 1,
            Self::Asphere(asphere) => asphere.term_count(),
            Self::Qcon(qcon) => qcon.term_count(),
            Self::Qbfs(qbfs) => qbfs.term_count(),
            Self::OffAxis(section) => section.term_count(),
            Self::Toroid(toroid) => toroid.term_count(),
            Self::XyPolynomial(polynomial) => polynomial.term_count(),
            Self::Zernike(zernike) => zernike.term_count(),
        }
    }
}

/// Returns the unit normal on the +z side of a surface z = f(x, y) from the gradient of f.
fn normal_from_gradient([gx, gy]: [f64; 2]) -> Vector {
    Vector::new(-gx, -gy, 1.0).normalize()
}

#[cfg(test)]
mod test_support {
    /// Returns 241 test places (x, y) on a disc of the given radius: the centre, and ten rings of 24 places. The
    /// distances between the rings are irregular. The outermost ring is at 0.99 of the radius.
    pub fn disc(radius: f64) -> Vec<[f64; 2]> {
        let ring = |r: f64| {
            (0..24).map(move |i| {
                let (sine, cosine) = (0.1 + std::f64::consts::TAU * f64::from(i) / 24.0).sin_cos();
                [radius * r * cosine, radius * r * sine]
            })
        };
        let rings = [1e-9, 1e-3, 0.05, 0.21, 0.4, 0.55, 0.7, 0.83, 0.95, 0.99].into_iter().flat_map(ring);
        std::iter::once([0.0, 0.0]).chain(rings).collect()
    }

    /// Returns the largest error of a gradient at the places of [`disc`] with the given radius. `surface` returns the
    /// sag and its gradient at (x, y). The error is the difference between this gradient and a numerical gradient,
    /// computed from the sag by central differences of fourth order. Panics if `surface` returns `None` at a place.
    pub fn gradient_error(surface: &impl Fn(f64, f64) -> Option<(f64, [f64; 2])>, radius: f64) -> f64 {
        let h = 5e-4 * radius;
        let difference =
            |sag: &dyn Fn(f64) -> f64| (8.0 * (sag(h) - sag(-h)) - (sag(2.0 * h) - sag(-2.0 * h))) / (12.0 * h);
        let errors = disc(radius).into_iter().map(|[x, y]| {
            let sag = |x, y| surface(x, y).expect("defined on the disc").0;
            let [gx, gy] = surface(x, y).expect("defined on the disc").1;
            let by_x = difference(&|t| sag(x + t, y));
            let by_y = difference(&|t| sag(x, y + t));
            (gx - by_x).abs().max((gy - by_y).abs())
        });
        errors.fold(0.0, f64::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sphere_normal_points_up() {
        for radius_mm in [5.0, -5.0] {
            let sphere = AnalyticSurface::Conic(Conic::new(radius_mm, 0.0).unwrap());
            let normal = sphere.normal(3.0, 0.0).unwrap();
            let expected = Vector::new(-0.6 * radius_mm.signum(), 0.0, 0.8);
            assert!((normal - expected).norm() < 1e-15, "{normal}");
            assert_eq!(sphere.normal(5.0, 0.0), None);
            assert_eq!(sphere.sag(f64::NAN, 0.0), None);
        }
    }

    #[test]
    fn asphere_gradient_matches_sag() {
        let asphere = Asphere::new(Conic::new(-120.0, -0.6).unwrap(), &[(3, 1e-6), (4, 1e-8), (10, 1e-18)]).unwrap();
        for surface in [AnalyticSurface::Asphere(asphere), AnalyticSurface::Conic(Conic::new(80.0, 0.0).unwrap())] {
            assert!(test_support::gradient_error(&|x, y| surface.sag_and_gradient(x, y), 60.0) < 1e-9);
        }
    }

    #[test]
    fn sag_overflow_is_none() {
        let steep = AnalyticSurface::Asphere(Asphere::new(Conic::PLANE, &[(60, 1e300)]).unwrap());
        assert!(steep.sag(1.0, 0.0).is_some());
        assert_eq!(steep.sag(10.0, 0.0), None);
    }
}
