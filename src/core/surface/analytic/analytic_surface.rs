//! Surface with a formula, which can be a section of a larger surface away from its axis.

use std::sync::Arc;

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use super::biconic_zernike::BiconicZernike;
use super::conic::{Asphere, Conic};
use super::error::{self, DefinitionError};
use super::forbes::{Qbfs, Qcon};
use super::polynomial::XyPolynomial;
use super::q2d::Q2d;
use super::tensor_polynomial::TensorPolynomial;
use super::toroid::{Biconic, Toroid};
use super::zernike::Zernike;
use crate::geometry::pose::min_rotation;
use crate::geometry::{Aperture, Point, Vector};
use crate::surface::parametric::HeightField;

/// Number of steps from the section's centre to a place, if Newton's method does not converge at this place directly.
const CONTINUATION_STEPS: u32 = 64;

/// Frame in which a section and its aperture are described.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "kebab-case")]
pub enum SectionFrame {
    /// The frame of the parent.
    Parent,
    /// The frame of the parent, translated so that the origin is on the surface at the section's centre.
    Shifted,
    /// A frame with its origin on the surface at the section's centre and z along the parent's normal there; the
    /// smallest rotation leads to it from the parent's frame, so that x and y stay as near to the parent's as possible.
    Tilted,
}

/// Section of a parent surface about a centre away from the parent's axis.
#[derive(Clone, Debug, PartialEq)]
pub struct OffAxis {
    parent: Box<AnalyticSurface>,
    frame: SectionFrame,
    /// The section's centre in the parent's frame.
    centre: Point,
    /// Rotation from the tilted frame to the parent's frame; its columns are the axes of the tilted frame.
    parent_from_tilted: Matrix3<f64>,
}

impl OffAxis {
    /// Creates an off-axis section of a parent surface. `distance_mm` is the distance of the centre of the section from
    /// the axis of the parent, and `azimuth_rad` its azimuth from x towards y. `frame` is the frame in which the
    /// section is described.
    ///
    /// # Errors
    /// Returns an error if the distance is negative or above 1e6 mm, if the azimuth is not finite, or if the parent has
    /// no value or no finite slope at the centre.
    pub fn new(
        parent: AnalyticSurface,
        distance_mm: f64,
        azimuth_rad: f64,
        frame: SectionFrame,
    ) -> Result<Self, DefinitionError> {
        if !(0.0..=1e6).contains(&distance_mm) {
            let remedy = "for the other side of the axis add 180 to `azimuth_deg`";
            return Err(DefinitionError::out_of_range("distance_mm", distance_mm, "from 0 to 1e6 mm", remedy));
        }
        let (sine, cosine) = error::check_finite("azimuth_deg", azimuth_rad)?.sin_cos();
        let (x_mm, y_mm) = (distance_mm * cosine, distance_mm * sine);
        let Some((z, gradient)) = parent.sag_and_gradient(x_mm, y_mm) else {
            return Err(DefinitionError::SectionOffParent { x_mm, y_mm });
        };
        let parent_from_tilted = min_rotation(&normal_from_gradient(gradient));
        Ok(Self { parent: Box::new(parent), frame, centre: Point::new(x_mm, y_mm, z), parent_from_tilted })
    }

    /// Returns the section's centre in the parent's frame, in millimetres.
    pub fn centre(&self) -> &Point {
        &self.centre
    }

    /// Returns the frame in which the section and its aperture are described.
    pub fn frame(&self) -> SectionFrame {
        self.frame
    }

    /// Returns the parent: the whole surface from which the section is cut.
    pub fn parent(&self) -> &AnalyticSurface {
        &self.parent
    }

    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (`x`, `y`) in the frame of the section. Returns `None` if
    /// the parent (the whole surface) has no value or no finite slope at this place. In the tilted frame, also returns
    /// `None` if no surface point that faces +z is found at this place.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        match self.frame {
            SectionFrame::Parent => self.parent.sag_and_gradient(x, y),
            SectionFrame::Shifted => {
                let (z, gradient) = self.parent.sag_and_gradient(self.centre.x + x, self.centre.y + y)?;
                Some((z - self.centre.z, gradient))
            }
            SectionFrame::Tilted => self.newton(x, y, 0.0).or_else(|| self.continue_from_centre(x, y)),
        }
    }

    /// Converts the place (`x`, `y`) in the frame of the section to the frame of its parent (the whole surface).
    /// Returns x and y of the same surface point in the parent's frame. Returns `None` if, in the tilted frame, the
    /// section has no value at this place.
    ///
    /// Units: millimetres.
    pub(super) fn parent_place(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        match self.frame {
            SectionFrame::Parent => Some([x, y]),
            SectionFrame::Shifted => Some([self.centre.x + x, self.centre.y + y]),
            SectionFrame::Tilted => {
                let (z, _) = self.sag_and_gradient(x, y)?;
                let place = self.centre + self.parent_from_tilted * Vector::new(x, y, z);
                Some([place.x, place.y])
            }
        }
    }

    /// Returns the sag z at (`x`, `y`) in the tilted frame of the section, and its gradient (dz/dx, dz/dy). Solves p_z
    /// = f(p_x, p_y) for z by Newton's method, with p = centre + R (x, y, z). Here f is the sag of the parent (the
    /// whole surface), and R rotates the tilted frame to the parent's frame. `start` is the first estimate of z in mm.
    ///
    /// Returns `None` if the iteration does not converge in 30 steps, meets a place where the parent has no value, or
    /// meets a place where the surface does not face +z.
    ///
    /// The gradient follows from the implicit function theorem. With the normal m = R^T (-f_x, -f_y, 1) in the tilted
    /// frame, the gradient is (-m_x / m_z, -m_y / m_z).
    fn newton(&self, x: f64, y: f64, start: f64) -> Option<(f64, [f64; 2])> {
        let mut z = start;
        let scale = self.centre.coords.amax().max(x.abs()).max(y.abs());
        for _ in 0..30 {
            let p = self.centre + self.parent_from_tilted * Vector::new(x, y, z);
            let (sag, [gx, gy]) = self.parent.sag_and_gradient(p.x, p.y)?;
            let m = self.parent_from_tilted.tr_mul(&Vector::new(-gx, -gy, 1.0));
            // A root on the far side of a closed surface has its normal turned away.
            if m.z <= 1e-9 * m.norm() {
                return None;
            }
            let step = (p.z - sag) / m.z;
            z -= step;
            // Newton's method squares the error: after so short a step only rounding is left.
            if step.abs() <= 1e-13 * scale.max(z.abs()) {
                return Some((z, [-m.x / m.z, -m.y / m.z]));
            }
        }
        None
    }

    /// Returns the sag and its gradient at (x, y) in the tilted frame by numerical continuation: follows the surface
    /// from the centre of the section in small steps. It is used if Newton's method does not converge directly. Returns
    /// `None` if a step does not converge.
    fn continue_from_centre(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        let step = 1.0 / f64::from(CONTINUATION_STEPS);
        let (mut z, mut gradient) = self.newton(0.0, 0.0, 0.0)?;
        for i in 1..=CONTINUATION_STEPS {
            let t = f64::from(i) * step;
            let ahead = z + (gradient[0] * x + gradient[1] * y) * step;
            (z, gradient) = self.newton(t * x, t * y, ahead)?;
        }
        Some((z, gradient))
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its computing time. In the tilted frame,
    /// this is five times the number of the parent surface, because Newton's method takes about five steps.
    pub(super) fn term_count(&self) -> usize {
        // Newton's method takes some five steps.
        self.parent.term_count() * if self.frame == SectionFrame::Tilted { 5 } else { 1 }
    }
}

/// Sum of surfaces, each shifted in x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct SurfaceSum {
    parts: Vec<(AnalyticSurface, [f64; 2])>,
}

impl SurfaceSum {
    /// Creates the sum of surfaces, each with the place in mm of its origin.
    pub fn new(parts: Vec<(AnalyticSurface, [f64; 2])>) -> Self {
        Self { parts }
    }

    /// Returns the sag z and its gradient (dz/dx, dz/dy) at (`x`, `y`); `None` where one of the surfaces has no value.
    ///
    /// Units: millimetres; the gradient has none.
    pub fn sag_and_gradient(&self, x: f64, y: f64) -> Option<(f64, [f64; 2])> {
        self.parts.iter().try_fold((0.0, [0.0; 2]), |(sum, [sx, sy]), (surface, shift)| {
            let (z, [gx, gy]) = surface.sag_and_gradient(x - shift[0], y - shift[1])?;
            Some((sum + z, [sx + gx, sy + gy]))
        })
    }
}

/// Surface given by a formula, or by a face of a CAD model, with checked numbers.
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
    /// Two conics plus Zernike polynomials.
    BiconicZernike(BiconicZernike),
    /// Powers of x and y.
    XyPolynomial(XyPolynomial),
    /// Zernike polynomials.
    Zernike(Zernike),
    /// Forbes' polynomials for strong aspheres.
    Qcon(Qcon),
    /// Forbes' polynomials for mild aspheres.
    Qbfs(Qbfs),
    /// Forbes' polynomials for freeform surfaces.
    Q2d(Q2d),
    /// Chebyshev or Legendre polynomials in x and y.
    TensorPolynomial(TensorPolynomial),
    /// Sum of surfaces, each shifted.
    Sum(SurfaceSum),
    /// Face of a CAD model, of which the place (u, v) of each (x, y) is found.
    Face(Arc<HeightField>),
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
            Self::BiconicZernike(surface) => surface.sag_and_gradient(x, y),
            Self::XyPolynomial(polynomial) => polynomial.sag_and_gradient(x, y),
            Self::Q2d(q2d) => q2d.sag_and_gradient(x, y),
            Self::TensorPolynomial(polynomial) => polynomial.sag_and_gradient(x, y),
            Self::Zernike(zernike) => zernike.sag_and_gradient(x, y),
            Self::Sum(sum) => sum.sag_and_gradient(x, y),
            Self::Face(field) => field.sag_and_gradient(x, y),
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
    pub(super) fn normalisation_radius_mm(&self) -> Option<f64> {
        match self {
            Self::Zernike(zernike) => Some(zernike.normalisation_radius_mm),
            Self::Qcon(qcon) => Some(qcon.normalisation_radius_mm),
            Self::Qbfs(qbfs) => Some(qbfs.normalisation_radius_mm),
            Self::Q2d(q2d) => Some(q2d.normalisation_radius_mm),
            Self::BiconicZernike(surface) => Some(surface.normalisation_radius_mm()),
            Self::OffAxis(section) => section.parent().normalisation_radius_mm(),
            _ => None,
        }
    }

    /// Returns the largest distance, in mm, between the axis of the formula and a point of `aperture`. For an off-axis
    /// section, the axis is that of its parent (the whole surface).
    pub(super) fn reach_mm(&self, aperture: &Aperture) -> f64 {
        let Self::OffAxis(section) = self else { return aperture.reach_mm() };
        let places = aperture.outline_mm(720).into_iter().filter_map(|[x, y]| section.parent_place(x, y));
        places.map(|[x, y]| x.hypot(y)).fold(0.0, f64::max)
    }

    /// Returns the number of terms that one evaluation sums, as a measure of its time.
    pub(super) fn term_count(&self) -> usize {
        match self {
            Self::Conic(_) | Self::Biconic(_) => 1,
            Self::Asphere(asphere) => asphere.term_count(),
            Self::Qcon(qcon) => qcon.term_count(),
            Self::Qbfs(qbfs) => qbfs.term_count(),
            Self::OffAxis(section) => section.term_count(),
            Self::Toroid(toroid) => toroid.term_count(),
            Self::XyPolynomial(polynomial) => polynomial.term_count(),
            Self::Q2d(q2d) => q2d.term_count(),
            Self::BiconicZernike(surface) => surface.term_count(),
            Self::TensorPolynomial(polynomial) => polynomial.term_count(),
            Self::Zernike(zernike) => zernike.term_count(),
            Self::Sum(sum) => sum.parts.iter().map(|(surface, _)| surface.term_count()).sum(),
            Self::Face(field) => field.term_count(),
        }
    }
}

/// Returns the unit normal on the +z side of a surface z = f(x, y) from the gradient of f.
pub(super) fn normal_from_gradient([gx, gy]: [f64; 2]) -> Vector {
    Vector::new(-gx, -gy, 1.0).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::analytic::conic::{Asphere, Conic};
    use crate::surface::analytic::test_support::{disc, gradient_error};

    fn sphere(radius_mm: f64) -> AnalyticSurface {
        AnalyticSurface::Conic(Conic::new(radius_mm, 0.0).unwrap())
    }

    fn asphere() -> AnalyticSurface {
        let terms = [(4, 2e-8), (5, -1e-10), (6, 3e-13)];
        AnalyticSurface::Asphere(Asphere::new(Conic::new(300.0, -1.0).unwrap(), &terms).unwrap())
    }

    fn section(parent: AnalyticSurface, distance_mm: f64, azimuth_deg: f64, frame: SectionFrame) -> OffAxis {
        OffAxis::new(parent, distance_mm, f64::to_radians(azimuth_deg), frame).unwrap()
    }

    #[test]
    fn section_at_zero_distance_is_parent() {
        for frame in [SectionFrame::Parent, SectionFrame::Shifted, SectionFrame::Tilted] {
            let cut = section(asphere(), 0.0, 30.0, frame);
            for [x, y] in disc(80.0) {
                let (z, [gx, gy]) = cut.sag_and_gradient(x, y).unwrap();
                let (sag, [fx, fy]) = asphere().sag_and_gradient(x, y).unwrap();
                assert!((z - sag).abs() < 1e-13 && (gx - fx).abs() < 1e-14 && (gy - fy).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn tilted_section_of_sphere_is_sphere() {
        // Out to 99 of 100 mm, where the tangent plane at the centre has long left the parent's disc.
        for (radius_mm, azimuth_deg) in [(100.0, 0.0), (-100.0, 200.0)] {
            let cut = section(sphere(radius_mm), 60.0, azimuth_deg, SectionFrame::Tilted);
            let (mut defined, mut worst) = (0, 0.0f64);
            for [x, y] in disc(99.0) {
                let Some((z, [gx, gy])) = cut.sag_and_gradient(x, y) else { continue };
                let (sag, [fx, fy]) = sphere(radius_mm).sag_and_gradient(x, y).unwrap();
                worst = worst.max((z - sag).abs()).max((gx - fx).abs() * 0.01).max((gy - fy).abs() * 0.01);
                defined += 1;
            }
            assert!(worst < 1e-12, "{worst}");
            assert!(defined > disc(99.0).len() * 3 / 4, "{defined}");
        }
    }

    #[test]
    fn tilted_section_lies_on_parent() {
        for azimuth_deg in [0.0, 77.0, 180.0, 300.0] {
            let cut = section(asphere(), 120.0, azimuth_deg, SectionFrame::Tilted);
            let (z, gradient) = cut.sag_and_gradient(0.0, 0.0).unwrap();
            assert!(z.abs() < 1e-14 && gradient[0].abs() < 1e-15 && gradient[1].abs() < 1e-15);
            for [x, y] in disc(40.0) {
                let (z, _) = cut.sag_and_gradient(x, y).unwrap();
                let p = cut.centre + cut.parent_from_tilted * Vector::new(x, y, z);
                let (sag, _) = asphere().sag_and_gradient(p.x, p.y).unwrap();
                assert!((p.z - sag).abs() < 1e-13);
                assert!((cut.parent_place(x, y).unwrap()[0] - p.x).abs() < 1e-13);
            }
        }
    }

    #[test]
    fn shifted_paraboloid_by_hand() {
        let parabola = AnalyticSurface::Conic(Conic::new(100.0, -1.0).unwrap());
        let cut = section(parabola, 30.0, 90.0, SectionFrame::Shifted);
        // (x^2 + (y + 30)^2 - 900) / 200 at (10, 10).
        let (z, [gx, gy]) = cut.sag_and_gradient(10.0, 10.0).unwrap();
        assert!((z - 4.0).abs() < 1e-14 && (gx - 0.1).abs() < 1e-15 && (gy - 0.4).abs() < 1e-15);
    }

    #[test]
    fn off_axis_gradient_matches_sag() {
        for frame in [SectionFrame::Shifted, SectionFrame::Tilted] {
            let cut = section(asphere(), 90.0, 40.0, frame);
            assert!(gradient_error(&|x, y| cut.sag_and_gradient(x, y), 45.0) < 1e-11);
        }
    }

    #[test]
    fn off_axis_refuses_bad_sections() {
        let cut = |distance, azimuth| OffAxis::new(sphere(50.0), distance, azimuth, SectionFrame::Tilted);
        assert_eq!(cut(-1.0, 0.0).unwrap_err().key().as_deref(), Some("distance_mm"));
        assert_eq!(cut(f64::NAN, 0.0).unwrap_err().key().as_deref(), Some("distance_mm"));
        assert_eq!(cut(1.0, f64::INFINITY).unwrap_err().key().as_deref(), Some("azimuth_deg"));
        assert!(matches!(cut(50.0, 0.0), Err(DefinitionError::SectionOffParent { .. })));
    }
}
