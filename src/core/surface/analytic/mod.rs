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

mod analytic_surface;
mod biconic_zernike;
mod conic;
mod definition;
mod error;
mod forbes;
mod jacobi;
mod polynomial;
mod q2d;
mod sampling;
mod tensor_polynomial;
mod toroid;
mod zernike;

pub use analytic_surface::{AnalyticSurface, OffAxis, SectionFrame, SurfaceSum};
pub use biconic_zernike::{BiconicZernike, BiconicZernikeDefinition};
pub use conic::{Asphere, AsphereDefinition, Conic, ConicDefinition};
pub use definition::{
    DefinedSurface, Formula, OffAxisDefinition, PlaneDefinition, Sampling, SamplingDefinition, SphereDefinition,
    SurfaceDefinition,
};
pub use error::DefinitionError;
pub use forbes::{Qbfs, QbfsDefinition, Qcon, QconDefinition};
pub(crate) use jacobi::values as jacobi_values;
pub use polynomial::{XyPolynomial, XyPolynomialDefinition};
pub use q2d::{Q2d, Q2dDefinition};
pub use sampling::SampledSurface;
pub use tensor_polynomial::{PolynomialFamily, TensorPolynomial, TensorPolynomialDefinition};
pub use toroid::{Biconic, BiconicDefinition, Toroid, ToroidDefinition};
pub use zernike::{Zernike, ZernikeDefinition, ZernikeNormalisation, ZernikeNumbering};

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
    use crate::geometry::Vector;

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
